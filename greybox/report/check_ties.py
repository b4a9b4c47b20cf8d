"""Pictures of defects of the kinematics: velocities from positions against those logged.

Every picture has the log before in its upper row and mended in its lower row.
What else was found is mended in both, so that a picture shows one finding only.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from greybox.channels import CHANNELS
from greybox.report.agreement import (
    Agreement,
    Widths,
    compare,
    constant_drift,
    find_widths,
    shifted,
    smoothed,
)
from greybox.report.check_rows import label_of
from greybox.report.figures import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
    draw_line,
    label_axes,
    legend_above,
    legend_outside,
    new_figure,
)
from greybox.report.thinning import find_gaps
from greybox.trial.checks.finding import CheckReport, Finding
from greybox.trial.checks.motion import NAMES, Motion, make_motion
from greybox.trial.raw_log import Recording
from greybox.trial.repair import apply_repairs
from greybox.trial.steps import Step
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

_DOTS = 250
_LAGS = 41
_CURVE_SAMPLES = 12_000
# what a mended pair must change by to be worth a column, in shares of the largest change
# logarithm of the disagreement's change below which a repair is no help
_LEAST_HELP = -0.01
_LEAST_CHANGE = 0.03
# smoothing goes on until the disagreement that is left is this share of that before
_CLEAR = 0.35
_WIDER = (1.0, 2.0, 4.0, 8.0)
_SPEED_SHARE = 0.3
_LONGEST = 300.0


@dataclass(frozen=True)
class Tie:
    """A log before and after one repair.

    Parameters
    ----------
    before, after : Agreement
    motion, mended : Motion
        Before and after.
    widths : Widths
        By which both were smoothed.
    names : tuple of str
        Of ``u, v, r``: those that the repair touches.
    drift : tuple of float
        Constant velocity, north and east [m/s], that only the positions have.
    antenna : tuple of float
    others : bool
        Whether other findings were mended in both.
    """

    before: Agreement
    after: Agreement
    motion: Motion
    mended: Motion
    widths: Widths
    names: tuple[str, ...]
    drift: tuple[float, float]
    antenna: tuple[float, float]
    others: bool

    @property
    def helps(self) -> bool:
        """Whether the repair brings the velocities closer, all in all."""
        ratio = [self.after.rms(n) / max(self.before.rms(n), 1e-12) for n in self.names]
        return float(np.mean(np.log(np.maximum(ratio, 1e-12)))) < _LEAST_HELP


def make_tie(finding: Finding, report: CheckReport, vessel: Vessel) -> Tie | None:
    """Compare a log before and after the repair of one finding.

    Parameters
    ----------
    finding : Finding
    report : CheckReport
        Its other findings are mended in both.
    vessel : Vessel
        Its antenna is where the positions are taken to be measured.

    Returns
    -------
    Tie or None
        None where the log has nothing to compare.
    """
    recording = report.recording
    if recording is None or not finding.repair:
        return None
    others = [f for f in report.findings if f is not finding and f.repair]
    mended = _motion(recording, report.findings)
    as_logged = _motion(recording, [f for f in report.findings if f is not finding])
    if mended is None or as_logged is None:
        return None
    antenna = tuple(float(a) for a in vessel.sensors.get("antenna", (0.0, 0.0))[:2])
    at = (antenna[0], antenna[1])
    widths = find_widths(mended)
    affects = any(_reaches(f) for f in others)
    best: tuple[float, Tie] | None = None
    for factor in _WIDER:
        wide = widths.times(factor)
        drift = constant_drift(compare(smoothed(mended, wide, mended), at))
        after = compare(smoothed(mended, wide, mended), at, drift)
        before = compare(smoothed(as_logged, wide, mended), at, drift)
        names = _touched(finding, before, after)
        if not names or (best is not None and wide.position > 0.05 * np.ptp(after.t)):
            continue
        # a slow disagreement drowns in the noise of derivatives until these are smoothed enough
        left = float(np.mean([after.rms(n) / before.rms(n) for n in names]))
        if best is None or left < 0.9 * best[0]:
            tie = Tie(before, after, as_logged, mended, wide, names, drift, at, affects)
            best = (left, tie)
        if left < _CLEAR:
            break
    return None if best is None else best[1]


def _motion(recording: Recording, findings: Sequence[Finding]) -> Motion | None:
    return make_motion(apply_repairs(recording, findings))


def _reaches(f: Finding) -> bool:
    """Whether a finding changes what velocities and positions say, beyond single samples."""
    return any(
        s.operation not in ("drop", "interpolate", "order") and set(s.channels) & set(NAMES)
        for s in f.repair
    )


def _touched(finding: Finding, before: Agreement, after: Agreement) -> tuple[str, ...]:
    """Return the pairs that a repair changes, of those that hold its channels."""
    change: dict[str, float] = {}
    for name in before.logged:
        tied = {"r", "psi"} if name == "r" else {"x_n", "y_n", "u", "v", "psi"}
        if name in after.logged and tied & set(finding.channels):
            one, two = before.rms(name), after.rms(name)
            size = float(np.nanstd(after.logged[name])) or 1.0
            if np.isfinite(one) and np.isfinite(two):
                change[name] = abs(one - two) / max(size, two, 1e-12)
    most = max(change.values(), default=0.0)
    return tuple(n for n in change if change[n] >= _LEAST_CHANGE * most and change[n] > 0)


def tie_figure(finding: Finding, tie: Tie) -> Figure:
    """Draw the disagreement of velocities before and after a repair.

    Parameters
    ----------
    finding : Finding
    tie : Tie
        Of that finding.
    """
    names = tie.names
    beside = {"clock_offset": 1, "lever_arm": 2, "heading_bias": 1}.get(finding.id, 0)
    if beside and len(names) > 2:
        names = _two_clearest(tie)
    if finding.id in ("lever_arm", "heading_bias"):
        names = tuple(n for n in names if n != "r") or names
    figure = new_figure(10.5, 5.6)
    columns = len(names)
    grid = figure.add_gridspec(
        2, columns + beside, width_ratios=[1.45] * columns + [1.0 if beside > 1 else 1.25] * beside
    )
    span = _window(finding, tie, names)
    for j, name in enumerate(names):
        pair = [figure.add_subplot(grid[i, j]) for i in (0, 1)]
        _draw_pair(pair, finding, tie, name, span)
    legend_outside(figure, figure.axes[0], "lower center", 3, fontsize=9)
    if finding.id == "clock_offset":
        _draw_curve(figure.add_subplot(grid[:, columns]), finding, tie)
    elif finding.id == "lever_arm":
        cells = [[figure.add_subplot(grid[i, columns + j]) for j in (0, 1)] for i in (0, 1)]
        _draw_slopes(cells, finding, tie)
    elif finding.id == "heading_bias":
        _draw_angles(figure.add_subplot(grid[:, columns]), finding, tie)
    figure.suptitle(title_of(finding), fontsize=11)
    return figure


def title_of(finding: Finding) -> str:
    """Return what a finding is, in a few words."""
    names = ", ".join(finding.channels or (finding.channel,))
    value = finding.value
    if finding.id == "actuator" and isinstance(value, float):
        return f"{names.replace(', ', ' after ')}: delay and lag of {value:.2g} s"
    if finding.id == "external_force" and isinstance(value, float):
        return f"A force from outside: {100 * value:.0f} % of the thrust at half speed"
    if finding.id == "clock_offset" and isinstance(value, float):
        return f"Clock of {names}: {abs(value):.2f} s {'late' if value > 0 else 'early'}"
    if finding.id == "heading_bias" and isinstance(value, float):
        turned = "clockwise" if value > 0 else "anticlockwise"
        return f"Heading bias: {abs(np.degrees(value)):.1f} deg {turned}"
    if finding.id == "lever_arm" and isinstance(value, tuple):
        return signed(f"Antenna at {value[0]:+.2f} m forward, {value[1]:+.2f} m to starboard")
    words = {"unit": "Unit", "frame": "Frame", "sign": "Sign or order"}
    return f"{words.get(finding.id, finding.id)} of {names}"


def mended_in_words(steps: Sequence[Step]) -> str:
    """Return what repairs do, in a few words."""
    said = []
    for s in steps:
        names = ", ".join(s.channels)
        if s.operation == "shift":
            said.append(f"{names} shifted by {-s.number('late'):+.2f} s")
        elif s.operation == "scale":
            said.append(
                f"{names} reversed"
                if s.number("factor") == -1
                else f"{names} times {s.number('factor'):.4g}"
            )
        elif s.operation == "exchange":
            said.append(f"{' and '.join(s.channels)} exchanged")
        elif s.operation == "earth_to_body":
            said.append("turned into body axes")
        elif s.operation == "turn_heading":
            said.append(f"heading turned by {-np.degrees(s.number('angle')):+.1f} deg")
        elif s.operation == "offset":
            said.append(f"{np.degrees(s.number('offset')):+.0f} deg added to {names}")
        elif s.operation == "move_antenna":
            said.append("positions moved by the arm")
    return signed(", ".join(said)) or "mended"


def signed(text: str) -> str:
    """Return a text with minus signs instead of hyphens before numbers."""
    return re.sub(r"(?<![\w.])-(?=\d)", "−", text)


def _two_clearest(tie: Tie) -> tuple[str, ...]:
    # a repair that makes a pair worse must show as well
    gain = {
        n: abs(np.log(max(tie.before.rms(n), 1e-12) / max(tie.after.rms(n), 1e-12)))
        for n in tie.names
    }
    kept = sorted(gain, key=lambda n: -gain[n])[:2]
    return tuple(n for n in tie.names if n in kept)


def _window(finding: Finding, tie: Tie, names: tuple[str, ...]) -> tuple[float, float]:
    """Return the span of time in which the repair helps most."""
    t = tie.before.t
    step = tie.motion.step
    total = float(t[-1] - t[0])
    length = max(0.25 * total, 60 * step)
    if finding.id == "clock_offset":
        # short enough that the eye sees the shift
        length = max(40 * abs(float(np.asarray(finding.value))), 40 * step)
    length = min(max(length, 30 * step), max(400 * step, _LONGEST), total)
    score = np.zeros(len(t))
    for n in names:
        size = max(tie.before.rms(n), 1e-12)
        one = np.abs(tie.before.implied[n] - tie.before.logged[n])
        two = np.interp(t, tie.after.t, np.abs(tie.after.implied[n] - tie.after.logged[n]))
        # a jump of the positions, which no repair takes away, must not decide
        score += np.nan_to_num(np.minimum(one / size, 2.5) - np.minimum(two / size, 2.5))
    width = max(min(round(length / step), len(t)), 1)
    rolling = np.convolve(score, np.ones(width), mode="valid")
    # a window over a gap would be half empty
    spans = t[width - 1 :] - t[: len(t) - width + 1]
    rolling = np.where(spans < 1.3 * width * step, rolling, -np.inf)
    k = int(np.argmax(rolling))
    return float(t[k]), float(t[min(k + width, len(t)) - 1])


def _draw_pair(
    pair: Sequence[Any], finding: Finding, tie: Tie, name: str, span: tuple[float, float]
) -> None:
    said = ("as logged", mended_in_words(finding.repair))
    if tie.others:
        said = ("as logged, rest mended", said[1])
    source = "from the heading" if tie.names == ("r",) else "from positions and heading"
    limits = []
    for ax, agreement, words in zip(pair, (tie.before, tie.after), said, strict=True):
        t = agreement.t
        inside = (t >= span[0]) & (t <= span[1])
        value = {"logged": agreement.logged[name], "implied": agreement.implied[name]}
        for key, colour, style, text in (
            ("logged", BLUE, "-", "logged"),
            ("implied", VERMILION, "--", source),
        ):
            shown = np.interp(t[inside], t, value[key])
            gaps = find_gaps(t[inside], tie.motion.step)
            look: dict[str, Any] = {"linestyle": style, "color": colour, "linewidth": 1.3}
            draw_line(ax, t[inside], shown, gaps, 400, label=text, **look)
        title = f"{words}:\n{agreement.rms(name):.3g} {CHANNELS[name].unit} apart (RMS)"
        label_axes(ax, y=label_of(name, None), title=title)
        ax.set_xlim(*span)
        limits.append(ax.get_ylim())
    (a, b), (c, d) = limits
    # one scale shows the gain, unless it would flatten one of them
    if max(b - a, d - c) < 4 * min(b - a, d - c):
        for ax in pair:
            ax.set_ylim(min(a, c), max(b, d))
    pair[0].tick_params(labelbottom=False)
    pair[1].set_xlabel("time [s]", fontsize=9)


def _draw_curve(ax: Any, finding: Finding, tie: Tie) -> None:
    """Draw the disagreement against a shift of the late channels."""
    value = float(np.asarray(finding.value))
    reach = max(2.5 * abs(value), 6 * tie.motion.step)
    lags = np.linspace(value - reach, value + reach, _LAGS)
    motion = tie.motion.excerpt(_CURVE_SAMPLES)
    # samples that a shift takes from beyond the ends of their stretch
    ends = np.zeros(len(motion), bool)
    for a, b in motion.stretches:
        far = min(int(max(abs(lags[0]), abs(lags[-1])) / motion.step) + 1, (b - a) // 3)
        ends[a : a + far] = ends[b - far : b] = True
    curves: dict[str, list[float]] = {n: [] for n in tie.names}
    for lag in lags:
        late = shifted(motion, finding.channels, float(lag))
        shown = compare(smoothed(late, tie.widths, tie.mended), tie.antenna, tie.drift)
        for n, curve in curves.items():
            gap = np.where(ends, np.nan, shown.implied[n] - shown.logged[n])
            curve.append(float(np.sqrt(np.nanmean(gap**2))))
    for (n, curve), colour, style in zip(
        curves.items(), (BLUE, ORANGE, GREEN), ("-", "--", "-."), strict=False
    ):
        at_zero = float(np.interp(0.0, lags, curve))
        ax.plot(lags, 100 * np.array(curve) / at_zero, style, color=colour, linewidth=1.4, label=n)
    ax.axvspan(*finding.ci, color=VERMILION, alpha=0.25, linewidth=0, label="95 % interval")
    ax.axvline(value, color=VERMILION, linewidth=1.2, label=signed(f"estimate {value:+.2f} s"))
    ax.axvline(0, color=BLACK, linewidth=0.8, linestyle=":")
    ax.set_ylim(bottom=0)
    taken = f"{', '.join(finding.channels)} taken to be late by [s]"
    label_axes(ax, taken, "disagreement [% of that as logged]")
    legend_above(ax, side="center", columns=2, columnspacing=1.0, handlelength=1.6)


def _draw_slopes(cells: Sequence[Sequence[Any]], finding: Finding, tie: Tie) -> None:
    """Draw the disagreement against the rate of turn: an arm is a slope."""
    assert isinstance(finding.value, tuple)
    arm = np.array([finding.repair[0].number("x"), finding.repair[0].number("y")])
    for row, agreement, words in zip(
        cells, (tie.before, tie.after), ("as logged", "mended"), strict=True
    ):
        turn = agreement.turn
        fast = np.nanquantile(np.abs(turn), 0.995)
        for ax, name, slope, said in zip(
            row, ("v", "u"), (arm[0], -arm[1]), ("forward", "starboard"), strict=True
        ):
            rest = agreement.implied[name] - agreement.logged[name]
            keep = np.isfinite(rest) & (np.abs(turn) <= fast)
            every = max(1, -(-int(keep.sum()) // _DOTS))
            ax.plot(
                turn[keep][::every], rest[keep][::every], ".", color=BLUE, markersize=2,
                alpha=0.6,
            )  # fmt: skip
            ends = np.array([-fast, fast])
            ax.plot(ends, slope * ends, color=VERMILION, linewidth=1.3)
            length = slope if name == "v" else -slope
            ax.set_title(signed(f"{words}; line: arm\n{length:+.2f} m {said}"), fontsize=9)
            label_axes(ax, y=f"{name} from positions − logged [m/s]", size=8)
    for j in (0, 1):
        low = min(cells[i][j].get_ylim()[0] for i in (0, 1))
        high = max(cells[i][j].get_ylim()[1] for i in (0, 1))
        for i in (0, 1):
            cells[i][j].set_ylim(low, high)
        cells[0][j].tick_params(labelbottom=False)
        cells[1][j].set_xlabel("rate of turn [rad/s]", fontsize=9)


def _draw_angles(ax: Any, finding: Finding, tie: Tie) -> None:
    """Draw by how much positions and velocities disagree in direction, against heading."""
    value = float(np.asarray(finding.value))
    far = 0.0
    for agreement, colour, marker, words in (
        (tie.before, VERMILION, ".", "as logged"), (tie.after, BLUE, ".", "mended"),
    ):  # fmt: skip
        implied = agreement.implied["u"] + 1j * agreement.implied["v"]
        logged = agreement.logged["u"] + 1j * agreement.logged["v"]
        fast = _SPEED_SHARE * np.nanquantile(np.abs(logged), 0.9)
        keep = np.isfinite(implied) & (np.abs(logged) > fast) & (np.abs(implied) > 0)
        # the track lies anticlockwise of the logged direction where the heading is too large
        angle = np.degrees(np.angle(logged[keep] * np.conj(implied[keep])))
        heading = np.degrees(agreement.psi[keep]) % 360
        every = max(1, -(-len(angle) // _DOTS))
        ax.plot(
            heading[::every], angle[::every], marker, color=colour, markersize=2.5, alpha=0.7,
            label=words,
        )  # fmt: skip
        far = max(far, float(np.quantile(np.abs(angle), 0.99)) if len(angle) else 0.0)
    ax.axhline(np.degrees(value), color=BLACK, linewidth=1.2, linestyle="--", label="estimate")
    ax.axhline(0, color=BLACK, linewidth=0.6)
    # mended angles scatter about zero as far as those as logged do about the estimate
    beyond = 1.2 * max(far - abs(np.degrees(value)), 0.1 * abs(np.degrees(value)))
    ends = sorted((0.0, float(np.degrees(value))))
    ax.set_ylim(ends[0] - beyond, ends[1] + beyond)
    ax.set_xlim(0, 360)
    ax.set_xticks(range(0, 361, 90))
    label_axes(ax, "heading [deg]", "direction of u, v and ψ − direction of the track [deg]")
    close: dict[str, Any] = {"columnspacing": 1.0, "handletextpad": 0.3, "markerscale": 3}
    legend_above(ax, side="center", columns=3, **close)
