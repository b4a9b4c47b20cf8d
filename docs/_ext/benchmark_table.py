"""Directives ``benchmarks`` and ``benchmarks-picture``: the record of `python -m benchmarks`.

The table and the picture are drawn from docs/benchmarks.json by each build.
"""

from __future__ import annotations

import json
import os
from itertools import groupby
from pathlib import Path
from typing import Any

from docutils import nodes
from matplotlib.figure import Figure
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

RECORD = Path(__file__).parents[1] / "benchmarks.json"
_HEADING = ("work", "size", "alternative", "here [s]", "alternative [s]", "ratio", "note")


class _Recorded(SphinxDirective):
    """What reads the record."""

    def record(self) -> dict[str, Any]:
        self.env.note_dependency(str(RECORD))
        return json.loads(RECORD.read_text("utf-8"))


def _times(timing: dict[str, float]) -> str:
    low, high = timing["shortest"], timing["longest"]
    return f"{timing['median']:.2g} ({low:.2g} to {high:.2g})"


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    name = (row["name"], f"{row['size']:g} {row['unit']}", row["alternative"])
    if row["ratio"] is None:
        return (*name, "", "", "", row["note"])
    return (*name, _times(row["ours"]), _times(row["theirs"]), f"{row['ratio']:.2g}", row["note"])


class Table(_Recorded):
    """The table, and the machine that it was measured on."""

    def run(self) -> list[nodes.Node]:
        """Return a paragraph and a table."""
        record = self.record()
        about = record["machine"]
        versions = ", ".join(f"{n} {v}" for n, v in about["versions"].items())
        said = (
            f"{about['date']}: {about['processor']}, {about['cores']} cores, {about['system']}, "
            f"Python {about['python']}, OMP_NUM_THREADS {about['threads']}. Mean number of "
            f"processes that wanted a core in the minute before: {about['load_before']}; in the "
            f"last minute, ours among them: {about['load_after']}. {versions}."
        )
        rows = [_HEADING, *map(_cells, record["rows"])]
        group = nodes.tgroup("", *(nodes.colspec(colwidth=1) for _ in _HEADING), cols=len(_HEADING))
        lines = [
            nodes.row("", *(nodes.entry("", nodes.paragraph("", cell)) for cell in row))
            for row in rows
        ]
        group += [nodes.thead("", lines[0]), nodes.tbody("", *lines[1:])]
        return [nodes.paragraph("", said), nodes.table("", group)]


class Picture(_Recorded):
    """Time against size, one panel a work."""

    def run(self) -> list[nodes.Node]:
        """Return a figure."""
        timed = [r for r in self.record()["rows"] if r["ratio"] is not None]
        works = [(n, list(g)) for n, g in groupby(timed, lambda r: r["name"])]
        figure = Figure(figsize=(9, 2.6 * -(-len(works) // 2)), layout="constrained")
        for k, (name, rows) in enumerate(works):
            axes = figure.add_subplot(-(-len(works) // 2), 2, k + 1)
            ticks: set[float] = set()
            for n, alternative in enumerate(dict.fromkeys(r["alternative"] for r in rows)):
                mine = [r for r in rows if r["alternative"] == alternative]
                size = [r["size"] for r in mine]
                ticks.update(size)
                for who, line in (("ours", "--"), ("theirs", "-")):
                    axes.loglog(
                        size, [r[who]["median"] for r in mine], line, marker="o", color=f"C{n}",
                        label=alternative if who == "theirs" else None,
                    )  # fmt: skip
            axes.set(title=name, xlabel=rows[0]["unit"], ylabel="time [s]")
            # only the sizes that were measured, a word each
            axes.set_xticks(sorted(ticks), [f"{x:g}" for x in sorted(ticks)])
            axes.set_xticks([], minor=True)
            axes.legend(fontsize="x-small")
        path = Path(self.env.doctreedir) / "benchmarks.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110)
        here = Path(self.env.doc2path(self.env.docname)).parent
        said = "Time against size: this package dashed, each alternative in the same colour solid."
        image = nodes.image(uri=os.path.relpath(path, here), alt=said)
        return [nodes.figure("", image, nodes.caption(said, said))]


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directives."""
    app.add_directive("benchmarks", Table)
    app.add_directive("benchmarks-picture", Picture)
    return {"parallel_read_safe": True}
