"""Which trial to run: input sequences and what they would tell.

Stands on `greybox` and is never imported by it.
"""

from __future__ import annotations

from experiment_design.information import PredictedPrecision, predict_precision
from experiment_design.inputs import prbs, random_two_level, to_log

__all__ = ["PredictedPrecision", "prbs", "predict_precision", "random_two_level", "to_log"]
