"""The inputs of a model on a log: generalised inputs and heading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.model.run.step import Heading
from greybox.model.structure import Structure
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LogInputs:
    """What a structure reads of a log beside its states.

    Parameters
    ----------
    tau : ndarray
        (N, nu) generalised inputs: the forces of the thrusters, or the channels
        themselves of a structure that is no ship's.
    psi : ndarray
        (N,) measured heading [rad], zero of a log without.
    """

    tau: Array
    psi: Array

    def heading(self, structure: Structure, heading: Heading) -> Array | None:
        """Return the heading that a free run is given (N,), None where it simulates its own."""
        simulated = heading == "simulated" and structure.turns
        return None if simulated or not structure.marine else self.psi

    @classmethod
    def of(cls, structure: Structure, log: TrialLog) -> LogInputs:
        """Read a log."""
        names = structure.inputs
        tau = log.forces(names) if structure.marine else np.column_stack([log[n] for n in names])
        return cls(tau, log["psi"] if "psi" in log else np.zeros(len(log)))
