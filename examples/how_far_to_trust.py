"""Whether to believe an estimate, and how precise it could have been."""

import numpy as np

import greybox as gb
from greybox.study.efficiency import CASES, virtual_trial

log = virtual_trial(np.random.default_rng(4), CASES[0], 1500)
for method in ("iv", "oe"):
    estimate = gb.estimate_model(log, method=method, predictor="wind")
    print(f"{method}: coefficients {estimate.verdict.text}")
    if estimate.prediction is not None:
        print(f"  prediction {estimate.prediction.text}")
    for reason in estimate.verdict.reasons[:3]:
        print(f"  {reason}")
    for name, limit in estimate.limits.items():
        print(f"  {name}: {limit.sentence}")

# what a parameter was known to be can be said, and what it cannot be
options = gb.OutputErrorOptions(
    bounds={"Xu": (-0.2, 0.0)}, priors={"Nr": (-0.1, 0.02)}, damping="enforce"
)
careful = gb.estimate_model(log, method="oe", predictor="wind", output_error=options)
print(careful.summary())
