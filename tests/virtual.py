"""Virtual trials of the thesis's ship, and logs as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from greybox.model.catalogue import get_structure
from greybox.model.simulation import simulate, stationary_disturbance
from greybox.study.chapter6 import TRUE
from greybox.study.inputs import smoothed_pulses
from greybox.trial.log import TrialLog, make_log
from greybox.vessel.toml import load_vessel

PARAMETERS = get_structure("thesis").parameters


def virtual_log(
    seed: int,
    samples: int = 2000,
    *,
    wind: float = 1.0,
    current: tuple[float, float] = (0.2, -0.2),
    noise: float = 1.0,
    spread: float = 1e-3,
    wind_spread: float | None = None,
    name: str = "virtual",
) -> TrialLog:
    """One run of the thesis's ship, with noises of (6.2) scaled by `noise`."""
    structure, vessel = get_structure("thesis"), load_vessel("thesis")
    rng = np.random.default_rng([100, seed])
    commands = {
        "n": smoothed_pulses(rng, samples, 10, 20, widths=(20, 80), smoothing=10),
        "alpha1": smoothed_pulses(rng, samples, 0.6, 1.1, widths=(20, 80), smoothing=10),
        "alpha2": smoothed_pulses(rng, samples, 0.6, 1.1, widths=(20, 80), smoothing=10),
    }
    tau = make_log(vessel, commands, 1.0).forces(structure.inputs)
    variances = [spread, spread, *[spread if wind_spread is None else wind_spread] * 2]
    std = np.sqrt(variances)
    d = stationary_disturbance(rng, np.array([*current, wind, wind]), std, samples)[0]
    theta = np.array([TRUE[n] for n in PARAMETERS])
    run = simulate(structure, theta, np.array([1.5, 1.2, 0.0]), tau[:-1], 1.0, d=d[:-1])
    x, psi = run.x[0], run.psi[0]
    c, s = np.cos(psi), np.sin(psi)
    channels = commands | {
        "u": x[:, 0] + noise * np.sqrt(2e-4) * rng.standard_normal(samples),
        "v": x[:, 1] + noise * np.sqrt(2e-4) * rng.standard_normal(samples),
        "r": x[:, 2] + noise * np.sqrt(2e-4) * rng.standard_normal(samples),
        "psi": psi + noise * 1e-2 * rng.standard_normal(samples),
        "u_q": x[:, 0] - (c * d[:, 2] + s * d[:, 3]),
        "v_q": x[:, 1] - (c * d[:, 3] - s * d[:, 2]),
    }
    return make_log(vessel, channels, 1.0, name)


def write_csv(log: TrialLog, path: Path, **replace: np.ndarray) -> Path:
    columns = {"t": log.t, **log.channels, **replace}
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="", fmt="%.17g")
    return path
