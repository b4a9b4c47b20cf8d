"""Which clocks, lever arm and heading bias a log shows: taken one by one, then doubted.

The one that explains most is taken first and the others are judged beside it;
afterwards each is dropped or exchanged where another makes it needless.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from greybox.trial.checks.motion import Motion
from greybox.trial.checks.sensor_offsets.estimate import Fit, estimate_gain, fit, scan
from greybox.trial.checks.sensor_offsets.model import Candidate, State, Tie, size
from greybox.vessel.vessel import Vessel

# what is too small to matter, and how many standard errors prove it
_LEAST_CLOCK = 0.1
_LEAST_HEADING = np.radians(0.75)
_LEAST_ARM = (0.1, 0.02)
_SIGMAS = 3.3
_LEAST_GAIN = 5.5
_MOST_LATE = 9.0
# in log-likelihood: what differs by less explains alike
NEARLY = 10.0
_FAR_COST = 12.0
_EARLY_COST = 3.0
# an antenna stands on the ship, or hardly beyond it [ship lengths]
_MOST_ARM = 0.8
_MOST = 3

_CANDIDATES = (
    Candidate("clock_offset", ("psi",)),
    # a rate gyro is noisy against what a slow ship turns: the least certain of all
    Candidate("clock_offset", ("r",), 2.5),
    Candidate("clock_offset", ("x_n", "y_n")),
    Candidate("clock_offset", ("u", "v")),
    Candidate("clock_offset", ("psi", "r"), 8.0),
    Candidate("clock_offset", ("u", "v", "r"), 6.0),
    Candidate("clock_offset", ("u",), 3.0),
    Candidate("clock_offset", ("v",), 3.0),
    Candidate("clock_offset", ("x_n",), 30.0),
    Candidate("clock_offset", ("y_n",), 30.0),
    Candidate("lever_arm", ("x_n", "y_n"), 3.0),
    Candidate("heading_bias", ("psi",)),
)


def usable_candidates(motion: Motion) -> list[Candidate]:
    """Return the defects that the channels of a log can show."""
    return [c for c in _CANDIDATES if _usable(c, motion)]


def sample_inflation(motion: Motion) -> float:
    """Return by what likelihoods of fast samples, which repeat each other, are too large."""
    return max(1.0, 0.1 / motion.step)


def select_candidates(
    tie: Tie, usable: list[Candidate], vessel: Vessel, antenna: tuple[float, float]
) -> tuple[Fit, list[tuple[float, Fit]]]:
    """Find the defects that explain a log best.

    Parameters
    ----------
    tie : Tie
        Aligned anew here as defects are found.
    usable : list of Candidate
    vessel : Vessel
    antenna : tuple of float
        Where the vessel file has the antenna, forward and starboard [m].

    Returns
    -------
    found : Fit
        Those that remain, together.
    first : list of tuple of float, Fit
        Each candidate by itself, with its log-likelihood less its cost.
    """
    chosen: tuple[Candidate, ...] = ()
    start = State(arm=antenna)
    plain = estimate_gain(tie, start, estimate_gain(tie, start))
    best = Fit(start, (), np.zeros((0, 0)), plain.loglik, np.zeros(0))
    inflation = sample_inflation(tie.motion)
    first: list[tuple[float, Fit]] = []
    for _ in range(_MOST):
        trials = _trials(tie, usable, chosen, best.state, vessel, inflation)
        if not trials:
            break
        first = first or trials
        worth, trial = _preferred(trials, vessel, antenna, inflation)
        if worth - best.loglik < _LEAST_GAIN * inflation:
            break
        chosen = trial.candidates
        tie.align(trial.state)
        best = fit(tie, chosen, trial.state)
    best = _without_one(tie, _pruned(tie, best, start, vessel, antenna), start, inflation)
    best = _exchanged(tie, best, usable, inflation)
    best = _simplest(tie, best, usable, start, inflation)
    return _pruned(tie, best, start, vessel, antenna), first


def _trials(
    tie: Tie,
    usable: list[Candidate],
    chosen: tuple[Candidate, ...],
    near: State,
    vessel: Vessel,
    inflation: float,
) -> list[tuple[float, Fit]]:
    """Return each candidate fitted beside those chosen, with log-likelihood less cost."""
    trials: list[tuple[float, Fit]] = []
    for c in usable:
        if any(c.id == k.id and set(c.channels) & set(k.channels) for k in chosen):
            continue
        trial = fit(tie, (*chosen, c), scan(tie, c, near))
        if max(map(abs, trial.state.late.values()), default=0.0) > _MOST_LATE:
            continue
        # a scan over many seconds finds more by chance than a search around zero
        late = trial.state.late[c.channels[0]] if c.id == "clock_offset" else 0.0
        if c.id == "lever_arm" and np.hypot(*trial.state.arm) > _MOST_ARM * vessel.length:
            continue
        cost = c.cost + (_FAR_COST if abs(late) > 2.0 else 0.0)
        # a sensor is late, not early; only all the others can be, and then the positions are
        cost = cost + (_EARLY_COST if late < 0 and "x_n" not in c.channels else 0.0)
        cost *= inflation
        trials.append((trial.loglik - cost, trial))
    return trials


def _preferred(
    trials: list[tuple[float, Fit]], vessel: Vessel, antenna: tuple[float, ...], inflation: float
) -> tuple[float, Fit]:
    """Return the best trial; of those nearly as good, one that is large enough to report."""
    best = max(trials, key=_first)
    large = [
        t
        for t in trials
        if significance(t[1], len(t[1].candidates) - 1, vessel, antenna) >= 1.0
        and t[0] > best[0] - NEARLY * inflation
    ]
    return max(large, key=_first) if large else best


def _exchanged(tie: Tie, found: Fit, usable: list[Candidate], inflation: float) -> Fit:
    """Exchange one late channel for another where that explains more beside the rest.

    What was taken first was taken alone, and may stand for two defects together.
    """
    if len(found.candidates) < 2:
        return found
    best, worth = found, net_likelihood(found, inflation)
    for k, old in enumerate(found.candidates):
        if old.id != "clock_offset":
            continue
        for new in usable:
            if new.id != "clock_offset" or new in found.candidates:
                continue
            others = tuple(c for j, c in enumerate(found.candidates) if j != k)
            state = _restored(found.state, old, found.state)
            trial = fit(tie, (*others, new), state)
            if net_likelihood(trial, inflation) > worth + 2.0 * inflation:
                best, worth = trial, net_likelihood(trial, inflation)
    return best


def _simplest(tie: Tie, found: Fit, usable: list[Candidate], start: State, inflation: float) -> Fit:
    """Return one late sensor in place of several defects where it explains nearly as much."""
    extra = len(found.candidates) - 1
    if extra < 1:
        return found
    best, worth = found, net_likelihood(found, inflation) - extra * NEARLY * inflation
    for c in usable:
        if c.id == "clock_offset":
            trial = fit(tie, (c,), scan(tie, c, start))
            if net_likelihood(trial, inflation) > worth:
                best, worth = trial, net_likelihood(trial, inflation)
    return best


def _without_one(tie: Tie, found: Fit, start: State, inflation: float) -> Fit:
    """Drop a candidate that another, looked for anew, makes needless."""
    for old in found.candidates if len(found.candidates) > 1 else ():
        others = tuple(c for c in found.candidates if c is not old)
        state = _restored(found.state, old, start)
        begins = [state]
        if len(others) == 1:
            begins.append(scan(tie, others[0], start))
        for begin in begins:
            trial = fit(tie, others, begin)
            if (
                net_likelihood(trial, inflation)
                > net_likelihood(found, inflation) - _LEAST_GAIN * inflation
            ):
                return _without_one(tie, trial, start, inflation)
    return found


def net_likelihood(found: Fit, inflation: float) -> float:
    """Return the log-likelihood of a fit less the costs of its candidates."""
    return found.loglik - inflation * sum(c.cost for c in found.candidates)


def _pruned(tie: Tie, found: Fit, start: State, vessel: Vessel, antenna: tuple[float, ...]) -> Fit:
    """Drop what is too small or too uncertain, least certain first, and fit the rest anew."""
    while found.candidates:
        worth = [significance(found, k, vessel, antenna) for k in range(len(found.candidates))]
        weakest = int(np.argmin(worth))
        if worth[weakest] >= 1.0:
            break
        kept = tuple(c for k, c in enumerate(found.candidates) if k != weakest)
        state = _restored(found.state, found.candidates[weakest], start)
        found = (
            fit(tie, kept, state)
            if kept
            else Fit(start, (), np.zeros((0, 0)), found.loglik, np.zeros(0))
        )
    return found


def _restored(state: State, candidate: Candidate, start: State) -> State:
    if candidate.id == "clock_offset":
        return replace(
            state, late={k: v for k, v in state.late.items() if k not in candidate.channels}
        )
    if candidate.id == "heading_bias":
        return replace(state, bias=start.bias)
    return replace(state, arm=start.arm)


def significance(found: Fit, k: int, vessel: Vessel, antenna: tuple[float, ...]) -> float:
    """Return how far a candidate passes both thresholds; below one it is no finding."""
    c = found.candidates[k]
    at = sum(size(o) for o in found.candidates[:k])
    cov = found.covariance[at : at + size(c), at : at + size(c)]
    if c.id == "lever_arm":
        off = np.array(found.state.arm) - np.array(antenna)
        least = _LEAST_ARM[0] + _LEAST_ARM[1] * vessel.length
        wald = float(off @ np.linalg.solve(cov + 1e-12 * np.eye(2), off))
        return float(min(np.hypot(*off) / least, np.sqrt(wald / (_SIGMAS**2 + 4))))
    std = float(np.sqrt(cov[0, 0]))
    if c.id == "clock_offset":
        value, least = found.state.late.get(c.channels[0], 0.0), _LEAST_CLOCK
    else:
        value, least = float(np.angle(np.exp(1j * found.state.bias))), float(_LEAST_HEADING)
    return min(abs(value) / least, abs(value) / (_SIGMAS * std))


def _first(pair: tuple[float, Fit]) -> float:
    return pair[0]


def _usable(c: Candidate, motion: Motion) -> bool:
    if not all(n in motion for n in c.channels):
        return False
    if c.id != "clock_offset":
        return motion.positioned
    if not motion.positioned:
        # heading against yaw rate alone: which of the two is late cannot be told
        return c.channels == ("r",)
    if c.channels in (("psi", "r"), ("u", "v", "r")):
        return motion.turned
    return motion.turned or "r" not in c.channels
