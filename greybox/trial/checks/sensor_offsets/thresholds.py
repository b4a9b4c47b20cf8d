"""The least offsets that matter, and the largest that a ship can have."""

from __future__ import annotations

import numpy as np

from greybox.trial.checks.sensor_offsets.model import ARM, BIAS, CLOCKS, SIZE
from greybox.trial.raw_log import Array
from greybox.vessel.vessel import Vessel

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
