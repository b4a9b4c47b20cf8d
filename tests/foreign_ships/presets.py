"""Named ships of several kinds and sizes, each with its noise and the sampling of its logs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from foreign_ships import azimuth_vessel, catamaran, mmg
from foreign_ships.environment import GRAVITY, Current, Waves, Wind
from foreign_ships.manoeuvres import kinds
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

    def weather(self, seed: int, strength: float = 1.0, waves: bool = False) -> dict[str, Any]:
        """Draw wind, current and waves that a trial of this ship could be held in.

        At strength 1 the wind reaches the service speed and the current a tenth of it, so that a
        model on a pond has a breeze and a ship a fresh wind. Give it to `sail`.
        """
        rng = np.random.default_rng([seed, 4])
        speed = strength * self.ship.service_speed
        where: dict[str, Any] = {
            "wind": Wind(
                speed * rng.uniform(0.3, 1.0),
                rng.uniform(-math.pi, math.pi),
                gusts=0.1 * speed,
                time=2 * self.ship.time_scale,
            ),
            "current": Current(
                speed * rng.uniform(0.02, 0.1),
                rng.uniform(-math.pi, math.pi),
                spread=0.01 * speed,
                time=60 * self.ship.time_scale,
            ),
        }
        if waves:
            length = self.ship.length * rng.uniform(0.3, 1.0)
            period = math.sqrt(2 * math.pi * length / GRAVITY)
            where["waves"] = Waves(0.01 * length * strength, period, rng.uniform(-3, 3))
        return where


def presets() -> dict[str, Preset]:
    """Return every ship by its name."""
    model = Noise(position=0.01, heading=0.002, u=0.003, v=0.003, r=0.001, wind=0.2)
    boat = Noise(position=0.02, heading=0.005, u=0.02, v=0.02, r=0.003, wind=0.3, speed=2.0)
    survey = Noise(position=0.05, heading=0.002, u=0.03, v=0.03, r=0.0005, wind=0.4, angle=0.003)
    bridge = Noise(position=0.5, heading=0.003, u=0.03, v=0.03, r=0.0002, wind=0.5)
    tug = Noise(position=0.3, heading=0.008, u=0.04, v=0.04, r=0.002, wind=0.5, angle=0.01)
    return {
        "kvlcc2-7m": Preset(mmg.kvlcc2(noise=model), 0.1, 720.0),
        "kvlcc2-320m": Preset(mmg.kvlcc2(320.0, noise=bridge), 1.0, 3600.0),
        "training-ship-105m": Preset(mmg.training_ship(noise=bridge), 0.5, 1800.0),
        "esso-osaka-3m": Preset(mmg.esso_osaka(noise=replace(model, u=0.005, v=0.005)), 0.1, 720.0),
        "survey-catamaran-1.2m": Preset(catamaran.survey_craft(1.2, noise=boat), 0.1, 600.0),
        "survey-catamaran-2m": Preset(catamaran.survey_craft(2.0, noise=boat), 0.2, 720.0),
        "research-catamaran-29m": Preset(catamaran.research_catamaran(noise=survey), 0.2, 1200.0),
        "research-vessel-29m": Preset(azimuth_vessel.research_vessel(noise=survey), 0.2, 1200.0),
        "workboat-12m": Preset(azimuth_vessel.workboat(noise=tug), 0.1, 720.0),
        "azimuth-ferry-18m": Preset(azimuth_vessel.ferry(noise=survey), 0.2, 900.0),
    }


# what estimation and diagnosis may be developed on: screw ships and catamarans
DEVELOPMENT: tuple[str, ...] = (
    "kvlcc2-7m",
    "kvlcc2-320m",
    "training-ship-105m",
    "esso-osaka-3m",
    "survey-catamaran-1.2m",
    "survey-catamaran-2m",
    "research-catamaran-29m",
)

# the vessels with azimuths are looked at only at the end, once, when nothing is changed any more;
# until then their simulator is tested here and its logs are estimated nowhere
FINAL: tuple[str, ...] = ("research-vessel-29m", "workboat-12m", "azimuth-ferry-18m")


def write_campaign(
    folder: str | Path,
    name: str,
    manoeuvres: Sequence[str],
    seed: int,
    *,
    weather: float = 0.0,
    waves: bool = False,
    every: int = 1,
    thrust: str | None = None,
) -> tuple[Path, list[Path]]:
    """Sail one trial for each named manoeuvre, and write the vessel file and the logs.

    Parameters
    ----------
    folder : path
        Made where it does not exist.
    name : str
        Of `presets`.
    manoeuvres : sequence of str
        Of `manoeuvres.kinds`.
    seed : int
        The trials draw their chance from it, each its own; one weather lasts for all.
    weather, waves :
        See `Preset.weather`; with wind the logs hold the apparent wind.
    every : int
        Only every so many samples are written.
    thrust : str, optional
        Thrust law of the vessel file.

    Returns
    -------
    path
        The vessel file.
    list of path
        The logs, numbered and named by manoeuvre.
    """
    preset = presets()[name]
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    vessel = folder / "vessel.toml"
    vessel.write_text(preset.ship.vessel_toml(thrust))
    where = preset.weather(seed, weather, waves) if weather else {}
    logs = []
    for i, kind in enumerate(manoeuvres):
        trial = preset.sail(kinds()[kind], seed=1000 * seed + i, **where)
        logs.append(trial.write_csv(folder / f"{i:02d}-{kind}.csv", every, wind=bool(weather)))
    return vessel, logs
