"""What the log of a blind trial holds: sensors, their noises and what is wrong with them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from greybox.rotation import body_to_ned, ned_to_body
from greybox.study.blind_causes import Effect
from greybox.study.blind_ship import History

Array = NDArray[np.float64]

# (6.2), and what is usual for positions and wind
NOISE = {
    "u": np.sqrt(2e-4), "v": np.sqrt(2e-4), "r": np.sqrt(2e-4), "psi": 1e-2,
    "x_n": 0.1, "y_n": 0.1, "u_q": 0.2, "v_q": 0.2,
}  # fmt: skip


def observe(
    history: History,
    ship: int,
    wind: Array,
    effects: tuple[Effect, ...],
    lead: int,
    *,
    noise: float,
    sensors: np.random.Generator,
    sea: np.random.Generator,
) -> dict[str, Array]:
    """Return the channels of one ship's log (N,), one sample a second.

    Parameters
    ----------
    history : History
    ship : int
    wind : ndarray
        (N + lead, 2) velocity of the air that the anemometer feels, north and east [m/s].
    effects : tuple of Effect
        Those of the sensors act here.
    lead : int
        Seconds before the log begins.
    noise : float
        Factor on the noises of the sensors.
    sensors, sea : numpy.random.Generator
        Draw the noises and the waves.
    """
    found = {e.id: e for e in effects}
    t, north, east = history.positions(ship)
    fine = {n: np.interp(t, history.t, history.x[:, i, ship]) for i, n in enumerate("uvr")}
    fine["psi"] = np.interp(t, history.t, history.x[:, 3, ship])
    fine |= {"x_n": north, "y_n": east}
    if "waves" in found:
        _rock(fine, t, found["waves"], sea)
    whole = np.arange(lead, len(wind))
    heading, over = (np.interp(whole, t, fine[n]) for n in ("psi", "u"))
    across = np.interp(whole, t, fine["v"])
    if "lever_arm" in found:
        _at_antenna(fine, found["lever_arm"])
    if "heading_bias" in found:
        _misaligned(fine, found["heading_bias"])
    late = found["clock_offset"].parameters if "clock_offset" in found else {}
    channels = {
        n: np.interp(whole - float(late.get(f"clock_{n}", 0.0)), t, value)
        for n, value in fine.items()
    }
    blow = ned_to_body(wind[lead:, 0], wind[lead:, 1], heading)
    channels["u_q"], channels["v_q"] = over - blow[0], across - blow[1]
    for i, n in enumerate(("n1", "n2", "alpha1", "alpha2")):
        channels[n] = history.commands[lead:, i, ship].copy()
    if "angle_offset" in found:
        for name, value in found["angle_offset"].parameters.items():
            # true minus logged
            channels[name.removeprefix("offset_")] -= float(value)
    if "sign" in found:
        name = str(found["sign"].parameters["channel"])
        channels[name] = -channels[name]
    for name, std in NOISE.items():
        channels[name] = channels[name] + noise * std * sensors.standard_normal(len(whole))
    return channels


def _at_antenna(fine: dict[str, Array], effect: Effect) -> None:
    """Measure positions, and perhaps velocities, where the antenna stands."""
    lx, ly = effect.number("lever_arm_x"), effect.number("lever_arm_y")
    north, east = body_to_ned(lx, ly, fine["psi"])
    fine["x_n"], fine["y_n"] = fine["x_n"] + north, fine["y_n"] + east
    if effect.parameters["variant"] == "antenna":
        fine["u"] = fine["u"] - fine["r"] * ly
        fine["v"] = fine["v"] + fine["r"] * lx


def _misaligned(fine: dict[str, Array], effect: Effect) -> None:
    """Bias the heading, and with it velocities that were turned from earth to body axes."""
    bias = effect.number("heading_bias")
    fine["psi"] = fine["psi"] + bias
    if effect.parameters["variant"] == "earth":
        fine["u"], fine["v"] = ned_to_body(fine["u"], fine["v"], bias)


def _rock(fine: dict[str, Array], t: Array, effect: Effect, rng: np.random.Generator) -> None:
    """Add narrow-band motion to u, v, r, and its integral to heading and positions."""
    motion, way = {}, {}
    for name in "uvr":
        rms = effect.number("ratio") * NOISE[name]
        motion[name], way[name] = narrow_band(rng, t, effect.number("frequency"), rms)
    north, east = body_to_ned(way["u"], way["v"], fine["psi"])
    fine["x_n"], fine["y_n"] = fine["x_n"] + north, fine["y_n"] + east
    fine["psi"] = fine["psi"] + way["r"]
    for name in "uvr":
        fine[name] = fine[name] + motion[name]


def narrow_band(
    rng: np.random.Generator, t: Array, frequency: float, rms: float
) -> tuple[Array, Array]:
    """Draw a narrow-band motion and its integral.

    Parameters
    ----------
    rng : numpy.random.Generator
    t : ndarray
        (M,) [s]
    frequency : float
        Middle of the band [Hz]; its width is a tenth of that.
    rms : float
        Root mean square of the motion.

    Returns
    -------
    tuple of ndarray
        (M,) each.
    """
    omega = 2 * np.pi * frequency * (1 + 0.1 * np.clip(rng.standard_normal(24), -2.5, 2.5))
    phase = rng.uniform(0, 2 * np.pi, 24)
    amplitude = rms * np.sqrt(2 / 24)
    angle = np.outer(t, omega) + phase
    return amplitude * np.cos(angle).sum(axis=1), amplitude * (np.sin(angle) / omega).sum(axis=1)


def gauss_markov(
    rng: np.random.Generator, samples: int, std: float, memory: float, width: int = 2
) -> Array:
    """Draw a zero-mean first-order process (N, width) at 1 Hz; white without memory [s]."""
    white = rng.standard_normal((samples, width))
    if memory <= 0:
        return std * white
    keep = np.exp(-1 / memory)
    out = np.empty_like(white)
    out[0] = white[0]
    for k in range(1, samples):
        out[k] = keep * out[k - 1] + np.sqrt(1 - keep**2) * white[k]
    return np.asarray(std * out)


def wanted(channels: Mapping[str, Array], positions: bool, anemometer: bool) -> dict[str, Array]:
    """Return the channels that this log holds."""
    gone = set() if positions else {"x_n", "y_n"}
    gone |= set() if anemometer else {"u_q", "v_q"}
    return {k: v for k, v in channels.items() if k not in gone}
