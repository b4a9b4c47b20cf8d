"""Noise levels of the measurements and of the motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import UsageError
from greybox.notebook import DisplayMixin, number, table, text

Array = NDArray[np.float64]


@dataclass(frozen=True, repr=False)
class NoiseLevels(DisplayMixin):
    """Standard deviations that a precision or a band rests on.

    Parameters
    ----------
    states : tuple of str
    measurement : ndarray
        (nx,) of the measured states [m/s, rad/s].
    process : ndarray
        (nx,) of what moves the states beside the model, per sample [m/s, rad/s].
    heading : float
        Of the measured heading [rad].
    wind : float
        Of each component of the measured velocity through the air [m/s].
    source : str
        Where the figures came from, one sentence.
    memory : ndarray
        (nx,) correlation of the process noise from sample to sample, in [0, 1);
        empty where it is white.
    """

    states: tuple[str, ...]
    measurement: Array
    process: Array
    heading: float = 0.0
    wind: float = 0.0
    source: str = ""
    memory: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        total = self.measurement**2 + self.process**2
        if not (np.isfinite(total).all() and (total > 0).all()):
            worst = self.states[int(np.argmin(np.where(np.isfinite(total), total, -1.0)))]
            raise UsageError(
                f"the noise of {worst} is 0, so any trial would give its equation without error: "
                f"state {worst}_std under [sensors] in the vessel file."
            )

    def summary(self) -> str:
        """Return the levels as text."""
        lines = [self._line()]
        lines += [f"  {n:<10}{m:>10} measured{p:>10} per sample" for n, m, p in self._rows()]
        return "\n".join(lines)

    def _line(self) -> str:
        return f"noise of {', '.join(self.states)}{': ' if self.source else ''}{self.source}"

    def _parts(self) -> tuple[str, ...]:
        return (
            table(("state", "measurement", "process, per sample"), self._rows()),
            text(f"heading {number(self.heading)} rad, wind {number(self.wind)} m/s"),
        )

    def _rows(self) -> list[tuple[str, str, str]]:
        each = zip(self.states, self.measurement, self.process, strict=True)
        return [(s, number(m), number(p)) for s, m, p in each]

    def to_dict(self) -> dict[str, Any]:
        """Return the levels for JSON [m/s, rad/s, rad]."""
        return {
            "measurement": dict(zip(self.states, map(float, self.measurement), strict=True)),
            "process": dict(zip(self.states, map(float, self.process), strict=True)),
            "heading": float(self.heading),
            "wind": float(self.wind),
            "source": self.source,
            "memory": dict(zip(self.states, map(float, self.memory), strict=False)),
        }


@dataclass(frozen=True)
class BandCalibration:
    """The errors of free runs on held-out logs, relative to the spread of their draws.

    Parameters
    ----------
    states : tuple of str
    factor : ndarray
        (nx,) on the half width of the draws of a run.
    misfit : ndarray
        (2, nx) what the model lacks, as it shows in a free run: the standard deviation of a
        normal error that reaches as far below the run, and above it [m/s, rad/s]. It is
        added as squares.
    runs : int
        Free runs that it rests on.
    kinds : tuple of str
        Kinds of manoeuvre that were left out in turn; empty where logs or parts were.
    """

    states: tuple[str, ...]
    factor: Array
    misfit: Array
    runs: int
    kinds: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the calibration for JSON."""
        return {
            "factor": dict(zip(self.states, map(float, self.factor), strict=True)),
            "misfit": dict(zip(self.states, self.misfit.T.tolist(), strict=True)),
            "runs": self.runs,
            "kinds": list(self.kinds),
        }


def calibration_from_dict(data: Mapping[str, Any], states: tuple[str, ...]) -> BandCalibration:
    """Build a calibration from the tables of a model file.

    Raises
    ------
    KeyError, TypeError, ValueError
        The tables are incomplete.
    """
    return BandCalibration(
        states,
        np.array([float(data["factor"][s]) for s in states]),
        np.array([[float(m) for m in data["misfit"][s]] for s in states]).reshape(-1, 2).T,
        int(data["runs"]),
        tuple(str(k) for k in data["kinds"]),
    )


def noise_from_dict(data: Mapping[str, Any], states: tuple[str, ...]) -> NoiseLevels:
    """Build levels from the tables of a model file.

    Raises
    ------
    UsageError
        A state has no noise at all.
    KeyError, TypeError, ValueError
        The tables are incomplete.
    """
    return NoiseLevels(
        states,
        np.array([float(data["measurement"][s]) for s in states]),
        np.array([float(data["process"][s]) for s in states]),
        float(data["heading"]),
        float(data["wind"]),
        str(data["source"]),
        np.array([float(m) for m in data.get("memory", {}).values()]),
    )
