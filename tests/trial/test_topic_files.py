"""Topics of ROS exported as one text file each: stamps, axes, names, clocks, and their merging."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pandas as pd
import pymap3d
import pytest

from greybox.errors import GreyboxError, LogError
from greybox.trial.checks.check import check_recording
from greybox.trial.checks.signal_quality import time_format_findings
from greybox.trial.convert.channel_mapping import read_recording, read_trial
from greybox.trial.convert.convert import import_recording
from greybox.trial.import_files import import_files
from greybox.trial.repair import apply_repairs
from greybox.vessel.force import generalised_force
from greybox.vessel.toml import load_vessel, vessel_from_dict

# 2025-04-11 09:15:45 UTC
EPOCH = 1744362945.3
ZONE = 7200.0
SHIP = {
    "name": "S",
    "length": 5,
    "thruster": [
        {
            "type": "azimuth", "x": x, "y": 0.0, "speed": f"n{k}", "angle": f"alpha{k}",
            "thrust": [[-900.0, -300.0], [0.0, 0.0], [900.0, 300.0]],
        }
        for k, x in ((1, 1.8), (2, -1.8))
    ],
    "columns": {
        "mot1.motor_speed": {"name": "n1", "unit": "rpm"},
        "mot2/motor_speed": {"name": "n2", "unit": "rpm"},
        "az1.data": {"name": "alpha1", "unit": "deg"},
        "az2": {"name": "alpha2", "unit": "deg"},
    },
    "closed_loop": {"column": "mode.data", "values": ["dp"]},
}  # fmt: skip
VESSEL = vessel_from_dict(SHIP)


def sailed(seconds=120.0, dt=0.1, seed=0):
    """Return the truth of a ship whose thrusters move it, with no preferred course."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, dt)
    held = np.arange(len(t)) // 80
    drive = {
        name: rng.uniform(low, high, held.max() + 1)[held]
        for name, low, high in (("n1", -700, 700), ("n2", -700, 700), ("alpha1", 0.3, 2.6),
                                ("alpha2", -2.6, -0.3))
    }  # fmt: skip
    tau = generalised_force(VESSEL, drive)
    x = np.zeros((len(t), 6))
    x[0, 2] = -0.7
    for k in range(len(t) - 1):
        _, _, psi, u, v, r = x[k]
        c, s = np.cos(psi), np.sin(psi)
        rates = (
            c * u - s * v, s * u + c * v, r,
            (tau["taux"][k] - 150 * u) / 2000 + v * r, (tau["tauy"][k] - 250 * v) / 2500 - u * r,
            (tau["taun"][k] - 1500 * r) / 5000,
        )  # fmt: skip
        x[k + 1] = x[k] + dt * np.array(rates)
    return {"t": t, **dict(zip(("x_n", "y_n", "psi", "u", "v", "r"), x.T, strict=True)), **drive}


def stamps(t, zone=ZONE, padded=True):
    """Return UNIX times as a recorder in a time zone writes them, to the nanosecond."""
    ns = np.round(np.asarray(t) * 1e6).astype(np.int64) * 1000 + int(zone) * 10**9
    whole = pd.to_datetime(ns // 10**9, unit="s").strftime("%Y/%m/%d %H:%M:%S")
    part = ns % 10**9
    return [f"{w}.{p:09d}" if padded else f"{w}.{p}" for w, p in zip(whole, part, strict=True)]


def header(t, frame):
    ns = np.round(np.asarray(t) * 1e6).astype(np.int64) * 1000
    return {
        "header_stamp_secs": ns // 10**9,
        "header_stamp_nsecs": ns % 10**9,
        "header_frame_id": [frame] * len(t),
    }


def quaternion(yaw):
    zero = np.zeros_like(yaw)
    return {"x": zero, "y": zero, "z": np.sin(yaw / 2), "w": np.cos(yaw / 2)}


def topics(ship, *, heading="ned", velocity="enu", frame="hemisphere", padded=True, delay=1e-3):
    """Return one table a topic."""
    t = EPOCH + ship["t"]
    psi = ship["psi"]
    north = np.cos(psi) * ship["u"] - np.sin(psi) * ship["v"]
    east = np.sin(psi) * ship["u"] + np.cos(psi) * ship["v"]
    first, second = {
        "enu": (east, north),
        "ned": (north, east),
        "flu": (ship["u"], -ship["v"]),
        "frd": (ship["u"], ship["v"]),
    }[velocity]
    lat, lon, _ = pymap3d.ned2geodetic(ship["x_n"], ship["y_n"], 0 * psi, 63.44, 10.42, 0.0)
    q = quaternion(psi if heading == "ned" else np.pi / 2 - psi)

    def recorded(late, **columns):
        return pd.DataFrame({"time": stamps(t + late, padded=padded), **columns})

    n = len(t)
    return {
        "fix": recorded(
            delay, **header(t, frame), status_status=[0] * n, latitude=lat, longitude=lon,
            altitude=[43.8] * n,
        ),
        "heading": recorded(
            delay, **header(t, frame), **{f"quaternion_{k}": v for k, v in q.items()}
        ),
        "velocity": recorded(
            delay, **header(t, frame), twist_linear_x=first, twist_linear_y=second,
            twist_linear_z=0.0, twist_angular_x=0.0, twist_angular_y=0.0, twist_angular_z=0.0,
        ),
        "mot1": recorded(0.01, in_charge=[True] * n, motor_speed=ship["n1"]),
        "mot2": recorded(0.02, in_charge=[True] * n, motor_speed=ship["n2"]),
        "az1": recorded(0.01, data=np.degrees(ship["alpha1"])),
        "az2": recorded(0.02, data=np.degrees(ship["alpha2"])),
        "mode": recorded(0.0, data=["dp" if x > 60 else "manual" for x in ship["t"]]),
    }  # fmt: skip


def written(folder, tables):
    folder.mkdir(exist_ok=True)
    paths = []
    for name, table in tables.items():
        paths.append(folder / f"{name}.csv")
        table.to_csv(paths[-1], index=False)
    return paths


def step_of(recording, operation, channel=None):
    (step,) = [
        s
        for s in recording.steps
        if s.operation == operation and (channel is None or channel in s.channels)
    ]
    return step


def operations(recording):
    return {s.operation for s in recording.steps}


SHIP_RUN = sailed()


@pytest.mark.parametrize("backwards", [False, True])
def test_the_topics_of_a_trial_become_one_log(tmp_path, backwards):
    paths = written(tmp_path, topics(SHIP_RUN, padded=False))
    recording = read_trial(paths[::-1] if backwards else paths, VESSEL)
    assert recording.epoch == pytest.approx(EPOCH, abs=1e-3)
    zone = step_of(recording, "time_zone")
    assert zone.number("ahead") == ZONE
    assert set(zone.channels) == {"n1", "n2", "alpha1", "alpha2", "mode.data"}
    assert {(s.t[1:] > s.t[:-1]).all() for s in recording.signals} == {True}
    (log,) = import_recording(recording, VESSEL).segments
    at = log.t + recording.epoch - EPOCH

    def truth(name):
        return np.interp(at, SHIP_RUN["t"], SHIP_RUN[name])

    for name, atol in {"u": 2e-3, "v": 2e-3, "n1": 90.0, "alpha2": 0.2}.items():
        assert np.median(np.abs(log[name] - truth(name))) < atol, name
    turn = np.unwrap(log["psi"]) - truth("psi")
    np.testing.assert_allclose(turn, 2 * np.pi * np.round(turn[0] / (2 * np.pi)), atol=1e-3)
    assert log.loop_known
    assert np.sum(log.closed_loop != (at > 60)) <= 2


def test_rows_are_neither_sorted_nor_dropped_where_fractions_lost_their_zeros(tmp_path):
    tables = topics(SHIP_RUN, padded=False)
    recording = read_trial(written(tmp_path, tables), VESSEL)
    exact = read_trial(written(tmp_path / "exact", topics(SHIP_RUN)), VESSEL)
    assert "pad_fractions" in operations(recording) - operations(exact)
    for s in exact.signals:
        np.testing.assert_allclose(recording[s.name].t, s.t, atol=1e-6)
        np.testing.assert_array_equal(recording[s.name].value, s.value)


@pytest.mark.parametrize("velocity", ["enu", "ned", "flu", "frd"])
@pytest.mark.parametrize("heading", ["ned", "enu"])
def test_axes_that_no_frame_tells_are_decided_by_the_data(tmp_path, heading, velocity):
    paths = written(tmp_path, topics(SHIP_RUN, heading=heading, velocity=velocity))
    recording = read_trial(paths, VESSEL)
    axes = {"ned": "north-east-down", "enu": "east-north-up", "flu": "forward-left-up",
            "frd": "forward-right-down"}  # fmt: skip
    assert step_of(recording, "read_axes", "psi").parameters["axes"] == axes[heading]
    names = ("u", "v") if velocity in ("flu", "frd") else ("v_n", "v_e")
    assert step_of(recording, "read_axes", names[0]).parameters["axes"] == axes[velocity]
    np.testing.assert_allclose(np.sin(recording["psi"].value), np.sin(SHIP_RUN["psi"]), atol=1e-9)
    if names == ("u", "v"):
        np.testing.assert_allclose(recording["v"].value, SHIP_RUN["v"], atol=1e-9)


def test_a_heading_alone_is_read_as_ros_defines_it_and_said_to_be_so(tmp_path):
    tables = topics(SHIP_RUN, heading="enu")
    (path,) = written(tmp_path, {"heading": tables["heading"]})
    recording = read_recording(path, VESSEL)
    np.testing.assert_allclose(np.sin(recording["psi"].value), np.sin(SHIP_RUN["psi"]), atol=1e-9)
    step = step_of(recording, "read_axes")
    assert step.decided_by == "default"
    assert step.sentence in recording.notes


def test_the_course_tells_the_heading_where_no_thruster_does(tmp_path):
    ship = dict(SHIP_RUN)
    t = ship["t"]
    ship |= {"psi": 0.4 + 0.2 * np.sin(t / 9), "u": 1 + 0 * t, "v": 0 * t}
    ship["x_n"] = np.cumsum(np.cos(ship["psi"])) * 0.1
    ship["y_n"] = np.cumsum(np.sin(ship["psi"])) * 0.1
    for heading, axes in (("ned", "north-east-down"), ("enu", "east-north-up")):
        tables = topics(ship, heading=heading)
        kept = {n: tables[n] for n in ("fix", "heading")}
        recording = read_trial(written(tmp_path / heading, kept), VESSEL)
        step = step_of(recording, "read_axes")
        assert (step.parameters["axes"], step.decided_by) == (axes, "check")


@pytest.mark.parametrize(
    ("frame", "heading", "velocity"),
    [("map", "enu", "enu"), ("gps_ned", "ned", "ned"), ("world/ned", "ned", "ned")],
)
def test_frames_that_tell_their_axes_are_believed(tmp_path, frame, heading, velocity):
    tables = topics(SHIP_RUN, heading=heading, velocity=velocity, frame=frame)
    kept = {n: tables[n] for n in ("heading", "velocity")}
    recording = read_trial(written(tmp_path, kept), VESSEL)
    assert "read_axes" not in operations(recording)
    np.testing.assert_allclose(np.sin(recording["psi"].value), np.sin(SHIP_RUN["psi"]), atol=1e-9)
    if frame != "gps_ned":
        north = np.cos(SHIP_RUN["psi"]) * SHIP_RUN["u"] - np.sin(SHIP_RUN["psi"]) * SHIP_RUN["v"]
        np.testing.assert_allclose(recording["v_n"].value, north, atol=1e-9)


SPELLED = {
    "flat": ("header_stamp_secs", "header_stamp_nsecs"),
    "dotted": ("header.stamp.secs", "header.stamp.nsecs"),
    "ros 2": ("header.stamp.sec", "header.stamp.nanosec"),
    "bare": ("secs", "nsecs"),
    "path": (".header.stamp.sec", ".header.stamp.nanosec"),
}


@pytest.mark.parametrize("how", SPELLED)
def test_the_header_stamp_is_the_time_however_it_is_spelled(tmp_path, how):
    table = topics(SHIP_RUN)["fix"]
    named = dict(zip(("header_stamp_secs", "header_stamp_nsecs"), SPELLED[how], strict=True))
    (path,) = written(tmp_path, {"fix": table.rename(columns=named)})
    recording = read_recording(path, VESSEL)
    np.testing.assert_allclose(
        recording["lat"].t + recording.epoch, EPOCH + SHIP_RUN["t"], atol=1e-5
    )


def test_rows_as_rostopic_echoes_them(tmp_path):
    t = EPOCH + SHIP_RUN["t"]
    ns = np.round(t * 1e6).astype(np.int64) * 1000
    q = quaternion(np.pi / 2 - SHIP_RUN["psi"])
    table = pd.DataFrame(
        {
            "%time": ns + 700_000, "field.header.seq": np.arange(len(t)),
            "field.header.stamp": ns, "field.header.frame_id": "odom",
            "field.child_frame_id": "base_link",
            "field.pose.pose.position.x": SHIP_RUN["y_n"],
            "field.pose.pose.position.y": SHIP_RUN["x_n"],
            **{f"field.pose.pose.orientation.{k}": v for k, v in q.items()},
            "field.twist.twist.linear.x": SHIP_RUN["u"],
            "field.twist.twist.linear.y": -SHIP_RUN["v"],
            "field.twist.twist.angular.z": -SHIP_RUN["r"],
        }
    )  # fmt: skip
    (path,) = written(tmp_path, {"odom": table})
    recording = read_recording(path, VESSEL)
    for name in ("x_n", "y_n", "u", "v", "r"):
        np.testing.assert_allclose(recording[name].value, SHIP_RUN[name], atol=1e-9)
    np.testing.assert_allclose(np.cos(recording["psi"].value), np.cos(SHIP_RUN["psi"]), atol=1e-9)
    np.testing.assert_allclose(recording["u"].t + recording.epoch, t, atol=1e-5)


@pytest.mark.parametrize("delay", [1e-3, 0.3, 5.0])
def test_a_recorder_that_is_late_is_in_no_other_time_zone(tmp_path, delay):
    tables = topics(SHIP_RUN, delay=delay)
    for name in ("fix", "heading", "velocity", "az1"):
        tables[name]["time"] = stamps(EPOCH + SHIP_RUN["t"] + delay, zone=0.0)
    kept = {n: tables[n] for n in ("fix", "heading", "velocity", "az1")}
    recording = read_trial(written(tmp_path, kept), VESSEL)
    assert "time_zone" not in operations(recording)
    assert recording["lat"].t[0] + recording.epoch == pytest.approx(EPOCH, abs=1e-5)
    assert recording["alpha1"].t[0] + recording.epoch == pytest.approx(EPOCH + delay, abs=1e-5)


def test_headers_of_another_clock_are_not_the_time(tmp_path):
    table = topics(SHIP_RUN)["fix"]
    table["header_stamp_secs"] -= 5000
    (path,) = written(tmp_path, {"fix": table})
    recording = read_recording(path, VESSEL)
    assert recording.epoch == pytest.approx(EPOCH + ZONE, abs=0.01)
    assert any("12200" in n for n in recording.notes)


def test_headers_that_nobody_stamped_leave_no_times(tmp_path):
    table = topics(SHIP_RUN)["fix"]
    table.loc[:, ["header_stamp_secs", "header_stamp_nsecs"]] = 0
    (path,) = written(tmp_path, {"fix": table})
    assert read_recording(path, VESSEL).epoch == pytest.approx(EPOCH + ZONE, abs=0.01)


def test_messages_without_a_fix_hold_no_position(tmp_path):
    table = topics(SHIP_RUN)["fix"]
    table.loc[10:19, "status_status"] = -1
    (path,) = written(tmp_path, {"fix": table})
    recording = read_recording(path, VESSEL)
    assert np.flatnonzero(np.isnan(recording["lat"].value)).tolist() == list(range(10, 20))


def test_what_is_no_place_on_earth_is_no_position(tmp_path):
    table = topics(SHIP_RUN)["fix"]
    table.loc[3, "latitude"] = np.inf
    table.loc[5, "longitude"] = 1e9
    paths = written(tmp_path, {"fix": table})
    (log, *_) = import_recording(read_trial(paths, VESSEL), VESSEL).segments
    assert np.abs(log["x_n"]).max() < 100
    table["longitude"] = np.nan
    with pytest.raises(LogError, match="no position"):
        import_recording(read_trial(written(tmp_path, {"fix": table}), VESSEL), VESSEL)


def two_files(folder, apart):
    t = SHIP_RUN["t"]
    motion = pd.DataFrame(
        {"time": stamps(EPOCH + t, zone=0.0), "north": SHIP_RUN["x_n"], "east": SHIP_RUN["y_n"],
         "heading": SHIP_RUN["psi"]}
    )  # fmt: skip
    thrusters = pd.DataFrame(
        {"time": stamps(EPOCH + t + 0.02, zone=apart), "n1": SHIP_RUN["n1"], "n2": SHIP_RUN["n2"],
         "alpha1": SHIP_RUN["alpha1"], "alpha2": SHIP_RUN["alpha2"]}
    )  # fmt: skip
    return written(folder, {"gnss": motion, "thrusters": thrusters})


PLAIN = replace(VESSEL, columns={}, closed_loop=None)


@pytest.mark.parametrize("zone", [3600.0, -19800.0, 900.0])
@pytest.mark.parametrize("backwards", [False, True])
def test_files_of_two_time_zones_are_one_trial(tmp_path, zone, backwards):
    paths = two_files(tmp_path, zone)
    recording = read_trial(paths[::-1] if backwards else paths, PLAIN)
    assert step_of(recording, "time_zone").number("ahead") == zone
    assert recording.epoch == pytest.approx(EPOCH, abs=1e-3)
    assert recording["n1"].t[0] == pytest.approx(0.02, abs=1e-5)


@pytest.mark.parametrize("apart", [1234.0, 400.0, 20 * 3600.0])
def test_files_whose_clocks_contradict_each_other_are_refused(tmp_path, apart):
    with pytest.raises(LogError, match=r"2025-04-11 09:15:45.* no time zone") as error:
        read_trial(two_files(tmp_path, apart), PLAIN)
    assert f"{apart:.0f}" in str(error.value)


@pytest.mark.parametrize(("last", "told"), [(1e12, "1e+12 s"), (1e300, "2025-04-22 23:04:2")])
def test_times_beyond_every_calendar_are_refused_with_the_number(tmp_path, last, told):
    """One that no clock counts in any unit is no time: the clock is told without it."""
    paths = two_files(tmp_path, 400.0)
    table = pd.read_csv(paths[1])
    table["time"] = EPOCH + 1e6 + SHIP_RUN["t"]
    table.loc[len(table) - 1, "time"] = last
    table.to_csv(paths[1], index=False)
    with pytest.raises(LogError, match="no time zone") as error:
        read_trial(paths, PLAIN)
    assert told in str(error.value)


def test_two_zones_of_recorders_are_refused(tmp_path):
    tables = topics(SHIP_RUN)
    tables["fix"]["time"] = stamps(EPOCH + SHIP_RUN["t"], zone=3600.0)
    with pytest.raises(LogError, match=r"1 h ahead .* 2 h"):
        read_trial(written(tmp_path, tables), VESSEL)


@pytest.mark.parametrize("backwards", [False, True])
def test_thrusters_of_their_own_file_need_no_motion(tmp_path, backwards):
    paths = two_files(tmp_path, 0.0)
    recording = read_trial(paths[::-1] if backwards else paths, PLAIN)
    assert {"x_n", "psi", "n1", "alpha2"} <= set(recording.names)
    assert not any("was recognised" in n for n in recording.notes)
    alone = read_recording(paths[1], PLAIN)
    assert any("no position, heading or velocity was recognised" in n for n in alone.notes)


def test_a_file_that_tells_nothing_is_left_out(tmp_path):
    paths = two_files(tmp_path, 0.0)
    other = pd.DataFrame({"time": stamps(EPOCH + SHIP_RUN["t"]), "humidity": 0.0})
    recording = read_trial([*paths, *written(tmp_path, {"air": other})], PLAIN)
    assert any(n == "air: no column but its time is known" for n in recording.notes)
    with pytest.raises(LogError, match=r"no column of the 2 files .* 'air\.column'"):
        read_trial(written(tmp_path, {"air": other, "water": other}), PLAIN)


@pytest.mark.parametrize("name", ["az1.data", "az1/data", "az1", "data"])
def test_a_column_may_be_named_with_its_file(tmp_path, name):
    ship = {**SHIP, "columns": {name: {"name": "alpha1", "unit": "deg"}}}
    (path,) = written(tmp_path, {"az1": topics(SHIP_RUN)["az1"]})
    recording = read_recording(path, vessel_from_dict(ship))
    np.testing.assert_allclose(recording["alpha1"].value, SHIP_RUN["alpha1"])


def test_thruster_columns_may_be_named_with_their_file(tmp_path):
    ship = {"name": "S", "length": 5, "thruster": [
        {"type": "azimuth", "speed": "mot1.motor_speed", "angle": "az1.data"}]}  # fmt: skip
    tables = topics(SHIP_RUN)
    paths = written(tmp_path, {n: tables[n] for n in ("mot1", "az1")})
    recording = read_trial(paths, vessel_from_dict(ship))
    np.testing.assert_array_equal(recording["mot1.motor_speed"].value, SHIP_RUN["n1"])
    # degrees, as the values show
    np.testing.assert_allclose(recording["az1.data"].value, SHIP_RUN["alpha1"])


def test_what_the_vessel_file_maps_is_not_read_once_more(tmp_path):
    columns = {
        "velocity.twist_linear_x": {"name": "v_e", "unit": "m/s"},
        "velocity.twist_linear_y": {"name": "v_n", "unit": "m/s"},
    }
    (path,) = written(tmp_path, {"velocity": topics(SHIP_RUN)["velocity"]})
    recording = read_recording(path, vessel_from_dict({**SHIP, "columns": columns}))
    assert set(recording.names) == {"v_n", "v_e"}


def test_components_are_not_guessed_as_positions(tmp_path):
    tables = topics(SHIP_RUN)
    table = tables["velocity"].rename(columns=lambda c: c.replace("twist_linear_", "twist.linear."))
    (path,) = written(tmp_path, {"velocity": table})
    assert not {"x_n", "y_n"} & set(read_recording(path, VESSEL).names)


# fractions of a second without their leading zeros


def wrong_second(t, digits, second):
    """Return times of which those of one second are written without leading zeros."""
    scale = 10**digits
    units = np.round(t * scale).astype(np.int64)
    texts = []
    for x in units:
        whole, part = divmod(int(x), scale)
        bare = whole - int(t[0]) == second
        texts.append((whole, f"{part}" if bare else f"{part:0{digits}d}"))
    return units / scale, texts


def log_of(texts, folder, as_date):
    if as_date:
        base = pd.Timestamp("2024-05-01")
        times = [f"{base + pd.Timedelta(seconds=w):%Y-%m-%d %H:%M:%S}.{p}" for w, p in texts]
    else:
        times = [f"{w}.{p}" for w, p in texts]
    n = len(times)
    rng = np.random.default_rng(0)
    width = max(len(p) for _, p in texts)
    t = np.array([float(f"{w}.{p:0>{width}}") for w, p in texts])
    psi, u = 0.3 * np.sin(t / 7), 2 + 0.2 * np.sin(t / 5)
    dt = np.diff(t, prepend=t[0])
    columns = {"x_n": np.cumsum(u * np.cos(psi) * dt), "y_n": np.cumsum(u * np.sin(psi) * dt),
               "psi": psi, "u": u, "v": 0 * t}  # fmt: skip
    noisy = {c: x + rng.normal(size=n) * 1e-3 for c, x in columns.items()}
    table = pd.DataFrame({"t": times, **noisy})
    (path,) = written(folder, {"log": table})
    return path


@pytest.mark.parametrize("as_date", [True, False])
@pytest.mark.parametrize("digits", [3, 6])
@pytest.mark.parametrize(
    "rate", [10, pytest.param(20, marks=pytest.mark.long), pytest.param(50, marks=pytest.mark.long)]
)
def test_one_second_of_wrong_fractions_is_found_and_mended(tmp_path, as_date, digits, rate):
    rng = np.random.default_rng(rate + digits)
    t = 100.013 + np.arange(60 * rate) / rate + rng.uniform(-0.1, 0.1, 60 * rate) / rate
    true, texts = wrong_second(t, digits, 31)
    wrong = [k for k, (w, p) in enumerate(texts) if len(p) < digits]
    path = log_of(texts, tmp_path, as_date)
    recording = read_recording(path, PLAIN)
    report = check_recording(recording, PLAIN)
    (finding,) = [f for f in report.findings if f.id == "time_format"]
    assert finding.safe
    assert finding.value == len(wrong)
    assert not [f for f in report.findings if f.id in ("duplicate_time", "outlier", "gap")]
    zero = 0.0 if recording.epoch is None else true[0]
    np.testing.assert_allclose(finding.picture["meant"] + zero, true[wrong], atol=2e-6)
    assert (finding.picture["written"] > finding.picture["meant"]).all()
    mended = apply_repairs(recording, [finding])
    np.testing.assert_allclose(mended["u"].t + zero, true, atol=2e-6)
    again = check_recording(replace(mended, steps=()), PLAIN)
    assert "time_format" not in {f.id for f in again.findings}


def test_numbers_are_mended_by_fix_and_named_without_it(tmp_path):
    t = 100.013 + np.arange(1200) / 20
    _, texts = wrong_second(t, 3, 31)
    path = log_of(texts, tmp_path, as_date=False)
    said = import_files([path], PLAIN, tmp_path / "a.csv")
    assert "put in order; 2 times lack the leading zeros" in said
    import_files([path], PLAIN, tmp_path / "b.csv", fix=True)
    log = pd.read_csv(tmp_path / "b.csv")
    # the rate of turn costs the first and the last
    assert len(log) == len(t) - 2
    steps = np.hypot(np.diff(log["x_n"]), np.diff(log["y_n"]))
    np.testing.assert_allclose(steps, 0.1, atol=0.02)


def disturbed(kind, rng):
    """Return times to the millisecond that are wrong in another way, or in none."""
    rate = rng.choice([5, 10, 20, 50])
    n = 60 * rate
    t = np.arange(n) / rate + rng.uniform(0, 1) + rng.normal(0, 0.05 / rate, n)
    t = np.sort(t)
    if kind == "dropped rows":
        t = np.delete(t, rng.integers(1, n - 1, n // 20))
    elif kind == "rows exchanged":
        for k in rng.integers(1, n - 2, 6):
            t[[k, k + 1]] = t[[k + 1, k]]
    elif kind == "bursts":
        for k in rng.integers(5, n - 15, 4):
            t[k : k + 5] = t[k + 5] - 1e-3 * np.arange(5, 0, -1)
    return np.round(t, 3)


@pytest.mark.parametrize("kind", ["jitter", "dropped rows", "rows exchanged", "bursts"])
@pytest.mark.parametrize("as_date", [True, False])
@pytest.mark.parametrize("stripped", [True, pytest.param(False, marks=pytest.mark.long)])
def test_times_that_are_wrong_otherwise_have_their_zeros(tmp_path, kind, as_date, stripped):
    rng = np.random.default_rng([len(kind), as_date, stripped])
    for _ in range(3):
        t = disturbed(kind, rng)
        texts = [divmod(int(x), 1000) for x in np.round(t * 1000)]
        texts = [(w, f"{p:03d}") for w, p in texts]
        if stripped:
            texts = [(w, p.rstrip("0") or "0") for w, p in texts]
        recording = read_recording(log_of(texts, tmp_path, as_date), PLAIN)
        assert time_format_findings(recording) == []


# damage


def damaged(lines, rng):
    lines = list(lines)
    for _ in range(rng.choice([1, 2, 10])):
        k = rng.randrange(len(lines))
        cells = lines[k].split(b",")
        how = rng.randrange(5)
        if how == 0:
            lines[k] = lines[k][: rng.randrange(len(lines[k]) + 1)]
        elif how == 1:
            i = rng.randrange(len(lines[k]) + 1)
            lines[k] = lines[k][:i] + bytes([rng.randrange(256)]) + lines[k][i + 1 :]
        elif how == 2:
            rng.shuffle(cells)
            lines[k] = b",".join(cells)
        elif how == 3:
            cells[rng.randrange(len(cells))] = rng.choice([b"", b"nan", b"1e999", b'"', b"x" * 300])
            lines[k] = b",".join(cells)
        else:
            lines = lines[: rng.randrange(1, len(lines) + 1)]
    return b"\n".join(lines)


@pytest.mark.parametrize("name", ["fix", "heading", "velocity", "az1"])
def test_damaged_files_give_a_log_or_one_sentence(tmp_path, name):
    ship = {k: v[:80] for k, v in SHIP_RUN.items()}
    (path,) = written(tmp_path, {name: topics(ship)[name]})
    lines = path.read_bytes().split(b"\n")
    rng = random.Random(name)
    for _ in range(12):
        path.write_bytes(damaged(lines, rng))
        said = ""
        try:
            said = " ".join(read_trial([path], VESSEL).names)
        except GreyboxError as error:
            said = str(error)
        assert said
        assert "\n" not in said


# real topics


def test_a_ferrys_topics_in_one_command(data_folder):
    folder = data_folder / "milliampere1" / "nlp1"
    if not folder.is_dir():
        pytest.skip(f"no topics in {folder}")
    ferry = load_vessel("ferry")
    recording = read_trial(sorted(folder.glob("*.csv")), ferry)
    assert step_of(recording, "time_zone").number("ahead") == ZONE
    # found by hand: the response to the thrusters, and the displacement of the antenna
    assert step_of(recording, "read_axes", "psi").parameters["axes"] == "north-east-down"
    assert step_of(recording, "read_axes", "v_n").parameters["axes"] == "east-north-up"
    assert {(s.t[1:] > s.t[:-1]).all() for s in recording.signals} == {True}
    imported = import_recording(recording, ferry)
    assert sum(len(s) for s in imported.segments) * imported.segments[0].sample_time > 480
    assert {"n1", "alpha4", "n1_ref", "alpha4_ref"} <= set(imported.segments[0].channels)
