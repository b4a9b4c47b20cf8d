"""Tests and verdict of an estimate as values; sentences are rendered from them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import Enum, StrEnum
from typing import Any, ClassVar, Literal

from greybox.errors import so_many
from greybox.notebook import DisplayMixin, items

# degrees of freedom of a variance from which on F is χ²
_KNOWN = 1e6


@dataclass(frozen=True)
class Distribution:
    """Distribution of a statistic under its null hypothesis.

    Parameters
    ----------
    family : {"chi2", "F"}
    parameters : tuple of float
        Degrees of freedom.
    scale : float
        The statistic is this times a variable of the family.
    """

    family: Literal["chi2", "F"]
    parameters: tuple[float, ...]
    scale: float = 1.0

    def sf(self, statistic: float) -> float:
        """Return the probability of a larger statistic."""
        from scipy.special import chdtrc, fdtrc

        tail = chdtrc if self.family == "chi2" else fdtrc
        return float(tail(*self.parameters, statistic / self.scale))

    def __str__(self) -> str:
        name, shown, scale = self.family, self.parameters, self.scale
        if name == "F" and shown[1] >= _KNOWN:
            name, shown, scale = "chi2", shown[:1], scale / shown[0]
        factor = "" if abs(scale - 1) < 1e-6 else f"{scale:.4g}·"
        return f"{factor}{'χ²' if name == 'chi2' else name}({', '.join(f'{p:.4g}' for p in shown)})"


@dataclass(frozen=True)
class NotApplicable:
    """Why a test was not made.

    Parameters
    ----------
    because : str
    diverged : bool
        Whether the simulation of the instruments left its bound.
    """

    because: str
    diverged: bool = False


@dataclass(frozen=True, repr=False)
class TestResult(DisplayMixin):
    """One test: what it supposes, what it found, and a sentence to act on.

    Parameters
    ----------
    kind : str
        What is tested, such as ``endogeneity``.
    null : str
        The null hypothesis.
    statistic, p_value : float or None
        None where the test does not apply, or has no such number.
    sentence : str
    level : float, optional
        What the statistic, or the p-value where there is one, is compared with.
    passed : bool, optional
        None where the test does not apply or only informs.
    parameters : tuple of str
        Parameters that the finding concerns.
    detail : mapping
        Numbers behind the sentence, for machines.
    state : str
        Whose equation is tested; empty where the test is of the whole model.
    distribution : Distribution, optional
        Of the statistic under the null, where it has a p-value.
    obstacle : NotApplicable, optional
        Why the test does not apply.
    """

    kind: str
    null: str
    statistic: float | None
    p_value: float | None
    sentence: str
    level: float | None = None
    passed: bool | None = None
    parameters: tuple[str, ...] = ()
    detail: Mapping[str, Any] = field(default_factory=dict)
    state: str = ""
    distribution: Distribution | None = None
    obstacle: NotApplicable | None = None

    __test__ = False  # not a test case

    @property
    def name(self) -> str:
        """Kind, and the equation where it is of one: ``endogeneity_u``."""
        return f"{self.kind}_{self.state}" if self.state else self.kind

    @property
    def df(self) -> float | None:
        """Degrees of freedom of the statistic, None where it has none."""
        return None if self.distribution is None else self.distribution.parameters[0]

    def summary(self) -> str:
        """Return null hypothesis and finding as text."""
        return f"{self.name}: {self.sentence}\n  null hypothesis: {self.null}"

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            "null": self.null,
            "statistic": self.statistic,
            "p_value": self.p_value,
            "distribution": None if self.distribution is None else str(self.distribution),
            "sentence": self.sentence,
            "level": self.level,
            "passed": self.passed,
            "not_applicable": None if self.obstacle is None else self.obstacle.because,
            "parameters": list(self.parameters),
            "detail": dict(self.detail),
        }


def not_applicable(
    kind: str, null: str, obstacle: str | NotApplicable, state: str = ""
) -> TestResult:
    """Return a test that does not apply, with the reason."""
    why = obstacle if isinstance(obstacle, NotApplicable) else NotApplicable(obstacle)
    said = f"not applicable: {why.because}."
    return TestResult(kind, null, None, None, said, state=state, obstacle=why)


class TrustLevel(StrEnum):
    """How far an estimate may be trusted; the values are the words that users read."""

    TRUST = "trust"
    TRUST_EXCEPT = "trust except"
    DO_NOT_TRUST = "do not trust"
    NOT_JUDGED = "not judged"


@dataclass(frozen=True)
class Reason(ABC):
    """One reason of a verdict.

    ``fatal`` reasons speak against the whole estimate, others against parameters, or only inform.
    """

    kind: ClassVar[str]
    fatal: ClassVar[bool] = True

    @property
    @abstractmethod
    def sentence(self) -> str:
        """The reason in words."""

    def to_dict(self) -> dict[str, Any]:
        """Return kind, numbers and sentence for JSON."""
        numbers = {f.name: _plain(getattr(self, f.name)) for f in fields(self)}
        return {"kind": self.kind, "fatal": self.fatal, **numbers, "sentence": self.sentence}


def _plain(value: Any) -> Any:
    if isinstance(value, TestResult):
        return value.name
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    return list(value) if isinstance(value, tuple) else value


# what explains the residuals, by the test that finds it
_EXPLAINS = {
    "heading_independence": "the heading",
    "input_independence": "the inputs",
    "overidentification": "the simulated motion",
}
MISFIT_TESTS = tuple(_EXPLAINS)


@dataclass(frozen=True)
class Misfit(Reason):
    """Something still explains the residuals: the structure is too small.

    Parameters
    ----------
    explained : mapping of str to tuple of str
        Kind of test -> states whose residuals it rejects.
    p_values : mapping of str to float
        Of the tests that reject, by name.
    """

    explained: Mapping[str, tuple[str, ...]]
    p_values: Mapping[str, float]

    kind: ClassVar[str] = "misfit"

    @property
    def sentence(self) -> str:
        """What explains the residuals of which equations."""
        told = [
            f"{what} still explain{'' if test == 'input_independence' else 's'} the residuals of "
            f"{', '.join(self.explained[test])}"
            for test, what in _EXPLAINS.items()
            if test in self.explained
        ]
        only = set(self.explained) == {"heading_independence"}
        lacks = "a current or wind" if only else "something"
        return f"{' and '.join(told)}, so the model lacks {lacks}"


class BiasSource(Enum):
    """Why least squares is biased; the values are the sentences that users read."""

    CLOSED_LOOP = "least squares on a closed loop is biased by an unknown amount (--method iv)"
    UNKNOWN = "least squares could not be compared with instruments, so its bias is not known"
    NOISE = "noise in the regressors of {states} biases least squares (--method iv)"


@dataclass(frozen=True)
class LeastSquaresBias(Reason):
    """Least squares is biased, or may be.

    Parameters
    ----------
    source : BiasSource
    p_values : mapping of str to float
        State -> p-value of the Durbin-Wu-Hausman test, where noise was found in regressors.
    """

    source: BiasSource
    p_values: Mapping[str, float] = field(default_factory=dict)

    kind: ClassVar[str] = "least_squares_bias"

    @property
    def sentence(self) -> str:
        """Why, and what to do."""
        return self.source.value.format(states=", ".join(self.p_values))

    def to_dict(self) -> dict[str, Any]:
        """Return kind, numbers and sentence for JSON."""
        return super().to_dict() | {"source": self.source.name.lower()}


@dataclass(frozen=True)
class Divergence(Reason):
    """The free run leaves its bound."""

    kind: ClassVar[str] = "divergence"

    @property
    def sentence(self) -> str:
        """What diverges."""
        return "its free run diverges on the estimation logs"


@dataclass(frozen=True)
class PoorFreeRun(Reason):
    """The free run is worse than a constant.

    Parameters
    ----------
    fit : mapping of str to float
        State -> free-run fit (6.12), below zero [%].
    """

    fit: Mapping[str, float]

    kind: ClassVar[str] = "poor_free_run"

    @property
    def sentence(self) -> str:
        """In which states."""
        return f"its free run of {', '.join(self.fit)} is worse than a constant"


@dataclass(frozen=True)
class Instability(Reason):
    """The identified model is unstable, or may be.

    Parameters
    ----------
    samples : float
        Share of the motion along which the largest eigenvalue exceeds 1.
    draws : float
        Share of models drawn from the covariance that are unstable.
    """

    samples: float
    draws: float

    kind: ClassVar[str] = "instability"

    @property
    def sentence(self) -> str:
        """Whether the estimate itself, or which share of its neighbours."""
        if max(self.samples, self.draws) >= 0.5:
            return "the model is unstable along the motion"
        return f"{100 * self.draws:.0f} % of the models within its standard errors are unstable"


@dataclass(frozen=True)
class MostlyUndetermined(Reason):
    """Most parameters are not determined.

    Parameters
    ----------
    parameters : tuple of str
    count : int
        Of all parameters.
    """

    parameters: tuple[str, ...]
    count: int

    kind: ClassVar[str] = "mostly_undetermined"

    @property
    def sentence(self) -> str:
        """Which."""
        return (
            f"{len(self.parameters)} of {so_many(self.count, 'parameter')} "
            f"{'is' if len(self.parameters) == 1 else 'are'} not determined "
            f"({', '.join(self.parameters)})"
        )


@dataclass(frozen=True)
class NoRegression(Reason):
    """The logs do not determine the regression that the tests rest on.

    Parameters
    ----------
    because : str
    """

    because: str

    kind: ClassVar[str] = "no_regression"

    @property
    def sentence(self) -> str:
        """What the logs lack."""
        return self.because


@dataclass(frozen=True)
class FailedTest(Reason):
    """A failed test, with the parameters that it concerns or the state of the iteration.

    Parameters
    ----------
    test : TestResult
    """

    test: TestResult

    kind: ClassVar[str] = "failed_test"
    fatal: ClassVar[bool] = False

    @property
    def sentence(self) -> str:
        """The test's own."""
        return f"{self.test.name}: {self.test.sentence}"


@dataclass(frozen=True)
class SharedMoment(Reason):
    """A parameter carries a moment of the disturbance too.

    Parameters
    ----------
    parameter : str
    """

    parameter: str

    kind: ClassVar[str] = "shared_moment"
    fatal: ClassVar[bool] = False

    @property
    def sentence(self) -> str:
        """Which parameter."""
        return f"{self.parameter} also carries a moment of the current or wind."


@dataclass(frozen=True, repr=False)
class Verdict(DisplayMixin):
    """Whether the coefficients of an estimate mean what their names say.

    Parameters
    ----------
    level : TrustLevel
    excepted : tuple of str
        Parameters not to rely on.
    because : tuple of Reason
        Those against the whole estimate first.
    """

    level: TrustLevel
    excepted: tuple[str, ...] = ()
    because: tuple[Reason, ...] = ()

    @property
    def text(self) -> str:
        """``trust``, ``trust except A, B`` or ``do not trust: reason``."""
        if self.level is TrustLevel.TRUST_EXCEPT:
            return f"{self.level} {', '.join(self.excepted)}"
        fatal = [r.sentence.rstrip(".") for r in self.because if r.fatal]
        return f"{self.level}: {'; '.join(fatal)}" if fatal else str(self.level)

    @property
    def reason(self) -> str:
        """Why this level, in one sentence without its stop."""
        fatal = [r for r in self.because if r.fatal]
        said = [r.sentence.rstrip(".") for r in fatal or self.because]
        if not said and self.level is TrustLevel.NOT_JUDGED:
            return "tests were not asked for"
        return "; ".join(said) or "no test speaks against them"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons for the level, a sentence each."""
        return tuple(r.sentence for r in self.because)

    def summary(self) -> str:
        """Return the verdict and its reasons as text."""
        return "\n".join([self.text, *(f"  {r}" for r in self.reasons)])

    def _parts(self) -> tuple[str, ...]:
        return (items("Because", self.reasons),)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            "level": str(self.level),
            "text": self.text,
            "except": list(self.excepted),
            "reason": self.reason,
            "because": [r.to_dict() for r in self.because],
        }


def refused(reasons: Sequence[Reason], excepted: Sequence[str]) -> Verdict:
    """Return the verdict not to trust an estimate."""
    return Verdict(TrustLevel.DO_NOT_TRUST, tuple(excepted), tuple(reasons))


UNJUDGED = Verdict(TrustLevel.NOT_JUDGED)
