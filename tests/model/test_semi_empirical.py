"""The model from main dimensions, against ships of other origin and against hand calculations."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
from foreign_ships import manoeuvres, presets

from greybox.errors import VesselError
from greybox.model.model import load_model
from greybox.model.semi_empirical import (
    METHOD,
    clarke_derivatives,
    crossflow_drag,
    full_thrust,
    main_dimensions,
    resistance,
    semi_empirical_model,
)
from greybox.vessel.conditions import Conditions
from greybox.vessel.force import generalised_force
from greybox.vessel.toml import load_vessel, vessel_from_dict, vessel_to_dict

SHIPS = [
    "kvlcc2-7m", "kvlcc2-320m", "training-ship-105m", "esso-osaka-3m", "survey-catamaran-1.2m",
    "survey-catamaran-2m", "research-catamaran-29m",
]  # fmt: skip
LENGTHS = 30


def known_vessel(name, thrust=None, **changes):
    """What a crew writes that knows its ship."""
    ship = presets()[name].ship
    tables = tomllib.loads(ship.vessel_toml(thrust)) | {
        "beam": ship.beam, "mass": ship.inertia[0], "service_speed": ship.service_speed,
        "conditions": {"draught": ship.draught},
    }  # fmt: skip
    return vessel_from_dict({k: v for k, v in (tables | changes).items() if v is not None})


def free_run(model, commands):
    """States (N, 3) under commands, (N,) each or held, from half the service speed."""
    s = model.structure
    step = ca.Function(
        "step", [s.symbols.x, s.symbols.tau],
        [ca.substitute(
            s.symbols.x + s.increment_expression(air_measured=False),
            ca.vertcat(s.symbols.psi, s.symbols.d, s.symbols.theta),
            ca.vertcat(0, ca.DM.zeros(4), model.theta),
        )],
    )  # fmt: skip
    tau = generalised_force(model.vessel, dict(zip(model.vessel.commands, commands, strict=True)))
    n = len(commands[0])
    inputs = np.array([tau.get(i, np.zeros(n)) for i in s.inputs])
    x0 = [main_dimensions(model.vessel).speed / 2, 0.0, 0.0]
    return np.array(step.mapaccum(n)(x0, inputs)).T


@lru_cache
def settled(name):
    """Commands full ahead and in a turn, and what the foreign ship makes of them."""
    preset = presets()[name]
    ship = preset.ship
    seconds = LENGTHS * ship.time_scale
    full = [0.0 if a.angle else a.limits[1] for a in ship.actuators]
    turn = ship.helm(1.0, 20 / 35)
    turn = [
        min(max(c, a.limits[0]), a.limits[1]) for c, a in zip(turn, ship.actuators, strict=True)
    ]
    found = []
    for commands in (full, turn):
        sailed = preset.sail(
            manoeuvres.table([0.0], [commands]), seconds, step=ship.time_scale / 60
        )
        found.append((commands, {k: float(sailed.true[k][-10:].mean()) for k in ("u", "r")}))
    return seconds, found


@pytest.mark.parametrize("thrust", [None, "quadratic"])
@pytest.mark.parametrize("name", SHIPS)
def test_speed_and_turn_of_foreign_ships(name, thrust):
    model = semi_empirical_model(known_vessel(name, thrust))
    seconds, ((full, ahead), (turn, turning)) = settled(name)
    samples = int(seconds / model.sample_time)
    u = free_run(model, [np.full(samples, c) for c in full])[-1, 0]
    r = free_run(model, [np.full(samples, c) for c in turn])[-1, 2]
    assert 1 / 1.5 < u / ahead["u"] < 1.5
    assert 1 / 2.5 < r / turning["r"] < 2.5


@pytest.mark.parametrize("name", SHIPS)
def test_length_and_speed_are_enough(name):
    bare = known_vessel(name, beam=None, mass=None, conditions=None)
    model = semi_empirical_model(bare)
    seconds, (_, (turn, turning)) = settled(name)
    samples = int(seconds / model.sample_time)
    r = free_run(model, [np.full(samples, c) for c in turn])[-1, 2]
    assert 1 / 2.5 < r / turning["r"] < 2.5


@pytest.mark.parametrize("name", SHIPS)
def test_stable_on_random_steps(name):
    model = semi_empirical_model(known_vessel(name))
    rng = np.random.default_rng(4)
    limits = model.vessel.limits.values()
    held = [np.repeat(rng.uniform(x.lower, x.upper, 100), 50) for x in limits]
    motion = free_run(model, held)
    hull = main_dimensions(model.vessel)
    assert np.abs(motion[:, 0]).max() < 1.6 * hull.speed
    assert np.abs(motion[:, 1]).max() < hull.speed
    # no ship turns by more than a circle of half her length
    assert np.abs(motion[:, 2]).max() * hull.length / hull.speed < 2.0


def test_drawn_models_are_stable():
    model = semi_empirical_model(known_vessel("training-ship-105m"))
    rng = np.random.default_rng(5)
    x = model.vessel.limits
    held = [np.repeat(rng.uniform(v.lower, v.upper, 40), 50) for v in x.values()]
    for _ in range(40):
        theta = model.theta + model.std * rng.standard_normal(len(model.theta))
        assert np.isfinite(free_run(replace(model, theta=theta), held)).all()


def test_clarke_of_a_tanker_by_hand():
    hull = replace(main_dimensions(known_vessel("kvlcc2-320m")), speed=1.0)
    found = clarke_derivatives(hull)
    # B/L 0.18143, B/T 2.76087, C_b 0.79965 (at 1025 kg/m3), pi (T/L)2 = 0.0135666
    unit = 0.5 * 1025 * 320.0**2
    assert hull.block == pytest.approx(0.79965, rel=1e-3)
    assert found.Y_v / unit == pytest.approx(-0.0135666 * 1.88308, rel=1e-3)
    assert found.Y_r / unit / 320 == pytest.approx(-0.0135666 * -0.321724, rel=1e-3)
    assert found.N_v / unit / 320 == pytest.approx(-0.0135666 * 0.657715, rel=1e-3)
    assert found.N_r / unit / 320**2 == pytest.approx(-0.0135666 * 0.256073, rel=1e-3)
    assert found.Y_vdot / unit / 320 == pytest.approx(-0.0135666 * 1.18536, rel=1e-3)
    assert found.N_rdot / unit / 320**3 == pytest.approx(-0.0135666 * 0.060992, rel=1e-3)


def test_resistance_of_a_tanker_at_sea():
    # KVLCC2 at 15.5 kn: a total coefficient of about 1.8e-3 on 27 200 m2 is 1.6 MN
    hull = main_dimensions(known_vessel("kvlcc2-320m"))
    assert 1.2e6 < resistance(hull, 7.97) < 2.1e6


def test_crossflow_of_pure_drift_and_rotation():
    hull = main_dimensions(known_vessel("kvlcc2-7m"))
    side, turning = crossflow_drag(hull)
    plate = 0.5 * 1025 * hull.draught * hull.length
    # between drift alone (1) and the whole range of turning (4/3 + ...)
    assert 0.6 < side / plate < 1.4
    assert 0.6 / 6 < turning / plate / hull.length**2 < 1.4 / 3


def test_damping_takes_energy_and_thrust_pushes():
    for name in SHIPS:
        model = semi_empirical_model(known_vessel(name))
        for term, value in zip(model.structure.terms, model.theta, strict=True):
            if term.dissipates:
                assert value <= 0, (name, term.name)
        theta = dict(zip(model.names, model.theta, strict=True))
        assert theta["Xmu"] > 0
        if "N_race" in theta:
            assert theta["N_race"] > 0 > theta["Y_race"]
        else:
            assert theta["Nmu"] > 0
        assert (model.std > 0).all()


def test_notes_name_each_assumption_and_its_key():
    bare = semi_empirical_model(load_vessel("thesis"))
    said = " ".join(bare.record["notes"])
    for key in ("state beam", "state draught", "state mass", "state service_speed"):
        assert key in said
    stated = semi_empirical_model(known_vessel("kvlcc2-320m"))
    assert len(stated.record["notes"]) == 1
    assert "assumed" not in stated.record["notes"][0]


def test_more_hulls_than_one_are_told():
    one, two = (main_dimensions(known_vessel(n)) for n in ("kvlcc2-7m", "survey-catamaran-2m"))
    assert two.several_hulls
    assert not one.several_hulls
    assert any("more than one hull" in n for n in two.notes)
    assert two.mass == 60.0


def test_draught_comes_from_the_mass():
    vessel = replace(known_vessel("kvlcc2-320m"), conditions=Conditions())
    assert main_dimensions(vessel).draught == pytest.approx(21.03, rel=0.1)


def test_speed_comes_from_thrust_in_newtons():
    tables = vessel_to_dict(load_vessel("ferry"))
    for t in tables["thruster"]:
        t["speed_limits"] = [-900.0, 900.0]
    ferry = vessel_from_dict(tables)
    hull = main_dimensions(ferry)
    assert full_thrust(ferry) == pytest.approx(4 * 415.0)
    assert 0.5 < hull.speed < 0.4 * np.sqrt(9.81 * 5) + 1e-9
    model = semi_empirical_model(ferry)
    ahead = [np.full(2000, 0.0 if c in ferry.angle_commands else 900.0) for c in ferry.commands]
    assert free_run(model, ahead)[-1, 0] == pytest.approx(hull.speed, rel=0.03)


def test_impossible_vessels_are_refused_in_a_sentence():
    with pytest.raises(VesselError, match=r"mass 1e\+09 kg, .* correct mass, beam or draught"):
        main_dimensions(known_vessel("kvlcc2-320m", mass=1e9))
    tonnes = known_vessel("training-ship-105m").mass / 1000
    with pytest.raises(
        VesselError, match=r"of length 105 m has more than .*: write the mass in kg"
    ):
        main_dimensions(known_vessel("training-ship-105m", mass=tonnes))
    with pytest.raises(VesselError, match="driven by 'n1' has no speed_limits"):
        semi_empirical_model(load_vessel("ferry"))


def test_saved_and_read_again(tmp_path):
    model = semi_empirical_model(known_vessel("training-ship-105m"))
    model.save(tmp_path / "model.json")
    again = load_model(tmp_path / "model.json")
    assert again == model
    assert again.record["method"] == METHOD
    assert again.vessel.beam == 17.91
    assert again.vessel.service_speed == 7.2
