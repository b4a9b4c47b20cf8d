"""Trustworthy ship models from sea trials.

The names here are the promised ones; each is loaded when it is first used, so
that importing the package, or asking for help, costs nothing.

Examples
--------
>>> import greybox as gb
>>> gb.get_structure("thesis").parameters[:3]
('Xu', 'Xvr', 'Xuu')
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from greybox.estimation.estimate import estimate_iv, estimate_ls
    from greybox.estimation.result import Estimate
    from greybox.model.catalogue import get_structure, structure_names
    from greybox.model.model import ManoeuvringModel, load_model
    from greybox.model.predictor import Predictor, build_predictor
    from greybox.model.simulation import simulate, stationary_disturbance
    from greybox.model.structure import Structure
    from greybox.trial.conditioning import decimate
    from greybox.trial.log import TrialLog, make_log
    from greybox.trial.reading import read_log
    from greybox.validation.choose import Request, estimate_model
    from greybox.validation.comparison import compare_models
    from greybox.validation.fit import fit_percent, run_model
    from greybox.vessel.toml import load_vessel
    from greybox.vessel.vessel import Vessel

_WHERE = {
    "Estimate": "greybox.estimation.result",
    "ManoeuvringModel": "greybox.model.model",
    "Predictor": "greybox.model.predictor",
    "Request": "greybox.validation.choose",
    "Structure": "greybox.model.structure",
    "TrialLog": "greybox.trial.log",
    "Vessel": "greybox.vessel.vessel",
    "build_predictor": "greybox.model.predictor",
    "compare_models": "greybox.validation.comparison",
    "decimate": "greybox.trial.conditioning",
    "estimate_iv": "greybox.estimation.estimate",
    "estimate_ls": "greybox.estimation.estimate",
    "estimate_model": "greybox.validation.choose",
    "fit_percent": "greybox.validation.fit",
    "get_structure": "greybox.model.catalogue",
    "load_model": "greybox.model.model",
    "load_vessel": "greybox.vessel.toml",
    "make_log": "greybox.trial.log",
    "read_log": "greybox.trial.reading",
    "run_model": "greybox.validation.fit",
    "simulate": "greybox.model.simulation",
    "stationary_disturbance": "greybox.model.simulation",
    "structure_names": "greybox.model.catalogue",
}

__all__ = [
    "Estimate",
    "ManoeuvringModel",
    "Predictor",
    "Request",
    "Structure",
    "TrialLog",
    "Vessel",
    "build_predictor",
    "compare_models",
    "decimate",
    "estimate_iv",
    "estimate_ls",
    "estimate_model",
    "fit_percent",
    "get_structure",
    "load_model",
    "load_vessel",
    "make_log",
    "read_log",
    "run_model",
    "simulate",
    "stationary_disturbance",
    "structure_names",
]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'greybox' has no attribute '{name}'")
    value = getattr(import_module(_WHERE[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
