"""Progress on a terminal, and silence in a pipe."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys

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
    try:
        done = subprocess.run(
            [sys.executable, *arguments], stderr=slave, stdout=subprocess.DEVNULL, timeout=120,
            env=given,
        )  # fmt: skip
        return done.returncode, os.read(master, 10_000).decode()
    finally:
        os.close(slave)
        os.close(master)


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
