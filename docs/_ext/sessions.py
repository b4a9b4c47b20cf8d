"""Directives ``session`` and ``made``: commands run by the build, and their files.

The commands of a page run in one folder, in the order of the page, and what they print stands in
the page: a command that fails fails the build. Output is kept beside the doctrees until a command
before it or the sources change. A page whose blocks say ``:after: PAGE`` starts with the files of
another page, and shows what a command printed there without running it again. ``made PAGE/FILE``
shows a picture that they wrote, or the first screen of a page that they wrote.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

sys.path.insert(0, str(Path(__file__).parents[1]))
from run_blocks import SOURCES, Step, read_block, run, shown

_BLOCK = re.compile(r"^```\{session\}\n(.*?)^```", re.M | re.S)
_AFTER = re.compile(r"^:after: (\S+)$", re.M)
_SCREEN = (1280, 800)
_log = logging.getLogger(__name__)


@cache
def _sources() -> bytes:
    """Return a hash of all that decides what a command prints."""
    digest = hashlib.sha256()
    folders = [SOURCES / "greybox", SOURCES / "experiment_design", SOURCES / "docs"]
    for path in sorted(p for f in folders for p in f.rglob("*") if p.suffix in _DECIDE):
        if "_ext" not in path.parts and "_build" not in path.parts:
            digest.update(path.read_bytes())
    return digest.digest()


_DECIDE = {".py", ".toml", ".csv", ".js"}


class Session:
    """The commands of one page: their output, and the folder that they wrote to."""

    def __init__(self, env: BuildEnvironment, page: str) -> None:
        self.folder = Path(env.doctreedir) / "sessions" / page
        self.folder.mkdir(parents=True, exist_ok=True)
        self._kept = self.folder.with_suffix(".json")
        text = Path(env.doc2path(page)).read_text(encoding="utf-8")
        blocks = _BLOCK.findall(text)
        self.steps = [s for block in blocks for s in read_block(_body(block))]
        named = next(filter(None, map(_AFTER.search, blocks)), None)
        self.before = session_of(env, named[1]) if named else None

    def outputs(self) -> dict[str, str]:
        """Return what each command prints, run anew where nothing is kept."""
        kept = json.loads(self._kept.read_text("utf-8")) if self._kept.exists() else {}
        found = self.before.outputs() if self.before else {}
        key, now = "".join([_sources().hex(), *found]), {}
        for step in self.steps:
            if self.before and step.command in self.before.outputs():
                continue
            key = hashlib.sha256((key + step.command).encode()).hexdigest()
            if key not in kept:
                _log.info("running %s", step.command)
                kept = {}
                if self.before and not now:
                    shutil.copytree(self.before.folder, self.folder, dirs_exist_ok=True)
            now[key] = kept[key] if key in kept else run(step, self.folder)
            found[step.command] = now[key]
            self._kept.write_text(json.dumps(now), encoding="utf-8")
        return found


def _body(block: str) -> str:
    """Return a block without the options of its directive."""
    return re.sub(r"\A(?::\w+:.*\n)+\n?", "", block)


def session_of(env: BuildEnvironment, page: str) -> Session:
    """Return the session of a page, one for each build."""
    sessions: dict[str, Session] = env.temp_data.setdefault("sessions", {})
    return sessions.setdefault(page, Session(env, page))


class Commands(SphinxDirective):
    """Commands and the lines of their output that are wanted, as they are printed now."""

    has_content = True
    option_spec = {"hidden": directives.flag, "after": directives.unchanged}  # noqa: RUF012

    def run(self) -> list[nodes.Node]:
        """Return one block a command."""
        session = session_of(self.env, self.env.docname)
        try:
            outputs = session.outputs()
            found = [_block(s, outputs[s.command]) for s in read_block("\n".join(self.content))]
        except (RuntimeError, ValueError, subprocess.TimeoutExpired) as error:
            raise self.error(str(error)) from error
        return [] if "hidden" in self.options else found


def _block(step: Step, output: str) -> nodes.Node:
    text = "\n".join([f"$ {step.command}", *shown(step, output)])
    return nodes.literal_block(text, text, language="console")


class Made(SphinxDirective):
    """A picture that the commands of a page wrote, or the first screen of a page."""

    required_arguments = 1
    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return a figure, or a note where it needs a browser and there is none."""
        page, name = self.arguments[0].split("/", 1)
        session = session_of(self.env, page)
        try:
            session.outputs()
            path = session.folder / name
            if not path.exists():
                raise RuntimeError(f"no command of '{page}' wrote '{name}'")
            if path.suffix == ".html":
                if _browser() is None:
                    said = f"Not drawn: this build found no Chromium to open {name} with."
                    return [nodes.note("", nodes.paragraph("", said))]
                path = _first_screen(path)
        except (RuntimeError, subprocess.SubprocessError) as error:
            raise self.error(str(error)) from error
        here = Path(self.env.doc2path(self.env.docname)).parent
        said = " ".join(self.content)
        image = nodes.image(uri=os.path.relpath(path, here), alt=said)
        return [nodes.figure("", image, nodes.caption(said, said))]


def _browser() -> str | None:
    return next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)


def _first_screen(page: Path) -> Path:
    """Return a picture of what a browser of usual size shows of a page before one scrolls."""
    picture = page.with_suffix(".screen.png")
    if picture.exists() and picture.stat().st_mtime > page.stat().st_mtime:
        return picture
    with tempfile.TemporaryDirectory() as profile:
        subprocess.run(
            [
                str(_browser()), "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
                "--no-first-run", "--disable-background-networking", "--disable-component-update",
                "--disable-sync", "--hide-scrollbars", "--virtual-time-budget=5000",
                f"--user-data-dir={profile}", "--window-size={},{}".format(*_SCREEN),
                f"--screenshot={picture}", page.as_uri(),
            ],
            capture_output=True, timeout=120, check=True,
        )  # fmt: skip
    if not picture.exists():
        raise RuntimeError(f"the browser drew no picture of {page.name}")
    return picture


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directives."""
    app.add_directive("session", Commands)
    app.add_directive("made", Made)
    return {"parallel_read_safe": False}
