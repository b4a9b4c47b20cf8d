"""The estimators that a design assumes, by the information that each draws from a trial."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from greybox.registry import Registry

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from experiment_design.information.moments import InformationModel
    from greybox.model.noise import NoiseLevels
    from greybox.model.predictor import Predictor
    from greybox.model.run.step import Integrator

    Array = NDArray[np.float64]


@dataclass(frozen=True)
class AssumedEstimator:
    """The estimator that a trial is designed for.

    Parameters
    ----------
    name : str
        As ``--estimator`` takes it.
    words : str
        What it is called.
    information : callable
        Returns the program that measures a motion's information, of a predictor, the
        parameters (p,), the disturbance means (nd,), noise levels, sample time [s],
        integrator, and what the wind adds to its mean (N, 2) where it is measured.
    free_run : bool
        Whether its information is of the parameters alone, in their order, and not of
        all regressors.
    """

    name: str
    words: str
    information: Callable[
        [Predictor, Array, Array, NoiseLevels, float, Integrator, Array | None], InformationModel
    ]
    free_run: bool = False


def _moments(
    predictor: Predictor,
    theta: Array,
    d: Array,
    noise: NoiseLevels,
    sample_time: float,
    integrator: Integrator,
    gust: Array | None,
    *,
    white: bool,
) -> InformationModel:
    from experiment_design.information.moments import MomentProgram

    return MomentProgram(
        predictor, theta, d, noise, sample_time, integrator=integrator, white=white, gust=gust
    )


def _sensitivities(
    predictor: Predictor,
    theta: Array,
    d: Array,
    noise: NoiseLevels,
    sample_time: float,
    integrator: Integrator,
    gust: Array | None,
) -> InformationModel:
    from experiment_design.information.sensitivities import SensitivityProgram
    from greybox.model.disturbances import CURRENT, WIND
    from greybox.model.predictor_kinds import PREDICTORS

    means: tuple[str, ...] = ()
    if PREDICTORS[predictor.kind].captures:
        means = CURRENT
        if not predictor.air_measured and predictor.structure.uses_air:
            means = CURRENT + WIND
    return SensitivityProgram(
        predictor, theta, d, noise, sample_time, means=means, integrator=integrator
    )


ESTIMATORS: Registry[AssumedEstimator] = Registry(
    "estimator",
    AssumedEstimator("iv", "zero-mean IV", partial(_moments, white=False)),
    AssumedEstimator("iv-white", "the same with white residuals", partial(_moments, white=True)),
    AssumedEstimator("oe", "output error", _sensitivities, free_run=True),
    group="experiment_design.estimators",
)
