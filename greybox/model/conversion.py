"""Between discrete parameters and continuous-time quantities (Table 3.1).

A discrete parameter is Ts times a force coefficient over an inertia. Ratios of
inertias show in the ties of Table 3.1; their scale does not, so it takes a mass
and either a thrust law in newtons or an assumed added mass in surge.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.errors import StructureError
from greybox.model.structure import Structure

# added mass in surge as a share of the mass, where nothing better is known;
# slender-body values lie between 0.03 and 0.07 (Clarke, Gedling and Hine, 1983)
SURGE_ADDED_MASS = 0.05
# relative difference up to which a tie counts as held
_HELD = 0.1


@dataclass(frozen=True)
class Inertia:
    """Masses with added mass, the denominators of Table 3.1.

    Parameters
    ----------
    surge : float
        m − X_u̇ [kg]
    sway : float
        m − Y_v̇ [kg]
    yaw : float
        I_z − N_ṙ [kg m²]
    """

    surge: float
    sway: float
    yaw: float

    def of(self, state: str) -> float:
        """Return the inertia of one equation."""
        return {"u": self.surge, "v": self.sway, "r": self.yaw}[state]


@dataclass(frozen=True)
class Tie:
    """A relation that Table 3.1 implies between discrete parameters.

    ``holds`` is true when the two sides differ by no more than a tenth of the larger.
    """

    name: str
    left: float
    right: float
    holds: bool
    sentence: str


def to_continuous(
    theta: Mapping[str, float], structure: Structure, sample_time: float, inertia: Inertia
) -> dict[str, float]:
    """Return force coefficients from discrete parameters.

    Parameters
    ----------
    theta : mapping of str to float
        Discrete parameters by name.
    structure : Structure
    sample_time : float
        Ts [s].
    inertia : Inertia

    Returns
    -------
    dict of str to float
        Coefficient of each term [N per unit of the regressor, N m in yaw], with
        the sign of Table 3.1: ``θ = Ts C / inertia``.
    """
    return {
        t.name: theta[t.name] * inertia.of(t.state) / sample_time
        for t in structure.terms
        if t.name in theta
    }


def estimate_inertia(
    theta: Mapping[str, float],
    sample_time: float,
    *,
    mass: float,
    thrust_in_newtons: bool,
) -> Inertia:
    """Return the inertias that a mass and the input gains imply.

    Parameters
    ----------
    theta : mapping of str to float
        Discrete parameters; ``Xmu``, ``Ymu`` and ``Nmu`` are used.
    sample_time : float
        [s]
    mass : float
        m [kg]
    thrust_in_newtons : bool
        True: µ = 1, so m − X_u̇ = Ts/Xmu. False: m − X_u̇ = m (1 + `SURGE_ADDED_MASS`).

    Raises
    ------
    StructureError
        An input gain is missing, zero or negative: no mass is.

    References
    ----------
    Ljungberg (2020), Table 3.1.
    """
    gains = {n: theta.get(n, 0.0) for n in ("Xmu", "Ymu", "Nmu")}
    for name, gain in gains.items():
        if not gain > 0.0:
            raise StructureError(
                f"the inertias follow from the input gains Xmu, Ymu and Nmu, and {name} is "
                f"{gain:.4g}: "
                + (
                    "a force that moves the ship against itself has no inertia. Other terms with "
                    "inputs take its place, or a thruster has the wrong sign in the vessel file."
                    if gain < 0.0
                    else "the thrusters' own forces show no inertia in that direction."
                )
            )
    surge = sample_time / gains["Xmu"] if thrust_in_newtons else mass * (1 + SURGE_ADDED_MASS)
    return Inertia(surge, surge * gains["Xmu"] / gains["Ymu"], surge * gains["Xmu"] / gains["Nmu"])


def inertia_errors(
    gains: NDArray[np.float64], covariance: NDArray[np.float64], *, thrust_in_newtons: bool
) -> Inertia:
    """Return the standard errors of the inertias of `estimate_inertia`, as shares of them.

    Parameters
    ----------
    gains : ndarray
        (3,) ``Xmu``, ``Ymu`` and ``Nmu``.
    covariance : ndarray
        (3, 3) of them.
    thrust_in_newtons : bool
        Otherwise surge, of an assumed added mass, has no error.
    """
    relative = covariance / np.outer(gains, gains)
    # of the logarithms of the inertias by those of the gains
    slopes = -np.eye(3)
    if not thrust_in_newtons:
        slopes[:, 0] += 1.0
    errors = np.sqrt(np.maximum(np.diag(slopes @ relative @ slopes.T), 0.0))
    return Inertia(*map(float, errors))


def check_ties(theta: Mapping[str, float], sample_time: float) -> list[Tie]:
    """Compare the relations that Table 3.1 implies: Xvr·Yur = −Ts² and Ymu/Xmu = −Yur/Ts."""
    sides: list[tuple[str, float, float]] = []
    if "Xvr" in theta and "Yur" in theta:
        sides.append(("Xvr·Yur = −Ts²", theta["Xvr"] * theta["Yur"], -(sample_time**2)))
    if "Yur" in theta and "Ymu" in theta and theta.get("Xmu"):
        sides.append(
            ("Ymu/Xmu = −Yur/Ts", theta["Ymu"] / theta["Xmu"], -theta["Yur"] / sample_time)
        )
    ties = []
    for name, value, right in sides:
        holds = bool(abs(value - right) <= _HELD * max(abs(value), abs(right)))
        says = "holds" if holds else "does not hold: masses from Table 3.1 are only nominal"
        sentence = f"{name}: {value:.4g} against {right:.4g}, {says}."
        ties.append(Tie(name, value, float(right), holds, sentence))
    return ties


def to_prime(
    coefficients: Mapping[str, float],
    structure: Structure,
    *,
    length: float,
    speed: float,
    density: float = 1025.0,
) -> dict[str, float]:
    """Return non-dimensional prime coefficients of the hydrodynamic terms.

    A force is divided by ½ρU²L², a moment by ½ρU²L³, velocities by U and the yaw
    rate by U/L, so C′ = C · Π(scale of each factor) / (½ρU²L² or ½ρU²L³).

    Parameters
    ----------
    coefficients : mapping of str to float
        As `to_continuous` gives them; terms with inputs and those with bumps are left out.
    length, speed : float
        L [m] and U [m/s].
    density : float
        ρ [kg/m³].

    References
    ----------
    SNAME (1950); Fossen (2011), prime system I.
    """
    scale = {"u": speed, "v": speed, "uq": speed, "vq": speed, "r": speed / length}
    found = {}
    for term in structure.terms:
        known = all(f.signal in scale and not f.bump for f in term.factors)
        if term.name not in coefficients or not known:
            continue
        force = 0.5 * density * speed**2 * length ** (3 if term.state == "r" else 2)
        regressor = float(np.prod([scale[f.signal] for f in term.factors]))
        found[term.name] = coefficients[term.name] * regressor / force
    return found
