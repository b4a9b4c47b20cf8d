"""The error budget on a page: sources of the squared error, before and after the extension."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from textwrap import fill

import numpy as np
from matplotlib.figure import Figure

from greybox.diagnosis.budget import SENSOR
from greybox.diagnosis.result import BudgetPart, Diagnosis, is_split, told_share
from greybox.report.figures import (
    BLUE,
    LABELS,
    ORANGE,
    legend_outside,
    new_figure,
    tidy,
)
from greybox.report.page import Table
from greybox.validation.fit import told_fits

# inches: letters stay legible where the page is 390 px wide
_WIDTH = 4.4
# in a line of a part's name
_LETTERS = 22
# shares in percent that are drawn; what lies beyond is cut off
_SHOWN = (-60.0, 140.0)
# share of the error of each state that a picture of its sources has to show
_TELLING = 0.5


def budget_in_words(diagnosis: Diagnosis) -> list[BudgetPart]:
    """Return the parts of the budget with the titles of causes in place of their ids.

    Where causes of one title have parts, each title is followed by its place.
    """
    found = {name: c for c in diagnosis.causes for name in (c.id, c.key)}
    parts = {p.part: found[p.part] for p in diagnosis.budget if p.part in found}
    titles = [c.title for c in parts.values()]
    told = {
        part: f"{c.title} ({c.key.partition(':')[2]})" if titles.count(c.title) > 1 else c.title
        for part, c in parts.items()
    }
    return [replace(p, part=told.get(p.part, p.part)) for p in diagnosis.budget]


def budget_figure(budget: Sequence[BudgetPart], extended: bool = True) -> Figure:
    """Draw the shares that the logs tell, and what is left of them where a model is extended."""
    states = list(budget[0].share)
    figure = new_figure(_WIDTH, 1.0 + 0.3 * len(budget))
    axes = figure.subplots(1, len(states), sharey=True, squeeze=False)[0]
    places = np.arange(len(budget))
    for ax, state in zip(axes, states, strict=True):
        told = [100.0 if is_split(p, state) else np.nan for p in budget]
        share = told * np.array([p.share[state] for p in budget])
        low, high = told * np.array([p.ci[state] for p in budget]).T
        look = {"edgecolor": "0.2", "linewidth": 0.6}
        before = "before" if extended else "share"
        ax.barh(places, share, 0.72, color=BLUE, label=before, **look)
        if extended:
            left = told * np.array([p.after[state] for p in budget])
            ax.barh(places, left, 0.3, color=ORANGE, label="after the extension", **look)
        interval = f"95 % interval{' of before' * extended}"
        ax.hlines(places, low, high, color="0.2", linewidth=1.0, label=interval)
        ax.axvline(0, color="0.2", linewidth=0.8)
        ax.set_xlim(*_SHOWN)
        ax.set_xticks([0, 100])
        ax.tick_params(axis="x", labelsize=8)
        ax.set_title(LABELS.get(state, state).split(" [")[0], fontsize=9)
        tidy(ax)
    names = [fill(p.part, _LETTERS, break_long_words=False) for p in budget]
    axes[0].set_yticks(places, names, fontsize=8.5)
    axes[0].set_ylim(len(budget) - 0.4, -0.6)
    when = " before the extension" * extended
    figure.supxlabel(f"share of the squared error{when} [%]", fontsize=9)
    legend_outside(figure, axes[0], "upper left", 3, handlelength=1.4, columnspacing=1.0)
    return figure


def budget_table(budget: Sequence[BudgetPart]) -> Table:
    """Return the shares with their intervals."""
    states = list(budget[0].share)
    rows = [[p.part, *(told_share(p, s) for s in states)] for p in budget]
    head = ["part", *(LABELS.get(s, s).split(" [")[0] for s in states)]
    caption = (
        "Sources of the squared held-out error before the model is extended [%] (95 % interval)"
    )
    return Table(caption, head, rows)


def largest(budget: Sequence[BudgetPart]) -> str:
    """Return the largest part of each state in words, of those that the logs tell."""
    told = []
    for state in budget[0].share:
        name = LABELS.get(state, state).split(" [")[0]
        parts = [p for p in budget if is_split(p, state)]
        if not parts:
            told.append(f"{name}: not determined")
            continue
        part = max(parts, key=lambda p: p.share[state])
        told.append(f"{name}: {part.part} {100 * part.share[state]:.0f} %")
    return "; ".join(told)


def tells(budget: Sequence[BudgetPart]) -> bool:
    """Whether the parts that the logs tell make up half of the error of every state, or more."""
    return bool(budget) and all(
        sum(max(p.share[s], 0.0) for p in budget if is_split(p, s)) >= _TELLING
        for s in budget[0].share
    )


def noise_shares(diagnosis: Diagnosis) -> dict[str, float]:
    """Return the share that sensor noise has in the squared error that is left, by state."""
    sensor = next((p for p in diagnosis.budget if p.part == SENSOR), None)
    if sensor is None:
        return {}
    left = {p.part: p.after if diagnosis.extended else p.share for p in diagnosis.budget}
    return {
        state: min(max(own / max(sum(of[state] for of in left.values()), 1e-300), 0.0), 1.0)
        for state, own in left[SENSOR].items()
        if is_split(sensor, state)
    }


def noise_sentence(
    shares: Mapping[str, float], bounds: Mapping[str, float], of: str = " that is left"
) -> list[str]:
    """Return how much of the error that is left is noise, and the fit that noise alone allows.

    Nothing where the logs do not tell.
    """
    if not shares:
        return []
    told = told_fits({s: 100 * share for s, share in shares.items()}, 0)
    said = f"Sensor noise makes up this much of the squared error{of}: {told}"
    bounds = {s: b for s, b in bounds.items() if s in shares}
    if bounds:
        said += (
            f". Measured with that noise, a perfect model would have a fit of about "
            f"{told_fits(bounds, 0)}"
        )
    return [f"{said}."]


def cut_off(budget: Sequence[BudgetPart]) -> bool:
    """Whether a share lies beyond what the picture shows."""
    low, high = _SHOWN
    return any(
        not low <= 100 * share <= high
        for p in budget
        for state, share in p.share.items()
        if is_split(p, state)
    )
