"""Gauss-Newton on free runs: one shot, or many segments that must join.

Each segment starts from its own unknown state; where a segment continues another
the end of the one must meet the start of the next. The linearised problem,

    minimise ½‖r − J_p δp − J_s δs‖²  subject to  c + F_p δp + F_s δs − δs⁺ = 0,

is reduced to the parameters by a sparse solve for the starts and multipliers, so
that an unstable model costs no more than a stable one. Normal equations add over
segments and logs.

References
----------
Bock (1983), generalised Gauss-Newton for multiple shooting; Nocedal and Wright
(2006), Numerical Optimization, sections 10.3 and 18.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, bmat, csc_matrix
from scipy.sparse.linalg import splu

from greybox.model.output import OutputModel
from greybox.model.run.output_runs import Simulator
from greybox.numerics.effort import require_time
from greybox.numerics.linalg import bounded_step
from greybox.numerics.robust import huber_loss, huber_weights

Array = NDArray[np.float64]
Loss = Literal["gaussian", "huber"]

# a step shorter than this many standard errors ends the iteration
TOLERANCE = 1e-6
# starts and ends of segments meet within this many noise deviations
_JOINED = 1e-6
_MOST = 60
# a run this many times beyond the largest measured value has escaped
_ESCAPED = 1e3
_DAMPING_LIMIT = 1e8


@dataclass(frozen=True)
class Measured:
    """What one log gives to a fit.

    Parameters
    ----------
    w, y : ndarray
        (N, nw) drivers and (N, ny) measured outputs.
    known : ndarray of bool
        (N,) samples whose outputs were measured; a run passes over the others.
    """

    w: Array
    y: Array
    known: NDArray[np.bool_]

    def first(self, samples: int) -> Measured:
        """Return the first samples."""
        return Measured(self.w[:samples], self.y[:samples], self.known[:samples])


@dataclass(frozen=True)
class Segments:
    """Logs cut into segments of m samples, the last ones padded.

    Parameters
    ----------
    w, y : ndarray
        (M, m, nw) and (M, m, ny).
    use : ndarray
        (M, m) 1 where a sample belongs to a log and was measured.
    joined : ndarray of bool
        (M,) whether the next segment continues this one.
    """

    w: Array
    y: Array
    use: Array
    joined: NDArray[np.bool_]


def cut(logs: Sequence[Measured], steps: int) -> Segments:
    """Cut logs into segments of `steps` samples, to be joined."""
    w, y, use, joined = [], [], [], []
    for log in logs:
        samples = len(log.y)
        count = -(-samples // steps)
        for j in range(count):
            index = np.minimum(np.arange(j * steps, (j + 1) * steps), samples - 1)
            w.append(log.w[index])
            y.append(log.y[index])
            own = np.arange(j * steps, (j + 1) * steps) < samples
            use.append((own & log.known[index]).astype(float))
            joined.append(j + 1 < count)
    return Segments(np.array(w), np.array(y), np.array(use), np.array(joined))


@dataclass(frozen=True)
class Restrictions:
    """Bounds and priors of the parameters.

    Parameters
    ----------
    low, high : ndarray
        (q,)
    mean, precision : ndarray
        (q,) of independent Gaussian priors; precision 0 where there is none.
    """

    low: Array
    high: Array
    mean: Array
    precision: Array

    def penalty(self, p: Array) -> float:
        """Return the priors' share of the cost."""
        return 0.5 * float(self.precision @ (p - self.mean) ** 2)


def unrestricted(q: int) -> Restrictions:
    """Return no bounds and no priors."""
    return Restrictions(np.full(q, -np.inf), np.full(q, np.inf), np.zeros(q), np.zeros(q))


@dataclass(frozen=True)
class Linearised:
    """Weighted residuals and rows of every segment at one point.

    ``r`` (M, m, ny) residuals in noise deviations; ``rows`` (M, m·ny, q + nz)
    derivatives of the outputs in the same units; ``end`` (M, nz) and ``slope``
    (M, nz, q + nz) of the states after each segment; ``level`` what the
    likelihood adds beside the squares; ``downhill`` (M, q + nz) the negative
    gradient where it is not ``rowsᵀ r``.
    """

    r: Array
    rows: Array
    end: Array
    slope: Array
    level: float = 0.0
    downhill: Array | None = None


def by_sample(rows: Array) -> Array:
    """Return derivatives (M, m, ny, q + nz) with the outputs of a sample below one another."""
    runs, samples, outputs, columns = rows.shape
    return rows.reshape(runs, samples * outputs, columns)


class Runs(Protocol):
    """What the iteration asks of a problem."""

    segments: Segments

    def linearise(self, p: Array, nodes: Array) -> Linearised:
        """Return residuals and derivatives at parameters (q,) and starts (M, nz)."""

    def value(self, p: Array, nodes: Array) -> tuple[Array, Array, float]:
        """Return residuals, ends and level without derivatives."""


class FreeRuns:
    """Free runs of an output model on segments, weighted by the noise of each output.

    Parameters
    ----------
    model : OutputModel
    segments : Segments
    sigma : ndarray
        (ny,) noise of each output.
    fixed : bool
        Whether the starts stay where they are; segments are then whole logs.
    """

    def __init__(
        self,
        model: OutputModel,
        segments: Segments,
        sigma: Array,
        simulator: Simulator | None = None,
        *,
        fixed: bool = False,
    ) -> None:
        self.model = model
        self.segments = segments
        self.sigma = sigma
        self.fixed = fixed
        self._simulator = Simulator(model, segments.w) if simulator is None else simulator
        self._bound = _ESCAPED * np.abs(segments.y).max(axis=(0, 1), initial=0.0) + _ESCAPED * sigma

    def with_sigma(self, sigma: Array) -> FreeRuns:
        """Return the same runs with other weights."""
        return FreeRuns(self.model, self.segments, sigma, self._simulator, fixed=self.fixed)

    def _weighted(self, y: Array) -> Array:
        use = self.segments.use[..., None] > 0
        # padding may run away, its weight must not; a run that escapes has no cost at all
        error = np.where(use, self.segments.y - y, 0.0)
        bounded = (np.abs(error) <= self._bound).all()
        return np.asarray(error / self.sigma) if bounded else np.full_like(error, np.inf)

    def linearise(self, p: Array, nodes: Array) -> Linearised:
        """Return residuals and derivatives at parameters (q,) and starts (M, nz)."""
        y, rows, end, slope = self._simulator.sensitivities(nodes, p)
        with np.errstate(over="ignore", invalid="ignore"):
            used = rows / self.sigma[:, None]
            if not self.segments.use.all():
                used[self.segments.use == 0] = 0.0
        if self.fixed:
            used[..., len(p) :] = 0.0
        return Linearised(self._weighted(y), by_sample(used), end, slope)

    def by_parameters(self, p: Array, nodes: Array, only: Sequence[int]) -> Array:
        """Return derivatives of the outputs in some parameters, (M, m, ny, len(only))."""
        return self._simulator.by_parameters(nodes, p, only)

    def outputs(self, p: Array, nodes: Array) -> Array:
        """Return what the runs show (M, m, ny)."""
        return self._simulator(nodes, p)[0]

    def value(self, p: Array, nodes: Array) -> tuple[Array, Array, float]:
        """Return residuals, ends and level without derivatives."""
        y, end = self._simulator(nodes, p)
        return self._weighted(y), end, 0.0


@dataclass(frozen=True)
class ShootingFit:
    """Where the iteration ended.

    Parameters
    ----------
    p : ndarray
        (q,)
    nodes : ndarray
        (M, nz) start of each segment.
    hessian : ndarray
        (q, q) of the cost in the parameters, starts eliminated, priors included.
    cost : float
    gap : float
        Largest distance between the end of a segment and the next start, in
        noise deviations.
    iterations : int
    converged : bool
    """

    p: Array
    nodes: Array
    hessian: Array
    cost: float
    gap: float
    iterations: int
    converged: bool


def loss_weights(r: Array, loss: Loss) -> Array:
    """Return the weight of each squared residual (iteratively reweighted)."""
    if loss == "gaussian":
        return np.ones_like(r)
    return huber_weights(r)


def loss_value(r: Array, loss: Loss) -> float:
    """Return the sum of the losses of residuals in noise deviations."""
    # a run that escapes is no error here, only worse than any other
    with np.errstate(over="ignore", invalid="ignore"):
        if loss == "gaussian":
            return 0.5 * float((r**2).sum())
        return float(huber_loss(r).sum())


@dataclass(frozen=True)
class Reduced:
    """The linearised problem in the parameters alone."""

    hessian: Array
    gradient: Array
    starts: Array
    starts_by_p: Array
    multipliers: Array
    multipliers_by_p: Array
    gap: Array


def reduce_starts(at: Linearised, segments: Segments, nodes: Array, q: int, loss: Loss) -> Reduced:
    """Return the linearised problem with the first states eliminated."""
    runs, nz = nodes.shape
    flat = at.r.reshape(runs, -1)
    # weights of one are not multiplied with
    weighted = at.rows if loss == "gaussian" else at.rows * loss_weights(flat, loss)[..., None]
    normal = weighted.transpose(0, 2, 1) @ at.rows
    right = (flat[:, None] @ weighted)[:, 0] if at.downhill is None else at.downhill
    # a start on which nothing depends stays
    idle = normal[:, range(q, q + nz), range(q, q + nz)] == 0
    own = block_diag(list(normal[:, q:, q:] + idle[:, None] * np.eye(nz)), format="csc")
    cross = normal[:, q:, :q].reshape(runs * nz, q)
    links = np.flatnonzero(segments.joined)
    gap = (at.end - np.roll(nodes, -1, axis=0))[links]
    size = len(links) * nz
    by_p = at.slope[links][:, :, :q].reshape(size, q)
    matrix = own
    if size:
        place = np.arange(size).reshape(len(links), nz)
        rows = np.repeat(place[:, :, None], nz, axis=2).ravel()
        before = (links[:, None] * nz + np.arange(nz))[:, None, :].repeat(nz, axis=1).ravel()
        values = at.slope[links][:, :, q:].ravel()
        after = ((links + 1)[:, None] * nz + np.arange(nz)).ravel()
        join = csc_matrix((values, (rows, before)), shape=(size, runs * nz)) - csc_matrix(
            (np.ones(size), (place.ravel(), after)), shape=(size, runs * nz)
        )
        matrix = bmat([[own, join.T], [join, None]], format="csc")
    sides = np.vstack(
        [
            np.column_stack([right[:, q:].ravel(), cross]),
            np.column_stack([-gap.ravel(), by_p]),
        ]
    )
    solved = splu(matrix).solve(sides)
    starts, multipliers = solved[: runs * nz], solved[runs * nz :]
    hessian = normal[:, :q, :q].sum(axis=0) - cross.T @ starts[:, 1:] - by_p.T @ multipliers[:, 1:]
    gradient = right[:, :q].sum(axis=0) - cross.T @ starts[:, 0] - by_p.T @ multipliers[:, 0]
    return Reduced(
        (hessian + hessian.T) / 2,
        gradient,
        starts[:, 0].reshape(runs, nz),
        starts[:, 1:].reshape(runs, nz, q),
        multipliers[:, 0],
        multipliers[:, 1:],
        gap,
    )


def _scales(runs: Runs, nz: int) -> Array:
    """Return the noise of each simulated state, (nz,), to weigh gaps with."""
    sigma = getattr(runs, "sigma", None)
    return np.ones(nz) if sigma is None else np.asarray(sigma[:nz])


def fit_segments(
    runs: Runs,
    p: Array,
    nodes: Array,
    restrictions: Restrictions,
    *,
    loss: Loss = "gaussian",
    most: int = _MOST,
    tolerance: float = TOLERANCE,
) -> ShootingFit:
    """Minimise the cost over parameters and starts, segments joined.

    Parameters
    ----------
    runs : Runs
    p : ndarray
        (q,) first parameters.
    nodes : ndarray
        (M, nz) first starts.
    restrictions : Restrictions
    loss : {"gaussian", "huber"}
    most : int
        Iterations at most.
    tolerance : float
        Length of the last step in standard errors.

    Returns
    -------
    ShootingFit
        ``converged`` False where no step lowered the cost any more or `most` were taken.
    """
    segments = runs.segments
    p = np.clip(p, restrictions.low, restrictions.high)
    links = np.flatnonzero(segments.joined)
    scale = _scales(runs, nodes.shape[1])
    weight, damping, done = 0.0, 0.0, False
    taken, before = 0, np.inf
    at = runs.linearise(p, nodes)
    shown = at.r, at.end, at.level
    hessian = np.zeros((len(p), len(p)))

    def merit(r: Array, end: Array, level: float, p: Array, nodes: Array) -> float:
        cost = loss_value(r, loss) + level + restrictions.penalty(p)
        with np.errstate(over="ignore", invalid="ignore"):
            gap = (end - np.roll(nodes, -1, axis=0))[links] / scale
            total = cost + weight * float(np.abs(gap).sum())
        return total if np.isfinite(total) else np.inf

    while taken < most:
        require_time()
        taken += 1
        if not all(np.isfinite(a).all() for a in (at.r, at.rows, at.slope)):
            break
        try:
            reduced = reduce_starts(at, segments, nodes, len(p), loss)
        except RuntimeError:
            # a run that forgets its start at once leaves the start unknown
            break
        hessian = reduced.hessian + np.diag(restrictions.precision)
        gradient = reduced.gradient - restrictions.precision * (p - restrictions.mean)
        accepted = False
        while damping < _DAMPING_LIMIT:
            step = bounded_step(
                hessian, gradient, restrictions.low - p, restrictions.high - p, damping
            )
            shift = reduced.starts - reduced.starts_by_p @ step
            if len(links):
                multipliers = reduced.multipliers - reduced.multipliers_by_p @ step
                sized = np.abs(multipliers.reshape(len(links), -1) * scale)
                weight = max(weight, 2.0 * float(sized.max()))
            gap = float(np.abs(reduced.gap / scale).max(initial=0.0))
            length = float(np.sqrt(max(float(step @ hessian @ step), 0.0)))
            if length < tolerance and gap < _JOINED:
                done = True
                break
            # steps that shrink fast leave less than this one's share of the one before
            last = length < 0.1 * before < np.inf and length**2 < tolerance * before
            last = last and gap < _JOINED and damping == 0.0
            now = merit(*shown, p, nodes)
            for share in (1.0, 0.5, 0.25, 0.1):
                moved = p + share * step, nodes + share * shift
                ahead = None
                if share == 1.0 and damping == 0.0 and not last:
                    # most full steps are taken: their derivatives are needed next
                    ahead = runs.linearise(*moved)
                    found = ahead.r, ahead.end, ahead.level
                else:
                    found = runs.value(*moved)
                if merit(*found, *moved) < now:
                    accepted = True
                    break
            if accepted:
                (p, nodes), shown = moved, found
                before = length if share == 1.0 else np.inf
                done = last and share == 1.0
                damping = 0.0 if share == 1.0 and damping < 1e-6 else damping / 10
                break
            # nothing to gain beyond rounding
            if length < 1e-3 and gap < _JOINED:
                done = True
                break
            damping = max(10 * damping, 1e-6)
        if done or not accepted:
            break
        at = runs.linearise(p, nodes) if ahead is None else ahead
    r, end, level = shown
    with np.errstate(over="ignore", invalid="ignore"):
        gap = float(np.abs((end - np.roll(nodes, -1, axis=0))[links] / scale).max(initial=0.0))
    cost = loss_value(r, loss) + level + restrictions.penalty(p)
    return ShootingFit(p, nodes, hessian, cost, gap, taken, done)


def measured_starts(segments: Segments, nz: int) -> Array:
    """Return the mean of the first samples of each segment, (M, nz)."""
    count = min(5, segments.y.shape[1])
    use = segments.use[:, :count, None]
    # in a gap, what lies between its ends
    use = np.where(use.any(axis=1, keepdims=True), use, 1.0)
    return np.asarray((segments.y[:, :count, :nz] * use).sum(axis=1) / use.sum(axis=1))
