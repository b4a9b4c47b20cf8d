"""Positions that jump because recordings were joined or their origin moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from greybox.numerics.recursion import decay
from greybox.numerics.robust import FROM_MEDIAN
from greybox.rotation import body_to_ned, ned_to_body
from greybox.trial.checks.finding import Finding
from greybox.trial.checks.position_hold import Track, position_track
from greybox.trial.checks.signal_quality import sampled
from greybox.trial.gaps import HOLE, usual_step
from greybox.trial.raw_log import Array, Mask, Recording
from greybox.trial.steps import mend
from greybox.vessel.force import generalised_force
from greybox.vessel.vessel import Vessel

# samples on both sides of a jump that may say what it should have been
_BESIDE = (4, 6, 9, 13, 20, 30)
# what wanders at random beside white noise: the position itself, or its rate
_WANDERS = (0, 1)
# reach of what says so, in the times over which it decays
_REACH = 4.0
# chance that noise makes one jump in a log, and how much larger a jump must be where the fewest
# samples predict best: there the ship's own moves scatter, with heavier tails than noise
_CHANCE, _MOVES = 0.0005, 1.4
# steps that come as often as this are the receiver's or the ship's habit: so many in a log, a
# tenth of its separate steps or at most as many, or one a minute [s]; a jump is twice as large
_FEW, _OFTEN, _MANY, _MINUTE, _ABOVE = 5, 0.1, 10, 60.0, 2.0
# lags by which velocities answer forces [samples], and samples for each of their coefficients
_LAGS, _LEAST_SAMPLES = (1.5, 6.0, 30.0), 12
# scatter beyond which a sample says no more of them; share of the clearest combination below
# which another says too little
_BOUND, _SAME = 4.0, 1e-3
# samples after which a position that returns is no outlier any more
_RETURN = 3
_OFF = (-3, -2, -1, 1, 2, 3)
# steps of a rounded position below which it may be rounding
_ROUNDINGS = 1.5
# share of a jump that falls between two samples, and that lasts
_AT_ONCE, _LASTS = 0.5, 0.45
# time within which a receiver's filter comes back from its own correction, and time on both
# sides of a jump that must differ by it [s]
_SETTLED, _LONG = 2.0, 5.0
# samples that say so on one side, and share of a jump above which their scatter says nothing
_LASTING, _VAGUE = (10, 15, 20, 30), 0.25
# places where it is tried how well positions are predicted so long
_TRIED = 40
# samples over which a speed is the median
_SPEED = 15
# share of uneven steps from which on a message may be a tick of the table late
_UNEVEN = 0.01
# no receiver or tank resolves less [m]
_FINEST = 1e-3
_MOST_JUMPS = 200


def jump_findings(recording: Recording, vessel: Vessel | None = None) -> list[Finding]:
    """Find positions that step because recordings were joined or the origin moved.

    The way from sample to sample is predicted by its neighbours in earth axes, or in body
    axes beside what thrusters and turning explain, and by the velocities. A jump is what stands
    out far beyond the log's own scatter, falls between two samples and lasts.

    Parameters
    ----------
    recording : Recording
        With positions in order of time, without outliers and held samples.
    vessel : Vessel, optional
        Whose thrusters the recording tells of.

    Returns
    -------
    list of Finding
        One a jump, in order of time.
    """
    track = position_track(recording)
    if track is None:
        return []
    found = []
    for jump in _jumps(track, recording, vessel):
        half = 1.96 * jump.error
        north, east = jump.size
        size = float(np.hypot(north, east))
        found.append(
            Finding(
                "position_jump",
                "x_n",
                (north, east),
                ((north - half, north + half), (east - half, east + half)),
                "m",
                f"the position steps by {size:.3g} m ({north:+.3g} north, {east:+.3g} east) "
                f"between t = {jump.before:.6g} and {jump.after:.6g} s and stays there, where the "
                f"samples on both sides predict it to {jump.error:.2g} m (standard error)",
                "cut the log there (import --fix does: what follows is a segment of its own), or "
                "correct the origin of one part",
                ("x_n", "y_n"),
                (mend("cut", ("x_n", "y_n"), times=(jump.after,), size=size),),
                True,
                {
                    "t": track.t, "x_n": track.p[:, 0], "y_n": track.p[:, 1],
                    "before": jump.before, "after": jump.after,
                },
            )
        )  # fmt: skip
    return found


@dataclass(frozen=True)
class _Jump:
    """A step of the position between two samples.

    Parameters
    ----------
    before, after : float
        Times of the samples on both sides [s].
    size : tuple of float
        North and east [m].
    error : float
        Standard error of either [m].
    """

    before: float
    after: float
    size: tuple[float, float]
    error: float


def _jumps(track: Track, recording: Recording, vessel: Vessel | None) -> list[_Jump]:
    """Return the jumps of positions, in order of time."""
    t, p = _messages(track)
    if len(t) < 4 * _BESIDE[0] + 1:
        return []
    period, tick = usual_step(t), usual_step(track.t)
    dt = np.diff(t)
    whole = dt <= HOLE * period
    # where the log is cut already, positions may begin anew
    begun = np.searchsorted(t, recording.cuts)
    whole[begun[(begun > 0) & (begun < len(t))] - 1] = False
    way = np.diff(p, axis=0)
    speed = _median(way / dt[:, None])
    middle = 0.5 * (t[1:] + t[:-1])
    psi = sampled(recording, "psi", middle)
    sailed = _velocity(recording, middle, psi)
    rest = None if sailed is None else np.where(whole[:, None], way - sailed * dt[:, None], 0.0)
    # as if every step took the usual time: what a longer or shorter one adds is known
    way = np.where(whole[:, None], way - speed * (dt - period)[:, None], 0.0)
    long = _Window(max(_BESIDE[0], round(_LONG / period)), max(_RETURN, round(_SETTLED / period)))
    lasting, vague = _steadier(way, rest, whole, long)
    # where messages come unevenly, each may be a tick of the table late
    uneven = np.mean(np.abs(dt - period) > 0.5 * min(tick, period)) > _UNEVEN
    slip = speed * tick if uneven else np.zeros_like(way)
    seconds, rounding = float(t[-1] - t[0]), max(track.step)
    search = _Search(whole, slip, lasting, vague, long, seconds, rounding)
    zero, rounded = np.zeros(len(way)), rounding / np.sqrt(12)
    # in body axes a turn is no bend
    alone = [_view(way, x, whole, rounded) for x in (zero, psi) if x is not None]
    if psi is not None and vessel is not None and alone[-1] is not None:
        pushes = _pushes(recording, vessel, middle)
        alone += [_beside(alone[-1], pushes, whole, rounded)] if pushes is not None else []
    ranked = sorted((v for v in alone if v is not None), key=lambda view: view.spread)
    views = [(v, ranked[1:]) for v in ranked[:1]]
    if rest is not None:
        views += [(v, []) for v in [_view(rest, zero, whole, rounded)] if v is not None]
    found: dict[int, tuple[Array, float]] = {}
    for view, others in views:
        # velocities that were made of the positions hide a jump, those of a sensor show it
        more = search.jumps(view, others)
        found |= {k: x for k, x in more.items() if all(abs(k - j) > _RETURN for j in found)}
    return [
        _Jump(float(t[k]), float(t[k + 1]), (float(size[0]), float(size[1])), error)
        for k, (size, error) in sorted(found.items())
    ]


def _messages(track: Track) -> tuple[Array, Array]:
    """Return times and positions once a message of the receiver, (N,) and (N, 2)."""
    new = np.concatenate([[True], (np.diff(track.p, axis=0) != 0).any(axis=1)])
    length = np.diff(np.append(np.flatnonzero(new), len(new)))
    if np.median(length) < 2:
        return track.t, track.p
    # after a gap the same position is another message
    new[1:] |= np.diff(track.t) > HOLE * usual_step(track.t)
    return track.t[new], track.p[new]


def _velocity(recording: Recording, t: Array, psi: Array | None) -> Array | None:
    """Return the velocity over ground at some times, (N, 2) [m/s]; None where it is not known."""
    pair = ("v_n", "v_e") if "v_n" in recording else ("u", "v")
    one, two = (sampled(recording, name, t) for name in pair)
    if one is None or two is None:
        return None
    if pair == ("v_n", "v_e"):
        return np.column_stack([one, two])
    return None if psi is None else np.column_stack(body_to_ned(one, two, psi))


@dataclass(frozen=True)
class _View:
    """Increments of the position in one pair of axes, and how they scatter.

    Parameters
    ----------
    way : ndarray
        (N, 2) [m].
    psi : ndarray
        (N,) from earth to these axes [rad].
    halves : tuple of int
        Samples on one side that predict them, from best to fewest.
    wanders : int
        What wanders beside the noise: 0 for the position, 1 for its rate.
    level : ndarray
        (N,) which of `halves` is free of holes and ends, its length where none is.
    scale : ndarray
        (N, 2) standard deviation of the steps that they leave [m].
    spread : float
        Most of `scale` [m].
    """

    way: Array
    psi: Array
    halves: tuple[int, ...]
    wanders: int
    level: NDArray[np.int64]
    scale: Array
    spread: float

    def steps(self, way: Array) -> Array:
        """Return the step at each increment of a way in these axes, (N, 2) [m]."""
        size = np.zeros_like(way)
        for k, half in enumerate(self.halves):
            here = self.level == k
            if here.any():
                size[here] = _filtered(way, _kernel(half, self.wanders))[here]
        return size

    def lasts(self, way: Array, whole: Mask, k: int) -> bool:
        """Whether a step at increment `k` is likelier than samples beside it that lie off."""
        around = max(self.halves[0], _LASTING[0])
        low, high = max(k - around, 0), min(k + around, len(way) - 1)
        holes = np.flatnonzero(~whole[low : high + 1]) + low
        around = min([k - low, high - k, *(abs(holes - k) - 1)]) + 1
        if around <= _RETURN:
            return False
        z = np.vstack([[0.0, 0.0], np.cumsum(way[k - around + 1 : k + around], axis=0)])
        at = np.arange(2 * around) - around
        shapes = np.column_stack(
            [at >= 0, *((at >= min(m, 0)) & (at < max(m, 0)) for m in _OFF)]
        ).astype(float)
        weighted = _precision(self.halves[0], self.wanders, around) @ shapes
        gain = np.sum((weighted.T @ z) ** 2, axis=1) / np.sum(weighted * shapes, axis=0)
        return bool(np.argmax(gain) == 0)


def _pushes(recording: Recording, vessel: Vessel, t: Array) -> Array | None:
    """Return the generalised forces and the yaw rate at some times, (N, q); None without them."""
    found = {c: sampled(recording, c, t) for c in (*vessel.commands, "r")}
    values = {c: value for c, value in found.items() if value is not None}
    if len(values) < len(found):
        return None
    turning = values.pop("r")
    return np.column_stack([*generalised_force(vessel, values).values(), turning])


def _beside(view: _View, pushes: Array, whole: Mask, rounded: float) -> _View | None:
    """Return a view in body axes beside what thrusters and turning explain of it.

    The velocities answer forces, and the turning of the ship's own momentum, as lags of
    unknown time do: sums of first-order lags. Their coefficients are those of generalised
    least squares, with the view's own filter as weight.
    """
    turning = pushes[:, -1:]
    moved = np.column_stack([pushes[:, :-1], _smooth(view.way) * turning])
    lags = np.exp(-1 / np.array(_LAGS))
    columns = [decay(float(a), (1 - a) * (moved - moved[0])) for a in lags]
    still = [turning, np.cos(view.psi)[:, None], np.sin(view.psi)[:, None], np.ones_like(turning)]
    x = np.column_stack(columns + still)
    clear = view.level == 0
    if clear.sum() < _LEAST_SAMPLES * x.shape[1]:
        return None
    x /= np.maximum(np.sqrt(np.mean(x[clear] ** 2, axis=0)), 1e-12)
    step = _kernel(view.halves[0], view.wanders)
    bound = _BOUND * view.scale[clear]
    left = np.clip(_filtered(view.way, step)[clear], -bound, bound)
    gram = x[clear].T @ _filtered(x, step)[clear]
    found = np.linalg.lstsq(0.5 * (gram + gram.T), x[clear].T @ left, rcond=_SAME)[0]
    rest = np.where(whole[:, None], view.way - x @ found, 0.0)
    made = _view(rest, view.psi, whole, rounded, turned=True)
    fitted = np.sqrt(1 - x.shape[1] / clear.sum())
    return None if made is None else replace(made, spread=made.spread / fitted)


def _view(
    way: Array, psi: Array, whole: Mask, rounded: float, *, turned: bool = False
) -> _View | None:
    """Return increments in axes turned by psi, with the windows that leave the least scatter.

    `rounded` is the standard deviation of the rounding of a position [m].
    """
    if psi.any() and not turned:
        way = np.column_stack(ned_to_body(way[:, 0], way[:, 1], psi))
    made = []
    for wanders, half in product(_WANDERS, _BESIDE):
        if 4 * half > len(way):
            continue
        step = _kernel(half, wanders)
        clear = np.convolve(whole, np.ones(len(step)), "same") > len(step) - 0.5
        if not clear.any():
            continue
        least = max(_FINEST, rounded) * float(np.linalg.norm(np.diff(step, prepend=0, append=0)))
        scale = np.maximum(_scale(_filtered(way, step), clear, half), least)
        spread = float(np.quantile(np.hypot(*scale[clear].T), 0.9))
        made.append((spread, half, clear, scale, wanders))
    if not made:
        return None
    best = min(made, key=lambda m: m[0])
    # near holes and ends fewer samples have to do
    chosen = [m for m in reversed(made) if m[4] == best[4] and m[1] <= best[1]]
    level = np.full(len(way), len(chosen))
    scale = np.full_like(way, np.inf)
    for k in reversed(range(len(chosen))):
        clear = chosen[k][2]
        level[clear], scale[clear] = k, chosen[k][3][clear]
    return _View(way, psi, tuple(m[1] for m in chosen), best[4], level, scale, best[0])


@dataclass(frozen=True)
class _Search:
    """The search for jumps among the increments of a track.

    Parameters
    ----------
    whole : ndarray
        (N,) bool, whether an increment spans no hole.
    slip : ndarray
        (N, 2) what a slip in time by one message changes, north and east [m].
    lasting : ndarray
        (N, 2) increments beside what predicts them best over a long window [m].
    vague : float
        What is left there of nothing [m].
    long : _Window
    seconds : float
        Length of the log.
    rounding : float
        Step of rounded positions [m], 0 where there is none.
    """

    whole: Mask
    slip: Array
    lasting: Array
    vague: float
    long: _Window
    seconds: float
    rounding: float

    def jumps(self, view: _View, others: Sequence[_View]) -> dict[int, tuple[Array, float]]:
        """Return size north and east, and standard error, of the jumps by increment.

        A jump is there in `others`, too, where they are sharp enough to show it: in earth and in
        body axes, with and without what thrusters explain. What a ship that is stopped or turned
        hard bends there is not.
        """
        way, lasting = view.way.copy(), self.lasting.copy()
        clear = view.level < len(view.halves)
        most = view.halves[0]
        windows = [_Window(half, _RETURN) for half in _LASTING]
        vague = [_vagueness(way, self.whole, w) for w in windows]
        slip = np.column_stack(ned_to_body(self.slip[:, 0], self.slip[:, 1], view.psi))
        found: dict[int, Array] = {}
        ways = [other.way.copy() for other in others]

        def look() -> tuple[Array, Array]:
            size = view.steps(way)
            total = np.maximum(np.hypot(*size.T), 1e-12)
            beyond = np.maximum(1 - np.abs(np.sum(slip * size, axis=1)) / total**2, 0.0)
            return size, np.where(clear, np.hypot(*(size / view.scale).T) * beyond, 0.0)

        def take(k: int, jump: Array) -> None:
            way[k] -= jump
            lasting[k] -= _to_earth(jump, view.psi[k])
            for other, beside in zip(others, ways, strict=True):
                beside[k] -= _turned(jump, other.psi[k] - view.psi[k])

        def bends(k: int, size: Array) -> bool:
            for other, beside in zip(others, ways, strict=True):
                turn = other.psi[k] - view.psi[k]
                if _norm(_turned(size, turn) / other.scale[k]) < noise:
                    continue
                # both views hold the same noise: what one of them adds is motion
                same = _turned(other.steps(beside)[k], -turn)
                if _norm(same / view.scale[k]) < least:
                    return True
            return False

        def holds(k: int, size: Array) -> bool:
            # rounding alone makes steps of its own size
            if _norm(size) < _ROUNDINGS * self.rounding or not _at_once(way, k, size):
                return False
            if not view.lasts(way, self.whole, k):
                return False
            # a receiver that wanders steps over one window and not over another
            sharp = [w for w, v in zip(windows, vague, strict=True) if v <= _VAGUE * _norm(size)]
            if not all(w.lasts(way, self.whole, k, size) for w in sharp):
                return False
            if self.vague > _VAGUE * _norm(size):
                return True
            return self.long.lasts(lasting, self.whole, k, _to_earth(size, view.psi[k]))

        size, distance = look()
        peaks = _peaks(distance, most)
        often = int(max(_FEW, min(_OFTEN * len(peaks), _MANY), self.seconds / _MINUTE))
        # the length of two normal components is beyond x by a chance of exp(-x²/2)
        noise = np.sqrt(2 * np.log(len(way) / _CHANCE))
        if most == _BESIDE[0]:
            noise *= _MOVES
        least = max(noise, _ABOVE * float(peaks[min(often, len(peaks)) - 1]))
        for _ in range(_MOST_JUMPS):
            k = int(np.argmax(distance))
            if distance[k] < least:
                break
            if holds(k, size[k]) and not bends(k, size[k]):
                found[k] = size[k]
                take(k, size[k])
            else:
                # what is beside it is its echo
                clear[max(k - most, 0) : k + most + 1] = False
            size, distance = look()
        # what was taken first may have been part of a larger one beside it
        for k in sorted(found) if len(found) > 1 else ():
            take(k, -found.pop(k))
            size, distance = look()
            if distance[k] >= least and holds(k, size[k]):
                found[k] = size[k]
                take(k, size[k])
        # steps one after another are motion, not jumps
        return {
            k: (_to_earth(x, view.psi[k]), _norm(view.scale[k]) / np.sqrt(2))
            for k, x in found.items()
            if all(j == k or abs(j - k) > _RETURN for j in found)
        }


@dataclass(frozen=True)
class _Window:
    """Samples on both sides of a step, and how many beside it are left out on one side."""

    half: int
    skipped: int

    def lasts(self, way: Array, whole: Mask, k: int, size: Array) -> bool:
        """Whether a step at increment `k` is there without the samples beside it, too."""
        return bool(self.least(way, whole, k) @ size > _LASTS * (size @ size))

    def least(self, way: Array, whole: Mask, k: int) -> Array:
        """Return the smaller of the steps at `k` without the samples after or before it, (2,).

        By a parabola through the samples on both sides [m].
        """
        low, high = max(k - self.half + 1, 0), min(k + self.half, len(way))
        holes = np.flatnonzero(~whole[low:high]) + low
        low = max([low, *(holes[holes < k] + 1)])
        high = min([high, *holes[holes > k]])
        z = np.vstack([[0.0, 0.0], np.cumsum(way[low:high], axis=0)])
        at = np.arange(low, high + 1) - k - 0.5
        steps = []
        for side in (at > 0, at < 0):
            skipped = min(self.skipped, int(side.sum()) - 4)
            if skipped < 0:
                continue
            keep = ~(side & (np.abs(at) < skipped))
            x = at[keep] / self.half
            design = np.column_stack([x > 0, np.ones(len(x)), x, x**2])
            # normal equations of four columns of order one: fast, and exact enough for a test
            steps.append(np.linalg.solve(design.T @ design, design.T @ z[keep])[0])
        return np.asarray(min(steps, key=_norm)) if steps else np.zeros(2)


def _at_once(way: Array, k: int, size: Array) -> bool:
    """Whether most of a step falls on one increment."""
    beside = np.median(np.r_[way[max(k - 3, 0) : k], way[k + 1 : k + 4]], axis=0)
    return bool((way[k] - beside) @ size > _AT_ONCE * (size @ size))


def _steadier(way: Array, rest: Array | None, whole: Mask, window: _Window) -> tuple[Array, float]:
    """Return what predicts positions best over a window, neighbours or velocities, and how well."""
    best: tuple[Array, float] = (way, np.inf)
    for x in (way, rest):
        if x is not None and (size := _vagueness(x, whole, window)) < best[1]:
            best = (x, size)
    return best


def _vagueness(way: Array, whole: Mask, window: _Window) -> float:
    """Return what is usually left of nothing over a window [m]."""
    at = np.linspace(window.half, len(way) - window.half - 1, _TRIED).astype(int)
    if at[0] >= at[-1]:
        return float(np.inf)
    return float(np.median([_norm(window.least(way, whole, k)) for k in at]))


def _norm(step: Array) -> float:
    return float(np.hypot(*step))


def _turned(step: Array, angle: float) -> Array:
    """Return a step in axes turned by an angle [rad]."""
    return np.array(ned_to_body(step[0], step[1], angle))


def _to_earth(step: Array, psi: float) -> Array:
    return np.array(body_to_ned(step[0], step[1], psi))


@lru_cache(maxsize=32)
def _kernel(half: int, wanders: int) -> Array:
    """Return what gives the step in the middle of increments by generalised least squares."""
    step = _precision(half, wanders, half) @ (np.arange(2 * half) >= half)
    # of increments instead of samples
    return np.asarray(np.cumsum((step / step[half:].sum())[::-1])[::-1][1:])


@lru_cache(maxsize=32)
def _precision(half: int, wanders: int, around: int) -> Array:
    """Return the inverse covariance of the positions up to `around` samples on both sides.

    They are a random walk (`wanders` 0) or its integral (1), started anywhere, beside white noise
    of unit variance, in the ratio at which what is `half` samples away says nothing any more:
    what a smoothing spline leaves (Wahba, 1978).
    """
    bend = np.diff(np.eye(2 * around), wanders + 1, axis=0)
    stiffness = (half / _REACH) ** (2 * wanders + 2)
    return np.asarray(
        np.eye(2 * around) - np.linalg.inv(np.eye(2 * around) + stiffness * bend.T @ bend)
    )


def _filtered(way: Array, kernel: Array) -> Array:
    return np.column_stack([np.convolve(w, kernel[::-1], "same") for w in way.T])


def _peaks(distance: Array, half: int) -> Array:
    """Return the largest distances that are apart from each other, in falling order."""
    from scipy.ndimage import maximum_filter1d

    return np.sort(distance[distance == maximum_filter1d(distance, 2 * half + 1)])[::-1]


def _median(rate: Array, size: int = _SPEED) -> Array:
    from scipy.ndimage import median_filter

    return np.column_stack([median_filter(x, size=size, mode="nearest") for x in rate.T])


def _smooth(way: Array) -> Array:
    """Return increments without noise, and without one that stands out."""
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(gaussian_filter1d(_median(way, 5), 2.0, axis=0, mode="nearest"))


def _scale(size: Array, clear: Mask, half: int) -> Array:
    """Return the robust scatter of steps beside each sample, not below that of the log, (N, 2).

    The samples that a jump itself moves are left out: the larger scatter of both sides.
    """
    part = np.abs(size)
    overall = np.median(part[clear] if clear.any() else part, axis=0)
    span = min(8 * half, len(part))
    windows = np.lib.stride_tricks.sliding_window_view(part, span, axis=0)[::half]
    centre = span / 2 + half * np.arange(len(windows))
    level = np.median(windows, axis=2)
    at = np.arange(len(part))
    away = span / 2 + 2 * half
    local = [
        np.maximum(np.interp(at - away, centre, x), np.interp(at + away, centre, x))
        for x in level.T
    ]
    return np.asarray(FROM_MEDIAN * np.maximum(np.column_stack(local), overall))
