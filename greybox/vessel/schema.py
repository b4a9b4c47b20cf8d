"""The vessel file's tables as a schema, and what is said of a file that does not keep it.

The sentences are made of the schema's typed errors: kind, place and value.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
)
from pydantic_core import PydanticCustomError

from greybox.errors import VesselError, suggestion
from greybox.vessel.vessel import THRUSTER_TYPES, Drive

# beyond it no ship has a number, and squares of squares overflow
_LARGEST = 1e12


def _possible(value: float) -> float:
    if abs(value) > _LARGEST:
        raise PydanticCustomError("too_large", "too large")
    return value


Number = Annotated[float, Field(allow_inf_nan=False), AfterValidator(_possible)]
Spread = Annotated[Number, Field(ge=0)]
Positive = Annotated[Number, Field(gt=0)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]


class Table(BaseModel):
    """A table of the file: no other keys, nothing converted but integers to numbers."""

    model_config = ConfigDict(extra="forbid", strict=True)


class MixtureTable(Table):
    """A thrust law between linear and quadratic."""

    quadratic_share: Number = 0.0
    reference: Number = 1.0


def _thrust_kind(value: Any) -> str:
    return "table" if isinstance(value, list) else "mixture" if isinstance(value, dict) else "law"


Thrust = Annotated[
    Annotated[Literal["linear", "quadratic"], Tag("law")]
    | Annotated[list[Pair], Tag("table")]
    | Annotated[MixtureTable, Tag("mixture")],
    Discriminator(_thrust_kind),
]


class ThrusterTable(Table):
    """What every ``[[thruster]]`` has."""

    x: Number = 0.0
    y: Number = 0.0
    speed: str
    speed_command: str | None = None
    speed_limits: Pair | None = None
    speed_rate: Positive | None = None
    drive: Drive = "feedback"
    thrust: Thrust = "linear"
    gain: Number = 1.0
    angle_offset: Number = 0.0


class AzimuthTable(ThrusterTable):
    """A thruster that turns."""

    type: Literal["azimuth"]
    angle: str
    angle_command: str | None = None
    angle_limits: Pair | None = None
    angle_rate: Positive | None = None


class FixedTable(ThrusterTable):
    """A thruster in a constant direction [rad]."""

    type: Literal["fixed"]
    angle: Number = 0.0


class TunnelTable(ThrusterTable):
    """A thruster that pushes sideways."""

    type: Literal["tunnel"]


class RudderTable(ThrusterTable):
    """A propeller with a rudder behind it."""

    type: Literal["propeller_rudder"]
    rudder: str
    rudder_command: str | None = None
    rudder_limits: Pair | None = None
    rudder_rate: Positive | None = None


AnyThruster = AzimuthTable | FixedTable | TunnelTable | RudderTable


class ColumnTable(Table):
    """A log column under another name, unit or sign than the canonical one."""

    name: str
    unit: str | None = None
    sign: int = 1


def _named(value: Any) -> Any:
    return {"name": value} if isinstance(value, str) else value


class SensorsTable(Table):
    """What is known of the sensors."""

    heading_std: Spread | None = None
    u_std: Spread | None = None
    v_std: Spread | None = None
    r_std: Spread | None = None
    position_std: Spread | None = None
    wind_std: Spread | None = None
    antenna: Annotated[list[Number], Field(min_length=2, max_length=3)] | None = None
    anemometer: Annotated[list[Number], Field(min_length=3, max_length=3)] | None = None
    velocity_at: Pair | None = None
    heading_bias: Number | None = None
    velocities_from_heading: bool | None = None
    clock: Annotated[dict[str, Number], Field(min_length=1)] | None = None
    reversed: Annotated[list[str], Field(min_length=1)] | None = None


class ActuationTable(Table):
    """How the force follows the commands."""

    lag: Number = 0.0
    lag_on: str = "force"
    delay: Number = 0.0
    lag_held: str = "start"
    between: str = "held"
    delay_on: str = "command"
    rate_limit: Positive | None = None
    rate_on: str | None = None


class ClosedLoopTable(Table):
    """Where the log tells that a controller moves the thrusters."""

    column: str
    values: list[str | int | float | bool]


class ConditionsTable(Table):
    """Conditions of logs that state none: numbers in SI, or texts with a unit."""

    draught: Any = None
    trim: Any = None
    loading: Any = None
    water_depth: Any = None
    sea_state: Any = None


class VesselTable(Table):
    """The whole file."""

    name: str
    length: Positive
    thruster: Annotated[
        list[Annotated[AnyThruster, Field(discriminator="type")]], Field(min_length=1)
    ]
    columns: dict[str, Annotated[ColumnTable, BeforeValidator(_named)]] = {}
    sensors: SensorsTable = SensorsTable()
    closed_loop: ClosedLoopTable | None = None
    mass: Positive | None = None
    beam: Positive | None = None
    service_speed: Positive | None = None
    actuation: ActuationTable = ActuationTable()
    conditions: ConditionsTable = ConditionsTable()


_TABLES: dict[str, type[Table]] = {
    "sensors": SensorsTable,
    "actuation": ActuationTable,
    "closed_loop": ClosedLoopTable,
    "conditions": ConditionsTable,
}
_THRUSTERS: dict[str, type[Table]] = dict(zip(THRUSTER_TYPES, get_args(AnyThruster), strict=True))
_COLUMNS = {"speed": "its propeller speed", "angle": "its angle", "rudder": "its rudder angle"}
# how keys begin whose numbers are angles or yaw rates
_IN_RADIANS = ("angle", "rudder_", "heading_", "r_std")
_LACKS = {"angle": "has no angle of its own", "rudder": "cannot have a rudder"}
_CHOICES = {"type": THRUSTER_TYPES, "drive": get_args(Drive), "law": ("linear", "quadratic")}
_LIMITS = "{name} must be [lowest, highest], it is {value}: correct it."
_LOOP = (
    '[closed_loop] needs column = "…" and values = [ … ]: the column that tells the mode, and its '
    "values under which a controller moves the thrusters."
)
_NUMBER = "{number} is {value}, a finite number is needed: correct it."
_TABLE = "{name} is not a table but {value}: write it as key = value lines."
_TYPES = f"Types: {', '.join(THRUSTER_TYPES)}."
# what is said of a kind of error, whatever the key
_BY_KIND = {
    "float_type": _NUMBER,
    "finite_number": _NUMBER,
    "too_large": f"{{name}} is {{value}}, no ship has more than {_LARGEST:g}: correct it.",
    "greater_than": "{name} is {value}, it must be positive: correct it.",
    "greater_than_equal": "{name} is {value}, it cannot be negative: correct it.",
    "union_tag_not_found": f"{{name}} has no 'type'. {_TYPES}",
    "union_tag_invalid": f"{{name}} has the type '{{tag}}'.{{near}} {_TYPES}",
}
# what is said of any other value that a key cannot have
_BY_KEY = {
    "": _TABLE,
    "thruster": "the vessel file has no [[thruster]] table: add at least one.",
    "drive": "{where} has drive = {value}.{near} Use 'feedback' (measured) or 'command'.",
    "law": "{where} has the thrust law {value}.{near} Use 'linear', 'quadratic', a table of "
    "[speed, force] pairs, or {{ quadratic_share = 0.5, reference = 10.0 }}.",
    "table": "the bollard table of {where} must list [speed, force] pairs.",
    "speed_limits": _LIMITS,
    "angle_limits": _LIMITS,
    "rudder_limits": _LIMITS,
    "column": _LOOP,
    "values": _LOOP,
    "sign": "{where} has sign = {value}: write 1, or -1 to reverse it.",
    "antenna": "{name} needs 2 numbers [m], it is {value}: write antenna = [x, y].",
    "anemometer": "{name} needs 3 numbers [m], it is {value}: write anemometer = [x, y, height].",
    "velocity_at": "{name} needs 2 numbers [m], it is {value}: write velocity_at = [x, y].",
    "clock": "{name} is {value}, it must name channels: write clock = {{ u = 1.2 }}.",
    "reversed": '{name} is {value}, it must name channels: write reversed = ["r"].',
    "velocities_from_heading": "{name} is {value}: write true where u, v were computed with the "
    "heading, else false.",
} | {
    key: f"{{where}} has {key} = {{value}}: '{key}' must name the column of {what}."
    for key, what in _COLUMNS.items()
}
_WORD = "{name} is {value}, a word in quotes is needed: correct it."
_LONGEST = 60


@dataclass(frozen=True)
class _Place:
    """Where in the file an error is: its table, in words, and the keys from there on."""

    table: type[Table]
    where: str
    path: tuple[int | str, ...] = ()
    thruster: str = ""

    @property
    def key(self) -> str:
        """What the value is known by: its key, for a thrust law its form."""
        return str(next((p for p in self.path if p != "thrust"), ""))

    @property
    def name(self) -> str:
        """The value in words."""
        if not self.path or self.table is VesselTable:
            return self.key or self.where
        inner = "".join(f" of {p}" for p in self.path[1:] if self.table is SensorsTable)
        of = "in" if self.table is SensorsTable else "of"
        return f"{self.path[0]}{inner} {of} {self.where}"


def _place(loc: tuple[int | str, ...]) -> _Place:
    match loc:
        case ("thruster", int(number), kind, "thrust", "mixture", *path):
            return _Place(MixtureTable, f"the thrust law of thruster {number + 1}", tuple(path))
        case ("thruster", int(number), str(kind), *path):
            return _Place(_THRUSTERS[kind], f"thruster {number + 1}", tuple(path), kind)
        case ("thruster", int(number)):
            return _Place(ThrusterTable, f"thruster {number + 1}")
        case ("columns", raw, *path):
            return _Place(ColumnTable, f"column '{raw}'", tuple(path))
        case ("columns",):
            return _Place(VesselTable, "[columns]")
        case (str(head), *path) if head in _TABLES:
            # an index within a list tells nothing that the value does not
            keys = tuple(p for p in path if isinstance(p, str))
            return _Place(_TABLES[head], f"[{head}]", keys)
    return _Place(VesselTable, "the vessel file", loc)


def checked(data: Any, source: str = "") -> VesselTable:
    """Return the file's tables as the schema has them.

    Raises
    ------
    VesselError
        They do not keep it.
    """
    try:
        return VesselTable.model_validate(data)
    except ValidationError as error:
        raise VesselError(_sentence(error, source)) from None


def _sentence(error: ValidationError, source: str) -> str:
    """Return in one sentence what a file does wrong first, unknown keys before all else."""
    first = min(error.errors(include_url=False), key=lambda e: e["type"] != "extra_forbidden")
    kind, value, place = first["type"], first["input"], _place(first["loc"])
    if kind == "extra_forbidden":
        return _unknown(place)
    if kind == "missing" and place.table is not ClosedLoopTable:
        what = _COLUMNS.get(place.key)
        add = f"name the log column of {what}" if what else "add it"
        where = place.where
        if source and place.table is VesselTable:
            where = f"{where} '{source}'"
        return f"{where} has no '{place.key}': {add}, as 'greybox import --help' shows."
    tag = first.get("ctx", {}).get("tag")
    number, word = place.name, tag or (value if isinstance(value, str) else "")
    if place.table is SensorsTable and len(place.path) == 1:
        # a sensor's number is known by its key alone
        number = place.key
    in_radians = _in_radians(place, first["input"])
    if kind == "float_type" and in_radians:
        return in_radians
    return (_BY_KIND.get(kind) or _BY_KEY.get(place.key, _WORD)).format(
        where=place.where,
        name=place.name,
        number=number,
        value=_shown(value),
        tag=tag,
        near=suggestion(word, _CHOICES.get("type" if tag else place.key, ())),
    )


def _in_radians(place: _Place, value: Any) -> str:
    """Return what is said of an angle that is written with its unit, "" of anything else."""
    if not isinstance(value, str) or not place.key.startswith(_IN_RADIANS):
        return ""
    written = re.fullmatch(r"\s*([-+]?[\d.]+)\s*(?:deg|degrees?|°)\s*(/\s*s)?\s*", value)
    if written is None:
        return ""
    try:
        number = math.radians(float(written[1]))
    except ValueError:
        return ""
    return (
        f"{place.name} is {_shown(value)}, a number is needed, in radians: {number:.4g} for "
        f"{value.strip()}."
    )


def _shown(value: Any) -> str:
    try:
        text = repr(value)
    except ValueError:  # Python spells no integer of thousands of digits
        return "an integer too large to be read"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"


def _unknown(place: _Place) -> str:
    """Return what is said of a key that its table does not have."""
    has = _LACKS.get(place.key.partition("_")[0])
    if place.thruster and has and any(place.key in t.model_fields for t in _THRUSTERS.values()):
        return f"{place.where} is of type {place.thruster} and {has}: remove '{place.key}'."
    known = place.table.model_fields
    dotted = " A name with a dot is written in quotes." if place.table is ColumnTable else ""
    return (
        f"{place.where} has the unknown key '{place.key}'.{suggestion(place.key, known)} "
        f"Known keys: {', '.join(sorted(known))}.{dotted}"
    )
