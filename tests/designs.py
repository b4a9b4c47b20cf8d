"""Requests that tests of the design share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from experiment_design.constraints.limits import TrialLimits
from experiment_design.request.request import PreparedRequest
from greybox.model.catalogue import get_structure
from greybox.model.model import ManoeuvringModel
from greybox.model.noise import NoiseLevels
from greybox.study.chapter6 import TRUE
from greybox.vessel.toml import load_vessel
from greybox.vessel.vessel import Limits

REGIME = (("u", 1), ("v", 1))
PROCESS = np.array([2e-3, 2e-3, 4e-4])


def limited_ship(speed=None, angle=None, angles=(0.6, 1.1)):
    """The thesis's ship, with rates."""
    ship = load_vessel("thesis")
    thrusters = tuple(
        replace(t, speed_limits=Limits(10.0, 20.0, speed), angle_limits=Limits(*angles, angle))
        for t in ship.thrusters
    )
    return replace(ship, thrusters=thrusters)


def make_request(structure="thesis", duration=120.0, **changes) -> PreparedRequest:
    """The thesis's ship as issue and CONTRACT have it, with changes."""
    s = get_structure(structure)
    n = len(s.states)
    start = np.array([1.5, 1.2, 0.0, 0.0]) if n == 3 else np.array([1.5, 0.0])
    signs = tuple(p for p in REGIME if p[0] in s.states)
    request = PreparedRequest(
        vessel=limited_ship(),
        structure=s,
        theta=np.array([TRUE[t] for t in s.parameters]),
        sample_time=1.0,
        noise=NoiseLevels(s.states, np.full(n, np.sqrt(2e-4)), PROCESS[:n]),
        duration=duration,
        hold=10.0,
        regimes=(signs,),
        starts=(start,),
        limits=TrialLimits(margins={"u": 0.5, "v": 0.4}),
        predictor="basic",
    )
    return replace(request, **changes)


def thesis_model(structure="thesis", spread=0.0) -> ManoeuvringModel:
    """The true model, each parameter uncertain by a share of itself."""
    s = get_structure(structure)
    theta = np.array([TRUE[t] for t in s.parameters])
    return ManoeuvringModel(s, theta, np.diag((spread * theta) ** 2), 1.0, limited_ship())
