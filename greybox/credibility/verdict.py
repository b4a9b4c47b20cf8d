"""What the tests of an estimate say together: trust, trust except these, or do not trust."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from greybox.estimation.registry import ESTIMATORS
from greybox.estimation.verdict import (
    MISFIT_TESTS,
    BiasSource,
    Divergence,
    FailedTest,
    Instability,
    LeastSquaresBias,
    Misfit,
    MostlyUndetermined,
    PoorFreeRun,
    Reason,
    SharedMoment,
    TestResult,
    TrustLevel,
    Verdict,
    refused,
)

# share of a correct model's estimates that may be refused for a misfit
_FAMILY = 0.01
# findings that concern some parameters and leave the others
_OF_PARAMETERS = {
    "relevance", "weak_instruments", "many_instruments", "anderson_rubin", "damping_signs",
    "margin_bias", "movement",
}  # fmt: skip


def weigh(
    tests: Sequence[TestResult],
    parameters: Sequence[str],
    method: str,
    *,
    contaminated: Sequence[str] = (),
    fit: Mapping[str, float] | None = None,
    diverged: bool = False,
) -> Verdict:
    """Weigh the tests of an estimate.

    Misfit (inputs explain the residuals, instruments contradict each other), an
    unstable model, and least squares that noise biases speak against the whole
    estimate; the rest against the parameters they name. Where more than half of
    them are named, nothing is left to trust. The tests of misfit are corrected
    for their number (Holm) and refuse one correct model in a hundred.

    Parameters
    ----------
    tests : sequence of TestResult
    parameters : sequence of str
        Labels of all parameters.
    method : str
    contaminated : sequence of str
        Parameters that carry a moment of the disturbance.
    fit : mapping of str to float, optional
        Free-run fit on the estimation logs [%].
    diverged : bool
        Whether the free run on the estimation logs diverges.
    """
    fatal: list[Reason] = [
        *misfit(tests),
        *_of_least_squares(tests, method),
        *free_run_faults(tests, fit, diverged),
    ]
    excepted: list[str] = []
    reasons: list[Reason] = []
    for test in tests:
        if test.passed is False and test.kind in _OF_PARAMETERS:
            excepted += [n for n in test.parameters if n in parameters]
            reasons.append(FailedTest(test))
    reasons += [FailedTest(t) for t in tests if t.kind == "convergence" and not t.passed]
    for name in contaminated:
        label = next((p for p in parameters if p.split("+")[0] == name), name)
        excepted.append(label)
        reasons.append(SharedMoment(label))
    excepted = [p for p in parameters if p in excepted]
    if 2 * len(excepted) > len(parameters):
        fatal.append(MostlyUndetermined(tuple(excepted), len(parameters)))
    if fatal:
        return refused((*fatal, *reasons), excepted)
    level = TrustLevel.TRUST_EXCEPT if excepted else TrustLevel.TRUST
    return Verdict(level, tuple(excepted), tuple(reasons))


def holm(p_values: Sequence[float], level: float) -> list[int]:
    """Return which hypotheses are rejected at a family level.

    References
    ----------
    Holm (1979).
    """
    order = sorted(range(len(p_values)), key=lambda i: p_values[i])
    rejected = []
    for rank, i in enumerate(order):
        if p_values[i] * (len(order) - rank) >= level:
            break
        rejected.append(i)
    return rejected


def misfit(tests: Sequence[TestResult]) -> tuple[Misfit, ...]:
    """Return what speaks against the structure, whatever the estimator; empty if nothing."""
    family = [t for t in tests if t.kind in MISFIT_TESTS and t.p_value is not None]
    found = [family[i] for i in holm([t.p_value or 0.0 for t in family], _FAMILY)]
    explained = {}
    # what is moved by inputs moves the motion too
    moved = {t.state for t in found if t.kind != "overidentification"}
    for kind in MISFIT_TESTS:
        states = tuple(dict.fromkeys(t.state for t in found if t.kind == kind))
        if kind == "overidentification":
            states = tuple(s for s in states if s not in moved)
        if states:
            explained[kind] = states
    if not explained:
        return ()
    return (Misfit(explained, {t.name: t.p_value or 0.0 for t in found}),)


def _of_least_squares(tests: Sequence[TestResult], method: str) -> tuple[LeastSquaresBias, ...]:
    if not ESTIMATORS[method].biased_by_noise:
        return ()
    family = [t for t in tests if t.kind == "endogeneity"]
    if any(t.kind == "closed_loop" and t.passed is False for t in tests):
        return (LeastSquaresBias(BiasSource.CLOSED_LOOP),)
    if any(t.obstacle is not None and t.obstacle.diverged for t in family):
        return (LeastSquaresBias(BiasSource.UNKNOWN),)
    known = [t for t in family if t.p_value is not None]
    found = [known[i] for i in holm([t.p_value or 0.0 for t in known], 0.05)]
    if not found:
        return ()
    p_values = {t.state: t.p_value or 0.0 for t in known if t in found}
    return (LeastSquaresBias(BiasSource.NOISE, p_values),)


def free_run_faults(
    tests: Sequence[TestResult], fit: Mapping[str, float] | None, diverged: bool = False
) -> tuple[Reason, ...]:
    """Return what speaks against simulating with the model; empty if nothing."""
    out: list[Reason] = []
    if diverged:
        out.append(Divergence())
    poor = {s: v for s, v in (fit or {}).items() if v < 0}
    if poor and not diverged:
        out.append(PoorFreeRun(poor))
    out += [
        Instability(t.detail["unstable_samples"], t.detail["unstable_draws"])
        for t in tests
        if t.kind == "stability" and t.passed is False
    ]
    return tuple(out)
