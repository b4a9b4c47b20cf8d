"""What a sequence would tell, before anyone goes to sea."""

import numpy as np

import greybox as gb
from experiment_design import prbs, predict_precision, random_two_level, to_log
from greybox.study.chapter6 import START, TRUE

ship = gb.load_vessel("thesis")
structure = gb.get_structure("thesis")
theta = np.array([TRUE[name] for name in structure.parameters])
predictor = gb.build_predictor(structure, "augmented", (("u", (1,)), ("v", (1,))))
noise = {"u": 0.02, "v": 0.02, "r": 0.02}
sequences = {
    "two-level": random_two_level(ship, 1200, 20, np.random.default_rng(0)),
    "PRBS": prbs(ship, 1200, 20),
}
for name, commands in sequences.items():
    plan = to_log(ship, commands, 1.0)
    print(name)
    print(predict_precision(predictor, theta, plan, np.append(START, 0.0), noise).summary())
