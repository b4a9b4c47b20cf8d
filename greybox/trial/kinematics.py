"""From what sensors give to what models need: velocities and sample time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]


def velocities_from_positions(
    x_n: Array,
    y_n: Array,
    psi: Array,
    sample_time: float,
    *,
    heading_std: float = 0.0,
    antenna: tuple[float, ...] = (0.0, 0.0),
) -> tuple[Array, Array, Array]:
    """Estimate body velocities from positions and heading by central differences.

    Parameters
    ----------
    x_n, y_n : ndarray
        (N,) position of the antenna, north and east [m].
    psi : ndarray
        (N,) heading, unwrapped [rad].
    sample_time : float
        Ts [s].
    heading_std : float
        Standard deviation of the heading noise [rad]; its shrinking of u and v
        by ρ = exp(−λ/2) is divided out.
    antenna : tuple of float
        Position of the antenna from the body origin, forward and starboard [m].

    Returns
    -------
    tuple of ndarray
        u, v [m/s] at the body origin and r [rad/s], (N,) each; the first and
        last sample are one-sided.

    References
    ----------
    Ljungberg (2020), eq. 3.57 (with Rᵀ, from n-frame differences to the body
    frame) and 3.64.
    """

    def rate(value: Array) -> Array:
        return np.asarray(np.gradient(value, sample_time))

    north, east, r = rate(x_n), rate(y_n), rate(psi)
    c, s = np.cos(psi), np.sin(psi)
    rho = np.exp(-(heading_std**2) / 2)
    u, v = (c * north + s * east) / rho, (-s * north + c * east) / rho
    return u + r * antenna[1], v - r * antenna[0], r


def decimate(log: TrialLog, sample_time: float) -> TrialLog:
    """Return the log at a longer sample time.

    Positions, heading and wind are averaged over the interval around each new
    sample; velocities are taken anew from positions where they were derived,
    else averaged alike; inputs are averaged over the interval that follows,
    which is what the ship then feels.

    Parameters
    ----------
    log : TrialLog
    sample_time : float
        A whole multiple of the log's own [s].

    Returns
    -------
    TrialLog

    Raises
    ------
    LogError
        It is not a multiple, or fewer than three samples would remain.
    """
    ratio = sample_time / log.sample_time
    step = round(ratio)
    if step < 1 or abs(ratio - step) > 0.01 * step:
        raise LogError(
            f"a sample time of {sample_time:g} s is {ratio:.3g} times the {log.sample_time:g} s "
            f"of '{log.name}': choose a whole multiple."
        )
    if step == 1:
        return log
    half = step // 2
    centres = np.arange(half, len(log) - step, step)
    if len(centres) < 3:
        raise LogError(
            f"'{log.name}' keeps {len(centres)} samples at {sample_time:g} s, at least 3 are "
            f"needed: choose a shorter sample time."
        )
    sums = {k: np.concatenate([[0.0], np.cumsum(v)]) for k, v in log.channels.items()}
    channels: dict[str, Array] = {}
    inputs = set(log.vessel.recorded_columns)
    for name, total in sums.items():
        first = centres if name in inputs else centres - half
        channels[name] = (total[first + step] - total[first]) / step
        if name not in inputs and step % 2 == 0:
            # an even window has no middle sample: halve its two ends
            last = centres + half
            value = log.channels[name]
            channels[name] += (value[last] - value[centres - half]) / (2 * step)
    derived = any(d.startswith("u, v") for d in log.provenance.derived)
    if derived:
        channels["u"], channels["v"], r = velocities_from_positions(
            channels["x_n"],
            channels["y_n"],
            channels["psi"],
            sample_time,
            heading_std=log.vessel.std("psi") or 0.0,
            antenna=log.vessel.sensors.get("antenna", (0.0, 0.0)),
        )
        if any("r from" in d for d in log.provenance.derived):
            channels["r"] = r
    note = f"decimated from {log.sample_time:g} s to {sample_time:g} s"
    out = replace(
        log,
        sample_time=sample_time,
        t=log.t[centres],
        channels=channels,
        closed_loop=log.closed_loop[centres],
        provenance=replace(log.provenance, derived=(*log.provenance.derived, note)),
    )
    return replace(out.window(1, len(out) - 1), name=log.name) if derived else out
