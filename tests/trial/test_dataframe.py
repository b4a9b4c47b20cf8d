"""Logs from and to pandas and xarray: the same logs as from files, and exact round trips."""

import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from virtual import virtual_log

import greybox as gb
from greybox.errors import LogError, UsageError
from greybox.vessel.vessel import ColumnMapping

VESSEL = {
    "name": "tug", "length": 12.0,
    "thruster": [{"type": "azimuth", "x": -4.0, "speed": "rpm", "angle": "az"}],
    "columns": {
        "time [ms]": {"name": "t", "unit": "ms"},
        "hdg [deg]": {"name": "psi", "unit": "deg"},
        "sog_u [kn]": {"name": "u", "unit": "kn"},
        "az": {"name": "az", "unit": "deg"},
    },
    "closed_loop": {"column": "mode", "values": ["dp"]},
}  # fmt: skip


@pytest.fixture
def tug():
    return gb.vessel_from_dict(VESSEL)


def columns(samples=200, seed=0):
    """As a raw file has them: milliseconds, degrees, knots, polar wind, words."""
    rng = np.random.default_rng(seed)
    return {
        "time [ms]": 500.0 * np.arange(samples) + 1000,
        "hdg [deg]": (np.linspace(300, 420, samples) % 360),
        "sog_u [kn]": 3 + rng.standard_normal(samples),
        "v": 0.1 * rng.standard_normal(samples),
        "r": 0.01 * rng.standard_normal(samples),
        "V_q": 5 + rng.random(samples),
        "gamma_q": rng.random(samples),
        "rpm": 500 + 100 * rng.random(samples),
        "az": 180 * rng.random(samples),
        "mode": np.where(np.arange(samples) < 50, "dp", "manual"),
    }


def equal(a, b, *, provenance=True):
    assert (a.name, a.sample_time, a.vessel, a.loop_known) == (
        b.name, b.sample_time, b.vessel, b.loop_known,
    )  # fmt: skip
    assert list(a.channels) == list(b.channels)
    np.testing.assert_array_equal(a.t, b.t)
    np.testing.assert_array_equal(a.closed_loop, b.closed_loop)
    for name in a.channels:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    if provenance:
        assert a.provenance == b.provenance


def test_a_frame_is_read_as_its_file(tug, tmp_path):
    frame = pd.DataFrame(columns())
    path = tmp_path / "frame.csv"
    frame.to_csv(path, index=False, float_format="%.17g")
    from_file = gb.read_log(path, tug)
    log = gb.log_from_pandas(frame, tug)
    assert from_file.provenance.derived == log.provenance.derived != ()
    equal(from_file, log, provenance=False)
    assert log.closed_loop.sum() == 50
    assert log["psi"].max() > 2 * np.pi
    # the index may hold the time, under the name that [columns] maps
    equal(log, gb.log_from_pandas(frame.set_index("time [ms]"), tug))


def test_parquet_and_frame_are_one(tug, tmp_path):
    frame = pd.DataFrame(columns(seed=1))
    frame.to_parquet(tmp_path / "frame.parquet")
    equal(
        gb.read_log(tmp_path / "frame.parquet", tug),
        gb.log_from_pandas(frame, tug),
        provenance=False,
    )


def test_columns_of_any_kind_of_array(tug):
    frame = pd.DataFrame(columns())
    kinds = {"v": "double[pyarrow]", "rpm": "Float64", "mode": "category"}
    equal(gb.log_from_pandas(frame, tug), gb.log_from_pandas(frame.astype(kinds), tug))
    parts = pd.concat([frame.astype(kinds)[:80], frame.astype(kinds)[80:]])
    equal(gb.log_from_pandas(frame, tug), gb.log_from_pandas(parts, tug))
    words = frame.assign(note=[{"a": 1}] * len(frame))
    equal(gb.log_from_pandas(frame, tug), gb.log_from_pandas(words, tug))


@pytest.mark.parametrize("zone", [None, "Europe/Berlin"])
def test_time_of_day_as_index(tug, zone):
    plain = replace(tug, columns={k: v for k, v in tug.columns.items() if v.name != "t"})
    data = columns()
    t = data.pop("time [ms]")
    seconds = gb.log_from_pandas(pd.DataFrame(data, index=pd.Index(t / 1000, name="t")), plain)
    stamps = pd.to_datetime(t + 1.7e12, unit="ms", utc=zone is not None)
    frame = pd.DataFrame(data, index=stamps if zone is None else stamps.tz_convert(zone))
    for index in (frame.index, pd.to_timedelta(t, unit="ms")):
        log = gb.log_from_pandas(frame.set_index(index), plain)
        assert log.sample_time == 0.5
        np.testing.assert_allclose(np.diff(log.t), np.diff(seconds.t), atol=1e-6)
        np.testing.assert_array_equal(log["u"], seconds["u"])


def test_units_that_are_stated_are_believed(ship):
    log = virtual_log(2, 50)
    frame = log.to_pandas().copy()
    frame.attrs = {"units": {"psi": "degrees", "u": "knots", "n": "% of full", "alpha1": "rad"}}
    frame["psi"] = np.degrees(frame["psi"])
    frame["u"] /= 1852 / 3600
    back = gb.log_from_pandas(frame, ship)
    np.testing.assert_allclose(back["psi"], log["psi"], rtol=1e-14)
    np.testing.assert_allclose(back["u"], log["u"], rtol=1e-14)
    frame.attrs["units"]["u"] = "furlongs"
    with pytest.raises(LogError, match="column 'u' has the unknown unit 'furlongs'"):
        gb.log_from_pandas(frame, ship)


@pytest.mark.parametrize("way", ["pandas", "xarray"])
def test_round_trips_are_exact(tug, ship, way):
    if way == "xarray":
        pytest.importorskip("xarray")
    there = gb.TrialLog.to_pandas if way == "pandas" else gb.TrialLog.to_xarray
    back = gb.log_from_pandas if way == "pandas" else gb.log_from_xarray
    read = gb.log_from_pandas(pd.DataFrame(columns()), tug, name="raw")
    # defects that were taken out already are not taken out again
    biased = replace(ship, sensors=dict(ship.sensors) | {"heading_bias": 0.1})
    odd = replace(virtual_log(4, 60), vessel=biased, sample_time=1 / 3, t=np.arange(60) / 3)
    for log in (read, odd, read.window(20, 90)):
        equal(log, back(there(log), log.vessel))


def test_a_thinned_frame_has_its_own_sample_time(ship):
    log = virtual_log(2, 100)
    assert gb.log_from_pandas(log.to_pandas().iloc[::2], ship).sample_time == 2.0


def test_frames_and_datasets_tell_units(ship):
    log = virtual_log(2, 30)
    frame = log.to_pandas()
    assert frame.index.name == "t"
    assert frame.attrs["units"]["r"] == "rad/s"
    assert "n" not in frame.attrs["units"]
    xarray = pytest.importorskip("xarray")
    data = log.to_xarray()
    assert isinstance(data, xarray.Dataset)
    assert data["psi"].attrs == {
        "units": "rad", "long_name": "heading, clockwise from north, unwrapped",
    }  # fmt: skip
    assert data["t"].attrs["units"] == "s"


def test_a_dataset_of_other_make(ship):
    xarray = pytest.importorskip("xarray")
    log = virtual_log(2, 40)
    data = xarray.Dataset(
        {n: ("time", a) for n, a in log.channels.items()},
        {"time": pd.to_datetime(log.t + 1.7e9, unit="s"), "trial": 3},
    )
    data["psi"] = ("time", np.degrees(log["psi"]), {"units": "degree"})
    with pytest.raises(LogError, match=r"'dataset' has no time.*rename_axis\('t'\)"):
        gb.log_from_xarray(data, ship)
    timed = replace(ship, columns={"time": ColumnMapping("t", None)})
    back = gb.log_from_xarray(data, timed)
    np.testing.assert_allclose(back["psi"], log["psi"], rtol=1e-14)
    np.testing.assert_array_equal(back.t, log.t)
    two = data.expand_dims(run=2)
    with pytest.raises(LogError, match=r"has 2 dimensions \(.*run 2.*isel"):
        gb.log_from_xarray(two, ship)
    with pytest.raises(LogError, match="'dataset' is a DataFrame, a Dataset is needed"):
        gb.log_from_xarray(log.to_pandas(), ship)


def test_without_xarray(ship, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    for use in (virtual_log(2, 30).to_xarray, lambda: gb.log_from_xarray(None, ship)):
        with pytest.raises(UsageError, match=r"pip install 'greybox-marine\[notebook\]'"):
            use()


def test_clear_errors(ship):
    frame = virtual_log(2, 30).to_pandas()
    frame.attrs = {}
    holed = frame.copy()
    holed["v"] = np.nan
    cases = [
        (frame.rename(columns={"alpha1": "alpha_1"}), r"no column 'alpha1'.*'alpha_1'\?"),
        (frame.drop(columns="u"), "no 'u' and it cannot be derived"),
        (frame.reset_index(drop=True), "has no time: neither a column 't' nor an index"),
        (frame.drop(index=[10.0, 11.0]), "has 1 gaps in its time.*frame.loc"),
        (frame.iloc[::-1], r"goes from 29 to 28 s in row 1, .*: recording_from_pandas sorts"),
        (holed, "column 'v' of .* holds no finite number in 30 rows"),
        (frame.iloc[:0], "has no rows"),
        (frame.iloc[:2], "has 2 samples, at least 3"),
        (pd.concat([frame, frame[["u"]]], axis=1), "2 columns called 'u'"),
        (pd.concat({"a": frame}, axis=1), "2 rows of names and 1 of index"),
        (frame["u"], "is a Series, a DataFrame is needed"),
        (frame.to_numpy(), "is a ndarray, a DataFrame is needed"),
    ]
    for wrong, message in cases:
        with pytest.raises(LogError, match=message):
            gb.log_from_pandas(wrong, ship)


def test_a_raw_frame_is_checked_and_imported(ship):
    log = virtual_log(2, 300, wind=0.0)
    frame = log.to_pandas().rename(columns={"psi": "heading"}).drop(columns=["u_q", "v_q"])
    frame.attrs = {}
    frame["heading"] = np.degrees(frame["heading"]) % 360
    frame.iloc[100:110] = np.nan
    recording = gb.recording_from_pandas(frame, ship, name="raw")
    assert "heading taken for psi in deg" in recording.notes[0]
    report = gb.check_recording(recording, ship)
    assert {f.id for f in report.findings} == {"nan"}
    segments = gb.import_recording(recording, ship).segments
    assert [len(s) for s in segments] == [100, 190]
    np.testing.assert_allclose(segments[0]["u"], log["u"][:100])
    turn = segments[0]["psi"] - log["psi"][:100]
    np.testing.assert_allclose(turn, turn[0], atol=1e-9)


def test_make_log_takes_a_frame(ship):
    log = virtual_log(2, 30)
    made = gb.make_log(ship, log.to_pandas(), 1.0, log.name)
    equal(log, made)
    later = gb.make_log(ship, log.to_pandas().iloc[5:], 1.0)
    assert later.t[0] == 5.0


def test_estimates_and_runs_as_frames(ship):
    log = virtual_log(2, 800)
    estimate = gb.estimate_model([log], method="ls", predictor="basic")
    frame = estimate.to_pandas()
    assert list(frame.index) == [*estimate.labels, *(n for n, _, _ in estimate.current)]
    assert list(frame.columns) == ["theta", "std", "ci_low", "ci_high", "unit", "per_second"]
    first = frame.iloc[0]
    assert first["theta"] == estimate[estimate.names[0]]
    np.testing.assert_allclose(first["ci_high"] - first["theta"], 1.96 * first["std"])
    assert frame.attrs["verdict"] == estimate.verdict.text
    run = gb.run_model(estimate.model(), log)
    table = run.to_pandas()
    np.testing.assert_array_equal(table["u"], run.x[:, 0])
    np.testing.assert_array_equal(table["psi_measured"], log["psi"])
    np.testing.assert_allclose(
        gb.fit_percent(table[["v_measured"]].to_numpy(), table[["v"]].to_numpy()), run.fit["v"]
    )
    assert table.attrs["units"]["r_measured"] == "rad/s"
    rows = gb.compare({"a": estimate}, log).to_pandas()
    assert rows.loc[("a", "virtual"), "fit_u"] == run.fit["u"]
