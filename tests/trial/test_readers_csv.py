"""CSV and Parquet as people and programs write them."""

from __future__ import annotations

import contextlib
import datetime
import pickle
import zipfile
from dataclasses import replace
from time import process_time

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

from greybox.errors import LogError
from greybox.trial.convert.channel_mapping import read_recording
from greybox.trial.readers import cells
from greybox.trial.readers.csv import open_csv
from greybox.trial.readers.formats import open_raw
from greybox.trial.readers.parquet import open_parquet
from greybox.trial.readers.table import read_columns
from greybox.vessel.toml import vessel_from_dict
from greybox.vessel.vessel import ColumnMapping

SHIP = {
    "name": "S",
    "length": 5,
    "thruster": [{"type": "azimuth", "speed": "n", "angle": "a"}],
}
VESSEL = vessel_from_dict(SHIP)


def frame(n=50, seed=0):
    rng = np.random.default_rng(seed)
    t = np.round(np.arange(n) * 0.1, 1)
    names = ("x_n", "y_n", "psi", "u", "v", "r", "n", "a")
    return pd.DataFrame({"t": t} | {k: rng.normal(size=n) for k in names})


def read(path):
    table = open_raw(path)
    return pd.DataFrame(read_columns(table, table.columns)), table


def written(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


LAYOUTS = {
    "plain": {},
    "semicolon and comma": {"sep": ";", "decimal": ","},
    "tab and comma": {"sep": "\t", "decimal": ","},
    "bar": {"sep": "|"},
    "crlf": {"lineterminator": "\r\n"},
    "cr": {"lineterminator": "\r"},
    "quoted": {"quoting": 1},
    "bom": {"encoding": "utf-8-sig"},
    "utf-16": {"encoding": "utf-16"},
    "blank": {"sep": " "},
    "exponent": {"float_format": "%.17e"},
}


@pytest.mark.parametrize("how", LAYOUTS)
def test_layouts_give_what_pandas_wrote(tmp_path, how):
    wanted = frame()
    wanted.to_csv(tmp_path / "x.csv", index=False, **LAYOUTS[how])
    found, _ = read(tmp_path / "x.csv")
    pd.testing.assert_frame_equal(found, wanted, check_exact=True)


@pytest.mark.parametrize("rows", [3, 59, 60, 61, 5000])
def test_rows_are_neither_lost_nor_doubled(tmp_path, rows):
    wanted = frame(rows)
    text = "\n\n# by a logger\nGroup A\n" + wanted.to_csv(index=False).replace("\n", "\n\n", 1)
    found, table = read(written(tmp_path / "x.csv", text))
    pd.testing.assert_frame_equal(found, wanted, check_exact=True)
    assert table.notes == ["2 lines before the header skipped"]


def test_aligned_columns_with_decimal_commas(tmp_path):
    wanted = frame().round(4)
    text = wanted.to_string(index=False, decimal=",").replace("\n", " \n") + "\n"
    found, _ = read(written(tmp_path / "x.txt", text))
    np.testing.assert_allclose(found, wanted, atol=1e-4)


def test_names_in_a_comment_as_numpy_writes_them(tmp_path):
    wanted = frame()
    path = tmp_path / "x.csv"
    np.savetxt(
        path, wanted, delimiter=",", header="made by numpy\n" + ",".join(wanted), fmt="%.17g"
    )
    found, table = read(path)
    pd.testing.assert_frame_equal(found, wanted, check_exact=True)
    assert "names of the columns read from a comment" in table.notes


@pytest.mark.parametrize("units", ["s,m,m,deg,kn,kn,deg/s,rpm,deg", "[s],[m],,[deg],[kn],[kn],,,"])
def test_second_header_line_of_units(tmp_path, units):
    text = frame().to_csv(index=False).split("\n", 1)
    found, table = read(written(tmp_path / "x.csv", f"{text[0]}\n{units}\n{text[1]}"))
    assert len(found) == 50
    assert table.units["psi"] == "deg"
    assert "second header line read as units" in table.notes


def test_second_header_line_of_words(tmp_path):
    text = frame().to_csv(index=False).split("\n", 1)
    words = "time,north,east,bow,ahead,aside,turn,prop,pod"
    found, table = read(written(tmp_path / "x.csv", f"{text[0]}\n{words}\n{text[1]}"))
    assert len(found) == 50
    assert "second header line skipped" in table.notes


def test_delimiters_at_the_ends_of_rows(tmp_path):
    wanted = frame()
    text = wanted.to_csv(index=False)
    for change in (lambda s: s.replace("\n", ",\n"), lambda s: s.replace("\n", ",\n").replace(
        ",\n", "\n", 1
    )):  # fmt: skip
        found, _ = read(written(tmp_path / "x.csv", change(text)))
        pd.testing.assert_frame_equal(found[list(wanted)], wanted, check_exact=True)


def test_damaged_cells_and_rows_are_counted(tmp_path):
    lines = frame().to_csv(index=False).splitlines()
    lines[5] = lines[5].replace(lines[5].split(",")[4], "12 m/s")
    lines[9] = lines[9] + ",1"
    lines[20] = "# stopped for lunch"
    text = "\n".join(lines).encode() + b"\n5.0,1,2,3"
    text = text.replace(lines[30].encode(), b"\xff\xfe," + lines[30].encode())
    found, table = read(written(tmp_path / "x.csv", text))
    assert len(found) == 47
    assert np.isnan(found["u"][4])
    assert "3 rows with another number of fields than the 9 of the header left out" in table.notes
    assert "the last line has no end: left out, since it may be cut" in table.notes
    assert "column 'u' holds words in 1 row: read as missing" in table.notes


def test_half_a_number_at_the_end_is_no_number(tmp_path):
    whole = frame().to_csv(index=False)
    found, table = read(written(tmp_path / "x.csv", whole[:-5].encode()))
    assert len(found) == len(frame()) - 1
    assert table.notes == ["the last line has no end: left out, since it may be cut"]


def test_numbers_as_people_write_them(tmp_path):
    cells = ["+1.5", " 2.5 ", "1.0D+02", "\u22123.5", "1e-3", ".5", "5.", "NaN", "-", "", "inf"]
    text = "t,u,n,a\n" + "".join(f"{k},{c},0,0\n" for k, c in enumerate(cells))
    found, table = read(written(tmp_path / "x.csv", text))
    wanted = [1.5, 2.5, 100, -3.5, 1e-3, 0.5, 5, *[np.nan] * 4]
    np.testing.assert_array_equal(found["u"], wanted)
    assert table.notes == []


def test_a_decimal_comma_that_comes_late(tmp_path):
    text = "t;u\n" + "".join(f"{k};1\n" for k in range(200)) + "200;1,5\n"
    found, _ = read(written(tmp_path / "x.csv", text))
    assert found["u"].iloc[-1] == 1.5


def test_one_byte_encodings_and_their_mixture(tmp_path):
    text = ("t,Geschwindigkeit (m/s),Größe [°]\n" + "1.0,2.0,3.0\n" * 9).encode("cp1252")
    found, table = read(written(tmp_path / "x.csv", text))
    assert table.columns[2] == "Größe [°]"
    assert "text in cp1252" in table.notes
    assert found.shape == (9, 3)
    rows = b"t,u,note\n" + b"1,2,sm\xc3\xb8rbr\xc3\xb8d\n" * 20000 + b"1,2,K\xf8benhavn\n"
    found, _ = read(written(tmp_path / "y.csv", rows))
    assert found["note"].iloc[0] == "smørbrød"
    assert len(found) == 20001


STAMPS = {
    "2024-05-01T12:00:00": 1714564800,
    "2024-05-01 12:00:00.25": 1714564800.25,
    "2024-05-01T12:00:00Z": 1714564800,
    "2024-05-01T12:00:00.5+02:00": 1714557600.5,
    "2024/05/01 12:00:00": 1714564800,
    "01.05.2024 12:00:00": 1714564800,
    "2024-05-01 12:00:00,25": 1714564800.25,
}


@pytest.mark.parametrize("stamp", STAMPS)
def test_dates(tmp_path, stamp):
    text = "time;u\n" + f"{stamp};1\n" * 3
    found, table = read(written(tmp_path / "x.csv", text))
    assert table.dates == {"time"}
    np.testing.assert_allclose(found["time"], STAMPS[stamp], rtol=0, atol=2e-7)


def test_times_of_day_go_on_past_midnight(tmp_path):
    text = "time,u\n" + "".join(f"{k // 3600 % 24:02}:{k // 60 % 60:02}:{k % 60:02}.5,1\n"
                                for k in range(86380, 86420))  # fmt: skip
    recording = read_recording(written(tmp_path / "x.csv", text), VESSEL)
    np.testing.assert_allclose(np.diff(recording["u"].t), 1)


@pytest.mark.parametrize("form", ["%I:%M:%S %p", "%Y-%m-%d %I:%M:%S %p", "%I:%M:%S.0%p"])
def test_a_clock_of_twelve_hours_goes_past_noon_and_midnight(tmp_path, form):
    """Hours 12 AM and 12 PM are 0 and 12: a column over both has even steps."""
    stamps = pd.date_range("2024-05-01 11:50:00", periods=1500, freq="min")
    table = frame(len(stamps)).drop(columns="t").assign(time=stamps.strftime(form).str.lower())
    table.to_csv(tmp_path / "x.csv", index=False)
    recording = read_recording(tmp_path / "x.csv", VESSEL)
    np.testing.assert_allclose(np.diff(recording["u"].t), 60)


def test_an_hour_that_no_half_of_a_day_has_is_no_time(tmp_path):
    table = frame().assign(t=[f"02:15:{k:02} PM" for k in range(50)])
    table.loc[7, "t"] = "14:15:07 PM"
    table.to_csv(tmp_path / "x.csv", index=False)
    recording = read_recording(tmp_path / "x.csv", VESSEL)
    assert "column 't' holds what is no time in 1 row: read as missing" in recording.notes
    assert np.isnan(recording["u"].t).sum() == 1


SIDED = {
    "behind": ["10.0 S", "10.0 P", "0.0 P", "2.5 s", "7"],
    "before": ["S10", "P 10", "P 0", "S 2.5", "7"],
    "words": ["10 Starboard", "Port: 10", "0 port", "STBD 2.5", "7"],
    "degrees": ["10° S", "10°P", "0 P", "2.5 deg S", "7"],
    "commas": ["10,0 S", "10,0 P", "0,0 P", "2,5 S", "7"],
}


@pytest.mark.parametrize("cells_of", SIDED.values(), ids=SIDED)
def test_a_rudder_to_starboard_is_positive(tmp_path, cells_of):
    table = frame().assign(a=np.resize(np.array(cells_of, object), 50))
    table.to_csv(tmp_path / "x.csv", index=False, sep=";")
    found, made = read(tmp_path / "x.csv")
    np.testing.assert_array_equal(found["a"][:5], [10, -10, 0, 2.5, 7])
    assert "column 'a' names sides: starboard is positive, port negative" in made.notes


def test_what_names_no_side_is_told(tmp_path):
    table = frame().assign(a=["10.0 S", "10.0 P"] * 25)
    # a side and a sign contradict each other
    table.loc[3:5, "a"] = ["10.0 X", "S 10 P", "-10.0 S"]
    table.to_csv(tmp_path / "x.csv", index=False)
    found, made = read(tmp_path / "x.csv")
    assert "column 'a' holds words in 3 rows: read as missing" in made.notes
    assert found["a"].isna().sum() == 3


@pytest.mark.parametrize(("name", "taken"), [("Rudder", True), ("Latitude", False)])
def test_one_side_alone_is_one_in_the_column_of_a_rudder(tmp_path, name, taken):
    frame().assign(**{name: "33.9 S"}).to_csv(tmp_path / "x.csv", index=False)
    assert (name in open_csv(tmp_path / "x.csv").sides) == taken


@pytest.mark.parametrize(
    ("text", "read"),
    [("2026-06-02 09:30:{:02}", "dates"), ("09:30:{:02}", "times of day")],
)
def test_dates_are_not_said_to_be_seconds(tmp_path, text, read):
    table = frame().head(50)
    times = [text.format(k) for k in range(len(table))]
    named = {n: table.drop(columns="t").assign(**{n: times}) for n in ("Time_UTC", "Datum")}
    for name, made in named.items():
        made.to_csv(tmp_path / f"{name}.csv", index=False)
    recording = read_recording(tmp_path / "Time_UTC.csv", VESSEL)
    assert f"column 'Time_UTC' taken for time by its {read}" in recording.notes
    with pytest.raises(LogError, match=r'\[columns\], such as "Datum" = "t" \(dates and'):
        read_recording(tmp_path / "Datum.csv", VESSEL)
    mapped = replace(VESSEL, columns={"Datum": ColumnMapping("t", None)})
    np.testing.assert_allclose(np.diff(read_recording(tmp_path / "Datum.csv", mapped)["u"].t), 1)


@pytest.mark.parametrize(("unit", "factor"), [("s", 1), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
@pytest.mark.parametrize("name", ["t", "timestamp"])
def test_unix_times(tmp_path, unit, factor, name):
    table = frame().rename(columns={"t": name})
    table[name] = ((1714564800 + np.arange(50) * 0.1) * factor).round(2)
    table.to_csv(tmp_path / "x.csv", index=False, float_format="%.2f")
    recording = read_recording(tmp_path / "x.csv", VESSEL)
    assert recording.epoch == pytest.approx(1714564800)
    np.testing.assert_allclose(recording["u"].t, np.arange(50) * 0.1, atol=1e-6)
    if name == "timestamp" or unit != "s":
        assert f"column '{name}' taken for time in {unit}" in recording.notes


def test_one_damaged_time_does_not_change_the_unit(tmp_path):
    table = frame()
    table.loc[7, "t"] = 1.7e18
    table.rename(columns={"t": "time"}).to_csv(tmp_path / "x.csv", index=False)
    recording = read_recording(tmp_path / "x.csv", VESSEL)
    assert recording["u"].t[8] == pytest.approx(0.8)


def test_thousands_of_columns(tmp_path):
    names = ["t", *(f"c{k}" for k in range(4000))]
    text = ",".join(names) + "\n" + (",".join(["0.123456789012345678"] * 4001) + "\n") * 5
    found, _ = read(written(tmp_path / "x.csv", text))
    assert found.shape == (5, 4001)
    wide = ",".join(f"c{k}" for k in range(5000)) + "\n" + "1," * 4999 + "1\n"
    with pytest.raises(LogError, match="names 5000 columns, at most 4096"):
        open_csv(written(tmp_path / "wide.csv", wide))


def test_columns_of_one_name(tmp_path):
    _, table = read(written(tmp_path / "x.csv", "t,u,u,u,u.2\n1,2,3,4,5\n2,3,4,5,6\n"))
    assert len(set(table.columns)) == 5
    assert "3 columns are called 'u': the last is taken as 'u.3'" in table.notes


def test_columns_may_stand_in_any_order(tmp_path):
    wanted = frame()
    wanted.to_csv(tmp_path / "a.csv", index=False)
    wanted[sorted(wanted, reverse=True)].to_csv(tmp_path / "b.csv", index=False)
    one, two = (read_recording(tmp_path / f"{x}.csv", VESSEL) for x in "ab")
    for name in one.names:
        np.testing.assert_array_equal(one[name].value, two[name].value)


def test_units_of_the_vessel_file_rescale(tmp_path):
    wanted = frame()
    wanted.to_csv(tmp_path / "a.csv", index=False)
    other = wanted.assign(
        u=wanted["u"] * 3600 / 1852, psi=np.degrees(wanted["psi"]), v=-wanted["v"]
    )
    other = other.rename(columns={"u": "STW", "psi": "Hd", "v": "Drift"})
    other.to_csv(tmp_path / "b.csv", index=False)
    mapped = vessel_from_dict(
        SHIP
        | {
            "columns": {
                "STW": {"name": "u", "unit": "kn"},
                "Hd": {"name": "psi", "unit": "deg"},
                "Drift": {"name": "v", "unit": "m/s", "sign": -1},
            }
        }
    )
    one = read_recording(tmp_path / "a.csv", VESSEL)
    two = read_recording(tmp_path / "b.csv", mapped)
    for name in ("u", "psi", "v"):
        np.testing.assert_allclose(one[name].value, two[name].value, rtol=1e-12)


def bad_csv():
    yield "empty", b"", "is empty"
    yield "blank", b"\n \n\n", "is empty"
    yield "comments", b"# a\n# b\n", "holds no rows"
    yield "header only", b"t,u,v\n", "header line of 3 names but no rows"
    yield "numbers only", b"1,2,3\n4,5,6\n", r"begins with numbers \(1, 2, 3\)"
    yield "binary", bytes(range(256)) * 20, "holds binary data"
    yield "control", b"\x01\x02\x03\x04abc\n" * 50, "control characters"
    yield "ambiguous", b"t,u\n" + b"1,5,2,5\n" * 9, "2 names in its header and 4 fields"
    yield "words", b"t,u\n" + b"one,two\n" * 9, "no rows|holds words"
    yield "dates", b"time,u\n" + b"5/1/24 3:00 PM,2\n" * 9, "holds '5/1/24 3:00 PM' where the time"
    yield "no time", b"u,v\n" + b"1,2\n" * 9, "no column 't'"
    yield "long line", b"t,u\n1,2\n" + b"7" * (1 << 23) * 3, "no column|cannot read|hold"
    yield "open quote", b't,u\n1,2\n"3,4\n' + b"5,6\n" * 50, "50 of 52 rows .* never closed"
    yield "narrow", b"t,u,v\n1,2,3\n" + b"1,2,3\n" * 80 + b"1,2\n" * 500, "500 of 581 rows"


@pytest.mark.parametrize(("content", "message"), [c[1:] for c in bad_csv()],
                         ids=[c[0] for c in bad_csv()])  # fmt: skip
def test_bad_csv(tmp_path, content, message):
    with pytest.raises(LogError, match=message):
        read_recording(written(tmp_path / "x.csv", content), VESSEL)


def test_one_line_of_ten_gigabytes(tmp_path):
    path = tmp_path / "x.csv"
    with open(path, "wb") as handle:
        handle.write(b"t,u\n1,2\n")
        handle.truncate(10 * 2**30)
    with pytest.raises(LogError, match="binary data"):
        read_recording(path, VESSEL)


def refused(folder):
    with zipfile.ZipFile(folder / "bomb.csv", "w", zipfile.ZIP_DEFLATED) as bomb:
        bomb.writestr("x.csv", b"0" * 10**7)
    (folder / "x.xlsx").write_bytes((folder / "bomb.csv").read_bytes())
    for protocol in range(6):
        (folder / f"p{protocol}.csv").write_bytes(pickle.dumps({"t": [1, 2]}, protocol))
    (folder / "c.csv").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    (folder / "x.csv").write_bytes(b"\x1f\x8b\x08" + bytes(50))
    (folder / "x.pkl").write_bytes(b"t,u\n1,2\n")
    return ["bomb.csv", "x.xlsx", *(f"p{k}.csv" for k in range(6)), "c.csv", "x.csv", "x.pkl"]


def test_archives_and_pickles_are_refused(tmp_path):
    for name in refused(tmp_path):
        with pytest.raises(LogError, match=r"is (a|compressed).*, not a log: unpack or export"):
            open_raw(tmp_path / name)


def test_paths_that_are_no_files(tmp_path):
    (tmp_path / "log.csv").write_text("t\n1\n")
    with pytest.raises(LogError, match=r"there is no file .* Did you mean 'log.csv'\?"):
        open_raw(tmp_path / "lg.csv")
    with pytest.raises(LogError, match="a folder without a ROS 2 bag"):
        open_raw(tmp_path)
    with pytest.raises(LogError, match="device or a pipe"):
        open_raw("/dev/null")
    with pytest.raises(LogError, match="cannot read"):
        open_raw(tmp_path / ("n" * 300 + ".csv"))
    (tmp_path / "log.xyz").write_text("t,u\n1,2\n")
    with pytest.raises(LogError, match="no known format"):
        open_raw(tmp_path / "log.xyz")
    # a shell that expands log* names the record too
    (tmp_path / "log.csv.json").write_text("{}")
    with pytest.raises(
        LogError, match=r"is the record of 'log.csv', .* logs alone, such as \*.csv"
    ):
        open_raw(tmp_path / "log.csv.json")


def test_parquet_types(tmp_path):
    table = frame()
    stamps = pd.Timestamp("2024-05-01T12:00:00.123456789Z") + pd.to_timedelta(table["t"], unit="s")
    full = table.assign(
        stamp=stamps,
        naive=stamps.dt.tz_localize(None),
        text=stamps.astype(str),
        day=datetime.date(2024, 5, 1),
        span=pd.to_timedelta(table["t"], unit="s"),
        flag=table["u"] > 0,
        small=table["u"].astype("float32"),
        count=np.arange(50, dtype="uint8"),
        mode=pd.Categorical(["dp", "manual"] * 25),
        code=pd.Categorical(np.repeat([1.5, 2.5], 25)),
        nested=[[1.0, 2.0]] * 50,
    )
    full["gap"] = pd.array([1, None] * 25, dtype="Int64")
    full.to_parquet(tmp_path / "x.parquet")
    found, opened = read(tmp_path / "x.parquet")
    for name in ("stamp", "naive", "text"):
        np.testing.assert_allclose(found[name] - found[name][0], table["t"], atol=3e-7)
        assert found[name][0] == pytest.approx(1714564800.123456789, abs=1e-6)
    assert found["day"][0] == 1714521600
    np.testing.assert_array_equal(found["flag"], full["flag"])
    np.testing.assert_array_equal(found["small"], full["small"])
    np.testing.assert_array_equal(found["code"], full["code"].astype(float))
    assert list(found["mode"]) == list(full["mode"])
    assert opened.units["span"] == "s"
    assert np.isnan(found["gap"][1])
    assert "column 'nested' is neither number, time nor text: left out" in opened.notes
    for time in ("stamp", "naive", "text", "span"):
        ship = vessel_from_dict(SHIP | {"columns": {time: {"name": "t", "unit": "s"}}})
        recording = read_recording(tmp_path / "x.parquet", ship)
        np.testing.assert_allclose(recording["u"].t, table["t"], atol=3e-7)


def test_parquet_bombs(tmp_path):
    path = tmp_path / "x.parquet"
    schema = pa.schema([("t", pa.float64())])
    with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        zeros = pa.table({"t": np.zeros(1 << 21)})
        for _ in range(2):
            writer.write_table(zeros)
    with pytest.raises(LogError, match=r"states 4194304 rows in .* at most 8 a byte"):
        open_parquet(path)


def test_a_parquet_row_group_that_unpacks_too_far(tmp_path, limited):
    limited(held_bytes=1 << 16)
    table = pa.table({"t": np.arange(1 << 16) // 100 * 1.0})
    parquet.write_table(table, tmp_path / "x.parquet", compression="zstd", use_dictionary=False)
    with pytest.raises(LogError, match=r"a row group of .* unpacks to \d+ bytes, at most 65536"):
        read(tmp_path / "x.parquet")


def test_a_parquet_row_group_of_long_texts(tmp_path, limited):
    limited(held_bytes=1 << 18)
    columns = {"t": np.arange(10.0), "u": np.arange(10.0)}
    table = pa.table(columns | {"said": ["x" * 10**5] * 10})
    options = {"compression": "none", "use_dictionary": False}
    parquet.write_table(table, tmp_path / "x.parquet", **options)
    with pytest.raises(LogError, match=r"has 1000\d\d bytes a row, more than the 65536 of any log"):
        read(tmp_path / "x.parquet")
    # bytes are no text: they are not read at all
    table = pa.table(columns | {"picture": [b"x" * 10**5] * 10})
    parquet.write_table(table, tmp_path / "x.parquet", **options)
    assert len(read(tmp_path / "x.parquet")[0]["u"]) == 10


@pytest.mark.parametrize("kind", [pa.string(), pa.large_string()])
@pytest.mark.parametrize("stored", [False, True])
def test_a_long_word_in_every_row_of_a_parquet_file(tmp_path, kind, stored):
    words = pa.array(["d" * 10**6, "dp"], kind)
    chosen = pa.array([0, 1, None, *[0] * 100_000], pa.int32())
    column = pa.DictionaryArray.from_arrays(chosen, words)
    table = pa.table({"t": np.arange(len(chosen)) * 1.0, "mode": column})
    # a decoded batch would hold 100 GB
    parquet.write_table(
        table, tmp_path / "x.parquet", compression="zstd", store_schema=stored,
        use_dictionary=["mode"], dictionary_pagesize_limit=1 << 24,
    )  # fmt: skip
    read_back = read(tmp_path / "x.parquet")[0]["mode"]
    assert list(read_back[:4]) == ["d" * 256, "dp", "", "d" * 256]


@pytest.mark.parametrize("kind", [pa.string(), pa.large_string()])
def test_long_words_are_cut(kind):
    words = cells.text(pa.array(["dp", None, "é" * 10**6], kind))
    assert list(words[:2]) == ["dp", ""]
    assert words[2] == "é" * 128


@pytest.mark.parametrize(
    ("tail", "words"),
    [
        ("a" * 70000, "a line is longer than 16384 bytes"),
        ('1,"' + "a\n" * 40000, "a quoted cell holds line ends, or its quote is never closed"),
    ],
)
def test_lines_without_an_end_after_a_good_start(tmp_path, limited, tail, words):
    limited(block_bytes=1 << 14)
    path = written(tmp_path / "x.csv", frame().to_csv(index=False) + tail)
    with pytest.raises(LogError, match=words):
        read(path)


def test_a_damaged_footer_does_not_end_the_process(tmp_path):
    """pyarrow throws through C++ where it is asked for the chunks of such files."""
    frame().to_parquet(tmp_path / "x.parquet")
    whole = bytearray((tmp_path / "x.parquet").read_bytes())
    for at in range(len(whole) - 1500, len(whole) - 8, 7):
        damaged = whole.copy()
        damaged[at] ^= 0x11
        with contextlib.suppress(LogError):
            read(written(tmp_path / "y.parquet", bytes(damaged)))


def test_bad_parquet(tmp_path):
    frame().to_parquet(tmp_path / "x.parquet")
    whole = (tmp_path / "x.parquet").read_bytes()
    for content in (whole[:-20], whole[: len(whole) // 2], b"PAR1", b"t,u\n1,2\n", whole[:4] * 9):
        with pytest.raises(LogError, match="as Parquet"):
            read(written(tmp_path / "y.parquet", content))
    with pytest.raises(LogError, match="is empty"):
        read(written(tmp_path / "y.parquet", b""))
    frame(50).head(0).to_parquet(tmp_path / "z.parquet")
    with pytest.raises(LogError, match="holds 0 rows"):
        read(tmp_path / "z.parquet")
    twice = pa.Table.from_arrays([pa.array([1.0]), pa.array([2.0])], names=["t", "t"])
    parquet.write_table(twice, tmp_path / "t.parquet")
    with pytest.raises(LogError, match="2 columns called 't'"):
        read(tmp_path / "t.parquet")


@pytest.mark.parametrize("part", [slice(None), slice(1, None), slice(3, 10), slice(5, 5)])
@pytest.mark.parametrize("values", [[1.5, None, -3.0] * 9, [None] * 12, [0.25] * 11, []])
def test_numbers_are_those_that_arrow_itself_gives(values, part):
    column = pa.array([None if v is None else str(v) for v in values], pa.string())[part]
    expected = column.cast(pa.float64()).to_numpy(zero_copy_only=False)
    np.testing.assert_array_equal(cells.numbers(column, ".", "u", {}), expected)


# short names of positions, and points between thousands


def track(n=200):
    t = np.arange(n) * 0.5
    return pd.DataFrame({"t": t, "n": 3 * t, "e": 20 * np.sin(t / 30), "heading": 0.1 * np.sin(t)})


UNCLAIMED = vessel_from_dict(
    {**SHIP, "thruster": [{"type": "azimuth", "speed": "rpm", "angle": "a"}]}
)


def test_north_and_east_may_be_called_n_and_e(tmp_path):
    track().to_csv(tmp_path / "x.csv", index=False)
    recording = read_recording(tmp_path / "x.csv", UNCLAIMED)
    np.testing.assert_array_equal(recording["x_n"].value, track()["n"])
    np.testing.assert_array_equal(recording["y_n"].value, track()["e"])
    assert "n taken for x_n in m, no unit being stated" in recording.notes


def test_positions_may_be_called_by_names_with_umlauts(tmp_path):
    table = track().rename(columns={"n": "Breite", "e": "Länge"})
    table.assign(Breite=54.0).to_csv(tmp_path / "x.csv", index=False)
    recording = read_recording(tmp_path / "x.csv", UNCLAIMED)
    np.testing.assert_array_equal(recording["lon"].value, track()["e"])


def test_a_speed_that_states_no_unit_says_what_to_do_about_knots(tmp_path):
    track().assign(AWS=5.0, AWA=0.1).to_csv(tmp_path / "x.csv", index=False)
    (said,) = (n for n in read_recording(tmp_path / "x.csv", UNCLAIMED).notes if "AWS" in n)
    assert said == (
        "AWS taken for V_q in m/s, no unit being stated (if it is in knots, say so in [columns])"
    )


@pytest.mark.parametrize("left_out", ["e", "n"])
def test_n_or_e_alone_is_no_position(tmp_path, left_out):
    track().drop(columns=left_out).to_csv(tmp_path / "x.csv", index=False)
    assert not {"x_n", "y_n"} & set(read_recording(tmp_path / "x.csv", UNCLAIMED).names)


def test_a_shaft_speed_that_the_vessel_claims_is_no_position(tmp_path):
    track().to_csv(tmp_path / "x.csv", index=False)
    recording = read_recording(tmp_path / "x.csv", VESSEL)
    assert "n" in recording.names
    assert not {"x_n", "y_n"} & set(recording.names)


@pytest.mark.parametrize("kind", ["held", "noise"])
def test_n_and_e_that_do_not_travel_are_no_positions(tmp_path, kind):
    data = track()
    rng = np.random.default_rng(0)
    data["n"] = 15.0 + np.arange(len(data)) // 60 if kind == "held" else rng.normal(size=len(data))
    data.to_csv(tmp_path / "x.csv", index=False)
    assert not {"x_n", "y_n"} & set(read_recording(tmp_path / "x.csv", UNCLAIMED).names)


def german(value):
    return f"{value:,.3f}".translate(str.maketrans(",.", ".,"))


@pytest.mark.parametrize("rows", [50, 5000])
def test_points_between_thousands_before_a_decimal_comma(tmp_path, rows):
    data = pd.DataFrame({"t": np.arange(rows) * 0.5, "x_n": 990.0 + np.arange(rows) * 1.25})
    data["psi"] = -0.5
    data.map(german).to_csv(tmp_path / "x.csv", sep=";", index=False)
    found, table = read(tmp_path / "x.csv")
    pd.testing.assert_frame_equal(found, data, check_exact=True)
    assert "column 'x_n' has points between thousands: 1.234,5 read as 1234.5" in table.notes


def test_points_that_are_no_thousands_stay_decimal(tmp_path):
    data = pd.DataFrame({"t": np.arange(50) * 0.5, "x_n": np.arange(50) * 1.25})
    texts = data.map(german)
    texts.loc[7, "x_n"] = "1.5"
    texts.loc[9, "x_n"] = "1.234,500"
    texts.to_csv(tmp_path / "x.csv", sep=";", index=False)
    found, _ = read(tmp_path / "x.csv")
    assert found.loc[7, "x_n"] == 1.5
    assert np.isnan(found.loc[9, "x_n"])


def test_damaged_numbers_in_columns_called_n_and_e_are_no_positions(tmp_path):
    rows = "".join(f"{0.1 * k:.1f},{1e300 * (-1) ** k},{k},0.1\n" for k in range(50))
    path = tmp_path / "log.csv"
    path.write_text("t,n,e,psi\n" + rows)
    ship = vessel_from_dict(
        {"name": "S", "length": 5, "thruster": [{"type": "fixed", "speed": "rps"}]}
    )
    assert not {"x_n", "y_n"} & set(read_recording(path, ship).names)


def test_a_number_of_a_million_digits_is_read_in_time(tmp_path):
    """Its digits are looked at once, whatever follows them."""
    start = process_time()
    assert not cells.is_number("9" * 10**6 + ",1;2", comma=True)
    assert process_time() - start < 1.0
    rows = b"t,u\n" + b"".join(b"%d,2\n" % k for k in range(9)) + b"9" * 10**6 + b",2\n"
    assert len(read(written(tmp_path / "x.csv", rows))[0]["u"]) == 10
