"""Is it a current, or has the ship less damping in yaw? The trial that tells."""

from dataclasses import replace

import numpy as np

import greybox as gb
from experiment_design import (
    CandidateModel,
    DesignRequest,
    TrialLimits,
    design_between,
    prepare_request,
)
from greybox.study.chapter6 import TRUE

ship = gb.load_vessel("thesis")
structure = gb.get_structure("thesis")
theta = np.array([TRUE[name] for name in structure.parameters])
in_current = gb.ManoeuvringModel(
    structure, theta, np.zeros((theta.size,) * 2), 1.0, ship,
    disturbances={"current_north": (0.1, 0.02), "current_east": (0.05, 0.02)},
)  # fmt: skip
damping = theta.copy()
damping[structure.index("Nvr")] = -0.06
weaker = CandidateModel("damping", structure, damping, np.zeros(4))

limits = TrialLimits(margins={"u": 0.3, "v": 0.2})
prepared = prepare_request(in_current, DesignRequest(200.0, limits, regime="u+v+"))
request = replace(prepared, effort=0.5)
print(design_between(request, weaker, ("current", "damping")).summary())
