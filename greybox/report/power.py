"""Text, tables and figures of the power study."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from greybox.report.figures import COLOURS, new_figure, tidy
from greybox.report.page import Page, Table, computed
from greybox.report.studies import StudyOutput, columns, pictures_of
from greybox.study.blind_causes import CAUSES
from greybox.study.power import ANSWERS, LEAST_FALL, Cell, Power, Share

_MARKERS = ("o", "s", "D")
_INSTEAD = ("group with it", "group without", "unexplained", "none", "failed")


def _kinds(study: Power) -> list[str]:
    return list(dict.fromkeys(c.kind for c in study.cells))


def _sizes(study: Power) -> list[float]:
    return sorted({c.size for c in study.cells if c.effects})


def _of_visible(study: Power, *cells: Cell) -> Share:
    """Return the share of trials that are named rightly, of those that have to be found."""
    trials = [o for cell in cells for o in study.visible(cell)]
    return Share(sum(o.answer == "right" for o in trials), len(trials))


def _power_table(study: Power, kind: str) -> Table:
    head = ["what is wrong", "size", "found", "named rightly", "in a group", "part", "wrong",
            "failed", "trials", f"rightly, if errors fall by {100 * LEAST_FALL:g} %"]  # fmt: skip
    rows = [
        [
            cell.label,
            f"{cell.size:g}" if cell.effects else "",
            str(study.share(cell, "detected")),
            *[str(study.share(cell, a)) for a in ("right", "group", "part", "wrong", "failed")],
            str(len(study.of(cell))),
            str(_of_visible(study, cell)) if cell.effects else "",
        ]
        for cell in study.cells
        if cell.kind == kind
    ]
    return Table(f"{kind}: shares of trials with 95 % intervals of Wilson", head, rows)


def _matrix(study: Power, kind: str, size: float) -> tuple[list[str], list[str], NDArray[np.int64]]:
    """Return truths, what was found, and counts (truths, found)."""
    counts = study.confusion(kind, size)
    seen = {name for row in counts.values() for name in row}
    others = sorted(seen - set(CAUSES) - set(_INSTEAD))
    found = [*[n for n in CAUSES if n in seen], *others, *_INSTEAD]
    return list(counts), found, np.array([[row[n] for n in found] for row in counts.values()])


def _confusion_figure(study: Power, kind: str, size: float) -> Figure:
    """Draw in per cent of each row what was found where something was wrong."""
    truths, found, counts = _matrix(study, kind, size)
    share = 100 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    figure = new_figure(0.48 * len(found) + 3.0, 0.3 * len(truths) + 2.2)
    axes = figure.add_subplot()
    image = axes.imshow(share, cmap="Blues", vmin=0, vmax=100, aspect="auto")
    for i, j in zip(*np.nonzero(counts), strict=True):
        axes.text(
            j, i, f"{share[i, j]:.0f}", ha="center", va="center", fontsize="small",
            color="white" if share[i, j] > 60 else "black",
        )  # fmt: skip
    axes.set_xticks(range(len(found)), found, rotation=55, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(truths)), truths)
    axes.set_xlabel("found first")
    axes.set_ylabel("what is wrong")
    figure.colorbar(image, ax=axes, label="share of the trials [%]", fraction=0.03)
    return figure


def _power_figure(study: Power) -> Figure:
    """Draw for each effect the shares found and named rightly against its size."""
    labels = list(dict.fromkeys(c.label for c in study.cells if c.effects))
    columns = min(4, len(labels))
    lines = -(-len(labels) // columns)
    figure = new_figure(2.6 * columns + 0.6, 1.9 * lines + 0.9)
    grid = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    for axes in grid.flat[len(labels) :]:
        axes.set_visible(False)
    for label, axes in zip(labels, grid.flat, strict=False):
        for k, kind in enumerate(_kinds(study)):
            mine = sorted(
                (c for c in study.cells if c.label == label and c.kind == kind),
                key=lambda c: c.size,
            )
            _curve(axes, study, mine, k, kind)
        axes.set_title(label, fontsize="small")
        axes.set_ylim(-3, 103)
        tidy(axes)
    for axes in grid[:, 0]:
        axes.set_ylabel("trials [%]")
    for axes in grid.flat[max(0, len(labels) - columns) : len(labels)]:
        axes.set_xlabel("size (1: as stated)")
        axes.tick_params(labelbottom=True)
    handles, names = grid.flat[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, fontsize="small")
    return figure


def _curve(axes: Any, study: Power, cells: list[Cell], k: int, kind: str) -> None:
    if not cells:
        return
    sizes = np.array([c.size for c in cells])
    shift = 0.012 * (k - 1)
    found = [100 * study.share(c, "detected").value for c in cells]
    axes.plot(
        sizes + shift, found, "--", color=COLOURS[k % 6], linewidth=1, label=f"found, {kind}"
    )  # fmt: skip
    right = [study.share(c, "right", "group") for c in cells]
    value = 100 * np.array([s.value for s in right])
    spread = np.abs(100 * np.array([s.interval for s in right]).T - value)
    axes.errorbar(
        sizes + shift, value, yerr=spread, fmt=f"-{_MARKERS[k % 3]}", markersize=4, linewidth=1,
        color=COLOURS[k % 6], label=f"rightly named or in the group, {kind}",
    )  # fmt: skip


def _estimates(study: Power) -> Table:
    """Return how far off the parameters of rightly named causes are."""
    rows = []
    for cell in study.cells:
        for name, pairs in study.errors(cell).items():
            errors = np.array([e for e, _ in pairs])
            held = np.mean([abs(e) <= 1.96 * s for e, s in pairs])
            rows.append(
                [cell.label, cell.kind, f"{cell.size:g}", name, f"{errors.mean():.3g}",
                 f"{np.sqrt((errors**2).mean()):.3g}", f"{100 * held:.0f} %", str(len(pairs))]
            )  # fmt: skip
    head = ["cause", "inputs", "size", "parameter", "mean error", "RMS error",
            "95 % intervals hold", "trials"]  # fmt: skip
    return Table("Parameters of the causes that were named rightly [SI, rad]", head, rows)


def _headline(study: Power) -> list[str]:
    sentences = []
    for kind in _kinds(study):
        none = [c for c in study.cells if c.kind == kind and not c.effects]
        if none:
            share = study.share(none[0], "detected")
            sentences.append(
                f"{kind}: with nothing wrong, something was found in {share} of "
                f"{share.runs} trials."
            )
        largest = [c for c in study.cells if c.kind == kind and c.effects
                   and c.size == max(_sizes(study))]  # fmt: skip
        named = [o for c in largest if set(c.effects) <= set(CAUSES) for o in study.of(c)]
        if named:
            right = sum(o.answer in ("right", "group") for o in named)
            wrong = sum(o.answer == "wrong" for o in named)
            sentences.append(
                f"{kind}: of {len(named)} trials with a cause at size {max(_sizes(study)):g}, "
                f"{right} were named rightly or in the right group, {wrong} wrongly."
            )
            with_names = [c for c in largest if set(c.effects) <= set(CAUSES)]
            if any(o.oracle is not None for c in with_names for o in study.of(c)):
                share = _of_visible(study, *with_names)
                sentences.append(
                    f"{kind}: where the cause, added, lowers the squared free-run errors by at "
                    f"least {100 * LEAST_FALL:g} %, it was named in {share} of {share.runs} trials."
                )
    return sentences


def power_output(study: Power, record: dict[str, Any]) -> StudyOutput:
    """Return tables and figures of the power study."""
    tables = [_power_table(study, kind) for kind in _kinds(study)]
    lines = []
    for table in tables:
        lines += [table.caption, *columns(table.header, table.rows)]
    figures = {}
    sizes = _sizes(study)
    if sizes:
        figures["power"] = (
            _power_figure(study),
            "Shares of trials against the size of what is wrong; bars are 95 % intervals.",
        )
    for kind in _kinds(study):
        figures[f"confusion_{kind}"] = (
            _confusion_figure(study, kind, max(sizes, default=1.0)),
            f"What was found first, by what is wrong, {kind} at the largest size; rows add to "
            f"100 %.",
        )
    estimates = _estimates(study)
    if estimates.rows:
        tables.append(estimates)
    failures = sorted({o.failure for o in study.outcomes if o.failure})
    if failures:
        tables.append(Table("Why judgements failed", ["message"], [[f] for f in failures[:20]]))
    sentences = _headline(study)
    page = Page(
        "Blind trials",
        " ".join(sentences),
        sentences=[
            "Trials are drawn from a seed and sailed by a simulator of their own; the judge sees "
            "logs and vessel. A group counts as right when it holds every true cause."
        ],
        pictures=pictures_of(figures),
        tables=tables,
        computed=computed(record),
    )
    text = "\n".join([*lines, *sentences])
    return StudyOutput(text, study.rows(), figures, page, {"shares.csv": shares_csv(study)})


def shares_csv(study: Power) -> str:
    """Return every share with its interval as CSV."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["kind", "effects", "size", "answer", "hits", "runs", "share", "low", "high"])
    for cell in study.cells:
        for answer in ANSWERS:
            share = study.share(cell, answer)
            low, high = share.interval
            writer.writerow(
                [cell.kind, cell.label, f"{cell.size:g}", answer, share.hits, share.runs,
                 f"{share.value:.6g}", f"{low:.6g}", f"{high:.6g}"]
            )  # fmt: skip
    return out.getvalue()
