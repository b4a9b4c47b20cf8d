"""An estimate as text: the verdicts, the table, the tests in groups."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from greybox.errors import so_many
from greybox.estimation.prediction_verdict import JudgedOn, seconds
from greybox.estimation.tried import told
from greybox.estimation.values import EstimateValues
from greybox.estimation.verdict import TestResult
from greybox.model.terms import parameter_unit
from greybox.trial.validity import in_words

WIDTH = 100
# of a value beside its label
_CELL = 28
# closed intervals, None for an infinite end
Pieces = Sequence[Sequence[float | None]]
_GROUPS = {
    "What the log determines": ("movement", "excitation", "relevance", "weak_instruments",
                                "anderson_rubin", "combinations"),
    "Whether the model explains it": ("input_independence", "heading_independence",
                                      "overidentification", "whiteness"),
    "What noise does to it": ("endogeneity", "many_instruments", "margin", "margin_bias",
                              "closed_loop"),
    "How it was found": ("convergence",),
    "What the model does": ("stability", "damping_signs", "slow_errors"),
}  # fmt: skip
BOUNDS = {
    "cramer_rao": "Against the Cramér-Rao bound",
    "optimal_iv": "Against the best instruments",
}
_MARKS = {True: "ok", False: "!!", None: "  "}


def summarise(estimate: EstimateValues) -> str:
    """Return the verdicts, the parameters in the manner of a regression table, and the tests."""
    lines = [f"{'Estimate of ' + estimate.vessel.name:^{WIDTH}}".rstrip(), "=" * WIDTH]
    if estimate.prediction is not None:
        judged = estimate.prediction
        on = ""
        if judged.judged_on is JudgedOn.VALIDATION:
            on = f"; on {judged.judged_words}, {seconds(judged.samples * estimate.sample_time)}"
        lines += _wrapped(f"Prediction: {judged.text}{on}", "  ")
    meant = estimate.meant
    lines += _wrapped(f"Coefficients: {meant.verdict.text}", "  ")
    if meant is not estimate:
        lines += _wrapped(whose(estimate), "  ")
    lines += ["=" * WIDTH, *_head(estimate), "=" * WIDTH, *_table(estimate), "=" * WIDTH]
    lines += _wrapped(estimate.told_of_choice, "  ")
    for name, value, std in estimate.current:
        lines.append(f"{name:<16}{value:>10.3f} ± {1.96 * std:.3f} m/s (95 %)")
    if estimate.fit:
        shown = ", ".join(f"{k} {v:.1f} %" for k, v in estimate.fit.items())
        lines.append(f"Free-run fit on the estimation logs: {shown}")
    if estimate.prediction is not None:
        lines += ["", "What its free run is good for", *estimate.prediction.table()]
    if meant is not estimate:
        lines += ["", f"{'The estimate of the coefficients':^{WIDTH}}".rstrip(), "=" * WIDTH]
        lines += [*_head(meant), "=" * WIDTH, *_table(meant), "=" * WIDTH]
        lines += _wrapped(meant.told_of_choice, "  ")
    for name, limit in meant.limits.items():
        lines += _wrapped(f"{BOUNDS[name]}: {limit.sentence}", "  ")
    if estimate.data.conditions.values:
        lines += _wrapped(f"Conditions: {in_words(estimate.data.conditions.values)}", "  ")
    for actuator in estimate.data.actuators:
        lines += _wrapped(f"Actuator: {actuator.sentence}", "  ")
    lines += told(estimate.tried)
    lines += _tests(meant.tests)
    if estimate.notes:
        lines += ["", "Notes"]
    for note in estimate.notes:
        lines += _wrapped(f"  {note}", "    ")
    return "\n".join(lines)


def whose(estimate: EstimateValues) -> str:
    """Return which numbers are whose, where two estimates stand beside each other."""
    own, meant = (
        f"{e.method} of {_structure(e)}, predictor '{e.predictor.kind}'"
        for e in (estimate, estimate.meant)
    )
    return (
        f"Two estimates stand beside each other: the free run, its fit and the verdict on the "
        f"prediction are those of {own}; coefficients, their tests and their verdict are those of "
        f"{meant}."
    )


def _structure(estimate: EstimateValues) -> str:
    structure = estimate.predictor.structure
    if len(structure.name) < _CELL:
        return f"structure '{structure.name}'"
    return so_many(len(structure.terms), "selected term")


def estimated(estimate: EstimateValues) -> list[tuple[str, float, float, str]]:
    """Return label, value, standard error and unit of each parameter, biases left out."""
    unit, structure = estimate.vessel.force_unit, estimate.predictor.structure
    columns, std = estimate.predictor.columns, estimate.std
    return [
        (
            columns[i].label,
            float(estimate.theta[i]),
            float(std[i]),
            parameter_unit(structure.terms[structure.index(columns[i].terms[0])], unit),
        )
        for i in estimate.predictor.parameter_columns
    ]


def _wrapped(text: str, indent: str) -> list[str]:
    return textwrap.wrap(
        text, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )


def _head(estimate: EstimateValues) -> list[str]:
    method = estimate.method + (", prefiltered" if estimate.prefilter == "noise" else "")
    structure = estimate.predictor.structure
    name, terms = structure.name, so_many(len(structure.terms), "term")
    rows = (
        ("Method:", method, "Samples:", f"{estimate.data.samples}"),
        ("Predictor:", estimate.predictor.kind, "Samples used:", f"{estimate.data.kept}"),
        ("Structure:", name if len(name) < _CELL else f"{terms} (below)",
         "Sample time:", f"{estimate.sample_time:g} s"),
        ("Std errors:", f"{estimate.covariance_kind}, {so_many(estimate.lags, 'lag')}",
         "Refinements:", f"{estimate.iteration.count}"),
    )  # fmt: skip
    lines = [f"{a:<18}{b:<{_CELL}}{c:<18}{d}" for a, b, c, d in rows]
    if len(name) >= _CELL:
        # where a line may break: before each term that came or went
        told = name.replace("+", " +").replace("-", " -")
        lines += _wrapped(f"Structure: {told}", "  ")
    return lines


def _table(estimate: EstimateValues) -> list[str]:
    sets = weak_safe_sets(estimate.tests)
    # only instruments can be weak
    safe = 24 if sets else 0
    named = 1 + max(11, *(len(c.label) for c in estimate.predictor.columns if not c.is_bias))
    lines = [
        f"{'parameter':<{named}}{'value':>10}{'std err':>9}{'[0.025':>11}{'0.975]':>11}"
        f"{'weak-safe 95 %' if sets else '':>{safe}}"
        f"{'per second':>11}  unit"
    ]
    unit, errors = estimate.vessel.force_unit, estimate.std
    structure = estimate.predictor.structure
    for state in structure.states:
        lines.append("-" * WIDTH)
        for i in estimate.predictor.equation(state):
            column = estimate.predictor.columns[i]
            if column.is_bias:
                continue
            value, std = estimate.theta[i], errors[i]
            term = structure.terms[structure.index(column.terms[0])]
            known = f"{std:>9.2g}{value - 1.96 * std:>11.4g}{value + 1.96 * std:>11.4g}"
            lines.append(
                f"{column.label:<{named}}{value:>10.4g}"
                f"{known if std > 0 else ' at bound'.ljust(31)}"
                f"{set_in_words(sets.get(column.label)):>{safe}}"
                f"{value / estimate.sample_time:>11.4g}  {parameter_unit(term, unit)}"
            )
    return lines


def weak_safe_sets(tests: Sequence[TestResult]) -> dict[str, Pieces]:
    """Return the sets (95 %) that hold however weak the instruments are, by parameter.

    Those that belong to another estimate than the one tested are left out.
    """
    sets: dict[str, Pieces] = {}
    for test in tests:
        if test.kind == "anderson_rubin" and test.detail.get("of") == "estimate":
            sets |= test.detail["sets"]
    return sets


def set_in_words(pieces: Pieces | None) -> str:
    """Return a set as it stands in a table: nothing where there is none."""
    if not pieces:
        return ""
    if len(pieces) == 2:
        return f"not {pieces[0][1]:.2g} to {pieces[1][0]:.2g}"
    low, high = pieces[0]
    if low is None and high is None:
        return "any value"
    if low is None:
        return f"below {high:.3g}"
    if high is None:
        return f"above {low:.3g}"
    return f"{low:.3g} to {high:.3g}"


def grouped(tests: Sequence[TestResult]) -> list[tuple[str, list[TestResult]]]:
    """Return the tests under the titles that tell what they ask."""
    left = list(tests)
    groups = []
    for title, kinds in _GROUPS.items():
        mine = [t for t in left if t.kind in kinds]
        left = [t for t in left if t not in mine]
        groups.append((title, mine))
    return [g for g in [*groups, ("Further", left)] if g[1]]


def _tests(tests: Sequence[TestResult]) -> list[str]:
    lines: list[str] = []
    for title, mine in grouped(tests):
        lines += ["", title]
        for test in mine:
            lines += _wrapped(f"  {_MARKS[test.passed]} {test.name}: {test.sentence}", " " * 7)
    return lines
