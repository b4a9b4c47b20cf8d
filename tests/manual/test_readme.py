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
    assert_alike(run_blocks.rewritten(README, tmp_path))


def assert_alike(found: str) -> None:
    """The words are the same, and numbers but for the last digits, which differ by processor."""
    plain = run_blocks.without_numbers
    assert list(map(plain, found.splitlines())) == list(map(plain, README.splitlines()))
    for new, old in zip(found.splitlines(), README.splitlines(), strict=True):
        if new != old:
            here, there = (
                [float(n.replace("−", "-")) for n in run_blocks.NUMBER.findall(line)]
                for line in (new, old)
            )
            assert here == pytest.approx(there, rel=0.05), new


def test_another_number_is_not_alike() -> None:
    assert "8.793 ± 0.064 s" in README
    assert_alike(README.replace("8.793 ± 0.064 s", "8.792 ± 0.064 s"))
    with pytest.raises(AssertionError, match="time constant of 7"):
        assert_alike(README.replace("8.793 ± 0.064 s", "7.793 ± 0.064 s"))
