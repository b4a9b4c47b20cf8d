"""Commands beside feedback: named in the vessel file, imported, kept, written and read again."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from greybox.diagnosis.extension import extended_vessel
from greybox.diagnosis.ship import Sensors
from greybox.errors import VesselError
from greybox.trial.convert.read import read_log
from greybox.trial.import_files import import_files
from greybox.trial.kinematics import decimate
from greybox.trial.log import make_log
from greybox.vessel.toml import vessel_from_dict, vessel_to_dict
from greybox.vessel.vessel import Actuator, Limits

AZIMUTH = {
    "type": "azimuth", "x": 2.0, "speed": "n", "angle": "a", "speed_command": "n_ref",
    "angle_command": "a_ref", "speed_limits": [-9, 9], "angle_rate": 0.2,
}  # fmt: skip
RUDDER = {
    "type": "propeller_rudder", "x": -5, "speed": "m", "rudder": "d", "rudder_command": "d_ref",
}  # fmt: skip


def vessel(*thrusters, **more):
    return vessel_from_dict({"name": "V", "length": 10, "thruster": list(thrusters), **more})


@pytest.mark.parametrize("drive", ["feedback", "command"])
def test_each_pair_is_an_actuator_whatever_drives(drive):
    v = vessel({**AZIMUTH, "drive": drive}, RUDDER)
    assert v.actuators == (
        Actuator(1, "speed", "n_ref", "n", Limits(-9, 9)),
        Actuator(1, "angle", "a_ref", "a", Limits(rate=0.2)),
        Actuator(2, "rudder", "d_ref", "d", Limits()),
    )
    assert [a.angular for a in v.actuators] == [False, True, True]
    assert set(v.recorded_columns) == {"n", "a", "n_ref", "a_ref", "m", "d", "d_ref"}
    assert v.recorded_columns[: len(v.commands)] == v.commands
    assert v.recorded_angles == {"a", "a_ref", "d", "d_ref"}
    assert vessel_from_dict(json.loads(json.dumps(vessel_to_dict(v)))) == v


def test_columns_that_thrusters_share_are_one_actuator():
    """A lever for two shafts, and two thrusters that name the same pair."""
    shaft = {"type": "fixed", "speed_command": "lever"}
    v = vessel(
        {**shaft, "speed": "port"}, {**shaft, "speed": "starboard"}, {**shaft, "speed": "port"}
    )
    assert [(a.thruster, a.command, a.feedback) for a in v.actuators] == [
        (1, "lever", "port"), (2, "lever", "starboard"),
    ]  # fmt: skip
    led = vessel(
        {**shaft, "speed": "port", "drive": "command"},
        {**shaft, "speed": "starboard", "drive": "command"},
    )
    assert led.commands == ("lever",)
    assert led.actuators == v.actuators
    assert vessel_from_dict(vessel_to_dict(led)) == led


def raw_trial(path, **changed):
    """Sixty seconds at 10 Hz, angles in degrees and wrapped, commands one second ahead."""
    t = np.arange(600) / 10
    turn = 170.0 + 0.5 * t
    columns = {
        "t": t, "x_n": 2 * t, "y_n": 0 * t, "psi": 0.01 * t, "n": np.sin(t - 1), "a": turn,
        "n_ref": np.sin(t), "a_ref": turn + 0.5,
    }  # fmt: skip
    frame = pd.DataFrame(columns | changed)
    for name in ("a", "a_ref"):
        if name in frame:
            frame[name] = (frame[name] + 180) % 360 - 180
    frame.dropna(axis=1, how="all").to_csv(path, index=False)
    return t


MAPPED = {n: {"name": n, "unit": "deg"} for n in ("a", "a_ref")}


@pytest.mark.parametrize("drive", ["feedback", "command"])
def test_import_keeps_both_and_turns_their_angles(tmp_path, drive):
    v = vessel({**AZIMUTH, "drive": drive}, columns=MAPPED)
    raw, out = tmp_path / "raw.csv", tmp_path / "log.csv"
    raw_trial(raw)
    import_files([raw], v, out)
    log = read_log(out, v)
    for name, ahead in (("a", 0.0), ("a_ref", 0.5)):
        np.testing.assert_allclose(log[name], np.radians(170 + 0.5 * log.t + ahead), atol=1e-9)
        assert log.units[name] == "rad"
    np.testing.assert_allclose(log["n_ref"], np.sin(log.t), atol=1e-9)
    np.testing.assert_allclose(log["n"], np.sin(log.t - 1), atol=1e-9)
    strict = read_log(raw, v)
    np.testing.assert_allclose(strict["a_ref"], np.radians(170.5 + 0.5 * strict.t), atol=1e-9)
    slow = decimate(log, 1.0)
    assert set(slow.channels) == set(log.channels)
    # held until the next sample, as the inputs that drive
    np.testing.assert_allclose(slow["n_ref"][0], log["n_ref"][log.t >= slow.t[0]][:10].mean())


def test_a_log_without_the_other_column_is_a_log(tmp_path):
    v = vessel(AZIMUTH, columns=MAPPED)
    raw, out = tmp_path / "raw.csv", tmp_path / "log.csv"
    t = raw_trial(raw, n_ref=np.nan, a_ref=np.nan)
    import_files([raw], v, out)
    for path in (raw, out):
        log = read_log(path, v)
        assert {"n", "a"} <= set(log.channels)
        assert not {"n_ref", "a_ref"} & set(log.channels)
    assert abs(len(log) - len(t)) <= 2


def test_holes_of_the_other_column_do_not_cut_the_log(tmp_path):
    v = vessel(AZIMUTH, columns=MAPPED)
    raw, out = tmp_path / "raw.csv", tmp_path / "log.csv"
    t = raw_trial(raw)
    frame = pd.read_csv(raw)
    frame.loc[(t > 20) & (t < 40), "n_ref"] = np.nan
    frame.loc[t > 50, "a_ref"] = np.nan
    frame.to_csv(raw, index=False)
    summary = import_files([raw], v, out)
    assert "1 segment" in summary
    assert len(read_log(out, v)) >= len(t) - 2
    assert not {"n_ref", "a_ref"} & set(read_log(raw, v).channels)


def test_columns_exchanged_by_a_diagnosis_take_their_commands_along():
    v = vessel(
        {"type": "fixed", "y": -1, "speed": "p", "speed_command": "p_ref"},
        {"type": "fixed", "y": 1, "speed": "s", "speed_command": "s_ref"},
    )
    log = make_log(v, {"p": np.zeros(3), "s": np.zeros(3)}, 1.0)
    got = extended_vessel(v, Sensors(), [("p", "s", 1.0), ("s", "p", 1.0)], log)
    assert [(a.thruster, a.command, a.feedback) for a in got.actuators] == [
        (1, "s_ref", "s"), (2, "p_ref", "p"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"speed_command": "n"}, "the column 'n' both as 'speed' and as 'speed_command'"),
        ({"angle_command": "a"}, "the column 'a' both as 'angle' and as 'angle_command'"),
    ],
)
def test_one_column_is_not_both(change, message):
    with pytest.raises(VesselError, match=message):
        vessel({**AZIMUTH, **change})
