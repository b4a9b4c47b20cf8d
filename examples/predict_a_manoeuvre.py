"""A zig-zag predicted from a trial without one, with intervals, beside that of the ship itself."""

import numpy as np

import greybox as gb
from greybox.study.chapter6 import TRUE
from greybox.study.efficiency import CASES, virtual_trial

trial = virtual_trial(np.random.default_rng(4), CASES[0], samples=3000)
model = gb.estimate_model(trial).model()
ship = gb.ManoeuvringModel(
    model.structure,
    np.array([TRUE[name] for name in model.names]),
    np.zeros((len(model.names),) * 2),
    model.sample_time,
    model.vessel,
)
asked = {
    "angles": [(np.radians(10), np.radians(10))],
    "side": "starboard",
    "command": 15.0,
    "limited": False,
}
found = gb.predict_manoeuvre(model, "zigzag", **asked, seed=1)
print(found.summary())
true = gb.predict_manoeuvre(ship, "zigzag", **asked, draws=40).manoeuvres[0].quantities
for name, told in found.manoeuvres[0].quantities.items():
    if told is not None:
        low, high = told.interval
        print(f"{name:<28}{told.value:9.3g}  ({low:.3g} to {high:.3g}), of the ship itself "
              f"{true[name].value:.3g} {told.unit}")  # fmt: skip
