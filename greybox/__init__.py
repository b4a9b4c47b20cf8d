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

import logging
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from greybox.diagnosis.causes import known_causes
    from greybox.diagnosis.causes.cause import Cause
    from greybox.diagnosis.diagnose import DiagnosisOptions, diagnose
    from greybox.diagnosis.given import fit_given
    from greybox.diagnosis.result import Diagnosis, Given
    from greybox.estimation.estimate import estimate_iv, estimate_ls
    from greybox.estimation.output_error import OutputErrorOptions, estimate_oe
    from greybox.estimation.output_setup import output_predictor
    from greybox.estimation.refined import estimate_refined_iv
    from greybox.estimation.result import Estimate, Verdict
    from greybox.export.export import Exported, export_model
    from greybox.model.catalogue import get_structure, structure_names
    from greybox.model.model import ManoeuvringModel, load_model
    from greybox.model.predictor import Predictor, build_predictor
    from greybox.model.simulation import simulate, stationary_disturbance
    from greybox.model.structure import Structure
    from greybox.prediction.predict import predict_manoeuvre
    from greybox.prediction.result import ManoeuvrePrediction
    from greybox.trial.checks.check import check_files, check_recording, check_recordings
    from greybox.trial.checks.finding import CheckReport, Finding
    from greybox.trial.convert.channel_mapping import read_recording
    from greybox.trial.convert.convert import import_recording
    from greybox.trial.convert.read import read_log, read_segments
    from greybox.trial.dataframe import log_from_pandas, log_from_xarray, recording_from_pandas
    from greybox.trial.import_files import import_files
    from greybox.trial.kinematics import decimate
    from greybox.trial.log import TrialLog, make_log
    from greybox.trial.manoeuvres import find_manoeuvres
    from greybox.trial.raw_log import Recording
    from greybox.trial.repair import repair
    from greybox.trial.store import write_log
    from greybox.trial.trial_summary import describe_recording
    from greybox.validation.choose import estimate_model
    from greybox.validation.comparison import compare_models
    from greybox.validation.fit import fit_percent, run_model
    from greybox.validation.request import Request
    from greybox.vessel.toml import load_vessel, vessel_from_dict
    from greybox.vessel.vessel import Vessel

# a library is silent until the program that uses it asks to hear
logging.getLogger(__name__).addHandler(logging.NullHandler())

_WHERE = {
    "Cause": "greybox.diagnosis.causes.cause",
    "Diagnosis": "greybox.diagnosis.result",
    "DiagnosisOptions": "greybox.diagnosis.diagnose",
    "Given": "greybox.diagnosis.result",
    "diagnose": "greybox.diagnosis.diagnose",
    "fit_given": "greybox.diagnosis.given",
    "known_causes": "greybox.diagnosis.causes",
    "CheckReport": "greybox.trial.checks.finding",
    "Estimate": "greybox.estimation.result",
    "Exported": "greybox.export.export",
    "Finding": "greybox.trial.checks.finding",
    "ImportOptions": "greybox.trial.convert.options",
    "ManoeuvrePrediction": "greybox.prediction.result",
    "ManoeuvringModel": "greybox.model.model",
    "OutputErrorOptions": "greybox.estimation.output_error",
    "Predictor": "greybox.model.predictor",
    "Recording": "greybox.trial.raw_log",
    "Request": "greybox.validation.request",
    "Structure": "greybox.model.structure",
    "TrialLog": "greybox.trial.log",
    "Verdict": "greybox.estimation.result",
    "Vessel": "greybox.vessel.vessel",
    "build_predictor": "greybox.model.predictor",
    "check_files": "greybox.trial.checks.check",
    "check_recording": "greybox.trial.checks.check",
    "check_recordings": "greybox.trial.checks.check",
    "compare_models": "greybox.validation.comparison",
    "decimate": "greybox.trial.kinematics",
    "estimate_iv": "greybox.estimation.estimate",
    "estimate_ls": "greybox.estimation.estimate",
    "estimate_model": "greybox.validation.choose",
    "estimate_oe": "greybox.estimation.output_error",
    "estimate_refined_iv": "greybox.estimation.refined",
    "export_model": "greybox.export.export",
    "find_manoeuvres": "greybox.trial.manoeuvres",
    "fit_percent": "greybox.validation.fit",
    "get_structure": "greybox.model.catalogue",
    "import_files": "greybox.trial.import_files",
    "import_recording": "greybox.trial.convert.convert",
    "load_model": "greybox.model.model",
    "load_vessel": "greybox.vessel.toml",
    "log_from_pandas": "greybox.trial.dataframe",
    "log_from_xarray": "greybox.trial.dataframe",
    "make_log": "greybox.trial.log",
    "predict_manoeuvre": "greybox.prediction.predict",
    "read_log": "greybox.trial.convert.read",
    "read_recording": "greybox.trial.convert.channel_mapping",
    "recording_from_pandas": "greybox.trial.dataframe",
    "read_segments": "greybox.trial.convert.read",
    "output_predictor": "greybox.estimation.output_setup",
    "repair": "greybox.trial.repair",
    "run_model": "greybox.validation.fit",
    "simulate": "greybox.model.simulation",
    "stationary_disturbance": "greybox.model.simulation",
    "structure_names": "greybox.model.catalogue",
    "describe_recording": "greybox.trial.trial_summary",
    "vessel_from_dict": "greybox.vessel.toml",
    "write_log": "greybox.trial.store",
}

__all__ = [
    "Cause",
    "CheckReport",
    "Diagnosis",
    "DiagnosisOptions",
    "Estimate",
    "Exported",
    "Finding",
    "Given",
    "ImportOptions",
    "ManoeuvrePrediction",
    "ManoeuvringModel",
    "OutputErrorOptions",
    "Predictor",
    "Recording",
    "Request",
    "Structure",
    "TrialLog",
    "Verdict",
    "Vessel",
    "build_predictor",
    "check_files",
    "check_recording",
    "check_recordings",
    "compare_models",
    "decimate",
    "describe_recording",
    "diagnose",
    "estimate_iv",
    "estimate_ls",
    "estimate_model",
    "estimate_oe",
    "estimate_refined_iv",
    "export_model",
    "find_manoeuvres",
    "fit_given",
    "fit_percent",
    "get_structure",
    "import_files",
    "import_recording",
    "known_causes",
    "load_model",
    "load_vessel",
    "log_from_pandas",
    "log_from_xarray",
    "make_log",
    "output_predictor",
    "predict_manoeuvre",
    "read_log",
    "read_recording",
    "read_segments",
    "recording_from_pandas",
    "repair",
    "run_model",
    "simulate",
    "stationary_disturbance",
    "structure_names",
    "vessel_from_dict",
    "write_log",
]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'greybox' has no attribute '{name}'")
    value = getattr(import_module(_WHERE[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
