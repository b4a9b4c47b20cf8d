"""How much of what a log tells each estimator uses: Monte Carlo against the bounds.

total = (IV against the best instruments) × (the best instruments against the
Cramér-Rao bound), for each parameter and by determinant, with the share of 95 %
intervals that hold the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import polygamma, psi

from greybox.errors import GreyboxError
from greybox.estimation.bound import iv_bound
from greybox.estimation.efficiency_bounds import cramer_rao, noise_variances
from greybox.estimation.output_error import OutputErrorOptions, estimate_oe
from greybox.estimation.output_setup import measured, output_model, output_predictor
from greybox.estimation.refined import estimate_refined_iv
from greybox.estimation.result import Estimate
from greybox.model.catalogue import get_structure
from greybox.model.noise import NoiseLevels
from greybox.model.predictor import Predictor, Regime, build_predictor
from greybox.model.run.simulation import simulate, stationary_disturbance
from greybox.numerics.linalg import scaled_logdet
from greybox.numerics.parallel import map_pieces
from greybox.rotation import ned_to_body
from greybox.selection.fit_single import estimate_iv
from greybox.study.chapter6 import TRUE, pulse_commands
from greybox.study.tables import Row
from greybox.trial.log import TrialLog, make_log
from greybox.vessel.toml import load_vessel

Array = NDArray[np.float64]

SAMPLES = 2000
# (6.2a-d)
SENSOR_VARIANCE, HEADING_VARIANCE = 2e-4, 1e-4
CURRENT, WIND = (0.2, -0.2), (1.0, 1.0)
# standard deviation and memory of the measured gusts [m/s, s]
GUST, GUST_MEMORY = 1.0, 20.0
_START = np.array([1.5, 1.2, 0.0])
_REGIME: Regime = (("u", (1,)), ("v", (1,)), ("r", (1, -1)))
_GUSTS, _PIECE = 6, 5
# for a covariance of 18 parameters to have a determinant
LEAST_RUNS = 24


@dataclass(frozen=True)
class Case:
    """One set of runs: its name, process noise a step (3,), and the estimators."""

    name: str
    process: tuple[float, float, float]
    estimators: tuple[str, ...]


CASES = (
    Case("no process noise", (0.0, 0.0, 0.0), ("IV", "refined IV", "OE")),
    Case("process noise", (2e-3, 2e-3, 2e-4), ("IV", "refined IV", "innovations")),
)


@dataclass(frozen=True)
class Share:
    """An efficiency with its 95 % interval; 1 is the bound."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, log: float, half: float) -> Share:
        """Return it from its logarithm and half of the interval of that."""
        return cls(*(float(np.exp(v)) for v in (log, log - half, log + half)))


@dataclass(frozen=True)
class CaseResult:
    """Estimates of all runs of a case, and its bounds.

    Parameters
    ----------
    case : Case
    names : tuple of str
        (p,)
    true : ndarray
        (p,)
    cramer_rao, optimal_iv : ndarray
        (p, p)
    theta, std : dict of str to ndarray
        Estimator -> (R, p); rows of failed runs hold no number.
    """

    case: Case
    names: tuple[str, ...]
    true: Array
    cramer_rao: Array
    optimal_iv: Array
    theta: Mapping[str, Array]
    std: Mapping[str, Array]

    def errors(self, estimator: str) -> Array:
        """Return the errors of the runs that did not fail, (R', p)."""
        theta = self.theta[estimator]
        return np.asarray(theta[np.isfinite(theta).all(axis=1)] - self.true)

    def determinant(self, estimator: str, bound: Array) -> Share:
        """Return (det bound / det C)^(1/p), corrected for the number of runs."""
        return determinant_efficiency(self.errors(estimator), bound)

    def parameter(self, estimator: str, bound: Array) -> list[Share]:
        """Return bound over variance, parameter by parameter."""
        errors = self.errors(estimator)
        n = len(errors) - 1
        spread = 1.96 * np.sqrt(float(polygamma(1, n / 2)))
        # E log χ²_n = ψ(n/2) + log 2
        level = np.log(errors.var(axis=0, ddof=1)) - float(psi(n / 2)) - np.log(2 / n)
        return [Share.of(v, spread) for v in np.log(np.diag(bound)) - level]

    def coverage(self, estimator: str) -> Array:
        """Return the share of 95 % intervals that hold the truth, (p,)."""
        theta = self.theta[estimator]
        good = np.isfinite(theta).all(axis=1)
        inside = np.abs(theta - self.true) <= 1.96 * self.std[estimator]
        return np.asarray(inside[good].mean(axis=0))

    def loss(self) -> tuple[float, list[float]]:
        """Return what the best instruments reach of the Cramér-Rao bound."""
        p = len(self.names)
        first, second = scaled_logdet(np.array([self.cramer_rao, self.optimal_iv]))
        single = np.diag(self.cramer_rao) / np.diag(self.optimal_iv)
        return float(np.exp((first - second) / p)), [float(v) for v in single]


@dataclass(frozen=True)
class Efficiency:
    """The study: `runs` asked for, and the cases."""

    runs: int
    cases: tuple[CaseResult, ...]

    def rows(self) -> list[Row]:
        """Return errors in units of the Cramér-Rao standard deviation."""
        out = []
        for result in self.cases:
            scale = np.sqrt(np.diag(result.cramer_rao))
            for estimator in result.case.estimators:
                errors = result.errors(estimator) / scale
                out += [
                    Row.of("efficiency", result.case.name, estimator, name, errors[:, i])
                    for i, name in enumerate(result.names)
                ]
        return out


def determinant_efficiency(errors: Array, bound: Array) -> Share:
    """Return (det bound / det C)^(1/p) from a sample of errors.

    Parameters
    ----------
    errors : ndarray
        (R, p), R > p + 1.
    bound : ndarray
        (p, p)

    Returns
    -------
    Share
        The logarithm of a sample determinant is biased and spread as sums of
        log χ² with falling degrees of freedom; both are accounted for.

    References
    ----------
    Anderson (2003), theorem 7.5.3.
    """
    runs, p = errors.shape
    n = runs - 1
    found = float(scaled_logdet(np.cov(errors.T).reshape(p, p)))
    half = (n - np.arange(p)) / 2
    found -= float(psi(half).sum()) + p * np.log(2 / n)
    spread = 1.96 * np.sqrt(float(polygamma(1, half).sum())) / p
    return Share.of((float(scaled_logdet(bound)) - found) / p, spread)


def virtual_trial(rng: np.random.Generator, case: Case, samples: int = SAMPLES) -> TrialLog:
    """Draw one trial of the thesis's ship in constant current and measured wind.

    Commands and gusts are those of every trial; measurement and process noise are drawn.
    """
    structure, vessel = get_structure("thesis"), load_vessel("thesis")
    commands = pulse_commands(samples)
    tau = make_log(vessel, commands, 1.0).forces(structure.inputs)
    theta = np.array([TRUE[n] for n in structure.parameters])
    wind = stationary_disturbance(
        np.random.default_rng(_GUSTS), np.array(WIND), GUST, samples,
        correlation_time=GUST_MEMORY,
    )[0]  # fmt: skip
    d = np.column_stack([np.tile(CURRENT, (samples, 1)), wind])
    run = simulate(
        structure, theta, _START, tau[:-1], 1.0,
        d=d[:-1],
        process_noise=rng.standard_normal((samples - 1, 3)) * np.array(case.process),
    )  # fmt: skip
    x, heading = run.x[0], run.psi[0]
    ahead, across = ned_to_body(wind[:, 0], wind[:, 1], heading)
    noise = np.sqrt(SENSOR_VARIANCE) * rng.standard_normal(x.shape)
    channels = {n: x[:, i] + noise[:, i] for i, n in enumerate(structure.states)}
    channels["psi"] = heading + np.sqrt(HEADING_VARIANCE) * rng.standard_normal(samples)
    channels["u_q"] = x[:, 0] - ahead
    channels["v_q"] = x[:, 1] - across
    return make_log(vessel, commands | channels, 1.0, case.name)


def _predictors() -> tuple[Predictor, Predictor]:
    structure = get_structure("thesis")
    return (
        build_predictor(structure, "wind", _REGIME),
        output_predictor(structure, "wind", _REGIME),
    )


def _estimates(case: Case, log: TrialLog) -> dict[str, Estimate]:
    linear, output = _predictors()
    plain = estimate_iv(linear, [log], wind="measured")
    found = {"IV": plain}
    ways: dict[str, Callable[[], Estimate]] = {
        # process noise moves the ship through the air too, so its wind is averaged
        "refined IV": lambda: estimate_refined_iv(
            linear, [log], start=plain, wind="smoothed" if any(case.process) else "measured"
        ),
        "OE": lambda: estimate_oe(output, [log], start=plain),
        "innovations": lambda: estimate_oe(
            output, [log], start=plain, options=OutputErrorOptions(process_noise=True)
        ),
    }
    for name in case.estimators:
        if name in ways:
            try:
                found[name] = ways[name]()
            except GreyboxError:
                continue
    return found


def _piece(piece: tuple[int, int, int], seed: int, samples: int) -> dict[str, tuple[Array, Array]]:
    which, chunk, runs = piece
    case = CASES[which]
    rng = np.random.default_rng([seed, which, chunk])
    names = get_structure("thesis").parameters
    theta = {e: np.full((runs, len(names)), np.nan) for e in case.estimators}
    std = {e: np.full((runs, len(names)), np.nan) for e in case.estimators}
    for k in range(runs):
        log = virtual_trial(rng, case, samples)
        try:
            found = _estimates(case, log)
        except GreyboxError:
            continue
        for name, estimate in found.items():
            model = estimate.model()
            order = [model.names.index(n) for n in names]
            theta[name][k], std[name][k] = model.theta[order], model.std[order]
    return {e: (theta[e], std[e]) for e in case.estimators}


def _bounds(case: Case, samples: int) -> tuple[Array, Array]:
    """Return the Cramér-Rao and the instruments' bound at the truth."""
    structure = get_structure("thesis")
    linear, output = _predictors()
    log = virtual_trial(np.random.default_rng(0), case, samples)
    sigma = np.full(3, np.sqrt(SENSOR_VARIANCE))
    noise = NoiseLevels(structure.states, sigma, np.array(case.process), np.sqrt(HEADING_VARIANCE))
    model = output_model(output, 1.0, "output")
    p = np.array([*[TRUE[c.name] for c in output.columns], *CURRENT])
    whole = cramer_rao(
        model, [measured(model, log)], p, np.array([[*_START, 0.0]]), noise_variances(model, noise)
    )
    theta = np.array([TRUE[n] for n in structure.parameters])
    best = iv_bound(linear, [log], theta, noise, d=np.array([*CURRENT, *WIND]))
    names = structure.parameters
    place = {c.name: i for i, c in enumerate(output.columns)}
    first = [place[n] for n in names]
    place = {linear.columns[i].name: i for i in linear.parameter_columns}
    second = [place[n] for n in names]
    return whole[np.ix_(first, first)], best[np.ix_(second, second)]


def reproduce_efficiency(
    runs: int = 1000,
    seed: int = 0,
    *,
    samples: int = SAMPLES,
    workers: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Efficiency:
    """Estimate many virtual trials and compare their spread with the bounds.

    Parameters
    ----------
    runs : int
        Of each case.
    seed : int
    samples : int
        Length of a trial.
    workers : int, optional
        Processes.
    progress : callable
        Called with pieces done and in all.
    """
    pieces = [
        (which, chunk, min(_PIECE, runs - first))
        for which in range(len(CASES))
        for chunk, first in enumerate(range(0, runs, _PIECE))
    ]
    collected: list[list[dict[str, tuple[Array, Array]]]] = [[] for _ in CASES]
    work = partial(_piece, seed=seed, samples=samples)
    for done, (piece, found) in enumerate(
        zip(pieces, map_pieces(work, pieces, workers=workers), strict=True), 1
    ):
        collected[piece[0]].append(found)
        progress(done, len(pieces))
    names = get_structure("thesis").parameters
    results = []
    for case, parts in zip(CASES, collected, strict=True):
        bound, best = _bounds(case, samples)
        results.append(
            CaseResult(
                case,
                names,
                np.array([TRUE[n] for n in names]),
                bound,
                best,
                {e: np.vstack([p[e][0] for p in parts]) for e in case.estimators},
                {e: np.vstack([p[e][1] for p in parts]) for e in case.estimators},
            )
        )
    return Efficiency(runs, tuple(results))
