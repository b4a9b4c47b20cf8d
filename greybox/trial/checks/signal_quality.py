"""Defects that show in one signal alone: times, holes, spikes, stuck and coarse values."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from greybox.channels import ANGLES
from greybox.errors import so_many
from greybox.numerics.robust import FROM_MEDIAN, robust_deviation
from greybox.rotation import body_to_ned
from greybox.trial.checks.finding import Finding, declare_unit, exact_finding
from greybox.trial.convert.channel_mapping import beyond_reach
from greybox.trial.convert.deduplicate import CUT_RUNS, second_run
from greybox.trial.convert.derived_signals import EARTH, MOTION_SIGNALS, continuous
from greybox.trial.convert.resample import clock
from greybox.trial.gaps import GAP, HOLE, runs, usual_step
from greybox.trial.raw_log import Array, Mask, Recording, Signal
from greybox.trial.steps import Step, mend
from greybox.trial.time_format import unpadded_numbers
from greybox.vessel.vessel import Vessel

MOTION = (*MOTION_SIGNALS, "u_q", "v_q")

# a spike stands out of its neighbours by this many robust standard deviations
_SPIKE = 10.0
_LOCAL_SPIKE = 7.0
_SPIKE_WIDTH = 3
# rounds in which spikes that stood beside larger ones come out
_ROUNDS = 5
# samples of an even clock over those recorded, beyond which a log is mostly gaps
_MOST_BRIDGED = 2.0
# a coarse signal has steps larger than its noise, and large enough to matter
_LEAST_STEP = 1.2
_MATERIAL = {
    "psi": 0.0035, "r": 0.0035, "x_n": 0.1, "y_n": 0.1, "u": 0.02, "v": 0.02, "v_n": 0.02,
    "v_e": 0.02,
}  # fmt: skip
# steps of rounded values that matter, as a share of the signal's spread
_COARSE = 0.004
# a rudder that stays within so few degrees all the time is hardly one [deg]
_HARDLY_MOVES = 3.5
# rates of turn over so long [s], how many, and what a rudder near midships does not cause: radians
# in a ship length, and correlation with the rudder
_TURN_WINDOW, _LEAST_TURNED, _HARD_TURN, _FOLLOWS = 4.0, 20, 0.25, 0.4
# a sensor that is stuck repeats itself this long
STUCK_SECONDS = 3.0
STUCK_SAMPLES = 8


def time_findings(recording: Recording) -> list[Finding]:
    """Find repeated, reversed and missing times, once for every clock.

    Parameters
    ----------
    recording : Recording
        Canonical signals.
    """
    found: list[Finding] = []
    for names, t in clocks(recording):
        finite = t[np.isfinite(t)]
        steps = np.diff(finite)
        repeated, back = int((steps == 0).sum()), int((steps < 0).sum())
        if repeated or back:
            count = repeated + back
            k = int(np.flatnonzero(steps <= 0)[0])
            once = f"{repeated} repeat{'' if repeated > 1 else 's'} the one before"
            what = [once] if repeated else []
            what += [f"{back} go{'' if back > 1 else 'es'} back"] if back else []
            second = second_run(finite)
            if second is None:
                where = f"the first after t = {finite[k]:.6g} s"
                fix = (
                    "sort the rows by time and keep the first of those that repeat "
                    "(import --fix does)"
                )
            else:
                k, twice = second
                where = (
                    f"from {finite[k - 1]:.6g} to {finite[k]:.6g} s, where a second run begins: "
                    f"{twice:.4g} s are there twice, and the first run alone was checked"
                )
                fix, finite = CUT_RUNS, finite[:k]
            found.append(
                exact_finding(
                    "duplicate_time",
                    ("t",),
                    float(count),
                    "1",
                    f"of the {len(steps) + 1} times of {listed(names)} {' and '.join(what)}, "
                    f"{where}",
                    fix,
                    (mend("order", names),) if second is None else (),
                    second is None,
                    {"t": t[np.isfinite(t)], "steps": steps, "names": names},
                )
            )
        found += _gaps(names, np.unique(finite))
    return found


def _gaps(names: tuple[str, ...], t: Array) -> list[Finding]:
    if len(t) < 4:
        return []
    usual = clock(t).period
    steps = np.diff(t)
    limit = np.full(len(steps), HOLE * usual)
    digits = significant_digits(t)
    if digits:
        # between times that were rounded there may have been others
        grid = 10.0 ** (np.floor(np.log10(np.maximum(t[1:], 1e-9))) + 1 - digits)
        limit = np.maximum(limit, GAP * grid)
    wide = np.flatnonzero(steps > limit)
    if not len(wide):
        return []
    longest = int(wide[np.argmax(steps[wide])])
    size = float(steps[longest])
    return [
        exact_finding(
            "gap",
            ("t",),
            size,
            "s",
            f"{so_many(len(wide), 'hole')} in {listed(names)}: no value for more "
            f"than {HOLE:g} usual steps of {usual:.4g} s; the longest hole lasts {size:.4g} s from "
            f"t = {t[longest]:.6g} s",
            "none needed: import keeps gaps as gaps, and each stretch becomes a segment",
            picture={
                "t": t,
                "gaps": [(float(t[k]), float(t[k + 1])) for k in wide[:200]],
                "names": names,
                "limit": HOLE * usual,
            },
        )
    ]


def missing_findings(recording: Recording) -> list[Finding]:
    """Find samples without a number, one finding for all columns that miss the same rows."""
    groups: dict[bytes, list[Signal]] = {}
    for s in recording.signals:
        bad = ~np.isfinite(s.value)
        if bad.any() and not _own_rate(bad):
            groups.setdefault(np.packbits(bad).tobytes(), []).append(s)
    # rows without a time are no rows at all
    found = []
    for members in groups.values():
        bad = ~np.isfinite(members[0].value)
        stretches = runs(bad)
        names = tuple(s.name for s in members)
        t, n = members[0].t, len(bad)
        start = t[stretches[0][0]]
        where = (
            "at the end"
            if len(stretches) == 1 and stretches[0][1] == n
            else (
                f"first at t = {start:.6g} s"
                if np.isfinite(start)
                else f"first in row {stretches[0][0] + 1}"
            )
        )
        count = float(bad.sum())
        found.append(
            exact_finding(
                "nan",
                names,
                count,
                "1",
                f"{int(count)} of {so_many(n, 'sample')} of {listed(names)} "
                f"{'holds' if count == 1 else 'hold'} no number, in "
                f"{so_many(len(stretches), 'stretch')}, {where}",
                "leave them out: import does, and keeps longer stretches as gaps",
                (mend("drop", names),),
                True,
                {"t": t, "bad": bad},
            )
        )
    return found


def _own_rate(bad: Mask) -> bool:
    """Whether the holes are those of a slow sensor in a fast table: most rows, evenly."""
    good = np.flatnonzero(~bad)
    if len(good) < 5 or bad.mean() < 0.4:
        return False
    steps = np.diff(good)
    return bool(np.mean(np.abs(steps - np.median(steps)) <= 1) > 0.95)


def spike_findings(recording: Recording) -> list[Finding]:
    """Find single samples, or up to three, that leave their neighbours and come back."""
    found = []
    for s in _motion(recording):
        t, value = clean(s)
        if len(value) < 30 or significant_digits(_wrapped(s)):
            continue
        spikes, scale, gap = _spikes_bridged(t, value, _worth(s.name, value))
        if not len(spikes):
            continue
        worst = spikes[np.argmax(np.abs(gap[spikes]))]
        size = float(gap[worst])
        half = 1.96 * scale
        found.append(
            Finding(
                "outlier",
                s.name,
                size,
                (size - half, size + half),
                s.unit or "1",
                f"{so_many(len(spikes), 'sample')} of {s.name} "
                f"{'stand out from their' if len(spikes) > 1 else 'stands out from its'} "
                f"neighbours, the largest by {size:.3g} {s.unit} at t = {t[worst]:.6g} s, "
                f"where the neighbours scatter by {scale:.2g} {s.unit}".rstrip(),
                "leave those samples out (import --fix does; what is missing is bridged where "
                "one sample is, else a gap)",
                (s.name,),
                (mend("drop", _measured_with(s, recording), times=tuple(map(float, t[spikes]))),),
                True,
                {"t": t, "value": value, "spikes": spikes, "worst": int(worst), "distance": gap},
            )
        )
    return found


def _measured_with(s: Signal, recording: Recording) -> tuple[str, ...]:
    """Return a signal, and the other component of its fix (speed and course), which is as wrong."""
    if s.name not in EARTH or any(n not in recording for n in EARTH):
        return (s.name,)
    one, two = (recording[n] for n in EARTH)
    return EARTH if np.array_equal(one.t, two.t) else (s.name,)


def _worth(name: str, value: Array) -> float:
    """Return the size below which a spike does no harm."""
    if name in ("x_n", "y_n"):
        # half of what the ship moves from sample to sample
        return max(0.5 * float(np.quantile(np.abs(np.diff(value)), 0.9)), 0.02)
    spread = float(np.subtract(*np.quantile(value, [0.95, 0.05])))
    if name in ("u_q", "v_q"):
        # gusts have heavy tails
        return 0.5 * spread
    return 0.005 if name == "psi" else 0.03 * spread


def _spikes_bridged(t: Array, value: Array, least: float) -> tuple[NDArray[np.int64], float, Array]:
    """Return what `_spikes` finds beyond `least` on the even clock that an import makes.

    Samples that were left out are bridged there; a spike hides smaller ones beside it, which
    show once it is bridged too.
    """
    period = usual_step(t)
    rows = np.arange(len(t))
    if period > 0 and 0 <= t[-1] - t[0] < _MOST_BRIDGED * len(t) * period:
        likely = np.round((t - t[0]) / period).astype(np.int64)
        rows = likely if (np.diff(likely) > 0).all() else rows
    even = np.interp(np.arange(rows[-1] + 1), rows, value)
    found = np.zeros(len(t), bool)
    scale, distance = 0.0, np.zeros(len(t))
    for _ in range(_ROUNDS):
        spikes, now, gap = _spikes(even)
        fresh = np.isin(rows, spikes[np.abs(gap[spikes]) > least]) & ~found
        scale = scale or now
        distance = np.where(found, distance, gap[rows])
        if not fresh.any():
            break
        found |= fresh
        even = np.interp(np.arange(rows[-1] + 1), rows[~found], value[~found])
    return np.flatnonzero(found), scale, distance


def _spikes(value: Array) -> tuple[NDArray[np.int64], float, Array]:
    """Return indices, robust scatter, and each sample's distance from its neighbours."""
    # each pair of distances predicts a sample from its neighbours to third order; of the
    # five predictions three do not touch a spike of up to three samples
    padded = np.pad(value, 4, mode="reflect", reflect_type="odd")
    n = len(value)
    mean = {k: 0.5 * (padded[4 - k : 4 - k + n] + padded[4 + k : 4 + k + n]) for k in (1, 2, 3, 4)}
    pairs = ((1, 2), (1, 3), (2, 3), (2, 4), (3, 4))
    predicted = [(b * b * mean[a] - a * a * mean[b]) / (b * b - a * a) for a, b in pairs]
    gap = value - np.median(predicted, axis=0)
    scale = robust_deviation(gap)
    step = quantum(value)
    scale = max(scale, step / np.sqrt(12), 1e-12 * max(float(np.abs(value).max()), 1e-300))
    out = np.abs(gap) > _SPIKE * scale + 2 * step
    if out.any():
        from scipy.ndimage import median_filter

        local = FROM_MEDIAN * median_filter(np.abs(gap), size=51, mode="nearest")
        out &= np.abs(gap) > _LOCAL_SPIKE * local + 2 * step
    wide = [
        k
        for a, b in runs(out)
        if b - a <= _SPIKE_WIDTH and _comes_back(value, a, b)
        for k in range(a, b)
    ]
    return np.array(wide, dtype=np.int64), scale, gap


def _comes_back(value: Array, a: int, b: int) -> bool:
    """Whether samples a to b leave their neighbours by far more than these differ.

    A sharp turn at a coarse sample time bends too, but its neighbours move alike.
    """
    rows = np.concatenate([np.arange(max(a - 3, 0), a), np.arange(b, min(b + 3, len(value)))])
    if len(rows) < 4:
        return False
    # a steady course is a slope: what counts is what stands out of it
    slope, level = np.polyfit(rows - a, value[rows], 1)
    near = np.arange(max(a - 3, 0), min(b + 3, len(value)))
    flat = value[near] - slope * (near - a) - level
    before, part, after = np.split(flat, [a - near[0], b - near[0]])
    beside = np.concatenate([before, after])
    excess = float(max((part - beside.max()).max(), (beside.min() - part).max()))
    steps = max(float(np.abs(np.diff(side)).max()) for side in (before, after) if len(side) > 1)
    return excess > 3 * max(steps, float(abs(after[0] - before[-1])) if len(after) else 0.0)


def significant_digits(value: Array) -> int:
    """Return the significant digits, at most four, that a signal was rounded to; else 0."""
    part = np.abs(value[value != 0][:20000])
    # one decade alone cannot tell significant digits from decimals
    if len(part) < 50 or part.max() < 30 * np.quantile(part, 0.01):
        return 0
    scale = 10.0 ** np.floor(np.log10(part))
    small = part[part < 0.1 * part.max()]
    for digits in (2, 3, 4):
        top = 10.0 ** (np.floor(np.log10(part.max())) + 1 - digits)
        # steps that are the same for small values are decimals, not digits
        if not len(small) or np.mean(np.abs(small / top - np.round(small / top)) < 1e-6) > 0.5:
            continue
        grid = scale * 10.0 ** (1 - digits)
        if np.mean(np.abs(part / grid - np.round(part / grid)) < 1e-6) > 0.995:
            return digits
    return 0


def _rounded_finding(
    name: str, t: Array, value: Array, unit: str, digits: int, per: float = 1.0
) -> Finding:
    """Return the finding; `per` is the unit in which the digits were counted."""
    largest = float(np.abs(value).max())
    step = per * float(10.0 ** (np.floor(np.log10(largest / per)) + 1 - digits))
    return exact_finding(
        "quantised",
        (name,),
        step,
        unit,
        f"{name} was written with {digits} significant digits: at {largest:.4g} {unit} it moves in "
        f"steps of {step:.3g} {unit}",
        "export it again with all its digits; what depends on fine differences of it is lost",
        picture={"t": t, "value": value},
    )


def coarse_findings(recording: Recording) -> list[Finding]:
    """Find signals, and times, that move in steps coarser than what they measure."""
    found = []
    for _, t in clocks(recording):
        times = t[np.isfinite(t)]
        digits = significant_digits(times)
        steps = np.diff(np.unique(times))
        # an even clock looks rounded too, when its step is
        usual = float(np.median(steps)) if len(steps) else 0.0
        if digits and np.mean(np.abs(steps - usual) > 0.3 * usual) > 0.2:
            found.append(_rounded_finding("t", times, times, "s", digits))
    for s in _motion(recording):
        t, value = clean(s)
        step = quantum(value)
        digits = significant_digits(_wrapped(s)) if step <= 0 else 0
        if digits and (digits < 4 or np.mean(np.diff(value) == 0) > 0.3):
            degrees = s.name in ANGLES | {"r"} and not significant_digits(
                s.value[np.isfinite(s.value)]
            )
            per = np.pi / 180 if degrees else 1.0
            coarse = _rounded_finding(s.name, t, value, s.unit or "1", digits, per)
            if isinstance(coarse.value, float) and coarse.value > _COARSE * np.std(value):
                found.append(coarse)
            continue
        if step <= 0 or len(value) < 50:
            continue
        change = np.abs(np.diff(value))
        moving = change > 0
        if moving.sum() < 10:
            continue
        # held samples of a slow sensor repeat too, but then jump by many steps
        still = 1.0 - moving.mean()
        single = float(np.mean(change[moving] < 1.5 * step))
        noise = _spikes(value)[1]
        matters = step > _LEAST_STEP * noise and step >= _MATERIAL.get(s.name, np.inf)
        if not matters and (still < 0.5 or single < 0.5):
            continue
        found.append(
            exact_finding(
                "quantised",
                (s.name,),
                step,
                s.unit or "1",
                f"{s.name} moves in steps of {step:.4g} {s.unit}, where its own noise is "
                f"{noise:.2g} {s.unit}, and repeats itself in {100 * still:.0f} % of the samples",
                "record it with more digits; until then use a longer sample time, and expect "
                f"an error of {step / np.sqrt(12):.2g} {s.unit} (standard deviation)",
                picture={"t": t, "value": value, "step": step},
            )
        )
    return found


def _wrapped(s: Signal) -> Array:
    """Return the values as they were written: digits count in degrees, not in radians."""
    value = s.value[s.known]
    degrees = np.degrees(value)
    if s.name in ANGLES | {"r"} and significant_digits(degrees):
        return np.asarray(degrees)
    return value


def quantum(value: Array) -> float:
    """Return the step of which all values are multiples; 0 where there is none."""
    part = value[: min(len(value), 20000)]
    unique = np.unique(part)
    if len(unique) < 3:
        return 0.0
    steps = np.diff(unique)
    fine = float(np.quantile(steps, 0.1))
    near = steps[steps < 1.2 * fine]
    step = float(np.mean(near))
    multiple = steps / step
    # positions from latitude and longitude lie on a grid that bends a little
    if np.mean(np.abs(multiple - np.round(multiple)) < 0.1) <= 0.9:
        return 0.0
    # at a steady rate all changes are alike: on a grid the others are whole steps, too
    change = np.abs(np.diff(part)) / step
    off = np.abs(change - np.round(change))
    other = off[(np.round(change) != np.median(np.round(change))) | (off >= 0.1)]
    return step if len(other) and np.mean(other < 0.1) > 0.5 else 0.0


def stuck_findings(recording: Recording) -> list[Finding]:
    """Find signals that repeat one value while the ship moves by the others."""
    found = []
    signals = list(_motion(recording))
    for s in signals:
        t, value = clean(s)
        if len(value) < 50:
            continue
        same = np.diff(value) == 0
        stretches = [(a, b + 1) for a, b in runs(same)]
        if not stretches:
            continue
        period = clock(t).period
        lengths = np.array([b - a for a, b in stretches])
        longest = int(np.argmax(lengths))
        a, b = stretches[longest]
        span = float(t[b - 1] - t[a])
        if significant_digits(_wrapped(s)):
            continue
        # runs of a held or coarse signal are its habit; a stuck one is far longer
        usual = float(np.quantile(lengths, 0.9)) if len(lengths) > 5 else 1.0
        enough = max(STUCK_SECONDS, 5 * usual * period)
        if span < enough or lengths[longest] < STUCK_SAMPLES:
            continue
        if not _moves(s.name, t[a], t[b - 1], signals, quantum(value)):
            continue
        found.append(
            exact_finding(
                "stuck",
                (s.name,),
                span,
                "s",
                f"{s.name} stays at {value[a]:.6g} {s.unit} for {span:.4g} s from "
                f"t = {t[a]:.6g} s ({b - a} samples), while the other channels move",
                "leave that stretch out (import --fix makes it a gap) and look at the sensor",
                (mend("drop", (s.name,), times=tuple(float(x) for x in t[a + 1 : b])),),
                True,
                {"t": t, "value": value, "stretch": (float(t[a]), float(t[b - 1]))},
            )
        )
    return found


def _moves(name: str, start: float, stop: float, signals: list[Signal], step: float) -> bool:
    """Whether the rest of the log says that this channel should have changed."""

    def part(other: str) -> Array | None:
        for s in signals:
            if s.name == other:
                t, value = clean(s)
                inside = value[(t >= start) & (t <= stop)]
                return inside if len(inside) > 3 else None
        return None

    span = stop - start
    if name in ("x_n", "y_n"):
        u, v = part("u"), part("v")
        if u is None or v is None:
            u, v = part("v_n"), part("v_e")
        psi = part("psi")
        if u is not None and v is not None and psi is not None and len(u) == len(v) == len(psi):
            rate = body_to_ned(u, v, psi)[name == "y_n"]
            return bool(np.ptp(np.cumsum(rate)) * span / len(rate) > max(0.3, 3 * step))
    if name == "psi":
        r = part("r")
        if r is not None:
            return bool(np.ptp(np.cumsum(r)) * span / len(r) > max(0.05, 3 * step))
    # a velocity repeats exactly only where everything stands still, or it is stuck
    for other in signals:
        inside = part(other.name)
        if other.name == name or inside is None:
            continue
        whole = clean(other)[1]
        if np.ptp(inside) > 0.3 * np.std(whole) > 0:
            return True
    return False


def angle_unit_findings(recording: Recording, vessel: Vessel) -> list[Finding]:
    """Find degrees under a radian name by the range of each angle, of a heading by its wraps."""
    found = []
    for s in recording.signals:
        if s.name not in ANGLES | vessel.recorded_angles:
            continue
        if beyond := beyond_reach(s, vessel):
            largest, limit = beyond
            if s.name in vessel.rudders and largest > 90:
                found.append(_wrong_column(s, largest, limit))
                continue
            # 122 of a propeller that were read as degrees are 2.1
            hardly = s.name in vessel.rudders and largest < _HARDLY_MOVES
            factor = float(np.pi / 180)
            why = (
                "and steps by 360 where it passes a full turn"
                if s.name == "psi"
                else f"above the {limit:.3g} rad that it can reach"
            )
            found.append(
                exact_finding(
                    "unit",
                    (s.name,),
                    180 / np.pi,
                    "deg per rad",
                    f"{s.name} reaches {largest:.4g}, {why}: it holds degrees where a log has "
                    f"radians{', or it is the wrong column' if hardly else ''}",
                    declare_unit((s.name,), "deg").replace(
                        "--fix", "--fix-also unit" if hardly else "--fix"
                    ),
                    (mend("scale", (s.name,), factor=factor),),
                    not hardly,
                    {"t": s.t, "value": s.value, "limit": float(limit)},
                )
            )
    return found


def _wrong_column(s: Signal, largest: float, limit: float) -> Finding:
    return exact_finding(
        "unit", (s.name,), largest, "1",
        f"{s.name} reaches {largest:.4g}, and no rudder passes 90 deg: wrong column?",
        f"map the column of the rudder angle to {s.name} in [columns] of the vessel file",
        picture={"t": s.t, "value": s.value, "limit": float(limit)},
    )  # fmt: skip


def still_rudder_findings(recording: Recording, vessel: Vessel) -> list[Finding]:
    """Find rudders that hardly leave midships while the ship turns hard after them.

    Parameters
    ----------
    recording : Recording
        Derived: headings are continuous, positions local.
    """
    if not vessel.rudders & set(recording.names):
        return []
    turn = _rate_of_turn(recording)
    if turn is None:
        return []
    t, rate, speed = turn
    # turned through a radian in so many ship lengths
    hard = float(np.quantile(np.abs(rate), 0.95)) * vessel.length / speed
    if hard < _HARD_TURN:
        return []
    found = []
    for s in recording.signals:
        if s.name not in vessel.rudders or not s.known.any():
            continue
        reach = float(np.max(np.abs(s.value[s.known])))
        angle = sampled(recording, s.name, t)
        limits = vessel.limits.get(s.name)
        most = max(abs(limits.lower or 0.0), abs(limits.upper or 0.0)) if limits else 0.0
        if angle is None or not 0 < np.degrees(reach) < 1.2 * (most or np.pi / 3):
            continue
        if _follows(rate, angle, t, vessel.length / speed) < _FOLLOWS:
            continue
        found.append(
            exact_finding(
                "unit", (s.name,), np.pi / 180, "rad per deg",
                f"{s.name} stays within {np.degrees(reach):.2g} deg while the ship turns by "
                f"{np.degrees(hard):.0f} deg in a ship length: it may hold radians that were read "
                f"as degrees, up to {np.degrees(np.degrees(reach)):.0f} deg",
                'write unit = "rad" at its column under [columns] of the vessel file and read '
                "the raw file again, or let greybox import --fix-also unit convert the log",
                (mend("scale", (s.name,), factor=180 / np.pi),), False,
                {"t": s.t, "value": s.value},
            )
        )  # fmt: skip
    return found


def _rate_of_turn(recording: Recording) -> tuple[Array, Array, float] | None:
    """Return times, rate of turn [rad/s] and usual speed [m/s]; None where they cannot be told."""
    if "psi" not in recording or not {"x_n", "y_n"} <= set(recording.names):
        return None
    t, psi = clean(recording["psi"])
    if len(t) < _LEAST_TURNED or t[-1] - t[0] < 2 * _TURN_WINDOW:
        return None
    grid = np.arange(t[0], t[-1] - _TURN_WINDOW, _TURN_WINDOW / 4)
    rate = (np.interp(grid + _TURN_WINDOW, t, psi) - np.interp(grid, t, psi)) / _TURN_WINDOW
    north, east = (sampled(recording, n, np.concatenate([grid, grid + _TURN_WINDOW]))
                   for n in ("x_n", "y_n"))  # fmt: skip
    if north is None or east is None or len(grid) < _LEAST_TURNED:
        return None
    way = np.hypot(*(np.diff(v.reshape(2, -1), axis=0)[0] for v in (north, east)))
    speed = float(np.median(way)) / _TURN_WINDOW
    return (grid + _TURN_WINDOW / 2, rate, speed) if speed > 0.1 else None


def _follows(rate: Array, angle: Array, t: Array, length_time: float) -> float:
    """Return how far a rate of turn follows an angle, lagged by up to three ship lengths."""
    best = 0.0
    for lag in np.linspace(0.0, 3.0, 7) * length_time:
        before = np.interp(t - lag, t, angle)
        if np.ptp(before) > 0 and np.ptp(rate) > 0:
            best = max(best, abs(float(np.corrcoef(before, rate)[0, 1])))
    return best


def _motion(recording: Recording) -> Iterable[Signal]:
    return (s for s in recording.signals if s.name in MOTION)


def clean(s: Signal) -> tuple[Array, Array]:
    """Return times and values where both are numbers, headings unwrapped."""
    keep = s.known
    t, value = (s.t, s.value) if keep.all() else (s.t[keep], s.value[keep])
    if s.name == "psi":
        value = continuous(value)
    return t, value


def sampled(recording: Recording, name: str, t: Array) -> Array | None:
    """Return a channel at some times, straight between its samples; None where it has no two."""
    if name not in recording:
        return None
    at, value = clean(recording[name])
    return np.interp(t, at, value) if len(at) > 1 else None


def clocks(recording: Recording) -> list[tuple[tuple[str, ...], Array]]:
    """Return the signals that share each clock."""
    groups: dict[int, tuple[list[str], Array]] = {}
    for s in recording.signals:
        groups.setdefault(id(s.t), ([], s.t))[0].append(s.name)
    return [(tuple(names), t) for names, t in groups.values()]


def listed(names: Iterable[str]) -> str:
    """Return names for a sentence; of many, the first three and how many more."""
    names = list(names)
    if len(names) > 4:
        return f"{', '.join(names[:3])} and {len(names) - 3} more"
    return ", ".join(names)


def time_format_findings(recording: Recording) -> list[Finding]:
    """Find times whose fraction of a second was written without its leading zeros.

    Parameters
    ----------
    recording : Recording
        Canonical signals.

    Returns
    -------
    list of Finding
        One for all columns of text that were read so, and one for each clock of numbers.
    """
    read = [s for s in recording.steps if s.operation == "pad_fractions" and s.numbers("times")]
    found = [_padded_text(read)] if read else []
    for names, t in clocks(recording):
        zero = recording.epoch or 0.0
        wrong = unpadded_numbers(t + zero)
        if not len(wrong):
            continue
        meant = wrong.times - zero
        written = t[wrong.rows]
        worst = int(np.argmax(written - meant))
        found.append(
            exact_finding(
                "time_format",
                ("t",),
                float(len(wrong)),
                "1",
                f"{len(wrong)} of {so_many(len(t), 'time')} of {listed(names)} "
                f"{'lacks' if len(wrong) == 1 else 'lack'} leading zeros in their "
                f"fraction of a second, the first at t = {meant[0]:.6g} s, written as "
                f"{written[0]:.6g} s; they come up to {written[worst] - meant[worst]:.3g} s late "
                f"and seem to go back behind",
                "put the zeros before the fractions again (import --fix does)",
                (_padding(names, len(wrong), float(written[0]), float(meant[0])),),
                True,
                {"t": t, "rows": wrong.rows, "written": written, "meant": meant, "names": names},
            )
        )
    return found


def _padding(names: tuple[str, ...], count: int, written: float, meant: float) -> Step:
    said = {"written": f"{written:.9g} s", "meant": f"{meant:.9g} s"}
    return mend("pad_fractions", names, count=float(count), **said)


def _padded_text(read: list[Step]) -> Finding:
    """Return the finding of columns of text that were read as meant; their steps tell where."""
    count = sum(s.number("count") for s in read)
    times = np.array([t for s in read for t in s.numbers("times")])
    late = np.array([t for s in read for t in s.numbers("late")])
    columns = listed(x for s in read for x in s.source)
    first, worst = read[0], int(np.argmax(late))
    said = first.parameters
    return exact_finding(
        "time_format",
        ("t",),
        count,
        "1",
        f"{so_many(round(count), 'time')} of {columns} {'has' if count == 1 else 'have'} fewer "
        f"digits than the others, such as "
        f"{said.get('written')} for {said.get('meant')} at t = {times[0]:.6g} s: "
        f"their fraction lacks its leading zeros, and would come up to {late[worst]:.3g} s late",
        "none needed: import reads them as they are meant; export times with all their digits",
        # the times are right already: to pad them again changes nothing
        tuple(read),
        True,
        {"t": times, "meant": times, "written": times + late, "names": first.source},
    )
