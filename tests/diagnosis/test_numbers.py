"""Bounds, counts and proofs: the numbers that a ruling stands on."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from designs import thesis_model
from virtual import virtual_log

from greybox.diagnosis.builder import kept_without_name
from greybox.diagnosis.causes import known_causes
from greybox.diagnosis.diagnose import DiagnosisOptions, diagnose
from greybox.diagnosis.evidence.held_out import proof_of
from greybox.diagnosis.hypothesis import Hypothesis, Parameter
from greybox.diagnosis.preparing import context_of, prepare
from greybox.diagnosis.result import Found, Quantity, _gain_lines
from greybox.diagnosis.search import Candidate, _beside_others, _of_the_ship, freed, search
from greybox.model.terms import mirror_sign, parse_term
from greybox.study.blind import draw
from greybox.trial.segments import join_segments, split_segments
from greybox.validation.fit import average_fit, run_model
from greybox.validation.gain import Gain, gains


@pytest.fixture(scope="module")
def ready():
    trial = draw(np.random.default_rng([3, 4]), samples=400)
    return prepare([trial.estimation], [trial.validation], None, "thesis", ["current"])


def test_coefficients_and_currents_of_a_cause_have_its_bounds(ready) -> None:
    problem = ready.case.problem("rk4")
    base = ready.base()
    (hypothesis,) = ready.hypotheses
    point = problem.add(base.point, hypothesis)
    low, high = problem.bounds(point)
    where = problem.numbers_of(point, hypothesis)[: len(hypothesis.parameters)]
    np.testing.assert_array_equal(low[where], [p.low for p in hypothesis.parameters])
    np.testing.assert_array_equal(high[where], [p.high for p in hypothesis.parameters])
    # all else is free, but that no damping exceeds what a step can take
    others = np.setdiff1d(np.arange(len(low)), where)
    terms = problem.structure.terms
    damping = [k for k, i in enumerate(point.places) if i < len(terms) and terms[i].dissipates]
    assert np.isinf(low[np.setdiff1d(others, damping)]).all()
    assert np.isinf(high[others]).all()


def test_a_fit_stays_within_the_bounds_of_a_coefficient(ready) -> None:
    base = ready.base()
    problem = ready.case.problem(base.integrator)
    name = "Xu"
    value = base.point.base.theta[problem.place(name)]
    # a bound that the logs would like to leave
    bounded = Parameter(name, "1", 0.0, low=value / 2, high=0.0)
    hypothesis = Hypothesis("cubic_damping", "cubic_damping:Xu", (bounded,), columns=(name,))
    found = problem.fit(problem.add(base.point, hypothesis), base.noise)
    assert found.point.base.theta[problem.place(name)] == pytest.approx(value / 2)


def test_what_comes_beside_a_cause_counts_as_freed(ready) -> None:
    base = ready.base()
    problem = ready.case.problem(base.integrator)
    (hypothesis,) = ready.hypotheses
    with_it = replace(base, point=problem.add(base.point, hypothesis))
    # the wind terms in still air, and the water's velocity that turns in body axes
    assert len(hypothesis.co_freed) == 3 + 2
    assert freed(base, with_it, hypothesis) == 2 + 5
    # what was free already costs nothing
    again = replace(hypothesis, co_freed=(*hypothesis.co_freed, "Xu"))
    assert freed(base, replace(base, point=problem.add(base.point, again)), again) == 2 + 5


def test_what_moves_the_ship_may_stay_without_a_name(ready) -> None:
    base = ready.base()
    (hypothesis,) = ready.hypotheses
    point = ready.case.problem(base.integrator).add(base.point, hypothesis)
    found = Candidate(hypothesis, base, 0.0, 0.0, 0.0, None)  # type: ignore[arg-type]
    assert _of_the_ship(ready.case, replace(base, point=point), found)


def test_a_run_that_leaves_every_bound_is_said_in_words() -> None:
    proof = proof_of(np.array([np.inf, np.inf]))
    assert proof.gain == np.inf
    assert proof.p_value == 0.0
    found = Found(
        "current", "current", "current", {"current_north": Quantity(0.2, 0.1, "m/s")}, 1e-9, 1e-8,
        "e", "x", "r", 12.0, proof.gain, proof.std,
    )  # fmt: skip
    told = found.to_dict()["held_out_gain"]
    assert told["value"] is None
    assert told["std"] is None
    assert told["sentence"] == "the held-out free run leaves every bound without it"
    json.dumps(told, allow_nan=False)
    worse = proof_of(np.array([-np.inf, 1.0]))
    assert worse.gain == -np.inf
    assert worse.p_value == 1.0


def test_damping_brakes_and_cross_terms_have_no_sign(ready) -> None:
    causes = known_causes()
    context = context_of(ready.structure, ready)
    most = {
        p.name: p.high
        for name in ("cubic_damping", "quadratic_yaw_damping", "crossflow", "inertia_coupling")
        for h in causes[name].hypotheses(context)
        for p in h.parameters
    }
    braking = {"X_uuu", "Y_vvv", "N_rrr", "N_|r|r", "Y_|r|v"}
    assert {n for n, high in most.items() if high == 0} == braking
    assert {"Y_|r|r", "N_|r|v", "Y_r", "N_v"} <= {n for n, h in most.items() if h > 0}
    # so does the air
    (wind,) = causes["wind"].hypotheses(replace(context, has_wind=True))
    assert {p.name: p.high for p in wind.parameters} == {"Wuu": 0.0, "Wvv": 0.0, "Wuv": np.inf}


def test_a_cubic_force_that_drives_is_not_called_damping(ready) -> None:
    base = ready.base()
    problem = ready.case.wider(["X_uuu"], "coloured").problem(base.integrator)
    found = known_causes()["cubic_damping"].hypotheses(context_of(ready.structure, ready))
    hypothesis = next(h for h in found if h.columns == ("X_uuu",))
    carried = ready.case.wider(["X_uuu"], "coloured").carried(base)
    k = problem.place("X_uuu")
    # what these logs would show of a ship that a cubic force drives
    driving = replace(carried.point, base=carried.point.base.with_value(k, 0.004))
    for run, start in zip(problem.runs, driving.starts, strict=True):
        run.y = run.run(driving.ship, start).y
    found = problem.fit(problem.add(carried.point, hypothesis), base.noise)
    assert found.point.base.theta[k] <= 0.0


@pytest.mark.parametrize(
    ("name", "even"),
    [("Y_0", True), ("Y_taux", True), ("N_|u|u", True), ("N_|taun|", True), ("Y_|r|v", False),
     ("Nmu", False), ("N_u*taun", False), ("Nuv", False)],
)  # fmt: skip
def test_what_stays_when_port_and_starboard_change_places(name: str, even: bool) -> None:
    assert parse_term(name).even is even


def test_signals_and_terms_have_one_mirror() -> None:
    for signal in ("u", "v", "r", "uq", "vq", "uc", "vc", "taux", "tauy", "taun",
                   "race_drag", "rudder_drag", "race", "rudder"):  # fmt: skip
        assert (mirror_sign(signal) == 1) == parse_term(f"X_{signal}").even


def test_the_gain_is_the_fit_of_whole_logs_whatever_their_gaps() -> None:
    log = virtual_log(5, 400)
    model = thesis_model()
    gap = join_segments([log.window(0, 150, "log"), log.window(190, 400, "log")], "log")
    worse = replace(model, theta=1.2 * model.theta)
    before, after = ([run_model(m, p) for p in split_segments(gap)] for m in (worse, model))
    found = gains(before, after, 1.0, 0)
    for runs, told in ((before, "before"), (after, "after")):
        whole = average_fit(runs)
        for state, gain in found.items():
            assert getattr(gain, told) == pytest.approx(whole[state], abs=1e-9)


def test_a_sensor_that_is_read_otherwise_gains_nothing_by_a_larger_motion() -> None:
    log, model = virtual_log(5, 400), thesis_model()
    before = run_model(model, log)
    # the same error of a channel that now moves twice as much
    sway = model.structure.states.index("v")
    moved = before.x.copy()
    moved[:, sway] += log["v"]
    other = replace(log, channels={**log.channels, "v": 2 * log["v"]})
    after = replace(before, log=other, x=moved)
    found = gains([before], [after], 1.0, 0)["v"]
    assert found.after == pytest.approx(found.before, abs=1e-9)
    assert found.ci == pytest.approx((0.0, 0.0), abs=1e-9)


def test_what_the_log_shows_by_itself_has_no_gain() -> None:
    found = Found("waves", "waves", "waves", {}, 1e-9, 1e-8, "e", "x", "r")
    told = found.to_dict()
    assert told["likelihood_gain"] is None
    assert told["held_out_gain"]["value"] is None
    assert found.proved == "the log itself shows it, without a free run"
    json.dumps(told, allow_nan=False)


@pytest.mark.long
def test_all_causes_count_as_tried_though_only_some_are_left() -> None:
    trial = draw(np.random.default_rng([31, 0]), ("quadratic_yaw_damping", "current"), samples=600)
    ready = prepare(
        [trial.estimation], [trial.validation], None, "thesis", ["current", "side_force"]
    )
    found = search(ready.case, ready.base(), ready.hypotheses, alone=False)
    assert found.causes
    assert found.tried == len(ready.hypotheses)


@pytest.mark.long
def test_a_current_beside_a_biased_compass_is_told_by_true_north() -> None:
    effects = ("current", "heading_bias")
    trial = draw(np.random.default_rng([55, 1]), effects, samples=900, positions=False)
    options = DiagnosisOptions(causes=list(effects), own_pace=False)
    found = diagnose([trial.estimation], validate=[trial.validation], options=options)
    truth = {name: v for effect in trial.truth for name, v in effect.parameters.items()}
    told = {name: q for cause in found.causes for name, q in cause.parameters.items()}
    for name in ("heading_bias", "current_north", "current_east"):
        assert abs(told[name].value - float(truth[name])) < 4 * told[name].std
    for name, (value, _) in found.model.disturbances.items():
        assert value == pytest.approx(told[name].value)


def test_a_run_that_many_causes_hold_within_bounds_is_no_proof_of_one() -> None:
    def held(cause: str, gain: float) -> Candidate:
        hypothesis = Hypothesis(cause, cause, (), ())
        return Candidate(hypothesis, None, 1.0, 0.0, 0.0, proof_of(np.full(3, gain)))

    many = [held("a", np.inf), held("b", np.inf), held("c", np.inf), held("d", -np.inf)]
    assert [c.proof.p_value for c in _beside_others(many)] == [2 / 3, 2 / 3, 2 / 3, 1.0]
    alone = [held("a", np.inf), held("b", -np.inf)]
    assert _beside_others(alone)[0].proof.p_value == 0.0


def test_delay_and_lag_that_hold_a_run_within_bounds_are_one_kind_of_cause() -> None:
    def held(cause: str, gain: float, past: bool) -> Candidate:
        hypothesis = Hypothesis(cause, cause, (), (), past=past)
        return Candidate(hypothesis, None, 1.0, 0.0, 0.0, proof_of(np.full(3, gain)))

    late = [held("input_delay", np.inf, True), held("thruster_lag", np.inf, True)]
    found = _beside_others([*late, held("clock_offset", -np.inf, False)])
    assert [c.proof.p_value for c in found] == [0.0, 0.0, 1.0]


def test_a_run_that_has_left_the_measurements_is_told_as_such() -> None:
    told = _gain_lines(
        {"u": Gain(-6775.0, 61.7, (1.0, 2.0)), "v": Gain(10.0, 20.0, (5.0, 15.0))}, ""
    )
    assert told[1].split() == ["u", "diverged", "->", "61.7"]
    assert told[2].split() == ["v", "10.0", "->", "20.0", "(gain", "5.0", "to", "15.0)"]


def test_what_stays_in_force_without_standing_is_named_in_a_note() -> None:
    def candidate(key: str) -> Candidate:
        hypothesis = Hypothesis(key.split(":")[0], key, (), (), place=key.partition(":")[2])
        return Candidate(hypothesis, None, 1.0, 0.0, 0.0, proof_of(np.ones(3)))

    current, lag, gone = (candidate(k) for k in ("current", "thruster_lag:delta", "lever_arm"))
    point = SimpleNamespace(hypotheses=(current.hypothesis, lag.hypothesis))
    found = SimpleNamespace(
        causes=(current,), leaning=(lag, gone), final=SimpleNamespace(point=point)
    )
    assert kept_without_name(found) == ["thruster_lag:delta"]
