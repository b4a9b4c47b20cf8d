"""Command sequences in unit coordinates, and sequences as logs.

A sequence of K holds for nc commands is an array (K, nc) with 0 at each
command's lower limit and 1 at its upper one.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from greybox.trial.log import TrialLog, make_log
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]


def random_two_level(holds: int, commands: int, count: int, rng: np.random.Generator) -> Array:
    """Draw each command at one of its limits in each hold.

    Parameters
    ----------
    holds, commands : int
        K and nc.
    count : int
        Sequences to draw.
    rng : numpy.random.Generator

    Returns
    -------
    ndarray
        (count, K, nc) 0 at the lower limit, 1 at the upper one.
    """
    return np.asarray((rng.random((count, holds, commands)) < 0.5).astype(float))


def random_pulses(holds: int, commands: int, count: int, rng: np.random.Generator) -> Array:
    """Draw levels uniformly between the limits, (count, K, nc)."""
    return rng.random((count, holds, commands))


def prbs(holds: int, commands: int, bits: tuple[int, ...] = (4, 5, 6, 7, 8, 9, 10)) -> Array:
    """Return maximum-length sequences, each command with its own shift.

    Parameters
    ----------
    holds, commands : int
        K and nc.
    bits : tuple of int
        Register lengths; the period is 2**bits − 1 holds.

    Returns
    -------
    ndarray
        (len(bits), K, nc) 0 at the lower limit, 1 at the upper one.

    References
    ----------
    Söderström and Stoica (1989), section 5.3.
    """
    # SciPy's signals take a while to load
    from scipy.signal import max_len_seq

    found = []
    for length in bits:
        sequence = max_len_seq(length)[0].astype(float)
        columns = [
            np.resize(np.roll(sequence, i * len(sequence) // commands), holds)
            for i in range(commands)
        ]
        found.append(np.column_stack(columns))
    return np.array(found)


def multisines(holds: int, commands: int, count: int, rng: np.random.Generator) -> Array:
    """Return sums of sines sampled at the holds, with random phases, (count, K, nc).

    Each command has its own harmonics of the trial, so that they do not overlap,
    and is scaled to its limits.

    References
    ----------
    Pintelon and Schoukens (2012), section 5.3.
    """
    k = np.arange(holds)
    highest = max(commands, min(holds // 2, 12 * commands))
    out = np.empty((count, holds, commands))
    for c in range(commands):
        harmonics = np.arange(c + 1, highest + 1, commands)
        phase = rng.uniform(0, 2 * np.pi, (count, len(harmonics)))
        angle = 2 * np.pi * harmonics[None, :, None] * k / holds + phase[..., None]
        wave = np.cos(angle).sum(axis=1)
        low, high = wave.min(axis=1, keepdims=True), wave.max(axis=1, keepdims=True)
        out[..., c] = (wave - low) / np.maximum(high - low, 1e-12)
    return out


def zig_zags(holds: int, vessel: Vessel) -> Array:
    """Return square waves of the steering commands at steady speed, (count, K, nc).

    Thrusters ahead and astern of midship steer against each other; half periods
    go from one hold to a quarter of the trial, at half and full speed and helm.
    """
    side: dict[str, float] = {}
    for t in vessel.thrusters:
        if isinstance(t.angle, str):
            side[t.angle] = 1.0 if t.x >= 0 else -1.0
        if t.rudder is not None:
            side[t.rudder] = 1.0
        if t.type == "tunnel":
            side[t.speed] = 1.0 if t.x >= 0 else -1.0
    k = np.arange(holds)
    found = []
    for half in sorted({h for h in (1, 2, 3, 4, 6, 8, 12, holds // 4) if 1 <= h <= holds // 2}):
        wave = np.where((k // half) % 2 == 0, 1.0, -1.0)
        for speed in (1.0, 0.5):
            for share in (1.0, 0.5):
                unit = np.full((holds, len(vessel.commands)), speed)
                for i, name in enumerate(vessel.commands):
                    if name in side:
                        unit[:, i] = 0.5 + 0.5 * share * side[name] * wave
                found.append(unit)
    return np.array(found)


def to_log(vessel: Vessel, commands: Mapping[str, Array], sample_time: float) -> TrialLog:
    """Return commands as a log without measurements, to be simulated.

    Parameters
    ----------
    vessel : Vessel
    commands : mapping of str to ndarray
        (N,) each command of the vessel.
    sample_time : float
        [s]

    Returns
    -------
    TrialLog
    """
    return make_log(vessel, commands, sample_time, "plan")
