"""Differences between two models: terms, coefficients, actuators, sensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from greybox.model.model import ManoeuvringModel
from greybox.notebook import with_error
from greybox.report.page import Marked, Table
from greybox.vessel.vessel import Thruster, Vessel

# value, standard error and unit by name
_Values = Mapping[str, tuple[float, float, str]]
_NOTE = "u_r, v_r: velocity through the water; u_q, v_q: through the air"


def marked_equations(base: ManoeuvringModel, model: ManoeuvringModel) -> list[Marked]:
    """Return the equations before and after, terms that went and came marked.

    Where nothing changed there is one set only.
    """
    old, new = (dict(map(_split, m.structure.equations())) for m in (base, model))
    if old == new:
        return [Marked("Equations", _pieces(new, new, ""))]
    return [
        Marked("Before", _pieces(old, new, "del")),
        Marked("After, what is new marked", _pieces(new, old, "ins")),
    ]


def _split(line: str) -> tuple[str, list[str]]:
    left, right = line.split(" = ", 1)
    return left, right.split(" + ")


def _pieces(shown: Mapping[str, list[str]], other: Mapping[str, list[str]], mark: Any) -> list[Any]:
    pieces: list[Any] = []
    for left, terms in shown.items():
        pieces.append((f"{left} = ", ""))
        for i, term in enumerate(terms):
            if i:
                pieces.append((" + ", ""))
            pieces.append((term, "" if term in other.get(left, []) else mark))
        pieces.append(("\n", ""))
    return [*pieces, (_NOTE, "")]


def coefficient_table(base: ManoeuvringModel, model: ManoeuvringModel) -> Table:
    """Return every coefficient and current before and after, ± one standard error."""
    old, new = _values(base), _values(model)
    caption = f"Coefficients per sample of {model.sample_time:g} s, ± one standard error"
    if old == new:
        rows = [[model.label(n), _shown(v, s), shown_unit(u)] for n, (v, s, u) in new.items()]
        return Table(caption, ["coefficient", "value", "unit"], rows)
    rows = []
    for name in dict.fromkeys([*old, *new]):
        cells = [_shown(*side[name][:2]) if name in side else "" for side in (old, new)]
        unit = (new.get(name) or old[name])[2]
        rows.append(
            [model.label(name), *cells, shown_unit(unit), _note(name, base, model, old, new)]
        )
    return Table(caption, ["coefficient", "before", "after", "unit", ""], rows)


def _note(
    name: str, base: ManoeuvringModel, model: ManoeuvringModel, old: _Values, new: _Values
) -> str:
    if name not in old:
        return "new"
    if name not in new:
        return "gone"
    return f"before: {base.label(name)}" if base.label(name) != model.label(name) else ""


def _values(model: ManoeuvringModel) -> _Values:
    found = {n: (v, s, u) for n, v, s, u in model.shown_parameters()}
    return found | {n: (v, s, "m/s") for n, (v, s) in model.disturbances.items()}


def shown_unit(unit: str) -> str:
    """Return a unit as it stands in a table: nothing for a pure number."""
    return "" if unit == "1" else unit.replace("^2", "²").replace("^3", "³")


def _shown(value: float, std: float) -> str:
    return unbroken(with_error(value, std))


def unbroken(number: str) -> str:
    """Return a number whose exponent stays with it: lines break after a hyphen."""
    return number.replace("e-", "e−")


def other_changes(base: ManoeuvringModel, model: ManoeuvringModel) -> list[str]:
    """Return what is different beside the equations, one sentence each."""
    told = vessel_changes(base.vessel, model.vessel)
    told += [f"{c.sentence}, on the log's clock." for c in model.changes if c not in base.changes]
    for name, (value, std) in model.disturbances.items():
        if name not in base.disturbances:
            told.append(f"{name} is {_shown(value, std)} m/s; before, the water stood still.")
    if base.integrator != model.integrator:
        told.append(f"The integrator is {model.integrator}, it was {base.integrator}.")
    return told


def vessel_changes(base: Vessel, vessel: Vessel) -> list[str]:
    """Return how thrusters, actuation, sensors and columns differ, one sentence each."""
    told = []
    for i, (old, new) in enumerate(zip(base.thrusters, vessel.thrusters, strict=True)):
        told += _thruster(f"Thruster {i + 1} ({', '.join(new.columns)})", old, new)
    if base.actuation != vessel.actuation:
        told.append(
            f"Commands act with {vessel.actuation.sentence}; before, with "
            f"{base.actuation.sentence}."
        )
    told += _sensors(base.sensors, vessel.sensors)
    for column, mapping in vessel.columns.items():
        if base.columns.get(column) != mapping:
            sign = " with its sign turned" if mapping.sign < 0 else ""
            told.append(f"Column {column} of the logs is read as {mapping.name}{sign}.")
    return told


def _thruster(name: str, old: Thruster, new: Thruster) -> list[str]:
    told = []
    if old.columns != new.columns:
        told.append(f"{name} was driven by {', '.join(old.columns)} before.")
    if old.gain != new.gain:
        told.append(
            f"{name} gives {100 * new.gain:.1f} % of its thrust law, before {100 * old.gain:.4g} %."
        )
    if old.angle_offset != new.angle_offset:
        told.append(
            f"{name} stands {np.rad2deg(new.angle_offset):.2f} deg ({new.angle_offset:.4f} rad) "
            f"beyond its logged angle, before {np.rad2deg(old.angle_offset):.4g} deg."
        )
    if old.thrust.quadratic_share != new.thrust.quadratic_share:
        told.append(
            f"{name}: {100 * new.thrust.quadratic_share:.0f} % of the thrust goes with n|n|, "
            f"before {100 * old.thrust.quadratic_share:.4g} %; both parts are equal at n = "
            f"{new.thrust.reference:.4g}."
        )
    elif old.thrust != new.thrust:
        told.append(f"{name} has another thrust law ({new.thrust.kind}, before {old.thrust.kind}).")
    return told


def _sensors(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    told = []
    for key, value in new.items():
        if key in old and old[key] == value:
            continue
        if key == "heading_bias":
            told.append(
                f"The compass shows {np.rad2deg(value):.2f} deg ({value:.4f} rad) too much."
            )
        elif key == "velocity_at":
            told.append(
                f"Surge and sway are measured {value[0]:.2f} m ahead and {value[1]:.2f} m to "
                f"starboard of the origin (negative: abaft, port)."
            )
        elif key == "clock":
            told += [
                f"{channel} comes {abs(late):.2f} s too {'late' if late > 0 else 'early'}."
                for channel, late in value.items()
                if old.get("clock", {}).get(channel) != late
            ]
        elif key == "reversed":
            told += [f"{c} has its sign turned." for c in value if c not in old.get(key, ())]
        elif key == "velocities_from_heading":
            told.append(
                "Surge and sway were computed with the heading, and are turned back with it."
            )
        else:
            told.append(f"{key} of the sensors is {value}, before {old.get(key, 'not stated')}.")
    return told
