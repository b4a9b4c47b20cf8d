"""The kinematic relations of one log's channels, and the sensor offsets that may disturb them.

Seven parameters belong to the instruments: the clocks of ψ, u, v, r against that of the positions
(of r against ψ where there are none), the antenna's lever arm, and the heading bias. Residuals of
positions and heading, and their derivatives, are taken at given values of all. What is expected of
them, the least that matters of each, and the largest that a ship can have stand here too.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from greybox.numerics.robust import robust_deviation
from greybox.trial.checks.motion import Motion, denoise, integrate, slope, smooth, to_ned
from greybox.trial.raw_log import Array
from greybox.vessel.vessel import Vessel

# order of the parameters: lateness by channel [s], lever arm [m], heading bias [rad]
CLOCKS = ("psi", "u", "v", "r")
ARM = slice(len(CLOCKS), len(CLOCKS) + 2)
BIAS = len(CLOCKS) + 2
SIZE = BIAS + 1

# beyond this time a channel's own noise is averaged out [s]
_NOISE_WINDOW = 5.0
# in standard deviations: what is beyond is no noise, but a bad sample
_USUAL = 4.0
# samples that a cubic spline needs more than
_SPLINE = 3
# what is too small to matter: [s], [rad], [m] and share of the ship's length
LEAST_CLOCK = 0.1
LEAST_HEADING = np.radians(0.75)
_LEAST_ARM = (0.1, 0.02)
# standard errors that prove an offset: one chance in a thousand
SIGMAS = 3.3
# an antenna stands on the ship: from the body origin no further than this [ship lengths]
_MOST_ARM = 0.8
# a logger or a filter delays by less [s]
MOST_LATE = 5.0
# logs that differ by less than so many times what matters may do so by misfit: one campaign
CAMPAIGN = 5.0
# what is expected before a log is read, standard deviations: [s], [ship lengths], [rad]; what a
# log cannot tell stays near nothing, where noise alone would lead it astray
_PRIOR = (2.0, 0.3, 0.15)


@dataclass(frozen=True)
class Residuals:
    """Residuals of one log at given offsets, and minus their derivatives.

    Derivatives by the offsets have no columns where they were not asked for.

    Parameters
    ----------
    position : ndarray
        (N, 2) measured minus dead-reckoned position [m]; no rows where the log has none.
    heading : ndarray
        (N,) measured heading minus integrated yaw rate [rad].
    position_columns, heading_columns : ndarray
        (N, 2, `SIZE`) and (N, `SIZE`): minus the derivatives by the offsets.
    position_own, heading_own : ndarray
        (N, 2, 4) and (N, 2): those by what each log has of its own: a constant velocity of the
        water, a scale of the velocities and a delay of east against north; a bias and a scale of
        the yaw rate.
    """

    position: Array
    heading: Array
    position_columns: Array
    heading_columns: Array
    position_own: Array
    heading_own: Array


class KinematicModel:
    """Residuals of positions and heading of one log for given offsets."""

    def __init__(self, motion: Motion) -> None:
        self.motion = motion
        self.positioned, self.turned = motion.positioned, motion.turned
        self.smooth = {
            n: denoise(v, motion) for n, v in motion.values.items() if n not in ("x_n", "y_n")
        }
        self.drift = (motion.t - motion.t[0]) / max(float(np.ptp(motion.t)), 1e-9)
        self._channels: dict[str, _Channel] = {}
        self.align(np.zeros(SIZE))

    @property
    def free(self) -> NDArray[np.int64]:
        """Parameters that the channels of this log can show."""
        clocks = ("psi", "u", "v") if self.positioned else ()
        names = [*clocks, *(["r"] if self.turned else [])]
        found = [CLOCKS.index(n) for n in names]
        return np.array(found + ([*range(ARM.start, SIZE)] if self.positioned else []))

    def align(self, offsets: Array) -> None:
        """Take the noise-free heading as it is at some offsets: its fast part is the rate's."""
        if not self.turned:
            return
        behind = offsets[CLOCKS.index("psi")] - offsets[CLOCKS.index("r")]
        whole = integrate(self.smooth["r"], self.motion)
        swept = _Channel(whole, whole, self.motion).slow(-behind)
        seconds = max(_NOISE_WINDOW, 5 * self.motion.step)
        self.smooth["psi"] = swept + smooth(self.motion["psi"] - swept, self.motion, seconds)
        self._channels.pop("psi", None)

    def residuals(self, offsets: Array, *, derivatives: bool = True) -> Residuals:
        """Return residuals and minus their derivatives at some offsets (`SIZE`,).

        Parameters
        ----------
        offsets : ndarray
            (`SIZE`,)
        derivatives : bool
            Whether those by the offsets are wanted.
        """
        m = self.motion
        n = len(m)
        late = self._late(offsets)
        slow = {k: self._channel(k).slow(late[k]) for k in CLOCKS if k in m}
        now = {k: slow[k] + self._channel(k).noise(late[k]) for k in slow}
        rate = {k: slope(v, m) for k, v in slow.items()} if derivatives else {}
        size = SIZE if derivatives else 0
        position, columns, own = np.zeros((n, 2)), np.zeros((n, 2, size)), np.zeros((n, 2, 4))
        if self.positioned:
            bias, arm = offsets[BIAS], offsets[ARM]
            psi = slow["psi"] - bias
            lever = to_ned(psi, np.full(n, arm[0]), np.full(n, arm[1]))
            seconds = max(_NOISE_WINDOW, 5 * m.step)
            steady = to_ned(psi, smooth(slow["u"], m, seconds), smooth(slow["v"], m, seconds))
            walked = to_ned(now["psi"] - bias, now["u"], now["v"])
            velocity = to_ned(psi, slow["u"], slow["v"])
            ways = [walked, steady]
            if derivatives:
                across = np.column_stack([-velocity[:, 1], velocity[:, 0]])
                turning = rate["psi"][:, None]
                ahead = to_ned(psi, rate["u"], np.zeros(n))
                aside = to_ned(psi, np.zeros(n), rate["v"])
                ways += [ahead, aside, across * turning, across]
            ways = np.split(integrate(np.hstack(ways), m), len(ways), axis=1)
            position = np.column_stack([m["x_n"], m["y_n"]]) - ways[0] - lever
            if derivatives:
                levered = np.column_stack([-lever[:, 1], lever[:, 0]])
                columns[:, :, CLOCKS.index("u")] = ways[2]
                columns[:, :, CLOCKS.index("v")] = ways[3]
                columns[:, :, CLOCKS.index("psi")] = ways[4] + levered * turning
                columns[:, :, ARM.start] = to_ned(psi, np.ones(n), np.zeros(n))
                columns[:, :, ARM.start + 1] = to_ned(psi, np.zeros(n), np.ones(n))
                columns[:, :, BIAS] = -ways[5] - levered
            own[:, 0, 0] = own[:, 1, 1] = self.drift
            own[:, :, 2] = ways[1]
            # one receiver has one clock, but axes that are not square, as of a local grid, look
            # like two in a turn: their mean is compared with the other clocks
            own[:, :, 3] = velocity * np.array([-0.5, 0.5])
        heading, swept, gyro = np.zeros(n), np.zeros((n, size)), np.zeros((n, 2))
        if self.turned:
            rates = [now["r"], slow["r"], *([rate["r"]] if derivatives else [])]
            both = integrate(np.column_stack(rates), m)
            heading = now["psi"] - both[:, 0]
            if derivatives:
                if self.positioned:
                    swept[:, CLOCKS.index("psi")] = -rate["psi"]
                swept[:, CLOCKS.index("r")] = both[:, 2]
            gyro[:, 0], gyro[:, 1] = self.drift, both[:, 1]
        return Residuals(position, heading, columns, swept, own, gyro)

    def _late(self, offsets: Array) -> dict[str, float]:
        late = {n: float(x) for n, x in zip(CLOCKS, offsets[: len(CLOCKS)], strict=True)}
        return late if self.positioned else late | {"psi": 0.0}

    def _channel(self, name: str) -> _Channel:
        if name not in self._channels:
            self._channels[name] = _Channel(self.motion[name], self.smooth[name], self.motion)
        return self._channels[name]


class _Channel:
    """One channel as it would be were it not late: its noise-free part, and its noise.

    Noise is moved in the frequency domain: interpolation between samples would shrink it, and so
    seem to explain it, and noise that stays behind seems to be a motion that comes late.
    """

    def __init__(self, value: Array, smooth: Array, motion: Motion) -> None:
        # SciPy's splines take a while to load
        from scipy.interpolate import CubicSpline

        self.smooth, self.motion = smooth, motion
        self.splines, self.spectra, self.spikes = [], [], []
        for a, b in motion.stretches:
            t, noise = motion.t[a:b], value[a:b] - smooth[a:b]
            usual = _USUAL * robust_deviation(noise)
            # a single bad sample would ring
            body = np.clip(noise, -usual, usual)
            self.splines.append(
                CubicSpline(t, smooth[a:b])
                if b - a > _SPLINE
                else partial(np.interp, xp=t, fp=smooth[a:b])
            )
            self.spectra.append(np.fft.rfft(body))
            self.spikes.append(noise - body)

    def slow(self, late: float) -> Array:
        """Return the noise-free part (N,), straight beyond the ends of each stretch."""
        if late == 0.0:
            return self.smooth
        out = np.empty_like(self.smooth)
        for (a, b), spline in zip(self.motion.stretches, self.splines, strict=True):
            t, value = self.motion.t[a:b], self.smooth[a:b]
            at, moved = t + late, out[a:b]
            moved[:] = spline(at)
            reach = min(5, b - a - 1)
            for inside, k, j in ((at < t[0], 0, reach), (at > t[-1], -1, -1 - reach)):
                rate = (value[k] - value[j]) / (t[k] - t[j])
                moved[inside] = value[k] + rate * (at[inside] - t[k])
        return out

    def noise(self, late: float) -> Array:
        """Return the noise (N,), its power kept, bad samples moved by whole ones."""
        out = np.empty_like(self.smooth)
        samples = late / self.motion.step
        for k, (a, b) in enumerate(self.motion.stretches):
            shift = np.exp(2j * np.pi * np.fft.rfftfreq(b - a) * samples)
            out[a:b] = np.fft.irfft(self.spectra[k] * shift, b - a)
            out[a:b] += np.roll(self.spikes[k], -round(samples))
        return out


def least(vessel: Vessel) -> Array:
    """Return what matters of each offset, (`SIZE`,)."""
    out = np.full(SIZE, LEAST_CLOCK)
    out[ARM] = least_arm(vessel)
    out[BIAS] = LEAST_HEADING
    return out


def least_arm(vessel: Vessel) -> float:
    """Return the lever arm that matters [m]."""
    return _LEAST_ARM[0] + _LEAST_ARM[1] * vessel.length


def most_arm(vessel: Vessel) -> float:
    """Return the distance from the body origin beyond which no antenna stands [m]."""
    return _MOST_ARM * vessel.length


def expected(vessel: Vessel) -> Array:
    """Return what is expected of each offset and the inverse variance of that, (2, `SIZE`)."""
    std = np.empty(SIZE)
    std[: len(CLOCKS)], std[ARM], std[BIAS] = _PRIOR[0], _PRIOR[1] * vessel.length, _PRIOR[2]
    centre = np.zeros(SIZE)
    centre[ARM] = vessel.sensors.get("antenna", (0.0, 0.0))[:2]
    return np.array([centre, std**-2])
