"""The page of `greybox predict`."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.prediction_verdict import PredictionLevel
from greybox.estimation.verdict import TrustLevel
from greybox.prediction.measuring import LABELS
from greybox.prediction.monte_carlo import MonteCarloQuantity
from greybox.prediction.result import (
    TITLES,
    ManoeuvrePrediction,
    PredictedManoeuvre,
    limit_words,
)
from greybox.report.figures import (
    BLACK,
    BLUE,
    VERMILION,
    label_axes,
    legend_above,
    new_figure,
    to_svg,
)
from greybox.report.next_steps import after_prediction
from greybox.report.page import Page, Picture, Section, Table, capital, computed
from greybox.trial.manoeuvres import Compliance, Criterion

Array = NDArray[np.float64]

_DEGREES = 180 / math.pi

# share of the draws whose tracks set the room of a picture to each side
_DRAWN = 0.9
_DOUBTS = {
    PredictionLevel.LIMITED: ("the model's free run was of limited use on held-out logs",),
    PredictionLevel.POOR: ("the model's free run was poor on held-out logs",),
}


def prediction_page(
    made: ManoeuvrePrediction, record: dict[str, Any], vessel: str = "V", fewer: str = ""
) -> Page:
    """Return the page: verdicts in the headline, a section with pictures for each manoeuvre."""
    sections = [_section(m, f"prediction{i}") for i, m in enumerate(made.manoeuvres)]
    lead, *others = sections[0].pictures
    sections[0] = replace(sections[0], pictures=others)
    return Page(
        title=f"{made.vessel}: predicted {TITLES[made.kind]}",
        headline=headline(made),
        sentences=[f"{capital(made.steering)}."],
        sections=[
            *sections,
            *([Section("Notes on these numbers", points=list(map(capital, made.notes)))]
              if made.notes else []),
        ],
        lead=replace(lead, caption=f"{sections[0].title}: {lead.caption}"),
        next_steps=after_prediction(made, record, vessel, fewer),
        computed=computed(record),
    )  # fmt: skip


def headline(made: ManoeuvrePrediction) -> str:
    """Return one sentence on the limits of the IMO, and one on the trial where there is one."""
    judged = [
        c for m in made.manoeuvres for c in m.criteria if c.verdict is not Compliance.NOT_APPLICABLE
    ]
    of = {v: [_against(c) for c in judged if c.verdict is v] for v in Compliance}
    parts = [
        f"{len(of[v])} of {len(judged)} {word}"
        + (f" ({'; '.join(dict.fromkeys(of[v]))})" if v is not Compliance.PASS else "")
        for v, word in (
            (Compliance.PASS, "met"),
            (Compliance.FAIL, "failed"),
            (Compliance.OPEN, "cannot be told"),
        )
        if of[v]
    ]
    told = (
        f"Limits of IMO MSC.137(76): {', '.join(parts)}."
        if judged
        else "No limit of IMO MSC.137(76) applies."
    )
    trials = [m.agreement for m in made.manoeuvres if m.agreement is not None]
    if trials:
        rows = [r for a in trials for r in a.rows]
        within = sum(r.agrees for r in rows)
        told = (
            f"{within} of {len(rows)} measured quantities agree with the prediction within both "
            f"intervals. {told}"
        )
    doubts = [
        *_DOUBTS.get(made.prediction, ()),
        # what logs that took no part say of predictions counts before tests of coefficients
        *["the estimate is not to be trusted"]
        * (made.prediction is PredictionLevel.NOT_JUDGED and made.trust is TrustLevel.DO_NOT_TRUST),
        *["the model is used beyond the motion that it was estimated on"]
        * any(m.extrapolated for m in made.manoeuvres),
        *["orders are taken to act at once"]
        * bool(made.instant and made.kind in ("turning", "zigzag")),
    ]
    return f"{told} But {' and '.join(doubts)}." if doubts else told


def _against(criterion: Criterion) -> str:
    """Return what a limit is of, with the value that was found and the limit."""
    found, limit = criterion.measured, limit_words(criterion)
    if found is None or not limit:
        return criterion.name
    angle = found.unit == "rad"
    value = f"{math.degrees(found.value):.1f} deg" if angle else f"{found.value:.2f} L"
    return f"{criterion.name} {value}, at most {limit}"


def _section(made: PredictedManoeuvre, key: str) -> Section:
    sentences = [] if made.agreement is None else [capital(made.agreement.sentence)]
    tables = [_values(made)]
    if made.agreement is not None and made.agreement.rows:
        tables.append(_beside(made))
    return Section(
        capital(made.label),
        sentences=sentences,
        pictures=_pictures(made, key),
        tables=tables,
        points=[*[capital(f"IMO {made.verdict_line(c)}.") for c in made.criteria],
                *map(capital, made.notes)],
    )  # fmt: skip


def _values(made: PredictedManoeuvre) -> Table:
    angles = made.log.vessel.angle_commands
    rows = [
        [
            f"{name} of the approach",
            *_cells(value.scaled(1.0, "rad" if name in angles else "1"), made.length), "", "",
        ]
        for name, value in made.commands.items()
    ]  # fmt: skip
    for name, value in made.quantities.items():
        criterion = made.criterion(name)
        limit = verdict = ""
        if criterion is not None:
            limit, verdict = limit_words(criterion), made.verdict_word(criterion)
        said = f"{LABELS[name]} (extrapolated)" if name in made.resting else LABELS[name]
        rows.append([said, *_cells(value, made.length), limit, verdict])
    return Table(
        "Predicted, with intervals of 95 %",
        ["quantity", "value", "in lengths", "95 %", "at most", "IMO MSC.137(76)"],
        rows,
    )


def _cells(value: MonteCarloQuantity | None, length: float) -> list[str]:
    if value is None:
        return ["not reached", "", ""]
    plain, interval = value.words()
    lengths = f"{value.value / length:.2f} L" if value.unit == "m" else ""
    # what was ordered is the same in every draw
    return [plain, lengths, interval if value.low < value.high else ""]


def _beside(made: PredictedManoeuvre) -> Table:
    agreement = made.agreement
    rows = []
    for row in agreement.rows if agreement is not None else ():
        shown = [v.words() for v in (row.predicted, row.measured, row.difference)]
        word = "agrees" if row.agrees else "differs"
        rows.append([LABELS[row.name], *(part for pair in shown for part in pair), word])
    return Table(
        "Predicted and measured",
        ["quantity", "predicted", "95 %", "measured", "95 %", "difference", "95 %", ""],
        rows,
    )


def _pictures(made: PredictedManoeuvre, key: str) -> list[Picture]:
    note = "The estimate's own run, and the range of 95 % of the draws (shaded)."
    if made.agreement is not None:
        note += f" Black: measured in {made.agreement.log}."
    if made.order is None:
        panels = [("speed", "speed [m/s]", 1.0), ("propeller", "propeller speed", 1.0)]
        return [Picture(to_svg(_histories(made, panels, 10, 4.2), key), note)]
    panels = [
        ("heading", "heading [deg]", _DEGREES),
        ("r", "yaw rate [deg/s]", _DEGREES),
        ("speed", "speed [m/s]", 1.0),
    ]
    if "steering" in made.bundle.nominal:
        panels.append(("steering", "steering [deg]", _DEGREES))
    drawn = "Tracks of the estimate's own run and of some draws."
    if _view(made, 0)[2] or _view(made, 1)[2]:
        drawn += " A few draws go on beyond the edge."
    if made.kind == "zigzag":
        drawn += " Its scales along and across differ."
    return [
        Picture(to_svg(_track(made), f"{key}track"), drawn, narrow=True),
        Picture(to_svg(_histories(made, panels, 5.4, 5.6), key), note, narrow=True),
    ]


def _histories(
    made: PredictedManoeuvre, panels: list[tuple[str, str, float]], width: float, height: float
) -> Any:
    figure = new_figure(width, height)
    grid = figure.add_gridspec(len(panels), 1)
    first: Any = None
    for i, (name, label, factor) in enumerate(panels):
        axes = figure.add_subplot(grid[i, 0], sharex=first)
        first = first or axes
        _history(axes, made, name, factor)
        last = i == len(panels) - 1
        label_axes(axes, "time from the order [s]" if last else "", label)
        axes.tick_params(labelbottom=last)
    return figure


def _history(axes: Any, made: PredictedManoeuvre, name: str, factor: float) -> None:
    bundle = made.bundle
    axes.fill_between(
        bundle.t,
        factor * bundle.low[name],
        factor * bundle.high[name],
        color=BLUE,
        alpha=0.2,
        linewidth=0,
    )
    axes.plot(bundle.t, factor * bundle.nominal[name], color=BLUE, linewidth=1.3)
    if made.agreement is not None and name in made.agreement.history:
        view = axes.get_ylim()
        measured = factor * made.agreement.history[name]
        axes.plot(made.agreement.history["t"], measured, color=BLACK, linewidth=0.9)
        axes.set_ylim(min(view[0], measured.min()), max(view[1], measured.max()))


def _view(made: PredictedManoeuvre, k: int) -> tuple[float, float, bool]:
    """Return the range along (0) or across (1) that a picture holds [m], and whether it cuts.

    A draw that leaves its circle would make the run too small to be read.
    """
    whole = [made.bundle.tracks[0][k], np.zeros(1)]
    if made.agreement is not None:
        whole.append(made.agreement.track[k])
    low, high = min(float(np.min(w)) for w in whole), max(float(np.max(w)) for w in whole)
    lows, highs = ([f(d[k]) for d in made.bundle.tracks] for f in (np.min, np.max))
    low = min(low, float(np.quantile(lows, 1 - _DRAWN)))
    high = max(high, float(np.quantile(highs, _DRAWN)))
    margin, room = 0.05 * max(high - low, 1e-6), 0.5 * (high - low)
    least, most = min(low, *map(float, lows)), max(high, *map(float, highs))
    cut = least < low - room or most > high + room
    return max(least, low - room) - margin, min(most, high + room) + margin, cut


def _track(made: PredictedManoeuvre) -> Any:
    figure = new_figure(5.4, 5.6)
    axes = figure.add_subplot()
    tracks = made.bundle.tracks
    axes.set_ylim(*_view(made, 0)[:2])
    axes.set_xlim(*_view(made, 1)[:2])
    for north, east in tracks[:0:-1]:
        axes.plot(east, north, color=BLUE, alpha=0.15, linewidth=0.7)
    axes.plot([], [], color=BLUE, alpha=0.3, linewidth=0.7, label="draws")
    axes.plot(tracks[0][1], tracks[0][0], color=BLUE, linewidth=1.5, label="predicted")
    if made.agreement is not None:
        along, across = made.agreement.track
        axes.plot(across, along, color=BLACK, linewidth=1.2, label="measured")
    axes.plot(0, 0, "o", color=VERMILION, markersize=6, markeredgecolor="white", label="order")
    if made.kind == "turning":
        axes.set_aspect("equal", adjustable="datalim")
    label_axes(axes, "to starboard of the approach [m]", "along the approach [m]")
    legend_above(axes, columns=4, borderaxespad=0.1, columnspacing=1.2)
    return figure
