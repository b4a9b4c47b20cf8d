"""Body velocities from the positions against those that were logged, for pictures.

The checks judge a log by integrated residuals; a reader sees the same defect
better in velocities. Both sides are smoothed alike, so that smoothing itself
parts them only where the ship turns within a few samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.numerics.robust import white_noise
from greybox.rotation import body_to_ned, ned_to_body
from greybox.trial.checks.motion import Motion, smooth, to_ned

Array = NDArray[np.float64]

# noise that a derivative may keep, as a share of what it measures
_NOISE = 0.01
_ENDS = 1.5


@dataclass(frozen=True)
class Widths:
    """Standard deviations [s] of the Gaussians that positions and headings are smoothed by."""

    position: float
    heading: float

    def times(self, factor: float) -> Widths:
        """Return them multiplied by a factor."""
        return Widths(self.position * factor, self.heading * factor)


@dataclass(frozen=True)
class Smoothed:
    """Smoothed signals of one time grid, from which both velocities are computed.

    Parameters
    ----------
    t : ndarray
        (N,) [s].
    step : float
        [s]
    rates : dict of str to ndarray
        (N,) each: ``x_n``, ``y_n`` velocities of the antenna [m/s], ``psi``
        heading [rad], ``turn`` its rate [rad/s], ``u``, ``v``, ``r`` as logged.
    stretches : tuple of (start, stop)
    valid : ndarray of bool
        (N,) away from the ends of the stretches.
    """

    t: Array
    step: float
    rates: Mapping[str, Array]
    stretches: tuple[tuple[int, int], ...]
    valid: NDArray[np.bool_]

    @property
    def pairs(self) -> tuple[str, ...]:
        """Names of what can be compared."""
        found = ("u", "v") if {"x_n", "y_n", "psi", "u", "v"} <= self.rates.keys() else ()
        return (*found, "r") if {"psi", "r"} <= self.rates.keys() else found


@dataclass(frozen=True)
class Agreement:
    """Logged velocities beside those that positions and heading imply.

    Parameters
    ----------
    t : ndarray
        (N,) [s].
    logged, implied : dict of str to ndarray
        (N,) of those of ``u, v`` [m/s] and ``r`` [rad/s] that can be compared; NaN
        near the ends of stretches.
    turn : ndarray
        (N,) rate of the heading [rad/s].
    psi : ndarray
        (N,) heading [rad].
    """

    t: Array
    logged: Mapping[str, Array]
    implied: Mapping[str, Array]
    turn: Array
    psi: Array

    def rms(self, name: str) -> float:
        """Return the root mean square disagreement, over the whole log."""
        gap = self.implied[name] - self.logged[name]
        return float(np.sqrt(np.nanmean(gap**2))) if np.isfinite(gap).any() else float("nan")


def find_widths(motion: Motion) -> Widths:
    """Choose the least smoothing after which derivatives have little noise.

    Parameters
    ----------
    motion : Motion
        Mended.
    """
    h = motion.step
    longest = max(b - a for a, b in motion.stretches) * h
    most = max(longest / 20, h)
    position = heading = h
    if "x_n" in motion and "y_n" in motion:
        way = np.hypot(np.diff(smooth(motion["x_n"], motion, 2 * h)) / h,
                       np.diff(smooth(motion["y_n"], motion, 2 * h)) / h)  # fmt: skip
        noise = max(_noise(motion, n) for n in ("x_n", "y_n"))
        position = _width(noise, float(np.median(way)), h)
    if "psi" in motion:
        rate = np.diff(smooth(motion["psi"], motion, 3 * h)) / h
        # jumps between stretches are no turns
        heading = _width(_noise(motion, "psi"), 2 * float(np.quantile(np.abs(rate), 0.9)), h)
    return Widths(min(position, most), min(heading, most))


def _noise(motion: Motion, name: str) -> float:
    """Return the standard deviation of white noise from third differences."""
    parts = [motion[name][a:b] for a, b in motion.stretches]
    return white_noise(parts) or 0.0


def _width(noise: float, size: float, step: float) -> float:
    # a Gaussian derivative of width w keeps noise² h / (4 √π w³)
    wanted = (_NOISE * max(size, 1e-12)) ** 2
    cube = noise**2 * step / (4 * np.sqrt(np.pi) * wanted)
    return float(max(cube ** (1 / 3), step))


def smoothed(motion: Motion, widths: Widths, guide: Motion) -> Smoothed:
    """Return the derivatives of positions and heading, and the velocities, smoothed alike.

    Parameters
    ----------
    motion : Motion
    widths : Widths
    guide : Motion
        The mended one. Its heading turns the velocities north and east while they
        are smoothed, as the positions are, or a turn would part the two.
    """
    rates: dict[str, Array] = {}
    for name in ("x_n", "y_n"):
        if name in motion:
            rates[name] = _derivative(smooth(motion[name], motion, widths.position), motion)
    if "u" in motion and "v" in motion and "psi" in guide:
        psi = np.interp(motion.t, guide.t, guide["psi"])
        slow = smooth(psi, motion, widths.heading)
        over = to_ned(psi, motion["u"], motion["v"])
        north, east = (smooth(over[:, k], motion, widths.position) for k in (0, 1))
        back = to_ned(-slow, north, east)
        rates["u"], rates["v"] = back[:, 0], back[:, 1]
    if "psi" in motion:
        rates["psi"] = smooth(motion["psi"], motion, widths.heading)
        rates["turn"] = _derivative(rates["psi"], motion)
    if "r" in motion:
        rates["r"] = smooth(motion["r"], motion, widths.heading)
    valid = np.zeros(len(motion), bool)
    for a, b in motion.stretches:
        edge = int(_ENDS * max(widths.position, widths.heading) / motion.step) + 1
        edge = min(edge, (b - a) // 4)
        valid[a + edge : b - edge] = True
    return Smoothed(motion.t, motion.step, rates, motion.stretches, valid)


def shifted(motion: Motion, channels: tuple[str, ...], late: float) -> Motion:
    """Return what a motion would be with some channels `late` seconds earlier."""
    values = dict(motion.values)
    for name in channels:
        if name in values:
            parts = [
                np.interp(motion.t[a:b] + late, motion.t[a:b], values[name][a:b])
                for a, b in motion.stretches
            ]
            values[name] = np.concatenate(parts)
    return Motion(motion.t, motion.step, values, motion.stretches)


def _derivative(value: Array, motion: Motion) -> Array:
    out = np.empty_like(value)
    for a, b in motion.stretches:
        out[a:b] = np.gradient(value[a:b], motion.step)
    return out


def compare(
    parts: Smoothed,
    antenna: tuple[float, float] = (0.0, 0.0),
    drift: tuple[float, float] = (0.0, 0.0),
) -> Agreement:
    """Compare logged velocities with those that positions and heading imply.

    Parameters
    ----------
    parts : Smoothed
    antenna : tuple of float
        Where the positions are taken to be measured, forward and starboard [m].
    drift : tuple of float
        Constant velocity of the water, north and east [m/s], which the positions
        have and the velocities lack.
    """
    rates, away = parts.rates, ~parts.valid
    psi = rates.get("psi", np.zeros(len(parts.t)))
    turning = rates.get("turn", np.zeros(len(parts.t)))
    logged: dict[str, Array] = {}
    implied: dict[str, Array] = {}
    for name in parts.pairs:
        if name == "r":
            value = turning
        else:
            north, east = rates["x_n"] - drift[0], rates["y_n"] - drift[1]
            u, v = ned_to_body(north, east, psi)
            value = u + antenna[1] * turning if name == "u" else v - antenna[0] * turning
        logged[name] = np.where(away, np.nan, rates[name])
        implied[name] = np.where(away, np.nan, value)
    return Agreement(parts.t, logged, implied, turning, psi)


def constant_drift(agreement: Agreement) -> tuple[float, float]:
    """Return the mean velocity, north and east [m/s], that only the positions have.

    The velocities of a log through water lack the current; the checks allow for
    one, so must their pictures. Zero where it is within the scatter.
    """
    if "u" not in agreement.logged:
        return 0.0, 0.0
    along, across = (agreement.implied[n] - agreement.logged[n] for n in ("u", "v"))
    north, east = map(np.nanmean, body_to_ned(along, across, agreement.psi))
    scatter = np.hypot(np.nanstd(along), np.nanstd(across))
    speed = np.sqrt(np.nanmean(agreement.logged["u"] ** 2 + agreement.logged["v"] ** 2))
    size = np.hypot(north, east)
    if not np.isfinite(size) or size < max(0.3 * scatter, 0.02 * speed):
        return 0.0, 0.0
    return float(north), float(east)
