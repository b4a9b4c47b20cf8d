"""Instruments: the regressors of a simulated model.

They follow the noise-free regressors and are independent of the measurement
noise, because only the inputs and the heading of the log enter the simulation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from greybox.model.predictor import Predictor
from greybox.model.run.changes import Change
from greybox.model.run.inputs import LogInputs
from greybox.model.run.simulation import FreeRun, simulate
from greybox.model.structure import Structure
from greybox.regression.regression import measured_rows, within_margins
from greybox.rotation import body_to_ned, ned_to_body
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]

# samples averaged for the initial state of a simulation
START_SAMPLES = 5
# seconds, and at least so many samples, over which the wind in an instrument is averaged
WIND_WINDOW = 60.0
_LEAST_WINDOW = 30
# a simulated state this many times beyond the largest measured one has diverged
DIVERGENCE_FACTOR = 10.0
_ANY_SHIP = 1e3


@dataclass(frozen=True)
class Instruments:
    """Instruments of each experiment.

    Parameters
    ----------
    z : tuple of ndarray
        (p, N) per log, rows in the order of the predictor's columns.
    keep : tuple of ndarray of bool
        (N,) rows that take part: those whose simulated states keep the margins,
        which, unlike measured ones, do not select on the noise.
    diverged : str
        Empty, or which simulation left its bound and where.
    x : tuple of ndarray
        (N, nx) simulated states, where they come from a simulation.
    """

    z: tuple[Array, ...]
    keep: tuple[NDArray[np.bool_], ...]
    diverged: str = ""
    x: tuple[Array, ...] = ()


def initial_state(log: TrialLog, states: tuple[str, ...]) -> Array:
    """Return the mean of a log's first samples, (nx,)."""
    return np.asarray(log.states(states)[:START_SAMPLES].mean(axis=0))


def state_bound(log: TrialLog, states: tuple[str, ...]) -> Array:
    """Return the magnitude past which a simulated state counts as diverged, (nx,)."""
    seen = [log[name][log.known([name])] for name in states]
    # a plan holds its start only, which says nothing of what the ship will reach
    return np.array(
        [DIVERGENCE_FACTOR * np.abs(x).max() if np.ptp(x) > 0 else _ANY_SHIP for x in seen]
    )


def simulate_log(
    structure: Structure,
    theta: Array,
    log: TrialLog,
    *,
    heading: Literal["measured", "simulated"] = "measured",
    d: Array | None = None,
    use_wind: bool = False,
    integrator: Literal["euler", "rk4"] = "euler",
    changes: Sequence[Change] = (),
    first: float = 0.0,
) -> FreeRun:
    """Run a model freely on the inputs of a log, from its first samples.

    Parameters
    ----------
    structure : Structure
    theta : ndarray
        (p,) parameters of the structure.
    log : TrialLog
    heading : {"measured", "simulated"}
    d : ndarray, optional
        (nd,) disturbance means [m/s].
    use_wind : bool
        Whether the measured velocity through the air drives the wind terms.
    changes : sequence of Change
        Of parameters.
    first : float
        Time of the log's first sample on the clock of the changes [s].

    Returns
    -------
    FreeRun
        One run of N−1 steps, (1, N, nx).
    """
    given = LogInputs.of(structure, log)
    air = log.air if use_wind and structure.uses_air else None
    return simulate(
        structure,
        theta,
        initial_state(log, structure.states),
        given.tau[:-1],
        log.sample_time,
        changes=changes,
        first=first,
        psi=given.heading(structure, heading),
        psi0=float(given.psi[0]),
        d=d,
        air=None if air is None else air[:-1],
        integrator=integrator,
        bound=state_bound(log, structure.states),
    )


def smoothed_wind(log: TrialLog) -> tuple[Array, Array] | None:
    """Return the measured wind north and east (N,), averaged over a minute [m/s].

    So hardly any of the sensor's noise at a sample is left in its instrument.
    None where the log lacks what the wind follows from.
    """
    if not {"u", "v", "psi", "u_q", "v_q"} <= log.channels.keys():
        return None
    from scipy.ndimage import uniform_filter1d

    u_w, v_w = log["u"] - log["u_q"], log["v"] - log["v_q"]
    window = min(max(_LEAST_WINDOW, round(WIND_WINDOW / log.sample_time)), len(log))
    north, east = body_to_ned(u_w, v_w, log["psi"])
    return (
        uniform_filter1d(north, window, mode="nearest"),
        uniform_filter1d(east, window, mode="nearest"),
    )


def _air_instrument(log: TrialLog, x: Array, psi: Array, wind: str) -> tuple[Array, Array]:
    """Return the velocity through the air of a simulated ship in the smoothed wind."""
    blow = smoothed_wind(log) if wind != "measured" and x.shape[1] > 1 else None
    if blow is None:
        return log["u_q"][: len(x)], log["v_q"][: len(x)]
    north, east = blow[0][: len(x)], blow[1][: len(x)]
    ahead, across = ned_to_body(north, east, psi)
    return x[:, 0] - ahead, x[:, 1] - across


def build_instruments(
    predictor: Predictor,
    logs: Sequence[TrialLog],
    theta: Array,
    *,
    zero_mean: bool = True,
    heading: Literal["measured", "simulated"] = "measured",
    wind: Literal["smoothed", "measured"] = "smoothed",
    lag: int = 0,
    margins: Mapping[str, float] | None = None,
    keep: Sequence[NDArray[np.bool_]] | None = None,
) -> Instruments:
    """Simulate a model on each log and form its regressors.

    Parameters
    ----------
    predictor : Predictor
        Whose regressors to form.
    logs : sequence of TrialLog
    theta : ndarray
        (p,) parameters of the predictor's structure, simulated without disturbances (4.61).
    zero_mean : bool
        Subtract each instrument's mean in each experiment (4.63).
    heading : {"measured", "simulated"}
        Heading inside the instruments. Measured is the one measured quantity
        allowed there; a simulated one drifts out of phase in long logs.
    wind : {"smoothed", "measured"}
        Wind inside the instruments: the measured one averaged over a minute, or
        as it is, noise included (section 7.2).
    lag : int
        Samples by which simulated states and inputs are delayed, for logs in
        closed loop: what was commanded before the noise cannot depend on it.
    margins : dict of str to float, optional
        Rows whose simulated states come closer to the origin are left out.
    keep : sequence of ndarray of bool, optional
        (N,) per log: the rows that take part, in place of those that keep the margins.

    Returns
    -------
    Instruments
    """
    structure = predictor.structure
    zs, keeps, xs = [], [], []
    for i, log in enumerate(logs):
        run = simulate_log(structure, theta, log, heading=heading)
        if run.diverged[0] >= 0:
            k = int(run.diverged[0])
            return Instruments(
                (), (), f"the simulation of '{log.name}' left its bound at sample {k} of {len(log)}"
            )
        x = run.x[0][:-1]
        samples = len(x)
        rows = within_margins(x, structure.states, margins) if keep is None else keep[i].copy()
        rows &= measured_rows(predictor, log)
        tau = LogInputs.of(structure, log).tau[:-1]
        if lag:
            shift = np.maximum(np.arange(samples) - lag, 0)
            x, tau = x[shift], tau[shift]
            rows[:lag] = False
        psi: Array | float = 0.0
        if structure.marine:
            psi = run.psi[0][:samples]
        z = predictor.evaluate(
            [np.ascontiguousarray(x[:, j]) for j in range(x.shape[1])],
            psi,
            [np.ascontiguousarray(c) for c in tau.T],
            _air_instrument(log, x, np.broadcast_to(psi, samples), wind)
            if predictor.air_measured
            else None,
        )
        if zero_mean and rows.any():
            # a constant keeps itself as instrument: its equation gives the mean residual
            mean = (z if rows.all() else z[:, rows]).mean(axis=1, keepdims=True)
            mean[list(predictor.constants)] = 0.0
            z -= mean
        zs.append(z)
        keeps.append(rows)
        xs.append(x)
    return Instruments(tuple(zs), tuple(keeps), x=tuple(xs))
