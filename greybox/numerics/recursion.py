"""Linear recursions over samples, all columns and all runs at once.

S(k+1) = A(k) S(k) + B(k) is three loops of C where there is a compiler. Elsewhere it is linear in
S(0): stretches of samples are followed side by side from nothing, and what each begins with is
added afterwards. With few columns, and for filters, the recursion is one banded triangular system
in all samples, which a library solves sooner.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs

from greybox.numerics.machine_code import SHOWN, Library

Array = NDArray[np.float64]

# up to this many columns, of fewer states, the banded system is the faster way
_FEW = 8
# from this many runs on a step of all of them together is work enough
_MANY = 16


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


# rows that are filtered side by side: each waits for its own last sample only
_ABREAST = 4
_FILTERED = f"""
void greybox_filtered(long long, long long, long long, const double*, const double*, double*,
                      const double*, double*);

static inline void abreast(const long long rows, long long samples, long long taps,
                           const double* restrict b, const double* restrict a,
                           double* restrict z, const double* restrict e, double* restrict y) {{
  long long row, k, i;
  for (i = 0; i < taps * rows; i++) z[i] = 0.0;
  for (k = 0; k < samples; k++) {{
    double x[{_ABREAST}], out[{_ABREAST}];
    for (row = 0; row < rows; row++) {{
      x[row] = e[row * samples + k];
      out[row] = z[row] + b[0] * x[row];
      y[row * samples + k] += out[row];
    }}
    for (i = 0; i + 1 < taps; i++)
      for (row = 0; row < rows; row++)
        z[i * rows + row] = z[(i + 1) * rows + row] + b[i + 1] * x[row] - a[i + 1] * out[row];
  }}
}}

void greybox_filtered(long long rows, long long samples, long long taps, const double* restrict b,
                      const double* restrict a, double* restrict z, const double* restrict e,
                      double* restrict y) {{
  for (; rows >= {_ABREAST}; rows -= {_ABREAST}) {{
    abreast({_ABREAST}, samples, taps, b, a, z, e, y);
    e += {_ABREAST} * samples; y += {_ABREAST} * samples;
  }}
  for (; rows > 0; rows--, e += samples, y += samples) abreast(1, samples, taps, b, a, z, e, y);
}}
"""
_RECURSIVE = f"""
void greybox_recursive(long long, long long, long long, const double*, double*);

static inline void abreast(const long long rows, long long samples, long long taps,
                           const double* restrict a, double* restrict y) {{
  long long row, k, d;
  for (k = 1; k < samples; k++) {{
    double past[{_ABREAST}] = {{0.0}};
    for (d = k < taps ? k : taps - 1; d > 0; d--)
      for (row = 0; row < rows; row++) past[row] -= a[d] * y[row * samples + k - d];
    for (row = 0; row < rows; row++) y[row * samples + k] += past[row];
  }}
}}

void greybox_recursive(long long rows, long long samples, long long taps,
                       const double* restrict a, double* restrict y) {{
  for (; rows >= {_ABREAST}; rows -= {_ABREAST}, y += {_ABREAST} * samples)
    abreast({_ABREAST}, samples, taps, a, y);
  for (; rows > 0; rows--, y += samples) abreast(1, samples, taps, a, y);
}}
"""


_SOURCES = {
    name: Library(
        lambda source=source: SHOWN + source,  # type: ignore[misc]
        name,
        [ctypes.c_longlong] * whole + [ctypes.c_void_p] * arrays,
        source,
    )
    for name, source, whole, arrays in (
        ("greybox_recursion", _RECURSION, 4, 3),
        ("greybox_filtered", _FILTERED, 3, 5),
        ("greybox_recursive", _RECURSIVE, 3, 2),
    )
}


@cache
def _compiled(name: str) -> Callable[..., None] | None:
    """Return a recursion as machine code; None where there is no compiler."""
    # compiled at the first call, however short: the same command gives the same digits each time
    return _SOURCES[name].found() or _SOURCES[name].made()


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
    in_c = _compiled("greybox_recursion")
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


def recursive(denominator: Array, rows: Array) -> Array:
    """Return y with A(q⁻¹) y = rows, from rest.

    Parameters
    ----------
    denominator : ndarray
        (n+1,) A in powers of the delay, its first coefficient 1.
    rows : ndarray
        (..., N), time last.
    """
    return _recursive(denominator, np.array(rows, float, order="C"))


def _recursive(denominator: Array, y: Array) -> Array:
    """Fill in place what `recursive` returns."""
    if not y.size:
        return y
    a, samples = np.ascontiguousarray(denominator, float), y.shape[-1]
    in_c = _compiled("greybox_recursive")
    if in_c is not None:
        in_c(y.size // samples, samples, len(a), a.ctypes.data, y.ctypes.data)
        return y
    band = np.repeat(a[:samples, None], samples, axis=1)
    solved, _ = dtbtrs(band, y.reshape(-1, samples).T, uplo="L", diag="U", overwrite_b=True)
    return np.asarray(solved.T.reshape(y.shape))


def decay(share: float, b: Array) -> Array:
    """Return y with y(0) = b(0) and y(k+1) = share·y(k) + b(k+1), along axis 0 of b (N, …)."""
    return np.moveaxis(recursive(np.array([1.0, -share]), np.moveaxis(b, 0, -1)), -1, 0)


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
    out = np.zeros((len(numerators), *channels[0].shape))
    in_c = _compiled("greybox_filtered")
    # the state of a filter has a zero behind it
    a, state = np.ascontiguousarray(denominator, float), np.zeros(_ABREAST * len(denominator))
    for i, j in zip(*np.nonzero(numerators.any(axis=2)), strict=True):
        b, y, e = numerators[i, j], out[i], np.ascontiguousarray(channels[j], float)
        if in_c is not None:
            b = np.ascontiguousarray(b, float)
            in_c(*y.shape, len(b), *(x.ctypes.data for x in (b, a, state, e, y)))
            continue
        for ago in np.flatnonzero(b[: y.shape[1]]):
            y[:, ago:] += b[ago] * e[:, : y.shape[1] - ago]
    return list(out if in_c is not None else _recursive(a, out))


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
