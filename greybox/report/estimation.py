"""The page of `greybox estimate`: whether to trust the model, how it moves, what is known of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.channels import MOTION_WORDS
from greybox.errors import so_many
from greybox.estimation.registry import ESTIMATORS
from greybox.estimation.result import Estimate
from greybox.estimation.summary import (
    BOUNDS,
    grouped,
    set_in_words,
    weak_safe_sets,
    whose,
)
from greybox.estimation.tried import Comparison
from greybox.estimation.values import EstimateValues
from greybox.estimation.verdict import TestResult, TrustLevel
from greybox.model.terms import parameter_unit
from greybox.report.comparison import run_picture
from greybox.report.estimation_figures import (
    MOST_DRAWN,
    REACH,
    correlation_figure,
    forest_figure,
    regime_shares,
    regimes_figure,
    residual_figure,
    tried_figure,
    visited_figure,
)
from greybox.report.figures import narrow, to_svg
from greybox.report.model_difference import shown_unit, unbroken
from greybox.report.next_steps import after_estimate
from greybox.report.page import Page, Picture, Section, Table, capital, computed
from greybox.report.physical import physical_summary
from greybox.selection.structures import StructureChoice
from greybox.trial.log import TrialLog
from greybox.validation.fit import mean_fit, run_model, told_fits

Array = NDArray[np.float64]

_OUTCOMES = {True: "passed", False: "speaks against it", None: "for information"}
# logs that are drawn against time: with more the page grows and tells nothing new
_MOST_LOGS = 3
_MOST_PAIRS = 3
_WORTH_TELLING = 0.9


def estimation_page(
    estimate: Estimate,
    logs: Sequence[TrialLog],
    record: Mapping[str, Any],
    *,
    choice: StructureChoice | None = None,
    mass: float | None = None,
    validate: Sequence[TrialLog] = (),
) -> Page:
    """Return the page, its story first.

    Parameters
    ----------
    estimate : Estimate
    logs : sequence of TrialLog
        Those it was estimated on.
    record : mapping
        How it was computed: versions, command, hashes of the files, seed.
    choice : StructureChoice, optional
        What other structures would have done.
    mass : float, optional
        m [kg], for physical coefficients.
    validate : sequence of TrialLog
        Those kept from the estimate that its prediction was judged on.
    """
    lead, run = _run(estimate, logs, validate)
    sections = [
        run,
        _parameters(estimate),
        _residuals(estimate.meant),
        _visited(estimate, logs),
        _tests(estimate.meant),
        _chosen(estimate, choice),
        _equations(estimate, mass),
    ]
    return Page(
        title=f"How far to trust this model of {estimate.vessel.name}",
        headline=headline(estimate),
        sentences=_summary(estimate),
        tables=_prediction(estimate),
        sections=[s for s in sections if s is not None],
        lead=lead,
        next_steps=after_estimate(estimate, record),
        computed=computed(dict(record))
        | {
            "standard errors": f"{estimate.covariance_kind}, residuals remembered over "
            f"{estimate.lags} samples",
            "free run": "from the mean of the log's first 5 samples, driven by its inputs and "
            "measured heading",
        },
    )


def headline(estimate: Estimate) -> str:
    """Return both verdicts as sentences, with how well the free run follows the logs."""
    verdict, prediction = estimate.meant.verdict, estimate.prediction
    if verdict.level is TrustLevel.TRUST_EXCEPT:
        told = f"Trust its coefficients, except for {', '.join(verdict.excepted)}"
    else:
        does = "Trust" if verdict.level is TrustLevel.TRUST else "Do not trust"
        told = f"{does} its coefficients: {verdict.reason}"
    if prediction is not None:
        told = f"Prediction is {prediction.level}: {prediction.reason}. {told}"
    if not estimate.fit:
        return f"{told}."
    fit = told_fits(estimate.fit, 0)
    logs = "log" if len(estimate.logs) == 1 else "logs"
    return f"{told}. Its free run fits the {logs} it was estimated on by {fit} (100 is perfect)."


def _prediction(estimate: Estimate) -> list[Table]:
    """Show what the free run is good for, a row a channel."""
    prediction = estimate.prediction
    if prediction is None:
        return []
    head, rows = prediction.rows()
    caption = f"What the free run is good for: on {prediction.judged_words}"
    return [Table(caption, head, [[unbroken(c) for c in row] for row in rows])]


def _summary(estimate: Estimate) -> list[str]:
    method = ESTIMATORS[estimate.method].description
    if estimate.prefilter == "noise":
        method += ", refined by the noise"
    told = [
        f"{so_many(len(estimate.names), 'parameter')} of structure "
        f"'{estimate.predictor.structure.name}' by "
        f"{method}, predictor '{estimate.predictor.kind}', from {estimate.kept} of "
        f"{estimate.samples} samples of {estimate.sample_time:g} s in "
        f"{so_many(len(estimate.logs), 'log')}.",
        # the headline has the others
        *(
            _sentence(r.sentence)
            for r in (estimate.prediction.because if estimate.prediction else ())
            if not r.fatal
        ),
        *(r.sentence for r in estimate.meant.verdict.because if not r.fatal),
    ]
    if estimate.meant is not estimate:
        told.append(whose(estimate))
    if estimate.current:
        shown = ", ".join(f"{n} {v:.3f} ± {1.96 * s:.3f} m/s" for n, v, s in estimate.current)
        told.append(f"Current found beside the parameters (± 95 %): {shown}.")
    return told


def _run(
    estimate: Estimate, logs: Sequence[TrialLog], validate: Sequence[TrialLog]
) -> tuple[Picture, Section]:
    """Show the free run against the logs, the worst of those that judge drawn apart."""
    model = estimate.model()
    own, kept = logs[:_MOST_LOGS], validate[:_MOST_LOGS]
    drawn = [*kept, *own]
    curves = 3 * len(drawn) * len(model.structure.states)
    runs = [run_model(model, log) for log in drawn]
    worst = int(np.argmin([mean_fit(run.fit) for run in runs[: len(kept) or len(own)]]))
    pictures = []
    for i, (log, run) in enumerate(zip(drawn, runs, strict=True)):
        whose = "kept from the estimate" if i < len(kept) else "the model was estimated on"
        caption = (
            f"Free run on {log.name} ({len(log)} samples of {log.sample_time:g} s), a log "
            f"{whose}: measured, simulated, and their difference below."
        )
        told = f"Fit: {told_fits(run.fit, 0)}."
        picture = run_picture(["model"], [run], [], curves, f"run{i}", caption, told)
        pictures.append(replace(picture, narrow=len(drawn) > 1))
    several = len(logs) > 1
    told = f"The model was fitted to {'these logs' if several else 'this log'}, so the free run "
    told += "shows what it cannot follow, not how well it predicts"
    sentences = [f"{told}: for that, see the table above." if estimate.prediction else f"{told}."]
    if len(logs) > len(own):
        sentences.append(f"Of {len(logs)} logs the first {len(own)} are drawn.")
    if len(validate) > len(kept):
        sentences.append(
            f"Of {len(validate)} logs kept from the estimate the first {len(kept)} are drawn."
        )
    first = "Of those drawn the one of lowest fit stands" if several else "Its free run is drawn"
    if kept:
        first = "Of the logs kept from the estimate the one of lowest fit stands"
        first = first if len(kept) > 1 else "The log kept from the estimate stands"
    sentences.append(f"{first} at the top of the page.")
    lead = pictures.pop(worst)
    return lead, Section("1. Does its free run follow the log?", sentences, pictures)


def _parameters(predicts: Estimate) -> Section:
    """Show intervals, and which estimates hang together; the parameters that predict below."""
    estimate = predicts.meant
    place = list(estimate.predictor.parameter_columns)
    theta, std = estimate.theta[place], estimate.std[place]
    labels, units = list(estimate.labels), _units(estimate)
    sets = weak_safe_sets(estimate.tests)
    known = np.isfinite(std)
    with_unit = [f"{n} [{u}]" if u else n for n, u in zip(labels, units, strict=True)]
    wide = [
        n for n, v, s in zip(labels, theta, std, strict=True)
        if not 1.96 * s * 100 <= REACH * abs(v)
    ]  # fmt: skip
    caption = "95 % intervals relative to each value; at −100 % a parameter would be zero."
    if sets:
        caption += " Light: the interval that holds even where the instruments are weak."
    if wide:
        caption += f" Wider than drawn: {', '.join(wide)}."
    worst = "; ".join(
        f"{n} ± {196 * s / abs(v):.0f} %" if v else f"{n} is 0"
        for n, v, s in zip(labels, theta, std, strict=True)
    )
    pictures = [
        narrow(
            forest_figure(
                with_unit, theta, np.where(known, std, 0.0), sets, estimate.verdict.excepted
            ),
            "forest",
            caption,
            f"Intervals of the parameters relative to their values: {worst}.",
        )
    ]
    told = []
    covariance = estimate.covariance[np.ix_(place, place)]
    if len(place) > 1 and known.all() and (std > 0).all():
        correlation = covariance / np.outer(std, std)
        told = _pairs(labels, correlation)
        pictures.append(
            narrow(
                correlation_figure(labels, correlation),
                "correlation",
                "Which estimates move together: a strong correlation means that the log tells "
                "the two apart badly. Beyond ±0.9 the sign is written.",
                f"Map of the correlations between {len(labels)} estimates. {' '.join(told)}",
            )
        )
    told += [f"{BOUNDS[name]}: {limit.sentence}" for name, limit in estimate.limits.items()]
    if estimate.told_of_choice:
        told.append(estimate.told_of_choice)
    tables = [_parameter_table(estimate)]
    if estimate is not predicts:
        told.insert(0, whose(predicts))
        table = _parameter_table(predicts)
        beside = f". {predicts.told_of_choice}" if predicts.told_of_choice else ""
        tables.append(replace(table, caption=f"What predicts: {table.caption}{beside}"))
    return Section("2. How well is each parameter known?", told, pictures, tables)


def _units(estimate: EstimateValues) -> list[str]:
    structure = estimate.predictor.structure
    return [
        shown_unit(
            parameter_unit(
                structure.terms[structure.index(estimate.predictor.columns[i].terms[0])],
                estimate.vessel.force_unit,
            )
        )
        for i in estimate.predictor.parameter_columns
    ]


def _pairs(labels: Sequence[str], correlation: Array) -> list[str]:
    """Return the strongest correlations in words."""
    low, high = np.tril_indices(len(labels), -1)
    order = np.argsort(-np.abs(correlation[low, high]))[:_MOST_PAIRS]
    pairs = [(labels[high[k]], labels[low[k]], correlation[low[k], high[k]]) for k in order]
    strong = [p for p in pairs if abs(p[2]) > _WORTH_TELLING]
    if not strong:
        one, other, value = pairs[0]
        return [
            f"No two estimates are strongly correlated; the most correlated are {one} and {other} "
            f"({value:.2f})."
        ]
    shown = ", ".join(f"{a} and {b} ({value:.2f})" for a, b, value in strong)
    return [f"The log tells these pairs apart worst (correlation): {shown}."]


def _parameter_table(estimate: EstimateValues) -> Table:
    place = list(estimate.predictor.parameter_columns)
    theta, std = estimate.theta[place], estimate.std[place]
    labels, units = estimate.labels, _units(estimate)
    sets = weak_safe_sets(estimate.tests)
    rows = []
    for name, unit, value, error in zip(labels, units, theta, std, strict=True):
        known = f"{value - 1.96 * error:.4g} to {value + 1.96 * error:.4g}"
        row = [
            name, f"{value:.4g}", *((f"{error:.2g}", known) if error > 0 else ("at bound", "–")),
            *([set_in_words(sets.get(name))] if sets else []),
            f"{value / estimate.sample_time:.4g}", unit,
            "not to rely on" if name in estimate.verdict.excepted else "",
        ]  # fmt: skip
        rows.append([unbroken(cell) for cell in row[:-2]] + row[-2:])
    return Table(
        f"Parameters per sample of {estimate.sample_time:g} s, and per second",
        [
            "parameter", "value", "std error", "95 % interval",
            *(["safe if weak"] if sets else []),
            "per second", "unit per sample", "",
        ],
        rows,
    )  # fmt: skip


def _by_state(tests: Sequence[TestResult], kind: str) -> dict[str, Mapping[str, Any]]:
    """Return the numbers of one kind of test, by state; those that do not apply are left out."""
    return {t.state: t.detail for t in tests if t.kind == kind and t.obstacle is None}


def _residuals(estimate: EstimateValues) -> Section | None:
    states = estimate.predictor.structure.states
    own = _by_state(estimate.tests, "whiteness")
    moved = _by_state(estimate.tests, "input_independence")
    inputs = {s: detail["inputs"] for s, detail in moved.items()}
    if not own and not inputs:
        return None
    told = [
        _sentence(f"{MOTION_WORDS.get(s, s)}: {t.sentence}")
        for s in states
        for t in estimate.tests
        if t.state == s and t.kind in ("whiteness", "input_independence")
    ]
    figure = residual_figure(states, own, inputs)
    caption = (
        "Correlation of the one-step residuals with themselves and with the inputs; grey holds 95 "
        "% of the values that chance gives, filled marks lie outside it. Neighbours depend on one "
        "another: "
        "the tests weigh all of them together."
    )
    sentence = (
        "Residuals of regressions on noisy measurements are coloured, which is no fault; but "
        "where an input explains them, the model lacks something."
    )
    return Section(
        "3. What do the residuals say?", [sentence],
        [Picture(to_svg(figure, "residuals"), caption, f"{caption} {' '.join(told)}")],
        points=told,
    )  # fmt: skip


def _visited(estimate: Estimate, logs: Sequence[TrialLog]) -> Section:
    """Show what the logs excite."""
    states = estimate.predictor.structure.states
    values = {s: np.concatenate([log[s] for log in logs]) for s in states}
    ranges = ", ".join(
        f"{MOTION_WORDS.get(s, s)} from {v.min():.2f} to {v.max():.2f}" for s, v in values.items()
    )
    margins = _margins(estimate)
    caption = "How much of the time each value was met, all logs together."
    if margins:
        caption += " Shaded: cut out, too near to zero."
    pictures = [
        narrow(
            visited_figure(values, margins), "visited", caption, f"{caption} {ranges} (m/s, rad/s)."
        )
    ]
    if "u" in values and "v" in values:
        shares = ", ".join(
            f"{n} {100 * s:.0f} %" for n, s in regime_shares(values["u"], values["v"]).items()
        )
        caption = (
            "Surge against sway with the share of the time in each combination of signs: a "
            "parameter of |u|u or |v|v is only known where the ship was."
        )
        figure = regimes_figure(values["u"], values["v"])
        pictures.append(narrow(figure, "regimes", caption, f"{caption} {shares}."))
    told = [
        _sentence(f"{MOTION_WORDS.get(s, s)}: {t.sentence}")
        for s in states
        for t in estimate.tests
        if t.state == s and t.kind == "excitation"
    ]
    return Section("4. What did the logs excite?", pictures=pictures, points=told)


def _margins(estimate: Estimate) -> dict[str, float]:
    return {
        t.state: float(t.detail["margin"])
        for t in estimate.tests
        if t.kind == "margin" and t.obstacle is None and estimate.kept < estimate.samples
    }


def _sentence(text: str) -> str:
    return capital(text) + ("" if text.endswith(".") else ".")


def _tests(estimate: EstimateValues) -> Section:
    """List every test with its statistic."""
    tables = [
        Table(
            title,
            ["test", "statistic", "p-value", "outcome", "what it says"],
            [
                [
                    t.name.replace("_", " "),
                    "" if t.statistic is None else unbroken(f"{t.statistic:.3g}"),
                    "" if t.p_value is None else unbroken(f"{t.p_value:.2g}"),
                    "does not apply" if t.obstacle is not None else _OUTCOMES[t.passed],
                    _sentence(t.sentence),
                ]
                for t in tests
            ],
            sentences=True,
        )
        for title, tests in grouped(estimate.tests)
    ]
    told = () if tables else ("No tests were made.",)
    return Section("5. All tests", told, tables=tables)


def _chosen(estimate: Estimate, choice: StructureChoice | None) -> Section | None:
    """Tell what was chosen for the user, and why."""
    if not estimate.notes and choice is None:
        return None
    texts = [("Structures compared", choice.summary())] if choice else []
    return Section(
        "6. What was chosen, and why",
        pictures=[p for i, c in enumerate(estimate.tried) for p in _tried_picture(c, i)],
        tables=[Table(_tried_caption(c), *c.table()) for c in estimate.tried],
        points=estimate.notes,
        texts=texts,
    )


def _tried_caption(compared: Comparison) -> str:
    return f"What was tried: {compared.title}, by {compared.judged_on}"


def _tried_picture(compared: Comparison, place: int) -> list[Picture]:
    """Draw the scores of what was compared, where there are some to compare."""
    scores = [r for r in compared.ordered if r.score is not None]
    if len(scores) < 2:
        return []
    caption = (
        f"{_tried_caption(compared)}. Bars: one standard error of the distance to the best, which "
        f"is dotted. {compared.decision}"
    )
    if len(scores) > MOST_DRAWN:
        caption += f" Of {len(scores)} the best {MOST_DRAWN} are drawn; all are in the table."
    every = "; ".join(f"{r.label}: {r.result}" for r in scores)
    return [narrow(tried_figure(compared), f"tried{place}", caption, f"{caption} {every}.")]


def _equations(estimate: Estimate, mass: float | None) -> Section:
    model = estimate.model()
    lines = "\n".join(
        [
            *model.structure.equations(),
            "u_r, v_r: velocity through the water; u_q, v_q: through the air",
        ]
    )
    texts = [("Per sample", lines)]
    if mass is not None:
        texts.append(("In physical units", physical_summary(model, mass)))
    return Section("7. The equations", texts=texts)
