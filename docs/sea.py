"""A virtual sea: writes the model that one starts from, or sails a plan.

python sea.py prior.json
python sea.py plan.csv trial.csv --seed 1
python sea.py plan.csv raw.csv --seed 1 --raw
"""

import argparse
from dataclasses import replace

import numpy as np

import greybox as gb
from greybox.study.chapter6 import START, TRUE

KNOT = 1852 / 3600  # m/s
LATE = 2.0  # s, of the recorder's velocities
LAG = 2.0  # s, of the true ship's forces behind their commands: what the model will lack

ship, structure = gb.load_vessel("thesis"), gb.get_structure("thesis")
slow = replace(ship, actuation=replace(ship.actuation, lag=LAG))
true = np.array([TRUE[name] for name in structure.parameters])


def believe(path):
    """Write a first model: every coefficient off by about a tenth, and said to be."""
    theta = true * (1 + 0.1 * np.random.default_rng(0).standard_normal(true.size))
    covariance = np.diag((0.1 * theta) ** 2)
    gb.ManoeuvringModel(structure, theta, covariance, 1.0, ship).save(path)


def sail(plan, path, seed, raw=False):
    """Sail the true ship on the plan's commands, and log what its sensors measure."""
    start = dict(zip(("u", "v", "r"), START, strict=True)) | {"psi": 0.0}
    log = gb.read_log(plan, slow, fill=start)
    rng, steps = np.random.default_rng(seed), len(log) - 1
    push = rng.standard_normal((steps, 3)) * [1e-3, 1e-3, 3e-4]
    forces = log.forces(structure.inputs)[:-1]
    run = gb.simulate(structure, true, START, forces, 1.0, process_noise=push, integrator="rk4")
    measured = run.x[0] + 0.014 * rng.standard_normal((steps + 1, 3))
    channels = {name: log[name] for name in ship.commands}
    channels |= dict(zip(("u", "v", "r"), measured.T, strict=True))
    channels["psi"] = run.psi[0] + 0.01 * rng.standard_normal(steps + 1)
    if raw:
        record(channels, path)
    else:
        gb.write_log([gb.make_log(ship, channels, 1.0)], path)


def record(channels, path):
    """Write a log as a recorder might: other names and units, a hole, and a slow velocity log."""
    t = np.arange(len(channels["psi"]))
    speed = (channels["u"] + 1j * channels["v"]) * np.exp(1j * channels["psi"])
    place = np.r_[0, np.cumsum(speed[1:] + speed[:-1]) / 2]
    raw = {
        "Time [s]": t,
        "North [m]": place.real,
        "East [m]": place.imag,
        "Heading [deg]": np.rad2deg(channels["psi"]) % 360,
        "Surge [kn]": np.interp(t - LATE, t, channels["u"]) / KNOT,
        "Sway [kn]": np.interp(t - LATE, t, channels["v"]) / KNOT,
        "Yaw rate [deg/s]": np.rad2deg(channels["r"]),
        **{name: channels[name] for name in ship.commands},
    }
    rows = np.column_stack(list(raw.values()))[(t < 300) | (t >= 320)]
    np.savetxt(path, rows, "%.6g", ",", header=",".join(raw), comments="")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("files", nargs="+")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--raw", action="store_true")
    given = parser.parse_args()
    if len(given.files) == 1:
        believe(given.files[0])
    else:
        sail(*given.files, given.seed, given.raw)
