"""Commands that move between their samples: what acts over each, whatever the rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.errors import VesselError
from greybox.trial.kinematics import decimate
from greybox.trial.log import make_log
from greybox.vessel.actuation import with_actuators_of
from greybox.vessel.toml import vessel_from_dict
from greybox.vessel.vessel import Actuation


@pytest.fixture
def log():
    """A propeller that speeds up and slows down, its force in proportion."""
    vessel = vessel_from_dict(
        {"name": "boat", "length": 10.0, "thruster": [{"type": "fixed", "speed": "n"}],
         "actuation": {"between": "interpolated"}}
    )  # fmt: skip
    count = 60
    channels = dict.fromkeys(("u", "v", "r", "psi"), np.zeros(count))
    return make_log(vessel, channels | {"n": 40 + 30 * np.sin(np.arange(count) / 10)}, 0.5)


def _held(log):
    return replace(log, vessel=replace(log.vessel, actuation=Actuation()))


def test_what_acts_is_the_mean_of_both_ends_of_a_sample(log):
    n, force = log["n"], log.forces(("taux",))[:, 0]
    assert force[:-1] == pytest.approx((n[:-1] + n[1:]) / 2)
    assert _held(log).forces(("taux",))[:, 0] == pytest.approx(n)


def test_at_a_longer_sample_time_it_is_the_mean_of_the_line_through_all_samples(log):
    slower = decimate(log, 2.0)
    first = round(slower.t[0] / 0.5)
    n = log["n"]
    line = [
        (n[k] + 2 * n[k + 1 : k + 4].sum() + n[k + 4]) / 8
        for k in range(first, first + 4 * (len(slower) - 1), 4)
    ]
    # means are shifted on a line between them, which a bent signal shows in second order
    off, off_if_held = (x.forces(("taux",))[:-1, 0] - line for x in (slower, _held(slower)))
    assert np.abs(off).max() < 0.2 * np.abs(off_if_held).max()


def test_a_plan_holds_its_commands_whatever_the_model_was_estimated_with(log):
    plain = replace(log.vessel, actuation=Actuation())
    assert with_actuators_of(plain, log.vessel).actuation.between == "held"


def test_a_word_that_is_none_of_both_is_refused():
    with pytest.raises(VesselError, match=r"between of \[actuation\] is 'jumping'"):
        Actuation(between="jumping")
