"""The model that the data choose, taken apart into causes that have a name.

Where (3.51) with a few causes leaves more than noise, `estimate`'s choice of terms begins: each
that stands for a cause is in force as one, is tested by leaving it out, and what else is wrong is
sought beside them. Lags, delays and rate limits that stood before are held at their values, for
the choice of terms, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.causes.hull import is_coupling, term_parameters
from greybox.diagnosis.causes.sensors import abeam
from greybox.diagnosis.evidence.held_out import worse
from greybox.diagnosis.evidence.kinematics import denied
from greybox.diagnosis.evidence.wind_direction import wind_direction
from greybox.diagnosis.fitting import Problem, stacked
from greybox.diagnosis.hypothesis import Hypothesis
from greybox.diagnosis.noise import Noise
from greybox.diagnosis.null_model import INTEGRATORS, DiagnosisProblem
from greybox.diagnosis.point import Fit, Point
from greybox.diagnosis.preparing import Prepared, context_of
from greybox.diagnosis.quantities import quantities_of
from greybox.diagnosis.refitting import SETTLE, on_all_processors
from greybox.diagnosis.search import Candidate, Search, assess_candidate, search
from greybox.diagnosis.ship import CURRENTS, Ship
from greybox.diagnosis.thresholds import PROVEN
from greybox.errors import ExcitationError, GreyboxError
from greybox.model.disturbances import TURNING
from greybox.model.structure import Structure
from greybox.model.terms import Term, parse_term
from greybox.numerics.linalg import ROUNDING, scaled
from greybox.numerics.parallel import ahead
from greybox.selection.cross_validation import Refit
from greybox.selection.free_run_selection import OWN
from greybox.selection.term_selection import TermChoice, select_terms
from greybox.trial.log import TrialLog
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

_AIR = {"uq", "vq"}
_FLOW = {"v", "r"}
_QUADRATIC = "quadratic_thrust"
# defects of sensors that turn one velocity into another, and forces that look alike
_TURNED = {"heading_bias", "lever_arm"}
_LIKE_TURNED = {"asymmetry", "side_force", "inertia_coupling"}


class Choosing:
    """A choice of terms that is begun before it is known to be needed.

    Parameters
    ----------
    begun : ExitStack
        With which the work ends.
    """

    def __init__(self, begun: ExitStack) -> None:
        self._begun = begun
        self._vessel: Vessel | None = None
        self._found: Callable[[], TermChoice | None]

    def begin(self, logs: Sequence[TrialLog]) -> None:
        """Begin it of logs; what was begun for another vessel than theirs ends."""
        if self._vessel != logs[0].vessel:
            self._begun.close()
            self._vessel = logs[0].vessel
            self._found = self._begun.enter_context(ahead(partial(_choice_of, logs)))

    def of(self, logs: Sequence[TrialLog]) -> TermChoice | None:
        """Return the terms that logs choose; None where they choose none."""
        self.begin(logs)
        return self._found()


def from_chosen(
    ready: Prepared,
    searched: Search,
    found: Search,
    choosing: Choosing,
    progress: Callable[[str], None],
) -> tuple[DiagnosisProblem, Search] | None:
    """Search with errors weighed by their size alone; None where that predicts no better.

    It begins with the terms that the data choose, or with what the search from (3.51) ended with:
    whichever follows the held-out logs more nearly.

    Parameters
    ----------
    ready : Prepared
        Without a model of its own.
    searched, found : Search
        From (3.51), before and after its causes were weighed.
    choosing : Choosing
    progress : callable
    """
    progress("terms that the data choose")
    late = _late(ready.case, found)
    ready = replace(ready, case=ready.case.acting(found.final.point.ship.vessel)) if late else ready
    choice = choosing.of(ready.case.logs)
    states = ready.case.structure.states
    if choice is not None and not set(choice.terms.structure.states) <= set(states):
        # the terms of motions that this structure leaves out are none of it
        choice = None
    terms = () if choice is None else choice.terms.structure.parameters
    case = ready.case.wider(terms, "free run")
    base = case.carried(found.base)
    plain = case.problem(base.integrator).settle(base)
    starts = [_holding(case, case.carried(searched.final).point, late)]
    # what the sensors deny imitates what forces do
    hypotheses = ready.of_forces
    keys = {c.hypothesis.key for c in late}
    named = [c.hypothesis for c in searched.causes if c.hypothesis.key not in keys]
    chosen: list[Hypothesis] = []
    every: list[Hypothesis] = []
    if choice is not None:
        chosen, every = _hypotheses(ready, case, choice)
        known = _known_columns(case.problem(base.integrator), base, chosen)
        chosen, every = (
            [_less(a, known) for a in some if not a.columns or set(a.columns) - known]
            for some in (chosen, every)
        )
        starts.append(_holding(case, _start(ready, case, choice, chosen, base), late))
    fit, *rest = _bounded(case, starts, plain.noise)
    by_data = rest[0] if rest else None
    if by_data is not None and (fit is None or worse(case.held_out, by_data, fit) < 0):
        fit, named, hypotheses = by_data, chosen, tuple(every)
    if fit is None:
        return None
    fit, named = _with_sensors(case, fit, named, hypotheses)
    fit, named = _with_wind(case, fit, named, hypotheses)
    proof = case.held_out(fit.integrator).prove(plain, fit)
    names = case.problem(fit.integrator).names
    # each is weighed at the end, by leaving it out
    causes = [assess_candidate(proof, plain, fit, a, len(hypotheses), names) for a in named]
    coupled = any(a.cause == "inertia_coupling" for a in named)
    others = [
        abeam(a) if coupled and a.cause == "lever_arm" else a for a in hypotheses if a not in named
    ]
    other = search(case, fit, others, begun=[*causes, *late], progress=progress)
    mine = replace(
        other, base=base, tried=len(hypotheses), chosen=by_data,
        nearest=None if plain.escaped else plain,
    )  # fmt: skip
    nearer = worse(case.held_out, mine.final, case.carried(found.final)) < 0
    return (case, mine) if nearer else None


def _late(case: DiagnosisProblem, found: Search) -> list[Candidate]:
    """Return the causes of past commands that stand, held at what innovations tell of them.

    Innovations forget the structure's misfit within seconds and show what commands do late; errors
    of whole runs do not.
    """
    out = []
    for cause in found.causes:
        hypothesis, fit = cause.hypothesis, found.final
        if not hypothesis.past:
            continue
        k = [h.key for h in fit.point.hypotheses].index(hypothesis.key)
        told = quantities_of(case.problem(fit.integrator), cause, fit)
        # with the convention of sampling that the fit ended with
        held = fit.point.hypotheses[k].held_at(fit.point.values[k])
        out.append(replace(cause, hypothesis=held, told=told))
    return out


def _holding(case: DiagnosisProblem, point: Point, late: Sequence[Candidate]) -> Point:
    """Return a point with causes held at their values."""
    for cause in late:
        if any(h.key == cause.hypothesis.key for h in point.hypotheses):
            point = case.problem("euler").drop(point, cause.hypothesis)
        point = case.problem("euler").add(point, cause.hypothesis)
    return point


def _start(
    ready: Prepared,
    case: DiagnosisProblem,
    choice: TermChoice,
    named: Sequence[Hypothesis],
    base: Fit,
) -> Point:
    """Return the chosen terms, those that stand for causes in force."""
    problem = case.problem(base.integrator)
    in_force = {n for a in named for n in (*a.columns, *a.co_freed)}
    chosen = choice.terms.structure.parameters
    free = dict.fromkeys((*chosen, *_replaced(ready.structure, named)))
    places = tuple(problem.place(n) for n in free if n not in in_force)
    share, pushed = _law(choice, base, named)
    start = Point(_ship(problem, choice, base, pushed), base.point.starts, places)
    for hypothesis in named:
        value = None if hypothesis.apply is None else np.array([share])
        start = problem.add(start, hypothesis, value)
    spare = [problem.place(n) for n in free if n not in in_force and n not in chosen]
    return _told_apart(problem, start, base.noise, spare)


def _known_columns(problem: Problem, base: Fit, named: Sequence[Hypothesis]) -> set[str]:
    """Return columns of causes that (3.51) can do as well on these logs: |X| u is X u ahead."""
    point = base.point
    for hypothesis in named:
        if hypothesis.apply is None:
            point = problem.add(point, hypothesis)
    normal = _normal(problem, point, base.noise)
    more = range(len(base.point.places), len(point.places))
    begun = [k for k in range(len(normal)) if k not in more]
    return {
        problem.names[point.places[k]]
        for k in more
        if len(normal) and _own_share(normal, [*begun, k], k) < OWN
    }


def _less(hypothesis: Hypothesis, known: AbstractSet[str]) -> Hypothesis:
    """Return a cause without the columns that are known."""
    if not known & set(hypothesis.columns):
        return hypothesis
    left = [k for k, name in enumerate(hypothesis.columns) if name not in known]
    columns = tuple(hypothesis.columns[k] for k in left)
    return replace(
        hypothesis, key=f"{hypothesis.cause}:{'+'.join(columns)}", columns=columns,
        parameters=tuple(hypothesis.parameters[k] for k in left),
    )  # fmt: skip


def _told_apart(problem: Problem, point: Point, noise: Noise, spare: Sequence[int]) -> Point:
    """Return the point without spare terms that do what others do: u v and |u| v are one ahead."""
    normal = _normal(problem, point, noise)
    kept = list(range(len(normal)))
    for i in spare:
        k = point.places.index(i)
        if kept and _own_share(normal, kept, k) < OWN:
            kept.remove(k)
    places = tuple(i for k, i in enumerate(point.places) if not kept or k in kept)
    return replace(point, places=places)


def _normal(problem: Problem, point: Point, noise: Noise) -> Array:
    """Return products of what each free number does, in its own size; none without bounds."""
    rows = stacked(problem.rows(point, noise))
    return scaled(rows.T @ rows)[0] if np.isfinite(rows).all() else np.zeros((0, 0))


def _own_share(normal: Array, among: Sequence[int], one: int) -> float:
    """Return what of one number's effect no other one among several has, squared."""
    part = normal[np.ix_(among, among)] + ROUNDING * np.eye(len(among))
    return float(1 / np.linalg.inv(part)[among.index(one), among.index(one)])


def _bounded(case: DiagnosisProblem, starts: Sequence[Point], noise: Noise) -> list[Fit | None]:
    """Return of each start the likelier fit by either integrator whose held-out runs have bounds.

    None where there is none.
    """
    ways = [(start, integrator) for start in starts for integrator in INTEGRATORS]

    def work(k: int) -> tuple[Fit, bool]:
        start, integrator = ways[k]
        problem = case.problem(integrator)
        fit = problem.settle(problem.fit(start, noise), SETTLE)
        fit = replace(fit, integrator=integrator)
        held = not fit.escaped and np.isfinite(case.held_out(integrator).squares(fit)).all()
        return fit, bool(held)

    found = on_all_processors([start for start, _ in ways], work)
    best = []
    for k in range(0, len(ways), len(INTEGRATORS)):
        fits = [fit for fit, held in found[k : k + len(INTEGRATORS)] if held]
        best.append(min(fits, key=lambda f: f.cost, default=None))
    return best


def _choice_of(logs: Sequence[TrialLog]) -> TermChoice | None:
    """Return the terms that logs choose; None where they choose none."""
    try:
        found = select_terms(logs, "no model", 0, Refit(_none), stepped=False)
    except GreyboxError:
        return None
    # what can be sent from one process to another
    return replace(found, again=_none)


def _none(_: Sequence[TrialLog]) -> NoReturn:
    raise ExcitationError("no model stands before.")


def _with_sensors(
    case: DiagnosisProblem, fit: Fit, named: list[Hypothesis], hypotheses: Sequence[Hypothesis]
) -> tuple[Fit, list[Hypothesis]]:
    """Return a fit and its causes, with the defects of sensors that the kinematics leave open.

    The choice of terms knows no sensors, and its terms imitate them: an asymmetry of thrust turns
    surge into sway as a compass bias does. One defect alone is then hardly seen beside another.
    All, or else one, are in force where the fit is likelier with them, each number at its price,
    and follows the held-out logs more nearly; each is weighed at the end, as the terms are. An
    antenna ahead of the origin moves as a ship with other coupled inertia does, so forces tell
    only one of the two: it stands in the place of that, or is abeam only.
    """
    defects = [h for h in hypotheses if h.cause in _TURNED and h not in named]
    if not defects or not any(h.cause in _LIKE_TURNED for h in named):
        return fit, named
    uncoupled = [h for h in named if h.cause != "inertia_coupling"]
    alike = len(uncoupled) < len(named) and any(h.cause == "lever_arm" for h in defects)
    beside = [abeam(h) if alike and h.cause == "lever_arm" else h for h in defects]
    every = [[*named, *beside], *([[*uncoupled, *defects]] if alike else [])]
    alone = [[*named, h] for h in beside if len(beside) > 1]
    return _best_of(case, fit, named, every) or _best_of(case, fit, named, alone) or (fit, named)


def _with_wind(
    case: DiagnosisProblem, fit: Fit, named: list[Hypothesis], hypotheses: Sequence[Hypothesis]
) -> tuple[Fit, list[Hypothesis]]:
    """Return a fit and its causes, with the wind where errors tell from where it blew.

    A weak wind promises less than many a term that takes up what the hull lacks, and would not be
    among those that are tried. A current takes much of what a steady wind does, so that the wind is
    asked for in its place, too; so is all of the wind in the place of those of its terms that were
    chosen beside one.
    """
    problem, held_out = case.problem(fit.integrator), case.held_out(fit.integrator)
    calm = [h for h in named if h.cause != "wind"]
    still = [h for h in calm if h.cause != "current"]
    if len(calm) < len(named):
        winds = [h for h in hypotheses if h.cause == "wind" and h not in named]
        ways = [[*still, h] for h in winds] if len(still) < len(calm) else []
        return _best_of(case, fit, named, ways) or (fit, named)
    fits = [fit]
    if len(still) < len(named):
        point = fit.point
        for hypothesis in named:
            point = point if hypothesis in still else problem.drop(point, hypothesis)
        fits.append(problem.settle(problem.fit(point, fit.noise), 1))
    blowing = [
        h for h in hypotheses
        if h.cause == "wind"
        and len(fits) * min(wind_direction(problem, h, f, held_out) for f in fits) < PROVEN
    ]  # fmt: skip
    ways = [[*causes, h] for h in blowing for causes in (named, still)[: len(fits)]]
    return _best_of(case, fit, named, ways) or (fit, named)


def _best_of(
    case: DiagnosisProblem,
    fit: Fit,
    named: Sequence[Hypothesis],
    ways: Sequence[list[Hypothesis]],
) -> tuple[Fit, list[Hypothesis]] | None:
    """Return the likeliest fit with other causes than those named, and these; None if none is."""
    problem = case.problem(fit.integrator)
    points = []
    for causes in ways:
        point = fit.point
        for hypothesis in named:
            point = point if hypothesis in causes else problem.drop(point, hypothesis)
        for hypothesis in causes:
            point = point if hypothesis in named else problem.add(point, hypothesis)
        points.append(point)

    def work(k: int) -> tuple[Fit, bool]:
        found = problem.settle(problem.fit(points[k], fit.noise), SETTLE)
        return found, not found.escaped and worse(case.held_out, found, fit) < 0

    price = np.log(problem.counts.sum())
    best: tuple[Fit, list[Hypothesis]] | None = None
    for (found, nearer), causes in zip(on_all_processors(points, work), ways, strict=True):
        least = fit if best is None else best[0]
        dearer = price * (len(found.point.vector()) - len(least.point.vector()))
        if nearer and found.cost + dearer < least.cost:
            best = found, causes
    return best


def _hypotheses(
    ready: Prepared, case: DiagnosisProblem, choice: TermChoice
) -> tuple[list[Hypothesis], list[Hypothesis]]:
    """Return the causes that the chosen terms stand for, and all that are to be tried."""
    structure, terms = ready.structure, choice.terms.structure
    vessel = case.logs[0].vessel
    # what the chosen terms hold is no hypothesis of its own, but a current's turn is part of it
    held = [name for name in _lacking(structure, terms) if name not in TURNING]
    context = context_of(structure.with_terms(*held), ready)
    grouped: dict[tuple[str, str], list[Term]] = {}
    for term in terms.terms:
        cause = _cause_of(term, structure, vessel)
        if cause is not None and cause in ready.causes:
            alone = cause in ("cubic_damping", "crossflow")
            grouped.setdefault((cause, term.name if alone else ""), []).append(term)
    named = [
        Hypothesis(
            cause,
            cause if cause == "wind" else f"{cause}:{'+'.join(t.name for t in mine)}",
            term_parameters([t.name for t in mine], context),
            columns=tuple(t.name for t in mine),
        )
        for (cause, _), mine in grouped.items()
    ]
    tried = [a for c in ready.causes.values() for a in c.hypotheses(context)]
    others = [a for a in tried if not denied(a.key, ready.agreeing)]
    if "current" in ready.causes and choice.terms.kind in ("wind", "augmented"):
        turned = context.lacking(*TURNING)
        current = [a for a in others if a.cause == "current" and not a.apply]
        named += [replace(a, co_freed=turned) for a in current]
        others = [a for a in others if a.cause != "current"]
    if choice.logs[0].vessel.thrusters[0].thrust != vessel.thrusters[0].thrust:
        named += [a for a in others if a.cause == _QUADRATIC]
        others = [a for a in others if a.cause != _QUADRATIC]
    return named, [*named, *others]


def _replaced(structure: Structure, named: Sequence[Hypothesis]) -> list[str]:
    """Return terms of (3.51) that chosen ones stand in for: a cause is what they cannot do."""
    columns = [name for cause in named for name in cause.columns]
    chosen = [parse_term(name) for name in columns if name not in CURRENTS]

    def alike(one: Term, two: Term) -> bool:
        mine, its = ({f.signal for f in t.factors} for t in (one, two))
        return one.state == two.state and bool(mine and its) and (mine <= its or its <= mine)

    return [t.name for t in structure.terms if any(alike(t, other) for other in chosen)]


def _lacking(structure: Structure, terms: Structure) -> list[str]:
    keys = {t.key for t in structure.terms}
    return [t.name for t in terms.terms if t.key not in keys]


def _cause_of(term: Term, structure: Structure, vessel: Vessel) -> str | None:
    """Return the cause that a term stands for where a structure lacks it."""
    if any(t.key == term.key for t in structure.terms):
        return None
    signals = [f.signal for f in term.factors]
    if not signals:
        return None if term.state == "u" else "side_force"
    if set(signals) <= _AIR:
        return "wind"
    if signals == [term.state] * 3:
        return "cubic_damping"
    if term.name == "N_|r|r":
        return "quadratic_yaw_damping"
    if is_coupling(term, vessel):
        return "inertia_coupling"
    if term.state in _FLOW and term.even:
        return "asymmetry"
    if term.state in _FLOW and len(signals) == 2 and set(signals) <= _FLOW:
        return "crossflow"
    if len(signals) == 2 and "u" in signals and set(signals) & {"taux", "tauy", "taun"}:
        own = {"u": "taux", "v": "tauy", "r": "taun"}[term.state]
        return "advance_speed" if own in signals else None
    return None


def _ship(problem: Problem, choice: TermChoice, base: Fit, pushed: float) -> Ship:
    """Return the chosen coefficients at the sample time and thrust of the diagnosis."""
    terms = choice.terms
    ship = base.point.base
    scale = problem.sample_time / choice.logs[0].sample_time
    theta = np.zeros(len(ship.theta))
    for term, value in zip(terms.structure.terms, terms.start, strict=True):
        theta[problem.place(term.name)] = value * scale * pushed**term.of_thrust
    return replace(ship, theta=theta, current=np.zeros(len(CURRENTS)))


def _law(choice: TermChoice, base: Fit, named: Sequence[Hypothesis]) -> tuple[float, float]:
    """Return the share of n|n| of the chosen law, and its force over that of the diagnosis.

    Both count the share at a typical speed of their own.
    """
    apply = next((a.apply for a in named if a.cause == _QUADRATIC), None)
    if apply is None:
        return 0.0, 1.0
    reference = apply(base.point.base, np.ones(1)).vessel.thrusters[0].thrust.reference
    straight, squared = choice.logs[0].vessel.thrusters[0].thrust.shares
    pushed = straight + squared * reference
    return squared * reference / pushed, pushed
