"""The simulation that output error fits: columns, unknown means, and signals of a log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError
from greybox.estimation.shooting import Measured
from greybox.model.disturbances import WIND
from greybox.model.output import OutputModel, Role, current_means
from greybox.model.predictor import Predictor, Regime, build_predictor
from greybox.model.predictor_kinds import PREDICTORS
from greybox.model.run.inputs import LogInputs
from greybox.model.run.step import Integrator, held
from greybox.model.structure import Structure
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]


def output_predictor(structure: Structure, kind: str, regime: Regime) -> Predictor:
    """Return the columns that output error estimates under a kind of predictor.

    The mean current stands in the model itself; bias-capturing columns remain
    for what an unmeasured wind does, with a constant in each equation.

    Parameters
    ----------
    structure : Structure
    kind : {"basic", "augmented", "wind", "basic+wind"}
    regime : sequence of (str, tuple of int)
        Signs that states keep, as `build_predictor`.

    Returns
    -------
    Predictor
    """
    asked = PREDICTORS[kind]
    if not asked.captures:
        return build_predictor(structure, kind, regime)
    # a run feels the current, and with it what is zero without one
    turning = [t for t in structure.terms if t.of_water]
    felt = structure.without(*(t.name for t in turning)) if turning else structure
    if asked.air_measured or not structure.marine or not structure.uses_air:
        found = replace(build_predictor(felt, asked.plain, regime), kind=kind)
    else:
        found = build_predictor(felt, kind, regime, disturbances=WIND, intercept=True)
    return found.with_terms(structure, turning) if turning else found


def output_model(
    predictor: Predictor,
    sample_time: float,
    heading: Role = "input",
    wind: Role = "input",
    integrator: Integrator = "euler",
) -> OutputModel:
    """Return the simulator of a predictor's kind, its unknown means as parameters."""
    means: tuple[str, ...] = ()
    if PREDICTORS[predictor.kind].captures:
        means = current_means(predictor)
    if wind == "output":
        means = (*means, *WIND)
    return OutputModel(predictor, sample_time, heading, wind, means, integrator)


def measured(model: OutputModel, log: TrialLog) -> Measured:
    """Return the data of a log for a fit of `model`.

    Raises
    ------
    LogError
        The wind is asked for and was not measured.
    """
    structure = model.predictor.structure
    needs = [n for n in (*model.drivers, *model.outputs) if n in ("u_q", "v_q")]
    if needs and not log.has_wind:
        raise LogError(
            f"predictor '{model.predictor.kind}' needs the wind, and '{log.name}' has neither "
            f"u_q, v_q nor V_q, gamma_q: use the predictor 'augmented' or 'basic'."
        )
    inputs = LogInputs.of(structure, log)
    given = dict(zip((*structure.inputs, "psi"), [*inputs.tau.T, inputs.psi], strict=True))

    def signal(name: str) -> Array:
        return np.asarray(given[name] if name in given else log[name])

    def driver(name: str) -> Array:
        value = signal(name)
        return value if name in structure.inputs else held(value, model.integrator)

    return Measured(
        np.column_stack([driver(n) for n in model.drivers]),
        np.column_stack([signal(n) for n in model.outputs]),
        log.known(model.outputs),
    )


def deviations(data: Sequence[Measured]) -> Array:
    """Return the standard deviation of each output over all logs, (ny,); 1 of what rests."""
    found = np.concatenate([log.y for log in data]).std(axis=0)
    return np.where(found > 0, found, 1.0)


def turns(structure: Structure, logs: Sequence[TrialLog]) -> bool:
    """Whether the structure turns the ship and every log has the heading."""
    return structure.turns and all("psi" in log for log in logs)
