"""The trial that tells two explanations apart, and how sure one will be afterwards."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from experiment_design.campaign import Progress
from experiment_design.contrast import Contrast, Pair
from experiment_design.design import Design, design_trial
from experiment_design.request import DesignRequest, Rival, build_problem
from experiment_design.search import draw_two_level
from greybox.errors import UsageError

Array = NDArray[np.float64]

# share of the usual search: distances are smoother in the levels than information is
_EFFORT = 0.2
# a log-likelihood ratio that no trial makes out
_SAME = 1e-6
# rounds in which the rival is fitted to the design and a new trial is sought
_REFITS = 2


@dataclass(frozen=True)
class Discrimination:
    """A trial between two explanations.

    Parameters
    ----------
    design : Design
        Its criterion is the logarithm of the expected log-likelihood ratio.
    names : (str, str)
    ratio : (float, float)
        Expected log-likelihood ratio in favour of the true one, if the first and
        if the second is true.
    ratio_refitted : (float, float)
        The same when every parameter of the wrong one is fitted to the new trial.
    random : float
        Mean ratio of the best of 200 random two-level sequences, nan if none.
    """

    design: Design
    names: tuple[str, str]
    ratio: tuple[float, float]
    ratio_refitted: tuple[float, float]
    random: float

    @property
    def probability(self) -> float:
        """Probability that the likelihood decides rightly, the worse of both cases."""
        return probability_right(min(self.ratio))

    @property
    def probability_refitted(self) -> float:
        """The same when the wrong one may fit all its parameters anew."""
        return probability_right(min(self.ratio_refitted))

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON: those of the design, and the discrimination."""
        a, b = self.names
        return self.design.to_dict() | {
            "criterion": "T",
            "discrimination": {
                "between": list(self.names),
                "log_likelihood_ratio": {a: self.ratio[0], b: self.ratio[1]},
                "log_likelihood_ratio_refitted": {
                    a: self.ratio_refitted[0],
                    b: self.ratio_refitted[1],
                },
                "best_random": self.random,
                "probability_right": self.probability,
                "probability_right_refitted": self.probability_refitted,
            },
        }

    def summary(self) -> str:
        """Return the result as text."""
        a, b = self.names
        lines = [
            f"Trial of {self.design.request.duration:g} s between {a} and {b}",
            self.design.status,
            f"expected log-likelihood ratio: {self.ratio[0]:.3g} if {a} is true, "
            f"{self.ratio[1]:.3g} if {b} is; best random two-level sequence {self.random:.3g}",
            f"the likelihood will decide rightly with probability {self.probability:.4f} for the "
            f"models as they are, {self.probability_refitted:.4f} when the wrong one is fitted to "
            f"the new trial",
        ]
        if self.probability_refitted < 0.95:
            lines.append(
                "Note: below 0.95 the trial may leave the question open: lengthen it, or widen "
                "the limits"
            )
        return "\n".join([*lines, *[f"Note: {n}" for n in self.design.notes]])


def probability_right(ratio: float) -> float:
    """Return the probability that a log-likelihood ratio of normal errors has the right sign.

    With the expectation T the ratio is distributed as N(T, 2T).
    """
    return float(norm.cdf(np.sqrt(max(ratio, 0.0) / 2)))


def design_between(
    request: DesignRequest,
    rival: Rival,
    names: tuple[str, str],
    *,
    best_effort: bool = False,
    progress: Progress | None = None,
    workers: int | None = None,
) -> Discrimination:
    """Design the trial in which two explanations predict the most different motion.

    The rival is fitted to each design found, and the fitted one joins those that
    the next design must tell apart.

    Parameters
    ----------
    request : DesignRequest
        Of one trial, with the first explanation as its model.
    rival : Rival
        The second one.
    names : (str, str)

    Raises
    ------
    UsageError
        The two predict the same motion, or several trials are asked for.

    References
    ----------
    Atkinson and Fedorov (1975), T-optimality; Kullback and Leibler (1951).
    """
    if request.trials != 1:
        raise UsageError("--between designs one trial at a time: leave out --trials.")
    rivals = [rival]
    _require_different(replace(request, rivals=(rival,)), names)
    best: Discrimination | None = None
    for _ in range(_REFITS):
        asked = replace(
            request, rivals=tuple(rivals), effort=_EFFORT * request.effort, estimator="iv"
        )
        design = design_trial(
            asked,
            best_effort=best_effort,
            progress=progress,
            workers=workers,
            alternatives=False,
            first=None if best is None else best.design.levels,
        )
        problem = build_problem(asked)
        if not isinstance(problem.contrast, Contrast):
            raise UsageError("the request names no rival.")
        pair = problem.contrast.pairs[0]
        found = _judge(design, pair, names)
        if best is None or min(found.ratio_refitted) > min(best.ratio_refitted):
            best = found
        rivals.append(_fitted(rival, pair, design.commands[0]))
    assert best is not None
    return best


def _require_different(request: DesignRequest, names: tuple[str, str]) -> None:
    """Raise where two explanations move the ship alike under every drawn sequence."""
    problem = build_problem(request)
    drawn = draw_two_level(problem, np.random.default_rng([29, request.seed]), 5)
    commands = problem.schedule.expand(problem.levels(drawn))
    largest = float(problem.contrast.value(commands).max()) if problem.contrast else 0.0
    if largest < np.log(_SAME):
        raise UsageError(
            f"{names[0]} and {names[1]} predict the same motion within these limits: the expected "
            f"log-likelihood ratio is {np.exp(largest):.1e} for random sequences. Name two models "
            f"that differ in what the ship does."
        )


def _free(model: Any) -> list[int]:
    """Return the positions of what a fit may move: all parameters, and a current that is there."""
    size = model.theta.size
    return [*range(size), *[size + i for i in range(model.d.size) if model.d[i] != 0]]


def _steps(pair: Pair, commands: Array) -> list[tuple[Array, Array, Array]]:
    """Return innovations, sensitivities and the fitted step of each model's filter."""
    out = []
    for which, model in enumerate((pair.first, pair.second)):
        seen = pair.innovations(commands)[which]
        slope = pair.sensitivities(commands, which, _free(model))
        size = np.linalg.norm(slope, axis=0)
        size[size == 0] = 1.0
        step = -np.linalg.lstsq(slope / size, seen, rcond=1e-8)[0] / size
        out.append((seen, slope, step))
    return out


def _judge(design: Design, pair: Pair, names: tuple[str, str]) -> Discrimination:
    steps = _steps(pair, design.commands[0])
    plain, refitted = [], []
    for seen, slope, step in steps:
        plain.append(float(seen @ seen) / 2)
        rest = seen + slope @ step
        refitted.append(min(float(rest @ rest) / 2, float(seen @ seen) / 2))
    # the first model's filter is wrong when the second one is true
    random = float("nan")
    if design.efficiency_vs_random is not None:
        random = float(np.exp(design.random_value))
    return Discrimination(design, names, (plain[1], plain[0]), (refitted[1], refitted[0]), random)


def _fitted(rival: Rival, pair: Pair, commands: Array) -> Rival:
    """Return the rival after one Gauss-Newton step towards the first model's motion."""
    _, _, step = _steps(pair, commands)[1]
    both = np.concatenate([rival.theta, rival.d])
    free = _free(pair.second)
    # a step is trusted as far as the linearisation may be
    size = np.maximum(0.3 * np.abs(both[free]), 1e-4)
    both[free] += np.clip(step, -size, size)
    split = rival.theta.size
    return Rival(rival.name, rival.structure, both[:split], both[split:])
