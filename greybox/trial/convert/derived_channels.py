"""What a log keeps is made of what was measured: velocities, yaw rate, wind.

On the uniform clock of a stretch without gaps. What was done to the wind stands
in the log's record, so that a log that is imported again is not moved again.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.channels import LOGGED
from greybox.errors import LogError, suggestion
from greybox.trial.convert.derived_signals import earth_to_body
from greybox.trial.convert.options import ImportOptions
from greybox.trial.convert.sensor_corrections import said_antenna
from greybox.trial.kinematics import velocities_from_positions
from greybox.trial.wind import move_anemometer, wind_at_height
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# the words by which a record tells what was done
_FROM_TRUE = "u_q, v_q from the true wind"
_MOVED = "u_q, v_q moved from the anemometer"
_BROUGHT = re.compile(r"true wind brought from \S+ to (\S+) m\b")


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


def wind_state(derived: Sequence[str]) -> WindState:
    """Return what the record of a log says was done to its wind.

    Parameters
    ----------
    derived : sequence of str
        What was derived, oldest first, as `complete_channels` says it.
    """
    heights = [float(m[1]) for d in derived if (m := _BROUGHT.match(d)) and _is_number(m[1])]
    return WindState(
        any(d.startswith((_FROM_TRUE, _MOVED)) for d in derived), heights[-1] if heights else None
    )


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def complete_channels(
    part: dict[str, Array],
    vessel: Vessel,
    sample_time: float,
    options: ImportOptions,
    earlier: Sequence[str] = (),
) -> tuple[dict[str, Array], list[str], bool]:
    """Make the channels of a log of those that were measured.

    Parameters
    ----------
    part : dict of str to ndarray
        (N,) each, on one uniform clock, angles unwrapped.
    vessel : Vessel
    sample_time : float
        Ts [s].
    options : ImportOptions
    earlier : sequence of str
        What was derived before, where the source is a log that greybox wrote.

    Returns
    -------
    channels : dict of str to ndarray
    derived : list of str
        What was derived, one sentence each.
    trim : bool
        Whether the first and last sample have only one neighbour (3.57).

    Raises
    ------
    LogError
        The wind is to be brought to a height and that of the anemometer is not known;
        a channel that the log has not is to be smoothed.
    """
    derived: list[str] = []
    logged = (*LOGGED, *vessel.recorded_columns)
    measured = [n for n in options.smooth if n in part and n in logged]
    _smooth(part, measured, sample_time, options, derived)
    antenna = vessel.sensors.get("antenna", (0.0, 0.0))
    trim = False
    psi = part.get("psi")
    if psi is not None and "r" not in part and len(psi) > 2:
        part["r"] = np.gradient(psi, sample_time)
        derived.append("r from heading by central differences (3.57)")
        trim = True
    if psi is not None and "u" not in part and "v_n" in part and "v_e" in part:
        # speed and course are the antenna's, u and v the body origin's
        u, v = earth_to_body(part["v_n"], part["v_e"], psi)
        r = part.get("r", np.zeros_like(u))
        part["u"] = u + r * antenna[1]
        part.setdefault("v", v - r * antenna[0])
        derived.append("u, v from the velocity over ground and the heading")
        derived += said_antenna(antenna)
    if psi is not None and "u" not in part and {"x_n", "y_n"} <= part.keys() and len(psi) > 2:
        if options.velocities == "savgol":
            from greybox.trial.smoothing import savgol_velocities

            u, v, r = savgol_velocities(
                part["x_n"], part["y_n"], psi, sample_time, window_s=options.window, order=3,
                heading_std=vessel.std("psi") or 0.0, antenna=antenna,
            )  # fmt: skip
            how = f"Savitzky-Golay over {options.window:g} s"
        else:
            u, v, r = velocities_from_positions(
                part["x_n"], part["y_n"], psi, sample_time,
                heading_std=vessel.std("psi") or 0.0, antenna=antenna,
            )  # fmt: skip
            how = "central differences (3.57)"
        part["u"] = u
        part.setdefault("v", v)
        if any(d.startswith("r from") for d in derived):
            part["r"] = r
        derived.append(f"u, v from positions and heading by {how}")
        derived += said_antenna(antenna)
        trim = True
    _complete_wind(part, vessel, options, derived, wind_state(earlier))
    channels = {n: part[n] for n in logged if n in part}
    _smooth(
        channels, [n for n in options.smooth if n not in measured], sample_time, options, derived
    )
    return channels, derived, trim


def _smooth(
    channels: dict[str, Array],
    names: Sequence[str],
    sample_time: float,
    options: ImportOptions,
    derived: list[str],
) -> None:
    from greybox.trial.smoothing import smooth

    for name in names:
        if name not in channels:
            raise LogError(
                f"'{name}' is to be smoothed and the log has no such channel."
                f"{suggestion(name, channels)} It has: {', '.join(channels)}."
            )
        window = options.smooth[name]
        channels[name] = smooth(channels[name], sample_time, window)
        derived.append(f"{name} smoothed over {window:g} s (local polynomials of order 2)")


def _complete_wind(
    part: dict[str, Array],
    vessel: Vessel,
    options: ImportOptions,
    derived: list[str],
    state: WindState,
) -> None:
    psi, u, v = part.get("psi"), part.get("u"), part.get("v")
    if "u_q" not in part and psi is not None and u is not None and v is not None:
        if "w_n" in part:
            # components of where it comes from: the air moves the other way
            from_x, from_y = earth_to_body(part["w_n"], part["w_e"], psi)
        elif "w_x" in part:
            from_x, from_y = part["w_x"], part["w_y"]
        else:
            return
        part["u_q"], part["v_q"] = u + from_x, v + from_y
        derived.append(f"{_FROM_TRUE}, the heading and the velocity over ground")
    elif "u_q" in part and "anemometer" in vessel.sensors and "r" in part and not state.at_origin:
        x, y, _ = vessel.sensors["anemometer"]
        part["u_q"], part["v_q"] = move_anemometer(part["u_q"], part["v_q"], part["r"], x, y)
        if x or y:
            derived.append(f"{_MOVED} at ({x:g}, {y:g}) m to the origin")
    wanted = options.reference_height
    if wanted is None or "u_q" not in part or u is None or v is None:
        return
    height = state.height
    # a record holds six digits
    if height is not None and math.isclose(height, wanted, rel_tol=1e-5):
        return
    if height is None:
        if "anemometer" not in vessel.sensors:
            raise LogError(
                f"the wind cannot be brought to {wanted:g} m without the height of the "
                f"anemometer: add anemometer = [x, y, height] to [sensors]."
            )
        height = vessel.sensors["anemometer"][2]
    part["u_q"], part["v_q"] = wind_at_height(
        part["u_q"], part["v_q"], u, v, height, reference_height=wanted
    )
    derived.append(f"true wind brought from {height:g} to {wanted:g} m (1/7 power law)")
