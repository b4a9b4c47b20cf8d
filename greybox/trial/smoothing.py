"""Local polynomials: velocities and signals with less noise, where the user asks.

A polynomial is fitted to the samples around each sample (Savitzky and Golay,
1964). The window trades noise against what is smeared: it should be short
against the fastest turn that the model has to explain. Neighbouring errors become
correlated, which standard errors from a white-noise formula do not know.
"""

from __future__ import annotations

import math

import numpy as np

from greybox.errors import LogError, so_many
from greybox.rotation import ned_to_body
from greybox.trial.raw_log import Array


def savgol_velocities(
    x_n: Array,
    y_n: Array,
    psi: Array,
    sample_time: float,
    window_s: float,
    order: int = 2,
    heading_std: float = 0.0,
    antenna: tuple[float, ...] = (0.0, 0.0),
) -> tuple[Array, Array, Array]:
    """Estimate body velocities from positions and heading by local polynomials.

    The alternative to the central differences of (3.57): order 1 with a window of two
    sample times is those differences (away from the ends), except that the heading which
    rotates them is then averaged as well.

    Parameters
    ----------
    x_n, y_n : ndarray
        (N,) position of the antenna, north and east [m], on a uniform clock.
    psi : ndarray
        (N,) heading [rad], unwrapped here where it is not.
    sample_time : float
        Ts [s].
    window_s : float
        Length of the window [s]: the largest odd number of samples whose first
        and last lie at most so far apart.
    order : int
        Of the polynomials, at least 1.
    heading_std : float
        Standard deviation of the heading noise [rad]. The rotation uses the
        heading of the fitted polynomial, so what shrinks u and v, and is divided
        out, is the noise that remains in it.
    antenna : tuple of float
        Position of the antenna from the body origin, forward and starboard [m].

    Returns
    -------
    tuple of ndarray
        u, v [m/s] at the body origin and r [rad/s], (N,) each; the first and
        last half window come from the outermost polynomials and are noisier.

    Raises
    ------
    LogError
        Lengths differ or a value is not finite; the order is below 1; the window
        holds fewer than order + 2 samples, or more than the log.

    References
    ----------
    Ljungberg (2020), eq. 3.57 (with Rᵀ) and 3.64; Savitzky and Golay (1964).
    """
    lengths = {len(x_n), len(y_n), len(psi)}
    if len(lengths) > 1:
        raise LogError(
            f"x_n, y_n and psi have {len(x_n)}, {len(y_n)} and {len(psi)} samples: "
            f"give arrays of one length."
        )
    count = window_samples(len(psi), sample_time, window_s, order, least_order=1)
    for name, value in (("x_n", x_n), ("y_n", y_n), ("psi", psi)):
        _require_finite(name, value)

    # SciPy's filters take half a second to load, and most logs need none
    from scipy.signal import savgol_filter

    def fitted(value: Array, derivative: int) -> Array:
        return np.asarray(
            savgol_filter(value, count, order, deriv=derivative, delta=sample_time), float
        )

    turned = np.unwrap(psi)
    north, east, r = fitted(x_n, 1), fitted(y_n, 1), fitted(turned, 1)
    heading = fitted(turned, 0)
    rho = np.exp(-((heading_std * _kept_noise(len(psi), count, order)) ** 2) / 2)
    u, v = (w / rho for w in ned_to_body(north, east, heading))
    return u + r * antenna[1], v - r * antenna[0], r


def smooth(value: Array, sample_time: float, window_s: float, order: int = 2) -> Array:
    """Return a signal smoothed by local polynomials.

    Parameters
    ----------
    value : ndarray
        (N,) on a uniform clock; angles unwrapped.
    sample_time : float
        Ts [s].
    window_s : float
        Length of the window [s], as in `savgol_velocities`.
    order : int
        Of the polynomials, at least 0; 0 and 1 are the moving average.

    Returns
    -------
    ndarray
        (N,), in the unit of `value`.

    Raises
    ------
    LogError
        A value is not finite; the order is below 0; the window holds fewer than
        order + 2 samples, or more than the log.
    """
    from scipy.signal import savgol_filter

    count = window_samples(len(value), sample_time, window_s, order, least_order=0)
    _require_finite("the signal", value)
    return np.asarray(savgol_filter(value, count, order), float)


def window_samples(
    samples: int | None,
    sample_time: float,
    window_s: float,
    order: int = 2,
    *,
    least_order: int = 0,
) -> int:
    """Return the odd number of samples of a window.

    Parameters
    ----------
    samples : int, optional
        Of the log; None where it is not known.
    sample_time : float
        Ts [s].
    window_s : float
        Length of the window [s], as in `savgol_velocities`.
    order, least_order : int
        Of the polynomials, and the lowest that makes sense.

    Raises
    ------
    LogError
        The order is too low, the window is not positive, or it holds fewer than
        order + 2 samples or more than the log.
    """
    if order < least_order or order != int(order):
        raise LogError(
            f"polynomials of order {order}: the order is a whole number of at least {least_order}."
        )
    if not (math.isfinite(window_s) and window_s >= 0 and sample_time > 0):
        raise LogError(
            f"a window of {window_s:g} s at a sample time of {sample_time:g} s: "
            f"both must be positive and finite."
        )
    # 0.6 s at 0.1 s is 5.999… steps in binary numbers
    count = 2 * math.floor(window_s / (2 * sample_time) + 1e-6) + 1
    if count < order + 2:
        odd = order + 2 + (order + 1) % 2
        raise LogError(
            f"a window of {window_s:g} s holds {so_many(count, 'sample')} of {sample_time:g} s, "
            f"order {order} "
            f"needs {order + 2}: use a window of at least {(odd - 1) * sample_time:g} s."
        )
    if samples is not None and count > samples:
        longest = 2 * ((samples - 1) // 2) * sample_time
        raise LogError(
            f"a window of {window_s:g} s holds {so_many(count, 'sample')}, the log has {samples}: "
            f"use a window of at most {max(longest, 0.0):g} s."
        )
    return count


def _require_finite(name: str, value: Array) -> None:
    bad = np.flatnonzero(~np.isfinite(value))
    if len(bad):
        raise LogError(
            f"{name} is not finite at sample {int(bad[0])}, which would spread over a window: "
            f"cut or repair the log there."
        )


def _kept_noise(samples: int, count: int, order: int) -> Array:
    """Return the share of white noise (N,) that a smoothed signal keeps, ends included."""
    from scipy.signal import savgol_coeffs

    half = count // 2
    # savgol_filter evaluates the outermost polynomials in the half windows at the ends
    weights = [savgol_coeffs(count, order, pos=k, use="dot") for k in range(half + 1)]
    kept = np.linalg.norm(weights, axis=1)
    nearest_end = np.minimum(np.arange(samples), np.arange(samples)[::-1])
    return np.asarray(kept[np.minimum(nearest_end, half)], float)
