"""Motion that no force of a manoeuvring model makes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from greybox.diagnosis.causes.cause import Cause, Context
from greybox.diagnosis.hypothesis import Hypothesis


class Waves(Cause):
    """First-order wave motion."""

    id = "waves"
    kind = "sensor"
    title = "wave motion"
    signature = "narrow-band motion of all channels at one frequency, whatever the commands"
    extension = "none in the equations: motion at that frequency is the sea's, not the model's"
    reference = "Fossen (2011), section 8.2"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return none: the spectrum of the innovations tells, no parameter of a run."""
        return ()

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say the period."""
        frequency = values["wave_frequency"][0]
        return (
            f"all channels move at {frequency:.3f} Hz (a period of {1 / frequency:.0f} s of "
            f"encounter), whatever the commands"
        )
