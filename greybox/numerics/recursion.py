"""Linear recursions over samples, all columns and all runs at once.

S(k+1) = A(k) S(k) + B(k) is three loops of C where there is a compiler. Elsewhere it is linear in
S(0): stretches of samples are followed side by side from nothing, and what each begins with is
added afterwards. With few columns the recursion is one banded triangular system in all samples,
which a library solves sooner.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs

from greybox.numerics.machine_code import SHOWN, Library

Array = NDArray[np.float64]

# up to this many columns, of fewer states, the banded system is the faster way
_FEW = 8
# from this many runs on a step of all of them together is work enough
_MANY = 16
# samples that a filter takes at once, and signals from which on that is the faster way
_AT_ONCE, _SIGNALS = 32, 4


_RECURSION = """
void greybox_recursion(long long runs, long long steps, long long n, long long m,
                       const double* restrict a, const double* restrict b, double* restrict s) {
  long long run, k, i, j, l;
  for (run = 0; run < runs; run++) {
    for (k = 0; k < steps; k++) {
      double* restrict next = s + n * m;
      for (i = 0; i < n; i++) {
        for (j = 0; j < m; j++) next[i * m + j] = b[i * m + j];
        for (l = 0; l < n; l++) {
          const double share = a[i * n + l];
          for (j = 0; j < m; j++) next[i * m + j] += share * s[l * m + j];
        }
      }
      a += n * n; b += n * m; s = next;
    }
    s += n * m;
  }
}
"""


_LIBRARY = Library(
    lambda: SHOWN + _RECURSION,
    "greybox_recursion",
    [ctypes.c_longlong] * 4 + [ctypes.c_void_p] * 3,
    _RECURSION,
)


@cache
def _compiled() -> Callable[..., None] | None:
    """Return the recursion as machine code; None where there is no compiler."""
    # compiled at the first call, however short: the same command gives the same digits each time
    return _LIBRARY.found() or _LIBRARY.made()


def propagate(a: Array, b: Array, start: Array) -> Array:
    """Return S with S(0) = start and S(k+1) = A(k) S(k) + B(k).

    Parameters
    ----------
    a : ndarray
        (..., N−1, n, n)
    b : ndarray
        (..., N−1, n, m)
    start : ndarray
        (..., n, m)

    Returns
    -------
    ndarray
        (..., N, n, m), infinite where it leaves the numbers' range.
    """
    lead, (steps, n, columns) = b.shape[:-3], b.shape[-3:]
    runs = math.prod(lead)
    a, b = a.reshape(runs, steps, n, n), b.reshape(runs, steps, n, columns)
    in_c = _compiled()
    out = np.empty((steps + 1, runs, n, columns)) if runs >= _MANY and in_c is None else None
    found = np.empty((runs, steps + 1, n, columns)) if out is None else out.swapaxes(0, 1)
    found[:, 0] = start.reshape(runs, n, columns)
    if found.size and steps:
        with np.errstate(over="ignore", invalid="ignore"):
            if in_c is not None:
                given = [np.ascontiguousarray(x, dtype=float) for x in (a, b)]
                in_c(runs, steps, n, columns, *(x.ctypes.data for x in (*given, found)))
            elif out is not None:
                _stepped(a, b, out)
            elif columns <= _FEW and n < _FEW:
                for each in zip(a, b, found, strict=True):
                    _banded(*each)
            else:
                _stretched(a, b, found)
        # what has left the range does not come back
        if not np.isfinite(found[:, -1]).all():
            found[~np.isfinite(found)] = np.inf
    return found.reshape(*lead, steps + 1, n, columns)


def decay(share: float, b: Array) -> Array:
    """Return y with y(0) = b(0) and y(k+1) = share·y(k) + b(k+1), along axis 0 of b (N, …)."""
    columns = np.array(b.reshape(len(b), -1), order="F")
    band = np.vstack([np.ones(len(b)), np.full(len(b), -share)])
    solved, _ = dtbtrs(band, columns, uplo="L", diag="U", overwrite_b=True)
    return np.asarray(solved.reshape(b.shape))


def filtered(numerators: Array, denominator: Array, channels: Sequence[Array]) -> list[Array]:
    """Pass channels through a rational filter, from rest: y_i = Σ_j B_ij(q⁻¹)/A(q⁻¹) e_j.

    Parameters
    ----------
    numerators : ndarray
        (k, k, n+1) in powers of the delay.
    denominator : ndarray
        (n+1,) likewise, its first coefficient 1.
    channels : sequence of ndarray
        k of them, (m, N) of m signals each, time last.

    Returns
    -------
    list of ndarray
        (m, N) of each of the k outputs.
    """
    signals, samples = channels[0].shape
    if signals >= _SIGNALS and samples > _AT_ONCE:
        with np.errstate(over="ignore", invalid="ignore"):
            found = _by_blocks(numerators, denominator, channels)
        # beyond the numbers' range a sample must not reach those before it
        if all(np.isfinite(y[:, -1]).all() for y in found):
            return found
    from scipy.signal import lfilter

    out = []
    for row in numerators:
        total = np.zeros((signals, samples))
        for numerator, e in zip(row, channels, strict=True):
            if numerator.any():
                total += lfilter(numerator, denominator, e)
        out.append(total)
    return out


def _by_blocks(numerators: Array, denominator: Array, channels: Sequence[Array]) -> list[Array]:
    """Filter blocks of samples by matrix products; what a block leaves is carried to the next."""
    (signals, samples), size = channels[0].shape, len(denominator) - 1
    blocks = -(-samples // _AT_ONCE)
    own, entering, leaving, carried = _block_matrices(
        numerators.tobytes(), denominator.tobytes(), len(channels)
    )
    given = []
    for e in channels:
        padded = np.zeros((signals, blocks * _AT_ONCE))
        padded[:, :samples] = e
        given.append(padded.reshape(-1, _AT_ONCE))
    y = np.zeros((len(given), *given[0].shape))
    left = np.zeros((len(given), len(given[0]), size))
    for i, j in zip(*np.nonzero(numerators.any(axis=2)), strict=True):
        y[i] += given[j] @ own[i, j]
        left[i] += given[j] @ leaving[i, j]
    rows = left.reshape(-1, blocks, size)
    pushed = np.ascontiguousarray(rows.swapaxes(0, 1))
    state = np.zeros_like(pushed)
    for k in range(blocks - 1):
        np.dot(state[k], carried, out=state[k + 1])
        state[k + 1] += pushed[k]
    y += (state.swapaxes(0, 1).reshape(-1, size) @ entering).reshape(y.shape)
    return [one.reshape(signals, -1)[:, :samples] for one in y]


@lru_cache(maxsize=64)
def _block_matrices(
    numerators: bytes, denominator: bytes, channels: int
) -> tuple[Array, Array, Array, Array]:
    """Return what acts on rows of a block's samples and on rows of the state that it begins with.

    ``own`` (k, k, L, L) from samples to outputs, ``entering`` (n, L) from the state to outputs,
    ``leaving`` (k, k, L, n) from samples to the state after the block, ``carried`` (n, n) from the
    state to that state. The state is that of the transposed direct form, turned so that it is as
    large as what it leads to: near a pole of one the other cancels digits.
    """
    a = np.frombuffer(denominator).astype(np.longdouble)
    b = np.frombuffer(numerators).astype(np.longdouble).reshape(channels, channels, len(a))
    size = len(a) - 1
    step = np.eye(size, k=1, dtype=np.longdouble)
    step[:, 0] -= a[1:]
    first = b[:, :, 1:] - b[:, :, :1] * a[1:]
    entering = np.empty((size, _AT_ONCE), np.longdouble)
    leaving = np.empty((*b.shape[:2], _AT_ONCE, size), np.longdouble)
    power = np.eye(size, dtype=np.longdouble)
    for k in range(_AT_ONCE):
        entering[:, k] = power[0]
        leaving[:, :, _AT_ONCE - 1 - k] = first @ power.T
        power = step @ power
    # of an impulse, by how many samples it is ago
    response = np.concatenate([b[:, :, :1], first @ entering[:, :-1]], axis=2)
    ago = np.arange(_AT_ONCE) - np.arange(_AT_ONCE)[:, None]
    own = np.where(ago >= 0, response[:, :, np.maximum(ago, 0)], 0.0)
    entering, turn = _orthonormal(entering)
    carried = power.T @ turn
    for i in range(size):
        carried[i] = (carried[i] - turn[i, :i] @ carried[:i]) / turn[i, i]
    return (
        own.astype(float),
        entering.astype(float),
        (leaving @ turn).astype(float),
        carried.astype(float),
    )


def _orthonormal(rows: NDArray[np.longdouble]) -> tuple[Any, Any]:
    """Return Q (n, L) with orthonormal rows and T (n, n), lower triangular, of rows T Q."""
    q, turn = rows.copy(), np.zeros((len(rows),) * 2, np.longdouble)
    for i in range(len(q)):
        # what rounding leaves of the first subtraction goes with the second
        for j in [*range(i), *range(i)]:
            along = q[i] @ q[j]
            turn[i, j] += along
            q[i] -= along * q[j]
        size = np.sqrt(q[i] @ q[i])
        turn[i, i] = size if size > 0 else 1.0
        q[i] /= turn[i, i]
    return q, turn


def _stepped(a: Array, b: Array, out: Array) -> None:
    """Fill out (N, M, n, m) behind the first sample of all runs."""
    after, own = (np.ascontiguousarray(x.swapaxes(0, 1)) for x in (a, b))
    for k in range(len(after)):
        np.matmul(after[k], out[k], out=out[k + 1])
        out[k + 1] += own[k]


def _banded(a: Array, b: Array, out: Array) -> None:
    """Fill out (N, n, m) of one run behind its first sample."""
    steps, n, columns = b.shape
    out[1:] = b
    out[1] += a[0] @ out[0]
    band = np.zeros((2 * n, steps * n))
    # row (k, i) and column (k−1, j) lie n + i − j below the diagonal of ones
    for i in range(n):
        for j in range(n):
            band[n + i - j, j : (steps - 1) * n : n] = -a[1:, i, j]
    solved, _ = dtbtrs(band, out[1:].reshape(steps * n, columns), uplo="L", diag="U")
    out[1:] = solved.reshape(steps, n, columns)


def _stretched(a: Array, b: Array, out: Array) -> None:
    """Fill out (M, N, n, m) behind the first sample of each run."""
    runs, steps, n, columns = b.shape
    length = math.isqrt(steps)
    count = steps // length
    whole = count * length

    def cut(x: Array) -> Array:
        return x[:, :whole].reshape(runs, count, length, n, -1)

    after, own, filled = cut(a), cut(b), cut(out[:, 1:])
    # what the first state of a stretch becomes along it
    carried = np.empty((runs, count, length, n, n))
    carried[:, :, 0], filled[:, :, 0] = after[:, :, 0], own[:, :, 0]
    for k in range(1, length):
        np.matmul(after[:, :, k], filled[:, :, k - 1], out=filled[:, :, k])
        filled[:, :, k] += own[:, :, k]
        np.matmul(after[:, :, k], carried[:, :, k - 1], out=carried[:, :, k])
    first = out[:, 0]
    for c in range(count):
        begun = carried[:, c].reshape(runs, length * n, n) @ first
        filled[:, c] += begun.reshape(runs, length, n, columns)
        first = filled[:, c, -1]
    for k in range(whole, steps):
        out[:, k + 1] = a[:, k] @ out[:, k] + b[:, k]
