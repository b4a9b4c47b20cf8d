"""Clock offsets, lever arm and heading bias in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.trial.checks.finding import Finding, Outcome
from greybox.trial.checks.motion import Motion
from greybox.trial.checks.sensor_offsets.estimate import Fit, fit
from greybox.trial.checks.sensor_offsets.model import Candidate, Tie, size
from greybox.trial.checks.sensor_offsets.select import (
    NEARLY,
    net_likelihood,
    sample_inflation,
    significance,
)
from greybox.trial.steps import mend
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

IDS = ("clock_offset", "lever_arm", "heading_bias")
# beyond these nothing can be said
_VAGUE_HEADING = np.radians(1.0)
_VAGUE_CLOCK = 0.3
_OWN_CLOCKS = (("psi",), ("r",), ("x_n", "y_n"), ("u", "v"))


def offset_findings(
    found: Fit,
    first: list[tuple[float, Fit]],
    motion: Motion,
    vessel: Vessel,
    antenna: tuple[float, ...],
) -> list[Finding]:
    """Return a finding for each defect, and what else would explain as much.

    Parameters
    ----------
    found : Fit
    first : list of tuple of float, Fit
        Each candidate by itself, as `select_candidates` returns them.
    motion : Motion
    vessel : Vessel
    antenna : tuple of float
        Where the vessel file has the antenna, forward and starboard [m].
    """
    findings = []
    at = 0
    for c in found.candidates:
        k = size(c)
        std = np.sqrt(np.diag(found.covariance[at : at + k, at : at + k]))
        at += k
        if c.id == "clock_offset":
            late = found.state.late.get(c.channels[0], 0.0)
            findings.append(_clock_finding(c, late, float(std[0]), motion))
        elif c.id == "heading_bias":
            bias = float(np.angle(np.exp(1j * found.state.bias)))
            findings.append(_heading_finding(bias, float(std[0])))
        else:
            findings.append(_arm_finding(np.array(found.state.arm), std, antenna))
    rivals = _rivals(first, found, vessel, antenna, sample_inflation(motion))
    if rivals:
        findings = [replace(f, evidence=f"{f.evidence}; {rivals}") for f in findings]
    return findings


def _rivals(
    first: list[tuple[float, Fit]],
    found: Fit,
    vessel: Vessel,
    antenna: tuple[float, ...],
    inflation: float,
) -> str:
    """Say what else would explain as much, where one defect was found."""
    if len(found.candidates) != 1:
        return ""
    mine = net_likelihood(found, inflation)
    said = []
    for worth, trial in sorted(first, key=lambda pair: pair[0], reverse=True):
        c = trial.candidates[0]
        alike = set(c.channels) & set(found.candidates[0].channels) and c.id == "clock_offset"
        if c == found.candidates[0] or (alike and found.candidates[0].id == c.id):
            continue
        if worth < mine - NEARLY * inflation or significance(trial, 0, vessel, antenna) < 1.0:
            continue
        if c.id == "clock_offset":
            late = trial.state.late[c.channels[0]]
            said.append(f"{' and '.join(c.channels)} {late:+.2f} s late")
        elif c.id == "lever_arm":
            said.append(f"an antenna at ({trial.state.arm[0]:.2f}, {trial.state.arm[1]:.2f}) m")
        else:
            said.append(f"a heading bias of {np.degrees(trial.state.bias):.1f} deg")
    if not said:
        return ""
    return f"{' or '.join(said[:2])} would explain nearly as much of this motion"


def _clock_finding(c: Candidate, value: float, std: float, motion: Motion) -> Finding:
    channels = c.channels
    if channels == ("x_n", "y_n") and value < 0:
        # a sensor can be late, not early: then all the others are
        channels, value = tuple(n for n in ("u", "v", "psi", "r") if n in motion), -value
    names = ", ".join(channels[:-1]) + " and " + channels[-1] if len(channels) > 1 else channels[0]
    late = "late" if value > 0 else "early"
    against = [n for n in ("x_n", "psi", "u", "r") if n in motion and n not in channels]
    half = ""
    if "x_n" in channels and abs(value - 0.5 * motion.step) < max(2.5 * std, 0.02):
        half = " (half a sample: a simulation by Euler's rule at this step looks the same)"
    return Finding(
        "clock_offset",
        channels[0],
        value,
        (value - 1.96 * std, value + 1.96 * std),
        "s",
        f"{names} {'comes' if len(channels) == 1 else 'come'} {abs(value):.2f} s {late} against "
        f"{_words(against)}: shifted so, positions, velocities and heading agree{half}",
        f"shift {names} by {-value:+.2f} s (import --fix does), and look for the delay in the "
        f"logger or a filter",
        channels,
        (mend("shift", channels, late=value),),
        True,
    )


def _words(names: list[str]) -> str:
    said = {"x_n": "the positions", "psi": "the heading", "u": "the velocities", "r": "the rate"}
    return " and ".join(said[n] for n in names) or "the rest"


def _heading_finding(value: float, std: float) -> Finding:
    return Finding(
        "heading_bias",
        "psi",
        value,
        (value - 1.96 * std, value + 1.96 * std),
        "rad",
        f"the heading is {np.degrees(abs(value)):.1f} deg "
        f"{'clockwise' if value > 0 else 'anticlockwise'} of the direction in which u and v carry "
        f"the positions ({np.degrees(std) * 1.96:.1f} deg at 95 %); a constant velocity of the "
        f"water is allowed for",
        f"subtract {value:.4f} rad from psi if the compass is misaligned (import --fix-also "
        f"heading_bias does), or turn u, v by as much if the velocity sensor is",
        ("psi",),
        (mend("turn_heading", ("psi",), angle=value),),
        False,
    )


def _arm_finding(arm: Array, std: Array, antenna: tuple[float, ...]) -> Finding:
    ci = tuple((float(a - 1.96 * s), float(a + 1.96 * s)) for a, s in zip(arm, std, strict=True))
    said = f"({antenna[0]:g}, {antenna[1]:g})"
    return Finding(
        "lever_arm",
        "x_n",
        (float(arm[0]), float(arm[1])),
        ci,
        "m",
        f"the positions are those of a point {arm[0]:+.2f} m forward and {arm[1]:+.2f} m to "
        f"starboard of where u and v hold (the vessel file says {said}): they swing by so much "
        f"when the ship turns",
        f"write antenna = [{arm[0]:.2f}, {arm[1]:.2f}] in [sensors], or import --fix, which moves "
        f"the positions to where the vessel file has them",
        ("x_n", "y_n"),
        (
            mend(
                "move_antenna",
                ("x_n", "y_n"),
                x=float(arm[0] - antenna[0]),
                y=float(arm[1] - antenna[1]),
            ),
        ),
        True,
    )


def offset_outcomes(tie: Tie, found: Fit, usable: list[Candidate]) -> list[Outcome]:
    """Say for each id what its standard error would allow to see."""
    outcomes = []
    m = tie.motion
    for kind in IDS:
        members = [c for c in usable if c.id == kind and c not in found.candidates]
        if not any(c.id == kind for c in usable):
            outcomes.append(
                Outcome(
                    kind, "cannot tell",
                    "needs positions, heading and velocities of a sensor of their own",
                )
            )  # fmt: skip
            continue
        if kind == "clock_offset" and not m.positioned:
            outcomes.append(
                Outcome(kind, "clean", "heading against yaw rate; no positions to tell which")
            )
            continue
        if kind == "clock_offset":
            outcomes.append(_clock_outcome(tie, found, usable))
            continue
        if not members:
            outcomes.append(Outcome(kind, "clean", "positions, velocities and heading compared"))
            continue
        with_it = fit(tie, (*found.candidates, members[0]), found.state, rounds=1)
        k = size(members[0])
        std = np.sqrt(np.diag(with_it.covariance))[-k:]
        span = np.degrees(np.ptp(m["psi"]))
        if kind == "heading_bias" and std[0] > _VAGUE_HEADING:
            outcomes.append(
                Outcome(
                    kind, "cannot tell",
                    f"the heading stays within {span:.0f} deg and the speed nearly constant: a "
                    f"bias cannot be told from a current (standard error "
                    f"{np.degrees(std[0]):.1f} deg)",
                )
            )  # fmt: skip
        elif kind == "lever_arm" and float(np.max(std)) > 0.5:
            outcomes.append(
                Outcome(
                    kind, "cannot tell",
                    f"the heading turns too little ({span:.0f} deg): standard error "
                    f"{float(np.max(std)):.2g} m",
                )
            )  # fmt: skip
        else:
            error = (
                f"{np.degrees(std[0]):.2f} deg"
                if kind == "heading_bias"
                else f"{std[0]:.2g} and {std[1]:.2g} m"
            )
            outcomes.append(Outcome(kind, "clean", f"standard error {error}"))
    return outcomes


def _clock_outcome(tie: Tie, found: Fit, usable: list[Candidate]) -> Outcome:
    """Say how well each clock is known, and which cannot be told."""
    known: list[str] = []
    vague: list[str] = []
    for c in usable:
        if c.id != "clock_offset" or c.channels not in _OWN_CLOCKS or c in found.candidates:
            continue
        fitted = fit(tie, (*found.candidates, c), found.state, rounds=1)
        std = float(np.sqrt(fitted.covariance[-1, -1]))
        words = f"{', '.join(c.channels)} {std:.2g} s"
        (vague if std > _VAGUE_CLOCK else known).append(words)
    if not known:
        said = f"this motion tells no clock apart (standard errors: {'; '.join(vague)})"
        return Outcome("clock_offset", "cannot tell", said)
    said = f"standard errors: {'; '.join(known)}"
    if vague:
        said += f"; cannot tell: {'; '.join(vague)}"
    return Outcome("clock_offset", "clean", said)
