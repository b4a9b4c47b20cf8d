"""Named ships of several kinds and sizes, each with its noise and the sampling of its logs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from foreign_ships import mmg
from foreign_ships.ship import Noise, Ship
from foreign_ships.simulate import Manoeuvre, Trial, simulate


@dataclass(frozen=True)
class Preset:
    """A ship with the sample time [s] and the usual length [s] of its trials."""

    ship: Ship
    dt: float
    duration: float

    def sail(self, commands: Manoeuvre, duration: float | None = None, **where: Any) -> Trial:
        """Simulate with this preset's sampling; `where` is that of `simulate`."""
        where.setdefault("step", max(0.1, min(0.5, self.ship.time_scale / 60)))
        return simulate(self.ship, commands, duration or self.duration, self.dt, **where)


def presets() -> dict[str, Preset]:
    """Return every ship by its name."""
    rtk = Noise(position=0.01, heading=0.002, u=0.005, v=0.005, r=0.002, wind=0.2)
    bridge = Noise(position=0.5, heading=0.003, u=0.03, v=0.03, r=0.0002, wind=0.5)
    return {
        "kvlcc2-7m": Preset(mmg.kvlcc2(noise=rtk), 0.1, 720.0),
        "kvlcc2-320m": Preset(mmg.kvlcc2(320.0, noise=bridge), 1.0, 3600.0),
        "training-ship-105m": Preset(mmg.training_ship(noise=bridge), 0.5, 1800.0),
        "esso-osaka-3m": Preset(
            mmg.esso_osaka(noise=Noise(position=0.01, heading=0.003, u=0.01, v=0.01, r=0.002)),
            0.1,
            720.0,
        ),
    }


DEVELOPMENT: tuple[str, ...] = (
    "kvlcc2-7m",
    "kvlcc2-320m",
    "training-ship-105m",
    "esso-osaka-3m",
)
