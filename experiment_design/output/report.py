"""The page of `greybox design`: the value of the plan, and the motion to expect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from experiment_design.optimise.search import REFERENCE
from experiment_design.output.next_steps import after_design
from experiment_design.output.pictures import draw_commands, draw_plan_track, draw_states, forbidden
from experiment_design.output.prediction import MotionBand, predict_motion
from experiment_design.output.result import Design
from experiment_design.output.sheet_contents import clock, plain_name, signed
from experiment_design.request.regimes import spell_regime
from greybox.report.chart import chart_of
from greybox.report.figures import BLUE, ORANGE, new_figure, tidy, to_svg
from greybox.report.page import Page, Picture, Section, Table, computed

Array = NDArray[np.float64]

# narrow enough that text is legible on a phone
_WIDTH = 6.2
_SIZE = 9.0
# times the information from which the other sequence tells nothing
_TELLS_NOTHING = 1000.0
_SHOWN = ("u", "v", "r", "psi")
# what stands before all else where no trial is behind the prior model
UNTRIED = (
    "Planned without an estimated model, from main dimensions: the figures are as good as these. "
)


def design_page(
    design: Design, notes: Sequence[str], record: dict[str, Any], headline: str = ""
) -> Page:
    """Return the page of a design.

    Parameters
    ----------
    design : Design
    notes : sequence of str
        What was chosen for the user.
    record : dict
        How it was computed.
    headline : str
        Instead of what the plan saves, as for a trial between two explanations.

    Returns
    -------
    Page
    """
    r = design.request
    sailed = design.from_first_command()
    bands = predict_motion(sailed)
    reference = None if headline else design.random_std
    trials = f"{clock(r.duration)} min"
    if r.trials > 1:
        trials = f"{r.trials} trials of {trials}"
    if design.lead_in_s:
        trials = f"lead-in of {clock(design.lead_in_s)} min, trial of {trials}"
    parts = [_trial(sailed, band) for band in bands]
    one = len(parts) == 1
    shown = [replace(p, pictures=p.pictures[i == 0 :]) for i, p in enumerate(parts)]
    keeping = [design.keeping.sentence()] if design.keeping is not None else []
    said = [design.status, *keeping, *notes, *design.notes]
    return Page(
        title=f"Plan for {plain_name(r.vessel.name)}: {trials}",
        headline=headline or (UNTRIED if r.untried else "") + saving(design),
        sentences=[_sentence(s) for s in said],
        lead=parts[0].pictures[0],
        next_steps=after_design(
            record, bool(headline), design.remedy, design.missed(), design.shorter
        ),
        pictures=[*(shown[0].pictures if one else []), *_std_pictures(design, reference)],
        tables=[
            *([_std_table(design, reference)] if np.isfinite(design.std).all() else []),
            *([] if headline else _alternatives(design)),
            _limits(design),
        ],
        computed=computed(record),
        sections=[] if one else shown,
    )  # fmt: skip


def _sentence(text: str) -> str:
    """Return text with a capital and a full stop."""
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def saving(design: Design) -> str:
    """Return how much time the plan saves, and how near it is to the best possible."""
    r = design.request
    whole = r.duration * r.trials
    gain, by = design.gain_vs_random, design.by_criterion
    if gain is None:
        first = "No random two-level sequence keeps the limits, so there is none to beat"
    elif gain > 1:
        first = (
            f"This plan saves {(gain - 1) * whole:.0f} s of trial: the best of "
            f"{min(design.random_kept, REFERENCE)} random two-level sequences would need "
            f"{gain * whole:.0f} s for the precision that it reaches in {whole:.0f} s "
            f"({gain:.2f} times the information{by})"
        )
    else:
        first = (
            f"This plan tells {gain:.2f} times what the best of "
            f"{min(design.random_kept, REFERENCE)} random two-level sequences tells{by}"
        )
    said = design.certificate.sentence().rstrip(".")
    led = ""
    if design.lead_in_s:
        led = (
            f" Before it a lead-in of {design.lead_in_s:g} s brings the ship into the regime; "
            f"these numbers leave it out."
        )
    return f"{first}; {said}.{led}"


def _trial(design: Design, band: MotionBand) -> Section:
    r = design.request
    north, east = band["x_n"].nominal, band["y_n"].nominal
    track = Figure(figsize=(_WIDTH, _WIDTH))
    draw_plan_track(track.add_axes((0.13, 0.09, 0.84, 0.8)), design, band, _SIZE)
    names = [n for n in _SHOWN if n in band]
    names += [n for n in band.names if n not in names and forbidden(design, band, n)]
    states = new_figure(_WIDTH, 1.35 * len(names) + 0.4)
    panels = states.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    draw_states(dict(zip(names, panels, strict=True)), design, band, _SIZE)
    count = len(r.schedule.commands)
    commands = new_figure(_WIDTH, max(0.8, min(1.3, 6 / count)) * count + 0.4)
    draw_commands(
        commands.subplots(count, 1, sharex=True, squeeze=False)[:, 0], design, band.trial, _SIZE
    )
    certain = (
        "The model is assumed to be exact and without process noise, so there is no band."
        if band.certain
        else f"The band holds about 95 % of {band.draws - band.lost} motions, of models drawn from "
        f"the prior{' with process noise' if r.noise.process.any() else ''}"
        + (f"; left out: {band.lost} more that ran away." if band.lost else ".")
    )
    outlines = (
        ""
        if band.certain
        else " The thin outlines are its parts at the numbered times, where the map holds them."
    )
    cells = ", ".join(
        f"{n} from {signed(band[n].nominal.min(), 2)} to {signed(band[n].nominal.max(), 2)}"
        for n in names
    )
    tag = f"t{band.trial}"
    return Section(
        f"Trial {band.trial + 1}, regime {spell_regime(r.regimes[band.trial])}",
        pictures=[
            Picture(
                to_svg(track, f"plan{tag}"),
                f"Expected track, north up, with the time in numbers. {certain}{outlines}",
                f"Map: the expected track covers {np.ptp(north):.0f} m from south to north and "
                f"{np.ptp(east):.0f} m from west to east in {clock(float(band.t[-1]))} minutes.",
                chart=chart_of(track),
            ),
            Picture(
                to_svg(states, f"states{tag}"),
                "Predicted motion with its band; what margins and caps forbid is shaded behind "
                "dashed lines.",
                f"Predicted motion against time: {cells} (m/s, rad/s, rad).",
                chart=chart_of(states),
            ),
            Picture(
                to_svg(commands, f"commands{tag}"),
                "Commands against time; dotted lines are the limits of the thrusters. Angles in "
                "rad, as in the plan's file, and degrees on the right.",
                f"Steps of {', '.join(r.schedule.commands)} against time.",
                chart=chart_of(commands),
            ),
        ],
    )


def _std_pictures(design: Design, reference: Array | None) -> list[Picture]:
    shown = [i for i, v in enumerate(design.values) if v]
    if not shown or not np.isfinite(design.std).all():
        return []
    figure = new_figure(_WIDTH, 0.3 * max(len(shown), 2) + 1.1)
    ax = figure.subplots()
    place = np.arange(len(shown))
    relative = 100 * design.std[shown] / np.abs(design.values[shown])
    both = [("this plan", relative, BLUE, "")]
    if reference is not None:
        other = 100 * reference[shown] / np.abs(design.values[shown])
        both.append(("best random two-level", other, ORANGE, "///"))
    thick = 0.8 / len(both)
    for k, (label, value, colour, hatch) in enumerate(both):
        ax.barh(
            place + (k - (len(both) - 1) / 2) * thick, value, thick, color=colour, label=label,
            hatch=hatch, edgecolor="white", linewidth=0.3,
        )  # fmt: skip
    ax.set_xscale("log")
    every = np.concatenate([v for _, v, _, _ in both])
    every = every[np.isfinite(every) & (every > 0)]
    if every.size:
        ax.set_xlim(every.min() / 2, every.max() * 1.5)
    ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    names = [design.names[i] for i in shown]
    ax.set_yticks(place, names, fontsize=_SIZE, parse_math=False)
    ax.invert_yaxis()
    ax.set_xlabel("standard error over prior value [%], log scale", fontsize=_SIZE)
    ax.tick_params(labelsize=_SIZE - 0.5)
    tidy(ax)
    ax.legend(
        fontsize=_SIZE, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False,
        borderaxespad=0.1,
    )  # fmt: skip
    left = [n for i, n in enumerate(design.names) if i not in shown]
    caption = "Predicted standard errors relative to the prior values; shorter is better."
    if left:
        caption += f" Left out, because their prior value is 0: {', '.join(left)}."
    words = ", ".join(f"{n} {v:.2g} %" for n, v in zip(names, relative, strict=True))
    alternative = f"Bars of relative standard errors: {words}."
    return [Picture(to_svg(figure, "precision"), caption, alternative)]


def _std_table(design: Design, reference: Array | None) -> Table:
    rows = []
    for i, name in enumerate(design.names):
        value, std = float(design.values[i]), float(design.std[i])
        rows.append([
            name, f"{value:.4g}", f"{std:.2g}", f"{100 * abs(std / value):.1f} %" if value else "–",
            *([] if reference is None else [f"{reference[i]:.2g}"]),
        ])  # fmt: skip
    return Table(
        "Predicted standard errors of the wanted parameters",
        [
            "parameter", "prior", "this plan", "relative",
            *([] if reference is None else ["best random"]),
        ],
        rows,
    )  # fmt: skip


def _alternatives(design: Design) -> list[Table]:
    rows = []
    for item in design.to_dict()["alternatives"]:
        gain = item["efficiency_of_design"]
        telling = gain is not None and gain < _TELLS_NOTHING
        rows.append([
            item["name"], str(item["tried"]), str(item["kept"]),
            (f"{gain:.2f}" if telling else "tells nothing")
            + ("" if item["kept"] else " (breaks limits)"),
        ])  # fmt: skip
    if not rows:
        return []
    return [
        Table(
            "Classical sequences by the same criterion: how many times the best of each kind this "
            "plan tells",
            ["instead of", "tried", "keep the limits", "times"],
            rows,
        )
    ]


def _limits(design: Design) -> Table:
    several = design.request.trials > 1
    rows = []
    for x in design.limits:
        if not np.isfinite(x.missed):
            state = "broken: the motion runs away"
        elif x.missed > 1e-3:
            state = f"broken by {x.missed:.3g} {x.unit}".rstrip()
        else:
            state = "kept"
        rows.append([
            *([str(x.trial + 1)] if several else []), x.name, f"{x.bound:g} {x.unit}".rstrip(),
            state,
        ])  # fmt: skip
    for name, least in design.margins.items():
        unit = "rad/s" if name == "r" else "m/s"
        rows.append([
            *(["all"] if several else []), f"least |{name}| from zero, currents included", "",
            f"{least:.3g} {unit}",
        ])  # fmt: skip
    return Table(
        "How the plan keeps its limits under the prior model",
        [*(["trial"] if several else []), "limit", "bound", "plan"],
        rows,
    )
