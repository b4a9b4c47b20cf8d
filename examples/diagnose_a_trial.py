"""A trial in a current that the model knows nothing of: found, named, mended, proved."""

import numpy as np

import greybox as gb
from greybox.study.blind import draw

# a virtual ship sails twice; what is wrong with it stays in trial.truth
trial = draw(np.random.default_rng(7), ("current",), kind="manoeuvres", samples=900)
found = gb.diagnose([trial.estimation], validate=[trial.validation])
print(found.summary())

print("\nthe truth:", {k: round(v, 3) for k, v in trial.truth[0].parameters.items()})
before, after = (gb.run_model(m, trial.validation).fit for m in (found.base, found.model))
print("fit of surge on the other trial:", round(before["u"], 1), "->", round(after["u"], 1))
