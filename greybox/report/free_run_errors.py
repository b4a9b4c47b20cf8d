"""Errors of free runs put end to end, with the quantities that they may depend on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.result import Runs
from greybox.report.error_profiles import block_ids

Array = NDArray[np.float64]
Index = NDArray[np.intp]

REGIMES = ("u+ v+", "u+ v−", "u− v+", "u− v−")
# spreads of the measurement beyond which a run has run away
_AWAY = 20.0


@dataclass(frozen=True)
class Errors:
    """Errors of all runs put end to end, with what they may follow.

    Parameters
    ----------
    error : mapping of str to mapping of str to ndarray
        Which run -> state -> (N,) measured − simulated, NaN where it ran away.
    blocks : mapping of str to mapping of str to ndarray of int
        As `error`: samples of one block are not independent.
    heading : ndarray or None
        (N,) [rad], from 0 up to 2π.
    speed : ndarray or None
        (N,) simulated, over ground [m/s], NaN where it ran away. A sensor's would have
        the noise of the error in it.
    regime : ndarray of int or None
        (N,) place in `REGIMES`, by the simulated signs, −1 where it ran away.
    commands : mapping of str to ndarray
        (N,) of each thruster column that all logs have and that moves.
    """

    error: Mapping[str, Mapping[str, Array]]
    blocks: Mapping[str, Mapping[str, Index]]
    heading: Array | None
    speed: Array | None
    regime: Index | None
    commands: Mapping[str, Array] = field(default_factory=dict)

    @property
    def states(self) -> tuple[str, ...]:
        """States that were compared."""
        return tuple(next(iter(self.error.values())))

    def rms(self, which: str, state: str) -> float:
        """Return the root mean square error of a run."""
        return float(np.sqrt(np.nanmean(self.error[which][state] ** 2)))

    @property
    def samples(self) -> int:
        """Of all runs."""
        return len(next(iter(next(iter(self.error.values())).values())))

    @property
    def regimes(self) -> tuple[int, ...]:
        """Places in `REGIMES` that were met."""
        if self.regime is None:
            return ()
        return tuple(int(g) for g in np.unique(self.regime) if g >= 0)

    @property
    def lost(self) -> int:
        """Samples at which some run ran away."""
        bad = [~np.isfinite(e) for run in self.error.values() for e in run.values()]
        return int(np.any(bad, axis=0).sum())


def simulations(run: Runs) -> tuple[str, ...]:
    """Return which runs to show: before and after, or one where they are the same."""
    if all(np.array_equal(run.before[s], run.after[s], equal_nan=True) for s in run.measured):
        return ("simulated",)
    return ("before", "after")


def simulated(run: Runs, name: str, state: str) -> Array:
    """Return a simulated state (N,), NaN where it is no number or the run is over.

    A model that corrects a late sensor has no input at an end of the log.
    """
    x = run.after[state] if name == "after" else run.before[state]
    out = np.full(len(run.measured[state]), np.nan)
    out[: len(x)] = np.where(np.isfinite(x), x, np.nan)
    return out


def gather(runs: Sequence[Runs]) -> Errors:
    """Return the errors of all runs.

    Parameters
    ----------
    runs : sequence of Runs
        At least one.
    """
    kinds = sorted({k for r in runs for k in simulations(r)})
    names = ["before", "after"] if "after" in kinds else ["simulated"]
    error: dict[str, dict[str, Array]] = {}
    blocks: dict[str, dict[str, Index]] = {}
    for name in names:
        error[name], blocks[name] = {}, {}
        for state in runs[0].measured:
            parts = [_error(r, name, state) for r in runs]
            error[name][state] = np.concatenate(parts)
            blocks[name][state] = block_ids([np.nan_to_num(p) for p in parts])
    heading = speed = regime = None
    if all("psi" in r.log for r in runs):
        heading = np.concatenate([r.log["psi"] for r in runs]) % (2 * np.pi)
    if {"u", "v"} <= set(runs[0].measured):
        u, v = (np.concatenate([simulated(r, "after", s) for r in runs]) for s in ("u", "v"))
        speed = np.hypot(u, v)
        regime = np.where(np.isfinite(speed), 2 * (u < 0) + (v < 0), -1)
    return Errors(error, blocks, heading, speed, regime, _commands(runs))


def _commands(runs: Sequence[Runs]) -> dict[str, Array]:
    names = [c for c in runs[0].log.vessel.commands if all(c in r.log for r in runs)]
    found = {c: np.concatenate([r.log[c] for r in runs]) for c in names}
    return {c: value for c, value in found.items() if np.ptp(value) > 0}


def _error(run: Runs, name: str, state: str) -> Array:
    measured = run.measured[state]
    spread = float(np.ptp(measured)) or 1.0
    error = measured - simulated(run, name, state)
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(error) < _AWAY * spread, error, np.nan)
