"""What logs can tell: how far the heading turns, which signs and commands they hold."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greybox.errors import ExcitationError
from greybox.model.predictor import Regime
from greybox.model.predictor_kinds import PredictorKind
from greybox.model.structure import Structure
from greybox.trial.log import TrialLog
from greybox.vessel.force import input_movement

# heading range that current north and east need to be told apart; least and advised [rad]
LEAST_HEADING, ADVISED_HEADING = np.deg2rad(20), np.deg2rad(90)

# share of its thrusters' push below which a force is what rounding leaves of it
_ROUNDING = 1e-9


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


def require_informative(
    logs: Sequence[TrialLog], predictor: PredictorKind, structure: Structure
) -> None:
    """Refuse logs that cannot answer, before any algebra does so obscurely.

    Raises
    ------
    ExcitationError
        No thruster command changes, thrusts cancel but for rounding, or the heading
        does not change for a predictor that must tell current north from east.
    """
    commands = logs[0].vessel.commands
    moved = {
        c: max(float(np.ptp(log[c])) for log in logs)
        + float(np.ptp([float(log[c][0]) for log in logs]))
        for c in commands
    }
    if all(v == 0.0 for v in moved.values()):
        raise ExcitationError(
            f"every thruster command is constant over the log ({', '.join(commands)}), so its "
            f"effect cannot be told from a constant: change the commands during the trial."
        )
    if structure.marine:
        share = movements(logs, structure)
        for term in structure.terms:
            for factor in term.factors:
                # one that is exactly zero is named by the equations
                if factor.signal in structure.inputs and 0 < share[factor.signal] < _ROUNDING:
                    raise ExcitationError(
                        f"parameter {term.name} is not excited: {factor.signal} is "
                        f"{share[factor.signal]:.1g} of what its thrusters push, which is rounding "
                        f"(at least {_ROUNDING:g} is needed), so its thrusts cancel over the whole "
                        f"log. Move what it multiplies, or leave it out (--structure "
                        f"'{structure.name}-{term.name}')."
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
