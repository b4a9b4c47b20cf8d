"""All tests of an estimate, in the order in which a reader wants them."""

from __future__ import annotations

import numpy as np

from greybox.credibility.anderson_rubin import anderson_rubin
from greybox.credibility.combinations import combinations
from greybox.credibility.endogeneity import endogeneity
from greybox.credibility.evidence import Equation, Evidence
from greybox.credibility.excitation import excitation
from greybox.credibility.heading import heading_independence
from greybox.credibility.independence import input_independence
from greybox.credibility.many import many_instruments
from greybox.credibility.margins import margin_bias, sign_margins
from greybox.credibility.movement import movement
from greybox.credibility.overidentification import overidentification
from greybox.credibility.residuals import whiteness
from greybox.credibility.stability import damping_signs, stability
from greybox.credibility.weak import weak_instruments
from greybox.estimation.verdict import NotApplicable, TestResult, not_applicable

_OF_EQUATIONS = {
    "excitation": "the regressors that the instruments explain are independent",
    "relevance": "some combination of the regressors is hardly moved by the instruments",
    "weak_instruments": "the part of a regressor that no other has is hardly moved",
    "anderson_rubin": "intervals that hold under weak instruments are as wide as the ordinary ones",
    "overidentification": "the estimate satisfies the equations of all instruments",
    "input_independence": "the residuals do not depend on the inputs, at any delay",
    "many_instruments": "the instruments of several logs are few enough not to fit the noise",
    "endogeneity": "the regressors do not depend on the noise: least squares suffices",
}


def assess(evidence: Evidence) -> tuple[TestResult, ...]:
    """Run every test of an estimate.

    Parameters
    ----------
    evidence : Evidence

    Returns
    -------
    tuple of TestResult
        A test that does not apply is among them, with the reason.
    """
    tests: list[TestResult] = []
    for equation in evidence.equations:
        tests += _of_equation(evidence, equation)
    states = evidence.predictor.structure.states
    if not evidence.equations:
        diverged = evidence.instruments.diverged
        obstacle = NotApplicable(diverged or "there are no instruments", bool(diverged))
        for state in states:
            for name, null in _OF_EQUATIONS.items():
                tests.append(not_applicable(name, null, obstacle, state))
    for row, state in enumerate(states):
        tests += [whiteness(evidence, row), combinations(evidence, state)]
    if evidence.predictor.structure.marine:
        kept = sum(int(k.sum()) for k in evidence.keep)
        cut = evidence.regression.samples - kept
        tests += sign_margins(evidence.logs, states, evidence.margins, cut)
    tests += [
        movement(evidence),
        margin_bias(evidence),
        stability(evidence),
        damping_signs(evidence),
    ]
    return tuple(tests)


def _of_equation(evidence: Evidence, equation: Equation) -> list[TestResult]:
    biases = frozenset(c.label for c in evidence.predictor.columns if c.is_bias)
    if evidence.estimator.free_run:
        # a free run needs no instruments: only what speaks of the model is asked
        return [
            overidentification(equation, biases, each_log=False),
            input_independence(evidence, equation),
            *_still_water(evidence, equation),
        ]
    if not len(equation.columns) or not np.isfinite(equation.solution.theta).all():
        reason = "its instruments leave a direction free"
        return [
            not_applicable(name, null, reason, equation.state)
            for name, null in _OF_EQUATIONS.items()
        ]
    return [
        excitation(equation),
        *weak_instruments(equation, biases),
        _of_part("anderson_rubin", equation)
        if equation.whole is not None
        else anderson_rubin(evidence, equation, biases),
        overidentification(equation, biases),
        input_independence(evidence, equation),
        *_still_water(evidence, equation),
        _of_part("many_instruments", equation)
        if equation.whole is not None
        else many_instruments(equation, biases),
        endogeneity(equation, decisive=evidence.estimator.biased_by_noise),
    ]


def _of_part(name: str, equation: Equation) -> TestResult:
    """Return a test that says nothing of an estimate on more samples than the logs hold."""
    reason = (
        "the estimate rests on all samples, with as many instruments as parameters, and these "
        "logs are a part of them"
    )
    return not_applicable(name, _OF_EQUATIONS[name], reason, equation.state)


def _still_water(evidence: Evidence, equation: Equation) -> list[TestResult]:
    """Ask for a current where the structure may feel one."""
    if not evidence.predictor.structure.marine:
        return []
    return [heading_independence(evidence, equation)]
