"""Make `shipmmg_kvlcc2.json`: turns and zig-zags of the KVLCC2 model by shipmmg.

shipmmg 0.0.9 asks for NumPy below 2 and a SciPy that still has `scipy.misc`, so it has an
environment of its own::

    python -m venv venv && venv/bin/pip install shipmmg==0.0.9 "scipy<1.12"
    venv/bin/python tests/foreign_ships/reference/make_shipmmg.py

shipmmg takes the drift angle at the centre of gravity and turns v to it with the other sign
than its equations of motion have, so there is a set with the centre at midship (which must
agree) and one with it where it is.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from shipmmg.mmg_3dof import (
    Mmg3DofBasicParams,
    Mmg3DofManeuveringParams,
    simulate_mmg_3dof,
    zigzag_test_mmg_3dof,
)

FILE = Path(__file__).with_name("shipmmg_kvlcc2.json")
RHO, LENGTH, DRAUGHT, SPEED, REVOLUTIONS = 1000.0, 7.0, 0.46, 1.179, 11.8
HULL = Mmg3DofManeuveringParams(
    k_0=0.2931,
    k_1=-0.2753,
    k_2=-0.1385,
    R_0_dash=0.022,
    X_vv_dash=-0.040,
    X_vr_dash=0.002,
    X_rr_dash=0.011,
    X_vvvv_dash=0.771,
    Y_v_dash=-0.315,
    Y_r_dash=0.083,
    Y_vvv_dash=-1.607,
    Y_vvr_dash=0.379,
    Y_vrr_dash=-0.391,
    Y_rrr_dash=0.008,
    N_v_dash=-0.137,
    N_r_dash=-0.049,
    N_vvv_dash=-0.030,
    N_vvr_dash=-0.294,
    N_vrr_dash=0.055,
    N_rrr_dash=-0.013,
)


def ship(x_G: float) -> Mmg3DofBasicParams:
    """Return the particulars with the centre of gravity at `x_G` [m]."""
    unit = RHO / 2 * LENGTH**2 * DRAUGHT
    mass = RHO * 3.27
    return Mmg3DofBasicParams(
        L_pp=LENGTH,
        B=1.27,
        d=DRAUGHT,
        x_G=x_G,
        D_p=0.216,
        m=mass,
        I_zG=mass * (0.25 * LENGTH) ** 2,
        A_R=0.0539,
        η=0.626,
        m_x=0.022 * unit,
        m_y=0.223 * unit,
        J_z=0.011 * unit * LENGTH**2,
        f_α=2.747,
        ϵ=1.09,
        t_R=0.387,
        x_R=-0.5 * LENGTH,
        a_H=0.312,
        x_H=-0.464 * LENGTH,
        γ_R_minus=0.395,
        γ_R_plus=0.640,
        l_R=-0.710,
        κ=0.50,
        t_P=0.220,
        w_P0=0.40,
        x_P=-0.650,
    )


def turn(x_G: float, degrees: float) -> dict[str, list[float]]:
    """Return u, v, r of 120 s with the rudder put over at once, every 2 s."""
    t = np.linspace(0, 120, 2401)
    run = simulate_mmg_3dof(
        ship(x_G),
        HULL,
        t,
        np.full(t.size, np.radians(degrees)),
        np.full(t.size, REVOLUTIONS),
        u0=SPEED,
        ρ=RHO,
        rtol=1e-9,
        atol=1e-10,
    )
    u, v, r = run.sol(t[::40])[:3]
    return {"t": t[::40].tolist(), "u": u.tolist(), "v": v.tolist(), "r": r.tolist()}


def zigzag(x_G: float, degrees: float) -> dict[str, list[float]]:
    """Return the rudder, u, v, r and heading of a zig-zag, every 0.25 s.

    The rudder angles of shipmmg's own zig-zag test are sailed once more with narrow tolerances,
    which that test does not take.
    """
    t = np.linspace(0, 90, 1801)
    revolutions = np.full(t.size, REVOLUTIONS)
    angle, heading = np.radians(degrees), np.radians(abs(degrees))
    asked, *_ = zigzag_test_mmg_3dof(
        ship(x_G),
        HULL,
        angle,
        heading,
        t,
        revolutions,
        δ_rad_rate=np.radians(15.8),
        u0=SPEED,
        ρ=RHO,
    )
    run = simulate_mmg_3dof(
        ship(x_G),
        HULL,
        t,
        asked,
        revolutions,
        u0=SPEED,
        ρ=RHO,
        rtol=1e-9,
        atol=1e-10,
        max_step=0.05,
    )
    u, v, r, rudder = run.sol(t)[:4]
    psi = np.concatenate([[0.0], np.cumsum((r[1:] + r[:-1]) / 2) * 0.05])
    columns = {"t": t, "rudder": rudder, "u": u, "v": v, "r": r, "psi": psi}
    return {name: x[::5].tolist() for name, x in columns.items()}


def trajectories() -> dict[str, dict[str, list[float]]]:
    """Return every run by its name."""
    runs = {}
    for name, x_G in (("midship", 0.0), ("aboard", 0.25)):
        for degrees in (35, -35):
            runs[f"turn {degrees} {name}"] = turn(x_G, degrees)
        for degrees in (10, -20):
            runs[f"zigzag {degrees} {name}"] = zigzag(x_G, degrees)
    return runs


if __name__ == "__main__":
    rounded = {
        name: {k: [float(f"{x:.6g}") for x in xs] for k, xs in run.items()}
        for name, run in trajectories().items()
    }
    FILE.write_text(json.dumps(rounded, indent=None, separators=(",", ":")) + "\n")
