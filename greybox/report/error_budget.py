"""The error budget on a page: whose the squared error is, before mending and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from greybox.diagnosis.budget import MOTION, REST, SENSOR, SLOW, WAVES
from greybox.diagnosis.result import BudgetPart, Gain
from greybox.report.figures import (
    BLUE,
    GREEN,
    LABELS,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    new_figure,
    tidy,
)
from greybox.report.page import Table

# inches: letters stay legible where the page is 390 px wide
_WIDTH = 4.4
_NAMELESS = {SENSOR: "0.8", MOTION: "0.55", SLOW: "0.35", WAVES: SKY, REST: "white"}
_CAUSES = (VERMILION, BLUE, ORANGE, GREEN, PURPLE)
_HATCHES = ("", "//", "..", "\\\\", "xx", "++")


def budget_figure(budget: Sequence[BudgetPart]) -> Figure:
    """Draw the shares of each state as two stacked bars, before and after."""
    states = list(budget[0].share)
    figure = new_figure(_WIDTH, 0.85 * len(states) + 1.2 + 0.16 * len(budget))
    ax = figure.subplots()
    causes = [p.part for p in budget if p.part not in _NAMELESS]
    places, names = [], []
    for i, state in enumerate(states):
        for j, when in enumerate(("before", "after")):
            y = 2.5 * i + j
            places.append(y)
            names.append(f"{LABELS.get(state, state).split(' [')[0]}, {when}")
            left = 0.0
            for part in budget:
                share = 100 * max((part.share if when == "before" else part.after)[state], 0.0)
                k = causes.index(part.part) if part.part in causes else 0
                own = part.part in causes
                ax.barh(
                    y, share, 0.8, left=left, edgecolor="0.2", linewidth=0.6,
                    color=_CAUSES[k % len(_CAUSES)] if own else _NAMELESS[part.part],
                    hatch=_HATCHES[k % len(_HATCHES)] if own else "",
                    label=part.part if i == j == 0 else None,
                )  # fmt: skip
                left += share
    ax.axvline(100, color="0.2", linewidth=0.8)
    ax.set_yticks(places, names, fontsize=8.5)
    ax.set_ylim(max(places) + 0.7, -0.7)
    ax.set_xlabel("share of the squared error before mending [%]", fontsize=9)
    ax.tick_params(axis="x", labelsize=8)
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper left", ncols=2, fontsize=8.5, frameon=False,
        handlelength=1.6, columnspacing=1.2,
    )  # fmt: skip
    tidy(ax)
    return figure


def budget_table(budget: Sequence[BudgetPart]) -> Table:
    """Return the shares with their intervals."""
    states = list(budget[0].share)
    rows = [
        [
            p.part,
            *(
                f"{100 * p.share[s]:.1f} ({100 * p.ci[s][0]:.1f} to {100 * p.ci[s][1]:.1f})"
                for s in states
            ),
        ]
        for p in budget
    ]
    head = ["part", *(LABELS.get(s, s).split(" [")[0] for s in states)]
    caption = "Whose the squared held-out error is, before mending [%] (95 % interval)"
    return Table(caption, head, rows)


def largest(budget: Sequence[BudgetPart]) -> str:
    """Return the largest part of each state in words."""
    told = []
    for state in budget[0].share:
        part = max(budget, key=lambda p: p.share[state])
        name = LABELS.get(state, state).split(" [")[0]
        told.append(f"{name}: {part.part} {100 * part.share[state]:.0f} %")
    return "; ".join(told)


def noise_sentence(budget: Sequence[BudgetPart], gain: Mapping[str, Gain]) -> str:
    """Return how much of the error that is left is noise, and the fit that noise alone allows.

    Parameters
    ----------
    budget : sequence of BudgetPart
    gain : mapping of str to Gain
        Fit (6.12) of the free run [%], by state.
    """
    (sensor,) = (p for p in budget if p.part == SENSOR)
    told, bounds = [], []
    for state, noise in sensor.after.items():
        share = min(max(noise / max(sum(p.after[state] for p in budget), 1e-300), 0.0), 1.0)
        name = LABELS.get(state, state).split(" ")[0] if state != "r" else "yaw rate"
        told.append(f"{name} {100 * share:.0f} %")
        if state in gain:
            bounds.append(f"{name} {100 - (100 - gain[state].after) * share**0.5:.0f} %")
    said = (
        f"Of the squared error that is left, this much is noise of the sensors: {', '.join(told)}"
    )
    if bounds:
        said += (
            f". Measured with that noise, a perfect model would have a fit of about "
            f"{', '.join(bounds)}"
        )
    return f"{said}."


def negative(budget: Sequence[BudgetPart]) -> bool:
    """Whether a share is below zero beyond what a picture would hide."""
    return bool(min(np.min(list(p.share.values())) for p in budget) < -0.02)
