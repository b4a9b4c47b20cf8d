"""Derivatives of every step along a run, in the state and in chosen numbers.

Those of the rate come from the structure's own expression, on all samples at once;
a step of several stages follows from them by the chain rule.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.model.run.compiled import LOOP, STEP, Loop
from greybox.model.run.step import AHEAD, WEIGHTS, StepModel
from greybox.numerics.recursion import propagate
from greybox.numerics.vectorised import Vectorised

Array = NDArray[np.float64]

# share of a state that a step moves it by, from which on the step is long
_LONG = 1.0
# sets of terms whose derivatives are kept
_KEPT = 16
# no number but the state
NOWHERE = np.zeros(0, int)


@dataclass(frozen=True)
class Linear:
    """Derivatives of each step along a run.

    Parameters
    ----------
    a : ndarray
        (N−1, nx, nx) in the state before.
    driven : ndarray
        (N−1, nx, m) in the numbers that were asked for.
    """

    a: Array
    driven: Array


def means(d: ca.SX, current: ca.SX) -> ca.SX:
    """Return disturbance means for the symbols d: a current, and no wind that is not measured."""
    unknown = d.numel()
    return ca.vertcat(current, ca.SX.zeros(max(unknown - 2, 0)))[:unknown]


def with_zeros(values: ca.SX, places: Sequence[int], size: int) -> ca.SX:
    """Return a vector (size,) of values at some places and zeros elsewhere."""
    out = ca.SX.zeros(size)
    for k, place in enumerate(places):
        out[place] = values[k]
    return out


# what `Slopes` does on arrays, sample by sample; of `full` the state comes first in every row
_LOOP = """
void {LOOP}(long long, const double* const*, double* const*);

enum {{ NX = {nx}, ND = {nd}, NP = {np}, ALL = {columns}, WIDE = 1 + ALL, EULER = {euler} }};

static void rates(const double* x, const double* read, const double* theta,
                  double* slopes, double* rate) {{
  const double* arg[] = {{x, read, theta}};
  double* res[] = {{slopes, rate}};
  {STEP}(arg, res, 0, 0, 0);
}}

static void moved_by(const double* full, const double* read, const double* theta, int m,
                     const int* column, double* out) {{
  double x[NX], slopes[NX * ALL], rate[NX];
  int i, j, c;
  for (i = 0; i < NX; i++) x[i] = full[i * WIDE];
  rates(x, read, theta, slopes, rate);
  for (i = 0; i < NX; i++) {{
    double* row = out + i * WIDE;
    row[0] = rate[i];
    for (c = 0; c < NX; c++) row[1 + c] = 0.0;
    for (c = 0; c < m; c++) row[1 + NX + c] = slopes[i * ALL + column[c]];
    for (j = 0; j < NX; j++) {{
      const double share = slopes[i * ALL + j];
      for (c = 1; c < 1 + NX + m; c++) row[c] += share * full[j * WIDE + c];
    }}
  }}
}}

static void through_stages(const double* x, const double* read, const double* theta, int m,
                           const int* column, double* a, double* driven) {{
  static const double ahead[] = {{{ahead}}}, weight[] = {{{weights}}};
  double start[NX * WIDE], at[NX * WIDE], now[NX * WIDE], total[NX * WIDE];
  int i, c, stage;
  for (i = 0; i < NX; i++) {{
    for (c = 0; c < 1 + NX + m; c++) start[i * WIDE + c] = c == 1 + i;
    start[i * WIDE] = x[i];
  }}
  moved_by(start, read, theta, m, column, now);
  for (i = 0; i < NX; i++)
    for (c = 0; c < 1 + NX + m; c++) total[i * WIDE + c] = weight[0] * now[i * WIDE + c];
  for (stage = 0; stage < {stages} - 1; stage++) {{
    for (i = 0; i < NX; i++)
      for (c = 0; c < 1 + NX + m; c++)
        at[i * WIDE + c] = start[i * WIDE + c] + ahead[stage] * now[i * WIDE + c];
    moved_by(at, read, theta, m, column, now);
    for (i = 0; i < NX; i++)
      for (c = 0; c < 1 + NX + m; c++)
        total[i * WIDE + c] += weight[1 + stage] * now[i * WIDE + c];
  }}
  for (i = 0; i < NX; i++) {{
    for (c = 0; c < NX; c++)
      a[i * NX + c] = start[i * WIDE + 1 + c] + total[i * WIDE + 1 + c];
    for (c = 0; c < m; c++) driven[i * m + c] = total[i * WIDE + 1 + NX + c];
  }}
}}

void {LOOP}(long long samples, const double* const* given, double* const* out) {{
  const double *restrict x = given[0], *restrict read = given[1], *restrict theta = given[2];
  const int m = (int)given[4][0], each = (int)given[4][1];
  double *restrict a = out[0], *restrict driven = out[1];
  int column[ALL], i, j, l, c;
  long long k;
  for (c = 0; c < m; c++) column[c] = (int)given[3][c];
  for (k = 0; k < samples; k++) {{
    double at[NX], slopes[NX * ALL], rate[NX], ahead[NX * NX], longest = 0.0;
    for (i = 0; i < NX; i++) at[i] = EULER ? x[i] : (x[i] + x[NX + i]) / 2;
    rates(at, read, theta, slopes, rate);
    for (i = 0; i < NX; i++) {{
      double size = 0.0;
      for (j = 0; j < NX; j++) size += fabs(slopes[i * ALL + j]);
      longest = size > longest ? size : longest;
    }}
    if (EULER) {{
      for (i = 0; i < NX; i++) {{
        for (j = 0; j < NX; j++) a[i * NX + j] = slopes[i * ALL + j] + ({one} && i == j);
        for (c = 0; c < m; c++) driven[i * m + c] = slopes[i * ALL + column[c]];
      }}
    }} else if (longest > {long}) {{
      through_stages(x, read, theta, m, column, a, driven);
    }} else {{
      for (i = 0; i < NX; i++)
        for (j = 0; j < NX; j++) {{
          double sum = i == j;
          for (l = 0; l < NX; l++)
            sum += slopes[i * ALL + l] * ((l == j) / 2.0 + slopes[l * ALL + j] / 6);
          ahead[i * NX + j] = sum;
        }}
      for (i = 0; i < NX; i++) {{
        for (j = 0; j < NX; j++) {{
          double sum = i == j;
          for (l = 0; l < NX; l++) sum += slopes[i * ALL + l] * ahead[l * NX + j];
          a[i * NX + j] = sum;
        }}
        for (c = 0; c < m; c++) {{
          double sum = 0.0;
          for (l = 0; l < NX; l++) sum += ahead[i * NX + l] * slopes[l * ALL + column[c]];
          driven[i * m + c] = sum;
        }}
      }}
    }}
    x += NX; read += ND; a += NX * NX; driven += NX * m;
    if (each) theta += NP;
  }}
}}
"""


class Slopes:
    """Derivatives of a step in a current.

    Those of a step of several stages follow from the rate's at the middle of the step, as the
    exponential of its Jacobian to third order: right to the second power of the step's length.
    At samples where that is long for what the rate does, they are carried through every stage.
    Machine code does so sample by sample; without a compiler arrays hold all samples.

    Parameters
    ----------
    step : StepModel
        With the measured heading.
    """

    def __init__(self, step: StepModel) -> None:
        self._step = step
        s, f = step.symbolic, step.increment
        current = ca.SX.sym("current", 2)
        rate = f(s.x, s.psi, s.tau, means(s.d, current), s.air, s.theta)
        slopes = ca.jacobian(rate, ca.vertcat(s.x, s.theta, current, s.tau))
        self._states, self._columns = slopes.shape
        self._coefficients = s.theta.numel()
        drivers = ca.vertcat(s.tau, s.psi, s.air, current)
        told = [ca.densify(ca.vec(slopes.T)), ca.densify(rate)]
        self._of_all = ca.Function("slopes", [s.x, drivers, s.theta], told, {"cse": True})
        self._loop = Loop(self._of_all, self._text(drivers.numel()))
        self._programs: dict[tuple[int, ...], Vectorised] = {}

    def _text(self, drivers: int) -> str:
        """Return the C code of the loop over samples."""
        step = self._step
        return _LOOP.format(
            LOOP=LOOP, STEP=STEP, nx=self._states, nd=drivers, np=self._coefficients,
            columns=self._columns, euler=int(step.integrator == "euler"),
            one=int(step.structure.increment), long=_LONG, stages=len(WEIGHTS),
            ahead=", ".join(map(repr, AHEAD)), weights=", ".join(map(repr, WEIGHTS)),
        )  # fmt: skip

    def _program(self, active: tuple[int, ...]) -> Vectorised:
        """Return all derivatives, and the rate, in the coefficients that are not zero."""
        program = self._programs.pop(active, None)
        if program is None:
            x, drivers = (ca.SX.sym(n, self._of_all.size1_in(n)) for n in ("i0", "i1"))
            own = ca.SX.sym("theta", len(active))
            # what only products with zeros lead to is not computed
            found = self._of_all.call([x, drivers, with_zeros(own, active, self._coefficients)])
            program = Vectorised(
                ca.vertsplit(ca.vertcat(*found)), ca.vertsplit(ca.vertcat(x, drivers, own))
            )
        # the sets of terms that are compared come again and again; those of old steps do not
        self._programs[active] = program
        if len(self._programs) > _KEPT:
            del self._programs[next(iter(self._programs))]
        return program

    def __call__(self, x: Array, drivers: Array, theta: Array, places: NDArray[np.int_]) -> Linear:
        """Return the derivatives along a run.

        Parameters
        ----------
        x : ndarray
            (N, nx)
        drivers : ndarray
            (N, nu + 5) generalised inputs, heading, velocity through the air,
            current north and east.
        theta : ndarray
            (p,) or (N, p)
        places : ndarray of int
            (m,) coefficients, past them the current north and east, and past those the
            generalised inputs.
        """
        columns = self._states + np.asarray(places, int)
        if self._loop.made():
            return self._by_machine_code(x, drivers, theta, columns)
        return self._on_arrays(x, drivers, theta, columns)

    def _by_machine_code(
        self, x: Array, drivers: Array, theta: Array, columns: NDArray[np.int_]
    ) -> Linear:
        steps, nx = len(x) - 1, self._states
        out = Linear(np.empty((steps, nx, nx)), np.empty((steps, nx, len(columns))))
        how = (columns, np.array([len(columns), theta.ndim - 1]))
        given = [np.ascontiguousarray(a, float) for a in (x, drivers, theta, *how)]
        self._loop(steps, given, (out.a, out.driven))
        return out

    def _on_arrays(
        self, x: Array, drivers: Array, theta: Array, columns: NDArray[np.int_]
    ) -> Linear:
        nx, euler = self._states, self._step.integrator == "euler"
        active = np.flatnonzero(theta.any(axis=0) if theta.ndim == 2 else theta)
        program = self._program(tuple(active.tolist()))
        at = x[:-1] if euler else (x[:-1] + x[1:]) / 2
        own = theta[..., active]
        given = (drivers[:-1], own if own.ndim == 1 else own[:-1])
        columns = np.concatenate([np.arange(nx), columns])
        slopes = self._rates(program, at.T.copy(), *given, columns)[1].transpose(2, 0, 1)
        state, driven = np.split(np.ascontiguousarray(slopes), [nx], axis=2)
        if not self._step.structure.increment:
            return Linear(state, driven)
        one = np.eye(nx)
        if euler:
            return Linear(one + state, driven)
        ahead = one + state @ (one / 2 + state / 6)
        moved = Linear(one + state @ ahead, ahead @ driven)
        far = np.abs(state).sum(axis=2).max(axis=1) > _LONG
        if far.any():
            exact = self._through_stages(program, x[:-1][far], *_of_rows(given, far), columns)
            moved.a[far], moved.driven[far] = exact.a, exact.driven
        return moved

    def _rates(
        self,
        program: Vectorised,
        at: Array,
        drivers: Array,
        own: Array,
        columns: NDArray[np.int_],
    ) -> tuple[Array, Array]:
        """Return the rate (nx, N) at states (nx, N), and its derivatives (nx, columns, N)."""
        nx, steps = at.shape
        values: list[Array | float] = [*at, *drivers.T.copy()]
        values += list(map(float, own)) if own.ndim == 1 else list(own.T.copy())
        wanted = (np.arange(nx)[:, None] * self._columns + columns).ravel()
        rows = np.concatenate([wanted, nx * self._columns + np.arange(nx)])
        out = program(values, np.empty((len(rows), steps)), wanted=rows.tolist())
        return out[-nx:], out[:-nx].reshape(nx, len(columns), steps)

    def _through_stages(
        self, program: Vectorised, x: Array, drivers: Array, own: Array, columns: NDArray[np.int_]
    ) -> Linear:
        """Return the derivatives of steps from states (N, nx), exactly."""
        (steps, nx), size = x.shape, len(columns)

        # time is last in memory: the state first, and behind it its derivatives
        def slope(full: Array) -> Array:
            at = np.ascontiguousarray(full[:, 0])
            rate, slopes = self._rates(program, at, drivers, own, columns)
            out = np.empty_like(full)
            out[:, 0], out[:, 1 : 1 + nx], out[:, 1 + nx :] = rate, 0.0, slopes[:, nx:]
            for i in range(nx):
                for j in range(nx):
                    out[i, 1:] += slopes[i, j] * full[j, 1:]
            return out

        start = np.zeros((nx, 1 + size, steps))
        start[:, 0] = x.T
        start[np.arange(nx), 1 + np.arange(nx)] = 1.0
        after = self._step.moved(slope, start).transpose(2, 0, 1)
        return Linear(*map(np.ascontiguousarray, (after[:, :, 1 : 1 + nx], after[:, :, 1 + nx :])))


def _of_rows(given: tuple[Array, Array], rows: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return drivers, and coefficients that may change along the run, at some of its samples."""
    drivers, own = given
    return drivers[rows], own if own.ndim == 1 else own[rows]


@lru_cache(maxsize=128)
def slopes_of(step: StepModel) -> Slopes:
    """Return the derivatives of a step, built once."""
    return Slopes(step)


def sensitivities(linear: Linear) -> Array:
    """Return ∂x of every column and of the initial state.

    Returns
    -------
    ndarray
        (N, nx, m + nx), the initial state last.
    """
    steps, nx, columns = linear.driven.shape
    full = np.concatenate([linear.driven, np.zeros((steps, nx, nx))], axis=2)
    start = np.hstack([np.zeros((nx, columns)), np.eye(nx)])
    return propagate(linear.a, full, start)
