"""Dead time, lag, rate limit, gain and dead band of each actuator, from command and feedback.

The feedback y of an actuator follows its command c as a first-order lag of time constant T
behind a dead time d, no faster than a rate limit R,

    ẋ = sat_R((g c(t − d) + o − x) / T),    y = x + noise,

fitted by output error on the clocks that command and feedback were recorded on: the command
is held between its samples, so x is known in closed form at every time. A rate limit and a
dead band enter only where the likelihood asks for them. Intervals allow for residuals that
are correlated over time and of unequal size (Newey and West, 1987).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import pi
from typing import Any

import numpy as np

from greybox.numerics.lagged_moments import bartlett_sums, lag_one_correlation
from greybox.numerics.recursion import propagate
from greybox.numerics.robust import HUBER, huber_loss, huber_weights, robust_deviation
from greybox.trial.actuator_estimate import ActuatorEstimate, Measured
from greybox.trial.checks.finding import Finding, Outcome
from greybox.trial.checks.motion import orderly
from greybox.trial.raw_log import Array, Mask, Recording
from greybox.vessel.vessel import Actuator, ActuatorKind, Vessel

# delays that are looked for [s]; a negative one is a command whose clock is late
_EARLIEST, _LATEST = -1.0, 6.0
_LAGS = (0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8, 25.6)
_SLOWEST = 60.0
# what passes before the unknown start of the actuator is forgotten: seconds, and share of the log
_START, _START_SHARE = 10.0, 0.1
_FEWEST_SAMPLES, _FEWEST_CHANGES = 60, 5
# share of the feedback's variance that the command must explain to be its command
_LEAST_EXPLAINED = 0.3
# what of the feedback is no spike: quantiles
_USUAL = (0.005, 0.995)
# gain in twice the log-likelihood (of samples that count as independent) and in the size of the
# residual for which a rate limit or a dead band is taken in
_LEAST_GAIN, _LEAST_SHARE = 12.0, 0.05
# loss at the best candidate, over that without, up to which it is fitted
_PROMISING = 1.0
# largest dead band of a propeller over its largest command, and how many are tried
_MOST_BAND, _MOST_LEVELS = 0.5, 48
# how many quarters of a sample the delay is moved along its ridge with the lag at most
_RIDGE = 24
# loss there over that of the fit up to which it is fitted anew
_NEAR = 1.5
# share of the loss by which a step must lower it for another to follow
_CONVERGED = 1e-6
# beyond the noise by this factor something is left that a lag does not explain
_LEFT_OVER = 1.15
# feedback that stands still in more than this share of the samples in which it must move is held
_HELD_SHARE = 0.5
_NORMAL = 1.96


def measure_actuators(
    recordings: Sequence[Recording], vessel: Vessel
) -> tuple[tuple[ActuatorEstimate, ...], list[tuple[Finding, tuple[str, ...]]], Outcome | None]:
    """Measure each actuator whose command and feedback are both recorded, all logs together.

    Parameters
    ----------
    recordings : sequence of Recording
        Canonical, of one ship.
    vessel : Vessel

    Returns
    -------
    tuple
        Estimates; a finding for each actuator that is not ideal, with the names of its logs; and
        the outcome of the check where there is nothing to measure.
    """
    estimates, findings, untold = [], [], []
    for actuator in vessel.actuators:
        pairs = [p for r in recordings if (p := _pair(r, actuator)) is not None]
        fit = _fit(pairs, actuator.kind) if pairs else None
        if fit is None:
            untold.append(f"{actuator.feedback} after {actuator.command}")
            continue
        estimate = _estimate(fit, pairs, actuator)
        estimates.append(estimate)
        if not estimate.ideal:
            findings.append((_finding(estimate, fit, pairs), estimate.logs))
    if estimates:
        return tuple(estimates), findings, None
    if not untold:
        nothing = "the vessel file names no actuator by command and feedback"
        return (), [], Outcome("actuator", "clean", nothing)
    reason = f"too few moves of a command that its feedback follows: {', '.join(untold)}"
    return (), [], Outcome("actuator", "cannot tell", reason)


@dataclass(frozen=True)
class _Pair:
    """Command and feedback of one log, each on its own clock.

    Parameters
    ----------
    log : str
    moved : ndarray
        (M,) times of the command's changes [s], the first sample included.
    command : ndarray
        (M,) value from each of them on.
    t, y : ndarray
        (N,) times [s] and values of the feedback.
    step : float
        Usual sample time of the slower one [s].
    circular : bool
        Whether whole turns make no difference.
    """

    log: str
    moved: Array
    command: Array
    t: Array
    y: Array
    step: float
    circular: bool

    def rest(self, x: Array) -> Array:
        """Return feedback minus model (N,)."""
        e = self.y - x
        return np.asarray((e + pi) % (2 * pi) - pi) if self.circular else e

    def turns(self) -> Array:
        """Return the whole turns that the feedback is ahead of the command (N,)."""
        if not self.circular:
            return np.zeros_like(self.y)
        held = self.command[np.clip(np.searchsorted(self.moved, self.t, "right") - 1, 0, None)]
        return np.asarray(2 * pi * np.round((self.y - held) / (2 * pi)))

    def rows(self, keep: Mask) -> _Pair:
        """Return the pair with some samples of the feedback only."""
        return replace(self, t=self.t[keep], y=self.y[keep])


def _pair(recording: Recording, actuator: Actuator) -> _Pair | None:
    if actuator.command not in recording or actuator.feedback not in recording:
        return None
    command, feedback = (
        orderly(recording[n], angular=actuator.angular)
        for n in (actuator.command, actuator.feedback)
    )
    tc, c, t, y = command.t, command.value, feedback.t, feedback.value
    if len(tc) < _FEWEST_SAMPLES or len(t) < _FEWEST_SAMPLES:
        return None
    begin = max(tc[0], t[0])
    begin += min(_START, _START_SHARE * (t[-1] - begin))
    step = max(float(np.median(np.diff(tc))), float(np.median(np.diff(t))))
    # a command is not known beyond its last sample
    keep = (t >= begin) & (t <= tc[-1] + step)
    change = np.flatnonzero(np.diff(c) != 0) + 1
    if keep.sum() < _FEWEST_SAMPLES or len(change) < _FEWEST_CHANGES:
        return None
    at = np.concatenate([[0], change])
    circular = actuator.kind == "angle"
    return _Pair(recording.name, tc[at], c[at], t[keep], y[keep], step, circular)


# parameters of the model, in the order of the arrays below
_D, _T, _G, _O, _R, _B = range(6)


@dataclass(frozen=True)
class _Fit:
    """A fitted actuator.

    Parameters
    ----------
    theta : ndarray
        (6,) d, T, g, o, R, b; R infinite and b zero where they are not in the model.
    free : tuple of int
        Which were fitted.
    scale : float
        Robust standard deviation of the residual.
    rest : ndarray
        (N,) residuals of all logs, one log after another.
    covariance : ndarray
        (p, p) of the free ones; empty until it is asked for.
    alike : tuple of ndarray
        Other parameters that explain the logs as well.
    hold : float
        Mean age of a feedback that the recorder repeats while it must move [s]; else 0.
    fresh : tuple of _Pair
        The logs where their feedback is new.
    """

    theta: Array
    free: tuple[int, ...]
    scale: float
    rest: Array
    covariance: Array
    alike: tuple[Array, ...] = ()
    hold: float = 0.0
    fresh: tuple[_Pair, ...] = ()


def _respond(theta: Array, pair: _Pair, kind: ActuatorKind) -> Array:
    """Return the model's feedback (N,) at the times of the feedback."""
    d, lag, gain, offset, rate, band = (float(p) for p in theta)
    c = pair.command
    if band and kind == "speed":
        c = np.where(np.abs(c) < band, 0.0, c)
        band = 0.0
    target = gain * c + offset
    at = pair.t - d
    j = np.clip(np.searchsorted(pair.moved, at, side="right") - 1, 0, None)
    since = np.maximum(at - pair.moved[j], 0.0)
    if not np.isfinite(rate) and not band:
        if lag <= 0:
            return np.asarray(target[j])
        keep = np.exp(-np.diff(pair.moved) / lag)
        # at a change the lag still goes to the target before it
        x = propagate(
            keep[:, None, None], ((1 - keep) * target[:-1])[:, None, None], target[:1, None]
        )[:, 0, 0]
        return np.asarray(target[j] + (x[j] - target[j]) * np.exp(-since / lag))
    x = _limited(np.diff(pair.moved), target, lag, rate, band)
    return x[j] + _moved(target[j] - x[j], since, lag, rate, band)


def _moved(error: Array, time: Array, lag: float, rate: float, band: float) -> Array:
    """Return how far an actuator gets in a time from an error that stays."""
    way = np.maximum(np.abs(error) - band, 0.0)
    linear = np.minimum(way, rate * lag if np.isfinite(rate) else np.inf)
    ramp = (way - linear) / rate
    decay = np.exp(-np.maximum(time - ramp, 0.0) / lag) if lag > 0 else np.zeros_like(way)
    # still on the ramp, or on the exponential behind it
    on_ramp = np.minimum(rate * time, way) if np.isfinite(rate) else way
    return np.asarray(np.sign(error) * np.where(time < ramp, on_ramp, way - linear * decay))


def _limited(times: Array, target: Array, lag: float, rate: float, band: float) -> Array:
    """Return x at each change of the command (M,), one after another."""
    x = float(target[0])
    knee = rate * lag if np.isfinite(rate) else np.inf
    decays = np.exp(-times / lag).tolist() if lag > 0 else [0.0] * len(times)
    exp = np.exp
    out = [x]
    for time, goal, decay in zip(times.tolist(), target.tolist(), decays, strict=False):
        error = goal - x
        way = (error if error > 0 else -error) - band
        if way > 0:
            if way <= knee:
                gone = way * (1 - decay)
            else:
                ramp = (way - knee) / rate
                if time <= ramp:
                    gone = rate * time
                else:
                    gone = way - (knee * float(exp((ramp - time) / lag)) if lag > 0 else 0.0)
            x += gone if error > 0 else -gone
        out.append(x)
    return np.asarray(out)


def _rest(theta: Array, pairs: Sequence[_Pair], kind: ActuatorKind) -> Array:
    return np.concatenate([p.rest(_respond(theta, p, kind)) for p in pairs])


def _scale(rest: Array) -> float:
    return robust_deviation(rest - np.median(rest))


def _huber(rest: Array, scale: float) -> float:
    return 2 * float(np.mean(huber_loss(rest / scale)))


def _fit(pairs: Sequence[_Pair], kind: ActuatorKind) -> _Fit | None:
    """Fit delay, lag, gain and offset, and what else the logs show; None where they show none."""
    start = _coarse(pairs)
    if start is None:
        return None
    # a joint that goes round has no gain but 1
    span = max(float(np.ptp(p.command)) for p in pairs)
    free: tuple[int, ...] = (_D, _T, _O) if kind == "angle" and span > 2 * pi else (_D, _T, _G, _O)
    if _G not in free:
        start[_O] += (start[_G] - 1) * float(np.mean([p.command.mean() for p in pairs]))
        start[_G] = 1.0
    fit = _along_ridge(_improve(start, free, pairs, kind), pairs, kind)
    hold, fresh = _held(fit, pairs, kind)
    fit = replace(fit, hold=hold, fresh=fresh)
    # values that the recorder repeats look like limits of the actuator
    if not hold and float(np.sqrt(np.mean(fit.rest**2))) > _LEFT_OVER * _noise(pairs):
        fit = _with_limits(fit, pairs, kind)
    fit = _least_late(fit, pairs, kind)
    return replace(fit, covariance=_covariance(fit, pairs, kind))


def _coarse(pairs: Sequence[_Pair]) -> Array | None:
    """Return the start of the fit: the delay and lag of a grid that correlate best."""
    best: tuple[float, Array] | None = None
    moments: dict[tuple[float, float], Array] = {}
    for lag in _LAGS:
        for p in pairs:
            step = min(max(float(np.median(np.diff(p.t))), 0.05), 1.0)
            grid = np.arange(p.t[0] + _LATEST, p.t[-1] + _EARLIEST, step)
            if len(grid) < _FEWEST_SAMPLES // 2:
                grid = np.arange(p.t[0], p.t[-1], step)
            feedback = p.y - p.turns()
            # spikes count for no more than what is usual
            feedback = np.clip(feedback, *np.quantile(feedback, _USUAL))
            y = np.interp(grid, p.t, feedback)
            delays = np.arange(_EARLIEST, _LATEST + 0.1, max(0.1, step))
            wide = np.arange(grid[0] - _LATEST - step, grid[-1] - _EARLIEST + step, step)
            free = replace(p, t=wide, y=wide)
            x = _respond(np.array([0.0, lag, 1.0, 0.0, np.inf, 0.0]), free, "angle")
            first = np.round((grid[0] - delays - wide[0]) / step).astype(int)
            first = np.clip(first, 0, len(wide) - len(grid))
            mean = float(y.mean())
            for d, k in zip(delays, first, strict=True):
                part = x[k : k + len(y)]
                sums = np.array(
                    [len(y), part.sum(), part @ part, y.sum(), part @ (y - mean), y @ y]
                )
                sums[4] += mean * sums[1]
                key = (round(float(d), 3), lag)
                moments[key] = moments.get(key, 0.0) + sums
    for (d, lag), (n, sx, sxx, sy, sxy, syy) in moments.items():
        var, cov, total = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
        if var <= 1e-12 * max(sxx, 1e-300) or total <= 1e-12 * max(syy, 1e-300):
            continue
        share = cov**2 / (var * total)
        if cov > 0 and (best is None or share > best[0]):
            gain = cov / var
            best = (share, np.array([d, lag, gain, (sy - gain * sx) / n, np.inf, 0.0]))
    return None if best is None or best[0] < _LEAST_EXPLAINED else best[1]


def _improve(
    theta: Array, free: tuple[int, ...], pairs: Sequence[_Pair], kind: ActuatorKind
) -> _Fit:
    """Minimise Huber's loss by damped Gauss-Newton steps, the scale taken anew between rounds."""
    theta = theta.copy()
    for _ in range(4):
        rest = _rest(theta, pairs, kind)
        scale = max(_scale(rest), _finest(pairs))
        loss, damping, before = _huber(rest, scale), 1e-3, theta.copy()
        for _ in range(12):
            slope = _slope(theta, free, pairs, kind)
            weight = huber_weights(rest / scale)
            size = np.sqrt(np.einsum("ij,ij->j", slope, slope))
            size[size == 0] = 1.0
            j = slope / size
            gram, push = j.T @ (weight[:, None] * j), j.T @ (weight * rest)
            done = False
            for _ in range(6):
                move = np.linalg.solve(gram + damping * np.eye(len(free)), push) / size
                tried = _bounded(theta, free, move)
                there = _rest(tried, pairs, kind)
                found = _huber(there, scale)
                if found < loss:
                    done = loss - found < _CONVERGED * loss
                    theta, rest, loss, damping = tried, there, found, damping / 5
                    break
                damping *= 8
            else:
                done = True
            if done:
                break
        which = list(free)
        change = np.abs(theta[which] - before[which])
        if np.all(change <= 1e-3 * np.maximum(np.abs(theta[which]), 0.01)):
            break
    rest = _rest(theta, pairs, kind)
    return _Fit(theta, free, max(_scale(rest), _finest(pairs)), rest, np.empty((0, 0)))


def _along_ridge(fit: _Fit, pairs: Sequence[_Pair], kind: ActuatorKind) -> _Fit:
    """Look for a better minimum where delay and lag have the same sum.

    Where the clocks of command and feedback beat, the loss has a kink at every phase.
    """
    total = float(fit.theta[_D] + fit.theta[_T])
    step = 2 * _resolved(fit.theta, pairs)
    reach = min(_RIDGE, max(int(fit.theta[_T] / step) + 4, 8))
    starts = []
    for k in range(-reach, reach + 1):
        theta = fit.theta.copy()
        theta[_D] += k * step
        theta[_T] = total - theta[_D]
        if theta[_T] >= 0:
            starts.append((_huber(_rest(theta, pairs, kind), fit.scale), theta))
    losses = np.array([np.inf, *(loss for loss, _ in starts), np.inf])
    low = np.flatnonzero((losses[1:-1] <= losses[:-2]) & (losses[1:-1] <= losses[2:]))
    best = fit
    near = low[losses[1:-1][low] < _NEAR * _huber(fit.rest, fit.scale)]
    for at in near[np.argsort(losses[1:-1][near])][:2]:
        found = _improve(starts[at][1], fit.free, pairs, kind)
        if _huber(found.rest, fit.scale) < _huber(best.rest, fit.scale):
            best = found
    return best


def _bounded(theta: Array, free: tuple[int, ...], move: Array) -> Array:
    out = theta.copy()
    out[list(free)] += move
    out[_D] = np.clip(out[_D], _EARLIEST, _LATEST + 2)
    out[_T] = np.clip(out[_T], 0.0, _SLOWEST)
    if _R in free:
        out[_R] = np.clip(out[_R], 0.3 * theta[_R], 3 * theta[_R])
    if _B in free:
        out[_B] = np.clip(out[_B], 0.3 * theta[_B], 3 * theta[_B])
    return out


def _slope(
    theta: Array, free: tuple[int, ...], pairs: Sequence[_Pair], kind: ActuatorKind
) -> Array:
    """Return the derivative of the model (N, p), central over what the clocks resolve."""
    step = _resolved(theta, pairs)
    spread = max(float(np.std(p.command)) for p in pairs)
    sizes = {
        _D: step, _T: max(0.02 * theta[_T], 0.4 * step), _G: 1e-3 * abs(theta[_G]),
        _O: 1e-3 * abs(theta[_G]) * spread, _R: 0.02 * theta[_R], _B: 0.05 * theta[_B],
    }  # fmt: skip
    columns = []
    linear = _R not in free and (_B not in free or kind == "speed") and theta[_G] != 0
    for k in free:
        if linear and k == _O:
            columns.append(np.ones(sum(len(p.t) for p in pairs)))
            continue
        if linear and k == _G:
            model = np.concatenate([_respond(theta, p, kind) for p in pairs])
            columns.append((model - theta[_O]) / theta[_G])
            continue
        up, down = theta.copy(), theta.copy()
        up[k] += sizes[k]
        down[k] = max(down[k] - sizes[k], 0.0) if k in (_T, _B) else down[k] - sizes[k]
        ahead = np.concatenate([_respond(up, p, kind) for p in pairs])
        behind = np.concatenate([_respond(down, p, kind) for p in pairs])
        columns.append((ahead - behind) / (up[k] - down[k]))
    return np.column_stack(columns)


def _resolved(theta: Array, pairs: Sequence[_Pair]) -> float:
    """Return the change of a delay over which the model is straight [s].

    An actuator without a lag jumps with its command: then what the samples resolve.
    """
    step = 0.25 * min(float(np.median(np.diff(p.t))) for p in pairs)
    return step if theta[_T] < step else 0.4 * min(step, 0.25 * float(theta[_T]))


def _finest(pairs: Sequence[_Pair]) -> float:
    """Return the standard deviation of rounding to the feedback's smallest step."""
    steps = np.concatenate([np.abs(np.diff(p.y)) for p in pairs])
    steps = steps[steps > 1e-9 * max(float(np.ptp(pairs[0].y)), 1e-300)]
    return max(float(steps.min() / np.sqrt(12)) if len(steps) else 0.0, 1e-9)


def _noise(pairs: Sequence[_Pair]) -> float:
    """Return the noise of the feedback, from what three samples leave of a straight line."""
    bend = np.concatenate([np.diff(p.y, 2) for p in pairs])
    return max(_scale(bend) / float(np.sqrt(6)), _finest(pairs))


def _with_limits(fit: _Fit, pairs: Sequence[_Pair], kind: ActuatorKind) -> _Fit:
    """Take in a rate limit or a dead band where the likelihood grows enough by it."""
    best = fit
    # a dead band may hide a rate limit, so that is tried again behind it
    for k in (_R, _B, _R):
        if k in best.free or (k == _B and best.theta[_B]):
            continue
        tried = []
        for value in _rates(pairs) if k == _R else _bands(best, pairs, kind):
            theta = best.theta.copy()
            theta[k] = value
            tried.append(theta)
            if k == _R and theta[_T] > 0:
                # most of a lag may have been the limit
                tried.append(np.where(np.arange(len(theta)) == _T, 0.2 * theta[_T], theta))
        losses = [_huber(_rest(theta, pairs, kind), best.scale) for theta in tried]
        # what is there already helps before anything else is fitted to it
        if not tried or min(losses) > _PROMISING * _huber(best.rest, best.scale):
            continue
        start = tried[int(np.argmin(losses))]
        if k == _B and kind == "speed":
            more = _with_threshold(start, best.free, pairs)
        else:
            more = _improve(start, (*best.free, k), pairs, kind)
        if _gain(best, more, pairs) > _LEAST_GAIN:
            best = more
    return best


def _with_threshold(start: Array, free: tuple[int, ...], pairs: Sequence[_Pair]) -> _Fit:
    """Fit the command below which a propeller stands: a staircase, so every level is tried."""
    fit = _improve(start, free, pairs, "speed")
    _, levels = _levels(pairs)
    tried = [np.where(np.arange(len(start)) == _B, b, fit.theta) for b in levels]
    losses = [_huber(_rest(theta, pairs, "speed"), fit.scale) for theta in tried]
    return _improve(tried[int(np.argmin(losses))], free, pairs, "speed")


def _levels(pairs: Sequence[_Pair]) -> tuple[Array, Array]:
    """Return sizes of the command that occur (M,), at most a few dozen, and between (M−1,)."""
    size = np.unique(np.abs(np.concatenate([p.command for p in pairs])))
    size = size[size <= _MOST_BAND * size[-1]]
    if len(size) > _MOST_LEVELS:
        size = np.unique(np.quantile(size, np.linspace(0, 1, _MOST_LEVELS)))
    return size, np.asarray(0.5 * (size[1:] + size[:-1]))


def _gain(simple: _Fit, more: _Fit, pairs: Sequence[_Pair]) -> float:
    """Return twice the gain in log-likelihood, of as many samples as count for independent."""
    ratio = _huber(simple.rest, simple.scale) / _huber(more.rest, simple.scale)
    if ratio < 1 + _LEAST_SHARE:
        return 0.0
    return float(_independent_count(more, pairs) * np.log(ratio))


def _independent_count(fit: _Fit, pairs: Sequence[_Pair]) -> float:
    """Return how many independent samples weigh as much as the residuals, neighbours alike."""
    near = power = 0.0
    for part in _parts(fit.rest, pairs):
        clipped = np.clip(part, -3 * fit.scale, 3 * fit.scale)
        near += float(clipped[1:] @ clipped[:-1])
        power += float(clipped @ clipped)
    alike = max(near / power, 0.0) if power > 0 else 0.0
    return len(fit.rest) * (1 - alike) / (1 + alike)


def _rates(pairs: Sequence[_Pair]) -> list[float]:
    """Return candidates for a rate limit: the fastest that the feedback moves for a while."""
    fastest = []
    for p in pairs:
        span = max(3, round(0.4 / max(float(np.median(np.diff(p.t))), 1e-9)))
        if len(p.y) > 2 * span:
            rate = np.abs(p.y[span:] - p.y[:-span]) / (p.t[span:] - p.t[:-span])
            fastest.append(np.sort(rate))
    if not fastest:
        return []
    rate = np.concatenate(fastest)
    top = float(np.quantile(rate, 0.995))
    moving = rate[rate > 0.3 * top]
    return [float(q) for q in np.unique([*np.quantile(moving, (0.5, 0.75)), top])] if top else []


def _bands(fit: _Fit, pairs: Sequence[_Pair], kind: ActuatorKind) -> list[float]:
    """Return candidates for half of a dead band."""
    if kind == "speed":
        return [float(b) for b in _levels(pairs)[1][:: max(1, _MOST_LEVELS // 12)]]
    return [0.7 * fit.scale, 1.5 * fit.scale, 3.0 * fit.scale]


def _parts(rest: Array, pairs: Sequence[_Pair]) -> list[Array]:
    return np.split(rest, np.cumsum([len(p.t) for p in pairs])[:-1])


def _covariance(fit: _Fit, pairs: Sequence[_Pair], kind: ActuatorKind) -> Array:
    """Return the covariance of the free parameters, robust to coloured uneven residuals.

    Sandwich with Bartlett weights that reach twice as far as Andrews' rule for a first-order
    process says, and critical values for such a reach (Kiefer and Vogelsang, 2005).
    """
    slope = _slope(fit.theta, fit.free, pairs, kind)
    size = np.sqrt(np.mean(slope**2, axis=0))
    size[size == 0] = 1.0
    slope = slope / size
    bound = HUBER * fit.scale
    inside = np.abs(fit.rest) <= bound
    scores = slope * np.clip(fit.rest, -bound, bound)[:, None]
    bread = (slope * inside[:, None]).T @ slope
    meat = np.zeros_like(bread)
    reached = count = 0
    for s in _parts(scores, pairs):
        rho = np.clip(lag_one_correlation(s), -0.9, 0.995)
        alpha = float(np.max(4 * rho**2 / ((1 - rho) ** 2 * (1 + rho) ** 2)))
        lags = int(min(2 * 1.1447 * (alpha * len(s)) ** (1 / 3), len(s) / 4))
        meat += bartlett_sums(s, lags)
        reached += 1 + lags
        count += len(s)
    p = len(fit.free)
    inverse = np.linalg.pinv(bread, rcond=1e-10)
    # the more of the log the weights reach over, the less certain is the covariance itself
    share = reached / count
    wider = (_NORMAL + 2.9694 * share + 0.4160 * share**2 - 0.5324 * share**3) / _NORMAL
    covariance = inverse @ meat @ inverse / np.outer(size, size)
    return np.asarray(covariance) * wider**2 * count / max(count - p, 1)


def _estimate(fit: _Fit, pairs: Sequence[_Pair], actuator: Actuator) -> ActuatorEstimate:
    new = None
    if fit.hold and fit.fresh:
        again = _improve(fit.theta, fit.free, fit.fresh, actuator.kind)
        again = replace(again, covariance=_covariance(again, fit.fresh, actuator.kind))
        new = _measured(again, _D, fit.fresh), _measured(again, _T, fit.fresh)
    delay = _measured(fit, _D, pairs)
    lag = _measured(fit, _T, pairs)
    response = delay.value + lag.value
    spread = _NORMAL * float(np.sqrt(max(fit.covariance[:2, :2].sum(), 0.0)))
    sums = [float(x[_D] + x[_T]) for x in fit.alike]
    between = min([response - spread, *sums]), max([response + spread, *sums])
    limited = _R in fit.free
    return ActuatorEstimate(
        actuator.thruster,
        actuator.kind,
        actuator.command,
        actuator.feedback,
        delay,
        lag,
        Measured(response, between),
        _measured(fit, _G, pairs),
        _measured(fit, _O, pairs),
        _measured(fit, _R, pairs) if limited else None,
        _measured(fit, _B, pairs) if fit.theta[_B] else None,
        fit.scale,
        max(p.step for p in pairs),
        fit.hold,
        new,
        tuple(p.log for p in pairs),
    )


def _measured(fit: _Fit, k: int, pairs: Sequence[_Pair]) -> Measured:
    """Return a parameter with its interval."""
    value = float(fit.theta[k])
    if k == _B and k not in fit.free:
        return Measured(value, _threshold_interval(fit, pairs))
    at = fit.free.index(k) if k in fit.free else None
    spread = 0.0 if at is None else _NORMAL * float(np.sqrt(max(fit.covariance[at, at], 0.0)))
    low, high = value - spread, value + spread
    if k in (_D, _T):
        alike = [theta[k] for theta in fit.alike]
        low, high = min([low, *alike]), max([high, *alike])
    return Measured(value, (max(low, 0.0) if k in (_T, _R, _B) else low, high))


def _least_late(fit: _Fit, pairs: Sequence[_Pair], kind: ActuatorKind) -> _Fit:
    """Return, of the delays and lags that explain the log alike, the smallest.

    With a lag shorter than a sample the likelihood of the delay is a staircase.
    """
    step = min(float(np.median(np.diff(p.t))) for p in pairs)
    if fit.theta[_T] >= 0.5 * step or (_B in fit.free and kind != "speed"):
        return fit
    count = _independent_count(fit, pairs)
    least = _huber(fit.rest, fit.scale)
    delays = np.unique([*(fit.theta[_D] + step * np.linspace(-1.2, 1.2, 13)), 0.0])
    delays = delays[np.abs(delays - fit.theta[_D]) <= 1.2 * step]
    found = []
    for d in delays:
        for lag in step * np.array([0.0, 0.1, 0.25, 0.5, 0.8]):
            theta = fit.theta.copy()
            theta[[_D, _T]] = d, lag
            found.append((_huber(_rest(theta, pairs, kind), fit.scale), theta))
    least = min(least, min(loss for loss, _ in found))
    alike = [x for loss, x in found if loss <= least * (1 + _NORMAL**2 / count)]
    as_good = [x for loss, x in found if loss <= least * (1 + 1 / count)]
    best = min(as_good, key=lambda x: abs(x[_D]) + x[_T], default=fit.theta)
    rest = _rest(best, pairs, kind)
    return replace(fit, theta=best, rest=rest, alike=tuple(alike))


def _threshold_interval(fit: _Fit, pairs: Sequence[_Pair]) -> tuple[float, float]:
    """Return the interval of a propeller's dead band: between sizes of commands that occur."""
    size, levels = _levels(pairs)
    bound = _huber(fit.rest, fit.scale) * (1 + _NORMAL**2 / _independent_count(fit, pairs))
    tried = [np.where(np.arange(len(fit.theta)) == _B, b, fit.theta) for b in levels]
    good = [
        k
        for k, theta in enumerate(tried)
        if levels[k] == fit.theta[_B] or _huber(_rest(theta, pairs, "speed"), fit.scale) <= bound
    ]
    return float(size[good[0]]), float(size[good[-1] + 1])


def _held(fit: _Fit, pairs: Sequence[_Pair], kind: ActuatorKind) -> tuple[float, tuple[_Pair, ...]]:
    """Return the mean age [s] of a feedback that the recorder repeats, and where it is new."""
    still = moving = 0
    ages: list[Array] = []
    fresh: list[_Pair] = []
    for p in pairs:
        x = _respond(fit.theta, p, kind)
        new = np.concatenate([[True], np.diff(p.y) != 0])
        # between two samples the model moves by more than rounding hides
        must = np.abs(np.diff(x, prepend=x[:1])) > max(2 * _finest([p]), 0.1 * fit.scale)
        moving += int(must.sum())
        still += int((must & ~new).sum())
        since = p.t - p.t[np.maximum.accumulate(np.where(new, np.arange(len(new)), 0))]
        ages.append(since[must])
        if new.sum() >= _FEWEST_SAMPLES:
            fresh.append(p.rows(new))
    if moving < _FEWEST_CHANGES or still < _HELD_SHARE * moving:
        return 0.0, ()
    return float(np.mean(np.concatenate(ages))), tuple(fresh)


def _finding(estimate: ActuatorEstimate, fit: _Fit, pairs: Sequence[_Pair]) -> Finding:
    e = estimate
    wrong = [
        words
        for holds, words in (
            (e.slow, "late"),
            (e.scaled, "scaled"),
            (e.rate_limit is not None, "limited in its rate"),
            (e.dead_band is not None, "blind to small moves"),
        )
        if holds
    ]
    what = {"speed": "propeller speed", "angle": "angle", "rudder": "rudder"}[e.kind]
    return Finding(
        "actuator",
        e.feedback,
        e.response.value,
        e.response.ci,
        "s",
        f"the {what} of thruster {e.thruster} is {' and '.join(wrong)}: {e.sentence}",
        f"let the feedback {e.feedback} drive the model; where only {e.command} is known, give the "
        f"model this delay and lag",
        (e.feedback, e.command),
        picture=_picture(fit, pairs, e.kind),
    )


# the picture shows the minute in which the command moves most [s]
_PICTURE_SECONDS = 60.0


def _picture(fit: _Fit, pairs: Sequence[_Pair], kind: ActuatorKind) -> dict[str, Any]:
    p = max(pairs, key=lambda x: len(x.command))
    moves = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(p.command)))])
    ends = np.searchsorted(p.moved, p.moved + _PICTURE_SECONDS, side="right") - 1
    start = float(p.moved[int(np.argmax(moves[ends] - moves))])
    seen = (p.t >= start) & (p.t <= start + _PICTURE_SECONDS)
    held = p.command[np.clip(np.searchsorted(p.moved, p.t[seen], "right") - 1, 0, None)]
    return {
        "log": p.log,
        "t": p.t[seen],
        "command": fit.theta[_G] * held + fit.theta[_O],
        "feedback": p.y[seen],
        "model": _respond(fit.theta, p.rows(seen), kind),
        "unit": "rad" if kind != "speed" else "as logged",
    }
