"""The loop of a step over samples as machine code, where a C compiler is there and it pays.

CasADi interprets the instructions of a step. A compiler makes the same of them in the same order,
which gives the same numbers in a twenty-fifth of the time (6.5 ns against 170 ns for a step of the
thesis's ship), but takes a few tenths of a second. So a step is compiled once so much of it was
interpreted as takes as long, and what is compiled is kept in a folder of the user's for later runs.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.numerics.machine_code import SHOWN, Library

Array = NDArray[np.float64]

# instructions that take CasADi about 2 ms, as long as it takes to open what was compiled before,
# and a quarter of a second, as long as the compiler takes
_LOOK, _PAYS = 10**6, 3 * 10**7
# `step` and `along` are names of the C library or may be: these are nobody's
STEP, LOOP = "greybox_step", "greybox_loop"


def _loop_text(step: ca.Function, carried: int) -> str:
    """Return C code of the loop, to stand behind that of the step.

    The step sees variables of the loop alone, which a compiler keeps in registers.
    """
    takes = [step.numel_in(i) for i in range(step.n_in())]
    gives = [step.numel_out(i) for i in range(step.n_out())]
    kept = [f"now{i}[j] = " if i < carried else "" for i in range(len(gives))]
    lines = [
        f"void {LOOP}(long long samples, const double* const* given, double* const* out) {{",
        "  long long k;",
        "  int j;",
        *(f"  double now{i}[{n}];" for i, n in enumerate(takes)),
        *(f"  double next{i}[{n}], *restrict out{i} = out[{i}];" for i, n in enumerate(gives)),
        f"  double* res[] = {{{', '.join(f'next{i}' for i in range(len(gives)))}}};",
        f"  const double* arg[] = {{{', '.join(f'now{i}' for i in range(len(takes)))}}};",
        f"  const double* read = given[{carried}];",
        *(
            f"  for (j = 0; j < {n}; j++) now{i}[j] = given[{i}][j];"
            for i, n in enumerate(takes)
            if i != carried
        ),
        "  for (k = 0; k < samples; k++) {",
        f"    for (j = 0; j < {takes[carried]}; j++) now{carried}[j] = *read++;",
        f"    {STEP}(arg, res, 0, 0, 0);",
        *(
            f"    for (j = 0; j < {n}; j++) *out{i}++ = {kept[i]}next{i}[j];"
            for i, n in enumerate(gives)
        ),
        "  }",
        "}",
    ]
    return "\n".join(lines) + "\n"


def _source(step: ca.Function, loop: str) -> str:
    """Return C code of a step, and of its loop."""
    generator = ca.CodeGenerator("step", {"casadi_int": "int", "casadi_real": "double"})
    given = [ca.SX.sym(step.name_in(i), step.sparsity_in(i)) for i in range(step.n_in())]
    generator.add(ca.Function(STEP, given, step.call(given)))
    # the step is part of the loop, so that it need not go to memory for what it carries
    return f"#define CASADI_SYMBOL_EXPORT static\n{generator.dump()}{SHOWN}{loop}"


class Loop:
    """A step taken along the samples of one run by machine code, once that pays.

    Parameters
    ----------
    step : casadi.Function
        SX.
    text : str
        C code of the loop, a function `LOOP` of the number of samples, the arrays given and those
        to fill, to stand behind the function `STEP` that CasADi makes of the step.
    """

    def __init__(self, step: ca.Function, text: str) -> None:
        self._step, self._text = step, text
        self._taken = 0
        self._opened = self._compiled = False
        self._run: Callable[..., None] | None = None

    def pays(self, samples: int) -> bool:
        """Return whether the next `samples` steps are to be taken here, and count them."""
        if self._run is None and not self._compiled:
            self._taken += samples * self._step.n_instructions()
            if self._taken >= _LOOK and not self._opened:
                self._opened, self._run = True, self._library.found()
            if self._taken >= _PAYS and self._run is None:
                self._compiled, self._run = True, self._library.made()
        return self._run is not None

    def made(self) -> bool:
        """Return whether steps are to be taken here, from the first one on.

        Of what is done in another way elsewhere the same command gives the same digits each time.
        """
        if not self._compiled:
            self._opened = self._compiled = True
            self._run = self._run or self._library.found() or self._library.made()
        return self._run is not None

    @cached_property
    def _library(self) -> Library:
        key = (self._step.serialize(), self._text, ca.CasadiMeta.version())
        arguments = [ctypes.c_longlong, ctypes.c_void_p, ctypes.c_void_p]
        return Library(lambda: _source(self._step, self._text), LOOP, arguments, repr(key))

    def __call__(self, samples: int, given: Sequence[Array], out: Sequence[Array]) -> None:
        """Take steps; only after `pays` or `made` said so.

        Parameters
        ----------
        samples : int
        given : sequence of ndarray
            Arguments of the first step, contiguous; what changes is (samples, ·).
        out : sequence of ndarray
            Filled with the results of each step, (samples, ·), contiguous.
        """
        assert self._run is not None
        # a second thread may run while the library does, so pointers are those of this call
        first, last = (
            (ctypes.c_void_p * len(x))(*[a.ctypes.data for a in x]) for x in (given, out)
        )
        self._run(samples, first, last)


@lru_cache(maxsize=128)
def loop_of(step: ca.Function, carried: int) -> Loop:
    """Return the loop of a step, the same one each time.

    Parameters
    ----------
    step : casadi.Function
        SX. Arguments are what it hands to the next one, then a column that changes with the
        step, then constants; results begin with what is handed on.
    carried : int
        How many arguments are handed on.
    """
    return Loop(step, _loop_text(step, carried))
