"""From the names and units of a source to canonical ones: mapped, exact, or guessed and said so."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from greybox.channels import CHANNELS
from greybox.vessel.vessel import Vessel

_UNIT_WORDS = {
    "°": "deg", "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad",
    "kts": "kn", "kt": "kn", "knot": "kn", "m s-1": "m/s", "ms-1": "m/s", "m*s^-1": "m/s",
    "m.s-1": "m/s", "meter": "m", "metre": "m", "meters": "m", "metres": "m", "sec": "s",
    "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "°/s": "deg/s", "dps": "deg/s",
    "°/min": "deg/min", "rad s-1": "rad/s", "1/s": "rps", "1/min": "rpm", "hz": "rps", "n": "N",
    "kn/h": "kn", "kmh": "km/h", "kph": "km/h", "newton": "N",
}  # fmt: skip
_UNITS = (
    "s", "ms", "us", "ns", "min", "h", "m", "cm", "mm", "km", "ft", "nmi", "rad", "deg", "m/s",
    "km/h", "kn", "knots", "rad/s", "deg/s", "deg/min", "rpm", "rps", "N", "kN",
)  # fmt: skip
# longest first: '_radps' must not be read as '_s'
_SUFFIXES = (
    ("radps", "rad/s"), ("rad_s", "rad/s"), ("rads", "rad/s"), ("degps", "deg/s"),
    ("deg_s", "deg/s"), ("degs", "deg/s"), ("dps", "deg/s"), ("deg_min", "deg/min"),
    ("degpm", "deg/min"), ("rad", "rad"), ("deg", "deg"), ("mps", "m/s"), ("m_s", "m/s"),
    ("knots", "kn"), ("kts", "kn"), ("kn", "kn"), ("kmh", "km/h"), ("kph", "km/h"),
    ("rpm", "rpm"), ("rps", "rps"), ("ms", "ms"), ("us", "us"), ("ns", "ns"), ("sec", "s"),
    ("s", "s"), ("m", "m"),
)  # fmt: skip
# words that tell how a signal was made, not what it is
_QUALIFIERS = {
    "hat", "mid", "meas", "measured", "ant", "antenna", "est", "estimated", "filt", "filtered",
    "gps", "gnss", "imu", "ins", "raw", "actual", "act", "body", "sensor", "mean",
}  # fmt: skip
# most telling spelling first: where two columns match, the earlier one is taken
_GUESSES: dict[str, tuple[str, ...]] = {
    "t": ("t", "time", "times", "timestamp", "t_rel", "elapsed", "elapsed_time", "seconds",
          "original_timestamp", "unix", "unix_time", "unix_utc", "utc", "datetime", "date_time",
          "epoch", "gps_time", "time_unix", "utc_time", "time_utc", "uhrzeit", "stamp",
          "zeit", "tid", "clock"),
    "psi": ("psi", "heading", "hdg", "true_heading", "heading_true", "yaw", "yaw_angle", "head",
            "hdt"),
    "x_n": ("x_n", "x_ned", "north", "n", "northing", "pos_n", "pos_north", "position_north",
            "north_position", "p_n", "pn", "x_north", "x0", "x_earth", "x_position", "x_pos",
            "pos_x", "position_x", "x"),
    "y_n": ("y_n", "y_ned", "east", "e", "easting", "pos_e", "pos_east", "position_east",
            "east_position", "p_e", "pe", "y_east", "y0", "y_earth", "y_position", "y_pos",
            "pos_y", "position_y", "y"),
    "u": ("u", "surge", "surge_velocity", "surge_speed", "surge_vel", "velocity_surge",
          "vel_surge", "u_velo", "u_vel", "u_velocity", "longitudinal_velocity", "nu_u"),
    "v": ("v", "sway", "sway_velocity", "sway_speed", "sway_vel", "velocity_sway", "vel_sway",
          "v_velo", "vm_velo", "v_vel", "vm", "v_velocity", "transverse_velocity",
          "lateral_velocity", "nu_v"),
    "r": ("r", "yaw_rate", "yawrate", "rate_of_turn", "turn_rate", "rot", "r_angvelo", "yaw_vel",
          "yaw_velocity", "r_velo", "omega_z", "gyro_z", "angular_velocity_z", "psi_dot", "nu_r"),
    "v_n": ("v_n", "vn", "v_north", "vel_n", "vel_north", "velocity_north", "north_velocity",
            "vx0", "north_vel"),
    "v_e": ("v_e", "ve", "v_east", "vel_e", "vel_east", "velocity_east", "east_velocity", "vy0",
            "east_vel"),
    "sog": ("sog", "speed_over_ground", "ground_speed"),
    "cog": ("cog", "course_over_ground", "ground_course", "course"),
    "lat": ("lat", "latitude", "breite", "breitengrad"),
    "lon": ("lon", "lng", "long", "longitude", "laenge", "laengengrad"),
    "V_q": ("aws", "apparent_wind_speed", "relative_wind_speed", "wind_speed_relative",
            "wind_speed_apparent", "wind_velo_relative", "rel_wind_speed"),
    "dir_q": ("awa", "apparent_wind_angle", "apparent_wind_direction", "relative_wind_direction",
              "relative_wind_angle", "wind_dir_relative", "wind_direction_relative",
              "wind_angle_relative", "rel_wind_dir", "rel_wind_angle"),
    "V_w": ("tws", "true_wind_speed", "wind_speed_true", "wind_velo_true"),
    "dir_w": ("twd", "true_wind_direction", "wind_direction_true", "wind_dir_true"),
}  # fmt: skip


@dataclass(frozen=True)
class Assigned:
    """What a column of the source is taken for.

    Parameters
    ----------
    raw : str
        Name in the source.
    name : str
        Canonical name, or thruster column.
    unit : str or None
        Unit of the source; None where nothing tells it.
    sign : int
        −1 where the vessel file reverses the column.
    how : {"mapped", "exact", "guessed"}
    """

    raw: str
    name: str
    unit: str | None
    sign: int
    how: str


def spelled_unit(text: str) -> str | None:
    """Return the unit that a text spells, in the spelling of `greybox.channels`, else None."""
    bare = text.strip()
    if bare in _UNITS:
        return bare
    low = bare.lower()
    if low in _UNIT_WORDS:
        return _UNIT_WORDS[low]
    return low if low in _UNITS else None


def split_unit(raw: str) -> tuple[str, str | None]:
    """Part a column name into its stem, lower case, and the unit that it carries."""
    unit: str | None = None
    bracket = re.search(r"[\[(]\s*([^\])]*)\s*[\])]\s*$", raw)
    stem = raw
    if bracket:
        unit = spelled_unit(bracket.group(1))
        stem = raw[: bracket.start()]
    stem = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", stem.strip())
    stem = re.sub(r"[^0-9a-zA-Z]+", "_", stem).strip("_").lower()
    if unit is None:
        for suffix, spelled in _SUFFIXES:
            if stem.endswith(f"_{suffix}") and stem != suffix:
                return stem[: -len(suffix) - 1], spelled
    return stem, unit


def assign(
    columns: Iterable[str],
    vessel: Vessel,
    *,
    units: Mapping[str, str] | None = None,
    canonical: Iterable[str] = (),
    guess: bool = True,
) -> dict[str, Assigned]:
    """Say which column is which signal.

    Parameters
    ----------
    columns : iterable of str
        Names in the source.
    vessel : Vessel
        Its ``[columns]`` come first, then exact canonical names and thruster
        columns, then guesses.
    units : mapping of str to str, optional
        Units that the source states beside its names.
    canonical : iterable of str
        Names that the format itself defines.
    guess : bool
        Whether to guess what is left from well-known spellings.

    Returns
    -------
    dict of str to Assigned
        By canonical name; each at most once.
    """
    columns, units, defined = list(columns), units or {}, set(canonical)
    found: dict[str, Assigned] = {}
    for raw, mapping in vessel.columns.items():
        if raw in columns:
            found[mapping.name] = Assigned(raw, mapping.name, mapping.unit, mapping.sign, "mapped")
    taken = {a.raw for a in found.values()}
    loop = [vessel.closed_loop[0]] if vessel.closed_loop else []
    for raw in columns:
        known = raw in CHANNELS or raw in vessel.recorded_columns or raw in loop
        if known and raw not in found and raw not in taken:
            # a canonical name promises its SI unit; a unit written beside it is believed
            unit = units.get(raw, CHANNELS[raw].unit if raw in CHANNELS else None)
            how = "exact" if raw not in defined else "defined"
            found[raw] = Assigned(raw, raw, unit, 1, how)
            taken.add(raw)
    if not guess:
        return found
    stems = {raw: split_unit(raw.rsplit(".", 1)[-1]) for raw in columns if raw not in taken}
    for name, spellings in _GUESSES.items():
        if name in found or _pointless(name, found):
            continue
        best: tuple[int, str] | None = None
        for raw, (stem, _) in stems.items():
            rank = _rank(stem, spellings)
            if raw not in taken and rank is not None and (best is None or rank < best[0]):
                best = (rank, raw)
        if best is None:
            continue
        raw = best[1]
        unit = units.get(raw, stems[raw][1])
        if unit == "ms" and CHANNELS[name].unit == "m/s":
            unit = "m/s"
        if unit is None or _fits(unit, CHANNELS[name].unit):
            found[name] = Assigned(raw, name, unit, 1, "guessed")
            taken.add(raw)
    return found


def _pointless(name: str, found: Mapping[str, Assigned]) -> bool:
    """Whether a guess would only repeat what is there in a better form."""
    mapped = {n for n, a in found.items() if a.how != "guessed"}
    return (
        (name in ("sog", "cog") and {"v_n", "v_e"} <= found.keys())
        or (name in ("v_n", "v_e", "sog", "cog") and {"u", "v"} <= found.keys())
        or (name in ("lat", "lon") and {"x_n", "y_n"} <= found.keys())
        or (name in ("V_q", "dir_q", "V_w", "dir_w") and {"u_q", "v_q"} <= mapped)
        or (name == "dir_q" and "gamma_q" in mapped)
        or (name in ("V_w", "dir_w") and "V_q" in found)
    )


def _rank(stem: str, spellings: tuple[str, ...]) -> int | None:
    if stem in spellings:
        return spellings.index(stem)
    words = [w for w in stem.split("_") if w not in _QUALIFIERS]
    bare = "_".join(words)
    return spellings.index(bare) + len(spellings) if bare in spellings else None


def _fits(unit: str, target: str) -> bool:
    from greybox.channels import unit_factor
    from greybox.errors import LogError

    try:
        unit_factor(unit, target, "")
    except LogError:
        return False
    return True
