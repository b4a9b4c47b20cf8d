"""Plans that tell open causes apart: what their power is, and what a diagnosis makes of them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from designs import PROCESS, limited_ship, make_request, ship_file, thesis_model
from scipy.stats import chi2, ncx2, norm

from experiment_design.constraints.limits import TrialLimits
from experiment_design.criteria.cause_power import WANTED, CausePower
from experiment_design.for_causes import (
    AskedCauses,
    _sizes,
    causes_left_open,
    design_for_causes,
    open_causes,
    without_open_causes,
)
from experiment_design.request.request import build_problem
from greybox.commands.main import main
from greybox.diagnosis.diagnose import DiagnosisOptions, diagnose
from greybox.diagnosis.thresholds import PROVEN, SIGNIFICANT
from greybox.errors import UsageError
from greybox.model.model import ManoeuvringModel
from greybox.model.run.simulation import simulate
from greybox.rotation import ned_to_body
from greybox.trial.log import make_log

SHIP = replace(
    limited_ship(angles=(-1.1, 1.1)),
    sensors={"u_std": 0.0141, "v_std": 0.0141, "r_std": 0.0141, "heading_std": 0.01},
)
BIAS = {"heading_bias": {"value": 0.006, "std": 0.003, "unit": "rad"}}
CURRENT = {
    "current_north": {"value": 0.009, "std": 0.004, "unit": "m/s"},
    "current_east": {"value": 0.0, "std": 0.004, "unit": "m/s"},
}


@pytest.fixture(scope="module")
def model() -> ManoeuvringModel:
    return replace(thesis_model(), vessel=SHIP)


def request_of(**changes):
    limits = TrialLimits(margins={"u": 0.2})
    return make_request(
        **{
            "vessel": SHIP,
            "regimes": ((("u", 1),),),
            "limits": limits,
            "duration": 120.0,
            **changes,
        }
    )


def power_of(request, model, estimates, tried=2):
    causes, *_ = open_causes(request, model, AskedCauses(estimates, tried, named=True))
    problem = build_problem(request)
    rollout = problem.scenarios[0].rollout
    levels = problem.levels(np.random.default_rng(3).random((1, *problem.shape)))
    motion = rollout.run(problem.schedule.expand(levels))
    power = CausePower(rollout, causes, request.noise, SIGNIFICANT, tried)
    return power.with_typical_sizes(motion), motion


def test_the_noncentrality_is_what_nothing_else_can_imitate(model) -> None:
    request = request_of()
    power, motion = power_of(request, model, {"heading_bias": BIAS, "current": CURRENT})
    report = power.report(motion)
    x, psi, tau = motion.state[0, :-1, :3], motion.state[0, :-1, 3], motion.tau[0]

    def shown(theta=request.theta, current=(0.0, 0.0), bias=0.0, start=x[0], turn=0.0):
        d = np.tile([*current, 0.0, 0.0], (len(tau), 1))
        run = simulate(request.structure, theta, start, tau, 1.0, psi=np.append(psi, psi[-1]), d=d)
        u, v, r = run.x[0, :-1].T
        u, v = ned_to_body(u, v, bias)
        return np.column_stack([u, v, r, turn + np.append(0.0, np.cumsum(r)[:-1])])

    plain = shown()
    step = 1e-6
    others = [shown(theta=request.theta + step * e) - plain for e in np.eye(len(request.theta))]
    others += [shown(start=x[0] + step * e) - plain for e in np.eye(3)]
    others += [shown(turn=step) - plain]
    currents = [shown(current=(step, 0.0)) - plain, shown(current=(0.0, step)) - plain]
    biased = shown(bias=0.006) - plain

    def left(wanted, known):
        found = []
        for noise in power._noises(motion):
            white = [noise.whiten(c[:, :, None]).ravel() for c in (wanted, *known)]
            rows = np.array(white[1:]).T
            rows = rows / np.linalg.norm(rows, axis=0)
            rest = white[0] - rows @ np.linalg.lstsq(rows, white[0], rcond=1e-8)[0]
            found.append(float(rest @ rest))
        return min(found)

    known = [o for o in others if o.any()]
    assert report.noncentrality[0] == pytest.approx(left(biased, [*known, *currents]), rel=0.01)
    # an estimate of zero east is no part of the bias, and has no size of its own
    north = shown(current=(0.009, 0.0)) - plain
    # the other component is not taken out: both are the cause's own
    assert report.noncentrality[1] == pytest.approx(left(north, [*known, biased]), rel=0.01)
    # the harder of both tests counts
    size, level = report.noncentrality[0], SIGNIFICANT / 2
    both = ncx2.sf(chi2.isf(level, 1), 1, size), norm.sf(norm.isf(PROVEN) - np.sqrt(size) / 2)
    assert report.power[0] == pytest.approx(min(both))
    assert report.pairs[0, 1] <= report.power.max() + 1e-12


def test_a_share_of_the_size_is_found_with_the_wanted_power(model) -> None:
    request = request_of()
    power, motion = power_of(request, model, {"heading_bias": BIAS, "current": CURRENT})
    share = power.report(motion).detectable_share[0]
    small = {"heading_bias": {"heading_bias": {"value": 0.006 * share}}, "current": CURRENT}
    other, _ = power_of(request, model, small)
    assert other.report(motion).power[0] == pytest.approx(WANTED, abs=1e-3)


def test_what_cannot_be_told_apart_has_the_power_of_chance(model) -> None:
    # two names of one thing: a lag of the forces, and one of all commands of a linear vessel
    ship = replace(
        SHIP,
        thrusters=tuple(replace(t, angle=0.5 if t.x > 0 else -0.5) for t in SHIP.thrusters),
    )
    request = request_of(vessel=ship)
    power, motion = power_of(
        request, replace(model, vessel=ship), {"thruster_lag:force": {}, "thruster_lag:command": {}}
    )
    assert (power.report(motion).power < 0.01).all()
    assert power.values(motion)[0] < -3


def test_typical_sizes_move_a_run_by_a_twentieth_of_its_spread(model) -> None:
    power, _ = power_of(request_of(), model, {"heading_bias": {}, "input_delay": {}})
    bias, delay = power.causes
    assert not bias.estimated
    assert 1e-3 < bias.size[0] < 0.1
    # no first derivative at the null: where its search begins
    assert delay.size[0] == pytest.approx(1.5)


def test_terms_that_the_model_has_are_the_causes_own(model) -> None:
    wider = model.structure.with_terms("Y_|r|v")
    theta = np.append(model.theta, -0.3)
    own = replace(model, structure=wider, theta=theta, covariance=np.zeros((16, 16)))
    request = replace(request_of(), structure=wider, theta=theta)
    power, motion = power_of(request, own, {"crossflow:Y_|r|v": {"Y_|r|v": {"value": -0.3}}})
    assert "Y_|r|v" not in power._own
    assert power.report(motion).power[0] > 0.5


def test_what_a_diagnosis_left_open() -> None:
    entry = {"id": "thruster_gain", "place": "thruster_gain:n:alpha1", "parameters": {"gain_n": {}}}
    told = {"verdict": "confused", "tried": 40, "partial": [], "candidates": [entry]}
    asked = causes_left_open(told)
    assert list(asked.estimates) == ["thruster_gain:n:alpha1"]
    assert asked.tried == 40
    with pytest.raises(UsageError, match=r"leaves no cause open \(its verdict is named\)"):
        causes_left_open(told | {"verdict": "named", "candidates": []})
    broken = (
        [], told | {"candidates": ["current"]}, told | {"candidates": [{"id": "current"}]},
        told | {"partial": None}, told | {"tried": "many"}, told | {"verdict": 3},
    )  # fmt: skip
    for data in broken:
        with pytest.raises(UsageError, match=r"'m\.json' is no diagnosis"):
            causes_left_open(data, "m.json")


def test_causes_that_cannot_be_at_work_are_named(model) -> None:
    request = request_of()
    with pytest.raises(UsageError, match="may be at work in 2 places: name one of thruster_gain:n"):
        open_causes(request, model, AskedCauses({"thruster_gain": {}}, named=True))
    with pytest.raises(UsageError, match=r"'curent' is no cause .* current"):
        open_causes(request, model, AskedCauses({"curent": {}}, named=True))
    # what a diagnosis found in the sensors alone is left out, and said
    causes, tried, notes = open_causes(request, model, AskedCauses({"waves": {}, "current": {}}))
    assert [c.id for c in causes] == ["current"]
    assert tried > 40
    told = "'waves' is no cause that a trial of this ship with this model could show."
    assert notes[0] == f"waves is left out: {told}"
    two = request_of(regimes=((("u", 1),),) * 2, starts=request.starts * 2)
    with pytest.raises(UsageError, match="--for causes designs one trial at a time"):
        design_for_causes(two, model, AskedCauses({"current": {}}))


def test_an_open_cause_that_the_model_holds_is_taken_out_of_it(model) -> None:
    # as a confused diagnosis writes the model: with the first cause, sizes as from none
    late = replace(SHIP.actuation, lag=6.0, lag_on="speed", rate_limit=0.2, rate_on="n")
    strong = tuple(replace(t, gain=0.8) for t in SHIP.thrusters)
    acting = replace(SHIP, actuation=late, thrusters=strong)
    here = {"current_north": (0.3, 0.01), "current_east": (0.1, 0.01)}
    held = ["thruster_lag:speed", "current", "thruster_gain:n:alpha1", "rate_limit:n"]
    holding = replace(model, vessel=acting, disturbances=here, record={"causes": held})
    estimates = {"thruster_lag:speed": {"lag": {"value": 6.0}}, "current": CURRENT}
    left, notes = without_open_causes(holding, AskedCauses(estimates), SHIP)
    assert left.vessel.actuation == SHIP.actuation
    assert not left.d[:2].any()
    assert left.vessel.thrusters[0].gain == 0.8
    said = "the model holds thruster_lag:speed, current, which is open: the trial is planned"
    assert notes[0].startswith(said)
    causes, *_ = open_causes(request_of(), left, AskedCauses(estimates))
    assert [c.size[0] for c in causes] == [6.0, 0.009]
    again, notes = without_open_causes(holding, AskedCauses({"thruster_gain": {}}), SHIP)
    assert again.vessel.thrusters == SHIP.thrusters
    assert again.vessel.actuation == late
    assert without_open_causes(model, AskedCauses(estimates), SHIP) == (model, ())


def test_a_rate_is_told_in_its_unit_and_searched_as_a_time(model) -> None:
    entry = {"rate_limit:n": {"rate_n": {"value": 0.2}}}
    (cause,), *_ = open_causes(request_of(), model, AskedCauses(entry, named=True))
    way = cause.hypothesis.parameters[0].over
    assert cause.size[0] == pytest.approx(way / 0.2)
    assert _sizes(cause) == "rate_n 0.2 n/s (as estimated)"


@pytest.fixture(scope="module")
def found(model):
    request = request_of(effort=0.6)
    return design_for_causes(
        request, model, AskedCauses({"heading_bias": BIAS, "current": CURRENT})
    )


def test_a_plan_tells_more_than_random_and_usual_trials(found) -> None:
    worst = found.plan.detectable_share.max()
    assert worst < found.random.detectable_share.max() < found.usual.detectable_share.max()
    told = found.to_dict()
    # shares go with the square root of the noncentrality
    ratio = found.random.detectable_share.max() / worst
    assert told["efficiency_vs_random"] == pytest.approx(ratio**2)
    assert told["efficiency_lower_bound"] is None
    assert told["certificate"]["reason"].startswith("no bound is known on the power")
    assert "noncentrality" in told["efficiency_of"]
    json.dumps(told["causes"], allow_nan=False)
    assert told["for"] == "causes"
    first = told["causes"][0]
    assert first["id"] == "heading_bias"
    assert first["parameters"]["heading_bias"]["away_from_null"] == pytest.approx(0.006)
    assert 0 < first["power_random"] <= 1
    (pair,) = told["pairs"]
    assert pair["ids"] == ["current", "heading_bias"]
    assert f"{worst:.2g} times as large" in found.headline()
    assert "heading_bias 0.006 rad (as estimated)" in found.summary()
    assert found.design.motions[0].state[0, :, 0].min() > 0.2 - 1e-3


def test_the_command(tmp_path, model, capsys) -> None:
    ship, prior, plan = tmp_path / "ship.toml", tmp_path / "model.json", tmp_path / "plan.csv"
    ship.write_text(ship_file(-1.1, "heading_std = 0.01"))
    model.save(prior)
    given = ["design", "--vessel", str(ship), "--model", str(prior), "--out", str(plan)]
    given += ["--duration", "120", "--effort", "0.1"]

    def said(*more):
        assert main([*given, *more]) in (1, 2)
        return capsys.readouterr().err

    assert "give --diagnosis D" in said("--for", "causes")
    assert "leave out --want" in said("--for", "causes", "--causes", "current", "--want", "Yv")
    assert "give one of them" in said("--causes", "current", "--diagnosis", "d.json")
    assert "use --for causes" in said("--for", "prediction", "--causes", "current")
    assert "cannot read the diagnosis" in said("--diagnosis", str(tmp_path / "d.json"))
    assert not plan.exists()
    entries = [
        {"id": "heading_bias", "place": "heading_bias", "parameters": BIAS},
        {"id": "current", "place": "current", "parameters": CURRENT},
    ]
    told = {"verdict": "confused", "tried": 40, "partial": [], "candidates": entries}
    # the extended model of a diagnosis tells it by itself
    replace(model, record={"diagnosis": told}).save(prior)
    out = tmp_path / "plan.json"
    assert main([*given, "--for", "causes", "--json", str(out)]) == 0
    assert "heading_bias" in capsys.readouterr().out
    data = json.loads(out.read_text())
    assert [c["id"] for c in data["causes"]] == ["heading_bias", "current"]
    assert data["level"] == pytest.approx(SIGNIFICANT / 40)
    assert len(plan.read_text().splitlines()) == 121


def sailed(model, start, commands, truth, seed):
    """One virtual trial in which either the compass is off or a current sets north."""
    rng = np.random.default_rng([5, seed])
    columns = dict(zip(SHIP.commands, commands.T, strict=True))
    tau = make_log(SHIP, columns, 1.0).forces(model.structure.inputs)
    d = np.array([[0.009 if truth == "current" else 0.0, 0.0, 0.0, 0.0]])
    x, psi = np.zeros((len(tau), 3)), np.zeros(len(tau))
    x[0], psi[0] = start[:3], start[3]
    pushed = PROCESS * rng.standard_normal(x.shape)
    for k in range(len(tau) - 1):
        run = simulate(model.structure, model.theta, x[k], tau[k : k + 1], 1.0, d=d, psi0=psi[k])
        x[k + 1], psi[k + 1] = run.x[0, 1] + pushed[k], run.psi[0, 1]
    u, v = ned_to_body(x[:, 0], x[:, 1], 0.006 if truth == "heading_bias" else 0.0)
    seen = np.column_stack([u, v, x[:, 2], psi])
    seen += rng.standard_normal(seen.shape) * [0.0141, 0.0141, 0.0141, 0.01]
    return make_log(SHIP, columns | dict(zip(("u", "v", "r", "psi"), seen.T, strict=True)), 1.0)


@pytest.mark.long
def test_a_diagnosis_names_the_right_cause_as_often_as_after_the_best_random_steps(model) -> None:
    from experiment_design.for_prediction import operating_envelope
    from experiment_design.optimise.envelope_search import exchange_settings

    both = ("current", "heading_bias")
    request = request_of(duration=300.0)
    plan = design_for_causes(
        request, model, AskedCauses({"current": CURRENT, "heading_bias": BIAS}, 2)
    )
    start = plan.design.request.starts[0]
    problem = build_problem(plan.design.request)
    power = CausePower(problem.scenarios[0].rollout, plan.causes, request.noise, SIGNIFICANT, 2)
    envelope, _ = operating_envelope(request, model, {})
    begun = exchange_settings(problem, envelope, power.values, 0, effort=0.01, tries=1).reference
    random = problem.commands(begun.unit)
    right = [
        sum(
            [c.id for c in diagnose(
                [sailed(model, start, commands, truth, seed)], model=model,
                options=DiagnosisOptions(causes=both, own_pace=False),
            ).causes] == [truth]
            for truth in both for seed in range(8)
        )
        for commands in (plan.design.commands[0], random)
    ]  # fmt: skip
    # the difference of two counts of 16 has a standard error of at most 2.8
    assert right[0] >= right[1] - 3
    assert right[0] >= 6
