"""Surge trials in a narrow or a wide range of speeds, for tests of weak instruments."""

from __future__ import annotations

import numpy as np

from greybox.model.catalogue import get_structure
from greybox.model.predictor import build_predictor
from greybox.study.inputs import smoothed_pulses
from greybox.trial.log import make_log
from greybox.vessel.toml import load_vessel

# Xu, Xuu, Wuu, Xmu of Table 6.1
TRUE = np.array([-0.05, -0.05, 0.0, 0.02])


def predictor():
    return build_predictor(get_structure("surge"), "basic", (("u", (1,)),))


def surge_log(seed, half, samples=1000, *, kind="pulses", noise=2e-4, process=0.0):
    """Speed within 1 ± `half` m/s, measured with variance `noise`."""
    rng = np.random.default_rng([300, seed])
    vessel = load_vessel("thesis")
    low, high = (-(TRUE[0] * u + TRUE[1] * u * u) / TRUE[3] for u in (1 - half, 1 + half))
    if kind == "pulses":
        tau = smoothed_pulses(rng, samples, low, high, widths=(20, 80), smoothing=10)
    elif kind == "binary":
        tau = np.repeat(rng.choice([low, high], samples // 20 + 1), 20)[:samples]
    else:
        phase = 2 * np.pi * np.arange(samples) / 150 + rng.uniform(0, 6)
        tau = (low + high) / 2 + (high - low) / 2 * np.sin(phase)
    commands = {
        "n": tau / (2 * np.cos(1.1)),
        "alpha1": np.full(samples, 1.1),
        "alpha2": np.full(samples, 1.1),
    }
    u = np.ones(samples)
    w = np.sqrt(process) * rng.standard_normal(samples)
    for k in range(samples - 1):
        u[k + 1] = u[k] + TRUE[0] * u[k] + TRUE[1] * abs(u[k]) * u[k] + TRUE[3] * tau[k] + w[k]
    still = np.zeros(samples)
    measured = u + np.sqrt(noise) * rng.standard_normal(samples)
    return make_log(vessel, commands | {"u": measured, "v": still, "r": still, "psi": still}, 1.0)
