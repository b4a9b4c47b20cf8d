"""What a diagnosis begins with: its logs, the model that was given, and causes to look for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.diagnosis.diagnose import DiagnosisOptions, diagnose
from greybox.diagnosis.extension import extended_model
from greybox.diagnosis.null_model import clocks_of
from greybox.diagnosis.preparing import _movement, prepare
from greybox.diagnosis.ship import Ship
from greybox.diagnosis.symptoms import find_symptoms
from greybox.errors import LogError, UsageError
from greybox.model.model import ManoeuvringModel
from greybox.model.run.changes import Change, factors_at
from greybox.study.blind import draw
from greybox.trial.segments import as_segments


def test_the_order_of_the_logs_leaves_no_propeller_out() -> None:
    trial = draw(
        np.random.default_rng([31, 8]), ("quadratic_thrust",), samples=400, positions=False
    )
    speed = trial.estimation["n1"].copy()
    # a transit, in which the bow thruster is off
    speed[:250] = 0.0
    transit = replace(trial.estimation, channels={**trial.estimation.channels, "n1": speed})
    alike = []
    for logs in ([transit, trial.validation], [trial.validation, transit]):
        ready = prepare(logs, [], None, "thesis", ["quadratic_thrust"])
        share = ready.hypotheses[0]
        assert "n1" in share.arguments
        ship = Ship(np.zeros(0), np.zeros(2), trial.estimation.vessel)
        alike.append(share.apply(ship, np.ones(1)).vessel)
    assert alike[0] == alike[1]


def test_causes_that_the_logs_cannot_show_are_told() -> None:
    trial = draw(np.random.default_rng([31, 8]), (), samples=400, positions=False)
    still = {n: v for n, v in trial.estimation.channels.items() if n not in ("u_q", "v_q")}
    log = replace(trial.estimation, channels=still)
    asked = ["wind", "current", "waves"]
    assert prepare([log], [], None, "thesis", asked).untried() == ["wind"]
    found = diagnose([log], options=DiagnosisOptions(causes=["wind"], own_pace=False))
    assert found.verdict in ("none", "unexplained")
    (note,) = [n for n in found.notes if "asked for" in n]
    assert note.startswith("wind was asked for and not tried, since these logs cannot show it")


def test_changes_count_from_the_start_of_a_log_that_has_gaps() -> None:
    trial = draw(np.random.default_rng([31, 5]), (), samples=600, positions=False)
    log = trial.estimation
    # the first segment is too short for a diagnosis
    kept = np.ones(600, bool)
    kept[50:70] = kept[300:330] = False
    gapped = replace(
        log,
        t=log.t[kept] + 1000.0,
        channels={n: v[kept] for n, v in log.channels.items()},
        closed_loop=log.closed_loop[kept],
    )
    segments = as_segments([gapped, trial.validation])
    ready = prepare(segments, as_segments(gapped), None, "thesis", ["parameter_change"])
    case, last = ready.case, float(trial.validation.t[-1])
    assert [len(x) for x in case.logs] == [230, 270, len(trial.validation)]
    problem = case.problem("euler")
    assert [run.time[0] for run in problem.runs] == [70.0, 330.0, 0.0]
    assert [run.duration for run in problem.runs] == [599.0, 599.0, last]
    assert [run.time[0] for run in case.held_out("euler").problem.runs] == [70.0, 330.0]
    moment = ready.hypotheses[0].parameters[1]
    assert moment.high == 0.95 * min(599.0, last)
    # parts of segments, held out in turn, and cases made of this one keep that clock
    alone = prepare(as_segments(gapped), [], None, "thesis", ["parameter_change"]).case
    for case in (alone, alone.wider(["X_uuu"], "coloured"), alone.acting(log.vessel)):
        held = [run for _, part in case.held_out("euler").parts for run in part.runs]
        assert [run.time[0] for run in held if run.log.t[0] >= 1330] == [330.0, 420.0, 510.0]
        assert {run.duration for run in held} == {599.0}


def test_two_logs_of_one_name_are_not_one_log() -> None:
    trial = draw(np.random.default_rng([31, 5]), (), samples=200, positions=False)
    one = replace(trial.estimation, name="log")
    two = replace(trial.validation, name="log", t=trial.validation.t + 500.0)
    assert [first for first, _ in clocks_of([one, two])] == [0.0, 500.0]


@pytest.fixture(scope="module")
def modelled():
    """Return a trial, and the model of (3.51) that its estimation log asks for."""
    trial = draw(np.random.default_rng([3, 11]), (), samples=400, positions=False)
    ready = prepare([trial.estimation], [trial.validation], None, "thesis", ["current"])
    theta = ready.base().point.base.theta[: len(ready.structure.parameters)]
    spread = np.zeros((len(theta), len(theta)))
    model = ManoeuvringModel(ready.structure, theta, spread, 1.0, trial.estimation.vessel)
    return trial, model


def test_a_model_whose_coefficients_change_is_judged_with_its_changes(modelled) -> None:
    trial, model = modelled
    changes = (Change("Nr", 0.8, 250.0), Change("Nr", 1.5, 100.0), Change("Xu", 1.2, 120.0))
    model = replace(model, changes=changes)
    ready = prepare([trial.estimation], [trial.validation], model, "thesis", ["current"])
    given = ready.as_given()
    (run,) = ready.case.problem(given.integrator).runs
    for k in (0, 110, 200, 399):
        expected = model.theta * factors_at(changes, model.names, float(k))
        assert run.parameters(given.point.ship)[k, : len(expected)] == pytest.approx(expected)
    base = ready.base()
    assert base.point.base.changes == given.point.ship.changes
    problem = ready.case.problem(base.integrator)
    told = extended_model(ready.structure, problem, base, ready.case.logs, {}, {}).changes
    assert [c.factor for c in told] == pytest.approx([1.5, 1.2, 0.8])


def test_a_coefficient_that_comes_back_from_zero_is_refused(modelled) -> None:
    trial, model = modelled
    model = replace(model, changes=(Change("Nr", 0.0, 100.0), Change("Nr", 1.0, 200.0)))
    ready = prepare([trial.estimation], [], model, "thesis", ["current"])
    with pytest.raises(UsageError, match="Nr of the model is zero and changes again at 200 s"):
        ready.as_given()


def test_logs_are_taken_at_the_sample_time_of_the_model(modelled, monkeypatch) -> None:
    trial, model = modelled
    given = []

    def stop(logs, validate, *_):
        given.extend([*logs, *validate])
        raise LogError("enough is known")

    monkeypatch.setattr("greybox.diagnosis.diagnose.prepare", stop)
    slow = replace(model, sample_time=2.0)
    with pytest.raises(LogError, match="enough is known"):
        diagnose([trial.estimation], validate=[trial.validation], model=slow)
    assert [log.sample_time for log in given] == [2.0, 2.0]
    fast = replace(model, sample_time=0.5)
    with pytest.raises(
        LogError, match=r"the model's sample time is 0.5 s and 'estimation' has 1 s"
    ):
        diagnose([trial.estimation], validate=[trial.validation], model=fast)


def test_what_was_not_measured_does_not_count() -> None:
    trial = draw(np.random.default_rng([77, 1]), (), samples=600, positions=False)
    log = trial.estimation
    kept = np.arange(len(log)) % 30 < 12
    lines = {n: np.interp(log.t, log.t[kept], log[n][kept]) for n in ("u", "v")}
    sparse = replace(
        log, channels={**log.channels, **lines}, missing=dict.fromkeys(("u", "v"), ~kept)
    )
    ready = prepare([sparse], [], None, "thesis", ["side_force"])
    fit = ready.base()
    problem = ready.case.problem(fit.integrator)
    assert problem.counts.tolist() == [240, 240, 600, 600]
    sensor = [float(g.sensor[0]) for g in fit.noise.groups]
    # straight lines have no noise: with them it would be 0.009
    assert sensor == pytest.approx([0.01414] * 3, rel=0.15)
    assert not np.concatenate(fit.nu)[~kept, :2].any()
    added = np.concatenate(problem.contributions(fit))
    assert added.sum() == pytest.approx(fit.cost)
    assert problem.costs(fit).sum() == pytest.approx(fit.cost)
    # residuals, symptoms and shares of the error are of measured samples alone
    squares = (fit.errors[0][kept, 0] ** 2).sum()
    assert problem.squares(fit.errors)[0] == pytest.approx(squares)
    told = [s.sentence for s in find_symptoms(problem, fit)]
    assert not any("times what its sensor's noise explains" in sentence for sentence in told)


def test_a_movement_goes_on_as_long_as_a_command_goes_the_same_way() -> None:
    # up by 2 in two samples, and back by 1
    ramp = np.array([0.0, 0.0, 1.0, 2.0, 2.0, 1.0])
    assert _movement([ramp]) == pytest.approx((2**3 + 1**3) / (2**2 + 1**2))
    assert _movement([ramp, ramp[:2]]) == _movement([ramp])
    assert _movement([np.ones(5)]) == 0.0
