"""The page of `greybox fleet`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from greybox.errors import so_many
from greybox.fleet.fleet import Fleet, ShipEstimate
from greybox.fleet.pooling import LEVEL
from greybox.fleet.trend import Trend
from greybox.report.chart import chart_of
from greybox.report.figures import (
    BLACK,
    BLUE,
    VERMILION,
    new_figure,
    shorten,
    tidy,
    to_svg,
)
from greybox.report.model_difference import shown_unit, unbroken
from greybox.report.next_steps import after_fleet
from greybox.report.page import Page, Picture, Section, Table, capital, computed
from greybox.validation.fit import percent

Array = NDArray[np.float64]

# ships that a map has room for, the most deviating ones
_MOST_MAPPED = 25
# lines in time that are drawn: the surest ones
_MOST_TRENDS = 6
# deviations [standard deviations] at which the map's colours end
_REACH = 6.0
_LABEL = 20
# coefficients beside one another that a phone shows legibly
_BROAD = 9


def fleet_page(fleet: Fleet, record: Mapping[str, Any]) -> Page:
    """Return the page, its verdict first.

    Parameters
    ----------
    fleet : Fleet
    record : mapping
        How it was computed: versions, command, seed.
    """
    verdict = fleet.verdict
    sections = [_class_section(fleet), _ships_section(fleet), _time_section(fleet)]
    return Page(
        title=f"{len(fleet.ships)} ships of one class: what they share and which one differs",
        headline=f"{capital(verdict)}.",
        sentences=[
            *(f"Caution: {c}." for c in fleet.cautions),
            *(capital(fleet.difference_sentence(c)) for c in fleet.differing),
            f"Every ship was estimated in the same way: {fleet.model.sentence}",
            *(capital(one.sentence) for one in fleet.left_out),
        ],
        lead=_map(fleet),
        next_steps=after_fleet(fleet, record),
        sections=[s for s in sections if s is not None],
        computed=computed(dict(record)),
    )


def _deviations(fleet: Fleet) -> Array:
    """Return how far each ship's own estimates lie from the class mean, in deviations, (k, p)."""
    own = np.array([np.diag(s.covariance) for s in fleet.ships])
    variance = own + fleet.pooled.omega + fleet.pooled.beta_std**2
    theta = np.array([s.theta for s in fleet.ships])
    return np.asarray((theta - fleet.pooled.beta) / np.sqrt(variance))


def _map(fleet: Fleet) -> Picture:
    """Draw how far each ship lies from the class in each coefficient."""
    deviations = _deviations(fleet)
    order = sorted(range(len(fleet.ships)), key=lambda i: fleet.comparisons[i].p_value)
    shown = sorted(order[:_MOST_MAPPED])
    names = [shorten(fleet.ships[i].name, _LABEL) for i in shown]
    figure = new_figure(0.27 * len(fleet.names) + 2.2, 0.24 * len(shown) + 1.7)
    axes = figure.subplots()
    image = axes.imshow(
        deviations[shown], cmap="PuOr", vmin=-_REACH, vmax=_REACH, aspect="auto",
        interpolation="nearest",
    )  # fmt: skip
    marked = [
        (row, d.coefficient)
        for row, i in enumerate(shown)
        for d in fleet.comparisons[i].differences
    ]
    if marked:
        rows, columns = zip(*marked, strict=True)
        # a light rim sets the frame off from the darkest cells
        for colour, thick in (("white", 4.5), (VERMILION, 2)):
            axes.plot(columns, rows, "s", color=colour, markersize=11, fillstyle="none",
                      markeredgewidth=thick)  # fmt: skip
    axes.set_xticks(range(len(fleet.names)), fleet.names, rotation=60, ha="right", fontsize=8,
                    rotation_mode="anchor", parse_math=False)  # fmt: skip
    axes.set_yticks(range(len(shown)), names, fontsize=8, parse_math=False)
    bar = figure.colorbar(image, ax=axes, fraction=0.04)
    bar.set_label("deviation from the class\n[standard deviations]", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    few = f" Of {len(fleet.ships)} ships the {len(shown)} most deviating are drawn."
    caption = (
        "The deviation of each ship's own estimate from the mean of the class, in standard "
        "deviations of error and spread together; a frame marks a coefficient that differs beyond "
        f"chance.{few if len(shown) < len(fleet.ships) else ''}"
    )
    far = np.unravel_index(np.abs(deviations).argmax(), deviations.shape)
    told = (
        f"{caption} The largest is {deviations[far]:.1f}, {fleet.names[far[1]]} of "
        f"'{fleet.ships[far[0]].name}'."
    )
    return Picture(to_svg(figure, "map"), caption, told, broad=len(fleet.names) > _BROAD)


def _number(value: float, digits: str = ".4g") -> str:
    return unbroken(f"{value:{digits}}")


def _class_section(fleet: Fleet) -> Section:
    """Show mean, spread and shrinkage of each coefficient."""
    pooled = fleet.pooled
    intervals = pooled.beta_interval()
    rows = [
        [
            name,
            _number(pooled.beta[j]),
            _number(pooled.beta_std[j], ".2g"),
            f"{_number(intervals[j, 0])} to {_number(intervals[j, 1])}",
            _number(float(np.sqrt(pooled.omega[j])), ".2g"),
            f"{pooled.shrinkage[:, j].mean():.2f}",
            shown_unit(fleet.units[j]),
        ]
        for j, name in enumerate(fleet.names)
    ]
    table = Table(
        f"The class, from {len(pooled.theta)} ships: coefficients per sample of "
        f"{fleet.model.sample_time:g} s",
        ["parameter", "mean", "std error", f"{100 * LEVEL:.0f} % interval",
         "std between ships", "shrinkage", "unit"],
        rows,
    )  # fmt: skip
    told = [
        "Each ship's coefficients are drawn towards the mean as far as the ships agree: a "
        "shrinkage of 0 leaves a ship its own estimate, 1 gives it the mean of the class.",
        "Ships that differ take no part in mean and spread, and keep their own estimates.",
    ]
    return Section("1. What do the ships share?", told, tables=[table])


def _ships_section(fleet: Fleet) -> Section:
    """Show the ships one by one, and each coefficient of all of them."""
    rows = []
    for ship, compared in zip(fleet.ships, fleet.comparisons, strict=True):
        fit = ", ".join(f"{k} {percent(v, 0).removesuffix(' %')}" for k, v in ship.fit.items())
        named = ", ".join(fleet.names[d.coefficient] for d in compared.differences)
        rows.append(
            [ship.name, str(ship.logs), _number(float(np.sqrt(compared.statistic)), ".3g"),
             _number(compared.p_adjusted, ".2g"),
             (named or "in all together") if compared.differs else "", fit]
        )  # fmt: skip
    table = Table(
        f"Each ship against the others, by {len(fleet.names)} coefficients",
        ["ship", "logs", "distance", "p adjusted", "differs in", "fit of its free run [%]"],
        rows,
    )
    figure = _coefficients_figure(fleet)
    caption = (
        f"Each coefficient of each ship: its own estimate with the {100 * LEVEL:.0f} % interval "
        "(grey), its pooled one (blue), the mean of the class (line); ships in the order "
        "of the table."
    )
    told = [
        "The distance is the Mahalanobis distance from the prediction of the other ships; the "
        "p-value is the probability of so large a deviation by chance, adjusted for the number of "
        "ships (Holm) and for the uncertain spread between few ships."
    ]
    return Section(
        "2. Which ship differs?", told, [Picture(to_svg(figure, "ships"), caption)], [table]
    )


def _coefficients_figure(fleet: Fleet) -> Figure:
    count = len(fleet.names)
    columns = min(3, count)
    lines = -(-count // columns)
    figure = new_figure(2.6 * columns + 0.4, 1.35 * lines + 0.4)
    grid = figure.subplots(lines, columns, squeeze=False, sharex=True)
    place = np.arange(1, len(fleet.ships) + 1)
    own = np.array([s.theta for s in fleet.ships])
    own_std = np.array([np.sqrt(np.diag(s.covariance)) for s in fleet.ships])
    drawn = [fleet.pooled_of(i) for i in range(len(fleet.ships))]
    value, std = (np.array([d[k] for d in drawn]) for k in (0, 1))
    small = {"markersize": 3, "linewidth": 0.9}
    for j, axes in enumerate(grid.flat):
        if j >= count:
            axes.set_visible(False)
            continue
        axes.axhline(fleet.pooled.beta[j], color=BLACK, linewidth=0.7)
        axes.errorbar(place - 0.15, own[:, j], yerr=1.96 * own_std[:, j], fmt=".", color="0.6",
                      **small)  # fmt: skip
        axes.errorbar(place + 0.15, value[:, j], yerr=1.96 * std[:, j], fmt=".", color=BLUE,
                      **small)  # fmt: skip
        axes.set_title(fleet.names[j], fontsize=8, parse_math=False)
        axes.tick_params(labelsize=7)
        tidy(axes)
    return figure


def _time_section(fleet: Fleet) -> Section | None:
    """Show what changes in time, or the lines that are nearest to it."""
    followed = [
        (float(p), i, j)
        for i, trend in enumerate(fleet.trends)
        if trend is not None
        for j, p in enumerate(trend.p_values)
    ]
    if not followed:
        return None
    changes = fleet.changes()
    drawn = sorted(followed)[: max(1, min(len(changes), _MOST_TRENDS))]
    points = [
        f"{c.coefficient} of '{c.ship}' changes by {c.slope:+.3g} per {c.per}, "
        f"{100 * LEVEL:.0f} % interval {c.interval[0]:.3g} to {c.interval[1]:.3g} "
        f"(p = {c.p_adjusted:.2g})."
        for c in changes
    ]
    told = [
        "A line is fitted to the estimates of each ship's periods; what differs from log to log "
        f"without a trend widens its interval. Of {so_many(len(followed), 'line')} {len(changes)} "
        f"{'rises or falls' if len(changes) == 1 else 'rise or fall'} beyond chance, adjusted "
        f"for their number (Holm)."
    ]
    if not changes:
        told.append("The one that is nearest to a change is drawn.")
    elif len(changes) > len(drawn):
        told.append(f"The {len(drawn)} most significant are drawn.")
    pictures = []
    for n, (_, i, j) in enumerate(drawn):
        trend = fleet.trends[i]
        assert trend is not None
        figure = _trend_figure(fleet.ships[i], trend, j, fleet.names[j], fleet.units[j])
        caption = (
            f"{fleet.names[j]} of '{fleet.ships[i].name}' over its logs: estimates of each period "
            f"and the line through them, with {100 * LEVEL:.0f} % intervals."
        )
        pictures.append(
            Picture(to_svg(figure, f"trend{n}"), caption, narrow=len(drawn) > 1,
                    chart=chart_of(figure))
        )  # fmt: skip
    return Section("3. Does anything change in time?", told, pictures, points=points)


def _trend_figure(ship: ShipEstimate, trend: Trend, j: int, name: str, unit: str) -> Figure:
    figure = new_figure(4.4, 2.8)
    axes = figure.subplots()
    # years count from 1970 in the times
    times = trend.times + (1970 if ship.dated else 0)
    half = trend.reach * trend.line_std[:, j]
    line = trend.line[:, j]
    axes.fill_between(times, line - half, line + half, color=BLUE, alpha=0.2, linewidth=0)
    axes.plot(times, line, color=BLUE, linewidth=1.3, label="line")
    value, error = trend.estimates[:, j], 1.96 * trend.std[:, j]
    axes.errorbar(times, value, yerr=error, fmt="o", color=BLACK, markersize=4, capsize=3,
                  linewidth=1, label="period")  # fmt: skip
    axes.set_xlabel("year" if ship.dated else "log, in the order of names", fontsize=8.5)
    label = f"{name} [{shown_unit(unit)}]".removesuffix(" []")
    axes.set_ylabel(label, fontsize=8.5, parse_math=False)
    axes.ticklabel_format(axis="x", useOffset=False)
    axes.tick_params(labelsize=8)
    axes.legend(fontsize=8, loc="best")
    tidy(axes)
    return figure
