"""Resolving axes that a file does not tell by the other signals of the trial.

A driver may give its heading and velocities in a frame named after the receiver. Whether they
are meant in the world's axes, east-north-up or north-east-down, or in the body's, shows in what
they must agree with: velocities with the positions, a heading with where the thrusters push.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from greybox.rotation import body_to_ned
from greybox.trial.convert.derived_signals import continuous, derive_signals
from greybox.trial.raw_log import Array, Recording, Signal
from greybox.trial.steps import DecidedBy, Step
from greybox.vessel.force import generalised_force
from greybox.vessel.vessel import Vessel

_STEP = 0.2
# over which displacements and changes of velocity are compared [s]
_WINDOW = 2.0
_LEAST_WINDOWS = 20
# rms displacement below which nothing moves [m]
_LEAST_MOVED = 0.05
# what the best reading leaves unexplained, against the next best
_CLEAR = 0.5
# log-likelihood by which the thrusters must prefer one heading
_LEAST_GAIN = 10.0
# mean cosine between course and heading of a ship that sails ahead, and by how much it must win
_AHEAD, _AHEAD_GAIN = 0.7, 0.2
_ENU, _NED = "east-north-up", "north-east-down"
_FLU, _FRD = "forward-left-up", "forward-right-down"


def settle_axes(recording: Recording, vessel: Vessel) -> Recording:
    """Decide on the axes of heading and velocities whose frames tell nothing.

    Parameters
    ----------
    recording : Recording
        Canonical; `unsure` names the signals, which were read as ROS states (REP 103).
    vessel : Vessel
        Its thrusters tell the heading.

    Returns
    -------
    Recording
        With what was decided as steps and notes; nothing is unsure any more.
    """
    if not recording.unsure:
        return recording
    # damaged numbers may be too large to be squared
    with np.errstate(over="ignore", invalid="ignore"):
        return _settled(recording, vessel)


def _settled(recording: Recording, vessel: Vessel) -> Recording:
    steps: list[Step] = []
    mirrored: bool | None = None
    if {"u", "v"} <= recording.unsure & set(recording.names):
        recording, mirrored, step = _settle_velocity(recording)
        steps.append(step)
    if "psi" in recording.unsure and "psi" in recording:
        recording, step = _settle_heading(recording, vessel, mirrored)
        steps.append(step)
    recording = replace(recording, unsure=frozenset()).with_steps(*steps)
    return recording.with_signals(recording.signals, *(s.sentence for s in steps))


def _settle_velocity(recording: Recording) -> tuple[Recording, bool | None, Step]:
    """Return the recording with velocities read rightly, and whether that needs ψ mirrored."""
    u, v = recording["u"], recording["v"]
    left = _left_over(recording)
    axes, mirrored = _FLU, None
    reason = "no frame tells, and there are no positions to compare with"
    decided: DecidedBy = "default"
    if left:
        order = sorted(left, key=lambda k: left[k])
        # the other readings of the same axes are no rivals: the heading is settled apart
        rival = next((k for k in order if k[0] != order[0][0]), order[0])
        reason = (
            f"no frame tells, and read so {100 * left[order[0]]:.0f} % of the displacement in the "
            f"positions is left, {100 * left[rival]:.0f} % if {rival[0]}"
        )
        if left[order[0]] < _CLEAR * left[rival]:
            axes, decided = order[0][0], "check"
            sure = [k for k in order if k[0] == axes]
            if len(sure) > 1 and left[sure[0]] < _CLEAR * left[sure[1]]:
                mirrored = sure[0][1]
    x, y = u, v.with_value(-v.value)
    named: tuple[Signal, Signal]
    if axes == _FRD:
        named = u, y
    elif axes == _FLU:
        named = u, v
    else:
        north, east = (x, y) if axes == _NED else (y, x)
        named = replace(north, name="v_n"), replace(east, name="v_e")
    others = [s for s in recording.signals if s.name not in ("u", "v")]
    step = Step(
        "read_axes",
        (named[0].name, named[1].name),
        (u.source,),
        {"axes": axes},
        decided_by=decided,
        reason=reason,
    )
    # what another file states is better than what had to be found out
    stated = {s.name for s in others}
    new = [s for s in named if s.name not in stated]
    return replace(recording, signals=(*others, *new)), mirrored, step


def _left_over(recording: Recording) -> dict[tuple[str, bool], float]:
    """Return the share of displacement left unexplained, by axes and by whether ψ is mirrored."""
    whole = derive_signals(recording)
    if not {"x_n", "y_n"} <= set(whole.names):
        return {}
    names = ["x_n", "y_n", "u", "v", *(["psi"] if "psi" in whole else [])]
    t, on = _grid(whole, names)
    if len(t) < _LEAST_WINDOWS * _WINDOW / _STEP:
        return {}
    n = round(_WINDOW / _STEP)
    moved = np.stack([on[c][n:] - on[c][:-n] for c in ("x_n", "y_n")])
    total = float(np.sum(moved**2))
    if np.sqrt(total / moved.shape[1]) < _LEAST_MOVED:
        return {}
    x, y = on["u"], -on["v"]
    readings: dict[tuple[str, bool], tuple[Array, Array]] = {
        (_ENU, False): (y, x),
        (_NED, False): (x, y),
    }
    if "psi" in on:
        for mirrored in {False, "psi" in recording.unsure}:
            psi = np.pi / 2 - on["psi"] if mirrored else on["psi"]
            readings[_FLU, mirrored] = body_to_ned(x, -y, psi)
            readings[_FRD, mirrored] = body_to_ned(x, y, psi)
    left = {}
    for key, pair in readings.items():
        travelled = np.stack([_mean(c, n) * _WINDOW for c in pair])
        left[key] = float(np.sum((moved - travelled) ** 2)) / total
    return left


def _settle_heading(
    recording: Recording, vessel: Vessel, mirrored: bool | None
) -> tuple[Recording, Step]:
    """Return the recording with ψ read rightly: as of east-north-up, or of north-east-down."""
    decided: DecidedBy = "check"
    if mirrored is not None:
        reason = "no frame tells, and so the velocities agree with the positions"
    else:
        gains = _by_thrusters(recording, vessel)
        cosines = _by_course(recording)
        if gains is not None and abs(gains[1] - gains[0]) > _LEAST_GAIN:
            mirrored = gains[1] > gains[0]
            reason = (
                f"no frame tells, and so the thrusters explain the motion better (log-likelihood "
                f"higher by {abs(gains[1] - gains[0]):.0f})"
            )
        elif cosines and max(cosines) > _AHEAD and abs(cosines[1] - cosines[0]) > _AHEAD_GAIN:
            mirrored = cosines[1] > cosines[0]
            reason = (
                f"no frame tells, and so the ship sails ahead (mean cosine between course and "
                f"heading {max(cosines):.2f}, else {min(cosines):.2f})"
            )
        else:
            mirrored, decided = False, "default"
            reason = "no frame tells and neither thrusters nor course do: as REP 103 has it"
    psi = recording["psi"]
    if mirrored:
        turned = psi.with_value((np.pi / 2 - psi.value) % (2 * np.pi))
        recording = replace(
            recording, signals=tuple(turned if s is psi else s for s in recording.signals)
        )
    step = Step(
        "read_axes",
        ("psi",),
        (psi.source,),
        {"axes": _NED if mirrored else _ENU},
        decided_by=decided,
        reason=reason,
    )
    return recording, step


def _by_course(recording: Recording) -> tuple[float, float] | None:
    """Return the mean cosine between course and heading as it is and mirrored."""
    found = _over_ground(recording, ["psi"])
    if found is None:
        return None
    _, on, north, east = found
    speed = np.hypot(north, east)
    sails = speed > 0.3 * np.quantile(speed, 0.9)
    course = np.arctan2(east, north)[sails]
    psi = on["psi"][sails]
    return float(np.mean(np.cos(course - psi))), float(np.mean(np.cos(course - np.pi / 2 + psi)))


def _by_thrusters(recording: Recording, vessel: Vessel) -> tuple[float, float] | None:
    """Return the log-likelihood gained by the thrusters' force, with ψ as it is and mirrored."""
    commands = list(vessel.commands)
    if not commands or not set(commands) <= set(recording.names):
        return None
    found = _over_ground(recording, ["psi", *commands], vessel.angle_commands)
    if found is None:
        return None
    t, on, north, east = found
    n = round(_WINDOW / _STEP)
    force = generalised_force(vessel, {c: on[c] for c in commands})
    zero = np.zeros(len(t))
    along, across = force.get("taux", zero), force.get("tauy", zero)
    moment = force.get("taun", zero)
    if not np.any(moment) and "race" in force:
        moment = force["race"]
    gains = []
    for mirrored in (False, True):
        psi = np.pi / 2 - on["psi"] if mirrored else on["psi"]
        push = np.concatenate([_mean(f, n)[::n] for f in body_to_ned(along, across, psi)])
        speed = np.concatenate([_mean(c, n)[::n] for c in (north, east)])
        change = np.concatenate([(_smooth(c)[n:] - _smooth(c)[:-n])[::n] for c in (north, east)])
        rate = _smooth(np.gradient(psi, _STEP))
        turning = _mean(rate, n)[::n]
        gain = _added(change, push, [speed, speed * np.abs(speed)])
        gain += _added((rate[n:] - rate[:-n])[::n], _mean(moment, n)[::n], [turning])
        gains.append(gain)
    return gains[0], gains[1]


def _added(change: Array, push: Array, damping: list[Array]) -> float:
    """Return by how much a force raises the log-likelihood over damping alone, 0 if it brakes."""
    rest = np.column_stack([np.ones(len(change)), *damping])
    both = np.column_stack([rest, push])
    if not np.isfinite(both).all() or not np.isfinite(change).all() or np.std(push) == 0:
        return 0.0
    alone = change - rest @ np.linalg.lstsq(rest, change, rcond=None)[0]
    gains = np.linalg.lstsq(both, change, rcond=None)[0]
    pushed = change - both @ gains
    if gains[-1] <= 0:
        return 0.0
    return 0.5 * len(change) * float(np.log(np.sum(alone**2) / max(np.sum(pushed**2), 1e-300)))


def _over_ground(
    recording: Recording, names: list[str], angles: frozenset[str] = frozenset()
) -> tuple[Array, Mapping[str, Array], Array, Array] | None:
    """Return times, signals and the velocity north and east on one clock."""
    whole = derive_signals(recording)
    have = set(whole.names)
    direct = {"v_n", "v_e"} <= have
    if not direct and not {"x_n", "y_n"} <= have:
        return None
    motion = ["v_n", "v_e"] if direct else ["x_n", "y_n"]
    t, on = _grid(whole, [*names, *motion], angles)
    if len(t) < _LEAST_WINDOWS * _WINDOW / _STEP:
        return None
    north, east = (on[c] if direct else _smooth(np.gradient(on[c], _STEP)) for c in motion)
    return t, on, north, east


def _grid(
    recording: Recording, names: list[str], angles: frozenset[str] = frozenset()
) -> tuple[Array, dict[str, Array]]:
    """Return times at which all signals have values, and the signals there."""
    clean = {}
    for name in names:
        s = recording[name]
        good = s.known
        order = np.argsort(s.t[good], kind="stable")
        t, value = s.t[good][order], s.value[good][order]
        clean[name] = (t, continuous(value) if name in {"psi", *angles} else value)
    if any(len(t) < 2 for t, _ in clean.values()):
        return np.empty(0), {}
    start, stop = max(t[0] for t, _ in clean.values()), min(t[-1] for t, _ in clean.values())
    # a day at the step is half a million samples
    grid = np.arange(start, min(stop, start + 86400.0), _STEP)
    return grid, {n: np.interp(grid, t, value) for n, (t, value) in clean.items()}


def _mean(value: Array, n: int) -> Array:
    """Return the mean over each n steps, trapezoidal, (N - n,)."""
    total = np.concatenate([[0.0], np.cumsum(0.5 * (value[1:] + value[:-1]))])
    return np.asarray((total[n:] - total[:-n]) / n)


def _smooth(value: Array) -> Array:
    n = round(1.0 / _STEP)
    return np.convolve(np.pad(value, n // 2, mode="edge"), np.ones(n) / n, "valid")
