"""Designs: what they gain, what they keep, and what is said when they cannot be."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from designs import limited_ship, make_request, thesis_model

from experiment_design import (
    Circle,
    DesignRequest,
    TrialLimits,
    design_trial,
    least_duration,
    predict_precision,
    prepare_request,
)
from experiment_design.design import CLOSEST
from experiment_design.excitation.inputs import multisines, prbs, random_two_level, zig_zags
from experiment_design.feasibility.checks import missed_targets
from experiment_design.optimise.campaign import Found, std_of
from experiment_design.optimise.search import assess, best_random, exchange, to_unit
from experiment_design.output.report import saving
from experiment_design.request.expressions import gradient_of
from experiment_design.request.regimes import parse_regime, spell_regime
from experiment_design.request.request import build_problem
from greybox.errors import ExcitationError, InfeasibleError, StructureError, UsageError
from greybox.files import plain
from greybox.model.catalogue import get_structure
from greybox.model.model import ManoeuvringModel


def replay(request, commands, theta=None, start=None):
    """The ship of (3.51) stepped by hand, without the package's simulation: (N+1, 6)."""
    p = dict(zip(request.structure.parameters, request.theta if theta is None else theta,
                 strict=True))  # fmt: skip
    u, v, r, psi = request.starts[0] if start is None else start
    north = east = 0.0
    rows = [(u, v, r, psi, north, east)]
    for n, a1, a2 in commands:
        tx = n * (np.cos(a1) + np.cos(a2))
        ty = n * (np.sin(a1) + np.sin(a2))
        tn = n * 9.0 * (np.sin(a1) - np.sin(a2))
        du = p["Xu"] * u + p["Xvr"] * v * r + (p["Xuu"] + p["Wuu"]) * abs(u) * u
        du += p["Xmu"] * tx + p["Xkappa"] * u * tx
        dv = p["Yv"] * v + p["Yur"] * u * r + (p["Yvv"] + p["Wvv"]) * abs(v) * v
        dv += p["Yvr"] * abs(v) * r + p["Ymu"] * ty
        dr = p["Nr"] * r + (p["Nuv"] + p["Wuv"]) * u * v + p["Nvv"] * abs(v) * v
        dr += p["Nvr"] * abs(v) * r + p["Nmu"] * tn
        north += np.cos(psi) * u - np.sin(psi) * v
        east += np.sin(psi) * u + np.cos(psi) * v
        u, v, r, psi = u + du, v + dv, r + dr, psi + r
        rows.append((u, v, r, psi, north, east))
    return np.array(rows)


@pytest.fixture(scope="module")
def basic():
    """15 parameters in 300 s, after a shorter search than usual."""
    return design_trial(make_request(duration=300.0, effort=0.3), workers=1)


def test_a_design_beats_the_best_of_200_random_sequences(basic):
    assert basic.efficiency_vs_random >= 1.3
    assert basic.random_kept == 200
    assert basic.status.startswith("solved")
    assert basic.seconds < 120
    problem = build_problem(basic.request)
    reference, _ = best_random(problem, basic.request.seed)
    gain = np.exp((basic.logdet - reference.value) / 15)
    assert basic.efficiency_vs_random == pytest.approx(gain)


def test_the_plan_keeps_its_limits_in_another_integrator(basic):
    motion = replay(basic.request, basic.commands[0])
    np.testing.assert_allclose(motion, basic.motions[0].state[0], atol=1e-9)
    assert motion[:, 0].min() >= 0.5 - 1e-3
    assert motion[:, 1].min() >= 0.4 - 1e-3
    commands = basic.commands[0]
    assert (commands.min(axis=0) >= [10.0, 0.6, 0.6]).all()
    assert (commands.max(axis=0) <= [20.0, 1.1, 1.1]).all()
    assert (np.diff(commands, axis=0)[np.arange(299) % 10 != 9] == 0).all()
    assert basic.margins["u"] == pytest.approx(motion[:, 0].min())


def test_a_design_shows_itself(basic):
    text = basic.summary()
    assert f"least distance from zero: u {basic.margins['u']:.3g} m/s, v " in text
    assert "times the information of the best of 200 random two-level sequences" in text
    assert "zig-zag" in text
    assert "<pre>Plan for Thesis ship" in basic._repr_html_()
    data = json.loads(json.dumps(plain(basic.to_dict())))
    for key in ("status", "criterion", "logdet", "efficiency_vs_random", "efficiency_lower_bound",
                "predicted_std", "margins", "wall_s"):  # fmt: skip
        assert key in data
    assert set(data["predicted_std"]) == set(basic.names)
    assert data["margins"]["u"] >= 0.5


def test_what_a_plan_gains_is_told_by_its_own_criterion(basic):
    other = replace(basic, request=replace(basic.request, criterion="A"), random_value=1.0,
                    criterion_value=1.5)  # fmt: skip
    said = f"{np.exp(0.5):.2f} times the information by criterion A of the best of 200"
    assert said in other.summary()
    assert f"({np.exp(0.5):.2f} times the information by criterion A)" in saving(other)
    assert other.to_dict()["efficiency_vs_random"] == basic.efficiency_vs_random


@pytest.mark.long
def test_the_same_seed_gives_the_same_plan():
    request = make_request(duration=120.0, effort=0.1)
    one = design_trial(request, workers=1, alternatives=False)
    two = design_trial(request, workers=2, alternatives=False)
    np.testing.assert_array_equal(one.commands[0], two.commands[0])
    other = design_trial(replace(request, seed=1), workers=1, alternatives=False)
    assert not np.array_equal(one.commands[0], other.commands[0])


@pytest.mark.usefixtures("hasty")
def test_an_interrupt_after_the_search_keeps_the_plan(monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("experiment_design.design.certify", stop)
    design = design_trial(make_request(duration=120.0, effort=0.1), workers=1)
    assert design.status.startswith("stopped by the user")
    assert design.certificate.efficiency_lower_bound is None
    assert "stopped" in design.certificate.sentence()


def test_steady_starts_keep_the_caps():
    limits = TrialLimits(speed_cap=2.2, yaw_cap=0.05)
    request = prepare_request(thesis_model(), DesignRequest(150.0, limits=limits))
    u, v, r, _ = request.starts[0]
    assert np.hypot(u, v) <= 2.2
    assert abs(r) <= 0.05


def test_a_steady_start_names_the_commands_that_hold_it():
    request = prepare_request(thesis_model(), DesignRequest(150.0, regime="u+v+"))
    (held,) = request.start_commands
    assert request.commands_at_start(0) == dict(zip(request.schedule.commands, held, strict=True))
    rollout = build_problem(request).scenarios[0].rollout
    states = rollout.run(np.tile(held, (1, 200, 1))).state[0, :, :3]
    np.testing.assert_allclose(states, np.tile(request.starts[0][:3], (201, 1)), atol=1e-6)
    u, v, r, _ = request.starts[0]
    (note,) = [n for n in request.notes if "steady motion" in n]
    assert f"u {u:.3g} m/s, v {v:.3g} m/s, r {r:.3g} rad/s, psi 0 rad" in note
    assert f"psi 0 rad, held by n {held[0]:.4g}, alpha1 {held[1]:.4g} rad" in note
    given = prepare_request(
        thesis_model(), DesignRequest(150.0, regime="u+v+", start=(1.5, 1.2, 0.0, 0.0))
    )
    assert given.commands_at_start(0) is None


def test_each_trial_tells_its_steady_start():
    asked = DesignRequest(150.0, trials=2, regime="u+v+,u+v-", start=(1.5, 1.2, 0.0, 0.0))
    request = prepare_request(replace(thesis_model(), vessel=limited_ship(angles=(-1, 1))), asked)
    assert [held is None for held in request.start_commands] == [True, False]
    (note,) = [n for n in request.notes if "steady motion" in n]
    assert note.startswith("trial 2 starts from a steady motion: u ")


def test_a_locked_thruster_has_equal_limits():
    request = make_request(
        structure="surge", vessel=limited_ship(angles=(0.8, 0.8)), effort=0.05, duration=150.0
    )
    design = design_trial(request, workers=1, alternatives=False)
    assert (design.commands[0][:, 1:] == 0.8).all()
    assert design.efficiency_vs_random > 0.9


def test_an_interrupt_returns_the_best_so_far():
    def stop(done, total):
        raise KeyboardInterrupt

    request = make_request(duration=120.0, effort=0.1)
    design = design_trial(request, workers=1, alternatives=False, progress=stop)
    assert design.status.startswith("stopped by the user")
    assert design.efficiency_vs_random >= 1.0
    assert len(design.commands[0]) == 120


@pytest.mark.long
def test_augmented_design_and_what_it_saves():
    """41 regressors, 600 s: as told as 3000 s of uniformly drawn pulses."""
    design = design_trial(make_request(duration=600.0, predictor="augmented"))
    assert design.efficiency_vs_random >= 1.4
    longer = make_request(duration=3000.0, predictor="augmented")
    rng = np.random.default_rng(0)
    for _ in range(5):
        pulses = np.repeat(rng.uniform([10, 0.6, 0.6], [20, 1.1, 1.1], (300, 3)), 10, axis=0)
        plan = dict(zip(("n", "alpha1", "alpha2"), pulses.T, strict=True))
        assert design.logdet > predict_precision(longer, [plan]).logdet


@pytest.mark.long
@pytest.mark.parametrize(
    "limits",
    [
        TrialLimits(margins={"u": 1.2, "v": 0.9}, area=Circle(0.0, 0.0, 80.0), clearance=5.0),
        TrialLimits(
            margins={"u": 0.5, "v": 0.4}, speed_cap=2.3, yaw_cap=0.08,
            end={"x_n": (0.0, 15.0), "y_n": (0.0, 15.0)}, energy=0.5, headings=3.0,
        ),
    ],
)  # fmt: skip
def test_limits_are_kept(limits):
    request = make_request(
        duration=240.0, limits=limits, vessel=limited_ship(2.0, 0.03), effort=0.25
    )
    design = design_trial(request, workers=1, alternatives=False)
    motion = replay(request, design.commands[0])
    tolerance = 1e-3
    assert motion[:, 0].min() >= limits.margins["u"] - tolerance
    assert motion[:, 1].min() >= limits.margins["v"] - tolerance
    step = np.abs(np.diff(design.commands[0], axis=0)).max(axis=0)
    assert (step <= np.array([2.0, 0.03, 0.03]) + 1e-9).all()
    if limits.area is not None:
        assert np.hypot(motion[:, 4], motion[:, 5]).max() <= 75.0 + tolerance
    else:
        assert np.hypot(motion[:, 0], motion[:, 1]).max() <= 2.3 + tolerance
        assert np.abs(motion[:, 2]).max() <= 0.08 + tolerance
        assert np.abs(motion[-1, 4:]).max() <= 15.0 + tolerance
        assert (np.abs(design.commands[0][:, 0] / 20) ** 3).mean() <= 0.5 + tolerance
        assert np.ptp(motion[:, 3]) >= 3.0 - tolerance
    assert all(x.missed <= 1e-4 for x in design.limits)


@pytest.mark.long
def test_a_plan_keeps_its_margins_under_the_prior():
    """With the stated probability, judged by other draws and another integrator."""
    model = thesis_model(spread=0.1)
    asked = DesignRequest(
        300.0, TrialLimits(margins={"u": 1.0, "v": 0.8}), start=(1.5, 1.2, 0.0, 0.0),
        predictor="basic",
        effort=0.25, probability=0.9,
    )  # fmt: skip
    request = prepare_request(model, asked)
    design = design_trial(request, workers=1, alternatives=False)
    assert design.keeping.probability >= 0.9
    rng = np.random.default_rng(99)
    kept = 0
    for _ in range(200):
        theta = model.theta * (1 + 0.1 * rng.standard_normal(18))
        motion = replay(request, design.commands[0], theta=theta)
        kept += motion[:, 0].min() >= 1.0 - 1e-3 and motion[:, 1].min() >= 0.8 - 1e-3
    # three standard errors of a share of 200
    assert kept / 200 >= 0.9 - 3 * np.sqrt(0.9 * 0.1 / 200)


def test_robust_designs_look_at_several_models():
    request = make_request(
        covariance=np.diag((0.1 * make_request().theta) ** 2), robust=3, effort=0.05
    )
    expected = build_problem(request)
    worst = build_problem(replace(request, worst_case=True))
    unit = np.random.default_rng(0).random((2, *expected.shape))
    assert (worst.evaluate(unit).value <= expected.evaluate(unit).value).all()
    for problem in (expected, worst):
        _, _, slope, _ = problem.gradient(unit[0])
        ends = []
        for step in (1e-6, -1e-6):
            moved = unit[0].copy()
            moved[2, 1] += step
            ends.append(problem.gradient(moved)[1])
        assert slope[2, 1] == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-3)


def test_exchange_improves_what_it_is_given():
    problem = build_problem(make_request(duration=150.0))
    reference, _ = best_random(problem, 0, 20)
    found = exchange(problem, reference.unit, 2)
    assert found.value > reference.value
    assert found.feasible


@pytest.mark.long
def test_a_campaign_determines_what_one_regime_cannot():
    """v·r and |v|·r are one function where v keeps its sign (Remark 4.1)."""
    structure = get_structure("thesis").with_terms("Y_vr")
    theta = np.append(make_request().theta, 0.02)
    ship = limited_ship(angles=(-1.1, 1.1))
    alone = make_request(structure="thesis", vessel=ship)
    alone = replace(alone, structure=structure, theta=theta)
    merged = alone.build_predictor()
    assert "Yvr+Y_vr" in [c.label for c in merged.columns]
    both = replace(
        alone, regimes=((("u", 1), ("v", 1)), (("u", 1), ("v", -1))),
        starts=(np.array([1.5, 0.8, 0.0, 0.0]), np.array([1.5, -0.8, 0.0, 0.0])),
        limits=TrialLimits(margins={"u": 0.3, "v": 0.2}), duration=120.0, effort=0.03,
    )  # fmt: skip
    design = design_trial(both, workers=1)
    assert len(design.commands) == 2
    assert np.isfinite(design.std).all()
    assert design.motions[0].state[0, :, 1].min() >= 0.2 - 1e-3
    assert design.motions[1].state[0, :, 1].max() <= -0.2 + 1e-3
    assert "Y_vr" in design.names


@pytest.mark.long
def test_earlier_trials_add_their_information():
    request = make_request(duration=150.0, effort=0.05)
    first = design_trial(request, workers=1, alternatives=False)
    information = np.linalg.inv(first.covariance)
    second = design_trial(
        replace(request, known=(first.names, information)), workers=1, alternatives=False
    )
    assert (second.std < first.std).all()
    # the same trial twice halves the variance; a chosen second one does better
    assert second.logdet > first.logdet + 15 * np.log(2)


@pytest.mark.long
def test_least_trial_time():
    request = make_request(duration=600.0, effort=0.1)
    shorter = least_duration(request, {"Yvv": 0.02, "Yur": 0.045}, workers=1)
    assert 60 < shorter.duration < 600
    design = design_trial(shorter, workers=1, alternatives=False)
    # the final design searches longer than the ones that found the duration
    assert (design.std <= np.array([0.02, 0.045]) * 1.03).all()
    with pytest.raises(InfeasibleError, match="600 s do not reach the target"):
        least_duration(request, {"Yvv": 1e-4}, workers=1)
    with pytest.raises(UsageError, match="must be positive"):
        least_duration(request, {"Yvv": 0.0}, workers=1)


@pytest.mark.long
def test_a_target_is_reached_by_what_keeps_the_limits_surely():
    """A target of what keeps them under the nominal prior alone would be missed twofold."""
    uncertain = np.diag((0.2 * np.abs(make_request().theta)) ** 2)
    limits = TrialLimits(margins={"u": 0.5, "v": 0.7})
    request = make_request(duration=120.0, effort=0.02, covariance=uncertain, limits=limits)
    shorter = least_duration(request, {"Yvv": 0.045}, workers=1)
    design = design_trial(shorter, workers=1, alternatives=False)
    assert design.keeping.probability >= 0.9
    assert design.std[0] <= 0.045 * 1.03


@pytest.mark.usefixtures("hasty")
def test_a_target_is_judged_after_the_tightening(monkeypatch):
    uncertain = np.diag((0.2 * np.abs(make_request().theta)) ** 2)
    request = make_request(duration=30.0, effort=0.01, covariance=uncertain)
    problem = build_problem(replace(request, wanted=("Yvv",), criterion="A", targets=(1.0,)))
    drawn = assess(problem, np.random.default_rng(0).random((20, *problem.shape)))
    safe = min(drawn, key=lambda c: c.value)
    monkeypatch.setattr(
        "experiment_design.duration.tightened_campaign",
        lambda request, *_, **__: (request, [safe], None, 0),
    )
    std = std_of([problem], [safe.unit])[0]
    with pytest.raises(InfeasibleError, match=r"Yvv would be 1\.2 times the"):
        least_duration(request, {"Yvv": std / 1.2}, workers=1)
    assert least_duration(request, {"Yvv": 1.01 * std}, workers=1).duration == 30


def test_a_target_that_the_plan_misses_is_told(good):
    request = replace(good.request, wanted=("Yvv",), criterion="A", targets=(0.01,))
    problem = build_problem(request)
    units = [to_unit(problem, good.levels[0])]
    std = std_of([problem], units)[0]
    (note,) = missed_targets(request, [problem], units)
    assert f"the standard error of Yvv is {std:.3g} and 0.01 was wanted" in note
    assert missed_targets(replace(request, targets=(std,)), [problem], units) == []
    assert missed_targets(good.request, [problem], units) == []


@pytest.mark.usefixtures("hasty")
def test_two_names_of_one_column_are_one_target():
    request = make_request(duration=30.0, effort=0.01)
    found = least_duration(request, {"Wuu": 8.0, "Yvv": 9.0, "Xuu": 7.0}, workers=1)
    assert found.wanted == ("Xuu", "Yvv")
    assert found.targets == (7.0, 9.0)
    with pytest.raises(InfeasibleError, match="the standard error of Wuu would be"):
        least_duration(request, {"Xuu": 1.0, "Wuu": 1e-9}, workers=1)


def test_a_target_beside_limits_that_cannot_be_kept(monkeypatch):
    """The design says which limit it is, or gives its closest plan."""

    def out_of_reach(request, problems, *_, **__):
        missed = [assess(p, np.full((1, *p.shape), 0.5))[0] for p in problems]
        return Found(tuple(replace(c, missed=c.missed + 1) for c in missed), 1, False)

    monkeypatch.setattr("experiment_design.duration.search_campaign", out_of_reach)
    found = least_duration(make_request(duration=60.0), {"Yvv": 0.02})
    assert found.duration == 60.0
    assert found.targets == (0.02,)


@pytest.mark.long
def test_the_limit_that_stops_a_target():
    limits = TrialLimits(margins={"u": 0.5, "v": 0.4}, headings=30.0)
    request = make_request(duration=100.0, effort=0.02, limits=limits)
    longest = least_duration(request, {"Yvv": 0.02}, workers=1)
    with pytest.raises(InfeasibleError, match="headings cannot cover 30 rad"):
        design_trial(longest, workers=1, alternatives=False)
    closest = design_trial(longest, workers=1, alternatives=False, best_effort=True)
    assert closest.status.startswith("limits not kept")
    assert any("headings cannot cover 30 rad" in n for n in closest.notes)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"limits": TrialLimits(margins={"v": 1.9})}, "no steady motion keeps the margins"),
        ({"regime": "u-v+"}, "no constant command within the limits of the thrusters holds"),
        (
            # a lead-in is for a single trial
            {"start": (0.2, 1.2, 0, 0), "limits": TrialLimits(margins={"u": 0.5}), "trials": 2},
            "starts 0.3 m/s beyond the margin of surge",
        ),
        ({"duration": 20.0, "predictor": "augmented"}, "a trial of 20 s is too short"),
        (
            {"duration": 30.0, "predictor": "wind", "wind": (5.0, 0.0)},
            "Lengthen the trial|too short",
        ),
        ({"limits": TrialLimits(area=Circle(500.0, 0.0, 50.0))}, "450.0 m outside the sea room"),
        pytest.param(
            {"limits": TrialLimits(area=Circle(0.0, 0.0, 12.0)), "start": (1.5, 1.2, 0, 0)},
            "the sea room is 24 m across; the smallest circle|sea room is too small",
            marks=pytest.mark.long,
        ),
        pytest.param(
            {"limits": TrialLimits(headings=30.0)},
            "headings cannot cover 30 rad",
            marks=pytest.mark.long,
        ),
        pytest.param(
            {"duration": 60.0, "limits": TrialLimits(speed_cap=1.0), "start": (0.7, 0.6, 0, 0)},
            "speed cap",
            marks=pytest.mark.long,
        ),
    ],
)
def test_what_cannot_be_is_said(asked, message):
    asked = {"duration": 150.0, "predictor": "basic", "effort": 0.05} | asked
    with pytest.raises(InfeasibleError, match=message):
        design_trial(prepare_request(thesis_model(), DesignRequest(**asked)), workers=1)


@pytest.mark.long
def test_the_closest_plan_on_request():
    asked = DesignRequest(
        150.0, predictor="basic", effort=0.05, limits=TrialLimits(headings=30.0), regime="u+v+"
    )
    design = design_trial(prepare_request(thesis_model(), asked), best_effort=True)
    assert design.status.startswith("limits not kept")
    assert any("headings cannot cover 30 rad" in n for n in design.notes)


@pytest.mark.usefixtures("hasty")
def test_the_closest_plan_to_margins_out_of_reach():
    """It keeps the margins nearest to them, and is held against those that were asked for."""
    asked = DesignRequest(
        60.0, TrialLimits(margins={"u": 9.0}), predictor="basic", effort=0.02, regime="u+"
    )
    model = thesis_model("surge", 0.05)
    with pytest.raises(InfeasibleError, match="no steady motion keeps the margin u 9 m/s") as told:
        prepare_request(model, asked)
    request = prepare_request(model, asked, best_effort=True)
    design = design_trial(request, workers=1, alternatives=False, best_effort=True)
    assert design.status == CLOSEST
    assert str(told.value) in design.notes
    (report,) = design.limits
    assert report.bound == 9.0
    assert report.missed == pytest.approx(9.0 - design.margins["u"])
    assert design.margins["u"] >= request.limits.margins["u"] - 1e-4
    assert design.keeping.probability == 0.0
    assert request.stand_ins in str(told.value)
    assert request.stand_ins in design.remedy
    assert "the margin of surge of 9 m/s is missed by" in design.summary()


def test_a_margin_out_of_reach_of_a_ship_that_crosses_zero_in_sway():
    asked = DesignRequest(
        60.0, TrialLimits(margins={"u": 9.0}), predictor="basic", effort=0.02, regime="u+"
    )
    with pytest.raises(InfeasibleError, match=r"the margin u 9 m/s: .* keeps u 2\.\d+ m/s\. Use"):
        prepare_request(thesis_model(), asked)


def test_an_unstable_prior():
    model = thesis_model()
    theta = model.theta.copy()
    theta[model.names.index("Xuu")] = 0.5
    theta[model.names.index("Yvv")] = 0.5
    with pytest.raises(InfeasibleError, match="unstable in free run") as told:
        prepare_request(replace(model, theta=theta), DesignRequest(150.0))
    assert "Lowering one of Xu, Yv, Nr alone does not help" in str(told.value)


def test_the_least_damping_of_an_unstable_prior():
    """The advice followed gives steady motions; two percent less of it does not."""
    model = thesis_model()
    theta = model.theta.copy()
    place = model.names.index("Nr")
    theta[place] = 0.3
    unstable = replace(model, theta=theta)
    with pytest.raises(InfeasibleError, match="unstable in free run") as told:
        prepare_request(unstable, DesignRequest(150.0))
    name, value, needed = re.search(
        r"(\w+) would have to fall from (-?[\d.]+) to (-?[\d.]+) for", str(told.value)
    ).groups()
    assert float(value) == theta[model.names.index(name)]
    for factor in (1.0, 0.98):
        changed = theta.copy()
        changed[model.names.index(name)] += factor * (float(needed) - float(value))
        damped = replace(model, theta=changed)
        if factor == 1.0:
            assert prepare_request(damped, DesignRequest(150.0)).theta is not None
        else:
            with pytest.raises(InfeasibleError, match="unstable in free run"):
                prepare_request(damped, DesignRequest(150.0))


def test_options_that_exclude_one_another():
    model = thesis_model()
    with pytest.raises(UsageError, match="--wind 5,0"):
        prepare_request(model, DesignRequest(150.0, predictor="wind"))
    with pytest.raises(UsageError, match="names 2 regimes for 1 trial"):
        prepare_request(model, DesignRequest(150.0, regime="u+v+,u+v-"))
    with pytest.raises(UsageError, match="--trials is 0"):
        prepare_request(model, DesignRequest(150.0, trials=0))
    with pytest.raises(UsageError, match="--start has 3 numbers, 4 are needed"):
        prepare_request(model, DesignRequest(150.0, start=(1, 2, 3)))
    with pytest.raises(
        UsageError, match=r"'Xuw' is no parameter of this model\. Did you mean 'Xu'"
    ):
        design_trial(prepare_request(model, DesignRequest(150.0, wanted=("Xuw",))))
    with pytest.raises(UsageError, match="a standard error of 0"):
        prepare_request(model, DesignRequest(150.0, prior=model))
    siso = get_structure("siso")
    wrong = ManoeuvringModel(siso, np.array([-0.1, 1.0]), np.zeros((2, 2)), 1.0, model.vessel)
    with pytest.raises(StructureError, match="has no surge speed u"):
        prepare_request(wrong, DesignRequest(150.0))


def test_a_sum_of_terms_gets_its_parts_back():
    """An estimate keeps Xuu for Xuu + Wuu; the disturbed trial needs both terms."""
    full = thesis_model()
    keep = [n for n in full.names if n not in ("Wuu", "Wvv", "Wuv")]
    theta = np.array([full.theta[full.names.index(n)] for n in keep])
    merged = ManoeuvringModel(
        full.structure.without("Wuu", "Wvv", "Wuv"), theta, np.zeros((15, 15)), 1.0, full.vessel,
        sums={"Xuu": ("Xuu", "Wuu"), "Yvv": ("Yvv", "Wvv"), "Nuv": ("Nuv", "Wuv")},
    )  # fmt: skip
    request = prepare_request(merged, DesignRequest(300.0, regime="u+v+"))
    assert len(request.build_predictor().columns) == 41


def test_regimes_as_text():
    assert parse_regime("u+v-", ("u", "v", "r")) == (("u", 1), ("v", -1))
    assert spell_regime(parse_regime("v-", ("u", "v"))) == "v-"
    with pytest.raises(UsageError, match="cannot be read at 'v'"):
        parse_regime("u+v", ("u", "v"))
    with pytest.raises(UsageError, match=r"names 'w', and .* has u, v: write their signs"):
        parse_regime("w+", ("u", "v"))
    with pytest.raises(UsageError, match="names 'u' twice"):
        parse_regime("u+u-", ("u", "v"))


def test_functions_of_the_parameters():
    values = {"Xuu": -0.05, "Xmu": 0.02}
    found = gradient_of("-Xuu/Xmu + sqrt(Xmu)**2", values)
    assert found["Xuu"] == pytest.approx(-50.0)
    assert found["Xmu"] == pytest.approx(-0.05 / 0.02**2 + 1)
    values |= {"N_|r|r": -2.0, "Y_|r|v": 0.5, "Nr": 4.0}
    assert gradient_of("N_|r|r", values) == {"N_|r|r": 1.0}
    found = gradient_of("N_|r|r/Nr - 3*Y_|r|v", values)
    assert found == pytest.approx({"N_|r|r": 0.25, "Nr": 2 / 16, "Y_|r|v": -3.0})
    with pytest.raises(UsageError, match=r"The model has: Xuu, Xmu, N_\|r\|r, Y_\|r\|v, Nr\.$"):
        gradient_of("N_|r|r + Nq", values)
    for text in (
        "N_|r|q/Nr",
        "__import__('os')",
        "Xuu.real",
        "(lambda: 1)()",
        "Xuu if 1 else 2",
        "1 +",
        "x" * 900,
    ):
        with pytest.raises(UsageError, match="--of"):
            gradient_of(text, values)
    with pytest.raises(UsageError, match="no finite slope"):
        gradient_of("3", values)


def test_classical_sequences():
    rng = np.random.default_rng(0)
    two = random_two_level(95, 3, 4, rng)
    assert two.shape == (4, 95, 3)
    assert set(np.unique(two)) == {0.0, 1.0}
    p = prbs(511, 2, (9,))[0]
    assert p[:, 0].mean() == pytest.approx(256 / 511)
    assert abs(np.corrcoef(p.T)[0, 1]) < 0.01
    m = multisines(64, 2, 3, rng)
    assert m.min() == pytest.approx(0.0)
    assert m.max() == pytest.approx(1.0)
    # harmonics of two commands do not overlap
    spectra = np.abs(np.fft.rfft(m[0] - m[0].mean(axis=0), axis=0))
    assert (spectra[:, 0] * spectra[:, 1]).max() < 1e-6 * spectra.max() ** 2
    z = zig_zags(20, limited_ship())
    assert z.shape[1:] == (20, 3)
    np.testing.assert_allclose(z[..., 1] + z[..., 2], 1.0)


def test_precision_of_a_given_plan():
    request = make_request(duration=200.0)
    still = {"n": np.full(200, 10.0), "alpha1": np.full(200, 0.8), "alpha2": np.full(200, 0.8)}
    with pytest.raises(ExcitationError, match="do not excite every direction"):
        predict_precision(request, [still])
    problem = build_problem(request)
    reference, _ = best_random(problem, 0, 20)
    commands = problem.commands(reference.unit)
    plan = dict(zip(("n", "alpha1", "alpha2"), commands.T, strict=True))
    found = predict_precision(request, [plan])
    assert found.logdet == pytest.approx(assess(problem, reference.unit[None])[0].value)
    assert "−log det" in found.summary()
    with pytest.raises(UsageError, match="has 100 samples, the request 200"):
        predict_precision(request, [{k: v[:100] for k, v in plan.items()}])
    with pytest.raises(UsageError, match="0 plans for 1 trial: "):
        predict_precision(request, [])


@pytest.fixture(scope="module")
def good():
    """A design of 120 s after a short search."""
    return design_trial(make_request(duration=120.0, effort=0.1), workers=1, alternatives=False)


@pytest.mark.long
def test_a_design_starts_from_what_it_is_given(good):
    request = make_request(duration=120.0, effort=0.02)
    again = design_trial(request, workers=1, alternatives=False, first=good.levels)
    assert again.logdet >= good.logdet - 1e-9
    cold = design_trial(request, workers=1, alternatives=False)
    assert cold.logdet < good.logdet


@pytest.mark.long
def test_a_first_sequence_need_not_keep_the_limits():
    """Slow ahead is below the margins; what lies beyond the thrusters is clipped."""
    limits = TrialLimits(margins={"u": 0.8, "v": 0.73})
    request = make_request(duration=120.0, effort=0.02, limits=limits)
    levels = np.tile([-99.0, 0.6, 0.6], (12, 1))
    missed = assess(build_problem(request), np.zeros((1, 12, 3)))[0].missed
    assert missed.max() > 0.02
    design = design_trial(request, workers=1, alternatives=False, first=(levels,))
    assert design.margins["u"] >= 0.8 - 1e-3
    assert design.margins["v"] >= 0.73 - 1e-3
    assert np.isfinite(design.std).all()


@pytest.mark.usefixtures("hasty")
def test_a_first_sequence_is_brought_within_the_rates(good):
    request = make_request(duration=120.0, effort=0.02, vessel=limited_ship(0.5, 0.01))
    assert np.abs(np.diff(good.levels[0], axis=0)).max(axis=0)[1] > 0.1
    design = design_trial(request, workers=1, alternatives=False, first=good.levels)
    step = np.abs(np.diff(design.commands[0], axis=0)).max(axis=0)
    assert (step <= np.array([0.5, 0.01, 0.01]) + 1e-9).all()
