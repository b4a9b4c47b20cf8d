"""Vessel files: what they say, and what they must not say."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest

from greybox.errors import VesselError
from greybox.vessel.force import force_function, force_inputs, generalised_force
from greybox.vessel.thrust import ThrustLaw
from greybox.vessel.toml import load_vessel, vessel_from_dict, vessel_to_dict

AZIMUTH = {"type": "azimuth", "x": 2.0, "y": -1.0, "speed": "n", "angle": "a"}


def vessel(*thrusters, **more):
    return vessel_from_dict({"name": "V", "length": 10, "thruster": list(thrusters), **more})


def test_azimuths_give_the_published_force():
    """(3.46), typed from the thesis."""
    v = vessel(AZIMUTH, {"type": "azimuth", "x": -3.0, "y": 0.5, "speed": "n2", "angle": "a2"})
    n, a, n2, a2 = 5.0, 0.3, 7.0, -1.1
    got = generalised_force(
        v, {"n": np.array([n]), "a": np.array([a]), "n2": np.array([n2]), "a2": np.array([a2])}
    )
    want = {
        "taux": n * math.cos(a) + n2 * math.cos(a2),
        "tauy": n * math.sin(a) + n2 * math.sin(a2),
        "taun": n * (2 * math.sin(a) + 1 * math.cos(a))
        + n2 * (-3 * math.sin(a2) - 0.5 * math.cos(a2)),
    }
    for name, value in want.items():
        np.testing.assert_allclose(got[name], value)


def test_symbolic_and_array_forces_agree():
    v = load_vessel("ferry")
    rng = np.random.default_rng(0)
    values = {c: rng.uniform(-900, 900, 20) for c in v.commands}
    got = generalised_force(v, values)
    function = force_function(v)
    want = np.array(
        [np.array(function([values[c][k] for c in v.commands])).ravel() for k in range(20)]
    )
    np.testing.assert_allclose(np.column_stack(list(got.values())), want, rtol=1e-10)


def test_fixed_tunnel_and_shared_columns():
    v = vessel(
        {"type": "fixed", "x": -4, "y": -1, "speed": "port"},
        {"type": "fixed", "x": -4, "y": 1, "speed": "port"},
        {"type": "tunnel", "x": 4, "y": 0, "speed": "bow"},
    )
    assert v.commands == ("port", "bow")
    got = generalised_force(v, {"port": np.array([3.0]), "bow": np.array([2.0])})
    np.testing.assert_allclose([got["taux"][0], got["tauy"][0], got["taun"][0]], [6, 2, 8])


def test_a_vessel_without_side_force_has_no_such_input():
    v = vessel({"type": "fixed", "y": -1, "speed": "l"}, {"type": "fixed", "y": 1, "speed": "r"})
    assert force_inputs(v) == ("taux", "taun")


def test_rudder_inputs_have_the_signs_of_the_derivation():
    v = vessel({"type": "propeller_rudder", "x": -5, "speed": "n", "rudder": "d"})
    assert force_inputs(v) == ("taux", "race", "rudder", "race_drag", "rudder_drag")
    d = 0.2
    ahead = generalised_force(v, {"n": np.array([4.0]), "d": np.array([d])})
    astern = generalised_force(v, {"n": np.array([-4.0]), "d": np.array([d])})
    np.testing.assert_allclose(ahead["race"], 4 * math.sin(d) * math.cos(d))
    np.testing.assert_allclose(ahead["race_drag"], 4 * math.sin(d) ** 2)
    np.testing.assert_allclose(astern["race"], 0.0)  # the race leaves forward
    np.testing.assert_allclose(astern["rudder"], math.sin(d) * math.cos(d))
    np.testing.assert_allclose(astern["taux"], -4.0)


@pytest.mark.parametrize(
    "law",
    [
        ThrustLaw("linear"),
        ThrustLaw("quadratic"),
        ThrustLaw("table", ((-9.0, -33.0), (-1.0, 0.0), (1.5, 0.0), (4.0, 10.0), (9.0, 42.0))),
    ],
)
def test_thrust_laws(law):
    n = ca.SX.sym("n")
    f = ca.Function("f", [n], [law.force(n)])
    for value in np.linspace(-9, 9, 37):
        if law.kind == "table":
            want = np.interp(value, *np.array(law.table).T)
        else:
            want = value if law.kind == "linear" else value * abs(value)
        assert float(f(value)) == pytest.approx(want, abs=1e-12)
    if law.kind == "table":  # beyond the ends by the last slope
        assert float(f(10)) == pytest.approx(42 + 32 / 5)


def test_the_file_says_what_drives_the_model():
    logged = {
        **AZIMUTH, "speed_command": "n_ref", "angle_command": "a_ref", "drive": "command",
    }  # fmt: skip
    assert vessel(logged).commands == ("n_ref", "a_ref")
    assert vessel({**logged, "drive": "feedback"}).commands == ("n", "a")


def test_limits_of_a_shared_column_are_the_tightest():
    v = vessel(
        {**AZIMUTH, "speed_limits": [0, 20], "speed_rate": 3},
        {**AZIMUTH, "angle": "b", "speed_limits": [2, 30], "speed_rate": 1},
    )
    assert (v.limits["n"].lower, v.limits["n"].upper, v.limits["n"].rate) == (2, 20, 1)


@pytest.mark.parametrize("name", ["thesis", "ferry"])
def test_examples_survive_a_round_trip(name):
    v = load_vessel(name)
    assert vessel_to_dict(vessel_from_dict(vessel_to_dict(v))) == vessel_to_dict(v)
    assert vessel_from_dict(vessel_to_dict(v)).thrusters == v.thrusters


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"type": "azimut"}, "Did you mean 'azimuth'"),
        ({"spede": "n"}, "unknown key 'spede'. Did you mean 'speed'"),
        ({"angle": 0.3}, "'angle' must name the column"),
        ({"thrust": "quadratc"}, "Did you mean 'quadratic'"),
        ({"thrust": [[1, 2]]}, "has 1 point"),
        ({"thrust": [[1, 2], [0, 1]]}, "goes from 1 to 0"),
        ({"speed_limits": [5, 1]}, "run from 5 to 1"),
        ({"speed_rate": -1}, "must be positive"),
        ({"x": "two"}, "a finite number is needed"),
        ({"drive": "comand"}, "Did you mean 'command'"),
        ({"drive": "command"}, "has no 'angle_command'"),
        ({"rudder": "d"}, "cannot have a rudder"),
    ],
)
def test_bad_thrusters(change, message):
    with pytest.raises(VesselError, match=message.replace("[", r"\[")):
        vessel({**AZIMUTH, **change})


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"columns": {"psi [deg]": {"name": "psi"}}}, 'without a unit: add unit = "rad"'),
        ({"columns": {"x": {"name": "psy", "unit": "deg"}}}, "Did you mean 'psi'"),
        ({"columns": {"x": {"name": "psi", "unit": "degree"}}}, "unknown unit 'degree'"),
        ({"columns": {"x": {"name": "psi", "unit": "m"}}}, "of the same dimension"),
        ({"sensors": {"heding_std": 1}}, "Did you mean 'heading_std'"),
        ({"sensors": {"antenna": [1]}}, "needs 2 numbers"),
        ({"sensors": {"u_std": -1}}, "cannot be negative"),
        ({"lenght": 3}, "Did you mean 'length'"),
        ({"closed_loop": {"column": 3}}, "needs column ="),
    ],
)
def test_bad_vessels(more, message):
    with pytest.raises(VesselError, match=message):
        vessel(AZIMUTH, **more)


def test_missing_and_foreign_files(tmp_path):
    with pytest.raises(VesselError, match="cannot read the vessel file"):
        load_vessel(tmp_path / "none.toml")
    bad = tmp_path / "bad.toml"
    bad.write_text("name = ")
    with pytest.raises(VesselError, match="is not TOML"):
        load_vessel(bad)
    bad.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(VesselError, match="not a text file"):
        load_vessel(bad)
    with pytest.raises(VesselError, match="has no 'thruster'"):
        vessel_from_dict({"name": "x", "length": 3})
