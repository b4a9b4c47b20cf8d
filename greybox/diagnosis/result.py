"""What a diagnosis returns."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.verdict import TestResult
from greybox.model.model import ManoeuvringModel
from greybox.notebook import DisplayMixin, interval, items, number, table, text, with_error
from greybox.trial.log import TrialLog
from greybox.trial.segments import of_one_log
from greybox.trial.validity import ConditionDifference
from greybox.validation.fit import LEFT, noise_fit
from greybox.validation.gain import Gain

Array = NDArray[np.float64]


class DiagnosisVerdict(StrEnum):
    """The verdict of a diagnosis; equal to the word in its JSON."""

    NAMED = "named"
    PARTLY = "partly"
    NONE = "none"
    CONFUSED = "confused"
    UNEXPLAINED = "unexplained"


_SAID = {
    DiagnosisVerdict.NAMED: "the cause is named",
    DiagnosisVerdict.PARTLY: "named causes explain a part of what is wrong",
    DiagnosisVerdict.NONE: "nothing is wrong beyond noise",
    DiagnosisVerdict.CONFUSED: "something is wrong, and several causes explain it equally well",
    DiagnosisVerdict.UNEXPLAINED: "something is wrong, and no known cause explains it",
}


# share of the squared error from which on a part is worth a line of text
_SHOWN = 0.005
# a 95 % interval of a share that is wider than the whole error tells nothing of it
_ANY = 1.0


def finite(value: float) -> float | None:
    """Return a number for JSON, None where there is none."""
    return float(value) if np.isfinite(value) else None


def file_word(cause: str) -> str:
    """Return the id of a cause as a part of a file's name."""
    return re.sub(r"[^\w.+-]+", "_", cause)


def _shown(p: float) -> str:
    """Return a p-value with its sign of relation; what underflows is no zero."""
    return f"= {p:.2g}" if p > 0 else "< 1e-300"


@dataclass(frozen=True)
class Quantity:
    """An estimate with its standard error."""

    value: float
    std: float
    unit: str

    def to_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {"value": self.value, "std": self.std, "unit": self.unit}


@dataclass(frozen=True)
class Found:
    """One cause with its evidence.

    Parameters
    ----------
    id : str
        Of the cause, with the place where the names of the parameters do not tell it.
    key : str
        Id with the place: which thruster, coefficient or channel.
    title : str
    parameters : mapping of str to Quantity
    p_value, p_adjusted : float
        Of no such effect; after correction for all causes that were tried.
    evidence, extension, reference : str
    gain : float
        Fall of −2 log L of the estimation logs; not a number where the log itself shows the cause.
    held_out, held_out_std : float
        Fall of −2 log L of logs it was not fitted to, and its standard error; infinite where
        their run leaves every bound without it, and minus that with it.
    """

    id: str
    key: str
    title: str
    parameters: Mapping[str, Quantity]
    p_value: float
    p_adjusted: float
    evidence: str
    extension: str
    reference: str
    gain: float = np.nan
    held_out: float = np.nan
    held_out_std: float = np.nan

    def to_dict(self) -> dict[str, Any]:
        """Return the cause for JSON."""
        return {
            "id": self.id,
            "parameters": {k: q.to_dict() for k, q in self.parameters.items()},
            "p_value": self.p_value,
            "p_adjusted": self.p_adjusted,
            "evidence": self.evidence,
            "extension": self.extension,
            "place": self.key,
            "likelihood_gain": finite(self.gain),
            "held_out_gain": {
                "value": finite(self.held_out),
                "std": finite(self.held_out_std),
                "sentence": self.proved,
            },
        }

    @property
    def proved(self) -> str:
        """What the cause does for logs that it was not fitted to, in words."""
        if np.isfinite(self.held_out):
            return f"held-out −2 log L falls by {self.held_out:.0f} ± {self.held_out_std:.0f}"
        if np.isnan(self.gain):
            return "the log itself shows it, without a free run"
        which = "without" if self.held_out > 0 else "with"
        return f"the held-out free run leaves every bound {which} it"


@dataclass(frozen=True)
class Remainder:
    """A smooth force without a name beside the causes: the black-box part of the model.

    Parameters
    ----------
    added : bool
        Whether it is in the extended model.
    terms : mapping of str to int
        Bumps in the equation of each state, as fitted; none where the logs ask for none.
    deviation : mapping of str to float
        Prior standard deviation of their coefficients, by marginal likelihood of the
        estimation logs [unit of the state, a sample].
    gain : mapping of str to Gain
        Held-out fit without and with it, by state; empty where nothing was fitted.
    validated_on : str
    reason : str
        Why it was added or not, one sentence.
    """

    added: bool
    terms: Mapping[str, int]
    deviation: Mapping[str, float]
    gain: Mapping[str, Gain]
    validated_on: str
    reason: str

    def to_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {
            "added": self.added,
            "terms": dict(self.terms),
            "deviation": dict(self.deviation),
            "gain": {k: g.to_dict() for k, g in self.gain.items()},
            "validated_on": self.validated_on,
            "reason": self.reason,
        }


@dataclass(frozen=True)
class BudgetPart:
    """A part of the squared held-out error.

    Parameters
    ----------
    part : str
        "sensor noise", the id of a cause, "motion and commands", "slow force", "waves", or
        "not split".
    share : mapping of str to float
        By state, of the squared error before the causes are mended.
    ci : mapping of str to (float, float)
        95 % intervals of the shares.
    after : mapping of str to float
        What is left of it once they are, of the same squared error.
    """

    part: str
    share: Mapping[str, float]
    ci: Mapping[str, tuple[float, ...]]
    after: Mapping[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Return the part for JSON."""
        return {
            "part": self.part,
            "share": dict(self.share),
            "ci": {k: list(v) for k, v in self.ci.items()},
            "after": dict(self.after),
        }


@dataclass(frozen=True)
class Ranked:
    """How a cause did at one step of the search, for pictures and tables.

    ``promise`` is the fall of −2 log L that its sensitivity predicts, ``gain`` that of
    its refit and ``held_out`` that on held-out logs; None where it was not refitted.
    """

    key: str
    promise: float
    gain: float | None = None
    held_out: float | None = None
    held_out_std: float | None = None


@dataclass(frozen=True)
class Symptom:
    """One thing that the simulation gets wrong.

    Parameters
    ----------
    sentence : str
    channel : str
    size : float
        Root mean square of the error it speaks of, in noise deviations.
    """

    sentence: str
    channel: str
    size: float


@dataclass(frozen=True)
class Runs:
    """Free runs on one log for pictures: measured, before, and after.

    Parameters
    ----------
    log : TrialLog
    held_out : bool
    measured, before, after : mapping of str to ndarray
        (N,) by state.
    """

    log: TrialLog
    held_out: bool
    measured: Mapping[str, Array]
    before: Mapping[str, Array]
    after: Mapping[str, Array]


@dataclass(frozen=True, repr=False)
class Diagnosis(DisplayMixin):
    """What the simulation gets wrong, why, and what it gains to mend it.

    Parameters
    ----------
    verdict : DiagnosisVerdict
    causes : tuple of Found
        Those that stand, in the order found.
    groups : tuple of tuple of str
        Causes that explain the logs equally well.
    gain : mapping of str to Gain
        By state, on the validation logs, or on parts held out in turn.
    wrong : tuple of Symptom
        Largest first.
    partial : tuple of Found
        Causes that help, and do no more than a generic force would.
    candidates : tuple of Found
        Members of the groups, each as it would be by itself.
    base, model : ManoeuvringModel
        Before, and extended by what was found; the same where nothing was.
    alternatives : mapping of str to ManoeuvringModel
        A model for each member of the groups, for a trial that tells them apart.
    remaining : str
        What is left after all causes, one sentence.
    validated_on : str
        Where the gain was measured, one sentence.
    next_steps : tuple of str
        What to measure or do next.
    steps : tuple of tuple of Ranked
        The search.
    runs : tuple of Runs
    notes : tuple of str
    tried : int
        Causes that were scored.
    record : mapping
        What the model file tells beside.
    residuals : mapping of str to tuple of TestResult
        Tests of the free run's errors ``before`` and ``after``.
    conditions : tuple of ConditionDifference
        In what the logs differ from each other, and from those of the model.
    budget : tuple of BudgetPart
        Whose the squared held-out error is; empty where a run leaves every bound.
    remainder : Remainder, optional
        A smooth force without a name, where it was asked for. `gain`, `runs` and `budget`
        are without it.
    gain_over_chosen : mapping of str to Gain
        By state, against the terms that the data chose; empty where none were.
    """

    verdict: DiagnosisVerdict
    causes: tuple[Found, ...]
    groups: tuple[tuple[str, ...], ...]
    gain: Mapping[str, Gain]
    wrong: tuple[Symptom, ...]
    partial: tuple[Found, ...]
    candidates: tuple[Found, ...]
    base: ManoeuvringModel
    model: ManoeuvringModel
    alternatives: Mapping[str, ManoeuvringModel]
    remaining: str
    validated_on: str
    next_steps: tuple[str, ...]
    steps: tuple[tuple[Ranked, ...], ...] = ()
    runs: tuple[Runs, ...] = ()
    notes: tuple[str, ...] = ()
    tried: int = 0
    record: Mapping[str, Any] = field(default_factory=dict)
    residuals: Mapping[str, tuple[TestResult, ...]] = field(default_factory=dict)
    conditions: tuple[ConditionDifference, ...] = ()
    budget: tuple[BudgetPart, ...] = ()
    remainder: Remainder | None = None
    gain_over_chosen: Mapping[str, Gain] = field(default_factory=dict)

    @property
    def headline(self) -> str:
        """The verdict in one sentence."""
        told = "; ".join(f"{c.title}: {c.evidence}" for c in self.causes) + "."
        for group in self.groups:
            told += f" Beside that these logs cannot tell {' from '.join(group)}."
        if self.verdict == DiagnosisVerdict.NAMED:
            return told
        if self.verdict == DiagnosisVerdict.PARTLY:
            return f"{told} {self.remaining}"
        if self.verdict == DiagnosisVerdict.CONFUSED:
            return (
                f"Something is wrong, and these logs cannot tell which cause it is: "
                f"{'; '.join(' or '.join(group) for group in self.groups)}."
            )
        if self.verdict == DiagnosisVerdict.NONE and self.wrong:
            return (
                "Nothing is wrong that repeats: the errors of the free run do not recur in the "
                "held-out logs."
            )
        said = f"{_SAID[self.verdict][0].upper()}{_SAID[self.verdict][1:]}."
        return f"{said} {self.remaining}" if self.verdict == DiagnosisVerdict.UNEXPLAINED else said

    @property
    def extended(self) -> bool:
        """Whether the model was extended: by causes, by one of those that cannot be told apart."""
        return bool(self.causes or self.groups) or self.model.structure != self.base.structure

    @property
    def held_out_fit(self) -> dict[str, float]:
        """Fit of the model's free run on what is held out [%], of the extended one if it was."""
        return {s: g.after if self.extended else g.before for s, g in self.gain.items()}

    def noise_bounds(self) -> dict[str, float]:
        """Return the fit (6.12) [%] of a perfect model on the held-out logs, by state.

        Empty where the noise is not known, or nothing was held out.
        """
        noise, held = self.model.noise, [run for run in self.runs if run.held_out]
        if noise is None or not held:
            return {}
        # as the fit is: of each log about its own mean
        logs = [[held[k] for k in places] for places in of_one_log([run.log for run in held])]
        return {
            state: float(
                np.mean(
                    [
                        noise_fit(np.concatenate([run.measured[state] for run in log]), float(std))
                        for log in logs
                    ]
                )
            )
            for state, std in zip(noise.states, noise.measurement, strict=True)
            if state in held[0].measured
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the diagnosis as the documented JSON, and further entries."""
        return {
            "verdict": str(self.verdict),
            "causes": [c.to_dict() for c in self.causes],
            "groups": [list(g) for g in self.groups],
            "gain": {k: g.to_dict() for k, g in self.gain.items()},
            "gain_over_chosen": {k: g.to_dict() for k, g in self.gain_over_chosen.items()},
            "wrong": [s.sentence for s in self.wrong],
            "budget": [part.to_dict() for part in self.budget],
            "headline": self.headline,
            "residuals": {
                when: {t.name: t.to_dict() for t in tests} for when, tests in self.residuals.items()
            },
            "partial": [c.to_dict() for c in self.partial],
            "candidates": [c.to_dict() for c in self.candidates],
            "remaining": self.remaining,
            "validated_on": self.validated_on,
            "next": list(self.next_steps),
            "tried": self.tried,
            "notes": list(self.notes),
            "condition_differences": [d.to_dict() for d in self.conditions],
        } | ({} if self.remainder is None else {"remainder": self.remainder.to_dict()})

    def summary(self) -> str:
        """Return the diagnosis as text."""
        where = "What the simulation gets wrong (estimation logs):"
        lines = [f"verdict: {self.verdict}", self.headline, "", where]
        if not self.wrong:
            good = self.verdict == DiagnosisVerdict.NONE
            lines.append(f"  nothing beyond noise{'' if good else ' in these logs by themselves'}")
        lines += [f"  {s.sentence}" for s in self.wrong]
        lines += [f"  {t.sentence}" for t in self.residuals.get("before", ()) if not t.passed]
        for title, causes in (
            ("Causes (± one standard error)", self.causes),
            ("No better than a generic force", self.partial),
            ("Each would explain it", self.candidates),
        ):  # fmt: skip
            if causes:
                lines += ["", f"{title}:"]
            for c in causes:
                # the verdict tells the evidence of those that stand
                said = c.title if c.evidence in self.headline else c.evidence
                lines.append(f"  {c.id}: {said}")
                lines += [
                    f"    {name:<22}{with_error(q.value, q.std):>24} {q.unit}".removesuffix(" 1")
                    for name, q in c.parameters.items()
                    if q.std > 0
                ]
                lines.append(
                    f"    adjusted p {_shown(c.p_adjusted)} ({self.tried} causes tried); {c.proved}"
                )
        if self.gain:
            lines += ["", *_gain_lines(self.gain, self.validated_on)]
        if self.gain_over_chosen:
            told = (
                f"{s} {g.before:.1f} -> {g.after:.1f} ({g.ci[0]:.1f} to {g.ci[1]:.1f})"
                for s, g in self.gain_over_chosen.items()
            )
            lines.append(f"Against the terms that the data chose: {', '.join(told)}.")
        lines += _budget_lines(self.budget)
        if self.remaining not in self.headline:
            lines += ["", self.remaining]
        if self.remainder is not None:
            lines.append(self.remainder.reason)
            if self.remainder.gain:
                lines += _gain_lines(self.remainder.gain, self.remainder.validated_on)
        lines += [f"next: {n}" for n in self.next_steps]
        lines += [f"note: {n}" for n in self.notes]
        return "\n".join(lines)

    def _line(self) -> str:
        return f"{self.verdict}: {self.headline}"

    def _parts(self) -> tuple[str, ...]:
        listed = [
            (c.id, name, number(q.value), interval(q.value, q.std), q.unit, number(c.p_adjusted, 2))
            for c in (*self.causes, *self.partial, *self.candidates)
            for name, q in c.parameters.items()
        ]
        head = ("cause", "parameter", "value", "95 %", "unit", "adjusted p")
        return (
            table(head, listed),
            _gain_table(self.gain, self.validated_on),
            items("What the simulation gets wrong", [s.sentence for s in self.wrong]),
            text(self.remaining),
            text("" if self.remainder is None else self.remainder.reason),
            items("Next", self.next_steps),
        )


@dataclass(frozen=True, repr=False)
class Given(DisplayMixin):
    """A model with causes that are known to act, and what they gain.

    Parameters
    ----------
    ids : tuple of str
    before, after : ManoeuvringModel
        Without and with them, estimated on the same logs.
    fall : float
        Share by which they lower the free runs' squared errors of the states, each in
        its sensor's variance, on the logs of the estimate.
    gain : dict of str to Gain
        On what is held out.
    validated_on : str
        What that is.
    """

    ids: tuple[str, ...]
    before: ManoeuvringModel
    after: ManoeuvringModel
    fall: float
    gain: dict[str, Gain]
    validated_on: str

    def summary(self) -> str:
        """Return the fall and the gain as text."""
        return "\n".join([self._line(), "", *_gain_lines(self.gain, self.validated_on)])

    def _line(self) -> str:
        return (
            f"with {', '.join(self.ids)} the squared free-run errors fall by "
            f"{100 * self.fall:.1f} %"
        )

    def _parts(self) -> tuple[str, ...]:
        return (_gain_table(self.gain, self.validated_on),)


def _budget_lines(budget: Sequence[BudgetPart]) -> list[str]:
    if not budget:
        return []
    states = list(budget[0].share)
    shown = [p for p in budget if any(abs(v) >= _SHOWN for v in (*p.share.values(),))]
    cells = [["", *states], *([p.part, *(told_share(p, s) for s in states)] for p in shown)]
    first, *wide = (max(map(len, column)) + 2 for column in zip(*cells, strict=True))
    lines = [
        f"  {part:<{first}}" + "".join(f"{v:>{w}}" for v, w in zip(row, wide, strict=True))
        for part, *row in cells
    ]
    return [
        "",
        "Sources of the squared held-out error [%], before the model is extended (95 %):",
        *lines,
        *([f"  {told}"] if (told := hardly_split(budget)) else []),
    ]


def hardly_split(budget: Sequence[BudgetPart]) -> str:
    """Return a sentence on states of whose error more cannot be split than there is."""
    rest = budget[-1].share
    beyond = [s for s, share in rest.items() if abs(share) > 1]
    if not beyond:
        return ""
    return (
        f"Of {', '.join(beyond)} the parts do not add up to the error: causes act against each "
        f"other there, or its error is small, so their shares say little."
    )


def is_split(part: BudgetPart, state: str) -> bool:
    """Whether the logs tell the share of a part in a state's error from any other."""
    low, high = part.ci[state]
    return high - low <= _ANY


def told_share(part: BudgetPart, state: str) -> str:
    """Return a share with its interval in percent, or that the logs do not tell it."""
    if not is_split(part, state):
        return "not determined"
    low, high = part.ci[state]
    return f"{100 * part.share[state]:.1f} ({100 * low:.1f} to {100 * high:.1f})"


def _gain_lines(gain: Mapping[str, Gain], where: str) -> list[str]:
    return [
        f"Fit of the free run (6.12) [%], {where}:",
        *(
            f"  {state:<3}{_fit(g.before):>8} -> {_fit(g.after)}{_gained(g, '   (gain {})')}"
            for state, g in gain.items()
        ),
    ]


def _fit(value: float) -> str:
    return f"{value:.1f}" if value > LEFT else "diverged"


def _gained(gain: Gain, said: str = "{}") -> str:
    """Return the interval of a gain; nothing where the run before has left the measurements."""
    low, high = gain.ci
    return said.format(f"{low:.1f} to {high:.1f}") if gain.before > LEFT else ""


def _gain_table(gain: Mapping[str, Gain], where: str) -> str:
    rows = [(s, _fit(g.before), _fit(g.after), _gained(g)) for s, g in gain.items()]
    head = ("free run", "fit before [%]", "after", "gain, 95 %")
    return table(head, rows, f"Fit (6.12), {where}")
