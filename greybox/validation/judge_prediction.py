"""The verdict on a model's prediction, from free runs on held-out logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.channels import CHANNELS
from greybox.estimation.prediction_verdict import (
    LIMITS,
    BandShare,
    ChannelPrediction,
    DrawsDiverge,
    Elsewhere,
    JudgedOn,
    NoBands,
    NoisierThanStated,
    PredictionVerdict,
    RefitsDiverge,
    RunsDiverge,
    weigh_prediction,
)
from greybox.estimation.verdict import Reason
from greybox.model.model import ManoeuvringModel
from greybox.numerics.binomial import wilson_interval
from greybox.numerics.robust import white_noise
from greybox.trial.log import TrialLog
from greybox.trial.segments import split_segments, whole_name
from greybox.validation.bands import predict_bands
from greybox.validation.calibration import RunErrors, cross_calibrated
from greybox.validation.criteria import independent_samples
from greybox.validation.fit import LogFit, noise_fit, run_from, run_model

Array = NDArray[np.float64]

# draws of a band that is only counted, and runs from measured states a log
_DRAWS, _RESTARTS = 64, 12
# weight of errors on what was left out beside those on the own logs: the share of the samples
# that a bootstrap draws; and error of a run, in spreads, beyond which it is lost whatever it is
_LEFT_OUT, _LOST = 1 - np.exp(-1.0), 3.0
# least width of a band, so that it divides, and half widths beyond which an error is none of it
_NONE, _FAR = 1e-300, 1e6


@dataclass(frozen=True)
class HeldOut:
    """A free run on a log that the estimate did not use of its model.

    Parameters
    ----------
    model : ManoeuvringModel
    run : LogFit
    part : int
        Of the logs that it belongs to: parts of one log share their mean within it.
    """

    model: ManoeuvringModel
    run: LogFit
    part: int = 0

    @classmethod
    def of(cls, model: ManoeuvringModel, log: TrialLog, part: int = 0) -> HeldOut:
        """Run the model on a log."""
        return cls(model, run_model(model, log), part)


@dataclass(frozen=True)
class NoiseBeside:
    """What the noise of a sensor leaves of a free run's error.

    Parameters
    ----------
    std : float
        Standard deviation of the noise [m/s, rad/s].
    fit : float
        Fit (6.12) that a perfect model would have [%].
    moves : bool
        Whether the channel moves by more than its noise, and enough to matter.
    matters : bool
        Whether it moves enough to matter, whatever its noise hides of that.
    """

    std: float
    fit: float
    moves: bool
    matters: bool


def noise_beside(held: HeldOut) -> dict[str, NoiseBeside]:
    """Return what sensor noise leaves of the error of a run, by state whose noise is known."""
    run, states = held.run, tuple(held.run.fit)
    noise, (spread, _) = _noise([held], states), _errors([held], states)
    moves, matters = (
        _moves([run], states, spread, beside, held.model.vessel.length)
        for beside in (noise, np.zeros(len(states)))
    )
    return {
        s: NoiseBeside(
            float(noise[i]),
            noise_fit(run.log[s][run.log.known((s,))], noise[i]),
            bool(moves[i]),
            bool(matters[i]),
        )
        for i, s in enumerate(states)
        if np.isfinite(noise[i]) and run.log.known((s,)).any()
    }


def judge_prediction(
    held: Sequence[HeldOut],
    judged_on: JudgedOn = JudgedOn.HELD_OUT,
    *,
    parts: int = 0,
    found: Sequence[Reason] = (),
    own: Sequence[HeldOut] = (),
    elsewhere: Sequence[HeldOut] = (),
    kinds: Sequence[str] = (),
    seed: int = 0,
    errors: Sequence[RunErrors | None] | None = None,
) -> PredictionVerdict:
    """Judge how well free runs predict.

    Parameters
    ----------
    held : sequence of HeldOut
        At least one; models may differ, as where logs are left out in turn.
    judged_on : JudgedOn
    parts : int
        Groups of logs that were left out in turn.
    found : sequence of Reason
        What is known already and is told with the rest.
    own : sequence of HeldOut
        Runs of the model that is judged on the logs of its estimate; `held` are then those of
        models estimated without a part, and only stand for it.
    elsewhere : sequence of HeldOut
        Runs of models estimated without whole logs, on these: how far the model reaches beyond
        what its logs show.
    kinds : sequence of str
        Of manoeuvres that were left out in `elsewhere`, none where logs were.
    seed : int
        Of the draws of the bands.
    errors : sequence of RunErrors or None, optional
        Of the runs `elsewhere`, None where there is no band: the bands judged are then those
        that the other runs calibrate.

    Returns
    -------
    PredictionVerdict
        Errors are those of all runs together, against the mean of each log, or part of one, as
        the best constant. A model estimated without a part is worse than that of all logs, its
        errors on its own logs are too small: with `own`, squared errors and spreads are 0.632
        times those of what was left out and 0.368 times those of its own logs. Without `errors`
        bands are those of each run's own model.

    References
    ----------
    Efron (1983), section 6: the .632 estimator.
    """
    runs = [h.run for h in held]
    states = tuple(runs[0].fit)
    spread, rmse = _errors(held, states, _LOST if own else np.inf)
    fitted = np.full(len(states), np.nan)
    if own:
        whole, fitted = _errors(own, states)
        spread, rmse = (
            np.sqrt(_LEFT_OUT * left**2 + (1 - _LEFT_OUT) * mine**2)
            for left, mine in ((spread, whole), (rmse, fitted))
        )
    noise = _noise(held, states)
    moves = _moves(runs, states, spread, noise, held[0].model.vessel.length)
    longest = max(float(part.t[-1] - part.t[0]) for r in runs for part in split_segments(r.log))
    beaten = moves & ~(rmse <= spread)
    horizon = _horizons(held, spread) if beaten.any() else np.full(len(states), longest)
    horizon = np.where(rmse <= spread, longest, horizon)
    bands, told = (
        _bands(held, states, seed) if errors is None else _calibrated(elsewhere, states, errors)
    )
    apart = [h.run for h in elsewhere]
    memory = _memory(apart or runs, states)
    wide, far = _errors(elsewhere or held, states)
    channels = [
        ChannelPrediction(
            s,
            CHANNELS[s].unit if s in CHANNELS else "",
            float(rmse[i]),
            float(spread[i]),
            float(noise[i]) if np.isfinite(noise[i]) else None,
            bool(moves[i]),
            float(horizon[i]),
            bool(rmse[i] <= spread[i]),
            bands.get(s),
            float(memory[i]) if np.isfinite(memory[i]) else None,
            float(fitted[i]) if np.isfinite(fitted[i]) else None,
            float(far[i]) if elsewhere and np.isfinite(far[i]) else None,
        )
        for i, s in enumerate(states)
    ]
    left = [r for r in runs if r.diverged >= 0]
    reasons = list(found)
    if left:
        after = min(float(r.log.t[r.diverged] - r.log.t[0]) for r in left)
        names = tuple(r.log.name for r in left)
        reasons.append((RefitsDiverge if own else RunsDiverge)(names, len(runs), after))
    lost = sum(r.diverged >= 0 for r in apart)
    with np.errstate(divide="ignore", invalid="ignore"):
        beyond = {s: float(v) for s, v, m in zip(states, far / wide, moves, strict=True) if m}
    if apart and (lost or any(not v <= LIMITS.good for v in beyond.values())):
        reasons.append(Elsewhere(tuple(kinds), len(own) > 1, beyond, lost, len(apart)))
    reasons += _noisy(held, states, rmse)
    return weigh_prediction(
        channels,
        judged_on,
        logs=[h.run.log.name for h in own or held],
        parts=parts,
        samples=sum(len(r.log) for r in runs),
        found=[*reasons, *told],
    )


def _by_log(runs: Sequence[LogFit]) -> list[list[LogFit]]:
    """Group the runs on parts of one log: of one name and origin, and never at the same time."""
    groups: list[list[LogFit]] = []
    for run in runs:
        log = run.log
        for group in groups:
            first = group[0].log
            if (
                whole_name(first.name) == whole_name(log.name)
                and first.provenance == log.provenance
                and all(r.log.t[-1] < log.t[0] or log.t[-1] < r.log.t[0] for r in group)
            ):
                group.append(run)
                break
        else:
            groups.append([run])
    return groups


def _errors(
    held: Sequence[HeldOut], states: tuple[str, ...], lost: float = np.inf
) -> tuple[Array, Array]:
    """Return the deviation from the mean of each log, and the error, root mean square (nx,).

    A run that diverges, or errs by more than `lost` times that deviation, errs by so much.
    """
    parts = dict.fromkeys(h.part for h in held)
    groups = [g for p in parts for g in _by_log([h.run for h in held if h.part == p])]
    spread, error = np.zeros(len(states)), np.zeros(len(states))
    for i, state in enumerate(states):
        squares: list[tuple[float, int]] = []
        for group in groups:
            measured = [r.log[state][r.log.known((state,))] for r in group]
            whole = np.concatenate(measured)
            if not len(whole):
                continue
            spread[i] += float(((whole - whole.mean()) ** 2).sum())
            for run, y in zip(group, measured, strict=True):
                x = run.x[run.log.known((state,)), i]
                away = np.inf if run.diverged >= 0 else float(((y - x) ** 2).sum())
                squares.append((away, len(y)))
        count = max(sum(n for _, n in squares), 1)
        spread[i] = np.sqrt(spread[i] / count)
        worst = (lost * spread[i]) ** 2 if np.isfinite(lost) else np.inf
        total = sum(away if away <= worst * n else worst * n for away, n in squares if n)
        error[i] = np.sqrt(total / count)
    return spread, error


def _memory(runs: Sequence[LogFit], states: tuple[str, ...]) -> Array:
    """Return the time over which errors are related (nx,) [s], nan where no run stays bounded."""
    out = np.full(len(states), np.nan)
    for i, state in enumerate(states):
        good = [(r, r.log.known((state,))) for r in runs if r.diverged < 0]
        errors = [(r.log[state] - r.x[:, i])[known][:, None] for r, known in good if known.any()]
        if errors:
            worth = float(independent_samples(errors, np.zeros(1))[0])
            out[i] = sum(map(len, errors)) * good[0][0].log.sample_time / worth
    return out


def _noise(held: Sequence[HeldOut], states: tuple[str, ...]) -> Array:
    """Return what the sensors' noise alone leaves (nx,), nan where nothing tells it.

    The least of what the vessel file states, what the estimate found (its misfit may be in
    it), and what neighbouring samples say: the third difference of a motion is small, that
    of white noise is not.
    """
    out = np.full(len(states), np.nan)
    vessel = held[0].run.log.vessel
    levels = [h.model.noise.measurement for h in held if h.model.noise is not None]
    for i, state in enumerate(states):
        said = [
            vessel.std(state),
            *(float(level[i]) for level in levels[:1]),
            white_noise([h.run.log.measured(state) for h in held]),
        ]
        told = [v for v in said if v is not None]
        if told:
            out[i] = min(told)
    return out


def _noisy(held: Sequence[HeldOut], states: tuple[str, ...], rmse: Array) -> list[Reason]:
    """Return the channels whose errors are mostly white and far above the noise that is stated.

    What a run leaves, not the measurements: coarsely sampled motion is rough too. Of velocities
    derived from positions the vessel file states nothing.
    """
    reasons: list[Reason] = []
    derived = any(h.run.log.provenance.velocities_derived for h in held)
    for i, state in enumerate(states):
        stated = None if derived else held[0].run.log.vessel.std(state)
        logs = [(h.run.log, h.run.x[:, i]) for h in held]
        seen = white_noise([log.measured(state) - x for log, x in logs])
        if stated and seen and seen > LIMITS.noise * stated and seen**2 > rmse[i] ** 2 / 2:
            unit = CHANNELS[state].unit if state in CHANNELS else ""
            reasons.append(NoisierThanStated(state, unit, seen, stated))
    return reasons


def _moves(
    runs: Sequence[LogFit],
    states: tuple[str, ...],
    spread: Array,
    noise: Array,
    length: float,
) -> NDArray[np.bool_]:
    """Return which channels move beyond their noise, and enough to matter beside the speed."""
    least = LIMITS.noise * np.nan_to_num(noise)
    if {"u", "v"} <= set(states):
        way = np.concatenate([r.log.states(("u", "v")) for r in runs])
        speed = float(np.sqrt((way**2).sum(axis=1).mean()))
        of = {"u": speed, "v": speed, "r": speed / length}
        least = np.maximum(least, [LIMITS.speed * of.get(s, 0.0) for s in states])
    return np.asarray((spread > least) & (spread > 0))


def _horizons(held: Sequence[HeldOut], spread: Array) -> Array:
    """Return up to when runs from measured states have less error than the constant (nx,) [s].

    Runs start all along the first half of each log and last half of it. Their error is that
    of all samples up to a time; the horizon ends where it first exceeds the spread.
    """
    total, count, sample_time = np.zeros((1, len(spread))), np.zeros((1, len(spread))), 1.0
    for h in held:
        for log in split_segments(h.run.log):
            states = h.model.structure.states
            steps = len(log) // 2
            known = np.stack([log.known((s,)) for s in states], axis=1)
            starts = np.unique(np.linspace(0, len(log) - 1 - steps, _RESTARTS).astype(int))
            starts = starts[known[starts].all(axis=1)]
            if steps < 1 or not len(starts):
                continue
            sample_time = h.model.sample_time
            x = run_from(h.model, log, starts, steps, first=float(log.t[0] - h.run.log.t[0]))
            window = starts[:, None] + np.arange(steps + 1)
            error = np.where(known[window], (x - log.states(states)[window]) ** 2, 0.0)
            if len(total) < steps + 1:
                more = ((0, steps + 1 - len(total)), (0, 0))
                total, count = np.pad(total, more), np.pad(count, more)
            total[: steps + 1] += error.sum(axis=0)
            count[: steps + 1] += known[window].sum(axis=0)
    # the start itself is measured
    with np.errstate(invalid="ignore"):
        mean = np.sqrt(np.cumsum(total[1:], axis=0) / np.maximum(np.cumsum(count[1:], axis=0), 1))
    worse = ~(mean <= spread)
    first = np.where(worse.any(axis=0), worse.argmax(axis=0), len(worse)) if len(worse) else 0
    return np.asarray(np.broadcast_to(first * sample_time, spread.shape), float)


def _bands(
    held: Sequence[HeldOut], states: tuple[str, ...], seed: int
) -> tuple[dict[str, BandShare], list[Reason]]:
    """Return how many measurements the bands hold, by state, and why there are none."""
    if all(h.model.noise is None and h.model.calibration is None for h in held):
        return {}, [NoBands("the estimate has no noise levels")]
    # errors in half widths of the band
    outward: list[Array] = []
    lost: list[str] = []
    for h in held:
        run = h.run
        if (h.model.noise is None and h.model.calibration is None) or run.diverged >= 0:
            continue
        low, high = predict_bands(h.model, run.log, seed=seed, runs=_DRAWS).measurement
        if np.isnan(low).any():
            lost.append(run.log.name)
            continue
        known = np.stack([run.log.known((s,)) for s in states], axis=1)
        error = np.where(known, run.log.states(states) - (low + high) / 2, np.nan)
        outward.append(error / np.maximum((high - low) / 2, _NONE))
    return _shares(outward, states), [DrawsDiverge(tuple(lost), len(held))] if lost else []


def _calibrated(
    held: Sequence[HeldOut], states: tuple[str, ...], errors: Sequence[RunErrors | None]
) -> tuple[dict[str, BandShare], list[Reason]]:
    """Return how many measurements bands hold that the runs calibrate for one another."""
    lost = tuple(
        h.run.log.name
        for h, e in zip(held, errors, strict=True)
        if e is None and h.run.diverged < 0
    )
    told: list[Reason] = [DrawsDiverge(lost, len(held))] if lost else []
    known = [e for e in errors if e is not None]
    sides = cross_calibrated(known, states)
    if not sides:
        return {}, [
            *told,
            NoBands("only one run was held out, and a band is calibrated on the others"),
        ]
    outward = [
        e.error / np.maximum(np.where(e.error < 0, *side), _NONE)
        for e, side in zip(known, sides, strict=True)
    ]
    return _shares(outward, states), told


def _shares(outward: Sequence[Array], states: tuple[str, ...]) -> dict[str, BandShare]:
    """Return how many errors, in half widths of their band and nan where unknown, lie inside."""
    found = {}
    for i, s in enumerate(states):
        parts = [np.clip(e[~np.isnan(e[:, i]), i], -_FAR, _FAR)[:, None] for e in outward]
        parts = [p for p in parts if len(p)]
        if parts:
            whole = np.concatenate(parts)
            share = float((np.abs(whole) <= 1).mean())
            worth = float(independent_samples(parts, np.zeros(1))[0])
            worth = min(worth, _worth_of_runs([np.abs(p) <= 1 for p in parts]))
            found[s] = BandShare(share, wilson_interval(share, worth), len(whole), worth)
    return found


def _worth_of_runs(inside: Sequence[NDArray[np.bool_]]) -> float:
    """Return how many independent samples have a share that varies as that of the runs does.

    Infinite where runs do not differ, or there is one.
    """
    runs = len(inside)
    size = np.array([len(p) for p in inside], float) / sum(map(len, inside))
    share = np.array([p.mean() for p in inside])
    whole = float(size @ share)
    between = float(size**2 @ (share - whole) ** 2) * runs / max(runs - 1, 1)
    return whole * (1 - whole) / between if between > 0 else np.inf
