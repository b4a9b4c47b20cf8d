"""Whether a cause stands beside a generic force of motion and commands that has no name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.atom import Atom
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.held_out import Pair, Proof, proof_of
from greybox.diagnosis.point import Fit
from greybox.diagnosis.remainder import (
    Use,
    contributions_beside,
    generic_force,
    motion_and_commands,
)
from greybox.diagnosis.ship import CURRENTS
from greybox.model.terms import parse_term

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Standing:
    """What a cause does beside a generic force, and against one of its own arguments.

    Parameters
    ----------
    beyond : Proof
        Fall of −2 log L of held-out logs by the cause where a generic force stands beside the
        model with it and the model without it.
    share : float or None
        What the cause alone takes of the fall that a generic force of its own arguments brings;
        None where it is no function of motion and present commands.
    half : float
        One-sided p-value of a share below one half.
    shift : float
        How far its values move when the generic force joins, in standard errors.
    """

    beyond: Proof
    share: float | None
    half: float
    shift: float


def standing(problem: Problem, atom: Atom, with_it: Fit, pairs: Sequence[Pair],
             without: Sequence[Pair]) -> Standing:  # fmt: skip
    """Weigh a cause against a generic force.

    Parameters
    ----------
    problem : Problem
    atom : Atom
    with_it : Fit
        With the cause in force.
    pairs, without : sequence of Pair
        That fit, and the one without the cause, on what is held out.
    """
    if any(p.held_fit.escaped or p.fit.escaped for p in (*pairs, *without)):
        better = not any(p.held_fit.escaped for p in pairs)
        none = np.zeros(1)
        return Standing(Proof(np.inf if better else -np.inf, 0.0, 0.0 if better else 1.0, none),
                        None, 1.0, 0.0)  # fmt: skip
    beside = [contributions_beside(p) for p in pairs]
    beyond = proof_of(np.concatenate([contributions_beside(p) for p in without])
                      - np.concatenate(beside))  # fmt: skip
    share, half = None, 1.0
    use = _own_arguments(problem, atom)
    if use is not None:
        plain = np.concatenate([np.concatenate(p.held.contributions(p.held_fit)) for p in without])
        own = np.concatenate([np.concatenate(p.held.contributions(p.held_fit)) for p in pairs])
        generic = np.concatenate([contributions_beside(p, use) for p in without])
        gained, could = plain - own, plain - generic
        share = float(gained.sum() / could.sum()) if could.sum() > 0 else np.inf
        half = proof_of(gained - 0.5 * could).p_value
    return Standing(beyond, share, half, _shift(problem, atom, with_it, pairs))


def _shift(problem: Problem, atom: Atom, fit: Fit, pairs: Sequence[Pair]) -> float:
    where = problem.numbers_of(fit.point, atom)
    if not where:
        return 0.0
    _, covariance = problem.covariance(fit)
    std = np.sqrt(np.diag(covariance)[where])
    moved = np.mean([generic_force(p, motion_and_commands).moved[where] for p in pairs], axis=0)
    return float(np.max(np.abs(moved) / np.maximum(std, 1e-300)))


def _own_arguments(problem: Problem, atom: Atom) -> Use | None:
    """Return which generic forces are functions of an atom's arguments; None where none is."""
    if atom.apply is not None:
        if not atom.arguments:
            return None
        columns = frozenset(atom.arguments)
        return lambda state, arguments: bool(arguments) and arguments <= columns
    if set(atom.columns) & {*CURRENTS}:
        return None
    commands = frozenset(problem.runs[0].log.vessel.commands)
    known = {*problem.structure.states}
    own: dict[str, frozenset[str]] = {}
    for name in atom.columns:
        term = parse_term(name)
        signals: set[str] = set()
        for factor in term.factors:
            if factor.signal in known:
                signals.add(factor.signal)
            elif factor.signal in problem.structure.inputs:
                signals |= commands
            else:
                return None
        own[term.state] = own.get(term.state, frozenset()) | signals
    return lambda state, arguments: state in own and arguments <= own[state]
