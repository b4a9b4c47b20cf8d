"""The README shows what its commands print."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
_spec = importlib.util.spec_from_file_location("run_blocks", ROOT / "docs" / "run_blocks.py")
assert _spec is not None
assert _spec.loader is not None
run_blocks = importlib.util.module_from_spec(_spec)
sys.modules[_spec.name] = run_blocks
_spec.loader.exec_module(run_blocks)

README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_it_goes_round_the_loop_in_about_two_hundred_lines() -> None:
    assert len(README.splitlines()) < 250
    commands = [
        step.command.split()[1]
        for block in run_blocks.BLOCK.findall(README)
        for step in run_blocks.read_block(block)
        if step.command.startswith("greybox")
    ]
    assert commands == [
        "demo", "design", "import", "check", "estimate", "diagnose", "compare", "predict", "export",
    ]  # fmt: skip


def test_a_wanted_line_is_shown_with_the_numbers_of_this_run() -> None:
    (step,) = run_blocks.read_block("$ greybox predict m.json\nadvance 1.5 L\n…\nspeed 2")
    shown = run_blocks.shown(step, "title\nadvance  1.46 L = 43 m\nnote\nspeed     2.2 m/s\n")
    assert shown == ["…", "advance  1.46 L = 43 m", "…", "speed     2.2 m/s"]
    with pytest.raises(RuntimeError, match="no longer prints a line that begins with 'speed 2'"):
        run_blocks.shown(step, "advance 1.4 L\n")


@pytest.mark.long
def test_what_it_shows_is_what_was_printed(tmp_path: Path) -> None:
    found = run_blocks.rewritten(README, tmp_path)
    plain = run_blocks.without_numbers
    # the last digits are another processor's
    assert list(map(plain, found.splitlines())) == list(map(plain, README.splitlines()))
