"""The one rotation between body axes and north-east-down, in the plane.

References
----------
Fossen (2011), Handbook of Marine Craft Hydrodynamics and Motion Control, eq. 2.43:
the velocity over ground is R(ψ) ν.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def body_to_ned(
    forward: Array | float, starboard: Array | float, psi: Array | float
) -> tuple[Array, Array]:
    """Return north and east components of vectors given in body axes.

    Parameters
    ----------
    forward, starboard : ndarray or float
        (N,) components along the bow and to starboard, any unit; any shapes that go together.
    psi : ndarray or float
        (N,) heading, clockwise from north [rad].

    Returns
    -------
    tuple of ndarray
        North and east, (N,) each, in the unit of the components.
    """
    c, s = np.cos(psi), np.sin(psi)
    return np.asarray(c * forward - s * starboard), np.asarray(s * forward + c * starboard)


def ned_to_body(
    north: Array | float, east: Array | float, psi: Array | float
) -> tuple[Array, Array]:
    """Return components along the bow and to starboard of vectors given north and east.

    Parameters
    ----------
    north, east : ndarray or float
        (N,) components, any unit; any shapes that go together.
    psi : ndarray or float
        (N,) heading, clockwise from north [rad].

    Returns
    -------
    tuple of ndarray
        Forward and starboard, (N,) each: the inverse of `body_to_ned`.
    """
    c, s = np.cos(psi), np.sin(psi)
    return np.asarray(c * north + s * east), np.asarray(c * east - s * north)
