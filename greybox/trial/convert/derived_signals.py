"""What a log needs and its source does not hold as such: positions, velocities, wind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.trial.raw_log import Recording, Signal

Array = NDArray[np.float64]


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
        components could be made; the notes tell.
    """
    signals = {s.name: s for s in recording.signals}
    notes: list[str] = []
    if "lat" in signals and "lon" in signals:
        lat, lon = signals.pop("lat"), signals.pop("lon")
        if not {"x_n", "y_n"} <= signals.keys() and np.isfinite(lat.value).any():
            north, east, zero = local_positions(lat, lon, origin)
            signals["x_n"], signals["y_n"] = north, east
            notes.append(
                f"x_n, y_n from {lat.source} north and east of {zero[0]:.8f}, {zero[1]:.8f} deg"
            )
    if "sog" in signals and "cog" in signals:
        sog, cog = signals.pop("sog"), signals.pop("cog")
        if not {"v_n", "v_e"} <= signals.keys():
            t, speed, course = _paired(sog, cog)
            for name, part in (("v_n", np.cos(course)), ("v_e", np.sin(course))):
                signals[name] = Signal(name, t, speed * part, "m/s", sog.source, True)
            notes.append(f"v_n, v_e from speed and course over ground of {sog.source}")
    for speed_name, angle_name, pair in (
        ("V_q", "gamma_q", ("u_q", "v_q")),
        ("V_q", "dir_q", ("u_q", "v_q")),
        ("V_w", "dir_w", ("w_n", "w_e")),
        ("V_w", "dir_t", ("w_x", "w_y")),
    ):
        if speed_name not in signals or angle_name not in signals or pair[0] in signals:
            continue
        t, speed, angle = _paired(signals[speed_name], signals.pop(angle_name))
        # gamma_q is minus the direction the wind comes from, and v_q = −V_q sin gamma_q
        angle = -angle if angle_name == "gamma_q" else angle
        source = signals[speed_name].source
        for name, part in zip(pair, (np.cos(angle), np.sin(angle)), strict=True):
            signals[name] = Signal(name, t, speed * part, "m/s", source, True)
        if pair[0] == "u_q":
            notes.append("u_q, v_q from apparent wind speed and direction (5.40)")
    for name in ("V_q", "V_w", "gamma_q", "dir_q", "dir_w", "dir_t"):
        signals.pop(name, None)
    if "psi" in signals:
        signals["psi"] = unwrapped(signals["psi"])
    return recording.with_signals(signals.values(), *notes)


def local_positions(
    lat: Signal, lon: Signal, origin: tuple[float, float] | None = None
) -> tuple[Signal, Signal, tuple[float, float]]:
    """Return north and east [m] of latitudes and longitudes, and their origin [deg].

    The local tangent plane of WGS 84 at the origin.
    """
    import pymap3d

    t, phi, lam = _paired(lat, lon)
    if origin is None:
        k = int(np.flatnonzero(np.isfinite(phi) & np.isfinite(lam))[0])
        origin = (float(phi[k]), float(lam[k]))
    north, east, _ = pymap3d.geodetic2ned(
        phi, lam, np.zeros_like(phi), origin[0], origin[1], 0.0, deg=True
    )
    return (
        Signal("x_n", t, np.asarray(north), "m", lat.source, True),
        Signal("y_n", t, np.asarray(east), "m", lon.source, True),
        origin,
    )


def unwrapped(signal: Signal) -> Signal:
    """Return an angle without its wraps; values that are no number stay."""
    value = signal.value.copy()
    finite = np.isfinite(value)
    value[finite] = continuous(value[finite])
    return replace(signal, value=value)


def continuous(angle: Array) -> Array:
    """Return an angle without its wraps, be they of 2π or, under a wrong name, of 360.

    What is beyond a turn already has been unwrapped before, or holds degrees:
    it is left as it is.
    """
    if not len(angle):
        return angle
    jumps = np.abs(np.diff(angle))
    if np.any((jumps > 300) & (jumps < 361)):
        return np.asarray(np.unwrap(angle, period=360.0))
    if np.abs(angle).max() > 2 * np.pi + 0.5:
        return angle
    return np.asarray(np.unwrap(angle))


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


def earth_to_body(north: Array, east: Array, psi: Array) -> tuple[Array, Array]:
    """Return the components along the bow and to starboard of a vector given north and east."""
    c, s = np.cos(psi), np.sin(psi)
    return c * north + s * east, c * east - s * north
