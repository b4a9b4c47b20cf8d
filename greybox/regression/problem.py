"""What an estimate from one-step equations rests on: logs, a predictor, how instruments are made.

Regression and instruments follow from it and are formed once.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from greybox.model.predictor import Predictor
from greybox.regression.instruments import Instruments, build_instruments
from greybox.regression.regression import Regression, build_regression
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]
Keep = Sequence[NDArray[np.bool_]]

# parameter values whose instruments are kept: the last ones of an iteration
_KEPT = 3


@dataclass(frozen=True, eq=False)
class RegressionSettings:
    """A predictor, and how its regressors and instruments are formed from logs.

    Parameters
    ----------
    predictor : Predictor
    margins : mapping of str to float, optional
        Rows with |state| below are left out (Remark 4.2) [m/s, rad/s].
    zero_mean, heading, wind, lag
        Of the instruments, as `build_instruments`.
    """

    predictor: Predictor
    margins: Mapping[str, float] | None = field(default=None, kw_only=True)
    zero_mean: bool = field(default=True, kw_only=True)
    heading: Literal["measured", "simulated"] = field(default="measured", kw_only=True)
    wind: Literal["smoothed", "measured"] = field(default="smoothed", kw_only=True)
    lag: int = field(default=0, kw_only=True)

    def on(self, logs: Sequence[TrialLog]) -> RegressionProblem:
        """Return the problem of logs that are in memory."""
        own = {f.name: getattr(self, f.name) for f in fields(RegressionSettings)}
        return RegressionProblem(logs=tuple(logs), **own)

    def simulated(
        self, logs: Sequence[TrialLog], theta: Array, keep: Keep | None = None
    ) -> Instruments:
        """Return the instruments of a model's parameters (p,), on its own rows or on given ones."""
        return build_instruments(
            self.predictor,
            logs,
            theta,
            zero_mean=self.zero_mean,
            heading=self.heading,
            wind=self.wind,
            lag=self.lag,
            margins=self.margins,
            keep=keep,
        )


@dataclass(frozen=True, eq=False)
class RegressionProblem(RegressionSettings):
    """Settings and the logs in memory that they are for.

    Parameters
    ----------
    predictor : Predictor
    logs : tuple of TrialLog
        One experiment each, of one sample time.
    settings
        As `RegressionSettings`.
    """

    logs: tuple[TrialLog, ...]
    _instruments: OrderedDict[bytes, Instruments] = field(
        default_factory=OrderedDict, init=False, repr=False
    )

    @cached_property
    def regression(self) -> Regression:
        """The regression of the measured logs."""
        return build_regression(self.predictor, self.logs, margins=self.margins)

    @property
    def keep(self) -> Keep:
        """Rows whose measured states keep the margins."""
        return [e.keep for e in self.regression.experiments]

    def instruments(self, theta: Array, keep: Keep | None = None) -> Instruments:
        """Return the instruments as `simulated` does, kept for the next call."""
        rows = b"" if keep is None else b"".join(k.tobytes() for k in keep)
        key = np.asarray(theta, float).tobytes() + rows
        found = self._instruments.pop(key, None)
        if found is None:
            found = self.simulated(self.logs, theta, keep)
        self._instruments[key] = found
        if len(self._instruments) > _KEPT:
            self._instruments.popitem(last=False)
        return found
