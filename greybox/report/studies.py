"""Text, tables, figures and pages of the reproduced studies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from greybox.errors import so_many
from greybox.files import make_folder, write_text
from greybox.report.figures import (
    bias_figure,
    error_histograms,
    fit_figure,
    overview_figure,
    save_png,
    to_svg,
)
from greybox.report.page import Page, Picture, Table, computed, write_page
from greybox.study.chapter4 import SETS, Chapter4
from greybox.study.chapter6 import Chapter6
from greybox.study.chapter7 import Chapter7
from greybox.study.tables import Row, to_csv


@dataclass(frozen=True)
class StudyOutput:
    """Results of a study: text for the terminal, rows, figures and texts by file name, a page."""

    text: str
    rows: Sequence[Row]
    figures: dict[str, tuple[Figure, str]]
    page: Page
    texts: Mapping[str, str] = field(default_factory=dict)


def write_output(output: StudyOutput, folder: str | Path) -> None:
    """Write tables.csv, one PNG a figure, the study's own texts and report.html into a folder.

    Raises
    ------
    LogError
        The folder cannot be made.
    """
    folder = make_folder(folder)
    for name, text in {"tables.csv": to_csv(output.rows), **output.texts}.items():
        write_text(text, folder / name)
    for name, (figure, _) in output.figures.items():
        save_png(figure, str(folder / f"{name}.png"))
    write_page(output.page, folder / "report.html")


def rows_text(rows: Sequence[Row]) -> str:
    """Return rows as an aligned table of mean ± sd."""
    lines = [
        f"{'table':<10}{'set':<10}{'est':<5}{'parameter':<12}{'mean':>10}{'sd':>10}"
        f"{'published':>12}{'sd':>10}{'runs':>7}"
    ]
    for r in rows:
        there = (
            f"{r.published_mean:>12.4f}{r.published_sd:>10.4f}"
            if r.published_mean is not None and r.published_sd is not None
            else f"{'':>22}"
        )
        lines.append(
            f"{r.table:<10}{r.set:<10}{r.estimator:<5}{r.parameter:<12}{r.mean:>10.4f}"
            f"{r.sd:>10.4f}{there}{r.runs:>7}"
        )
    return "\n".join(lines)


def _table(caption: str, rows: Sequence[Row]) -> Table:
    def cell(mean: float | None, sd: float | None) -> str:
        return "" if mean is None or sd is None else f"{mean:.4f} ± {sd:.4f}"

    return Table(
        caption,
        ["estimator", "parameter", "this study", "published", "runs"],
        [
            [
                r.estimator,
                r.parameter,
                cell(r.mean, r.sd),
                cell(r.published_mean, r.published_sd),
                str(r.runs),
            ]
            for r in rows
        ],
    )


def columns(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table of text, each column as wide as its longest cell."""
    widths = [max(map(len, cells)) + 2 for cells in zip(head, *rows, strict=True)]
    return [
        "  " + "".join(f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=True))
        for cells in (head, *rows)
    ]


def pictures_of(figures: dict[str, tuple[Figure, str]]) -> list[Picture]:
    """Return the figures of a study for its page."""
    return [Picture(to_svg(f, name), caption) for name, (f, caption) in figures.items()]


def chapter4_output(result: Chapter4, record: dict[str, Any]) -> StudyOutput:
    """Return tables and histograms of chapter 4."""
    rows = result.rows()
    figures = {}
    for case in SETS:
        errors = {e: v for (f, e), v in result.errors.items() if f == case.figures}
        caption = (
            f"Normalised errors of n and f, mean of v {case.mean:g}, "
            f"{'zero-mean input' if case.floor is None else 'input kept above 0.6'}"
            f"{', second measurement used' if case.second else ''} (Figures {case.figures})."
        )
        figures[f"figures_{case.figures}"] = (
            error_histograms(errors, ("n", "f"), f"Figures {case.figures}"),
            caption,
        )
    inside = sum(
        r.published_mean is not None
        and r.published_sd is not None
        and abs(r.mean - r.published_mean) <= 3 * r.published_sd / np.sqrt(r.runs) + 0.015
        for r in rows
    )
    headline = (
        f"{inside} of {len(rows)} means agree with the published ones within three standard "
        f"errors plus 0.015; only zero-mean instruments with states kept from the origin are "
        f"free of bias."
    )
    text = rows_text(rows) + "\n" + headline
    if result.unconverged:
        text += f"\n{result.unconverged} refinements did not converge."
    page = Page(
        "Chapter 4: eliminating disturbances",
        headline,
        pictures=pictures_of(figures),
        tables=[_table("Mean ± sd of (estimate − true)/|true|", rows)],
        computed=computed(record),
    )
    return StudyOutput(text, rows, figures, page)


def chapter6_output(result: Chapter6, record: dict[str, Any]) -> StudyOutput:
    """Return Tables 6.2-6.7 and Figures 6.1-6.3."""
    rows = result.rows()
    figures = {
        "figure_6.1": (
            overview_figure(result.example, "One virtual trial (Figure 6.1)"),
            "One of the virtual trials at low wind: states, heading and velocity through the air.",
        )
    }
    for wind, label in ((1, "6.2"), (10, "6.3")):
        fits = {e: v for (w, e), v in result.fits.items() if w == wind}
        if fits:
            figures[f"figure_{label}"] = (
                fit_figure(
                    result.lengths,
                    fits,
                    ("u", "v", "r"),
                    f"Fit on an undisturbed zig-zag, wind {wind} m/s (Figure {label})",
                ),
                f"Median fit with quartiles against log length, wind {wind} m/s; medians below "
                f"−20 % are not shown.",
            )
    for wind, estimator in ((1, "IV2"), (1, "IV3"), (10, "IV3"), (10, "IV2")):
        part = [r for r in rows if r.set == f"{wind} m/s" and r.estimator == estimator]
        if part:
            figures[f"errors_{estimator}_{wind}"] = (
                bias_figure(part, f"{estimator}, wind {wind} m/s"),
                f"Mean ± sd of each normalised error of {estimator} at {wind} m/s, in units of "
                f"the published sd.",
            )
    consistent = [
        r
        for r in rows
        if (r.set, r.estimator) in (("1 m/s", "IV2"), ("1 m/s", "IV3"), ("10 m/s", "IV3"))
    ]
    inside = sum(abs(r.mean) < r.sd for r in consistent)
    bad = sum(result.unconverged.values())
    headline = (
        f"The consistent estimators (IV2 and IV3 at 1 m/s, IV3 at 10 m/s) have {inside} of "
        f"{len(consistent)} means within one standard deviation of the truth."
    )
    text = rows_text(rows) + "\n" + headline
    if bad:
        text += f"\n{bad} refinements did not converge and are left out: " + ", ".join(
            f"{e} at {w} m/s {n}" for (w, e), n in result.unconverged.items() if n
        )
    page = Page(
        "Chapter 6: simulation study",
        headline,
        sentences=[
            "One input sequence serves all runs, as the spread of the published least-squares "
            "estimates shows it did there; the sequence itself is not published, so the biases of "
            "the inconsistent estimators can agree in direction only."
        ],
        pictures=pictures_of(figures),
        tables=[
            _table(f"Table {t}: normalised errors, mean ± sd", [r for r in rows if r.table == t])
            for t in sorted({r.table for r in rows})
        ],
        computed=computed(record) | {"samples a run": str(result.samples)},
    )
    return StudyOutput(text, rows, figures, page)


def chapter7_output(result: Chapter7, record: dict[str, Any]) -> StudyOutput:
    """Return Tables 7.1-7.4 for the user's or virtual days."""
    rows = result.rows()
    tests = result.sign_tests()
    fit_rows = [r for r in rows if r.table == "7.1"]
    figure = _fit_bars(result)
    figures = {
        "table_7.1": (
            figure,
            "Mean fit on the validation logs ± sd over estimation sets; bars below −50 % are cut.",
        )
    }
    best = max(result.fits, key=lambda n: float(np.clip(result.fits[n], -100, 100).mean()))
    mean = {(r.estimator, r.parameter): r for r in fit_rows}
    means = [mean[best, f"fit_{s}"].mean for s in result.states]
    headline = (
        f"On {so_many(len(result.validation), 'validation log')} {best} fits best over "
        f"{so_many(len(result.sets), 'estimation set')}: "
        + ", ".join(f"{s} {m:.0f} %" for s, m in zip(result.states, means, strict=True))
        + "."
    )
    lines = [
        f"estimation sets: {len(result.sets)} of {so_many(len(result.sets[0]), 'log')}; "
        f"validation: " + ", ".join(result.validation),
        f"{'estimator':<10}" + "".join(f"{'fit ' + s + ' [%]':>20}" for s in result.states),
    ]
    for name in result.fits:
        cells = [mean[name, f"fit_{s}"] for s in result.states]
        lost = result.diverged(name)
        lines.append(
            f"{name:<10}"
            + "".join(f"{r.mean:>11.1f} ± {r.sd:<6.1f}" for r in cells)
            + (f"  diverged on {lost} of {so_many(len(result.sets), 'set')}" if lost else "")
        )
    lines += [t.sentence for t in tests]
    lines += [f"{n} was left out: {why}" for n, why in result.skipped.items()]
    lines.append(headline)
    page = Page(
        "Chapter 7: experimental study",
        headline,
        sentences=[f"{n} was left out: {why}" for n, why in result.skipped.items()],
        pictures=pictures_of(figures),
        tables=[
            Table(
                "Table 7.1: fit on the validation logs [%], mean ± sd over estimation sets",
                ["estimator", "quantity", "mean ± sd"],
                [[r.estimator, r.parameter, f"{r.mean:.1f} ± {r.sd:.1f}"] for r in fit_rows],
            ),
            Table(
                "Table 7.2: sign test over estimation sets against the first estimator",
                ["estimator", "state", "wins", "p-value (two-sided)"],
                [[t.model, t.state, f"{t.wins}/{t.of}", f"{t.p_value:.2g}"] for t in tests],
            ),
            Table(
                "Tables 7.3, 7.4: parameters, mean ± sd over estimation sets",
                ["estimator", "parameter", "mean ± sd"],
                [
                    [r.estimator, r.parameter, f"{r.mean:.4g} ± {r.sd:.2g}"]
                    for r in rows
                    if r.table != "7.1"
                ],
            ),
        ],
        computed=computed(record)
        | {"estimation sets": "; ".join(" + ".join(s) for s in result.sets)},
    )
    return StudyOutput("\n".join(lines), rows, figures, page)


def _fit_bars(result: Chapter7) -> Figure:
    from greybox.report.figures import COLOURS, LABELS, new_figure, tidy

    figure = new_figure(9, 3.2)
    axes = figure.subplots(1, len(result.states), sharey=True, squeeze=False)[0]
    names = list(result.fits)
    for i, state in enumerate(result.states):
        finite = [result.fits[n][:, i][np.isfinite(result.fits[n][:, i])] for n in names]
        value = np.array([f.mean() if len(f) else -np.inf for f in finite])
        sd = np.array([f.std(ddof=1) if len(f) > 1 else 0.0 for f in finite])
        axes[i].bar(
            names,
            np.clip(value, -50, 100),
            yerr=np.where(value > -50, np.minimum(sd, 100), np.nan),
            color=[COLOURS[j % 6] for j in range(len(names))],
            capsize=3,
        )
        axes[i].set_title(LABELS.get(state, state).split(" [")[0], fontsize=10)
        axes[i].axhline(0, color="black", linewidth=0.8)
        axes[i].set_ylim(-55, 105)
        tidy(axes[i])
    axes[0].set_ylabel("fit (6.12) [%]")
    return figure
