"""The motion that a plan is expected to give, with bands over prior models and process noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from experiment_design.constraints.kinds.sea_room import edge_distance
from experiment_design.excitation.rollout import plausible_bounds
from experiment_design.output.result import Design
from experiment_design.request.request import build_problem
from greybox.model.run.simulation import positions, simulate
from greybox.vessel.actuation import actuated_force

Array = NDArray[np.float64]

_QUANTILES = (0.025, 0.975)
# share of the drawn motions that stay in the corridor all the way
_CORRIDOR = 0.95
_STREAM = 19


@dataclass(frozen=True)
class Band:
    """One signal: nominal, 2.5 % and 97.5 % quantiles, each (N+1,)."""

    nominal: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class MotionBand:
    """The motion that one trial is expected to have.

    Parameters
    ----------
    trial : int
    t : ndarray
        (N+1,) [s]
    names : tuple of str
        States, then ``psi``, ``x_n``, ``y_n``, ``speed`` (over ground) and, where
        there is a sea room, ``edge`` (distance to its edge, negative outside).
    nominal, low, high : ndarray
        (N+1, n) under the prior model, and 2.5 % and 97.5 % quantiles
        [m/s, rad/s, rad, m].
    places : ndarray
        (R, N+1, 2) north and east [m] of the 95 % of motions that stay nearest to
        the nominal one.
    edge_kept : float
        Distance from the edge that 97.5 % of the motions keep all the way [m], nan
        without a sea room.
    heading_off, position_off : ndarray
        (N+1,) within which 95 % of the motions have stayed of the nominal one
        since the start [rad, m].
    draws : int
        Motions that the quantiles are over; 1 where nothing is uncertain.
    lost : int
        Draws that left every plausible bound and are left out.
    """

    trial: int
    t: Array
    names: tuple[str, ...]
    nominal: Array
    low: Array
    high: Array
    places: Array
    edge_kept: float
    heading_off: Array
    position_off: Array
    draws: int
    lost: int

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def __getitem__(self, name: str) -> Band:
        i = self.names.index(name)
        return Band(self.nominal[:, i], self.low[:, i], self.high[:, i])

    @property
    def certain(self) -> bool:
        """Whether nothing was uncertain, so that the bands have no width."""
        return self.draws == 1

    def hulls(self, index: NDArray[np.intp], *, joined: bool = False) -> list[Array]:
        """Return what the places span at samples (M,): polygons (m, 2) of east and north.

        Joined, each spans the next sample's places too, so that they overlap.
        """
        found = []
        for k, after in zip(index, [*index[1:], index[-1]], strict=True):
            points = self.places[:, [k, after] if joined else [k], ::-1].reshape(-1, 2)
            # a hull needs room in both directions
            if np.linalg.matrix_rank(points - points[0], tol=1e-3) == 2:
                points = points[ConvexHull(points).vertices]
            found.append(points)
        return found


def predict_motion(design: Design, draws: int = 200) -> tuple[MotionBand, ...]:
    """Predict each trial with bands over models drawn from the prior, and process noise.

    Parameters
    ----------
    design : Design
    draws : int
        Models; one is enough where the model is known exactly and nothing else moves
        the vessel.

    Returns
    -------
    tuple of MotionBand
        One per trial; equal requests give equal bands.
    """
    r = design.request
    process = np.asarray(r.noise.process, float)
    if not r.uncertain and not process.any():
        draws = 1
    thetas = r.draw_models(draws, 2)
    states = r.structure.states
    bound = plausible_bounds(states)
    found = []
    for trial, commands in enumerate(design.commands):
        start, samples = r.starts[trial], len(commands)
        columns = {n: commands[:, i] for i, n in enumerate(r.vessel.commands)}
        made = actuated_force(r.vessel, columns, r.sample_time)
        tau = np.stack([made.get(n, np.zeros(samples)) for n in r.structure.inputs], axis=-1)
        rng = np.random.default_rng([_STREAM, r.seed, trial])
        noise = None
        if process.any():
            noise = rng.standard_normal((draws, samples, len(states))) * process
        free = simulate(
            r.structure, thetas, start[:-1], tau, r.sample_time,
            psi=None if "r" in states else np.full(samples + 1, start[-1]),
            psi0=float(start[-1]),
            d=np.broadcast_to(r.d, (samples, r.d.size)) if r.d.any() else None,
            process_noise=noise,
            integrator=r.integrator,
            bound=bound,
        )  # fmt: skip
        stable = free.diverged < 0
        x, psi = free.x[stable], np.asarray(free.psi)[stable]
        if r.misfit is not None:
            rollout = build_problem(r, trial).scenarios[0].rollout
            x, psi = rollout.off(x, psi, r.misfit(design.motions[trial], draws)[stable])
            kept = (np.abs(x) <= bound).all(axis=(1, 2))
            stable[stable] = kept
            x, psi = x[kept], psi[kept]
        names, drawn = _signals(design, x, psi)
        nominal = _signals(design, *_nominal(design, trial))[1][0]
        if draws == 1 or not len(drawn):
            drawn = nominal[None]
        low, high = np.quantile(drawn, _QUANTILES, axis=0)
        where = [names.index("x_n"), names.index("y_n")]
        away = np.linalg.norm(drawn[..., where] - nominal[:, where], axis=-1)
        near = away.max(axis=1) <= np.quantile(away.max(axis=1), _CORRIDOR)
        edge_kept = float("nan")
        if "edge" in names:
            least = drawn[..., names.index("edge")].min(axis=1)
            edge_kept = float(np.quantile(least, _QUANTILES[0]))
        heading = np.abs(drawn - nominal)[..., names.index("psi")]
        found.append(
            MotionBand(
                trial,
                np.asarray(np.arange(samples + 1) * r.sample_time, float),
                names,
                nominal,
                low,
                high,
                drawn[near][..., where],
                edge_kept,
                _corridor(heading),
                _corridor(away),
                draws,
                int((~stable).sum()) if draws > 1 else 0,
            )
        )
    return tuple(found)


def _nominal(design: Design, trial: int) -> tuple[Array, Array]:
    nx = len(design.request.structure.states)
    state = design.motions[trial].state
    return state[:1, :, :nx], state[:1, :, nx]


def _signals(design: Design, x: Array, psi: Array) -> tuple[tuple[str, ...], Array]:
    """Return the names and (R, N+1, n) signals of states (R, N+1, nx) and headings."""
    r = design.request
    states = r.structure.states
    pair = np.zeros((*x.shape[:2], 2))
    for i, name in enumerate(("u", "v")):
        if name in states:
            pair[..., i] = x[..., states.index(name)]
    place = positions(pair, psi, r.sample_time, np.asarray(r.limits.position, float))
    names = [*states, "psi", "x_n", "y_n", "speed"]
    parts = [x, psi[..., None], place, np.hypot(pair[..., :1], pair[..., 1:])]
    if r.limits.area is not None:
        names.append("edge")
        parts.append(edge_distance(r.limits.area, place[..., 0], place[..., 1])[..., None])
    return tuple(names), np.concatenate(parts, axis=-1)


def _corridor(away: Array) -> Array:
    """Return within what (N+1,) most of the motions (R, N+1) have stayed since the start."""
    return np.asarray(np.quantile(np.maximum.accumulate(away, axis=1), _CORRIDOR, axis=0))
