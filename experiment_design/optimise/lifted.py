"""What the shooting intervals sum: moments of the IV estimate, or output-error information."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiment_design.excitation.rollout import force_vector
from experiment_design.information.moments import MomentProgram
from experiment_design.information.sensitivities import SensitivityProgram
from experiment_design.optimise.logdet import Affine, LogDet
from experiment_design.optimise.shooting import Passed, Shooting
from experiment_design.request.problem import TrialProblem

Array = NDArray[np.float64]


class MomentShooting(Shooting):
    """Sums of `MomentProgram`: G̃, and M̃ or the variances of white errors.

    Parameters
    ----------
    problem : TrialProblem
    unit : ndarray
        (K, nc)
    information : MomentProgram
    exact : bool
        Lift M̃, instead of taking the equation errors as white.
    """

    def __init__(
        self, problem: TrialProblem, unit: Array, information: MomentProgram, exact: bool
    ) -> None:
        self.information = information
        self.exact = exact
        y, r = information, problem.scenarios[0].rollout
        commands = r.symbols[1]
        self._rows = ca.Function("columns", list(y.symbols), list(y.expressions))
        self._force = ca.Function(
            "force", [commands], [force_vector(r.vessel, r.structure, commands)]
        )
        super().__init__(problem, unit)

    def _measure(self, unit: Array) -> None:
        """Take the scales of states and columns from the motion of a typical sequence."""
        y = self.information
        state, tau = self._motion(unit)
        self.state_scale = self._state_scale(state)
        z, a = self._columns(state, tau)
        self.shift = z.mean(axis=1)
        size = np.sqrt(((z - self.shift[:, None]) ** 2).sum(axis=1))
        self.size = np.where(size > 1e-9 * np.abs(z).max(axis=1).clip(1e-300), size, 1.0)
        self.spread = np.maximum((a**2).sum(axis=1) @ y.channel_std**2, 1e-300)
        self._start_z, self._start_a = (z - self.shift[:, None]) / self.size[:, None], a

    def _columns(self, state: Array, tau: Array) -> tuple[Array, Array]:
        """Return regressors (p, N) and slopes (nx, N, channels)."""
        y, nx, samples = self.information, self.rollout.nx, self.schedule.samples
        columns = ca.Function("columns", list(y.symbols), list(y.expressions)).map(samples)
        z, a = columns(state[:-1, :nx].T, state[:-1, nx][None], tau.T)
        return np.array(z), np.array(a).reshape(nx, samples, -1)

    def _index_sums(self) -> None:
        """Give each lifted sum its place among the variables."""
        y = self.information
        samples = self.schedule.samples
        self.blocks = [list(e) for e in y.equations]
        # every equation's columns with its constant first
        self.order = []
        for i, mine in enumerate(self.blocks):
            self.order += [(i, None), *[(i, c) for c in mine]]
        self.gram_at = {}
        first = 0
        for mine in self.blocks:
            for j in range(len(mine) + 1):
                for k in range(j + 1):
                    if j:
                        self.gram_at[first + k, first + j] = len(self.gram_at)
            first += len(mine) + 1
        all_columns = len(self.order)
        if self.exact:
            s = self._scores(self._start_z, self._start_a)
            self.score_scale = 1 / np.sqrt(np.maximum((s**2).sum(axis=(1, 2)), 1e-300))
            self.others = all_columns * (all_columns + 1) // 2
        else:
            self.others = len(self.blocks)
        process = y.process_std**2
        self.floor_variance = np.array(
            [
                process[i]
                + sum(
                    std**2
                    for std, own in zip(y.channel_std, y.channel_own, strict=True)
                    if own == i
                )
                for i in range(len(self.blocks))
            ]
        )
        self.mean_spread = self.spread / samples

    def _scores(self, z: Array, a: Array) -> Array:
        """Return the scores of the extended columns at the start, (P, channels, N+1)."""
        y = self.information
        samples = z.shape[1]
        out = np.zeros((len(self.order), len(y.channel_std), samples + 1))
        for p, (i, c) in enumerate(self.order):
            row = np.full(samples, 1 / np.sqrt(samples)) if c is None else z[c]
            for h, (std, own) in enumerate(zip(y.channel_std, y.channel_own, strict=True)):
                out[p, h, :-1] -= std * a[i, :, h] * row
                if own == i:
                    out[p, h, 1:] += std * row
        return out

    def _sums(self, z: Array, a: Array) -> Array:
        """Return the lifted sums (L,) of scaled regressors and slopes."""
        y = self.information
        constant = np.full(z.shape[1], 1 / np.sqrt(z.shape[1]))
        rows = np.array([constant if c is None else z[c] for _, c in self.order])
        gram = rows @ rows.T
        out = [gram[p, q] for p, q in self.gram_at]
        if not self.exact:
            return np.concatenate([out, (a**2).sum(axis=1) @ y.channel_std**2 / self.spread])
        s = self._scores(z, a).reshape(len(rows), -1) * self.score_scale[:, None]
        score = s @ s.T
        return np.array(out + [score[p, q] for q in range(len(rows)) for p in range(q + 1)])

    def _nodes_and_sums(self, unit: Array) -> tuple[Array, Array]:
        state, tau = self._motion(unit)
        z, a = self._columns(state, tau)
        sums = self._sums((z - self.shift[:, None]) / self.size[:, None], a)
        return state[self._node_samples()][:, self.kept] / self.state_scale, sums

    def _first_node(self) -> Array:
        start = np.append(self.rollout.start, [0.0, 0.0])[self.kept]
        return np.asarray(start / self.state_scale)

    # -- criterion --------------------------------------------------------------------------

    def _variance(self, equation: int, sums: Any) -> Any:
        spread = self.mean_spread[equation] * sums[self.grams + equation]
        return self.floor_variance[equation] + spread

    def _variance_terms(self, equation: int, count: int) -> tuple[list[LogDet], float]:
        variance = Affine(1)
        variance.base[0, 0] = self.floor_variance[equation] / self.mean_spread[equation]
        variance.add(0, 0, self.grams + equation, 1.0)
        shift = -count * float(np.log(self.mean_spread[equation]))
        return [variance.term(-float(count), self.lifted, 1)], shift

    def _scaled(self) -> float:
        return 2 * float(np.log(self.score_scale).sum()) if self.exact else 0.0

    def _border(self, nuisance: list[int]) -> list[LogDet]:
        size, known = len(self.order), self._fixed_gram()
        matrix = Affine(size + len(nuisance))
        scale = self.score_scale
        self._score_block(matrix, scale)
        for a, n in enumerate(nuisance):
            for p in range(size):
                self._gram_entry(matrix, p, size + a, p, n, float(scale[p]), known)
        return [matrix.term(-1.0, self.lifted, size)]

    def _score_block(self, matrix: Affine, scale: Array) -> None:
        """Write M̃, rows and columns scaled, into the leading block."""
        size, earlier = len(self.order), self.problem.known
        known = earlier[0].score_covariance[0] if earlier else None
        process = self.information.process_std**2
        entry = self.grams
        for q in range(size):
            for p in range(q + 1):
                ratio = scale[p] * scale[q] / (self.score_scale[p] * self.score_scale[q])
                matrix.add(p, q, entry, float(ratio))
                entry += 1
                (i, c), (_, d) = self.order[p], self.order[q]
                weight = float(process[i] * scale[p] * scale[q])
                if weight:
                    self._gram_entry(matrix, p, q, p, q, weight, None)
                if known is not None and c is not None and d is not None:
                    value = scale[p] * scale[q] * known[c, d]
                    matrix.add_constant(p, q, value / (self.size[c] * self.size[d]))

    # -- intervals --------------------------------------------------------------------------

    def _sample(self, state: ca.SX, command: ca.SX) -> tuple[list[ca.SX], ca.SX]:
        """Return scaled regressors with the constants, and slopes."""
        nx = self.rollout.nx
        z, a = self._rows(state[:nx], state[nx], self._force(command))
        z = (z - ca.DM(self.shift)) / ca.DM(self.size)
        constant = ca.SX(1 / np.sqrt(self.schedule.samples))
        return [constant if c is None else z[c] for _, c in self.order], a

    def _score(
        self, old: list[ca.SX] | None, new: list[ca.SX] | None, a: ca.SX
    ) -> list[list[ca.SX]]:
        """Return Z(k−1) − Z(k)A(k), each noise by its standard deviation."""
        y, out = self.information, []
        for h, (std, own) in enumerate(zip(y.channel_std, y.channel_own, strict=True)):
            column = []
            for p, (i, _) in enumerate(self.order):
                value = -a[i, h] * new[p] if new is not None else ca.SX(0)
                if own == i and old is not None:
                    value = value + old[p]
                column.append(value * (float(std) * self.score_scale[p]))
            out.append(column)
        return out

    def _open(self, node: ca.SX) -> Passed:
        squares = [] if self.exact else [ca.SX(0)] * len(self.blocks)
        return Passed([], [], squares, ca.SX())

    def _look(self, passed: Passed, state: ca.SX, command: ca.SX, first: ca.SX) -> None:
        z, a = self._sample(state, command)
        if not self.exact:
            for i in range(len(self.blocks)):
                square = ca.sumsqr(a[i, :].T * ca.DM(self.information.channel_std))
                passed.squares[i] += square / float(self.spread[i])
        elif passed.vectors:
            passed.scores += self._score(passed.vectors[-1], z, a)
        else:
            # the very first sample has no predecessor
            passed.scores += [[first * e for e in c] for c in self._score(None, z, a)]
        passed.vectors.append(z)

    def _close(self, passed: Passed, state: ca.SX, command: ca.SX, more: ca.SX) -> None:
        if self.exact:
            z, a = self._sample(state, command)
            passed.scores += self._score(passed.vectors[-1], [more * e for e in z], a)


class SensitivityShooting(Shooting):
    """Sums of `SensitivityProgram`: the nodes hold the sensitivities too, F is lifted.

    Parameters
    ----------
    problem : TrialProblem
    unit : ndarray
        (K, nc)
    information : SensitivityProgram
    """

    def __init__(self, problem: TrialProblem, unit: Array, information: SensitivityProgram) -> None:
        self.information = information
        r = problem.scenarios[0].rollout
        commands = r.symbols[1]
        self._slopes = ca.Function(
            "slopes_at", list(information.symbols), list(information.expressions)
        )
        self._force = ca.Function(
            "force", [commands], [force_vector(r.vessel, r.structure, commands)]
        )
        super().__init__(problem, unit)

    def _sensitivities(self, state: Array, tau: Array) -> Array:
        """Return S (N+1, n, columns)."""
        nx = self.rollout.nx
        signals = state[None, :-1, :nx], state[None, :-1, nx], tau[None]
        return np.asarray(self.information.sensitivities(*signals)[0])

    def _measure(self, unit: Array) -> None:
        state, tau = self._motion(unit)
        s = self._sensitivities(state, tau)
        first = self.information.first[:, self.information.order]
        largest = np.maximum(np.abs(s).max(axis=0), np.abs(first))
        self.s_scale = np.where(largest > 0, largest, 1.0)
        self.state_scale = np.concatenate([self._state_scale(state), self.s_scale.ravel()])
        gram = np.einsum("kip,i,kip->p", s, self.information.weight, s)
        self.size = np.sqrt(np.where(gram > 0, gram, 1.0))

    def _index_sums(self) -> None:
        count = self.information.columns
        self.order = [(0, c) for c in range(count)]
        self.gram_at = {}
        for q in range(count):
            for p in range(q + 1):
                self.gram_at[p, q] = len(self.gram_at)
        self.others = 0

    def _nodes_and_sums(self, unit: Array) -> tuple[Array, Array]:
        state, tau = self._motion(unit)
        s = self._sensitivities(state, tau)
        at = self._node_samples()
        nodes = np.concatenate([state[at][:, self.kept], s[at].reshape(len(at), -1)], axis=1)
        rows = (s[1:] * np.sqrt(self.information.weight)[:, None] / self.size).reshape(
            -1, self.information.columns
        )
        gram = rows.T @ rows
        return nodes / self.state_scale, np.array([gram[p, q] for p, q in self.gram_at])

    def _first_node(self) -> Array:
        start = np.append(self.rollout.start, [0.0, 0.0])[self.kept]
        first = self.information.first[:, self.information.order]
        return np.asarray(np.concatenate([start, first.ravel()]) / self.state_scale)

    def _fixed_gram(self) -> Array:
        y = self.information
        first = y.first[:, y.order]
        own = first.T @ (y.weight[:, None] * first)
        return np.asarray(own + self.problem.known[0].gram[0] if self.problem.known else own)

    def _open(self, node: ca.SX) -> Passed:
        shape = self.s_scale.shape
        flat = node[len(self.kept) :] * ca.DM(self.s_scale.ravel())
        return Passed([], [], [], ca.reshape(flat, shape[1], shape[0]).T)

    def _look(self, passed: Passed, state: ca.SX, command: ca.SX, first: ca.SX) -> None:
        y, nx = self.information, self.rollout.nx
        a, entry = self._slopes(state[:nx], state[nx], self._force(command))
        driven = ca.horzcat(entry, ca.SX(y.size, y.columns - entry.shape[1]))
        after = ca.mtimes(a, passed.sensitivity) + driven[:, y.order.tolist()]
        passed.sensitivity = after
        for i in np.flatnonzero(y.weight):
            row = after[int(i), :] * float(np.sqrt(y.weight[i])) / ca.DM(self.size).T
            passed.vectors.append([row[c] for c in range(y.columns)])

    def _carried(self, passed: Passed) -> list[ca.SX]:
        return [ca.vec(passed.sensitivity.T) / ca.DM(self.s_scale.ravel())]

    def _close(self, passed: Passed, state: ca.SX, command: ca.SX, more: ca.SX) -> None:
        """Nothing crosses: measurements of two samples are independent."""

    def _score_block(self, matrix: Affine, scale: Array) -> None:
        """Nothing to fill: the covariance is the inverse of the information."""
