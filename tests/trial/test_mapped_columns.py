"""``[columns]``: the short form, units that nobody gives, and alternatives of one signal."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from greybox.errors import LogError
from greybox.trial.convert import two_pass_import
from greybox.trial.convert.channel_mapping import read_recording
from greybox.trial.convert.read import read_log
from greybox.trial.import_files import import_files
from greybox.vessel.toml import vessel_from_dict

T = np.arange(100) / 10


def vessel(columns):
    thruster = {"type": "fixed", "speed": "n"}
    return vessel_from_dict({"name": "V", "length": 10, "thruster": [thruster], "columns": columns})


def imported(tmp_path, ship, *frames):
    files = [tmp_path / f"raw{k}.csv" for k in range(len(frames))]
    for file, frame in zip(files, frames, strict=True):
        frame.to_csv(file, index=False)
    import_files(files, ship, tmp_path / "log.csv")
    return read_log(tmp_path / "log.csv", ship)


def table(**columns):
    moving = {"u": 2 + 0 * T, "v": 0 * T, "n": 5 + 0 * T}
    return pd.DataFrame({"tvec": T, "yaw": 0.1 * T, **moving} | columns)


@pytest.mark.parametrize("long", [False, True])
def test_si_where_no_unit_is_given(tmp_path, long):
    """Seconds of ten and headings beyond fifty are seconds and radians still."""
    short = {"tvec": "t", "yaw": "psi"}
    ship = vessel({k: {"name": v} for k, v in short.items()} if long else short)
    frame = table(tvec=20 * T, yaw=60 + 0.1 * T)
    frame.to_csv(tmp_path / "plain.csv", index=False)
    for log in (imported(tmp_path, ship, frame), read_log(tmp_path / "plain.csv", ship)):
        assert log.sample_time == 2.0
        turns = (log["psi"] - 60 - 0.005 * log.t) / (2 * np.pi)
        np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)


@pytest.mark.parametrize("raw", ["yaw [deg]", "yaw_deg", "bridge.yaw [deg]"])
def test_a_unit_in_the_name_of_a_column_is_given(tmp_path, raw):
    frame = table().rename(columns={"yaw": raw})
    log = imported(tmp_path, vessel({"tvec": "t", raw: "psi"}), frame)
    np.testing.assert_allclose(log["psi"], np.radians(0.1 * log.t), atol=1e-9)


def test_a_thruster_column_with_a_unit_in_brackets_is_found(tmp_path):
    rudder = {"type": "propeller_rudder", "speed": "n_prop", "rudder": "delta"}
    ship = vessel_from_dict({"name": "V", "length": 10, "thruster": [rudder]})
    frame = table(**{"t": T, "n_prop [rps]": 5 + T, "delta (deg)": T}).drop(columns=["tvec", "n"])
    log = imported(tmp_path, ship, frame)
    # a propeller speed keeps its unit, an angle is in rad
    np.testing.assert_allclose(log["n_prop"], 5 + log.t, atol=1e-9)
    np.testing.assert_allclose(log["delta"], np.radians(log.t), atol=1e-9)
    read = read_recording(tmp_path / "raw0.csv", ship)
    assert "n_prop [rps] taken for n_prop" in read.notes
    # of two units neither is the right one
    frame.assign(**{"n_prop [rpm]": 60.0}).to_csv(tmp_path / "two.csv", index=False)
    assert "n_prop" not in read_recording(tmp_path / "two.csv", ship)


@pytest.mark.parametrize("cells", [20_000_000, 0])
def test_a_thruster_column_that_the_vessel_file_misspells_is_told(tmp_path, monkeypatch, cells):
    monkeypatch.setattr(two_pass_import, "_LARGE_CELLS", cells)
    frame = table(yaw=0.0).rename(columns={"n": "RPM_PORT"})
    frame.to_csv(tmp_path / "raw.csv", index=False)
    thruster = {"type": "fixed", "speed": "RPM_PROT"}
    columns = {"tvec": "t", "yaw": "psi"}
    ship = vessel_from_dict({"name": "V", "length": 10, "thruster": [thruster], "columns": columns})
    said = import_files([tmp_path / "raw.csv"], ship, tmp_path / "log.csv")
    told = "no column 'RPM_PROT', which the vessel file names. Did you mean 'RPM_PORT'?"
    assert f"note: {told}\n" in said


def test_unix_nanoseconds_are_no_seconds(tmp_path):
    ship = vessel({"tvec": "t", "yaw": "psi"})
    log = imported(tmp_path, ship, table(tvec=(1.7e18 + 1e9 * T).astype(np.int64)))
    assert log.sample_time == 0.1


def test_columns_mapped_to_one_signal_are_alternatives(tmp_path):
    """Two loggers, two names: each file holds one of them."""
    ship = vessel({"tvec": "t", "yaw": "psi", "hdg": {"name": "psi", "unit": "deg"}})
    first = imported(tmp_path, ship, table())
    other = table(hdg=np.degrees(0.1 * T)).drop(columns="yaw")
    np.testing.assert_allclose(imported(tmp_path, ship, other)["psi"], first["psi"], atol=1e-9)
    other.to_csv(tmp_path / "plain.csv", index=False)
    log = read_log(tmp_path / "plain.csv", ship)
    np.testing.assert_allclose(log["psi"], 0.1 * log.t, atol=1e-9)
    later = other.assign(tvec=T + 10, hdg=np.degrees(0.1 * T + 1))
    both = imported(tmp_path, ship, table(), later)
    np.testing.assert_allclose(both["psi"], 0.1 * both.t, atol=1e-9)


def test_alternatives_at_the_same_times_are_refused_by_name(tmp_path):
    ship = vessel({"tvec": "t", "yaw": "psi", "hdg": {"name": "psi", "unit": "deg"}})
    with pytest.raises(LogError, match="columns 'yaw' and 'hdg' are both there"):
        imported(tmp_path, ship, table(hdg=0 * T))
    apart = pd.DataFrame({"tvec": T, "hdg": 0 * T})
    with pytest.raises(LogError, match="columns 'yaw' of 'raw0' and 'hdg' of 'raw1'"):
        imported(tmp_path, ship, table(), apart)
    assert not (tmp_path / "log.csv").exists()


def test_a_mapped_column_of_words_is_not_told_unused(tmp_path):
    ship = vessel_from_dict(
        {
            "name": "V", "length": 10, "thruster": [{"type": "fixed", "speed": "n"}],
            "columns": {"tvec": "t", "yaw": "psi", "state": "mode", "none": "x_n"},
            "closed_loop": {"column": "mode", "values": ["auto"]},
        }
    )  # fmt: skip
    log = imported(tmp_path, ship, table(state="auto"))
    assert log.closed_loop.all()
    notes = log.provenance.read
    assert "[columns] maps 'none' to 'x_n', which no file has" in notes
    assert not any("'state'" in n for n in notes)


@pytest.mark.parametrize("there", [{"lat": 63 + 1e-6 * T, "lon": 10 + 1e-6 * T}, {}])
def test_nothing_is_missed_where_another_column_serves(tmp_path, there):
    ship = vessel({"tvec": "t", "yaw": "psi", "north": "x_n", "east": "y_n"})
    notes = imported(tmp_path, ship, table(**there)).provenance.read
    assert any("which no file has" in n for n in notes) is not bool(there)


@pytest.mark.parametrize(
    ("column", "to", "message"),
    [
        ("Propeller rpm", "d", "is in 'rpm', and .* to 'd', which is an angle: wrong column?"),
        ("Rudder [deg]", "n", "is in 'deg', and .* to 'n', which is a propeller speed: wrong"),
        ("Rudder [rpm]", "d", "which is an angle: wrong column?"),
    ],
)
def test_a_unit_that_a_thruster_column_cannot_have_is_refused(tmp_path, column, to, message):
    thruster = {"type": "propeller_rudder", "speed": "n", "rudder": "d"}
    ship = {"name": "V", "length": 10, "thruster": [thruster], "columns": {column: to}}
    frame = table(**{column: 5 + 0 * T})
    with pytest.raises(LogError, match=message):
        imported(tmp_path, vessel_from_dict(ship), frame)


def test_endings_that_are_words_of_a_name_are_no_units(tmp_path):
    thruster = {"type": "propeller_rudder", "speed": "n", "rudder": "d"}
    columns = {"tvec": "t", "yaw": "psi", "rudder_s": "d"}
    ship = {"name": "V", "length": 10, "thruster": [thruster], "columns": columns}
    log = imported(tmp_path, vessel_from_dict(ship), table(rudder_s=0.1 + 0 * T))
    np.testing.assert_allclose(log["d"], 0.1)


@pytest.mark.parametrize(("apart", "noted"), [(200.0, False), (7200.0, True)])
def test_trials_of_several_days_in_one_log_are_noted(tmp_path, apart, noted):
    files = [tmp_path / f"day{k}.csv" for k in range(2)]
    for k, file in enumerate(files):
        table(t=1.6e9 + k * apart + 10 * T).drop(columns="tvec").to_csv(file, index=False)
    ship = vessel({"yaw": "psi"})
    text = import_files(files, ship, tmp_path / "log.csv")
    assert ("h between them became one log" in text) == noted
    assert ("name a folder, such as --out log/, to write one log each" in text) == noted
