"""The page of a diagnosis: its story, its statistics, and legible in a real browser."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from browser import needs_browser, require_legible, without_scripts
from virtual import PARAMETERS, virtual_log

from greybox.diagnosis.result import BudgetPart, Diagnosis, Found, Quantity, Ranked, Runs, Symptom
from greybox.model.catalogue import get_structure
from greybox.model.model import ManoeuvringModel
from greybox.model.noise import NoiseLevels
from greybox.model.run.changes import Change
from greybox.notebook import with_error
from greybox.report.diagnosed_causes import probability
from greybox.report.diagnosis import diagnosis_page
from greybox.report.diagnosis_figures import command_figure, gain_figure, most_followed
from greybox.report.error_budget import budget_figure, budget_in_words, budget_table, largest
from greybox.report.error_profiles import block_ids, memory, profile
from greybox.report.free_run_errors import gather
from greybox.report.model_difference import (
    coefficient_table,
    marked_equations,
    other_changes,
)
from greybox.report.page import render, write_page
from greybox.study.chapter6 import TRUE
from greybox.validation.fit import run_model
from greybox.validation.gain import Gain
from greybox.vessel.toml import load_vessel
from greybox.vessel.vessel import Actuation

HOSTILE = '<script>alert("x")</script> & $x^$'
SIDE = {"v": -1, "r": -1, "psi": -1}
VERDICTS = ("named", "partly", "none", "confused", "unexplained")
RECORD = {"program": "greybox-marine 0.1.0", "command": {"logs": ["day1.csv"], "seed": 0},
          "logs": ["day1.csv 0123456789ab"]}  # fmt: skip


def model_of(names=PARAMETERS, **more):
    structure = get_structure("thesis")
    structure = structure.with_terms(*[n for n in names if n not in PARAMETERS])
    theta = np.array([TRUE.get(n, -0.002) for n in structure.parameters])
    return ManoeuvringModel(
        structure, theta, np.diag((0.02 * theta) ** 2), 1.0, load_vessel("thesis"), **more
    )


def extended():
    vessel = load_vessel("thesis")
    first = replace(vessel.thrusters[0], gain=0.83, angle_offset=0.05)
    second = replace(vessel.thrusters[1], angle="alpha9")
    vessel = replace(
        vessel, thrusters=(first, second, *vessel.thrusters[2:]),
        actuation=Actuation(lag=2.5, delay=1.0),
        sensors={**vessel.sensors, "heading_bias": 0.06, "clock": {"u": 1.5}, "reversed": ("r",),
                 "velocity_at": (3.0, -1.0)},
    )  # fmt: skip
    model = model_of(
        (*PARAMETERS, "N_|r|r"),
        disturbances={"current_north": (0.2, 0.004), "current_east": (-0.2, 0.005)},
        changes=(Change("Xu", 1.6, 600.0),),
    )
    return replace(model, vessel=vessel)


def flown():
    current = {"current_north": (0.2, 0.004), "current_east": (-0.2, 0.005)}
    model = model_of((*PARAMETERS, "N_|r|r"), disturbances=current)
    return replace(model, theta=np.append(model.theta[:-1], -1e-6))


@cache
def runs_of(names, same):
    before = model_of()
    after = before if same else flown()
    out = []
    for i, name in enumerate(names):
        log = virtual_log(i, 600, wind=0.0, name=name)
        x, y = (run_model(m, log).x.T for m in (before, after))
        states = ("u", "v", "r")
        if i:  # another day to port
            log = replace(log, channels={k: SIDE.get(k, 1) * v for k, v in log.channels.items()})
            x, y = (
                [SIDE.get(s, 1) * row for s, row in zip(states, z, strict=True)] for z in (x, y)
            )
        out.append(
            Runs(log, i > 0, {s: log[s] for s in states}, dict(zip(states, x, strict=True)),
                 dict(zip(states, y, strict=True)))
        )  # fmt: skip
    return tuple(out)


CURRENT = Found(
    "current", "current", "current",
    {"current_north": Quantity(0.203, 0.004, "m/s"),
     "current_east": Quantity(-0.197, 0.005, "m/s")},
    0.0, 1e-300, "the errors of surge and sway turn with the heading as in a current of 0.28 m/s "
    "towards 316 deg", "the mean current, north and east", "Fossen (2011)", 5210.4, 1804.2, 95.1,
)  # fmt: skip
BIAS = Found(
    "heading_bias", "heading_bias", "compass bias",
    {"heading_bias": Quantity(0.0612, 0.0021, "rad")}, 3e-8, 1.2e-6,
    "surge and sway are turned against the ship's axes by 3.5 ± 0.1 deg",
    "the bias of the compass in the vessel", "Fossen (2011)", 61.2, 22.8, 9.4,
)  # fmt: skip
BUDGET = tuple(
    BudgetPart(
        name, dict.fromkeys("uvr", share), dict.fromkeys("uvr", (share - 0.05, share + 0.05)),
        dict.fromkeys("uvr", 0.0 if name == "current" else share),
    )
    for name, share in {"sensor noise": 0.1, "current": 0.7, "not split": 0.2}.items()
)  # fmt: skip
STEPS = (
    (
        Ranked("current", 4800.0, 5210.4, 1804.2, 95.1),
        Ranked("heading_bias", 900.0, 1210.0, -240.0, 80.0),
        Ranked("parameter_change:Xu", 610.0, 700.0, 30.0, 60.0),
        Ranked("crossflow:Y_|r|v", 210.0, 180.0, 12.0, 21.0),
        *[Ranked(f"thruster_gain:n:alpha{k}", 80.0 - 5 * k) for k in range(9)],
    ),
    (
        Ranked("heading_bias", 55.0, 61.2, 22.8, 9.4),
        Ranked("advance_speed:X_u*taux+Y_u*tauy+N_u*taun", 4.0),
        Ranked("thruster_gain:n$x^{:<b>", 0.4),
    ),
)


def diagnosis_of(verdict, name="day 2"):
    same = verdict == "none"
    base = model_of()
    runs = runs_of(("day 1", name), same)
    gain = {
        "u": Gain(41.2, 41.2 if same else 88.1, (0.0, 0.0) if same else (43.0, 50.1)),
        "v": Gain(-3e4 if verdict == "confused" else 35.0, 35.0 if same else 79.3, (31.0, 55.0)),
        "r": Gain(81.0, 81.0 if same else 81.3, (-0.4, 1.0)),
    }
    return Diagnosis(
        verdict=verdict,
        causes={"named": (CURRENT, BIAS), "partly": (CURRENT,)}.get(verdict, ()),
        groups=(("current", "heading_bias"),) if verdict == "confused" else (),
        gain=gain,
        wrong=()
        if same
        else (
            Symptom("surge is over-predicted by 0.21 m/s when heading south", "u", 14.2),
            Symptom("sway is under-predicted by 0.19 m/s when heading east", "v", 12.9),
        ),
        partial={"unexplained": (CURRENT,), "partly": (BIAS,)}.get(verdict, ()),
        candidates=(CURRENT, BIAS) if verdict == "confused" else (),
        base=base,
        model=base if same else flown(),
        alternatives={},
        remaining="What remains of the error is noise (p = 0.41).",
        validated_on=f"on {name}, which nothing was fitted to",
        next_steps=("Turn through all headings at one speed.", "Calibrate the compass."),
        steps=STEPS[:1] if same else STEPS,
        runs=runs,
        notes=("The sample time of 1 s hides lags below 0.75 s.",),
        tried=52,
        record={"seed": 7},
    )


@pytest.fixture(scope="module")
def pages():
    return {v: diagnosis_page(diagnosis_of(v, HOSTILE), RECORD) for v in VERDICTS}


@pytest.fixture(scope="module")
def written(pages):
    """The pages as HTML, without the scripts that are their own."""
    return {v: without_scripts(render(page)) for v, page in pages.items()}


@pytest.fixture(scope="module")
def told(written):
    """What the pages say."""
    return {v: text_of(html) for v, html in written.items()}


def text_of(html):
    told = re.sub(r"<[^>]+>", "", re.sub(r"<svg.*?</svg>", "", html, flags=re.S))
    # units are tied to their numbers
    return told.replace("\u00a0", " ")


@pytest.mark.parametrize("verdict", VERDICTS)
def test_story_in_its_order(told, verdict):
    shown = told[verdict]
    titles = ["What to do next", *(f"{k}. " for k in range(1, 6))]
    places = [shown.index(title) for title in titles]
    assert places == sorted(places)
    assert f"Verdict: {verdict}, after 52 causes were tried." in shown
    assert "What remains of the error is noise (p = 0.41)." in shown
    assert "Calibrate the compass." in shown
    assert "hides lags below 0.75 s" in shown
    assert "0123456789ab" in shown
    assert "greybox-marine 0.1.0" in shown


@pytest.mark.parametrize("verdict", VERDICTS)
def test_names_from_logs_are_escaped(written, verdict):
    html = written[verdict]
    assert "<script>" not in html
    assert "<b>" not in html
    assert "&lt;script&gt;alert(&#34;x&#34;)&lt;/script&gt; &amp; $x^$" in html


def test_nothing_is_fetched(written):
    html = written["named"]
    assert not re.search(r'(?:src|href)="(?!#)', html)
    assert not re.search(r"url\((?!#)", html)


def test_named(pages, written, told):
    shown = told["named"]
    assert pages["named"].headline.startswith("Current: the errors of surge and sway turn")
    assert "surge is over-predicted by 0.21 m/s when heading south" in shown
    assert "surge from 41.2 % to 88.1 %" in shown
    assert "0.2030 ± 0.0040" in shown
    assert "3.51 ± 0.12 deg" in shown
    assert "below 1e−16" in shown
    assert "1804.2 ± 95.1" in shown
    assert "current_north is 0.2000 ± 0.0040 m/s; before, the water stood still." in shown
    assert "Extension for current: the mean current, north and east." in shown
    assert "43.0 to 50.1" in shown
    assert pages["named"].sections[1].title == "2. Causes"
    assert "<ins>N_|r|r·|r|·r</ins>" in written["named"]


def test_none(pages, written, told):
    shown = told["none"]
    assert "Nothing is wrong beyond noise." in shown
    assert "52 causes were tried; held-out logs confirm none of them." in shown
    assert "The model stays as it is." in shown
    assert "<ins>" not in written["none"]
    assert "before and after" not in pages["none"].lead.caption


@pytest.mark.usefixtures("undrawn")
def test_whose_the_error_is_stands_in_bars_and_numbers(told):
    named = diagnosis_of("named")
    noise = NoiseLevels(("u", "v", "r"), np.full(3, 0.014), np.zeros(3), 0.0, 0.0, "test")
    named = replace(named, budget=BUDGET, model=replace(named.model, noise=noise))
    page = diagnosis_page(named, RECORD)
    assert "Sources of the squared error" in page.lead.caption
    assert "surge u: current 70 %" in page.lead.alternative
    assert "70.0 (65.0 to 75.0)" in text_of(without_scripts(render(page)))
    assert "Sources of the squared" not in told["named"]
    # 0.1 of 0.3 that are left; a perfect model misses by the noise alone
    said = " ".join(page.sentences)
    assert "that is left: surge 33 %, sway 33 %, yaw rate 33 %" in said
    surge = np.concatenate([run.measured["u"] for run in named.runs if run.held_out])
    assert f"about surge {100 * (1 - 0.014 / surge.std()):.0f} %" in said


@pytest.mark.usefixtures("undrawn")
def test_a_model_that_lacks_nothing_is_judged_as_it_is():
    """Coefficients estimated again without a part of the logs are no other model."""
    given = diagnosis_of("none")
    runs = [replace(run, after={s: 0.9 * x for s, x in run.after.items()}) for run in given.runs]
    gain = {s: Gain(66.0, fit, (-40.0, -20.0)) for s, fit in zip("uvr", (30, 31, 32), strict=True)}
    page = diagnosis_page(replace(given, runs=tuple(runs), gain=gain, budget=BUDGET), RECORD)
    assert page.headline == (
        "Nothing is wrong beyond noise. You can predict with the model: on data held out from the "
        "fit it has a fit of surge 66 %, sway 66 %, yaw rate 66 %."
    )
    pictures = [page.lead, *(p for s in page.sections for p in s.pictures)]
    assert not any("after" in p.caption for p in pictures)
    assert "changes" not in " ".join(page.sentences)
    # 0.1 of all, not of what an extension leaves
    assert "that is left: surge 10 %, sway 10 %, yaw rate 10 %" in " ".join(page.sentences)
    assert len(budget_figure(BUDGET, False).axes[0].containers) == 1


@pytest.mark.usefixtures("undrawn")
def test_what_is_wrong_is_shown_where_the_model_was_not_fitted():
    still = replace(diagnosis_of("none"), verdict="unexplained", remaining="Why: a, b. More of it.")
    page = diagnosis_page(still, RECORD)
    assert "held out from the fit" in page.lead.caption
    assert "estimated on" in page.sections[0].pictures[0].caption
    # why is enough for the first screen
    assert "explains it. Why: a, b. Do not predict" in page.headline
    first, other = still.runs
    late = np.arange(len(other.log)) > 500
    far = {s: x + 2 * np.ptp(x) * late for s, x in other.before.items()}
    away = replace(still, runs=(first, replace(other, before=far, after=far)))
    told = "What leaves the picture is drawn at its edge."
    assert told in diagnosis_page(away, RECORD).lead.caption
    assert told not in diagnosis_page(away, RECORD).sections[0].pictures[0].caption


@pytest.mark.usefixtures("undrawn")
def test_noise_allows_what_it_does_about_the_mean_of_each_log():
    noise = NoiseLevels(("u", "v", "r"), np.full(3, 0.014), np.zeros(3), 0.0, 0.0, "test")
    named = diagnosis_of("named")
    held = named.runs[1]
    faster = replace(held, measured={s: y + 5.0 for s, y in held.measured.items()},
                     log=replace(held.log, name="day 3"))  # fmt: skip
    named = replace(named, model=replace(named.model, noise=noise), runs=(held, faster))
    want = 100 * (1 - 0.014 / held.measured["u"].std())
    assert named.noise_bounds()["u"] == pytest.approx(want)


@pytest.mark.usefixtures("undrawn")
def test_causes_of_the_budget_have_their_titles():
    own = replace(CURRENT, id="thruster_lag:n", key="thruster_lag:n", title="slow thrusters")
    other = replace(own, id="thruster_lag:alpha1", key="thruster_lag:alpha1")
    parts = [BUDGET[0], *(replace(BUDGET[1], part=c.id) for c in (own, other)), BUDGET[2]]
    named = replace(diagnosis_of("named"), budget=tuple(parts))
    for causes, first in (((own,), "slow thrusters"), ((own, other), "slow thrusters (n)")):
        told = replace(named, causes=causes)
        rows = budget_table(budget_in_words(told)).rows
        assert [row[0] for row in rows[:2]] == ["sensor noise", first]
        assert f"surge u: {first} 70 %" in diagnosis_page(told, RECORD).lead.alternative
    assert told.to_dict()["budget"][1]["part"] == "thruster_lag:n"


@pytest.mark.usefixtures("undrawn")
def test_parts_that_do_not_add_up_are_said_to():
    budget = (*BUDGET[:-1], replace(BUDGET[-1], share={"u": 0.2, "v": 0.2, "r": -23.1}))
    named = replace(diagnosis_of("named"), budget=budget)
    told = "Of r the parts do not add up to the error"
    assert told in diagnosis_page(named, RECORD).lead.caption
    lines = named.summary().splitlines()
    assert any(told in line for line in lines)
    (shown,) = (line for line in lines if line.startswith("  not split"))
    assert shown.count("  20.0 (") == 2
    assert "  -2310.0 (" in shown


@pytest.mark.usefixtures("undrawn")
def test_a_share_that_may_be_any_is_not_told():
    wide = {"u": (0.15, 0.25), "v": (-0.2, 0.8), "r": (-0.3, 1.4)}
    budget = (BUDGET[0], replace(BUDGET[1], ci=wide), BUDGET[2])
    named = replace(diagnosis_of("named"), budget=budget)
    (line,) = (x for x in named.summary().splitlines() if x.startswith("  current  "))
    assert line.split("  ")[-1].strip() == "not determined"
    assert "70.0 (-20.0 to 80.0)" in line
    assert budget_table(budget).rows[1][-1] == "not determined"
    widths = [[b.get_width() for b in ax.patches] for ax in budget_figure(budget).axes]
    assert np.isnan(widths[2][1])
    assert np.isfinite(widths[1]).all()
    unsaid = "Shares that the logs do not determine are not drawn."
    page = diagnosis_page(named, RECORD)
    # the picture of what logs do not tell is not the first
    assert unsaid not in page.lead.caption
    assert unsaid in page.sections[0].pictures[-1].caption
    assert unsaid not in diagnosis_page(diagnosis_of("named"), RECORD).lead.caption
    assert named.to_dict()["budget"][1]["ci"]["r"] == [-0.3, 1.4]
    assert "current" in largest(BUDGET).split("; ")[-1]
    assert "current" not in largest(budget).split("; ")[-1]
    assert (
        largest([replace(budget[1], ci=dict.fromkeys("uvr", (-1.6, 1.8)))]).count("not determined")
        == 3
    )


def test_confused(told):
    shown = told["confused"]
    assert "these logs cannot tell which cause it is: current or heading_bias." in shown
    assert "greybox design --between" in shown
    assert "heading_bias looks like sway in proportion to surge" in shown
    assert "sway from diverged to 79.3 %" in shown
    assert "drawn at the edge" in shown
    assert "A run that diverged has no interval." in shown


@pytest.mark.usefixtures("undrawn")
def test_the_first_of_what_cannot_be_told_apart_is_judged(pages):
    assert "You can predict with the model with current: on data" in pages["confused"].headline
    assert "cannot tell apart." in pages["confused"].sections[1].pictures[0].caption
    # a run that diverged has no interval, in words as in numbers
    rows = pages["confused"].sections[3].tables[0].rows
    assert [row[3:] for row in rows if row[1] == "diverged"] == [["", ""]]
    several = replace(diagnosis_of("confused"), groups=(("a", "b"), ("c", "d")))
    assert several.headline.endswith("cause it is: a or b; c or d.")


def test_a_gain_is_drawn_up_to_a_perfect_fit():
    gain = {
        "u": Gain(-30.0, 80.0, (90.0, 240.0)), "v": Gain(-2000.0, 60.0, (1500.0, 2600.0))
    }  # fmt: skip
    ax = gain_figure(gain).axes[0]
    intervals = [line.get_xdata() for line in ax.lines if line.get_linewidth() == 6]
    assert [list(x) for x in intervals] == [[60.0, 100.0], []]


def test_unexplained(told):
    shown = told["unexplained"]
    assert "None of the 52 causes that were tried explains the errors. No better than a generic "
    assert "force would be: current." in shown
    assert "current: the errors of surge and sway" in shown


def test_partly(pages, told):
    shown = told["partly"]
    # causes first, then what remains
    headline = pages["partly"].headline
    assert headline.startswith("Current: the errors of surge and sway turn")
    assert "What remains of the error is noise (p = 0.41). You can predict with" in headline
    assert "These causes are confirmed, and an error beyond noise remains." in shown
    assert "No better than a generic force would be: heading_bias." in shown


def test_a_model_that_misses_held_out_data_is_not_to_be_predicted_with():
    named = diagnosis_of("named")
    gain = {
        s: Gain(-30.0, fit, (1.0, 9.0)) for s, fit in {"u": 35.0, "v": 60.0, "r": -17.0}.items()
    }
    said = diagnosis_page(replace(named, gain=gain), RECORD).headline
    assert "Do not predict surge, yaw rate with the extended model: on data held out" in said
    assert "surge 35 %, sway 60 %, yaw rate -17 %" in said


def test_every_picture_says_what_it_shows(pages):
    for page in pages.values():
        pictures = [page.lead, *(p for s in page.sections for p in s.pictures)]
        assert len(pictures) >= 6
        assert all(len(p.alternative) > 60 for p in pictures)
    runs = [p for p in pages["named"].sections[0].pictures if "Free run on" in p.caption]
    assert ["held out" in p.caption for p in runs] == [False, True]
    assert "Root mean square errors: surge [m/s] 0." in runs[0].alternative


def test_logs_without_runs_or_gain():
    bare = replace(diagnosis_of("unexplained"), runs=(), gain={}, steps=((),), partial=())
    html = render(diagnosis_page(bare, RECORD))
    assert "No gain was measured." in text_of(html)
    assert "<svg" not in html


@pytest.mark.long
def test_runs_that_run_away_are_left_out_and_said_so():
    diagnosis = diagnosis_of("named")
    run = diagnosis.runs[0]
    wild = {s: np.where(np.arange(len(x)) < 500, x, np.inf) for s, x in run.before.items()}
    diagnosis = replace(diagnosis, runs=(replace(run, before=wild), diagnosis.runs[1]))
    errors = gather(diagnosis.runs)
    assert errors.lost == 100
    assert np.isfinite(errors.rms("before", "u"))
    assert "runs away at 100 of 1200 samples" in text_of(render(diagnosis_page(diagnosis, RECORD)))


def test_the_command_that_errors_follow_is_shown(told):
    run = runs_of(("one",), False)[0]
    n = run.log["n"]
    # commands are held for long: an error that follows one of them, and a little of all else
    pushed = {s: run.measured[s] - 0.01 * (n - n.mean()) for s in run.measured}
    errors = gather([replace(run, before=pushed, after=dict(run.measured))])
    assert set(errors.commands) == {c for c in run.log.vessel.commands if np.ptp(run.log[c]) > 0}
    assert most_followed(errors) == "n"
    figure = command_figure(errors, "n")
    line = figure.axes[0].get_lines()[0]
    place, mean = line.get_xdata(), line.get_ydata()
    slope = np.polyfit(place, mean, 1)[0]
    assert slope == pytest.approx(0.01, rel=1e-6)
    # a command with two values has two bins
    two = replace(errors, commands={"n": np.where(n > np.median(n), 5.0, 3.0)})
    assert len(command_figure(two, "n").axes[0].get_lines()[0].get_xdata()) == 2
    assert most_followed(replace(errors, commands={})) is None
    assert "by the command that it goes with most" in told["named"]


@pytest.mark.usefixtures("undrawn")
def test_a_step_without_a_named_cause_says_so():
    named = diagnosis_of("named")
    told = [p.caption for p in diagnosis_page(named, RECORD).sections[1].pictures]
    assert "Bold: the causes that the verdict names." in told[0]
    other = replace(named, steps=(tuple(r for r in named.steps[0] if r.key[0] == "t"),))
    (told,) = (p.caption for p in diagnosis_page(other, RECORD).sections[1].pictures)
    assert "The verdict names none of these." in told
    assert "Bold" not in told


def test_only_what_the_verdict_names_is_bold(pages):
    # glyphs of bold names: c of current, _ of heading_bias
    named, partly = (pages[v].sections[1].pictures[0].svg for v in ("named", "partly"))
    assert "-Bold-46" in named
    assert "-Bold-42" in named
    assert "-Bold-46" in partly
    assert "-Bold-42" not in partly


@pytest.mark.usefixtures("undrawn")
def test_the_gain_beyond_the_terms_that_the_data_chose(pages):
    over = {"u": Gain(55.3, 61.4, (5.1, 7.1)), "v": Gain(-2e3, 61.4, (5.1, 7.1))}
    page = diagnosis_page(replace(diagnosis_of("named"), gain_over_chosen=over), RECORD)
    tables = page.sections[3].tables
    assert len(tables) == 1 + len(pages["named"].sections[3].tables)
    assert "the terms that the data chose" in tables[1].caption
    assert tables[1].rows[0] == ["surge", "55.3 %", "61.4 %", "+6.1", "5.1 to 7.1"]
    assert tables[1].rows[1][:4] == ["sway", "diverged", "61.4 %", ""]


@pytest.mark.usefixtures("undrawn")
def test_a_cause_that_is_there_or_not_has_no_number():
    held = replace(CURRENT, parameters={"interpolated": Quantity(1.0, 0.0, "1")})
    named = replace(diagnosis_of("named"), causes=(held,))
    page = diagnosis_page(named, RECORD)
    assert "interpolated" not in render(page)
    assert "interpolated" not in named.summary()
    assert page.sections[1].title == "2. The cause"


def test_runs_that_end_before_their_log():
    run = diagnosis_of("named").runs[0]
    short = replace(run, after={s: x[:-5] for s, x in run.after.items()})
    errors = gather([short])
    assert errors.lost == 5
    assert (errors.regime[-5:] == -1).all()
    assert errors.regimes == (0,)
    page = diagnosis_page(replace(diagnosis_of("named"), runs=(short,)), RECORD)
    assert "The free run has ended or runs away at 5 of 600 samples" in text_of(render(page))


@pytest.mark.long
def test_causes_that_need_no_force_model():
    kinematic = replace(BIAS, key="heading_bias:kinematics", gain=np.nan)
    shown = text_of(
        render(diagnosis_page(replace(diagnosis_of("named"), causes=(kinematic,)), RECORD))
    )
    assert "none needed" in shown
    assert "0.0 ± " not in shown


def test_what_changes_beside_the_equations():
    told = " ".join(other_changes(model_of(), extended()))
    for part in (
        "gives 83.0 % of its thrust law, before 100 %",
        "stands 2.86 deg (0.0500 rad) beyond its logged angle",
        "a lag of 2.5 s of each force and a delay of 1 s; before, with no lag and no delay",
        "Thruster 2 (n, alpha9) was driven by n, alpha2 before.",
        "The compass shows 3.44 deg (0.0600 rad) too much.",
        "u comes 1.50 s too late.",
        "r has its sign turned.",
        "3.00 m ahead and -1.00 m to starboard",
        "Xu is 1.6 times its value from 600 s on, on the log's clock.",
        "current_east is -0.2000 ± 0.0050 m/s",
    ):
        assert part in told
    assert other_changes(model_of(), model_of()) == []


def test_equations_are_marked_where_they_differ():
    before, after = marked_equations(extended(), model_of())
    assert [t for t, mark in before.pieces if mark == "del"] == ["N_|r|r·|r|·r"]
    assert not any(mark for _, mark in after.pieces)
    same = marked_equations(model_of(), model_of())
    assert [m.title for m in same] == ["Equations"]


def test_coefficients_that_stood_for_a_sum_are_told():
    base = replace(model_of(), sums={"Xuu": ("Xuu", "Wuu")})
    rows = {r[0]: r for r in coefficient_table(base, extended()).rows}
    assert rows["Xuu"][-1] == "before: Xuu+Wuu"
    assert rows["Xu"][-1] == ""
    assert rows["N_|r|r"][1:] == ["", "-0.002000 ± 0.000040", "s", "new"]
    assert coefficient_table(extended(), base).rows[-1][-1] == "gone"


@pytest.mark.parametrize(
    ("value", "std", "shown"),
    [
        (0.31234, 0.0123, "0.312 ± 0.012"),
        (1234.5, 12.0, "1234 ± 12"),
        (3.2e-9, 1e-10, "3.20e-09 ± 1.0e-10"),
        (0.25, 0.0, "0.25"),
        (0.25, np.inf, "0.25"),
    ],
)
def test_digits_follow_the_standard_error(value, std, shown):
    assert with_error(value, std) == shown


def test_probability():
    assert probability(0.0123) == "0.012"
    assert probability(0.0) == "below 1e−16"


def test_intervals_of_means_hold_for_errors_with_a_memory():
    """95 % intervals cover a zero mean about as often, where those of white noise would not."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(11)
    group = (np.arange(2000) // 20) % 4
    series = lfilter([1], [1, -0.9], rng.standard_normal((300, 2000)))
    inside, plain = [], []
    for error in series:
        found = profile(error, group, block_ids([error]), 4)
        inside.append(np.abs(found.mean) < found.half)
        white = [1.96 * error[group == g].std() / np.sqrt((group == g).sum()) for g in range(4)]
        plain.append(np.abs(found.mean) < white)
    # the four groups of a series are nearly independent
    assert abs(np.mean(inside) - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 1200) + 0.02
    assert np.mean(plain) < 0.6


def test_profile_is_exact_and_admits_ignorance():
    value = np.r_[np.ones(50), 3 * np.ones(50)]
    group = np.r_[np.zeros(50, int), np.ones(49, int), -1]
    found = profile(value, group, np.arange(100) // 10, 3)
    assert found.mean[:2] == pytest.approx([1, 3])
    assert found.half[:2] == pytest.approx(0)
    assert np.isnan(found.mean[2])
    assert np.isnan(profile(value, group, np.arange(100) // 50, 2).half).all()
    assert list(found.samples) == [50, 49, 0]


def test_memory():
    assert memory(np.zeros(10)) == 1
    slow = np.sin(np.arange(400) * 2 * np.pi / 400)
    assert 80 < memory(slow) < 120


@needs_browser
@pytest.mark.parametrize(
    "verdict", ["named", *(pytest.param(v, marks=pytest.mark.long) for v in VERDICTS[1:])]
)
def test_in_a_browser(tmp_path, pages, verdict):
    path = tmp_path / "page.html"
    write_page(pages[verdict], path)
    require_legible(path, 390)


@pytest.mark.usefixtures("undrawn")
def test_many_causes_stand_by_their_titles_on_the_first_screen():
    one = diagnosis_of("named").causes[0]
    other = replace(one, title="another cause")
    many = replace(diagnosis_of("partly"), causes=(one, other, one, one))
    headline = diagnosis_page(many, RECORD).headline
    # causes of one title are told apart by what they estimate
    told = f"{one.title} ({', '.join(one.parameters)})"
    assert headline.startswith(f"4 causes stand: {told}; another cause; {told}; ")
    assert "They do not explain all of it. You can predict with the extended model" in headline
    assert one.evidence not in headline
