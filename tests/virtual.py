"""Virtual trials of the thesis's ship, and logs as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from greybox.model.catalogue import get_structure
from greybox.model.run.simulation import simulate, stationary_disturbance
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
    without: tuple[str, ...] = (),
) -> TrialLog:
    """One run of the thesis's ship, with noises of (6.2) scaled by `noise`.

    Terms in `without` are none of this ship's.
    """
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
    theta = np.array([0.0 if n in without else TRUE[n] for n in PARAMETERS])
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


def recorded(
    seed: int,
    rate: float = 2.0,
    *,
    seconds: float = 600.0,
    wide: bool = False,
    arm: tuple[float, float] = (0.0, 0.0),
    late: dict[str, float] | None = None,
    heading_bias: float = 0.0,
    noise: float = 1.0,
) -> dict[str, np.ndarray]:
    """A sea trial as sensors record it: positions to 0.05 m, velocities of their own sensor.

    The thesis's ship in current and wind, integrated at 0.1 s or finer; noises
    of (6.2) on u, v, r, psi. `wide` lets the azimuths push to both sides.
    """
    structure, vessel = get_structure("thesis"), load_vessel("thesis")
    rng = np.random.default_rng([200, seed])
    # fine enough that Euler's half step is no latency
    fine = 1 / rate / np.ceil(50 / rate)
    stride = round(1 / rate / fine)
    pad = round(10 / fine)
    samples = round(seconds / fine) + 2 * pad + 1
    low, high = (-1.1, 1.1) if wide else (0.6, 1.1)
    hold = (round(15 / fine), round(60 / fine))
    edge = round(5 / fine)
    commands = {
        "n": smoothed_pulses(rng, samples, 10, 20, widths=hold, smoothing=edge),
        "alpha1": smoothed_pulses(rng, samples, low, high, widths=hold, smoothing=edge),
        "alpha2": smoothed_pulses(rng, samples, low, high, widths=hold, smoothing=edge),
    }
    tau = make_log(vessel, commands, fine).forces(structure.inputs)
    speed, towards = rng.uniform(0, 0.5), rng.uniform(0, 2 * np.pi)
    wind, wind_to = rng.uniform(0, 8), rng.uniform(0, 2 * np.pi)
    d = np.array(
        [speed * np.cos(towards), speed * np.sin(towards), wind * np.cos(wind_to),
         wind * np.sin(wind_to)]
    )  # fmt: skip
    theta = np.array([TRUE[n] for n in PARAMETERS]) * fine
    start = rng.uniform(-np.pi, np.pi)
    run = simulate(structure, theta, np.array([1.5, 1.2, 0.0]), tau[:-1], fine, d=d, psi0=start)
    x, psi = run.x[0], run.psi[0]
    c, s = np.cos(psi), np.sin(psi)
    velocity = np.column_stack([c * x[:, 0] - s * x[:, 1], s * x[:, 0] + c * x[:, 1]])
    way = np.vstack([[0, 0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * fine, axis=0)])
    truth = {
        "x_n": way[:, 0] + c * arm[0] - s * arm[1],
        "y_n": way[:, 1] + s * arm[0] + c * arm[1],
        "psi": psi + heading_bias,
        "u": x[:, 0], "v": x[:, 1], "r": x[:, 2],
        "u_q": x[:, 0] - (c * d[2] + s * d[3]), "v_q": x[:, 1] - (c * d[3] - s * d[2]),
        **commands,
    }  # fmt: skip
    std = {
        "x_n": 0.05, "y_n": 0.05, "psi": 0.01, "u": np.sqrt(2e-4), "v": np.sqrt(2e-4),
        "r": np.sqrt(2e-4), "u_q": 0.2, "v_q": 0.2,
    }  # fmt: skip
    at = np.arange(pad, samples - pad, stride)
    out = {"t": (at - pad) * fine}
    for name, value in truth.items():
        shift = (late or {}).get(name, 0.0)
        clean = np.interp(at * fine - shift, np.arange(samples) * fine, value)
        out[name] = clean + noise * std.get(name, 0.0) * rng.standard_normal(len(at))
    return out


def as_recording(columns: dict[str, np.ndarray], vessel=None):
    """Columns of a log as canonical signals on one clock."""
    from greybox.channels import CHANNELS
    from greybox.trial.raw_log import Recording, Signal

    t = np.asarray(columns["t"], float)
    return Recording(
        "virtual",
        tuple(
            Signal(n, t, np.asarray(v, float), CHANNELS[n].unit if n in CHANNELS else None, n, True)
            for n, v in columns.items()
            if n != "t"
        ),
    )
