"""The trial that separates two explanations, and the probability of the right decision."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from experiment_design.criteria.t_optimality import Contrast, Pair
from experiment_design.design import design_trial
from experiment_design.optimise.campaign import Progress
from experiment_design.optimise.search import draw_two_level
from experiment_design.output.result import Design
from experiment_design.request.exclusions import require_compatible
from experiment_design.request.request import CandidateModel, PreparedRequest, build_problem
from greybox.errors import InfeasibleError, UsageError
from greybox.notebook import DisplayMixin, items, number, sparkline, table

Array = NDArray[np.float64]

# share of the usual search: distances are smoother in the levels than information is
_EFFORT = 0.2
# share of the ratio that is left when one explanation can become the other
_NESTED = 1e-3
# a log-likelihood ratio that no trial makes out
_SAME = 1e-6
# rounds in which the rival is fitted to the design and a new trial is sought
_REFITS = 2


@dataclass(frozen=True, repr=False)
class Discrimination(DisplayMixin):
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
    nested : bool
        Whether one of them, fitted, can be the other: then only the case counts
        in which the other cannot follow.
    random : float
        Mean ratio of the best of 200 random two-level sequences, nan if none.
    """

    design: Design
    names: tuple[str, str]
    ratio: tuple[float, float]
    ratio_refitted: tuple[float, float]
    nested: bool
    random: float

    @property
    def probability(self) -> float:
        """Probability that the likelihood picks the true explanation, the lower of the two."""
        return probability_right(min(self.ratio))

    @property
    def probability_refitted(self) -> float:
        """The same when the wrong one may fit all its parameters anew."""
        return probability_right(self.telling)

    @property
    def telling(self) -> float:
        """Log-likelihood ratio that remains after the wrong explanation is fitted anew."""
        return max(self.ratio_refitted) if self.nested else min(self.ratio_refitted)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON: those of the design, and the discrimination."""
        return self.design.to_dict() | {
            "criterion": "T",
            "discrimination": {
                "between": list(self.names),
                "log_likelihood_ratio": dict(zip(self.names, self.ratio, strict=True)),
                "log_likelihood_ratio_refitted": dict(
                    zip(self.names, self.ratio_refitted, strict=True)
                ),
                "nested": self.nested,
                "best_random": self.random,
                "probability_right": self.probability,
                "probability_right_refitted": self.probability_refitted,
            },
        }

    def _line(self) -> str:
        a, b = self.names
        return (
            f"trial of {self.design.request.duration:g} s between {a} and {b}: the likelihood "
            f"decides rightly with probability {self.probability_refitted:.4f}"
        )

    def _parts(self) -> tuple[str, ...]:
        commands = zip(
            self.design.request.schedule.commands, self.design.commands[0].T, strict=True
        )
        return (
            table(
                ("if true", "log-likelihood ratio", "the other fitted anew"),
                [
                    (n, number(x, 3), number(y, 3))
                    for n, x, y in zip(self.names, self.ratio, self.ratio_refitted, strict=True)
                ],
            ),
            table(
                ("command", "least", "most", "over time"),
                [(n, number(c.min()), number(c.max()), sparkline(c)) for n, c in commands],
            ),
            items("Notes", self.design.notes),
        )

    def summary(self) -> str:
        """Return the result as text."""
        a, b = self.names
        random = "no random sequence keeps the limits"
        if np.isfinite(self.random):
            random = f"best random two-level sequence {self.random:.3g}"
        lines = [
            f"Trial of {self.design.request.duration:g} s between {a} and {b}",
            self.design.status,
            f"expected log-likelihood ratio: {self.ratio[0]:.3g} if {a} is true, "
            f"{self.ratio[1]:.3g} if {b} is; {random}",
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
    request: PreparedRequest,
    rival: CandidateModel,
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
    request : PreparedRequest
        Of one trial, with the first explanation as its model.
    rival : CandidateModel
        The second one.
    names : (str, str)
    best_effort : bool
        Whether the closest plan is returned where a limit cannot be kept.
    progress : callable, optional
        Called with steps done and steps in all.
    workers : int, optional
        Processes.

    Returns
    -------
    Discrimination

    Raises
    ------
    UsageError
        The two predict the same motion or have other states, or what is asked does not go with
        two models.
    InfeasibleError
        The limits cannot be kept, or the run of one leaves every bound at the slightest change.

    References
    ----------
    Atkinson and Fedorov (1975), T-optimality; Kullback and Leibler (1951).
    """
    require_compatible(request.given | {"between"})
    mine, other = request.structure.states, rival.structure.states
    if set(mine) != set(other):
        raise UsageError(
            f"{names[0]} has the states {', '.join(mine)} and {names[1]} {', '.join(other)}: name "
            f"two models of the same states, whose motions can be compared."
        )
    first = CandidateModel(
        names[0], request.structure, request.theta, request.d, integrator=request.integrator
    )
    pairs = [(first, rival)]
    _require_different(replace(request, contrasts=tuple(pairs)), names)
    best: Discrimination | None = None
    for _ in range(_REFITS):
        asked = replace(
            request, contrasts=tuple(pairs), effort=_EFFORT * request.effort, estimator="iv"
        )
        design = design_trial(
            asked,
            best_effort=best_effort,
            progress=progress,
            workers=workers,
            alternatives=False,
            first=None if best is None else best.design.levels,
        )
        contrast = build_problem(asked).contrast
        assert isinstance(contrast, Contrast)
        steps = _steps(contrast.pairs[0], design.commands[0], names)
        found = _judge(design, contrast.pairs[0], steps, names)
        if best is None or found.telling > best.telling:
            best = found
        # each is fitted to the other's motion, unless it can become the other
        for which, explanation in enumerate((first, rival)):
            if found.ratio_refitted[1 - which] > _NESTED * found.ratio[1 - which]:
                fitted = _fitted(explanation, steps[which][2])
                pairs.append((first, fitted) if which else (fitted, rival))
    assert best is not None
    return best


def _require_different(request: PreparedRequest, names: tuple[str, str]) -> None:
    """Raise where two explanations move the ship alike under every drawn sequence."""
    problem = build_problem(request)
    drawn = draw_two_level(problem, np.random.default_rng([29, request.seed]), 5)
    commands = problem.commands(drawn)
    assert isinstance(problem.contrast, Contrast)
    largest = float(problem.contrast.value(commands).max())
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


def _steps(pair: Pair, commands: Array, names: tuple[str, str]) -> list[tuple[Array, Array, Array]]:
    """Return innovations, sensitivities and the fitted step of each model's filter.

    Raises
    ------
    InfeasibleError
        A run leaves every bound as soon as one parameter changes.
    """
    out = []
    seen = pair.innovations(commands)
    for which, model in enumerate((pair.first, pair.second)):
        slope = pair.sensitivities(commands, which, _free(model))
        lost = ~np.isfinite(slope).all(axis=0)
        if lost.any():
            known = (*model.structure.parameters, *model.structure.disturbances)
            raise InfeasibleError(
                f"the run of {names[which]} leaves every bound when {known[int(lost.argmax())]} "
                f"changes by a hundred-thousandth of itself, so nothing tells how well it could "
                f"imitate {names[1 - which]}: shorten the trial (--duration), or estimate both on "
                f"longer logs."
            )
        size = np.linalg.norm(slope, axis=0)
        size[size == 0] = 1.0
        step = -np.linalg.lstsq(slope / size, seen[which], rcond=1e-8)[0] / size
        out.append((seen[which], slope, step))
    return out


def _judge(
    design: Design,
    pair: Pair,
    steps: list[tuple[Array, Array, Array]],
    names: tuple[str, str],
) -> Discrimination:
    plain, refitted = [], []
    for seen, slope, step in steps:
        plain.append(float(seen @ seen) / 2)
        rest = seen + slope @ step
        refitted.append(min(float(rest @ rest) / 2, plain[-1]))
    # the first model's filter is the wrong one when the second model is true
    ratio, left = (plain[1], plain[0]), (refitted[1], refitted[0])
    nested = any(b < _NESTED * a for a, b in zip(ratio, left, strict=True))
    random = float(np.exp(design.random_value)) if design.random_kept else float("nan")
    return Discrimination(design, names, ratio, left, nested, random)


def _fitted(explanation: CandidateModel, step: Array) -> CandidateModel:
    """Return an explanation after one Gauss-Newton step towards the other's motion."""
    both = np.concatenate([explanation.theta, explanation.d])
    free = _free(explanation)
    # a step is trusted as far as the linearisation may be
    size = np.maximum(0.3 * np.abs(both[free]), 1e-4)
    both[free] += np.clip(step, -size, size)
    split = explanation.theta.size
    return replace(explanation, theta=both[:split], d=both[split:])
