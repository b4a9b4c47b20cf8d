"""What the demo has done so far: steps in words, the files they wrote, what they returned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from experiment_design.output.result import Design
from greybox.diagnosis.result import Diagnosis
from greybox.estimation.result import Estimate
from greybox.files import sha256
from greybox.study.blind_causes import Effect
from greybox.trial.checks.finding import CheckReport
from greybox.trial.log import TrialLog
from greybox.validation.comparison import Comparison
from greybox.validation.gain import Gain


@dataclass(frozen=True)
class Step:
    """One step of the loop.

    Parameters
    ----------
    title : str
    command : str
        What a user types for it, in the demo's folder; empty for the virtual sea.
    told : tuple of str
        What came out, in sentences.
    """

    title: str
    command: str
    told: tuple[str, ...]


class Files:
    """Where each step of the demo leaves its file.

    Parameters
    ----------
    folder : Path
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # the model that the first trial is designed with, and the designed commands
        self.prior, self.plan = folder / "prior.json", folder / "plan.csv"
        # the log of the designed trial, and one that takes no part in any fit
        self.trial, self.other = folder / "trial.csv", folder / "other.csv"
        # the estimated model, and that extended by the cause that was found
        self.model, self.better = folder / "model.json", folder / "better.json"
        self.next_plan, self.report = folder / "next_plan.csv", folder / "report.html"

    def hashes(self) -> dict[str, str]:
        """Return the SHA-256 of each step's file by its name."""
        written = (
            self.prior, self.plan, self.trial, self.other, self.model, self.better, self.next_plan
        )  # fmt: skip
        return {path.name: sha256(path) for path in written}


@dataclass(frozen=True)
class Demo:
    """The whole loop, once round.

    Parameters
    ----------
    files : Files
    steps : tuple of Step
    design, next_design : Design
    trial, other : TrialLog
    hidden : tuple of Effect
        What was wrong with the ship all along.
    check : CheckReport
    estimate : Estimate
    before, after : Comparison
        Free runs on the other log: of the estimate, and beside it of the extended model.
    gain : mapping of str to Gain
        By which the extended model's run on the other log is better, by channel.
    diagnosis : Diagnosis
    """

    files: Files
    steps: tuple[Step, ...]
    design: Design
    next_design: Design
    trial: TrialLog
    other: TrialLog
    hidden: tuple[Effect, ...]
    check: CheckReport
    estimate: Estimate
    before: Comparison
    after: Comparison
    gain: Mapping[str, Gain]
    diagnosis: Diagnosis
