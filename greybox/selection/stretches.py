"""The most informative stretches of a stream, for computations that need data in memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import so_many
from greybox.estimation.values import EstimationData
from greybox.model.predictor import Predictor, build_predictor
from greybox.model.structure import Structure
from greybox.regression.regression import build_experiment
from greybox.selection.prediction import part_of_estimate
from greybox.trial.actuator_estimate import known_actuators
from greybox.trial.log import TrialLog
from greybox.trial.stream import LogStream, Place
from greybox.trial.validity import pooled_conditions, ranges, settings_of, unlike

Array = NDArray[np.float64]

# samples of a stretch, long enough for several manoeuvres, and of all: tests and refits of so
# many take about as long as a few passes over a month
_STRETCH, _DRAWN = 1800, 21_600
# stretches of one segment that are looked at further
_OF_SEGMENT = 2
# share of a regressor's mean square from which on a direction counts as moved
_MOVED = 1e-6


@dataclass(frozen=True)
class Drawn:
    """Stretches of a stream, with statistics of its segments.

    Parameters
    ----------
    stream : LogStream
        Without what could not be read.
    logs : tuple of TrialLog
        The stretches, those first that tell most.
    data : EstimationData
        Of the whole stream.
    """

    stream: LogStream
    logs: tuple[TrialLog, ...]
    data: EstimationData

    @property
    def samples(self) -> int:
        """Samples of all stretches."""
        return sum(map(len, self.logs))

    @property
    def share(self) -> float:
        """Share of the stream that they hold."""
        return self.samples / self.data.samples

    @property
    def sentence(self) -> str:
        """What rests on them alone."""
        return (
            f"the coefficients and their standard errors rest on all {self.data.samples} samples, "
            f"which were read in passes; the choice of the predictor, noise levels, tests, fit and "
            f"the verdict on the prediction rest on {self.part}."
        )

    @property
    def part(self) -> str:
        """How many samples they hold, in words."""
        return (
            f"{self.samples} of them ({100 * self.share:.3g} %) in "
            f"{so_many(len(self.logs), 'stretch')}, "
            f"those that tell the parameters apart best"
        )

    def to_dict(self, rests_on_it: Sequence[str]) -> dict[str, Any]:
        """Return the stretches for JSON, with what rests on them."""
        return {
            "rests_on_it": list(rests_on_it),
            "samples": self.samples,
            "share": self.share,
            "stretches": [
                {"name": log.name, "start": float(log.t[0]), "samples": len(log)}
                for log in self.logs
            ],
        }

    def require_others(self, logs: Sequence[TrialLog]) -> None:
        """Refuse logs that validate and are files of the stream, drawn from or not.

        Raises
        ------
        UsageError
            Names the log.
        """
        files = {f.known.sha256 for f in self.stream.parts}
        for log in logs:
            if log.provenance.sha256 in files:
                raise part_of_estimate(log)


@dataclass(frozen=True)
class _Segment:
    """A segment's stretches that tell most, with their moments (k, k), ranges and settings."""

    samples: int
    stretches: tuple[tuple[int, int, Array], ...]
    ranges: dict[str, tuple[float, float]]
    settings: dict[str, list[float]]


def draw(stream: LogStream, structure: Structure) -> Drawn:
    """Draw the stretches whose regressors, one after another, add most to the information.

    Parameters
    ----------
    stream : LogStream
    structure : Structure

    Raises
    ------
    LogError
        No file can be read.

    References
    ----------
    Nemhauser, Wolsey and Fisher (1978): the greedy choice reaches 63 % of the largest log
    determinant at least.
    """
    predictor = build_predictor(structure, "basic", tuple((s, (1, -1)) for s in structure.states))
    stream, found = stream.run(partial(_look_at, predictor))
    stretches = [(place, *one) for place, segment in found for one in segment.stretches]
    moments = np.array([m for *_, m in stretches])
    chosen: list[tuple[Place, int, int]] = []
    samples = 0
    for k in _greedy(moments, len(moments)):
        place, start, stop, _ = stretches[k]
        if samples and samples + stop - start > _DRAWN:
            break
        chosen.append((place, start, stop))
        samples += stop - start
    whole = stream.read([place for place, _, _ in chosen])
    logs = tuple(
        log if stop - start == len(log) else log.window(start, stop)
        for log, (_, start, stop) in zip(whole, chosen, strict=True)
    )
    return Drawn(stream, logs, _data(stream, logs[0], [s for _, s in found]))


def _look_at(predictor: Predictor, log: TrialLog) -> _Segment:
    """Return what a segment tells."""
    states = predictor.structure.states
    experiment = build_experiment(predictor, log)
    rows = np.where(experiment.keep, experiment.phi, 0.0)
    if predictor.structure.marine:
        psi = log["psi"][:-1]
        rows = np.vstack([rows, np.cos(psi), np.sin(psi)])
    count = max(len(log) // _STRETCH, 1)
    length = min(len(log), _STRETCH)
    own = rows[:, : count * length - 1]
    own = np.pad(own, ((0, 0), (0, count * length - own.shape[1])), mode="edge")
    parts = own.reshape(len(own), count, length).transpose(1, 0, 2)
    parts = parts - parts.mean(axis=2, keepdims=True)
    moments = parts @ parts.transpose(0, 2, 1)
    return _Segment(
        len(log),
        tuple((k * length, (k + 1) * length, moments[k]) for k in _greedy(moments, _OF_SEGMENT)),
        ranges([log], states),
        settings_of([log]),
    )


def _greedy(moments: Array, count: int) -> list[int]:
    """Return positions of moments (n, k, k) in the order in which they add most, `count` at most.

    Those that add nothing, since nothing moves in them, are left out where others do.
    """
    size = np.sqrt(np.mean(np.diagonal(moments, axis1=1, axis2=2), axis=0))
    moved = size > 0
    unit = moments[:, moved][:, :, moved] / np.outer(size[moved], size[moved])
    total = _MOVED * np.eye(int(moved.sum()))
    left = list(range(len(moments)))
    order: list[int] = []
    before = float(np.linalg.slogdet(total)[1])
    while left and len(order) < count:
        gains = np.linalg.slogdet(total + unit[left])[1]
        best = int(np.argmax(gains))
        if order and not gains[best] > before:
            break
        before = float(gains[best])
        order.append(left.pop(best))
        total = total + unit[order[-1]]
    return order


def _data(stream: LogStream, log: TrialLog, segments: Sequence[_Segment]) -> EstimationData:
    """Return what is known of all files; rows that take part are counted by the estimate."""
    found: dict[str, tuple[float, float]] = {}
    for segment in segments:
        for name, (low, high) in segment.ranges.items():
            least, most = found.get(name, (low, high))
            found[name] = min(low, least), max(high, most)
    names = [n for n in segments[0].settings if all(n in s.settings for s in segments)]
    all_settings = {n: np.concatenate([s.settings[n] for s in segments]) for n in names}
    # conditions are those of the records beside the files
    heads = [replace(log.window(0, 2, f.file.name), provenance=f.known) for f in stream.parts]
    samples = sum(s.samples for s in segments)
    return EstimationData(
        samples,
        samples,
        tuple(
            {"name": f.file.name, "sha256": f.known.sha256, "samples": f.rows} for f in stream.parts
        ),
        found,
        unlike(all_settings) if names else {},
        pooled_conditions(heads),
        known_actuators(f.known.actuators for f in stream.parts),
    )
