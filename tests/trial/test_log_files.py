"""Folders, patterns and addresses stand for the logs in them."""

from __future__ import annotations

import ftplib
from pathlib import Path

import pytest

from greybox.errors import LogError
from greybox.trial.log_files import find_logs, local_copy


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("b.csv", "a.parquet", "a.parquet.json", "_part.csv", ".hidden.csv", "day/c.PQ"):
        path = tmp_path / "logs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    return tmp_path / "logs"


def test_a_folder_stands_for_its_logs_by_name(folder: Path) -> None:
    files = find_logs([str(folder)])
    assert [Path(f.path).relative_to(folder).as_posix() for f in files] == [
        "a.parquet", "b.csv", "day/c.PQ",
    ]  # fmt: skip
    assert all(f.found for f in files)


def test_a_pattern_stands_for_what_it_matches(folder: Path) -> None:
    assert [f.name for f in find_logs([str(folder / "*.csv")])] == ["b.csv"]


def test_a_file_that_is_named_is_not_searched_for(folder: Path) -> None:
    path = str(folder / "_part.csv")
    (file,) = find_logs([path])
    assert file.path == path
    assert not file.found


def test_an_address_is_copied_for_as_long_as_it_is_read(folder: Path) -> None:
    pytest.importorskip("fsspec")
    files = find_logs([f"file://{folder}"])
    assert [f.name for f in files] == ["a.parquet", "b.csv", "c.PQ"]
    with local_copy(files[1].path) as path:
        assert path.name == "b.csv"
        assert path.read_text() == "b.csv"
    assert not path.exists()


def test_what_holds_no_log_says_how_many_files_it_holds(folder: Path) -> None:
    for name in ("b.csv", "a.parquet", "day/c.PQ"):
        (folder / name).unlink()
    with pytest.raises(LogError, match=r"holds 3 files, none of which ends in \.csv"):
        find_logs([str(folder)])


def test_an_address_that_vanishes_is_named(folder: Path) -> None:
    pytest.importorskip("fsspec")
    files = find_logs([f"file://{folder}"])
    (folder / "b.csv").unlink()
    with (
        pytest.raises(LogError, match=r"b\.csv' cannot be reached"),
        local_copy(files[1].path),
    ):
        pass


@pytest.mark.parametrize("error", [TypeError("no host"), ftplib.error_perm("530 no\nentry")])
def test_whatever_a_file_system_raises_is_told_in_one_sentence(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    core = pytest.importorskip("fsspec.core")

    def refuse(path: str) -> None:
        raise error

    monkeypatch.setattr(core, "url_to_fs", refuse)
    with pytest.raises(LogError, match=r"x\.csv' cannot be reached: (no host|530 no entry)\. Corr"):
        find_logs(["ftp:///x.csv"])
    with (
        pytest.raises(LogError, match="cannot be reached"),
        local_copy("ftp:///x.csv"),
    ):
        pass
