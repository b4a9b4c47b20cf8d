"""The verdict on a search: what it found, and what remains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.evidence.held_out import HeldOut, Pair, proof_of, worse
from greybox.diagnosis.evidence.omnibus import Omnibus, disagreement, omnibus
from greybox.diagnosis.point import Fit
from greybox.diagnosis.result import DiagnosisVerdict, Found, file_word
from greybox.diagnosis.search import Candidate, Search, left_to_motion
from greybox.diagnosis.ship import LogRun
from greybox.diagnosis.symptoms import moved_beside, word
from greybox.diagnosis.thresholds import (
    APART,
    BESIDE,
    EACH,
    GUST,
    LARGE,
    LEFT_OVER,
    LONGER,
    MOST_OF,
    NEAR,
    RELEVANT,
    SENSORS,
    SIGNIFICANT,
    SURE,
    WORTH,
)
from greybox.diagnosis.waves import Waves, noise_in, squares_in
from greybox.model.run.step import Integrator
from greybox.validation.gain import Gain

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Ruling:
    """The verdict with what is left and what to do next.

    Parameters
    ----------
    verdict : DiagnosisVerdict
    named : tuple of Candidate
        Causes that stand and have no rival, in the order found.
    leaning : tuple of Candidate
        Causes that help and do not stand.
    remaining : str
    next_steps : list of str
    before, omnibus : Omnibus
        Of the model without causes, and of what was found.
    final : Fit
        Of the extended model; that without causes where nothing is extended.
    notes : tuple of str
    """

    verdict: DiagnosisVerdict
    named: tuple[Candidate, ...]
    leaning: tuple[Candidate, ...]
    remaining: str
    next_steps: list[str]
    before: Omnibus
    omnibus: Omnibus
    final: Fit
    notes: tuple[str, ...] = ()


def rule(
    found: Search,
    held_out: Callable[[Integrator], HeldOut],
    groups: Sequence[Sequence[Candidate]],
    known: Sequence[Found],
    gain: Mapping[str, Gain],
    waves: Waves | None = None,
    seconds: float = 900.0,
) -> Ruling:
    """Decide the verdict.

    Parameters
    ----------
    found : Search
    held_out : callable
        Of an integrator.
    groups : sequence of sequence of Candidate
        Causes that do equally well.
    known : sequence of Found
        Causes that the log proves without forces.
    gain : mapping of str to Gain
        Fit of the held-out free run without causes and with them.
    waves : Waves, optional
        That the logs were sailed in: what they move is nothing that the model should do.
    seconds : float
        How long a trial to plan next may last [s].
    """
    final, stand, leaning, notes = found.final, found.causes, found.leaning, []
    # a run that is worse than a constant predicts nothing, however much worse it is
    better = sum(max(g.after, 0.0) - max(g.before, 0.0) for g in gain.values())
    if final is not found.base and better < 0:
        # likelier errors are no better simulation: nothing is extended by them
        helped = ", ".join(c.hypothesis.id for c in stand) or "terms that the data chose"
        notes.append(
            f"{helped} made the held-out errors likelier but the free run no better, so the "
            f"model was not extended."
        )
        final, stand, leaning, groups = found.base, (), (*stand, *leaning), ()
    pairs = held_out(final.integrator).pairs(final)
    diagnosed = held_out(found.before.integrator).pairs(found.before)
    # of one and the same fit it is computed once
    first = omnibus(diagnosed)
    left = omnibus(pairs) if diagnosed is not pairs else first
    explained = _explained(found, held_out) if stand else 0.0
    why = _wrong(found.base, final, pairs, left, explained, bool(stand), waves)
    anew = ""
    if found.given is not None and not why:
        anew = _other_coefficients(diagnosed, held_out(found.base.integrator).pairs(found.base))
        why = anew
    if not (why or stand or known) and final is not found.base:
        taken = 1 - np.exp(worse(held_out, final, found.base))
        why = (
            f"terms of motion and commands that belong to no known cause lower the squared error "
            f"of the "
            f"held-out runs by {100 * taken:.0f} %"
        )
    named = tuple(c for c in stand if not _grouped(c, groups))
    # one that makes held-out runs worse does not help, and one that may be chance is none
    leaning = tuple(c for c in leaning if c.p_adjusted < SIGNIFICANT and c.proof.gain > 0)
    if named or known:
        verdict = DiagnosisVerdict.PARTLY if why else DiagnosisVerdict.NAMED
    elif groups:
        verdict = DiagnosisVerdict.CONFUSED
    else:
        verdict = DiagnosisVerdict.UNEXPLAINED if why else DiagnosisVerdict.NONE
    # of the squared error that the diagnosed model had
    kept = float(np.exp(worse(held_out, final, found.before))) if stand else 1.0
    return Ruling(
        verdict, named, leaning, _remaining(final, pairs, left, why, kept, waves),
        _next(verdict, groups, bool(anew), seconds), first, left, final, tuple(notes),
    )  # fmt: skip


def leaves_more(found: Search, held_out: Callable[[Integrator], HeldOut]) -> bool:
    """Whether what was found leaves more than noise, or than a model of other terms would.

    Where causes explain much, what is small beside them may still be large for a model.
    """
    if left_to_motion(held_out, found.final):
        return True
    pairs = held_out(found.final.integrator).pairs(found.final)
    explained = _explained(found, held_out) if found.causes else 0.0
    left = omnibus(pairs)
    return bool(_wrong(found.base, found.final, pairs, left, explained, bool(found.causes), None))


def _explained(found: Search, held_out: Callable[[Integrator], HeldOut]) -> float:
    """Return the fall of −2 log L by the causes, of held-out logs where their runs are bounded."""
    gain = found.proof(held_out)
    fall = gain if np.isfinite(gain) else found.base.cost - found.final.cost
    return max(fall, 0.0) if np.isfinite(fall) else 0.0


def _wrong(
    base: Fit, final: Fit, pairs: Sequence[Pair], left: Omnibus, explained: float, found: bool,
    waves: Waves | None,
) -> str:  # fmt: skip
    """Return what is wrong with what a model leaves; nothing where nothing is."""
    numbers = sum(int(pair.held.counts.sum()) for pair in pairs)
    if left.proof.p_value < SURE and left.gain > max(WORTH * numbers, LEFT_OVER * explained):
        return (
            f"forces that belong to no known cause would explain another "
            f"{100 * left.explicable:.1f} % of the squared errors of logs that they were not "
            f"fitted to (p = {left.proof.p_value:.1g})"
        )
    other = disagreement(pairs)
    if other.p_value < APART and other.fall > RELEVANT * numbers + BESIDE * explained:
        return "the coefficients that fit these logs do not fit the held-out ones"
    before, after = _excess(base, final, pairs, waves), _excess(final, final, pairs, waves)
    # a cause that leaves much of the error where it was is not what is wrong, or not alone
    if found and after > LARGE and after > MOST_OF * before:
        return f"the causes leave {100 * after / before:.0f} % of the squared error"
    if not found and before > LARGE and _drifts(pairs):
        return (
            f"in all logs a force moves the ship that lasts longer than gusts "
            f"({GUST:g} s): a current that changes, or an effect that belongs to no known cause"
        )
    return _no_prediction(pairs, waves)


def _other_coefficients(given: Sequence[Pair], anew: Sequence[Pair]) -> str:
    """Return how far the coefficients of a given model are from those that the logs ask for."""
    if any(p.held_fit.escaped for p in given):
        return "the model as it was given leaves every bound on these logs"
    if any(p.held_fit.escaped for p in anew):
        return ""
    one, two = (
        np.concatenate([c for p in pairs for c in p.held.contributions(p.held_fit)])
        for pairs in (given, anew)
    )
    count = len(given[0].held.structure.states)
    squares = [
        sum(p.held.squares(p.held_fit.errors)[:count] for p in pairs) for pairs in (given, anew)
    ]
    fall = 1 - float(np.min(squares[1] / np.maximum(squares[0], 1e-300)))
    proof = proof_of(one - two)
    if proof.p_value > APART or fall < WORTH:
        return ""
    return (
        f"estimating the coefficients of the model again lowers the squared error of the held-out "
        f"logs by {100 * fall:.0f} %: the given ones do not hold here"
    )


def _no_prediction(pairs: Sequence[Pair], waves: Waves | None) -> str:
    """Return how far held-out free runs are from what sensors show; nothing where they are near."""
    if any(p.held_fit.escaped for p in pairs):
        return "the held-out free run leaves every bound"
    missed, constant = _missed(pairs, waves), _against_constant(pairs)
    far = {s: m for s, m in missed.items() if m > SENSORS}
    if far:
        told = ", ".join(f"{word(s)} by {m:.0f}" for s, m in far.items())
        return (
            f"the held-out free run misses {told} times what its sensor's noise explains; up to "
            f"{SENSORS:g} times may be gusts"
        )
    poor = [s for s, m in missed.items() if m > NEAR and constant[s] > 1]
    if poor:
        return (
            f"the held-out free run of {' and '.join(map(word, poor))} is worse than a constant, "
            f"and that is not only noise"
        )
    return ""


def _against_constant(pairs: Sequence[Pair]) -> dict[str, float]:
    """Return the squared held-out error of each state in the variance of its motion."""
    names = pairs[0].problem.structure.states
    errors, moved = (
        np.sum([p.held.squares(of) for p, of in zip(pairs, every, strict=True)], axis=0)
        for every in (
            [p.held_fit.errors for p in pairs],
            [[_about_mean(run) for run in p.held.runs] for p in pairs],
        )
    )
    return {s: float(errors[i] / max(moved[i], 1e-300)) for i, s in enumerate(names)}


def _about_mean(run: LogRun) -> Array:
    """Return what was measured less its mean, (N, ny)."""
    counts = np.maximum(run.known.sum(axis=0), 1)
    return np.asarray(run.y - run.y.sum(axis=0, where=run.known) / counts)


def _missed(pairs: Sequence[Pair], waves: Waves | None) -> dict[str, float]:
    """Return the root mean square held-out error of each state in its sensor's deviations."""
    names = pairs[0].problem.runs[0].outputs
    shown = [p.held_fit for p in pairs]
    squares, counts = np.sum(
        [squares_in(waves, fit, names, noise_in(waves, fit)) for fit in shown], axis=0
    )
    missed = np.sqrt(squares / np.maximum(counts, 1))
    groups = pairs[0].held_fit.noise.groups
    return {names[g.outputs[0]]: float(m) for g, m in zip(groups, missed, strict=True)}


def _grouped(candidate: Candidate, groups: Sequence[Sequence[Candidate]]) -> bool:
    return any(c.hypothesis.key == candidate.hypothesis.key for pair in groups for c in pair)


def _drifts(pairs: Sequence[Pair]) -> bool:
    """Whether what moves a channel beside the model is slower than gusts, in every log."""
    every = [one for p in pairs for one in ((p.problem, p.fit), (p.held, p.held_fit))]
    falls = []
    for problem, fit in every:
        if fit.escaped:
            return False
        longest = GUST / problem.sample_time
        short, free = (problem.forgetful(fit, memory) for memory in (longest, np.inf))
        falls.append(problem.costs(short) - problem.costs(free))
    of_channels = np.array(falls)
    slow = (of_channels.min(axis=0) > EACH) & (of_channels.sum(axis=0) > LONGER * len(pairs))
    return bool(slow.any())


def _excess(fit: Fit, final: Fit, pairs: Sequence[Pair], waves: Waves | None) -> float:
    """Return the mean squared error of the states in the sensors' variances, less their own."""
    names = pairs[0].problem.runs[0].outputs
    squares, counts = squares_in(waves, fit, names, noise_in(waves, final))
    return float(squares.sum() / counts.sum()) - 1.0


def _remaining(final: Fit, pairs: Sequence[Pair], left: Omnibus, why: str, kept: float,
               waves: Waves | None) -> str:  # fmt: skip
    problem = pairs[0].problem
    # of the logs that it was fitted to, or of the first part of them
    fit = final if pairs[0].fit.escaped else problem.forgetful(pairs[0].fit, np.inf)
    # of a line no colour tells
    moved = "" if waves else moved_beside(fit, problem.runs[0].outputs)
    mover = "In these logs something that the model lacks moves"
    if not why:
        mover = "Gusts, or forces as short-lived, move"
    tail = f" {mover} {moved}." if moved else ""
    if why:
        return f"What is left is not only noise: {why}.{tail}"
    missed = {s: m for s, m in _missed(pairs, waves).items() if m > NEAR}
    if missed:
        told = ", ".join(f"{word(s)} by {m:.0f}" for s, m in missed.items())
        tail = (
            f" The held-out free run still misses {told} times what its sensor's noise explains, "
            f"as gusts do.{tail}"
        )
    if left.proof.p_value < SURE and left.explicable > 0:
        share = f"{100 * left.explicable:.1f} % of the squared errors"
        if 0 < kept < 1:
            share += f" that are left, {100 * left.explicable * kept:.2g} % of those before"
        return (
            f"Forces that belong to no known cause would explain another {share} "
            f"(p = {left.proof.p_value:.1g}): too little to change the verdict.{tail}"
        )
    return f"What is left cannot be told from {'gusts' if missed or moved else 'noise'}.{tail}"


def _next(
    verdict: DiagnosisVerdict,
    groups: Sequence[Sequence[Candidate]],
    anew: bool,
    seconds: float = 900.0,
) -> list[str]:
    out = []
    for ids in ([c.hypothesis.id for c in pair] for pair in groups):
        told = "--model MODEL --for causes"
        if len(ids) == 2:
            told = f"--between {' '.join(f'MODEL.{file_word(i)}.json' for i in ids)}"
        out.append(
            f"design a trial that tells {' from '.join(ids)}: greybox design --vessel V {told} "
            f"--duration {seconds:g} --out plan.csv"
        )
    if anew:
        out.append(
            "estimate the model's coefficients from these logs: greybox estimate LOGS --vessel V "
            "--out estimated.json"
        )
    elif verdict in (DiagnosisVerdict.UNEXPLAINED, DiagnosisVerdict.PARTLY):
        if verdict is DiagnosisVerdict.UNEXPLAINED:
            out.append(
                "see whether sensors and the vessel file are right: greybox check LOGS --vessel V "
                "--report check.html"
            )
        out.append(
            "measure what the model does not know (wind, depth, draught, propeller and rudder as "
            "they really moved), repeat a run of these logs, and diagnose both together"
        )
    if verdict in (DiagnosisVerdict.NAMED, DiagnosisVerdict.PARTLY):
        out.append(
            "design the next trial with the extended model, so that its least certain "
            f"coefficients move: greybox design --vessel V --model MODEL --duration {seconds:g} "
            f"--out plan.csv"
        )
    if verdict is DiagnosisVerdict.NONE:
        out.append("nothing has to be mended; a trial in other conditions would tell more")
    return out
