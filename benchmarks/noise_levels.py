"""Noise levels by exact slopes, and by SciPy's finite differences: a row of `python -m benchmarks`.

Both maximise the same likelihood of the same equation errors by the same L-BFGS-B, from the same
start; what differs is where the slopes come from. The process noise has a memory, and the sensors
are sought too: nine levels.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from greybox.estimation.banded_covariance import ErrorBand, ErrorNoise
from greybox.estimation.noise import ErrorLikelihood

LEVELS = np.array([0.1, 0.2, 0.1, 0.05, 0.1, 0.05])
MEMORY = np.array([0.9, 0.8, 0.7])


def draw(samples, seed=0):
    """Equation errors of three states whose slopes change along the log."""
    rng = np.random.default_rng(seed)
    slopes = np.zeros((samples, 3, 3))
    slopes += np.diag([0.9, 0.8, 0.85])
    slopes += 0.1 * np.sin(np.arange(samples) / 50)[:, None, None]
    e = LEVELS[:3] * rng.standard_normal((samples + 1, 3))
    w = np.zeros((samples, 3))
    for k in range(1, samples):
        w[k] = MEMORY * w[k - 1] + LEVELS[3:] * np.sqrt(1 - MEMORY**2) * rng.standard_normal(3)
    errors = e[1:] - np.einsum("kij,kj->ki", slopes, e[:-1]) + w
    band = ErrorBand(slopes, np.ones(samples, bool))
    return ErrorLikelihood([band], [errors], [True] * 3, np.full(3, 1e-9))


def noise_of(p):
    return ErrorNoise(np.exp(p[:3]), np.exp(p[3:6]), -np.expm1(-np.exp(p[6:])), np.zeros(0))


def loss_and_slope(likelihood, p):
    noise = noise_of(p)
    loss, measured, process, memory = likelihood.slopes(noise)
    by_memory = memory * (1 - noise.memory) * np.exp(p[6:])
    return loss, np.concatenate(
        [2 * noise.measurement**2 * measured, 2 * noise.process**2 * process, by_memory]
    )


def fit(likelihood, exact):
    start = np.log(np.concatenate([np.full(6, 0.12), np.full(3, 1.0)]))
    unit = np.sqrt(len(likelihood.values[0][0]))
    bounds = np.array([(-7.0, 1.0)] * 6 + [(-5.0, 2.0)] * 3) * unit
    options = {"ftol": 1e-9, "gtol": 0.01}
    if exact:

        def scaled(p):
            loss, slope = loss_and_slope(likelihood, p / unit)
            return loss, slope / unit

        return minimize(scaled, start * unit, method="L-BFGS-B", jac=True, bounds=bounds,
                        options=options)  # fmt: skip
    return minimize(lambda p: likelihood.loss(noise_of(p / unit)), start * unit, method="L-BFGS-B",
                    bounds=bounds, options={**options, "eps": 1e-4 * unit})  # fmt: skip
