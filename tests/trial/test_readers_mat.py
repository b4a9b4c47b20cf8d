"""MATLAB files are made here: by SciPy, and by h5py with the attributes that MATLAB writes."""

from __future__ import annotations

import json
import mmap
import os
import pickle
import struct
import zlib
from dataclasses import asdict, replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy import sparse
from scipy.io import savemat

from greybox.errors import LogError
from greybox.trial.readers import mat_process, matfile
from greybox.trial.readers.mat import read_mat

N = 50
T = np.arange(N) * 0.1
U = np.sin(T)
START = 1_714_550_400.0  # 2024-05-01 08:00 UTC


# tests of what a process of its own is there for; a copy of this one reads as it does
OWN_PROCESS = {
    "test_columns_rows_and_matrices", "test_sizes_stated_without_bytes_are_refused",
    "test_a_file_that_needs_more_memory_than_it_may_is_refused",
    "test_a_reader_that_takes_too_long_is_ended", "test_a_reader_that_crashes_is_damage",
}  # fmt: skip


@pytest.fixture(autouse=True)
def forked(request, monkeypatch):
    """Read in a copy of this process, which has imported SciPy already."""

    def run(path, folder, bounds):
        child = os.fork()
        if not child:
            try:
                mat_process.main(str(path.resolve()), str(folder), json.dumps(asdict(bounds)))
            finally:
                os._exit(0)
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

    def restricted(most):
        held = int(Path("/proc/self/statm").read_text().split()[0]) * mmap.PAGESIZE
        bound(replace(most, process_bytes=held + most.process_bytes))

    bound = mat_process._restrict
    if request.function.__name__ not in OWN_PROCESS and Path("/proc/self/statm").exists():
        monkeypatch.setattr(mat_process, "_run", run)
        monkeypatch.setattr(mat_process, "_restrict", restricted)


def put(group, name, value):
    """Write one value as MATLAB 7.3 does: columns first, class as attribute."""
    if isinstance(value, dict):
        inner = group.create_group(name)
        inner.attrs["MATLAB_class"] = np.bytes_("struct")
        for key, item in value.items():
            put(inner, key, item)
    elif isinstance(value, list):
        refs = group.file.require_group("#refs#")
        made = [put(refs, f"r{len(refs)}", v) for v in value]
        data = np.array([[d.ref] for d in made], dtype=h5py.ref_dtype)
        item = group.create_dataset(name, data=data)
        item.attrs["MATLAB_class"] = np.bytes_("cell")
    elif isinstance(value, str):
        codes = np.frombuffer(value.encode("utf-16-le"), np.uint16).reshape(-1, 1)
        item = group.create_dataset(name, data=codes)
        item.attrs["MATLAB_class"] = np.bytes_("char")
        item.attrs["MATLAB_int_decode"] = np.int32(2)
    else:
        array = np.atleast_2d(value)
        item = group.create_dataset(name, data=array.T)
        kinds = {"float64": "double", "float32": "single", "bool": "logical"}
        item.attrs["MATLAB_class"] = np.bytes_(kinds.get(array.dtype.name, array.dtype.name))
    return group[name]


def hdf(path, variables, edit=None):
    """Write a file of version 7.3 with MATLAB's user block."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in variables.items():
            put(file, name, value)
        if edit is not None:
            edit(file)
    with open(path, "r+b") as handle:
        handle.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path


def five(path, variables, **options):
    savemat(path, {k: cells(v) for k, v in variables.items()}, **options)
    return path


def cells(value):
    """Return lists as object arrays, which SciPy writes as cells."""
    if isinstance(value, dict):
        return {k: cells(v) for k, v in value.items()}
    if isinstance(value, list):
        array = np.empty((len(value), 1), object)
        array[:, 0] = [cells(v) for v in value]
        return array
    return value


def packed(path, variables):
    return five(path, variables, do_compression=True)


def column(x):
    return np.asarray(x).reshape(-1, 1)


makers = pytest.mark.parametrize("make", [five, packed, hdf])


@makers
def test_columns_rows_and_matrices(tmp_path, make):
    wide = np.column_stack([U, 2 * U, 3 * U])
    path = make(
        tmp_path / "a.mat",
        {
            "t": column(T),
            "u": column(U),
            "row": U.reshape(1, -1),
            "wide": wide,
            "flat": wide.T,
            "on": column(T > 1),
            "count": column(np.arange(N, dtype=np.int16)),
            "hole": column(np.where(T > 1, np.nan, 1.0)),
            "draught": 4.25,
            "ship": "Example",
        },
    )
    recording = read_mat(path)
    for name, value in {
        "u": U, "row": U, "wide_1": U, "wide_3": 3 * U, "flat_2": 2 * U, "on": T > 1,
        "count": np.arange(N), "hole": np.where(T > 1, np.nan, 1.0),
    }.items():  # fmt: skip
        np.testing.assert_array_equal(recording[name].value, value, err_msg=name)
        np.testing.assert_array_equal(recording[name].t, T)
        assert recording[name].unit is None
        assert not recording[name].canonical
    assert "t" not in recording
    assert recording.epoch is None
    assert "draught = 4.25" in recording.notes
    assert "ship = Example" in recording.notes
    assert recording.files[0].format == ("MAT 7.3" if make is hdf else "MAT 5")
    assert len(recording.files[0].sha256) == 64


def test_version_4(tmp_path):
    path = tmp_path / "a.mat"
    savemat(path, {"t": column(T), "u": column(U)}, format="4")
    recording = read_mat(path)
    np.testing.assert_array_equal(recording["u"].value, U)
    assert recording.files[0].format == "MAT 4"


def test_big_endian(tmp_path):
    def matrix(name, values):
        name = name.ljust(8, b"\0")
        body = struct.pack(">IIII", 6, 8, 6, 0)
        body += struct.pack(">IIii", 5, 8, len(values), 1)
        body += struct.pack(">I", 1 << 16 | 1) + name[:4]
        body += struct.pack(">II", 9, 8 * len(values)) + values.astype(">f8").tobytes()
        return struct.pack(">II", 14, len(body)) + body

    path = tmp_path / "a.mat"
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x01\x00MI"
    path.write_bytes(head + matrix(b"t", T) + matrix(b"u", U))
    np.testing.assert_array_equal(read_mat(path)["u"].value, U)


@makers
def test_nested_structs_take_their_own_time(tmp_path, make):
    slow = np.arange(7.0)
    path = make(
        tmp_path / "a.mat",
        {
            "log": {
                "gps": {"time": column(slow), "lat": column(slow + 50)},
                "imu": {"t_ms": column(1000 * T), "deep": {"r": column(U)}},
                "mass": 3.0,
            },
            "other": {"x": column(slow)},
        },
    )
    recording = read_mat(path)
    np.testing.assert_array_equal(recording["log.gps.lat"].t, slow)
    np.testing.assert_allclose(recording["log.imu.deep.r"].t, T)
    np.testing.assert_array_equal(recording["other.x"].t, slow)
    assert any("'other.x' has no time of its own: 'log.gps.time'" in n for n in recording.notes)
    assert "log.mass = 3" in recording.notes


def test_times_side_by_side_go_by_length_and_by_name(tmp_path):
    path = five(
        tmp_path / "a.mat",
        {
            "t": column(T), "gps_time": column(T + 5), "wind_t": column(np.arange(9.0)),
            "u": column(U), "gps_lat": column(U), "wind": column(np.ones(9)), "T": column(T),
        },
    )  # fmt: skip
    recording = read_mat(path)
    np.testing.assert_array_equal(recording["u"].t, T)
    np.testing.assert_array_equal(recording["gps_lat"].t, T + 5)
    assert len(recording["wind"]) == 9
    np.testing.assert_array_equal(recording["T"].value, T)


@makers
def test_a_table_saved_as_a_struct(tmp_path, make):
    table = {
        "Time": column(T),
        "Variables": np.column_stack([U, 2 * U]),
        "Properties": {
            "VariableNames": ["speed", "heading"],
            "VariableUnits": ["kts", "furlong"],
        },
    }
    recording = read_mat(make(tmp_path / "a.mat", {"S": table}))
    np.testing.assert_array_equal(recording["S.heading"].value, 2 * U)
    assert recording["S.speed"].unit == "kn"
    assert recording["S.heading"].unit is None
    assert any("'furlong'" in n for n in recording.notes)


@makers
def test_a_timeseries_saved_as_a_struct(tmp_path, make):
    series = {
        "Name": "speed", "Time": column(T / 60), "Data": column(U),
        "TimeInfo": {"Units": "minutes"}, "DataInfo": {"Units": "m/s"},
    }  # fmt: skip
    recording = read_mat(make(tmp_path / "a.mat", {"speed": series}))
    np.testing.assert_allclose(recording["speed"].t, T)
    np.testing.assert_array_equal(recording["speed"].value, U)
    assert recording["speed"].unit == "m/s"


def test_simulink_structure_with_time(tmp_path):
    signals = np.empty(2, dtype=[("values", "O"), ("label", "O"), ("blockName", "O")])
    signals[0] = (np.column_stack([U, 2 * U]), "vel", "m/a")
    signals[1] = (U.reshape(1, 1, N), "", "model/Heading")
    savemat(tmp_path / "a.mat", {"out": {"time": column(T), "signals": signals}})
    recording = read_mat(tmp_path / "a.mat")
    np.testing.assert_array_equal(recording["out.vel_2"].value, 2 * U)
    np.testing.assert_array_equal(recording["out.Heading"].value, U)


def test_a_struct_array_of_samples(tmp_path):
    log = np.empty(N, dtype=[("t", "O"), ("u", "O"), ("mode", "O")])
    for k in range(N):
        log[k] = (T[k], U[k] if k else np.empty((0, 0)), "dp" if k else "manual")
    savemat(tmp_path / "a.mat", {"log": log})
    recording = read_mat(tmp_path / "a.mat")
    np.testing.assert_array_equal(recording["log.u"].value, [np.nan, *U[1:]])
    assert recording.text["log.mode"][1][:2].tolist() == ["manual", "dp"]


def test_a_struct_array_in_hdf(tmp_path):
    def edit(file):
        group = file.create_group("log")
        group.attrs["MATLAB_class"] = np.bytes_("struct")
        for name, values in {"t": T, "u": U}.items():
            put(file, "tmp", [np.float64(v) for v in values])
            group.create_dataset(name, data=file["tmp"][()])
            del file["tmp"]

    recording = read_mat(hdf(tmp_path / "a.mat", {"x": 1.0}, edit))
    np.testing.assert_array_equal(recording["log.u"].value, U)
    np.testing.assert_array_equal(recording["log.u"].t, T)


@makers
def test_words_as_long_as_the_time_are_text(tmp_path, make):
    words = ["auto" if k % 2 else "" for k in range(N)]
    words[0] = "x" * 1000
    recording = read_mat(make(tmp_path / "a.mat", {"t": T, "u": U, "mode": words}))
    t, found = recording.text["mode"]
    np.testing.assert_array_equal(t, T)
    assert found[1] == "auto"
    assert len(found[0]) == 256


@pytest.mark.parametrize(
    ("time", "word"),
    [
        (START + T, "UNIX time in s"),
        ((START + T) * 1e3, "UNIX time in ms"),
        (np.int64(START * 1e9) + np.round(T * 1e9).astype(np.int64), "UNIX time in ns"),
        (np.uint64(START * 1e6) + np.round(T * 1e6).astype(np.uint64), "UNIX time in us"),
        (719529.0 + (START + T) / 86400.0, "datenum"),
    ],
)
def test_absolute_times_set_the_epoch(tmp_path, time, word):
    recording = read_mat(five(tmp_path / "a.mat", {"time": column(time), "u": column(U)}))
    assert recording.epoch == pytest.approx(START, abs=2e-5)
    exact = word.endswith((" ns", " us"))
    np.testing.assert_allclose(recording["u"].t, T, atol=1e-12 if exact else 2e-5)
    assert any(word in n for n in recording.notes)


def test_a_stated_second_is_no_day(tmp_path):
    for tree in (
        {"time_s": column(750000 + T)},
        {"log": {"time": 750000 + T, "TimeInfo": {"Units": "seconds"}}},
        # nobody logs a sample a day
        {"t": column(750000 + T)},
    ):
        where = tree.get("log", tree)
        where["u"] = column(U)
        (signal,) = read_mat(five(tmp_path / "a.mat", tree)).signals
        np.testing.assert_allclose(np.diff(signal.t), np.diff(T), atol=1e-9)


@pytest.mark.parametrize("style", ["{:%Y-%m-%d %H:%M:%S}", "{:%d-%b-%Y %H:%M:%S}"])
def test_dates_as_text_are_a_time(tmp_path, style):
    from datetime import UTC, datetime

    words = [style.format(datetime.fromtimestamp(START + k, UTC)) for k in range(N)]
    recording = read_mat(five(tmp_path / "a.mat", {"Time": words, "u": column(U)}))
    assert recording.epoch == START
    np.testing.assert_array_equal(recording["u"].t, np.arange(N))
    assert any("UTC" in n for n in recording.notes)


def test_unsigned_times_that_go_back_do_not_wrap(tmp_path):
    stamps = (START + np.round(T)).astype(np.uint32)
    stamps[20] -= 3
    stamps[0] += 1
    recording = read_mat(five(tmp_path / "a.mat", {"time": column(stamps), "u": column(U)}))
    np.testing.assert_array_equal(recording["u"].t, stamps.astype(float) - stamps[0])


def test_two_absolute_times_share_the_earlier_epoch_and_a_relative_one_is_noted(tmp_path):
    recording = read_mat(
        five(
            tmp_path / "a.mat",
            {
                "a": {"t": column(START + T), "u": column(U)},
                "b": {"t": column(START + 2 + T), "v": column(U)},
                "c": {"t": column(T), "w": column(U)},
            },
        )
    )
    assert recording.epoch == START
    np.testing.assert_allclose(recording["b.v"].t, T + 2, atol=1e-6)
    np.testing.assert_array_equal(recording["c.w"].t, T)
    assert any("'c.t' does not count from 1970" in n for n in recording.notes)


def test_complex_and_sparse(tmp_path):
    path = five(
        tmp_path / "a.mat",
        {
            "t": column(T),
            "u": column(U),
            "z": column(U + 1j * T),
            "small": sparse.csc_array(column(U)),
            "large": sparse.csc_array((10_000, 10_000)),
        },
    )
    recording = read_mat(path)
    assert "z" not in recording
    np.testing.assert_array_equal(recording["small"].value, U)
    assert any("'z' was left out: it is complex" in n for n in recording.notes)
    assert any("sparse matrix of 100000000 elements" in n for n in recording.notes)


def test_complex_sparse_and_objects_in_hdf(tmp_path):
    def edit(file):
        pair = np.zeros((1, N), dtype=[("real", float), ("imag", float)])
        file.create_dataset("z", data=pair).attrs["MATLAB_class"] = np.bytes_("double")
        thin = file.create_group("thin")
        thin.attrs["MATLAB_sparse"] = np.uint64(3)
        when = file.create_dataset("when", data=np.full((1, 6), 0xDD000000, np.uint32))
        when.attrs["MATLAB_class"] = np.bytes_("datetime")
        when.attrs["MATLAB_object_decode"] = np.int32(3)

    recording = read_mat(hdf(tmp_path / "a.mat", {"t": T, "u": U}, edit))
    assert recording.names == ("u",)
    notes = " ".join(recording.notes)
    assert "'z' was left out: it is complex" in notes
    assert "'thin' was left out: it is sparse" in notes
    assert "MATLAB 'datetime' object, which only MATLAB can read: in MATLAB save plain" in notes


def opaque(name=b"T", kind=b"timetable"):
    """Return an object as version 5 stores it: names, then a matrix of uint32."""

    def text(word):
        return struct.pack("<II", 1, len(word)) + word.ljust(-(-len(word) // 8) * 8, b"\0")

    inner = struct.pack("<IIII", 6, 8, 13, 0) + struct.pack("<IIii", 5, 8, 6, 1)
    inner += struct.pack("<II", 1, 0) + struct.pack("<II6I", 6, 24, 0xDD000000, 2, 1, 1, 1, 1)
    body = struct.pack("<IIII", 6, 8, 17, 0) + text(name) + text(b"MCOS") + text(kind)
    body += struct.pack("<II", 14, len(inner)) + inner
    return struct.pack("<II", 14, len(body)) + body


def test_an_object_in_version_5_says_how_to_save_it(tmp_path):
    path = five(tmp_path / "a.mat", {"t": column(T), "u": column(U)})
    path.write_bytes(path.read_bytes() + opaque())
    recording = read_mat(path)
    assert any("'T' was left out: it is a MATLAB 'timetable' object" in n for n in recording.notes)
    path.write_bytes(path.read_bytes()[:128] + opaque())
    with pytest.raises(
        LogError, match=r"holds no time; it holds T \(unreadable\).*'timetable'.*t ="
    ):
        read_mat(path)


def test_no_time_says_what_is_there(tmp_path):
    path = five(tmp_path / "a.mat", {"u": column(U), "log": {"v": column(U)}, "w": "hi"})
    with pytest.raises(
        LogError,
        match=r"holds no time; it holds u \(50 x 1\), log \(struct with v\), w \(text\).*"
        r"called 't'",
    ):
        read_mat(path)


def test_no_signal_as_long_as_the_time(tmp_path):
    path = five(tmp_path / "a.mat", {"t": column(T), "u": column(U[:-3])})
    with pytest.raises(LogError, match=r"times 't' \(50\) but no signal of that length"):
        read_mat(path)
    path = five(tmp_path / "a.mat", {"t": column(T), "u": column(U[:-3]), "v": column(U)})
    assert any("'u' (47 x 1): left out" in n for n in read_mat(path).notes)


def test_a_thrust_called_T_is_no_time(tmp_path):
    path = five(tmp_path / "a.mat", {"T": column(U), "u": column(U)})
    with pytest.raises(LogError, match="holds no time"):
        read_mat(path)


# files that are damaged, foreign or hostile


def attempt(path):
    try:
        return read_mat(path), ""
    except LogError as error:
        return None, str(error)


def check_cut_files(tmp_path, kind, shares):
    variables = {"t": column(T), "u": column(U), "s": {"v": column(U)}}
    path = tmp_path / "a.mat"
    if kind == "four":
        savemat(path, {"t": column(T), "u": column(U)}, format="4")
    else:
        {"five": five, "packed": packed, "hdf": hdf}[kind](path, variables)
    whole = path.read_bytes()
    complete = len(read_mat(path).signals)
    for share in shares:
        path.write_bytes(whole[: int(share * len(whole))])
        recording, message = attempt(path)
        if recording is None:
            assert "Copy it again" in message or "Save " in message or "no signal" in message
        else:
            # a cut between two variables leaves a whole file
            assert len(recording.signals) < complete


@pytest.mark.parametrize("kind", ["five", "packed", "four"])
@pytest.mark.parametrize(
    "shares", [[0.2, 0.6, 0.99], pytest.param(np.linspace(0, 0.999, 12), marks=pytest.mark.long)]
)
def test_cut_files_are_refused(tmp_path, kind, shares):
    check_cut_files(tmp_path, kind, shares)


def test_cut_hdf_files_are_refused(tmp_path):
    check_cut_files(tmp_path, "hdf", np.linspace(0, 0.999, 40))


@pytest.mark.parametrize(
    ("kind", "copies"),
    [
        (hdf, 80), (five, 3), (packed, 2),
        pytest.param(five, 15, marks=pytest.mark.long),
        pytest.param(packed, 15, marks=pytest.mark.long),
    ],
)  # fmt: skip
def test_flipped_bytes_never_raise_anything_else(tmp_path, kind, copies):
    variables = {"t": column(T[:9]), "u": column(U[:9]), "s": {"v": column(U[:9]), "w": "hi"}}
    path = kind(tmp_path / "a.mat", variables)
    whole = path.read_bytes()
    chance = np.random.default_rng(5)
    for _ in range(copies):
        data = bytearray(whole)
        low = 0 if kind is hdf else 128
        for position in chance.integers(low, len(data), 3):
            data[position] = chance.integers(0, 256)
        path.write_bytes(data)
        recording, message = attempt(path)
        assert recording is not None or len(message) > 20


def test_a_wrong_checksum_is_damage(tmp_path):
    path = packed(tmp_path / "a.mat", {"t": column(T)})
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(LogError, match=r"damaged compressed data .*incorrect data check"):
        read_mat(path)


@pytest.mark.parametrize("content", [b"", b"MATLAB", b"garbage " * 100, bytes(2000), b"\xff" * 300])
def test_garbage_is_refused(tmp_path, content):
    path = tmp_path / "a.mat"
    path.write_bytes(content)
    with pytest.raises(LogError, match="no MATLAB file"):
        read_mat(path)
    with pytest.raises(LogError, match="there is no file"):
        read_mat(tmp_path / "b.mat")


def head():
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"


def element(kind, body):
    return struct.pack("<II", kind, len(body)) + body


def test_a_bomb_is_refused_before_it_is_loaded(tmp_path, limited):
    limited(held_bytes=10**6)
    path = packed(tmp_path / "a.mat", {"t": np.zeros((10**6, 1))})
    assert path.stat().st_size < 10**4
    with pytest.raises(LogError, match=r"holds \d+ bytes or more once inflated, at most 1000000"):
        read_mat(path)


def test_many_small_numbers_are_counted_as_what_they_become(tmp_path, limited):
    limited(values=10**4)
    for make in (packed, hdf):
        path = make(tmp_path / "a.mat", {"t": np.zeros((10**5, 1), np.int8)})
        with pytest.raises(LogError, match="holds 100000 numbers, at most 10000"):
            read_mat(path)


def stated(kind, rows, columns, content):
    """Return a file whose one variable states its size."""
    body = struct.pack("<IIII", 6, 8, kind, 0) + struct.pack("<IIii", 5, 8, rows, columns)
    return head() + element(14, body + struct.pack("<II", 1, 0) + content)


FIELD = struct.pack("<HHi", 5, 4, 8) + struct.pack("<II8s", 1, 8, b"a")


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        (1, b""),
        (2, FIELD),
        (4, struct.pack("<II", 16, 0)),
        (6, struct.pack("<II", 9, 0)),
        (6, struct.pack("<II", 9, 2**31)),
        (6, b""),
    ],
    ids=["cells", "structs", "text", "numbers", "element", "tag"],
)
def test_sizes_stated_without_bytes_are_refused(tmp_path, kind, content):
    path = tmp_path / "a.mat"
    path.write_bytes(stated(kind, 2**10, 2**10, content))
    with pytest.raises(LogError, match=r"is damaged|needs more than the|holds no time"):
        read_mat(path)


def test_a_file_that_needs_more_memory_than_it_may_is_refused(tmp_path, limited):
    limited(process_bytes=2**28)
    path = five(tmp_path / "a.mat", {"t": column(T), "u": np.zeros((2**24, 1))})
    with pytest.raises(LogError, match="needs more than the 268435456 bytes of memory"):
        read_mat(path)


def test_a_reader_that_takes_too_long_is_ended(tmp_path, limited):
    limited(process_seconds=0.01)
    with pytest.raises(LogError, match=r"was not read within 0.01 s: save only the columns"):
        read_mat(five(tmp_path / "a.mat", {"t": column(T), "u": column(U)}))


def test_a_reader_that_crashes_is_damage(tmp_path, monkeypatch):
    crash = "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)"
    monkeypatch.setattr("greybox.trial.readers.mat_process._COMMAND", crash)
    with pytest.raises(LogError, match="made its reader end with status -11: it is damaged"):
        read_mat(five(tmp_path / "a.mat", {"t": column(T), "u": column(U)}))


@pytest.mark.parametrize("compressed", [False, True])
def test_every_kind_of_value_arrives_as_it_was_saved(tmp_path, compressed):
    chance = np.random.default_rng(2)
    thin = sparse.random_array((9, 7), density=0.3, rng=chance, format="csc")
    kinds = ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"]
    saved = {k: chance.integers(0, 99, (2, 3, 4)).astype(k) for k in kinds}
    saved |= {"on": np.array([[True, False]]), "nothing": np.empty((0, 3))}
    path = tmp_path / "a.mat"
    savemat(
        path,
        saved
        | {
            "thin": thin,
            "thin_on": thin.astype(bool),
            "rows": np.array(["ab", "cde"]),
            "greek": "\u03b1\u03b2",
            "cell": np.array([[np.arange(3.0), "x"], [{"a": 1.0}, np.empty((0, 0))]], object),
            "bare": {"inner": {}},
            "none": np.empty((0, 0), object),
        },
        do_compression=compressed,
    )
    tree, _ = matfile.load_tree(path)
    for name, value in saved.items():
        assert tree[name].dtype == (np.uint8 if name == "on" else value.dtype)
        np.testing.assert_array_equal(tree[name], value)
    for name, value in {"thin": thin, "thin_on": thin.astype(bool)}.items():
        np.testing.assert_array_equal(tree[name], value.toarray())
    assert tree["rows"] == ["ab", "cde"]
    assert tree["greek"] == "\u03b1\u03b2"
    assert tree["none"] == []
    assert tree["bare"] == {"inner": {}}
    # columns first
    assert [type(v).__name__ for v in tree["cell"]] == ["ndarray", "dict", "str", "ndarray"]


def test_several_objects_are_each_named(tmp_path):
    path = five(tmp_path / "a.mat", {"t": column(T), "u": column(U)})
    path.write_bytes(path.read_bytes() + opaque() + opaque(b"D", b"datetime"))
    notes = " ".join(read_mat(path).notes)
    assert "'T' was left out: it is a MATLAB 'timetable' object" in notes
    assert "'D' was left out: it is a MATLAB 'datetime' object" in notes


def test_deep_nesting_is_refused(tmp_path):
    value = np.float64(1.0)
    for _ in range(20):
        value = {"inner": value}
    for make in (five, packed, hdf):
        with pytest.raises(LogError, match="nests structs deeper than 16"):
            read_mat(make(tmp_path / "a.mat", {"t": column(T), "deep": value}))
    body = b""
    for _ in range(100_000):
        inner = struct.pack("<IIII", 6, 8, 1, 0) + struct.pack("<IIii", 5, 8, 1, 1)
        body = element(14, inner + struct.pack("<II", 1, 0) + body) if len(body) < 10**5 else body
    (tmp_path / "a.mat").write_bytes(head() + element(15, zlib.compress(body)))
    with pytest.raises(LogError, match=r"is damaged|nests structs deeper"):
        read_mat(tmp_path / "a.mat")


def test_too_many_cells(tmp_path, limited):
    limited(items=100)
    for make in (five, hdf):
        path = make(tmp_path / "a.mat", {"c": [np.float64(k) for k in range(200)]})
        with pytest.raises(LogError, match=r"variables, fields or cells, at most 100"):
            read_mat(path)


def test_hdf_claims_are_checked_before_reading(tmp_path):
    def edit(file):
        file.create_dataset("big", shape=(2**20, 2**20), dtype="f8", chunks=(1, 1024))

    path = hdf(tmp_path / "a.mat", {"t": T, "u": U}, edit)
    with pytest.raises(LogError, match=f"holds {2**40 + 0} numbers|holds {2**40 + N} numbers"):
        read_mat(path)


def test_hdf_links_and_foreign_data_are_not_followed(tmp_path):
    secret = hdf(tmp_path / "secret.mat", {"t": T, "u": U})
    raw = tmp_path / "raw.bin"
    raw.write_bytes(T.tobytes())

    def edit(file):
        file["outside"] = h5py.ExternalLink(str(secret), "/u")
        file["soft"] = h5py.SoftLink("/u")
        file.create_dataset("foreign", (N,), "f8", external=[(str(raw), 0, 8 * N)])
        layout = h5py.VirtualLayout(shape=(N,), dtype="f8")
        layout[:] = h5py.VirtualSource(str(raw), "x", shape=(N,))
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("words", data=np.array(["a", "b"], object), dtype=h5py.string_dtype())
        file["group"] = file.create_group("loop")
        file["loop"]["again"] = file["loop"]

    recording = read_mat(hdf(tmp_path / "a.mat", {"t": T, "u": U}, edit))
    assert recording.names == ("u",)
    notes = " ".join(recording.notes)
    for name, reason in {
        "outside": "links are not followed", "soft": "links are not followed",
        "foreign": "in another file", "virtual": "in another file",
        "words": "its type is object", "loop.again": "contains itself",
    }.items():  # fmt: skip
        assert f"'{name}' was left out" in notes
        assert reason in notes


def test_a_reference_that_is_no_array_is_a_cell(tmp_path):
    def edit(file):
        item = file.create_dataset("one", data=file["u"].ref, dtype=h5py.ref_dtype)
        item.attrs["MATLAB_class"] = np.bytes_("cell")

    assert "u" in read_mat(hdf(tmp_path / "a.mat", {"t": T, "u": U}, edit)).names


class Trap:
    """Creates a file when it is unpickled."""

    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return open, (str(self.target), "w")


def test_pickled_objects_are_only_bytes(tmp_path):
    target = tmp_path / "made"
    bomb = np.frombuffer(pickle.dumps(Trap(target)), np.uint8)
    for make in (five, hdf):
        path = make(tmp_path / "a.mat", {"t": column(T), "u": column(U), "p": column(bomb)})
        assert read_mat(path).names[0] == "u"

    def edit(file):
        opaque = np.dtype(f"V{bomb.size}")
        file.create_dataset("p", data=np.frombuffer(bomb.tobytes(), opaque))

    assert read_mat(hdf(tmp_path / "a.mat", {"t": T, "u": U}, edit)).names == ("u",)
    assert not target.exists()
