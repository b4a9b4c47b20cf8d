"""The process noise of a model that was fitted by free runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.free_run import noise_of
from greybox.estimation.innovations import FilterRuns, first_noise, fit_noise
from greybox.estimation.output_setup import measured, turns
from greybox.estimation.shooting import FreeRuns, Loss, cut
from greybox.model.output import OutputModel
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]

# process noise to start from, in deviations of the measurements
_BESIDE = 0.1
# least and largest process noise that is tried, likewise, and how many
_GRID = (3e-3, 1.0, 12)
# samples of each log that noise levels are sought in
_NOISE_SAMPLES = 1500
# what −log L rises by where a level has no weight left
_UNLIKELY = 25.0
# least noise of an output, in its weight of the fit
_LEAST = 1e-9


def residual_noise(runs: FreeRuns, p: Array, nodes: Array, loss: Loss) -> FreeRuns:
    """Return the runs weighted by their own residuals, whatever weights they were fitted with."""
    r, _, _ = runs.value(p, nodes)
    return runs.with_sigma(noise_of(r, runs.sigma, runs.segments.use, loss, _LEAST * runs.sigma))


def noise_of_sensors(runs: FreeRuns) -> tuple[OutputModel, Array, str]:
    """Return the residuals' variances as those of the measurements, and no process noise."""
    nz = len(runs.model.states)
    variances = np.concatenate([runs.sigma**2, np.zeros(nz)])
    return runs.model, variances, "residuals of the free run, process noise taken as none"


def noise_of_run(
    runs: FreeRuns, p: Array, nodes: Array, logs: Sequence[TrialLog]
) -> tuple[OutputModel, Array, str]:
    """Return variances of the measurements and of a step, of a fit that knew the former only.

    The parameters are held: a free run tells them best where little moves the ship
    beside the model, and how much that is, its innovations tell. Those of the heading
    take part, because they tell yaw noise that the yaw rate's own sensor hides.
    """
    model = runs.model
    ends = np.flatnonzero(~runs.segments.joined)
    nodes = nodes[np.concatenate([[0], ends[:-1] + 1])]
    seen = dict(zip(model.outputs, runs.sigma, strict=True))
    if turns(model.predictor.structure, logs) and "psi" not in seen:
        model = replace(model, heading="output")
        nodes = np.column_stack([nodes, [log["psi"][0] for log in logs]])
    # levels need fewer samples than coefficients
    data = [measured(model, log).first(_NOISE_SAMPLES) for log in logs]
    whole = cut(data, max(len(d.y) for d in data))
    first = first_noise(data, len(model.states))
    sigma = np.array([seen.get(n, np.sqrt(first[i])) for i, n in enumerate(model.outputs)])
    start = np.concatenate([sigma, _BESIDE * sigma[: len(model.states)]]) ** 2
    filtered = FilterRuns(model, whole, start)
    if not np.isfinite(filtered.value(p, nodes)[2]):
        return noise_of_sensors(runs)
    found = fit_noise(filtered, p, nodes)
    mean = found.copy()
    for i in range(len(sigma), len(found)):
        mean[i] = mean_variance(filtered, p, nodes, found, i, sigma[i - len(sigma)])
    return model, mean, "likelihood of the innovations at the coefficients of the free run"


def mean_variance(
    runs: FilterRuns, p: Array, nodes: Array, noise: Array, i: int, unit: float
) -> float:
    """Return the mean of one variance under its likelihood, flat in the logarithm.

    Where little moves the ship the most likely deviation is often 0, and a band that
    believes it is too narrow.
    """
    from scipy.interpolate import PchipInterpolator

    steps = np.unique(np.append(unit * np.geomspace(*_GRID), np.sqrt(noise[i])))
    loss: list[float] = []
    for step in steps:
        trial = noise.copy()
        trial[i] = step**2
        r, levels = runs.filtered(p, nodes, trial)
        # a variance under which the run escapes is not likely at all
        with np.errstate(over="ignore"):
            loss.append((float((r**2).sum()) + float(levels.sum())) / 2)
        if step > np.sqrt(noise[i]) and loss[-1] > min(loss) + _UNLIKELY:
            # larger ones are less likely still
            break
    steps = steps[: len(loss)]
    fine = np.geomspace(steps[0], steps[-1], 400)
    values = np.array(loss)
    values = np.where(np.isfinite(values), values, np.nanmax(values[np.isfinite(values)]))
    weight = np.exp(values.min() - PchipInterpolator(np.log(steps), values)(np.log(fine)))
    if not weight.any():
        # sharper than the grid
        return float(steps[values.argmin()] ** 2)
    return float(weight @ fine**2 / weight.sum())
