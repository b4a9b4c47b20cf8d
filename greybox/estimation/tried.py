"""What a choice tried: every alternative with its held-out score, as values, a table and lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from greybox.notebook import DisplayMixin, table

# rows of a comparison that a summary shows, and the width of their labels
_SHOWN, _LABEL = 4, 58


@dataclass(frozen=True)
class TriedModel:
    """One alternative of a comparison.

    Parameters
    ----------
    structure, predictor, method : str
    sample_time : float
        [s]
    thrust : str
        How the force goes with the speed n of a propeller.
    terms : int
        Parameters of the model.
    integrator : {"euler", "rk4"}
    commands : {"held", "interpolated"}
        What logged commands do between samples.
    score : float or None
        Mean fit of the free runs over the channels [%], each cut at −100; None where there is
        none.
    behind, se : float or None
        How far that falls behind the best one, and the standard error of this difference [%].
    chosen : bool
    note : str
        Why there is no score, or what decided instead.
    """

    structure: str
    predictor: str
    method: str
    sample_time: float
    thrust: str
    terms: int
    score: float | None = None
    behind: float | None = None
    se: float | None = None
    chosen: bool = False
    note: str = ""
    integrator: str = "euler"
    commands: str = "held"

    @property
    def label(self) -> str:
        """Method, predictor, size and structure."""
        return f"{self.method}, {self.predictor}, {self.terms} terms: {self.structure}"

    @property
    def result(self) -> str:
        """Score and distance to the best in words."""
        if self.score is None:
            return self.note or "no score"
        told = f"{self.score:.1f} %"
        if self.behind:
            error = "" if self.se is None else f" ± {self.se:.1f}"
            told += f", {self.behind:.1f}{error} behind"
        return f"{told}; {self.note}" if self.note else told

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return dict(vars(self))


@dataclass(frozen=True, repr=False)
class Comparison(DisplayMixin):
    """Alternatives that were compared in one way.

    Parameters
    ----------
    title : str
        What was compared.
    judged_on : str
        By what.
    rule : str
        Which one is taken.
    rows : tuple of TriedModel
    """

    title: str
    judged_on: str
    rule: str
    rows: tuple[TriedModel, ...]

    @property
    def chosen(self) -> TriedModel | None:
        """The alternative that was taken."""
        return next((r for r in self.rows if r.chosen), None)

    @property
    def decision(self) -> str:
        """Which alternative was taken and why, in a sentence."""
        taken = (
            "None"
            if self.chosen is None
            else f"{self.chosen.label} (thrust ~ {self.chosen.thrust})"
        )
        return f"{taken} was chosen: {self.rule}."

    @property
    def ordered(self) -> list[TriedModel]:
        """The best first, those without a score last."""
        return sorted(self.rows, key=lambda r: -np.inf if r.score is None else r.score)[::-1]

    def lines(self, most: int = _SHOWN) -> list[str]:
        """Return the best rows and the chosen one as lines of text."""
        best = self.ordered
        shown = [r for i, r in enumerate(best) if i < most or r.chosen]
        lines = [f"  {self.title}, by {self.judged_on}:"]
        for row in shown:
            label = row.label if len(row.label) <= _LABEL else row.label[: _LABEL - 1] + "…"
            lines.append(f"  {'>' if row.chosen else ' '} {label:<{_LABEL}} {row.result}")
        if len(best) > len(shown):
            lines.append(f"    and {len(best) - len(shown)} more (--report and --json have all)")
        return lines

    def summary(self) -> str:
        """Return all rows and the decision as text."""
        return "\n".join([*self.lines(len(self.rows)), f"  {self.decision}"])

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Return the header and rows, as cells of a table."""
        head = ["structure", "chosen", "terms", "method", "predictor", "thrust ~", "step [s]",
                "integrator", "commands", "score [%]", "behind", "std error", ""]  # fmt: skip
        return head, [
            [
                r.structure, "chosen" if r.chosen else "", str(r.terms), r.method, r.predictor,
                r.thrust, f"{r.sample_time:g}", r.integrator, r.commands,
                *("–" if v is None else f"{v:.1f}" for v in (r.score, r.behind, r.se)),
                r.note,
            ]
            for r in self.ordered
        ]  # fmt: skip

    def _parts(self) -> tuple[str, ...]:
        return (table(*self.table()),)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            "title": self.title,
            "judged_on": self.judged_on,
            "rule": self.rule,
            "decision": self.decision,
            "rows": [r.to_dict() for r in self.rows],
        }


def told(comparisons: Sequence[Comparison]) -> list[str]:
    """Return what was tried as lines of a summary, nothing where nothing was compared."""
    if not comparisons:
        return []
    head = "What was tried (free-run fit, mean over the channels; behind the best ± std error)"
    return ["", head, *(line for c in comparisons for line in c.lines())]
