"""Predicted manoeuvres: quantities with intervals, verdicts, and the runs behind them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.prediction_verdict import PredictionLevel
from greybox.estimation.verdict import TrustLevel
from greybox.notebook import DisplayMixin, items, number, table
from greybox.prediction.extrapolation import Extrapolation, of_all
from greybox.prediction.measuring import LABELS
from greybox.prediction.monte_carlo import MonteCarloQuantity
from greybox.trial.log import TrialLog
from greybox.trial.manoeuvres import Compliance, Criterion, Quantity
from greybox.trial.manoeuvres.finding import Manoeuvre
from greybox.trial.validity import ConditionDifference

Array = NDArray[np.float64]
Kind = Literal["turning", "zigzag", "stopping", "crash"]
Side = Literal["port", "starboard", ""]

# how a verdict reads in a prediction
WORDS = {
    Compliance.PASS: "meets",
    Compliance.FAIL: "fails",
    Compliance.OPEN: "cannot be told",
    Compliance.NOT_APPLICABLE: "not applicable",
}
TITLES = {
    "turning": "turning circle",
    "zigzag": "zig-zag",
    "stopping": "stop without thrust",
    "crash": "crash stop",
}
# the quantity that each criterion is about
CRITERIA = {
    "advance": "advance",
    "tactical diameter": "tactical_diameter",
    "initial turning": "initial_turning",
    "first overshoot": "first_overshoot",
    "second overshoot": "second_overshoot",
    "track reach": "track_reach",
}


@dataclass(frozen=True)
class Compared:
    """A predicted quantity beside the measured one.

    Parameters
    ----------
    name : str
    predicted : MonteCarloQuantity
    measured : Quantity
    difference : Quantity
        Measured minus predicted; its interval holds both.
    agrees : bool
        Whether that interval holds zero.
    """

    name: str
    predicted: MonteCarloQuantity
    measured: Quantity
    difference: MonteCarloQuantity
    agrees: bool


@dataclass(frozen=True)
class Agreement:
    """Prediction and trial side by side.

    Parameters
    ----------
    log : str
        Name of the trial's log.
    measured : TurningCircle, ZigZag or Stopping
    rows : tuple of Compared
    sentence : str
    track : tuple of ndarray
        (2,) of (M,) positions of the trial along its approach and to starboard of it, from
        where the manoeuvre was ordered [m].
    history : dict of str to ndarray
        ``t`` from the order [s], ``heading`` from the original one [rad], ``r`` [rad/s],
        ``speed`` [m/s] of the trial, (M,).
    """

    log: str
    measured: Manoeuvre
    rows: tuple[Compared, ...]
    sentence: str
    track: tuple[Array, Array]
    history: dict[str, Array]


@dataclass(frozen=True)
class Bundle:
    """Runs of the estimate and of its draws, for pictures.

    Parameters
    ----------
    t : ndarray
        (N,) from the order [s].
    nominal : dict of str to ndarray
        ``heading`` from the original one [rad], ``r`` [rad/s], ``speed`` [m/s], ``propeller``
        in the unit of the log, and ``steering`` [rad] where an angle steers, (N,).
    low, high : dict of str to ndarray
        (N,) 95 % limits of the draws still under way, nan where more than half of them are not.
    tracks : tuple of (ndarray, ndarray)
        Way ahead and to starboard of some draws, the estimate's first, from the order [m].
    """

    t: Array
    nominal: dict[str, Array]
    low: dict[str, Array]
    high: dict[str, Array]
    tracks: tuple[tuple[Array, Array], ...]


@dataclass(frozen=True)
class PredictedManoeuvre:
    """One manoeuvre to one side.

    Parameters
    ----------
    kind : {"turning", "zigzag", "stopping", "crash"}
    side : {"port", "starboard", ""}
        Of the first turn; empty for a stop.
    order : float or None
        Steering order: an angle [rad], or a share where speeds steer.
    heading : float or None
        At which a zig-zag is reversed [rad].
    label : str
    commands : dict of str to MonteCarloQuantity
        Of the approach, in the unit of the log, angles [rad].
    quantities : dict of str to MonteCarloQuantity or None
        None where the estimate itself does not reach it; `LABELS` says what they are.
    criteria : tuple of Criterion
    draws : int
    diverged, incomplete, unheld : int
        Draws that diverged, that did not complete the manoeuvre, and that do not hold the
        approach within the limits of the commands. The last are left out of all intervals.
    notes : tuple of str
    log : TrialLog
        The run of the estimate itself.
    order_time : float
        When the manoeuvre was ordered in `log` [s].
    bundle : Bundle
    agreement : Agreement or None
    extrapolated : tuple of Extrapolation
        Signals that leave their ranges in the estimation logs.
    resting : tuple of str
        Quantities that rest on what the run does from then on.
    """

    kind: Kind
    side: Side
    order: float | None
    heading: float | None
    label: str
    commands: dict[str, MonteCarloQuantity]
    quantities: dict[str, MonteCarloQuantity | None]
    criteria: tuple[Criterion, ...]
    draws: int
    diverged: int
    incomplete: int
    unheld: int
    notes: tuple[str, ...]
    log: TrialLog
    order_time: float
    bundle: Bundle
    agreement: Agreement | None = None
    extrapolated: tuple[Extrapolation, ...] = ()
    resting: tuple[str, ...] = ()

    @property
    def length(self) -> float:
        """Of the ship [m]."""
        return self.log.vessel.length

    def criterion(self, name: str) -> Criterion | None:
        """Return the criterion on a quantity, None where there is none."""
        return next((c for c in self.criteria if CRITERIA.get(c.name) == name), None)

    def verdict_word(self, criterion: Criterion) -> str:
        """Return the verdict on a limit as it reads, where no log speaks for it with the reason."""
        said = WORDS[criterion.verdict]
        rests = criterion.limit is not None and CRITERIA.get(criterion.name) in self.resting
        return f"extrapolated: {said}" if rests else said

    def verdict_line(self, criterion: Criterion) -> str:
        """Return limit, verdict and reason of a criterion in one line."""
        word, limit = self.verdict_word(criterion), limit_words(criterion)
        if not limit:
            return f"{criterion.name}: {word}, because {criterion.reason}"
        note = f" ({criterion.reason})" if criterion.reason else ""
        return f"{criterion.name}, at most {limit}: {word}{note}"

    def summary(self) -> str:
        """Return values, verdicts, agreement and notes as text."""
        angles = self.log.vessel.angle_commands
        moved = [
            f"{n} = {_shown(q, n in angles)}"
            for n, q in self.commands.items()
            if abs(q.value) > 1e-9 or n not in angles
        ]
        lines = [self.label, f"  approach with {', '.join(moved)}"]
        for name, value in self.quantities.items():
            if value is None:
                lines.append(f"  {LABELS[name]:<26}not reached")
                continue
            mark = "  extrapolated" if name in self.resting else ""
            lines.append(f"  {LABELS[name]:<26}{value.text(self.length)}{mark}")
        lines += [f"  IMO {self.verdict_line(c)}" for c in self.criteria]
        if self.agreement is not None:
            lines.append(f"  trial: {self.agreement.sentence}")
            lines += [f"    {compared_line(c, self.length)}" for c in self.agreement.rows]
        # the prediction begins with them
        told = {e.sentence for e in self.extrapolated}
        lines += [f"  note: {n}" for n in self.notes if n not in told]
        return "\n".join(lines)

    def to_list(self) -> list[dict[str, Any]]:
        """Return one row a quantity for JSON, SI and radians."""
        rows = []
        measured = {} if self.agreement is None else {c.name: c for c in self.agreement.rows}
        for name, value in self.quantities.items():
            criterion = self.criterion(name)
            row: dict[str, Any] = {
                "manoeuvre": self.kind,
                "side": self.side or None,
                "steering": self.order,
                "reversed_at": self.heading,
                "name": name,
                "value": None if value is None else value.value,
                "ci": None if value is None else list(value.interval),
                "unit": None if value is None else value.unit,
                "draws": 0 if value is None else value.reached,
                "extrapolated": name in self.resting,
                "criterion": None,
                "verdict": None,
            }
            if criterion is not None:
                lengths = criterion.measured is not None and criterion.measured.unit == "1"
                row["verdict"] = WORDS[criterion.verdict]
                if criterion.limit is not None:
                    row["criterion"] = {
                        "at_most": criterion.limit * (self.length if lengths else 1.0),
                        "unit": "m" if lengths else "rad",
                        "source": "IMO MSC.137(76)",
                    }
                row["verdict_reason"] = criterion.reason
            if name in measured:
                beside = measured[name]
                row["measured"] = {
                    "value": beside.measured.value,
                    "ci": list(beside.measured.interval),
                    "difference": beside.difference.value,
                    "difference_ci": list(beside.difference.interval),
                    "agrees": beside.agrees,
                }
            rows.append(row)
        return rows


def _range(ci: Sequence[float | None] | None) -> str:
    return " to ".join(number(x) for x in ci or ())


@dataclass(frozen=True, repr=False)
class ManoeuvrePrediction(DisplayMixin):
    """What a model predicts of one kind of manoeuvre.

    Parameters
    ----------
    kind : {"turning", "zigzag", "stopping", "crash"}
    vessel : str
    steering : str
        How the vessel is steered and propelled, in words.
    manoeuvres : tuple of PredictedManoeuvre
    draws : int
    notes : tuple of str
        What holds for all of them.
    conditions : tuple of ConditionDifference
        In what the trial differs from the logs that the model was estimated on.
    trust : TrustLevel
        Of the estimate's verdict on its coefficients.
    prediction : PredictionLevel
        Of its verdict on its predictions.
    instant : tuple of str
        Commands whose orders are taken to act at once, as the vessel file has no rate of them.
    """

    kind: Kind
    vessel: str
    steering: str
    manoeuvres: tuple[PredictedManoeuvre, ...]
    draws: int
    notes: tuple[str, ...]
    conditions: tuple[ConditionDifference, ...] = ()
    trust: TrustLevel = TrustLevel.NOT_JUDGED
    prediction: PredictionLevel = PredictionLevel.NOT_JUDGED
    instant: tuple[str, ...] = ()

    @property
    def extrapolated(self) -> tuple[Extrapolation, ...]:
        """Signals that leave their ranges in the estimation logs, those of all manoeuvres."""
        return of_all([e for m in self.manoeuvres for e in m.extrapolated])

    def summary(self) -> str:
        """Return all manoeuvres as text."""
        title = TITLES[self.kind].capitalize()
        beyond = [e.sentence for e in self.extrapolated]
        if beyond:
            beyond.append(
                "no log speaks for the rows that are marked 'extrapolated': their intervals may be "
                "too narrow."
            )
        told = {e.sentence for m in self.manoeuvres for e in m.extrapolated}
        lines = [
            f"{title} of {self.vessel}, predicted; 95 % intervals from {self.draws} draws",
            *beyond,
            self.steering,
            *[f"note: {n}" for n in self.notes if n not in told],
        ]
        return "\n\n".join(["\n".join(lines), *[m.summary() for m in self.manoeuvres]])

    def _parts(self) -> Iterator[str]:
        for m in self.manoeuvres:
            rows = [
                (
                    r["name"],
                    number(r["value"]),
                    _range(r["ci"] or ()),
                    r["unit"],
                    r["verdict"] or "",
                )
                for r in m.to_list()
            ]
            yield table(("quantity", "value", "95 %", "unit", "IMO"), rows, m.label)
        yield items("Notes", self.notes)

    def to_dict(self) -> dict[str, Any]:
        """Return the result for JSON: one row a quantity, SI and radians."""
        return {
            "manoeuvre": self.kind,
            "vessel": self.vessel,
            "steering": self.steering,
            "draws": self.draws,
            "notes": list(self.notes),
            "condition_differences": [d.to_dict() for d in self.conditions],
            "quantities": [row for m in self.manoeuvres for row in m.to_list()],
            "runs": [
                {
                    "side": m.side or None,
                    "steering": m.order,
                    "reversed_at": m.heading,
                    "label": m.label,
                    "approach": {n: q.to_dict() | {"unit": "rad" if n in
                                 m.log.vessel.angle_commands else "as logged"}
                                 for n, q in m.commands.items()},
                    "diverged": m.diverged,
                    "incomplete": m.incomplete,
                    "approach_not_held": m.unheld,
                    "agreement": None if m.agreement is None else m.agreement.sentence,
                    "notes": list(m.notes),
                }
                for m in self.manoeuvres
            ],
        }  # fmt: skip


def limit_words(criterion: Criterion) -> str:
    """Return the limit of a criterion with its unit, empty where it has none."""
    if criterion.limit is None:
        return ""
    angle = criterion.measured is not None and criterion.measured.unit == "rad"
    return f"{math.degrees(criterion.limit):.1f} deg" if angle else f"{criterion.limit:g} L"


def compared_line(row: Compared, length: float) -> str:
    """Return measured value and difference of a row in one line."""
    word = "agrees" if row.agrees else "differs"
    return (
        f"{LABELS[row.name]:<26}measured {row.measured.text(length)}, "
        f"minus predicted {row.difference.text()}: {word}"
    )


def _shown(value: MonteCarloQuantity, angle: bool) -> str:
    factor, unit = (180 / math.pi, " deg") if angle else (1.0, "")
    low, high = (f"{b * factor:.4g}" for b in value.interval)
    # what was ordered is the same in every draw
    interval = f" (95 %: {low} to {high})" if low != high else ""
    return f"{value.value * factor:.4g}{unit}{interval}"
