"""Chapter 4: LS, IV and zero-mean IV on a scalar second-order modulus model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from greybox.model.catalogue import get_structure
from greybox.model.predictor import build_predictor
from greybox.model.run.simulation import simulate
from greybox.numerics.parallel import map_pieces
from greybox.study.inputs import offset_gaussian
from greybox.study.monte_carlo import Batch, BatchRegression
from greybox.study.tables import Row, normalised, published

Array = NDArray[np.float64]

TRUE = np.array([-0.1, 1.0])
# (4.59): means and variances
PROCESS_MEAN, PROCESS_VARIANCE = 0.1, 0.1
DISTURBANCE_VARIANCE = 0.25
NOISE_VARIANCE = 0.1
SAMPLES = 5000

# one input sequence served all runs of the published study; so does this one
INPUT_SEED = 1
_CHUNK = 125


@dataclass(frozen=True)
class MonteCarloSet:
    """One of the four sets: figure range, mean of v, input floor, whether y2 is used."""

    figures: str
    mean: float
    floor: float | None
    second: bool


SETS = (
    MonteCarloSet("4.1-4.2", 0.0, None, False),
    MonteCarloSet("4.3-4.5", 0.0, 0.6, False),
    MonteCarloSet("4.6-4.8", 0.1, 0.6, False),
    MonteCarloSet("4.9-4.11", 0.1, 0.6, True),
)
ESTIMATORS = ("LS", "IV1", "IV2")


@dataclass(frozen=True)
class Chapter4:
    """Normalised errors, set and estimator -> (runs, 2), for n and f."""

    runs: int
    errors: dict[tuple[str, str], Array]
    unconverged: int

    def rows(self) -> list[Row]:
        """Return the means and standard deviations that the figure captions give."""
        reference = {(r["figures"], r["estimator"]): r for r in published("chapter4")}
        rows = []
        for (figures, estimator), errors in self.errors.items():
            there = reference[figures, estimator]
            for j, name in enumerate("nf"):
                known = there[f"{name}_mean"], there[f"{name}_sd"]
                rows.append(Row.of(figures, figures, estimator, name, errors[:, j], known))
        return rows


def virtual_batch(rng: np.random.Generator, case: MonteCarloSet, runs: int, samples: int) -> Batch:
    """Simulate (4.58) with the noises of (4.59).

    Returns
    -------
    Batch
        ``x`` holds y1; ``measured`` is y1 + y2 where the second measurement is used (4.13).
    """
    structure = get_structure("siso")
    given = offset_gaussian(np.random.default_rng([4, INPUT_SEED]), samples, case.floor)
    v = case.mean + np.sqrt(DISTURBANCE_VARIANCE) * rng.standard_normal((runs, samples, 1))
    w = PROCESS_MEAN + np.sqrt(PROCESS_VARIANCE) * rng.standard_normal((runs, samples, 1))
    run = simulate(structure, TRUE, np.zeros(1), given[None, :, None], 1.0, d=v, process_noise=w)
    noise = np.sqrt(NOISE_VARIANCE)
    y1 = run.x + noise * rng.standard_normal(run.x.shape)
    measured = None
    if case.second:
        y2 = v + noise * rng.standard_normal(v.shape)
        measured = y1.copy()
        measured[:, :-1] += y2
    return Batch(y1, 0.0, given[None, :, None], None, np.zeros(1), measured)


def _piece(piece: tuple[int, int, int], seed: int) -> tuple[int, dict[str, Array], int]:
    which, chunk, runs = piece
    rng = np.random.default_rng([seed, which, chunk])
    batch = virtual_batch(rng, SETS[which], runs, SAMPLES)
    regression = BatchRegression(build_predictor(get_structure("siso"), "basic"), batch)
    ls = regression.least_squares()
    iv = {
        name: regression.refine(ls, zero_mean=zero_mean)
        for name, zero_mean in (("IV1", False), ("IV2", True))
    }
    theta = {"LS": ls} | {name: e.theta for name, e in iv.items()}
    errors = {
        name: np.column_stack([normalised(t[:, j], TRUE[j]) for j in range(2)])
        for name, t in theta.items()
    }
    return which, errors, sum(int(e.unconverged.sum()) for e in iv.values())


def reproduce_chapter4(
    runs: int = 500,
    seed: int = 0,
    *,
    workers: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Chapter4:
    """Repeat the four Monte Carlo sets of chapter 4.

    Parameters
    ----------
    runs : int
        Runs a set.
    seed : int
        Draws the noise.
    workers : int, optional
        Processes; by default one a processor.
    progress : callable
        Called with runs done and runs in all.

    Returns
    -------
    Chapter4

    References
    ----------
    Ljungberg (2020), section 4.5, Figures 4.1-4.11.
    """
    pieces = [
        (which, chunk, min(_CHUNK, runs - first))
        for which in range(len(SETS))
        for chunk, first in enumerate(range(0, runs, _CHUNK))
    ]
    found: dict[tuple[str, str], list[Array]] = {}
    unconverged, done = 0, 0
    work = partial(_piece, seed=seed)
    for which, errors, bad in map_pieces(work, pieces, workers=workers):
        for name in ESTIMATORS:
            found.setdefault((SETS[which].figures, name), []).append(errors[name])
        unconverged += bad
        done += len(errors["LS"])
        progress(done, runs * len(SETS))
    return Chapter4(runs, {k: np.concatenate(v) for k, v in found.items()}, unconverged)
