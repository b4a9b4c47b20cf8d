"""Vessel files: what they say, and what they must not say."""

from __future__ import annotations

import json
import math
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

from greybox.errors import VesselError
from greybox.trial.log import make_log
from greybox.vessel.actuation import Actuation, actuated_force, limited
from greybox.vessel.force import force_expressions, force_inputs, generalised_force
from greybox.vessel.thrust import ThrustLaw, typical_speed
from greybox.vessel.toml import load_vessel, vessel_from_dict, vessel_to_dict
from greybox.vessel.vessel import ColumnMapping, Thruster

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
    commands = ca.SX.sym("commands", len(v.commands))
    function = ca.Function(
        "force", [commands], [ca.vertcat(*force_expressions(v, commands).values())]
    )
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
        ThrustLaw("linear", quadratic_share=0.3, reference=6.0),
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
            share = law.quadratic_share if law.kind == "linear" else 1.0
            want = (1 - share) * value + share * value * abs(value) / law.reference
        assert float(f(value)) == pytest.approx(want, abs=1e-12)
    if law.kind == "table":  # beyond the ends by the last slope
        assert float(f(10)) == pytest.approx(42 + 32 / 5)


def test_the_file_says_what_drives_the_model():
    logged = {
        **AZIMUTH, "speed_command": "n_ref", "angle_command": "a_ref", "drive": "command",
    }  # fmt: skip
    assert vessel(logged).commands == ("n_ref", "a_ref")
    assert vessel({**logged, "drive": "feedback"}).commands == ("n", "a")


def test_gain_and_offset_of_an_azimuth_and_of_a_rudder():
    v = vessel(
        {**AZIMUTH, "gain": 0.7, "angle_offset": 0.1},
        {"type": "propeller_rudder", "x": -5, "speed": "m", "rudder": "d", "gain": 2,
         "angle_offset": -0.05},
    )  # fmt: skip
    plain = vessel(AZIMUTH, {"type": "propeller_rudder", "x": -5, "speed": "m", "rudder": "d"})
    rng = np.random.default_rng(3)
    n, a, m, d = rng.uniform(-1, 1, (4, 50))
    got = generalised_force(v, {"n": n, "a": a, "m": m, "d": d})
    want = generalised_force(plain, {"n": 0.7 * n, "a": a + 0.1, "m": 2 * m, "d": d - 0.05})
    for name, value in want.items():
        np.testing.assert_allclose(got[name], value, atol=1e-14)


def slow_force(vessel, commands, step):
    """The delay and the lag sample by sample, one command at a time."""
    late = vessel.actuation
    a = math.exp(-step / late.lag)
    t = np.arange(len(next(iter(commands.values())))) * step

    def lag(c):
        x = [c[0]]
        for k in range(len(c) - 1):
            x.append(a * x[k] + (1 - a) * c[k])
        return np.array(x)

    moved = {k: np.interp(t - late.delay, t, c) for k, c in commands.items()}
    if late.lag_on == "force":
        return {k: lag(f) for k, f in generalised_force(vessel, moved).items()}
    slow = vessel.commands if late.lag_on == "command" else {t.speed for t in vessel.thrusters}
    return generalised_force(vessel, {k: lag(c) if k in slow else c for k, c in moved.items()})


@pytest.mark.parametrize("on", ["force", "speed", "command"])
@pytest.mark.parametrize("delay", [0.0, 1.0, 1.3, 500.0])
def test_late_force_equals_the_recursion(on, delay):
    v = vessel(
        {**AZIMUTH, "thrust": "quadratic"}, actuation={"lag": 2.0, "lag_on": on, "delay": delay}
    )
    rng = np.random.default_rng(4)
    values = {"n": rng.uniform(-9, 9, (3, 200)), "a": rng.uniform(-3, 3, (3, 200))}
    got = actuated_force(v, values, 0.5)
    for run in range(3):
        want = slow_force(v, {k: c[run] for k, c in values.items()}, 0.5)
        for name, value in want.items():
            np.testing.assert_allclose(got[name][run], value, atol=1e-11)


def test_one_command_is_late_and_the_other_is_not():
    """Delay, then rate limit, then lag, each of one column, sample by sample."""
    on = {"lag": 2.0, "lag_on": "a", "delay": 0.8, "delay_on": "n", "rate_limit": 0.4,
          "rate_on": "a"}  # fmt: skip
    v = vessel(AZIMUTH, actuation=on)
    assert (v.delayed_commands, v.lagged_commands) == (("n",), ("a",))
    rng = np.random.default_rng(4)
    n, a, step = rng.uniform(-9, 9, 200), rng.uniform(-3, 3, 200), 0.5
    t = np.arange(200) * step
    keep, at, acts, slow = math.exp(-step / 2.0), a[0], [a[0]], [a[0]]
    for k in range(1, 200):
        slow.append(keep * slow[-1] + (1 - keep) * acts[-1])
        # the mean of where it is, moment by moment within the sample
        inner = [at + np.clip(a[k] - at, -0.4 * s, 0.4 * s) for s in (np.arange(2000) + 0.5) / 4e3]
        acts.append(np.mean(inner))
        at = at + np.clip(a[k] - at, -0.2, 0.2)
    want = generalised_force(vessel(AZIMUTH), {"n": np.interp(t - 0.8, t, n), "a": np.array(slow)})
    got = actuated_force(v, {"n": n, "a": a}, step)
    for name, value in want.items():
        np.testing.assert_allclose(got[name], value, atol=1e-5)
    assert v.actuation.sentence == (
        "a lag of 2 s of a and a delay of 0.8 s of n and a rate limit of 0.4 per second of a"
    )


@pytest.mark.parametrize("shape", [(50,), (3, 50)])
def test_a_limited_signal_catches_up_and_no_faster(shape):
    wanted = np.random.default_rng(2).uniform(-1, 1, shape)
    got = limited(wanted, 0.3)
    assert np.abs(np.diff(got)).max() <= 0.3 + 1e-12
    np.testing.assert_array_equal(got[..., 0], wanted[..., 0])
    np.testing.assert_allclose(limited(wanted, 1e12), wanted, atol=1e-9)
    level = np.concatenate([np.zeros((*shape[:-1], 1)), np.ones((*shape[:-1], 9))], axis=-1)
    want = [0, 0.125, 0.375, 0.625, 0.875, 1, 1, 1, 1, 1]
    np.testing.assert_allclose(limited(level, 0.25), np.broadcast_to(want, level.shape))


def test_a_lag_is_exact_for_held_commands():
    """The step response of a first-order lag, and none without lag and delay."""
    commands = {"n": np.array([1.0] + [3.0] * 40), "a": np.zeros(41)}
    late = vessel(AZIMUTH, actuation={"lag": 4.0})
    got = actuated_force(late, commands, 0.5)["taux"]
    want = 1 + 2 * (1 - np.exp(-0.5 * np.arange(40) / 4))
    np.testing.assert_allclose(got[1:], want, rtol=1e-12)
    plain = vessel(AZIMUTH)
    np.testing.assert_array_equal(actuated_force(plain, commands, 0.5)["taux"], commands["n"])


def test_a_log_gives_the_late_force():
    v = vessel(AZIMUTH, actuation={"lag": 2.0, "delay": 0.7})
    rng = np.random.default_rng(5)
    values = {"n": rng.uniform(0, 9, 50), "a": rng.uniform(-1, 1, 50)}
    got = make_log(v, values, 0.5).forces(("taux", "taun", "race"))
    want = actuated_force(v, values, 0.5)
    np.testing.assert_array_equal(got.T, [want["taux"], want["taun"], np.zeros(50)])


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
    assert vessel_from_dict(vessel_to_dict(v)) == v


def test_all_that_a_diagnosis_adds_survives_a_round_trip():
    v = vessel(
        {**AZIMUTH, "gain": 0.8, "angle_offset": -0.03,
         "thrust": {"quadratic_share": 0.25, "reference": 15}},
        columns={"yaw": {"name": "r", "unit": "rad/s", "sign": -1}},
        actuation={"lag": 1.5, "lag_on": "a", "delay": 0.4, "delay_on": "n", "rate_limit": 0.1,
                   "rate_on": "a"},
    )  # fmt: skip
    assert v.thrusters[0].thrust == ThrustLaw("linear", (), 0.25, 15.0)
    assert v.actuation == Actuation(1.5, "a", 0.4, delay_on="n", rate_limit=0.1, rate_on="a")
    assert vessel_from_dict(json.loads(json.dumps(vessel_to_dict(v)))) == v
    plain = vessel_to_dict(vessel(AZIMUTH))
    assert not {"actuation", "gain", "angle_offset"} & (plain.keys() | plain["thruster"][0].keys())


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
        ({"angle_limits": [-180, 180]}, "reach 180 rad, and 12.6 .* radians, 3.142 for 180 deg"),
        ({"speed_rate": -1}, "must be positive"),
        ({"x": "two"}, "a finite number is needed"),
        ({"drive": "comand"}, "Did you mean 'command'"),
        ({"drive": "command"}, "has no 'angle_command'"),
        ({"rudder": "d"}, "cannot have a rudder"),
        ({"gain": math.nan}, "gain of thruster 1 is nan, a finite number"),
        ({"angle_offset": "x"}, "angle_offset of thruster 1 is 'x'"),
        ({"type": "fixed", "angle": 0.0, "angle_offset": 0.1}, "its angle is not logged"),
        ({"thrust": {"quadratic_share": 1.2}}, "quadratic_share is 1.2, it must be within 0"),
        ({"thrust": {"quadratic_share": 0.2, "reference": 0}}, "is 0, it must be positive"),
        ({"thrust": {"quadratic_shar": 0.2}}, "Did you mean 'quadratic_share'"),
        ({"thrust": [[1, 2], [2, "x"]]}, "thrust of thruster 1 is 'x', a finite number"),
        ({"thrust": [[1, 2], [2]]}, "must list [speed, force] pairs"),
        ({"type": "tunnel"}, "is of type tunnel and has no angle of its own"),
        ({"speed": 3}, "'speed' must name the column of its propeller speed"),
        ({"x": True}, "x of thruster 1 is True, a finite number"),
    ],
)
def test_bad_thrusters(change, message):
    with pytest.raises(VesselError, match=message.replace("[", r"\[")):
        vessel({**AZIMUTH, **change})


def test_limits_of_a_rudder_are_not_degrees():
    rudder = {"type": "propeller_rudder", "speed": "n", "rudder": "d", "rudder_limits": [-35, 35]}
    with pytest.raises(VesselError, match=r"reach 35 rad, and 1\.57 .* 0\.6109 for 35 deg"):
        vessel(rudder)


RUDDER = {"type": "propeller_rudder", "x": -1.0, "speed": "n", "rudder": "d"}


def test_rates_of_angles_are_not_degrees_per_second():
    model = {"name": "model", "length": 2.0}
    azimuth = vessel_from_dict({**model, "thruster": [{**AZIMUTH, "angle_rate": 12}]})
    assert "angle_rate of thruster 1 is 12 rad/s" in azimuth.doubts[0]
    quick = vessel_from_dict({**model, "thruster": [{**RUDDER, "rudder_rate": 3}]})
    assert "write radians, 0.05236 if 3 deg/s is meant" in quick.doubts[0]
    for rate in (0.3, 1.0):
        slow = vessel_from_dict({**model, "thruster": [{**RUDDER, "rudder_rate": rate}]})
        assert not slow.doubts


def test_a_rudder_ahead_of_the_origin_is_asked_about():
    (doubt,) = vessel({**RUDDER, "x": 14.0}).doubts
    assert "x = 14 m, ahead of the origin: sign of x?" in doubt
    assert not vessel(RUDDER).doubts
    assert not vessel({**AZIMUTH, "x": 14.0}).doubts


def test_two_thrusters_at_one_place_are_asked_about():
    port = {"type": "fixed", "x": -0.85, "y": -0.41, "speed": "left"}
    (doubt,) = vessel(port, {**port, "speed": "right"}).doubts
    assert "thrusters 1 and 2 stand at one place, x = -0.85 m and y = -0.41 m: sign of y?" in doubt
    assert not vessel(port, {**port, "y": 0.41, "speed": "right"}).doubts
    # in line, as contrarotating propellers are; and two of one column
    assert not vessel({**port, "y": 0.0}, {**port, "y": 0.0, "speed": "right"}).doubts
    assert not vessel(port, port).doubts


def test_noise_in_degrees_is_asked_about():
    made = {"name": "model", "length": 2.0, "thruster": [RUDDER]}
    first, second = vessel_from_dict({**made, "sensors": {"heading_std": 0.3, "r_std": 0.2}}).doubts
    assert "heading_std is 0.3 rad, which is 17.2 deg: write radians, 0.005236" in first
    assert "0.003491 if 0.2 deg/s is meant" in second
    assert not vessel_from_dict({**made, "sensors": {"heading_std": 0.01, "r_std": 0.004}}).doubts
    with pytest.raises(VesselError, match=r"heading_std in .* '0.3 deg', .* 0.005236 for 0.3 deg"):
        vessel_from_dict({**made, "sensors": {"heading_std": "0.3 deg"}})


def test_an_angle_of_a_fixed_thruster_is_in_radians():
    fixed = {"type": "fixed", "x": -0.85, "speed": "n"}
    with pytest.raises(VesselError, match=r"angle of thruster 1 is 180 rad, .* 3\.142 for 180 deg"):
        vessel({**fixed, "angle": 180})
    with pytest.raises(VesselError, match=r"in radians: 3\.142 for 180 deg"):
        vessel({**fixed, "angle": "180 deg"})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rudder_limits": ["-35 deg", "35 deg"]}, "is '-35 deg', .* in radians: -0.6109 for -35"),
        ({"rudder_limits": [-0.6, "35°"]}, "in radians: 0.6109 for 35°"),
        ({"rudder_rate": "3 deg/s"}, "in radians: 0.05236 for 3 deg/s"),
        ({"rudder_limits": [-0.6, "far"]}, "a finite number is needed"),
        ({"speed_limits": [0, "35 deg"]}, "a finite number is needed"),
    ],
)
def test_angles_are_written_in_radians(change, message):
    with pytest.raises(VesselError, match=message):
        vessel({**RUDDER, **change})


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"columns": {"gnss": {"heading": "psi"}}}, "A name with a dot is written in quotes"),
        ({"columns": {"x": "psy"}}, "Did you mean 'psi'"),
        ({"columns": {"x": {"unit": "deg"}}}, "column 'x' has no 'name'"),
        ({"columns": {"x": {"name": "psi", "sign": True}}}, "sign = True: write 1, or -1"),
        ({"columns": {"x": 3}}, "column 'x' is not a table but 3"),
        ({"sensors": 3}, "\\[sensors\\] is not a table but 3"),
        ({"mass": -1}, "mass is -1, it must be positive"),
        ({"length": 10**5000}, "length is an integer too large to be read, a finite number"),
        ({"name": ["long"] * 100}, "name is \\['long', .{1,60}…, a word in quotes"),
        ({"columns": {"x": {"name": "psy", "unit": "deg"}}}, "Did you mean 'psi'"),
        ({"columns": {"x": {"name": "psi", "unit": "degre"}}}, "unknown unit 'degre'"),
        ({"columns": {"x": {"name": "psi", "unit": "m"}}}, "of the same dimension"),
        ({"sensors": {"heding_std": 1}}, "Did you mean 'heading_std'"),
        ({"sensors": {"antenna": [1]}}, "needs 2 numbers"),
        ({"sensors": {"u_std": -1}}, "cannot be negative"),
        ({"lenght": 3}, "Did you mean 'length'"),
        ({"closed_loop": {"column": 3}}, "needs column ="),
        ({"actuation": {"lag": -1}}, "lag of \\[actuation\\] is -1 s, it must be zero or positive"),
        ({"actuation": {"delay": math.inf}}, "delay of \\[actuation\\] is inf, a finite number"),
        ({"actuation": {"lag_on": "forc"}}, "Did you mean 'force'"),
        ({"actuation": {"lagg": 1}}, "Did you mean 'lag'"),
        (
            {"actuation": {"lag_on": "nn"}},
            "'nn'. Did you mean 'n'\\? Use force, speed, angle, command or a",
        ),
        ({"actuation": {"delay_on": "m"}}, "a column that moves a thruster: n, a"),
        ({"actuation": {"rate_limit": 1, "rate_on": "b"}}, "rate_on of \\[actuation\\] is 'b'"),
        ({"actuation": {"rate_limit": 1}}, "has rate_limit but no rate_on"),
        ({"actuation": {"rate_on": "n"}}, "has rate_on but no rate_limit"),
        ({"actuation": {"rate_limit": 0, "rate_on": "n"}}, "is 0, it must be positive"),
    ],
)
def test_bad_vessels(more, message):
    with pytest.raises(VesselError, match=message):
        vessel(AZIMUTH, **more)


def test_what_cannot_be_built_in_code_either():
    with pytest.raises(VesselError, match="gain of the thruster driven by 'n' is inf"):
        Thruster("tunnel", 0.0, 0.0, "n", gain=math.inf)
    with pytest.raises(VesselError, match="a quadratic thrust law has quadratic_share"):
        ThrustLaw("quadratic", quadratic_share=0.5)
    with pytest.raises(VesselError, match="is nan s, it must be zero"):
        Actuation(lag=math.nan)


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
    bad.write_text(f"length = {'9' * 5000}")
    with pytest.raises(VesselError, match="is not TOML"):
        load_vessel(bad)
    bad.write_text("#" * 1_000_001)
    with pytest.raises(VesselError, match="has 1000001 bytes, a vessel file at most 1000000"):
        load_vessel(bad)
    with pytest.raises(VesselError, match="has no 'thruster'"):
        vessel_from_dict({"name": "x", "length": 3})
    with pytest.raises(VesselError, match="the vessel file is not a table but 3"):
        vessel_from_dict(3)


def test_each_wrong_value_is_one_sentence_of_bounded_length():
    """Any value at any place: an error in a sentence, or a vessel."""
    whole = {
        "name": "V", "length": 10.0, "mass": 3.0,
        "thruster": [
            {**AZIMUTH, "thrust": [[0.0, 1.0], [1.0, 2.0]], "speed_limits": [0, 1], "gain": 1.0},
            {"type": "propeller_rudder", "speed": "m", "rudder": "d", "rudder_rate": 1.0,
             "thrust": {"quadratic_share": 0.5, "reference": 2.0}},
        ],
        "columns": {"a.b": {"name": "u", "unit": "kn", "sign": -1}, "c": "t"},
        "sensors": {"antenna": [0, 1], "clock": {"u": 1.0}, "reversed": ["r"], "u_std": 0.1,
                    "velocities_from_heading": True},
        "closed_loop": {"column": "mode", "values": ["auto", 3]},
        "actuation": {"lag": 1.0, "lag_on": "speed"},
    }  # fmt: skip
    vessel_from_dict(whole)

    def places(node, path=()):
        yield path
        inside = enumerate(node) if isinstance(node, list) else node.items()
        for key, inner in inside:
            if isinstance(inner, dict | list):
                yield from places(inner, (*path, key))
            else:
                yield (*path, key)

    said = []
    for path in list(places(whole))[1:]:
        for value in (None, True, -1, 0, math.nan, 10**400, "", "x" * 5000, [], {}, [[]], {"k": 1}):
            copy = json.loads(json.dumps(whole))
            node = copy
            for key in path[:-1]:
                node = node[key]
            node[path[-1]] = value
            try:
                vessel_from_dict(copy)
            except VesselError as error:
                said.append(str(error))
    assert len(said) > 300
    # a word stands in full where a suggestion may follow
    assert max(map(len, said)) < 6000
    assert not any("\n" in s or "pydantic" in s for s in said)


@pytest.mark.parametrize("name", ["u", "n"])
def test_the_short_form_of_a_column_is_the_long_one_without_a_unit(name):
    v = vessel(AZIMUTH, columns={"topic.field": name, "b": {"name": "psi"}})
    assert v.columns["topic.field"] == ColumnMapping(name, None)
    assert vessel_from_dict(vessel_to_dict(v)) == v
    assert v == vessel(AZIMUTH, columns={"topic.field": {"name": name}, "b": "psi"})


def test_help_and_models_in_code_need_no_schema_library():
    code = "import sys, greybox.commands.main, greybox.model.model as m; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    assert b"greybox.vessel.toml" in loaded.stdout
    assert b"pydantic" not in loaded.stdout


def test_a_propeller_that_idles_for_most_of_its_logs_is_typically_as_fast_as_when_it_pushes():
    idle, at_work = np.full(900, 0.07), np.tile([30.0, -30.0], 50)
    assert typical_speed([idle, at_work]) == pytest.approx(30 / math.sqrt(10), rel=1e-3)
