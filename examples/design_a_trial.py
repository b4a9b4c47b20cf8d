"""Design the next trial of a ship whose model is uncertain by 10 %, and see what it would tell."""

import tempfile
from pathlib import Path

import numpy as np

import greybox as gb
from experiment_design import DesignRequest, TrialLimits, design_trial, prepare_request, write_plan
from greybox.study.chapter6 import TRUE

ship = gb.load_vessel("thesis")
structure = gb.get_structure("thesis")
theta = np.array([TRUE[name] for name in structure.parameters])
prior = gb.ManoeuvringModel(structure, theta, np.diag((0.1 * theta) ** 2), 1.0, ship)

# a sea room 400 m square, around the start; the current is captured, not measured
room = np.array([[-200.0, -200.0], [200.0, -200.0], [200.0, 200.0], [-200.0, 200.0]])
limits = TrialLimits(margins={"u": 0.5, "v": 0.4}, area=room)
asked = DesignRequest(300.0, limits, regime="u+v+", effort=0.1)
request = prepare_request(prior, asked)
design = design_trial(request)
print(design.summary())
for note in request.notes:
    print("Note:", note)
with tempfile.TemporaryDirectory() as folder:
    write_plan(design, Path(folder) / "plan.csv")
