"""Terms that the data chose, and defects of sensors beside them."""

from __future__ import annotations

from dataclasses import replace
from math import factorial
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from greybox.diagnosis.builder import at_limit
from greybox.diagnosis.causes.sensors import LeverArm, abeam, alike_to_forces, turned_alike
from greybox.diagnosis.chosen import (
    _known_columns,
    _law,
    _own_share,
    _ship,
    _told_apart,
    _with_sensors,
)
from greybox.diagnosis.hypothesis import Hypothesis, Parameter
from greybox.diagnosis.preparing import prepare
from greybox.diagnosis.search import Candidate, _of_the_ship
from greybox.diagnosis.ship import Ship
from greybox.model.run.step import MONOTONE, Integrator
from greybox.model.terms import parse_term
from greybox.study.blind import draw
from greybox.trial.log import TrialLog
from greybox.vessel.force import generalised_force
from greybox.vessel.thrust import ThrustLaw
from greybox.vessel.vessel import Thruster, Vessel

BIAS, ARM = 0.06, (-0.9, 0.4)


def as_measured(log: TrialLog) -> TrialLog:
    """Return a log whose antenna is away from the origin and whose compass is biased."""
    u, v = log["u"] - log["r"] * ARM[1], log["v"] + log["r"] * ARM[0]
    turned = {
        "u": u * np.cos(BIAS) + v * np.sin(BIAS),
        "v": v * np.cos(BIAS) - u * np.sin(BIAS),
    }
    return replace(log, channels={**log.channels, **turned})


@pytest.mark.parametrize("defect", [True, False])
def test_defects_of_sensors_stand_beside_terms_that_imitate_them(defect: bool) -> None:
    trial = draw(np.random.default_rng([4, 2]), (), samples=500, positions=False)
    logs = [trial.estimation, trial.validation]
    one, two = (as_measured(log) for log in logs) if defect else logs
    ready = prepare([one], [two], None, "thesis", ["heading_bias", "lever_arm"])
    terms = ("Y_taux", "N_taux")
    imitating = Hypothesis(
        "asymmetry", "asymmetry", tuple(Parameter(n, "", 0.0) for n in terms), columns=terms
    )
    case = ready.case.wider(terms, "free run")
    base = case.carried(ready.base())
    problem = case.problem(base.integrator)
    fit = problem.settle(problem.fit(problem.add(base.point, imitating), base.noise))
    found, causes = _with_sensors(case, fit, [imitating], ready.hypotheses)
    if not defect:
        assert causes == [imitating]
        return
    assert {h.cause for h in causes} == {"asymmetry", "heading_bias", "lever_arm"}
    told = {h.cause: v for h, v in zip(found.point.hypotheses, found.point.values, strict=True)}
    assert np.abs(told["heading_bias"]) == pytest.approx([BIAS], abs=0.01)
    assert told["lever_arm"] == pytest.approx(ARM, abs=0.25)


def test_an_antenna_far_off_is_sought_with_the_coefficients_of_least_squares() -> None:
    trial = draw(np.random.default_rng([4, 2]), (), samples=500, positions=False)
    ahead = 12.0

    def seen(log: TrialLog) -> TrialLog:
        return replace(log, channels={**log.channels, "v": log["v"] + ahead * log["r"]})

    ready = prepare([seen(trial.estimation)], [trial.validation], None, "thesis", ["lever_arm"])
    (arm,) = ready.hypotheses
    base = ready.base()
    ((hypothesis, found),) = ready.case.from_far(base, [arm], {})
    assert hypothesis == arm
    assert found.cost < base.cost
    assert found.point.values[-1] == pytest.approx([ahead, 0.0], abs=1.0)
    # nothing is begun where a refit from near promises as much
    assert ready.case.from_far(base, [arm], {arm.key: np.inf}) == []


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_damping_stays_where_a_step_decays_more_the_more_it_is(integrator: Integrator) -> None:
    z = np.linspace(MONOTONE[integrator], 0.0, 200)
    powers = range(2 if integrator == "euler" else 5)
    step = sum(z**k / factorial(k) for k in powers)
    assert np.all(np.diff(step) > 0)
    assert step[0] >= 0
    trial = draw(np.random.default_rng([4, 2]), (), samples=500, positions=False)
    ready = prepare([trial.estimation], [trial.validation], None, "linear+N_|r|r", ["lever_arm"])
    problem = ready.case.problem(integrator)
    base = ready.base()
    names = problem.structure.parameters
    theta = base.point.base.theta.copy()
    # the pole of a rate of 0.3 again, on the other side, and all forces as much larger
    theta[names.index("Nr")] = -1.7 if integrator == "euler" else -2.6
    twin = replace(base.point, base=replace(base.point.base, theta=theta))
    found = problem.settle(problem.fit(twin, base.noise))
    told = dict(zip(names, found.point.base.theta, strict=True))
    assert MONOTONE[integrator] <= told["Nr"] < 0
    r = trial.estimation["r"]
    least = dict(zip(names, problem.bounds(base.point)[0], strict=False))
    # and one that ends there is told
    theta[names.index("Nr")] = MONOTONE[integrator]
    edge = replace(base.point, base=replace(base.point.base, theta=theta))
    assert (at_limit(problem, edge), at_limit(problem, found.point)) == (["Nr"], [])
    expected = MONOTONE[integrator] * (r**2).sum() / (np.abs(r) ** 3).sum()
    assert least["N_|r|r"] == pytest.approx(expected)


def test_only_the_place_abeam_of_an_antenna_is_sought_beside_coupled_inertia() -> None:
    trial = draw(np.random.default_rng([4, 2]), (), samples=200, positions=False)
    ready = prepare([trial.estimation], [trial.validation], None, "thesis", ["lever_arm"])
    (arm,) = ready.hypotheses
    # forces of motion and commands imitate it
    assert {"u", "v", "r"} < {*arm.arguments}
    ship = ready.base().point.ship
    length = trial.estimation.vessel.length
    assert [p.high for p in arm.parameters] == [length, length / 2]
    other = abeam(arm)
    assert [p.name for p in other.parameters] == ["lever_arm_y"]
    assert {len(value) for value in arm.far} == {2}
    assert not other.far
    assert other.apply is not None
    assert other.apply(ship, np.array([0.3])).sensors.lever == (0, 0.3)
    # a sensor's defect has a name, or is no part of a model
    problem, base = ready.case.problem("rk4"), ready.base()
    moved = replace(base, point=problem.add(base.point, arm, np.array([1.0, 0.0])))
    found = Candidate(arm, moved, 0.0, 0.0, 0.0, None)  # type: ignore[arg-type]
    assert not _of_the_ship(ready.case, replace(moved, integrator="rk4"), found)
    coupling = replace(arm, cause="inertia_coupling", key="inertia_coupling:Y_r", parameters=())
    assert alike_to_forces(arm, coupling)
    assert alike_to_forces(coupling, arm)
    assert not alike_to_forces(other, coupling)
    assert not alike_to_forces(coupling, coupling)
    said = LeverArm().evidence({"lever_arm_y": (-2.0, 0.1)})
    assert said == "the velocities are those of a point 2.00 ± 0.10 m to port of the origin"


def test_terms_that_logs_cannot_tell_apart_are_free_once() -> None:
    square = np.array([[1.0, 1.0, 0.2], [1.0, 1.0, 0.2], [0.2, 0.2, 1.0]])
    assert _own_share(square, [0, 1, 2], 1) < 1e-9
    assert _own_share(square, [0, 2], 0) == pytest.approx(1 - 0.2**2)
    # a ship that only goes ahead: |u| u is u u
    trial = draw(np.random.default_rng([4, 2]), (), samples=200, positions=False)
    assert (trial.estimation["u"] > 0).all()
    ready = prepare([trial.estimation], [trial.validation], None, "thesis", ["crossflow"])
    case = ready.case.wider(["N_|u|v", "N_|v|v"], "free run")
    base = case.carried(ready.base())
    problem = case.problem(base.integrator)

    def damping(name: str) -> Hypothesis:
        return Hypothesis("crossflow", f"crossflow:{name}", (Parameter(name, "1/m", 0.0),), (name,))

    # and (3.51) has u v
    assert _known_columns(problem, base, [damping("N_|u|v"), damping("Y_|r|v")]) == {"N_|u|v"}
    both = problem.add(base.point, damping("N_|u|v"))
    own = problem.place("Nuv")
    assert set(both.places) - set(_told_apart(problem, both, base.noise, [own]).places) == {own}
    assert _told_apart(problem, base.point, base.noise, [own]).places == base.point.places


def test_a_compass_bias_and_a_force_to_one_side_are_rivals() -> None:
    def of(cause: str) -> Hypothesis:
        return Hypothesis(cause, cause, ())

    assert turned_alike(of("heading_bias"), of("asymmetry"))
    assert turned_alike(of("side_force"), of("heading_bias"))
    assert not turned_alike(of("asymmetry"), of("side_force"))
    assert not turned_alike(of("heading_bias"), of("lever_arm"))


@pytest.mark.parametrize("law", [ThrustLaw(quadratic_share=0.5, reference=12.0),
                                 ThrustLaw("quadratic"), ThrustLaw()])  # fmt: skip
def test_a_chosen_thrust_law_keeps_its_force(law: ThrustLaw) -> None:
    trial = draw(np.random.default_rng([4, 2]), (), samples=200, positions=False)
    ready = prepare([trial.estimation], [trial.validation], None, "thesis", ["quadratic_thrust"])
    base = ready.base()
    vessel = trial.estimation.vessel
    thrusters = tuple(replace(t, thrust=law) for t in vessel.thrusters)
    log = replace(trial.estimation, vessel=replace(vessel, thrusters=thrusters))
    share, pushed = _law(cast(Any, SimpleNamespace(logs=[log])), base, ready.hypotheses)
    apply = ready.hypotheses[0].apply
    assert apply is not None
    ours = apply(base.point.base, np.array([share])).vessel.thrusters[0].thrust
    assert ours.reference != law.reference
    speeds = np.array([-14.0, 3.0, 20.0])
    for n in speeds:
        assert pushed * float(ours.force(n)) == pytest.approx(float(law.force(n)))


def test_a_chosen_rudder_keeps_its_force() -> None:
    def ship(law: ThrustLaw) -> Vessel:
        screw = Thruster("propeller_rudder", -1.5, 0.0, "n", rudder="delta", thrust=law)
        return Vessel("tanker", 3.0, (screw,))

    chosen, ours = ship(ThrustLaw("quadratic")), ship(ThrustLaw(quadratic_share=1.0, reference=8.0))
    names = ("Xmu", "X_race_drag", "X_|u|u*rudder_drag", "N_race", "N_|u|u*rudder", "N_u*race")
    terms = [parse_term(name) for name in names]
    choice = SimpleNamespace(
        terms=SimpleNamespace(structure=SimpleNamespace(terms=terms), start=np.arange(1.0, 7.0)),
        logs=[SimpleNamespace(sample_time=0.5)],
    )  # fmt: skip
    problem = SimpleNamespace(sample_time=0.5, place=names.index)
    begun = Ship(np.zeros(len(names)), np.zeros(2), ours)
    base = SimpleNamespace(point=SimpleNamespace(base=begun))
    made = _ship(cast(Any, problem), cast(Any, choice), cast(Any, base), 8.0)
    commands = {"n": np.array([3.0, 8.0, 12.0]), "delta": np.array([0.1, -0.3, 0.5])}
    theirs, mine = (generalised_force(v, commands) for v in (chosen, ours))
    for name, term, value in zip(names, terms, choice.terms.start, strict=True):
        signal = next(f.signal for f in term.factors if f.signal in theirs)
        assert made.theta[names.index(name)] * mine[signal] == pytest.approx(
            value * theirs[signal]
        ), name
