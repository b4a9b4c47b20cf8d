"""Frame, sign and unit of each motion channel, by which reading the kinematics agree.

Each alternative is a small change to how columns are read. All are compared by
the likelihood of positions against velocities and of heading against yaw rate;
the fewest changes win unless the gain is beyond doubt. Where no velocities tie the
heading to positions, heading and yaw rate tell only the ratio of their units and signs:
the course over ground then tells which of the two is read wrongly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from greybox.numerics.parallel import map_forked
from greybox.rotation import ned_to_body
from greybox.trial.checks.course import PLAUSIBLE, Course, course_scatter
from greybox.trial.checks.finding import Finding, Outcome, declare_unit, exact_finding
from greybox.trial.checks.motion import Motion, integrate, profiles, read_together, to_ned
from greybox.trial.checks.wind_convention import STEADIER
from greybox.trial.convert.derived_signals import continuous, usual_reach
from greybox.trial.raw_log import Array
from greybox.trial.steps import Step, mend
from greybox.units import UNITS

Values = dict[str, Array]

# what one more change must gain in log-likelihood, and in share of the residual
_LEAST_GAIN = 15.0
_LEAST_SHARE = 0.15
# the way made in this time shows where the velocity points
_TURN_SECONDS = 10.0
# a gross error shows in a part of a long log
_EXCERPT = 8000
# and in means over so many seconds of a fast one
_STEP = 0.5
# lateness that is no frame or unit, near enough for a small ship's zig-zag [s]
_LATENESS = (-3.0, *(k / 4 for k in range(-8, 9) if k), 3.0, 4.5)
# residuals whitened together hold about so many numbers
_AT_ONCE = 100_000
_DEG = np.pi / 180
# readings that explain less by no more than this are as good as the best
_ALIKE = 3.0
# wrapped radians that were read as degrees reach no further than this [rad]
_TURN_OF_RADIANS = 1.1 * 2 * np.pi * _DEG
# what reaches further is hardly a heading in radians [rad]
_TURNS = 4 * np.pi
_KNOT = UNITS["kn"].factor


@dataclass(frozen=True)
class ColumnHypothesis:
    """One alternative reading of some columns.

    Parameters
    ----------
    id : {"unit", "frame", "sign"}
    group : str
        Columns that are read otherwise; two changes of one group exclude each other.
    channels : tuple of str
    apply : callable
        Values -> values, on the grid.
    repair : tuple of Step
    words : str
        What the log holds, for the evidence.
    fix : str
    value : float
    unit : str
    cost : float
        Changes that it counts for.
    """

    id: str
    group: str
    channels: tuple[str, ...]
    apply: Callable[[Values], Values]
    repair: tuple[Step, ...]
    words: str
    fix: str
    value: float = -1.0
    unit: str = "1"
    cost: float = 1.0


def _scaled(names: tuple[str, ...], factor: float) -> Callable[[Values], Values]:
    return lambda x: {**x, **{n: x[n] * factor for n in names if n in x}}


def _sign(*names: str, group: str, cost: float = 1.0) -> ColumnHypothesis:
    return ColumnHypothesis(
        "sign", group, names, _scaled(names, -1.0), (mend("scale", names, factor=-1.0),),
        f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} reversed",
        f"change the sign of {' and '.join(names)} (import --fix does), or map it with sign = -1",
        cost=cost,
    )  # fmt: skip


def _unit(
    names: tuple[str, ...], group: str, factor: float, said: str, held: str
) -> ColumnHypothesis:
    return ColumnHypothesis(
        "unit", group, names, _scaled(names, factor), (mend("scale", names, factor=factor),),
        f"{' and '.join(names)} {'holds' if len(names) == 1 else 'hold'} {held} under a {said} "
        f"name",
        declare_unit(names, held),
        1 / factor, f"{held} per {said}",
    )  # fmt: skip


def _read_as(name: str, factor: float, said: str, held: str) -> ColumnHypothesis:
    """Return that a column was read in the unit that its name says and holds another one."""

    def apply(x: Values) -> Values:
        value = x[name] * factor
        # as numbers between plus and minus 0.11 it showed no wraps
        return {**x, name: np.unwrap(value) if name == "psi" else value}

    return ColumnHypothesis(
        "unit", name, (name,), apply, (mend("scale", (name,), factor=factor),),
        f"{name} holds {held} that were read as {said}",
        f'write unit = "{held}" at its column under [columns] of the vessel file and read the raw '
        f"file again, or let greybox import --fix convert the log",
        1 / factor, f"{held} per {said}",
    )  # fmt: skip


def _swap(a: str, b: str, *, group: str, words: str = "") -> ColumnHypothesis:
    return ColumnHypothesis(
        "sign", group, (a, b), lambda x: {**x, a: x[b], b: x[a]}, (mend("exchange", (a, b)),),
        f"{a} and {b} are swapped{words}",
        f"exchange {a} and {b} (import --fix does), or correct [columns]",
        0.0,
    )  # fmt: skip


def _earth(names: tuple[str, str], words: str) -> ColumnHypothesis:
    def apply(x: Values) -> Values:
        u, v = ned_to_body(x[names[0]], x[names[1]], x["psi"])
        return {**x, "u": u, "v": v}

    return ColumnHypothesis(
        "frame", "velocity", ("u", "v"), apply, (mend("earth_to_body", names),),
        f"u and v are velocities {words}, not along the body's axes",
        "turn them by the heading into body axes (import --fix does), or map them to "
        f"{'v_n and v_e' if names[0] == 'u' else 'v_e and v_n'} in [columns]",
        0.0, "1",
    )  # fmt: skip


_PSI = (
    _sign("psi", group="psi"),
    ColumnHypothesis(
        "frame", "psi", ("psi",), lambda x: {**x, "psi": np.pi / 2 - x["psi"]},
        (mend("scale", ("psi",), factor=-1.0), mend("offset", ("psi",), offset=np.pi / 2)),
        "psi counts from east, anticlockwise, not from north, clockwise",
        "replace psi by pi/2 - psi (import --fix does)", 0.0, "1",
    ),
    ColumnHypothesis(
        "unit", "psi", ("psi",),
        lambda x: {**x, "psi": np.unwrap(continuous(x["psi"]) * _DEG)},
        (mend("scale", ("psi",), factor=_DEG),),
        "psi holds degrees where a log has radians",
        declare_unit(("psi",), "deg"), 180 / np.pi, "deg per rad",
    ),
    _read_as("psi", 1 / _DEG, "deg", "rad"),
    ColumnHypothesis(
        "sign", "psi", ("psi",), lambda x: {**x, "psi": x["psi"] + np.pi},
        (mend("offset", ("psi",), offset=np.pi),),
        "psi points astern",
        "add half a turn to psi", np.pi, "rad", cost=1.1,
    ),
)  # fmt: skip
_RATE = (
    _sign("r", group="r"),
    _unit(("r",), "r", _DEG, "rad/s", "deg/s"),
    _unit(("r",), "r", _DEG / 60, "rad/s", "deg/min"),
    _read_as("r", 1 / 60, "deg/s", "deg/min"),
    _read_as("r", 1 / _DEG, "deg/s", "rad/s"),
)
_VELOCITY = (
    _sign("u", group="velocity"),
    _sign("v", group="velocity"),
    _sign("u", "v", group="velocity", cost=1.05),
    _swap("u", "v", group="velocity"),
    _unit(("u", "v"), "speed", _KNOT, "m/s", "kn"),
    _unit(("u", "v"), "speed", 1 / 3.6, "m/s", "km/h"),
    _unit(("u",), "speed", _KNOT, "m/s", "kn"),
    _unit(("v",), "speed", _KNOT, "m/s", "kn"),
    _earth(("u", "v"), "north and east"),
    _earth(("v", "u"), "east and north"),
)
_POSITION = (
    _sign("y_n", group="position"),
    _sign("x_n", group="position"),
    _swap("x_n", "y_n", group="position", words=" (east before north)"),
    _unit(("x_n", "y_n"), "length", 1000.0, "m", "km"),
)
_ACROSS = (
    _swap("psi", "r", group="psi"),
    _swap("v", "r", group="velocity"),
    _swap("u", "r", group="velocity"),
)


_CHANGES = (*_PSI, *_RATE, *_VELOCITY, *_POSITION, *_ACROSS)
_HEADING_IN_DEGREES, _HEADING_IN_RADIANS = _PSI[2:4]
# both were read as degrees
_SHARED = (_HEADING_IN_RADIANS, _RATE[4])
# what heading and yaw rate by themselves cannot tell from another reading of the two
_OF_HEADING_AND_RATE = (*_PSI[:4], *_RATE)


@dataclass(frozen=True)
class ColumnReading:
    """The reading of a log's columns that the kinematics agree with.

    Parameters
    ----------
    changes : tuple of ColumnHypothesis
        Empty where the log is as its names say.
    motion : Motion
        Read so.
    gain : float
        Log-likelihood gained over the names as they are, by all logs that are read so.
    logs : tuple of int
        Which logs are read so together.
    sure : bool
        Whether this log follows logs that agree, or tells by itself, and no other reading
        explains as much.
    remark : str
        What else speaks for the reading, or leaves it in doubt.
    """

    changes: tuple[ColumnHypothesis, ...]
    motion: Motion
    gain: float
    logs: tuple[int, ...] = (0,)
    sure: bool = True
    remark: str = ""


def find_readings(
    motions: Sequence[Motion], courses: Sequence[Course | None] = ()
) -> list[ColumnReading]:
    """Choose among the readings of the columns, of all logs of one ship together.

    Parameters
    ----------
    motions : sequence of Motion
        As named.
    courses : sequence of Course, optional
        Of the same logs, as named; None where a log has none.

    Returns
    -------
    list of ColumnReading
        Fewest changes first: each must gain 15 in log-likelihood (a chance of
        1e-7) and shrink the residual by 15 %. A log that contradicts the
        others by as much is read by itself.
    """
    scores = map_forked(lambda m: _Alternatives(m).cache, motions)
    logs = [_Alternatives(m, known) for m, known in zip(motions, scores, strict=True)]
    groups = read_together(dict(enumerate(logs)), _decide, _contradicts)
    readings: dict[int, ColumnReading] = {}
    for key, group in groups:
        known = [c for i in group if i < len(courses) and (c := courses[i]) is not None]
        settled = _settle([logs[i] for i in group], known, key)
        for i in group:
            readings[i] = _reading(i, motions[i], logs, settled, group, len(groups) > 1)
    return [readings[i] for i in range(len(logs))]


@dataclass(frozen=True)
class _Settled:
    """A reading, whether it is the only one that explains so much, and what tells that."""

    key: Key
    sure: bool = True
    remark: str = ""


def _settle(logs: Sequence[_Alternatives], courses: Sequence[Course], key: Key) -> _Settled:
    """Choose among the readings that heading and yaw rate alone cannot tell from `key`.

    The course over ground turns with the true heading, and a hull that goes ahead keeps it near
    the bow. What neither tells is left at the fewest changes, of the yaw rate sooner than of the
    heading: nothing is derived from the yaw rate.
    """
    if any(log.motion.positioned for log in logs):
        return _Settled(key)
    rivals = {r: _of_heading(_changes(logs, r)) for r in _rivals(logs, key)}
    if len(set(map(_words, rivals.values()))) < 2:
        return _Settled(key)
    lie = {r: course_scatter(courses, partial(_heading, turned)) for r, turned in rivals.items()}
    steadiest = min(scatter for scatter, _ in lie.values())
    kept = [r for r in rivals if lie[r][0] <= STEADIER * steadiest]
    told = len(kept) < len(rivals)
    if any(c.id == "unit" for turned in rivals.values() for c in turned):
        # a course that hardly turns lies best to a heading that hardly does
        told &= STEADIER * steadiest < course_scatter(courses, np.zeros_like)[0]
    if not told:
        return _undecided(logs, rivals, key)
    # one that counts from elsewhere turns alike
    chosen = min(kept, key=lambda r: (len(r), abs(lie[r][1])))
    other = next((r for r in kept if _words(rivals[r]) != _words(rivals[chosen])), None)
    if not rivals[chosen]:
        return _Settled(chosen, True, "; the course turns with psi as it is")
    signs = any(c.id != "unit" for c in rivals[chosen])
    remark = f"; the course {'turns against' if signs else 'does not turn with'} psi as it is"
    off = abs(lie[chosen][1])
    if other is None or off < PLAUSIBLE:
        return _Settled(chosen, True, remark)
    doubt = " and ".join(c.words for c in rivals[other])
    remark += f", {np.degrees(off):.0f} deg off the bow so read: perhaps {doubt}"
    return _Settled(chosen, False, remark)


def _rivals(logs: Sequence[_Alternatives], key: Key) -> list[Key]:
    """Return the readings of heading and yaw rate that explain as much as `key`, and itself."""
    changes = _changes(logs, key)
    if not all(c in _OF_HEADING_AND_RATE for c in changes):
        return [key]
    best = sum(log.gain(key) for log in logs)
    least = best - _ALIKE * max(log.sample_correlation_factor for log in logs)
    known = {k: made for log in logs for k, (made, _, _) in log.ranked.items()}
    return [
        k
        for k, made in known.items()
        if k == key
        # where the columns agree as they are named, they hold at most one unit that both share
        or (
            (bool(changes) or made == _SHARED)
            and all(c in _OF_HEADING_AND_RATE for c in made)
            and sum(log.gain(k) for log in logs) >= least
        )
    ]


def _undecided(
    logs: Sequence[_Alternatives], rivals: Mapping[Key, tuple[ColumnHypothesis, ...]], key: Key
) -> _Settled:
    """Return the reading of the fewest changes, in doubt where another one has as few."""
    reach = max(usual_reach(log.motion["psi"]) for log in logs)

    def likely(r: Key) -> bool:
        if _HEADING_IN_RADIANS in rivals[r] and reach > _TURN_OF_RADIANS:
            return False
        return len(r) == len(key) or (_HEADING_IN_DEGREES in rivals[r] and reach > _TURNS)

    kept = list(filter(likely, rivals))
    if len({_words(rivals[r]) for r in kept}) < 2:
        return _Settled(next(iter(kept), key))
    chosen = min(kept, key=lambda r: (len(r), len(rivals[r])))
    other = next(r for r in kept if _words(rivals[r]) != _words(rivals[chosen]))
    doubt = " and ".join(c.words for c in _changes(logs, other))
    return _Settled(
        chosen, False, f"; that {doubt} would explain as much, and no course tells which"
    )


def _of_heading(changes: Iterable[ColumnHypothesis]) -> tuple[ColumnHypothesis, ...]:
    return tuple(c for c in changes if c.channels == ("psi",))


def _heading(changes: Iterable[ColumnHypothesis], psi: Array) -> Array:
    """Return a heading read with some changes."""
    for c in changes:
        psi = c.apply({"psi": psi})["psi"]
    return psi


def _reading(
    i: int, motion: Motion, logs: Sequence[_Alternatives], settled: _Settled,
    together: tuple[int, ...], divided: bool,
) -> ColumnReading:  # fmt: skip
    mine, key = logs[i], settled.key
    changes = tuple(c for c in _changes([logs[k] for k in together], key) if mine.applies(c))
    if not changes:
        return ColumnReading((), motion, 0.0, together)
    gain = sum(logs[k].beside(key) for k in together)
    sure, remark = settled.sure, settled.remark
    if divided and mine.beside(key) < _LEAST_GAIN * mine.sample_correlation_factor:
        sure = False
        remark += "; other logs of the ship are as named, and this one cannot tell by itself"
    return ColumnReading(changes, read(motion, changes), gain, together, sure, remark)


def _decide(logs: Sequence[_Alternatives]) -> Key:
    """Return the reading that these logs prefer together; nothing where it is as named."""
    costs: dict[Key, float] = {}
    for log in logs:
        costs |= {key: cost for key, (_, _, cost) in log.ranked.items()}
    penalty = _LEAST_GAIN * max(log.sample_correlation_factor for log in logs)
    gains = {key: sum(log.gain(key) for log in logs) for key in costs}

    def earned(key: Key) -> bool:
        """Whether a reading shrinks the residual enough for what it costs more than others."""
        samples = max(sum(log.judging(_changes(logs, key)) for log in logs), 1)
        return all(
            1.0 - np.exp(-2 * (gains[key] - gains[other]) / samples) >= _LEAST_SHARE * more
            for other, cost in costs.items()
            if (more := costs[key] - cost) > 0
        )

    # a late sensor may explain nearly as much as a unit and an arm do
    key = next(filter(earned, sorted(costs, key=lambda k: penalty * costs[k] - gains[k])))
    changes = _changes(logs, key)
    kept = []
    for change in (c for c in changes if c.group not in _LATER):
        silent = _silent((change,))
        # whatever shrinks a channel shrinks its noise: it must explain more than nothing would
        lost = sum(
            log.score(changes) - log.score((*changes, silent))
            for log in logs
            if log.applies(change)
        )
        told = any(n in log.motion for n in silent.channels for log in logs)
        if not told or lost >= _LEAST_GAIN:
            kept.append(change)
    return _words(kept)


def _changes(logs: Sequence[_Alternatives], key: Key) -> tuple[ColumnHypothesis, ...]:
    for log in logs:
        if key in log.ranked:
            return log.ranked[key][0]
    return ()


def _contradicts(log: _Alternatives, key: Key) -> bool:
    """Whether a log by itself prefers another reading beyond doubt."""
    own = _decide([log])
    if own == key:
        return False
    penalty = _LEAST_GAIN * log.sample_correlation_factor
    cost = log.ranked[own][2] - log.ranked[key][2] if key in log.ranked else 0.0
    return log.beside(own) - log.beside(key) > penalty * (1.0 + cost)


def read(motion: Motion, changes: tuple[ColumnHypothesis, ...]) -> Motion:
    """Return the motion with its columns read otherwise."""
    values = dict(motion.values)
    for change in sorted(changes, key=_order):
        values = change.apply(values)
    return replace(motion, values=values)


def reading_findings(reading: ColumnReading, names: Sequence[str] = ()) -> list[Finding]:
    """Return one finding for each change of a reading.

    Parameters
    ----------
    reading : ColumnReading
    names : sequence of str
        Of all logs that were read together.
    """
    found = []
    several = len(reading.logs) > 1
    for c in reading.changes:
        tied = (
            "positions and velocities"
            if c.group in ("velocity", "speed", "position", "length")
            else "heading and the other channels"
        )
        beside = f" in {len(reading.logs)} logs together" if several else ""
        found.append(
            exact_finding(
                c.id,
                c.channels,
                c.value,
                c.unit,
                f"{c.words}: only then do {tied} agree (log-likelihood higher by "
                f"{reading.gain:.0f}{beside}){reading.remark}",
                c.fix if reading.sure else c.fix.replace("--fix", f"--fix-also {c.id}", 1),
                c.repair,
                reading.sure,
                {"changes": reading.changes},
                tuple(names[i] for i in reading.logs) if several and names else (),
            )
        )
    return found


def frame_outcomes(motion: Motion | None) -> list[Outcome]:
    """Say what could be compared, for the checks of unit, frame and sign."""
    seen = []
    if motion is not None and motion.positioned:
        seen.append("positions against velocities and heading")
    if motion is not None and motion.turned:
        seen.append("heading against yaw rate")
    why = "needs positions, heading and velocities, or heading and yaw rate, that overlap"
    return [
        Outcome(i, "clean" if seen else "cannot tell", " and ".join(seen) or why)
        for i in ("unit", "frame", "sign")
    ]


def _turned(m: Motion) -> ColumnHypothesis:
    """Return the change that turns the heading by the angle that fits best."""
    angle = 0.0
    if m.positioned:
        way, walked, _ = _ways(m)
        angle = float(np.angle(np.vdot(walked, way)))
    return ColumnHypothesis(
        "sign", "turned", ("psi",), lambda x: {**x, "psi": x["psi"] + angle}, (),
        f"turned by {angle:.6f}", "", angle, "rad", cost=1.3,
    )  # fmt: skip


def _aside(m: Motion) -> ColumnHypothesis:
    """Return the change that moves the positions by the lever arm that fits best."""
    way, walked, swept = _ways(m)
    power = float(np.vdot(swept, swept).real)
    arm = complex(np.vdot(swept, way - walked)) / power if power else 0j

    def apply(x: Values) -> Values:
        out = arm * np.exp(1j * x["psi"])
        return {**x, "x_n": x["x_n"] - out.real, "y_n": x["y_n"] - out.imag}

    return ColumnHypothesis(
        "sign", "aside", ("x_n", "y_n"), apply, (),
        f"aside by {arm.real:.6f}, {arm.imag:.6f}", "", abs(arm), "m", cost=1.3,
    )  # fmt: skip


def _ways(m: Motion) -> tuple[NDArray[np.complex128], ...]:
    """Return ways made by positions, by velocities, and of a point 1 m ahead against the ship."""
    span = max(1, round(_TURN_SECONDS / m.step))
    place = integrate(to_ned(m["psi"], m["u"], m["v"]), m)
    moved = (m["x_n"] + 1j * m["y_n"], place[:, 0] + 1j * place[:, 1], np.exp(1j * m["psi"]))
    ways = tuple(z[span:] - z[:-span] for z in moved)
    for way in ways:
        for a, _ in m.stretches[1:]:
            way[max(a - span, 0) : a] = 0
    return ways


def _late(motion: Motion) -> Iterator[ColumnHypothesis]:
    """Return readings with some channels moved in time, so that lateness is no frame or unit."""

    # by whole samples: between samples the noise would be averaged, which looks like agreement
    def shifted(names: tuple[str, ...], steps: int) -> Callable[[Values], Values]:
        def apply(x: Values) -> Values:
            moved = dict(x)
            for n in names:
                moved[n] = x[n].copy()
                for a, b in motion.stretches:
                    rows = np.clip(np.arange(a, b) + steps, a, b - 1)
                    moved[n][a:b] = x[n][rows]
            return moved

        return apply

    for names in (("psi",), ("u", "v"), ("x_n", "y_n")):
        for late in _LATENESS:
            # steps of logs differ, what is tried does not
            steps = round(late / motion.step)
            words = f"{' and '.join(names)} {late:g} s late"
            if steps == 0:
                continue
            yield ColumnHypothesis(
                "sign", "late", names, shifted(names, steps), (), words, "", late, "s", cost=1.3
            )


def _silent(changes: tuple[ColumnHypothesis, ...]) -> ColumnHypothesis:
    names = tuple(n for c in changes for n in c.channels if n in ("u", "v", "r"))
    if _HEADING_IN_RADIANS in changes:
        # beside a heading 57 times as large the yaw rate is small
        names += ("r",)
    return ColumnHypothesis(
        "sign", "silent", names, _scaled(names, 0.0), (),
        f"without {', '.join(names)}", "",
    )  # fmt: skip


# what a reading is called, in every log: the words of its changes
Key = tuple[str, ...]
# a relation's name, and the reading that it is looked at by
_Residual = tuple[str, Key]
_LATER = ("turned", "late", "aside")


class _Alternatives:
    """Log-likelihoods of the readings of one log; those that are known are not computed again."""

    def __init__(self, motion: Motion, known: Mapping[_Residual, float] | None = None) -> None:
        self.motion = motion = motion.coarser(_STEP).excerpt(_EXCERPT)
        self.relations = [r for r in _RELATIONS if all(n in motion for n in r.channels)]
        self.cache = dict(known or {})
        # neighbouring samples of a fast log say the same: its likelihood counts them all
        self.sample_correlation_factor = max(1.0, 0.5 / motion.step / 5)
        usable = [c for c in _CHANGES if self.applies(c)]
        alternatives: dict[Key, tuple[ColumnHypothesis, ...]] = {(): ()}
        alternatives |= {_words((c,)): (c,) for c in usable}
        if motion.positioned:
            alternatives |= {("turned",): (_turned(motion),), ("aside",): (_aside(motion),)}
            for c in usable:
                alternatives[*_words((c,)), "aside"] = (c, _aside(read(motion, (c,))))
            alternatives |= {_words((c,)): (c,) for c in _late(motion)}
        for a, b in combinations(usable, 2):
            if a.group != b.group and not set(a.channels) & set(b.channels):
                alternatives[_words((a, b))] = (a, b)
        self._score_all(list(alternatives.values()))
        base = self.score(())
        # what is read so, the log-likelihood that it gains, and what it costs
        self.ranked = {
            key: (changes, self.score(changes) - base, sum(c.cost for c in changes))
            for key, changes in alternatives.items()
        }

    def gain(self, key: Key) -> float:
        """Return the log-likelihood that a reading gains; nothing where it does not apply."""
        return self.ranked[key][1] if key in self.ranked else 0.0

    def beside(self, key: Key) -> float:
        """Return what a reading gains, or gains beside a lever arm where that tells more."""
        if (*key, "aside") not in self.ranked:
            return self.gain(key)
        return max(self.gain(key), self.gain((*key, "aside")) - self.gain(("aside",)))

    def judging(self, changes: tuple[ColumnHypothesis, ...]) -> int:
        """Return how many residuals can tell about these changes."""
        told = (r for r in self.relations if any(map(r.reads, changes)))
        return len(self.motion) * sum(r.components for r in told)

    def applies(self, change: ColumnHypothesis) -> bool:
        if not all(c in self.motion for c in change.channels):
            return False
        if change.group in ("velocity", "position", "speed", "length"):
            return self.motion.positioned
        return self.motion.positioned or self.motion.turned

    def score(self, changes: tuple[ColumnHypothesis, ...]) -> float:
        """Return the log-likelihood of a reading."""
        self._score_all([changes])
        return sum(self.cache[r.name, _words(filter(r.reads, changes))] for r in self.relations)

    def _score_all(self, alternatives: Sequence[tuple[ColumnHypothesis, ...]]) -> None:
        """Fill the cache with these readings, many residuals at once."""
        for relation in self.relations:
            new: dict[Key, tuple[ColumnHypothesis, ...]] = {}
            for changes in alternatives:
                key = _words(filter(relation.reads, changes))
                if (relation.name, key) not in self.cache:
                    new.setdefault(key, changes)
            m = self.motion
            drift = (m.t - m.t[0])[:, None]
            at_once = max(1, _AT_ONCE // len(m))
            for k in range(0, len(new), at_once):
                keys = list(new)[k : k + at_once]
                z = np.stack([relation.residual(read(m, new[key])) for key in keys], axis=1)
                for key, found in zip(keys, profiles(z, drift, m), strict=True):
                    self.cache[relation.name, key] = found.loglik


def _order(change: ColumnHypothesis) -> int:
    # the heading must be right before velocities are turned by it
    if change.group in (*_LATER, "silent"):
        return 2
    return 1 if change.id == "frame" and change.group == "velocity" else 0


def _words(changes: Iterable[ColumnHypothesis]) -> Key:
    return tuple(c.words for c in changes)


def _position_residual(m: Motion) -> Array:
    walked = integrate(to_ned(m["psi"], m["u"], m["v"]), m)
    position = np.column_stack([m["x_n"], m["y_n"]])
    # a reading is judged per metre, so that one in kilometres has no advantage
    # the size of all steps together stays the same whatever is reversed or exchanged
    scale = float(np.sqrt(np.mean(np.diff(position, axis=0) ** 2))) or 1.0
    return np.asarray((position - walked) / scale)


def _heading_residual(m: Motion) -> Array:
    scale = float(np.sqrt(np.mean(np.diff(m["psi"]) ** 2))) or 1.0
    return np.asarray((m["psi"] - integrate(m["r"], m)) / scale)[:, None]


@dataclass(frozen=True)
class _Relation:
    """What ties motion channels together: a residual (N, `components`) that should be noise."""

    name: str
    channels: tuple[str, ...]
    components: int
    residual: Callable[[Motion], Array]

    def reads(self, change: ColumnHypothesis) -> bool:
        """Whether a change concerns it."""
        return bool(set(change.channels) & set(self.channels))


_RELATIONS = (
    _Relation("position", ("x_n", "y_n", "u", "v", "psi"), 2, _position_residual),
    _Relation("heading", ("psi", "r"), 1, _heading_residual),
)
