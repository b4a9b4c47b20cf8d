"""Each script in examples/ runs to its end, as a user starts it."""

import doctest
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "examples"
# within seconds; the others take up to half a minute
QUICK = {"add_a_term", "predict_precision"}
SECONDS = 600
# every step of the loop, and all of it
STEPS = {
    "import_and_check", "estimate_and_compare", "diagnose_a_trial", "design_a_trial",
    "whole_loop", "frames", "keep_a_track",
}  # fmt: skip


def scripts():
    for path in sorted(FOLDER.glob("*.py")):
        marks = [] if path.stem in QUICK else [pytest.mark.long]
        yield pytest.param(path, marks=marks, id=path.stem)


def run(path, folder, *arguments):
    environment = os.environ | {"PYTHONPATH": str(FOLDER.parent), "MPLBACKEND": "Agg"}
    data = os.environ.get("GREYBOX_DATA", "../shared/data")
    environment["GREYBOX_DATA"] = str((FOLDER.parent / data).resolve())
    done = subprocess.run(
        [sys.executable, str(path), *arguments], cwd=folder, env=environment, timeout=SECONDS,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_every_step_has_a_script():
    assert {p.stem for p in FOLDER.glob("*.py")} >= STEPS


@pytest.mark.parametrize("path", list(scripts()))
def test_example_runs(path, tmp_path):
    assert path.read_text(encoding="utf-8").startswith('"""')
    assert run(path, tmp_path).strip()
    assert not list(tmp_path.iterdir()), "examples leave no files"


@pytest.mark.long
def test_track_is_kept_better_in_a_known_current(tmp_path):
    said = run(FOLDER / "keep_a_track.py", tmp_path, "track.png")
    known, unknown = (
        float(line.split("cross-track ")[1].split(" m")[0])
        for line in said.splitlines()
        if "cross-track" in line
    )
    assert known < 0.3 < 0.5 < unknown
    assert (tmp_path / "track.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_page_of_library_use_says_what_happens(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = (FOLDER.parent / "docs" / "library.md").read_text(encoding="utf-8")
    names: dict[str, object] = {}
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    for language, block in re.findall(r"```(\w*)\n(.*?)```", page, re.DOTALL):
        if language == "python":
            exec(compile(block, "library.md", "exec"), names)
        elif block.startswith(">>>"):
            test = doctest.DocTestParser().get_doctest(block, names, "library.md", None, 0)
            runner.run(test, clear_globs=False)
    assert runner.tries > 8
    assert runner.failures == 0
