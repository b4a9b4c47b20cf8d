"""A log recorded with a defect, and a vessel file that says so, give the log without it."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest

from greybox.errors import LogError, VesselError
from greybox.trial.convert.convert import import_recording
from greybox.trial.convert.read import read_log, read_segments
from greybox.trial.convert.sensor_corrections import correct_channels, correct_log
from greybox.trial.dataframe import recording_from_pandas
from greybox.trial.import_files import import_files
from greybox.trial.log import make_log
from greybox.trial.steps import mend
from greybox.trial.store import write_log
from greybox.vessel.toml import vessel_from_dict, vessel_to_dict

STEP = 0.1
SHIP = {"name": "S", "length": 5, "thruster": [{"type": "azimuth", "speed": "n", "angle": "a"}]}


def ship(**sensors):
    return vessel_from_dict(SHIP | {"sensors": sensors})


def signals(late=None, n=600):
    """A weaving ship by formula; channels named in `late` as their sensors give them."""

    def at(name):
        t = np.arange(n) * STEP - (late or {}).get(name, 0.0)
        return {
            "psi": 0.7 * np.sin(0.2 * t) + 0.05 * t,
            "r": 0.14 * np.cos(0.2 * t) + 0.05,
            "u": 2 + 0.3 * np.sin(0.13 * t),
            "v": 0.2 * np.cos(0.11 * t),
            "n": 5 + np.sin(0.3 * t),
            "a": 0.4 * np.sin(0.17 * t),
        }[name]

    return {c: at(c) for c in ("psi", "r", "u", "v", "n", "a")}


def read(columns, tmp_path, vessel):
    path = tmp_path / "log.csv"
    n = len(next(iter(columns.values())))
    pd.DataFrame({"t": np.arange(n) * STEP} | columns).to_csv(path, index=False)
    return read_log(path, vessel)


def body(angle, u, v):
    c, s = np.cos(angle), np.sin(angle)
    return c * u + s * v, c * v - s * u


def test_reversed_channels_and_heading(tmp_path):
    true = signals()
    wrong = true | {"r": -true["r"], "a": -true["a"], "psi": true["psi"] + 0.08}
    log = read(wrong, tmp_path, ship(reversed=["r", "a"], heading_bias=0.08))
    for name, value in true.items():
        np.testing.assert_allclose(log[name], value, atol=1e-12)
    done = {s.operation: s for s in log.provenance.steps}
    assert set(done["scale"].channels) == {"r", "a"}
    assert done["turn_heading"].parameters == {"angle": 0.08}
    assert {s.decided_by for s in done.values()} == {"vessel"}
    assert "heading turned back by 0.08 rad, as the vessel file states" in log.provenance.derived


def test_velocities_that_were_made_with_the_heading_keep_their_course(tmp_path):
    true = signals()
    u, v = body(0.08, true["u"], true["v"])
    wrong = true | {"psi": true["psi"] + 0.08, "u": u, "v": v}
    log = read(wrong, tmp_path, ship(heading_bias=0.08, velocities_from_heading=True))
    for name in ("psi", "u", "v"):
        np.testing.assert_allclose(log[name], true[name], atol=1e-12)


def test_velocities_of_another_place(tmp_path):
    true = signals()
    wrong = true | {"u": true["u"] - true["r"] * -0.7, "v": true["v"] + true["r"] * 2.5}
    log = read(wrong, tmp_path, ship(velocity_at=[2.5, -0.7]))
    np.testing.assert_allclose(log["u"], true["u"], atol=1e-12)
    np.testing.assert_allclose(log["v"], true["v"], atol=1e-12)


def test_late_and_early_clocks(tmp_path):
    """Exact for whole samples, to interpolation otherwise; what is not known is cut."""
    late = {"u": 0.7, "psi": -0.3, "n": 0.25}
    log = read(signals(late), tmp_path, ship(clock=late))
    assert len(log) == 600 - 7 - 3
    assert log.t[0] == pytest.approx(0.3)
    true = signals()
    for name in ("u", "psi", "v", "r", "a"):
        np.testing.assert_allclose(log[name], true[name][3:-7], atol=1e-12)
    np.testing.assert_allclose(log["n"], true["n"][3:-7], atol=STEP**2 / 8 * 0.09 * 1.01)


def recorded(bias=0.0, arm=(0.0, 0.0), psi_late=0.0):
    """Positions of an antenna and a heading, with the true u and v from fine integration."""
    fine = 20
    n = 600
    t = np.arange(n * fine) * STEP / fine
    psi = 0.7 * np.sin(0.2 * t) + 0.05 * t
    u, v = 2 + 0.3 * np.sin(0.13 * t), 0.2 * np.cos(0.11 * t)
    c, s = np.cos(psi), np.sin(psi)
    step = STEP / fine
    north, east = (
        np.concatenate([[0], np.cumsum(0.5 * (w[1:] + w[:-1])) * step])
        for w in (c * u - s * v, s * u + c * v)
    )
    later = t - psi_late
    heading = 0.7 * np.sin(0.2 * later) + 0.05 * later
    columns = {
        "x_n": north + c * arm[0] - s * arm[1],
        "y_n": east + s * arm[0] + c * arm[1],
        "psi": heading + bias,
        "n": np.ones_like(t),
        "a": np.zeros_like(t),
    }
    return {k: w[::fine] for k, w in columns.items()}, u[::fine], v[::fine]


DEFECTS = [
    ({"bias": 0.1}, {"heading_bias": 0.1}),
    ({"arm": (3.0, -1.0)}, {"antenna": [3.0, -1.0]}),
    ({"psi_late": 0.6}, {"clock": {"psi": 0.6}}),
    (
        {"bias": 0.1, "arm": (3.0, -1.0), "psi_late": 0.6},
        {"heading_bias": 0.1, "antenna": [3, -1], "clock": {"psi": 0.6}},
    ),
]


@pytest.mark.parametrize(("defect", "sensors"), DEFECTS)
@pytest.mark.parametrize(
    "when",
    ["derived by the reader", "derived by an import", "corrected by the import", "in memory"],
)
def test_velocities_derived_with_the_defect(defect, sensors, when, tmp_path):
    """Whether u, v were made before the vessel file said so, or after, they come out right."""
    columns, u, v = recorded(**defect)
    path = tmp_path / "raw.csv"
    frame = pd.DataFrame({"t": np.arange(600) * STEP} | columns)
    frame.to_csv(path, index=False)
    if when == "derived by the reader":
        log = read_log(path, ship(**sensors))
    elif when == "derived by an import":
        import_files([path], ship(), tmp_path / "log.csv")
        log = read_log(tmp_path / "log.csv", ship(**sensors))
    elif when == "corrected by the import":
        import_files([path], ship(**sensors), tmp_path / "log.csv")
        log = read_log(tmp_path / "log.csv", ship())
        again = read_log(tmp_path / "log.csv", ship(**sensors))
        assert again.provenance == log.provenance
        np.testing.assert_array_equal(again["u"], log["u"])
    else:
        log = correct_log(read_log(path, ship()), ship(**sensors))
    k = np.round(log.t / STEP).astype(int)
    assert len(log) >= 590
    rows = slice(2, -2)
    np.testing.assert_allclose(log["u"][rows], u[k][rows], atol=2e-3)
    np.testing.assert_allclose(log["v"][rows], v[k][rows], atol=2e-3)


def test_a_corrected_log_is_not_corrected_again(tmp_path):
    true = signals({"v": 0.5})
    wrong = true | {"psi": true["psi"] + 0.08, "r": -true["r"], "u": true["u"] - true["r"]}
    vessel = ship(heading_bias=0.08, reversed=["r"], clock={"v": 0.5}, velocity_at=[0.0, 1.0])
    once = read(wrong, tmp_path, vessel)
    write_log([once], tmp_path / "once.csv")
    twice = read_log(tmp_path / "once.csv", vessel)
    assert correct_log(twice).provenance == twice.provenance
    import_files([tmp_path / "once.csv"], vessel, tmp_path / "again.csv")
    thrice = read_log(tmp_path / "again.csv", vessel)
    for log in (twice, correct_log(twice), thrice):
        for name in once.channels:
            np.testing.assert_allclose(log[name], once[name], atol=1e-12)
    more = read_log(tmp_path / "once.csv", ship(heading_bias=0.1))
    np.testing.assert_allclose(more["psi"], once["psi"] - 0.02, atol=1e-12)
    assert [s.parameters["angle"] for s in more.provenance.steps
            if s.operation == "turn_heading"] == pytest.approx([0.08, 0.02])  # fmt: skip


def test_an_anemometer_is_moved_by_the_corrected_yaw_rate(tmp_path):
    """What is made of a channel is made after its correction."""
    true = signals()
    felt = {"u_q": 1 - true["r"] * 2.0, "v_q": 3 + true["r"] * 4.0}
    columns = {"t": np.arange(600) * STEP} | true | felt | {"r": -true["r"]}
    pd.DataFrame(columns).to_csv(tmp_path / "raw.csv", index=False)
    vessel = ship(reversed=["r"], anemometer=[4.0, 2.0, 5.0])
    import_files([tmp_path / "raw.csv"], vessel, tmp_path / "log.csv")
    for path in ("raw.csv", "log.csv"):
        log = read_log(tmp_path / path, vessel)
        np.testing.assert_allclose(log["u_q"], 1, atol=1e-12)
        np.testing.assert_allclose(log["v_q"], 3, atol=1e-12)


def test_blocks_are_corrected_as_the_whole(tmp_path, monkeypatch, limited):
    late = {"u": 0.7, "psi": -1.3, "n": 0.25}
    columns = {"t": np.arange(600) * STEP} | signals(late)
    frame = pd.DataFrame(columns).drop(index=range(200, 240))
    frame["psi"] += 0.08
    frame.to_csv(tmp_path / "raw.csv", index=False)
    vessel = ship(clock=late, heading_bias=0.08, reversed=["a"])
    import_files([tmp_path / "raw.csv"], vessel, tmp_path / "whole.csv")
    monkeypatch.setattr("greybox.trial.convert.two_pass_import._LARGE_CELLS", 0)
    monkeypatch.setattr("greybox.trial.convert.two_pass_import._BLOCK_ROWS", 50)
    limited(block_bytes=1 << 12)
    import_files([tmp_path / "raw.csv"], vessel, tmp_path / "blocks.csv")
    one, two = (pd.read_csv(tmp_path / f"{n}.csv") for n in ("whole", "blocks"))
    pd.testing.assert_frame_equal(one, two, rtol=1e-9, atol=1e-9)
    logs = [read_segments(tmp_path / f"{n}.csv", vessel) for n in ("whole", "blocks")]
    assert [len(s) for s in logs[0]] == [len(s) for s in logs[1]] == [180, 340]
    assert logs[0][0].provenance.steps == logs[1][0].provenance.steps


def test_clocks_that_leave_nothing_are_refused_by_the_import(tmp_path):
    pd.DataFrame({"t": np.arange(600) * STEP} | signals()).to_csv(tmp_path / "raw.csv")
    with pytest.raises(LogError, match=r"fewer than 3 samples .* \(u by 100 s\)"):
        import_files([tmp_path / "raw.csv"], ship(clock={"u": 100.0}), tmp_path / "log.csv")
    assert not (tmp_path / "log.csv").exists()


def test_a_corrected_log_is_not_merged_with_a_raw_one(tmp_path):
    """The record of the one would speak for the other."""
    whole = pd.DataFrame({"t": np.arange(600) * STEP} | signals())
    whole[:300].to_csv(tmp_path / "first.csv", index=False)
    whole[300:].to_csv(tmp_path / "later.csv", index=False)
    vessel, out = ship(heading_bias=0.08), tmp_path / "both.csv"
    import_files([tmp_path / "first.csv"], vessel, tmp_path / "log.csv")
    with pytest.raises(
        LogError, match=r"psi of 'log' is corrected \(heading turned back .*'later'"
    ):
        import_files([tmp_path / "log.csv", tmp_path / "later.csv"], vessel, out)
    import_files([tmp_path / "later.csv"], vessel, tmp_path / "log2.csv")
    import_files([tmp_path / "log.csv", tmp_path / "log2.csv"], vessel, out)
    np.testing.assert_allclose(read_log(out, vessel)["psi"], signals()["psi"] - 0.08, atol=1e-12)


def test_a_frame_of_a_corrected_log_is_not_corrected_again(tmp_path):
    vessel = ship(heading_bias=0.08, reversed=["r"])
    log = read(signals(), tmp_path, vessel)
    (again,) = import_recording(recording_from_pandas(log.to_pandas(), vessel), vessel).segments
    for name in log.channels:
        np.testing.assert_allclose(again[name], log[name], atol=1e-12)
    assert again.provenance.steps == log.provenance.steps


def test_only_the_signs_that_import_mended_are_left_to_it(tmp_path):
    from dataclasses import replace

    log = make_log(ship(), signals(), STEP)
    mended = replace(log.provenance, steps=(mend("scale", ("r",), factor=-1.0),))
    write_log([replace(log, provenance=mended)], tmp_path / "log.csv")
    got = read_log(tmp_path / "log.csv", ship(reversed=["r", "a"]))
    np.testing.assert_array_equal(got["r"], log["r"])
    np.testing.assert_array_equal(got["a"], -log["a"])
    assert any("reversed of r is not applied" in n for n in got.provenance.read)


def test_a_mended_clock_leaves_those_of_other_sensors_to_the_vessel_file():
    channels = {n: np.arange(50.0) for n in ("u", "v", "r", "psi", "u_q", "v_q")}
    vessel = ship(clock={"u": -1.0, "psi": 1.0, "u_q": 2.0})
    mended = (mend("shift", ("psi",), late=1.0),)
    got = correct_channels(channels, 1.0, vessel, mended)
    # what ties the motions was mended on one side or the other, the wind was not
    assert got.channels["psi"][10] == got.channels["u"][10] == 10
    assert got.channels["u_q"][10] == 12
    assert any("clock of psi, u is not applied: it was mended" in n for n in got.notes)


def test_what_import_mended_is_left_to_it(tmp_path):
    from dataclasses import replace

    log = make_log(ship(), signals(), STEP)
    mended = replace(log.provenance, steps=(mend("turn_heading", ("psi",), angle=0.1),))
    write_log([replace(log, provenance=mended)], tmp_path / "log.csv")
    got = read_log(tmp_path / "log.csv", ship(heading_bias=0.1))
    np.testing.assert_allclose(got["psi"], log["psi"])
    assert any("heading_bias is not applied: it was mended" in n for n in got.provenance.read)


def test_a_plan_has_nothing_to_correct(tmp_path):
    vessel = ship(reversed=["a"], clock={"n": 1.0}, heading_bias=0.3)
    frame = {"n": np.arange(20.0), "a": np.ones(20)}
    path = tmp_path / "plan.csv"
    pd.DataFrame({"t": np.arange(20) * STEP} | frame).to_csv(path, index=False)
    log = read_log(path, vessel, fill={"u": 1.0, "v": 0.0, "r": 0.0, "psi": 0.2})
    np.testing.assert_array_equal(log["a"], frame["a"])
    np.testing.assert_array_equal(log["psi"], np.full(20, 0.2))


def test_segments_shorter_than_the_clock_are_left_out(tmp_path):
    """Each stretch between gaps has its own ends."""
    columns = {"t": np.arange(600) * STEP} | signals({"u": 0.5})
    gone = np.r_[100:120, 126:140]
    path = tmp_path / "log.csv"
    pd.DataFrame(columns).drop(index=gone).to_csv(path, index=False)
    logs = read_segments(path, ship(clock={"u": 0.5}))
    assert [len(s) for s in logs] == [95, 455]
    with pytest.raises(LogError, match=r"fewer than 3 samples .* \(u by 100 s\)"):
        read_segments(path, ship(clock={"u": 100.0}))
    with pytest.raises(LogError, match="fewer than 3 samples"):
        correct_log(logs[0], ship(clock={"u": 100.0}))


def test_the_keys_survive_a_round_trip():
    vessel = ship(
        heading_bias=-0.02, velocities_from_heading=True, velocity_at=[1, 2],
        clock={"u": 1.2, "psi": -0.5, "n": 0.1}, reversed=["r", "a"], antenna=[1, 0],
    )  # fmt: skip
    assert vessel_from_dict(vessel_to_dict(vessel)) == vessel


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ({"heading_bias": "x"}, "heading_bias is 'x', a finite number"),
        ({"heading_bias": 30.0}, "is 30 rad, more than a turn"),
        ({"velocities_from_heading": 1}, "velocities_from_heading in .sensors. is 1: write true"),
        ({"velocity_at": [1]}, "velocity_at in .sensors. needs 2 numbers"),
        ({"clock": 1.2}, "clock in .sensors. is 1.2, it must name channels"),
        ({"clock": {"u": math.inf}}, "clock of u in .sensors. is inf"),
        ({"clock": {"psy": 1.0}}, "Did you mean 'psi'"),
        ({"reversed": "r"}, "reversed in .sensors. is 'r', it must name channels"),
        ({"reversed": ["t"]}, "names 't', which is no channel that can be corrected"),
    ],
)
def test_bad_keys(sensors, message):
    with pytest.raises(VesselError, match=message):
        ship(**sensors)


@pytest.mark.parametrize("blocks", [False, True])
def test_a_clock_of_velocities_that_are_made_on_reading(blocks, tmp_path, monkeypatch, limited):
    columns, _, _ = recorded(arm=(3.0, -1.0))
    north, east = columns.pop("x_n"), columns.pop("y_n")
    made = columns | {"v_n": np.gradient(north, STEP), "v_e": np.gradient(east, STEP)}
    pd.DataFrame({"t": np.arange(600) * STEP} | made).to_csv(tmp_path / "raw.csv", index=False)
    vessel = ship(clock={"u": 0.53, "v": 0.53, "r": -0.2})
    if blocks:
        monkeypatch.setattr("greybox.trial.convert.two_pass_import._LARGE_CELLS", 0)
        monkeypatch.setattr("greybox.trial.convert.two_pass_import._BLOCK_ROWS", 50)
        limited(block_bytes=1 << 12)
    import_files([tmp_path / "raw.csv"], vessel, tmp_path / "log.csv")
    expected = correct_log(read_log(tmp_path / "raw.csv", ship()), vessel)
    for log in (read_log(tmp_path / "raw.csv", vessel), read_log(tmp_path / "log.csv", vessel)):
        assert log.t[0] == pytest.approx(expected.t[0])
        assert len(log) == len(expected)
        for name in ("u", "v", "r", "psi"):
            np.testing.assert_allclose(log[name], expected[name], atol=1e-9)
