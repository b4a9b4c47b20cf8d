"""The operating envelope of a ship, and the error of predictions over it that a trial would leave.

No real ship is in the family of its prior model. What the terms do not say is a smooth force of
motion and commands: in each equation potential terms g stand beside the primary terms φ, with a
prior variance τ² (DuMouchel and Jones, 1994). An estimate chooses its terms by the log, so where
a trial has been it follows this force, and elsewhere it does not know it. With the sensitivities
S of the trial's free run in the coefficients of both, output errors of variance σ² and the
prior's precision Λ, 0 and 1/τ², the trial leaves coefficients whose covariance is

    C = (G + Λ)⁻¹ = C G C + C Λ C,   G = Σ Sᵀ S / σ²,

of which the first part is by noise and the second what the trial does not tell. W are the moments
of the sensitivities of free runs over the envelope, so the mean squared error of predicted motion
is tr W C: small where the trial moves as the ship will be used, much and long.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiment_design.excitation.rollout import Motion, Rollout
from experiment_design.excitation.schedule import Schedule
from greybox.errors import InfeasibleError, UsageError
from greybox.model.noise import NoiseLevels
from greybox.model.predictor import Predictor
from greybox.model.run.step import StepModel
from greybox.numerics.linalg import scaled, sizes, trace_with_inverse
from greybox.numerics.recursion import propagate
from greybox.numerics.vectorised import Vectorised
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# constant commands that are tried, and after how many time scales the motion is steady
_TRIED, _SETTLING = 1000, 60.0
# speeds that are tried with nothing steered
_AHEAD = 20
# sequences that stand for the envelope, their length, and after how long a free run begins anew
_SEQUENCES, _LENGTH, _RUN = 40, 40.0, 20.0
# how long a command is held in them, in time scales: half a length to six lengths sailed
HOLDS = (0.5, 6.0)
# centres of the potential terms
_CENTRES = 40
# samples of a motion that its moments are summed over
_SAMPLES = 160
# share of the settings that count as straight, and how often one of these is held
_STRAIGHT, _COURSE = 0.1, 0.25
# how much more than a setting by its width it counts that shares of settings add up to one
_ADD_UP = 1e3
# slowest and fastest surge of the envelope, in what the prior's trial showed
_SLOWEST, _FASTEST = 0.55, 1.1
# what not even the potential terms say, as a share of the spread of each state
_UNSAID = 0.05
# share of the commands, and of the usual manoeuvres, under which the prior must hold the ship
HELD = 0.25
# least misfit, as a share of the spread of each state
_LEAST_MISFIT = 0.05


@dataclass(frozen=True)
class Envelope:
    """The operating envelope of a ship, and the predictions that a trial must support.

    Parameters
    ----------
    rollout : Rollout
        The prior model, from a steady motion of the envelope.
    begun : ndarray
        (nc,) constant commands that hold the ship in that motion: the first of `ahead`, or else the
        fastest of those that hold a course.
    ahead : ndarray
        (k, nc) constant commands that steer nothing and hold a course, fastest first; none where
        one command alone steers.
    predictor : Predictor
        Whose columns are the primary terms.
    variance : ndarray
        (nx,) of the output error at a sample, counted as if each were new.
    lower, upper : ndarray
        (nc,) range of each command.
    speeds : tuple of float
        Slowest and fastest surge [m/s].
    settings : ndarray
        (S, nc) constant commands that keep the ship within both, from a course at speed.
    lasting : ndarray
        (S,) for how long they do [s], at most the longest hold.
    reached : ndarray
        (S, nx) the motions that the ship then has [m/s, rad/s].
    straight : ndarray of int
        (m,) those of them that hold a course best.
    time_scale : float
        Time in which the ship sails her length [s].
    misfit : ndarray
        (nx,) error of the prior's free runs as a share of the spread of each state.
    spread : ndarray
        (nx,) standard deviation of each state over the envelope.
    """

    rollout: Rollout
    begun: Array
    ahead: Array
    predictor: Predictor
    variance: Array
    lower: Array
    upper: Array
    speeds: tuple[float, float]
    settings: Array
    lasting: Array
    reached: Array
    straight: NDArray[np.intp]
    time_scale: float
    misfit: Array
    spread: Array
    _features: _Features = field(repr=False)
    _moments: tuple[Array, ...] = field(repr=False)
    _precision: Array = field(repr=False)

    def misled(self, motion: Motion, draws: int) -> Array:
        """Return by how much forces drawn from the prior's misfit move one run, (D, N+1, nx).

        To first order, beside the primary terms that imitate them best over the envelope.
        """
        from scipy.interpolate import make_interp_spline

        (rows,), every = _sensitivities(self.rollout, self.predictor, self._features, motion)
        p = len(self.predictor.columns)
        beta = np.random.default_rng(53).standard_normal((draws, len(self._precision) - p))
        beta /= np.sqrt(self._precision[p:])
        imitated = beta @ _imitation(self._moments, p).T
        off = np.tensordot(np.concatenate([-imitated, beta], axis=1), rows, axes=(1, 2))
        known = np.minimum(every * np.arange(off.shape[1] + 1), motion.tau.shape[1])
        off = np.pad(off, ((0, 0), (1, 0), (0, 0)))
        at = np.arange(motion.tau.shape[1] + 1)
        return np.asarray(make_interp_spline(known, off, k=1, axis=1)(at))

    def errors(self, motion: Motion, known: Array | float = 0.0) -> tuple[Array, Array]:
        """Return the prediction errors that remain after estimates from R motions.

        Parameters
        ----------
        motion : Motion
        known : ndarray, optional
            (p + q, p + q) moments of other trials, as `information` gives them.

        Returns
        -------
        tuple of ndarray
            (R, nx) mean squared error of each state by noise, and by forces that the trial does
            not tell, in the variance of the state; inf where a run is unstable or a term not
            excited.
        """
        noise, unknown = np.full((2, len(motion.state), self.rollout.nx), np.inf)
        good, (gram,) = self._telling(motion, 1)
        left = self._covariance(gram, known)
        by_prior = left * self._precision @ left
        for i, w in enumerate(self._moments):
            noise[good, i] = np.einsum("ab,rab->r", w, left - by_prior)
            unknown[good, i] = np.einsum("ab,rab->r", w, by_prior)
        return noise, unknown

    def error_without_parts(self, motion: Motion, known: Array | float, parts: int) -> Array:
        """Return the error (R,) of both kinds with contiguous parts of R motions left out in turn.

        The mean over them and over the states; see `errors`.
        """
        found = np.full(len(motion.state), np.inf)
        good, grams = self._telling(motion, parts)
        found[good] = 0.0
        whole, w = grams.sum(axis=0), np.mean(self._moments, axis=0)
        for part in grams:
            units, outers = self._normal(whole - part, known)
            found[good] += [
                trace_with_inverse(w / outer, unit) / parts
                for unit, outer in zip(units, outers, strict=True)
            ]
        return found

    def _covariance(self, gram: Array, known: Array | float) -> Array:
        """Return the covariance (R, m, m) of coefficients that moments and the prior leave."""
        unit, outer = self._normal(gram, known)
        return np.asarray(np.linalg.inv(unit) / outer)

    def _normal(self, gram: Array, known: Array | float) -> tuple[Array, Array]:
        """Return G + Λ with a diagonal of one (R, m, m), and what it was divided by."""
        unit, outer = scaled(gram + np.diag(self._precision) + known)
        # a direction that is hardly excited stays what the prior says it is
        return unit + 1e-9 * np.eye(unit.shape[-1]), outer

    def information(self, motion: Motion) -> Array:
        """Return what output error tells of primary and potential terms, G (R, p + q, p + q)."""
        return np.asarray(self._by_part(motion, np.arange(len(motion.state)), 1)[0])

    def _telling(self, motion: Motion, parts: int) -> tuple[NDArray[np.intp], Array]:
        """Return which runs tell all primary terms, and the information of their parts."""
        stable = np.flatnonzero(motion.stable)
        grams = self._by_part(motion, stable, parts)
        whole = grams.sum(axis=0)
        size = np.diagonal(whole, axis1=1, axis2=2)[:, : len(self.predictor.columns)]
        excited = np.isfinite(whole).all(axis=(1, 2)) & (size > 0).all(axis=1)
        return stable[excited], grams[:, excited]

    def _by_part(self, motion: Motion, which: NDArray[np.intp], parts: int) -> Array:
        """Return the information of each contiguous part of some runs, (parts, R, m, m)."""
        motion = Motion(
            motion.state[which], motion.tau[which], motion.commands[which], motion.stable[which]
        )
        rows, every = _sensitivities(self.rollout, self.predictor, self._features, motion)
        rows /= np.sqrt(self.variance)[:, None]
        told = [
            part.reshape(len(which), part.shape[1] * part.shape[2], part.shape[3])
            for part in np.array_split(rows, parts, axis=1)
        ]
        return every * np.array([part.transpose(0, 2, 1) @ part for part in told])

    def within(self, motion: Motion) -> NDArray[np.bool_]:
        """Return at which samples of R motions surge is within that of the envelope, (R, N+1)."""
        return _within(motion, self.speeds)

    def pick(self, rng: np.random.Generator) -> tuple[Array, float]:
        """Draw one setting (nc,), any or now and then a course, and how long it may last [s]."""
        which = _picked(self.settings, self.straight, rng)
        return self.settings[which], float(self.lasting[which])

    def draw(self, samples: int, rng: np.random.Generator) -> Array:
        """Draw commands (N, nc) as the ship is used: settings that are held short and long."""
        dt = self.rollout.sample_time
        return _drawn(self.settings, self.lasting / dt, self.straight, samples,
                      self.time_scale / dt, rng)  # fmt: skip


def _ahead(vessel: Vessel, columns: Sequence[str], lower: Array, upper: Array) -> Array:
    """Return commands (k, nc) that steer nothing, speeds at the same share of their ranges.

    There are none where one command alone steers: two may hold a course against each other.
    """
    tunnels = {t.speed for t in vessel.thrusters if t.type == "tunnel"}
    steers = np.array([c in vessel.angle_commands or c in tunnels for c in columns])
    share = np.linspace(1.0, 0.0, _AHEAD if steers.sum() > 1 else 0)[:, None]
    return np.where(steers, np.clip(0.0, lower, upper), lower + (upper - lower) * share)


def _within(motion: Motion, speeds: tuple[float, float]) -> NDArray[np.bool_]:
    surge = motion.state[..., 0]
    return np.asarray((surge >= speeds[0]) & (surge <= speeds[1]) & motion.stable[:, None])


def _picked(settings: Array, straight: NDArray[np.intp], rng: np.random.Generator) -> int:
    if rng.random() < _COURSE:
        return int(straight[rng.integers(len(straight))])
    return int(rng.integers(len(settings)))


def _drawn(
    settings: Array,
    lasting: Array,
    straight: NDArray[np.intp],
    samples: int,
    scale: float,
    rng: np.random.Generator,
) -> Array:
    out = np.empty((samples, settings.shape[1]))
    first = 0
    while first < samples:
        which = _picked(settings, straight, rng)
        held = min(scale * float(np.exp(rng.uniform(*np.log(HOLDS)))), lasting[which])
        last = first + max(1, round(held))
        out[first:last], first = settings[which], last
    return out


class _Features:
    """Primary regressors of a predictor, and potential terms, along motions.

    The potential terms are the Nyström features of a Gaussian process of states and commands
    (Rasmussen and Williams, 2006, section 8.1), the same in each equation: with independent
    coefficients of one variance their sum has the covariance exp(−|s − s'|² / 2 m) of signals s
    in their standard deviations, m of them.
    """

    def __init__(self, rollout: Rollout, predictor: Predictor, signals: Array, seed: int) -> None:
        from scipy.cluster.vq import kmeans2

        step = StepModel.free(rollout.structure, rollout.integrator)
        s = step.symbolic
        terms = s.at(ca.vertcat(*predictor.expressions), rollout.d, rollout.theta,
                     rollout.sample_time)  # fmt: skip
        terms = ca.substitute(terms, s.air, ca.DM.zeros(2))
        self._terms = Vectorised(
            ca.vertsplit(terms), [*ca.vertsplit(s.x), s.psi, *ca.vertsplit(s.tau)]
        )
        self._mean, std = signals.mean(axis=0), signals.std(axis=0)
        self._std = np.where(std > 0, std, 1.0)
        scaled = (signals - self._mean) / self._std
        self._centres = kmeans2(scaled, _CENTRES, minit="++", seed=seed)[0]
        self._width = float(signals.shape[1])
        values, vectors = np.linalg.eigh(self._kernel(self._centres))
        # those of least variance, together less than what not even potential terms say
        kept = np.cumsum(values) > _UNSAID**2 * values.sum()
        self._root = vectors[:, kept] / np.sqrt(values[kept])
        self.size = self._root.shape[1]

    def _kernel(self, signals: Array) -> Array:
        square = ((signals**2).sum(axis=-1)[..., None] + (self._centres**2).sum(axis=1)
                  - 2 * signals @ self._centres.T)  # fmt: skip
        return np.asarray(np.exp(-np.maximum(square, 0.0) / (2 * self._width)))

    def __call__(self, x: Array, psi: Array, tau: Array, commands: Array) -> tuple[Array, Array]:
        """Return regressors (p, R, N) and potential terms (k, R, N)."""
        rows = [x[..., i] for i in range(x.shape[-1])]
        rows += [psi, *[tau[..., i] for i in range(tau.shape[-1])]]
        z = np.empty((self._terms.size, *psi.shape))
        self._terms([np.ascontiguousarray(r) for r in rows], z)
        signals = (np.concatenate([x, commands], axis=-1) - self._mean) / self._std
        return z, np.moveaxis(self._kernel(signals) @ self._root, -1, 0)


def build_envelope(
    rollout: Rollout,
    predictor: Predictor,
    noise: NoiseLevels,
    schedule: Schedule,
    commands: Mapping[str, tuple[float, float]],
    speeds: tuple[float, float] | None,
    misfit: Array,
    seed: int,
    shown: Array | None = None,
) -> Envelope:
    """Compute the operating envelope of a ship from her prior model.

    Parameters
    ----------
    rollout : Rollout
        The prior model.
    predictor : Predictor
        Its primary terms.
    noise : NoiseLevels
    schedule : Schedule
        With the commands' limits.
    commands : mapping of str to (float, float)
        Range of each command that is used, as far as its limits go: speeds in the log's unit,
        angles [rad].
    speeds : (float, float), optional
        Slowest and fastest surge that the prior's trial showed [m/s].
    misfit : ndarray
        (nx,) error of the prior's free runs as a share of the spread of each state.
    seed : int
    shown : ndarray, optional
        (K, nc) settings of all commands that the prior's trial showed: what the ship is used for
        lies between them, which of a ship with two propellers is less than all that both could do;
        nan where the range of a command says it instead. By default every range does.

    Raises
    ------
    UsageError
        A range lies beyond the limits of its command.
    InfeasibleError
        The prior model holds the ship under too few of the commands.
    """
    rng = np.random.default_rng([37, seed])
    limits = zip(schedule.commands, schedule.lower, schedule.upper, strict=True)
    lower, upper = np.array(
        [(max(a, commands[n][0]), min(b, commands[n][1])) for n, a, b in limits]
    ).T
    for i in np.flatnonzero(lower > upper):
        name, a, b = schedule.commands[i], schedule.lower[i], schedule.upper[i]
        raise UsageError(
            f"the envelope of {name}, {commands[name][0]:g} to {commands[name][1]:g}, lies beyond "
            f"its limits, {a:g} to {b:g}: name a range within them, such as --envelope "
            f"{name}={a:g}:{b:g}."
        )
    dt, nx, length = rollout.sample_time, rollout.nx, rollout.vessel.length
    tried = lower + (upper - lower) * rng.random((_TRIED, len(lower)))
    if shown is not None:
        tried = _between(tried, np.clip(shown, lower, upper), upper - lower)
    surge = (-np.inf, np.inf)
    fast = 1.0 if speeds is None else max(abs(speeds[0]), abs(speeds[1]))
    if speeds is not None and speeds[0] > 0:
        surge = (_SLOWEST * speeds[0], _FASTEST * speeds[1])
    scale = max((length or 20 * fast) / fast, 4 * dt)
    settled = rollout.run(np.repeat(tried[:, None], int(_SETTLING * scale / dt), axis=1))
    steady = settled.state[:, -1, :nx]
    if speeds is None:
        fast = float(np.quantile(steady[settled.stable, 0], 0.98)) if settled.stable.any() else 1.0
        surge = (0.2 * fast, np.inf)
        scale = max((length or 20 * fast) / fast, 4 * dt)
    held = _within(settled, surge)[:, -1]
    if held.any():
        # where a crew would begin: on a course, at speed
        course = _straight(steady[held])
        best = course[int(steady[held][course, 0].argmax())]
        begun, start, ahead = tried[held][best], steady[held][best], tried[:0]
        plain = _ahead(rollout.vessel, schedule.commands, lower, upper)
        if len(plain):
            settled = rollout.run(np.repeat(plain[:, None], settled.tau.shape[1], axis=1))
            x, size = settled.state[:, -1, :nx], steady[held].std(axis=0)
            # as straight as the fastest one that was drawn, and no faster
            good = _within(settled, surge)[:, -1] & (x[:, 0] <= start[0])
            good &= (np.abs(x[:, 1:]) <= np.abs(start[1:]) + 0.1 * size[1:]).all(axis=1)
            ahead = plain[good]
            if good.any():
                begun, start = ahead[0], x[good][0]
        rollout = Rollout(
            rollout.vessel, rollout.structure, rollout.theta, rollout.d,
            np.append(start, 0.0), dt, rollout.integrator,
        )  # fmt: skip
        motion = rollout.run(np.repeat(tried[:, None], int(HOLDS[1] * scale / dt), axis=1))
        # until when a setting keeps the ship within the envelope, at most the longest hold
        kept = np.logical_and.accumulate(_within(motion, surge), axis=1).sum(axis=1) - 1
        held = kept >= HOLDS[0] * scale / dt
    if held.mean() < HELD:
        raise InfeasibleError(
            f"the prior model holds the ship within the speeds of its own trial under "
            f"{100 * held.mean():.0f} % of the commands, {100 * HELD:.0f} % are needed to plan "
            f"with it: estimate it on a longer trial, or use --prior none."
        )
    settings, kept = tried[held], kept[held]
    reached = motion.state[held, kept, :nx]
    straight = _straight(reached)
    samples = int(_LENGTH * scale / dt)
    used = np.array(
        [_drawn(settings, kept, straight, samples, scale / dt, rng) for _ in range(_SEQUENCES)]
    )
    motion = rollout.run(used)
    inside = _within(motion, surge)[:, :-1]
    if inside.mean() < HELD:
        raise InfeasibleError(
            f"the prior model leaves the speeds of its own trial for "
            f"{100 * (1 - inside.mean()):.0f} % of the usual manoeuvres: estimate it on a longer "
            f"trial, or use --prior none."
        )
    # a run that has left them once says nothing of the envelope
    inside = np.logical_and.accumulate(inside, axis=1)
    x = motion.state[:, :-1, :nx][inside]
    signals = np.concatenate([x, motion.commands[inside]], axis=-1)
    features = _Features(rollout, predictor, signals[::7], seed)
    rows, every = _sensitivities(rollout, predictor, features, motion, int(_RUN * scale / dt))
    spread = x.std(axis=0)
    spread[spread == 0] = 1.0
    s = rows[inside[:, ::every]]
    moments = tuple(s[:, i].T @ s[:, i] / (len(s) * spread[i] ** 2) for i in range(nx))
    share = np.maximum(misfit, _LEAST_MISFIT)
    tau = _prior_variance(moments, len(predictor.columns), share)
    # an error of a step lasts about a time scale, and so does what no term says
    lasting = scale / dt
    by_step = lasting * np.asarray(noise.process, float) ** 2 + (_UNSAID * spread) ** 2
    variance = np.asarray(noise.measurement, float) ** 2 + lasting * by_step
    precision = np.concatenate([np.zeros(len(predictor.columns)), 1 / tau])
    return Envelope(
        rollout, begun, ahead, predictor, variance, lower, upper, surge, settings, kept * dt,
        reached, straight, scale, share, spread, features, moments, precision,
    )  # fmt: skip


def _between(tried: Array, shown: Array, width: Array) -> Array:
    """Return settings (M, nc), moved to the nearest ones between those that were shown, (K, nc).

    Nearest in units of a width of each command; those that are nan in `shown` stay.
    """
    from scipy.optimize import nnls

    bound = np.flatnonzero(~np.isnan(shown).any(axis=0))
    if not len(bound):
        return tried
    unit = np.where(width > 0, width, 1.0)[bound]
    # shares of the shown settings that add up to one
    rows = np.vstack([(shown[:, bound] / unit).T, np.full(len(shown), _ADD_UP)])
    out = tried.copy()
    for setting in out:
        shares, _ = nnls(rows, np.append(setting[bound] / unit, _ADD_UP))
        setting[bound] = shares @ shown[:, bound] / shares.sum()
    return out


def _straight(reached: Array) -> NDArray[np.intp]:
    """Return which of some motions (S, nx) hold a course best."""
    aside = np.abs(reached[:, 1:]) / np.maximum(reached[:, 1:].std(axis=0), 1e-12)
    return np.argsort(aside.sum(axis=1), kind="stable")[: max(1, round(_STRAIGHT * len(reached)))]


def _sensitivities(
    rollout: Rollout,
    predictor: Predictor,
    features: _Features,
    motion: Motion,
    run: int | None = None,
) -> tuple[Array, int]:
    """Return sensitivities (R, N, nx, p + q) of free runs, and samples from one to the next.

    A free run begins anew after `run` samples, by default never. Between two of them the slopes
    and terms of the first stand.
    """
    nx, states, samples = rollout.nx, rollout.structure.states, motion.tau.shape[1]
    every = max(1, samples // _SAMPLES)
    at = np.arange(0, samples, every)
    x, tau, commands = motion.state[:, at], motion.tau[:, at], motion.commands[:, at]
    z, g = features(x[..., :nx], x[..., nx], tau, commands)
    thinned = Motion(motion.state[:, [*at, -1]], tau, commands, motion.stable)
    slopes = rollout.slopes(thinned)[:nx, :nx].transpose(2, 3, 0, 1)
    over, gained = np.broadcast_to(np.eye(nx), slopes.shape), np.zeros(slopes.shape)
    for _ in range(every):
        over, gained = slopes @ over, gained + over
    p, k = len(z), len(g)
    pushed = np.zeros((*slopes.shape[:3], p + nx * k))
    for i, name in enumerate(states):
        rows = predictor.equation(name)
        by = gained[..., i, None]
        pushed[..., rows] += by * np.moveaxis(z[rows], 0, -1)[:, :, None]
        pushed[..., p + i * k : p + (i + 1) * k] = by * np.moveaxis(g, 0, -1)[:, :, None]
    if run is not None:
        over = over.copy()
        over[:, :: max(1, run // every)] = 0.0
    found = propagate(over, pushed, np.zeros((*pushed.shape[:1], *pushed.shape[2:])))
    return found[:, 1:], every


def _imitation(moments: tuple[Array, ...], p: int) -> Array:
    """Return the coefficients (p, q) of the primary terms that imitate each potential one best."""
    total = np.sum(moments, axis=0)
    size, unit = sizes(total), scaled(total)[0]
    best = np.linalg.solve(unit[:p, :p] + 1e-9 * np.eye(p), unit[:p, p:])
    return np.asarray(best * size[p:] / size[:p, None])


def _prior_variance(moments: tuple[Array, ...], p: int, share: Array) -> Array:
    """Return the variance (q,) of the potential terms' coefficients, one for each equation.

    With it the best coefficients of the p primary terms leave the misfit that the prior has shown.
    """
    from scipy.optimize import nnls

    best, nx = _imitation(moments, p), len(moments)
    k = best.shape[1] // nx
    left = np.empty((nx, nx))
    for i, w in enumerate(moments):
        rest = w[p:, p:] - best.T @ w[:p, p:] - w[p:, :p] @ best + best.T @ w[:p, :p] @ best
        left[i] = np.maximum(np.diag(rest), 0.0).reshape(nx, k).sum(axis=1)
    found, _ = nnls(left / share[:, None] ** 2, np.ones(nx))
    # an equation that others could speak for keeps a tenth of what it alone would need
    floor = 0.1 * share**2 / np.maximum(np.diag(left), 1e-300)
    return np.repeat(np.maximum(found, floor), k)
