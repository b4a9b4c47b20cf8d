"""Local polynomials: value, slope, crossing and peak of a noisy signal with standard errors.

The window grows while a parabola still describes it; the value is then taken
from a polynomial of higher order over the same window, so that what the
parabola leaves over is no bias. Only times of samples enter, even or not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import special

from greybox.numerics.robust import robust_deviation
from greybox.trial.raw_log import Array

Side = Literal["both", "before", "after"]

# half width of the first window, and its greatest, as shares of the time scale
_NARROW, _WIDE, _GROWTH = 0.1, 0.4, 1.4
# probability below which the quartic is needed and the window too wide
_LACK_OF_FIT = 0.1
_FEWEST = 9
# samples of white noise that a coloured residual is worth, at least
_FEWEST_WORTH = 8.0


@dataclass(frozen=True)
class LocalFit:
    """A polynomial around one time.

    Parameters
    ----------
    at : float
        Its centre [s].
    coefficients : ndarray
        (p + 1,) of powers of ``t - at``, lowest first [unit/s^k].
    covariance : ndarray
        (p + 1, p + 1)
    window : (float, float)
        Times of its first and last sample [s].
    dof : float
        Degrees of freedom of the residual.
    noise : float
        Standard deviation of one sample.
    """

    at: float
    coefficients: Array
    covariance: Array
    window: tuple[float, float]
    dof: float
    noise: float

    def value(self, t: float, order: int = 0) -> float:
        """Return the value, or a derivative, at a time."""
        return float(self._row(t, order) @ self.coefficients)

    def std(self, t: float, order: int = 0) -> float:
        """Return the standard error of `value`."""
        row = self._row(t, order)
        return math.sqrt(max(0.0, float(row @ self.covariance @ row)))

    def _row(self, t: float, order: int) -> Array:
        x = t - self.at
        return np.array(
            [
                math.perm(k, order) * x ** (k - order) if k >= order else 0.0
                for k in range(len(self.coefficients))
            ]
        )


def noise_std(t: Array, y: Array) -> float:
    """Estimate the standard deviation of white noise on a smooth signal, robustly.

    Parameters
    ----------
    t, y : ndarray
        (N,), time increasing [s].

    Returns
    -------
    float
        From the median distance of each sample to the cubic through its four
        neighbours; 0 for fewer than eight samples. Noise that is smooth over
        five samples is not seen.
    """
    if len(t) < 8:
        return 0.0
    around = [t[0:-4], t[1:-3], t[3:-1], t[4:]]
    here = t[2:-2]
    weights = []
    for i, own in enumerate(around):
        w = np.ones_like(here)
        for j, other in enumerate(around):
            if j != i:
                w *= (here - other) / (own - other)
        weights.append(w)
    values = [y[0:-4], y[1:-3], y[3:-1], y[4:]]
    miss = y[2:-2] - sum(w * v for w, v in zip(weights, values, strict=True))
    miss /= np.sqrt(1 + sum(w**2 for w in weights))
    return robust_deviation(miss)


def residual_inflation(residual: Array) -> float:
    """Return by how much coloured residuals enlarge the variance of a mean.

    (1 + ρ)/(1 − ρ) for the first-order autoregression with their lag-one
    correlation ρ; 1 where ρ is not significantly positive.
    """
    n = len(residual)
    power = float(residual @ residual)
    if n < 20 or power <= 0:
        return 1.0
    rho = float(residual[1:] @ residual[:-1]) / power
    if rho <= 2 / math.sqrt(n):
        return 1.0
    rho = min(rho, 0.999)
    return float(np.clip((1 + rho) / (1 - rho), 1.0, max(1.0, n / _FEWEST_WORTH)))


def regress(design: Array, y: Array, std: float | None = None) -> tuple[Array, Array, float, float]:
    """Fit by least squares, with a covariance that allows for coloured residuals.

    Parameters
    ----------
    design : ndarray
        (N, p)
    y : ndarray
        (N,)
    std : float, optional
        Noise of one sample where it is known: the residual's is not taken below it.

    Returns
    -------
    tuple
        Coefficients (p,), covariance (p, p), degrees of freedom, noise of one sample.
    """
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0] = 1.0
    q, right = np.linalg.qr(design / scale)
    inverse = np.linalg.pinv(right)
    coefficients = inverse @ (q.T @ y)
    residual = y - (design / scale) @ coefficients
    n, p = design.shape
    free = max(n - p, 1)
    variance = float(residual @ residual) / free if n > p else 0.0
    inflation = residual_inflation(residual)
    dof = max(1.0, free / inflation)
    if std is not None and std**2 >= variance:
        variance, dof = std**2, math.inf
    covariance = variance * inflation * (inverse @ inverse.T)
    return coefficients / scale, covariance / np.outer(scale, scale), dof, math.sqrt(variance)


def fit_at(
    t: Array,
    y: Array,
    at: float,
    scale: float,
    *,
    std: float | None = None,
    side: Side = "both",
    bounds: tuple[float, float] = (-math.inf, math.inf),
) -> LocalFit:
    """Fit a signal around one time.

    Parameters
    ----------
    t, y : ndarray
        (N,) time [s] and signal.
    at : float
        [s]
    scale : float
        Time over which the signal changes its course, such as a quarter of a
        period [s]; windows are shares of it.
    std : float, optional
        Known noise of one sample.
    side : {"both", "before", "after"}
        Samples used; one side where the signal has a kink at `at`.
    bounds : (float, float)
        Times that the window may not leave [s].
    """
    low, high = bounds
    if side == "before":
        high = min(high, at)
    if side == "after":
        low = max(low, at)
    inside = np.flatnonzero((t >= low) & (t <= high))
    if len(inside) == 0:
        inside = np.array([int(np.argmin(np.abs(t - at)))])
    distance = np.sort(np.abs(t[inside] - at))
    enough = distance[min(len(distance), _FEWEST) - 1]
    half = max(_NARROW * scale, float(enough))
    best = inside[np.abs(t[inside] - at) <= half * (1 + 1e-9)]
    while half * _GROWTH <= _WIDE * scale:
        half *= _GROWTH
        wider = inside[np.abs(t[inside] - at) <= half * (1 + 1e-9)]
        if _needs_quartic(t[wider] - at, y[wider]):
            break
        best = wider
    x, z = t[best] - at, y[best]
    # two samples are kept to tell the noise, of which a simulated signal has none; what turns
    # is a line at least, since a constant is off by half of what it turns in the window
    spare, least = (1, 0) if std == 0 else (3, int(len(best) > 2))
    degree = min(3 if side != "both" else 4, max(least, len(best) - spare))
    design = np.vander(x, degree + 1, increasing=True)
    coefficients, covariance, dof, noise = regress(design, z, std)
    return LocalFit(
        at, coefficients, covariance, (float(t[best[0]]), float(t[best[-1]])), dof, noise
    )


def _needs_quartic(x: Array, y: Array) -> bool:
    n = len(x)
    if n < 10:
        return False
    basis = np.vander(x / np.abs(x).max(), 5, increasing=True)
    # the first three columns span the parabolas
    q, _ = np.linalg.qr(basis)
    shares = q.T @ y
    coarse, fine = (float(rest @ rest) for rest in (y - q[:, :p] @ shares[:p] for p in (3, 5)))
    if fine <= 1e-24 * float(y @ y):
        return coarse > 1e-20 * float(y @ y)
    ratio = (coarse - fine) / 2 / (fine / (n - 5))
    return float(special.fdtrc(2, n - 5, ratio)) < _LACK_OF_FIT


def crossing(
    t: Array,
    y: Array,
    level: float,
    start: float,
    stop: float,
    scale: float,
    *,
    std: float | None = None,
) -> tuple[float, LocalFit] | None:
    """Find when a signal first rises through a level.

    Parameters
    ----------
    t, y : ndarray
        (N,)
    level : float
    start, stop : float
        Interval searched [s].
    scale : float
        See `fit_at`.
    std : float, optional
        Known noise of one sample.

    Returns
    -------
    tuple or None
        The time [s], its fit there; the standard error of the time is
        ``fit.std(time) / fit.value(time, 1)``. None where the level is not reached.
    """
    k = np.flatnonzero((t >= start) & (t <= stop))
    above = k[y[k] >= level]
    if len(above) == 0:
        return None
    # with noise the signal dithers about the level: the middle of the first passage
    first = int(above[0])
    dither = k[(k >= first) & (t[k] <= t[first] + _NARROW * scale)]
    last = int(dither[y[dither] < level].max(initial=first))
    time = float((t[first] + t[last]) / 2)
    fit = fit_at(t, y, time, scale, std=std, bounds=(start - _WIDE * scale, stop + _WIDE * scale))
    for _ in range(3):
        guess = time
        for _ in range(8):
            slope = fit.value(guess, 1)
            if slope <= 0:
                break
            step = (level - fit.value(guess)) / slope
            guess = float(np.clip(guess + step, fit.window[0], fit.window[1]))
            if abs(step) < 1e-12 * max(1.0, abs(guess)):
                break
        moved, time = abs(guess - time), guess
        if moved < 1e-3 * scale:
            break
        fit = fit_at(t, y, time, scale, std=std, bounds=(start, stop + _WIDE * scale))
    if fit.value(time, 1) <= 0 or not start <= time <= stop:
        return None
    return time, fit


def peak(
    t: Array,
    y: Array,
    start: float,
    stop: float,
    scale: float,
    *,
    std: float | None = None,
) -> tuple[float, LocalFit] | None:
    """Find the highest point of a signal between two times.

    Returns
    -------
    tuple or None
        Its time [s] and the fit there; None where the signal still rises or
        already falls at an end of the interval, so that no peak was seen.
    """
    # in a window too narrow for the noise the polynomial may have no top
    for wider in (1.0, 1.6, 2.5):
        found = _peak(t, y, start, stop, wider * scale, std)
        if found is not None:
            return found
    return None


def _peak(
    t: Array, y: Array, start: float, stop: float, scale: float, std: float | None
) -> tuple[float, LocalFit] | None:
    k = np.flatnonzero((t >= start) & (t <= stop))
    if len(k) < 5:
        return None
    # a running mean, so that the highest noise is not taken for the peak
    half = _NARROW * scale / 2
    left, right = np.searchsorted(t[k], t[k] - half), np.searchsorted(t[k], t[k] + half, "right")
    total = np.concatenate([[0.0], np.cumsum(y[k])])
    mean = (total[right] - total[left]) / (right - left)
    time = float(t[k[int(np.argmax(mean))]])
    fit = fit_at(t, y, time, scale, std=std, bounds=(start, stop))
    for _ in range(3):
        grid = np.linspace(fit.window[0], fit.window[1], 201)
        values = np.polynomial.polynomial.polyval(grid - fit.at, fit.coefficients)
        guess = float(grid[int(np.argmax(values))])
        for _ in range(8):
            bend = fit.value(guess, 2)
            if bend >= 0:
                break
            guess = float(np.clip(guess - fit.value(guess, 1) / bend, *fit.window))
        moved, time = abs(guess - time), guess
        if moved < 1e-3 * scale:
            break
        fit = fit_at(t, y, time, scale, std=std, bounds=(start, stop))
    edge = 1e-6 * scale
    inside = start + edge < time < stop - edge and fit.window[0] < time < fit.window[1]
    if not inside or fit.value(time, 2) >= 0:
        return None
    return time, fit
