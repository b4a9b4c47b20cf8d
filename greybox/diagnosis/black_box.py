"""The black-box part of an extended model: a smooth force that no term of the structure describes.

In each equation it is a sum of bumps of the signals that the equation's own terms see: the
velocities through the water, the yaw rate, and the thrusters' forces. Each is a product over
these signals of (1 − ((s − centre)/width)²)², so all of it is zero where one of them is far from
what it was in the estimation logs. The coefficients of the bumps are ordinary parameters with a
normal prior about zero, whose deviation the marginal likelihood of the estimation logs gives in
each equation, zero included. The model's other coefficients stay as they were: outside the range of
the logs the model is what it was without this force.

References
----------
MacKay (1992), section 4, on the evidence; Rasmussen and Williams (2006), section 8.3.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.builder import held_runs
from greybox.diagnosis.evidence.features import through_water
from greybox.diagnosis.evidence.held_out import Pair
from greybox.diagnosis.extension import noise_levels, one_step_deviations
from greybox.diagnosis.fitting import Problem, stacked
from greybox.diagnosis.null_model import DiagnosisProblem, runs_on
from greybox.diagnosis.point import Fit, Point
from greybox.diagnosis.result import Diagnosis, Remainder
from greybox.diagnosis.ship import LogRun
from greybox.model.model import ManoeuvringModel
from greybox.model.structure import Structure
from greybox.model.terms import EQUATIONS, Factor, Term
from greybox.numerics.lagged_moments import correlation_factor
from greybox.trial.log import TrialLog
from greybox.validation.bands import joint_covariance
from greybox.validation.gain import Gain, gains

Array = NDArray[np.float64]

# bumps of an equation
_BUMPS = 24
# of a signal's range in the logs: least width of a bump, and over how much beyond the range all
# of them vanish
_WIDTH, _BEYOND = 1.0, 0.25
# prior deviations of an equation's bumps, in those whose joint effect has the size of the
# innovations, that are tried
_STRENGTHS = np.concatenate([[0.0], np.geomspace(0.01, 30.0, 18)])
# samples that the errors' noise remembers at most: a longer memory passes for what is missing
_MEMORY = 10.0
# times that the run is linearised anew, and halvings of a step that does not help
_ROUNDS, _HALVINGS = 8, 6
# fall of the squared held-out errors from which on bumps are worth their numbers
_LEAST = 0.05
# points of the fit (6.12) by which a state may surely lose
_TRIFLE = 0.5
# rounds over the equations' strengths
_SWEEPS = 4
_LETTERS = {state: letter for letter, state in EQUATIONS.items()}


def bump_terms(problem: Problem, fit: Fit, seed: int) -> tuple[Term, ...]:
    """Return the bumps of each equation, about centres of what the estimation logs show.

    Parameters
    ----------
    problem : Problem
        Of the estimation logs.
    fit : Fit
        Along whose free runs the signals are taken.
    seed : int
        Of the centres.
    """
    ship = fit.point.ship
    parts = []
    for run, start in zip(problem.runs, fit.point.starts, strict=True):
        x = through_water(run, fit, run.run(ship, start).x)
        parts.append(np.column_stack([x, run.forces(ship.vessel, ship.wires)]))
    seen = np.concatenate(parts)
    structure = problem.structure
    names = (*structure.states, *structure.inputs)
    terms: list[Term] = []
    for state in structure.states:
        used = {
            f.signal
            for t, value in zip(structure.terms, ship.theta, strict=True)
            if t.state == state and value != 0
            for f in t.factors
        }
        at = [i for i, n in enumerate(names) if n in structure.states or n in used]
        at = [i for i in at if np.ptp(seen[:, i]) > 1e-9 * (np.abs(seen[:, i]).max() + 1e-300)]
        values = seen[:, at]
        low, high = values.min(axis=0), values.max(axis=0)
        window = tuple(
            Factor(names[i], centre=c, width=w, flat=f)
            for i, c, w, f in zip(
                at, _rounded((low + high) / 2), _rounded(_BEYOND * (high - low)),
                _rounded((high - low) / 2), strict=True,
            )
        )  # fmt: skip
        for k, centre in enumerate(_centres(values, seed)):
            # about the middle of a range wide, at its ends narrower
            width = np.minimum(centre - low, high - centre) + _WIDTH * (high - low)
            near = tuple(
                Factor(names[i], centre=c, width=w)
                for i, c, w in zip(at, _rounded(centre), _rounded(width), strict=True)
            )
            terms.append(Term(f"{_LETTERS.get(state, state)}_g{k + 1}", state, (*near, *window)))
    return tuple(terms)


def _rounded(values: Array) -> list[float]:
    return [float(f"{v:.6g}") for v in values]


def _centres(values: Array, seed: int) -> Array:
    """Return at most `_BUMPS` means of clusters of values (N, d), each signal by its deviation."""
    from scipy.cluster.vq import kmeans2

    spread = values.std(axis=0)
    # clusters that lose their last member keep their place
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found, member = kmeans2(values / spread, _BUMPS, minit="++", seed=seed)
    return np.asarray(found[np.unique(member)] * spread)


def with_remainder(
    case: DiagnosisProblem, fit: Fit, told: Diagnosis, validate: Sequence[TrialLog], seed: int
) -> Diagnosis:
    """Return a diagnosis with a force of bumps beside its extended model.

    The estimation logs alone choose where the bumps are and how large; held-out free runs only
    say whether they stay.

    Parameters
    ----------
    case : DiagnosisProblem
    fit : Fit
        Which the extended model is.
    told : Diagnosis
    validate : sequence of TrialLog
        Parts of the estimation logs are held out in turn where there is none.
    seed : int
    """
    problem = case.problem(fit.integrator)
    states = problem.structure.states
    empty = Remainder(False, dict.fromkeys(states, 0), {}, {}, told.validated_on, "")
    if fit.escaped:
        reason = "No force without a name is added: the free run leaves every bound without it."
        return replace(told, remainder=replace(empty, reason=reason))
    terms = bump_terms(problem, fit, seed)
    wide = wider(case, terms)
    made = fit_black_box(wide.problem(fit.integrator), wide.carried(fit), terms)
    size = {t.state: float(d) for t, d in zip(terms, made.deviation, strict=True)}
    found = replace(
        empty,
        terms={s: sum(t.state == s for t in terms) if size.get(s) else 0 for s in states},
        deviation=size,
    )
    if not made.deviation.any():
        reason = "No force without a name is added: the estimation logs ask for none."
        return replace(told, remainder=replace(found, reason=reason))
    model = extended_by(told.model, terms, made)
    if validate:
        one, two = runs_on(told.model, validate), runs_on(model, validate)
    else:
        pairs = case.held_out(fit.integrator).pairs(fit)
        one, two = held_runs(pairs), held_runs([_beside(wide, p, terms) for p in pairs])
    found = replace(found, gain=gains(one, two, problem.sample_time, seed))
    fall = 1 - float(np.exp(2 * np.mean([_log_ratio(g) for g in found.gain.values()])))
    surely = any(g.ci[0] > 0 for g in found.gain.values())
    found = replace(found, added=fall > _LEAST and surely and not _worse(found))
    found = replace(found, reason=_reason(found, fall))
    record = {**model.record, "remainder": found.to_dict()}
    return replace(
        told, remainder=found, model=replace(model, record=record) if found.added else told.model
    )


def _log_ratio(gain: Gain) -> float:
    """Return the logarithm of the ratio of root mean squared errors, with over without."""
    one, two = (max(100 - fit, 1e-6) for fit in (gain.before, gain.after))
    return float(np.log(two / one))


def _worse(found: Remainder) -> list[str]:
    """Return the states whose held-out fit surely falls, by more than a trifle."""
    return [s for s, g in found.gain.items() if g.ci[1] < -_TRIFLE]


def _reason(found: Remainder, fall: float) -> str:
    where = ", ".join(f"{n} in {s}" for s, n in found.terms.items() if n)
    what = f"A smooth force without a name (bumps: {where})"
    if found.added:
        return (
            f"{what} is in the model: the squared errors of held-out free runs fall by "
            f"{100 * fall:.0f} % with it (mean of the states)."
        )
    if fall > _LEAST and _worse(found):
        return (
            f"{what} is not added: the squared errors of held-out free runs fall by "
            f"{100 * fall:.0f} % with it (mean of the states), but {', '.join(_worse(found))} "
            f"would be worse."
        )
    if fall > _LEAST:
        return f"{what} is not added: it improves the held-out free run of no state significantly."
    how = f"fall by {100 * fall:.2g} %" if fall > 0 else f"grow by {-100 * fall:.2g} %"
    return (
        f"{what} is not added: the squared errors of held-out free runs {how} with it (mean of "
        f"the states; at least {100 * _LEAST:.0f} % less are asked for)."
    )


def _beside(wide: DiagnosisProblem, pair: Pair, terms: Sequence[Term]) -> Pair:
    """Return what a fit to a part of the logs does for the rest with bumps of its own."""
    fitting, held = (_wider(p, wide.universe) for p in (pair.problem, pair.held))
    made = fit_black_box(fitting, wide.carried(pair.fit), terms)
    after = held.fit_starts(made.fit.point, pair.held_fit.noise)
    return Pair(fitting, made.fit, held, after)


def wider(case: DiagnosisProblem, terms: Sequence[Term]) -> DiagnosisProblem:
    """Return a case with bumps among the terms of its universe."""
    return DiagnosisProblem(
        case.structure, case.universe.with_terms(*terms), case.logs, case.held_out_logs,
        case.kind, case.regime, case.metric, case.clocks,
    )  # fmt: skip


def _wider(problem: Problem, structure: Structure) -> Problem:
    """Return the logs ready to be explained by a structure with more terms."""
    runs = [
        LogRun(structure, r.log, r.integrator, float(r.log.t[0] - r.time[0]), r.duration)
        for r in problem.runs
    ]
    return Problem(runs, problem.metric)


def extended_by(model: ManoeuvringModel, terms: Sequence[Term], made: BlackBox) -> ManoeuvringModel:
    """Return a model with the bumps of the equations that ask for any.

    Its other numbers stay as they are; the covariance knows how the bumps would follow them.
    """
    kept = np.flatnonzero(made.deviation).tolist()
    structure = replace(model.structure, name=f"{model.structure.name}+g")
    p, known = len(model.theta), list(model.disturbances)
    spread = joint_covariance(model)
    shared = [i for i, n in enumerate([*model.names, *known]) if n in made.problem.names]
    follow = np.zeros((len(kept), p + len(known)))
    follow[:, shared] = made.follow([[*model.names, *known][i] for i in shared])[kept]
    lift = np.vstack([np.eye(p + len(known)), follow])
    full = lift @ spread @ lift.T
    full[p + len(known) :, p + len(known) :] += made.posterior[np.ix_(kept, kept)]
    # the means of disturbances stand behind all parameters
    order = np.r_[0:p, p + len(known) : len(full), p : p + len(known)]
    full = full[np.ix_(order, order)]
    full = (full + full.T) / 2
    m = p + len(kept)
    white = made.problem.forgetful(made.fit, np.inf)
    return replace(
        model,
        structure=structure.with_terms(*(terms[k] for k in kept)),
        theta=np.append(model.theta, made.values[kept]),
        covariance=full[:m, :m],
        disturbance_covariance=full[:, m:] if known else np.zeros((0, 0)),
        residual_std=one_step_deviations(made.problem, white),
        noise=noise_levels(made.problem, white),
    )


@dataclass(frozen=True)
class BlackBox:
    """A force of bumps fitted beside a model.

    Parameters
    ----------
    problem : Problem
        With the bumps among its terms.
    fit : Fit
        Free in the bumps and the starts alone.
    deviation : ndarray
        (m,) prior deviation of each bump's coefficient [unit of the state], zero where the logs
        ask for no bumps in its equation.
    posterior : ndarray
        (m, m) covariance of the bumps, the model's other numbers given.
    """

    problem: Problem
    fit: Fit
    deviation: Array
    posterior: Array

    @property
    def values(self) -> Array:
        """Coefficients of the bumps, (m,)."""
        return self.fit.point.vector()[: len(self.deviation)]

    def follow(self, others: Sequence[str]) -> Array:
        """Return by how much the bumps move if other numbers do, (m, q).

        Parameters
        ----------
        others : sequence of str
            Coefficients and currents: what they are wrong by, the bumps make up for.
        """
        places = tuple(self.problem.place(n) for n in others)
        line = _linearised(self.problem, replace(self.fit, point=_free(self.fit.point, places)))
        mine = _linearised(self.problem, self.fit)
        if line is None or mine is None:
            return np.zeros((len(self.deviation), len(places)))
        return -self.posterior @ mine.across.T @ line.across


def fit_black_box(problem: Problem, fit: Fit, terms: Sequence[Term]) -> BlackBox:
    """Fit bumps to the free runs of logs; nothing else is free but the starts.

    Parameters
    ----------
    problem : Problem
        Whose structure holds `terms`.
    fit : Fit
        Of the model without them: their coefficients are zero there.
    terms : sequence of Term
    """
    # what hypotheses made of the ship is fixed
    point = replace(fit.point, base=fit.point.ship, hypotheses=(), values=())
    point = _free(point, tuple(problem.place(t.name) for t in terms))
    fit = problem.forgetful(replace(fit, point=point), _MEMORY)
    equations = [[k for k, t in enumerate(terms) if t.state == s] for s in problem.structure.states]
    m = len(terms)
    best = BlackBox(problem, fit, np.zeros(m), np.zeros((m, m)))
    for _ in range(_ROUNDS):
        line = _linearised(problem, fit)
        if line is None:
            break
        now = fit.point.vector()
        deviation = _deviations(line, now[:m], equations)
        wanted, posterior = _ridge(line, now[:m], deviation)
        step = np.concatenate([wanted - now[:m], line.starts(wanted - now[:m])])
        better = _stepped(problem, fit, step, deviation, line.alike)
        if better is None:
            break
        fit = problem.forgetful(better, _MEMORY)
        if _missed(problem, fit) >= _missed(problem, best.fit):
            # likelier by a colour that gives one state away for another
            break
        best = BlackBox(problem, fit, deviation, posterior)
    return best


def _missed(problem: Problem, fit: Fit) -> float:
    """Return the mean logarithm of the states' squared errors."""
    states = slice(len(problem.structure.states))
    mean = problem.squares(fit.errors)[states] / problem.counts[states]
    return float(np.log(np.maximum(mean, 1e-300)).mean())


def _free(point: Point, places: tuple[int, ...]) -> Point:
    return replace(point, places=places)


@dataclass(frozen=True)
class _Linear:
    """Free runs to first order.

    Parameters
    ----------
    own, begun : ndarray
        (n, m) and (n, s) whitened derivatives in the numbers and in the starts.
    seen : ndarray
        (n,) innovations.
    across : ndarray
        (n, m) the first without what the starts can imitate, over `alike`.
    left : ndarray
        (n,) the innovations, likewise.
    alike : float
        The square root of how many innovations tell as much as one without a memory would.
    """

    own: Array
    begun: Array
    seen: Array
    across: Array
    left: Array
    alike: float

    def starts(self, moved: Array) -> Array:
        """Return by how much the starts move if the numbers do (m,)."""
        left = self.seen - self.own @ moved
        return np.asarray(np.linalg.lstsq(self.begun, left, rcond=1e-8)[0])


def _linearised(problem: Problem, fit: Fit) -> _Linear | None:
    """Return the free runs to first order; None at the edge of stability."""
    rows = stacked(problem.rows(fit.point, fit.noise))
    if not np.isfinite(rows).all():
        return None
    own, begun = np.split(rows, [len(fit.point.places)], axis=1)
    seen = stacked(fit.nu)
    alike = float(np.sqrt(correlation_factor(np.concatenate(fit.nu))))
    basis = np.linalg.qr(begun)[0]
    return _Linear(
        own, begun, seen, (own - basis @ (basis.T @ own)) / alike,
        (seen - basis @ (basis.T @ seen)) / alike, alike,
    )  # fmt: skip


def _deviations(line: _Linear, now: Array, equations: Sequence[Sequence[int]]) -> Array:
    """Return the prior deviations (m,) that make the innovations likeliest, one an equation."""
    target = line.left + line.across @ now
    normal, moved = line.across.T @ line.across, line.across.T @ target
    size = np.zeros(len(now))
    for mine in equations:
        trace = float(np.diag(normal)[mine].sum())
        size[mine] = 1.0 / np.sqrt(trace / len(target)) if trace > 0 else 0.0
    tried = np.ones(len(now))

    def cost(strength: Array) -> float:
        """Return −2 log of the marginal likelihood, constants apart."""
        d = strength * size
        grown = np.eye(len(d)) + d[:, None] * normal * d
        root = np.linalg.cholesky(grown)
        share = np.linalg.solve(root, d * moved)
        return float(2 * np.log(np.diag(root)).sum() - share @ share)

    for _ in range(_SWEEPS):
        before = tried.copy()
        for mine in equations:
            if mine:
                costs = []
                for strength in _STRENGTHS:
                    tried[mine] = strength
                    costs.append(cost(tried))
                tried[mine] = _STRENGTHS[int(np.argmin(costs))]
        if np.array_equal(before, tried):
            break
    return tried * size


def _ridge(line: _Linear, now: Array, deviation: Array) -> tuple[Array, Array]:
    """Return the numbers (m,) of largest posterior density, and their covariance (m, m)."""
    normal = line.across.T @ line.across
    moved = line.across.T @ (line.left + line.across @ now)
    grown = np.eye(len(now)) + deviation[:, None] * normal * deviation
    covariance = deviation[:, None] * np.linalg.inv(grown) * deviation
    covariance = (covariance + covariance.T) / 2
    return covariance @ moved, covariance


def _stepped(problem: Problem, fit: Fit, step: Array, deviation: Array, alike: float) -> Fit | None:
    """Return the fit a step on, or a part of it; None where no part of it helps."""
    m = len(deviation)

    def density(point: Point, cost: float) -> float:
        used = deviation > 0
        return cost / alike**2 + float(((point.vector()[:m][used] / deviation[used]) ** 2).sum())

    least = density(fit.point, fit.cost)
    for k in range(_HALVINGS):
        point = fit.point.at(fit.point.vector() + step / 2**k)
        errors = problem.errors(point)
        nu, cost = problem.whitened(fit.noise, errors)
        if density(point, cost) < least:
            return replace(fit, point=point, errors=tuple(errors), nu=tuple(nu), cost=cost)
    return None
