"""What the pages say is there: code runs, files and names exist, commands and names are covered."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib import import_module, util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import needs_browser

import greybox
from greybox.commands.main import build_parser, main
from greybox.diagnosis.result import DiagnosisVerdict
from greybox.study.chapter6 import START
from greybox.trial.checks.finding import IDS
from greybox.trial.readers import formats

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
_TOP = ("greybox", "experiment_design", "tests", "docs", "examples", "benchmarks")


def text_of(page: str) -> str:
    return (DOCS / page).read_text(encoding="utf-8")


def code_of(page: str) -> list[str]:
    """Return the Python blocks of a page."""
    return re.findall(r"^```python\n(.*?)^```", text_of(page), re.S | re.M)


def module_of(path: Path) -> Any:
    """Return a script of the documentation as a module."""
    spec = util.spec_from_file_location(path.stem, path)
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", ["extending.md", "log.md"])
def test_code_runs(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    found: dict[str, Any] = {}
    for block in code_of(page):
        exec(block, found)
    assert capsys.readouterr().out


@dataclass
class Entry:
    name: str
    made: Any

    def load(self):
        return self.made


def test_reader_of_the_page_is_used_by_import(tmp_path, monkeypatch):
    (block,) = (b for b in code_of("extending.md") if "def read_gps" in b)
    found: dict[str, Any] = {}
    exec(block, found)
    monkeypatch.setattr(formats, "entry_points", lambda group: [Entry("gps", found["read_gps"])])
    t = np.arange(120.0)
    rows = np.column_stack([t, 2.0 * t, 0.1 * t, np.full(120, 3.0)])
    np.savetxt(tmp_path / "track.gps", rows)
    recording = formats.open_raw(tmp_path / "track.gps")
    assert [s.name for s in recording.signals] == ["x_n", "y_n", "psi"]
    (report,) = greybox.check_files([tmp_path / "track.gps"], greybox.load_vessel("thesis"))
    assert report.outcomes


def places(page: str) -> list[str]:
    """Return what a page names in backticks and looks like a source file or folder."""
    named = re.findall(r"`([^`\s]+)`", text_of(page))
    return [
        n for n in named if re.fullmatch(r"[\w./]+\.py|(?:greybox|experiment_design)/[\w./]+", n)
    ]


@pytest.mark.parametrize(
    "page",
    [
        "method.md",
        "validation.md",
        "causes.md",
        "checks.md",
        "design.md",
        "cases.md",
        "extending.md",
    ],
)
def test_places_in_the_code_exist(page):
    folders = [ROOT / "experiment_design", ROOT / "greybox"]
    for place in places(page):
        if place.startswith(_TOP):
            found = [ROOT / place]
        else:
            found = [f / place for f in reversed(folders) if (f / place).exists()][:1]
        assert [f for f in found if f.exists()], f"{page} names {place}, which is not there"
        path = found[0].resolve()
        folders.append(path if path.is_dir() else path.parent)
        parts = path.relative_to(ROOT).with_suffix("").parts
        if path.suffix == ".py" and parts[0] in _TOP[:2]:
            import_module(".".join(parts))


@pytest.mark.parametrize("page", sorted(p.name for p in DOCS.glob("*.md")))
def test_dotted_names_exist(page):
    for name in re.findall(r"`((?:greybox|experiment_design)(?:\.\w+)+)`", text_of(page)):
        if name in ("greybox.commands", "greybox.causes", "greybox.readers", "greybox.toml"):
            continue
        whole = name.split(".")
        value: Any = import_module(whole[0])
        for k, part in enumerate(whole[1:], 2):
            if not hasattr(value, part):
                value = import_module(".".join(whole[:k]))
            else:
                value = getattr(value, part)


def test_words_of_the_commands_are_explained():
    words = {w for line in re.findall(r"^(\w[^\n]*)\n  \S", text_of("glossary.md"), re.M)
             for w in line.split(", ")}  # fmt: skip
    asked = ("regime", "margin", "hold", "predictor", "instrument", "prior", "verdict", "budget",
             "misfit", "regressor", "residual", "segment", "draw", "lead-in",
             "closed loop", "race", "taux", "vc")  # fmt: skip
    assert not [w for w in asked if w not in words]


def test_every_verdict_is_explained():
    told = text_of("trust.md")
    assert all(f"| `{verdict}` |" in told for verdict in DiagnosisVerdict)
    assert all(f"| `Prediction: {level}" in told for level in ("good", "limited", "poor"))


def test_every_command_is_described():
    (commands,) = (a for a in build_parser()._actions if a.dest == "command")
    everything = "".join(p.read_text(encoding="utf-8") for p in DOCS.rglob("*.md"))
    missing = [c for c in commands.choices if f"greybox {c}" not in everything]
    assert not missing
    # predict and export stand beside what their models are for
    pages = {p.stem for f in (DOCS, DOCS / "howto") for p in f.glob("*.md")}
    assert commands.choices.keys() - pages == {"help"}


def test_every_finding_has_its_picture():
    assert sorted(p.stem for p in (DOCS / "images" / "checks").glob("*.png")) == sorted(IDS)
    shown = re.findall(r"^### `(\w+)`$", text_of("checks.md"), re.M)
    assert sorted(shown) == sorted(IDS)


def test_every_cause_has_its_picture():
    described = re.findall(r"^#### `(\w+)`$", text_of("causes.md"), re.M)
    pictures = {p.stem for p in (DOCS / "images" / "causes").glob("*.png")}
    assert set(described) == pictures
    for name in described:
        assert f"(images/causes/{name}.png)" in text_of("causes.md")


def test_pictures_stay_small():
    drawn = [p for f in ("causes", "checks") for p in (DOCS / "images" / f).iterdir()]
    assert sum(p.stat().st_size for p in drawn) < 1_200_000


def test_steps_of_the_reference_name_public_names():
    text = (DOCS / "_ext" / "public_names.py").read_text(encoding="utf-8")
    listed = re.search(r"STEPS = \{(.*?)\n\}", text, re.S)[1]
    groups = re.findall(r'"(\w+)": ((?:\s*"[^"]*")+)', listed)
    names = [n for _, texts in groups for n in "".join(re.findall(r'"([^"]*)"', texts)).split()]
    import experiment_design

    public = {*greybox.__all__, *experiment_design.__all__}
    assert len(names) == len(set(names)) > 60
    assert set(names) <= public
    assert all((DOCS / "reference" / f"{step}.rst").exists() for step, _ in groups)


def test_sea_of_the_tutorial_sails(tmp_path, capsys):
    sea = module_of(DOCS / "sea.py")
    sea.believe(tmp_path / "prior.json")
    plan = tmp_path / "plan.csv"
    rows = [f"{t},{10 + 10 * (t // 20 % 2)},0.8,0.8" for t in range(60)]
    plan.write_text("t,n,alpha1,alpha2\n" + "\n".join(rows) + "\n")
    sea.sail(plan, tmp_path / "trial.csv", 1)
    log = greybox.read_log(tmp_path / "trial.csv", greybox.load_vessel("thesis"))
    assert len(log) == 60
    assert abs(log["u"][0] - START[0]) < 0.1
    arguments = ["simulate", str(tmp_path / "prior.json"), str(tmp_path / "trial.csv")]
    assert main([*arguments, "--out", str(tmp_path / "run.csv"), "--no-bands"]) == 0


def test_broken_links_are_found(tmp_path):
    links = module_of(DOCS / "check_links.py")
    (tmp_path / "a.html").write_text('<a href="b.html#there">x</a><a href="https://a.org/">y</a>')
    (tmp_path / "b.html").write_text('<p id="there"></p><a href="a.html">x</a>')
    assert links.broken_links(tmp_path) == ([], {"https://a.org/"})
    (tmp_path / "c.html").write_text(
        '<a href="b.html#nowhere">x</a><img src="gone.png"><a href="http://nosite">y</a>'
    )
    wrong, _ = links.broken_links(tmp_path)
    assert wrong == [
        "c.html: 'b.html#nowhere' has no such anchor",
        "c.html: there is no 'gone.png'",
        "c.html: 'http://nosite' names no site",
    ]


@needs_browser
def test_pages_that_are_cut_off_are_found(tmp_path, capsys):
    pages = module_of(DOCS / "check_pages.py")
    (tmp_path / "good.html").write_text("<p>short</p>")
    assert pages.main(tmp_path) == 0
    assert "1 page opened in a browser: nothing is cut off" in capsys.readouterr().out
    wide = '<p style="width: 800px">much</p><script>console.error("oh")</script>'
    (tmp_path / "wide.html").write_text(wide)
    assert pages.main(tmp_path) == 3
    told = capsys.readouterr().out
    assert '"oh"' in told
    assert "wide.html: on a phone of 390 px it scrolls sideways by " in told
    assert "wide.html: cut off on A4: P: much" in told


def test_documentation_speaks_of_itself_alone():
    for page in [*DOCS.rglob("*.md"), *DOCS.rglob("*.rst"), *DOCS.glob("*.py")]:
        if "_build" not in page.parts:
            assert "/tmp/" not in page.read_text(encoding="utf-8"), page.name
