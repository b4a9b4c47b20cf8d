"""Which of several models is better on logs, beyond chance, and whether it predicts."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.channels import MOTION_WORDS
from greybox.estimation.prediction_verdict import LIMITS, NothingMoved, RunsDiverge
from greybox.validation.fit import LEFT, LogFit, mean_fit, told_fits
from greybox.validation.gain import Gain, gain_over_stretches
from greybox.validation.judge_prediction import NoiseBeside

Array = NDArray[np.float64]

# fit [%] with which the error is half of the spread: the limit of a good prediction
_USABLE = 100 * (1 - LIMITS.good)
# percent of fit below what noise allows that are as good as it
_NEAR = 5.0


def weak_channels(
    fit: Mapping[str, float], bounds: Mapping[str, float], still: Collection[str] = ()
) -> list[str]:
    """Return the states that a model does not predict.

    Parameters
    ----------
    fit, bounds : mapping of str to float
        Fit (6.12) of each state, and that of a perfect model where the sensor's noise is
        known [%]: noise may hide a channel, which is no fault of the model.
    still : collection of str
        States that moved too little to matter, which do not decide.
    """
    return [
        s for s, f in fit.items()
        if s not in still and f < min(_USABLE, bounds.get(s, 100.0) - _NEAR)
    ]  # fmt: skip


def beyond_noise(
    fit: Mapping[str, float], bounds: Mapping[str, float], still: Collection[str] = ()
) -> list[str]:
    """Return the states whose error is more than the noise of their sensor explains."""
    return [s for s, f in fit.items() if s not in still and f < bounds.get(s, 100.0) - _NEAR]


def use_sentence(
    which: str,
    on: str,
    fit: Mapping[str, float],
    bounds: Mapping[str, float],
    still: Collection[str] = (),
) -> str:
    """Return whether a model predicts, beside what sensor noise allows.

    Parameters
    ----------
    which, on : str
        The model, and the data that it was not fitted to.
    fit, bounds, still
        As `weak_channels`.
    """
    weak = weak_channels(fit, bounds, still)
    words = ", ".join(MOTION_WORDS.get(s, s) for s in weak)
    told = f"Do not predict {words} with {which}" if weak else f"You can predict with {which}"
    bounded = {s: f for s, f in fit.items() if f > LEFT}
    left = ", ".join(MOTION_WORDS.get(s, s) for s in fit if s not in bounded)
    does = [f"it has a fit of {told_fits(bounded, 0)}"] if bounded else []
    does += [f"its run of {left} diverges"] if left else []
    told += f": on {on} {' and '.join(does)}"
    bounds = {s: b for s, b in bounds.items() if s in fit}
    if bounds:
        told += f"; sensor noise allows at most {told_fits(bounds, 0)}"
    return f"{told}."


@dataclass(frozen=True)
class Difference:
    """How much better one model fits the same logs than another.

    Parameters
    ----------
    model, against : str
    fit : Gain
        Of the mean over the states, from the second model to the first [%].
    states : mapping of str to Gain
    """

    model: str
    against: str
    fit: Gain
    states: Mapping[str, Gain]

    @property
    def certain(self) -> bool:
        """Whether it is better beyond chance."""
        return self.fit.ci[0] > 0

    @property
    def words(self) -> str:
        """The difference with its interval."""
        low, high = self.fit.ci
        return f"{self.fit.after - self.fit.before:.1f} (95 %: {low:.1f} to {high:.1f})"

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            "model": self.model,
            "against": self.against,
            "fit": self.fit.to_dict(),
            "states": {s: g.to_dict() for s, g in self.states.items()},
        }


@dataclass(frozen=True)
class ComparisonVerdict:
    """Which model is better beyond chance, and whether it predicts.

    Parameters
    ----------
    best : str
        The model of the highest mean fit on the judged logs.
    models : int
    judged, logs : int
        Logs that are judged, those that no model was estimated on where there are some, and
        all.
    fit : mapping of str to float
        Mean fit of the best model on the judged logs, by state [%].
    bounds, shares : mapping of str to float
        Fit that a perfect model would have there [%], and the share of sensor noise in the
        squared error, by state whose noise is known.
    still : tuple of str
        States that moved too little to matter: these do not decide.
    untested : bool
        Whether no state moved beyond its noise, so that nothing is known of the prediction.
    diverging : RunsDiverge or None
        Of the best model.
    differences : tuple of Difference
        Between the best model and each other one whose runs stay bounded, the next best first.
    in_sample : tuple of str
        The best model, and those that are no worse, if they were estimated on judged logs.
    """

    best: str
    models: int
    judged: int
    logs: int
    fit: Mapping[str, float]
    bounds: Mapping[str, float]
    shares: Mapping[str, float]
    still: tuple[str, ...]
    untested: bool
    diverging: RunsDiverge | None
    differences: tuple[Difference, ...]
    in_sample: tuple[str, ...]

    @property
    def rivals(self) -> tuple[str, ...]:
        """Models that are not worse than the best one beyond chance."""
        return tuple(d.against for d in self.differences if not d.certain)

    @property
    def weak(self) -> list[str]:
        """States that the best model does not predict."""
        return weak_channels(self.fit, self.bounds, self.still)

    @property
    def beyond_noise(self) -> list[str]:
        """States whose error is more than the noise of their sensor explains."""
        return beyond_noise(self.fit, self.bounds, self.still)

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        which = "it" if self.models > 1 else f"'{self.best}'"
        return " ".join(filter(None, [self._better(), self._use(which)]))

    def _use(self, which: str) -> str:
        if self.diverging is not None:
            return f"Do not predict with {which}: {self.diverging.sentence}."
        if self.in_sample:
            held = "these logs" if self.judged > 1 else "this log"
            who = " and ".join(f"'{name}'" for name in self.in_sample)
            were = "were" if len(self.in_sample) > 1 else "was"
            whose = f"the fit of '{self.best}'" if self.models > 1 else "its fit"
            return (
                f"{who} {were} estimated on {held}, so {whose} there ({told_fits(self.fit, 0)}) "
                f"says little of how it predicts others."
            )
        if self.untested:
            return f"{NothingMoved().sentence.capitalize()}."
        on = "this log" if self.logs == 1 else f"these {self.logs} logs"
        if self.judged < self.logs:
            on = f"{self.judged} of {on}, kept from every estimate,"
        return use_sentence(which, on, self.fit, self.bounds, self.still)

    def _better(self) -> str:
        """Return whether one of several models is better than the others, with an interval."""
        if self.models == 1:
            return ""
        if self.diverging is not None:
            return f"Of {self.models} models '{self.best}' fits best."
        others = f"the {self.models - 1} other models"
        better = "fits better" if self.in_sample else "predicts better"
        if not self.differences:
            other = others if self.models > 2 else "the other model"
            return f"'{self.best}' {better} than {other}, whose free runs diverge."
        first = self.differences[0]
        told = f"'{self.best}' {better} than "
        if self.rivals:
            told = f"'{self.best}' is not better beyond chance than "
            others = " or ".join(f"'{name}'" for name in self.rivals)
        elif self.models == 2:
            others = f"'{first.against}'"
        beside = f" than that of '{first.against}'" if self.models > 2 else ""
        return (
            f"{told}{others}: its mean fit is {first.fit.after:.1f} %, higher{beside} by "
            f"{first.words}."
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            "sentence": self.sentence,
            "best": self.best,
            "judged_logs": self.judged,
            "fit": dict(self.fit),
            "noise_fit": dict(self.bounds),
            "noise_share": dict(self.shares),
            "hardly_moved": list(self.still),
            "untested": self.untested,
            "diverging": self.diverging and self.diverging.to_dict(),
            "differences": [d.to_dict() for d in self.differences],
            "rivals": list(self.rivals),
            "in_sample": list(self.in_sample),
        }


def mean_fits(runs: Sequence[LogFit]) -> dict[str, float]:
    """Return the mean fit of each state over logs [%]."""
    return {s: float(np.mean([run.fit[s] for run in runs])) for s in runs[0].fit}


def judge_comparison(
    names: Sequence[str],
    runs: Sequence[Sequence[LogFit]],
    rmse: Sequence[Sequence[Mapping[str, float]]],
    noise: Sequence[Sequence[Mapping[str, NoiseBeside]]],
    own: Sequence[Sequence[bool]],
    effects: Sequence[Sequence[Array]],
) -> ComparisonVerdict:
    """Return which model is better on logs that none was estimated on, or on all if there are none.

    Parameters
    ----------
    names : sequence of str
        Of the models.
    runs, rmse, noise, own : sequence of sequence
        As `Comparison` has them, a row a model.
    effects : sequence of sequence of ndarray
        Likewise, as `stretch_effects` gives them.
    """
    kept = [k for k in range(len(runs[0])) if not any(mine[k] for mine in own)]
    judged = kept or list(range(len(runs[0])))
    fits = [mean_fits([row[k] for k in judged]) for row in runs]
    order = np.argsort([-mean_fit(fit) for fit in fits], kind="stable")
    best = int(order[0])
    leaving = [_leaving([row[k] for k in judged]) for row in runs]
    differences = [
        _difference(
            (names[i], names[best]), fits[i], fits[best],
            [effects[best][k] - effects[i][k] for k in judged],
        )
        for i in map(int, order[1:])
        if leaving[i] is None and leaving[best] is None
    ]  # fmt: skip
    told = [noise[best][k] for k in judged]
    noisy = [s for s in fits[best] if all(s in one for one in told)]
    samples = np.array([runs[best][k].samples for k in judged])

    def of_noise(s: str) -> float:
        error = samples @ [rmse[best][k][s] ** 2 for k in judged]
        return float(min(samples @ [one[s].std ** 2 for one in told] / max(error, 1e-300), 1.0))

    equals = [names[best], *(d.against for d in differences if not d.certain)]
    return ComparisonVerdict(
        names[best],
        len(names),
        len(judged),
        len(runs[0]),
        fits[best],
        {s: float(np.mean([one[s].fit for one in told])) for s in noisy},
        {s: of_noise(s) for s in noisy},
        tuple(s for s in noisy if not any(one[s].matters for one in told)),
        len(noisy) == len(fits[best]) and not any(one[s].moves for one in told for s in noisy),
        leaving[best],
        tuple(differences),
        tuple(n for n in equals if any(own[names.index(n)][k] for k in judged)),
    )


def _leaving(runs: Sequence[LogFit]) -> RunsDiverge | None:
    """Return how many of the runs of a model leave their bound."""
    left = [r for r in runs if r.diverged >= 0]
    after = min((r.diverged * r.log.sample_time for r in left), default=0.0)
    return RunsDiverge(tuple(r.log.name for r in left), len(runs), after) if left else None


def _difference(
    names: tuple[str, str],
    before: Mapping[str, float],
    after: Mapping[str, float],
    effects: Sequence[Array],
) -> Difference:
    """Return by how much the second model of two is better, by its means over the logs."""
    whole = gain_over_stretches(
        mean_fit(before), mean_fit(after), [one.mean(axis=0) for one in effects]
    )
    states = {
        s: gain_over_stretches(before[s], after[s], [one[i] for one in effects])
        for i, s in enumerate(before)
    }
    return Difference(names[1], names[0], whole, states)
