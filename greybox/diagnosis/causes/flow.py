"""Water and air that move: current, wind and waves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from greybox.diagnosis.causes.cause import Cause, Context
from greybox.diagnosis.causes.hull import term_parameters
from greybox.diagnosis.hypothesis import Hypothesis, Parameter
from greybox.model.disturbances import TURNING, WIND_TERMS
from greybox.notebook import with_error

# no current is stronger [m/s]
_STRONGEST = 5.0


class Current(Cause):
    """A current that is constant over the trial."""

    id = "current"
    kind = "flow"
    title = "current"
    signature = (
        "errors of surge and sway over ground that turn with the heading: one compass direction "
        "is always too slow, the opposite too fast"
    )
    extension = (
        "the mean current, north and east; forces see the velocity through the water, which turns "
        "in body axes as the ship does"
    )
    reference = "Ljungberg (2020), eq. 5.2; Fossen (2011), section 8.3"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return the two components together."""
        if context.current_known or not context.structure.marine:
            return ()
        return (
            Hypothesis(
                self.id, self.id,
                tuple(
                    Parameter(n, "m/s", 0.0, -_STRONGEST, _STRONGEST)
                    for n in ("current_north", "current_east")
                ),
                columns=("current_north", "current_east"),
                # in still air the hull feels its velocity over ground, not through the water
                co_freed=context.lacking(
                    *TURNING, *(() if context.has_wind else WIND_TERMS)
                ),
            ),
        )  # fmt: skip

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say speed and direction."""
        (north, a), (east, b) = values["current_north"], values["current_east"]
        speed = float(np.hypot(north, east))
        std = np.hypot(north * a, east * b) / speed if speed else np.hypot(a, b)
        return (
            f"the errors of surge and sway turn with the heading as in a current of "
            f"{with_error(speed, float(std))} m/s towards "
            f"{np.rad2deg(np.arctan2(east, north)) % 360:.0f} deg"
        )


class Wind(Cause):
    """Forces of the measured wind."""

    id = "wind"
    kind = "flow"
    title = "wind force"
    signature = "errors that follow the square of the measured velocity through the air"
    extension = "the wind terms of (3.51) on the measured velocity through the air"
    reference = "Ljungberg (2020), eq. 3.51; Blendermann (1994)"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return the lacking wind terms together, where the wind was measured."""
        lacking = context.lacking(*WIND_TERMS) if context.has_wind else ()
        if not lacking:
            return ()
        return (Hypothesis(self.id, self.id, term_parameters(lacking, context), columns=lacking),)

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say which equations feel it."""
        felt = [n for n, (v, s) in values.items() if s > 0 and abs(v) > 2 * s] or list(values)
        return (
            f"the errors follow the square of the measured velocity through the air "
            f"({', '.join(f'{n} = {values[n][0]:.2g}' for n in felt)})"
        )


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
