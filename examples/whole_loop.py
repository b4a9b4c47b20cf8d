"""The whole loop: design, sail, read, estimate, compare, diagnose, extend, gain, design again."""

from dataclasses import replace

import greybox as gb
from experiment_design import DesignRequest, TrialLimits, design_trial, prepare_request
from experiment_design.demo.loop import prior_model, virtual_sea

prior = prior_model()
limits = TrialLimits(margins={"u": 0.3, "v": 0.3})
asked = DesignRequest(300.0, limits, regime="u+v+", predictor="basic", effort=0.05)
design = design_trial(prepare_request(prior, asked), alternatives=False)
print(design.summary())

# a ship that feels a current which no model is told of; its second trial stays aside
sea = virtual_sea(design, "current", seed=3)
trial, other = sea.estimation, sea.validation

estimate = gb.estimate_model(trial, method="oe", predictor="basic")
print(estimate.summary())
print(gb.compare({"prior": prior, "estimate": estimate}, other).summary())

found = gb.diagnose([trial], validate=[other])
print(found.summary())
print("what had been hidden:", dict(sea.truth[0].parameters))

again = replace(asked, prior=found.model)
print(design_trial(prepare_request(found.model, again), alternatives=False).summary())
