"""Physical masses and derivatives of a model, as text (Table 3.1)."""

from __future__ import annotations

import numpy as np

from greybox.errors import StructureError
from greybox.model.conversion import (
    SURGE_ADDED_MASS,
    check_ties,
    estimate_inertia,
    inertia_errors,
    to_continuous,
    to_prime,
)
from greybox.model.model import ManoeuvringModel


def physical_summary(model: ManoeuvringModel, mass: float, speed: float | None = None) -> str:
    """Return masses, force coefficients and prime coefficients of a model.

    Parameters
    ----------
    model : ManoeuvringModel
    mass : float
        m [kg]
    speed : float, optional
        U of the prime coefficients [m/s]; by default √(g L)/4, a usual service
        Froude number.
    """
    theta = dict(zip(model.names, map(float, model.theta), strict=True))
    newtons = model.force_unit == "N"
    try:
        inertia = estimate_inertia(theta, model.sample_time, mass=mass, thrust_in_newtons=newtons)
    except StructureError as error:
        return f"Physical quantities: not available, because {error}"
    gains = [model.names.index(n) for n in ("Xmu", "Ymu", "Nmu")]
    errors = inertia_errors(
        model.theta[gains], model.covariance[np.ix_(gains, gains)], thrust_in_newtons=newtons
    )

    def shown(state: str, unit: str) -> str:
        error = 100 * errors.of(state)
        return f"{inertia.of(state):.4g} {unit}" + (f" ± {error:.2g} %" if error else "")

    length = model.vessel.length
    usual = " of a usual Froude number, 0.25" if speed is None else ""
    speed = (9.81 * length) ** 0.5 / 4 if speed is None else speed
    coefficients = to_continuous(theta, model.structure, model.sample_time, inertia)
    primes = to_prime(coefficients, model.structure, length=length, speed=speed)
    how = (
        "from the thrust law in newtons"
        if newtons
        else f"with an assumed added mass in surge of {100 * SURGE_ADDED_MASS:.0f} % of the mass"
    )
    lines = [
        f"Physical quantities for m = {mass:g} kg, {how}:",
        f"  m − X_u̇ = {shown('u', 'kg')}, m − Y_v̇ = {shown('v', 'kg')}, "
        f"I_z − N_ṙ = {shown('r', 'kg m²')}"
        + (" (± one standard error)" if any(map(errors.of, "uvr")) else ""),
        f"  {'coefficient':<14}{'value':>13}{'prime':>13}   (SI; prime with L = {length:g} m, "
        f"U = {speed:.2f} m/s{usual})",
    ]
    for name, value in coefficients.items():
        prime = f"{primes[name]:>13.4g}" if name in primes else f"{'':>13}"
        lines.append(f"  {model.label(name):<14}{value:>13.4g}{prime}")
    lines += [f"  {tie.sentence}" for tie in check_ties(theta, model.sample_time)]
    return "\n".join(lines)
