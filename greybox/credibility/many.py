"""Many instruments: logs with instruments of their own add up a bias towards least squares.

Every instrument fits a little of the noise in the regressors. One log has as
many instruments as parameters; E logs have E times as many, and the stacked
estimate (4.5) drifts towards least squares by the surplus.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greybox.credibility.evidence import Equation
from greybox.credibility.weak import orthonormal
from greybox.errors import so_many
from greybox.estimation.verdict import TestResult, not_applicable
from greybox.numerics.lagged_moments import lagged_products
from greybox.numerics.linalg import scaled_inverse

Array = NDArray[np.float64]

# standard errors of bias at which 95 % intervals cover 92 %; the prediction is cautious,
# because residuals of a biased estimate show less of what biased it
TOLERATED_BIAS = 0.5
# the noises of a regressor and of its equation meet within so many samples
_REACH = 2


def surplus_bias(equation: Equation) -> Array:
    """Return the bias of the stacked estimate that surplus instruments cause, (p,).

    E Σ ẑ e = Σ_k Σ_t P(t, t+k) γ_ve(k) with P the projection on the instruments
    of a log; the share (q − p)/q of it is the surplus. Residuals of a biased estimate
    show less of γ_ve than the errors themselves: it is taken at the estimate that is left
    when the bias is gone, which is linear in it.

    References
    ----------
    Nagar (1959); Bekker (1994).
    """
    p = len(equation.labels)
    q = 0
    traces = np.zeros(2 * _REACH + 1)
    # of the noise of the regressors with the residuals, and with the regressors themselves
    meeting = np.zeros((2 * _REACH + 1, p))
    itself = np.zeros((2 * _REACH + 1, p, p))
    for z, f, hat, e in zip(
        equation.z, equation.phi, equation.solution.projected, equation.residuals, strict=True
    ):
        basis = orthonormal(z)
        if not len(basis):
            continue
        q += len(basis)
        for k in range(-_REACH, _REACH + 1):
            noise = [f - hat]
            traces[k + _REACH] += float(np.trace(lagged_products([basis], [basis], k)))
            meeting[k + _REACH] += lagged_products(noise, [e[None]], -k)[:, 0]
            itself[k + _REACH] += lagged_products(noise, [f], -k)
    weights = traces / max(equation.freedom - q, 1) * max(q - p, 0) / max(q, 1)
    left = equation.solution.information - np.tensordot(weights, itself, 1)
    return np.asarray(scaled_inverse(left) @ (weights @ meeting))


def many_instruments(equation: Equation, biases: frozenset[str]) -> TestResult:
    """Say in standard errors what surplus instruments bias."""
    null = "the instruments of several logs are few enough not to fit the noise"
    if equation.obstacle:
        return not_applicable("many_instruments", null, equation.obstacle, equation.state)
    if len(equation.z) == 1:
        reason = "one log has as many instruments as parameters"
        return not_applicable("many_instruments", null, reason, equation.state)
    std = np.where(equation.std > 0, equation.std, np.inf)
    ratio = dict(zip(equation.labels, (surplus_bias(equation) / std).tolist(), strict=True))
    wanted = [n for n in equation.labels if n not in biases]
    worst = max(wanted, key=lambda n: abs(ratio[n]))
    hit = tuple(n for n in wanted if abs(ratio[n]) > TOLERATED_BIAS)
    return TestResult(
        "many_instruments",
        null,
        abs(ratio[worst]),
        None,
        f"the instruments of {so_many(len(equation.z), 'log')} bias the estimate towards least "
        f"squares, most "
        f"{worst}, by {ratio[worst]:+.2f} standard errors"
        + (f" ({', '.join(hit)} by more than half): use fewer, longer logs." if hit else "."),
        TOLERATED_BIAS,
        not hit,
        hit,
        {"standard_errors": {n: ratio[n] for n in wanted}},
        state=equation.state,
    )
