"""How surely a diagnosis of the next trial would find a cause, and tell it from others.

A cause moves the free run of the model by its sensitivity. What the coefficients, the start and
the other open causes can imitate is projected out; the squared rest, in the noise of the errors,
is the noncentrality λ of the tests that the diagnosis rules by. It is an upper bound of what ships
outside the model's family give, whose misfit no test of this room knows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2, norm

from experiment_design.excitation.rollout import Motion, Rollout
from greybox.diagnosis.fitting import groups_of
from greybox.diagnosis.hypothesis import Hypothesis
from greybox.diagnosis.linear import NOWHERE
from greybox.diagnosis.noise import Noise, assumed_noise
from greybox.diagnosis.ship import CURRENTS, LogRun, Ship
from greybox.diagnosis.thresholds import GUST, PROVEN
from greybox.errors import InfeasibleError
from greybox.model.noise import NoiseLevels
from greybox.numerics.linalg import scaled_inverse, tall_svd
from greybox.rotation import ned_to_body
from greybox.trial.log import make_log

Array = NDArray[np.float64]

# power that a trial is designed for: where it is reached, the value of a sequence is zero
WANTED = 0.9
# share of a direction that must be left when what imitates it is taken out
_OWN = 1e-6
# singular values below this share of the largest tell nothing
_ALIKE = 1e-8
# share of the spread of the motion that a cause of unknown size is taken to move a free run by
TYPICAL = 0.05
# deviation of a compass of which nothing is stated [rad]
_COMPASS = 0.01


@dataclass(frozen=True)
class OpenCause:
    """A cause that a diagnosis left open, with the size that it is expected to have.

    Parameters
    ----------
    hypothesis : Hypothesis
    size : ndarray
        (m,) distance of each tested parameter from its null value.
    estimated : bool
        Whether the sizes are estimates; else each is a typical size, its sign unknown.
    """

    hypothesis: Hypothesis
    size: Array
    estimated: bool

    @property
    def id(self) -> str:
        """As the diagnosis names it."""
        return self.hypothesis.id

    @property
    def tested(self) -> tuple[int, ...]:
        """Positions of the parameters that have a null value to be tested against."""
        return tuple(i for i, p in enumerate(self.hypothesis.parameters) if not p.reach)

    def step(self, k: int) -> float:
        """Return a small distance from the null of a tested parameter, to where it may be."""
        if not self.tested:
            return 0.0
        p = self.hypothesis.parameters[self.tested[k]]
        return -p.step if p.high <= p.null else p.step

    @property
    def columns(self) -> int:
        """Degrees of freedom of the test; a cause without parameters is there or not."""
        return max(len(self.tested), 1)


@dataclass(frozen=True)
class PowerReport:
    """How well one sequence would separate the open causes.

    Parameters
    ----------
    noncentrality : ndarray
        (m,) of each cause, all other open causes projected out.
    power : ndarray
        (m,)
    detectable_share : ndarray
        (m,) of its expected size, at which a cause is found with the wanted power; inf where no
        size is enough.
    pairs : ndarray
        (m, m) power of cause i with cause j alone projected out, the smaller of both ways.
    """

    noncentrality: Array
    power: Array
    detectable_share: Array
    pairs: Array


class CausePower:
    """The power of a diagnosis, as a function of a motion.

    Parameters
    ----------
    rollout : Rollout
        The prior model.
    causes : sequence of OpenCause
    noise : NoiseLevels
    level : float
        Significance that a cause must have, before correction for those that are tried.
    tried : int
        Hypotheses that the diagnosis corrects for.
    """

    def __init__(
        self,
        rollout: Rollout,
        causes: Sequence[OpenCause],
        noise: NoiseLevels,
        level: float,
        tried: int,
    ) -> None:
        self.rollout, self.causes, self.level = rollout, tuple(causes), level / max(tried, 1)
        names = dict.fromkeys(n for c in causes for n in c.hypothesis.columns)
        has = rollout.structure.parameters
        self._own = tuple(n for n in has if n not in names)
        more = [n for n in names if n not in has and n not in CURRENTS]
        self._universe = rollout.structure.with_terms(*more)
        theta = np.concatenate([rollout.theta, np.zeros(len(more))])
        self._ship = Ship(theta, np.asarray(rollout.d[:2], float), rollout.vessel)
        self._levels = noise
        self._colours: tuple[Noise, ...] = ()
        self._needed = np.array([self._noncentrality_for(c.columns) for c in causes])

    def with_typical_sizes(self, motion: Motion) -> CausePower:
        """Return the same with a size for each cause that has no estimate.

        It is where the search of a diagnosis begins, or where that is the null value what moves
        the free run along the first of the motions by a twentieth of its spread.
        """
        run, start = self._run(motion)
        null = run.run(self._ship, start).y
        count = len(run.states)
        spread = np.maximum(run.y[:, :count].std(axis=0), 1e-12)
        out = []
        for cause in self.causes:
            size = cause.size.copy()
            for k, i in enumerate(() if cause.estimated else cause.tested):
                p = cause.hypothesis.parameters[i]
                size[k] = p.start - p.null
                if not size[k]:
                    step = cause.step(k)
                    away = run.run(self._moved(cause, k, step), start).y - null
                    share = np.sqrt(((away[:, :count] / spread) ** 2).mean(axis=0)).max()
                    size[k] = step * (TYPICAL / share if np.isfinite(share) and share > 0 else 1.0)
            out.append(replace(cause, size=size))
        return CausePower(self.rollout, out, self._levels, self.level, 1)

    def values(self, motion: Motion) -> Array:
        """Return the value of R motions, (R,); −inf where one is unstable or tells nothing.

        It is the least logarithm of the noncentralities over those of the wanted power, which
        grows with the least power and goes on growing where that is all but one.
        """
        out = np.full(len(motion.state), -np.inf)
        for r in np.flatnonzero(motion.stable):
            grams = self._grams(motion, int(r))
            if grams is not None:
                out[r] = self._value(self._noncentralities(grams))
        return out

    def report(self, motion: Motion) -> PowerReport:
        """Return what the first of the motions would tell."""
        grams = self._grams(motion, 0)
        if grams is None:
            raise InfeasibleError(
                "the model runs away where an open cause is as large as it was estimated, so no "
                "trial can be designed for it: give a model that was estimated with it."
            )
        found = self._noncentralities(grams)
        m = len(self.causes)
        columns = [c.columns for c in self.causes]
        pairs = np.ones((m, m))
        for i in range(m):
            for j in range(m):
                if i != j:
                    left = self._noncentrality(grams, i, [j])
                    pairs[i, j] = self._power(left, columns[i])
        power = np.array([self._power(v, n) for v, n in zip(found, columns, strict=True)])
        with np.errstate(divide="ignore"):
            share = np.sqrt(self._needed / found)
        return PowerReport(found, power, share, np.minimum(pairs, pairs.T))

    def _value(self, noncentralities: Array) -> float:
        with np.errstate(divide="ignore"):
            return float(np.log(noncentralities / self._needed).min())

    def _power(self, noncentrality: float, columns: int) -> float:
        """Return the probability that a cause passes the harder of the diagnosis's two tests.

        Its numbers must be significant (chi-square), and the fall of −2 log L of held-out parts
        must exceed its own standard error: of expectation λ it has the variance 4 λ.
        """
        significant = self.level
        if noncentrality > 0:
            limit = chi2.isf(self.level, columns)
            significant = float(ncx2.sf(limit, columns, noncentrality))
        proven = float(norm.sf(norm.isf(PROVEN) - np.sqrt(noncentrality) / 2))
        return min(significant, proven)

    def _noncentrality_for(self, columns: int) -> float:
        return float(brentq(lambda v: self._power(v, columns) - WANTED, 1e-3, 1e3))

    def _noncentralities(self, grams: Sequence[Array]) -> Array:
        every = range(len(self.causes))
        return np.array(
            [self._noncentrality(grams, i, [j for j in every if j != i]) for i in every]
        )

    @cached_property
    def _places(self) -> list[NDArray[np.intp]]:
        """Columns of each cause."""
        ends = np.cumsum([c.columns for c in self.causes])
        return [np.arange(e - c.columns, e) for e, c in zip(ends, self.causes, strict=True)]

    def _noncentrality(self, grams: Sequence[Array], i: int, others: Sequence[int]) -> float:
        """Return that of one cause with others projected out, of the colour that leaves least."""
        return min(self._of_colour(gram, i, others) for gram in grams)

    def _of_colour(self, gram: Array, i: int, others: Sequence[int]) -> float:
        mine, cause = self._places[i], self.causes[i]
        own = left = gram[np.ix_(mine, mine)]
        if others:
            # Schur complement
            out = np.concatenate([self._places[j] for j in others])
            across = gram[np.ix_(mine, out)]
            left = own - across @ scaled_inverse(gram[np.ix_(out, out)], _ALIKE) @ across.T
        if cause.estimated:
            away = np.where(cause.size != 0, 1.0, 0.0) if len(cause.size) else np.ones(1)
            found, before = float(away @ left @ away), float(away @ own @ away)
        else:
            # of unknown direction: the mean over all
            found, before = float(np.trace(left)) / len(mine), float(np.trace(own)) / len(mine)
        return found if found > _OWN * before else 0.0

    def _grams(self, motion: Motion, r: int) -> list[Array] | None:
        """Return products of all causes' whitened sensitivities, coefficients and start taken out.

        (m, m) for each colour, in units of the expected sizes; None where a run escapes.
        """
        run, start = self._run(motion, r)
        shown = run.run(self._ship, start)
        if not np.isfinite(shown.y).all():
            return None
        places = np.array([self._universe.index(n) for n in self._own])
        with np.errstate(over="ignore", invalid="ignore"):
            nuisance = run.columns(self._ship, shown, places)
        moved = []
        for cause in self.causes:
            for k in range(cause.columns):
                size = float(cause.size[k]) if len(cause.size) else 0.0
                # what is estimated to be zero is still no part of the other causes
                size = size or cause.step(k)
                moved.append(run.run(self._moved(cause, k, size), start).y - shown.y)
        columns = np.stack(moved, axis=2)
        if not (np.isfinite(columns).all() and np.isfinite(nuisance).all()):
            return None
        return [_cleared_products(c, nuisance, columns) for c in self._noises(motion)]

    def _moved(self, cause: OpenCause, k: int, size: float) -> Ship:
        """Return the ship with one tested parameter of a cause away from its null."""
        hypothesis = cause.hypothesis
        if hypothesis.apply is None:
            place = (*self._universe.parameters, *CURRENTS).index(hypothesis.columns[k])
            both = np.concatenate([self._ship.theta, self._ship.current])
            return self._ship.with_value(place, both[place] + size)
        value = np.array([p.start if p.reach else p.null for p in hypothesis.parameters], float)
        if len(value):
            value[cause.tested[k]] += size
        return hypothesis.apply(self._ship, value)

    def _run(self, motion: Motion, r: int = 0) -> tuple[LogRun, Array]:
        nx = self.rollout.nx
        state = motion.state[r, :-1]
        names = self.rollout.structure.states
        channels = dict(zip(names, state[:, :nx].T, strict=True)) | {"psi": state[:, nx]}
        channels |= dict(zip(self.rollout.vessel.commands, motion.commands[r].T, strict=True))
        if self._universe.uses_air:
            wind = np.asarray(self.rollout.d[2:4], float)
            across = ned_to_body(wind[0], wind[1], state[:, nx])
            channels["u_q"] = channels["u"] - across[0]
            channels["v_q"] = channels.get("v", 0.0) - across[1]
        log = make_log(self.rollout.vessel, channels, self.rollout.sample_time, "plan")
        run = LogRun(self._universe, log, self.rollout.integrator)
        return run, state[0, : len(run.outputs)]

    def _noises(self, motion: Motion) -> tuple[Noise, ...]:
        """Return the colours that errors may have, from the first motion that is asked for.

        What moves a ship beside her model is forgotten at once, or as late as gusts are: a
        diagnosis finds the memory in the errors, and takes for it what a slow cause does.
        """
        if not self._colours:
            run, start = self._run(motion)
            shown = run.run(self._ship, start)
            nx, dt = self.rollout.nx, self.rollout.sample_time
            poles = np.ones(len(run.outputs))
            poles[:nx] = np.diag(run.linearise(self._ship, shown, NOWHERE).a.mean(axis=0))
            compass = [self._levels.heading or _COMPASS] * (len(run.outputs) - nx)
            sensor = np.array([*self._levels.measurement, *compass])
            process = np.array([*self._levels.process, *[0.0] * len(compass)])
            self._colours = tuple(
                assumed_noise(sensor, process, poles, dt, groups_of(run), memory)
                for memory in (0.0, float(np.exp(-dt / GUST)))
            )
        return self._colours


def _cleared_products(noise: Noise, nuisance: Array, columns: Array) -> Array:
    """Return products (m, m) of whitened columns (N, ny, m) with the nuisance taken out."""
    known, rows = (noise.whiten(c).reshape(-1, c.shape[2]) for c in (nuisance, columns))
    scale = np.sqrt((known**2).sum(axis=0))
    scale[scale == 0] = 1.0
    basis = tall_svd(known / scale, _ALIKE)[0]
    clear = rows - basis @ (basis.T @ rows)
    clear[:, (clear**2).sum(axis=0) <= _OWN * (rows**2).sum(axis=0)] = 0.0
    return np.asarray(clear.T @ clear)
