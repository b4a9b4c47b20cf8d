"""Runs the commands of a page and writes what they print into it: python docs/run_blocks.py PAGE.

A block marked ``console`` holds commands after ``$`` and, below each, the lines of its output that
are shown. A line stays when the output still holds one that is the same but for its numbers;
the numbers are those of this run, and ``…`` stands where lines are left out. ``*`` shows all of it.
Commands run in one new folder, in the order of the page. One that fails stops everything, but
for one whose error the page shows.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

SOURCES = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"^```console\n(.*?)^```", re.M | re.S)
NUMBER = re.compile(r"[-+−]?\b\d+(?:[.,]\d+)*(?:e[-+]?\d+)?")
_OUTER = "…"
SECONDS = 900


@dataclass(frozen=True)
class Step:
    """A command as it is typed, and the lines of its output that are wanted."""

    command: str
    wanted: tuple[str, ...]

    @property
    def fails(self) -> bool:
        """Whether the page shows the error that the command ends with."""
        name = " ".join(self.command.split()[:2])
        return any(line.startswith(f"{name}: ") for line in self.wanted)


def read_block(text: str) -> list[Step]:
    """Return the commands of a block with the lines below each."""
    steps: list[tuple[list[str], list[str]]] = []
    for line in text.rstrip().splitlines():
        if line.startswith("$ "):
            steps.append(([line[2:]], []))
        elif steps and steps[-1][0][-1].endswith("\\"):
            steps[-1][0].append(line)
        elif steps:
            steps[-1][1].append(line)
        else:
            raise ValueError(f"a block begins with '{line}', not with a command after '$ '")
    return [Step("\n".join(command), tuple(lines)) for command, lines in steps]


def run(step: Step, folder: Path) -> str:
    """Return what a command prints in a folder; a command that fails raises."""
    words = shlex.split(step.command.replace("\\\n", " "))
    if words[0] == "python":
        words[0] = sys.executable
        words[1] = str(next(p for p in _scripts(words[1]) if p.exists()))
    elif words[0] == "greybox":
        words[:1] = [sys.executable, "-m", "greybox"]
    paths = os.pathsep.join([str(SOURCES), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    environment = {k: v for k, v in os.environ.items() if k != "GREYBOX_CONFIG"}
    done = subprocess.run(
        words, cwd=folder, env=environment | {"PYTHONPATH": paths}, timeout=SECONDS, check=False,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, encoding="utf-8",
    )  # fmt: skip
    if bool(done.returncode) != step.fails:
        raise RuntimeError(
            f"'{step.command}' ended with status {done.returncode}, and the page shows "
            f"{'an' if step.fails else 'no'} error:\n{done.stdout[-2000:]}"
        )
    return done.stdout


def _scripts(name: str) -> list[Path]:
    """Return where a script that a page names may be."""
    return [SOURCES / name, SOURCES / "docs" / name]


def without_numbers(line: str) -> str:
    """Return a line with one sign for every number and one blank for all between words."""
    return " ".join(NUMBER.sub("#", line).split())


def shown(step: Step, output: str) -> list[str]:
    """Return the wanted lines as they were printed, ``…`` where lines are left out.

    A wanted line stands for the next line that begins the same, numbers aside.
    """
    lines = [line.rstrip() for line in output.rstrip().splitlines()]
    if step.wanted == ("*",):
        return lines
    plain = [without_numbers(line) for line in lines]
    found: list[str] = []
    last = -1
    for line in step.wanted:
        begins = without_numbers(line)
        if begins in ("", _OUTER):
            continue
        at = next((i for i in range(last + 1, len(lines)) if plain[i].startswith(begins)), None)
        if at is None:
            raise RuntimeError(
                f"'{step.command}' no longer prints a line that begins with '{line}' there. "
                f"It prints:\n{output}"
            )
        found += [*_left_out(lines[last + 1 : at]), lines[at]]
        last = at
    return found + _left_out(lines[last + 1 :]) if found else []


def _left_out(lines: Sequence[str]) -> list[str]:
    return [_OUTER] if any(lines) else list(lines[:1])


def rewritten(text: str, folder: Path) -> str:
    """Return a page with the output of its commands, run in a folder."""

    def block(match: re.Match[str]) -> str:
        nonlocal folder
        parts = []
        for step in read_block(match[1]):
            if step.command.startswith("cd "):
                folder = folder / step.command[3:]
                parts.append(f"$ {step.command}")
                continue
            parts += [f"$ {step.command}", *shown(step, run(step, folder))]
        return "```console\n" + "\n".join(parts) + "\n```"

    return BLOCK.sub(block, text)


if __name__ == "__main__":
    page = Path(sys.argv[1])
    with tempfile.TemporaryDirectory() as made:
        written = rewritten(page.read_text(encoding="utf-8"), Path(made))
    page.write_text(written, encoding="utf-8")
