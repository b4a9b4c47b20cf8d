"""Progress on a terminal, and silence in a pipe."""

from __future__ import annotations

import ast
import os
import pty
import re
import subprocess
import sys
from argparse import Namespace
from contextlib import suppress
from pathlib import Path

import pytest

from greybox.commands.main import build_parser
from greybox.commands.parser import sub_parsers
from greybox.commands.time_left import TimeLeft, in_words

ROOT = Path(__file__).parents[2]
PACKAGES = ("greybox", "experiment_design")
SCRIPT = """
from greybox.commands.common import progress
show = progress("design")
for done in range(1, 4):
    show(done, 3)
"""


def on_a_terminal(*arguments: str, **environment: str) -> tuple[int, str]:
    """Run Python with its standard error on a pseudo-terminal; its status and what was shown."""
    master, slave = pty.openpty()
    given = {k: v for k, v in os.environ.items() if k != "NO_COLOR"} | environment
    shown = b""
    with subprocess.Popen(
        [sys.executable, *arguments], stderr=slave, stdout=subprocess.DEVNULL, env=given
    ) as process:
        os.close(slave)
        # the end of a terminal that nobody writes to any more is an error
        with suppress(OSError):
            while part := os.read(master, 10_000):
                shown += part
    os.close(master)
    return process.returncode, shown.decode()


def on_the_screen(shown: str) -> str:
    """Return the lines that a terminal is left with, control sequences carried out."""
    lines = [""]
    for part in re.findall(r"\x1b\[[?0-9;]*[A-Za-z]|[\r\n]|[^\x1b\r\n]+", shown):
        if part == "\n":
            lines.append("")
        elif part.endswith("K"):
            lines[-1] = ""
        elif part.endswith("A") and part.startswith("\x1b"):
            lines = lines[: len(lines) - int(part[2:-1] or 1)]
        elif not part.startswith("\x1b") and part != "\r":
            lines[-1] = part
    return "\n".join(lines)


def test_a_warning_is_no_line_of_the_program_on_the_terminal():
    script = (
        "import numpy as np\n"
        "from greybox.commands.terminal import telling\n"
        "with telling({}, False):\n"
        "    np.float64(1e300) ** 2\n"
    )
    shown = [
        subprocess.run(
            [sys.executable, "-c", script.format(verbose)], capture_output=True, text=True,
            cwd=ROOT, check=True,
        ).stderr
        for verbose in (0, 1)
    ]  # fmt: skip
    assert shown[0] == ""
    assert "overflow encountered" in shown[1]
    assert ".py" not in shown[1]


def test_progress_shows_and_clears():
    status, shown = on_a_terminal("-c", SCRIPT)
    assert status == 0
    assert "design: 1 of 3" in shown
    assert "design: 2 of 3" in shown
    assert on_the_screen(shown) == ""


def test_the_words_of_progress_follow_the_work():
    """Work without counted steps is told by what is done now, not by what was done first."""
    script = """
import logging
from greybox.commands.common import progress
from greybox.commands.terminal import telling
log, show = logging.getLogger("greybox.any"), progress("refits")
with telling(0, False):
    for text in ("read the log", "chose a way"):
        log.info(text)
    show(1, 2)
    log.info("a part of a step")
    show(2, 2)
    log.info("wrote the model")
"""
    _, shown = on_a_terminal("-c", script)
    for text in ("read the log", "chose a way", "refits: 1 of 2", "wrote the model"):
        assert text in shown
    assert "a part of a step" not in shown


def test_the_time_stays_beside_long_words():
    script = """
import logging
from greybox.commands.terminal import telling
with telling(0, False):
    logging.getLogger("greybox.any").info("word " * 50)
"""
    _, shown = on_a_terminal("-c", script, COLUMNS="60", NO_COLOR="1")
    lines = re.sub(r"\x1b\[[?0-9;]*[A-Za-z]", "", shown).split("\r")
    assert any("word word" in line and line.rstrip().endswith("0:00:00") for line in lines)


def test_an_error_takes_the_place_of_progress():
    """A command that fails half way leaves its one sentence alone on the line."""
    script = SCRIPT.replace("range(1, 4)", "range(1, 3)") + (
        "from greybox.commands.common import complain\ncomplain('greybox design: it went wrong.')\n"
    )
    _, shown = on_a_terminal("-c", script, NO_COLOR="1")
    assert on_the_screen(shown).strip() == "greybox design: it went wrong."


def test_silent_in_a_pipe():
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, timeout=60)
    assert done.stderr == b""
    assert done.stdout == b""


class Clock:
    """Seconds that pass when they are told to."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_the_time_left_follows_the_usual_shares_of_stages() -> None:
    clock = Clock()
    left = TimeLeft([("", 10.0), ("samples", 30.0), ("pictures", 60.0)], clock)
    left.tell("read the vessel")
    assert left.seconds() is None
    clock.now = 5.0
    left.tell("samples of 3 logs")
    assert left.seconds() == pytest.approx(45.0)
    clock.now = 15.0
    assert left.seconds() == pytest.approx(35.0)
    # twice as slow as usual: the pictures will be, too
    clock.now = 40.0
    assert left.seconds() == pytest.approx(60.0)
    left.tell("pictures of logs: 0 of 4", 0, 4)
    clock.now = 70.0
    left.tell("pictures of logs: 2 of 4", 2, 4)
    assert left.seconds() == pytest.approx(30.0)
    assert left.share() == pytest.approx(0.7)


def test_to_start_up_is_no_part_of_the_first_stage() -> None:
    clock = Clock()
    left = TimeLeft([("reading", 5.0), ("samples", 95.0)], clock)
    clock.now = 2.0
    left.tell("reading logs: 0 of 2", 0, 2)
    clock.now = 3.0
    left.tell("samples of 2 logs")
    assert left.seconds() == pytest.approx(19.0)


def test_a_stage_that_never_came_takes_no_time() -> None:
    clock = Clock()
    left = TimeLeft([("", 10.0), ("terms", 50.0), ("gain", 10.0)], clock)
    left.tell("read")
    clock.now = 10.0
    left.tell("gain")
    assert left.seconds() == pytest.approx(10.0)


def test_counted_steps_need_no_stages() -> None:
    clock = Clock()
    left = TimeLeft(clock=clock)
    for done, now in enumerate((0.0, 4.0, 8.0)):
        clock.now = now
        left.tell(f"runs: {done} of 10", done, 10)
    assert left.seconds() == pytest.approx(32.0)


def test_time_is_told_as_coarsely_as_it_is_known() -> None:
    told = [in_words(s) for s in (3.0, 21.7, 133.0, 9000.0)]
    assert told == ["a few seconds left", "about 20 s left", "about 2 min left", "about 2.5 h left"]


@pytest.mark.long
def test_the_bar_counts_down_and_leaves_processes_to_the_work() -> None:
    """It is drawn between two messages, and by no thread, beside which nothing could be shared."""
    script = """
import logging, time
from greybox.commands.terminal import telling
from greybox.numerics.parallel import lanes, map_forked
log, before = logging.getLogger("greybox.any"), lanes()
def work(_):
    log.info("told by a copy")
with telling(0, False, [("", 1.0), ("second", 20.0)]):
    log.info("first")
    time.sleep(2.1)
    log.info("second")
    assert lanes() == before
    map_forked(work, range(2))
    time.sleep(5)
"""
    status, shown = on_a_terminal("-c", script, NO_COLOR="1")
    assert status == 0
    assert len(set(re.findall(r"about \d+ s left", shown))) > 1
    assert "told by a copy" not in shown
    assert on_the_screen(shown) == ""


def texts_outside_stages() -> str:
    """Return all text of the sources but that of the functions that list stages."""
    found: list[str] = []
    for path in (p for f in PACKAGES for p in (ROOT / f).rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        listed = {
            id(inside)
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef) and node.name == "stages"
            for inside in ast.walk(node)
        }
        constants = (n for n in ast.walk(tree) if isinstance(n, ast.Constant))
        found += [str(n.value) for n in constants if id(n) not in listed]
    return "\n".join(found)


def test_every_stage_is_told_by_something() -> None:
    """A stage whose words nothing tells would count for ever."""
    told, found = texts_outside_stages(), 0
    every = {"purpose": "coefficients", "target": [""], "report": "page.html", "fix": True}
    for given in (every, every | {"purpose": "prediction"}):
        for parser in sub_parsers(build_parser()).values():
            stages = parser.get_default("stages")
            blank = {a.dest: a.default for a in parser._actions}
            for words, share in stages(Namespace(**blank | given)) if stages else ():
                found += 1
                # numbers and colons are put behind the text that the sources hold
                assert re.sub(r"[ :\d]+$", "", words) in told, f"nothing tells '{words}'"
                assert share > 0
    assert found > 30


@pytest.mark.long
def test_a_check_on_a_terminal_tells_the_time_that_is_left(noisy_csv: Path) -> None:
    page = str(noisy_csv.with_suffix(".html"))
    given = ["-m", "greybox", "check", str(noisy_csv), "--vessel", "thesis", "--report", page]
    status, shown = on_a_terminal(*given, NO_COLOR="1")
    assert status == 0
    assert "pictures of logs: 0 of 1" in shown
    assert " left" in shown
