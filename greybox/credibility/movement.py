"""Which coefficients belong to what the logs did not move: rounding, not motion."""

from __future__ import annotations

import numpy as np

from greybox.credibility.evidence import Evidence
from greybox.estimation.informative import is_noise, movements
from greybox.estimation.verdict import TestResult, not_applicable

# share of what its thrusters could push, or of the ship's speed, below which nothing moved:
# 0.06 degrees of thrust direction, or of drift
_LEAST = 1e-3
# relative singular value of regressors of like size below which they are one
_ONE = 1e-6
_NAMED = 0.3


def movement(evidence: Evidence) -> TestResult:
    """Tell whether the logs move every factor of every term, and the terms of an equation apart.

    Forces are measured by what the thrusters push, velocities by the ship's speed, the yaw
    rate by her speed and length, and regressors by their own size: units, rounding and the
    number of samples change nothing.

    Parameters
    ----------
    evidence : Evidence
    """
    name, null = "movement", "the logs move what every parameter multiplies"
    predictor = evidence.predictor
    if not predictor.structure.marine:
        return not_applicable(
            name, null, "the structure is not of a ship, so there is no speed to compare with"
        )
    share = movements(evidence.logs, predictor.structure)
    for force in set(predictor.structure.inputs) & share.keys():
        if share[force] >= _LEAST and is_noise(evidence.logs, force, share[force]):
            share[force] = 0.0
    for i, state in enumerate(predictor.structure.states):
        # a measured velocity holds noise too, a simulated one does not
        x = [run[:, i] for run in evidence.instruments.x if np.isfinite(run[:, i]).all()]
        if len(x) == len(evidence.logs) and state in share:
            measured = np.concatenate([log[state] for log in evidence.logs])
            size = float(np.sqrt(np.mean(measured**2)))
            moved = float(np.sqrt(np.mean(np.concatenate(x) ** 2)))
            share[state] *= min(1.0, moved / size) if size > 0 else 0.0
    found: dict[str, str] = {}
    least = 1.0
    for i in predictor.parameter_columns:
        column = predictor.columns[i]
        term = predictor.structure.terms[predictor.structure.index(column.terms[0])]
        for factor in term.factors:
            moved = share.get(factor.signal, 1.0)
            least = min(least, moved)
            if moved < _LEAST:
                found[column.label] = factor.signal
    apart: list[str] = []
    for equation in evidence.equations:
        values = equation.solution.singular_values
        if len(values) and not values[-1] > _ONE * values[0]:
            weight = np.abs(equation.solution.weakest)
            large = weight >= _NAMED * weight.max()
            apart += [n for n, here in zip(equation.labels, large, strict=True) if here]
    told = [
        f"{signal} changes by {share[signal]:.1g} of "
        + ("its thrusters' force" if signal in predictor.structure.inputs else "the ship's speed")
        + f" (at least {_LEAST:g} is needed), so "
        f"{', '.join(n for n, s in found.items() if s == signal)} rests on rounding or noise"
        for signal in dict.fromkeys(found.values())
    ]
    if apart:
        told.append(f"only rounding tells {', '.join(apart)} apart in the logs")
    return TestResult(
        name,
        null,
        least,
        None,
        f"{'; '.join(told)}: move it, or leave it out of the structure."
        if told
        else "every force, every velocity and what each parameter multiplies changes enough.",
        _LEAST,
        not told,
        tuple(dict.fromkeys([*found, *apart])),
        {"share": {k: float(v) for k, v in share.items()}},
    )
