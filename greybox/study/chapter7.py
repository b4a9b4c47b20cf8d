"""Chapter 7: six estimators on a windy day, validated on a calm one.

The pipeline of the thesis: velocities by finite differences, held wind,
instruments from the least-squares model simulated log by log with measured
heading and wind, one step of IV, no mean removal; many estimation sets, average
fit on the other day, sign tests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from greybox.errors import GreyboxError, UsageError
from greybox.estimation.result import Estimate
from greybox.model.catalogue import get_structure, structure_for
from greybox.model.predictor import Predictor, build_predictor
from greybox.model.run.simulation import positions, simulate, stationary_disturbance
from greybox.model.structure import Structure
from greybox.rotation import ned_to_body
from greybox.selection.fit_single import estimate_iv, estimate_ls
from greybox.study.chapter6 import TRUE
from greybox.study.inputs import smoothed_pulses, zig_zag
from greybox.study.tables import Row
from greybox.trial.kinematics import velocities_from_positions
from greybox.trial.log import TrialLog, make_log
from greybox.validation.comparison import SignTest, sign_test
from greybox.validation.fit import run_model
from greybox.vessel.force import force_inputs
from greybox.vessel.toml import load_vessel

Array = NDArray[np.float64]

# (7.1)-(7.3): what the thesis kept of the bias-capturing regressors without a current
REDUCED_BIASES = (
    "u:u*cos(psi)", "u:u*sin(psi)", "u:cos²(psi)", "u:sin(2psi)",
    "v:cos(psi)", "v:sin(psi)", "v:cos²(psi)", "v:sin(2psi)",
    "r:v*cos(psi)", "r:v*sin(psi)", "r:u*cos(psi)", "r:u*sin(psi)", "r:cos²(psi)", "r:sin(2psi)",
)  # fmt: skip
ESTIMATORS = ("LS1", "LS2", "LS3", "IV1", "IV2", "IV3")
MOST_SETS = 9


@dataclass(frozen=True)
class Chapter7:
    """Fits of every estimator on every estimation set.

    Parameters
    ----------
    sets : tuple of tuple of str
        Names of the logs of each estimation set.
    fits : dict
        estimator -> (sets, states) mean fit on the validation logs [%].
    states : tuple of str
    theta : dict
        estimator -> (sets, p) parameters.
    names : dict
        estimator -> labels of the parameters.
    skipped : dict of str to str
        Estimators that could not be used, and why.
    validation : tuple of str
        Names of the validation logs.
    """

    sets: tuple[tuple[str, ...], ...]
    fits: dict[str, Array]
    states: tuple[str, ...]
    theta: dict[str, Array]
    names: dict[str, tuple[str, ...]]
    skipped: dict[str, str]
    validation: tuple[str, ...]

    def diverged(self, estimator: str) -> int:
        """Return on how many sets the model of an estimator cannot be simulated."""
        return int((~np.isfinite(self.fits[estimator]).all(axis=1)).sum())

    def sign_tests(self) -> list[SignTest]:
        """Return the tests of Table 7.2: each estimator against the first, over the sets."""
        names = list(self.fits)
        return [
            sign_test(
                name,
                names[0],
                state,
                list(self.fits[names[0]][:, i]),
                list(self.fits[name][:, i]),
            )
            for name in names[1:]
            for i, state in enumerate(self.states)
        ]

    def rows(self) -> list[Row]:
        """Return Table 7.1 (fits) and the parameters of Tables 7.3, 7.4."""
        rows = []

        def add(table: str, estimator: str, name: str, value: Array) -> None:
            # sets whose model diverges have no fit; the count tells them
            good = value[np.isfinite(value)]
            mean = float(good.mean()) if len(good) else float("nan")
            sd = float(good.std(ddof=1)) if len(good) > 1 else 0.0
            rows.append(Row(table, "all sets", estimator, name, mean, sd, None, None, len(good)))

        for estimator, fit in self.fits.items():
            for i, state in enumerate(self.states):
                add("7.1", estimator, f"fit_{state}", fit[:, i])
        for estimator, theta in self.theta.items():
            for j, label in enumerate(self.names[estimator]):
                table = "7.3" if label.startswith("W") else "7.4"
                add(table, estimator, label, theta[:, j])
        return rows


def predictors(structure: Structure, wind: bool) -> dict[str, Predictor]:
    """Return the predictors of LS1/IV1, LS2/IV2 (7.1)-(7.3) and LS3/IV3 (7.4)-(7.6)."""
    known = tuple(b for b in REDUCED_BIASES if b.split(":")[0] in structure.states)
    found = {
        "1": build_predictor(structure, "basic"),
        "2": build_predictor(structure, "augmented", biases=known),
    }
    if wind:
        found["3"] = build_predictor(structure, "basic+wind")
    return found


def estimation_sets(logs: Sequence[TrialLog]) -> list[list[TrialLog]]:
    """Form overlapping estimation sets, balanced between surge and sway excitation.

    As the thesis: with six logs, two of the three with most surge and two of
    the three with most sway, nine sets. With fewer logs one is left out at a
    time; a single log is a set of its own. There are at most `MOST_SETS`.
    """
    if len(logs) < 2:
        return [list(logs)]
    if len(logs) < 4:
        return [[log for log in logs if log is not left] for left in logs]
    sway = sorted(logs, key=lambda log: float(np.std(log["v"]) / (np.std(log["u"]) + 1e-9)))
    half = len(logs) // 2
    surge_logs, sway_logs = sway[:half], sway[half:]
    pairs = product(
        combinations(surge_logs, max(1, len(surge_logs) - 1)),
        combinations(sway_logs, max(1, len(sway_logs) - 1)),
    )
    return [[*a, *b] for a, b in pairs][:MOST_SETS]


def _estimates(structure: Structure, logs: list[TrialLog], wind: bool) -> dict[str, Estimate | str]:
    found: dict[str, Estimate | str] = {}
    for k, predictor in predictors(structure, wind).items():
        try:
            ls = estimate_ls(predictor, logs, covariance="white", judged=False)
        except GreyboxError as error:
            found[f"LS{k}"] = found[f"IV{k}"] = str(error)
            continue
        found[f"LS{k}"] = ls
        try:
            # one step from the least-squares model, as section 7.2. The mean is kept, but
            # for the bias-capturing predictor, whose constants only zero mean removes
            found[f"IV{k}"] = estimate_iv(
                predictor,
                logs,
                start=ls,
                zero_mean=predictor.augmented,
                wind="measured",
                refine=False,
                covariance="white",
                judged=False,
            )
        except GreyboxError as error:
            found[f"IV{k}"] = str(error)
    return {name: found[name] for name in ESTIMATORS if name in found}


def reproduce_chapter7(
    estimation: Sequence[TrialLog],
    validation: Sequence[TrialLog],
    *,
    structure: Structure | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Chapter7:
    """Run the pipeline of chapter 7.

    Parameters
    ----------
    estimation, validation : sequence of TrialLog
        Logs of the two days.
    structure : Structure, optional
        (3.51) by default, without what the thrusters cannot excite.
    progress : callable
        Called with sets done and sets in all.

    Returns
    -------
    Chapter7

    Raises
    ------
    UsageError
        A day has no logs.

    References
    ----------
    Ljungberg (2020), chapter 7, Tables 7.1-7.7.
    """
    if not estimation or not validation:
        raise UsageError("chapter 7 needs logs of both days: give --estimate and --validate.")
    structure = structure or structure_for("thesis", force_inputs(estimation[0].vessel))
    wind = all(log.has_wind for log in [*estimation, *validation]) and structure.uses_air
    sets = estimation_sets(estimation)
    fits: dict[str, list[list[float]]] = {}
    theta: dict[str, list[Array]] = {}
    names: dict[str, tuple[str, ...]] = {}
    skipped: dict[str, str] = {}
    for i, logs in enumerate(sets):
        for name, estimate in _estimates(structure, logs, wind).items():
            if isinstance(estimate, str):
                skipped.setdefault(name, estimate)
                continue
            model = estimate.model()
            runs = [run_model(replace(model, disturbances={}), log) for log in validation]
            fits.setdefault(name, []).append(
                [float(np.mean([r.fit[s] for r in runs])) for s in structure.states]
            )
            columns = [c for c in estimate.predictor.columns if not c.is_bias]
            names[name] = tuple(c.label for c in columns)
            theta.setdefault(name, []).append(estimate.theta[estimate.predictor.parameter_columns])
        progress(i + 1, len(sets))
    complete = [n for n in ESTIMATORS if len(fits.get(n, [])) == len(sets)]
    for name in fits:
        if name not in complete:
            skipped.setdefault(name, "it failed on some estimation sets")
    return Chapter7(
        tuple(tuple(log.name for log in logs) for logs in sets),
        {n: np.array(fits[n]) for n in complete},
        structure.states,
        {n: np.array(theta[n]) for n in complete},
        {n: names[n] for n in complete},
        {n: why for n, why in skipped.items() if n not in complete},
        tuple(log.name for log in validation),
    )


def virtual_day(seed: int, wind: float, name: str, batches: int = 6) -> list[TrialLog]:
    """Make one day of short trials: half with surge, half with sway as main excitation.

    The ship of Table 6.1 steps finely, its positions and heading are measured
    at 1 Hz and the velocities are taken from them (3.57); the wind is measured
    every 5 s and held.

    Parameters
    ----------
    seed : int
    wind : float
        Mean wind speed [m/s].
    name : str
    batches : int

    Returns
    -------
    list of TrialLog
        Of 6-10 minutes each.
    """
    structure, vessel = get_structure("thesis"), load_vessel("thesis")
    fine = 10
    theta = np.array([TRUE[n] for n in structure.parameters]) / fine
    logs = []
    for batch in range(batches):
        rng = np.random.default_rng([7, seed, batch])
        samples = int(rng.integers(360, 600))
        count = samples * fine
        pulses = {"widths": (30 * fine, 90 * fine), "smoothing": 10 * fine}
        speed = smoothed_pulses(rng, count, 8.0, 20.0, **pulses)  # type: ignore[arg-type]
        if batch % 2 == 0:
            bow = np.zeros(count)
            stern = zig_zag(count, 1 / fine, amplitude=0.35, period=float(rng.uniform(70, 130)))
        else:
            bow = smoothed_pulses(rng, count, 0.3, 1.5, **pulses)  # type: ignore[arg-type]
            stern = smoothed_pulses(rng, count, 0.3, 1.5, **pulses)  # type: ignore[arg-type]
        commands = {"n": speed, "alpha1": bow, "alpha2": stern}
        blank = make_log(vessel, commands | {"u": speed}, 1 / fine)
        direction = rng.uniform(0, 2 * np.pi)
        mean = np.array([0.0, 0.0, wind * np.cos(direction), wind * np.sin(direction)])
        d = stationary_disturbance(
            rng,
            mean,
            np.array([0.0, 0.0, 0.1 * wind, 0.1 * wind]),
            count,
            correlation_time=20.0,
            sample_time=1 / fine,
        )[0]
        run = simulate(
            structure,
            theta,
            np.array([1.0, 0.0, 0.0]),
            blank.forces(structure.inputs),
            1 / fine,
            psi0=rng.uniform(-np.pi, np.pi),
            d=d,
        )
        track = positions(run.x[0], run.psi[0], 1 / fine)[:-1]
        keep = slice(0, count, fine)
        psi = run.psi[0][:-1][keep] + 0.005 * rng.standard_normal(samples)
        where = track[keep] + 0.01 * rng.standard_normal((samples, 2))
        u, v, r = velocities_from_positions(where[:, 0], where[:, 1], psi, 1.0, heading_std=0.005)
        w = d[keep]
        x = run.x[0][:-1][keep]
        forward, starboard = ned_to_body(w[:, 2], w[:, 3], run.psi[0][:-1][keep])
        u_q, v_q = x[:, 0] - forward, x[:, 1] - starboard
        held = (np.arange(samples) // 5) * 5
        channels = {k: value[keep] for k, value in commands.items()} | {
            "x_n": where[:, 0], "y_n": where[:, 1], "psi": psi, "u": u, "v": v, "r": r,
            "u_q": u_q[held] + 0.2 * rng.standard_normal(samples)[held],
            "v_q": v_q[held] + 0.2 * rng.standard_normal(samples)[held],
        }  # fmt: skip
        logs.append(make_log(vessel, channels, 1.0, f"{name}_{batch + 1}").window(1, samples - 1))
    return [replace(log, name=f"{name}_{i + 1}") for i, log in enumerate(logs)]
