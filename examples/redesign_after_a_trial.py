"""Design, run, estimate, design again: the second trial knows what the first one told."""

from dataclasses import replace

import numpy as np

import greybox as gb
from experiment_design import DesignRequest, TrialLimits, design_trial, prepare_request
from greybox.study.chapter6 import TRUE
from greybox.trial.log import make_log

ship, structure = gb.load_vessel("thesis"), gb.get_structure("thesis")
true = np.array([TRUE[name] for name in structure.parameters])
rng = np.random.default_rng(0)


def sail(design):
    """Run the true ship on the plan, as its sensors record it."""
    commands = dict(zip(ship.commands, design.commands[0].T, strict=True))
    tau = make_log(ship, commands, 1.0).forces(structure.inputs)
    start = design.request.starts[0]
    w = rng.standard_normal((len(tau) - 1, 3)) * [2e-3, 2e-3, 4e-4]
    run = gb.simulate(structure, true, start[:3], tau[:-1], 1.0, process_noise=w)
    measured = run.x[0] + np.sqrt(2e-4) * rng.standard_normal(run.x[0].shape)
    channels = commands | dict(zip(("u", "v", "r"), measured.T, strict=True))
    channels["psi"] = run.psi[0] + 0.01 * rng.standard_normal(len(tau))
    return make_log(ship, channels, 1.0, "trial")


# what is believed at first: parameters off by a tenth
guess = true * (1 + 0.1 * rng.standard_normal(true.size))
model = gb.ManoeuvringModel(structure, guess, np.zeros((18, 18)), 1.0, ship)
limits = TrialLimits(margins={"u": 0.5, "v": 0.4})
asked = DesignRequest(400.0, limits, regime="u+v+", predictor="basic", effort=0.3)
first = design_trial(prepare_request(model, asked), alternatives=False)
estimate = gb.estimate_model(sail(first), method="iv", predictor="basic")
model = estimate.model()

# the second trial adds to the first one's information, and keeps its limits in nine of ten models
again = replace(asked, prior=model)
second = design_trial(prepare_request(model, again), alternatives=False)
print(f"{'parameter':<10}{'after one':>12}{'after both':>12}")
for name, one, both in zip(second.names, model.std, second.std, strict=True):
    print(f"{name:<10}{one:>12.2g}{both:>12.2g}")
