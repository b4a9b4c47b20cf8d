"""From a log to a model to a judgement, on a virtual trial with current and wind."""

import numpy as np

import greybox as gb
from greybox.study.chapter6 import START, TRUE
from greybox.study.inputs import smoothed_pulses

rng = np.random.default_rng(1)
ship = gb.load_vessel("thesis")
structure = gb.get_structure("thesis")


def virtual_trial(samples=3000):
    """Sail the ship of Table 6.1 and measure it with noise."""
    commands = {
        name: smoothed_pulses(rng, samples, low, high)
        for name, low, high in (("n", 10, 20), ("alpha1", 0.6, 1.1), ("alpha2", 0.6, 1.1))
    }
    tau = gb.make_log(ship, commands, 1.0).forces(structure.inputs)
    drift = gb.stationary_disturbance(rng, np.array([0.2, -0.2, 0.5, 0.5]), 0.03, samples)[0]
    theta = np.array([TRUE[name] for name in structure.parameters])
    run = gb.simulate(structure, theta, START, tau[:-1], 1.0, d=drift[:-1])
    noise = 0.014 * rng.standard_normal((samples, 3))
    u, v, r = (run.x[0] + noise).T
    return gb.make_log(ship, commands | {"u": u, "v": v, "r": r, "psi": run.psi[0]}, 1.0)


first, second = virtual_trial(), virtual_trial()
biased = gb.estimate_model(first, method="ls", predictor="basic")
estimate = gb.estimate_model(first)
print(estimate.summary())
print(gb.compare({"least squares": biased, "chosen": estimate}, second).summary())
