"""Channels that are derived from measured ones: local positions, velocities, yaw rate, wind.

`derive_signals` makes, on the clock of each sensor, what may be interpolated;
`complete_channels` makes velocities, yaw rate and wind on the clock of the log.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.channels import LOGGED
from greybox.errors import LogError, suggestion
from greybox.rotation import ned_to_body
from greybox.trial.convert.options import ImportOptions
from greybox.trial.kinematics import velocities_from_positions
from greybox.trial.raw_log import Array, Recording, Signal
from greybox.trial.smoothing import savgol_velocities, smooth
from greybox.trial.steps import Step
from greybox.trial.wind import move_anemometer, relative_wind, wind_at_height
from greybox.vessel.vessel import Vessel

# speed and direction, and the components that may be interpolated
_POLAR = (
    ("sog", "cog", ("v_n", "v_e")),
    ("V_q", "gamma_q", ("u_q", "v_q")),
    ("V_q", "dir_q", ("u_q", "v_q")),
    ("V_w", "dir_w", ("w_n", "w_e")),
    ("V_w", "dir_t", ("w_x", "w_y")),
)
# how far wrapped radians reach, and the noise of a sensor
_TURN = 2 * np.pi + 0.5
# order of the polynomials of positions: the velocity may bend within the window
POSITION_ORDER = 3
_SMOOTHING_ORDER = 2
# pairs that tell of a motion, each what another would, and all of its signals
BODY, EARTH, PLACE = ("u", "v"), ("v_n", "v_e"), ("x_n", "y_n")
MOTION_SIGNALS = (*PLACE, "psi", *BODY, "r", *EARTH)


def derive_signals(recording: Recording, origin: tuple[float, float] | None = None) -> Recording:
    """Turn angles and geographic positions into what may be interpolated.

    Latitude and longitude become north and east of the first position, speed
    and course a velocity, wind speed and direction two components; headings
    are unwrapped. Each on its own clock, before any resampling.

    Parameters
    ----------
    recording : Recording
        Canonical signals.
    origin : tuple of float, optional
        Latitude and longitude [deg] of ``x_n = y_n = 0``; the first position
        by default.

    Returns
    -------
    Recording
        Without ``lat``, ``lon``, ``sog``, ``cog`` and polar winds where their
        components could be made; the steps tell.
    """
    signals = {s.name: s for s in recording.signals}
    steps: list[Step] = []
    if "lat" in signals and "lon" in signals:
        lat, lon = signals.pop("lat"), signals.pop("lon")
        if not {"x_n", "y_n"} <= signals.keys() and np.isfinite(places(lat, lon)[1]).any():
            north, east, zero = local_positions(lat, lon, origin)
            signals["x_n"], signals["y_n"] = north, east
            place = {"lat": zero[0], "lon": zero[1]}
            steps.append(Step("tangent_plane", ("x_n", "y_n"), ("lat", "lon"), place))
    for size, direction, pair in _POLAR:
        if size not in signals or direction not in signals or pair[0] in signals:
            continue
        t, speed, angle = _paired(signals[size], signals.pop(direction))
        # gamma_q is minus the direction that the wind comes from
        parts = relative_wind(speed, -angle if direction == "gamma_q" else angle)
        for name, part in zip(pair, parts, strict=True):
            signals[name] = Signal(name, t, part, "m/s", signals[size].source, True)
        steps.append(Step("polar", pair, (size, direction)))
    for name in {n for size, direction, _ in _POLAR for n in (size, direction)}:
        signals.pop(name, None)
    if "psi" in signals:
        signals["psi"] = unwrapped(signals["psi"])
    return recording.with_signals(signals.values()).with_steps(*steps)


def local_positions(
    lat: Signal, lon: Signal, origin: tuple[float, float] | None = None
) -> tuple[Signal, Signal, tuple[float, float]]:
    """Return north and east [m] of latitudes and longitudes, and their origin [deg].

    The local tangent plane of WGS 84 at the origin.
    """
    import pymap3d

    t, phi, lam = places(lat, lon)
    if origin is None:
        k = int(np.flatnonzero(np.isfinite(phi))[0])
        origin = (float(phi[k]), float(lam[k]))
    north, east, _ = pymap3d.geodetic2ned(
        phi, lam, np.zeros_like(phi), origin[0], origin[1], 0.0, deg=True
    )
    return (
        Signal("x_n", t, np.asarray(north), "m", lat.source, True),
        Signal("y_n", t, np.asarray(east), "m", lon.source, True),
        origin,
    )


def places(lat: Signal, lon: Signal) -> tuple[Array, Array, Array]:
    """Return times, latitude and longitude [deg], NaN for both where they are no place on earth."""
    t, phi, lam = _paired(lat, lon)
    known = (np.abs(phi) <= 90) & (np.abs(lam) <= 360)
    return t, np.where(known, phi, np.nan), np.where(known, lam, np.nan)


def unwrapped(signal: Signal) -> Signal:
    """Return an angle without its wraps; values that are no number stay."""
    value = signal.value.copy()
    finite = np.isfinite(value)
    value[finite] = continuous(value[finite])
    return replace(signal, value=value)


def continuous(angle: Array) -> Array:
    """Return an angle without its wraps, be they of 2π or, under a wrong name, of 360.

    What is beyond a turn already has been unwrapped before, or holds degrees: it is left as it
    is. So are single glitches beyond a turn among wrapped values.
    """
    if not len(angle):
        return angle
    if wraps_by_degrees(angle):
        return np.asarray(np.unwrap(angle, period=360.0))
    if usual_reach(angle) > _TURN:
        return angle
    glitch = np.abs(angle) > _TURN
    out = angle.astype(float)
    out[~glitch] = np.unwrap(angle[~glitch])
    return out


def wraps_by_degrees(angle: Array) -> bool:
    """Whether an angle, each value a number, steps by 360 where it passes a full turn."""
    jumps = np.abs(np.diff(angle))
    return bool(np.any((jumps > 300) & (jumps < 361)))


def usual_reach(angle: Array) -> float:
    """Return the largest size of an angle, each value a number, single glitches left out."""
    return float(np.quantile(np.abs(angle), 0.98))


def _paired(a: Signal, b: Signal) -> tuple[Array, Array, Array]:
    """Return both signals at the times of the first."""
    if len(a) == len(b) and np.array_equal(a.t, b.t):
        return a.t, a.value, b.value
    order = np.argsort(b.t, kind="stable")
    t, k = b.t[order], np.searchsorted(b.t[order], a.t)
    # the nearest: they come from one sensor, and angles cannot be interpolated
    left = np.clip(k - 1, 0, len(t) - 1)
    right = np.clip(k, 0, len(t) - 1)
    near = np.where(np.abs(t[left] - a.t) <= np.abs(t[right] - a.t), left, right)
    return a.t, a.value, b.value[order][near]


@dataclass(frozen=True)
class WindState:
    """What was done to a wind before.

    Parameters
    ----------
    at_origin : bool
        Whether it is that of the body origin.
    height : float, optional
        Height to which it was brought [m]; None where it is as measured.
    """

    at_origin: bool = False
    height: float | None = None

    def __str__(self) -> str:
        place = "moved to the origin" if self.at_origin else "not moved"
        height = "at the height of its sensor" if self.height is None else f"at {self.height:g} m"
        return f"{place} and {height}"


def wind_state(steps: Iterable[Step]) -> WindState:
    """Return what the steps of a log did to its wind."""
    at_origin, height = False, None
    for step in steps:
        if step.operation in ("true_wind", "move_anemometer"):
            at_origin = True
        elif step.operation == "wind_height":
            height = step.number("height")
    return WindState(at_origin, height)


@dataclass(frozen=True)
class Completed:
    """Channels of a log, measured and derived.

    Parameters
    ----------
    channels : dict of str to ndarray
        (N,) each.
    steps : tuple of Step
        What was made, in order.
    trim : bool
        Whether the first and last sample have only one neighbour (3.57).
    """

    channels: dict[str, Array]
    steps: tuple[Step, ...]
    trim: bool


def complete_channels(
    part: dict[str, Array],
    vessel: Vessel,
    sample_time: float,
    options: ImportOptions,
    before: Sequence[Step] = (),
) -> Completed:
    """Derive the channels of a log from those that were measured.

    Parameters
    ----------
    part : dict of str to ndarray
        (N,) each, on one uniform clock, angles unwrapped.
    vessel : Vessel
    sample_time : float
        Ts [s].
    options : ImportOptions
    before : sequence of Step
        What was done to the channels already.

    Raises
    ------
    LogError
        Nothing can be made of them; the wind is to be brought to a height and that of the
        anemometer is not known; a channel that the log has not is to be smoothed.
    """
    logged = (*LOGGED, *vessel.recorded_columns)
    measured = [n for n in options.smooth if n in part and n in logged]
    steps = _smooth(part, measured, sample_time, options)
    motion = _velocities(part, vessel, sample_time, options)
    steps += motion
    steps += _wind(part, vessel, options, wind_state(before))
    channels = {n: part[n] for n in logged if n in part}
    if not channels:
        raise LogError(
            f"no channel of a log can be made of {', '.join(part)} alone: velocities need the "
            f"heading psi. Map more columns in [columns], or add the file that holds them."
        )
    later = [n for n in options.smooth if n not in measured]
    steps += _smooth(channels, later, sample_time, options)
    trim = any(s.operation in ("difference", "local_polynomials") for s in motion)
    return Completed(channels, tuple(steps), trim)


def _smooth(
    channels: dict[str, Array], names: Sequence[str], sample_time: float, options: ImportOptions
) -> list[Step]:
    steps = []
    for name in names:
        if name not in channels:
            raise LogError(
                f"'{name}' cannot be smoothed, for the log has no such channel."
                f"{suggestion(name, channels)} It has: {', '.join(channels)}."
            )
        window = options.smooth[name]
        channels[name] = smooth(channels[name], sample_time, window, _SMOOTHING_ORDER)
        how = {"window": window, "order": float(_SMOOTHING_ORDER)}
        steps.append(Step("smooth", (name,), parameters=how, decided_by="user"))
    return steps


def made_from_positions(names: Container[str]) -> bool:
    """Whether u or v of a log with these channels is made from positions and heading."""
    lacking = any(n not in names for n in BODY) and any(n not in names for n in EARTH)
    return lacking and all(n in names for n in (*PLACE, "psi"))


def _velocities(
    part: dict[str, Array], vessel: Vessel, sample_time: float, options: ImportOptions
) -> list[Step]:
    """Make u, v and r where nothing measured them; return what was done."""
    psi = part.get("psi")
    if psi is None:
        return []
    steps = []
    missing = [n for n in BODY if n not in part]
    turning = "r" not in part and len(psi) > 2
    if turning:
        part["r"] = np.gradient(psi, sample_time)
    antenna = vessel.sensors.get("antenna", (0.0, 0.0))
    differenced = ["r"] if turning else []
    if missing and {"v_n", "v_e"} <= part.keys():
        # speed and course are the antenna's, u and v the body origin's
        u, v = ned_to_body(part["v_n"], part["v_e"], psi)
        r = part.get("r", np.zeros_like(u))
        made = {"u": u + r * antenna[1], "v": v - r * antenna[0]}
        source = ("v_n", "v_e", "psi")
        steps.append(Step("earth_to_body", tuple(missing), source))
    elif made_from_positions(part) and len(psi) > 2:
        place = part["x_n"], part["y_n"], psi, sample_time
        std = vessel.std("psi") or 0.0
        source = ("x_n", "y_n", "psi")
        if options.velocities == "savgol":
            u, v, r = savgol_velocities(
                *place,
                window_s=options.window,
                order=POSITION_ORDER,
                heading_std=std,
                antenna=antenna,
            )
            how = {"window": options.window, "order": float(POSITION_ORDER)}
            names = (*missing, *differenced)
            steps.append(Step("local_polynomials", names, source, how, decided_by="user"))
            if turning:
                part["r"], differenced = r, []
        else:
            u, v, _ = velocities_from_positions(*place, heading_std=std, antenna=antenna)
            steps.append(Step("difference", tuple(missing), source))
        made = {"u": u, "v": v}
    else:
        missing = []
    for name in missing:
        part[name] = made[name]
    if differenced:
        steps.insert(0, Step("difference", ("r",), ("psi",)))
    if missing and any(antenna[:2]):
        arm = {"x": antenna[0], "y": antenna[1], "sensor": "antenna"}
        steps.append(Step("move_velocity", tuple(missing), (), arm, decided_by="vessel"))
    return steps


def _wind(
    part: dict[str, Array], vessel: Vessel, options: ImportOptions, state: WindState
) -> list[Step]:
    """Make the velocity through the air at the body origin; return what was done."""
    psi, u, v = part.get("psi"), part.get("u"), part.get("v")
    steps = []
    if "u_q" not in part and psi is not None and u is not None and v is not None:
        if "w_n" in part:
            # components of where it comes from: the air moves the other way
            from_x, from_y = ned_to_body(part["w_n"], part["w_e"], psi)
        elif "w_x" in part:
            from_x, from_y = part["w_x"], part["w_y"]
        else:
            return []
        part["u_q"], part["v_q"] = u + from_x, v + from_y
        source = ("w_n", "w_e") if "w_n" in part else ("w_x", "w_y")
        steps.append(Step("true_wind", ("u_q", "v_q"), (*source, "psi", "u", "v")))
    elif {"u_q", "v_q", "r"} <= part.keys() and "anemometer" in vessel.sensors:
        x, y, _ = vessel.sensors["anemometer"]
        if (x or y) and not state.at_origin:
            part["u_q"], part["v_q"] = move_anemometer(part["u_q"], part["v_q"], part["r"], x, y)
            place = {"x": x, "y": y}
            moved = Step("move_anemometer", ("u_q", "v_q"), (), place, decided_by="vessel")
            steps.append(moved)
    wanted = options.reference_height
    if wanted is None or "u_q" not in part or u is None or v is None:
        return steps
    height = state.height
    # a record of version 1 holds six digits
    if height is not None and math.isclose(height, wanted, rel_tol=1e-5):
        return steps
    if height is None:
        if "anemometer" not in vessel.sensors:
            raise LogError(
                f"the wind cannot be brought to {wanted:g} m without the height of the "
                f"anemometer: add anemometer = [x, y, height] to [sensors]."
            )
        height = vessel.sensors["anemometer"][2]
    part["u_q"], part["v_q"] = wind_at_height(part["u_q"], part["v_q"], u, v, height, wanted)
    between = {"measured": height, "height": wanted}
    return [*steps, Step("wind_height", ("u_q", "v_q"), (), between, decided_by="user")]
