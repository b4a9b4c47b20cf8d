"""Preparation of a diagnosis: repaired logs of sufficient length, a structure, its causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.causes import Cause, Context, known_causes
from greybox.diagnosis.evidence.kinematics import decided, denied, judged_by_kinematics, mended
from greybox.diagnosis.hypothesis import Hypothesis
from greybox.diagnosis.null_model import Clock, DiagnosisProblem, clocks_of
from greybox.diagnosis.point import Fit
from greybox.diagnosis.ship import CURRENTS, Change, derived_motions
from greybox.errors import LogError, UsageError, suggestion
from greybox.estimation.informative import require_commands, require_motion
from greybox.model.catalogue import for_inputs, get_structure, structure_for
from greybox.model.disturbances import WIND_TERMS
from greybox.model.model import ManoeuvringModel
from greybox.model.structure import Structure
from greybox.regression.regression import common_sample_time
from greybox.trial.checks.finding import Finding
from greybox.trial.convert.sensor_corrections import correct_log
from greybox.trial.log import TrialLog
from greybox.trial.segments import whole_name
from greybox.vessel.force import force_inputs
from greybox.vessel.thrust import typical_speed
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# samples that a diagnosis needs in every log
SHORTEST = 120


@dataclass(frozen=True)
class Prepared:
    """A case with the causes to look for.

    Parameters
    ----------
    case : DiagnosisProblem
    structure : Structure
        Without any cause.
    causes : mapping of str to Cause
    hypotheses : tuple of Hypothesis
        Of those causes, as far as these logs can show them.
    findings : tuple of Finding
        What the kinematics of the logs tell already; the logs are mended by them.
    validate : tuple of TrialLog
    short : tuple of str
        Names of logs left out.
    model : ManoeuvringModel or None
        As it was given.
    agreeing : frozenset of str
        Causes or places of which the kinematics show nothing though they could, or all there is.
    together : frozenset of str
        Channels that the kinematics show to have one clock.
    """

    case: DiagnosisProblem
    structure: Structure
    causes: Mapping[str, Cause]
    hypotheses: tuple[Hypothesis, ...]
    findings: tuple[Finding, ...]
    validate: tuple[TrialLog, ...]
    short: tuple[str, ...]
    model: ManoeuvringModel | None
    agreeing: frozenset[str] = frozenset()
    together: frozenset[str] = frozenset()

    @property
    def of_forces(self) -> tuple[Hypothesis, ...]:
        """The hypotheses without those of which sensors that agree show nothing."""
        return tuple(h for h in self.hypotheses if not denied(h.key, self.agreeing))

    @property
    def tried(self) -> int:
        """How many hypotheses are tried, for which p-values are corrected."""
        return len(self.hypotheses) + len(self.findings)

    def base(self) -> Fit:
        """Return the fit without causes."""
        model = self.model
        if model is None:
            return self.case.base(None, np.zeros(2))
        return self.case.base(self._coefficients(model), model.d[:2], self._changes(model))

    def as_given(self) -> Fit | None:
        """Return the model as it was given; None where there is none, or its run has no bound."""
        model = self.model
        if model is None:
            return None
        return self.case.as_given(
            self._coefficients(model), model.d[:2], model.integrator, self._changes(model)
        )

    def untried(self) -> list[str]:
        """Return the causes of which these logs leave nothing to try; waves need no hypothesis."""
        tried = {h.id for h in self.hypotheses} | {f.id for f in self.findings} | {"waves"}
        return [name for name in self.causes if name not in tried]

    @staticmethod
    def _coefficients(model: ManoeuvringModel) -> dict[str, float]:
        return dict(zip(model.names, map(float, model.theta), strict=True))

    def _changes(self, model: ManoeuvringModel) -> tuple[Change, ...]:
        """Return the model's changes, each by how much more than the one before."""
        before: dict[str, float] = {}
        out = []
        for change in sorted(model.changes, key=lambda c: c.time):
            name = change.parameter
            was = before.get(name, 1.0)
            if not was:
                raise UsageError(
                    f"{name} of the model is zero and changes again at {change.time:g} s, which a "
                    f"diagnosis cannot follow: leave its first change out."
                )
            place = self.case.universe.parameters.index(name)
            out.append(Change(place, change.factor / was, change.time))
            before[name] = change.factor
        return tuple(out)


def prepare(
    logs: Sequence[TrialLog],
    validate: Sequence[TrialLog],
    model: ManoeuvringModel | None,
    structure: str,
    ids: Sequence[str] | None,
) -> Prepared:
    """Set up the case of a diagnosis.

    Parameters
    ----------
    logs, validate : sequence of TrialLog
    model : ManoeuvringModel or None
    structure : str
        Where no model is given.
    ids : sequence of str or None
        Causes to look for; None for all.

    Raises
    ------
    LogError
        No log is long enough, one lacks a channel, or sample times differ.
    UsageError
        A cause does not exist.
    """
    common_sample_time([*logs, *validate])
    short = [log.name for log in (*logs, *validate) if len(log) < SHORTEST]
    # also the segments that are left out are of the log that a change counts in
    clocks = [
        [clock for log, clock in zip(every, clocks_of(every), strict=True) if len(log) >= SHORTEST]
        for every in (logs, validate)
    ]
    logs = _long_enough(logs)
    validate = _long_enough(validate) if validate else []
    causes = _chosen(ids)
    if model is None:
        require_commands(logs)
    else:
        _require_ship(model, [*logs, *validate])
    stated = logs[0].vessel if model is None else model.vessel
    # what is found is beyond what is stated already
    kinematics = judged_by_kinematics([correct_log(log, stated) for log in (*logs, *validate)])
    findings = [f for f in kinematics.findings if f.id in causes]
    vessel = mended(stated, findings)
    logs, own = _corrected(logs, clocks[0], vessel)
    validate, others = _corrected(validate, clocks[1], vessel)
    start = _structure(structure, logs, model)
    require_motion(logs, start)
    duration = min(length for _, length in (*own, *others))
    context = _context(start, logs, validate, duration, model, kinematics.together)
    # of a clock of one channel the kinematics tell all; an arm or a bias may be shared by all
    told = decided(findings) | {a for a in kinematics.agreeing if a.startswith("clock_offset:")}
    known = [a for c in causes.values() for a in c.hypotheses(context)]
    hypotheses = [a for a in known if not denied(a.key, told)]
    case = _case(start, hypotheses, logs, validate, (own, others))
    return Prepared(
        case,
        start,
        causes,
        tuple(hypotheses),
        tuple(findings),
        tuple(validate),
        tuple(short),
        model,
        kinematics.agreeing | told,
        kinematics.together,
    )


def _corrected(
    logs: Sequence[TrialLog], clocks: Sequence[Clock], vessel: Vessel
) -> tuple[list[TrialLog], list[Clock]]:
    """Return logs without their sensors' defects, and their clocks without the ends so cut."""
    made = [correct_log(log, vessel) for log in logs]
    ends = [
        (new.t[0] - old.t[0], old.t[-1] - new.t[-1]) for old, new in zip(logs, made, strict=True)
    ]
    return made, [
        (first + float(before), length - float(before + after))
        for (first, length), (before, after) in zip(clocks, ends, strict=True)
    ]


def with_own_sensors(logs: Sequence[TrialLog]) -> list[TrialLog]:
    """Return the logs that are long enough as `prepare` makes them where checks find nothing."""
    kept = _long_enough(logs)
    return [correct_log(log, kept[0].vessel) for log in kept]


def _long_enough(logs: Sequence[TrialLog]) -> list[TrialLog]:
    kept = [log for log in logs if len(log) >= SHORTEST]
    if not kept:
        longest = max(logs, key=len)
        gaps = whole_name(longest.name) != longest.name
        bridged = ", or bridge single missing rows by greybox import" if gaps else ""
        raise LogError(
            f"'{longest.name}' has {len(longest)} samples, a diagnosis needs at least {SHORTEST}: "
            f"give a longer log{bridged}."
        )
    return kept


# words of the field for what causes are called by
_ALSO = {
    "antenna": "lever_arm", "gps": "lever_arm", "set": "current", "tide": "current",
    "compass": "heading_bias", "gyro": "heading_bias", "lag": "thruster_lag",
    "delay": "input_delay", "rudder_offset": "angle_offset", "clock": "clock_offset",
}  # fmt: skip


def _chosen(ids: Sequence[str] | None) -> dict[str, Cause]:
    known = known_causes()
    for name in ids or ():
        if name not in known:
            raise UsageError(
                f"there is no cause '{name}'"
                f"{': write causes apart, with spaces' if ',' in name else ''}."
                f"{suggestion(_ALSO.get(name.casefold(), name), known)} Known: {', '.join(known)}."
            )
    return {k: c for k, c in known.items() if ids is None or k in ids}


def _structure(name: str, logs: Sequence[TrialLog], model: ManoeuvringModel | None) -> Structure:
    if model is not None:
        return model.structure
    inputs = force_inputs(logs[0].vessel)
    # also where a name takes terms away or adds some
    get_structure(name)
    structure = structure_for(name, inputs)
    still = [t for t in WIND_TERMS if t in structure.parameters]
    return for_inputs(structure.without(*still), inputs) if still else structure


def context_of(structure: Structure, ready: Prepared) -> Context:
    """Return what causes are told of a prepared case, with another structure."""
    case = ready.case
    duration = min(length for _, length in (*case.clocks[0], *case.clocks[1]))
    return _context(structure, case.logs, case.held_out_logs, duration, ready.model, ready.together)


def _context(
    structure: Structure,
    logs: Sequence[TrialLog],
    validate: Sequence[TrialLog],
    duration: float,
    model: ManoeuvringModel | None,
    together: frozenset[str],
) -> Context:
    first = logs[0]
    driven = [t.speed for t in first.vessel.thrusters]
    speeds = {c: typical_speed([log[c] for log in logs]) for c in driven}
    logs = [*logs, *validate]
    moved = {c: [log[c] for log in logs] for c in first.vessel.commands}
    turns = "r" in structure.states and all("psi" in log for log in logs)
    return Context(
        structure=structure,
        vessel=first.vessel,
        outputs=(*structure.states, "psi") if turns else structure.states,
        has_wind=all(log.has_wind for log in logs),
        duration=duration,
        sample_time=first.sample_time,
        speeds=speeds,
        current_known=model is not None and any(model.d[:2]),
        ranges={c: max(float(np.ptp(x)) for x in v) for c, v in moved.items()},
        fastest={
            c: max(float(np.abs(np.diff(x)).max()) for x in v) / first.sample_time
            for c, v in moved.items()
        },
        moves={c: _movement(v) for c, v in moved.items()},
        derived=together.union(*map(derived_motions, logs)),
        passage=_passage(logs),
    )


def _movement(commands: Sequence[Array]) -> float:
    """Return the typical size of a movement of a command (N,) of each log, large ones first."""
    sizes = []
    for value in commands:
        steps = np.diff(value)
        # one movement as long as it goes on the same way
        begins = np.flatnonzero(np.diff(np.sign(steps), prepend=0.0))
        sizes.append(np.abs(np.add.reduceat(steps, begins)) if len(begins) else np.zeros(0))
    every = np.concatenate(sizes)
    squares = float((every**2).sum())
    return float((every**3).sum()) / squares if squares else 0.0


def _passage(logs: Sequence[TrialLog]) -> float:
    """Return the time in which the ship sails her length [s], 0 where nothing tells her speed."""
    if not all("u" in log for log in logs):
        return 0.0
    speed = float(np.sqrt(np.mean(np.concatenate([log["u"] for log in logs]) ** 2)))
    return logs[0].vessel.length / max(speed, 1e-9)


def _case(
    structure: Structure,
    hypotheses: Sequence[Hypothesis],
    logs: Sequence[TrialLog],
    validate: Sequence[TrialLog],
    clocks: tuple[Sequence[Clock], Sequence[Clock]],
) -> DiagnosisProblem:
    names = dict.fromkeys(n for a in hypotheses for n in (*a.columns, *a.co_freed))
    added = [n for n in names if n not in structure.parameters and n not in CURRENTS]
    universe = structure.with_terms(*added)
    wind = universe.uses_air and all(log.has_wind for log in [*logs, *validate])
    both: tuple[int, ...] = (1, -1)
    return DiagnosisProblem(
        structure, universe, logs, validate,
        "basic+wind" if wind and structure.uses_air else "basic",
        tuple((s, both) for s in structure.states),
        clocks=clocks,
    )  # fmt: skip


def _require_ship(model: ManoeuvringModel, logs: Sequence[TrialLog]) -> None:
    """Raise where a log lacks a column that moves the thrusters of the model's ship."""
    for log in logs:
        if lacking := [c for c in model.vessel.commands if c not in log]:
            raise LogError(
                f"log '{log.name}' has no {', '.join(map(repr, lacking))}, which moves the "
                f"thrusters of the model's ship, '{model.vessel.name}': give a model of "
                f"'{log.vessel.name}', or leave --model out."
            )
