"""Pictures of defects of single signals: times, holes, spikes, stuck and coarse values."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from greybox.errors import so_many
from greybox.report.figures import (
    BLACK,
    BLUE,
    GREEN,
    LABELS,
    VERMILION,
    draw_line,
    label_axes,
    legend_above,
    new_figure,
    tidy,
)
from greybox.report.thinning import find_gaps, pick, thin
from greybox.trial.checks.finding import Finding
from greybox.trial.checks.signal_quality import MOTION
from greybox.trial.convert.derived_signals import continuous
from greybox.trial.convert.resample import clock
from greybox.trial.gaps import runs
from greybox.trial.raw_log import Recording, Signal
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# of one kind in one picture: more would be one block of colour
_MOST_MARKS = 300
# a zoom shows this much beside what it zooms on, in its lengths and in samples
_BESIDE = 1.0
_BESIDE_SAMPLES = 25
_ROWS = 8
_FRACTION_SECONDS = 5.0
_NAMED = {
    "x_n": "position north x_n [m]", "y_n": "position east y_n [m]",
    "v_n": "velocity north v_n [m/s]", "v_e": "velocity east v_e [m/s]",
    "u_q": "wind along the bow u_q [m/s]", "v_q": "wind across v_q [m/s]",
}  # fmt: skip


def label_of(name: str, unit: str | None) -> str:
    """Return the label of an axis with its unit."""
    if name in _NAMED or name in LABELS:
        return _NAMED.get(name) or LABELS[name]
    return f"{name} [{unit if unit and unit != '1' else 'unit of the log'}]"


def gap_figure(finding: Finding, recording: Recording) -> Figure:
    """Draw a signal with its gaps, a close-up of the longest, and the steps of its clock."""
    names: tuple[str, ...] = finding.picture["names"]
    gaps: list[tuple[float, float]] = finding.picture["gaps"]
    times: Array = finding.picture["t"]
    s = _telling(recording, names)
    t, value = _orderly(s)
    figure, whole, zoom, third = _axes("Holes in the times", True)
    _draw(whole, t, value)
    _shade(whole, gaps)
    start, stop = max(gaps, key=_length)
    low, high = _around(t, start, stop)
    _draw_part(zoom, t, value, low, high)
    _shade(zoom, [x for x in gaps if x[1] > low and x[0] < high], "")
    zoom.set_title(f"the longest: {stop - start:.4g} s", fontsize=9)
    steps = np.diff(times)
    third.semilogy(*_dots(times[:-1], steps, 600), ".", color=BLUE, markersize=2.5)
    wide = steps > finding.picture["limit"]
    third.semilogy(times[:-1][wide], steps[wide], "v", color=VERMILION, markersize=5)
    third.axhline(finding.picture["limit"], color=BLACK, linewidth=0.8, linestyle="--")
    told = "time to the next sample; above the dashed line it is a gap"
    label_axes(third, "time [s]", "step [s]", told)
    _name(s, whole, zoom)
    return figure


def order_figure(finding: Finding) -> Figure:
    """Draw the times by row, with those that repeat or go back."""
    t: Array = finding.picture["t"]
    rows = np.arange(1, len(t) + 1, dtype=float)
    wrong = np.flatnonzero(np.diff(t) <= 0) + 1
    figure, whole, zoom, third = _axes("Times that repeat or go back", True)
    low = max(int(wrong[0]) - _ROWS, 0)
    high = min(int(wrong[0]) + _ROWS, len(t))
    for ax, part in ((whole, slice(None)), (zoom, slice(low, high))):
        inside = wrong[(rows[wrong] >= rows[part][0]) & (rows[wrong] <= rows[part][-1])]
        draw_line(ax, rows[part], t[part], np.array([], np.intp), 2000, color=BLUE, linewidth=1.0)
        if ax is zoom:
            ax.plot(rows[part], t[part], ".", color=BLUE, markersize=4)
        inside = inside[:_MOST_MARKS]
        ax.plot(rows[inside], t[inside], "v", color=VERMILION, markersize=6, label="wrong time")
        label_axes(ax, "row of the file", "time [s]")
    zoom.set_title(f"around the first, row {wrong[0] + 1}", fontsize=9)
    steps = np.diff(t)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    third.plot(*_dots(rows[1:], steps, 600), ".", color=BLUE, markersize=2.5)
    third.plot(rows[wrong], steps[wrong - 1], "v", color=VERMILION, markersize=5)
    third.axhline(0, color=BLACK, linewidth=0.8, linestyle="--")
    third.set_yscale("symlog", linthresh=usual)
    told = "time since the row before; it must be above zero"
    label_axes(third, "row of the file", "step [s]", told)
    _legend(whole)
    return figure


def fractions_figure(finding: Finding) -> Figure:
    """Draw by how much times are late whose fractions lack leading zeros, and a close-up."""
    meant: Array = finding.picture["meant"]
    written: Array = finding.picture["written"]
    figure, whole, zoom, _ = _axes("Fractions of a second without leading zeros")
    near = np.abs(meant - meant[0]) <= _FRACTION_SECONDS
    for ax, part in ((whole, slice(None)), (zoom, near)):
        late = written[part] - meant[part]
        ax.vlines(meant[part], 0.0, late, color=BLACK, linewidth=0.6)
        ax.plot(meant[part], late, "v", color=VERMILION, markersize=5, label="as written")
        ax.plot(meant[part], 0 * late, ".", color=BLUE, markersize=5, label="as meant")
        label_axes(ax, "time [s]", "late [s]")
    zoom.set_title(f"around the first, t = {meant[0]:.6g} s", fontsize=9)
    _legend(whole)
    return figure


def missing_figure(finding: Finding, recording: Recording) -> Figure:
    """Draw a signal with the stretches that hold no number, and a close-up of the longest."""
    t: Array = finding.picture["t"]
    bad: NDArray[np.bool_] = finding.picture["bad"]
    s = _telling(recording, finding.channels)
    timed, along = np.isfinite(t), "time [s]"
    if not (bad & timed).any():
        # rows that have no time either stand by their number
        along, t, timed = "row of the file", np.arange(1.0, len(t) + 1), np.ones(len(t), bool)
        s = replace(s, t=t)
    t, bad = t[timed], bad[timed]
    good_t, value = _orderly(s)
    period = clock(np.unique(t)).period if len(t) > 1 else 1.0
    # a lone missing sample is as wide as its step
    found = runs(bad)
    spans = [(t[a] - period / 2, t[b - 1] + period / 2) for a, b in found]
    figure, whole, zoom, _ = _axes(f"Samples without a number: {', '.join(finding.channels)}")
    if spans:
        ends = (float(t.min()), float(t.max()))
        _draw(whole, good_t, value, breaks=spans)
        whole.set_xlim(*_margin(*ends))
        _shade(whole, spans, "no number")
        start, stop = max(spans, key=_length)
        low, high = _around(t, start, stop)
        _draw_part(zoom, good_t, value, low, high, breaks=spans)
        inside = [x for x in spans if x[1] > low and x[0] < high]
        _shade(zoom, inside, "")
        count = max(b - a for a, b in found)
        zoom.set_title(f"the longest: {so_many(count, 'sample')}", fontsize=9)
    _name(s, whole, zoom, along=along)
    return figure


def spike_figure(finding: Finding) -> Figure:
    """Draw the whole signal with its outliers marked, and a close-up of the largest."""
    t: Array = finding.picture["t"]
    value: Array = finding.picture["value"]
    spikes: NDArray[np.int64] = finding.picture["spikes"]
    size = abs(float(np.asarray(finding.value)))
    distance: Array = finding.picture["distance"]
    figure, whole, zoom, third = _axes(f"Outliers of {finding.channel}", True)
    _draw(whole, t, value)
    k = int(finding.picture["worst"])
    part = _around_rows(k, k + 1, len(t))
    zoom.plot(t[part], value[part], color=BLUE, linewidth=1.0)
    zoom.plot(t[part], value[part], ".", color=BLUE, markersize=4)
    near = spikes[(spikes >= part.start) & (spikes < part.stop)]
    for ax, marked in ((whole, spikes[:_MOST_MARKS]), (zoom, near)):
        _circle(ax, t[marked], value[marked], "outlier", size=8)
    zoom.set_title(f"the largest: {size:.3g} {finding.unit} from its neighbours", fontsize=9)
    # on a slope an outlier shows only against what its neighbours predict
    third.plot(t[part], distance[part], ".-", color=BLUE, linewidth=0.8, markersize=4)
    _circle(third, t[near], distance[near], size=8)
    told = "distance from what the neighbours predict"
    label_axes(third, "time [s]", f"distance [{finding.unit}]", told)
    _name(finding, whole, zoom)
    _legend(whole)
    return figure


def wrap_figure(finding: Finding) -> Figure:
    """Draw the heading with samples interpolated across its wrap, close up, and without them."""
    t: Array = finding.picture["t"]
    turn = float(finding.picture["turn"])
    value: Array = finding.picture["value"] * (360.0 / turn)
    between: NDArray[np.int64] = finding.picture["between"]
    figure, whole, zoom, third = _axes("Heading interpolated across its wrap", True)
    # lines would hide what lies between the two sides
    whole.plot(*_dots(t, value, 3000), ".", color=BLUE, markersize=1.5)
    part = _around_rows(int(between[0]), int(between[0]) + 1, len(t))
    zoom.plot(t[part], value[part], ".-", color=BLUE, linewidth=0.8, markersize=4)
    near = between[(between >= part.start) & (between < part.stop)]
    for ax, marked in ((whole, between[:_MOST_MARKS]), (zoom, near)):
        _circle(ax, t[marked], value[marked], "between the sides")
    zoom.set_title(f"closer, around t = {t[between[0]]:.6g} s", fontsize=9)
    kept = np.setdiff1d(np.arange(part.start, part.stop), near)
    third.plot(
        t[kept], np.unwrap(value[kept], period=360.0), ".-", color=BLUE, linewidth=0.8,
        markersize=4,
    )  # fmt: skip
    third.set_title("without those samples, unwrapped", fontsize=9)
    for ax in (whole, zoom, third):
        label_axes(ax, "time [s]", "heading psi [deg]")
    _legend(whole)
    return figure


def hold_figure(finding: Finding) -> Figure:
    """Draw a coordinate with its held samples, a close-up of the longest, and its increments."""
    t: Array = finding.picture["t"]
    held: NDArray[np.int64] = finding.picture["held"]
    worst = int(finding.picture["worst"])
    figure, whole, zoom, third = _axes("Positions that repeat under way", True)
    part = _around_rows(worst, worst + 1, len(t))
    name = max(("x_n", "y_n"), key=lambda n: float(np.ptp(finding.picture[n][part])))
    value: Array = finding.picture[name]
    near = held[(held >= part.start) & (held < part.stop)]
    _draw(whole, t, value)
    zoom.plot(t[part], value[part], ".-", color=BLUE, linewidth=0.8, markersize=4)
    for ax, marked in ((whole, held[:_MOST_MARKS]), (zoom, near)):
        _circle(ax, t[marked], value[marked], "repeated")
        label_axes(ax, "time [s]", label_of(name, "m"))
    zoom.set_title("most repeated in a row", fontsize=9)
    way = np.hypot(np.diff(finding.picture["x_n"]), np.diff(finding.picture["y_n"]))
    rows = np.arange(max(part.start, 1), part.stop)
    third.plot(t[rows], way[rows - 1], ".-", color=BLUE, linewidth=0.8, markersize=4)
    third.plot(t[near], way[near - 1], "v", color=VERMILION, markersize=5)
    told = "way since the sample before: none, then all at once"
    label_axes(third, "time [s]", "way [m]", told)
    _legend(whole)
    return figure


def jump_figure(finding: Finding) -> Figure:
    """Draw the coordinate that jumps most, a close-up of the jump, and the track there."""
    t: Array = finding.picture["t"]
    after = float(finding.picture["after"])
    size = np.abs(np.asarray(finding.value))
    name = "x_n" if size[0] >= size[1] else "y_n"
    value: Array = finding.picture[name]
    figure, whole, zoom, third = _axes("The position jumps", True)
    k = int(np.searchsorted(t, after))
    part = _around_rows(k, k + 1, len(t))
    _draw(whole, t, value)
    zoom.plot(t[part], value[part], ".-", color=BLUE, linewidth=0.8, markersize=4)
    for ax in (whole, zoom):
        ax.axvline(after, color=VERMILION, linewidth=1.0, label="cut here")
        label_axes(ax, "time [s]", label_of(name, "m"))
    zoom.set_title(f"closer: a step of {np.hypot(*size):.3g} m", fontsize=9)
    for rows, colour, when in (
        (slice(part.start, k), BLUE, "before"),
        (slice(k, part.stop), VERMILION, "after"),
    ):
        third.plot(
            finding.picture["y_n"][rows], finding.picture["x_n"][rows], ".-", color=colour,
            linewidth=0.8, markersize=4, label=when,
        )  # fmt: skip
    third.set_aspect("equal", adjustable="datalim")
    label_axes(third, "east [m]", "north [m]", "the track, before and after")
    _legend(whole)
    third.legend(fontsize=8, frameon=False)
    return figure


def stuck_figure(finding: Finding, recording: Recording) -> Figure:
    """Draw the plateau in the whole signal and close up, beside a channel that moves meanwhile."""
    t: Array = finding.picture["t"]
    value: Array = finding.picture["value"]
    start, stop = finding.picture["stretch"]
    other = _mover(recording, finding.channel, start, stop)
    figure, whole, zoom, third = _axes(f"{finding.channel} is stuck", other is not None)
    low, high = _around(t, start, stop)
    _draw(whole, t, value)
    _draw_part(zoom, t, value, low, high)
    zoom.set_title(f"it repeats one value for {stop - start:.4g} s", fontsize=9)
    axes = [whole, zoom]
    if other is not None:
        _draw_part(third, *_orderly(other), low, high)
        third.set_xlim(zoom.get_xlim())
        third.set_title(f"meanwhile {other.name} moves", fontsize=9)
        _name(other, third)
        axes.append(third)
    for ax in axes:
        _shade(ax, [(start, stop)], "stuck" if ax is whole else "")
    _name(finding, whole, zoom)
    return figure


def coarse_figure(finding: Finding) -> Figure:
    """Draw a close-up of the steps of a signal, and a histogram of its changes."""
    t: Array = finding.picture["t"]
    value: Array = finding.picture["value"]
    step = float(finding.picture["step"])
    figure, whole, zoom, third = _axes(f"{finding.channel} moves in coarse steps", True)
    _draw(whole, t, value)
    # where it changes most often the steps show best
    width = min(60, len(t))
    busy = np.convolve(np.r_[np.diff(value) != 0, False], np.ones(width), mode="valid")
    k = int(np.argmax(busy))
    part = slice(k, k + width)
    zoom.step(t[part], value[part], where="post", color=BLUE, linewidth=0.8)
    zoom.plot(t[part], value[part], ".", color=BLUE, markersize=4)
    inside = value[part]
    if np.ptp(inside) < 25 * step:
        origin = float(inside.min())
        for level in origin + step * np.arange(round(float(np.ptp(inside)) / step) + 1):
            zoom.axhline(float(level), color=VERMILION, linewidth=0.5, alpha=0.7)
    zoom.set_title(f"closer, with the steps of {step:.4g} {finding.unit}", fontsize=9)
    change = np.round(np.abs(np.diff(value)) / step)
    sizes = np.arange(0, min(max(float(change.max()), 3), 8) + 1)
    share = [100 * float(np.mean(change == k)) for k in sizes]
    third.bar(sizes, share, color=[VERMILION, *[BLUE] * (len(sizes) - 1)], width=0.7)
    third.set_xticks(sizes)
    size = f"change between samples [steps of {step:.4g} {finding.unit}]"
    told = f"{share[0]:.0f} % of the samples repeat the one before"
    label_axes(third, size, "share of samples [%]", told)
    _name(finding, whole, zoom)
    return figure


def range_figure(finding: Finding) -> Figure:
    """Draw an angle against the range that radians allow, as logged and mended."""
    t: Array = finding.picture["t"]
    value: Array = finding.picture["value"]
    limit = float(finding.picture["limit"])
    keep = np.isfinite(t) & np.isfinite(value)
    factor = finding.repair[0].number("factor") if finding.repair else 1.0
    figure = new_figure(10, 4.6)
    above, below = figure.subplots(2, 1, sharex=True)
    for ax, x, title in (
        (above, value, "as logged"),
        (below, value * factor, f"multiplied by {factor:.5g}"),
    ):
        told = f"possible in rad (within {limit:.3g})"
        ax.axhspan(-limit, limit, color=GREEN, alpha=0.15, linewidth=0, label=told)
        _draw(ax, t[keep], x[keep])
        ax.set_title(title, fontsize=9, loc="left")
        ax.set_ylabel(f"{finding.channel} [rad]", fontsize=9)
    low, high = float(np.min(value[keep] * factor)), float(np.max(value[keep] * factor))
    room = 0.15 * max(high - low, 0.1)
    below.set_ylim(low - room, high + room)
    above.set_xlabel("")
    above.tick_params(labelbottom=False)
    legend_above(above, side="right", borderaxespad=0.2)
    figure.suptitle(f"Unit of {finding.channel}", fontsize=11)
    return figure


def signals_figure(finding: Finding, recording: Recording, vessel: Vessel) -> Figure:
    """Draw the channels of a finding as logged, where no clearer picture exists."""
    names = [n for n in (finding.channels or (finding.channel,)) if n in recording][:4]
    names = names or [n for n in (*MOTION, *vessel.commands) if n in recording][:1]
    names = names or [s.name for s in recording.signals[:1]]
    figure = new_figure(10, 1.9 * max(len(names), 1) + 0.7)
    axes = figure.subplots(max(len(names), 1), 1, sharex=True, squeeze=False)[:, 0]
    for ax, name in zip(axes, names, strict=False):
        s = recording[name]
        _draw(ax, *_orderly(s))
        ax.set_ylabel(label_of(name, s.unit), fontsize=9)
        if ax is not axes[-1]:
            ax.set_xlabel("")
    figure.suptitle(f"{finding.id}: {', '.join(finding.channels or (finding.channel,))}")
    return figure


def _axes(title: str, three: bool = False) -> tuple[Figure, Any, Any, Any]:
    """Return axes for the whole signal above, for a close-up below, and for a third picture."""
    figure = new_figure(10, 5.0)
    grid = figure.add_gridspec(2, 2, height_ratios=[1, 1.15])
    whole = figure.add_subplot(grid[0, :])
    zoom = figure.add_subplot(grid[1, 0] if three else grid[1, :])
    third = figure.add_subplot(grid[1, 1]) if three else None
    for ax in filter(None, (whole, zoom, third)):
        label_axes(ax)
    figure.suptitle(title, fontsize=11)
    return figure, whole, zoom, third


def _orderly(s: Signal) -> tuple[Array, Array]:
    """Return times and values that are numbers, in order of time."""
    keep = np.isfinite(s.t) & np.isfinite(s.value)
    order = np.argsort(s.t[keep], kind="stable")
    t, value = s.t[keep][order], s.value[keep][order]
    return t, continuous(value) if s.name == "psi" and len(value) > 1 else value


def _draw(ax: Any, t: Array, value: Array, breaks: Sequence[tuple[float, float]] = ()) -> None:
    """Draw a line that is interrupted at holes, thinned without losing a peak."""
    if len(t) > 1:
        order = np.argsort(t, kind="stable")
        t, value = t[order], value[order]
        usual = clock(t).period
        gaps = find_gaps(t, max(usual, 1e-12) * 1.6)
        if breaks:
            starts = np.searchsorted(t, [b[0] for b in breaks]) - 1
            gaps = np.unique(np.r_[gaps, starts[(starts >= 0) & (starts < len(t) - 1)]])
        # twice the pixels of a panel of three
        index = thin(gaps, value, points=800)
        t, value = pick(t, index), pick(value, index)
    ax.plot(t, value, color=BLUE, linewidth=0.9)
    ax.set_xlabel("time [s]", fontsize=9)
    tidy(ax)


def _draw_part(
    ax: Any,
    t: Array,
    value: Array,
    low: float,
    high: float,
    breaks: Sequence[tuple[float, float]] = (),
) -> None:
    inside = (t >= low) & (t <= high)
    _draw(ax, t[inside], value[inside], breaks)
    if inside.sum() < 200:
        ax.plot(t[inside], value[inside], ".", color=BLUE, markersize=4)
    ax.set_xlim(low, high)


def _around(t: Array, start: float, stop: float) -> tuple[float, float]:
    """Return a span with room on both sides of what it shows, within the log."""
    period = clock(np.unique(t)).period if len(t) > 1 else 1.0
    beside = max(_BESIDE * (stop - start), _BESIDE_SAMPLES * period)
    return (
        max(start - beside, min(float(t.min()), start) - period),
        min(stop + beside, max(float(t.max()), stop) + period),
    )


def _around_rows(first: int, stop: int, count: int) -> slice:
    """Return some rows with others on both sides, of `count` that there are."""
    return slice(max(first - _BESIDE_SAMPLES, 0), min(stop + _BESIDE_SAMPLES, count))


def _margin(low: float, high: float) -> tuple[float, float]:
    room = 0.02 * max(high - low, 1e-9)
    return low - room, high + room


def _shade(ax: Any, spans: Iterable[tuple[float, float]], label: str = "gap") -> None:
    """Shade spans over the whole height; those too narrow for the page still show as lines."""
    shown = sorted(spans, key=_length)[-_MOST_MARKS:]
    ax.broken_barh(
        [(a, b - a) for a, b in shown], (0, 1), transform=ax.get_xaxis_transform(),
        facecolor=VERMILION, edgecolor=VERMILION, linewidth=0.8, alpha=0.3, zorder=0,
        label=label or None,
    )  # fmt: skip
    if label:
        _legend(ax)


def _legend(ax: Any) -> None:
    legend_above(ax, side="right", columns=3, borderaxespad=0.2)


def _circle(ax: Any, t: Array, value: Array, label: str = "", size: float = 7) -> None:
    ax.plot(
        t, value, "o", markersize=size, markerfacecolor="none", markeredgecolor=VERMILION,
        markeredgewidth=1.4, label=label or None,
    )  # fmt: skip


def _name(of: Signal | Finding, *axes: Any, along: str = "time [s]") -> None:
    name = of.name if isinstance(of, Signal) else of.channel
    for ax in axes:
        label_axes(ax, along, label_of(name, of.unit))


def _telling(recording: Recording, names: Sequence[str]) -> Signal:
    """Return the signal of some that shows a hole best: a moving one, not a command."""
    ranked = [n for n in ("psi", "r", "u", "v", *MOTION) if n in names and n in recording]
    ranked += [n for n in names if n in recording]
    return recording[ranked[0]] if ranked else recording.signals[0]


def _mover(recording: Recording, channel: str, start: float, stop: float) -> Signal | None:
    """Return the channel that moves most, for its own habit, while another is stuck."""
    best: tuple[float, Signal] | None = None
    for s in recording.signals:
        if s.name == channel or s.name not in MOTION:
            continue
        t, value = _orderly(s)
        inside = value[(t >= start) & (t <= stop)]
        spread = float(np.std(value)) if len(value) else 0.0
        if len(inside) < 4 or spread == 0:
            continue
        # the channel that is tied to the stuck one says most
        tied = 3.0 if {s.name, channel} in ({"psi", "r"}, {"x_n", "u"}, {"y_n", "u"}) else 1.0
        moved = tied * float(np.ptp(inside)) / spread
        if best is None or moved > best[0]:
            best = (moved, s)
    return None if best is None else best[1]


def _dots(x: Array, y: Array, most: int) -> tuple[Array, Array]:
    every = max(1, -(-len(x) // most))
    return x[::every], y[::every]


def _length(span: tuple[float, float]) -> float:
    return span[1] - span[0]
