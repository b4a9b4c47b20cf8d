"""Convention of the measured wind: the right one keeps the true wind steady in turns."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from greybox.trial.checks.finding import Finding
from greybox.trial.checks.motion import make_motion, smooth, to_ned
from greybox.trial.raw_log import Recording
from greybox.trial.steps import Step, mend

Array = NDArray[np.float64]

# the true wind must become this much steadier under another convention
_RATIO = 3.0
_LEAST_TURN = np.radians(60)
_BLOCK_SECONDS = 20.0

Convention = tuple[str, str, str, tuple[Step, ...], Callable[[Array, Array, Array], Array]]

_NEGATED = (mend("scale", ("u_q", "v_q"), factor=-1.0),)
_CONVENTIONS: tuple[Convention, ...] = (
    (
        "sign", "u_q and v_q are the wind, not the velocity of the ship through the air",
        "change the sign of both (import --fix does)", _NEGATED, lambda u, v, psi: -(u + 1j * v),
    ),
    (
        "sign", "v_q is reversed (the wind's direction counts anticlockwise)",
        "change the sign of v_q (import --fix does)", (mend("scale", ("v_q",), factor=-1.0),),
        lambda u, v, psi: u - 1j * v,
    ),
    (
        "sign", "u_q is reversed",
        "change the sign of u_q (import --fix does)", (mend("scale", ("u_q",), factor=-1.0),),
        lambda u, v, psi: -u + 1j * v,
    ),
    (
        "sign", "u_q and v_q are swapped",
        "exchange u_q and v_q (import --fix does)", (mend("exchange", ("u_q", "v_q")),),
        lambda u, v, psi: v + 1j * u,
    ),
    (
        "frame", "u_q and v_q are north and east components, not along the body's axes",
        "turn them by the heading into body axes", (),
        lambda u, v, psi: (u + 1j * v) * np.exp(-1j * psi),
    ),
)  # fmt: skip


def wind_findings(recording: Recording, findings: list[Finding]) -> list[Finding]:
    """Find a wind in another convention than the documented one.

    The air over ground, v_air = R(ψ)(ν − ν_q), does not turn with the ship. Of
    the conventions that people use, the one that leaves it steadiest is right,
    if it does so by far and the ship has turned far enough.

    Parameters
    ----------
    recording : Recording
        Canonical, mended.
    findings : list of Finding
        Those made before: where the motion itself is in doubt, nothing is said.
    """
    motion = make_motion(recording, ("psi", "u", "v", "u_q", "v_q"))
    if motion is None or not all(n in motion for n in ("psi", "u", "v", "u_q", "v_q")):
        return []
    psi = motion["psi"]
    if np.ptp(psi) < _LEAST_TURN:
        return []
    u, v, u_q, v_q = (smooth(motion[n], motion, 2.0) for n in ("u", "v", "u_q", "v_q"))

    def scatter(through: Array) -> float:
        air = to_ned(psi, u - through.real, v - through.imag)
        # gusts are slower than a block, turns are not: both count alike in every convention
        return float(np.sum(np.var(air, axis=0)))

    as_named = scatter(u_q + 1j * v_q)
    others = [(scatter(c[4](u_q, v_q, psi)), k) for k, c in enumerate(_CONVENTIONS)]
    best, k = min(others)
    blocks = max(int(np.ptp(motion.t) / _BLOCK_SECONDS), 1)
    if best * _RATIO > as_named or blocks < 5:
        return []
    kind, words, fix, steps, meant = _CONVENTIONS[k]
    through = meant(u_q, v_q, psi)
    ratio = float(np.sqrt(as_named / max(best, 1e-12)))
    return [
        Finding(
            kind,
            "u_q" if k != 1 else "v_q",
            -1.0,
            (-1.0, -1.0),
            "1",
            f"{words}: read so, the true wind is {ratio:.1f} times steadier while the ship turns "
            f"over {np.degrees(np.ptp(psi)):.0f} deg",
            fix,
            ("u_q", "v_q") if k != 1 else ("v_q",),
            steps,
            bool(steps),
            {
                "t": motion.t,
                "psi": psi,
                "air": to_ned(psi, u - u_q, v - v_q),
                "air_mended": to_ned(psi, u - through.real, v - through.imag),
            },
        )
    ]
