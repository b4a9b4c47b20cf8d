"""Options of `design` that do not go together, and how each is refused.

What is asked is a set of words: options by the names of their values, such as ``margin_v``; the
purpose, such as ``for causes``; and ``prior none``, ``criterion c``, which are values that
matter here. What the prior model and the regime have to be for an option to act is a condition,
such as ``a yaw rate``, which can be judged only once these are known.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import dataclass
from types import MappingProxyType

from greybox.errors import UsageError

# options that ask for the precision of coefficients by themselves
COEFFICIENTS = (
    "criterion", "want", "of", "target", "estimator", "regime", "prior", "robust", "margin_v",
    "margin_air",
)  # fmt: skip
# conditions that options act under
YAW_RATE, COVARIANCE, MEASURED_WIND = "a yaw rate", "a covariance", "a measured wind"
SURGE_SIGN, SWAY_SIGN = "a sign of surge", "a sign of sway"
REGRESSORS = "an estimator of regressors"
CONDITIONS = (YAW_RATE, COVARIANCE, MEASURED_WIND, SURGE_SIGN, SWAY_SIGN, REGRESSORS)
_SPELT = {"purpose": "--for"}


def spelt(name: str) -> str:
    """Return an option, a purpose or a condition as a user reads it."""
    return name if name in CONDITIONS else _SPELT.get(name, f"--{name.replace('_', '-')}")


@dataclass(frozen=True)
class Exclusion:
    """Options that are refused beside others, or without what they act on.

    Parameters
    ----------
    options : tuple of str
        Any of these is refused
    against : tuple of str
        beside any of these,
    needs : tuple of str
        or without all of these.
    why : str
        Reason; ``{option}`` and ``{other}`` stand for the two that met.
    instead : str
        What to do.
    """

    options: tuple[str, ...]
    against: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    why: str = ""
    instead: str = ""

    def sentence(self, given: Set[str], lacking: Mapping[str, str]) -> str:
        """Return why options are refused and what to do, ``""`` where they are not.

        Parameters
        ----------
        given : set of str
        lacking : mapping of str to str
            Conditions that are not met, each with what is so instead.
        """
        option = next((n for n in self.options if n in given), "")
        other = next((n for n in self.against if n in given), "")
        unmet = next((lacking[n] for n in self.needs if n in lacking), "")
        absent = self.needs and not given & set(self.needs)
        if not option or not (other or unmet or (absent and self.needs[0] not in CONDITIONS)):
            return ""
        return self.told(spelt(option), spelt(other), unmet)

    def told(self, option: str, other: str, unmet: str = "") -> str:
        """Return the sentence on two options, and on what is so instead of a condition."""
        said = f"{self.why}, and {unmet}" if unmet else self.why
        return f"{said}: {self.instead}.".replace("{option}", option).replace("{other}", other)


def _beside(options: str, against: str, why: str, instead: str = "leave out {other}") -> Exclusion:
    return Exclusion(_names(options), against=_names(against), why=why, instead=instead)


def _without(options: str, needs: str, why: str, instead: str) -> Exclusion:
    return Exclusion(_names(options), needs=_names(needs), why=why, instead=instead)


def _names(text: str) -> tuple[str, ...]:
    return tuple(n.strip() for n in text.split(","))


_ALL = ", ".join(COEFFICIENTS)
# in the order in which they are told: the first one that is broken
RULES = (
    _beside(
        "between", "purpose, envelope, causes, diagnosis", "{option} tells two explanations apart",
    ),
    _beside(
        "prior none", "model, between", "{option} starts without any model and {other} names one",
        "leave one of them out",
    ),
    _beside(
        "prior none", "after", "{option} starts without any trial and {other} names one",
        "leave one of them out",
    ),
    _beside(
        "after", "prior", "{option} takes what its logs told as known beforehand",
        "leave out {other}, and name all logs behind {option}",
    ),
    _beside(
        "after", "between",
        "{option} designs the rest of a trial for one model and {other} tells two apart",
        "leave one of them out",
    ),
    _without(
        "save_model", "after", "{option} writes the model that --after LOG estimates", "name LOG"
    ),
    _beside(
        "save_model", "model",
        "{option} writes the model that --after estimates and {other} names one that is there",
        "leave one of them out",
    ),
    _beside(
        "between", "criterion, want, of, target, estimator, prior, robust",
        "{option} looks at how differently two models move, and not at the precision of "
        "coefficients",
    ),
    _beside("between, for causes", "trials", "{option} designs one trial at a time"),
    _beside("causes", "diagnosis", "{option} and {other} both say what is open",
            "give one of them"),
    _without(
        "causes, diagnosis", "for causes", "{option} says what is open",
        "use --for causes with it",
    ),
    _beside("for causes", _ALL, "{option} tests causes and not coefficients"),
    _beside(
        "for causes", "after, prior none", "{option} needs the model that was diagnosed",
        "leave out {other} and give it by --model",
    ),
    _beside(
        "for prediction", _ALL, "{option} covers all coefficients and both sides",
        "leave out {other}, or use --for coefficients",
    ),
    _without(
        "envelope", "for prediction, for causes",
        "{option} says what predictions are wanted for", "use --for prediction with it",
    ),
    _beside(
        "target", "criterion, want, of",
        "{option} makes the standard errors that it names small, and no others",
    ),
    _beside("of", "want", "{option} names by itself which parameters count"),
    _without(
        "of", "criterion c", "{option} names a function of the parameters, and criterion c is the "
        "only one that looks at it", "use --criterion c with it",
    ),
    _without(
        "criterion c", "of",
        "{option} looks at one coefficient or one function of the parameters",
        "name it, such as --of Yvv or --of 'Xuu/Xmu'",
    ),
    _without(
        "worst_case", "robust", "{option} looks at the worst of the models that --robust draws",
        "say how many, such as --robust 8, or leave it out",
    ),
    _beside("area", "circle", "{option} and {other} exclude one another", "give one sea room"),
    _without(
        "clearance", "area, circle", "{option} is kept from the edge of a sea room",
        "give one by --area or --circle, or leave it out",
    ),
    _beside("cluster", "workers", "{option} computes with all workers that the cluster has"),
    _without(
        "margin_air", MEASURED_WIND,
        "{option} keeps the measured velocity through the air from zero",
        "leave it out, or use --predictor wind",
    ),
    _without(
        "gust", MEASURED_WIND, "{option} is how a measured wind varies about its mean",
        "leave it out, or use --predictor wind",
    ),
    _without(
        "gust", REGRESSORS, "{option} is how a measured wind varies in the regressors",
        "leave it out, or use --estimator iv",
    ),
    _without("yaw_cap", YAW_RATE, "{option} bounds the yaw rate", "leave it out"),
    _without(
        "headings", YAW_RATE, "{option} asks for a range of headings", "leave it out"
    ),
    _without(
        "margin_u", SURGE_SIGN, "{option} keeps surge on one side of zero",
        "leave it out, or give surge one, such as --regime u+",
    ),
    _without(
        "margin_v", SWAY_SIGN, "{option} keeps sway on one side of zero",
        "leave it out, or give sway one, such as --regime u+v+",
    ),
    _without(
        "robust", COVARIANCE, "{option} draws models from the covariance of the prior model",
        "leave it out, or use a model that was estimated",
    ),
    _without(
        "probability", COVARIANCE,
        "{option} is over models drawn from the covariance of the prior model",
        "leave it out, or use a model that was estimated",
    ),
)  # fmt: skip


def require_compatible(given: Set[str], lacking: Mapping[str, str] = MappingProxyType({})) -> None:
    """Refuse options that do not go together, or that would be ignored.

    Parameters
    ----------
    given : set of str
        What is asked, as `RULES` names it.
    lacking : mapping of str to str
        Those of `CONDITIONS` that are not met, each with what is so instead, such as
        ``structure 'surge' has none``.

    Raises
    ------
    UsageError
        Says which, why, and what to do.
    """
    for rule in RULES:
        if said := rule.sentence(given, lacking):
            raise UsageError(said)
