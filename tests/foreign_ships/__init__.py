"""Virtual ships that share no code and no structure with the product's model.

Judges of estimation, diagnosis and design, in NumPy and plain floats; nothing here imports the
product. `presets()` names the ships; `simulate(ship, manoeuvre, duration)` gives a `Trial` with
the truth and the log, `ship.vessel_toml()` the vessel file that a crew would write::

    from foreign_ships import manoeuvres, presets

    preset = presets()["kvlcc2-7m"]
    trial = preset.sail(manoeuvres.zigzag(20, 20), seed=1)
    trial.write_csv("zigzag.csv")
    Path("ship.toml").write_text(preset.ship.vessel_toml())

From a shell, ``PYTHONPATH=tests python -m foreign_ships kvlcc2-7m random zigzag-20 --out DIR``.
"""

from foreign_ships.environment import Current, Waves, Wind, Windage
from foreign_ships.presets import DEVELOPMENT, FINAL, Preset, presets, write_campaign
from foreign_ships.ship import SILENT, Actuator, Faults, Noise, Ship
from foreign_ships.simulate import Manoeuvre, Motion, Trial, simulate

__all__ = [
    "DEVELOPMENT",
    "FINAL",
    "SILENT",
    "Actuator",
    "Current",
    "Faults",
    "Manoeuvre",
    "Motion",
    "Noise",
    "Preset",
    "Ship",
    "Trial",
    "Waves",
    "Wind",
    "Windage",
    "presets",
    "simulate",
    "write_campaign",
]
