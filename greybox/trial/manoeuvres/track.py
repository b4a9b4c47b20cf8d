"""Where the ship went: positions of its origin, and the length of its track."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from greybox.rotation import body_to_ned
from greybox.trial.manoeuvres.local import noise_std, regress
from greybox.trial.manoeuvres.quantity import Quantity
from greybox.trial.raw_log import Array


@dataclass(frozen=True)
class Track:
    """Positions of the body origin over ground.

    Parameters
    ----------
    t : ndarray
        (N,) [s]
    x_n, y_n : ndarray
        (N,) north and east [m].
    std : float or None
        Known noise of one position [m].
    walk : float
        Variance that a displacement gains per second where positions are
        integrated velocities [m²/s]; 0 where they were measured.
    integrated : bool
        Whether positions are integrated velocities.
    """

    t: Array
    x_n: Array
    y_n: Array
    std: float | None
    walk: float
    integrated: bool


def make_track(
    t: Array,
    x_n: Array | None,
    y_n: Array | None,
    psi: Array,
    u: Array,
    v: Array,
    *,
    position_std: float | None = None,
    heading_std: float | None = None,
) -> Track:
    """Return measured positions, or integrate velocities where there are none.

    Parameters
    ----------
    t : ndarray
        (N,) [s]
    x_n, y_n : ndarray or None
        (N,) of the body origin [m].
    psi, u, v : ndarray
        (N,) heading [rad] and velocity over ground, body axes [m/s].
    position_std, heading_std : float, optional
        Known noise of one sample [m], [rad].
    """
    if x_n is not None and y_n is not None:
        return Track(t, x_n, y_n, position_std, 0.0, False)
    north, east = body_to_ned(u, v, psi)
    steps = np.diff(t)

    def integral(rate: Array) -> Array:
        return np.concatenate([[0.0], np.cumsum(steps * (rate[1:] + rate[:-1]) / 2)])

    heading = noise_std(t, psi) if heading_std is None else heading_std
    speed = float(np.median(np.hypot(u, v)))
    variance = max(noise_std(t, u), noise_std(t, v)) ** 2 + (speed * heading) ** 2
    walk = variance * float(np.median(steps)) if len(steps) else 0.0
    return Track(t, integral(north), integral(east), None, walk, True)


def without_antenna(
    x_n: Array, y_n: Array, psi: Array, antenna: tuple[float, ...]
) -> tuple[Array, Array]:
    """Return positions of the body origin from those of the antenna.

    Parameters
    ----------
    x_n, y_n, psi : ndarray
        (N,) position of the antenna [m], heading [rad].
    antenna : tuple of float
        Antenna from the origin, forward and starboard [m].
    """
    north, east = body_to_ned(antenna[0], antenna[1], psi)
    return x_n - north, y_n - east


def path_length(track: Track, start: float, stop: float, scale: float) -> Quantity:
    """Return how far the ship travelled along its track.

    The positions are smoothed by a cubic spline; noise adds to the length of
    any track, and its mean share is taken off.

    Parameters
    ----------
    track : Track
    start, stop : float
        [s]
    scale : float
        Time over which the track changes its course [s].
    """
    from scipy.interpolate import BSpline

    pad = scale / 6
    k = np.flatnonzero((track.t >= start - pad) & (track.t <= stop + pad))
    t = track.t[k]
    if len(t) < 6 or stop <= start:
        north = np.interp([start, stop], track.t, track.x_n)
        east = np.interp([start, stop], track.t, track.y_n)
        way = math.hypot(float(np.diff(north)[0]), float(np.diff(east)[0]))
        return Quantity(way, (track.std or 0.0) * math.sqrt(2), "m")
    pieces = int(np.clip(math.ceil((t[-1] - t[0]) / (scale / 6)), 1, max(1, len(t) // 3 - 3)))
    inner = np.linspace(t[0], t[-1], pieces + 1)
    knots = np.concatenate([[inner[0]] * 3, inner, [inner[-1]] * 3])
    size = pieces + 3
    basis = BSpline(knots, np.eye(size), 3)
    design = np.asarray(basis(t))
    fits = [regress(design, value[k], track.std) for value in (track.x_n, track.y_n)]
    low, high = max(start, float(t[0])), min(stop, float(t[-1]))
    grid, weights = _gauss(low, high, 4 * pieces)
    rate = np.asarray(basis.derivative()(grid))
    north, east = (rate @ fit[0] for fit in fits)
    speed = np.maximum(np.hypot(north, east), 1e-12)
    variance = 0.0
    across = np.zeros_like(speed)
    for own, other, (_, covariance, _, _) in zip((north, east), (east, north), fits, strict=True):
        gradient = (weights * own / speed) @ rate
        variance += float(gradient @ covariance @ gradient)
        across += (other / speed) ** 2 * np.einsum("gi,ij,gj->g", rate, covariance, rate)
    # where the ship nearly stands the first-order correction would exceed the speed itself
    excess = np.minimum(across / (2 * speed), speed / 2)
    variance += track.walk * (stop - start)
    length = float(weights @ (speed - excess))
    return Quantity(length, math.sqrt(variance), "m", min(fit[2] for fit in fits))


def _gauss(start: float, stop: float, pieces: int) -> tuple[Array, Array]:
    nodes, weights = np.polynomial.legendre.leggauss(3)
    edges = np.linspace(start, stop, pieces + 1)
    half = np.diff(edges)[:, None] / 2
    middle = (edges[1:] + edges[:-1])[:, None] / 2
    return (middle + half * nodes).ravel(), (half * weights).ravel()
