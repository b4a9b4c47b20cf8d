"""Parametrised command sequences within a vessel's limits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from greybox.errors import VesselError
from greybox.trial.log import TrialLog, make_log
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]


def command_ranges(vessel: Vessel) -> dict[str, tuple[float, float]]:
    """Return the range of each command.

    Raises
    ------
    VesselError
        A command has no limits in the vessel file.
    """
    ranges = {}
    for name, limits in vessel.limits.items():
        if limits.lower is None or limits.upper is None:
            raise VesselError(
                f"'{name}' has no limits, and a sequence must stay within some: add "
                f"speed_limits or angle_limits to its thruster in the vessel file."
            )
        ranges[name] = (limits.lower, limits.upper)
    return ranges


def _held(levels: Array, hold: int, samples: int) -> Array:
    return np.asarray(np.repeat(levels, hold)[:samples])


def random_two_level(
    vessel: Vessel, samples: int, hold: int, rng: np.random.Generator
) -> dict[str, Array]:
    """Draw each command at one of its limits, changing every `hold` samples.

    Parameters
    ----------
    vessel : Vessel
        With limits for every command.
    samples, hold : int
        N, and samples between changes.
    rng : numpy.random.Generator

    Returns
    -------
    dict of str to ndarray
        (N,) a command: speeds in the log's unit, angles [rad].
    """
    count = -(-samples // hold)
    return {
        name: _held(np.where(rng.random(count) < 0.5, low, high), hold, samples)
        for name, (low, high) in command_ranges(vessel).items()
    }


def prbs(vessel: Vessel, samples: int, hold: int, *, bits: int = 9) -> dict[str, Array]:
    """Return pseudo-random binary sequences, each command with its own shift of one period.

    Parameters
    ----------
    bits : int
        Register length; the period is 2**bits − 1 holds.

    References
    ----------
    Söderström and Stoica (1989), section 5.3: maximum-length sequences.
    """
    from scipy.signal import max_len_seq

    sequence = max_len_seq(bits)[0].astype(float)
    ranges = command_ranges(vessel)
    count = -(-samples // hold)
    out = {}
    for i, (name, (low, high)) in enumerate(ranges.items()):
        shifted = np.roll(sequence, i * len(sequence) // len(ranges))
        levels = np.resize(shifted, count)
        out[name] = _held(low + (high - low) * levels, hold, samples)
    return out


def to_log(vessel: Vessel, commands: Mapping[str, Array], sample_time: float) -> TrialLog:
    """Return commands as a log without measurements, to be simulated.

    Parameters
    ----------
    commands : mapping of str to ndarray
        (N,) each command of the vessel.
    sample_time : float
        [s]
    """
    return make_log(vessel, commands, sample_time, "plan")
