"""What a diagnosis begins with: its logs, the model that was given, and causes to look for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from greybox.diagnosis.preparing import prepare
from greybox.diagnosis.ship import Ship
from greybox.study.blind import draw


def test_the_order_of_the_logs_leaves_no_propeller_out() -> None:
    trial = draw(
        np.random.default_rng([31, 8]), ("quadratic_thrust",), samples=400, positions=False
    )
    speed = trial.estimation["n1"].copy()
    # a transit, in which the bow thruster is off
    speed[:250] = 0.0
    transit = replace(trial.estimation, channels={**trial.estimation.channels, "n1": speed})
    alike = []
    for logs in ([transit, trial.validation], [trial.validation, transit]):
        ready = prepare(logs, [], None, "thesis", ["quadratic_thrust"])
        share = ready.hypotheses[0]
        assert "n1" in share.arguments
        ship = Ship(np.zeros(0), np.zeros(2), trial.estimation.vessel)
        alike.append(share.apply(ship, np.ones(1)).vessel)
    assert alike[0] == alike[1]
