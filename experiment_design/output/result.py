"""The result of a design: sequences, their information, and how they keep the limits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from experiment_design.certificate.certificate import Certificate
from experiment_design.constraints.limits import TOLERANCE, LimitReport
from experiment_design.criteria.optimality import CRITERIA
from experiment_design.excitation.rollout import Motion
from experiment_design.feasibility.constraint_satisfaction import ConstraintSatisfaction
from experiment_design.optimise.classical import Alternative
from experiment_design.optimise.search import REFERENCE
from experiment_design.request.regimes import spell_regime
from experiment_design.request.request import PreparedRequest, build_problem
from greybox.channels import CHANNELS
from greybox.errors import so_many
from greybox.files import replacing
from greybox.notebook import DisplayMixin, interval, items, number, sparkline, table, text
from greybox.numerics.linalg import scaled_logdet
from greybox.trial.plan_parts import LEAD_IN, TRIAL

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlanPart:
    """A part of a plan: what a stretch of a trial is sailed for.

    Parameters
    ----------
    name : {"lead-in", "trial", "validation"}
    trial : int
        Counted from 0.
    begin, end : float
        Since the trial's first command [s].
    """

    name: str
    trial: int
    begin: float
    end: float

    @property
    def seconds(self) -> float:
        """Its length [s]."""
        return self.end - self.begin


def run_through(request: PreparedRequest, levels: Array) -> Motion:
    """Return the motion from the lead-in's first command to the end of a trial of levels (K, nc).

    Lag and delay of the vessel are in it.
    """
    whole = request.from_first_command()
    commands = whole.schedule.expand(request.with_lead_in(levels))
    return build_problem(whole).scenarios[0].rollout.run(commands[None], late=True)


@dataclass(frozen=True, repr=False)
class Design(DisplayMixin):
    """Sequences for the next trials, with their information and limits.

    All fields but `parts` speak of the trials behind a lead-in; see `from_first_command`.

    Parameters
    ----------
    request : PreparedRequest
    commands : tuple of ndarray
        (N, nc) per trial: speeds in the log's unit, angles [rad].
    levels : tuple of ndarray
        (K, nc) per trial, one row a hold.
    motions : tuple of Motion
        Predicted motion of each trial under the nominal model.
    names : tuple of str
        The wanted parameters.
    values : ndarray
        (p_w,) their prior values.
    covariance : ndarray
        (p_w, p_w) predicted covariance of their estimates.
    criterion_value : float
        On the scale of `Criterion`.
    efficiency_vs_random : float or None
        Against the best of 200 random two-level sequences that keep the limits;
        None where none of them does.
    random_value : float
        Criterion of that one, nan where there is none.
    random_kept : int
        How many were found that keep the limits.
    certificate : Certificate
    margins : dict of str to float
        Least |u_r| and |v_r| (or |r|) over all trials.
    limits : tuple of LimitReport
    keeping : ConstraintSatisfaction or None
        Probability of keeping the limits under models drawn from the prior.
    alternatives : tuple of Alternative
        Classical sequences by the same criterion, for the first trial of one.
    status : str
        A sentence on how the design ended.
    notes : tuple of str
    evaluations : int
    seconds : float
    parts : tuple of PlanPart
        In order, lead-in included; empty where each trial is one part.
    random_std : ndarray or None
        (p_w,) predicted standard errors of the best random two-level sequences.
    shorter : str
        Command of a shorter plan that was tried and keeps limits that this one may not.
    """

    request: PreparedRequest
    commands: tuple[Array, ...]
    levels: tuple[Array, ...]
    motions: tuple[Motion, ...]
    names: tuple[str, ...]
    values: Array
    covariance: Array
    criterion_value: float
    efficiency_vs_random: float | None
    random_value: float
    random_kept: int
    certificate: Certificate
    margins: dict[str, float]
    limits: tuple[LimitReport, ...]
    keeping: ConstraintSatisfaction | None
    alternatives: tuple[Alternative, ...]
    status: str
    notes: tuple[str, ...]
    evaluations: int
    seconds: float
    parts: tuple[PlanPart, ...] = ()
    random_std: Array | None = None
    shorter: str = ""

    @property
    def lead_in_s(self) -> float:
        """Length of the lead-in [s], 0 without one."""
        return sum(p.seconds for p in self.parts if p.name == LEAD_IN)

    @property
    def broken(self) -> tuple[LimitReport, ...]:
        """Limits that the nominal motion misses by more than rounding."""
        return tuple(x for x in self.limits if x.missed > 10 * TOLERANCE)

    @property
    def doubtful(self) -> bool:
        """Whether the limits are kept with a lower probability than was asked for."""
        return self.keeping is not None and self.keeping.probability < self.request.probability

    @property
    def remedy(self) -> str:
        """What helps a plan that breaks its limits, or may; empty where it keeps them."""
        if not (self.broken or self.doubtful):
            return ""
        r = self.request
        if r.stand_ins:
            return f"design it with {r.stand_ins}, or widen the limits of the thrusters"
        wider = "give it more room (--area, --circle), " if r.limits.area is not None else ""
        less = "narrow --envelope" if r.misfit is not None else "lower the margins"
        return (
            f"{wider}shorten it (--duration), {less}, or sail a short trial first and design again "
            f"with the model that it gives"
        )

    def share(self, part: PlanPart) -> float:
        """Return what a part takes of its trial's time, lead-in included."""
        own = [p.seconds for p in self.parts if p.trial == part.trial]
        return part.seconds / sum(own) if own else 1.0

    def part_names(self, trial: int, t: NDArray[np.floating[Any]]) -> tuple[str, ...]:
        """Return the part that each of the times t (N,) [s] of a trial belongs to, if any does."""
        own = [p for p in self.parts if p.trial == trial]
        if not own:
            return ()
        # times are multiples of the sample time, parts begin at such
        begins = np.array([p.begin for p in own]) - 0.5 * self.request.sample_time
        return tuple(own[i].name for i in np.searchsorted(begins, t, side="right") - 1)

    def from_first_command(self) -> Design:
        """Return the plan as it is sailed: commands, levels, motion and start with the lead-in."""
        r = self.request
        if r.lead_in is None:
            return self
        motion = run_through(r, self.levels[0])
        return replace(
            self,
            request=r.from_first_command(),
            commands=(motion.commands[0],),
            levels=(r.with_lead_in(self.levels[0]),),
            motions=(motion,),
        )

    @property
    def std(self) -> Array:
        """Predicted standard errors (p_w,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def logdet(self) -> float:
        """−log det of the predicted covariance."""
        return logdet_information(self.covariance)

    def efficiency(self, covariance: Array) -> float:
        """Return (det C_other / det C)^(1/p) of another covariance (p_w, p_w)."""
        gain = self.logdet - logdet_information(covariance)
        return float(np.exp(gain / len(self.names)))

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON, the main ones first."""
        r = self.request
        return {
            "status": self.status,
            "criterion": r.criterion,
            "logdet": self.logdet,
            "efficiency_vs_random": self.efficiency_vs_random,
            "efficiency_lower_bound": self.certificate.efficiency_lower_bound,
            "predicted_std": dict(zip(self.names, self.std, strict=True)),
            "margins": self.margins,
            "wall_s": self.seconds,
            "parameters": dict(zip(self.names, self.values, strict=True)),
            "predictor": r.predictor,
            "estimator": r.estimator,
            "trials": r.trials,
            "duration": r.duration,
            "hold": r.hold,
            "lead_in_s": self.lead_in_s,
            "parts": [
                {
                    "part": p.name,
                    "trial": p.trial + 1,
                    "from": p.begin,
                    "to": p.end,
                    "share": self.share(p),
                }
                for p in self.parts
                or [PlanPart(TRIAL, t, 0.0, r.duration) for t in range(r.trials)]
            ],
            "regimes": [spell_regime(s) for s in r.regimes],
            "starts": [
                dict(zip((*r.structure.states, "psi"), s, strict=True))
                for s in r.from_first_command().starts
            ],
            "start_commands": [
                r.from_first_command().commands_at_start(t) for t in range(r.trials)
            ],
            "random_kept": self.random_kept,
            "certificate": self.certificate.to_dict(),
            "limits": [
                {
                    "trial": x.trial + 1,
                    "name": x.name,
                    "bound": x.bound,
                    "unit": x.unit,
                    "missed": x.missed,
                }
                for x in self.limits
            ],
            "keeps_limits": None if self.keeping is None else self.keeping.to_dict(),
            "alternatives": [
                {
                    "name": a.name,
                    "tried": a.tried,
                    "kept": a.kept,
                    "efficiency_of_design": self._gain(a.value),
                }
                for a in self.alternatives
            ],
            "noise": {
                "measurement": dict(zip(r.structure.states, r.noise.measurement, strict=True)),
                "process": dict(zip(r.structure.states, r.noise.process, strict=True)),
                "source": r.noise.source,
            },
            "evaluations": self.evaluations,
            "notes": list(self.notes),
        }

    def _gain(self, value: float) -> float | None:
        if not np.isfinite(value):
            return None
        size = CRITERIA[self.request.criterion].shared_by(len(self.names))
        return float(np.exp((self.criterion_value - value) / size))

    @property
    def gain_vs_random(self) -> float | None:
        """`efficiency_vs_random`, by the criterion that was designed for where it is not D."""
        if self.efficiency_vs_random is None or CRITERIA[self.request.criterion].determinant:
            return self.efficiency_vs_random
        return self._gain(self.random_value)

    @property
    def by_criterion(self) -> str:
        """Which information `gain_vs_random` compares, for a sentence; empty for that of D."""
        criterion = CRITERIA[self.request.criterion]
        return "" if criterion.determinant else f" by criterion {criterion.name}"

    def _behind(self) -> str:
        return f" behind a lead-in of {self.lead_in_s:g} s" if self.lead_in_s else ""

    def missed(self) -> list[str]:
        """Return which limits are not kept, each with its bound and by how much."""
        return [
            f"the {x.phrase} is missed by {x.missed:.3g} {x.unit}".rstrip() for x in self.broken
        ]

    def summary(self) -> str:
        """Return the design as text."""
        r = self.request
        lines = [
            f"Plan for {r.vessel.name}: {so_many(r.trials, 'trial')} of "
            f"{r.duration:g} s{self._behind()}, commands change every {r.hold:g} s, regime "
            f"{', '.join(spell_regime(s) for s in r.regimes)}",
            f"{self.status}",
            *(["planned without an estimated model, from main dimensions"] if r.untried else []),
        ]
        if (gain := self.gain_vs_random) is not None:
            lines.append(
                f"{gain:.2f} times the information{self.by_criterion} of the best of "
                f"{min(self.random_kept, REFERENCE)} random two-level sequences, which would need "
                f"{gain * r.duration * r.trials:.0f} s for the same precision"
            )
        else:
            lines.append("no random two-level sequence keeps the limits, so there is none to beat")
        lines.append(self.certificate.sentence())
        margins = ", ".join(
            f"{k} {v:.3g} {CHANNELS[k].unit if k in CHANNELS else ''}".rstrip()
            for k, v in self.margins.items()
        )
        if margins:
            lines.append(f"least distance from zero: {margins}")
        lines += self.missed()
        if self.keeping is not None:
            lines.append(self.keeping.sentence())
        wide = max(14, *map(len, self.names))
        lines += ["", f"{'parameter':<{wide}}{'prior':>12}{'std err':>12}{'relative':>11}"]
        for name, value, std in zip(self.names, self.values, self.std, strict=True):
            share = f"{100 * abs(std / value):.1f} %" if value else "-"
            lines.append(f"{name:<{wide}}{value:>12.4g}{std:>12.2g}{share:>11}")
        if self.alternatives:
            lines += ["", f"{'instead of':<28}{'tried':>7}{'kept':>7}  this plan gives"]
            for a in self.alternatives:
                gain = self._gain(a.value)
                shown = "-" if gain is None else f"{gain:.2f} times"
                if gain is None or gain > 1000:
                    shown = "tells nothing"
                if not a.kept:
                    shown += " (breaks limits)"
                lines.append(f"{a.name:<28}{a.tried:>7}{a.kept:>7}  {shown}")
        lines += [f"Note: {n}" for n in self.notes]
        return "\n".join(lines)

    def to_pandas(self) -> pd.DataFrame:
        """Return the plan as `write_plan` writes it.

        Returns
        -------
        DataFrame
            Index ``t`` [s], or ``trial``, ``t`` where there are several trials; one column
            a command, behind ``part`` where there are parts. Each row holds until the next.
        """
        import pandas as pd

        r = self.request
        frames = []
        for trial, commands in enumerate(self.from_first_command().commands):
            t = np.arange(len(commands)) * r.sample_time
            frame = pd.DataFrame(commands, columns=list(r.schedule.commands))
            frame = frame.assign(trial=trial + 1, t=t)
            frames.append(frame.assign(part=self.part_names(trial, t)) if self.parts else frame)
        index = ["trial", "t"] if r.trials > 1 else ["t"]
        columns = [*(["part"] if self.parts else []), *r.schedule.commands]
        plan = pd.concat(frames).set_index(index)[columns]
        plan.attrs = {"sample_time": r.sample_time, "vessel": r.vessel.name}
        return plan

    def _line(self) -> str:
        return (
            f"plan for {self.request.vessel.name}: {self.request.trials} of "
            f"{self.request.duration:g} s{self._behind()}; {self.status}"
        )

    def _parts(self) -> tuple[str, ...]:
        names = self.request.schedule.commands
        told = zip(self.names, self.values, self.std, strict=True)
        return (
            text(f"{self.certificate.sentence()[0].upper()}{self.certificate.sentence()[1:]}."),
            items("Limits not kept", self.missed()),
            table(
                ("trial", "command", "least", "most", "over time"),
                [
                    (k + 1, n, number(c.min()), number(c.max()), sparkline(c))
                    for k, plan in enumerate(self.from_first_command().commands)
                    for n, c in zip(names, plan.T, strict=True)
                ],
            ),
            table(
                ("parameter", "prior", "predicted std err", "95 % of the estimate"),
                [(n, number(v), number(s, 2), interval(v, s)) for n, v, s in told],
            ),
            items("Notes", self.notes),
        )


def logdet_information(covariance: Array) -> float:
    """Return −log det of a covariance, scaled so that units cost no digits."""
    d = np.diag(covariance)
    if not np.isfinite(d).all() or not (d > 0).all():
        return float("-inf")
    return -float(scaled_logdet(covariance))


def write_plan(design: Design, path: str | Path) -> None:
    """Write the commands as CSV of ``t`` and the thruster columns, ``trial`` first if several.

    Each row holds from its time on until the next. A column ``part`` behind ``t`` says what a row
    is sailed for, where there is more than one part.

    Parameters
    ----------
    design : Design
    path : str or Path
    """
    r = design.request
    names = r.schedule.commands
    several = r.trials > 1
    with replacing(path) as handle:
        handle.write(
            ",".join(
                [*(["trial"] if several else []), "t", *(["part"] if design.parts else []), *names]
            )
            + "\n"
        )
        for trial, commands in enumerate(design.from_first_command().commands):
            t = np.arange(len(commands)) * r.sample_time
            part = design.part_names(trial, t)
            for k, row in enumerate(commands):
                cells = [f"{t[k]:.10g}", *part[k : k + 1], *(f"{v:.10g}" for v in row)]
                handle.write(",".join([*([str(trial + 1)] if several else []), *cells]) + "\n")
