"""Ships whose manoeuvres have closed forms."""

from __future__ import annotations

import numpy as np

from greybox.model.catalogue import get_structure, structure_for
from greybox.model.model import ManoeuvringModel
from greybox.model.structure import Structure
from greybox.vessel.force import force_inputs
from greybox.vessel.toml import vessel_from_dict
from greybox.vessel.vessel import Vessel

LENGTH = 20.0
# parameters per second
LINEAR = {
    "Xu": -0.05, "Xmu": 0.01, "Yv": -0.2, "Yur": -0.5, "Ymu": 0.01, "Nr": -0.3, "Nuv": -0.005,
    "Nmu": 0.001,
}  # fmt: skip
RUDDER = {
    "Xuu": -0.02, "Xmu": 0.01, "X_|u|u*rudder_drag": -0.01, "Yv": -0.2, "Yur": -0.4,
    "Y_|u|u*rudder": -0.02, "Nr": -0.25, "Nuv": -0.004, "N_|u|u*rudder": 0.006,
}  # fmt: skip


def azimuth_ship(**thruster: object) -> Vessel:
    """Return a ship with one azimuth thruster aft."""
    own = {"type": "azimuth", "x": -8.0, "speed": "n", "angle": "a", **thruster}
    return vessel_from_dict({"name": "Azimuth ship", "length": LENGTH, "thruster": [own]})


def rudder_ship(actuation: dict[str, object] | None = None, **thruster: object) -> Vessel:
    """Return a ship with one propeller and rudder."""
    own = {"type": "propeller_rudder", "x": -9.0, "speed": "n", "rudder": "delta", **thruster}
    tables: dict[str, object] = {"name": "Rudder ship", "length": LENGTH, "thruster": [own]}
    return vessel_from_dict(tables | ({"actuation": actuation} if actuation else {}))


def model_of(
    structure: Structure,
    values: dict[str, float],
    vessel: Vessel,
    step: float = 0.05,
    spread: float = 0.0,
) -> ManoeuvringModel:
    """Return a model with parameters per second, each known to a share of itself."""
    keep = structure.without(*[n for n in structure.parameters if n not in values])
    theta = step * np.array([values[n] for n in keep.parameters])
    return ManoeuvringModel(
        keep, theta, np.diag((spread * theta) ** 2), step, vessel,
        record={"ranges": {"n": (0.0, 15.0)}},
    )  # fmt: skip


def linear_ship(step: float = 0.05, spread: float = 0.0, **thruster: object) -> ManoeuvringModel:
    """Return a ship of linear damping, steered by an azimuth thruster."""
    return model_of(get_structure("linear"), LINEAR, azimuth_ship(**thruster), step, spread)


def rudder_model(
    step: float = 0.05,
    spread: float = 0.0,
    actuation: dict[str, object] | None = None,
    **thruster: object,
) -> ManoeuvringModel:
    """Return a ship of quadratic resistance, steered by a rudder."""
    vessel = rudder_ship(actuation, **thruster)
    structure = structure_for("thesis", force_inputs(vessel))
    return model_of(structure, RUDDER, vessel, step, spread)
