"""`greybox import` from the outside: logs that estimate, bad input, nothing half-written."""

from __future__ import annotations

import json
import os
import pickle
import random

import numpy as np
import pandas as pd
import pytest
from mcap.writer import Writer
from virtual import recorded, virtual_log, write_csv

from greybox.commands.main import main


def data(n=60):
    t = np.arange(n) * 0.5
    return pd.DataFrame(
        {
            "t": t, "x_n": 2 * t, "y_n": np.sin(t), "psi": 0.1 * np.sin(t / 5), "u": 2 + 0 * t,
            "v": 0.1 * np.sin(t), "r": 0.02 * np.cos(t / 5), "u_q": 3 + 0 * t, "v_q": 0 * t,
            "n": 15 + 0.01 * t, "alpha1": 0.8 + 0 * t, "alpha2": 0.8 + 0 * t,
        }
    )  # fmt: skip


def nmea(seconds=60):
    lines = []
    for k in range(seconds):
        for body in (
            f"GPGGA,2359{k % 60:02}.00,6325.{k:06},N,01024.{k:06},E,1,9,1,5,M,4,M,,",
            f"GPRMC,2359{k % 60:02}.00,A,6325.{k:06},N,01024.{k:06},E,5.1,45.0,010623,,,A",
            f"HEHDT,{k}.5,T", "WIMWV,20,R,5,N,A", "IIRPM,S,1,100,20,A", "TIROT,2,A",
        ):  # fmt: skip
            check = 0
            for c in body.encode():
                check ^= c
            lines.append(f"${body}*{check:02X}\r\n")
    return "".join(lines).encode()


def run(capsys, *arguments):
    status = main([str(a) for a in arguments])
    return status, *capsys.readouterr()


@pytest.mark.long
def test_a_log_with_a_gap_is_estimated_by_segments(tmp_path, capsys):
    log = virtual_log(1, 1500)
    raw = write_csv(log, tmp_path / "raw.csv")
    lines = raw.read_text().splitlines(keepends=True)
    raw.write_text("".join(lines[:701] + lines[731:]))
    status, out, _ = run(
        capsys, "import", raw, "--vessel", "thesis", "--out", tmp_path / "log.csv",
        "--note", "draught=1.2 m",
    )  # fmt: skip
    assert status == 0
    assert "1470 samples of 1 s, 1499 s, 2 segments" in out
    assert "1 gap kept as such, the longest of 31 s at t = 699 s" in out
    record = json.loads((tmp_path / "log.csv.json").read_text())
    assert record["segments"] == [[0, 699, 700], [730, 1499, 770]]
    assert record["notes"] == {"draught": "1.2 m"}
    model = tmp_path / "model.json"
    status, out, err = run(
        capsys, "estimate", tmp_path / "log.csv", "--vessel", "thesis", "--out", model
    )
    assert status == 0, err
    with_gap = json.loads(model.read_text())["theta"]
    whole = write_csv(log, tmp_path / "whole.csv")
    assert run(capsys, "estimate", whole, "--vessel", "thesis", "--out", model)[0] == 0
    fitted = json.loads(model.read_text())
    both = [np.array(list(x.values()) if isinstance(x, dict) else x)
            for x in (with_gap, fitted["theta"])]  # fmt: skip
    spread = fitted["std"]
    spread = np.array(list(spread.values()) if isinstance(spread, dict) else spread)
    # two estimates that share 98 % of their data
    assert np.all(np.abs(both[0] - both[1]) < 2 * spread)


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_nmea_and_thrusters_merge(tmp_path, capsys, ending):
    (tmp_path / "bridge.nmea").write_bytes(nmea())
    start = pd.Timestamp("2023-06-01T23:59:00Z").timestamp()
    data().assign(t=start + np.arange(60))[["t", "n", "alpha1", "alpha2"]].to_csv(
        tmp_path / "thrusters.csv", index=False
    )
    out = tmp_path / f"log.{ending}"
    status, said, _ = run(
        capsys, "import", tmp_path / "bridge.nmea", tmp_path / "thrusters.csv",
        "--vessel", "thesis", "--out", out, "--json", "-",
    )  # fmt: skip
    assert status == 0
    record = json.loads(said)
    assert [f["format"] if isinstance(f, dict) else f[2] for f in record["files"]] == [
        "NMEA 0183", "CSV",
    ]  # fmt: skip
    assert record["epoch"] == pytest.approx(start)
    log = pd.read_csv(out) if ending == "csv" else pd.read_parquet(out)
    assert {"t", "x_n", "y_n", "psi", "u", "v", "r", "u_q", "v_q", "n"} <= set(log)
    assert np.diff(log["t"]).max() == pytest.approx(1)
    assert log["n"].iloc[0] == pytest.approx(15)


def test_guesses_are_stated(tmp_path, capsys):
    columns = recorded(0, seconds=60)
    table = pd.DataFrame(columns).rename(
        columns={"t": "Time [ms]", "psi": "True Heading", "x_n": "North", "u": "Surge (kn)"}
    )
    table["Time [ms]"] *= 1000
    table["True Heading"] = np.degrees(table["True Heading"]) % 360
    table["Surge (kn)"] *= 3600 / 1852
    table.to_csv(tmp_path / "raw.csv", index=False)
    status, out, _ = run(
        capsys, "import", tmp_path / "raw.csv", "--vessel", "thesis", "--out", tmp_path / "o.csv"
    )
    assert status == 0
    for note in (
        "column 'Time [ms]' taken for time in ms", "True Heading taken for psi in deg, since",
        "North taken for x_n in m", "Surge (kn) taken for u in kn",
    ):  # fmt: skip
        assert note in out
    log = pd.read_csv(tmp_path / "o.csv")
    np.testing.assert_allclose(log["u"], columns["u"], rtol=1e-9)
    np.testing.assert_allclose(np.exp(1j * log["psi"]), np.exp(1j * columns["psi"]), atol=1e-9)


def test_angles_that_cannot_be_radians_are_told(tmp_path, capsys):
    raw = data()
    raw["alpha1"] = np.degrees(raw["alpha1"])
    raw["paint"] = 1.0
    raw.to_csv(tmp_path / "raw.csv", index=False)
    given = ["import", tmp_path / "raw.csv", "--vessel", "thesis", "--out", tmp_path / "log.csv"]
    status, out, _ = run(capsys, *given)
    assert status == 0
    assert "note: alpha1 reaches 45.84, above the 12.6 rad that it can reach" in out
    assert 'write "alpha1" = { name = "alpha1", unit = "deg" } under [columns]' in out
    assert "columns not used: paint (map those that belong to the log in" in out
    status, out, _ = run(capsys, *given, "--fix", "--fix-not", "stuck")
    assert "note: alpha1 reaches" not in out
    assert "mended: unit of alpha1" in out
    again = ["import", tmp_path / "log.csv", "--vessel", "thesis", "--out", tmp_path / "again.csv"]
    assert "mended" not in run(capsys, *again)[1]
    nothing = run(capsys, *again, "--fix", "--fix-not", "stuck")
    assert "\nmended: nothing, as the checks" in nothing[1]


def test_a_mapping_that_no_file_has_is_told(tmp_path, capsys):
    ship = tmp_path / "ship.toml"
    ship.write_text(
        'name = "S"\nlength = 5\n[[thruster]]\ntype = "azimuth"\nspeed = "n"\nangle = "alpha1"\n'
        '[columns]\n"Wind U" = { name = "u_q", unit = "m/s" }\n'
    )
    data().drop(columns=["u_q", "v_q"]).to_csv(tmp_path / "raw.csv", index=False)
    status, out, _ = run(
        capsys, "import", tmp_path / "raw.csv", "--vessel", ship, "--out", tmp_path / "o.csv"
    )
    assert status == 0
    assert "[columns] maps 'Wind U' to 'u_q', which no file has" in out
    assert "next: see whether sensors" in out


def test_a_thruster_column_that_is_misspelt_gets_its_name_and_comes_before_the_checks(
    tmp_path, capsys
):
    ship = tmp_path / "ship.toml"
    ship.write_text(
        'name = "S"\nlength = 5\n[[thruster]]\ntype = "azimuth"\nspeed = "n"\nangle = "aft"\n'
        '[columns]\n"Azimuth PS" = "aft"\n'
    )
    raw = data().rename(columns={"alpha1": "Azimuth PS [rad]"})
    raw.to_csv(tmp_path / "raw.csv", index=False)
    given = ["import", tmp_path / "raw.csv", "--vessel", ship, "--out", tmp_path / "o.csv"]
    status, out, _ = run(capsys, *given)
    assert status == 0
    assert "'aft', which no file has. Did you mean 'Azimuth PS [rad]'?\n" in out
    assert "next: name the raw column of aft, with its unit, in the vessel file's [columns]" in out
    assert "greybox check" not in out
    raw.rename(columns={"psi": "Compass"}).to_csv(tmp_path / "raw.csv", index=False)
    _, out, _ = run(capsys, *given)
    assert "next: name the raw columns of psi, aft, with their units" in out


def sparse(path):
    with open(path, "wb") as handle:
        handle.truncate(10 * 2**30)


BAD = {
    "empty.csv": b"", "empty.parquet": b"", "empty.nmea": b"", "random.csv": os.urandom(3000),
    "random.parquet": os.urandom(3000), "random.nmea": os.urandom(3000),
    "random.bin": os.urandom(300), "sparse.csv": sparse, "sparse.nmea": sparse,
    "sparse.parquet": sparse, "zip.csv": b"PK\x03\x04" + bytes(100),
    "pickle.csv": pickle.dumps({"t": 1}), "header.csv": b"t,u,v\n", "text.nmea": b"hello\n" * 99,
    "text.parquet": b"t,u\n1,2\n", "csv.xlsx": b"t,u\n1,2\n",
    "still.csv": b"t,foo\n" + b"1,2\n" * 9,
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_files_end_in_one_message_and_leave_nothing(tmp_path, capsys, name):
    raw = tmp_path / name
    BAD[name](raw) if callable(BAD[name]) else raw.write_bytes(BAD[name])
    status, out, err = run(
        capsys, "import", raw, "--vessel", "thesis", "--out", tmp_path / "log.csv"
    )
    assert status == 1
    assert out == ""
    assert err.startswith("greybox import: ")
    assert err.count("\n") == 1
    assert name in err
    assert os.listdir(tmp_path) == [name]


def test_a_log_that_was_there_survives_a_failure(tmp_path, capsys):
    (tmp_path / "log.csv").write_text("kept")
    (tmp_path / "log.csv.json").write_text("kept too")
    (tmp_path / "raw.csv").write_text("t,u\n" + "1,2\n" * 2)
    status, _, _ = run(
        capsys, "import", tmp_path / "raw.csv", "--vessel", "thesis", "--out", tmp_path / "log.csv"
    )
    assert status == 1
    assert (tmp_path / "log.csv").read_text() == "kept"
    assert (tmp_path / "log.csv.json").read_text() == "kept too"


def test_a_file_is_not_written_over_itself(tmp_path, capsys):
    raw = tmp_path / "raw.csv"
    data().to_csv(raw, index=False)
    before = raw.read_bytes()
    status, _, err = run(capsys, "import", raw, "--vessel", "thesis", "--out", raw)
    assert status == 1
    assert "--out would write over" in err
    assert raw.read_bytes() == before


@pytest.mark.parametrize("out", ["logs", "logs/"])
def test_a_file_where_the_folder_should_be(tmp_path, capsys, out):
    for name in ("a.csv", "b.csv"):
        data().to_csv(tmp_path / name, index=False)
    (tmp_path / "logs").write_text("mine")
    status, _, err = run(
        capsys, "import", tmp_path / "a.csv", tmp_path / "b.csv", "--vessel", "thesis", "--out",
        f"{tmp_path}/{out}",
    )  # fmt: skip
    assert status == 1
    assert "cannot make the folder" in err
    assert len(err.splitlines()) == 1
    assert (tmp_path / "logs").read_text() == "mine"


def test_devices_and_full_disks(tmp_path, capsys, monkeypatch):
    raw = tmp_path / "raw.csv"
    data().to_csv(raw, index=False)
    status, _, err = run(capsys, "import", raw, "--vessel", "thesis", "--out", "/dev/null")
    assert status == 1
    assert "a device or a pipe" in err

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("greybox.trial.store._write_tables", full)
    out = tmp_path / "log.csv"
    status, _, err = run(capsys, "import", raw, "--vessel", "thesis", "--out", out)
    assert status == 1
    assert "No space left on device. Nothing was written" in err
    assert os.listdir(tmp_path) == ["raw.csv"]


def mutated(rng, content):
    out = bytearray(content)
    for _ in range(rng.choice([1, 3, 30])):
        at, kind = rng.randrange(len(out)), rng.random()
        if kind < 0.4:
            out[at] = rng.randrange(256)
        elif kind < 0.7:
            out[at:at] = rng.choice(
                [b",", b"\n", b'"', b"\0", b"nan", b"1e999", b"\xff", b"$", b";"]
            )
        else:
            del out[at : at + rng.choice([1, 10, 200])]
        out = out or bytearray(b"x")
    return bytes(out)


@pytest.mark.parametrize("seed", range(40))
def test_damaged_files_give_a_log_or_a_message(tmp_path, capsys, seed):
    rng = random.Random(seed)
    ending = rng.choice([".csv", ".parquet", ".nmea"])
    whole = tmp_path / "whole"
    if ending == ".nmea":
        content = nmea()
    elif ending == ".csv":
        content = data().to_csv(index=False, sep=rng.choice(",;\t ")).encode()
    else:
        data().to_parquet(whole)
        content = whole.read_bytes()
    (tmp_path / f"raw{ending}").write_bytes(mutated(rng, content))
    whole.unlink(missing_ok=True)
    status, _, err = run(
        capsys, "import", tmp_path / f"raw{ending}", "--vessel", "thesis",
        "--out", tmp_path / "log.csv",
    )  # fmt: skip
    left = sorted(os.listdir(tmp_path))
    if status == 0:
        assert left == sorted(["log.csv", "log.csv.json", f"raw{ending}"])
    else:
        assert status == 1
        assert err.count("\n") == 1
        assert left == [f"raw{ending}"]


MAST = (4.0, -1.5, 5.0)
MAST_SHIP = f"""name = "S"
length = 30
[[thruster]]
type = "azimuth"
speed = "n"
angle = "alpha1"
[sensors]
anemometer = [{MAST[0]}, {MAST[1]}, {MAST[2]}]
"""


def turning(seconds=90):
    """NMEA of a ship in a steady turn, and ν_q of its origin in the wind at 10 m.

    Complex numbers, north + i east: the mast's velocity is the derivative of its path.
    """
    rate, heading = 0.04, 0.3
    psi = heading + rate * np.arange(seconds)
    bow = np.exp(1j * psi)
    ground = (2.0 + 0.2j) * bow
    mast = ground + 1j * rate * complex(*MAST[:2]) * bow
    wind = 4.0 - 3.0j
    felt = (wind - mast) / bow
    towards = np.angle(-felt)
    lines = []
    for k in range(seconds):
        course = np.degrees(np.angle(ground[k])) % 360
        for body in (
            f"GPRMC,10{k // 60:02}{k % 60:02}.00,A,6325.0,N,01024.0,E,"
            f"{abs(ground[k]) * 3600 / 1852:.9f},{course:.9f},010623,,,A",
            f"HEHDT,{np.degrees(psi[k]) % 360:.9f},T", f"TIROT,{np.degrees(rate) * 60:.9f},A",
            f"WIMWV,{np.degrees(towards[k]) % 360:.9f},R,{abs(felt[k]):.9f},M,A",
        ):  # fmt: skip
            check = 0
            for c in body.encode():
                check ^= c
            lines.append(f"${body}*{check:02X}\r\n")
    through = (ground - wind * 2 ** (1 / 7)) / bow
    return "".join(lines).encode(), through


def test_wind_is_moved_from_the_mast_and_brought_to_a_height(tmp_path, capsys):
    ship, out = tmp_path / "ship.toml", tmp_path / "log.csv"
    ship.write_text(MAST_SHIP)
    sentences, through = turning()
    (tmp_path / "all.nmea").write_bytes(sentences)
    arguments = ("--vessel", ship, "--reference-height", 10, "--out", out)
    status, said, _ = run(capsys, "import", tmp_path / "all.nmea", *arguments)
    assert status == 0
    assert "u_q, v_q moved from the anemometer at (4, -1.5) m to the origin" in said
    assert "true wind brought from 5 to 10 m (1/7 power law)" in said
    log = pd.read_csv(out)
    first = round(float(log["t"].iloc[0]))
    np.testing.assert_allclose(
        log["u_q"] + 1j * log["v_q"], through[first : first + len(log)], atol=1e-7
    )
    # no height of the anemometer is known
    ship.write_text(MAST_SHIP.partition("[sensors]")[0])
    status, _, err = run(capsys, "import", tmp_path / "all.nmea", *arguments)
    assert status == 1
    assert "cannot be brought to 10 m without the height of the anemometer" in err


@pytest.mark.parametrize("cells", [None, 0], ids=["memory", "blocks"])
def test_a_log_that_is_imported_again_is_the_same(tmp_path, capsys, monkeypatch, cells):
    ship = tmp_path / "ship.toml"
    ship.write_text(MAST_SHIP)
    (tmp_path / "all.nmea").write_bytes(turning()[0])
    if cells is not None:
        monkeypatch.setattr("greybox.trial.convert.two_pass_import._LARGE_CELLS", cells)
    source = "all.nmea"
    records = []
    for name in ("a.csv", "b.csv", "c.csv"):
        assert run(
            capsys, "import", tmp_path / source, "--vessel", ship, "--reference-height", 10,
            "--out", tmp_path / name, *(("--note", "draught=1.2") if name == "a.csv" else ()),
        )[0] == 0  # fmt: skip
        records.append(json.loads((tmp_path / f"{name}.json").read_text()))
        source = name
    assert (tmp_path / "b.csv").read_bytes() == (tmp_path / "a.csv").read_bytes()
    assert (tmp_path / "c.csv").read_bytes() == (tmp_path / "a.csv").read_bytes()
    for key in ("steps", "derived", "conditions"):
        assert records[0][key] == records[1][key] == records[2][key] != []
    assert records[0]["conditions"] == {"draught": 1.2}


def test_an_option_that_acted_on_nothing_is_told(tmp_path, capsys):
    raw, out = tmp_path / "raw.csv", tmp_path / "log.csv"
    table = data(300).drop(columns=["u_q", "v_q"])
    options = ("--velocities", "savgol", "--window", "5", "--origin", "58,15")
    table.to_csv(raw, index=False)
    given = ("import", raw, "--vessel", "thesis", "--out", out, *options)
    status, said, _ = run(capsys, *given, "--reference-height", "10")
    assert status == 0
    assert "note: --velocities savgol changed nothing, as no velocity was made from" in said
    assert "note: --origin changed nothing, as no position came from latitude and" in said
    assert "note: --reference-height changed nothing, as the log has no wind" in said
    # a window for a channel of its own makes no velocity
    assert "note: --velocities savgol" in run(capsys, *given, "--smooth", "r=6")[1]
    table.drop(columns=["u", "v"]).to_csv(raw, index=False)
    assert "note: --velocities savgol" not in run(capsys, *given)[1]


def test_a_height_is_changed_from_that_of_the_log(tmp_path, capsys):
    ship = tmp_path / "ship.toml"
    ship.write_text(MAST_SHIP)
    (tmp_path / "all.nmea").write_bytes(turning()[0])
    for source, height, name in (
        ("all.nmea", 10, "ten"), ("ten.csv", 20, "by_ten"), ("all.nmea", 20, "direct"),
    ):  # fmt: skip
        assert run(
            capsys, "import", tmp_path / source, "--vessel", ship, "--reference-height", height,
            "--out", tmp_path / f"{name}.csv",
        )[0] == 0  # fmt: skip
    one, two = pd.read_csv(tmp_path / "by_ten.csv"), pd.read_csv(tmp_path / "direct.csv")
    pd.testing.assert_frame_equal(one, two, rtol=1e-12)


def test_winds_in_two_states_are_not_merged(tmp_path, capsys):
    ship = tmp_path / "ship.toml"
    ship.write_text(MAST_SHIP)
    (tmp_path / "all.nmea").write_bytes(turning()[0])
    command = ("--vessel", ship, "--out")
    assert run(capsys, "import", tmp_path / "all.nmea", *command, tmp_path / "a.csv")[0] == 0
    later = pd.read_csv(tmp_path / "a.csv")
    later["t"] += json.loads((tmp_path / "a.csv.json").read_text())["epoch"] + 90
    later.to_csv(tmp_path / "later.csv", index=False)
    status, _, err = run(
        capsys, "import", tmp_path / "a.csv", tmp_path / "later.csv", *command, tmp_path / "b.csv"
    )
    assert status == 1
    assert "the wind of 'a' is moved to the origin and at the height of its sensor, that of" in err
    assert "'later' is not moved" in err


def test_topics_of_a_bag_are_chosen_and_named(tmp_path, capsys):
    bag = tmp_path / "trial.mcap"
    t = 0.5 * np.arange(60)
    said = {
        "/nav": [{"heading": 0.1 * s, "over_ground": {"ahead": 2.0 + s / 9}} for s in t],
        "/engine": [{"speed": 100.0 + s} for s in t],
        "/other": [{"psi": 9.0, "u": 9.0} for _ in t],
    }
    with open(bag, "wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, messages in said.items():
            channel = writer.register_channel(topic, "json", 0)
            for s, message in zip(t, messages, strict=True):
                nanos = 1_714_550_400 * 10**9 + int(1e9 * s)
                writer.add_message(channel, nanos, json.dumps(message).encode(), nanos)
        writer.finish()
    arguments = ("import", bag, "--vessel", "thesis", "--out", tmp_path / "log.csv")
    status, _, _ = run(
        capsys, *arguments, "--topic", "/nav=heading=psi,over_ground.ahead=u",
        "--topic", "/engine=n",
    )  # fmt: skip
    assert status == 0
    log = pd.read_csv(tmp_path / "log.csv")
    np.testing.assert_allclose(log["psi"], 0.1 * log["t"])
    np.testing.assert_allclose(log["u"], 2 + log["t"] / 9)
    # a command is held: the mean over the sample that follows
    np.testing.assert_allclose(log["n"], 100 + log["t"])
    for given, words in (
        ("/nva=psi", "no topic '/nva'. Did you mean '/nav'"),
        ("/nav=headin=psi", "no numeric field 'headin'"),
        ("=psi", "--topic =psi has no value"),
    ):
        status, _, err = run(capsys, *arguments, "--topic", given)
        assert status == 1
        assert words in err
    table = ("import", tmp_path / "log.csv", *arguments[2:-1], tmp_path / "again.csv")
    status, _, err = run(capsys, *table, "--topic", "/nav=psi")
    assert status == 1
    assert "--topic names /nav, and no raw file is a ROS bag" in err
    assert not (tmp_path / "again.csv").exists()


@pytest.mark.parametrize("cells", [None, 0], ids=["memory", "blocks"])
def test_channels_are_smoothed_where_asked(tmp_path, capsys, monkeypatch, limited, cells):
    if cells is not None:
        monkeypatch.setattr("greybox.trial.convert.two_pass_import._LARGE_CELLS", cells)
        monkeypatch.setattr("greybox.trial.convert.two_pass_import._BLOCK_ROWS", 50)
        limited(block_bytes=1 << 12)
    rng = np.random.default_rng(5)
    table = data(300).drop(columns=["r"])
    table["psi"] = 0.3 + 0.01 * table["t"]
    table["v"] = 0.1 * rng.standard_normal(300)
    table["u"] = rng.standard_normal(300)
    table = table.drop(index=[*range(100, 110), *range(114, 120)])
    table.to_csv(tmp_path / "raw.csv", index=False)
    out = tmp_path / "log.csv"
    arguments = ("import", tmp_path / "raw.csv", "--vessel", "thesis", "--out", out)
    status, said, _ = run(
        capsys, *arguments, "--smooth", "u=4", "--smooth", "r=2.9", "--smooth", "psi=2"
    )
    assert status == 0
    record = json.loads((tmp_path / "log.csv.json").read_text())
    assert record["derived"] == [
        "u smoothed over 4 s (local polynomials of order 2)",
        "psi smoothed over 2 s (local polynomials of order 2)",
        "r from heading by central differences (3.57)",
        "r smoothed over 2.9 s (local polynomials of order 2)",
    ]
    assert record["command"]["smooth"] == ["u=4", "r=2.9", "psi=2"]
    assert "u smoothed over 4 s" in said
    # the four samples between two gaps are fewer than a window
    assert [s[2] for s in record["segments"]] == [98, 178]
    log = pd.read_csv(out).set_index("t")
    np.testing.assert_allclose(log["r"], 0.01, atol=1e-12)
    raw = table.set_index("t")
    np.testing.assert_array_equal(log["v"], raw["v"][log.index])
    for at in (0.5, 20.0, 49.0, 60.5, 100.0, 149.0):
        # the parabola through the nine samples around, of the outermost at the ends
        stretch = raw["u"].loc[:49.5] if at < 50 else raw["u"].loc[60.0:]
        k = int(np.clip(stretch.index.get_loc(at), 4, len(stretch) - 5))
        near = stretch.iloc[k - 4 : k + 5]
        fitted = np.polyval(np.polyfit(near.index - at, near, 2), 0.0)
        assert log["u"][at] == pytest.approx(fitted, abs=1e-9)


@pytest.mark.parametrize("cells", [None, 0], ids=["memory", "blocks"])
@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("r", "--smooth r has no value"),
        ("r=0", "--smooth r has a window of '0', it must be a positive number of seconds"),
        ("r=-1", "'-1', it must be a positive number"), ("r=nan", "'nan', it must be a positive"),
        ("r=x", "'x', it must be a positive"), ("r=1e999", "'1e999', it must be a positive"),
        ("psy=4", "'psy' cannot be smoothed, for the log has no such channel. Did you mean 'psi'?"),
        ("t=4", "'t' cannot be smoothed, for the log has no such channel"),
        ("rr=1", "'rr' cannot be smoothed, for the log has no such channel. Did you mean 'r'?"),
        ("r=1", "r cannot be smoothed: a window of 1 s holds 3 samples of 0.5 s, order 2 needs 4"),
        ("r=50", "a window of 50 s holds 101 samples, the log has 60: use a window of at most 29"),
        ("r=25", "no 51 that follow each other"),
    ],
)  # fmt: skip
def test_windows_that_cannot_be(tmp_path, capsys, monkeypatch, cells, given, words):
    if cells is not None:
        monkeypatch.setattr("greybox.trial.convert.two_pass_import._LARGE_CELLS", cells)
    table = data()
    (table.drop(index=range(30, 36)) if given == "r=25" else table).to_csv(
        tmp_path / "raw.csv", index=False
    )
    status, _, err = run(
        capsys, "import", tmp_path / "raw.csv", "--vessel", "thesis",
        "--out", tmp_path / "log.csv", "--smooth", given,
    )  # fmt: skip
    assert status == 1
    assert words in err
    assert err.count("\n") == 1
    assert os.listdir(tmp_path) == ["raw.csv"]


def test_notes_that_all_files_share_are_told_once(tmp_path, capsys):
    ship = tmp_path / "ship.toml"
    ship.write_text('name = "S"\nlength = 2\n[[thruster]]\ntype = "fixed"\nspeed = "n"\n')
    rows = "".join(f"{0.2 * k:.1f};{k};{5 + k}\n" for k in range(40))
    for name, more in (("a", ""), ("b", ";Volt"), ("c", "")):
        filled = rows.replace("\n", ";12\n") if more else rows
        (tmp_path / f"{name}.csv").write_text(f"t;Heading [deg];n{more}\n{filled}")
    files = [str(tmp_path / f"{n}.csv") for n in "abc"]
    assert main(["import", *files, "--vessel", str(ship), "--out", str(tmp_path / "logs")]) == 0
    told = capsys.readouterr().out
    assert told.count("Heading [deg] taken for psi in deg") == 1
    assert "note: all files: Heading [deg] taken for psi in deg" in told
    # what one file alone has stays with it
    assert (
        told.index("b.csv: ") < told.index("note: columns not used: Volt") < told.index("c.csv: ")
    )
    assert main(["import", files[0], "--vessel", str(ship), "--out", str(tmp_path / "l.csv")]) == 0
    assert "note: Heading [deg] taken for psi in deg" in capsys.readouterr().out
