"""Reading a vessel from its TOML file, with the nearest name for every typo."""

from __future__ import annotations

import logging
import math
import tomllib
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from greybox.channels import CHANNELS, unit_factor
from greybox.errors import LogError, VesselError, suggestion
from greybox.files import nearest_file
from greybox.vessel.thrust import ThrustLaw
from greybox.vessel.vessel import (
    THRUSTER_TYPES,
    Actuation,
    ColumnMapping,
    Limits,
    Thruster,
    Vessel,
)

_TOP = {"name", "length", "thruster", "columns", "sensors", "closed_loop", "mass", "actuation"}
_THRUSTER = {
    "type": str,
    "x": float,
    "y": float,
    "speed": str,
    "angle": (str, float),
    "rudder": str,
    "speed_limits": list,
    "speed_rate": float,
    "angle_limits": list,
    "angle_rate": float,
    "rudder_limits": list,
    "rudder_rate": float,
    "thrust": (str, list, dict),
    "gain": float,
    "angle_offset": float,
    "drive": str,
    "speed_command": str,
    "angle_command": str,
    "rudder_command": str,
}
_MIXED = {"quadratic_share": 0.0, "reference": 1.0}
_SENSORS = {
    "heading_std",
    "u_std",
    "v_std",
    "r_std",
    "position_std",
    "wind_std",
    "antenna",
    "anemometer",
    "heading_bias",
    "velocities_from_heading",
    "velocity_at",
    "clock",
    "reversed",
}
_CORRECTED = ("x_n", "y_n", "psi", "u", "v", "r", "u_q", "v_q")
_SIZES = {"antenna": (2, 3), "anemometer": (3,), "velocity_at": (2,)}
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
        if source.stat().st_size > _MAX_BYTES:
            raise VesselError(
                f"'{source}' has {source.stat().st_size} bytes, a vessel file at most "
                f"{_MAX_BYTES}: is it the log?"
            )
        data = tomllib.loads(source.read_text(encoding="utf-8"))
    except OSError as error:
        raise VesselError(
            f"cannot read the vessel file '{source}': {error.strerror}."
            f"{nearest_file(source, EXAMPLES)} Name an existing TOML file."
        ) from error
    except UnicodeDecodeError as error:
        raise VesselError(f"'{source}' is not a text file: name a TOML vessel file.") from error
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise VesselError(f"'{source}' is not TOML: {error}. Correct that line.") from error
    vessel = vessel_from_dict(data)
    _log.info("read vessel %s: %s, %d thruster(s)", source, vessel.name, len(vessel.thrusters))
    return vessel


def vessel_from_dict(data: dict[str, Any]) -> Vessel:
    """Build a vessel from the tables of its file.

    Parameters
    ----------
    data : dict
        As ``tomllib`` reads them.

    Returns
    -------
    Vessel

    Raises
    ------
    VesselError
        As `load_vessel`.
    """
    _known_keys(data, _TOP, "the vessel file")
    for key in ("name", "length", "thruster"):
        if key not in data:
            raise VesselError(f"the vessel file has no '{key}': add it (see the vessel format).")
    name, length = data["name"], _number(data["length"], "length")
    if not length > 0:
        raise VesselError(f"length is {length:g} m, it must be positive: correct it.")
    if not isinstance(data["thruster"], list) or not data["thruster"]:
        raise VesselError("the vessel file has no [[thruster]] table: add at least one.")
    thrusters = tuple(_thruster(t, i + 1) for i, t in enumerate(data["thruster"]))
    vessel = Vessel(
        name=str(name),
        length=length,
        thrusters=thrusters,
        sensors=_sensors(data.get("sensors", {}), Vessel("", 1.0, thrusters).recorded_columns),
        closed_loop=_closed_loop(data.get("closed_loop")),
        mass=_number(data["mass"], "mass") if "mass" in data else None,
        actuation=_actuation(data.get("actuation", {})),
    )
    columns = _columns(data.get("columns", {}), vessel)
    return Vessel(**{**vessel.__dict__, "columns": columns})


def vessel_to_dict(vessel: Vessel) -> dict[str, Any]:
    """Return the tables of a vessel file, to be kept inside a model file."""
    thrusters = []
    for t in vessel.thrusters:
        row: dict[str, Any] = {"type": t.type, "x": t.x, "y": t.y, "speed": t.speed}
        if t.type in ("azimuth", "fixed"):
            row["angle"] = t.angle
        if t.rudder is not None:
            row["rudder"] = t.rudder
        for key, limits in (
            ("speed", t.speed_limits),
            ("angle", t.angle_limits),
            ("rudder", t.rudder_limits),
        ):
            if limits.lower is not None:
                row[f"{key}_limits"] = [limits.lower, limits.upper]
            if limits.rate is not None:
                row[f"{key}_rate"] = limits.rate
        for key, column, other, _ in t.movements:
            if other is not None:
                measured, commanded = (column, other)[:: 1 if t.drive == "feedback" else -1]
                row |= {key: measured, f"{key}_command": commanded}
        if t.drive != "feedback":
            row["drive"] = t.drive
        row["thrust"] = [list(p) for p in t.thrust.table] or t.thrust.kind
        if t.thrust.quadratic_share or t.thrust.reference != 1:
            row["thrust"] = {k: getattr(t.thrust, k) for k in _MIXED}
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
    if vessel.mass is not None:
        data["mass"] = vessel.mass
    if vessel.actuation != Actuation():
        data["actuation"] = vars(vessel.actuation).copy()
    return data


def _known_keys(table: Any, known: Any, where: str) -> None:
    if not isinstance(table, dict):
        raise VesselError(f"{where} is not a table: write it as key = value lines.")
    for key in table:
        if key not in known:
            raise VesselError(
                f"{where} has the unknown key '{key}'.{suggestion(key, known)} "
                f"Known keys: {', '.join(sorted(known))}."
            )


def _number(value: Any, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise VesselError(f"{what} is {value!r}, a finite number is needed: correct it.")
    return float(value)


def _limits(table: dict[str, Any], key: str, where: str) -> Limits:
    lower = upper = rate = None
    pair = table.get(f"{key}_limits")
    if pair is not None:
        if not isinstance(pair, list) or len(pair) != 2:
            raise VesselError(f"{key}_limits of {where} must be [lowest, highest]: correct it.")
        lower, upper = (_number(v, f"{key}_limits of {where}") for v in pair)
        if lower > upper:
            raise VesselError(
                f"{key}_limits of {where} run from {lower:g} to {upper:g}: "
                f"the first must be the smaller."
            )
    if f"{key}_rate" in table:
        rate = _number(table[f"{key}_rate"], f"{key}_rate of {where}")
        if rate <= 0:
            raise VesselError(f"{key}_rate of {where} is {rate:g}, it must be positive.")
    return Limits(lower, upper, rate)


def _thrust(value: Any, where: str) -> ThrustLaw:
    if isinstance(value, list):
        if not all(isinstance(p, list) and len(p) == 2 for p in value):
            raise VesselError(f"the bollard table of {where} must list [speed, force] pairs.")
        return ThrustLaw(
            "table",
            tuple(
                (_number(n, f"a speed of {where}"), _number(f, f"a force of {where}"))
                for n, f in value
            ),
        )
    if isinstance(value, dict):
        _known_keys(value, _MIXED, f"the thrust law of {where}")
        share, reference = (_number(value.get(k, d), f"{k} of {where}") for k, d in _MIXED.items())
        return ThrustLaw("linear", (), share, reference)
    laws = ("linear", "quadratic")
    if value not in laws:
        raise VesselError(
            f"{where} has the thrust law '{value}'.{suggestion(str(value), laws)} "
            f"Use 'linear', 'quadratic', a table of [speed, force] pairs, or "
            f"{{ quadratic_share = 0.5, reference = 10.0 }}."
        )
    return ThrustLaw(value)


def _thruster(table: Any, number: int) -> Thruster:
    where = f"thruster {number}"
    _known_keys(table, _THRUSTER, where)
    kind = table.get("type")
    if kind not in THRUSTER_TYPES:
        raise VesselError(
            f"{where} has the type '{kind}'.{suggestion(str(kind), THRUSTER_TYPES)} "
            f"Types: {', '.join(THRUSTER_TYPES)}."
        )
    if "speed" not in table:
        raise VesselError(f"{where} has no 'speed': name the log column of its propeller speed.")
    drive = table.get("drive", "feedback")
    if drive not in ("feedback", "command"):
        raise VesselError(
            f"{where} has drive = '{drive}'.{suggestion(drive, ('feedback', 'command'))} "
            f"Use 'feedback' (measured) or 'command'."
        )

    def column(key: str, *, other: bool = False) -> Any:
        command = table.get(f"{key}_command")
        if drive == "command" and command is None and isinstance(table.get(key), str):
            raise VesselError(
                f"{where} is driven by its command but has no '{key}_command': name that column."
            )
        return command if (drive == "command") is not other else table.get(key)

    angle: str | float = 0.0
    if kind == "azimuth":
        if not isinstance(table.get("angle"), str):
            raise VesselError(f"{where} is an azimuth: 'angle' must name the column of its angle.")
        angle = column("angle")
    elif kind == "fixed":
        angle = _number(table.get("angle", 0.0), f"angle of {where}")
    elif kind == "tunnel":
        angle = math.pi / 2
    if kind == "propeller_rudder" and not isinstance(table.get("rudder"), str):
        raise VesselError(f"{where} has no 'rudder': name the log column of its rudder angle.")
    if kind != "propeller_rudder" and "rudder" in table:
        raise VesselError(f"{where} is of type {kind} and cannot have a rudder: remove 'rudder'.")
    if kind in ("tunnel", "propeller_rudder") and "angle" in table:
        raise VesselError(f"{where} is of type {kind} and has no angle of its own: remove 'angle'.")
    return Thruster(
        type=kind,
        x=_number(table.get("x", 0.0), f"x of {where}"),
        y=_number(table.get("y", 0.0), f"y of {where}"),
        speed=str(column("speed")),
        angle=angle,
        rudder=column("rudder") if kind == "propeller_rudder" else None,
        thrust=_thrust(table.get("thrust", "linear"), where),
        speed_limits=_limits(table, "speed", where),
        angle_limits=_limits(table, "angle", where),
        rudder_limits=_limits(table, "rudder", where),
        gain=_number(table.get("gain", 1.0), f"gain of {where}"),
        angle_offset=_number(table.get("angle_offset", 0.0), f"angle_offset of {where}"),
        drive=drive,
        speed_other=column("speed", other=True),
        angle_other=column("angle", other=True) if kind == "azimuth" else None,
        rudder_other=column("rudder", other=True) if kind == "propeller_rudder" else None,
    )


def _actuation(table: Any) -> Actuation:
    _known_keys(table, ("lag", "lag_on", "delay", "lag_held"), "[actuation]")
    return Actuation(
        lag=_number(table.get("lag", 0.0), "lag of [actuation]"),
        lag_on=table.get("lag_on", "force"),
        delay=_number(table.get("delay", 0.0), "delay of [actuation]"),
        lag_held=table.get("lag_held", "start"),
    )


def _columns(table: Any, vessel: Vessel) -> dict[str, ColumnMapping]:
    found: dict[str, ColumnMapping] = {}
    known = [*CHANNELS, *vessel.recorded_columns]
    if vessel.closed_loop:
        known.append(vessel.closed_loop[0])
    if not isinstance(table, dict):
        raise VesselError('[columns] must hold lines such as "psi [deg]" = { name = "psi", … }.')
    for raw, entry in table.items():
        _known_keys(entry, {"name", "unit", "sign"}, f"column '{raw}'")
        name = entry.get("name")
        if name not in known:
            raise VesselError(
                f"column '{raw}' is mapped to '{name}', which is neither a channel nor a "
                f"thruster column.{suggestion(str(name), known)}"
            )
        unit = entry.get("unit")
        target = CHANNELS[name].unit if name in CHANNELS else None
        if name in vessel.recorded_angles:
            target = "rad"
        if target is not None and unit is None:
            raise VesselError(
                f"column '{raw}' is mapped to '{name}' without a unit: add unit = \"{target}\" "
                f"or the unit that the log uses."
            )
        if unit is not None:
            try:
                unit_factor(unit, target, raw)
            except LogError as error:
                raise VesselError(str(error)) from None
        if any(c.name == name for c in found.values()):
            raise VesselError(f"two columns are mapped to '{name}': keep one of them.")
        sign = entry.get("sign", 1)
        if sign not in (1, -1) or isinstance(sign, bool):
            raise VesselError(f"column '{raw}' has sign = {sign}: write 1, or -1 to reverse it.")
        found[raw] = ColumnMapping(name, unit, int(sign))
    return found


def _sensors(table: Any, commands: Iterable[str]) -> dict[str, Any]:
    _known_keys(table, _SENSORS, "[sensors]")
    found: dict[str, Any] = {}
    for key, value in table.items():
        if key == "clock":
            late = value if isinstance(value, dict) else {}
            _corrected_channels(value, late, commands, "clock", "{ u = 1.2 }")
            found[key] = {c: _number(s, f"clock of {c} in [sensors]") for c, s in late.items()}
        elif key == "reversed":
            names = value if isinstance(value, list) else []
            _corrected_channels(value, names, commands, "reversed", '["r"]')
            found[key] = tuple(names)
        elif key == "velocities_from_heading":
            if not isinstance(value, bool):
                raise VesselError(
                    f"velocities_from_heading in [sensors] is {value!r}: write true where u, v "
                    f"were computed with the heading, else false."
                )
            found[key] = value
        elif key == "heading_bias":
            found[key] = _number(value, key)
            if abs(found[key]) > 2 * math.pi:
                raise VesselError(
                    f"heading_bias in [sensors] is {found[key]:g} rad, more than a turn: write "
                    f"it in radians."
                )
        elif key in _SIZES:
            size = _SIZES[key]
            if not isinstance(value, list) or len(value) not in size:
                raise VesselError(
                    f"{key} in [sensors] needs {size[0]} numbers [m]: write [x, y"
                    f"{', height' if key == 'anemometer' else ''}]."
                )
            found[key] = tuple(_number(v, key) for v in value)
        else:
            found[key] = _number(value, key)
            if found[key] < 0:
                raise VesselError(f"{key} is {found[key]:g}, it cannot be negative: correct it.")
    return found


def _corrected_channels(
    value: Any, names: Iterable[Any], commands: Iterable[str], key: str, example: str
) -> None:
    """Refuse what lists no channels that a log may need to have corrected."""
    known = (*_CORRECTED, *commands)
    if not names:
        raise VesselError(
            f"{key} in [sensors] is {value!r}, it must name channels: write {key} = {example}."
        )
    for name in names:
        if name not in known:
            raise VesselError(
                f"{key} in [sensors] names '{name}', which is no channel that can be corrected."
                f"{suggestion(str(name), known)} Channels: {', '.join(known)}."
            )


def _closed_loop(table: Any) -> tuple[str, tuple[str, ...]] | None:
    if table is None:
        return None
    _known_keys(table, {"column", "values"}, "[closed_loop]")
    if not isinstance(table.get("column"), str) or not isinstance(table.get("values"), list):
        raise VesselError(
            '[closed_loop] needs column = "…" and values = [ … ]: the column that tells the '
            "mode, and its values under which a controller moves the thrusters."
        )
    return table["column"], tuple(str(v) for v in table["values"])
