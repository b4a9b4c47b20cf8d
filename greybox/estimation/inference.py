"""Intervals and tests of linear restrictions on named parameters."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from math import isfinite
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import UsageError, suggestion
from greybox.estimation.verdict import Distribution, TestResult
from greybox.numerics.linalg import scaled_inverse

Array = NDArray[np.float64]
# one restriction or several in words, or the value of each parameter
Restrictions = str | Sequence[str] | Mapping[str, float]

_LEVEL = 0.05
_NUMBER = r"\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?"
_PART = re.compile(
    rf"\s*(?P<sign>[+-]?)\s*(?:(?P<factor>{_NUMBER})\s*(?:\*\s*)?)?(?P<name>[^\W\d][^\s+*-]*)?\s*"
)


def _shown(value: Any) -> str:
    """Return a value as a sentence shows it."""
    return f"{float(value):g}" if isinstance(value, Real) else f"{value!r:.40}"


def confidence_intervals(values: Array, std: Array, level: float) -> Array:
    """Return the limits (p, 2) of intervals from the normal distribution.

    Raises
    ------
    UsageError
        The level is not between 0 and 1.
    """
    from scipy.special import ndtri

    given: Any = level
    if not isinstance(given, Real) or not 0 < level < 1:
        raise UsageError(
            f"the level of an interval is {_shown(level)}, give a number between 0 and 1, such as "
            f"0.95."
        )
    reach = float(ndtri((1 + level) / 2)) * std
    return np.column_stack([values - reach, values + reach])


def restriction_matrix(
    names: Sequence[str], restrictions: Restrictions | None
) -> tuple[Array, Array, str]:
    """Return R (q, p), the values (q,) that R θ has under the null, and the null in words.

    Parameters
    ----------
    names : sequence of str
        Of the parameters, (p,).
    restrictions : str, sequence of str or mapping of str to float, optional
        As `Estimate.wald_test`.

    Raises
    ------
    UsageError
        A restriction cannot be read, names no parameter, or follows from the others.
    """
    if restrictions is None:
        restrictions = dict.fromkeys(names, 0.0)
    if isinstance(restrictions, Mapping):
        given: Any
        for name, given in restrictions.items():
            if not isinstance(given, Real) or not isfinite(given):
                raise UsageError(
                    f"the restriction of {name!r:.40} is {_shown(given)}, a finite number is "
                    f"needed: write {{'{names[0]}': 0.1}}, or '{names[0]} = 0.1'."
                )
        told = [f"{name} = {float(value):g}" for name, value in restrictions.items()]
        rows = [({name: 1.0}, float(value)) for name, value in restrictions.items()]
    else:
        told = [" ".join(text.split()) for text in _texts(names, restrictions)]
        rows = [_restriction(text) for text in told]
    if not rows:
        raise UsageError("there is no restriction to test: write one as 'Xu = 2*Yv + 0.1'.")
    matrix, values = np.zeros((len(rows), len(names))), np.zeros(len(rows))
    for i, (weights, value) in enumerate(rows):
        for name, weight in weights.items():
            if name not in names:
                raise UsageError(
                    f"the restriction '{told[i]}' names '{name}', which is no parameter."
                    f"{suggestion(str(name), names)} Parameters: {', '.join(names)}."
                )
            matrix[i, list(names).index(name)] = weight
        if not matrix[i].any():
            raise UsageError(
                f"the restriction '{told[i]}' names no parameter: write it as "
                f"'{names[0]} = 0.1'. Parameters: {', '.join(names)}."
            )
        values[i] = value
    rank = int(np.linalg.matrix_rank(matrix))
    if rank < len(rows):
        raise UsageError(
            f"{len(rows)} restrictions hold {rank} independent ones ({'; '.join(told)}): name each "
            f"only once."
        )
    return matrix, values, " and ".join(told)


def _texts(names: Sequence[str], given: Any) -> list[str]:
    """Return the restrictions one by one."""
    if isinstance(given, str):
        return given.split(",")
    texts = list(given) if isinstance(given, Iterable) else [given]
    for text in texts:
        if not isinstance(text, str):
            raise UsageError(
                f"the restriction {text!r:.40} names no parameter: write '{names[0]} = 0.1' or "
                f"{{'{names[0]}': 0.1}}. Parameters: {', '.join(names)}."
            )
    return texts


def _restriction(text: str) -> tuple[dict[str, float], float]:
    """Return the weights and the value of ``2*Xu - Yv = 0.1``."""
    left, equals, right = text.partition("=")
    if not equals or "=" in right:
        raise UsageError(f"the restriction '{text}' cannot be read: write it as 'Xu = 2*Yv + 0.1'.")
    weights: dict[str, float] = {}
    value = 0.0
    for side, turn in ((left, 1.0), (right, -1.0)):
        for name, amount in _sum(side, text):
            if name:
                weights[name] = weights.get(name, 0.0) + turn * amount
            else:
                value -= turn * amount
    return weights, value


def _sum(side: str, text: str) -> list[tuple[str, float]]:
    """Return the names and factors of a sum; numbers by themselves have no name."""
    parts: list[tuple[str, float]] = []
    at = 0
    while at < len(side):
        part = _PART.match(side, at)
        if part is None or part.end() == at or not (part["factor"] or part["name"]):
            break
        if parts and not part["sign"]:
            break
        amount = float(part["factor"] or 1.0) * (-1.0 if part["sign"] == "-" else 1.0)
        parts.append((part["name"] or "", amount))
        at = part.end()
    if at < len(side) or not parts:
        raise UsageError(f"the restriction '{text}' cannot be read: write it as 'Xu = 2*Yv + 0.1'.")
    return parts


def wald_test(
    names: Sequence[str], theta: Array, covariance: Array, restrictions: Restrictions | None
) -> TestResult:
    """Test linear restrictions on parameters by their covariance.

    Parameters
    ----------
    names : sequence of str
    theta, covariance : ndarray
        (p,) and (p, p).
    restrictions : str, sequence of str or mapping of str to float, optional
        As `Estimate.wald_test`.

    Returns
    -------
    TestResult
        χ² with as many degrees of freedom as there are restrictions.

    Raises
    ------
    UsageError
        A restriction cannot be read, names no parameter, or follows from the others.

    References
    ----------
    Wald (1943).
    """
    matrix, values, told = restriction_matrix(names, restrictions)
    away = matrix @ theta - values
    spread = matrix @ covariance @ matrix.T
    variance = np.diag(spread)
    null = Distribution("chi2", (float(len(away)),))
    if not (np.isfinite(variance).all() and (variance > 0).all()):
        raise UsageError(
            f"the standard error of {told} is not known, so it cannot be tested: leave such "
            f"parameters out."
        )
    statistic = float(away @ scaled_inverse(spread) @ away)
    p = null.sf(statistic)
    return TestResult(
        "wald",
        told,
        statistic,
        p,
        f"χ²({len(away)}) = {statistic:.4g} (p = {p:.2g}): {told} is "
        f"{'rejected' if p < _LEVEL else 'not rejected'} at the {100 * _LEVEL:.0f} % level.",
        _LEVEL,
        p >= _LEVEL,
        tuple(n for n, column in zip(names, matrix.T, strict=True) if column.any()),
        distribution=null,
    )
