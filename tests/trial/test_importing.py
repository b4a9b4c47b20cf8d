"""From recordings to logs: gaps, merging, frames, and files larger than memory."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pymap3d
import pytest
from virtual import as_recording, recorded

from greybox.errors import LogError
from greybox.trial.convert import two_pass_import as stream
from greybox.trial.convert.channel_mapping import read_recording
from greybox.trial.convert.convert import import_recording
from greybox.trial.convert.merge import merge
from greybox.trial.convert.options import ImportOptions
from greybox.trial.convert.read import read_segments
from greybox.trial.import_files import import_files
from greybox.trial.raw_log import Recording, Signal
from greybox.trial.steps import Step
from greybox.units import UNITS
from greybox.vessel.toml import load_vessel, vessel_from_dict

VESSEL = load_vessel("thesis")


def columns(n=400, dt=0.5):
    t = np.round(np.arange(n) * dt, 6)
    return {
        "t": t, "x_n": 2 * t, "y_n": np.sin(t / 9), "psi": 0.1 * np.sin(t / 5), "u": 2 + 0 * t,
        "v": 0.1 * np.sin(t / 4), "r": 0.02 * np.cos(t / 5), "u_q": 3 + 0 * t, "v_q": 0 * t,
        "n": 15 + np.sin(t / 3), "alpha1": 0.8 + 0 * t, "alpha2": 0.9 + 0 * t,
    }  # fmt: skip


def imported(data, **options):
    return import_recording(as_recording(data), VESSEL, ImportOptions(**options))


def without(data, rows):
    return {k: np.delete(v, rows) for k, v in data.items()}


def to_csv(data, path):
    pd.DataFrame(data).to_csv(path, index=False)
    return path


def test_a_clean_log_comes_out_as_it_went_in():
    data = columns()
    (log,) = imported(data).segments
    assert log.sample_time == 0.5
    for name, value in data.items():
        np.testing.assert_array_equal(log.t if name == "t" else log[name], value)


def test_gaps_are_gaps_for_every_channel():
    data = columns()
    for name in ("psi", "n", "u_q"):
        broken = {k: v.copy() for k, v in data.items()}
        broken[name][100:130] = np.nan
        result = imported(broken)
        one, two = result.segments
        assert one.t[-1] == data["t"][99]
        assert two.t[0] == data["t"][130]
        assert any("1 gap kept as such, the longest of 15.5 s at t = 49.5 s" in n
                   for n in result.notes)  # fmt: skip
    one, two = imported(without(data, slice(100, 130))).segments
    np.testing.assert_array_equal(two["v"], data["v"][130:])


def test_gaps_that_hold_most_of_the_time():
    data = columns(300)
    data["t"] = data["t"] + 500 * (np.arange(300) // 60)
    assert [len(s) for s in imported(data).segments] == [60] * 5


def test_a_command_that_is_logged_when_it_changes_is_held():
    data = columns()
    full = as_recording(data)
    at = np.array([0.0, 3, 50, 51, 120, 199])
    change = Signal("n", at, np.arange(6.0), None, "n", True)
    recording = full.with_signals([*(s for s in full.signals if s.name != "n"), change])
    (log,) = import_recording(recording, VESSEL).segments
    assert len(log) == 400
    np.testing.assert_array_equal(log["n"], np.searchsorted(at, log.t, side="right") - 1)


@pytest.mark.parametrize("cells", [20_000_000, 0])
def test_the_record_says_in_how_many_rows_an_input_is_held(tmp_path, monkeypatch, cells):
    """Every input, also one whose gap alone was bridged; what comes at every row is not."""
    data = columns()
    data["n"][np.arange(400) % 4 != 0] = np.nan
    data["alpha1"][~np.isin(np.arange(400), [0, 3, 50, 333])] = np.nan
    monkeypatch.setattr(stream, "_LARGE_CELLS", cells)
    monkeypatch.setattr(stream, "_BLOCK_ROWS", 100)
    said = import_files([to_csv(data, tmp_path / "raw.csv")], VESSEL, tmp_path / "log.csv")
    record = json.loads((tmp_path / "log.csv.json").read_text())
    (step,) = (s for s in record["steps"] if s["operation"] == "hold")
    rows = sum(count for _, _, count in record["segments"])
    # the slow input ends a few rows before the log would
    held = dict(zip(step["channels"], step["parameters"]["rows"], strict=True))
    assert rows == step["parameters"]["of"] == 397
    assert held == {"n": 297, "alpha1": 393}
    sentence = "of 397 rows the value before is held: n in 297, alpha1 in 393"
    assert sentence in record["derived"]
    assert sentence in said
    (log,) = read_segments(tmp_path / "log.csv", VESSEL)
    assert Step("hold", ("n", "alpha1"), (), {"rows": (297.0, 393.0), "of": 397.0}) in (
        log.provenance.steps
    )


def test_a_sensor_that_died_does_not_take_the_trial_with_it():
    data = columns()
    data["u_q"][50:] = np.nan
    result = imported(data)
    assert len(result.segments[0]) == 400
    assert "u_q" not in result.segments[0]
    assert any(n.startswith("u_q covers 24.5 of 199.5 s: left out") for n in result.notes)


def test_mixed_rates_meet_on_the_slowest_motion_sensor():
    rng = np.random.default_rng(0)
    fast, slow = np.arange(0, 200, 0.1), np.arange(0, 200, 1.0)
    noise = rng.normal(0, 0.1, len(fast))
    signals = [
        Signal("psi", fast, 0.01 * fast + noise, "rad", "psi", True),
        *(Signal(n, slow, 0 * slow + 1, None, n, True) for n in ("x_n", "y_n", "u", "v", "r")),
        *(Signal(n, fast, np.floor(fast / 7), None, n, True) for n in VESSEL.commands),
    ]
    (log,) = import_recording(Recording("x", tuple(signals)), VESSEL).segments
    assert log.sample_time == 1
    error = log["psi"] - 0.01 * log.t
    # the low-pass keeps about 0.08 of the band
    assert abs(error.std() / (0.1 * np.sqrt(0.08)) - 1) < 4 / np.sqrt(2 * len(log))
    np.testing.assert_allclose(log["n"][:-1], np.floor(log.t[:-1] / 7), atol=1e-9)


def test_positions_against_pymap3d():
    t = np.arange(100.0)
    lat, lon = 63.4 + 1e-5 * t, 10.4 - 2e-5 * t
    signals = [
        Signal("lat", t, lat, "deg", "lat", True), Signal("lon", t, lon, "deg", "lon", True),
        Signal("psi", t, 0 * t, "rad", "psi", True),
    ]  # fmt: skip
    # heading noise would be divided out of the velocities (3.64)
    calm = replace(VESSEL, sensors={})
    (log,) = import_recording(Recording("x", tuple(signals)), calm).segments
    north, east, _ = pymap3d.geodetic2ned(lat, lon, 0, lat[0], lon[0], 0)
    np.testing.assert_allclose(log["x_n"], north[1:-1], atol=1e-9)
    np.testing.assert_allclose(log["y_n"], east[1:-1], atol=1e-9)
    np.testing.assert_allclose(log["u"], np.gradient(north)[1:-1], atol=1e-6)
    (moved,) = import_recording(
        Recording("x", tuple(signals)), VESSEL, ImportOptions(origin=(63.4, 10.3))
    ).segments
    assert moved["y_n"][0] == pytest.approx(
        pymap3d.geodetic2ned(lat[1], lon[1], 0, 63.4, 10.3, 0)[1]
    )


def test_true_wind_becomes_velocity_through_the_air():
    """Ship eastward at 3 m/s, wind of 5 m/s from the north: it comes from port."""
    t = np.arange(50.0)
    base = {"psi": np.pi / 2 + 0 * t, "u": 3 + 0 * t, "v": 0 * t, "r": 0 * t}
    for extra in (
        {"V_w": 5 + 0 * t, "dir_w": 0 * t},
        {"V_w": 5 + 0 * t, "dir_t": -np.pi / 2 + 0 * t},
        {"V_q": np.hypot(3, 5) + 0 * t, "dir_q": np.arctan2(-5, 3) + 0 * t},
    ):
        (log,) = imported({"t": t, **base, **extra}).segments
        np.testing.assert_allclose(log["u_q"], 3, atol=1e-12)
        np.testing.assert_allclose(log["v_q"], -5, atol=1e-12)


@pytest.mark.parametrize("epoch", [None, 1717236000.0])
@pytest.mark.parametrize("cut", [1, 137, 399])
def test_two_halves_merge_to_the_whole(tmp_path, cut, epoch):
    data = columns()
    if epoch is not None:
        data["t"] = data["t"] + epoch
    table = pd.DataFrame(data)
    table.to_csv(tmp_path / "all.csv", index=False)
    table[:cut].to_csv(tmp_path / "a.csv", index=False)
    # the row at the seam may stand in both
    table[cut - 1 :].to_csv(tmp_path / "b.csv", index=False)
    whole = import_recording(read_recording(tmp_path / "all.csv", VESSEL), VESSEL)
    for order in ("ab", "ba"):
        parts = merge([read_recording(tmp_path / f"{x}.csv", VESSEL) for x in order])
        result = import_recording(parts, VESSEL)
        assert len(result.segments) == 1
        assert result.segments[0].provenance.epoch == epoch
        for name in whole.segments[0].channels:
            np.testing.assert_allclose(result.segments[0][name], whole.segments[0][name], atol=1e-6)


def test_columns_of_two_files_merge(tmp_path):
    data = columns()
    motion = {k: v for k, v in data.items() if k not in VESSEL.commands}
    inputs = {k: data[k] for k in ("t", *VESSEL.commands)}
    files = [to_csv(motion, tmp_path / "a.csv"), to_csv(inputs, tmp_path / "b.csv")]
    recording = merge([read_recording(p, VESSEL) for p in files])
    (log,) = import_recording(recording, VESSEL).segments
    for name in data.keys() - {"t"}:
        np.testing.assert_allclose(log[name], data[name], atol=1e-12)
    both = merge([read_recording(files[0], VESSEL)] * 2)
    assert any("psi stands in 'a' and 'a' at the same times" in n for n in both.notes)


@pytest.mark.parametrize("named", [("a", "b"), ("a", "a")])
def test_parts_of_which_one_was_corrected_do_not_merge(named):
    first, second = (as_recording({k: v[part] for k, v in columns().items()})
                     for part in (slice(0, 200), slice(200, 400)))  # fmt: skip
    late = Step("shift", ("psi",), parameters={"late": 0.5}, decided_by="vessel")
    parts = [replace(first, name=named[0]), replace(second, name=named[1]).with_steps(late)]
    with pytest.raises(LogError, match=f"psi of 'a' is as recorded, that of '{named[1]}' is corr"):
        merge(parts)


def test_clocks_that_cannot_meet(tmp_path):
    data = columns()
    one = read_recording(to_csv(data, tmp_path / "a.csv"), VESSEL)
    late = data | {"t": data["t"] + 1.7e9}
    two = read_recording(to_csv(late, tmp_path / "b.csv"), VESSEL)
    with pytest.raises(LogError, match="'b' has the time of day and 'a' only seconds"):
        merge([one, two])
    apart = {k: data[k] for k in ("t", *VESSEL.commands)} | {"t": data["t"] + 5000}
    motion = {k: v for k, v in data.items() if k not in VESSEL.commands}
    parts = merge([as_recording(motion), as_recording(apart)])
    with pytest.raises(LogError, match=r"overlap from 5000 s \(n\) to 199.5 s"):
        import_recording(parts, VESSEL)


def test_rows_out_of_order_and_twice():
    data = columns()
    rows = np.arange(400)
    rows[[10, 11]] = rows[[11, 10]]
    rows = np.insert(rows, 50, [50, 50])
    result = imported({k: v[rows] for k, v in data.items()})
    (log,) = result.segments
    np.testing.assert_array_equal(log["v"], data["v"])
    assert any("goes back 1 time, first from 5.5 to 5 s: put in order" in n for n in result.notes)
    assert any("2 values of x_n repeat a time: the first is kept" in n for n in result.notes)


def test_a_stretch_shorter_than_the_window_of_velocities_is_left_out():
    data = {k: v.copy() for k, v in columns().items() if k not in ("u", "v", "r")}
    for name in ("x_n", "y_n", "psi"):
        data[name][np.r_[100:130, 135:160]] = np.nan
    result = imported(data, velocities="savgol", window=6.0)
    assert [len(s) for s in result.segments] == [98, 238]
    # velocities that were measured need no window
    assert len(imported(columns(), velocities="savgol", window=1e4).segments) == 1
    with pytest.raises(LogError, match="a window of 10000 s holds 20001 samples"):
        imported(data, velocities="savgol", window=1e4)


def test_times_that_are_no_number_cost_their_rows_alone():
    data = columns()
    times = data["t"].copy()
    times[[7, 200, 201]] = [np.nan, np.inf, np.inf]
    (log,) = imported(data | {"t": times}, max_gap=2.0).segments
    assert len(log) == len(data["t"])
    kept = ~np.isin(np.arange(len(log)), [7, 200, 201])
    np.testing.assert_array_equal(log["u"][kept], data["u"][kept])


def test_two_runs_in_one_file_are_not_shuffled():
    data = columns()
    twice = {k: np.concatenate([v, v[100:300] + (0 if k == "t" else 1)]) for k, v in data.items()}
    with pytest.raises(LogError, match=r"goes back from 199.5 to 50 s, over .* are there twice"):
        imported(twice)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: {"t": d["t"]}, "no position, heading, velocity or thruster column"),
        (lambda d: {k: v[:2] for k, v in d.items()}, "no position, heading"),
        (lambda d: {"t": d["t"], "v_n": d["u"], "v_e": d["v"]}, "v_n, v_e alone: velocities need"),
        (lambda d: d | {"t": np.append(d["t"][:-1], 1e12)}, "1e.12 s, 2e.12 samples of 0.5 s, but"),
    ],
)
def test_recordings_that_make_no_log(change, message):
    with pytest.raises(LogError, match=message):
        imported(change(columns()))


def test_stretches_that_are_too_short():
    data = columns()
    data["psi"] = np.where(np.arange(400) % 10 < 2, data["psi"], np.nan)
    with pytest.raises(LogError, match="no 3 that follow each other in which psi"):
        imported(data, max_gap=1.0)


def large(case, n=9000):
    rng = np.random.default_rng(3)
    data = columns(n, 0.1)
    data["psi"] = np.cumsum(rng.normal(0.003, 0.02, n))
    for name in ("u", "v", "u_q", "v_q", "alpha1"):
        data[name] = data[name] + rng.normal(0, 0.1, n)
    data["alpha2"] = np.cumsum(rng.normal(0, 0.05, n))
    table = pd.DataFrame(data)
    table["alpha2"] = (table["alpha2"] + np.pi) % (2 * np.pi) - np.pi
    table["Heading"] = np.degrees(table.pop("psi")) % 360
    if case == "gaps":
        table.loc[2500:2560, "n"] = np.nan
        table = table.drop(index=[*range(1990, 2010), *range(3000, 5100), 6000])
    elif case == "geographic":
        table["lat"], table["lon"] = 63 + 1e-6 * table["x_n"], 10 + 1e-6 * table["y_n"]
        table = table.drop(columns=["u", "v", "r", "x_n", "y_n"])
        table.loc[table.index % 4 > 0, ["u_q", "v_q"]] = np.nan
        table["t"] += 1.7e9
    elif case == "disorder":
        order = np.arange(n)
        order[[2000, 2003]] = order[[2003, 2000]]
        order[[5000, 5001]] = order[[5001, 5000]]
        table = table.iloc[np.insert(order, 7000, 6999)]
    elif case == "modes":
        table["mode"] = np.where(np.arange(n) // 700 % 2, "dp", "manual")
    return table


@pytest.fixture(scope="module")
def raw_file(tmp_path_factory):
    """A large log as a file, written once for all options."""
    folder = tmp_path_factory.mktemp("large")

    @cache
    def written(case, ending):
        path = folder / case / f"raw.{ending}"
        path.parent.mkdir(exist_ok=True)
        if ending == "csv":
            large(case).to_csv(path, index=False)
        else:
            large(case).to_parquet(path, index=False, row_group_size=1000)
        return path

    return written


@pytest.mark.parametrize("case", ["plain", "gaps", "geographic", "disorder", "modes"])
@pytest.mark.parametrize(
    "options",
    [
        {}, {"sample_time": 1.0}, {"velocities": "savgol"},
        {"smooth": {"psi": 2.0, "u": 6.0, "alpha2": 1.0}},
        {"smooth": {"psi": 12.0}, "velocities": "savgol"},
    ],
    ids=["plain", "slower", "savgol", "smooth", "smooth-savgol"],
)  # fmt: skip
@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_blocks_give_the_log_that_memory_gives(
    tmp_path, monkeypatch, limited, raw_file, case, options, ending
):
    loop = {"closed_loop": {"column": "mode", "values": ["dp"]}}
    thrusters = [
        {"type": "azimuth", "x": x, "speed": "n", "angle": a}
        for x, a in ((9, "alpha1"), (-9, "alpha2"))
    ]
    vessel = vessel_from_dict({"name": "S", "length": 30, "thruster": thrusters} | loop)
    raw = raw_file(case, ending)
    chosen = ImportOptions(**options)
    first = import_files([raw], vessel, tmp_path / "a.csv", chosen)
    monkeypatch.setattr(stream, "_LARGE_CELLS", 0)
    monkeypatch.setattr(stream, "_BLOCK_ROWS", 700)
    limited(block_bytes=1 << 15, block_rows=450)
    second = import_files([raw], vessel, tmp_path / "b.csv", chosen)
    one, two = (pd.read_csv(tmp_path / f"{x}.csv") for x in "ab")
    # UNIX times are known to 0.2 µs, and filters begin where a block does
    near = 1e-5 if case == "geographic" else 1e-8
    pd.testing.assert_frame_equal(one, two, rtol=near, atol=near)
    assert first.splitlines()[:2] == second.splitlines()[:2]
    a, b = (json.loads((tmp_path / f"{x}.csv.json").read_text()) for x in "ab")
    for key in ("rows", "sample_time", "segments", "derived", "epoch", "files", "units"):
        assert a[key] == b[key]
    if case != "disorder":
        assert sorted(a["read"]) == sorted(b["read"])


@pytest.mark.parametrize("cells", [20_000_000, 0])
@pytest.mark.parametrize("held", [True, False])
def test_columns_n_and_e_of_a_file_of_any_size(tmp_path, monkeypatch, cells, held):
    t = np.arange(400) * 0.5
    north = 15.0 + t // 30 if held else 2 * t
    table = pd.DataFrame({"t": t, "psi": 0.01 * t, "u": 2 + 0 * t, "n": north, "e": 0.5 * t})
    table.to_csv(tmp_path / "raw.csv", index=False)
    vessel = vessel_from_dict(
        {"name": "S", "length": 30, "thruster": [{"type": "fixed", "speed": "rpm"}]}
    )
    monkeypatch.setattr(stream, "_LARGE_CELLS", cells)
    import_files([tmp_path / "raw.csv"], vessel, tmp_path / "log.csv")
    assert ("x_n" in pd.read_csv(tmp_path / "log.csv")) is not held


@pytest.mark.parametrize("cells", [20_000_000, 0])
@pytest.mark.parametrize("place", ["degrees", "metres", "none"])
@pytest.mark.parametrize("unit", ["m/s", "kn", "km/h"])
def test_a_speed_over_ground_without_a_unit_goes_as_far_as_the_positions(
    tmp_path, monkeypatch, limited, unit, place, cells
):
    rng = np.random.default_rng(1)
    t = np.arange(900.0)
    course, speed = 2.0 * np.sin(t / 60), 3.0 + np.cos(t / 40)
    # at rest before the trial
    speed[:150] = 0.0
    north, east = (np.cumsum(speed * f(course)) + rng.normal(0, 0.5, 900) for f in (np.cos, np.sin))
    metres = {"Northing": north, "Easting": east}
    degrees = {"Latitude": 57 + north / 111_400, "Longitude": 11 + east / 60_800}
    table = {
        "Time": t, **{"metres": metres, "degrees": degrees, "none": {}}[place],
        "HDG_TRUE": np.degrees(course) % 360, "SOG": speed / UNITS[unit].factor,
        "COG": np.degrees(course) % 360, "rpm": 100 + 0 * t,
    }  # fmt: skip
    pd.DataFrame(table).to_csv(tmp_path / "raw.csv", index=False)
    vessel = vessel_from_dict(
        {"name": "S", "length": 30, "thruster": [{"type": "fixed", "speed": "rpm"}]}
    )
    monkeypatch.setattr(stream, "_LARGE_CELLS", cells)
    monkeypatch.setattr(stream, "_BLOCK_ROWS", 300)
    limited(block_bytes=1 << 13, block_rows=100)
    text = import_files([tmp_path / "raw.csv"], vessel, tmp_path / "log.csv")
    told = "m/s" if place == "none" else unit
    fits = ", since so it goes as far as the positions do"
    why = ", no unit being stated" if place == "none" else fits
    assert f"note: SOG taken for sog in {told}{why}" in text
    log = pd.read_csv(tmp_path / "log.csv")
    factor = 1.0 if told == unit else 1 / UNITS[unit].factor
    np.testing.assert_allclose(log["u"].max(), 4.0 * factor, rtol=1e-3)


@pytest.mark.parametrize("cells", [20_000_000, 0])
@pytest.mark.parametrize(
    ("mapping", "read"),
    [({"name": "sog"}, "m/s"), ({"name": "sog", "unit": "km/h"}, "km/h"), (None, "")],
)
def test_a_speed_over_ground_in_another_unit_than_stated_is_told(
    tmp_path, monkeypatch, mapping, read, cells
):
    t = np.arange(200.0)
    named = "SOG" if mapping else "SOG (kts)"
    speed = 4 / UNITS["kn"].factor + 0 * t
    table = {"t": t, "north": 4 * t, "east": 0 * t, "psi": 0 * t, named: speed, "cog": 0 * t}
    pd.DataFrame(table | {"rpm": 100 + 0 * t}).to_csv(tmp_path / "raw.csv", index=False)
    vessel = vessel_from_dict(
        {"name": "S", "length": 30, "thruster": [{"type": "fixed", "speed": "rpm"}]}
        | {"columns": {"SOG": mapping} if mapping else {}}
    )
    monkeypatch.setattr(stream, "_LARGE_CELLS", cells)
    text = import_files([tmp_path / "raw.csv"], vessel, tmp_path / "log.csv")
    told = f"SOG is read in {read}, and goes as far as the positions do in kn: correct its unit"
    assert (told in text) == (mapping is not None)
    factor = UNITS[read or "kn"].factor / UNITS["kn"].factor
    np.testing.assert_allclose(pd.read_csv(tmp_path / "log.csv")["u"], 4 * factor)


@pytest.mark.parametrize("cells", [20_000_000, 0])
@pytest.mark.parametrize("named", ["SOG [kn]", "SOG"])
def test_a_stated_unit_of_the_speed_over_ground_is_believed(tmp_path, monkeypatch, named, cells):
    t = np.arange(200.0)
    # a tenth of the way that the speed makes: no unit fits, and none is looked for
    table = {"t": t, "north": 0.2 * t, "east": 0 * t, "psi": 0 * t, named: 4 + 0 * t, "cog": 0 * t}
    pd.DataFrame(table | {"rpm": 100 + 0 * t}).to_csv(tmp_path / "raw.csv", index=False)
    columns = {} if named == "SOG [kn]" else {"SOG": {"name": "sog", "unit": "kn"}}
    vessel = vessel_from_dict(
        {"name": "S", "length": 30, "thruster": [{"type": "fixed", "speed": "rpm"}]}
        | {"columns": columns}
    )
    monkeypatch.setattr(stream, "_LARGE_CELLS", cells)
    import_files([tmp_path / "raw.csv"], vessel, tmp_path / "log.csv")
    np.testing.assert_allclose(pd.read_csv(tmp_path / "log.csv")["u"], 4 * UNITS["kn"].factor)


@pytest.mark.parametrize("cells", [20_000_000, 0])
def test_positions_of_a_file_of_any_size_begin_at_the_first_place_on_earth(
    tmp_path, monkeypatch, cells
):
    t = np.arange(400) * 0.5
    table = pd.DataFrame({"t": t, "lat": 63.4 + 1e-5 * t, "lon": 10.4, "psi": 0 * t, "n": 5.0})
    table.loc[:2, ["lat", "lon"]] = 91.0, 181.0
    table.to_csv(tmp_path / "raw.csv", index=False)
    vessel = vessel_from_dict(
        {"name": "S", "length": 30, "thruster": [{"type": "fixed", "speed": "n"}]}
    )
    monkeypatch.setattr(stream, "_LARGE_CELLS", cells)
    import_files([tmp_path / "raw.csv"], vessel, tmp_path / "log.csv")
    north = pd.read_csv(tmp_path / "log.csv")["x_n"]
    assert north.abs().min() < 2
    assert north.max() == pytest.approx(1e-5 * 198 * 111_000, rel=0.02)


def test_a_large_file_whose_time_starts_again(tmp_path, monkeypatch):
    table = large("plain")
    pd.concat([table, table]).to_csv(tmp_path / "raw.csv", index=False)
    monkeypatch.setattr(stream, "_LARGE_CELLS", 0)
    monkeypatch.setattr("greybox.trial.convert.two_pass_import._MAX_BACK_ROWS", 1000)
    with pytest.raises(LogError, match=r"goes back by 899.9 s, at most 100 s"):
        import_files([tmp_path / "raw.csv"], VESSEL, tmp_path / "a.csv")
    assert not (tmp_path / "a.csv").exists()


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_a_log_is_read_again_as_it_was_written(tmp_path, ending):
    data = recorded(0, rate=2.0, seconds=120)
    raw = to_csv(without(data, slice(100, 130)), tmp_path / "raw.csv")
    mapped = vessel_from_dict(
        {
            "name": "T", "length": 30,
            "thruster": [{"type": "azimuth", "speed": "n", "angle": "alpha1"}],
            "columns": {"v": {"name": "v", "unit": "kn", "sign": -1}},
        }
    )  # fmt: skip
    log = tmp_path / f"log.{ending}"
    import_files([raw], mapped, log)
    segments = read_segments(log, mapped)
    assert [s.provenance.source for s in segments] == ["raw.csv"] * 2
    np.testing.assert_allclose(segments[0]["v"], -data["v"][:100] * 1852 / 3600)
    # imported again it is the same: its columns are not converted twice
    again = tmp_path / f"again.{ending}"
    import_files([log], mapped, again)
    for one, two in zip(segments, read_segments(again, mapped), strict=True):
        for name in one.channels:
            np.testing.assert_allclose(one[name], two[name], rtol=1e-12, atol=1e-12)
    # a log that was edited since is read by the vessel file's columns
    record = tmp_path / f"log.{ending}.json"
    record.write_text("{" * 10000)
    assert read_segments(log, mapped)[0]["v"][0] != segments[0]["v"][0]


def test_the_old_name_of_the_longest_gap_still_works():
    with pytest.warns(DeprecationWarning, match="max_gap"):
        assert ImportOptions(hole=3.0).max_gap == 3.0
    assert ImportOptions(max_gap=2.0).max_gap == 2.0


def test_a_rudder_in_degrees_is_no_wrapped_angle(tmp_path):
    """An import without a fix keeps its numbers, and a fit refuses them."""
    vessel = vessel_from_dict({
        "name": "boat", "length": 12.0,
        "thruster": [{"type": "propeller_rudder", "x": -5.0, "speed": "n", "rudder": "delta"}],
    })  # fmt: skip
    data = {k: v for k, v in columns().items() if k in ("t", "x_n", "y_n", "psi", "u", "v", "r")}
    rudder = np.repeat([0.0, 10.0, 35.0, -20.0], 100)
    data |= {"n": np.full(400, 5.0), "delta": rudder}
    (log,) = import_recording(as_recording(data), vessel, ImportOptions()).segments
    assert np.array_equal(log["delta"], rudder)
    with pytest.raises(LogError, match=r"'delta' of 'x.csv' reaches 35, above the 1.57 rad"):
        read_segments(to_csv(data, tmp_path / "x.csv"), vessel)
