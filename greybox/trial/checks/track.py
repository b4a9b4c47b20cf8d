"""Positions against the velocity over ground: the way that both make.

A factor between the two is another unit; a mirrored way is latitude for longitude or one of them
reversed. Which of the two is mirrored shows against the heading.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from greybox.errors import so_many
from greybox.rotation import body_to_ned
from greybox.trial.checks.course import (
    LEAST_SPEED,
    PLAUSIBLE,
    SIDEWAYS,
    course_scatter,
    make_course,
    sign_finding,
)
from greybox.trial.checks.finding import Finding, exact_finding
from greybox.trial.checks.motion import integrate, make_motion
from greybox.trial.checks.signal_quality import clean
from greybox.trial.checks.wind_convention import STEADIER
from greybox.trial.convert.derived_signals import derive_signals, places
from greybox.trial.raw_log import Recording
from greybox.trial.repair import apply_repairs
from greybox.trial.steps import Step, mend
from greybox.units import UNITS

# parts of a log that are left out in turn for the error (jackknife)
_BLOCKS = 12
# over so long the way made is beyond the noise of positions [s]
_SPAN = 10.0
_FEWEST_SPANS = 12
# share of the way made that the velocity must explain, and least factor that is another unit
_EXPLAINED, _OTHER_UNIT = 0.9, 1.3
# how near a factor must be to that between two units, beside its standard errors
_NEAR_UNIT, _ERRORS = 0.02, 3.3
_SPEEDS = ("m/s", "kn", "km/h", "mph")


def track_findings(recording: Recording) -> list[Finding]:
    """Find positions that make another way than the velocity over ground says.

    Parameters
    ----------
    recording : Recording
        Canonical, before anything is derived from it.
    """
    lat_lon = "lat" in recording and "lon" in recording
    if lat_lon and (beyond := _beyond_the_poles(recording)):
        return beyond
    ways = _Ways.of(recording)
    if ways is None:
        return []
    found = []
    if ways.contradict:
        found = _mirrored(recording, ways)
        if not (found and found[0].safe):
            return found
        recording = apply_repairs(recording, found)
        ways = _Ways.of(recording)
        if ways is None or ways.contradict:
            return found
    return found + _other_unit(ways)


@dataclass(frozen=True)
class _Ways:
    """Ways that positions and the velocity over ground make in equal times, north + i east [m].

    Parameters
    ----------
    channels : tuple of str
        Of the velocity.
    moved, walked : ndarray
        (N,) by the positions and by the velocity.
    """

    channels: tuple[str, ...]
    moved: NDArray[np.complex128]
    walked: NDArray[np.complex128]

    @staticmethod
    def of(recording: Recording) -> _Ways | None:
        """Return the ways of a recording, None where it tells too few or was not under way."""
        derived = derive_signals(recording)
        channels: tuple[str, ...] = ("v_n", "v_e")
        if {"sog", "cog"} <= set(recording.names):
            channels = ("sog", "cog")
        elif {"u", "v"} <= set(_made_of_course(recording)):
            channels = ("u", "v")
            derived = _over_ground_again(derived)
        motion = make_motion(derived, ("x_n", "y_n", "v_n", "v_e"))
        if motion is None or len(motion.values) < 4:
            return None
        place = motion["x_n"] + 1j * motion["y_n"]
        gone = integrate(np.column_stack([motion["v_n"], motion["v_e"]]), motion)
        way = gone[:, 0] + 1j * gone[:, 1]
        span = max(1, round(_SPAN / motion.step))
        rows = np.concatenate([np.arange(a, b - span, span) for a, b in motion.stretches])
        if len(rows) < _FEWEST_SPANS:
            return None
        moved, walked = place[rows + span] - place[rows], way[rows + span] - way[rows]
        # a jump of the positions is no way
        usual = np.abs(moved) <= 10 * np.median(np.abs(moved))
        moved, walked = moved[usual], walked[usual]
        speed = float(np.sqrt(np.mean(np.abs(walked) ** 2))) / (span * motion.step)
        if len(moved) < _FEWEST_SPANS or speed < LEAST_SPEED / 4:
            return None
        return _Ways(channels, moved, walked)

    def explained(self, *, mirrored: bool = False) -> tuple[float, complex]:
        """Return the share of the way that a factor of the velocity explains, and the factor."""
        walked = self.walked.conj() if mirrored else self.walked
        factor = complex(np.vdot(walked, self.moved) / np.vdot(walked, walked).real)
        total = float(np.vdot(self.moved, self.moved).real)
        rest = self.moved - factor * walked
        return 1.0 - float(np.vdot(rest, rest).real) / max(total, 1e-300), factor

    @property
    def contradict(self) -> bool:
        """Whether the two point elsewhere."""
        share, factor = self.explained()
        if share > _EXPLAINED:
            return bool(abs(np.angle(factor)) > PLAUSIBLE)
        return bool(STEADIER * (1.0 - self.explained(mirrored=True)[0]) < 1.0 - share)


def _made_of_course(recording: Recording) -> set[str]:
    """Return the velocities of a log that were made of speed and course over ground."""
    made = (s for s in recording.steps if s.derives_motion and "v_n" in s.source)
    return {n for s in made for n in s.channels if n in recording}


def _over_ground_again(recording: Recording) -> Recording:
    """Return a log with the velocities over ground that its u and v were made of."""
    if not {"psi", "u", "v"} <= set(recording.names):
        return recording
    u, v = recording["u"], recording["v"]
    psi = np.interp(u.t, *clean(recording["psi"]))
    north, east = body_to_ned(u.value, np.interp(u.t, *clean(v)), psi)
    made = [replace(u, name="v_n", value=north), replace(u, name="v_e", value=east)]
    return recording.with_signals([*recording.signals, *made])


def _beyond_the_poles(recording: Recording) -> list[Finding]:
    """Find latitudes that only a longitude can be."""
    lat, lon = recording["lat"], recording["lon"]
    known = np.isfinite(lat.value)
    valid = np.isfinite(places(lat, lon)[1]).sum()
    if not known.any() or valid > 0.5 * known.sum():
        return []
    if np.isfinite(places(lon, lat)[1]).sum() <= 0.5 * known.sum():
        return []
    return [
        exact_finding(
            "sign", ("lat", "lon"), 0.0, "1",
            f"lat and lon are swapped: latitudes end at 90 deg, and lat reaches "
            f"{np.nanmax(np.abs(lat.value)):.4g}",
            "exchange lat and lon (import --fix does), or correct [columns]",
            (mend("exchange", ("lat", "lon")),), True,
        )
    ]  # fmt: skip


def _position_readings(recording: Recording) -> Iterator[tuple[str, tuple[str, ...], Step]]:
    """Return other readings of the positions: in words, their channels, the repair."""
    pair = ("lat", "lon") if "lat" in recording and "lon" in recording else ("x_n", "y_n")
    yield f"{pair[0]} and {pair[1]} are swapped", pair, mend("exchange", pair)
    for name in pair:
        yield f"{name} is reversed", (name,), mend("scale", (name,), factor=-1.0)
    yield f"{pair[0]} and {pair[1]} are reversed", pair, mend("scale", pair, factor=-1.0)


def _course_readings(ways: _Ways) -> Iterator[tuple[str, tuple[str, ...], tuple[Step, ...]]]:
    if "cog" in ways.channels:
        back = mend("scale", ("cog",), factor=-1.0)
        from_east = mend("offset", ("cog",), offset=np.pi / 2)
        yield "cog counts from east, anticlockwise", ("cog",), (back, from_east)
        yield "cog counts anticlockwise", ("cog",), (back,)
        yield "cog points astern", ("cog",), (mend("offset", ("cog",), offset=np.pi),)
    elif ways.channels == ("v_n", "v_e"):
        yield "v_n and v_e are swapped", ("v_n", "v_e"), (mend("exchange", ("v_n", "v_e")),)
        for name in ways.channels:
            yield f"{name} is reversed", (name,), (mend("scale", (name,), factor=-1.0),)


def _mirrored(recording: Recording, ways: _Ways) -> list[Finding]:
    """Find which of positions and velocity over ground points elsewhere."""
    made: list[tuple[bool, str, tuple[str, ...], tuple[Step, ...]]] = [
        (True, words, channels, (step,)) for words, channels, step in _position_readings(recording)
    ]
    made += [(False, *reading) for reading in _course_readings(ways)]
    fitting = []
    for positions, words, channels, repair in made:
        finding = exact_finding("sign", channels, 0.0, "1", words, "", repair, True)
        read = _Ways.of(apply_repairs(recording, [finding]))
        if read is None:
            continue
        share, factor = read.explained()
        if share > _EXPLAINED and abs(np.angle(factor)) < PLAUSIBLE:
            fitting.append((share, positions, words, channels, repair))
    if not fitting:
        return []
    scatter = [
        course_scatter([c] if (c := make_course(r)) is not None else [], lambda psi: psi)
        for r in _tracks(recording)
    ]
    by_place, by_velocity = scatter
    at_fault: bool | None = None
    if _keeps_to_bow(by_velocity, by_place):
        at_fault = True
    elif _keeps_to_bow(by_place, by_velocity):
        at_fault = False
    likely = [f for f in fitting if at_fault is None or f[1] == at_fault] or fitting
    share, positions, words, channels, repair = max(likely, key=lambda f: (f[1], f[0]))
    rivals = [f for f in likely if f[1] == positions and f[2] != words and f[0] > share - 0.01]
    sure = at_fault is not None and not rivals
    projected = any(s.operation == "tangent_plane" for s in recording.steps)
    if projected and channels == ("x_n", "y_n") and repair[0].operation == "exchange":
        # degrees of latitude and longitude are of different length: only the raw file has them
        repair, sure = (), False
    velocity = " and ".join(ways.channels)
    why = f"only then do positions and {velocity} agree ({100 * share:.1f} % of the way made)"
    if at_fault is not None:
        why += f", and the course of {velocity if at_fault else 'the positions'} keeps to the bow"
    else:
        other = next((f[2] for f in fitting if f[1] != positions), "")
        why += ", and no heading tells which of them is right"
        why += f": perhaps {other}" if other else ""
    if rivals:
        why += f"; that {rivals[0][2]} would explain as much"
    return [sign_finding(words, channels, repair, why, sure)]


def _keeps_to_bow(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether one of two courses, by scatter and angle, keeps to the bow and the other does not."""
    (scatter, angle), (more, apart) = one, other
    return abs(angle) < PLAUSIBLE and (STEADIER * scatter < more or abs(apart) > SIDEWAYS)


def _tracks(recording: Recording) -> Iterator[Recording]:
    """Return the recording with the course of its positions alone, and of its velocity alone."""
    derived = derive_signals(recording)
    if {"u", "v"} <= set(_made_of_course(recording)):
        derived = _over_ground_again(derived)
    yield derived.with_signals(s for s in derived.signals if s.name not in ("v_n", "v_e"))
    yield derived.with_signals(s for s in derived.signals if s.name not in ("x_n", "y_n"))


def _other_unit(ways: _Ways) -> list[Finding]:
    """Find a speed over ground in another unit than its name says."""
    share, factor = ways.explained()
    ratio = 1.0 / abs(factor) if factor else 0.0
    if share < _EXPLAINED or not ratio or 1 / _OTHER_UNIT < ratio < _OTHER_UNIT:
        return []
    rows = np.arange(len(ways.moved))
    left = np.array([
        1.0 / abs(replace(ways, moved=ways.moved[keep], walked=ways.walked[keep]).explained()[1])
        for block in np.array_split(rows, _BLOCKS)
        for keep in (np.delete(rows, block),)
    ])  # fmt: skip
    error = float(np.sqrt((_BLOCKS - 1) / _BLOCKS * np.sum((left - left.mean()) ** 2)))
    near = _ERRORS * error / ratio + _NEAR_UNIT
    units = [
        (held, said)
        for a, b in combinations(_SPEEDS, 2)
        for held, said in ((a, b), (b, a))
        if abs(np.log(ratio * UNITS[held].factor / UNITS[said].factor)) < near
    ]
    names = ("sog",) if "sog" in ways.channels else ways.channels
    said_so = " and ".join(names)
    evidence = (
        f"the speed over ground of {said_so} is {ratio:.3g} times what the positions make "
        f"(in {so_many(len(rows), 'span')} of {_SPAN:g} s)"
    )
    if len(units) != 1:
        return [
            Finding(
                "unit", names[0], ratio, (ratio - 1.96 * error, ratio + 1.96 * error), "1",
                f"{evidence}, the factor of {'several units' if units else 'no two units'}",
                "look up the units of speed and positions and state them in [columns]", names,
            )
        ]  # fmt: skip
    ((held, said),) = units
    true = UNITS[held].factor / UNITS[said].factor
    return [
        Finding(
            "unit", names[0], ratio, (ratio - 1.96 * error, ratio + 1.96 * error),
            f"{held} per {said}",
            f"{evidence}: it holds {held} that were read as {said}",
            f'write unit = "{held}" at the column of the speed over ground under [columns] of the '
            f"vessel file and read the raw file again, or let greybox import --fix convert the log",
            names, (mend("scale", names, factor=true),), True,
        )
    ]  # fmt: skip
