"""Positions that are repeated because the receiver's message came late."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.errors import so_many
from greybox.numerics.robust import robust_deviation
from greybox.trial.checks.finding import Finding, exact_finding
from greybox.trial.checks.signal_quality import (
    STUCK_SAMPLES,
    STUCK_SECONDS,
    clean,
    significant_digits,
)
from greybox.trial.gaps import HOLE, usual_step
from greybox.trial.raw_log import Array, Mask, Recording
from greybox.trial.steps import mend

Rows = NDArray[np.int64]

# standard errors by which the ship must have moved around a held position
_UNDER_WAY = 5.0
# time around a sample over which its speed is taken [s], and least samples
_AROUND, _AROUND_SAMPLES = 2.0, 5
# steps of a rounded position that a hold must miss
_MISSED = 3.5
# greatest way that the bend of a geographic grid adds where a coordinate repeats [m]
_BEND = 1e-4
# chance that as many held samples come of rounding alone
_CHANCE = 0.01
# share of held messages from which on holding at even intervals is a receiver's own rate
_OWN_SHARE, _EVEN = 0.1, 0.95


@dataclass(frozen=True)
class Track:
    """Positions at the times that both coordinates share.

    Parameters
    ----------
    t : ndarray
        (N,) increasing [s].
    p : ndarray
        (N, 2) north and east [m].
    step : tuple of float
        Steps of rounded coordinates [m], 0 where there are none.
    """

    t: Array
    p: Array
    step: tuple[float, float]


def position_track(recording: Recording) -> Track | None:
    """Return the positions; None where there are too few."""
    if "x_n" not in recording or "y_n" not in recording:
        return None
    (t, north), (t_east, east) = clean(recording["x_n"]), clean(recording["y_n"])
    if len(t) != len(t_east) or not np.array_equal(t, t_east):
        t, a, b = np.intersect1d(t, t_east, return_indices=True)
        north, east = north[a], east[b]
    if len(t) < 30 or not (np.diff(t) > 0).all():
        return None
    return Track(t, np.column_stack([north, east]), (_grid(north), _grid(east)))


def _grid(value: Array) -> float:
    """Return the step of a rounded coordinate [m], 0 where it is none.

    What was rounded as latitude and longitude lies on a grid that bends: only the ways
    between neighbours are multiples of its step.
    """
    digits = significant_digits(value)
    if digits:
        # the coarsest step, that of the largest values
        return float(10.0 ** (np.floor(np.log10(np.abs(value).max())) + 1 - digits))
    every = np.abs(np.diff(value[:20000]))
    way = every[every > _BEND]
    if len(way) < 10:
        return 0.0
    # where single steps are rare, a larger share of the ways begins at two of them
    for share in (0.01, 0.002):
        least = float(np.quantile(way, share))
        step = float(np.mean(way[way < 1.5 * least]))
        multiple = every / step
        whole = np.round(multiple)
        # at a steady speed all ways are alike: a grid shows in ways of several steps
        usual = np.mean(whole == np.median(whole))
        near = np.mean(np.abs(multiple - whole) < 0.15)
        if near > 0.9 and usual < 0.98:
            return step
    return 0.0


def hold_findings(recording: Recording) -> list[Finding]:
    """Find positions that are repeated because the receiver's message came late.

    A position that repeats to the last digit while the ship makes way is an old one. A
    receiver slower than the table repeats each of its positions, evenly: that is its rate.

    Parameters
    ----------
    recording : Recording
        With positions in order of time.

    Returns
    -------
    list of Finding
        At most one.
    """
    track = position_track(recording)
    if track is None:
        return []
    held = _held(track)
    if held is None:
        return []
    rows, longest, missed = held
    t = track.t
    count = float(len(rows))
    return [
        exact_finding(
            "position_hold",
            ("x_n", "y_n"),
            count,
            "1",
            f"{so_many(len(rows), 'position', 'repeats', 'repeat')} the one "
            f"before to the last digit under way, the first at t = {t[rows[0]]:.6g} s, most in a "
            f"row {longest[1]} at t = {t[longest[0]]:.6g} s, where the ship went "
            f"{missed:.3g} m meanwhile: the receiver's messages came late",
            "interpolate those samples between their neighbours (import --fix does)",
            (mend("interpolate", ("x_n", "y_n"), times=tuple(float(x) for x in t[rows])),),
            True,
            {
                "t": t, "x_n": track.p[:, 0], "y_n": track.p[:, 1], "held": rows,
                "worst": longest[0],
            },
        )
    ]  # fmt: skip


def _held(track: Track) -> tuple[Rows, tuple[int, int], float] | None:
    """Return the held rows, first row and length of the longest hold, and what it missed [m]."""
    t, p = track.t, track.p
    period = usual_step(t)
    gap = np.diff(t) > HOLE * period
    same = (np.diff(p, axis=0) == 0).all(axis=1) & ~gap
    if not same.any():
        return None
    first = np.flatnonzero(np.concatenate([[True], ~same]))
    length = np.diff(np.append(first, len(t)))
    speed, sure = _speed(t[first], p[first], t, p, period)
    moving = sure & (length < len(t))
    if not moving.any():
        return None
    usual = max(round(float(np.median(length[moving]))), 1)
    extra = length - usual
    last = np.minimum(first + length, len(t)) - 1
    missed = extra * period * speed
    stuck = (t[last] - t[first] >= max(STUCK_SECONDS, 5 * usual * period)) & (
        length >= STUCK_SAMPLES
    )
    # at a gap or the log's end nobody knows what came next
    followed = np.append(~gap, False)[last]
    late = (
        moving & (length >= 2 * usual) & (missed >= _MISSED * max(track.step)) & ~stuck & followed
    )
    if not late.any() or _own_rate(late, length, usual, first, p, speed * period):
        return None
    went = np.where(moving, usual * period * speed, 0.0)
    late &= extra >= usual * _least_hold(extra[late] // usual, p[first], went, track.step)
    chosen = np.flatnonzero(late)
    if not len(chosen):
        return None
    rows = np.concatenate([np.arange(first[k] + usual, first[k] + length[k]) for k in chosen])
    k = int(chosen[np.argmax(length[chosen])])
    return rows, (int(first[k] + usual), int(extra[k])), float(missed[k])


def _speed(at: Array, there: Array, t: Array, p: Array, period: float) -> tuple[Array, Mask]:
    """Return the speed [m/s] around some samples, and whether it is more than noise."""
    half = max(_AROUND, _AROUND_SAMPLES * period)
    a = np.searchsorted(t, at - half)
    b = np.minimum(np.searchsorted(t, at + half), len(t) - 1)
    way = np.hypot(*(p[b] - p[a]).T)
    time = t[b] - t[a]
    if len(at) > 2:
        share = ((at[1:-1] - at[:-2]) / (at[2:] - at[:-2]))[:, None]
        off = there[1:-1] - (1 - share) * there[:-2] - share * there[2:]
        noise = robust_deviation(off) / np.sqrt(1.5)
    else:
        noise = 0.0
    return way / np.maximum(time, period), way > _UNDER_WAY * np.sqrt(2) * noise


def _own_rate(late: Mask, length: Rows, usual: int, first: Rows, p: Array, way: Array) -> bool:
    """Whether positions repeat evenly and none is followed by a longer step."""
    chosen = np.flatnonzero(late)
    apart = np.diff(chosen)
    if len(apart) < 5 or np.mean(np.abs(apart - np.median(apart)) <= 1) < _EVEN:
        return False
    if len(chosen) > _OWN_SHARE * len(length):
        return True
    after = chosen[chosen + 1 < len(first)]
    went = np.hypot(*(p[first[after + 1]] - p[first[after]]).T)
    expected = length[after] * way[after]
    usually = usual * way[after]
    return bool(np.sum(went) < 0.5 * np.sum(expected + usually))


def _least_hold(messages: Rows, p: Array, went: Array, step: tuple[float, float]) -> float:
    """Return the messages that a hold must miss so that rounding alone does not explain it.

    A rounded position repeats by chance about as often as it moves by one step of the
    rounding; those with and against the ship's way differ, their geometric mean does not.
    `went` is what the ship goes in one message, (N,).
    """
    if not min(step) > 0:
        return 1.0
    from scipy.special import pdtrc

    way = np.diff(p, axis=0)
    near = (np.abs(way) < 1.5 * np.array(step)).all(axis=1)
    wide = np.zeros_like(way)
    wide[1:-1] = p[3:] - p[:-3]
    along = np.sum(way * wide, axis=1)
    for least in np.unique(messages):
        among = least * went[:-1] >= _MISSED * max(step)
        ahead = np.count_nonzero(near & among & (along > 0))
        astern = np.count_nonzero(near & among & (along < 0))
        once = np.sqrt((ahead + 0.5) * (astern + 0.5)) / 4
        expected = once * (once / max(np.count_nonzero(among), 1)) ** (least - 1)
        if pdtrc(np.count_nonzero(messages >= least) - 1, expected) < _CHANCE:
            return float(least)
    return np.inf
