"""Evaluate an SX function on whole arrays, one NumPy call an instruction.

CasADi's virtual machine visits one sample at a time. Regressors are needed at
millions of samples, where one vectorised call for each instruction of the same
function is several times faster. The function stays the single source: nothing
is written a second time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.errors import StructureError

Array = NDArray[np.float64]

_UNARY: dict[int, Callable[..., Any]] = {
    ca.OP_NEG: np.negative,
    ca.OP_SQ: np.square,
    ca.OP_TWICE: lambda a: 2.0 * a,
    ca.OP_SQRT: np.sqrt,
    ca.OP_EXP: np.exp,
    ca.OP_LOG: np.log,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_TAN: np.tan,
    ca.OP_TANH: np.tanh,
    ca.OP_FABS: np.abs,
    ca.OP_SIGN: np.sign,
    ca.OP_INV: np.reciprocal,
    ca.OP_NOT: lambda a: np.asarray(a == 0, float),
    ca.OP_FLOOR: np.floor,
    ca.OP_CEIL: np.ceil,
}
_BINARY: dict[int, Callable[..., Any]] = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_POW: np.power,
    ca.OP_CONSTPOW: np.power,
    ca.OP_FMIN: np.fmin,
    ca.OP_FMAX: np.fmax,
    ca.OP_ATAN2: np.arctan2,
    ca.OP_LT: lambda a, b: np.asarray(np.less(a, b), float),
    ca.OP_LE: lambda a, b: np.asarray(np.less_equal(a, b), float),
    ca.OP_EQ: lambda a, b: np.asarray(np.equal(a, b), float),
    ca.OP_NE: lambda a, b: np.asarray(np.not_equal(a, b), float),
    ca.OP_AND: lambda a, b: np.asarray((a != 0) & (b != 0), float),
    ca.OP_OR: lambda a, b: np.asarray((a != 0) | (b != 0), float),
    ca.OP_IF_ELSE_ZERO: lambda a, b: np.where(a != 0, b, 0.0),
}

# what it fills, by what, from what, and what is used by it for the last time
_Call = tuple[int, Callable[..., Any], tuple[int, ...], tuple[int, ...]]
# choices of expressions that are kept: those of a fit come again at each of its steps
_PARTS = 64


class Vectorised:
    """An SX function as a program of array operations.

    Parameters
    ----------
    expressions : sequence of SX
        Scalars to evaluate.
    symbols : sequence of SX
        Scalars that they depend on, in the order of the arrays given to a call.

    Raises
    ------
    StructureError
        The expression uses an operation that has no array form here.
    """

    def __init__(self, expressions: Sequence[ca.SX], symbols: Sequence[ca.SX]) -> None:
        function = ca.Function("f", list(symbols), [ca.vertcat(*expressions)], {"cse": True})
        self.size = len(expressions)
        # (target, operation, sources); targets are numbered once
        calls: list[tuple[int, Callable[..., Any], tuple[int, ...]]] = []
        self._inputs: list[tuple[int, int]] = []
        self._constants: dict[int, float] = {}
        self._outputs: list[tuple[int, int]] = []
        rows = function.sparsity_out(0).row()
        holder: dict[int, int] = {}
        for k in range(function.n_instructions()):
            op = function.instruction_id(k)
            slots = function.instruction_input(k)
            target = function.instruction_output(k)
            if op == ca.OP_OUTPUT:
                self._outputs.append((rows[target[1]], holder[slots[0]]))
                continue
            if op == ca.OP_CONST:
                self._constants[k] = function.instruction_constant(k)
            elif op == ca.OP_INPUT:
                self._inputs.append((k, slots[0]))
            elif op in _UNARY:
                calls.append((k, _UNARY[op], (holder[slots[0]],)))
            elif op in _BINARY:
                calls.append((k, _BINARY[op], (holder[slots[0]], holder[slots[1]])))
            else:
                raise StructureError(
                    f"an expression uses the CasADi operation {op}, which has no array form here: "
                    f"write the term with products, moduli and trigonometric functions."
                )
            holder[target[0]] = k
        last = {i: target for target, _, sources in calls for i in sources}
        shown = {source for _, source in self._outputs}
        # with what a call is the last to use: its memory is warm, and given to the next
        self._parts: dict[tuple[int, ...], tuple[list[tuple[int, int]], list[_Call]]] = {}
        self._calls: list[_Call] = [
            (*call, tuple(i for i in set(call[2]) if last[i] == call[0] and i not in shown))
            for call in calls
        ]

    def prepare(self, known: Mapping[int, Array | float]) -> dict[int, Any]:
        """Evaluate once what depends on some arguments only.

        Parameters
        ----------
        known : mapping of int to ndarray
            Position of an argument -> its array.

        Returns
        -------
        dict
            To be given to calls whose other arguments change.
        """
        work: dict[int, Any] = dict(self._constants)
        work |= {k: known[i] for k, i in self._inputs if i in known}
        for target, call, sources, _ in self._calls:
            if all(i in work for i in sources):
                work[target] = call(*[work[i] for i in sources])
        return work

    def _part(self, wanted: tuple[int, ...]) -> tuple[list[tuple[int, int]], list[_Call]]:
        """Return the outputs that are wanted, and the calls that they need."""
        if wanted not in self._parts:
            if len(self._parts) == _PARTS:
                del self._parts[next(iter(self._parts))]
            place = {i: row for row, i in enumerate(wanted)}
            outputs = [(place[i], source) for i, source in self._outputs if i in place]
            needed = {source for _, source in outputs}
            for target, _, sources, _ in reversed(self._calls):
                if target in needed:
                    needed.update(sources)
            self._parts[wanted] = outputs, [call for call in self._calls if call[0] in needed]
        return self._parts[wanted]

    def __call__(
        self,
        arrays: Sequence[Array | float],
        out: Array,
        prepared: Mapping[int, Any] | None = None,
        wanted: Sequence[int] | None = None,
    ) -> Array:
        """Fill ``out[i]`` with expression i, or i of those wanted, evaluated on `arrays`.

        Parameters
        ----------
        arrays : sequence of ndarray
            One a symbol, of shapes that broadcast to ``out.shape[1:]``.
        out : ndarray
            (size, ...) array to fill; returned.
        prepared : mapping, optional
            What `prepare` returned for some of the same arguments.
        wanted : sequence of int, optional
            Expressions to evaluate; by default all.
        """
        outputs, calls = self._outputs, self._calls
        if wanted is not None:
            outputs, calls = self._part(tuple(wanted))
        work: dict[int, Any] = dict(self._constants if prepared is None else prepared)
        for k, i in self._inputs:
            work.setdefault(k, arrays[i])
        for target, call, sources, spent in calls:
            if target not in work:
                work[target] = call(*[work[i] for i in sources])
                for i in spent:
                    del work[i]
        if len(outputs) < len(out):
            out[...] = 0.0
        for row, source in outputs:
            out[row] = work[source]
        return out
