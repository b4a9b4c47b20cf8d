"""What commands write as JSON is what their schemas promise; see the tests of each command too."""

from __future__ import annotations

import json

import pytest
from schemas import schema
from virtual import virtual_log, write_csv

from greybox.commands.main import main


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("outputs")
    write_csv(virtual_log(5, 250), folder / "trial.csv")
    return folder


def run(*arguments):
    assert main([str(a) for a in arguments]) == 0


def read(path):
    return json.loads(path.read_text(encoding="utf-8"))


def test_check(folder):
    log = folder / "trial.csv"
    # an hour without samples, then the same once more
    text = log.read_text().splitlines()
    late = [f"{float(row.split(',')[0]) + 4000:g},{row.split(',', 1)[1]}" for row in text[1:]]
    (folder / "gap.csv").write_text("\n".join([*text, *late]) + "\n")
    for name, logs in (("one", ["gap.csv"]), ("two", ["trial.csv", "gap.csv"])):
        out = folder / f"check_{name}.json"
        run("check", *[folder / n for n in logs], "--vessel", "thesis", "--json", out)
        data = read(out)
        schema("check-1").validate(data)
        assert "gap" in {f["id"] for f in data["findings"]}


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("check-1", {"findings": [{"id": "none"}], "provenance": {}}),
        ("diagnose-1", {"verdict": "perhaps"}),
        ("model-4", {"format": "greybox-model", "version": 4}),
    ],
)
def test_schemas_refuse_what_is_not_promised(name, change):
    assert not schema(name).is_valid(change)
