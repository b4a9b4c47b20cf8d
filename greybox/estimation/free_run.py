"""Free runs fitted to logs: a filter that trusts the model more and more, then the run itself.

The free run is so bent a function of its parameters that a start far off ends
anywhere. A filter that corrects the state at every sample is nearly linear in them;
its gain is lowered in steps until what is left is the free run.

References
----------
Ljung (1999), section 10.5, on the search for output-error models; Bock (1983).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.innovations import ObservedRuns
from greybox.estimation.shooting import (
    TOLERANCE,
    FreeRuns,
    Loss,
    Measured,
    Restrictions,
    Segments,
    ShootingFit,
    cut,
    fit_segments,
    loss_value,
    measured_starts,
    unrestricted,
)
from greybox.model.output import OutputModel
from greybox.numerics.robust import FROM_MEDIAN

Array = NDArray[np.float64]
Shooting = Literal["auto", "single", "multiple"]

# process over measurement variance of the filters, one after the other
_RATIOS = (1.0, 0.1, 0.01, 1e-3)
# and where those ended in doubt
_SLOWLY = (3.0, 1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 1e-4)
# errors, in changes from sample to sample, up to which a start is tried as it is, and
# beyond which an end is in doubt
_NEARBY, _DOUBTFUL = 10.0, 1.0
# iterations of each, and the length of a step in standard errors that is near enough
_STEPS, _NEAR = 6, 0.3
# samples of each log that are enough to come near
_PART = 2000
# segments of a log, and samples that a segment has at least
_SEGMENTS, _LEAST = 64, 50
# noise-free signals still need a scale
_FLOOR = 1e-9
# cost of a run from the measured first states, in that of the fit, up to which both are one motion
_FOLLOWS = 2.0
# relative change of the noise of an output below which it stays
_SETTLED = 1e-5
# iterations with rough weights, and with good ones
_ROUGH, _FINE = 4, 60


def segment_length(logs: Sequence[Measured]) -> int:
    """Return the samples of a segment for multiple shooting."""
    longest = max(len(log.y) for log in logs)
    total = sum(len(log.y) for log in logs)
    return min(longest, max(_LEAST, -(-total // _SEGMENTS)))


def noise_of(r: Array, sigma: Array, use: Array, loss: Loss, floor: Array) -> Array:
    """Return the noise of each output from weighted residuals r (M, m, ny)."""
    errors = (r * sigma)[use > 0]
    if loss == "gaussian":
        found = np.sqrt((errors**2).mean(axis=0))
    else:
        found = FROM_MEDIAN * np.median(np.abs(errors), axis=0)
    return np.asarray(np.maximum(found, floor))


def fit_free_runs(
    model: OutputModel,
    logs: Sequence[Measured],
    p: Array,
    *,
    restrictions: Restrictions | None = None,
    loss: Loss = "gaussian",
    sigma: Array | None = None,
    shooting: Shooting = "auto",
    near: bool = False,
    once: bool = False,
    fixed: bool = False,
    tolerance: float = TOLERANCE,
) -> tuple[ShootingFit, FreeRuns]:
    """Fit parameters and initial states to logs; the noise of each output with them.

    Segments first, from the measured states: a model far off, or unstable,
    cannot run away within one. Then whole runs, where they stay bounded. A model
    that only joined segments hold together, and that leaves more error than the
    sensors have, is no unstable ship but a structure too small: whole runs are
    fitted in its place, if any stays bounded.

    Parameters
    ----------
    model : OutputModel
    logs : sequence of Measured
    p : ndarray
        (q,) start.
    restrictions : Restrictions, optional
    loss : {"gaussian", "huber"}
    sigma : ndarray, optional
        (ny,) noise of each output, known; by default estimated (its likelihood
        concentrated: the residuals' own deviation).
    shooting : {"auto", "single", "multiple"}
        ``multiple`` ends with segments, ``single`` begins with whole runs.
    near : bool
        Whether `p` is near already, such as that of another heading.
    once : bool
        Whether the first end of whole runs is returned, however it is.
    fixed : bool
        Whether runs begin where the logs were measured to begin, as a prediction does; they are
        whole then.
    tolerance : float
        Length of the last step in standard errors.

    Returns
    -------
    tuple of (ShootingFit, FreeRuns)
    """
    restrictions = unrestricted(len(p)) if restrictions is None else restrictions
    size = np.sqrt(np.mean([(log.y**2).mean(axis=0) for log in logs], axis=0))
    floor = _FLOOR * np.maximum(size, _FLOOR)
    change = changes(logs)
    weights = np.maximum(change, floor) if sigma is None else sigma
    whole = cut(logs, max(len(log.y) for log in logs))
    starts = measured_starts(whole, len(model.states))
    uncut = FreeRuns(model, whole, weights, fixed=fixed)
    if near and sigma is None and loss == "gaussian":
        # what the start leaves is its noise; a robust scale far off tells nothing
        r, _, _ = uncut.value(p, starts)
        if np.isfinite(r).all():
            uncut = uncut.with_sigma(noise_of(r, weights, whole.use, loss, floor))
    shooting = "single" if fixed else shooting

    def attempt(
        p: Array, nodes: Array, shooting: Shooting = shooting
    ) -> tuple[ShootingFit, FreeRuns]:
        nodes = starts if fixed else nodes
        single: ShootingFit | None = None
        if shooting != "multiple":
            single, runs = _settle(
                uncut, p, nodes, restrictions, loss, sigma is None, floor, tolerance
            )
            if single.converged or shooting == "single":
                return single, runs
        segments = cut(logs, segment_length(logs))
        fit, joined = _settle(
            FreeRuns(model, segments, weights), p, measured_starts(segments, len(model.states)),
            restrictions, loss, sigma is None, floor, tolerance,
        )  # fmt: skip
        if single is not None and not fit.converged and np.isfinite(single.cost):
            return single, runs
        return fit, joined

    if near:
        return attempt(p, starts)

    def doubtful(pair: tuple[ShootingFit, FreeRuns]) -> bool:
        return in_doubt(pair[0], pair[1].sigma, change)

    noise = np.maximum(change, floor)
    found: list[tuple[ShootingFit, FreeRuns]] = []
    # with derivatives, which a fit from here begins with
    r = uncut.with_sigma(noise).linearise(p, starts).r
    if p.any() and np.isfinite(r).all() and float((r**2).mean()) < _NEARBY**2:
        found.append(attempt(p, starts, "single" if once else shooting))
        if once or not doubtful(found[0]):
            return found[0]
    part = [log.first(_PART) for log in logs]
    begun = [approach(model, part, p, starts, restrictions, noise)]
    if once:
        return attempt(*begun[0], "single")
    found.append(attempt(*begun[0]))
    if doubtful(found[-1]):
        # more error than the sensors show: another way may end elsewhere
        begun.append(approach(model, logs, p, starts, restrictions, noise, _SLOWLY))
        found.append(attempt(*begun[1]))
    samples = float(whole.use.sum())

    def level(pair: tuple[ShootingFit, FreeRuns]) -> float:
        value = pair[0].cost + samples * float(np.log(pair[1].sigma).sum())
        return value if np.isfinite(value) else np.inf

    best = min(found, key=level)
    if shooting == "auto" and doubtful(best) and not _follows(best, whole, starts):
        bounded = [pair for pair in (attempt(*b, "single") for b in begun) if level(pair) < np.inf]
        return min(bounded, key=level, default=best)
    return best


def changes(logs: Sequence[Measured]) -> Array:
    """Return the root mean square of each output's change from sample to sample, (ny,)."""
    squares = [(np.diff(log.y, axis=0) ** 2).mean(axis=0) for log in logs]
    return np.asarray(np.sqrt(np.mean(squares, axis=0)))


def in_doubt(fit: ShootingFit, sigma: Array, change: Array) -> bool:
    """Whether a fit did not converge, or leaves more than sensors do.

    Parameters
    ----------
    fit : ShootingFit
    sigma : ndarray
        (ny,) noise of each output that it leaves.
    change : ndarray
        (ny,) of `changes`.
    """
    return not fit.converged or bool((sigma > _DOUBTFUL * change).any())


def _follows(pair: tuple[ShootingFit, FreeRuns], whole: Segments, starts: Array) -> bool:
    """Whether the model follows the logs from their measured first states (M, nz)."""
    fit, runs = pair
    r, _, _ = FreeRuns(runs.model, whole, runs.sigma).value(fit.p, starts)
    return bool(np.isfinite(r).all()) and 0.5 * float((r**2).sum()) < _FOLLOWS * fit.cost


def approach(
    model: OutputModel,
    logs: Sequence[Measured],
    p: Array,
    starts: Array,
    restrictions: Restrictions,
    change: Array,
    ratios: Sequence[float] = _RATIOS,
) -> tuple[Array, Array]:
    """Return parameters and initial states near those of the free run, from `p` or from none.

    Parameters
    ----------
    model, logs, restrictions
        As `fit_free_runs`.
    p, starts : ndarray
        (q,) and (M, nz).
    change : ndarray
        (ny,) root mean square of the outputs' change from sample to sample.
    ratios : sequence of float
        Process over measurement variance of the filters, one after the other.
    """
    whole = cut(logs, max(len(log.y) for log in logs))
    variance = change**2 / 2
    first = ObservedRuns(model, whole, variance, ratios[0])
    best, least = p, np.inf
    for candidate in (p, np.zeros_like(p)):
        r, _, _ = first.value(candidate, starts)
        cost = loss_value(r, "gaussian")
        if cost < least:
            best, least = candidate, cost
    for ratio in ratios:
        runs = ObservedRuns(model, whole, variance, ratio)
        fit = fit_segments(runs, best, starts, restrictions, most=_STEPS, tolerance=_NEAR)
        if not np.isfinite(fit.cost):
            break
        best, starts = fit.p, fit.nodes
    return best, starts


def _settle(
    runs: FreeRuns,
    p: Array,
    nodes: Array,
    restrictions: Restrictions,
    loss: Loss,
    estimate_noise: bool,
    floor: Array,
    tolerance: float,
    rounds: int = 12,
) -> tuple[ShootingFit, FreeRuns]:
    """Alternate between the fit and the noise of the outputs until both stay."""
    if not estimate_noise:
        return fit_segments(runs, p, nodes, restrictions, loss=loss, tolerance=tolerance), runs
    total, settled = 0, max(_SETTLED, tolerance)
    fit = ShootingFit(p, nodes, np.zeros((len(p), len(p))), np.inf, np.inf, 0, False)
    for turn in range(rounds):
        # a few steps at a time while the weights are still rough
        fit = fit_segments(
            runs, fit.p, fit.nodes, restrictions, loss=loss,
            most=_ROUGH if turn < 5 else _FINE, tolerance=tolerance,
        )  # fmt: skip
        total += fit.iterations
        r, _, _ = runs.value(fit.p, fit.nodes)
        if not np.isfinite(r).all():
            break
        sigma = noise_of(r, runs.sigma, runs.segments.use, loss, floor)
        if fit.converged and (np.abs(sigma / runs.sigma - 1) < settled).all():
            break
        stuck = not fit.converged and fit.iterations < 4
        runs = runs.with_sigma(sigma)
        if stuck and turn > 5:
            break
    return replace(fit, iterations=total), runs
