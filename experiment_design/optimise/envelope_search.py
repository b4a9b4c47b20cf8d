"""Search for sequences that leave the least error of predictions over the operating envelope.

Levels are exchanged with those of a candidate set (Fedorov, 1972; Meyer and Nachtsheim, 1995):
settings that hold the ship in her envelope, so that no plan goes where its prior model was
never near. Several chains start from the best of random sequences of these settings.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limits import TOLERANCE, UNIT_SCALE
from experiment_design.excitation.rollout import Motion
from experiment_design.information.envelope import HOLDS, Envelope
from experiment_design.optimise.search import Candidate, limit_scale, to_unit
from experiment_design.request.problem import TrialProblem
from greybox.numerics.parallel import map_forked

_log = logging.getLogger(__name__)
Array = NDArray[np.float64]

# random sequences that a search begins with, and that a plan is compared with
RANDOM = 200
# share of a trial, at its beginning, that is a usual manoeuvre, by which an estimate of the rest is
# judged; at least two legs of a zig-zag, and at most this much. An estimate chooses by its runs on
# the last part of a log, which must be like all that it is wanted for
_VALIDATION, _LONGEST_VALIDATION = 0.15, 1 / 3
# parts of a trial: an estimate chooses its terms by leaving out each of as many in turn, and what
# is left must tell what the part that is left out shows
PARTS = 4
_CHAINS, _KEPT, _TOGETHER, _ROUNDS = 4, 12, 64, 14
# of the largest steady yaw rate: how hard the zig-zag turns, and how hard those that a trial may
# begin with; time scales of each leg
_TURN, _TURNS, _LEG = 0.6, (0.3, 0.6, 0.9), 3.0
# share of the trial that either sign of sway and of yaw rate takes at least, where the envelope
# has both
_EITHER = 0.35
# share of moves that draw a stretch anew; the others swap two; share of sequences that begin anew
_ANEW, _BEGINS_ANEW = 0.7, 0.1


@dataclass(frozen=True)
class EnvelopeSearch:
    """What a search found.

    Parameters
    ----------
    candidate : Candidate
        Its value is what was searched for: −½ log of the mean squared error of predictions.
    random : ndarray
        (kept,) values of the random sequences that keep the limits.
    reference : Candidate
        The best of these, of those that keep the limits where some do.
    evaluations : int
    """

    candidate: Candidate
    random: Array
    reference: Candidate
    evaluations: int

    @property
    def kept(self) -> int:
        """How many of the random sequences keep the limits."""
        return len(self.random)


def usual_manoeuvres(envelope: Envelope, holds: int, hold: float) -> Array:
    """Return an approach, a two-sided zig-zag at two speeds, and a turn, levels (K, nc).

    Parameters
    ----------
    envelope : Envelope
    holds : int
        K
    hold : float
        [s]
    """
    right, left = _to_both_sides(envelope, _TURN, fast=True)
    slow_right, slow_left = _to_both_sides(envelope, _TURN, fast=False)
    order = np.array([
        envelope.begun, right, left, right, left, slow_left, slow_right, slow_left, slow_right,
        left,
    ])  # fmt: skip
    # where it is too short for all of it, every leg gets its share
    leg = max(1, min(_leg(envelope, hold), holds // len(order)))
    return np.asarray(order[np.minimum(np.arange(holds) // leg, len(order) - 1)])


def usual_beginnings(envelope: Envelope, holds: int, hold: float) -> Array:
    """Return the zig-zags and turns that a trial may begin with, levels (M, B, nc).

    Each at two speeds, three rates of turn, and to either side first.

    Parameters
    ----------
    envelope : Envelope
    holds : int
        Of the whole trial.
    hold : float
        [s]
    """
    leg = _leg(envelope, hold)
    count = min(max(round(_VALIDATION * holds), 2 * leg), int(_LONGEST_VALIDATION * holds))
    # too short for two legs: each gets its half
    leg = max(1, min(leg, count // 2))
    other = np.arange(count) // leg % 2
    found = []
    for share in _TURNS:
        for fast in (True, False):
            pair = np.array(_to_both_sides(envelope, share, fast=fast))
            zig_zags = [pair[other], pair[1 - other]]
            found += [*zig_zags, *(np.tile(turn, (count, 1)) for turn in pair)]
    return np.array(found)


def _leg(envelope: Envelope, hold: float) -> int:
    """Return how many holds a leg of a zig-zag lasts."""
    return max(1, round(_LEG * envelope.time_scale / hold))


def _to_both_sides(envelope: Envelope, share: float, *, fast: bool) -> tuple[Array, Array]:
    """Return the settings (nc,) that turn to starboard and port by a share of the largest rate."""
    settings, reached = envelope.settings, envelope.reached
    rate = reached[:, -1] if reached.shape[1] > 1 else np.zeros(len(reached))
    middle = np.median(reached[:, 0])
    part = reached[:, 0] >= middle if fast else reached[:, 0] < middle
    # straight motion passes for both sides of a ship that cannot turn
    wanted = share * np.abs(rate[part]).max(initial=0.0)
    right, left = (settings[part][int(np.abs(rate[part] - s * wanted).argmin())] for s in (1, -1))
    return right, left


def search_envelope(
    problem: TrialProblem,
    envelope: Envelope,
    seed: int,
    effort: float = 1.0,
    known: Array | float = 0.0,
    workers: int | None = None,
) -> EnvelopeSearch:
    """Search for the sequence that leaves the least error of predictions.

    Parameters
    ----------
    problem : TrialProblem
        With the limits, its run starting where the envelope's does.
    envelope : Envelope
    seed : int
    effort : float
        Times the usual number of evaluations.
    known : ndarray, optional
        (p, p) moments of other trials.
    workers : int, optional
        Processes.
    """

    def worth(motion: Motion) -> Array:
        with np.errstate(divide="ignore"):
            return np.asarray(-0.5 * np.log(envelope.error_without_parts(motion, known, PARTS)))

    hold = problem.schedule.hold * problem.schedule.sample_time
    return exchange_settings(
        problem, envelope, worth, seed, effort=effort, workers=workers,
        beginnings=usual_beginnings(envelope, problem.shape[0], hold),
    )  # fmt: skip


def exchange_settings(
    problem: TrialProblem,
    envelope: Envelope,
    worth: Callable[[Motion], Array],
    seed: int,
    *,
    effort: float = 1.0,
    tries: int = _TOGETHER,
    workers: int | None = None,
    beginnings: Array | None = None,
) -> EnvelopeSearch:
    """Search for the sequence of settings of an envelope that is worth most.

    Parameters
    ----------
    problem : TrialProblem
        With the limits, its run starting where the envelope's does.
    envelope : Envelope
    worth : callable
        Value of R motions, (R,); −inf where one tells nothing.
    seed : int
    effort : float
        Times the usual number of rounds.
    tries : int
        Sequences that each round of each chain tries.
    workers : int, optional
        Processes.
    beginnings : ndarray, optional
        (M, B, nc) one of which the sequence begins with; random sequences do not.
    """
    holds, nc = problem.shape
    if beginnings is None:
        beginnings = np.empty((1, 0, nc))
    begun = beginnings.shape[1]
    hold = problem.schedule.hold * problem.schedule.sample_time
    longest = max(1, min(holds - begun, round(HOLDS[1] * envelope.time_scale / hold)))

    def judged(levels: Array) -> list[tuple[Array, Candidate]]:
        out = []
        for first in range(0, len(levels), _TOGETHER):
            part = levels[first : first + _TOGETHER]
            complete = problem.schedule.within_reach(part)
            motion = problem.scenarios[0].rollout.run(problem.schedule.expand(complete))
            value = worth(motion)
            missed = problem.scenarios[0].limits.violations(motion)
            aside = one_sided(envelope, motion) + 1 - envelope.within(motion).mean(axis=1)
            out += [
                (p, Candidate(u, float(v), np.append(missed[:, i], aside[i])))
                for i, (p, u, v) in enumerate(
                    zip(part, to_unit(problem, complete), value, strict=True)
                )
            ]
        return out

    def picked(rng: np.random.Generator) -> tuple[Array, int]:
        setting, lasting = envelope.pick(rng)
        return setting, _held(rng, max(1, min(longest, int(lasting / hold))))

    def drawn(count: int, rng: np.random.Generator) -> Array:
        out = np.empty((count, holds, len(problem.schedule.commands)))
        for levels in out:
            k = 0
            while k < holds:
                setting, held = picked(rng)
                levels[k : k + held] = setting
                k += held
        return out

    def moved(levels: Array, rng: np.random.Generator) -> Array:
        out = levels.copy()
        if len(beginnings) > 1 and rng.random() < _BEGINS_ANEW:
            out[:begun] = beginnings[rng.integers(len(beginnings))]
        for _ in range(int(rng.integers(1, 4))):
            setting, held = picked(rng)
            i = int(rng.integers(begun, holds - held + 1))
            if rng.random() < _ANEW:
                out[i : i + held] = setting
            else:
                j = int(rng.integers(begun, holds - held + 1))
                out[i : i + held], out[j : j + held] = (
                    out[j : j + held].copy(), out[i : i + held].copy(),
                )  # fmt: skip
        return out

    def strayed(levels: Array, candidate: Candidate) -> NDArray[np.bool_]:
        """Return in which holds (K,) a sequence breaks limits on its path."""
        if (candidate.missed[:-1] <= TOLERANCE).all():
            return np.zeros(holds, bool)
        commands = problem.schedule.expand(problem.schedule.within_reach(levels))
        state = problem.scenarios[0].rollout.run(commands[None]).state[0, 1:]
        over = np.any(problem.scenarios[0].limits.path_values(state) > TOLERANCE, axis=0)
        firsts = np.arange(0, len(state), problem.schedule.hold)
        return np.logical_or.reduceat(over, firsts)[:holds]

    def mended(levels: Array, astray: NDArray[np.bool_], rng: np.random.Generator) -> Array:
        """Return a sequence with other settings where it breaks limits, and shortly before."""
        out = levels.copy()
        edges = np.flatnonzero(np.diff(np.concatenate([[0], astray.astype(int), [0]])))
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            setting, held = picked(rng)
            out[max(begun, first - held) : last] = setting
        return out

    scale = np.append(limit_scale(problem), UNIT_SCALE[""])

    def better(found: list[tuple[Array, Candidate]]) -> list[tuple[Array, Candidate]]:
        return sorted(found, key=lambda f: (f[1].shortfall(scale), -f[1].value))[:_KEPT]

    random = judged(drawn(RANDOM, np.random.default_rng([41, seed])))
    rounds = max(2, round(_ROUNDS * effort))

    def chain(number: int) -> tuple[Array, Candidate]:
        rng = np.random.default_rng([43, seed, number])
        pool = better(random)
        if begun:
            anew = np.array([levels for levels, _ in pool])
            anew[:, :begun] = beginnings[rng.integers(len(beginnings), size=len(anew))]
            pool = judged(anew)
        for _ in range(rounds):
            parents = rng.integers(len(pool), size=tries)
            astray = [strayed(levels, candidate) for levels, candidate in pool]
            children = np.array([
                mended(pool[i][0], astray[i], rng) if astray[i].any() else moved(pool[i][0], rng)
                for i in parents
            ])  # fmt: skip
            pool = better(pool + judged(children))
        return pool[0]

    _log.info("settings are exchanged: %d chains of %d rounds", _CHAINS, rounds)
    found = better(map_forked(chain, range(_CHAINS), workers=workers))
    # the sides and speeds that a sequence goes to are no limits of the trial
    keeping = [(p, c) for p, c in random if (c.missed[:-1] <= TOLERANCE).all()]
    rival = better(keeping or random)[0]
    best, reference = (replace(c, missed=c.missed[:-1]) for _, c in (found[0], rival))
    values = np.array([c.value for _, c in keeping])
    return EnvelopeSearch(best, values, reference, RANDOM + _CHAINS * rounds * tries)


def one_sided(envelope: Envelope, motion: Motion) -> Array:
    """Return by how much the rarer sign of sway or yaw rate falls short of its share, (R,)."""
    short = np.zeros(len(motion.state))
    for i, name in enumerate(envelope.rollout.structure.states):
        to_starboard = (envelope.reached[:, i] > 0).mean()
        if name not in ("v", "r") or min(to_starboard, 1 - to_starboard) < _EITHER / 2:
            continue
        share = (motion.state[:, :, i] > 0).mean(axis=1)
        short = np.maximum(short, _EITHER - np.minimum(share, 1 - share))
    return short


def _held(rng: np.random.Generator, longest: int) -> int:
    """Draw for how many holds a setting is kept, as often long as short in their logarithm."""
    return min(longest, max(1, int(np.exp(rng.uniform(0.0, np.log(longest + 1))))))
