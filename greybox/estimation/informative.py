"""The information in logs: range of headings, signs of the velocities, movement of commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.errors import ExcitationError
from greybox.model.predictor import Regime
from greybox.model.predictor_kinds import PredictorKind
from greybox.model.structure import Structure
from greybox.numerics.robust import white_noise
from greybox.trial.log import TrialLog
from greybox.vessel.force import input_movement

Array = NDArray[np.float64]

# heading range that current north and east need to be told apart; least and advised [rad]
LEAST_HEADING, ADVISED_HEADING = np.deg2rad(20), np.deg2rad(90)

# share of its thrusters' push below which a force is what rounding leaves of it
_ROUNDING = 1e-9
# a command is held where it moves by less than this share of its size (an angle, of 1 rad), and by
# no more than so many times the white noise that neighbouring samples show
_STEADY, _WHITE = 0.02, 1.3
# samples with a jump from which on a column holds orders
_JUMPS = 3


def heading_range(logs: Sequence[TrialLog]) -> float:
    """Return how much of the circle the headings of all logs cover [rad].

    Whole turns between logs do not count: 2π less the largest gap.
    """
    psi = np.sort(np.concatenate([log["psi"] for log in logs]) % (2 * np.pi))
    gaps = np.append(np.diff(psi), psi[0] + 2 * np.pi - psi[-1])
    return float(2 * np.pi - gaps.max())


def regime_of(logs: Sequence[TrialLog], structure: Structure) -> Regime:
    """Return the signs that each state takes in more than one sample of twenty.

    Rarer ones are noise or short passages, which simulated instruments may not
    repeat; columns for them would have no instrument.
    """
    regime = []
    for state in structure.states:
        value = np.concatenate([log[state] for log in logs])
        signs = tuple(s for s in (1, -1) if float((s * value > 0).mean()) > 0.05)
        regime.append((state, signs or (1, -1)))
    return tuple(regime)


def movements(logs: Sequence[TrialLog], structure: Structure) -> dict[str, float]:
    """Return how far each input and velocity of a ship moves, as shares without unit.

    Inputs beside what the thrusters push (`input_movement`), u and v beside the ship's
    speed, r beside her speed over her length, all root mean square over the logs.
    """
    vessel = logs[0].vessel
    commands = {c: np.concatenate([log[c] for log in logs]) for c in vessel.commands}
    made = input_movement(vessel, commands)
    found = {n: made[n] for n in structure.inputs if n in made}
    size = {
        s: float(np.sqrt(np.mean(np.concatenate([log[s] for log in logs]) ** 2)))
        for s in ("u", "v", "r")
        if s in structure.states
    }
    speed = float(np.hypot(size.get("u", 0.0), size.get("v", 0.0)))
    if speed > 0:
        found |= {s: v / speed * (vessel.length if s == "r" else 1.0) for s, v in size.items()}
    return found


def _held(values: Sequence[Array], angle: bool) -> float | None:
    """Return by how much a command moves that is held but for its sensor's noise, else None."""
    whole = np.concatenate(values)
    if np.ptp(whole) == 0.0:
        return 0.0
    spread, size = float(np.std(whole)), 1.0 if angle else float(np.sqrt(np.mean(whole**2)))
    steady = spread < _STEADY * size and spread < _WHITE * (white_noise(values) or 0.0)
    return spread if steady else None


def unexcited(structure: Structure, lost: Sequence[str], why: str) -> str:
    """Return the sentence that parameters are not excited, and what to do.

    Parameters
    ----------
    structure : Structure
    lost : sequence of str
        Names of terms, or of disturbances, which no structure can leave out.
    why : str
        What was seen.
    """
    many = len(lost) > 1
    kept = {t.state for t in structure.terms if t.name not in lost}
    smaller = kept == set(structure.states) and set(lost) <= set(structure.parameters)
    leave = f"-{'-'.join(lost)}"
    return (
        f"parameter{'s' * many} {', '.join(lost)} {'are' if many else 'is'} not excited: {why}. "
        f"Move what {'they multiply' if many else 'it multiplies'}"
        + (
            f", or leave {'them' if many else 'it'} out (--structure '{structure.name}{leave}')."
            if smaller
            else "."
        )
    )


def is_noise(logs: Sequence[TrialLog], name: str, share: float) -> bool:
    """Whether an input of this share (`movements`) is only the noise of commands that cancel."""
    values = [log.forces((name,)).ravel() for log in logs]
    size = float(np.sqrt(np.mean(np.concatenate(values) ** 2)))
    return share < _STEADY and size < _WHITE * (white_noise(values) or 0.0)


def orders_logged(logs: Sequence[TrialLog]) -> list[str]:
    """Say in one note which columns moved faster than the vessel file lets them: orders do.

    Where ``[actuation]`` states how orders act, that is known already.
    """
    vessel, step = logs[0].vessel, logs[0].sample_time
    if vessel.actuation or all(t.drive == "command" for t in vessel.thrusters):
        return []
    jumps = []
    for name, limits in vessel.limits.items():
        if limits.rate is None or name not in logs[0]:
            continue
        moved = np.concatenate([np.abs(np.diff(log[name])) for log in logs])
        # what a sample holds may be the mean of two
        if np.sum(moved > 2 * limits.rate * step) >= _JUMPS:
            fastest = float(moved.max()) / step
            jumps.append(f"{name} ({fastest:.3g} per second, its rate is {limits.rate:.3g})")
    if not jumps:
        return []
    return [
        f"moved faster than the vessel file lets them: {', '.join(jumps)}. Such columns hold "
        f"orders, not what actuators did, and a model of orders that jump does not hold for a plan "
        f"whose orders do not. Log the feedback, or state lag or rate_limit in [actuation]."
    ]


def cancelled(structure: Structure, share: Mapping[str, float]) -> tuple[list[str], list[str]]:
    """Return the inputs whose thrusts cancel but for rounding, and the terms that have them."""
    # a rudder amidships, or a propeller at rest, is named by the equations
    still = [s for s in structure.inputs if share.get(s, 1.0) < _ROUNDING]
    still = [s for s in still if share[s] > 0 or s in ("taux", "tauy", "taun")]
    return still, [t.name for t in structure.terms if any(f.signal in still for f in t.factors)]


def require_informative(
    logs: Sequence[TrialLog], predictor: PredictorKind, structure: Structure
) -> None:
    """Refuse logs that do not determine the parameters, before the algebra fails obscurely.

    Raises
    ------
    ExcitationError
        No thruster command changes by more than its noise, the ship does not move, thrusts
        cancel but for rounding, or the heading does not change for a predictor that must tell
        current north from east.
    """
    require_commands(logs)
    require_motion(logs, structure)
    if structure.marine:
        share = movements(logs, structure)
        still, lost = cancelled(structure, share)
        if lost:
            raise ExcitationError(
                unexcited(
                    structure,
                    lost,
                    f"{', '.join(f'{s} is {share[s]:.1g}' for s in still)} of what its thrusters "
                    f"push, which is rounding (at least {_ROUNDING:g} is needed), so its thrusts "
                    f"cancel over the whole log, or push another way (see [[thruster]])",
                )
            )
    if predictor.captures:
        turned = heading_range(logs)
        if turned < LEAST_HEADING:
            raise ExcitationError(
                f"heading stays within {np.degrees(turned):.0f} deg, so current_north and "
                f"current_east cannot be told apart (needs about "
                f"{np.degrees(ADVISED_HEADING):.0f} deg). Turn during the trial, or use "
                f"--predictor {predictor.plain}."
            )


def require_commands(logs: Sequence[TrialLog]) -> None:
    """Refuse logs over which no thruster command changes by more than its noise."""
    commands = logs[0].vessel.commands
    angles = logs[0].vessel.angle_commands
    held = {c: _held([log[c] for log in logs], c in angles) for c in commands}
    if None not in held.values():
        noisy = [f"{c} by {spread:.2g}" for c, spread in held.items() if spread]
        raise ExcitationError(
            f"every thruster command is constant over the log ({', '.join(commands)}"
            + (f"; but for noise, which moves {', '.join(noisy)}" if noisy else "")
            + "), so its effect cannot be told from a constant: change the commands during the "
            "trial."
        )


def require_motion(logs: Sequence[TrialLog], structure: Structure) -> None:
    """Refuse logs over which no state of a structure changes."""
    if all(float(np.ptp(log[s])) == 0.0 for log in logs for s in structure.states):
        raise ExcitationError(
            f"{', '.join(structure.states)} do not change over the whole log, so the motion does "
            f"not show what the commands do: see whether the columns hold what was measured "
            f"(greybox check), and give a log in which the ship moves."
        )
