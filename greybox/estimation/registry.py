"""Estimators by name, each one file in `greybox.estimation.estimators`.

An entry says in data what the rest of the package must know of an estimator:
the shell, the choice between estimators, their tests and their comparison ask
the entry, never the name. Entries are light; what they compute with is
imported when they fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from greybox.registry import Registry

if TYPE_CHECKING:
    from greybox.estimation.problem import EstimationProblem, Fitted


@dataclass(frozen=True)
class Estimator:
    """One way to estimate the parameters of a predictor.

    Parameters
    ----------
    name : str
        As ``--method`` takes it and `Estimate.method` holds it.
    words : str
        What it is called.
    fit : callable
        Estimates an `EstimationProblem` and returns `Fitted`: its tests are run by the package.
    free_run : bool
        Whether it fits free runs: the run itself feels the current, whose components
        are parameters, and no regression is solved.
    instruments : bool
        Whether simulated instruments make it consistent under noise in the regressors.
    biased_by_noise : bool
        Whether noise in the regressors biases it.
    weights : tuple of str
        In what output error measures its errors, each compared as a way of its own.
    automatic : bool
        Whether it takes part where the choice of the method is left to the data.
    detail : str
        Words behind its name where there is room.
    ended : str
        A note on how it ended, with ``{status}``.
    unconverged : str
        What an iteration that still moved means.
    closed_loop : str
        What feedback in the logs means for it, with ``{lag}``.
    order : int
        Place in lists.
    """

    name: str
    words: str
    fit: Callable[[EstimationProblem], Fitted]
    free_run: bool = False
    instruments: bool = False
    biased_by_noise: bool = False
    weights: tuple[Literal["noise", "deviation"], ...] = ("noise",)
    automatic: bool = True
    detail: str = ""
    ended: str = ""
    unconverged: str = "so it may be off"
    closed_loop: str = "whose effect on it is not known. "
    order: int = 9

    @property
    def description(self) -> str:
        """Its words, with more behind them where there is more to say."""
        return f"{self.words} ({self.detail})" if self.detail else self.words


ESTIMATORS: Registry[Estimator] = Registry(
    "method", package="greybox.estimation.estimators", group="greybox.estimators"
)


def automatic_estimators() -> list[Estimator]:
    """Return those that the data may choose, the least biased by noise first, free runs last."""
    found = [e for e in ESTIMATORS.values() if e.automatic]
    return sorted(found, key=lambda e: (e.free_run, e.biased_by_noise))


def free_run_estimator() -> Estimator:
    """Return the estimator to fit free runs with where a regression does not do."""
    return next(e for e in automatic_estimators() if e.free_run)
