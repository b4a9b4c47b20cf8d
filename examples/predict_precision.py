"""What given sequences would tell, before anyone goes to sea."""

import numpy as np

import greybox as gb
from experiment_design import DesignRequest, build_problem, predict_precision, prepare_request
from experiment_design.excitation.inputs import prbs, random_two_level, zig_zags
from greybox.errors import ExcitationError
from greybox.study.chapter6 import START, TRUE

ship = gb.load_vessel("thesis")
structure = gb.get_structure("thesis")
theta = np.array([TRUE[name] for name in structure.parameters])
prior = gb.ManoeuvringModel(structure, theta, np.zeros((theta.size,) * 2), 1.0, ship)
asked = DesignRequest(1200.0, hold=20.0, regime="u+v+", start=[*START, 0.0], predictor="basic")
request = prepare_request(prior, asked)
schedule = build_problem(request).schedule
holds, commands = schedule.holds, len(schedule.commands)
sequences = {
    "two-level": random_two_level(holds, commands, 1, np.random.default_rng(0))[0],
    "PRBS": prbs(holds, commands, (6,))[0],
    "zig-zag": zig_zags(holds, ship)[5],
}
for name, unit in sequences.items():
    levels = schedule.lower + (schedule.upper - schedule.lower) * unit
    plan = dict(zip(schedule.commands, schedule.expand(levels).T, strict=True))
    print(name)
    try:
        print(predict_precision(request, [plan]).summary())
    except ExcitationError as error:
        print(error)
