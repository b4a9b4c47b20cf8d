"""The model before any cause, fitted to the logs: where every diagnosis begins."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.evidence.held_out import Folds, HeldOut, OtherLogs
from greybox.diagnosis.fitting import Metric, Problem
from greybox.diagnosis.hypothesis import Hypothesis
from greybox.diagnosis.point import Fit, Point
from greybox.diagnosis.ship import Change, LogRun, Ship, shifted, wired
from greybox.errors import ExcitationError
from greybox.estimation.free_run import fit_free_runs
from greybox.estimation.output_setup import measured, output_model, output_predictor
from greybox.model.model import ManoeuvringModel
from greybox.model.predictor import Predictor, Regime, build_predictor
from greybox.model.predictor_kinds import PREDICTORS
from greybox.model.run.step import Integrator
from greybox.model.structure import Structure
from greybox.model.terms import parse_term
from greybox.numerics.parallel import map_forked
from greybox.regression.regression import build_regression
from greybox.rotation import body_to_ned, ned_to_body
from greybox.trial.convert.sensor_corrections import correct_log
from greybox.trial.log import TrialLog
from greybox.trial.segments import of_one_log
from greybox.validation.fit import LogFit, run_model
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

INTEGRATORS: tuple[Integrator, ...] = ("euler", "rk4")
# fall of −2 log L from which on the other integrator is taken
_BETTER = 6.0
# fall of the one-step errors' −2 log L from which on a rewired log is worth a fit
_REWIRED = 20.0
# and hypotheses, of those whose runs leave every bound, that get one
_RESCUED = 2
# free-run errors, in the sensors' deviations, up to which a first fit needs no second
_NEAR = 3.0
# damping a sample of a run that must stay bounded
_BRAKE = 0.01
# parts of the logs that are held out in turn where there is no validation log
FOLDS = 3
_SHORTEST = 60


# time of the first sample of the log that a segment is of, and how long that log is [s]
Clock = tuple[float, float]


def clocks_of(logs: Sequence[TrialLog]) -> list[Clock]:
    """Return the clock that changes count on, of each log: that of the whole log of a segment."""
    return [
        (float(logs[places[0]].t[0]), float(logs[places[-1]].t[-1] - logs[places[0]].t[0]))
        for places in of_one_log(logs)
        for _ in places
    ]


def run_on(model: ManoeuvringModel, log: TrialLog) -> LogFit:
    """Run a model on a log as its vessel file reads it."""
    return runs_on(model, [log])[0]


def runs_on(model: ManoeuvringModel, logs: Sequence[TrialLog]) -> list[LogFit]:
    """Run a model on each log, its changes by the clock of the log that each is a segment of."""
    return [
        run_model(model, correct_log(log, model.vessel), first=float(log.t[0]) - origin)
        for log, (origin, _) in zip(logs, clocks_of(logs), strict=True)
    ]


class DiagnosisProblem:
    """Logs, a structure to diagnose, and a wider one that every cause fits in.

    Parameters
    ----------
    structure, universe : Structure
    logs, held_out : sequence of TrialLog
        To estimate on, and to prove on; without the latter, parts of the former.
    kind : str
        Predictor of the first coefficients.
    regime : Regime
    metric : {"coloured", "free run"}
        See `Problem`.
    clocks : tuple of sequence of Clock, optional
        Of `logs` and of `held_out`, as `clocks_of` gives them.
    """

    def __init__(
        self,
        structure: Structure,
        universe: Structure,
        logs: Sequence[TrialLog],
        held_out: Sequence[TrialLog],
        kind: str,
        regime: Regime,
        metric: Metric = "coloured",
        clocks: tuple[Sequence[Clock], Sequence[Clock]] | None = None,
    ) -> None:
        self.structure, self.universe = structure, universe
        self.metric: Metric = metric
        self.logs, self.held_out_logs = list(logs), list(held_out)
        self.clocks = clocks or (clocks_of(logs), clocks_of(held_out))
        self.kind, self.regime = kind, regime
        self._problems: dict[Integrator, Problem] = {}
        self._held: dict[Integrator, HeldOut] = {}

    def wider(self, names: Sequence[str], metric: Metric) -> DiagnosisProblem:
        """Return the case with more terms that a hypothesis may use, and errors weighed anew."""
        known = {t.key for t in self.universe.terms}
        more = [n for n in names if parse_term(n).key not in known]
        return DiagnosisProblem(
            self.structure, self.universe.with_terms(*more), self.logs, self.held_out_logs,
            self.kind, self.regime, metric, self.clocks,
        )  # fmt: skip

    def acting(self, vessel: Vessel) -> DiagnosisProblem:
        """Return the case with logs whose commands act as they do in a vessel."""
        logs, held_out = (
            [
                replace(log, vessel=replace(log.vessel, actuation=vessel.actuation))
                for log in every
            ]
            for every in (self.logs, self.held_out_logs)
        )  # fmt: skip
        return DiagnosisProblem(
            self.structure, self.universe, logs, held_out, self.kind, self.regime, self.metric,
            self.clocks,
        )  # fmt: skip

    def carried(self, fit: Fit) -> Fit:
        """Return a fit of a case with fewer terms as one of this."""
        base = fit.point.base
        more = len(self.universe.parameters) - len(base.theta)
        theta = np.concatenate([base.theta, np.zeros(more)])
        # currents stand behind the coefficients
        places = tuple(i if i < len(base.theta) else i + more for i in fit.point.places)
        point = replace(fit.point, base=replace(base, theta=theta), places=places)
        return replace(fit, point=point)

    def problem(self, integrator: Integrator) -> Problem:
        """Return the estimation logs, ready to be run."""
        if integrator not in self._problems:
            self._problems[integrator] = self._made(
                zip(self.logs, self.clocks[0], strict=True), integrator
            )
        return self._problems[integrator]

    def held_out(self, integrator: Integrator) -> HeldOut:
        """Return where causes have to prove themselves."""
        if integrator not in self._held:
            if self.held_out_logs:
                self._held[integrator] = OtherLogs(
                    self.problem(integrator),
                    self._made(zip(self.held_out_logs, self.clocks[1], strict=True), integrator),
                )
            else:
                self._held[integrator] = Folds(self._folds(integrator))
        return self._held[integrator]

    def _made(self, parts: Iterable[tuple[TrialLog, Clock]], integrator: Integrator) -> Problem:
        runs = [LogRun(self.universe, log, integrator, *clock) for log, clock in parts]
        return Problem(runs, self.metric)

    def _folds(self, integrator: Integrator) -> list[tuple[Problem, Problem]]:
        out = []
        for k in range(FOLDS):
            fitting: list[tuple[TrialLog, Clock]] = []
            held: list[tuple[TrialLog, Clock]] = []
            for log, clock in zip(self.logs, self.clocks[0], strict=True):
                edges = np.linspace(0, len(log), FOLDS + 1).astype(int)
                held.append((log.window(int(edges[k]), int(edges[k + 1])), clock))
                for a, b in ((0, int(edges[k])), (int(edges[k + 1]), len(log))):
                    if b - a >= _SHORTEST:
                        fitting.append((log.window(a, b), clock))
            if not fitting:
                # the middle of a short log leaves nothing long enough beside it
                continue
            out.append((self._made(fitting, integrator), self._made(held, integrator)))
        return out

    def base(
        self,
        coefficients: Mapping[str, float] | None,
        current: Array,
        changes: tuple[Change, ...] = (),
    ) -> Fit:
        """Return the fit of the model without causes, with the likelier integrator.

        A log from a simulation in steps of its sample time wants Euler's rule, a ship
        whose commands are held between samples the classical Runge-Kutta rule.

        Raises
        ------
        ExcitationError
            No free run of the structure stays bounded.
        """
        found: list[Fit] = []
        for values, spare in self._first(coefficients):
            # these ways are for those who have found none
            if spare and any(not self._escapes(f) for f in found):
                break
            # further starts run with the integrator that the first one preferred
            tried = [min(found, key=lambda f: f.cost).integrator] if found else INTEGRATORS
            first = values()
            fits = map_forked(partial(self._fit, first, current, changes), tried)
            found += [f for f in fits if f is not None and not f.escaped]
            if any(self._follows(f) for f in found):
                break
        if found:
            return min(found, key=lambda f: (self._escapes(f), f.cost))
        raise ExcitationError(
            f"no free run of '{self.structure.name}' stays bounded on "
            f"{', '.join(log.name for log in self.logs)}: give a model that follows them with "
            f"--model."
        )

    def _escapes(self, fit: Fit) -> bool:
        """Whether the model runs away on what is held out."""
        return any(pair.held_fit.escaped for pair in self.held_out(fit.integrator).pairs(fit))

    def _follows(self, fit: Fit) -> bool:
        """Whether a fit leaves little more than the sensors' noise, and holds elsewhere."""
        return not self._escapes(fit) and self._near(fit)

    def _near(self, fit: Fit) -> bool:
        squares, counts = fit.in_sensors()
        return bool((np.sqrt(squares / np.maximum(counts, 1)) < _NEAR).all())

    def _first(
        self, coefficients: Mapping[str, float] | None
    ) -> Iterator[tuple[Callable[[], Mapping[str, float]], bool]]:
        """Yield ways to first coefficients, the quickest first, and whether it is a spare one."""
        if coefficients is not None:
            given = dict(coefficients)
            yield lambda: given, False
        case = (self.structure, self.logs)
        yield lambda: rough(*case, self.kind, self.regime)[0], False
        if self.structure.marine and not PREDICTORS[self.kind].air_measured:
            # columns for a current and a wind, so that they bias the others less
            yield lambda: rough(*case, "augmented", self.regime)[0], False
        yield lambda: steady(self.structure, self.logs, self.regime), True
        yield lambda: careful(*case, self.kind, self.regime), True

    def first(self, logs: Sequence[TrialLog]) -> Mapping[str, float]:
        """Return first coefficients of the structure on logs, by least squares."""
        return rough(self.structure, logs, self.kind, self.regime)[0]

    def as_given(
        self,
        coefficients: Mapping[str, float],
        current: Array,
        integrator: Integrator,
        changes: tuple[Change, ...] = (),
    ) -> Fit | None:
        """Return a model as it is, its starts alone fitted; None where its run has no bound."""
        problem = self.problem(integrator)
        theta = np.array([coefficients.get(n, 0.0) for n in self.universe.parameters])
        starts = tuple(run.start() for run in problem.runs)
        point = Point(Ship(theta, current, self.logs[0].vessel, changes), starts, ())
        errors = problem.errors(point)
        if not all(np.isfinite(e).all() for e in errors):
            return None
        noise = problem.noise_of(errors, point)
        return replace(problem.settle(problem.fit(point, noise), 2), integrator=integrator)

    def _fit(
        self,
        coefficients: Mapping[str, float],
        current: Array,
        changes: tuple[Change, ...],
        integrator: Integrator,
        hypothesis: Hypothesis | None = None,
    ) -> Fit | None:
        problem = self.problem(integrator)
        theta = np.array([coefficients.get(n, 0.0) for n in self.universe.parameters])
        places = tuple(problem.place(n) for n in self.structure.parameters)
        starts = tuple(run.start() for run in problem.runs)
        point = Point(Ship(theta, current, self.logs[0].vessel, changes), starts, places)
        if hypothesis is not None:
            point = problem.add(point, hypothesis)
            starts = tuple(
                np.where([n in point.ship.sensors.reversed for n in run.outputs], -s, s)
                for run, s in zip(problem.runs, starts, strict=True)
            )
            point = replace(point, starts=starts)
        errors = problem.errors(point)
        if not all(np.isfinite(e).all() for e in errors):
            return None
        # errors of a model far off look like a force with a memory, and weigh little as that
        noise = problem.noise_of(errors, point)
        return replace(problem.settle(problem.fit(point, noise), 3), integrator=integrator)

    def refit_from_least_squares(self, fit: Fit) -> Fit:
        """Return the fit from least-squares coefficients, if that ends lower.

        Those of a model that lacked a cause may lie beyond a hill of the likelihood; these
        are of the logs as they would be without what the fit knows of sensors and thrusters.
        """
        own = {self.problem(fit.integrator).place(n) for n in self.structure.parameters}
        if self._near(fit) or not own <= set(fit.point.places):
            return fit
        first, _ = self._least_squares(fit.point)
        found = self._refitted(fit.point, fit.integrator, first)
        return found if found is not None and found.cost < fit.cost - _BETTER else fit

    def other_integrator(self, fit: Fit) -> Fit:
        """Return the fit with the other integrator, if that is likelier."""
        other = next(i for i in INTEGRATORS if i != fit.integrator)
        problem = self.problem(other)
        found = problem.settle(problem.fit(fit.point, fit.noise), 2)
        better = not found.escaped and found.cost < fit.cost - _BETTER
        return replace(found, integrator=other) if better else fit

    def likeliest_variant(self, fit: Fit, hypothesis: Hypothesis) -> Fit:
        """Return the fit with the convention of sampling that the logs ask for."""
        problem = self.problem(fit.integrator)
        for variant in hypothesis.variants:
            hypotheses = tuple(
                variant if a.key == hypothesis.key else a for a in fit.point.hypotheses
            )
            found = problem.settle(
                problem.fit(replace(fit.point, hypotheses=hypotheses), fit.noise), 1
            )
            if not found.escaped and found.cost < fit.cost - _BETTER:
                fit = found
        return fit

    def restart(
        self, fit: Fit, hypotheses: Sequence[Hypothesis], escaped: Sequence[Hypothesis] = ()
    ) -> list[tuple[Hypothesis, Fit]]:
        """Return fits from first coefficients of their own, for hypotheses that need them.

        Only those whose one-step errors by least squares are clearly smaller than
        those of the log as it stands.

        Parameters
        ----------
        fit : Fit
            Without any cause.
        hypotheses : sequence of Hypothesis
            Of which those count that ask for it.
        escaped : sequence of Hypothesis
            With which the run of these coefficients leaves every bound, however likely
            they are with others; the most promising of them are tried.
        """
        asked = [a for a in hypotheses if a.refit_from_scratch]
        moved = [a for a in escaped if a.apply is not None and not a.refit_from_scratch]
        if not asked and not moved:
            return []
        level = rough(self.structure, self.logs, self.kind, self.regime)[1]
        ranked: list[tuple[float, Hypothesis, Mapping[str, float]]] = []
        for hypothesis in (*asked, *moved):
            point = self.problem(fit.integrator).add(fit.point, hypothesis)
            values, own = self._least_squares(point)
            if level - own >= _REWIRED:
                ranked.append((own, hypothesis, values))
        ranked.sort(key=lambda item: item[0])
        worth = [item for item in ranked if item[1].refit_from_scratch]
        worth += [item for item in ranked if not item[1].refit_from_scratch][:_RESCUED]
        out = []
        for _, hypothesis, first in worth:
            base = fit.point.base
            found = [
                self._fit(first, base.current, base.changes, i, hypothesis) for i in INTEGRATORS
            ]
            bounded = [f for f in found if f is not None and not f.escaped]
            if bounded:
                out.append((hypothesis, min(bounded, key=lambda f: f.cost)))
        return out

    def from_far(
        self, fit: Fit, hypotheses: Sequence[Hypothesis], promised: Mapping[str, float]
    ) -> list[tuple[Hypothesis, Fit]]:
        """Return fits from far values of hypotheses, with the coefficients of least squares there.

        Only where these make one-step errors clearly smaller than a refit from near promises.

        Parameters
        ----------
        fit : Fit
            Without any of the hypotheses.
        hypotheses : sequence of Hypothesis
            Of which those count that have far values.
        promised : mapping of str to float
            Fall of −2 log L that each promises from where it is, by key.
        """
        problem, out = self.problem(fit.integrator), []
        asked = [a for a in hypotheses if a.far]
        level = self._least_squares(fit.point)[1] if asked else 0.0
        for hypothesis in asked:
            ways = [problem.add(fit.point, hypothesis, np.array(value)) for value in hypothesis.far]
            found = [self._least_squares(point) for point in ways]
            best = int(np.argmin([own for _, own in found]))
            if level - found[best][1] < max(promised.get(hypothesis.key, 0.0), 0.0) + _REWIRED:
                continue
            begun = self._refitted(ways[best], fit.integrator, found[best][0])
            if begun is not None and not begun.escaped:
                out.append((hypothesis, begun))
        return out

    def _least_squares(self, point: Point) -> tuple[dict[str, float], float]:
        """Return `rough` of the free terms on logs as they would be without what a point knows."""
        free = {self.universe.parameters[i] for i in point.places if i < len(point.base.theta)}
        terms = tuple(t for t in self.universe.terms if t.name in free)
        logs = [_as_it_should_be(log, point.ship) for log in self.logs]
        return rough(replace(self.universe, terms=terms), logs, self.kind, self.regime)

    def _refitted(
        self, point: Point, integrator: Integrator, first: Mapping[str, float]
    ) -> Fit | None:
        """Return the fit from other coefficients; None where their runs leave every bound."""
        problem, base = self.problem(integrator), point.base
        theta = np.array(
            [first.get(n, base.theta[i]) for i, n in enumerate(self.universe.parameters)]
        )
        point = replace(point, base=replace(base, theta=theta))
        errors = problem.errors(point)
        if not all(np.isfinite(e).all() for e in errors):
            return None
        found = problem.settle(problem.fit(point, problem.noise_of(errors, point)), 3)
        return replace(found, integrator=integrator)


def _as_it_should_be(log: TrialLog, ship: Ship) -> TrialLog:
    channels = dict(log.channels)
    channels |= wired({c: log[c] for c in log.vessel.commands}, ship.wires)
    sensors = ship.sensors
    for name in sensors.reversed:
        channels[name] = -log[name]
    for name, seconds in sensors.late:
        channels[name] = shifted(channels[name], -seconds / log.sample_time)
    if "u" in channels and "v" in channels:
        u, v = body_to_ned(channels["u"], channels["v"], sensors.turned)
        channels["u"], channels["v"] = u, v
        if "r" in channels:
            channels["u"] = channels["u"] + sensors.lever[1] * channels["r"]
            channels["v"] = channels["v"] - sensors.lever[0] * channels["r"]
        if ship.current.any():
            # forces are of the motion through the water
            north, east = map(float, ship.current)
            forward, starboard = ned_to_body(north, east, log["psi"])
            channels["u"] = channels["u"] - forward
            channels["v"] = channels["v"] - starboard
    return replace(log, channels=channels, vessel=ship.vessel)


def rough(
    structure: Structure, logs: Sequence[TrialLog], kind: str, regime: Regime
) -> tuple[dict[str, float], float]:
    """Return the coefficients of least squares, and −2 log L of its one-step errors.

    Noise biases them, but they are near enough to begin with; what the logs do not
    move stays at zero.
    """
    predictor = build_predictor(structure.estimable(), kind, regime)
    regression = build_regression(predictor, logs)
    y = np.concatenate([e.y for e in regression.experiments], axis=1)
    phi = np.concatenate([e.phi for e in regression.experiments], axis=1)
    theta = np.zeros(len(predictor.columns))
    level = 0.0
    for i, state in enumerate(structure.states):
        mine = [k for k, c in enumerate(predictor.columns) if c.state == state]
        size = np.sqrt((phi[mine] ** 2).mean(axis=1))
        size[size == 0] = 1.0
        theta[mine] = np.linalg.lstsq((phi[mine] / size[:, None]).T, y[i], rcond=1e-7)[0] / size
        error = y[i] - theta[mine] @ phi[mine]
        level += len(error) * float(np.log(max(float((error**2).mean()), 1e-300)))
    return _coefficients(predictor, theta), level


def steady(structure: Structure, logs: Sequence[TrialLog], regime: Regime) -> dict[str, float]:
    """Return least-squares coefficients of own damping and thrust alone: a run that stays bounded.

    Damping that would drive the ship is set to a little that brakes it.
    """
    own = [
        t for t in structure.terms
        if [f.signal for f in t.factors] == [t.state]
        or (t.factors and all(f.signal in structure.inputs for f in t.factors))
    ]  # fmt: skip
    plain = replace(structure, name="steady", terms=tuple(own))
    if {t.state for t in own} != set(structure.states):
        return {}
    values, _ = rough(plain, logs, "basic", regime)
    damping = {t.name for t in own if t.factors[0].signal == t.state}
    return {n: min(v, -_BRAKE) if n in damping else v for n, v in values.items()}


def careful(
    structure: Structure, logs: Sequence[TrialLog], kind: str, regime: Regime
) -> dict[str, float]:
    """Return coefficients by output error, which finds a way from far off."""
    predictor = output_predictor(structure, kind, regime)
    model = output_model(predictor, logs[0].sample_time)
    data = [measured(model, log) for log in logs]
    fit, _ = fit_free_runs(model, data, np.zeros(len(model.parameters)))
    return _coefficients(predictor, fit.p)


def _coefficients(predictor: Predictor, theta: Array) -> dict[str, float]:
    """Return the coefficients of a predictor's own terms; those of a sum stand for its first."""
    return {
        predictor.columns[i].terms[0]: float(theta[i])
        for i in predictor.parameter_columns
        if np.isfinite(theta[i])
    }
