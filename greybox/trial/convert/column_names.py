"""From the names and units of a source to canonical ones: mapped, exact, or guessed and said so."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from greybox.channels import CHANNELS
from greybox.errors import LogError
from greybox.units import spelled_unit, suffix_unit, unit_factor
from greybox.vessel.vessel import Vessel

# words that tell how a signal was made, not what it is
_QUALIFIERS = {
    "hat", "mid", "meas", "measured", "ant", "antenna", "est", "estimated", "filt", "filtered",
    "gps", "gnss", "imu", "ins", "raw", "actual", "act", "body", "sensor", "mean",
}  # fmt: skip
# most telling spelling first: where two columns match, the earlier one is taken
_GUESSES: dict[str, tuple[str, ...]] = {
    "t": ("header_stamp", "t", "time", "times", "timestamp", "t_rel", "elapsed", "elapsed_time",
          "seconds", "original_timestamp", "unix", "unix_time", "unix_utc", "utc", "datetime",
          "date_time", "epoch", "gps_time", "time_unix", "utc_time", "time_utc", "time_stamp",
          "local_time", "time_local", "uhrzeit", "stamp", "zeit", "tid", "clock"),
    "psi": ("psi", "heading", "hdg", "true_heading", "heading_true", "yaw", "yaw_angle", "head",
            "hdt", "gyro_heading", "heading_gyro", "compass_heading", "hdg_true", "true_hdg",
            "hdg_gyro", "gyro_hdg"),
    "x_n": ("x_n", "x_ned", "north", "northing", "pos_n", "pos_north", "position_north",
            "north_position", "p_n", "pn", "x_north", "x0", "x_earth", "x_position", "x_pos",
            "pos_x", "position_x", "x"),
    "y_n": ("y_n", "y_ned", "east", "easting", "pos_e", "pos_east", "position_east",
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
# north and east where both stand together; alone, n is a shaft speed
_SHORT = {"x_n": "n", "y_n": "e"}
_UMLAUTS = {"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss"}
# the field of messages that hold one value
_ALONE = "data"


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


def split_unit(raw: str) -> tuple[str, str | None]:
    """Part a column name into its stem, lower case, and the unit that it carries."""
    stem, unit = _without_brackets(raw)
    for umlaut, spelled in _UMLAUTS.items():
        stem = stem.replace(umlaut, spelled)
    stem = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", stem)
    stem = re.sub(r"[^0-9a-zA-Z]+", "_", stem).strip("_").lower()
    return suffix_unit(stem) if unit is None else (stem, unit)


def _without_brackets(raw: str) -> tuple[str, str | None]:
    """Part a column name from the unit that stands in brackets behind it."""
    bracket = re.search(r"[\[(]\s*([^\])]*)\s*[\])]\s*$", raw)
    if bracket is None:
        return raw.strip(), None
    return raw[: bracket.start()].strip(), spelled_unit(bracket.group(1))


def assign(
    columns: Iterable[str],
    vessel: Vessel,
    *,
    units: Mapping[str, str] | None = None,
    canonical: Iterable[str] = (),
    guess: bool = True,
    stem: str = "",
    parts: Collection[str] = (),
) -> dict[str, Assigned]:
    """Say which column is which signal.

    Parameters
    ----------
    columns : iterable of str
        Names in the source.
    vessel : Vessel
        Its ``[columns]`` come first, then exact canonical names and thruster
        columns, then thruster columns with a unit in brackets, then guesses.
    units : mapping of str to str, optional
        Units that the source states beside its names.
    canonical : iterable of str
        Names that the format itself defines.
    guess : bool
        Whether to guess what is left from well-known spellings.
    stem : str
        Name of the file, by which the vessel file may qualify a column
        (``az1.data``, ``az1/data``, or ``az1`` where ``data`` is all it holds).
    parts : collection of str
        Columns that mean something only with others: never guessed.

    Returns
    -------
    dict of str to Assigned
        By canonical name; each at most once.

    Raises
    ------
    LogError
        ``[columns]`` maps two of the columns to one name.
    """
    columns, units, defined = list(columns), units or {}, set(canonical)
    found: dict[str, Assigned] = {}
    qualified = _qualified(columns, stem)
    for called, mapping in vessel.columns.items():
        raw, name = called if called in columns else qualified.get(called, ""), mapping.name
        if not raw:
            continue
        if name in found and found[name].raw != raw:
            raise LogError(
                f"columns '{found[name].raw}' and '{raw}' are both there, and [columns] maps both "
                f"to '{name}': remove one of the two lines from the vessel file."
            )
        if mapping.unit is None and name in vessel.recorded_columns:
            _require_fitting(raw, name, vessel.unit(name), units)
        unit = mapping.unit or _mapped_unit(raw, vessel.unit(name), units)
        # without a unit it promises what the canonical name does
        how = "mapped" if mapping.unit else "exact"
        found[name] = Assigned(raw, name, unit, mapping.sign, how)
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
    for name in (*vessel.recorded_columns, *loop):
        raw = qualified.get(name, "")
        if raw and name not in found and raw not in taken:
            found[name] = Assigned(raw, name, units.get(raw), 1, "mapped")
            taken.add(raw)
    if not guess:
        return found
    taken |= set(parts)
    for name in (c for c in vessel.recorded_columns if c not in found):
        named = [raw for raw in columns if raw not in taken and _without_brackets(raw)[0] == name]
        # of two, such as in rpm and in rps, neither is it
        if len(named) == 1:
            (raw,), target = named, vessel.unit(name)
            unit = units.get(raw, _without_brackets(raw)[1])
            if unit is None or target is None or _fits(unit, target):
                # what has no unit of its own is kept as it is
                unit = unit if target else None
                found[name] = Assigned(raw, name, unit, 1, "guessed")
                taken.add(raw)
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
    if not {"x_n", "y_n", "lat", "lon"} & found.keys():
        found |= _short_pair(stems, taken, units)
    return found


def _short_pair(
    stems: Mapping[str, tuple[str, str | None]], taken: Collection[str], units: Mapping[str, str]
) -> dict[str, Assigned]:
    """Return north and east where columns ``n`` and ``e`` stand together.

    Alone, ``n`` is a shaft speed.
    """
    found = {}
    for name, short in _SHORT.items():
        for raw, (stem, spelled) in stems.items():
            unit = units.get(raw, spelled)
            fits = unit is None or _fits(unit, "m")
            if raw not in taken and _rank(stem, (short,)) is not None and fits:
                found[name] = Assigned(raw, name, unit, 1, "guessed")
                break
    return found if len(found) == 2 else {}


def is_short_pair(assigned: Mapping[str, Assigned]) -> bool:
    """Whether north and east were guessed from columns ``n`` and ``e``, which may be others."""
    pair = [(assigned[n], short) for n, short in _SHORT.items() if n in assigned]
    return len(pair) == 2 and all(
        a.how == "guessed" and _rank(split_unit(a.raw)[0], (short,)) is not None
        for a, short in pair
    )


def _qualified(columns: Sequence[str], stem: str) -> dict[str, str]:
    """Return the columns by the names that tell the file too."""
    found = {f"{stem}{mark}{c}": c for c in columns for mark in "./"} if stem else {}
    if stem and _ALONE in columns and stem not in columns:
        found[stem] = _ALONE
    return found


def _mapped_unit(raw: str, target: str | None, units: Mapping[str, str]) -> str | None:
    """Return the unit of a column that is mapped without one: as it states itself, or SI."""
    unit = units.get(raw, split_unit(raw)[1])
    if unit == "ms" and target == "m/s":
        return "m/s"
    return unit if unit is not None and target is not None and _fits(unit, target) else target


def _require_fitting(raw: str, name: str, target: str | None, units: Mapping[str, str]) -> None:
    """Refuse a column of a thruster whose stated unit such a column cannot have."""
    stated = units.get(raw, _without_brackets(raw)[1])
    ending = split_unit(raw)[1]
    # other endings may be words of a name, as the s of starboard
    unit = stated or (ending if ending in ("rpm", "rps", "deg", "rad") else None)
    if unit is None:
        return
    try:
        unit_factor(unit, target, raw)
    except LogError:
        kind = "a propeller speed" if target is None else "an angle"
        raise LogError(
            f"column '{raw}' is in '{unit}', and [columns] maps it to '{name}', which is {kind}: "
            f"wrong column? Map another one, or state its unit there."
        ) from None


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
    try:
        unit_factor(unit, target, "")
    except LogError:
        return False
    return True
