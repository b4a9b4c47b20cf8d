"""Text, tables and figures of the efficiency study."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from greybox.report.figures import COLOURS, new_figure, tidy
from greybox.report.page import Page, Table, computed
from greybox.report.studies import StudyOutput, columns, pictures_of
from greybox.study.efficiency import CaseResult, Efficiency, Share

_MARKERS = ("o", "s", "D", "^")


def _shown(share: Share) -> str:
    return f"{share.value:.2g} ({share.low:.2g}-{share.high:.2g})"


def _parameters(result: CaseResult, single: list[float]) -> Table:
    """Return the factors of each parameter: against best IV, that against Cramér-Rao, in all."""
    head, columns = ["parameter", "best IV against Cramér-Rao"], []
    for estimator in result.case.estimators:
        if "IV" in estimator:
            head.append(f"{estimator} against best IV")
            columns.append(result.parameter(estimator, result.optimal_iv))
        head.append(f"{estimator}, total")
        columns.append(result.parameter(estimator, result.cramer_rao))
    rows = [
        [name, f"{single[i]:.2g}", *[_shown(column[i]) for column in columns]]
        for i, name in enumerate(result.names)
    ]
    return Table(
        f"{result.case.name}: each parameter, total = the two factors' product", head, rows
    )


def _figure(result: CaseResult) -> Figure:
    """Draw each parameter's efficiency against the Cramér-Rao bound."""
    figure = new_figure(8.5, 0.28 * len(result.names) + 1.6)
    axes = figure.add_subplot()
    rows = np.arange(len(result.names))
    estimators = result.case.estimators
    for j, estimator in enumerate(estimators):
        shares = result.parameter(estimator, result.cramer_rao)
        value = np.array([s.value for s in shares])
        spread = np.abs(np.array([[s.low, s.high] for s in shares]).T - value)
        axes.errorbar(
            value,
            rows + 0.2 * (j - (len(estimators) - 1) / 2),
            xerr=spread,
            fmt=_MARKERS[j % 4],
            markersize=4,
            linewidth=1,
            color=COLOURS[j % 6],
            label=estimator,
        )
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_yticks(rows, result.names)
    axes.invert_yaxis()
    axes.set_xlabel("Cramér-Rao variance over variance of the estimates, 95 % intervals")
    axes.legend(loc="upper left", fontsize="small")
    tidy(axes)
    return figure


def efficiency_output(study: Efficiency, record: dict[str, Any]) -> StudyOutput:
    """Return tables and figures of the efficiency study."""
    lines: list[str] = []
    tables, figures = [], {}
    sentences = []
    for result in study.cases:
        overall, single = result.loss()
        rows = []
        for estimator in result.case.estimators:
            against = result.determinant(estimator, result.cramer_rao)
            best = result.determinant(estimator, result.optimal_iv)
            cover = result.coverage(estimator)
            runs = len(result.errors(estimator))
            is_instrumental = "IV" in estimator
            rows.append(
                [
                    estimator,
                    _shown(against),
                    _shown(best) if is_instrumental else "",
                    f"{overall:.2g}" if is_instrumental else "",
                    f"{100 * cover.mean():.1f} % ({100 * cover.min():.1f}-{100 * cover.max():.1f})",
                    str(runs),
                ]
            )
        head = [
            "estimator", "against Cramér-Rao", "against best IV", "best IV against Cramér-Rao",
            "95 % intervals hold", "runs",
        ]  # fmt: skip
        caption = f"{result.case.name}: efficiency by determinant, p-th root, 95 % interval"
        tables.append(Table(caption, head, rows))
        lines += [result.case.name, *columns(head, rows)]
        tables.append(_parameters(result, single))
        last = result.case.estimators[-1]
        reached = result.determinant(last, result.cramer_rao)
        sentences.append(
            f"{result.case.name.capitalize()}: {last} reaches {100 * reached.value:.0f} % "
            f"({100 * reached.low:.0f}-{100 * reached.high:.0f}) of the Cramér-Rao bound by "
            f"determinant."
        )
        figures[f"efficiency_{result.case.name.replace(' ', '_')}"] = (
            _figure(result),
            f"Efficiency of each parameter, {result.case.name}; 1 is the Cramér-Rao bound.",
        )
    headline = " ".join(sentences)
    page = Page(
        "Efficiency of the estimators",
        headline,
        sentences=[
            "Virtual trials of the thesis's ship with the noises of (6.2), a constant unknown "
            "current and measured gusts. The bounds are at the truth, initial states and current "
            "being unknown; best IV is the bound of one-step equations with instruments that "
            "depend on the inputs only."
        ],
        pictures=pictures_of(figures),
        tables=tables,
        computed=computed(record),
    )
    return StudyOutput("\n".join([*lines, headline]), study.rows(), figures, page)
