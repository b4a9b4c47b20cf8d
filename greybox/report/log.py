"""Pictures of one log before any model: track, motion, inputs and wind."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MultipleLocator
from numpy.typing import NDArray

from greybox.errors import so_many
from greybox.report.figures import (
    BLACK,
    COLOURS,
    LEGEND_ROW,
    ORANGE,
    STYLES,
    draw_line,
    label_axes,
    legend_above,
    legend_columns,
    new_figure,
    shorten,
)
from greybox.report.thinning import find_gaps, longest
from greybox.report.track import draw_track
from greybox.trial.log import TrialLog
from greybox.trial.wind import direction_from, true_wind
from greybox.units import spelled_unit

Array = NDArray[np.float64]

# of gaps and of spans under a controller: more would be one grey block anyway
_MOST_SPANS = 300
_HOURS_FROM = 3 * 3600.0
_LONG_NAME = 18
_LONGEST_LABEL = 40
# inches: letters stay legible where the page is 390 px wide
_PHONE = 4.8
_DOTS = 1500
_GREY = "0.82"
_DEGREES = (1, 2, 5, 10, 15, 30, 45, 90, 180, 360, 720, 1440, 3600, 7200, 36000)


@dataclass(frozen=True)
class _Clock:
    """Time as it is drawn, with the gaps worth drawing."""

    time: Array
    unit: str
    gaps: NDArray[np.intp]
    all_gaps: NDArray[np.intp]


@dataclass(frozen=True)
class _Panel:
    """Signals of one unit that share one pair of axes."""

    label: str
    lines: Mapping[str, Array]
    kind: Literal["number", "angle", "direction"] = "number"
    controlled: Sequence[tuple[float, float]] = field(default=())


def page_figures(log: TrialLog, points: int = 2000) -> dict[str, Figure]:
    """Draw one log, as far as it has the channels, in two parts that are legible on a phone.

    Gaps (steps above 1.5 sample times) interrupt the lines and are shaded. Long
    logs are drawn by their envelopes, no peak lost.

    Parameters
    ----------
    log : TrialLog
    points : int
        About how many a line has.

    Returns
    -------
    dict of str to Figure
        ``track`` with north up where the log has positions, and ``signals``, states, inputs
        and wind, with one time axis.
    """
    clock = _clock(log)
    figures: dict[str, Figure] = {}
    if "x_n" in log and "y_n" in log:
        figures["track"] = new_figure(_PHONE, _PHONE)
        draw_track(figures["track"].subplots(), log, clock.gaps, points)
    panels = [*_states(log), *_inputs(log, clock), *_wind(log)]
    if panels:
        labels = [[shorten(name, _LONGEST_LABEL) for name in panel.lines] for panel in panels]
        more = sum(-(-len(names) // legend_columns(names, _PHONE)) - 1 for names in labels)
        height = 1.25 * len(panels) + 0.6 + LEGEND_ROW * more
        figures["signals"] = new_figure(_PHONE, height)
        axes = figures["signals"].subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        _draw(list(axes), panels, clock, points)
    return figures


def facts(log: TrialLog) -> str:
    """Return how long a log is, and its gaps, in words."""
    return _facts(log, _clock(log))


def _clock(log: TrialLog) -> _Clock:
    time = log.t - log.t[0]
    unit = "s"
    if time[-1] > _HOURS_FROM:
        time, unit = time / 3600, "h"
    gaps = find_gaps(log.t, log.sample_time)
    return _Clock(time, unit, longest(gaps, log.t, _MOST_SPANS), gaps)


def _states(log: TrialLog) -> Iterator[_Panel]:
    speeds = {f"{word} {n}": log[n] for n, word in (("u", "surge"), ("v", "sway")) if n in log}
    if speeds:
        yield _Panel("velocity over\nground [m/s]", speeds)
    if "r" in log:
        yield _Panel("yaw rate r\n[deg/s]", {"r": np.degrees(log["r"])})
    if "psi" in log:
        yield _Panel("heading ψ\n[deg]", {"ψ": np.degrees(log["psi"])}, "angle")


def _inputs(log: TrialLog, clock: _Clock) -> Iterator[_Panel]:
    units = {m.name: m.unit for m in log.vessel.columns.values()}
    speeds: dict[str, dict[str, Array]] = {}
    angles: dict[str, Array] = {}
    for name in log.vessel.commands:
        if name not in log:
            continue
        if name in log.vessel.angle_commands:
            angles[name] = np.degrees(log[name])
        else:
            unit = units.get(name) or _split_unit(name)[1] or "unit of the log"
            speeds.setdefault(unit, {})[name] = log[name]
    controlled = _controlled(log, clock)
    for unit, lines in speeds.items():
        yield _Panel(f"propeller speed{_only(lines)}\n[{unit}]", lines, "number", controlled)
    if angles:
        rudders = {t.rudder for t in log.vessel.thrusters}
        word = "rudder angle" if angles.keys() <= rudders else "thruster angle"
        yield _Panel(f"{word}{_only(angles)}\n[deg]", angles, "angle", controlled)


def _only(lines: Mapping[str, Array]) -> str:
    """Return the name of a single line, which needs no legend; on a line of its own if long."""
    if len(lines) != 1:
        return ""
    # a unit within the column's name would stand beside the axis's own
    name = _split_unit(next(iter(lines)))[0]
    name = name if len(name) <= _LONG_NAME else f"{name[: _LONG_NAME - 1]}…"
    return f" {name}" if len(name) <= 5 else f"\n{name}"


def _split_unit(name: str) -> tuple[str, str]:
    """Return a column's name without the unit in brackets that ends it, and that unit."""
    found = re.search(r"\s*[\[(]([^\])]*)[\])]\s*$", name)
    unit = spelled_unit(found[1]) if found else None
    return (name[: found.start()], unit) if found and unit else (name, "")


def _controlled(log: TrialLog, clock: _Clock) -> list[tuple[float, float]]:
    """Return start and length of the spans in which a controller moves the thrusters."""
    if not log.loop_known or not log.closed_loop.any():
        return []
    change = np.diff(np.r_[0, log.closed_loop.astype(int), 0])
    start, stop = np.flatnonzero(change > 0), np.flatnonzero(change < 0) - 1
    if len(start) > _MOST_SPANS:
        return []
    return [
        (clock.time[a], clock.time[b] - clock.time[a]) for a, b in zip(start, stop, strict=True)
    ]


def _wind(log: TrialLog) -> Iterator[_Panel]:
    if not log.has_wind:
        return
    u_q, v_q = log["u_q"], log["v_q"]
    if all(n in log for n in ("psi", "u", "v")):
        speed, origin = direction_from(*true_wind(u_q, v_q, log["psi"], log["u"], log["v"]))
        yield _Panel("true wind\nspeed [m/s]", {"speed": speed})
        yield _Panel("true wind from\n[deg from north]", {"from": np.degrees(origin)}, "direction")
        return
    yield _Panel("apparent wind\nspeed [m/s]", {"speed": np.hypot(u_q, v_q)})
    origin = np.degrees(np.arctan2(v_q, u_q))
    yield _Panel("apparent wind from\n[deg from bow]", {"from": origin}, "direction")


def _facts(log: TrialLog, clock: _Clock) -> str:
    found = [
        f"{so_many(len(log), 'sample')} of {log.sample_time:g} s",
        f"{log.t[-1] - log.t[0]:.6g} s from t = {log.t[0]:.10g} s",
    ]
    gaps = clock.all_gaps
    if len(gaps):
        missing = float(np.sum(log.t[gaps + 1] - log.t[gaps] - log.sample_time))
        found.append(f"{so_many(len(gaps), 'gap')}, {missing:.6g} s missing")
    else:
        found.append("no gaps")
    if log.loop_known:
        found.append(f"{100 * log.closed_loop.mean():.0f} % under a controller")
    return ", ".join(found)


def _draw(axes: list[Any], panels: Sequence[_Panel], clock: _Clock, points: int) -> None:
    for ax, panel in zip(axes, panels, strict=True):
        if panel.kind == "direction":
            _draw_direction(ax, panel, clock, min(points, _DOTS))
        else:
            _draw_lines(ax, panel, clock, points)
        label_axes(ax, y=panel.label, size=8)
        ax.tick_params(labelbottom=ax is axes[-1])
        # bars reach over the whole height whatever the values are
        across = ax.get_xaxis_transform()
        time = clock.time
        spans = [(time[k], time[k + 1] - time[k]) for k in clock.gaps]
        if spans:
            ax.broken_barh(
                spans, (0, 1), transform=across, color=_GREY, linewidth=0.5, zorder=0, label="gap"
            )
        if panel.controlled:
            ax.broken_barh(
                list(panel.controlled),
                (0, 0.05),
                transform=across,
                color=ORANGE,
                linewidth=0,
                zorder=0,
                label="controller on",
            )
        shown = len(panel.lines) > 1 or panel.controlled or (spans and ax is axes[0])
        if shown:
            handles, labels = ax.get_legend_handles_labels()
            if len(panel.lines) == 1:
                # the label of the axis names the only line
                handles, labels = handles[1:], labels[1:]
            labels = [shorten(label, _LONGEST_LABEL) for label in labels]
            look: dict[str, Any] = {"borderaxespad": 0.1, "handlelength": 1.6}
            columns = legend_columns(labels, _PHONE)
            legend_above(ax, handles, labels, columns=columns, columnspacing=1.2, **look)
    if axes:
        axes[0].figure.align_ylabels(axes)
        axes[-1].set_xlabel(f"time from the first sample [{clock.unit}]", fontsize=9)
        if len(clock.time) > 1:
            axes[0].set_xlim(clock.time[0], clock.time[-1])


def _draw_lines(ax: Any, panel: _Panel, clock: _Clock, points: int) -> None:
    for j, (name, value) in enumerate(panel.lines.items()):
        colour = COLOURS[j % 6] if len(panel.lines) > 1 else BLACK
        look: dict[str, Any] = {"color": colour, "linestyle": STYLES[j % 4], "linewidth": 0.9}
        draw_line(ax, clock.time, value, clock.gaps, points, label=name, **look)
    if panel.kind == "angle":
        ax.yaxis.set_major_locator(_degree_ticks(panel.lines.values()))


def _degree_ticks(values: Any) -> Any:
    spread = max(float(v.max()) for v in values) - min(float(v.min()) for v in values)
    step = next((d for d in _DEGREES if spread <= 4 * d), None)
    return MultipleLocator(step or 10 ** np.ceil(np.log10(spread / 4)))


def _draw_direction(ax: Any, panel: _Panel, clock: _Clock, dots: int) -> None:
    """Draw a direction on a circle as dots: lines would jump across the page at 0/360."""
    ((name, value),) = panel.lines.items()
    radians = np.radians(value)
    mean = np.degrees(np.arctan2(np.sin(radians).mean(), np.cos(radians).mean()))
    near = mean + np.mod(value - mean + 180, 360) - 180
    if np.ptp(near) > 270:
        near = np.mod(value, 360)
    # extremes of a circle mean little: every so many samples, not the envelope
    index = np.arange(0, len(near), -(-len(near) // dots))
    ax.plot(
        clock.time[index],
        near[index],
        linestyle="none",
        marker=".",
        markersize=1.8,
        color=BLACK,
        label=name,
    )
    low, high = float(near.min()), float(near.max())
    step = next(d for d in (5, 10, 15, 30, 45, 90) if high - low <= 4 * d or d == 90)
    low, high = step * np.floor(low / step), step * np.ceil(high / step + 1e-9)
    ax.yaxis.set_major_locator(FixedLocator(np.arange(low, high + step / 2, step).tolist()))
    ax.yaxis.set_major_formatter(
        FuncFormatter(lambda y, _: f"{y if 0 <= y <= 360 else y % 360:.0f}")
    )
    margin = 0.05 * (high - low)
    ax.set_ylim(low - margin, high + margin)
