"""Many ships of one class: estimated alike, pooled, compared, and followed in time."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import GreyboxError
from greybox.estimation.result import Estimate
from greybox.fleet.differing import SIGNIFICANCE, Comparison, compare_units, least_deviation
from greybox.fleet.pooling import Pooled, pool
from greybox.fleet.ships import LeftOut, ShipFiles, find_ships, require_ships
from greybox.fleet.trend import FEWEST_PERIODS, Trend, fit_trend, least_slope
from greybox.model.terms import parameter_unit
from greybox.notebook import DisplayMixin
from greybox.numerics.parallel import map_pieces
from greybox.numerics.threads import one_thread
from greybox.selection.estimate import estimate_requested
from greybox.selection.request import Request
from greybox.trial.convert.read import read_segments
from greybox.trial.kinematics import decimate_segments
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]
_log = logging.getLogger(__name__)

# ships whose data choose the structure of the class: what one of them lacks, such as wind or
# turns, another may have
_PILOTS = 3
# periods of a ship at most: as many as a picture shows, each of whole logs
_MOST_PERIODS = 12
# ships named in one sentence
_MOST_NAMED = 5
_YEAR = 365.25 * 86400.0


@dataclass(frozen=True)
class ClassModel:
    """How every ship of a class is estimated.

    Parameters
    ----------
    method, predictor, structure : str
        As `estimate_model` takes them.
    sample_time : float
        [s]
    chosen_by : tuple of str
        Ships whose data preferred it.
    asked : tuple of str
        Ships whose data were asked.
    """

    method: str
    predictor: str
    structure: str
    sample_time: float
    chosen_by: tuple[str, ...]
    asked: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """What was chosen, and by whom."""
        return (
            f"structure '{self.structure}' by {self.method} with predictor '{self.predictor}' at "
            f"{self.sample_time:g} s, as the data of {len(self.chosen_by)} of {len(self.asked)} "
            f"ships that were examined prefer ({', '.join(self.chosen_by)})."
        )


@dataclass(frozen=True)
class ShipEstimate:
    """One ship's coefficients, from all its logs and from each period.

    Parameters
    ----------
    name : str
    names, units : tuple of str
        (p,) of the coefficients, sums spelled out.
    theta, covariance : ndarray
        (p,) and (p, p)
    fit : mapping of str to float
        Free-run fit on the ship's own logs [%].
    logs : int
    times : ndarray
        (T,) of the periods that could be estimated: years since 1970, or the number of the log.
    dated : bool
        Whether the times are dates.
    estimates, covariances : ndarray
        (T, p) and (T, p, p) of the periods.
    notes : tuple of str
    """

    name: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    theta: Array
    covariance: Array
    fit: Mapping[str, float]
    logs: int
    times: Array
    dated: bool
    estimates: Array
    covariances: Array
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Change:
    """A coefficient of a ship that changes in time."""

    ship: str
    coefficient: str
    slope: float
    interval: tuple[float, float]
    per: str
    p_adjusted: float


@dataclass(frozen=True, repr=False)
class Fleet(DisplayMixin):
    """What the ships of a class have in common, which one differs, and what changes in time.

    Parameters
    ----------
    name : str
    model : ClassModel
    ships : tuple of ShipEstimate
    left_out : tuple of LeftOut
    comparisons : tuple of Comparison
        One a ship, in their order.
    pooled : Pooled
        Of the ships that do not differ.
    trends : tuple of Trend or None
        One a ship; None where it has too few periods.
    """

    name: str
    model: ClassModel
    ships: tuple[ShipEstimate, ...]
    left_out: tuple[LeftOut, ...]
    comparisons: tuple[Comparison, ...]
    pooled: Pooled
    trends: tuple[Trend | None, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients."""
        return self.ships[0].names

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the coefficients."""
        return self.ships[0].units

    @property
    def differing(self) -> tuple[Comparison, ...]:
        """The ships that differ from the others, the most certain first."""
        return tuple(sorted((c for c in self.comparisons if c.differs), key=lambda c: c.p_value))

    def pooled_of(self, ship: int) -> tuple[Array, Array, Array]:
        """Return the pooled coefficients of a ship, their standard errors and shrinkage, (p,) each.

        Those of a ship that differs are its own: nothing is to be learnt of it from the others.
        """
        if self.comparisons[ship].differs:
            one = self.ships[ship]
            return one.theta, np.sqrt(np.diag(one.covariance)), np.zeros(len(one.theta))
        row = sum(not c.differs for c in self.comparisons[:ship])
        return self.pooled.theta[row], self.pooled.theta_std[row], self.pooled.shrinkage[row]

    def changes(self) -> list[Change]:
        """Return what changes in time, adjusted for all coefficients of all ships (Holm)."""
        tests = [
            (float(p), ship, j)
            for ship, trend in enumerate(self.trends)
            if trend is not None
            for j, p in enumerate(trend.p_values)
        ]
        found, adjusted = [], 0.0
        for place, (p, ship, j) in enumerate(sorted(tests)):
            adjusted = max(adjusted, p * (len(tests) - place))
            if adjusted >= SIGNIFICANCE:
                break
            trend = self.trends[ship]
            assert trend is not None
            low, high = map(float, trend.slope_interval[j])
            one = self.ships[ship]
            found.append(
                Change(one.name, self.names[j], float(trend.slope[j]), (low, high),
                       "year" if one.dated else "log", adjusted)
            )  # fmt: skip
        return found

    def difference_sentence(self, comparison: Comparison) -> str:
        """Return in what a ship differs from the others, as one sentence."""
        name = self.ships[comparison.unit].name
        if not comparison.differences:
            return f"'{name}' differs from the other ships in no single coefficient."
        told = ", ".join(
            f"{self.names[d.coefficient]} by {d.value:+.3g} ± {1.96 * d.std:.2g} (theirs: "
            f"{d.expected:.3g}) {self.units[d.coefficient]}".removesuffix(" 1")
            for d in comparison.differences
        )
        return f"'{name}' differs from the other ships in {told} (p = {comparison.p_adjusted:.2g})."

    @property
    def verdict(self) -> str:
        """Which ships differ, and whether anything changes in time."""
        odd, changes = self.differing, self.changes()
        count = len(self.ships)
        if odd:
            named = ", ".join(
                f"'{self.ships[c.unit].name}' in "
                f"{', '.join(self.names[d.coefficient] for d in c.differences) or 'all together'}"
                for c in odd
            )
            does = "differs" if len(odd) == 1 else "differ"
            told = f"{len(odd)} of {count} ships {does} from the others: {named}"
        else:
            told = f"none of {count} ships differs from the others beyond chance"
        followed = sum(t is not None for t in self.trends)
        if changes:
            time = ", ".join(f"{c.coefficient} of '{c.ship}'" for c in changes)
            return f"{told}; changing in time: {time}"
        if followed:
            return f"{told}; no coefficient of the {followed} ships followed in time changes"
        return told

    @property
    def cautions(self) -> tuple[str, ...]:
        """How far the numbers can be trusted, a sentence each."""
        told = []
        if lost := [s.name for s in self.ships if not all(v > 0 for v in s.fit.values())]:
            told.append(
                f"the free run of {_listed(lost)} fits its own logs no better than a constant: "
                f"rely neither on these coefficients nor on the mean of a class that they are in"
            )
        if few := [s.name for s in self.ships if s.logs < FEWEST_PERIODS]:
            told.append(
                f"{_listed(few)} has fewer than {FEWEST_PERIODS} logs: what varies from log to log "
                f"(weather, draught, sensors) is in no standard error there, and may look like a "
                f"difference between ships"
            )
        count = len(self.ships)
        reach = least_deviation(count, len(self.names))
        told.append(
            f"among {count} ships one coefficient must deviate by about "
            f"{float(f'{reach:.2g}'):.0f} standard deviations before chance is "
            f"ruled out: a ship that is not named may still differ by less"
        )
        lines = [t for t in self.trends if t is not None]
        if lines:
            fewest = min(lines, key=lambda t: len(t.times))
            steep = least_slope(fewest.slope_df, len(lines) * len(self.names), SIGNIFICANCE)
            told.append(
                f"a line through {len(fewest.times)} periods must climb by about "
                f"{float(f'{steep:.2g}'):.0f} of its standard errors before chance is ruled out: "
                f"with more logs less is enough"
            )
        return tuple(told)

    def rows(self) -> list[dict[str, Any]]:
        """Return the table, a row for each coefficient of each ship."""
        changed = {(c.ship, c.coefficient): c for c in self.changes()}
        spread = np.sqrt(self.pooled.omega)
        rows = []
        for i, (ship, compared) in enumerate(zip(self.ships, self.comparisons, strict=True)):
            value, std, shrinkage = self.pooled_of(i)
            own = np.sqrt(np.diag(ship.covariance))
            by = {d.coefficient: d for d in compared.differences}
            trend = self.trends[i]
            for j, name in enumerate(self.names):
                interval = (None, None) if trend is None else tuple(trend.slope_interval[j])
                change = changed.get((ship.name, name))
                rows.append(
                    {
                        "ship": ship.name, "parameter": name, "unit": self.units[j],
                        "estimate": ship.theta[j], "std": own[j],
                        "pooled": value[j], "pooled_std": std[j], "shrinkage": shrinkage[j],
                        "class_mean": self.pooled.beta[j],
                        "class_mean_std": self.pooled.beta_std[j], "class_spread": spread[j],
                        "ship_p_adjusted": compared.p_adjusted,
                        "difference": by[j].value if j in by else None,
                        "difference_std": by[j].std if j in by else None,
                        "slope": None if trend is None else trend.slope[j],
                        "slope_low": interval[0], "slope_high": interval[1],
                        "slope_per": "year" if ship.dated else "log",
                        "slope_p_adjusted": change.p_adjusted if change else None,
                    }
                )  # fmt: skip
        return rows

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON values."""
        ships = []
        for i, (ship, compared) in enumerate(zip(self.ships, self.comparisons, strict=True)):
            value, std, shrinkage = self.pooled_of(i)
            trend = self.trends[i]
            ships.append(
                {
                    "ship": ship.name,
                    "logs": ship.logs,
                    "theta": ship.theta,
                    "covariance": ship.covariance,
                    "std": np.sqrt(np.diag(ship.covariance)),
                    "fit": dict(ship.fit),
                    "pooled": value,
                    "pooled_std": std,
                    "shrinkage": shrinkage,
                    "differs": compared.differs,
                    "statistic": compared.statistic,
                    "df": compared.df,
                    "p_value": compared.p_value,
                    "p_adjusted": compared.p_adjusted,
                    "differences": [
                        {
                            "parameter": self.names[d.coefficient], "value": d.value,
                            "std": d.std, "expected": d.expected,
                        }
                        for d in compared.differences
                    ],
                    "trend": None
                    if trend is None
                    else {
                        "per": "year" if ship.dated else "log",
                        "times": trend.times, "estimates": trend.estimates, "std": trend.std,
                        "slope": trend.slope, "slope_interval": trend.slope_interval,
                        "p_values": trend.p_values,
                    },
                    "notes": list(ship.notes),
                }
            )  # fmt: skip
        return {
            "format": "greybox-fleet",
            "version": 1,
            "verdict": self.verdict,
            "cautions": list(self.cautions),
            "names": list(self.names),
            "units": list(self.units),
            "model": {
                "method": self.model.method, "predictor": self.model.predictor,
                "structure": self.model.structure, "sample_time": self.model.sample_time,
                "chosen_by": list(self.model.chosen_by), "asked": list(self.model.asked),
            },
            "class": {
                "ships": [s.name for s, c in zip(self.ships, self.comparisons, strict=True)
                          if not c.differs],
                "mean": self.pooled.beta, "mean_std": self.pooled.beta_std,
                "mean_interval": self.pooled.beta_interval(),
                "spread": np.sqrt(self.pooled.omega),
            },
            "ships": ships,
            "changes": [
                {"ship": c.ship, "parameter": c.coefficient, "slope": c.slope,
                 "interval": list(c.interval), "per": c.per, "p_adjusted": c.p_adjusted}
                for c in self.changes()
            ],
            "left_out": [{"ship": one.ship, "reason": one.reason} for one in self.left_out],
        }  # fmt: skip

    def summary(self) -> str:
        """Return the result as text: verdict, class, ships, what was left out."""
        lines = [f"Verdict: {self.verdict}.", *(f"caution: {c}." for c in self.cautions), ""]
        lines += [f"Estimated: {self.model.sentence}", ""]
        lines += [self.difference_sentence(c) for c in self.differing]
        lines += [
            f"{c.coefficient} of '{c.ship}' changes by {c.slope:+.3g} per {c.per} "
            f"({c.interval[0]:.3g} to {c.interval[1]:.3g}; p = {c.p_adjusted:.2g})."
            for c in self.changes()
        ]
        alike = len(self.pooled.theta)
        lines += ["", f"The class, of {alike} ships:"]
        head = ("parameter", "mean", "std error", "between ships", "shrinkage")
        wide = max(12, *map(len, self.names))
        lines.append(f"  {head[0]:<{wide}}" + "".join(f"{h:>15}" for h in head[1:]) + "  unit")
        for j, name in enumerate(self.names):
            shrunk = float(self.pooled.shrinkage[:, j].mean())
            lines.append(
                f"  {name:<{wide}}{self.pooled.beta[j]:>15.4g}{self.pooled.beta_std[j]:>15.2g}"
                f"{np.sqrt(self.pooled.omega[j]):>15.2g}{shrunk:>15.2f}  {self.units[j]}"
            )
        lines += ["", f"  {'ship':<20}{'logs':>6}{'distance':>12}{'p adjusted':>12}  fit"]
        for ship, compared in zip(self.ships, self.comparisons, strict=True):
            fit = ", ".join(
                f"{k} {v:.0f} %" if v > -1000 else f"{k} diverged" for k, v in ship.fit.items()
            )
            lines.append(
                f"  {ship.name:<20}{ship.logs:>6}{np.sqrt(compared.statistic):>12.3g}"
                f"{compared.p_adjusted:>12.2g}  {fit}"
            )
        lines += ["", *(f"note: {one.sentence}" for one in self.left_out)] if self.left_out else []
        return "\n".join(lines)

    def _line(self) -> str:
        return f"fleet '{self.name}': {self.verdict}"


def _listed(ships: Sequence[str]) -> str:
    """Return ships in words, the first few by name."""
    named = ", ".join(f"'{s}'" for s in ships[:_MOST_NAMED])
    more = len(ships) - _MOST_NAMED
    return f"each of {named}{f' and {more} more' if more > 0 else ''}" if ships[1:] else named


@dataclass(frozen=True)
class _Task:
    """One ship that is to be estimated in a given way, or that is asked for the way."""

    ship: ShipFiles
    seed: int
    model: ClassModel | None = None


def estimate_fleet(
    folder: str | Path,
    *,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Fleet:
    """Estimate the ships of a fleet folder alike, pool and compare them.

    Parameters
    ----------
    folder : str or Path
        One folder a ship, each with a vessel file and logs.
    seed : int
    progress : callable
        Is told how many ships are done, and of how many.

    Returns
    -------
    Fleet

    Raises
    ------
    LogError
        Fewer than three ships can be estimated.
    VesselError
        A ship is of another class.
    """
    files, left_out = find_ships(folder)
    model, files = _class_model(files, left_out, seed, str(folder))
    found: list[ShipEstimate] = []
    for done, result in enumerate(map_pieces(_estimated, [_Task(f, seed, model) for f in files])):
        progress(done + 1, len(files))
        if isinstance(result, LeftOut):
            left_out.append(result)
        else:
            found.append(result)
    ships = _of_one_structure(found, left_out)
    require_ships([s.name for s in ships], left_out, str(folder))
    return pool_ships(Path(folder).name, model, ships, left_out)


@one_thread()
def pool_ships(
    name: str,
    model: ClassModel,
    ships: Sequence[ShipEstimate],
    left_out: Sequence[LeftOut] = (),
) -> Fleet:
    """Compare ships that are estimated alike, pool those that do not differ, find trends.

    Parameters
    ----------
    name : str
    model : ClassModel
    ships : sequence of ShipEstimate
        At least three, of the same coefficients.
    left_out : sequence of LeftOut
    """
    theta = np.array([s.theta for s in ships])
    covariance = np.array([s.covariance for s in ships])
    comparisons = compare_units(theta, covariance)
    alike = [c.unit for c in comparisons if not c.differs]
    trends = tuple(
        fit_trend(s.times, s.estimates, s.covariances)
        if len(s.times) >= FEWEST_PERIODS and np.ptp(s.times) > 0
        else None
        for s in ships
    )
    pooled = pool(theta[alike], covariance[alike])
    return Fleet(name, model, tuple(ships), tuple(left_out), comparisons, pooled, trends)


def _class_model(
    files: Sequence[ShipFiles], left_out: list[LeftOut], seed: int, folder: str
) -> tuple[ClassModel, list[ShipFiles]]:
    """Return how the class is estimated, and the ships that are left to be."""
    rest = list(files)
    while True:
        # spread over the names, which often tell age or yard
        places = np.unique(np.linspace(0, len(rest) - 1, min(_PILOTS, len(rest))).astype(int))
        asked = [rest[i] for i in places]
        answers = list(map_pieces(_preferred, [_Task(f, seed) for f in asked]))
        chosen = [a for a in answers if isinstance(a, ClassModel)]
        if chosen:
            break
        failed = [a for a in answers if isinstance(a, LeftOut)]
        left_out += failed
        gone = {one.ship for one in failed}
        rest = [f for f in rest if f.name not in gone]
        require_ships([f.name for f in rest], left_out, folder)
    votes = Counter((a.method, a.predictor, a.structure) for a in chosen)
    best = votes.most_common(1)[0][0]
    by = [a for a in chosen if (a.method, a.predictor, a.structure) == best]
    # what is too fast for one ship is not for another, and slower samples lose what it has
    step = min(a.sample_time for a in by)
    names = tuple(name for a in by for name in a.chosen_by)
    model = ClassModel(*best, step, names, tuple(name for a in chosen for name in a.asked))
    _log.info("the class: %s", model.sentence)
    return model, rest


@one_thread()
def _preferred(task: _Task) -> ClassModel | LeftOut:
    """Return how the data of one ship would be estimated."""
    name = task.ship.name
    try:
        logs = [s for part in _read(task.ship) for s in part]
        found = estimate_requested(logs, Request(judged=False, seed=task.seed))
    except (GreyboxError, OSError) as error:
        return LeftOut(name, str(error))
    predictor = found.predictor
    return ClassModel(
        found.method, predictor.kind, predictor.structure.name, found.sample_time, (name,), (name,)
    )


def _read(ship: ShipFiles, sample_time: float | None = None) -> list[list[TrialLog]]:
    """Return the segments of each log of a ship, decimated where they are to be."""
    logs = [read_segments(path, ship.vessel) for path in ship.logs]
    if sample_time is None:
        return logs
    return [decimate_segments(segments, sample_time)[0] for segments in logs]


@one_thread()
def _estimated(task: _Task) -> ShipEstimate | LeftOut:
    """Return one ship's coefficients from all its logs and from each period, or why not."""
    assert task.model is not None
    model, ship = task.model, task.ship
    request = Request(model.method, model.predictor, model.structure, judged=False, seed=task.seed)
    try:
        logs = _read(ship, model.sample_time)
        whole = estimate_requested([s for part in logs for s in part], request)
    except (GreyboxError, OSError) as error:
        return LeftOut(ship.name, str(error))
    theta, covariance = _coefficients(whole)
    if not (np.isfinite(covariance).all() and (np.diag(covariance) > 0).all()):
        return LeftOut(ship.name, "the standard errors of its coefficients are not finite.")
    plain = Request(
        model.method, model.predictor, model.structure, judged=False, seed=task.seed,
        prefilter="none",
    )  # fmt: skip
    times, dated = _times(logs)
    periods, notes = [], list(whole.notes)
    for part in np.array_split(np.arange(len(logs)), min(_MOST_PERIODS, len(logs))):
        named = ship.logs[part[0]].name
        try:
            found = estimate_requested([s for i in part for s in logs[i]], plain)
        except GreyboxError as error:
            notes.append(f"the period of '{named}' was left out: {error}")
            continue
        value, spread = _coefficients(found)
        if found.labels != whole.labels or not np.isfinite(spread).all():
            notes.append(f"the period of '{named}' was left out: it does not tell all parameters.")
            continue
        periods.append((float(np.mean(times[part])), value, spread))
    size = len(theta)
    structure = whole.predictor.structure
    units = tuple(
        parameter_unit(
            structure.terms[structure.index(whole.predictor.columns[i].terms[0])],
            ship.vessel.force_unit,
        )
        for i in whole.predictor.parameter_columns
    )
    return ShipEstimate(
        ship.name,
        whole.labels,
        units,
        theta,
        covariance,
        whole.fit,
        len(logs),
        np.array([t for t, _, _ in periods]),
        dated,
        np.array([v for _, v, _ in periods]).reshape(-1, size),
        np.array([s for _, _, s in periods]).reshape(-1, size, size),
        tuple(notes),
    )


def _coefficients(estimate: Estimate) -> tuple[Array, Array]:
    """Return the parameters without biases, (p,) and (p, p)."""
    place = list(estimate.predictor.parameter_columns)
    return estimate.theta[place], estimate.covariance[np.ix_(place, place)]


def _times(logs: Sequence[Sequence[TrialLog]]) -> tuple[Array, bool]:
    """Return the time of each log, (n,): in years where all are dated, else its number."""
    epochs = [part[0].provenance.epoch for part in logs]
    known = [e for e in epochs if e is not None]
    if len(known) < len(logs) or len(set(known)) < len(known):
        return np.arange(1.0, len(logs) + 1), False
    starts = [part[0].t[0] for part in logs]
    return (np.array(known) + np.array(starts)) / _YEAR, True


def _of_one_structure(ships: Sequence[ShipEstimate], left_out: list[LeftOut]) -> list[ShipEstimate]:
    """Return the ships with the coefficients that most have; the others are left out."""
    if not ships:
        return []
    usual = Counter((s.names, s.units) for s in ships).most_common(1)[0][0]
    kept = []
    for ship in ships:
        if (ship.names, ship.units) == usual:
            kept.append(ship)
            continue
        own = [f"{n} [{u}]" for n, u in zip(ship.names, ship.units, strict=True)]
        other = [f"{n} [{u}]" for n, u in zip(*usual, strict=True)]
        left_out.append(
            LeftOut(
                ship.name,
                f"its parameters are {', '.join(own)}, and those of the other ships "
                f"{', '.join(other)}.",
            )
        )
    return kept
