"""Reading and conditioning of logs."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from virtual import recorded

from greybox.errors import LogError
from greybox.trial.convert.options import ImportOptions
from greybox.trial.convert.read import read_log
from greybox.trial.import_files import import_files
from greybox.trial.kinematics import decimate, decimate_segments, velocities_from_positions
from greybox.trial.log import make_log
from greybox.trial.log_files import find_logs
from greybox.trial.stream import open_stream
from greybox.trial.wind import relative_wind
from greybox.vessel.toml import load_vessel, vessel_from_dict

# ten steps around a sample, half of each end
KERNEL = np.r_[0.5, np.ones(9), 0.5] / 10
SHIP = {
    "name": "S",
    "length": 5,
    "thruster": [{"type": "azimuth", "speed": "n", "angle": "a"}],
}


def table(n=20, **replace):
    t = np.arange(n) * 0.5
    columns = {
        "t": t, "x_n": t * 2, "y_n": t * 0, "psi": 0 * t + 0.1, "u": 0 * t + 2, "v": 0 * t,
        "r": 0 * t, "n": t, "a": 0 * t,
    }  # fmt: skip
    return pd.DataFrame(columns | replace)


def read(frame, tmp_path, vessel=SHIP, **kw):
    path = tmp_path / "log.csv"
    frame.to_csv(path, index=False)
    return read_log(path, vessel_from_dict(vessel), **kw)


def test_csv_and_parquet_give_the_same_log(tmp_path):
    frame = table()
    one = read(frame, tmp_path)
    frame.to_parquet(tmp_path / "log.parquet")
    two = read_log(tmp_path / "log.parquet", vessel_from_dict(SHIP))
    assert one.sample_time == two.sample_time == 0.5
    for name in one.channels:
        np.testing.assert_array_equal(one[name], two[name])


def test_names_and_units_of_the_vessel_file(tmp_path):
    frame = table().rename(columns={"psi": "Heading", "t": "ms", "u": "SOG"})
    frame["Heading"] = np.degrees(np.linspace(3.0, 3.4, 20) % 6.28)
    frame["ms"] *= 1000
    frame["SOG"] = 10.0
    ship = SHIP | {
        "columns": {
            "Heading": {"name": "psi", "unit": "deg"},
            "ms": {"name": "t", "unit": "ms"},
            "SOG": {"name": "u", "unit": "kn"},
        }
    }
    log = read(frame, tmp_path, ship)
    assert log.sample_time == pytest.approx(0.5)
    np.testing.assert_allclose(log["psi"], np.linspace(3.0, 3.4, 20))
    np.testing.assert_allclose(log["u"], 10 * 1852 / 3600)


def test_dates_count_from_the_first_and_numbers_keep_their_zero(tmp_path):
    start = pd.Timestamp("2024-05-01T12:00:00Z")
    frame = table()
    dates = (start + pd.to_timedelta(frame["t"], unit="s")).dt.strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    log = read(frame.assign(t=dates), tmp_path)
    np.testing.assert_allclose(log.t, frame["t"], atol=1e-6)
    assert log.provenance.epoch == pytest.approx(start.timestamp())
    log = read(frame.assign(t=frame["t"] + 1.7e9), tmp_path)
    np.testing.assert_array_equal(log.t, frame["t"] + 1.7e9)
    assert log.provenance.epoch is None


def test_heading_is_unwrapped(tmp_path):
    psi = np.linspace(3.0, 9.0, 20)
    log = read(table(psi=(psi + np.pi) % (2 * np.pi) - np.pi), tmp_path)
    np.testing.assert_allclose(log["psi"], psi)


def test_velocities_come_from_positions_where_absent(tmp_path):
    t = np.arange(200) * 0.1
    psi = 0.3 * np.sin(0.2 * t)
    rate = 0.06 * np.cos(0.2 * t)
    u, v = 1.5 + 0.2 * np.sin(0.3 * t), 0.3 * np.cos(0.4 * t)
    fine = np.linspace(0, t[-1], 200001)

    def integral(f):
        value = np.interp(fine, t, f)
        return np.interp(t, fine, np.concatenate([[0], np.cumsum(value[:-1]) * fine[1]]))

    north = integral(np.cos(psi) * u - np.sin(psi) * v)
    east = integral(np.sin(psi) * u + np.cos(psi) * v)
    ax, ay = 1.2, -0.4
    frame = pd.DataFrame(
        {
            "t": t,
            "x_n": north + np.cos(psi) * ax - np.sin(psi) * ay,
            "y_n": east + np.sin(psi) * ax + np.cos(psi) * ay,
            "psi": psi, "n": t, "a": t,
        }
    )  # fmt: skip
    log = read(frame, tmp_path, SHIP | {"sensors": {"antenna": [ax, ay]}})
    assert "3.57" in log.provenance.derived[0]
    np.testing.assert_allclose(log["u"], u[1:-1], atol=2e-3)
    np.testing.assert_allclose(log["v"], v[1:-1], atol=2e-3)
    np.testing.assert_allclose(log["r"], rate[1:-1], atol=1e-4)


def test_heading_noise_is_divided_out():
    """(3.64): the mean of u shrinks by exp(−λ/2) without the correction."""
    rng = np.random.default_rng(0)
    n, std = 40000, 0.3
    x = 2.0 * np.arange(n)
    psi = std * rng.standard_normal(n)
    raw, _, _ = velocities_from_positions(x, 0 * x, psi, 1.0)
    mended, _, _ = velocities_from_positions(x, 0 * x, psi, 1.0, heading_std=std)
    error = 3 * raw.std() / np.sqrt(n)
    assert abs(raw.mean() - 2 * np.exp(-(std**2) / 2)) < error
    assert abs(mended.mean() - 2) < error * 1.1


def test_polar_wind():
    """(5.41), (5.42): wind from starboard gives v_q > 0."""
    u_q, v_q = relative_wind(np.array([3.0]), np.array([np.pi / 2]))
    np.testing.assert_allclose([u_q[0], v_q[0]], [0, 3], atol=1e-12)


def test_decimation_averages_what_the_ship_feels(ship):
    n = 40
    signal = np.arange(n, dtype=float)
    log = make_log(
        ship,
        {"n": signal, "alpha1": signal, "alpha2": signal, "u": signal, "v": signal, "r": signal,
         "psi": signal},
        0.5,
    )  # fmt: skip
    slow = decimate(log, 2.0)
    assert slow.sample_time == 2.0
    k = np.flatnonzero(np.isin(log.t, slow.t))
    np.testing.assert_allclose(slow["u"], signal[k])  # centred: a ramp keeps its value
    np.testing.assert_allclose(slow["n"], [signal[i : i + 4].mean() for i in k])  # ahead
    with pytest.raises(LogError, match=r"1\.5 times"):
        decimate(log, 0.75)


def test_a_segment_too_short_for_a_sample_time_is_left_out(ship):
    n = 40
    flat = {name: np.ones(n) for name in ("n", "alpha1", "alpha2", "u", "v", "r", "psi")}
    log = make_log(ship, flat, 0.5, "trial")
    kept, notes = decimate_segments([log, log.window(0, 5, "trial[2]")], 2.0)
    assert [(k.name, k.sample_time) for k in kept] == [("trial", 2.0)]
    assert notes == (
        "'trial[2]' was left out: its 5 samples (2.5 s) are too few for a sample time of 2 s.",
    )
    with pytest.raises(LogError, match=r"'trial\[2\]' keeps 0 samples at 2 s"):
        decimate_segments([log.window(0, 5, "trial[2]")], 2.0)
    # no whole multiple is no matter of length
    with pytest.raises(LogError, match=r"1\.5 times"):
        decimate_segments([log], 0.75)


def earth_fixed(n=400, dt=0.1):
    """A weaving ship whose log holds velocities north and east."""
    t = np.arange(n) * dt
    psi = 0.4 * np.sin(0.2 * t)
    u, v = 2 + 0.2 * np.sin(0.3 * t), 0.1 * np.cos(0.2 * t)
    north, east = np.cos(psi) * u - np.sin(psi) * v, np.sin(psi) * u + np.cos(psi) * v
    frame = pd.DataFrame({"t": t, "psi": psi, "v_n": north, "v_e": east, "n": t, "a": 0 * t})
    return frame, u, v, 0.08 * np.cos(0.2 * t)


def test_velocities_north_and_east_are_turned_into_body_axes(tmp_path):
    frame, u, v, r = earth_fixed()
    log = read(frame, tmp_path)
    np.testing.assert_allclose(log["u"], u[1:-1], atol=1e-12)
    np.testing.assert_allclose(log["v"], v[1:-1], atol=1e-12)
    np.testing.assert_allclose(log["r"], r[1:-1], atol=1e-5)
    # no position is named where there was none
    assert list(log.provenance.derived) == [
        "r from heading by central differences (3.57)",
        "u, v from the velocity over ground and the heading",
    ]
    # the import is the same way
    import_files([tmp_path / "log.csv"], log.vessel, tmp_path / "imported.csv")
    imported = read_log(tmp_path / "imported.csv", log.vessel)
    for name in ("psi", "u", "v", "r", "n", "a"):
        np.testing.assert_allclose(imported[name], log[name], atol=1e-12)
    assert imported.provenance.derived == log.provenance.derived


def test_velocities_without_positions_are_averaged_at_a_longer_sample_time(tmp_path):
    frame = earth_fixed()[0]
    log = read(frame, tmp_path)
    slow = decimate(log, 1.0)
    k = np.searchsorted(log.t, slow.t - 1e-6)
    around = [log["u"][i - 5 : i + 6] for i in k]
    np.testing.assert_allclose(slow["u"], [(w.sum() - (w[0] + w[-1]) / 2) / 10 for w in around])
    # the yaw rate was made by differences: it is made anew of the averaged heading
    np.testing.assert_allclose(slow["r"][1:-1], np.gradient(slow["psi"], 1.0)[1:-1])
    assert [s.operation for s in slow.provenance.steps] == [
        "difference", "earth_to_body", "decimate", "difference",
    ]  # fmt: skip
    assert slow.provenance.steps[-1].channels == ("r",)
    # differences take a sample at either end
    with pytest.raises(LogError, match=r"keeps 2 samples at 8 s, at least 3 are needed"):
        decimate(log, 8.0)


@pytest.mark.parametrize("velocities", ["central", "savgol"])
def test_a_longer_sample_time_keeps_how_velocities_were_made(tmp_path, velocities):
    """Differences are made anew, since only that gains from averaged positions; the rest not."""
    rng = np.random.default_rng(3)
    data = recorded(3, rate=10.0, seconds=120)
    noisy = data["x_n"] + 0.2 * rng.standard_normal(len(data["t"]))
    frame = pd.DataFrame({k: v for k, v in data.items() if k not in "uvr"} | {"x_n": noisy})
    frame.to_csv(tmp_path / "raw.csv", index=False)
    ship, options = load_vessel("thesis"), ImportOptions(velocities=velocities, window=4.0)
    import_files([tmp_path / "raw.csv"], ship, tmp_path / "log.csv", options)
    log = read_log(tmp_path / "log.csv", ship)
    slow = decimate(log, 1.0)
    anew = [s for s in slow.provenance.steps if s.operation == "difference"]
    if velocities == "central":
        assert [s.channels for s in anew[-2:]] == [("u", "v"), ("r",)]
        u, v, r = velocities_from_positions(
            slow["x_n"], slow["y_n"], slow["psi"], 1.0, heading_std=ship.std("psi")
        )
        for name, value in (("u", u), ("v", v), ("r", r)):
            np.testing.assert_allclose(slow[name][1:-1], value[1:-1], atol=1e-12)
    else:
        assert anew == []
        k = np.searchsorted(log.t, slow.t - 1e-6)
        for name in "uvr":
            mean = [np.convolve(log[name][i - 5 : i + 6], KERNEL, "valid")[0] for i in k]
            np.testing.assert_allclose(slow[name], mean, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.rename(columns={"n": "m"}), "no column 'n', which moves a thruster"),
        (lambda f: f.drop(columns=["t"]), "no column 't'"),
        (lambda f: f.drop(columns=["u", "x_n"]), "no 'u' and it cannot be derived"),
        (lambda f: f.drop(columns=["psi"]), "no heading 'psi'"),
        (
            lambda f: f.assign(u=f["u"].where(f.index > 99)),
            "holds no finite number in 20 rows, from row 2 on",
        ),
        (
            lambda f: f.assign(u=f["u"].where(f.index < 9), v=f["v"].where(f.index > 12)),
            "no 3 that follow each other",
        ),
        (lambda f: f.assign(v="x"), "no finite number"),
        (lambda f: f.assign(t=f["t"][::-1].to_numpy()), "must increase"),
        (
            lambda f: f.assign(t=1700000000.5 + np.r_[np.arange(19), 17]),
            r"from 1700000018.5 to 1700000017.5 s in row 21",
        ),
        (
            lambda f: f.assign(n=f["n"].where(f.index % 3 > 0), t=np.r_[np.arange(19), 17.0]),
            r"from 17 to 17 s in row 21",
        ),
        (
            lambda f: f.assign(n=f["n"].where(f.index % 3 > 0)),
            "falls into 7 pieces, .*: 7 of 20 rows left out, the first row 2, where n holds no "
            "finite number. Make one log of it with greybox import, which holds inputs",
        ),
        (lambda f: f.assign(t=np.r_[np.arange(10), 10 + 2 * np.arange(10)]), "two sample times"),
        (
            lambda f: f.assign(n=f["n"].where(f.index != 10), t=f["t"] + 0.2 * (f.index > 10)),
            "two sample times: 0.5 s, but 1.2 s after t = 4.5 s",
        ),
        (lambda f: f.head(2), "has 2 samples, at least 3"),
        (
            lambda f: f.assign(t=np.r_[np.arange(10), 9 + 1.15 * np.arange(1, 11)]),
            "on average in its first half",
        ),
    ],
)
def test_bad_logs(tmp_path, change, message):
    with pytest.raises(LogError, match=message):
        read(change(table()), tmp_path)


def test_windows_of_a_stream_have_the_sample_time_of_their_file(tmp_path, monkeypatch):
    """Jitter gives each window another mean, and one estimate needs one sample time."""
    monkeypatch.setattr("greybox.trial.stream._LEAST_ROWS", 500)
    monkeypatch.setattr("greybox.trial.stream._MOST_ROWS", 500)
    t = 0.5 * np.arange(2000) + np.random.default_rng(0).uniform(-0.03, 0.03, 2000)
    table(2000, t=t).to_parquet(tmp_path / "log.parquet")
    ship = vessel_from_dict(SHIP)
    stream, found = open_stream(find_logs([str(tmp_path)]), ship).run(len)
    logs = stream.read([place for place, _ in found])
    assert [len(log) for log in logs] == [500] * 4
    whole = read_log(tmp_path / "log.parquet", ship).sample_time
    assert {log.sample_time for log in logs} == {stream.interval}
    assert stream.interval == pytest.approx(whole, rel=1e-9)
    # a part at a rate of its own keeps it, for what needs one sample time to refuse
    t[1500:] = t[1499] + 0.6 * np.arange(1, 501)
    table(2000, t=t).to_parquet(tmp_path / "log.parquet")
    stream, found = open_stream(find_logs([str(tmp_path)]), ship).run(len)
    slow = stream.read([place for place, _ in found])[-1]
    assert slow.sample_time == pytest.approx(0.6)


def test_a_column_that_another_thruster_has_is_no_misspelling(tmp_path):
    thrusters = [{"type": "fixed", "speed": f"speed{k}"} for k in (1, 2)]
    frame = table().rename(columns={"n": "speed1"})
    with pytest.raises(LogError, match=r"no column 'speed2', which moves a thruster of 'S'\. Give"):
        read(frame, tmp_path, SHIP | {"thruster": thrusters})
    frame["speed_2"] = frame["speed1"]
    with pytest.raises(LogError, match=r"no column 'speed2', .* Did you mean 'speed_2'\?"):
        read(frame, tmp_path, SHIP | {"thruster": thrusters})


def test_bad_files(tmp_path):
    ship = vessel_from_dict(SHIP)
    with pytest.raises(LogError, match="there is no file"):
        read_log(tmp_path / "none.csv", ship)
    (tmp_path / "log.xlsx").write_text("t")
    with pytest.raises(LogError, match="is a spreadsheet, not a log"):
        read_log(tmp_path / "log.xlsx", ship)
    (tmp_path / "log.parquet").write_text("not parquet")
    with pytest.raises(LogError, match="as Parquet"):
        read_log(tmp_path / "log.parquet", ship)
    (tmp_path / "empty.csv").write_text("")
    with pytest.raises(LogError, match="is empty"):
        read_log(tmp_path / "empty.csv", ship)


def test_a_mapped_column_must_be_there(tmp_path):
    ship = SHIP | {"columns": {"wind_u": {"name": "u_q", "unit": "m/s"}}}
    with pytest.raises(LogError, match=r"no column 'wind_u', which \[columns\] maps to 'u_q'"):
        read(table(), tmp_path, ship)


def test_holes_in_positions_do_not_matter_beside_velocities(tmp_path):
    frame = table()
    frame.loc[7, "x_n"] = np.nan
    log = read(frame, tmp_path)
    assert np.flatnonzero(np.isnan(log.measured("x_n"))).tolist() == [7]
    assert log.known(("u", "v", "r", "psi")).all()
    assert len(log) == len(frame)


def test_closed_loop_is_read_from_the_mode(tmp_path):
    frame = table()
    frame["mode"] = ["dp"] * 15 + ["manual"] * 5
    log = read(frame, tmp_path, SHIP | {"closed_loop": {"column": "mode", "values": ["dp"]}})
    assert log.loop_known
    assert log.closed_loop.sum() == 15


def test_make_log_refuses_uneven_and_infinite(ship):
    with pytest.raises(LogError, match="has 2 samples and 'v' has 3"):
        make_log(ship, {"u": np.zeros(2), "v": np.zeros(3)}, 1.0)
    with pytest.raises(LogError, match="not finite at sample 1"):
        make_log(ship, {"u": np.array([0, np.inf])}, 1.0)
