"""Tables of the alternatives that were compared for a choice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from greybox.estimation.registry import free_run_estimator
from greybox.estimation.result import Estimate
from greybox.estimation.tried import Comparison
from greybox.selection.alternatives import OVER, Alternative, scored, tried_model
from greybox.selection.cross_validation import EstimatorComparison, gain
from greybox.selection.held_out import Ranking
from greybox.selection.term_selection import FEW, Step, TermChoice, law_in_words
from greybox.trial.log import TrialLog


def estimators_tried(
    compared: EstimatorComparison, like: Estimate, logs: Sequence[TrialLog]
) -> Comparison:
    """Return the table of estimators that held-out runs compared."""
    rows = []
    for i, (variant, scores) in enumerate(zip(compared.variants, compared.scores, strict=True)):
        way = Alternative(like.predictor.structure, variant.label, like.predictor.kind)
        row = tried_model(way, logs, chosen=i == compared.chosen, note="refused")
        by, se = gain(compared.scores[compared.best] - scores)
        if np.isfinite(by):
            row = replace(row, score=float(np.nanmean(scores)), behind=by, se=se, note="")
        rows.append(row)
    return Comparison(
        "estimators of this structure",
        "free runs on parts of the logs that were left out in turn",
        f"{compared.variants[0].label} stays unless another gains more than a standard error",
        tuple(rows),
    )


def terms_tried(choice: TermChoice, found: Estimate, logs: Sequence[TrialLog]) -> list[Comparison]:
    """Return the tables of thrust laws and of numbers of terms that were tried."""
    way = Alternative(choice.terms.structure, free_run_estimator().name, choice.terms.kind)
    present = Alternative(found.predictor.structure, found.method, found.predictor.kind)
    selected, law = tried_model(way, choice.logs), choice.logs[0].vessel.thrusters[0].thrust
    rows = []
    for i, row in enumerate(choice.rows):
        name = selected.structure if row["chosen"] else "selected terms"
        base = replace(selected, structure=name) if i else tried_model(present, logs)
        values = {k: row[k] for k in ("score", "behind", "se", "chosen")}
        rows.append(replace(base, terms=row["coefficients"], **values))
    laws = [
        replace(
            selected,
            structure=f"thrust ~ {law_in_words(one)}",
            thrust=law_in_words(one),
            terms=FEW,
            score=100 * (1 - float(np.sqrt(error))) if np.isfinite(error) else None,
            chosen=one == law,
            note="" if np.isfinite(error) else OVER,
        )
        for one, error in choice.laws
    ]
    best = max((r.score for r in laws if r.score is not None), default=0.0)
    laws = [r if r.score is None else replace(r, behind=best - r.score) for r in laws]
    by_terms = Comparison(
        "number of terms",
        "free runs on parts of the logs that were left out in turn, the terms chosen without each",
        "the fewest terms, the published structure first, whose error is larger than the least by "
        "no more than one standard error and 1 %",
        tuple(rows),
    )
    by_law = Comparison(
        "thrust law",
        "free runs on all the logs",
        "n|n|, as propeller theory has it, unless another leaves an error that is 10 % smaller",
        tuple(laws),
    )
    taken = Step(choice.terms.integrator, choice.logs[0].vessel.actuation.between)
    by_step = Comparison(
        "integrator, and commands between samples",
        "free runs of these terms on parts of the logs that were left out in turn",
        "the first stays unless it falls behind the best by more than one standard error and 1 %",
        tuple(
            replace(
                selected,
                structure=f"steps by {step.integrator}, commands {step.commands}",
                integrator=step.integrator,
                commands=step.commands,
                score=score if np.isfinite(score) else None,
                behind=behind if np.isfinite(score) else None,
                se=se if np.isfinite(score) else None,
                chosen=step == taken,
                note="" if np.isfinite(score) else OVER,
            )
            for step, score, behind, se in choice.steps
        ),
    )
    tables = [(by_law, len(laws) > 1), (by_terms, True), (by_step, bool(choice.steps))]
    return [compared for compared, shown in tables if shown]


def runs_tried(
    estimates: Sequence[Estimate],
    found: Ranking,
    logs: Sequence[TrialLog],
) -> Comparison:
    """Return the table of estimates whose runs over parts left out were compared."""
    rows = [
        scored(
            tried_model(
                Alternative(e.predictor.structure, e.method, e.predictor.kind),
                logs,
                chosen=i == found.chosen,
            ),
            found,
            i,
        )
        for i, e in enumerate(estimates)
    ]
    return Comparison(
        "ways to predict",
        "free runs on parts of the logs that were left out in turn",
        "the first estimate stays unless it falls behind the best by more than one standard error",
        tuple(rows),
    )
