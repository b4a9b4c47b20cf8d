"""The output model: simulated quantities, their inputs and unknowns.

States z are those of the structure and, where it is simulated, the heading; the
outputs are the measured states, and the heading and the velocity through the
air where they count as measurements and not as inputs. The parameters are the
coefficients of a predictor's columns, followed by disturbance means.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from greybox.errors import StructureError
from greybox.model.disturbances import CURRENT, WIND
from greybox.model.predictor import Column, Predictor

Role = Literal["input", "output"]


@dataclass(frozen=True)
class OutputModel:
    """The simulated quantities, their inputs and unknowns.

    Parameters
    ----------
    predictor : Predictor
        Its columns are the terms of each equation; coefficients in its order.
    sample_time : float
        [s]
    heading : {"input", "output"}
        The measured heading drives the run, or is simulated and compared.
    wind : {"input", "output"}
        Likewise for the velocity through the air; as an output it follows from
        a constant wind.
    means : tuple of str
        Disturbance means that are parameters, such as the current.
    integrator : {"euler", "rk4"}
    """

    predictor: Predictor
    sample_time: float
    heading: Role = "input"
    wind: Role = "input"
    means: tuple[str, ...] = ()
    integrator: Literal["euler", "rk4"] = "euler"

    def __post_init__(self) -> None:
        structure = self.predictor.structure
        if self.heading == "output" and "r" not in structure.states:
            raise StructureError(
                f"structure '{structure.name}' has no yaw rate, so its heading cannot be "
                f"simulated: take the heading as an input."
            )
        unknown = [n for n in self.means if n not in structure.disturbances]
        if unknown:
            raise StructureError(
                f"structure '{structure.name}' has no disturbance '{unknown[0]}'. "
                f"It has: {', '.join(structure.disturbances) or 'none'}."
            )
        if self.wind == "output" and not set(WIND) <= set(self.means):
            raise StructureError(
                f"the velocity through the air follows from {', '.join(WIND)}, which are no "
                f"parameters here: take the wind as an input."
            )

    @property
    def states(self) -> tuple[str, ...]:
        """Simulated states, the heading last where it is simulated."""
        own = self.predictor.structure.states
        return (*own, "psi") if self.heading == "output" else own

    @property
    def outputs(self) -> tuple[str, ...]:
        """Channels that are compared."""
        return (*self.states, "u_q", "v_q") if self.wind == "output" else self.states

    @property
    def drivers(self) -> tuple[str, ...]:
        """What a step reads of the log: generalised inputs, heading, wind."""
        structure = self.predictor.structure
        names = list(structure.inputs)
        if self.heading == "input" and structure.marine:
            names.append("psi")
        if self.wind == "input" and self.predictor.air_measured:
            names += ["u_q", "v_q"]
        return tuple(names)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters: equation and column, then the means."""
        columns = [c.label if not c.is_bias else f"{c.state}: {c.name}" for c in self.columns]
        return (*columns, *self.means)

    @property
    def columns(self) -> tuple[Column, ...]:
        """Columns of the predictor."""
        return self.predictor.columns


def current_means(predictor: Predictor) -> tuple[str, ...]:
    """Return the means of the current that a marine structure can feel."""
    structure = predictor.structure
    if not structure.marine:
        return ()
    sees = {f.signal for t in structure.terms for f in t.factors} & {"u", "v"}
    return CURRENT if sees else ()
