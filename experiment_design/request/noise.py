"""How noisy the next trial's measurements and its motion will be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greybox.errors import UsageError
from greybox.model.model import ManoeuvringModel
from greybox.model.noise import NoiseLevels
from greybox.model.run.step import StepModel
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]


def noise_levels(
    model: ManoeuvringModel,
    vessel: Vessel,
    process: Array | None = None,
) -> NoiseLevels:
    """Return the noise levels that the vessel file and a previous estimate state.

    The one-step residual of (4.3) holds the measurement noise twice,
    var ε = σ² + Σ aⱼ² σⱼ² + w²; what its standard deviation leaves beyond the
    sensors' noise is process noise.

    Parameters
    ----------
    model : ManoeuvringModel
        Its ``noise``, else its ``residual_std``, is used where `process` is not given.
    vessel : Vessel
        Its sensors' standard deviations.
    process : ndarray, optional
        (nx,) process noise per sample.

    Returns
    -------
    NoiseLevels
        With a sentence on where they come from.

    Raises
    ------
    UsageError
        Neither tells how noisy a state is.
    """
    states = model.structure.states
    residual = np.asarray(model.residual_std, float)
    has_residual = residual.shape == (len(states),) and bool((residual > 0).all())
    channels = (*states, "psi", "wind")
    stated = {n: vessel.std(n) for n in channels}
    a = np.asarray(
        StepModel(model.structure, model.integrator).jacobians(
            [1.0] * len(states), 0.0, [0.0] * len(model.structure.inputs),
            model.d, [1.0, 1.0], model.theta, model.sample_time,
        )[0]
    )  # fmt: skip
    told = ["sensors of the vessel file"] if any(v is not None for v in stated.values()) else []
    if model.noise is not None:
        levels = (*model.noise.measurement, model.noise.heading, model.noise.wind)
        found = {n: x for n, x in zip(channels, levels, strict=True) if stated[n] is None}
        stated |= found
        # a heading or a wind of no noise was not measured
        names = ["heading" if n == "psi" else n for n, x in found.items() if n in states or x]
        if names:
            told.append(f"noise of {', '.join(names)} as the model's estimate found it")
    missing = [s for s in states if stated[s] is None]
    if missing and not has_residual:
        raise UsageError(
            f"nothing tells how noisy {', '.join(missing)} "
            f"{'is' if len(missing) == 1 else 'are'}: state "
            f"{', '.join(f'{s}_std' for s in missing)} under [sensors] in the vessel file, or "
            f"design with a model that was estimated."
        )
    # without a stated sensor, half of the residual is taken as the sensor's
    measurement = np.array(
        [residual[i] / np.sqrt(2.0) if stated[s] is None else stated[s]
         for i, s in enumerate(states)]
    )  # fmt: skip
    if missing:
        told.append(f"noise of {', '.join(missing)} from the model's residuals")
    if process is None and model.noise is not None:
        process = np.asarray(model.noise.process, float)
        told.append("process noise as the model's estimate found it")
    elif process is None and has_residual:
        beyond = residual**2 - measurement**2 - a**2 @ measurement**2
        process = np.sqrt(np.maximum(beyond, 0.0))
        told.append("process noise from the model's residuals")
    elif process is None:
        process = np.zeros(len(states))
        told.append("no process noise, because the model has no residuals")
    else:
        process = np.asarray(process, float)
        if process.shape != (len(states),) or not (process >= 0).all():
            raise UsageError(
                f"the process noise has {process.size} values, one that is not negative is "
                f"needed for each of {', '.join(states)}."
            )
        told.append("process noise as given")
    return NoiseLevels(
        states,
        measurement,
        process,
        stated["psi"] or 0.0,
        stated["wind"] or 0.0,
        "; ".join(told),
    )
