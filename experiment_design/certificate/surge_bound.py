"""The best that a trial in surge alone could reach, by dynamic programming.

With one state and one force, the sums G and M over a trial are sums over holds
of terms that depend on the speed at the start of the hold, on its force and on
the force before (the equation error remembers one sample). With the regressors
extended by a constant, z̃ = (z, 1), centring needs no more than these sums. Any
linear functional of them is maximised over all sequences by dynamic programming,
and the criterion over mixtures of sequences by repeated linearisation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from experiment_design.certificate.mixture import best_weights
from experiment_design.excitation.rollout import Rollout
from experiment_design.information.moments import MomentProgram, Moments
from experiment_design.request.problem import TrialProblem
from greybox.model.run.simulation import simulate

Array = NDArray[np.float64]

# speeds and forces of the grid
_SPEEDS, _FORCES = 72, 37
_STARTS = 4
_STEPS = 25
# gain of one more step, in units of the criterion, that ends the improvement
_ENOUGH = 2e-3
# commands at which the extremes of the force are looked for
_PROBES = 40_000
# by how much of its span the range of speeds is widened
_WIDER = 2e-3


@dataclass(frozen=True)
class SurgeBound:
    """Upper bound of the criterion over all sequences.

    Parameters
    ----------
    bound, gap : float
        Bound, and its part that the best mixture did not reach.
    grid : float
        How far a grid twice as fine moved it; part of the bound.
    spread : float
        Largest difference between the starts.
    starts, mixture, evaluations : int
        Starts, sequences in the best mixture, programmes solved.
    """

    bound: float
    gap: float
    grid: float
    spread: float
    starts: int
    mixture: int
    evaluations: int


def _along(slope: Moments, sums: Moments) -> float:
    """Return the linear functional of sums that a derivative in them is."""
    return float(
        (slope.gram * sums.gram).sum() + (slope.score_covariance * sums.score_covariance).sum()
    )


def why_not_surge(problem: TrialProblem) -> str:
    """Return why dynamic programming does not apply, empty where it does."""
    scenario = problem.scenarios[0]
    rollout, information = scenario.rollout, scenario.information
    if rollout.structure.states != ("u",) or rollout.structure.inputs != ("taux",):
        return "the model has more than one state or force"
    if (
        not isinstance(information, MomentProgram)
        or information.white
        or information.gust is not None
    ):
        return "the information is not a sum over samples"
    if max(problem.schedule.ramp) > 1 or problem.schedule.limited:
        return "commands are ramped"
    return ""


def bound_surge(problem: TrialProblem, unit: Array, seed: int = 0) -> SurgeBound:
    """Bound the criterion of a trial in surge over all sequences within the limits.

    Parameters
    ----------
    problem : TrialProblem
        For which `why_not_surge` is empty.
    unit : ndarray
        (K, nc) unit coordinates of a design, one of the starts.
    seed : int
        Of the other starts.
    """
    rng = np.random.default_rng([17, seed])
    trial = _Trial(problem)
    coarse = _Programme(trial, _SPEEDS, _FORCES)
    commands = problem.levels(unit)
    holds = problem.schedule.holds
    ends = np.array([trial.lowest, trial.highest])
    starts = [trial.force(commands)[None]]
    starts += [ends[(rng.random((6, holds)) < 0.5).astype(int)] for _ in range(_STARTS - 1)]
    found = [_improve(trial, coarse, forces) for forces in starts]
    values = [f[0] for f in found]
    value, mixed, slope, members, _ = found[int(np.argmax(values))]
    evaluations = sum(f[4] for f in found) + 2
    fine = _Programme(trial, 2 * _SPEEDS, 2 * _FORCES - 1)
    base = _along(slope, mixed)
    best, rough = fine.maximise(slope)[0], coarse.maximise(slope)[0]
    grid = abs(best - rough)
    gap = max(best, rough) - base
    return SurgeBound(
        value + max(gap, 0.0) + grid, max(gap, 0.0), grid, float(max(values) - min(values)),
        len(starts), members, evaluations,
    )  # fmt: skip


class _Trial:
    """One trial in surge as a function of the forces of its holds."""

    def __init__(self, problem: TrialProblem) -> None:
        scenario = problem.scenarios[0]
        information = scenario.information
        assert isinstance(information, MomentProgram)
        self.problem = problem
        self.rollout: Rollout = scenario.rollout
        self.information: MomentProgram = information
        self.known = problem.known[0] if problem.known else None
        self.samples, self.hold = problem.schedule.samples, problem.schedule.hold
        self.variance = information.channel_std**2
        self.process = float(information.process_std[0] ** 2)
        self.lowest, self.highest = self._extremes()
        self.slowest, self.fastest = self._reach()

    def force(self, commands: Array) -> Array:
        """Return the surge force (...) of commands (..., nc)."""
        return self.rollout.forces(commands)[..., 0]

    def _extremes(self) -> tuple[float, float]:
        s = self.problem.schedule
        count = max(3, int(_PROBES ** (1 / len(s.commands)))) // 2 * 2 + 1
        count = min(count, 41)
        axes = [np.linspace(a, b, count) for a, b in zip(s.lower, s.upper, strict=True)]
        force = self.force(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
        return float(force.min()), float(force.max())

    def run(self, start: Array, tau: Array) -> Array:
        """Return speeds (R, n+1) from start (R,) under forces (R, n)."""
        rollout = self.rollout
        samples = tau.shape[1]
        d = np.broadcast_to(rollout.d, (samples, rollout.d.size)) if rollout.d.any() else None
        psi = np.full(samples + 1, rollout.start[-1])
        free = simulate(
            rollout.structure, rollout.theta, start[:, None], tau[..., None],
            rollout.sample_time, psi=psi, d=d, integrator=rollout.integrator,
        )  # fmt: skip
        return np.asarray(free.x[..., 0])

    def _reach(self) -> tuple[float, float]:
        """Return the range of speeds that any forces can reach."""
        low = high = float(self.rollout.start[0])
        for _ in range(self.samples):
            u = np.repeat(np.linspace(low, high, 21), 2)
            after = self.run(u, np.resize([self.lowest, self.highest], u.size)[:, None])[:, 1]
            new = min(low, float(after.min())), max(high, float(after.max()))
            if new[0] > low - 1e-6 and new[1] < high + 1e-6:
                break
            low, high = new
        wider = _WIDER * (high - low)
        return low - wider, high + wider

    def extended(self, u: Array, tau: Array) -> tuple[Array, Array]:
        """Return z̃ (..., q) and slopes (channels, ...) at speeds and forces of one shape."""
        flat = u.reshape(1, -1)
        psi = np.full(flat.shape, self.rollout.start[-1])
        z, a = self.information.regressors(flat[..., None], psi, tau.reshape(1, -1, 1))
        full = np.concatenate([z[:, 0], np.ones_like(flat)])
        return full.T.reshape(*u.shape, -1), a[0, :, 0].reshape(-1, *u.shape)

    def sums(self, forces: Array) -> list[Moments]:
        """Return the extended sums of sequences of forces (R, K)."""
        tau = np.repeat(forces, self.hold, axis=1)[:, : self.samples]
        u = self.run(np.full(len(tau), self.rollout.start[0]), tau)[:, :-1]
        z, a = self.extended(u, tau)
        out = []
        for i in range(len(tau)):
            s = np.zeros((z.shape[2], self.samples + 1))
            s[:, :-1] = -a[0, i] * z[i].T
            s[:, 1:] += z[i].T
            gram = z[i].T @ z[i]
            score = self.variance[0] * s @ s.T + self.process * gram
            for c in range(1, len(a)):
                score += self.variance[c] * (z[i].T * a[c, i] ** 2) @ z[i]
            out.append(Moments(gram, score))
        return out

    def value(self, sums: Moments) -> tuple[float, Moments]:
        """Return the criterion of extended sums, and its derivatives in them."""
        mean = sums.gram[:-1, -1] / sums.gram[-1, -1]
        p = np.hstack([np.eye(mean.size), -mean[:, None]])
        moments = Moments((p @ sums.gram @ p.T)[None], (p @ sums.score_covariance @ p.T)[None])
        if self.known is not None:
            moments = moments + self.known
        value, d_gram, d_score = self.problem.criterion.gradient(moments)
        gram, score = p.T @ d_gram @ p, p.T @ d_score @ p
        # the mean that the scores are centred by moves with the sums
        turn = -2.0 * d_score @ (p @ sums.score_covariance)[:, -1] / sums.gram[-1, -1]
        gram[:-1, -1] += turn / 2
        gram[-1, :-1] += turn / 2
        gram[-1, -1] -= turn @ mean
        return value, Moments(gram, score)


class _Programme:
    """Maximises linear functionals of the extended sums on a grid of speed and force."""

    def __init__(self, trial: _Trial, speeds: int, forces: int) -> None:
        self.trial = trial
        self.u = np.linspace(trial.slowest, trial.fastest, speeds)
        self.tau = np.linspace(trial.lowest, trial.highest, forces)
        u, tau = np.repeat(self.u, forces), np.tile(self.tau, speeds)
        path = trial.run(u, np.repeat(tau[:, None], trial.hold, axis=1))
        shape = (speeds, forces, trial.hold)
        held = np.broadcast_to(tau[:, None], path[:, :-1].shape)
        z, self.a = trial.extended(path[:, :-1].reshape(shape), held.reshape(shape))
        self.z = z
        place = (path[:, -1].reshape(speeds, forces) - self.u[0]) / (self.u[1] - self.u[0])
        self.cell = np.clip(place.astype(int), 0, speeds - 2)
        self.share = place - self.cell
        # the sample before a hold, from the speed that it led to and its force
        span = self.u[-1] - self.u[0]
        wide = np.linspace(self.u[0] - span, self.u[-1] + span, 8 * speeds)
        before = np.empty((speeds, forces))
        for j, t in enumerate(self.tau):
            after = trial.run(wide, np.full((wide.size, 1), t))[:, 1]
            order = np.maximum.accumulate(after)
            before[:, j] = np.interp(self.u, order, wide)
        self.before = trial.extended(before, np.broadcast_to(self.tau, before.shape))[0]

    def maximise(self, slope: Moments) -> tuple[float, Array]:
        """Return the largest ⟨slope, sums⟩ over all sequences, and its forces (K,)."""
        trial = self.trial
        score = trial.variance[0] * slope.score_covariance
        plain = slope.gram + trial.process * slope.score_covariance
        z, a = self.z, self.a
        along = np.einsum("ijkc,ijkc->ijk", z @ plain, z)
        noise = np.einsum("ijkc,ijkc->ijk", z @ slope.score_covariance, z)
        along = along + noise * (
            trial.variance[0] * (1.0 + a[0] ** 2)
            + np.einsum("c,cijk->ijk", trial.variance[1:], a[1:] ** 2)
        )
        joint = np.einsum("ijkc,ijkc->ijk", z[:, :, :-1] @ score, z[:, :, 1:])
        along[:, :, 1:] -= 2.0 * a[0][:, :, 1:] * joint
        last = trial.samples - (trial.problem.schedule.holds - 1) * trial.hold
        whole, part = along.sum(axis=2), along[:, :, :last].sum(axis=2)
        first = z[:, :, 0] * a[0][:, :, :1]
        cross = -2.0 * (self.before @ score) @ first.transpose(0, 2, 1)
        column = np.arange(self.tau.size)[None, :]
        future = np.zeros(whole.shape)
        ahead: list[Array] = []
        for k in range(trial.problem.schedule.holds - 1, -1, -1):
            own = whole if ahead else part
            now = own + (1 - self.share) * future[self.cell, column]
            now += self.share * future[self.cell + 1, column]
            ahead.append(now)
            if k:
                future = (cross + now[:, None, :]).max(axis=2)
        ahead.reverse()
        return self._forward(ahead, cross)

    def _forward(self, ahead: list[Array], cross: Array) -> tuple[float, Array]:
        trial = self.trial
        step = self.u[1] - self.u[0]

        def at(table: Array, u: float) -> Array:
            place = (u - self.u[0]) / step
            cell = int(np.clip(place, 0, self.u.size - 2))
            return np.asarray(table[cell] + (place - cell) * (table[cell + 1] - table[cell]))

        u = float(trial.rollout.start[0])
        values = at(ahead[0], u)
        j = int(values.argmax())
        forces = [self.tau[j]]
        for now in ahead[1:]:
            u = float(trial.run(np.array([u]), np.full((1, trial.hold), self.tau[j]))[0, -1])
            j = int((at(now, u) + at(cross, u)[j]).argmax())
            forces.append(self.tau[j])
        return float(values.max()), np.array(forces)


def _improve(
    trial: _Trial, programme: _Programme, forces: Array
) -> tuple[float, Moments, Moments, int, int]:
    """Raise the criterion over mixtures of sequences, first those of forces (R, K)."""
    known = trial.sums(forces)
    gram = np.array([s.gram for s in known])
    score = np.array([s.score_covariance for s in known])
    weights = np.full(len(known), 1.0 / len(known))
    for step in range(_STEPS):
        mixed = Moments(np.tensordot(weights, gram, 1), np.tensordot(weights, score, 1))
        value, slope = trial.value(mixed)
        best, sequence = programme.maximise(slope)
        base = _along(slope, mixed)
        if best - base < _ENOUGH or step == _STEPS - 1:
            break
        more = trial.sums(sequence[None])[0]
        gain = _along(slope, more) - base
        if gain <= _ENOUGH / 4:
            break
        gram = np.concatenate([gram, more.gram[None]])
        score = np.concatenate([score, more.score_covariance[None]])
        weights = _weights(trial, gram, score, np.append(0.8 * weights, 0.2))
        kept = weights > 1e-7
        gram, score, weights = gram[kept], score[kept], weights[kept] / weights[kept].sum()
    return value, mixed, slope, int((weights > 1e-3).sum()), step + 1


def _weights(trial: _Trial, gram: Array, score: Array, weights: Array) -> Array:
    """Return weights of sums (n, q, q) that maximise the criterion from given ones."""

    def worth(parts: list[Array]) -> tuple[float, list[Array]]:
        mixed = Moments(np.tensordot(parts[0], gram, 1), np.tensordot(parts[0], score, 1))
        value, slope = trial.value(mixed)
        along = np.einsum("ij,rij->r", slope.gram, gram)
        return value, [along + np.einsum("ij,rij->r", slope.score_covariance, score)]

    return best_weights(worth, [weights], 80)[0]
