"""Narrow-band motion in the innovations: waves, which no force of the model explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.channels import CHANNELS
from greybox.diagnosis.causes.cause import Cause
from greybox.diagnosis.noise import Noise, white_deviations
from greybox.diagnosis.point import Fit
from greybox.diagnosis.result import Found, Quantity

Array = NDArray[np.float64]

# frequencies at which waves meet ships [Hz]
_BAND = (0.04, 0.35)
# segments, and how far around a line its background is taken
_SEGMENT, _AROUND = 128, 9
# times the background that a line must stand out
_CLEAR = 3.0
# half width of a sea's peak as a share of its frequency
_NARROW = 0.35
# relative standard error of a level from this many segments
_LEVEL = 0.1


@dataclass(frozen=True)
class Waves:
    """A spectral line.

    Parameters
    ----------
    frequency : float
        Of encounter [Hz].
    frequency_std : float
        [Hz]
    std : mapping of str to float
        Motion in the band by state [m/s, rad/s].
    ratio : float
        Power of the line over its surroundings.
    p_value : float
        Of white innovations, all lines of the band counted.
    """

    frequency: float
    frequency_std: float
    std: dict[str, float]
    ratio: float
    p_value: float


def find_waves(
    nu: Sequence[Array], errors: Sequence[Array], names: Sequence[str], sample_time: float
) -> Waves | None:
    """Look for a line in the innovations that all channels share.

    Parameters
    ----------
    nu, errors : sequence of ndarray
        (N, ny) innovations and free-run errors of each log.
    names : sequence of str
        Channels, in their order; angles are left out.
    sample_time : float
        [s]
    """
    from scipy.ndimage import median_filter, uniform_filter1d
    from scipy.special import chdtrc

    use = [i for i, n in enumerate(names) if n != "psi"]
    frequency, power, count = _spectrum([n[:, use] for n in nu], sample_time)
    if frequency.size < 2 * _AROUND:
        return None
    together = power.mean(axis=1)
    inside = (frequency > _BAND[0]) & (frequency < min(_BAND[1], 0.45 / sample_time))
    if not inside.any():
        return None
    background = median_filter(together, size=2 * _AROUND + 1, mode="nearest")
    ratio = np.where(inside, together / np.maximum(background, 1e-300), 0.0)
    k = int(np.argmax(ratio))
    freedom = 2 * count * len(use)
    p = min(1.0, float(chdtrc(freedom, ratio[k] * freedom)) * int(inside.sum()))
    near = np.abs(frequency - frequency[k]) < _NARROW * frequency[k]
    # a hump as wide as the band is no sea
    wide = (ratio > 0.5 * ratio[k]) & inside & ~near
    if ratio[k] < _CLEAR or p > 1e-4 or wide.sum() > 2:
        return None
    excess = np.maximum(together - background, 0.0) * near
    centre = float((frequency * excess).sum() / excess.sum())
    width = float(np.sqrt(((frequency - centre) ** 2 * excess).sum() / excess.sum()))
    _, raw, _ = _spectrum([e[:, use] for e in errors], sample_time)
    step = frequency[1] - frequency[0]
    # what stands above the sensors' noise, from where slower errors end
    whole = (raw / np.maximum(raw.sum(axis=0), 1e-300)).mean(axis=1)
    lowest = int(np.argmin(uniform_filter1d(whole, 3, mode="nearest")[: k + 1]))
    floor = np.median(raw[-(len(raw) // 4) :], axis=0)
    energy = np.maximum((raw[lowest:] - floor).sum(axis=0), 0.0) * step
    return Waves(
        centre,
        max(width / np.sqrt(max(count, 1)), step / np.sqrt(12 * max(count, 1))),
        {names[i]: float(np.sqrt(e)) for i, e in zip(use, energy, strict=True)},
        float(ratio[k]),
        p,
    )


def noise_in(waves: Waves | None, fit: Fit) -> Noise:
    """Return the noise of a fit, in waves with the sensors that third differences tell.

    Colours have no line: of errors that hold one they take all for the sensors', or nothing.
    """
    if waves is None:
        return fit.noise
    return fit.noise.with_sensors(white_deviations(fit.errors, fit.known))


def squares_in(
    waves: Waves | None, fit: Fit, names: Sequence[str], noise: Noise
) -> tuple[Array, NDArray[np.int_]]:
    """Return what `Fit.in_sensors` does, without the motion in waves.

    Parameters
    ----------
    waves : Waves or None
    fit : Fit
    names : sequence of str
        Channels, in their order.
    noise : Noise
        Whose sensors.
    """
    squares, counts = fit.in_sensors(noise)
    if waves is not None:
        moved = np.array([waves.std.get(names[g.outputs[0]], 0.0) for g in noise.groups])
        sensor = np.array([g.sensor[0] for g in noise.groups])
        squares = np.maximum(squares - counts * (moved / sensor) ** 2, 0.0)
    return squares, counts


def _spectrum(parts: Sequence[Array], sample_time: float) -> tuple[Array, Array, int]:
    """Return frequencies [Hz], one-sided densities (F, k), and how many segments were averaged."""
    window = np.hanning(_SEGMENT + 2)[1:-1]
    total, count = np.zeros((_SEGMENT // 2 + 1, parts[0].shape[1])), 0
    for part in parts:
        for start in range(0, len(part) - _SEGMENT + 1, _SEGMENT // 2):
            piece = part[start : start + _SEGMENT]
            piece = (piece - piece.mean(axis=0)) * window[:, None]
            total += np.abs(np.fft.rfft(piece, axis=0)) ** 2
            count += 1
    if count == 0:
        return np.zeros(0), total, 0
    density = 2 * total * sample_time / ((window**2).sum() * count)
    # overlapping halves are not independent
    frequency = np.asarray(np.fft.rfftfreq(_SEGMENT, sample_time)[1:], float)
    return frequency, np.asarray(density[1:]), max(1, round(count * 0.6))


def found_waves(waves: Waves, cause: Cause, tried: int) -> Found:
    """Return a line as a cause."""
    parameters = {"wave_frequency": Quantity(waves.frequency, waves.frequency_std, "Hz")}
    for name, std in waves.std.items():
        unit = CHANNELS[name].unit if name in CHANNELS else "1"
        parameters[f"wave_std_{name}"] = Quantity(std, _LEVEL * std, unit)
    told = {k: (q.value, q.std) for k, q in parameters.items()}
    return Found(
        cause.id, cause.id, cause.title, parameters, waves.p_value,
        min(1.0, waves.p_value * tried), cause.evidence(told), cause.extension, cause.reference,
    )  # fmt: skip
