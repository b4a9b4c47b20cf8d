"""Several models on several logs: fit, error in units, errors ahead, sign tests."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from greybox.channels import CHANNELS
from greybox.errors import UsageError, suggestion
from greybox.estimation.result import Estimate
from greybox.model.model import ManoeuvringModel
from greybox.notebook import DisplayMixin, items, number, table
from greybox.numerics.threads import one_thread
from greybox.public import known_keywords
from greybox.trial.log import Logs, TrialLog, as_list
from greybox.trial.validity import ConditionDifference, other_conditions
from greybox.validation.bands import LEVEL, Bands, predict_bands
from greybox.validation.comparison_verdict import ComparisonVerdict, judge_comparison, mean_fits
from greybox.validation.fit import LogFit, mean_fit, run_from, run_model
from greybox.validation.gain import stretch_effects
from greybox.validation.judge_prediction import HeldOut, NoiseBeside, noise_beside

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

HORIZONS = (10.0, 30.0, 60.0)
_MOST_STARTS = 300
# what a comparison holds in memory for each sample of a log and model: 0.25 kB were measured,
# with Parquet files of 60,000 samples
BYTES = 512


@dataclass(frozen=True)
class SignTest:
    """How often one model fits better than another (Tables 7.2, 7.6).

    ``p_value`` is two-sided under the null that either is better with equal
    chance; logs of one trial are related, so it is a lower bound.
    """

    model: str
    against: str
    state: str
    wins: int
    of: int
    p_value: float

    @property
    def sentence(self) -> str:
        """The result in words."""
        if not self.of:
            return f"{self.model} fits {self.state} as well as {self.against} in every log."
        return (
            f"{self.model} fits {self.state} better than {self.against} in {self.wins} of "
            f"{self.of} (p = {self.p_value:.2g})."
        )


def rmse_titles(states: Iterable[str]) -> list[str]:
    """Return the headings of columns of root mean square errors, with their units."""
    return [f"rmse {s} [{CHANNELS[s].unit}]" for s in states]


@dataclass(frozen=True, repr=False)
class Comparison(DisplayMixin):
    """Models (rows) on logs (columns).

    Parameters
    ----------
    names : tuple of str
        Of the models.
    runs : tuple of tuple of LogFit
        One row a model, one column a log.
    rmse : tuple of tuple of dict
        Root mean square error of the free run, state -> [m/s, rad/s].
    ahead : tuple of tuple of dict
        Horizon [s] -> state -> root mean square error of runs that start from
        the measured state.
    sign_tests : tuple of SignTest
        Each model against the first, over the logs.
    bands : tuple of tuple of Bands
        Where the motion and its measurement should lie; None where they were not asked
        for, or the run itself diverges.
    conditions : tuple of tuple of ConditionDifference
        One row a model: in what the logs differ from those it was estimated on.
    noise : tuple of tuple of dict
        What sensor noise leaves of the error, by state whose noise is known.
    own : tuple of tuple of bool
        Whether a model was estimated on a log.
    verdict : ComparisonVerdict
    notes : tuple of str
        What to know of the logs.
    """

    names: tuple[str, ...]
    runs: tuple[tuple[LogFit, ...], ...]
    rmse: tuple[tuple[dict[str, float], ...], ...]
    ahead: tuple[tuple[dict[str, dict[str, float]], ...], ...]
    sign_tests: tuple[SignTest, ...]
    bands: tuple[tuple[Bands | None, ...], ...]
    conditions: tuple[tuple[ConditionDifference, ...], ...]
    noise: tuple[tuple[dict[str, NoiseBeside], ...], ...]
    own: tuple[tuple[bool, ...], ...]
    verdict: ComparisonVerdict
    notes: tuple[str, ...] = ()

    def fits(self) -> list[dict[str, float]]:
        """Return the mean fit of each model [%]."""
        return [mean_fits(row) for row in self.runs]

    def best(self) -> int:
        """Return which model fits best, by the mean over the channels."""
        return self.names.index(self.verdict.best)

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        return {
            "models": [
                {
                    "model": name,
                    "fit": fit,
                    "condition_differences": [d.to_dict() for d in differences],
                    "logs": [
                        {
                            "log": run.log.name,
                            "samples": run.samples,
                            "gaps": [g.to_dict() for g in run.gaps],
                            "fit": run.fit,
                            "rmse": rmse,
                            "ahead": ahead,
                            "diverged_at_sample": run.diverged if run.diverged >= 0 else None,
                            "estimated_on": own,
                            "noise": {n: vars(one) for n, one in noise.items()},
                            "band": {s: c.to_dict() for s, c in band.coverage.items()}
                            if band
                            else {},
                            "band_notes": list(band.notes) if band else [],
                        }
                        for run, rmse, ahead, band, own, noise in zip(
                            row, errors, aheads, bands, mine, noises, strict=True
                        )
                    ],
                }
                for name, fit, differences, row, errors, aheads, bands, mine, noises in zip(
                    self.names,
                    self.fits(),
                    self.conditions,
                    self.runs,
                    self.rmse,
                    self.ahead,
                    self.bands,
                    self.own,
                    self.noise,
                    strict=True,
                )
            ],
            "sign_test": [
                {
                    "model": t.model,
                    "against": t.against,
                    "state": t.state,
                    "wins": t.wins,
                    "of": t.of,
                    "p_value": t.p_value,
                    "sentence": t.sentence,
                }
                for t in self.sign_tests
            ],
            "verdict": self.verdict.to_dict(),
            "start": "mean of the log's first 5 samples",
            "notes": list(self.notes),
        }

    @property
    def _width(self) -> int:
        """Of the column of models: names that are cut may be alike."""
        return max(24, 1 + max(map(len, self.names)))

    def summary(self) -> str:
        """Return the tables as text."""
        states = list(self.runs[0][0].fit)
        width, of_log = self._width, max(26, 1 + max(len(r.log.name) for r in self.runs[0]))
        lines = [
            f"verdict: {self.verdict.sentence}",
            f"{'model':<{width}}{'log':<{of_log}}"
            + "".join(f"{'fit ' + s + ' [%]':>12}" for s in states)
            + "".join(f"{title:>15}" for title in rmse_titles(states)),
        ]
        for name, row, errors in zip(self.names, self.runs, self.rmse, strict=True):
            for run, rmse in zip(row, errors, strict=True):
                lines.append(
                    f"{name:<{width}}{run.log.name:<{of_log}}"
                    + "".join(f"{run.fit[s]:>12.1f}" for s in states)
                    + "".join(f"{rmse[s]:>15.3g}" for s in states)
                    + (f"  diverged at sample {run.diverged}" if run.diverged >= 0 else "")
                )
            if len(row) > 1:
                mean = {s: float(np.mean([r.fit[s] for r in row])) for s in states}
                shown = "".join(f"{mean[s]:>12.1f}" for s in states)
                lines.append(f"{name:<{width}}{'mean':<{of_log}}{shown}")
        for name, aheads in zip(self.names, self.ahead, strict=True):
            for horizon in sorted(set().union(*aheads), key=float):
                error = {
                    s: np.sqrt(np.mean([a[horizon][s] ** 2 for a in aheads if horizon in a]))
                    for s in states
                }
                shown = ", ".join(
                    f"{s} {e:.3g} {CHANNELS[s].unit}" if np.isfinite(e) else f"{s} diverged"
                    for s, e in error.items()
                )
                lines.append(f"{name:<{width}}{horizon} s ahead, rms error: {shown}")
        lines += self._covered()
        lines += [
            f"{name:<{width}}note: {d.sentence}"
            for name, differences in zip(self.names, self.conditions, strict=True)
            for d in differences
        ]
        told = (g.sentence for row in self.runs for run in row for g in run.gaps)
        lines += [f"note: {sentence}" for sentence in dict.fromkeys((*self.notes, *told))]
        if len(self.runs[0]) > 1:
            lines += [t.sentence for t in self.sign_tests]
        return "\n".join(lines)

    def to_pandas(self) -> pd.DataFrame:
        """Return fit and error of each model on each log.

        Returns
        -------
        DataFrame
            Index ``model``, ``log``; columns ``fit_u`` [%], ``rmse_u`` [m/s, rad/s], … a state.
        """
        import pandas as pd

        rows = [
            {"model": name, "log": run.log.name}
            | {f"fit_{s}": f for s, f in run.fit.items()}
            | {f"rmse_{s}": e for s, e in rmse.items()}
            for name, row, errors in zip(self.names, self.runs, self.rmse, strict=True)
            for run, rmse in zip(row, errors, strict=True)
        ]
        return pd.DataFrame(rows).set_index(["model", "log"])

    def _line(self) -> str:
        fits = [
            f"{n} {', '.join(f'{s} {v:.1f}' for s, v in fit.items())}"
            for n, fit in zip(self.names, self.fits(), strict=True)
        ]
        return f"mean fit [%]: {'; '.join(fits)}"

    def _parts(self) -> tuple[str, ...]:
        states = list(self.runs[0][0].fit)
        rows = [
            [name, run.log.name]
            + [number(run.fit[s], 3) for s in states]
            + [number(rmse[s], 3) for s in states]
            + [run.picture(states[0])]
            for name, row, errors in zip(self.names, self.runs, self.rmse, strict=True)
            for run, rmse in zip(row, errors, strict=True)
        ]
        head = ["model", "log", *(f"fit {s} [%]" for s in states), *rmse_titles(states)]
        several = len(self.runs[0]) > 1
        return (
            table([*head, f"{states[0]}: measured, simulated"], rows),
            items("Notes", self.notes),
            items("Sign tests", [t.sentence for t in self.sign_tests] if several else []),
        )

    def _covered(self) -> list[str]:
        """Return a line a model on how many measurements its bands hold."""
        lines, width = [], self._width
        for name, row in zip(self.names, self.bands, strict=True):
            held = [b for b in row if b is not None and b.coverage]
            if held:
                shown = ", ".join(
                    f"{s} {100 * float(np.mean([b.coverage[s].share for b in held])):.0f} %"
                    for s in held[0].coverage
                    if all(s in b.coverage for b in held)
                )
                lines.append(f"{name:<{width}}samples in the {100 * LEVEL:.0f} % band: {shown}")
            for note in dict.fromkeys(n for b in row if b is not None for n in b.notes):
                lines.append(f"{name:<{width}}bands: {note}")
        return lines


def sign_test(
    name: str, against: str, state: str, first: Sequence[float], second: Sequence[float]
) -> SignTest:
    """Count how often the second series of fits exceeds the first, with its p-value."""
    from scipy.special import bdtr

    wins = sum(b > a for a, b in zip(first, second, strict=True))
    ties = sum(b == a for a, b in zip(first, second, strict=True))
    count = len(first) - ties
    p = min(1.0, 2 * float(bdtr(min(wins, count - wins), count, 0.5))) if count else 1.0
    return SignTest(name, against, state, wins, count, p)


def errors_ahead(
    model: ManoeuvringModel,
    run: LogFit,
    heading: Literal["measured", "simulated"] = "measured",
) -> dict[str, dict[str, float]]:
    """Return root mean square errors some seconds ahead of measured states.

    Parameters
    ----------
    model : ManoeuvringModel
    run : LogFit
        Whose log, at the model's rate, to start from.
    heading : {"measured", "simulated"}

    Returns
    -------
    dict
        Horizon in seconds -> state -> error [m/s, rad/s]; horizons longer than
        half the log are left out.
    """
    log, states = run.log, model.structure.states
    x, known = log.states(states), log.known(states)
    found = {}
    for horizon in HORIZONS:
        steps = round(horizon / log.sample_time)
        if steps < 1 or steps > len(log) // 2:
            continue
        last = len(log) - steps
        starts = np.unique(np.linspace(0, last - 1, min(last, _MOST_STARTS)).astype(int))
        unbroken = np.isclose(
            log.t[starts + steps] - log.t[starts], horizon, atol=log.sample_time / 2
        )
        starts = starts[known[starts] & known[starts + steps] & unbroken]
        if not len(starts):
            continue
        end = run_from(model, log, starts, steps, heading=heading)[:, -1]
        error = np.full(x.shape[1], np.inf)
        if np.isfinite(end).all():
            error = np.sqrt(((end - x[starts + steps]) ** 2).mean(axis=0))
        found[f"{horizon:g}"] = dict(zip(states, map(float, error), strict=True))
    return found


@known_keywords
def compare(
    models: Mapping[str, ManoeuvringModel | Estimate],
    logs: Logs | Mapping[str, Logs],
    *,
    heading: Literal["measured", "simulated"] = "measured",
    bands: bool = True,
    seed: int = 0,
) -> Comparison:
    """Run every model freely on every log.

    Parameters
    ----------
    models : mapping of str to ManoeuvringModel or Estimate
        By the names that the comparison shows.
    logs : TrialLog, sequence of TrialLog, or mapping of str to these
        A mapping holds the logs as each model reads them (its vessel's columns), by its name.
    heading : {"measured", "simulated"}
    bands : bool
        Whether to draw bands.
    seed : int
        Of the bands' draws.

    Returns
    -------
    Comparison
        Fit (6.12), errors in units and ahead, sign tests against the first model.

    Raises
    ------
    UsageError
        There is no model, a model has no logs, or models differ in their states.
    LogError
        There is no log.
    """
    if not isinstance(models, Mapping):
        raise UsageError("the models to compare have no names: write compare({name: model}, logs).")
    known = {n: m.model() if isinstance(m, Estimate) else m for n, m in models.items()}
    own = logs if isinstance(logs, Mapping) else dict.fromkeys(known, logs)
    for name in known:
        if name not in own:
            raise UsageError(
                f"the logs have no '{name}'.{suggestion(name, own)} They have {', '.join(own)}: "
                f"give those of every model, or one sequence for all."
            )
    lists = [as_list(own[name]) for name in known]
    for name, model in known.items():
        if not isinstance(model, ManoeuvringModel):
            raise UsageError(
                f"'{name}' is {model!r:.60}, which is no model: read one with load_model(path)."
            )
    if not known:
        raise UsageError("there is no model to compare: give at least one, by name.")
    columns = zip(*lists, strict=True)
    return compare_each(known, columns, heading=heading, bands=bands, seed=seed)


def compare_models(
    models: Sequence[ManoeuvringModel],
    names: Sequence[str],
    logs: Sequence[Sequence[TrialLog]],
    *,
    heading: Literal["measured", "simulated"] = "measured",
    bands: bool = True,
    seed: int = 0,
) -> Comparison:
    """Return what `compare` does (deprecated).

    Parameters
    ----------
    models : sequence of ManoeuvringModel
    names : sequence of str
    logs : sequence of sequence of TrialLog
        The logs as each model reads them.
    heading, bands, seed
        As `compare`.

    Returns
    -------
    Comparison

    Raises
    ------
    UsageError
        Models, names and lists of logs are not as many.
    LogError
        A model has no logs of its own.
    """
    warnings.warn(
        "compare_models(models, names, logs) is deprecated: write compare({name: model}, logs).",
        DeprecationWarning,
        stacklevel=2,
    )
    given: Any = logs
    flat = isinstance(given, TrialLog) or any(isinstance(mine, TrialLog) for mine in given)
    if flat or not len(models) == len(names) == len(logs):
        of_logs = "logs that stand in no list" if flat else f"{len(logs)} lists of logs"
        raise UsageError(
            f"{len(models)} models and {len(names)} names have {of_logs}, and each needs a list of "
            f"its own: write compare({{name: model}}, logs), which takes one list for all."
        )
    known = dict(zip(names, models, strict=True))
    columns = zip(*(as_list(mine) for mine in logs), strict=True)
    return compare_each(known, columns, heading=heading, bands=bands, seed=seed)


@dataclass(frozen=True)
class _Compared:
    """One model on one log: what `Comparison` holds of it."""

    run: LogFit
    rmse: dict[str, float]
    ahead: dict[str, dict[str, float]]
    band: Bands | None
    noise: dict[str, NoiseBeside]
    effects: Array

    def without_samples(self) -> _Compared:
        """Return what tables tell."""
        band = self.band and self.band.without_samples()
        return replace(self, run=self.run.without_samples(), band=band)


def _compared(
    model: ManoeuvringModel,
    log: TrialLog,
    heading: Literal["measured", "simulated"],
    bands: bool,
    seed: int,
) -> _Compared:
    """Run a model on a log."""
    run = run_model(model, log, heading=heading)
    stays = run.diverged < 0
    rmse = {
        s: float(np.sqrt(np.nanmean((run.log.measured(s) - run.x[:, i]) ** 2)))
        if stays
        else float("inf")
        for i, s in enumerate(model.structure.states)
    }
    band = predict_bands(model, run.log, heading=heading, seed=seed) if bands and stays else None
    noise = noise_beside(HeldOut(model, run))
    return _Compared(
        run, rmse, errors_ahead(model, run, heading), band, noise, stretch_effects(run)
    )


def _estimated_on(model: ManoeuvringModel, log: TrialLog) -> bool:
    used = {one["sha256"] for one in model.record.get("logs", ())}
    return log.provenance.sha256 in used - {""}


def _own_logs(name: str, own: Sequence[bool]) -> str:
    """Return a sentence where logs are those that the model was estimated on, else ``""``."""
    which = "these logs" if len(own) > 1 else "this log"
    if not all(own):
        which = f"{sum(own)} of {which[:5]} {len(own)} logs"
    told = f"'{name}' was estimated on {which}: how it fits there says little of other logs."
    return told if any(own) else ""


def _to_keep(rows: Sequence[Sequence[_Compared]], most: int) -> set[int]:
    """Return which logs stay whole: the first ones, and that which each model fits worst."""
    fits = [[mean_fit(one.run.fit) for one in row] for row in rows]
    return {*range(min(most, len(rows[0]))), *(int(np.argmin(f)) for f in fits if most)}


@one_thread()
def compare_each(
    known: Mapping[str, ManoeuvringModel],
    columns: Iterable[Sequence[TrialLog]],
    *,
    heading: Literal["measured", "simulated"] = "measured",
    bands: bool = True,
    seed: int = 0,
    whole: int | None = None,
) -> Comparison:
    """Run every model freely on one log after another.

    Parameters
    ----------
    known : mapping of str to ManoeuvringModel
    columns : iterable of sequence of TrialLog
        One log after another, each as every model reads it; none is asked for before the one
        before it was compared.
    heading, bands, seed
        As `compare`.
    whole : int, optional
        Of so many logs, the first ones and those that fit worst, samples are kept for pictures;
        of the others only what the tables tell. By default all are kept.

    Returns
    -------
    Comparison

    Raises
    ------
    UsageError
        Models differ in their states.
    """
    names, models = tuple(known), list(known.values())
    states = {model.structure.states for model in models}
    if len(states) > 1:
        one, two = sorted(states)[:2]
        raise UsageError(
            f"models with the states {', '.join(one)} and {', '.join(two)} cannot stand in one "
            f"table: compare those of the same states."
        )
    rows: list[list[_Compared]] = [[] for _ in models]
    own: list[list[bool]] = [[] for _ in models]
    for logs in columns:
        for model, log, row, mine in zip(models, logs, rows, own, strict=True):
            row.append(_compared(model, log, heading, bands, seed))
            mine.append(_estimated_on(model, log))
        keep = set(range(len(rows[0]))) if whole is None else _to_keep(rows, whole)
        for row in rows:
            row[:] = [
                one if k in keep or one.run.whole else one.without_samples()
                for k, one in enumerate(row)
            ]
    runs = tuple(tuple(one.run for one in row) for row in rows)
    rmse = tuple(tuple(one.rmse for one in row) for row in rows)
    noise = tuple(tuple(one.noise for one in row) for row in rows)
    effects = [[one.effects for one in row] for row in rows]
    tests = [
        sign_test(name, names[0], s, [r.fit[s] for r in runs[0]], [r.fit[s] for r in row])
        for name, row in zip(names[1:], runs[1:], strict=True)
        for s in runs[0][0].fit
        if s in row[0].fit
    ]
    return Comparison(
        names,
        runs,
        rmse,
        tuple(tuple(one.ahead for one in row) for row in rows),
        tuple(tests),
        tuple(tuple(one.band for one in row) for row in rows),
        tuple(
            other_conditions(model.conditions, [run.log for run in row])
            for model, row in zip(models, runs, strict=True)
        ),
        noise,
        tuple(map(tuple, own)),
        judge_comparison(names, runs, rmse, noise, own, effects),
        tuple(filter(None, (_own_logs(*one) for one in zip(names, own, strict=True)))),
    )
