"""How often a judge names what is wrong with blind trials: size, power, confusion.

The judge is any function of a trial; it sees the logs and the vessel, and must
not look at the truth, against which its judgement is counted.
"""

from __future__ import annotations

import re
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import zip_longest

import numpy as np

from greybox.diagnosis.assumed_causes import fit_given
from greybox.diagnosis.diagnose import diagnose
from greybox.diagnosis.result import DiagnosisVerdict
from greybox.errors import GreyboxError, UsageError
from greybox.numerics.binomial import wilson_interval
from greybox.numerics.parallel import map_pieces, processors
from greybox.study.blind import Order, Trial, draw_many
from greybox.study.blind_causes import CAUSES, Effect
from greybox.study.blind_conditions import Conditions
from greybox.study.blind_effects import UNKNOWN, shows
from greybox.study.tables import Row

ANSWERS = ("detected", "right", "group", "part", "wrong", "unexplained", "none", "failed")
VERDICTS = tuple(map(str, DiagnosisVerdict))
SINGLE = tuple((name,) for name in (*CAUSES, *UNKNOWN))
# share of the free-run errors from which on an effect has to be found
LEAST_FALL = 0.05
# ships sailed side by side: enough to hide the cost of a step, few enough to share the work
_PIECE = 32


@dataclass(frozen=True)
class Judgement:
    """The result of judging a trial.

    Parameters
    ----------
    verdict : {"named", "partly", "none", "confused", "unexplained"}
    ids : tuple of str
        Causes in the order found.
    groups : tuple of tuple of str
        Causes that explain the data equally well.
    parameters : mapping of str to (float, float)
        Values and standard errors of the named causes' parameters.
    gain : mapping of str to float
        Fit (6.12) on the validation log after the extension less before [%]: u, v, r.
    places : tuple of str
        Of the causes, in their order: the id with the actuator, coefficient or channel, as
        ``thruster_gain:n1``. Where a judge tells none the ids alone are compared.
    """

    verdict: str
    ids: tuple[str, ...] = ()
    groups: tuple[tuple[str, ...], ...] = ()
    parameters: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    gain: Mapping[str, float] = field(default_factory=dict)
    places: tuple[str, ...] = ()


@dataclass(frozen=True)
class Oracle:
    """What a model with the true causes, estimated on the same log, would make of a trial.

    Parameters
    ----------
    fall : float
        Share by which they lower the squared free-run errors of the estimation log, each
        state in its sensor's variance.
    gain : mapping of str to float
        Fit (6.12) on the validation log after less before [%]: u, v, r.
    """

    fall: float
    gain: Mapping[str, float] = field(default_factory=dict)

    @property
    def matters(self) -> bool:
        """Whether the effects lower the errors by as much as a diagnosis has to see."""
        return self.fall >= LEAST_FALL


Judge = Callable[[Trial], Judgement]
Knows = Callable[[Trial], Oracle]


def judge_by_diagnosis(trial: Trial) -> Judgement:
    """Diagnose the estimation log, with the validation log held out."""
    found = diagnose([trial.estimation], validate=[trial.validation])
    return Judgement(
        found.verdict,
        tuple(c.id for c in found.causes),
        found.groups,
        {name: (q.value, q.std) for c in found.causes for name, q in c.parameters.items()},
        {state: g.after - g.before for state, g in found.gain.items()},
        tuple(c.key for c in found.causes),
    )


def oracle_by_fit(trial: Trial) -> Oracle:
    """Fit the causes that act to the estimation log, and measure them on the other."""
    ids = [e.id.partition(":")[0] for e in trial.truth]
    given = fit_given([trial.estimation], ids, validate=[trial.validation])
    return Oracle(given.fall, {state: g.after - g.before for state, g in given.gain.items()})


@dataclass(frozen=True)
class Cell:
    """One kind of trial: ids of what is wrong, its size, the kind of inputs."""

    effects: tuple[str, ...]
    size: float
    kind: str

    @property
    def label(self) -> str:
        """The effects' ids, ``none`` where nothing is wrong."""
        return " + ".join(self.effects) or "none"


@dataclass(frozen=True)
class Outcome:
    """One judged trial.

    Parameters
    ----------
    cell : Cell
    run : int
    truth : tuple of Effect
    judgement : Judgement or None
        None where the judge failed.
    failure : str
        Its message.
    oracle : Oracle or None
        None where it was not asked, or where the effects have no name.
    """

    cell: Cell
    run: int
    truth: tuple[Effect, ...]
    judgement: Judgement | None
    failure: str = ""
    oracle: Oracle | None = None

    @property
    def detected(self) -> bool:
        """Whether the judge says that something is wrong."""
        return self.judgement is not None and self.judgement.verdict != DiagnosisVerdict.NONE

    @property
    def named(self) -> tuple[str, ...]:
        """The causes that are named, with ``elsewhere`` where the true one has another place."""
        if self.judgement is None:
            return ()
        true = {e.id: e.places for e in self.truth}
        return tuple(
            f"{name} elsewhere"
            if place and true.get(name) and true[name].isdisjoint(re.split("[:+]|sign_", place))
            else name
            for name, place in zip_longest(self.judgement.ids, self.judgement.places)
        )

    @property
    def answer(self) -> str:
        """How the judgement compares with the truth.

        ``right``: all causes named with their place (which actuator, coefficient or channel), no
        other, and nothing left; an effect that has no name left unexplained; nothing found where
        nothing is. ``part``: some of them named, or others beside them. ``group``: confused,
        every cause being in a group. ``failed``, ``none``, ``unexplained`` and ``wrong`` are
        what is left.
        """
        if self.judgement is None:
            return "failed"
        verdict, ids = self.judgement.verdict, set(self.named)
        true = set(self.cell.effects)
        nameless = bool(true) and true <= set(UNKNOWN)
        members = {i for group in self.judgement.groups for i in group}
        if verdict == DiagnosisVerdict.NONE:
            return "right" if not true else "none"
        if verdict == DiagnosisVerdict.UNEXPLAINED:
            return "right" if nameless else "unexplained"
        if verdict == DiagnosisVerdict.CONFUSED:
            return "group" if true and true <= ids | members else "wrong"
        if ids == true and verdict == DiagnosisVerdict.NAMED:
            return "right"
        return "part" if ids & true else "wrong"

    @property
    def found(self) -> str:
        """The column of the confusion matrix: the cause found first, or what was said instead."""
        if self.judgement is None:
            return "failed"
        if self.judgement.verdict == DiagnosisVerdict.CONFUSED:
            return "group with it" if self.answer == "group" else "group without"
        if self.judgement.verdict in (DiagnosisVerdict.NAMED, DiagnosisVerdict.PARTLY):
            return self.named[0]
        return self.judgement.verdict


@dataclass(frozen=True)
class Share:
    """A share of trials with its 95 % interval."""

    hits: int
    runs: int

    @property
    def value(self) -> float:
        """The share itself."""
        return self.hits / self.runs if self.runs else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """The interval of Wilson (1927)."""
        return wilson_interval(self.value, self.runs)

    @property
    def error(self) -> float:
        """Binomial standard error of the share."""
        return float(np.sqrt(self.value * (1 - self.value) / self.runs))

    def __str__(self) -> str:
        if not self.runs:
            return ""
        low, high = self.interval
        return f"{100 * self.value:.0f} % ({100 * low:.0f}-{100 * high:.0f})"


@dataclass(frozen=True)
class Power:
    """The study: all judged trials, in the order of its cells."""

    outcomes: tuple[Outcome, ...]

    @property
    def cells(self) -> tuple[Cell, ...]:
        """Every kind of trial once."""
        return tuple(dict.fromkeys(o.cell for o in self.outcomes))

    def of(self, cell: Cell) -> list[Outcome]:
        """Return the trials of a cell."""
        return [o for o in self.outcomes if o.cell == cell]

    def share(self, cell: Cell, *answers: str) -> Share:
        """Return the share of a cell's trials with one of some answers.

        ``detected`` counts every trial of which the judge says that something is wrong.
        """
        mine = self.of(cell)
        hits = sum(o.answer in answers or ("detected" in answers and o.detected) for o in mine)
        return Share(hits, len(mine))

    def visible(self, cell: Cell) -> list[Outcome]:
        """Return the trials whose effects lower the errors by as much as has to be found.

        All where no oracle was asked. What was answered plays no part: counting what was named
        rightly in any case would raise the share of right answers.
        """
        return [o for o in self.of(cell) if o.oracle is None or o.oracle.matters]

    def confusion(self, kind: str, size: float) -> dict[str, Counter[str]]:
        """Return for each truth how often each thing was found; ``none`` has one size."""
        return {
            cell.label: Counter(o.found for o in self.of(cell))
            for cell in self.cells
            if cell.kind == kind and (cell.size == size or not cell.effects)
        }

    def errors(self, cell: Cell) -> dict[str, list[tuple[float, float]]]:
        """Return errors and standard errors of the parameters where the causes were named."""
        out: dict[str, list[tuple[float, float]]] = {}
        for o in self.of(cell):
            if o.judgement is None or o.answer != "right":
                continue
            true = {k: v for e in o.truth for k, v in e.parameters.items() if isinstance(v, float)}
            for name, (value, std) in o.judgement.parameters.items():
                if name in true:
                    out.setdefault(name, []).append((value - true[name], std))
        return out

    def gains(self, cell: Cell) -> dict[str, list[float]]:
        """Return the gains on the validation logs where something was found [%]."""
        out: dict[str, list[float]] = {}
        for o in self.of(cell):
            if o.judgement is not None and o.detected:
                for name, value in o.judgement.gain.items():
                    out.setdefault(name, []).append(value)
        return out

    def lost(self, cell: Cell) -> list[float]:
        """Return the fit lost against the oracle's model where causes were named [%].

        Of each trial the state that loses most; negative where every state gains.
        """
        out = []
        for o in self.of(cell):
            if o.oracle is not None and o.judgement is not None and o.judgement.ids:
                gain = o.judgement.gain
                out.append(max(o.oracle.gain[s] - gain[s] for s in o.oracle.gain))
        return out

    def rows(self) -> list[Row]:
        """Return shares with their binomial standard errors, confusion, errors and gains."""
        rows = []
        for cell in self.cells:
            place = f"{cell.kind}, size {cell.size:g}"

            def row(
                table: str, name: str, mean: float, sd: float, n: int, place: str = place,
                label: str = cell.label,
            ) -> Row:  # fmt: skip
                return Row(table, place, label, name, mean, sd, None, None, n)

            for answer in ANSWERS:
                share = self.share(cell, answer)
                rows.append(row("power", answer, share.value, share.error, share.runs))
            count = Counter(o.found for o in self.of(cell))
            for name, hits in sorted(count.items()):
                share = Share(hits, len(self.of(cell)))
                rows.append(row("confusion", name, share.value, share.error, share.runs))
            for name, pairs in self.errors(cell).items():
                rows.append(row("error", name, *_moments([e for e, _ in pairs]), len(pairs)))
                share = Share(sum(abs(e) <= 1.96 * s for e, s in pairs), len(pairs))
                rows.append(row("95 % interval holds", name, share.value, share.error, share.runs))
            for name, values in self.gains(cell).items():
                rows.append(row("gain", name, *_moments(values), len(values)))
        return sorted(rows, key=lambda r: r.table)


def _moments(values: Sequence[float]) -> tuple[float, float]:
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")
    return float(np.mean(values)), spread


def _piece(
    piece: Sequence[tuple[Cell, int]],
    judge: Judge,
    oracle: Knows | None,
    seed: int,
    conditions: Conditions,
) -> list[Outcome]:
    rngs, orders = [], []
    for cell, run in piece:
        # the same ships and inputs at every size of an effect
        key = zlib.crc32(f"{cell.label} {cell.kind}".encode())
        rngs.append(np.random.default_rng([seed, key, run]))
        orders.append(Order(cell.effects, cell.size))
    trials = draw_many(rngs, orders, replace(conditions, kind=piece[0][0].kind))
    out = []
    for (cell, run), trial in zip(piece, trials, strict=True):
        outcome = _judged(cell, run, trial, judge)
        # the truth is looked at only now that the verdict is in
        if oracle is not None and cell.effects and set(cell.effects) <= set(CAUSES):
            outcome = replace(outcome, oracle=oracle(trial))
        out.append(outcome)
    return out


def _judged(cell: Cell, run: int, trial: Trial, judge: Judge) -> Outcome:
    blind = replace(trial, truth=(), ship={})
    try:
        judgement = judge(blind)
    except GreyboxError as error:
        return Outcome(cell, run, trial.truth, None, str(error))
    if judgement.verdict not in VERDICTS or (
        judgement.verdict == DiagnosisVerdict.NAMED and not judgement.ids
    ):
        raise UsageError(
            f"the judge gave the verdict '{judgement.verdict}' with {len(judgement.ids)} ids: give "
            f"one of {', '.join(VERDICTS)}, and at least 1 id where it is 'named'."
        )
    return Outcome(cell, run, trial.truth, judgement)


def run_power(
    judge: Judge,
    *,
    oracle: Knows | None = None,
    effects: Sequence[tuple[str, ...]] = SINGLE,
    sizes: Sequence[float] = (0.25, 0.5, 1.0),
    kinds: Sequence[str] = ("manoeuvres",),
    runs: int = 20,
    none_runs: int = 100,
    seed: int = 0,
    conditions: Conditions | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Power:
    """Judge many blind trials of each effect and size, and of none.

    Parameters
    ----------
    judge : callable
        Trial -> Judgement; a module-level function where there are several workers. It
        gets trials without truth. An error of this package counts as a failure.
    oracle : callable, optional
        Trial -> Oracle; asked, after the judge, about trials whose effects have a name.
    effects : sequence of tuple of str
        What is wrong: one id or more each.
    sizes : sequence of float
        1 is the stated range of an effect.
    kinds : sequence of str
        Of inputs. Effects that cannot show in a kind are left out there.
    runs, none_runs : int
        Trials of each effect, size and kind; trials of each kind with nothing wrong.
    seed : int
        A trial depends on it, its effects, its kind and its number only.
    conditions : Conditions, optional
        All else of the trials.
    workers : int, optional
        Processes.
    progress : callable
        Called with trials done and in all.

    Raises
    ------
    UsageError
        No trial is asked for, an effect does not exist, or the judge gives no verdict.
    """
    conditions = conditions or Conditions()
    pieces: list[list[tuple[Cell, int]]] = []
    for kind in kinds:
        wanted = [(Cell((), 1.0, kind), run) for run in range(none_runs)]
        for ids in effects:
            if all(shows(name, kind) for name in ids):
                cells = [Cell(tuple(ids), size, kind) for size in sizes]
                wanted += [(cell, run) for cell in cells for run in range(runs)]
        # few trials are shared out all the same
        size = max(1, min(_PIECE, -(-len(wanted) // (workers or processors()))))
        pieces += [wanted[k : k + size] for k in range(0, len(wanted), size)]
    if not pieces:
        raise UsageError("the study has 0 trials: ask for runs, none_runs and at least one kind.")
    total, outcomes = sum(map(len, pieces)), list[Outcome]()
    work = partial(_piece, judge=judge, oracle=oracle, seed=seed, conditions=conditions)
    for found in map_pieces(work, pieces, workers=workers):
        outcomes += found
        progress(len(outcomes), total)
    return Power(tuple(outcomes))
