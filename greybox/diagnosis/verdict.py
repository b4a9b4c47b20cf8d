"""The ruling on what a search found, and on what it left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from greybox.diagnosis.held_out import HeldOut, Pair
from greybox.diagnosis.omnibus import Omnibus, disagreement, omnibus
from greybox.diagnosis.point import Fit
from greybox.diagnosis.result import DiagnosisVerdict, Found
from greybox.diagnosis.search import RELEVANT, Candidate, Search
from greybox.diagnosis.symptoms import coloured
from greybox.model.run.step import Integrator

# significance of what any force could still explain
_SURE = 0.005
# share of what the causes explain that may be left over, for the model's own simplicity
_LEFT = 0.1
# significance of other coefficients on the held-out logs, and the share of the causes' gain
# that fitting them there may bring beside
_APART, _BESIDE = 1e-4, 0.25
# mean squared error, in the sensors' variances, that is worth a word, and the share of what
# was there that causes may leave
_LARGE, _MOST_OF = 0.3, 0.35
# seconds for which gusts are remembered at most, and the fall of −2 log L of all logs, and of
# each, by a longer memory from which on what moves the ship is no gust
_GUST, _LONGER, _EACH = 30.0, 18.0, 4.0


@dataclass(frozen=True)
class Ruling:
    """The verdict with what is left and what to do next.

    Parameters
    ----------
    verdict : DiagnosisVerdict
    remaining : str
    next_steps : list of str
    before, omnibus : Omnibus
        Of the model without causes, and of what was found.
    """

    verdict: DiagnosisVerdict
    remaining: str
    next_steps: list[str]
    before: Omnibus
    omnibus: Omnibus


def rule(
    found: Search,
    held_out: Callable[[Integrator], HeldOut],
    groups: Sequence[Sequence[Candidate]],
    known: Sequence[Found],
) -> Ruling:
    """Decide what may be said.

    Parameters
    ----------
    found : Search
    held_out : callable
        Of an integrator.
    groups : sequence of sequence of Candidate
        Causes that do equally well.
    known : sequence of Found
        Causes that the log proves without forces.
    """
    held = held_out(found.final.integrator)
    pairs = held.pairs(found.final)
    first = omnibus(held_out(found.base.integrator).pairs(found.base))
    left = omnibus(pairs)
    other = disagreement(pairs)
    numbers = sum(nu.size for pair in pairs for nu in pair.held_fit.nu)
    explained = max(found.proof(held_out), 0.0) if found.causes else 0.0
    allowed = max(RELEVANT * numbers, _LEFT * explained)
    wrong = left.proof.p_value < _SURE and left.gain > allowed
    apart = other.p_value < _APART and other.fall > RELEVANT * numbers + _BESIDE * explained
    before, after = _excess(found.base, found.final), _excess(found.final, found.final)
    # a cause that leaves much of the error where it was is not what is wrong, or not alone
    much = bool(found.causes) and after > _LARGE and after > _MOST_OF * before
    drifts = not found.causes and before > _LARGE and _drifts(pairs)
    if wrong or apart or much or drifts:
        verdict = DiagnosisVerdict.UNEXPLAINED
    elif groups and not known and len(groups) == len(found.causes):
        verdict = DiagnosisVerdict.CONFUSED
    elif found.causes or known:
        verdict = DiagnosisVerdict.NAMED
    else:
        verdict = DiagnosisVerdict.NONE
    why = ""
    if wrong:
        why = (
            f"forces that no cause stands for would explain another "
            f"{100 * left.explicable:.1f} % of the squared errors of logs that they were not "
            f"fitted to (p = {left.proof.p_value:.1g})"
        )
    elif apart:
        why = "the coefficients that these logs ask for do not hold for the held-out ones"
    elif much:
        why = f"the causes leave {100 * after / before:.0f} % of the squared error"
    elif drifts:
        why = (
            f"a force moves the ship in all logs that is remembered for longer than gusts "
            f"({_GUST:g} s): a current that changes, or something that no cause stands for"
        )
    outputs = pairs[0].problem.runs[0].outputs
    return Ruling(
        verdict, _remaining(found.final, outputs, why), _next(verdict, groups), first, left
    )


def _drifts(pairs: Sequence[Pair]) -> bool:
    """Whether what moves a channel beside the model is slower than gusts, in every log."""
    every = [one for p in pairs for one in ((p.problem, p.fit), (p.held, p.held_fit))]
    falls = []
    for problem, fit in every:
        if fit.escaped:
            return False
        longest = _GUST / problem.sample_time
        short, free = (problem.forgetful(fit, memory) for memory in (longest, np.inf))
        falls.append(problem.costs(short) - problem.costs(free))
    of_channels = np.array(falls)
    slow = (of_channels.min(axis=0) > _EACH) & (of_channels.sum(axis=0) > _LONGER * len(pairs))
    return bool(slow.any())


def _excess(fit: Fit, final: Fit) -> float:
    """Return the mean squared error of the states in the sensors' variances, less their own."""
    sensor, places = [], []
    for group in final.noise.groups:
        sensor.append(group.sensor[0])
        places.append(group.outputs[0])
    errors = np.concatenate(fit.errors)[:, places]
    return float(((errors / np.maximum(sensor, 1e-300)) ** 2).mean()) - 1.0


def _remaining(final: Fit, outputs: Sequence[str], why: str) -> str:
    moved = coloured(final, outputs)
    tail = f" In these logs {moved}." if moved else ""
    if why:
        return f"What is left is not noise: {why}.{tail}"
    return f"What is left is not told from noise.{tail}"


def _next(verdict: DiagnosisVerdict, groups: Sequence[Sequence[Candidate]]) -> list[str]:
    out = [
        f"design a trial that tells {' from '.join(c.atom.cause for c in pair)}: greybox design "
        f"--between {' '.join(f'MODEL.{c.atom.cause}.json' for c in pair[:2])}"
        for pair in groups
    ]
    if verdict is DiagnosisVerdict.UNEXPLAINED:
        out.append(
            "measure what the model does not know (wind, depth, draught, propeller and rudder as "
            "they really moved), repeat a run of these logs, and diagnose both together"
        )
    elif verdict is DiagnosisVerdict.NAMED:
        out.append(
            "design the next trial with the extended model, so that its least certain "
            "coefficients move: greybox design --model MODEL"
        )
    elif verdict is DiagnosisVerdict.NONE:
        out.append("the model may be used as it is; a trial in other conditions would tell more")
    return out
