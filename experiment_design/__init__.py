"""Which trial to run: thruster sequences that tell most, and what they would tell.

Stands on `greybox` and is never imported by it. The names here are the promised
ones; each is loaded when it is first used.
"""

from __future__ import annotations

import logging
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from experiment_design.certificate import Certificate, certify
    from experiment_design.design import design_trial
    from experiment_design.discriminate import Discrimination, design_between
    from experiment_design.inputs import prbs, random_two_level, to_log
    from experiment_design.limits import Circle, TrialLimits
    from experiment_design.noise import noise_levels
    from experiment_design.plan import write_plan
    from experiment_design.precision import PredictedPrecision, predict_precision
    from experiment_design.prepare import Wishes, prepare_request
    from experiment_design.request import DesignRequest, Rival, build_problem
    from experiment_design.result import Design
    from experiment_design.timing import least_duration
    from greybox.model.noise import NoiseLevels

# a library is silent until the program that uses it asks to hear
logging.getLogger(__name__).addHandler(logging.NullHandler())

_WHERE = {
    "Certificate": "certificate",
    "Circle": "limits",
    "Design": "result",
    "DesignRequest": "request",
    "Discrimination": "discriminate",
    "NoiseLevels": "noise",
    "PredictedPrecision": "precision",
    "Rival": "request",
    "TrialLimits": "limits",
    "Wishes": "prepare",
    "build_problem": "request",
    "certify": "certificate",
    "design_between": "discriminate",
    "design_trial": "design",
    "least_duration": "timing",
    "noise_levels": "noise",
    "prbs": "inputs",
    "predict_precision": "precision",
    "prepare_request": "prepare",
    "random_two_level": "inputs",
    "to_log": "inputs",
    "write_plan": "plan",
}

__all__ = [
    "Certificate",
    "Circle",
    "Design",
    "DesignRequest",
    "Discrimination",
    "NoiseLevels",
    "PredictedPrecision",
    "Rival",
    "TrialLimits",
    "Wishes",
    "build_problem",
    "certify",
    "design_between",
    "design_trial",
    "least_duration",
    "noise_levels",
    "prbs",
    "predict_precision",
    "prepare_request",
    "random_two_level",
    "to_log",
    "write_plan",
]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'experiment_design' has no attribute '{name}'")
    value = getattr(import_module(f"experiment_design.{_WHERE[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
