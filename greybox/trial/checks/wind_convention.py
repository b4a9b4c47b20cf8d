"""Convention of the measured wind: the right one keeps the true wind steady in turns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from greybox.trial.checks.finding import Finding, exact_finding, factor_of
from greybox.trial.checks.motion import make_motion, smooth, to_ned
from greybox.trial.raw_log import Array, Recording
from greybox.trial.steps import Step, mend

# what does not turn with the ship must become this much steadier under another convention
STEADIER = 3.0
_LEAST_TURN = np.radians(60)
_BLOCK_SECONDS = 20.0


@dataclass(frozen=True)
class _Convention:
    """One reading of the wind's channels: what is wrong with them, what to do, what is meant."""

    id: str
    channels: tuple[str, ...]
    words: str
    fix: str
    repair: tuple[Step, ...]
    meant: Callable[[Array, Array, Array], Array]


def _reversed(
    channels: tuple[str, ...], words: str, meant: Callable[[Array, Array, Array], Array]
) -> _Convention:
    repair = (mend("scale", channels, factor=-1.0),)
    return _Convention(
        "sign", channels, words, f"change the sign of {' and '.join(channels)}", repair, meant
    )


_CONVENTIONS = (
    _reversed(
        ("u_q", "v_q"), "u_q and v_q are the wind, not the velocity of the ship through the air",
        lambda u, v, psi: -(u + 1j * v),
    ),
    _reversed(
        ("v_q",), "v_q is reversed (the wind's direction counts anticlockwise)",
        lambda u, v, psi: u - 1j * v,
    ),
    _reversed(("u_q",), "u_q is reversed", lambda u, v, psi: -u + 1j * v),
    _Convention(
        "sign", ("u_q", "v_q"), "u_q and v_q are swapped", "exchange u_q and v_q",
        (mend("exchange", ("u_q", "v_q")),), lambda u, v, psi: v + 1j * u,
    ),
    _Convention(
        "frame", ("u_q", "v_q"),
        "u_q and v_q are north and east components, not along the body's axes",
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

    Returns
    -------
    list of Finding
        At most one; safe to mend where positions tell that velocities and heading are right.
    """
    if any(f.id in ("frame", "sign", "unit") and not f.safe for f in findings):
        return []
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
    best, k = min((scatter(c.meant(u_q, v_q, psi)), k) for k, c in enumerate(_CONVENTIONS))
    blocks = max(int(np.ptp(motion.t) / _BLOCK_SECONDS), 1)
    if best * STEADIER > as_named or blocks < 5:
        return []
    convention = _CONVENTIONS[k]
    through = convention.meant(u_q, v_q, psi)
    ratio = float(np.sqrt(as_named / max(best, 1e-12)))
    tied = "x_n" in recording and "y_n" in recording
    doubt = "" if tied else "; without positions u, v or psi may be at fault instead"
    option = "--fix" if tied else f"--fix-also {convention.id}"
    return [
        exact_finding(
            convention.id,
            convention.channels,
            factor_of(convention.repair),
            "1",
            f"{convention.words}: read so, the true wind is {ratio:.1f} times steadier while the "
            f"ship turns over {np.degrees(np.ptp(psi)):.0f} deg{doubt}",
            f"{convention.fix} (import {option} does)" if convention.repair else convention.fix,
            convention.repair,
            tied and bool(convention.repair),
            {
                "t": motion.t,
                "psi": psi,
                "air": to_ned(psi, u - u_q, v - v_q),
                "air_mended": to_ned(psi, u - through.real, v - through.imag),
            },
        )
    ]
