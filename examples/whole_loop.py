"""The whole loop: design, sail, read, estimate, compare, diagnose, extend, gain, design again."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import greybox as gb
from experiment_design import Wishes, design_trial, prepare_request
from greybox.study.chapter6 import TRUE

rng = np.random.default_rng(3)
ship, structure = gb.load_vessel("thesis"), gb.get_structure("thesis")
true = np.array([TRUE[name] for name in structure.parameters])
hidden = np.array([0.25, -0.15, 0.0, 0.0])  # a current [m/s] that no model is told of
guess = gb.ManoeuvringModel(structure, 0.9 * true, np.diag((0.1 * true) ** 2), 1.0, ship)


def sail(commands, path):
    """Run the true ship on commands, write what its sensors measure, and read it."""
    channels = dict(zip(ship.commands, commands.T, strict=True))
    tau = gb.make_log(ship, channels, 1.0).forces(structure.inputs)
    run = gb.simulate(structure, true, np.array([1.5, 1.2, 0.0]), tau[:-1], 1.0, d=hidden)
    measured = run.x[0] + 0.01 * rng.standard_normal(run.x[0].shape)
    channels |= dict(zip("uvr", measured.T, strict=True)) | {"psi": run.psi[0]}
    gb.write_log([gb.make_log(ship, channels, 1.0, path.stem)], path)
    return gb.read_log(path, ship)


wishes = Wishes(
    300.0, trials=2, regime="u+v+", margin_u=0.3, margin_v=0.3, predictor="basic", effort=0.05
)
plan = design_trial(prepare_request(guess, wishes).request, alternatives=False)
with tempfile.TemporaryDirectory() as folder:
    first, second = (sail(c, Path(folder) / f"{k}.csv") for k, c in enumerate(plan.commands))
estimate = gb.estimate_model([first], gb.Request(method="iv", predictor="basic"))
print(estimate.summary())
models = [guess, estimate.model()]
print(gb.compare_models(models, ["guess", "estimate"], [[second], [second]]).summary())

found = gb.diagnose([first], validate=[second])
print(found.summary())

again = replace(wishes, trials=1, prior=found.model)
print(design_trial(prepare_request(found.model, again).request, alternatives=False).summary())
