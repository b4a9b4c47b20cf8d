"""What to do with a plan, as its page and the terminal tell it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from greybox.report.next_steps import NextStep, typed


def after_design(
    record: Mapping[str, Any],
    judged: bool,
    remedy: str = "",
    missed: Sequence[str] = (),
    shorter: str = "",
) -> list[NextStep]:
    """Return what to do once the plan has been sailed, or before one that breaks its limits is.

    Parameters
    ----------
    record : mapping
        As the command records it.
    judged : bool
        Whether the plan has a part to judge the estimate by.
    remedy : str
        What helps a plan that does not keep its limits as it was asked to.
    missed : sequence of str
        Which limits it does not keep.
    shorter : str
        Command of a shorter plan that was tried and keeps them.
    """
    if remedy:
        why = f" ({'; '.join(missed)})" if missed else ""
        if shorter:
            tried = "half the duration keeps its limits, as was tried"
            return [NextStep(f"Do not sail this plan as it is{why}: {tried}", shorter)]
        return [NextStep(f"Do not sail this plan as it is{why}: {remedy}")]
    vessel, given = typed(record, "vessel", "V"), record.get("command", {})
    check = NextStep(
        "Sail the plan, and check its log before you leave the area",
        f"greybox check LOG --vessel {vessel} --report check.html",
    )
    explain = any(map(given.get, ("between", "causes", "diagnosis")))
    if explain or given.get("purpose") == "causes":
        return [
            check,
            NextStep(
                "See which of the explanations the log supports",
                f"greybox diagnose LOG --vessel {vessel} --report diagnosis.html",
            ),
        ]
    part = f" --plan {typed(record, 'out', 'PLAN')}" if judged else ""
    return [
        check,
        NextStep(
            "Estimate the model from it",
            f"greybox estimate LOG --vessel {vessel}{part} --out model.json --report model.html",
        ),
    ]
