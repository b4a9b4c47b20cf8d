"""Pictures of a diagnosis: runs before and after, what the error follows, gain, ranking."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, SymmetricalLogLocator
from numpy.typing import NDArray

from greybox.channels import CHANNELS, MOTION_WORDS
from greybox.diagnosis.result import Ranked, Runs
from greybox.report.error_profiles import Profile, profile
from greybox.report.figures import (
    BLACK,
    BLUE,
    LABELS,
    SKY,
    VERMILION,
    draw_line,
    label_axes,
    legend_outside,
    new_figure,
    run_axes,
)
from greybox.report.free_run_errors import REGIMES, Errors, simulated, simulations
from greybox.report.thinning import find_gaps
from greybox.validation.fit import LEFT
from greybox.validation.gain import Gain

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# inches: letters stay legible where the page is 390 px wide
_WIDTH = 4.4
_POINTS = 600
_COMPASS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
_SPEEDS = 8
_MOST_RANKED = 8
# fall of −2 log L up to which the ranking's axis is linear
_LINEAR = 10.0
# worse fits than this are drawn at the edge [%]
LOWEST_FIT = -50.0

_STYLE: Mapping[str, dict[str, Any]] = {
    "before": {"color": VERMILION, "linestyle": "--", "marker": "s"},
    "after": {"color": BLUE, "linestyle": "-", "marker": "o"},
    "simulated": {"color": BLUE, "linestyle": "-", "marker": "o"},
}
_SHORT = {state: f"{word} [{CHANNELS[state].unit}]" for state, word in MOTION_WORDS.items()}


def run_figure(run: Runs, points: int = _POINTS) -> Figure:
    """Draw each state of one log, measured and simulated, with the error below.

    Parameters
    ----------
    run : Runs
    points : int
        About how many a line has.
    """
    states = list(run.measured)
    shown = simulations(run)
    figure = new_figure(_WIDTH, 2.35 * len(states) + 0.5)
    t = run.log.t - run.log.t[0]
    gaps = find_gaps(t, run.log.sample_time)
    pairs = run_axes(figure, states, _SHORT, "error", 9)
    for state, (top, below) in zip(states, pairs, strict=True):
        measured = run.measured[state]
        spread, low, high = _room(measured)
        draw_line(top, t, measured, gaps, points, color=BLACK, linewidth=0.9, label="measured")
        for name in shown:
            style = {k: v for k, v in _STYLE[name].items() if k != "marker"}
            style |= {"linewidth": 1.2, "label": name}
            x = simulated(run, name, state)
            draw_line(top, t, np.clip(x, low, high), gaps, points, **style)
            draw_line(below, t, np.clip(measured - x, -spread, spread), gaps, points, **style)
        below.axhline(0, color=BLACK, linewidth=0.6)
    _legend(figure, pairs[0][0])
    return figure


def _room(measured: Array) -> tuple[float, float, float]:
    """Return the spread of a signal, and the limits within which a simulation is drawn."""
    spread = float(np.ptp(measured)) or 1.0
    return spread, measured.min() - 0.6 * spread, measured.max() + 0.6 * spread


def leaves_picture(run: Runs) -> bool:
    """Whether a simulation goes further than it is drawn."""
    for state, measured in run.measured.items():
        spread, low, high = _room(measured)
        for name in simulations(run):
            x = simulated(run, name, state)
            far = (x < low) | (x > high) | (np.abs(measured - x) > spread)
            if far.any():
                return True
    return False


def heading_figure(errors: Errors) -> Figure:
    """Draw the mean error of each state in sectors of the measured heading."""
    assert errors.heading is not None
    sectors = 12
    width = 2 * np.pi / sectors
    group = np.round(errors.heading / width).astype(int) % sectors
    place = np.arange(sectors) * 360.0 / sectors
    figure, axes = _profiles(errors, group, place, 360 / sectors)
    axes[-1].set_xticks(np.arange(0, 360, 45), _COMPASS)
    axes[-1].set_xlabel("measured heading", fontsize=9)
    return figure


def speed_figure(errors: Errors) -> Figure:
    """Draw the mean error of each state by speed, as many samples in each bin."""
    assert errors.speed is not None
    group, place = _bins(errors.speed)
    figure, axes = _profiles(errors, group, place, float(np.nanmin(np.diff(place), initial=1.0)))
    axes[-1].set_xlabel("simulated speed over ground [m/s]", fontsize=9)
    return figure


def command_figure(errors: Errors, name: str) -> Figure:
    """Draw the mean error of each state by a command, as many samples in each bin."""
    group, place = _bins(errors.commands[name])
    figure, axes = _profiles(errors, group, place, float(np.nanmin(np.diff(place), initial=1.0)))
    axes[-1].set_xlabel(f"command {name}, as logged", fontsize=9, parse_math=False)
    return figure


def most_followed(errors: Errors) -> str | None:
    """Return the command whose bins' means have the largest share of the squared errors."""
    first = next(iter(errors.error.values()))

    def share(value: Array) -> float:
        group, place = _bins(value)
        total = 0.0
        for error in first.values():
            known = np.isfinite(error)
            count = np.bincount(group[known], minlength=len(place))
            sums = np.bincount(group[known], error[known], minlength=len(place))
            squares = float((error[known] ** 2).sum())
            total += float((sums**2 / np.maximum(count, 1)).sum()) / max(squares, 1e-300)
        return total

    shares = {name: share(value) for name, value in errors.commands.items()}
    return max(shares, key=shares.__getitem__, default=None)


def _bins(value: Array) -> tuple[Index, Array]:
    """Return the bin of each sample (N,), −1 where it is no number, and the bins' means."""
    known = np.isfinite(value)
    edges = np.unique(np.quantile(value[known], np.linspace(0, 1, _SPEEDS + 1)[1:-1]))
    found = np.searchsorted(edges, value)
    # of a command with few values some bins stay empty
    used, dense = np.unique(found[known], return_inverse=True)
    group = np.full(len(value), -1)
    group[known] = dense
    return group, np.array([value[group == g].mean() for g in range(len(used))])


def _profiles(errors: Errors, group: Index, place: Array, step: float) -> tuple[Figure, list[Any]]:
    """Draw one pair of axes a state, one line a run."""
    states = errors.states
    figure = new_figure(_WIDTH, 1.55 * len(states) + 0.9)
    axes = list(figure.subplots(len(states), 1, sharex=True, squeeze=False)[:, 0])
    for ax, state in zip(axes, states, strict=True):
        drawn = []
        for j, (name, run) in enumerate(errors.error.items()):
            found = _profile(run[state], group, errors.blocks[name][state], len(place))
            drawn.append(found)
            shift = 0.12 * step * (j - (len(errors.error) - 1) / 2)
            ax.errorbar(
                place + shift, found.mean, yerr=found.half, label=name, linewidth=1.1,
                markersize=4, capsize=2, elinewidth=0.9, **_STYLE[name],
            )  # fmt: skip
        ax.axhline(0, color=BLACK, linewidth=0.7)
        _keep_in_view(ax, drawn)
        label_axes(ax, y=_SHORT.get(state, state))
        ax.yaxis.set_major_locator(MaxNLocator(4))
    _legend(figure, axes[0], enough=2)
    return figure, axes


def _profile(error: Array, group: Index, blocks: Index, groups: int) -> Profile:
    known = np.isfinite(error)
    return profile(error[known], group[known], blocks[known], groups)


def _keep_in_view(ax: Any, drawn: Sequence[Profile]) -> None:
    """Let the means rule the view: the interval of a bin hardly visited may leave it."""
    means = np.concatenate([p.mean for p in drawn])
    halves = np.concatenate([p.half for p in drawn])
    reach = np.abs(means) + np.minimum(np.nan_to_num(halves), 2 * np.nanmax(np.abs(means)))
    most = 1.1 * float(np.nanmax(reach))
    if most > 0:
        ax.set_ylim(-most, most)


def _legend(figure: Figure, ax: Any, *, enough: int = 1) -> None:
    """Put the legend above everything, where there are enough entries to need one."""
    if len(ax.get_legend_handles_labels()[1]) >= enough:
        look = {"fontsize": 8.5, "handlelength": 1.6, "columnspacing": 1.2}
        legend_outside(figure, ax, "upper left", 4, **look)


def regime_figure(errors: Errors) -> Figure:
    """Draw the root mean square error by the signs of surge and sway."""
    assert errors.regime is not None
    states = errors.states
    met = list(errors.regimes)
    figure = new_figure(_WIDTH, 1.55 * len(states) + 0.9)
    axes = list(figure.subplots(len(states), 1, sharex=True, squeeze=False)[:, 0])
    wide = 0.8 / len(errors.error)
    for ax, state in zip(axes, states, strict=True):
        for j, (name, run) in enumerate(errors.error.items()):
            found = _profile(
                run[state] ** 2, errors.regime, errors.blocks[name][state], len(REGIMES)
            )
            mean, half = found.mean[met], found.half[met]
            root = np.sqrt(mean)
            low = root - np.sqrt(np.maximum(mean - half, 0))
            high = np.sqrt(mean + half) - root
            ax.bar(
                np.arange(len(met)) + wide * (j - (len(errors.error) - 1) / 2), root, 0.92 * wide,
                yerr=[low, high], label=name, color=_STYLE[name]["color"], capsize=3,
                hatch="//" if name == "before" else None, edgecolor="white", linewidth=0,
                error_kw={"elinewidth": 0.9},
            )  # fmt: skip
        label_axes(ax, y=_SHORT.get(state, state))
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.set_ylim(bottom=0)
    total = len(errors.regime)
    axes[-1].set_xticks(
        range(len(met)),
        [f"{REGIMES[g]}\n{100 * (errors.regime == g).sum() / total:.0f} %" for g in met],
    )
    axes[-1].set_xlabel("signs of surge and sway, share of the time", fontsize=9)
    _legend(figure, axes[0], enough=2)
    return figure


def gain_figure(gain: Mapping[str, Gain], bounds: Mapping[str, float] | None = None) -> Figure:
    """Draw the fit of each state before and after, the interval of the gain on the latter.

    Parameters
    ----------
    gain : mapping of str to Gain
    bounds : mapping of str to float, optional
        What a perfect model would reach by state [%], measured with the noise of the sensors.
    """
    figure = new_figure(_WIDTH, 0.55 * len(gain) + 1.2)
    ax = figure.subplots()
    bounded = [i for i, state in enumerate(gain) if state in (bounds or {})]
    if bounds and bounded:
        highest = [bounds[s] for s in gain if s in bounds]
        ax.plot(
            highest, bounded, "|", color=BLACK, markersize=15, markeredgewidth=2, zorder=4,
            label="noise allows",
        )  # fmt: skip
    for i, g in enumerate(gain.values()):
        before, after = max(g.before, LOWEST_FIT), max(g.after, LOWEST_FIT)
        ax.plot([before, after], [i, i], color="0.6", linewidth=1.5, zorder=1)
        # what is gained on a run that leaves every bound has no size
        ends = [np.clip(g.before + c, LOWEST_FIT, 100) for c in g.ci] if g.before > LEFT else []
        ax.plot(ends, [i] * len(ends), color=SKY, linewidth=6, alpha=0.8, zorder=2,
                solid_capstyle="butt", label="gain, 95 %" if i == 0 else None)  # fmt: skip
        for name, value in (("before", before), ("after", after)):
            ax.plot(
                value, i, _STYLE[name]["marker"], color=_STYLE[name]["color"], markersize=7,
                markerfacecolor="white" if name == "before" else None, zorder=3,
                label=name if i == 0 else None, linestyle="none",
            )  # fmt: skip
    ax.axvline(100, color=BLACK, linewidth=0.7)
    names = [LABELS.get(s, s).split(" [")[0] for s in gain]
    label_axes(ax, "fit of the free run (6.12) [%], 100 is perfect")
    ax.set_yticks(range(len(gain)), names, fontsize=9)
    ax.set_ylim(len(gain) - 0.5, -0.5)
    _legend(figure, ax)
    return figure


def ranked_for_picture(step: Sequence[Ranked], kept: Sequence[str]) -> list[Ranked]:
    """Return the causes that a picture of a step shows, the best first.

    Parameters
    ----------
    step : sequence of Ranked
    kept : sequence of str
        Keys that are shown wherever they rank.
    """

    def merit(r: Ranked) -> tuple[bool, float]:
        return r.gain is not None, r.promise if r.gain is None else r.gain

    order = sorted(step, key=merit, reverse=True)
    shown = order[:_MOST_RANKED]
    return shown + [r for r in order[_MOST_RANKED:] if r.key in kept]


def ranking_figure(step: Sequence[Ranked], kept: Sequence[str]) -> Figure:
    """Draw the predicted, fitted and held-out gain of each cause at one step of the search.

    Parameters
    ----------
    step, kept
        As for `ranked_for_picture`; kept ones are set in bold.
    """
    rows = ranked_for_picture(step, kept)
    figure = new_figure(_WIDTH, 0.42 * len(rows) + 1.5)
    ax = figure.subplots()
    place = np.arange(len(rows))
    # a fit that left every bound has no bar
    gains = np.array(
        [np.nan if r.gain is None or not np.isfinite(r.gain) else r.gain for r in rows]
    )
    proofs = np.array([np.nan if r.held_out is None else r.held_out for r in rows])
    spread = np.array([0.0 if r.held_out_std is None else 1.96 * r.held_out_std for r in rows])
    ax.barh(place - 0.2, [r.promise for r in rows], 0.3, color="0.75", label="promised")
    ax.barh(place + 0.12, gains, 0.3, color=SKY, label="refitted")
    ax.errorbar(
        proofs, place + 0.12, xerr=spread, fmt="D", color=BLACK, markersize=4, capsize=3,
        linewidth=1.1, label="held-out, 95 %",
    )  # fmt: skip
    ax.axvline(0, color=BLACK, linewidth=0.7)
    ax.set_xscale("symlog", linthresh=_LINEAR)
    _few_decades(ax, np.concatenate([[r.promise for r in rows], gains, proofs]), proofs - spread)
    labels = [r.key.replace(":", ":\n", 1) if len(r.key) > 22 else r.key for r in rows]
    ax.set_yticks(place, labels, fontsize=8, parse_math=False)
    for tick, row in zip(ax.get_yticklabels(), rows, strict=True):
        tick.set_fontweight("bold" if row.key in kept else "normal")
    ax.set_ylim(len(rows) - 0.5, -0.6)
    label_axes(ax, "fall of −2 log L")
    _legend(figure, ax)
    return figure


def _few_decades(ax: Any, values: Array, lows: Array) -> None:
    """Set limits and so few ticks that their labels stay apart."""
    most = max(float(np.nanmax(values)), _LINEAR)
    least = min(float(np.nanmin(np.append(lows, 0.0))), 0.0)
    ax.set_xlim(1.6 * least if least < 0 else 0, 2.0 * most)
    locator = SymmetricalLogLocator(base=10, linthresh=_LINEAR)
    locator.set_params(numticks=7)
    ax.xaxis.set_major_locator(locator)
