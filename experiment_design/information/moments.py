"""Moments of the zero-mean IV estimate that a sequence would give, and their derivatives.

With Z the centred noise-free regressors of the equations, block by block, the
estimate of (2.21) with zero-mean instruments (4.63) has the covariance

    C = G⁻¹ M G⁻¹,   G = Σ Z Zᵀ,   M = Σ Z R Zᵀ,

R being the covariance of the equation error. That error is a moving average,
ε(k) = e(k+1) − A(k) e(k) + w(k) with A = ∂x⁺/∂x, so that M is a Gram matrix
itself: M = Σ S(k) Σe S(k)ᵀ + Σ Z(k) Σw Z(k)ᵀ with S(k) = Z(k−1) − Z(k) A(k).
Noise of the measured heading and wind enters through −∂f/∂ψ and −∂f/∂ν_q and
has no memory. Both sums add over trials, each centred by itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiment_design.excitation.rollout import Motion
from greybox.model.disturbances import velocity_through
from greybox.model.noise import NoiseLevels
from greybox.model.predictor import Predictor
from greybox.model.run.step import Integrator, StepModel
from greybox.model.structure import Structure
from greybox.numerics.vectorised import Vectorised

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Moments:
    """G and M of R sequences, (R, p, p) each, all equations together."""

    gram: Array
    score_covariance: Array

    def __add__(self, other: Moments) -> Moments:
        return Moments(self.gram + other.gram, self.score_covariance + other.score_covariance)


class InformationModel(Protocol):
    """Sums over samples from which the covariance follows."""

    def __call__(self, x: Array, psi: Array, tau: Array) -> Moments:
        """Return the sums of R sequences."""
        ...

    def gradient(
        self, x: Array, psi: Array, tau: Array, d_gram: Array, d_score: Array
    ) -> tuple[Array, Array]:
        """Carry derivatives in the sums back to states with heading, and inputs."""
        ...


def moments_of(
    information: InformationModel, motion: Motion, known: Moments | None = None
) -> Moments:
    """Return the sums of R motions, those of other trials included."""
    nx = motion.state.shape[2] - 3
    own = information(motion.state[:, :-1, :nx], motion.state[:, :-1, nx], motion.tau)
    return own if known is None else own + known


def measured_air(structure: Structure, north: ca.SX, east: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the velocity through the air that would be measured, in the structure's symbols."""
    s = structure.symbols
    states = dict(zip(structure.states, ca.vertsplit(s.x), strict=True))
    return velocity_through(states, s.psi, north, east)


class MomentProgram:
    """Compiled sums of one predictor at one prior model.

    Parameters
    ----------
    predictor : Predictor
    theta : ndarray
        (p_structure,) prior parameters.
    d : ndarray
        (nd,) disturbance means that the trial is expected to meet [m/s].
    noise : NoiseLevels
    sample_time : float
        [s]
    integrator : {"euler", "rk4"}
        Of the step whose slopes say how a sample's noise enters the next equation error.
    white : bool
        Take the equation error as white with its average variance: M ∝ G.
    gust : ndarray, optional
        (N, 2) what the wind adds to its mean at each sample, north and east [m/s].
        A measured wind that never varies is no regressor of its own: the terms of
        the air are then combinations of those of the water.
    """

    def __init__(
        self,
        predictor: Predictor,
        theta: Array,
        d: Array,
        noise: NoiseLevels,
        sample_time: float,
        *,
        integrator: Integrator = "euler",
        white: bool = False,
        gust: Array | None = None,
    ) -> None:
        structure = predictor.structure
        step = StepModel.free(structure, integrator, air_measured=predictor.air_measured)
        s = step.symbolic
        self.predictor = predictor
        self.white = white
        self.nx = len(structure.states)
        self.equations = [predictor.equation(name) for name in structure.states]
        self.columns = len(predictor.columns)
        # the velocity through the air that would be measured, where it is a regressor
        air = s.air
        blow = ca.SX(0, 1)
        self.gust = gust
        if predictor.air_measured:
            blow = ca.SX.sym("gust", 2)
            air = ca.vertcat(*measured_air(structure, d[2] + blow[0], d[3] + blow[1]))
        x_next = s.next_state[: self.nx]
        channels: list[tuple[ca.SX, float, int | None]] = [
            (s.x[i], float(noise.measurement[i]), i) for i in range(self.nx)
        ]
        if noise.heading > 0 and np.any(d):
            channels.append((s.psi, noise.heading, None))
        if noise.wind > 0 and predictor.air_measured:
            channels += [(s.air[i], noise.wind, None) for i in range(2)]
        slopes = ca.horzcat(*[ca.jacobian(x_next, symbol) for symbol, _, _ in channels])
        fixed = [
            ca.substitute(s.at(e, d, theta, sample_time), s.air, air)
            for e in (ca.vertcat(*predictor.expressions), slopes)
        ]
        # of each noise channel, and the state whose next sample it stands in too, if any
        self.channel_std = np.array([std for _, std, _ in channels])
        self.channel_own = tuple(own for _, _, own in channels)
        self.process_std = np.asarray(noise.process, float)
        self._channels = len(channels)
        self._inputs = len(structure.inputs)
        if gust is None and blow.numel():
            fixed = [ca.substitute(e, blow, ca.DM.zeros(2)) for e in fixed]
            blow = ca.SX(0, 1)
        moving = ca.vertsplit(blow) if blow.numel() else []
        scalars = [*ca.vertsplit(s.x), s.psi, *ca.vertsplit(s.tau), *moving]
        z, a = fixed
        outputs = ca.vertcat(z, ca.vec(a.T))
        self._forward = Vectorised(ca.vertsplit(outputs), scalars)
        weights = ca.SX.sym("w", outputs.numel())
        arguments = ca.vertcat(*scalars)
        back = ca.jtimes(outputs, arguments, weights, True)
        self._backward = Vectorised(ca.vertsplit(back), [*scalars, *ca.vertsplit(weights)])
        self._arguments = len(scalars)
        self._last: tuple[Array, Array, Array, tuple[list[Array], Array, Array, Array]] | None = (
            None
        )
        # what IPOPT's interval functions are built from
        self.symbols = (s.x, s.psi, s.tau)
        self.expressions = (z, a)

    def _signals(self, x: Array, psi: Array, tau: Array) -> list[Array]:
        return [
            *[np.ascontiguousarray(x[..., i]) for i in range(self.nx)],
            np.ascontiguousarray(psi),
            *[np.ascontiguousarray(tau[..., i]) for i in range(tau.shape[-1])],
            *([] if self.gust is None else [self.gust[: x.shape[-2], i] for i in range(2)]),
        ]

    def regressors(self, x: Array, psi: Array, tau: Array) -> tuple[Array, Array]:
        """Return regressors (p, R, N), not centred, and slopes (nx, channels, R, N).

        The slopes are those of the next state in what is measured with noise: the
        states first, the others without memory.
        """
        return self._samples(self._signals(x, psi, tau))

    def _samples(self, signals: list[Array]) -> tuple[Array, Array]:
        shape = signals[0].shape
        out = np.empty((self._forward.size, *shape))
        self._forward(signals, out)
        return out[: self.columns], out[self.columns :].reshape(self.nx, self._channels, *shape)

    def _prepare(self, x: Array, psi: Array, tau: Array) -> tuple[list[Array], Array, Array, Array]:
        """Return signals, centred regressors, slopes and scattered noise.

        A climb asks for the sums and the derivatives of the same sequence one
        after the other: the last single one is kept.
        """
        last = self._last
        if (
            len(x) == 1
            and last is not None
            and np.array_equal(last[0], x)
            and np.array_equal(last[1], psi)
            and np.array_equal(last[2], tau)
        ):
            return last[3]
        signals = self._signals(x, psi, tau)
        z, a = self._samples(signals)
        z -= z.mean(axis=-1, keepdims=True)
        s = np.empty(0) if self.white else self._scattered(z, a)
        found = (signals, z, a, s)
        if len(x) == 1:
            self._last = (x.copy(), psi.copy(), tau.copy(), found)
        return found

    def _scattered(self, z: Array, a: Array) -> Array:
        """Return what each noise value adds to the scores, (R, p, channels·(N+1))."""
        runs, samples = z.shape[1:]
        s = np.zeros((runs, self.columns, self._channels, samples + 1))
        for i, mine in enumerate(self.equations):
            rows = slice(mine[0], mine[-1] + 1)
            part = z[rows].transpose(1, 0, 2)
            for c in range(self._channels):
                block = s[:, rows, c]
                np.multiply(part, -a[i, c][:, None, :], out=block[..., :samples])
                if self.channel_own[c] == i:
                    block[..., 1:] += part
                block *= self.channel_std[c]
        return s.reshape(runs, self.columns, -1)

    def _gram(self, z: Array) -> Array:
        gram = np.zeros((z.shape[1], self.columns, self.columns))
        for mine in self.equations:
            rows = slice(mine[0], mine[-1] + 1)
            part = np.ascontiguousarray(z[rows].transpose(1, 0, 2))
            gram[:, rows, rows] = part @ part.transpose(0, 2, 1)
        return gram

    def _variances(self, a: Array) -> Array:
        """Return the average variance of each equation's error, (R, nx)."""
        own = (
            np.array([1.0 if o is not None else 0.0 for o in self.channel_own])
            * self.channel_std**2
        )
        mean = (a**2).mean(axis=-1)
        spread = np.einsum("icr,c->ri", mean, self.channel_std**2)
        return np.asarray(spread + own[: self.nx] + self.process_std**2)

    def __call__(self, x: Array, psi: Array, tau: Array) -> Moments:
        """Return the moments of R sequences.

        Parameters
        ----------
        x : ndarray
            (R, N, nx) states, the first N of a run.
        psi : ndarray
            (R, N) heading [rad].
        tau : ndarray
            (R, N, nu) generalised inputs.
        """
        _, z, a, s = self._prepare(x, psi, tau)
        gram = self._gram(z)
        weights = (
            self._variances(a)
            if self.white
            else np.broadcast_to(self.process_std**2, (len(gram), self.nx))
        )
        score = np.zeros_like(gram)
        for i, mine in enumerate(self.equations):
            rows = slice(mine[0], mine[-1] + 1)
            score[:, rows, rows] = gram[:, rows, rows] * weights[:, i, None, None]
        if not self.white:
            score += s @ s.transpose(0, 2, 1)
        return Moments(gram, score)

    def gradient(
        self, x: Array, psi: Array, tau: Array, d_gram: Array, d_score: Array
    ) -> tuple[Array, Array]:
        """Carry derivatives from the moments of one sequence to its signals.

        Parameters
        ----------
        x, psi, tau : ndarray
            (N, nx), (N,), (N, nu).
        d_gram, d_score : ndarray
            (p, p) symmetric, derivatives of a scalar in G and M.

        Returns
        -------
        tuple of ndarray
            (N, nx + 1) derivative in states and heading, (N, nu) in the inputs.
        """
        signals, z, a, scattered = self._prepare(x[None], psi[None], tau[None])
        samples = z.shape[2]
        back = np.zeros((self._forward.size, samples))
        d_z = back[: self.columns]
        d_a = back[self.columns :].reshape(self.nx, self._channels, samples)
        weights = self._variances(a)[0] if self.white else self.process_std**2
        if not self.white:
            q = (2.0 * d_score @ scattered[0]).reshape(self.columns, self._channels, samples + 1)
            q *= self.channel_std[None, :, None]
        for i, mine in enumerate(self.equations):
            rows = slice(mine[0], mine[-1] + 1)
            part = z[rows, 0]
            inner = d_gram[rows, rows] + weights[i] * d_score[rows, rows]
            d_z[rows] += 2.0 * inner @ part
            if self.white:
                total = float((d_score[rows, rows] * (part @ part.T)).sum())
                for c in range(self._channels):
                    d_a[i, c] = 2.0 * total * self.channel_std[c] ** 2 * a[i, c, 0] / samples
                continue
            for c in range(self._channels):
                mine_q = q[rows, c]
                d_z[rows] -= a[i, c, 0] * mine_q[:, :samples]
                d_a[i, c] = -(part * mine_q[:, :samples]).sum(axis=0)
                if self.channel_own[c] == i:
                    d_z[rows] += mine_q[:, 1:]
        d_z -= d_z.mean(axis=1, keepdims=True)
        out = np.empty((self._arguments, samples))
        first = [v[0] if v.ndim > 1 else v for v in signals]
        self._backward([*first, *back], out)
        return out[: self.nx + 1].T, out[self.nx + 1 : self.nx + 1 + self._inputs].T
