"""The power study: it counts what a judge says, and shows it with intervals."""

from __future__ import annotations

import csv
import io
from functools import partial

import numpy as np
import pytest
from statsmodels.stats.proportion import proportion_confint

from greybox.errors import ExcitationError, UsageError
from greybox.report.power import power_output, shares_csv
from greybox.report.studies import write_output
from greybox.study.blind_causes import Effect
from greybox.study.blind_conditions import Conditions
from greybox.study.power import Cell, Judgement, Oracle, Outcome, Power, Share, run_power

QUICK = Conditions(euler=True, samples=60)


def outcome(true, verdict, ids=(), groups=(), **more):
    cell = Cell(tuple(true), 1.0, "manoeuvres")
    truth = tuple(Effect(n, {"lag": 5.0, "variant": "speed"}) for n in true)
    return Outcome(cell, 0, truth, Judgement(verdict, tuple(ids), tuple(groups), **more))


@pytest.mark.parametrize(
    ("given", "answer", "found"),
    [
        (((), "none"), "right", "none"),
        (((), "named", ["current"]), "wrong", "current"),
        (((), "confused", [], [("current", "wind")]), "wrong", "group without"),
        (((), "unexplained"), "unexplained", "unexplained"),
        ((("current",), "none"), "none", "none"),
        ((("current",), "named", ["current"]), "right", "current"),
        ((("current",), "named", ["wind"]), "wrong", "wind"),
        ((("current",), "named", ["wind", "current"]), "part", "wind"),
        ((("current",), "confused", [], [("current", "wind")]), "group", "group with it"),
        ((("current",), "confused", [], [("lag", "wind")]), "wrong", "group without"),
        ((("current", "waves"), "named", ["current"]), "part", "current"),
        ((("current", "waves"), "named", ["waves", "current"]), "right", "waves"),
        ((("backlash",), "unexplained"), "right", "unexplained"),
        ((("backlash",), "named", ["current"]), "wrong", "current"),
    ],
)
def test_each_answer_is_counted_as_what_it_is(given, answer, found):
    one = outcome(*given)
    assert (one.answer, one.found) == (answer, found)
    assert one.detected == (given[1] != "none")


@pytest.mark.parametrize(
    ("effect", "parameters", "place", "rightly"),
    [
        ("thruster_gain", {"gain_n2": 0.7}, "thruster_gain:n2:1", True),
        ("thruster_gain", {"gain_n2": 0.7}, "thruster_gain:n1:0", False),
        ("clock_offset", {"clock_u": 2.0}, "clock_offset:u:kinematics", True),
        ("clock_offset", {"clock_u": 2.0}, "clock_offset:v", False),
        ("parameter_change", {"Yv_factor": 2.0, "Yv_time": 9.0}, "parameter_change:Yv", True),
        ("parameter_change", {"Yv_factor": 2.0, "Yv_time": 9.0}, "parameter_change:Yvr", False),
        ("cubic_damping", {"X_uuu": -0.1}, "cubic_damping:Y_vvv", False),
        ("asymmetry", {"Y_taux": 0.1, "N_taux": 0.1}, "asymmetry:N_taux+Y_taux", True),
        ("asymmetry", {"Y_taux": 0.1, "N_taux": 0.1}, "asymmetry:N_|u|u+Y_|u|u", False),
        ("sign", {"channel": "alpha1"}, "sign:sign_alpha1", True),
        ("sign", {"channel": "alpha1"}, "sign:swapped_alpha1_alpha2", False),
        ("current", {"current_north": 0.3}, "current", True),
    ],
)
def test_a_cause_of_another_place_is_named_wrongly(effect, parameters, place, rightly):
    cell = Cell((effect,), 1.0, "manoeuvres")
    judged = Judgement("named", (effect,), places=(place,))
    one = Outcome(cell, 0, (Effect(effect, parameters),), judged)
    assert one.answer == ("right" if rightly else "wrong")
    assert one.found == effect + (" elsewhere" * (not rightly))


def test_intervals_are_those_of_wilson():
    for hits, runs in ((0, 10), (3, 17), (20, 20), (5, 100)):
        expected = proportion_confint(hits, runs, method="wilson")
        assert Share(hits, runs).interval == pytest.approx(expected, abs=1e-6)
    assert str(Share(1, 2)) == "50 % (9-91)"
    assert str(Share(0, 0)) == ""


def seesaw(trial, *, threshold):
    """A judge that calls noisy sway rates a cause; it must not see the truth."""
    assert trial.truth == ()
    assert trial.ship == {}
    roughness = np.diff(trial.estimation["r"]).std()
    if roughness < threshold:
        return Judgement("none")
    return Judgement("named", ("waves",), (), {"ratio": (3.1, 0.1)}, {"u": 1.0})


@pytest.fixture(scope="module")
def study():
    return run_power(
        partial(seesaw, threshold=0.0235),
        effects=[("waves",), ("uneven_damping",), ("current",)],
        sizes=(0.25, 1.0),
        kinds=("manoeuvres", "pulses"),
        runs=4,
        none_runs=6,
        seed=1,
        conditions=QUICK,
        workers=1,
    )


def test_every_trial_is_drawn_and_none_that_cannot_show(study):
    assert len(study.outcomes) == 2 * 6 + 2 * 4 * (3 + 2)
    assert Cell(("uneven_damping",), 1.0, "pulses") not in study.cells
    whole = Cell(("waves",), 1.0, "manoeuvres")
    assert study.share(whole, "right").value == 1.0
    assert study.share(Cell(("waves",), 0.25, "manoeuvres"), "right").value < 1.0
    assert study.confusion("manoeuvres", 1.0)["waves"] == {"waves": 4}
    assert study.errors(whole)["ratio"] == [(pytest.approx(0.1), 0.1)] * 4
    assert study.gains(whole) == {"u": [1.0] * 4}


def test_one_ship_serves_every_size_of_an_effect(study):
    by_size = [
        [o.truth[0].number("frequency") for o in study.of(Cell(("waves",), size, "pulses"))]
        for size in (0.25, 1.0)
    ]
    assert by_size[0] == by_size[1]
    assert len(set(by_size[0])) == 4


def test_failures_are_counted_not_raised(tmp_path):
    study = run_power(failing, effects=[("current",)], sizes=(1.0,), runs=2, none_runs=0,
                      conditions=QUICK, workers=1)  # fmt: skip
    assert study.share(study.cells[0], "failed") == Share(2, 2)
    write_output(power_output(study, {"program": "test"}), tmp_path)
    assert "turn more" in (tmp_path / "report.html").read_text()


def failing(trial):
    raise ExcitationError("turn more")


def test_more_runs_begin_with_the_same_trials(study):
    again = run_power(
        partial(seesaw, threshold=0.0235), effects=[("waves",)], sizes=(1.0,), runs=12,
        none_runs=0, kinds=("pulses",), seed=1, conditions=QUICK, workers=1,
    )  # fmt: skip
    cell = Cell(("waves",), 1.0, "pulses")
    assert [o.truth for o in again.of(cell)][:4] == [o.truth for o in study.of(cell)]
    assert [o.run for o in again.outcomes] == list(range(12))


def test_tables_figures_and_page(study, tmp_path):
    output = power_output(study, {"program": "test"})
    write_output(output, tmp_path)
    assert (tmp_path / "shares.csv").read_text() == shares_csv(study)
    assert "with nothing wrong, something was found in" in output.text
    lines = (tmp_path / "tables.csv").read_text().splitlines()
    assert lines[0].startswith("table,set,estimator,parameter,mean,sd")
    rows = list(csv.DictReader(io.StringIO(shares_csv(study))))
    assert len(rows) == 8 * len(study.cells)
    for row in rows:
        assert float(row["low"]) <= float(row["share"]) <= float(row["high"])
    for name in ("power", "confusion_manoeuvres", "confusion_pulses"):
        assert (tmp_path / f"{name}.png").stat().st_size > 5000
    page = (tmp_path / "report.html").read_text()
    for words in ("named rightly", "Parameters of the causes", "95 % intervals hold"):
        assert words in page


def knows(trial):
    """An oracle that needs the truth: half of the ships are hardly moved by their effect."""
    assert trial.truth
    large = trial.ship["Xu"] < -0.05
    return Oracle(0.3 if large else 0.01, {"u": 3.0})


def test_an_oracle_says_which_trials_count_and_what_was_lost(tmp_path):
    study = run_power(
        partial(seesaw, threshold=0.0235), oracle=knows, effects=[("waves",), ("current",)],
        sizes=(1.0,), runs=8, none_runs=2, seed=1, conditions=QUICK, workers=1,
    )  # fmt: skip
    waves, current = (Cell((n,), 1.0, "manoeuvres") for n in ("waves", "current"))
    assert all(o.oracle is None for o in study.of(Cell((), 1.0, "manoeuvres")))
    large = [o for o in study.of(current) if o.oracle.matters]
    assert 0 < len(large) < 8
    assert study.visible(current) == large
    # being named rightly makes no trial one that had to be found
    found = [o for o in study.of(waves) if o.oracle.matters]
    assert 0 < len(found) < 8
    assert study.visible(waves) == found
    assert study.lost(waves) == [2.0] * 8
    output = power_output(study, {"program": "test"})
    share = Share(len(found), len(found) + len(large))
    assert f"by at least 5 %, it was named in {share} of {share.runs} trials" in output.text


def test_shares_of_a_cell_add_to_one(study):
    from greybox.study.power import ANSWERS

    for cell in study.cells:
        assert sum(study.share(cell, a).hits for a in ANSWERS if a != "detected") == len(
            study.of(cell)
        )
    assert Power(()).cells == ()


@pytest.mark.parametrize(
    ("judge", "changes", "words"),
    [
        (lambda trial: Judgement("maybe"), {}, "verdict 'maybe' with 0 ids"),
        (lambda trial: Judgement("named"), {}, "at least 1 id"),
        (lambda trial: Judgement("none"), {"none_runs": 0, "effects": []}, "0 trials"),
        (lambda trial: Judgement("none"), {"effects": [("curent",)]}, "Did you mean 'current'"),
    ],
)
def test_a_study_that_cannot_be_run_says_so(judge, changes, words):
    options = {"effects": [], "none_runs": 1, "runs": 1, "conditions": QUICK, "workers": 1}
    with pytest.raises(UsageError, match=words):
        run_power(judge, **(options | changes))
