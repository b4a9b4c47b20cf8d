"""Reading a vessel from its TOML file, with the nearest name for every typo."""

from __future__ import annotations

import logging
import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from greybox.channels import CHANNELS
from greybox.errors import LogError, VesselError, suggestion
from greybox.files import nearest_file
from greybox.units import unit_factor
from greybox.vessel.conditions import Conditions
from greybox.vessel.thrust import ThrustLaw
from greybox.vessel.vessel import Actuation, ColumnMapping, Limits, Thruster, Vessel

if TYPE_CHECKING:
    from greybox.vessel.schema import AnyThruster, ColumnTable, ConditionsTable, SensorsTable

_MOVED = ("angle", "rudder", "speed")
# no rudder passes a right angle; an azimuth whose angle is not wrapped may make two turns [rad]
_FARTHEST = {"rudder": math.pi / 2, "angle": 4 * math.pi}
_CORRECTED = ("x_n", "y_n", "psi", "u", "v", "r", "u_q", "v_q")
_log = logging.getLogger(__name__)
EXAMPLES = ("thesis", "ferry")
_MAX_BYTES = 1_000_000


def example_vessel(name: str) -> Path:
    """Return the path of a vessel file that ships with the package.

    Parameters
    ----------
    name : {"thesis", "ferry"}
        The ship of Ljungberg (2020), chapter 6; a 5 m ferry with four azimuths.
    """
    return Path(str(resources.files("greybox.vessel") / "examples" / f"{name}.toml"))


def load_vessel(path: str | Path) -> Vessel:
    """Read a vessel file.

    Parameters
    ----------
    path : str or Path
        TOML file, or the name of an example vessel (``thesis``, ``ferry``).

    Returns
    -------
    Vessel

    Raises
    ------
    VesselError
        The file is missing, is not TOML, has an unknown key or thruster type
        (the nearest is suggested), or contradicts itself.
    """
    source = Path(path)
    if not source.exists() and str(path) in EXAMPLES:
        source = example_vessel(str(path))
    try:
        with source.open("rb") as handle:
            raw = handle.read(_MAX_BYTES + 1)
    except OSError as error:
        raise VesselError(
            f"cannot read the vessel file '{source}': {error.strerror}."
            f"{nearest_file(source, EXAMPLES)} Name an existing TOML file, or write one with the "
            f"lines that 'greybox import --help' shows."
        ) from error
    if len(raw) > _MAX_BYTES:
        raise VesselError(
            f"'{source}' has {max(source.stat().st_size, len(raw))} bytes, a vessel file at most "
            f"{_MAX_BYTES}: is it the log?"
        )
    try:
        data = tomllib.loads(raw.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise VesselError(f"'{source}' is not a text file: name a TOML vessel file.") from error
    except (ValueError, RecursionError) as error:  # TOMLDecodeError, and an integer too long
        raise VesselError(f"'{source}' is not TOML: {error}. Correct that line.") from error
    vessel = vessel_from_dict(data, source.name)
    _log.info("read vessel %s: %s, %d thruster(s)", source, vessel.name, len(vessel.thrusters))
    return vessel


def vessel_from_dict(data: dict[str, Any], source: str = "") -> Vessel:
    """Build a vessel from the tables of its file.

    Parameters
    ----------
    data : dict
        As ``tomllib`` reads them.
    source : str
        Name of the file, for what is said of it.

    Returns
    -------
    Vessel

    Raises
    ------
    VesselError
        As `load_vessel`.
    """
    # here, so that commands that load no vessel start fast
    from greybox.vessel.schema import checked

    table = checked(data, source)
    thrusters = tuple(_thruster(t, f"thruster {i}") for i, t in enumerate(table.thruster, 1))
    loop = table.closed_loop
    vessel = Vessel(
        name=table.name,
        length=table.length,
        thrusters=thrusters,
        closed_loop=None if loop is None else (loop.column, tuple(map(str, loop.values))),
        mass=table.mass,
        beam=table.beam,
        service_speed=table.service_speed,
        actuation=Actuation(**vars(table.actuation)),
        conditions=_conditions(table.conditions),
    )
    return replace(
        vessel,
        sensors=_sensors(table.sensors, vessel.recorded_columns),
        columns={raw: _column(raw, c, vessel) for raw, c in table.columns.items()},
    )


def vessel_to_dict(vessel: Vessel) -> dict[str, Any]:
    """Return the tables of a vessel file, to be kept inside a model file."""
    thrusters = []
    for t in vessel.thrusters:
        row: dict[str, Any] = {"type": t.type, "x": t.x, "y": t.y, "speed": t.speed}
        if t.type in ("azimuth", "fixed"):
            row["angle"] = t.angle
        if t.rudder is not None:
            row["rudder"] = t.rudder
        for key, column, other, limits in t.movements:
            if limits.lower is not None:
                row[f"{key}_limits"] = [limits.lower, limits.upper]
            if limits.rate is not None:
                row[f"{key}_rate"] = limits.rate
            if other is not None:
                measured, commanded = (column, other)[:: 1 if t.drive == "feedback" else -1]
                row |= {key: measured, f"{key}_command": commanded}
        if t.drive != "feedback":
            row["drive"] = t.drive
        row["thrust"] = [list(p) for p in t.thrust.table] or t.thrust.kind
        if t.thrust.quadratic_share or t.thrust.reference != 1:
            row["thrust"] = {
                "quadratic_share": t.thrust.quadratic_share, "reference": t.thrust.reference,
            }  # fmt: skip
        if t.gain != 1:
            row["gain"] = t.gain
        if t.angle_offset:
            row["angle_offset"] = t.angle_offset
        thrusters.append(row)
    data: dict[str, Any] = {"name": vessel.name, "length": vessel.length, "thruster": thrusters}
    if vessel.columns:
        data["columns"] = {
            raw: {"name": c.name}
            | ({"unit": c.unit} if c.unit else {})
            | ({"sign": c.sign} if c.sign != 1 else {})
            for raw, c in vessel.columns.items()
        }
    if vessel.sensors:
        data["sensors"] = {
            k: list(v) if isinstance(v, tuple) else dict(v) if isinstance(v, Mapping) else v
            for k, v in vessel.sensors.items()
        }
    if vessel.closed_loop:
        data["closed_loop"] = {
            "column": vessel.closed_loop[0],
            "values": list(vessel.closed_loop[1]),
        }
    stated = {"mass": vessel.mass, "beam": vessel.beam, "service_speed": vessel.service_speed}
    data |= {name: value for name, value in stated.items() if value is not None}
    if vessel.actuation != Actuation():
        data["actuation"] = {k: v for k, v in vars(vessel.actuation).items() if v is not None}
    if vessel.conditions:
        data["conditions"] = vessel.conditions.to_dict()
    return data


def _thruster(table: AnyThruster, where: str) -> Thruster:
    row: dict[str, Any] = vars(table)
    led = table.drive == "command"
    moved: dict[str, Any] = {"angle": math.pi / 2} if table.type == "tunnel" else {}
    for key in _MOVED:
        column, command = row.get(key), row.get(f"{key}_command")
        if not isinstance(column, str):
            moved |= {} if column is None else {key: column}
            continue
        if led and command is None:
            raise VesselError(
                f"{where} is driven by its command but has no '{key}_command': name that column."
            )
        moved |= {key: command, f"{key}_other": column} if led else {
            key: column, f"{key}_other": command,
        }  # fmt: skip
    fixed = moved.get("angle")
    if isinstance(fixed, int | float) and abs(fixed) > 2 * math.pi:
        raise VesselError(
            f"angle of {where} is {fixed:g} rad, more than a turn: write radians, "
            f"{math.radians(fixed):.4g} for {fixed:g} deg."
        )
    limits: dict[str, Any] = {f"{k}_limits": _limits(row, k, where) for k in _MOVED}
    return Thruster(
        **moved,
        **limits,
        **{key: row[key] for key in ("type", "x", "y", "gain", "angle_offset", "drive")},
        thrust=_thrust(row["thrust"]),
    )


def _limits(row: Mapping[str, Any], key: str, where: str) -> Limits:
    lower, upper = row.get(f"{key}_limits") or (None, None)
    if lower is not None and upper is not None and lower > upper:
        raise VesselError(
            f"{key}_limits of {where} run from {lower:g} to {upper:g}: "
            f"the first must be the smaller."
        )
    farthest = max(abs(lower or 0.0), abs(upper or 0.0))
    if farthest > _FARTHEST.get(key, math.inf):
        raise VesselError(
            f"{key}_limits of {where} reach {farthest:g} rad, and {_FARTHEST[key]:.3g} rad at most "
            f"are possible: write radians, {math.radians(farthest):.4g} for {farthest:g} deg."
        )
    return Limits(lower, upper, row.get(f"{key}_rate"))


def _thrust(law: Any) -> ThrustLaw:
    if isinstance(law, str):
        return ThrustLaw("quadratic" if law == "quadratic" else "linear")
    if isinstance(law, list):
        return ThrustLaw("table", tuple((n, f) for n, f in law))
    return ThrustLaw("linear", (), law.quadratic_share, law.reference)


def _column(raw: str, table: ColumnTable, vessel: Vessel) -> ColumnMapping:
    known = [*CHANNELS, *vessel.recorded_columns]
    if vessel.closed_loop:
        known.append(vessel.closed_loop[0])
    if table.name not in known:
        raise VesselError(
            f"column '{raw}' is mapped to '{table.name}', which is neither a channel nor a "
            f"thruster column.{suggestion(table.name, known)} Name a channel, such as psi or u, or "
            f"write that name as the speed, angle or rudder of a [[thruster]] too."
        )
    if table.unit is not None:
        try:
            unit_factor(table.unit, vessel.unit(table.name), raw)
        except LogError as error:
            raise VesselError(str(error)) from None
    if table.sign not in (1, -1):
        raise VesselError(f"column '{raw}' has sign = {table.sign}: write 1, or -1 to reverse it.")
    return ColumnMapping(table.name, table.unit, table.sign)


def _conditions(table: ConditionsTable) -> Conditions:
    try:
        return Conditions.read(vars(table))
    except LogError as error:
        raise VesselError(f"[conditions] of the vessel file: {error}") from None


def _sensors(table: SensorsTable, commands: Iterable[str]) -> dict[str, Any]:
    known = (*_CORRECTED, *commands)
    for key in ("clock", "reversed"):
        for name in getattr(table, key) or ():
            if name not in known:
                raise VesselError(
                    f"{key} in [sensors] names '{name}', which is no channel that can be "
                    f"corrected.{suggestion(name, known)} Channels: {', '.join(known)}."
                )
    if abs(table.heading_bias or 0.0) > 2 * math.pi:
        raise VesselError(
            f"heading_bias in [sensors] is {table.heading_bias:g} rad, more than a turn: write "
            f"it in radians."
        )
    stated = table.model_dump(exclude_none=True)
    return {k: tuple(v) if isinstance(v, list) else v for k, v in stated.items()}
