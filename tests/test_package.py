"""What the package says of itself."""

from __future__ import annotations

import tomllib
from importlib.metadata import metadata, version
from pathlib import Path

import pytest
from ruamel.yaml import YAML

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_the_citation_is_of_this_version(project):
    cited = YAML(typ="safe").load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= set(cited)
    assert cited["version"] == project["version"] == version("greybox-marine")
    assert cited["license"] == project["license"]
    (thesis,) = cited["references"]
    assert thesis["authors"] == [{"family-names": "Ljungberg", "given-names": "Fredrik"}]
    assert thesis["year"] == 2020


def test_extras_repeat_nothing_that_is_installed_anyway(project):
    def names(lines):
        return {line.split(">")[0].split("[")[0] for line in lines}

    core = names(project["dependencies"])
    for extra, lines in project["optional-dependencies"].items():
        assert not core & names(lines), extra
    # commands that ask for these names go on working
    assert {"parquet", "test", "lint", "cluster", "dask"} <= set(project["optional-dependencies"])


def test_the_metadata_is_whole():
    told = metadata("greybox-marine")
    for key in ("Summary", "License-Expression", "Requires-Python", "Keywords", "Description"):
        assert told[key], key
    assert "Typing :: Typed" in told.get_all("Classifier")


@pytest.mark.parametrize("package", ["greybox", "experiment_design"])
def test_types_are_marked(package):
    assert (ROOT / package / "py.typed").exists()


def test_counted_nouns_are_in_the_plural_but_for_one():
    from greybox.errors import so_many

    told = [so_many(k, noun) for k, noun in ((0, "gap"), (1, "log"), (2, "stretch"), (3, "row"))]
    assert told == ["0 gaps", "1 log", "2 stretches", "3 rows"]
    assert so_many(1, "message", "was", "were") == "1 message was"
    assert so_many(2, "message", "was", "were") == "2 messages were"
