"""Tests of the errors of a free run: white or coloured, related to the inputs or not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.evidence.omnibus import Omnibus
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.point import Fit
from greybox.diagnosis.symptoms import word
from greybox.diagnosis.waves import Waves
from greybox.estimation.verdict import Distribution, TestResult

Array = NDArray[np.float64]

# samples that the errors' memory is looked for in, and the level of each test
_LAGS, _LEVEL = 20, 0.05


def residual_tests(
    problem: Problem, fit: Fit, left: Omnibus, waves: Waves | None
) -> tuple[TestResult, ...]:
    """Test the errors of a free run.

    Parameters
    ----------
    problem : Problem
    fit : Fit
    left : Omnibus
        Of the fit.
    waves : Waves or None
        A line in its innovations.

    Returns
    -------
    tuple of TestResult
        Whiteness of each state's error, independence of motion, commands, heading
        and time, and narrow-band motion.

    References
    ----------
    Ljung and Box (1978); Stoffer and Toloi (1992), where samples are missing.
    """
    errors, known = np.concatenate(fit.errors), np.concatenate(problem.known)
    out = [
        _whiteness(name, errors[:, i], known[:, i])
        for i, name in enumerate(problem.structure.states)
    ]
    free = left.proof.p_value > _LEVEL
    z = left.proof.gain / left.proof.std if left.proof.std > 0 else 0.0
    out.append(
        TestResult(
            "independence",
            "no force of motion, commands, heading or time explains errors that it was not "
            "fitted to",
            z,
            left.proof.p_value,
            f"a force of motion, commands, heading or time would explain "
            f"{100 * left.explicable:.1f} % of the squared errors of the held-out logs"
            f"{'' if not free else ', which chance does too'}.",
            _LEVEL,
            free,
            detail={"explicable": left.explicable},
        )
    )
    told = (
        "no frequency stands out of the errors."
        if waves is None
        else f"{waves.frequency:.3f} Hz stands {waves.ratio:.0f} times above its surroundings."
    )
    out.append(
        TestResult(
            "narrow_band",
            "no frequency stands out of the errors",
            None if waves is None else waves.ratio,
            None if waves is None else waves.p_value,
            told,
            _LEVEL,
            waves is None,
        )
    )
    return tuple(out)


def _whiteness(name: str, e: Array, known: NDArray[np.bool_] | None = None) -> TestResult:
    known = np.ones(len(e), bool) if known is None else known
    n = int(known.sum())
    e = np.where(known, e - e[known].sum() / max(n, 1), 0.0)
    energy = max(float(e @ e), 1e-300)
    lags = range(1, _LAGS + 1)
    rho = np.array([float(e[k:] @ e[:-k]) / energy for k in lags])
    pairs = np.maximum([int((known[k:] & known[:-k]).sum()) for k in lags], 1)
    statistic = n * (n + 2) * float((rho**2 / pairs).sum())
    null = Distribution("chi2", (float(_LAGS),))
    p = null.sf(statistic)
    return TestResult(
        "whiteness",
        f"the free-run error of {word(name)} is white",
        statistic,
        p,
        f"the error of {word(name)} "
        + (
            "is not told from sensor noise."
            if p > _LEVEL
            else f"has a memory: {rho[0]:.2f} from sample to sample."
        ),
        _LEVEL,
        p > _LEVEL,
        state=name,
        distribution=null,
    )
