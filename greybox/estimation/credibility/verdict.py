"""One sentence on top: trust, trust except these parameters, or do not trust."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from greybox.estimation.credibility.words import listed
from greybox.estimation.result import TestResult, Verdict

# share of a correct model's estimates that may be refused for a misfit
_FAMILY = 0.01
# findings that concern some parameters and leave the others
_OF_PARAMETERS = (
    "relevance_", "weak_instruments_", "many_instruments_", "anderson_rubin_", "damping_signs",
    "margin_bias",
)  # fmt: skip
# tests of the structure: by what they explain the residuals
_LAST = "overidentification_"
_EXPLAIN = {
    "heading_independence_": "the heading still explains",
    "input_independence_": "the inputs still explain",
    _LAST: "the simulated motion still explains",
}
_OF_THE_MODEL = tuple(_EXPLAIN)


def judge(
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
    fatal = [*misfit(tests), *_of_least_squares(tests, method), *motion(tests, fit, diverged)]
    excepted: list[str] = []
    reasons: list[str] = []
    for test in tests:
        if test.passed is False and test.name.startswith(_OF_PARAMETERS):
            excepted += [n for n in test.parameters if n in parameters]
            reasons.append(f"{test.name}: {test.sentence}")
    reasons += [
        f"{t.name}: {t.sentence}" for t in tests if t.name == "convergence" and not t.passed
    ]
    for name in contaminated:
        label = next((p for p in parameters if p.split("+")[0] == name), name)
        excepted.append(label)
        reasons.append(f"{label} also carries a moment of the current or wind.")
    excepted = [p for p in parameters if p in excepted]
    if 2 * len(excepted) > len(parameters):
        fatal.append(
            f"{len(excepted)} of {len(parameters)} parameters are not determined "
            f"({listed(excepted)})"
        )
    if fatal:
        return Verdict(f"do not trust: {'; '.join(fatal)}", tuple(excepted), (*fatal, *reasons))
    if excepted:
        return Verdict(f"trust except {listed(excepted)}", tuple(excepted), tuple(reasons))
    return Verdict("trust", (), tuple(reasons))


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


def misfit(tests: Sequence[TestResult]) -> list[str]:
    """Return what speaks against the structure, whatever the estimator; empty if nothing."""
    family = [t for t in tests if t.name.startswith(_OF_THE_MODEL) and t.p_value is not None]
    found = [family[i] for i in holm([t.p_value or 0.0 for t in family], _FAMILY)]
    told = []
    for test, explain in _EXPLAIN.items():
        states = dict.fromkeys(t.name.rsplit("_", 1)[1] for t in found if t.name.startswith(test))
        if test == _LAST:
            # what is moved by inputs moves the motion too
            moved = {t.name.rsplit("_", 1)[1] for t in found if not t.name.startswith(_LAST)}
            states = {s: None for s in states if s not in moved}
        if states:
            told.append(f"{explain} the residuals of {listed([*states])}")
    only = told and all("heading" in t for t in told)
    lacks = " lacks a current or wind" if only else " lacks something"
    return [f"{' and '.join(told)}, so the model{lacks}"] if told else []


def _of_least_squares(tests: Sequence[TestResult], method: str) -> list[str]:
    if method != "ls":
        return []
    family = [t for t in tests if t.name.startswith("endogeneity_")]
    if any(t.name == "closed_loop" and t.passed is False for t in tests):
        return ["least squares on a closed loop is biased by an unknown amount (--method iv)"]
    known = [t for t in family if t.p_value is not None]
    if any("left its bound" in t.sentence for t in family):
        return ["least squares could not be compared with instruments, so its bias is not known"]
    found = [known[i] for i in holm([t.p_value or 0.0 for t in known], 0.05)]
    if not found:
        return []
    states = [t.name.rsplit("_", 1)[1] for t in known if t in found]
    return [f"noise in the regressors of {listed(states)} biases least squares (--method iv)"]


def motion(
    tests: Sequence[TestResult], fit: Mapping[str, float] | None, diverged: bool = False
) -> list[str]:
    """Return what speaks against simulating with the model; empty if nothing."""
    out = []
    if diverged:
        out.append("its free run diverges on the estimation logs")
    poor = [s for s, v in (fit or {}).items() if v < 0]
    if poor and not diverged:
        out.append(f"its free run of {listed(poor)} is worse than a constant")
    for test in tests:
        if test.name == "stability" and test.passed is False:
            if max(test.detail["unstable_samples"], test.detail["unstable_draws"]) >= 0.5:
                out.append("the model is unstable along the motion")
            else:
                share = 100 * test.detail["unstable_draws"]
                out.append(f"{share:.0f} % of the models within its standard errors are unstable")
    return out
