"""Information of an output-error estimate: Cramér-Rao by sensitivities, and its derivatives.

When the simulated states are fitted to the measured ones, with independent
measurement noise of covariance Σe and no process noise, the information is

    F = Σ S(k)ᵀ Σe⁻¹ S(k),   S(k+1) = A(k) S(k) + B(k),

S = ∂x/∂θ, A = ∂x⁺/∂x and B = ∂x⁺/∂θ along the noise-free motion. Unknown initial
states enter through S(0), unknown disturbance means through B; both are
nuisance. The adjoint of the recursion is one banded linear system.

Process noise would need the innovations form, with the gains of a Kalman filter
and their sensitivities; `NoiseLevels.process` is left out here, so that F is
what simulation error can reach on a ship that nothing else moves.

References
----------
Ljung (1999), System Identification, sections 7.4 and 9.4; Goodwin and Payne
(1977), Dynamic System Identification, chapter 6.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiment_design.excitation.rollout import costates
from experiment_design.information.moments import Moments, measured_air
from greybox.errors import UsageError
from greybox.model.noise import NoiseLevels
from greybox.model.predictor import Predictor
from greybox.model.run.step import Integrator, StepModel
from greybox.numerics.recursion import propagate
from greybox.numerics.vectorised import Vectorised

Array = NDArray[np.float64]


class SensitivityProgram:
    """Compiled sensitivities of one structure at one prior model; a `InformationModel`.

    Columns are the parameters of the predictor first (`wanted`), then the
    initial states, then the disturbance means.

    Parameters
    ----------
    predictor : Predictor
        Names the parameters; where one column stands for several terms, they
        move together in the proportion of their prior values. Its
        bias-capturing columns are not used: `means` takes their place.
    theta : ndarray
        (p_structure,) prior parameters.
    d : ndarray
        (nd,) disturbance means that the trial is expected to meet [m/s].
    noise : NoiseLevels
        Its ``measurement``, and ``heading`` where the structure turns.
    sample_time : float
        [s]
    initial : bool
        Estimate the initial states, and the heading's where it is simulated.
    means : tuple of str
        Names of the disturbance means that are estimated, such as
        ``("current_north", "current_east")``; the measured wind's are not.
    integrator : {"euler", "rk4"}

    Attributes
    ----------
    names : tuple of str
        Of the columns.
    wanted : tuple of int
        Positions of the parameters among them.

    Raises
    ------
    UsageError
        A state is measured without noise, or a mean has another name.
    """

    def __init__(
        self,
        predictor: Predictor,
        theta: Array,
        d: Array,
        noise: NoiseLevels,
        sample_time: float,
        *,
        initial: bool = True,
        means: tuple[str, ...] = (),
        integrator: Integrator = "euler",
    ) -> None:
        structure = predictor.structure
        states = structure.states
        theta, d = np.asarray(theta, float), np.asarray(d, float)
        self.predictor = predictor
        self.nx = len(states)
        silent = [n for n, v in zip(states, noise.measurement, strict=True) if not v > 0]
        if silent:
            raise UsageError(
                f"the measurement of {silent[0]} has no noise, so output error would know it "
                f"exactly: state {silent[0]}_std under [sensors] in the vessel file."
            )
        unknown = [n for n in means if n not in structure.disturbances]
        if unknown:
            raise UsageError(
                f"there is no disturbance mean '{unknown[0]}' to be estimated: there are "
                f"{', '.join(structure.disturbances) or 'none'}."
            )
        turns = "r" in states
        # the heading moves the states only where something drifts past the ship; a measured wind
        # is an input
        drift = d[:2] if predictor.air_measured else d
        heading = turns and (noise.heading > 0 or bool(drift.any()))
        self.size = self.nx + heading
        std = np.append(noise.measurement, [noise.heading] * heading)
        self.weight = np.where(std > 0, 1 / np.where(std > 0, std, 1.0) ** 2, 0.0)
        step = StepModel.free(structure, integrator, air_measured=predictor.air_measured)
        s = step.symbolic
        next_state = s.next_state[: self.size]
        z = ca.vertcat(s.x, *[s.psi] * heading)
        slope = ca.jacobian(next_state, z)
        by_theta = ca.jacobian(next_state, s.theta)
        columns = [predictor.columns[i] for i in predictor.parameter_columns]
        directions = np.zeros((len(theta), len(columns)))
        for j, column in enumerate(columns):
            places = [structure.index(t) for t in column.terms]
            total = float(theta[places].sum())
            share = theta[places] / total if total else np.full(len(places), 1 / len(places))
            directions[places, j] = share
        parts = [ca.mtimes(by_theta, ca.DM(directions))]
        chosen = [structure.disturbances.index(n) for n in means]
        if chosen:
            parts.append(ca.jacobian(next_state, s.d)[:, chosen])
        entry = ca.densify(ca.horzcat(*parts))
        slope, entry = (s.at(e, d, theta, sample_time) for e in (slope, entry))
        if predictor.air_measured:
            air = ca.vertcat(*measured_air(structure, ca.SX(d[2]), ca.SX(d[3])))
            slope, entry = (ca.substitute(e, s.air, air) for e in (slope, entry))
        # what IPOPT's interval functions are built from
        self.symbols = (s.x, s.psi, s.tau)
        self.expressions = (slope, entry)
        outputs = ca.vertcat(ca.vec(slope.T), ca.vec(entry.T))
        scalars = [*ca.vertsplit(s.x), s.psi, *ca.vertsplit(s.tau)]
        self._driven = entry.shape[1]
        self._initial = self.size if initial else 0
        self.columns = self._driven + self._initial
        # parameters, initial states, means: the driven columns without the initial states
        p = len(columns)
        self.order = np.array(
            [*range(p), *range(self._driven, self.columns), *range(p, self._driven)]
        )
        # S(0), driven columns first
        self.first = np.zeros((self.size, self.columns))
        self.first[:, self._driven :] = np.eye(self.size)[:, : self._initial]
        first = [f"{n}(0)" for n in (*states, *["psi"] * heading)] if initial else []
        self.names = (*predictor.parameter_names, *first, *means)
        self.wanted = tuple(range(p))
        self._forward = Vectorised(ca.vertsplit(outputs), scalars)
        w = ca.SX.sym("w", outputs.numel())
        back = ca.jtimes(outputs, ca.vertcat(*scalars), w, True)
        self._backward = Vectorised(ca.vertsplit(back), [*scalars, *ca.vertsplit(w)])
        self._arguments = len(scalars)

    def _signals(self, x: Array, psi: Array, tau: Array) -> list[Array]:
        signals = [*np.moveaxis(x, -1, 0), psi, *np.moveaxis(tau, -1, 0)]
        return [np.ascontiguousarray(v) for v in signals]

    def _slopes(self, signals: list[Array]) -> tuple[Array, Array]:
        """Return A (n, n, R, N) and B (n, q, R, N)."""
        shape = signals[0].shape
        out = self._forward(signals, np.empty((self._forward.size, *shape)))
        n = self.size
        return out[: n * n].reshape(n, n, *shape), out[n * n :].reshape(n, self._driven, *shape)

    def _recursions(self, a: Array, b: Array) -> Array:
        """Return S (R, N+1, n, columns) of runs with A (n, n, R, N) and B (n, q, R, N)."""
        runs, samples = a.shape[2:]
        driven = np.zeros((runs, samples, self.size, self.columns))
        driven[..., : self._driven] = b.transpose(2, 3, 0, 1)
        start = np.tile(self.first, (runs, 1, 1))
        return propagate(np.ascontiguousarray(a.transpose(2, 3, 0, 1)), driven, start)

    def sensitivities(self, x: Array, psi: Array, tau: Array) -> Array:
        """Return S of R sequences, (R, N+1, n, columns); see `__call__`.

        Rows are the states, and the heading [rad] last where it is simulated.
        """
        a, b = self._slopes(self._signals(x, psi, tau))
        return self._recursions(a, b)[..., self.order]

    def __call__(self, x: Array, psi: Array, tau: Array) -> Moments:
        """Return the information of R sequences, as G and as M, so that C = F⁻¹.

        Parameters
        ----------
        x : ndarray
            (R, N, nx) states, the first N of a run; all N + 1 are measured.
        psi : ndarray
            (R, N) heading [rad].
        tau : ndarray
            (R, N, nu) generalised inputs.
        """
        a, b = self._slopes(self._signals(x, psi, tau))
        s = self._recursions(a, b)[..., self.order] * np.sqrt(self.weight)[:, None]
        rows = s.reshape(len(s), -1, self.columns)
        out = rows.transpose(0, 2, 1) @ rows
        return Moments(out, out)

    def gradient(
        self, x: Array, psi: Array, tau: Array, d_gram: Array, d_score: Array
    ) -> tuple[Array, Array]:
        """Carry derivatives from the information of one sequence to its signals.

        Parameters
        ----------
        x, psi, tau : ndarray
            (N, nx), (N,), (N, nu).
        d_gram, d_score : ndarray
            (columns, columns) symmetric, derivatives of a scalar in G and M.

        Returns
        -------
        tuple of ndarray
            (N, nx + 1) derivative in states and heading, (N, nu) in the inputs.
        """
        signals = self._signals(x[None], psi[None], tau[None])
        a, b = self._slopes(signals)
        s = self._recursions(a, b)[0]
        a = a[:, :, 0]
        back_to = np.argsort(self.order)
        d_f = (d_gram + d_score)[np.ix_(back_to, back_to)]
        costate = costates(a, 2.0 * self.weight[:, None] * (s @ d_f))[1:]
        samples, n = a.shape[-1], self.size
        d_a = costate @ s[:-1].transpose(0, 2, 1)
        d_b = costate[..., : self._driven]
        weights = np.concatenate([d_a.reshape(samples, -1), d_b.reshape(samples, -1)], axis=1)
        assert weights.shape[1] == n * n + n * self._driven
        out = np.empty((self._arguments, samples))
        self._backward([*[v[0] for v in signals], *np.ascontiguousarray(weights.T)], out)
        return out[: self.nx + 1].T, out[self.nx + 1 :].T
