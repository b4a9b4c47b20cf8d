"""The base class of causes, and the data that a cause is given."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.hypothesis import Hypothesis
from greybox.model.structure import Structure
from greybox.notebook import DisplayMixin, table
from greybox.vessel.force import force_inputs
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]
Kind = Literal["force", "flow", "thruster", "sensor", "change"]


@dataclass(frozen=True)
class Context:
    """The case that causes are sought for.

    Parameters
    ----------
    structure : Structure
        Of the model that is diagnosed.
    vessel : Vessel
    outputs : tuple of str
        Channels that are compared.
    has_wind : bool
        Whether the velocity through the air was measured in every log.
    duration : float
        Of the shortest log [s].
    sample_time : float
        [s]
    speeds : mapping of str to float
        Typical size of each propeller speed.
    current_known : bool
        Whether the model has a current already.
    ranges : mapping of str to float
        Largest less smallest value of each command.
    fastest : mapping of str to float
        Fastest change of each command from sample to sample [per second].
    moves : mapping of str to float
        Typical size of a movement of each command from one rest or turn to the next.
    derived : frozenset of str
        Velocities and yaw rate that were made of other channels, or shown to have the clock of
        those.
    passage : float
        Time in which the ship sails her length [s]; 0 where nothing tells her speed.
    """

    structure: Structure
    vessel: Vessel
    outputs: tuple[str, ...]
    has_wind: bool
    duration: float
    sample_time: float
    speeds: Mapping[str, float]
    current_known: bool = False
    ranges: Mapping[str, float] = field(default_factory=dict)
    fastest: Mapping[str, float] = field(default_factory=dict)
    moves: Mapping[str, float] = field(default_factory=dict)
    derived: frozenset[str] = frozenset()
    passage: float = 0.0

    def lacking(self, *terms: str) -> tuple[str, ...]:
        """Return the named terms that the structure allows but does not contain.

        A spelling that equals a term of (3.55) comes back by its name there.
        """
        from greybox.model.terms import parse_term

        keys = {t.key for t in self.structure.terms}
        signals = {*self.structure.states, *self.structure.inputs, "uq", "vq", "uc", "vc"}
        made = force_inputs(self.vessel)
        if "taun" in made and "tauy" not in made:
            # fixed thrusters side by side steer and never push aside
            signals.discard("tauy")
        out = []
        for name in terms:
            term = parse_term(name)
            fits = term.state in self.structure.states and all(
                f.signal in signals for f in term.factors
            )
            if fits and term.key not in keys:
                out.append(term.name)
        return tuple(out)


class Cause(DisplayMixin):
    """A reason why a simulation may disagree with the sea.

    A subclass states the class variables and gives its hypotheses. It becomes known to
    every diagnosis by an entry point of the group ``greybox.causes``.

    Attributes
    ----------
    id : str
        By which results name it.
    kind : {"force", "flow", "thruster", "sensor", "change"}
    title : str
        A few words.
    signature : str
        What it looks like in a log, one sentence.
    extension : str
        What the extended model has.
    reference : str
    """

    id: ClassVar[str]
    kind: ClassVar[Kind]
    title: ClassVar[str]
    signature: ClassVar[str]
    extension: ClassVar[str]
    reference: ClassVar[str]

    def summary(self) -> str:
        """Return how the cause shows in a log, and what mends it, as text."""
        return "\n".join([self._line(), *(f"  {name}: {said}" for name, said in self._said())])

    def _line(self) -> str:
        return f"{self.id}: {self.title}"

    def _said(self) -> list[tuple[str, str]]:
        return [
            ("signature", self.signature),
            ("extension", self.extension),
            ("reference", self.reference),
        ]

    def _parts(self) -> tuple[str, ...]:
        return (table(("what", "is"), self._said()),)

    @abstractmethod
    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return the hypotheses of this cause; none where it cannot occur in these logs."""

    @abstractmethod
    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Return the evidence for the cause in one sentence.

        Parameters
        ----------
        values : mapping of str to (float, float)
            Parameter name -> estimate and standard error.
        """

    def evidence_of(self, hypothesis: Hypothesis, values: Mapping[str, tuple[float, float]]) -> str:
        """Return the evidence sentence of one hypothesis, with its place where that matters."""
        return self.evidence(values)
