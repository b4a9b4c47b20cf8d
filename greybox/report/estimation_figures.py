"""Pictures of an estimate: intervals, residuals, what the log visited, correlations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray

from greybox.estimation.summary import Pieces
from greybox.estimation.tried import Comparison
from greybox.report.figures import (
    BLACK,
    BLUE,
    COLOURS,
    LABELS,
    ORANGE,
    SKY,
    VERMILION,
    label_axes,
    legend_outside,
    new_figure,
    shorten,
)

Array = NDArray[np.float64]

# inches: letters stay legible where the page is 390 px wide
_WIDTH = 5.2
_NARROW = 4.4
# of the value: an interval that reaches further is drawn to the edge [%]
REACH = 200.0
_DOTS = 3000
# alternatives that a picture has room for, the best ones; letters of their labels
MOST_DRAWN = 30
_LABEL = 40
_MARKERS = ("o", "s", "^", "D", "v", "x")


def forest_figure(
    labels: Sequence[str],
    theta: Array,
    std: Array,
    sets: Mapping[str, Pieces],
    doubtful: Sequence[str],
) -> Figure:
    """Draw each parameter's 95 % interval relative to its value.

    Parameters
    ----------
    labels : sequence of str
        With units.
    theta, std : ndarray
        (p,)
    sets : mapping of str to pieces
        Intervals that hold under weak instruments, by label without unit.
    doubtful : sequence of str
        Labels, without unit, that the verdict excepts.
    """
    names = [label.split(" [")[0] for label in labels]
    figure = new_figure(_NARROW, 0.25 * len(labels) + 1.3)
    ax = figure.subplots()
    size = np.where(theta == 0, 1.0, np.abs(theta)) / 100
    half = np.minimum(1.96 * std / size, 2 * REACH)
    for i, name in enumerate(names):
        pieces = sets.get(name, ())
        told = "if weak" if name == next(iter(sets), None) else "_"
        for low, high in pieces:
            ends = [
                np.clip((e - theta[i]) / size[i], -2 * REACH, 2 * REACH)
                for e in (-np.inf if low is None else low, np.inf if high is None else high)
            ]
            ax.plot(
                ends, [i, i], color=SKY, linewidth=6, alpha=0.6, solid_capstyle="butt", label=told
            )
    fine = np.array([n not in doubtful for n in names])
    for chosen, colour, marker, told in (
        (fine, BLUE, "o", "95 %"), (~fine, VERMILION, "s", "not to rely on"),
    ):  # fmt: skip
        if chosen.any():
            place = np.flatnonzero(chosen)
            ax.errorbar(
                np.zeros(len(place)), place, xerr=half[chosen], fmt=marker, color=colour,
                markersize=4.5, capsize=3, linewidth=1.3, label=told,
            )  # fmt: skip
    ax.axvline(-100, color=BLACK, linewidth=0.7, linestyle=":")
    ax.axvline(100, color=BLACK, linewidth=0.7, linestyle=":")
    widest = float(np.nanmax(half, initial=20.0))
    reach = float(np.clip(1.15 * widest, 30.0, REACH))
    ax.set_xlim(-reach, reach)
    ax.set_yticks(range(len(labels)), labels, fontsize=8, parse_math=False)
    ax.set_ylim(len(labels) - 0.5, -0.5)
    ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:+.0f}" if v else "0"))
    label_axes(ax, "distance from the estimate [% of it], zero at −100 %", size=8.5)
    _legend(figure, ax, 3)
    return figure


def tried_figure(comparison: Comparison) -> Figure:
    """Draw the score of each alternative with its standard error, the best as a line.

    An alternative whose bar reaches the line is as good as the best by one standard error.
    """
    scored = [r for r in comparison.ordered if r.score is not None]
    rows = [r for i, r in enumerate(scored) if i < MOST_DRAWN or r.chosen]
    figure = new_figure(_WIDTH, (0.3 if len(rows) < 15 else 0.2) * len(rows) + 1.1)
    ax = figure.subplots()
    scores = np.array([r.score for r in rows], float)
    errors = np.array([r.se or 0.0 for r in rows])
    taken = np.array([r.chosen for r in rows])
    for which, colour, marker, said in (
        (~taken, BLUE, "o", "tried"), (taken, VERMILION, "D", "chosen"),
    ):  # fmt: skip
        if which.any():
            ax.errorbar(
                scores[which], np.flatnonzero(which), xerr=errors[which], fmt=marker, color=colour,
                markersize=5, capsize=3, linewidth=1.3, label=said,
            )  # fmt: skip
    ax.axvline(scores.max(), color=BLACK, linewidth=0.8, linestyle=":", label="best")
    labels = [shorten(r.label, _LABEL) for r in rows]
    ax.set_yticks(range(len(rows)), labels, fontsize=8, parse_math=False)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    label_axes(ax, "free-run fit, mean over the channels [%]", size=8.5)
    _legend(figure, ax, 3)
    return figure


def residual_figure(
    states: Sequence[str],
    own: Mapping[str, Mapping[str, Any]],
    inputs: Mapping[str, Mapping[str, Mapping[str, Any]]],
) -> Figure:
    """Draw the memory of each equation's residuals, and what inputs explain of them.

    Parameters
    ----------
    states : sequence of str
    own : mapping
        State -> ``lags``, ``correlation``, ``band`` of the residuals with themselves.
    inputs : mapping
        State -> input -> the same with that input.
    """
    figure = new_figure(_WIDTH, 1.75 * len(states) + 0.7)
    axes = figure.subplots(len(states), 2, sharex="col", squeeze=False)
    for row, state in zip(axes, states, strict=True):
        if state in own:
            _correlogram(row[0], {"": own[state]})
        if state in inputs:
            _correlogram(row[1], inputs[state])
        word = LABELS.get(state, state).split(" [")[0]
        label_axes(row[0], y=f"{word}\ncorrelation", size=8.5)
        label_axes(row[1])
        for ax in row:
            ax.yaxis.set_major_locator(MaxNLocator(4))
    for ax, title, below in zip(
        axes[0], ("residuals with themselves", "residuals with inputs"),
        ("samples between them", "samples since the input"), strict=True,
    ):  # fmt: skip
        ax.set_title(title, fontsize=9)
        axes[-1][int(ax is axes[0][1])].set_xlabel(below, fontsize=8.5)
    told = [ax for ax in axes[:, 1] if len(ax.get_legend_handles_labels()[1])]
    if told:
        _legend(figure, told[0], 4)
    return figure


def _correlogram(ax: Any, series: Mapping[str, Mapping[str, Any]]) -> None:
    """Draw correlations at some delays, the band that holds 95 % of chance behind them."""
    lags = next(iter(series.values()))["lags"]
    place = np.arange(len(lags))
    wide = 0.8 / len(series)
    for j, (name, told) in enumerate(series.items()):
        at = place + wide * (j - (len(series) - 1) / 2)
        band, value = np.array(told["band"]), np.array(told["correlation"])
        ax.bar(at, 2 * band, 0.95 * wide, bottom=-band, color="0.85", linewidth=0, zorder=1)
        # where the estimate makes a correlation vanish, rounding is left of it and of its band
        outside = np.abs(value) > band + 1e-6
        ax.vlines(at, 0, value, color=COLOURS[j % 6], linewidth=1.1, zorder=2)
        for chosen, face in ((outside, COLOURS[j % 6]), (~outside, "white")):
            label = (name or "_") if chosen is outside else "_"
            ax.plot(
                at[chosen], value[chosen], _MARKERS[j % 6], color=COLOURS[j % 6],
                markerfacecolor=face, markersize=4, linestyle="none", zorder=3, label=label,
            )  # fmt: skip
    ax.axhline(0, color=BLACK, linewidth=0.6)
    ax.set_xticks(place, [str(v) for v in lags])


def visited_figure(states: Mapping[str, Array], margins: Mapping[str, float]) -> Figure:
    """Draw how often each state had each value, all logs together.

    Parameters
    ----------
    states : mapping of str to ndarray
        (N,) measured [m/s, rad/s].
    margins : mapping of str to float
        Samples nearer to zero were cut out.
    """
    figure = new_figure(_NARROW, 1.35 * len(states) + 0.4)
    axes = figure.subplots(len(states), 1, squeeze=False)[:, 0]
    for ax, (name, value) in zip(axes, states.items(), strict=True):
        count, edges = np.histogram(value, bins=40)
        ax.stairs(100 * count / len(value), edges, color=BLUE, fill=True, alpha=0.7)
        ax.axvline(0, color=BLACK, linewidth=1)
        if name in margins:
            ax.axvspan(-margins[name], margins[name], color=ORANGE, alpha=0.3, linewidth=0)
        label_axes(ax, LABELS.get(name, name), "% of time", size=8.5)
    return figure


def regimes_figure(u: Array, v: Array) -> Figure:
    """Draw surge against sway, with the share of the time in each combination of signs."""
    figure = new_figure(_NARROW, _NARROW)
    ax = figure.subplots()
    every = max(1, -(-len(u) // _DOTS))
    ax.plot(v[::every], u[::every], ".", color=BLUE, markersize=2.2, alpha=0.4, linestyle="none")
    ax.axhline(0, color=BLACK, linewidth=0.8)
    ax.axvline(0, color=BLACK, linewidth=0.8)
    for axis, value in (("x", v), ("y", u)):
        most = 1.15 * float(np.abs(value).max()) or 1.0
        getattr(ax, f"set_{axis}lim")(-most, most)
    for name, share in regime_shares(u, v).items():
        ahead, right = name[1] == "+", name[4] == "+"
        ax.text(
            0.98 if right else 0.02, 0.98 if ahead else 0.02, f"{name}\n{100 * share:.0f} %",
            transform=ax.transAxes, ha="right" if right else "left",
            va="top" if ahead else "bottom", fontsize=9,
        )  # fmt: skip
    label_axes(ax, LABELS["v"], LABELS["u"])
    return figure


def regime_shares(u: Array, v: Array) -> dict[str, float]:
    """Return the share of samples in each combination of signs of surge and sway."""
    return {
        f"u{a} v{b}": float(np.mean(((u > 0) == (a == "+")) & ((v > 0) == (b == "+"))))
        for a in "+−"
        for b in "+−"
    }


def correlation_figure(labels: Sequence[str], correlation: Array) -> Figure:
    """Draw the correlations of the estimates, (p, p), signs by colour and by letter."""
    p = len(labels)
    figure = new_figure(_NARROW, _NARROW + 0.2)
    ax = figure.subplots()
    shown = np.tril(np.ones((p, p), bool), -1)
    image = ax.imshow(np.where(shown, correlation, np.nan), cmap="PuOr", vmin=-1, vmax=1)
    for i, j in zip(*np.nonzero(shown & (np.abs(correlation) > 0.9)), strict=True):
        ax.text(
            j, i, "+" if correlation[i, j] > 0 else "−", ha="center", va="center", color="white",
            fontsize=8, fontweight="bold",
        )  # fmt: skip
    ax.set_xticks(range(p), labels, rotation=90, fontsize=7.5, parse_math=False)
    ax.set_yticks(range(p), labels, fontsize=7.5, parse_math=False)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    bar = figure.colorbar(image, ax=ax, shrink=0.7, location="top")
    bar.set_ticks([-1, -0.5, 0, 0.5, 1])
    bar.ax.tick_params(labelsize=8)
    bar.set_label("correlation of the estimates", fontsize=8.5)
    return figure


def _legend(figure: Figure, ax: Any, columns: int) -> None:
    legend_outside(figure, ax, "upper left", columns, fontsize=8.5)
