"""Parts of a plan on the log that sailed it: the part to estimate on, and that to validate on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate

from greybox.errors import LogError, so_many
from greybox.files import read_csv_rows
from greybox.trial.convert.time_grid import MIN_SEGMENT
from greybox.trial.log import TrialLog
from greybox.trial.raw_log import Array
from greybox.trial.segments import join_segments, numbered, whole_name
from greybox.vessel.vessel import Vessel

Samples = NDArray[np.intp]

LEAD_IN, TRIAL, CROSSING, VALIDATION = "lead-in", "trial", "crossing", "validation"
# rows that no estimate counts: the ship is on her way into a regime, or from one to another
LEFT_OUT = (LEAD_IN, CROSSING)
# of the plan's samples, or of the log's where these are fewer: what must follow the plan, so that
# its parts are taken for the log's; a trial that was broken off or helped out of trouble has less
_FOLLOWED = 0.8
# distance from the plan at which a command follows it, as a share of the range that the plan
# gives it, and time by which it may be early or late [s]: a helmsman's and a thruster's
_NEAR, _LATE = 0.1, 2.0


@dataclass(frozen=True)
class PlannedTrial:
    """One trial of a plan.

    Parameters
    ----------
    name : str
    t : ndarray
        (N,) uniform times [s]; each row holds until the next.
    commands : mapping of str to ndarray
        (N,) each thruster column, as the log has it.
    parts : tuple of str
        (N,) what each row is sailed for.
    """

    name: str
    t: Array
    commands: Mapping[str, Array]
    parts: tuple[str, ...]

    def with_validation_estimated(self) -> PlannedTrial:
        """Return the trial with its validation as part of what is estimated on."""
        return replace(self, parts=tuple(TRIAL if p == VALIDATION else p for p in self.parts))

    @property
    def step(self) -> float:
        """Sample time [s]."""
        return float(self.t[1] - self.t[0])

    def rows(self, t: Array, shift: float) -> Samples:
        """Return the row that holds at each time (M,) of a log, −1 outside the plan."""
        row = np.floor((t - shift - self.t[0]) / self.step + 1e-6).astype(np.intp)
        return np.where((row >= 0) & (row < len(self.t)), row, -1)

    def followed(self, log: TrialLog, shift: float) -> float:
        """Return the share of samples that follow the plan, of the log's or the plan's if fewer."""
        inside = self.rows(log.t, shift) >= 0
        for name, planned in self.commands.items():
            near = _NEAR * float(np.ptp(planned)) + 1e-9
            around = np.stack(
                [self.rows(log.t + late, shift) for late in np.arange(-_LATE, _LATE + 0.5)]
            )
            value = np.where(around >= 0, planned[around], np.nan)
            known = (around >= 0).any(axis=0)
            low, high = np.full(len(log), np.inf), np.full(len(log), -np.inf)
            low[known] = np.nanmin(value[:, known], axis=0)
            high[known] = np.nanmax(value[:, known], axis=0)
            inside &= (log[name] >= low - near) & (log[name] <= high + near)
        fewer = min(len(log), len(self.t) * self.step / log.sample_time)
        return min(1.0, float(inside.sum()) / fewer)

    def best_shift(self, log: TrialLog) -> float:
        """Return the shift [s] of the plan at which the log's commands are nearest to it."""
        dt = log.sample_time
        count = max(1, round(len(self.t) * self.step / dt))
        held = self.rows(self.t[0] + np.arange(count) * dt, 0.0)
        place = np.round((log.t - log.t[0]) / dt).astype(np.intp)
        there, score = np.zeros(place[-1] + 1), np.zeros(place[-1] + count)
        there[place] = 1.0
        for name, planned in self.commands.items():
            spread = float(np.std(planned))
            if not spread:
                continue
            middle = float(np.mean(planned))
            plan = (planned[held] - middle) / spread
            sailed = np.zeros(len(there))
            sailed[place] = (log[name] - middle) / spread
            # of each overlap: samples less their squared distance, which chance makes negative
            for one, other, weight in (
                (there, np.ones(count), 1.0), (sailed**2, np.ones(count), -1.0),
                (there, plan**2, -1.0), (sailed, plan, 2.0),
            ):  # fmt: skip
                score += weight * correlate(one, other, "full", "fft")
        return float(log.t[0] - self.t[0] + (int(score.argmax()) - count + 1) * dt)


@dataclass(frozen=True)
class SailedPlan:
    """How one log follows a plan.

    Parameters
    ----------
    log, plan : str
    shift : float
        What was added to the plan's times to be the log's [s].
    followed : float
        Share of the samples that follow it.
    samples : dict of str to int
        Samples of the log in each part; those outside the plan under ``outside``.
    """

    log: str
    plan: str
    shift: float
    followed: float
    samples: dict[str, int]

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return dict(vars(self))

    @property
    def sentence(self) -> str:
        """What was taken from the plan."""
        shifted = f", shifted by {self.shift:g} s," if self.shift else ""
        said = (
            f"'{self.log}' follows the plan '{self.plan}'{shifted} in "
            f"{100 * self.followed:.0f} % of its samples"
        )
        out = [f"{self.samples[n]} of {n}" for n in LEFT_OUT if self.samples.get(n)]
        if self.samples.get("outside"):
            out.append(f"{self.samples['outside']} outside the plan")
        if out:
            said += f"; left out of the estimate are {' and '.join(out)}"
        if self.samples.get(VALIDATION):
            said += (
                f"; its {self.samples[VALIDATION]} samples of validation judged an estimate of the "
                f"rest, and then took part in this one"
            )
        return f"{said}."


def read_plan(path: str | Path, vessel: Vessel) -> tuple[PlannedTrial, ...]:
    """Read a plan as `greybox design` writes it.

    Parameters
    ----------
    path : str or Path
    vessel : Vessel
        Whose thruster columns it has.

    Returns
    -------
    tuple of PlannedTrial
        All one part where it has no column ``part``.

    Raises
    ------
    LogError
        The file cannot be read, a column is missing, a value is no number, or a part unknown.
    """
    path = Path(path)
    header, lines = read_csv_rows(path, "the plan", "Name the CSV that greybox design wrote.")
    rows = [dict(zip(header, line, strict=False)) for line in lines]
    lacking = [n for n in ("t", *vessel.commands) if n not in header]
    if lacking:
        raise LogError(
            f"the plan '{path.name}' has no column {', '.join(lacking)}: it has "
            f"{', '.join(header) or 'none'}. Name the CSV that greybox design wrote for "
            f"{vessel.name}."
        )
    unknown = {r.get("part") or TRIAL for r in rows} - {LEAD_IN, TRIAL, CROSSING, VALIDATION}
    if unknown:
        raise LogError(
            f"the plan '{path.name}' has the part '{min(unknown)}', which is none of {LEAD_IN}, "
            f"{TRIAL}, {CROSSING} and {VALIDATION}."
        )
    found = []
    for number, group in groupby(rows, lambda r: r.get("trial") or ""):
        own = list(group)
        try:
            values = np.array([[float(r[n]) for n in ("t", *vessel.commands)] for r in own])
        except (ValueError, KeyError) as error:
            raise LogError(
                f"the plan '{path.name}' holds a value that is no number: {error}."
            ) from error
        steps = np.diff(values[:, 0])
        if len(own) < 2 or not (np.abs(steps - steps[0]) < 1e-6 * steps[0]).all():
            raise LogError(
                f"the plan '{path.name}' has {so_many(len(own), 'row')} with steps of "
                f"{steps.min(initial=np.inf):g} to {steps.max(initial=0.0):g} s: its times must "
                f"increase evenly, as greybox design writes them."
            )
        name = path.name + (f", trial {number}" if number else "")
        commands = dict(zip(vessel.commands, values[:, 1:].T, strict=True))
        found.append(
            PlannedTrial(name, values[:, 0], commands, tuple(r.get("part") or TRIAL for r in own))
        )
    if not found:
        raise LogError(f"the plan '{path.name}' has no rows: greybox design writes one a sample.")
    return tuple(found)


def by_parts(
    logs: Sequence[TrialLog], plan: Sequence[PlannedTrial]
) -> tuple[list[TrialLog], list[TrialLog], tuple[SailedPlan, ...]]:
    """Return the parts of logs that a plan was sailed for.

    Times of plan and log are taken as the same where the log follows the plan so; else the plan
    is shifted to where the thruster columns agree best.

    Parameters
    ----------
    logs : sequence of TrialLog
        Segments; those of one file have one shift.
    plan : sequence of PlannedTrial
        Each log is held against the trial that it follows best.

    Returns
    -------
    tuple of (list of TrialLog, list of TrialLog, tuple of SailedPlan)
        What is estimated on, what judges, and how each file follows the plan.

    Raises
    ------
    LogError
        Fewer than 80 % of a log's samples follow the plan, or none is left to estimate on.
    """
    fit: list[TrialLog] = []
    judges: list[TrialLog] = []
    told = []
    for name, group in groupby(logs, lambda log: whole_name(log.name)):
        segments = list(group)
        trial, shift, share = _nearest(segments, plan)
        if share < _FOLLOWED:
            raise LogError(
                f"'{name}' follows the plan '{trial.name}' in {100 * share:.0f} % of its samples "
                f"at best, shifted by {shift:g} s, and {100 * _FOLLOWED:.0f} % are needed: name "
                f"the plan that was sailed, or leave out --plan."
            )
        counts: dict[str, int] = {}
        own: dict[str, list[TrialLog]] = {TRIAL: [], VALIDATION: []}
        for log in segments:
            row = trial.rows(log.t, shift)
            labels = np.array([trial.parts[k] if k >= 0 else "outside" for k in row])
            for label in dict.fromkeys(labels.tolist()):
                counts[label] = counts.get(label, 0) + int((labels == label).sum())
            edges = [0, *(np.flatnonzero(labels[1:] != labels[:-1]) + 1).tolist(), len(log)]
            for a, b in pairwise(edges):
                if b - a >= MIN_SEGMENT and labels[a] in own:
                    own[labels[a]].append(log.window(a, b, log.name))
        # as segments between gaps are named, so that they count as one log
        fit += numbered(own[TRIAL], name)
        judges += numbered(own[VALIDATION], f"{name}, {VALIDATION}")
        told.append(SailedPlan(name, trial.name, shift, share, counts))
    if not fit:
        counted = ", ".join(f"{n} {k}" for s in told for k, n in s.samples.items())
        raise LogError(
            f"no {MIN_SEGMENT} samples in a row of the logs belong to the part '{TRIAL}' of the "
            f"plan (there are {counted}): leave out --plan to estimate on all."
        )
    return fit, judges, tuple(told)


def _nearest(
    segments: Sequence[TrialLog], plan: Sequence[PlannedTrial]
) -> tuple[PlannedTrial, float, float]:
    """Return the trial that a log of segments follows best, its shift [s], and the share."""
    log = join_segments(segments, segments[0].name)
    best = (plan[0], 0.0, -1.0)
    # a trial that follows the plan by its own clock is not shifted
    for trial in plan:
        share = trial.followed(log, 0.0)
        best = (trial, 0.0, share) if share > best[2] else best
    if best[2] >= _FOLLOWED:
        return best
    for trial in plan:
        shift = trial.best_shift(log)
        share = trial.followed(log, shift)
        best = (trial, shift, share) if share > best[2] else best
    return best
