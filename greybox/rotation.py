"""The one rotation between body axes and north-east-down, in the plane.

References
----------
Fossen (2011), Handbook of Marine Craft Hydrodynamics and Motion Control, eq. 2.43:
the velocity over ground is R(ψ) ν.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import casadi as ca

Array = NDArray[np.float64]


def _cos_sin(psi: Any) -> tuple[Any, Any]:
    if hasattr(psi, "sparsity"):
        import casadi as ca

        return ca.cos(psi), ca.sin(psi)
    return np.cos(psi), np.sin(psi)


def _alike(psi: Any, *components: Any) -> tuple[Any, ...]:
    return components if hasattr(psi, "sparsity") else tuple(map(np.asarray, components))


@overload
def body_to_ned(forward: ca.SX, starboard: ca.SX, psi: ca.SX) -> tuple[ca.SX, ca.SX]: ...
@overload
def body_to_ned(
    forward: Array | float, starboard: Array | float, psi: Array | float
) -> tuple[Array, Array]: ...
def body_to_ned(forward: Any, starboard: Any, psi: Any) -> tuple[Any, Any]:
    """Return north and east components of vectors given in body axes.

    Parameters
    ----------
    forward, starboard : ndarray, float or SX
        (N,) components along the bow and to starboard, any unit; any shapes that go together.
    psi : ndarray, float or SX
        (N,) heading, clockwise from north [rad].

    Returns
    -------
    tuple of ndarray or SX
        North and east, (N,) each, in the unit of the components.
    """
    c, s = _cos_sin(psi)
    return _alike(psi, c * forward - s * starboard, s * forward + c * starboard)


@overload
def ned_to_body(north: ca.SX, east: ca.SX, psi: ca.SX) -> tuple[ca.SX, ca.SX]: ...
@overload
def ned_to_body(
    north: Array | float, east: Array | float, psi: Array | float
) -> tuple[Array, Array]: ...
def ned_to_body(north: Any, east: Any, psi: Any) -> tuple[Any, Any]:
    """Return components along the bow and to starboard of vectors given north and east.

    Parameters
    ----------
    north, east : ndarray, float or SX
        (N,) components, any unit; any shapes that go together.
    psi : ndarray, float or SX
        (N,) heading, clockwise from north [rad].

    Returns
    -------
    tuple of ndarray or SX
        Forward and starboard, (N,) each: the inverse of `body_to_ned`.
    """
    c, s = _cos_sin(psi)
    return _alike(psi, c * north + s * east, c * east - s * north)
