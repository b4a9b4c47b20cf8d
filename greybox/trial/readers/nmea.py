"""NMEA 0183: what GNSS, compass, wind, rudder and shaft instruments send.

The sentences are few and flat, and a day at sea holds millions of them: they
are split here rather than by a general parser, which the tests use as oracle.
"""

from __future__ import annotations

import re
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import reduce
from math import isfinite, nan
from operator import xor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError, so_many
from greybox.files import sha256
from greybox.trial.raw_log import Array, Recording, Signal, SourceFile
from greybox.trial.readers.limits import limits
from greybox.units import UNITS

_DAY = 86400.0
_SPEED_UNITS = {b"K": "km/h", b"N": "kn", b"M": "m/s", b"S": "mph"}
_STAMP = re.compile(
    rb"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:[.,]\d+)?)(Z|[+-]\d\d:?\d\d)?"
    rb"|(?<![\d.])(\d{9,10}(?:\.\d+)?|\d{13})(?![\d.])"
)
# a date that jumps further is a receiver that has just woken up
_MAX_DAYS = 366
# a sentence comes at most so long after its time [s]
_LATE = 600.0
# by unit: factor to SI, and the SI unit
_FACTORS = {symbol: (unit.factor, unit.si) for symbol, unit in UNITS.items()}
# sides of the ship, and of the meridian
_SIGNS = {b"L": -1.0, b"R": 1.0, b"W": -1.0, b"E": 1.0}
# which sentence to believe where several give one quantity, best first
_PREFERRED = {
    "lat": ("GGA", "GNS", "RMC", "GLL"), "lon": ("GGA", "GNS", "RMC", "GLL"),
    "sog": ("VTG", "RMC"), "cog": ("VTG", "RMC"), "psi": ("THS", "HDT", "HDG"),
    "V_q": ("MWV", "VWR"), "dir_q": ("MWV", "VWR"), "V_w": ("MWD", "MWV"),
}  # fmt: skip

Fields = list[bytes]
# a quantity by name and the sentence that gave it
Key = tuple[str, str]


class _Track:
    """Values of one quantity from one sentence, with the place in the stream."""

    def __init__(self) -> None:
        self.tag = array("q")
        self.order = array("q")
        self.value = array("d")
        self.unit = ""


class _Stream:
    """What has been understood so far."""

    def __init__(self) -> None:
        self.tracks: defaultdict[Key, _Track] = defaultdict(_Track)
        self.tags = array("d")
        self.tag_order = array("q")
        self.day = 0
        self.first_date: tuple[int, datetime] | None = None
        self.counts: Counter[str] = Counter()
        self.skipped: Counter[str] = Counter()
        self.remarks: Counter[str] = Counter()
        # lines so far, those among them with a stamp, and sentences with a checksum
        self.order = self.stamped = self.checksums = 0
        # stamp before each line, by its number; only as long as the last line that has one
        self.stamps = array("d")
        self.sentence = ""

    def give(self, name: str, value: float, unit: str) -> None:
        """Add one value, in `unit`, at the time that was told last."""
        track = self.tracks[name, self.sentence]
        track.unit = unit
        track.tag.append(len(self.tags) - 1)
        track.order.append(self.order)
        track.value.append(value)

    def stamp(self, value: float) -> None:
        self.stamped += 1
        missing = self.order - len(self.stamps)
        self.stamps.extend([nan] * missing)
        self.stamps.append(value)

    def time(self, field: bytes) -> None:
        """Note the time of day of a sentence; a fall by half a day is midnight."""
        hours, minutes, rest = int(field[0:2]), int(field[2:4]), float(field[4:])
        if not (0 <= hours < 24 and 0 <= minutes < 60 and 0 <= rest < 61):
            raise ValueError(field)
        now = self.day * _DAY + hours * 3600 + minutes * 60 + rest
        if self.tags:
            before = self.tags[-1]
            if now < before - _DAY / 2:
                self.day += 1
                now += _DAY
            elif before - _LATE < now - _DAY < before and self.day > 0:
                # a late sentence of the day before
                now -= _DAY
            if now == before:
                return
        self.tags.append(now)
        self.tag_order.append(self.order)

    def idle_time(self, field: bytes) -> None:
        """Note the time that a receiver without a fix tells: its clock goes on once it was set."""
        if self.tags:
            self.time(field)

    def date(self, year: int, month: int, day: int, *, sure: bool) -> None:
        """Note a date; `sure` where the receiver has a fix: it may then move the day."""
        found = datetime(year, month, day, tzinfo=UTC)
        if self.first_date is None:
            self.first_date = (self.day, found)
            return
        zero, first = self.first_date
        days = zero + (found - first).days - self.day
        # several days may lie between two recordings in one file
        if sure and 0 <= days <= _MAX_DAYS:
            self.day += days
            if self.tags and self.tag_order[-1] == self.order:
                # a pause of nearly a day looks like a late sentence
                late = self.tags[-1] < (self.day - days) * _DAY
                self.tags[-1] += (days + late) * _DAY


@dataclass(frozen=True)
class _Value:
    """One quantity of a sentence.

    Parameters
    ----------
    name : str
        Signal that it becomes.
    offers : tuple of (int, str)
        Field and its unit, best first: that which is filled is taken. An empty unit
        stands in the field behind, as a letter.
    required : bool
        Whether a sentence is wrong where no field is filled.
    side : int
        Field of the letter that gives the sign, 0 for none.
    added : tuple of int
        Fields whose values are added, each with its side behind it.
    status : int
        Field that holds ``V`` where this value is not valid, 0 for none.
    number : int
        Field whose number is part of the signal's name, 0 for none.
    """

    name: str
    offers: tuple[tuple[int, str], ...]
    required: bool = True
    side: int = 0
    added: tuple[int, ...] = ()
    status: int = 0
    number: int = 0

    def read(self, f: Fields) -> tuple[str, float, str] | None:
        """Return signal, value and its SI unit; None where it is missing and may be."""
        if self.status and _field(f, self.status) == b"V":
            return None
        found = next((offer for offer in self.offers if _field(f, offer[0])), None)
        if found is None and not self.required:
            return None
        # where all are empty the first fails, as it shall
        at, unit = found or self.offers[0]
        value = float(f[at]) * (_SIGNS[f[self.side]] if self.side else 1.0)
        for k in self.added:
            if _field(f, k):
                value += float(f[k]) * _SIGNS[f[k + 1]]
        factor, si = _FACTORS[unit or _SPEED_UNITS[f[at + 1]]]
        value *= factor
        if not isfinite(value):
            raise ValueError(self.name)
        return f"{self.name}{_numbered(f[self.number])}" if self.number else self.name, value, si


@dataclass(frozen=True)
class _Sentence:
    """How one kind of sentence is read: numbers of its fields, 0 for those it has not.

    Parameters
    ----------
    values : tuple of _Value
    time : int
        Time of day.
    untimed : bool
        Whether it may be missing: version 1.5 has GLL without it.
    date : tuple of int
        Day, month and year, or one field that holds all three.
    place : int
        Latitude; its hemisphere, longitude and hemisphere follow.
    status : int
        Field that `good` judges, a missing one as an empty one.
    good : callable
    bad : str
        What a sentence is whose status is not good.
    variant : int
        Field whose letter chooses among `variants`.
    variants : mapping of bytes to tuple of _Value
    lacking : tuple of (int, str), optional
        Field, and what is remarked where it is empty.
    """

    values: tuple[_Value, ...] = ()
    time: int = 0
    untimed: bool = False
    date: tuple[int, ...] = ()
    place: int = 0
    status: int = 0
    good: Callable[[bytes], bool] = bool
    bad: str = "without a fix"
    variant: int = 0
    variants: Mapping[bytes, tuple[_Value, ...]] = field(default_factory=dict)
    lacking: tuple[int, str] | None = None

    def read(self, s: _Stream, f: Fields) -> None:
        """Take in what one sentence tells.

        Raises
        ------
        ValueError, IndexError, KeyError
            A field is missing, or makes no sense; none of its values was taken then.
        """
        told = _field(f, self.time) if self.time else b""
        if self.status and not self.good(_field(f, self.status)):
            s.skipped[f"{s.sentence[2:]} {self.bad}"] += 1
            if told:
                s.idle_time(told)
            return
        if self.time and (told or not self.untimed):
            s.time(told)
        if self.date and (date := _date([_field(f, k) for k in self.date])) is not None:
            # only a receiver with a fix may move the day
            s.date(*date, sure=self.status > 0)
        found = _place(f[self.place : self.place + 4]) if self.place else []
        for value in self.variants[f[self.variant]] if self.variant else self.values:
            given = value.read(f)
            if given is not None:
                found.append(given)
        if self.lacking is not None and not _field(f, self.lacking[0]):
            s.remarks[self.lacking[1]] += 1
        for name, number, unit in found:
            s.give(name, number, unit)


def _numbered(text: bytes) -> int:
    """Return the number of a shaft or engine; a ship has no hundred, a damaged file may."""
    number = int(text)
    if not 0 <= number < 100:
        raise ValueError(text)
    return number


def _field(f: Fields, k: int) -> bytes:
    return f[k] if k < len(f) else b""


def _place(f: Fields) -> list[tuple[str, float, str]]:
    """Return latitude and longitude of a position: both or none."""
    north = _degrees(f[0], f[1], b"NS", 90)
    return [("lat", north, "deg"), ("lon", _degrees(f[2], f[3], b"EW", 180), "deg")]


def _degrees(value: bytes, side: bytes, sides: bytes, most: float) -> float:
    if len(side) != 1 or side not in sides:
        raise ValueError(side)
    whole = float(value)
    degrees = whole // 100
    minutes = whole - 100 * degrees
    angle = degrees + minutes / 60
    if not (0 <= angle <= most and minutes < 60):
        raise ValueError(value)
    return -angle if side in b"SW" else angle


def _date(parts: Fields) -> tuple[int, int, int] | None:
    """Return year, month and day of three fields or of one (010624); None where there is none."""
    if len(parts) == 1 and len(parts[0]) == 6:
        (joined,) = parts
        parts = [joined[0:2], joined[2:4], joined[4:6]]
    if len(parts) != 3 or not all(parts):
        return None
    day, month, year = (int(p) for p in parts)
    if year < 100:
        # GPS time begins in 1980
        year += 1900 if year >= 80 else 2000
    return year, month, day


def _none_of(*marks: bytes) -> Callable[[bytes], bool]:
    return lambda status: status not in marks


def _one_of(*marks: bytes) -> Callable[[bytes], bool]:
    return lambda status: status in marks


def _any_system(modes: bytes) -> bool:
    """Whether one of the systems that GNS names has a fix."""
    return bool(modes.strip(b"N"))


def _shaft(kind: str) -> tuple[_Value, ...]:
    return (
        _Value(f"rpm_{kind}", ((3, "rpm"),), number=2),
        _Value(f"pitch_{kind}", ((4, "1"),), number=2, required=False),
    )


_SPEED = _Value("sog", ((5, "kn"), (7, "km/h")), required=False)
_COURSE = _Value("cog", ((1, "deg"),), required=False)
_SENTENCES: dict[bytes, _Sentence] = {
    b"GGA": _Sentence(time=1, place=2, status=6, good=_none_of(b"", b"0")),
    b"GNS": _Sentence(time=1, place=2, status=6, good=_any_system),
    b"GLL": _Sentence(time=5, untimed=True, place=1, status=6, good=_none_of(b"V")),
    b"RMC": _Sentence(
        (_Value("sog", ((7, "kn"),), required=False), _Value("cog", ((8, "deg"),), required=False)),
        time=1, date=(9,), place=3, status=2, good=_one_of(b"A"),
    ),
    b"ZDA": _Sentence(time=1, date=(2, 3, 4)),
    b"VTG": _Sentence(
        (_SPEED, _COURSE), status=9, good=_none_of(b"N")
    ),
    b"HDT": _Sentence((_Value("psi", ((1, "deg"),)),)),
    b"THS": _Sentence(
        (_Value("psi", ((1, "deg"),)),),
        status=2, good=_one_of(b"A", b""), bad="that is not autonomous",
    ),
    b"HDG": _Sentence(
        (_Value("psi", ((1, "deg"),), added=(2, 4)),),
        lacking=(4, "HDG without variation taken for true headings"),
    ),
    b"ROT": _Sentence(
        (_Value("r", ((1, "deg/min"),)),), status=2, good=_none_of(b"V"), bad="marked invalid"
    ),
    b"MWV": _Sentence(
        status=5, good=_none_of(b"V"), bad="marked invalid", variant=2,
        variants={
            b"R": (_Value("dir_q", ((1, "deg"),)), _Value("V_q", ((3, ""),))),
            b"T": (_Value("dir_t", ((1, "deg"),)), _Value("V_w", ((3, ""),))),
        },
    ),
    b"VWR": _Sentence(
        (
            _Value("dir_q", ((1, "deg"),), side=2),
            _Value("V_q", ((5, "m/s"), (3, "kn"), (7, "km/h"))),
        )
    ),
    b"MWD": _Sentence((_Value("dir_w", ((1, "deg"),)), _Value("V_w", ((7, "m/s"), (5, "kn"))))),
    b"RPM": _Sentence(
        status=5, good=_none_of(b"V"), bad="marked invalid", variant=1,
        variants={b"S": _shaft("shaft"), b"E": _shaft("engine")},
    ),
    b"RSA": _Sentence(
        (
            _Value("rudder_starboard", ((1, "deg"),), required=False, status=2),
            _Value("rudder_port", ((3, "deg"),), required=False, status=4),
        )
    ),
}  # fmt: skip


def read_nmea(path: Path) -> Recording:
    """Read a file of NMEA 0183 sentences.

    Sentences without a time take that of the last timed one; where several of a
    kind come between two times they are spread evenly. A stamp before the ``$``
    (UNIX or ISO time, or a tag block) is used instead where nearly every line has
    one. Truncated lines and wrong checksums are skipped and counted.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Recording
        ``lat``, ``lon`` [deg], ``sog``, ``cog``, ``psi``, ``r``, wind, rudders
        [SI], shafts [rpm]; the talker that sent most is taken for each.

    Raises
    ------
    LogError
        The file holds no sentence that can be read, or none with a time.
    """
    stream = _Stream()
    for raw in _lines(path):
        line = raw.strip()
        if not line:
            continue
        stream.order += 1
        start = line.find(b"$")
        if start < 0:
            if line[:1] != b"!":
                stream.skipped["lines without a sentence (truncated?)"] += 1
            continue
        if start:
            stamp = _stamp(line[:start])
            if stamp is not None:
                stream.stamp(stamp)
        # where an end of line was lost, the sentence behind it is still whole
        for sentence in line[start + 1 :].split(b"$"):
            _take(sentence, stream)
    return _recording(path, stream)


def _take(sentence: bytes, stream: _Stream) -> None:
    """Understand one sentence, given without its ``$``, or count why not."""
    body, star, check = sentence.rpartition(b"*")
    if not star:
        # believed only in files that carry no checksums at all
        if stream.checksums:
            stream.skipped["truncated sentences"] += 1
            return
        body = check
    else:
        stream.checksums += 1
        try:
            right = reduce(xor, body, 0) == int(check[:2], 16) and len(check) >= 2
        except ValueError:
            right = False
        if not right:
            stream.skipped["wrong checksums"] += 1
            return
    fields = body.split(b",")
    if fields[0][:1] == b"P":
        # of one maker, whatever its name ends in
        stream.skipped["proprietary sentences"] += 1
        return
    kind = _SENTENCES.get(fields[0][2:])
    if kind is None:
        return
    stream.sentence = fields[0].decode("ascii", "replace")
    stream.counts[stream.sentence] += 1
    try:
        kind.read(stream, fields)
    except (ValueError, IndexError, KeyError, OverflowError):
        stream.skipped[f"{stream.sentence} with empty or wrong fields"] += 1


def looks_like_nmea(head: bytes) -> bool:
    """Whether the first bytes of a file hold NMEA 0183 sentences."""
    lines = head.splitlines()[:50]
    hits = sum(bool(re.search(rb"[$!][A-Z]{2}[A-Z]{3},", line)) for line in lines)
    return hits > 0.3 * max(len(lines), 1)


def _lines(path: Path) -> Iterator[bytes]:
    rest, most = b"", limits().line_bytes
    with open(path, "rb") as handle:
        while block := handle.read(limits().block_bytes):
            lines = (rest + block).replace(b"\r", b"\n").split(b"\n")
            # a line without end is cut here, and fails as a sentence
            rest = lines.pop()[-most:]
            for line in lines:
                yield line if len(line) <= most else line[-most:]
    if rest:
        yield rest


def _stamp(prefix: bytes) -> float | None:
    found = _STAMP.search(prefix)
    if not found:
        return None
    if found.group(3):
        digits = found.group(3)
        return float(digits) * (1e-3 if len(digits) == 13 else 1.0)
    zone = (found.group(2) or b"Z").decode()
    try:
        moment = datetime.fromisoformat(found.group(1).decode().replace(",", ".") + zone)
    except ValueError:
        return None
    return moment.timestamp()


def _recording(path: Path, stream: _Stream) -> Recording:
    if not stream.counts:
        raise LogError(
            f"'{path.name}' holds no NMEA 0183 sentence that can be read among {stream.order} "
            f"lines ({sum(stream.skipped.values())} skipped): name a file of sentences such as "
            f"GGA, HDT."
        )
    stamped = stream.stamped > 0.9 * stream.order
    if not len(stream.tags) and not stamped:
        raise LogError(
            f"'{path.name}' has {sum(stream.counts.values())} sentences but none with a time "
            f"(GGA, RMC, GLL, ZDA): record a GNSS receiver beside them."
        )
    notes = [f"{n} {what} skipped" for what, n in sorted(stream.skipped.items())]
    notes += [f"{n} {what}" for what, n in sorted(stream.remarks.items())]
    tags, tag_order = np.array(stream.tags), np.array(stream.tag_order, dtype=np.int64)
    stamps = np.concatenate([stream.stamps, [nan]])
    offset = 0.0
    if stamped:
        notes.append("times of untimed sentences from the stamps before them")
        if len(tags):
            offset = _median(_at(stamps, tag_order) - tags)
    use_stamps = stamped and isfinite(offset)
    signals = []
    for name, sentence in sorted(_choose(stream, notes).items()):
        track = stream.tracks[name, sentence]
        at, order = np.array(track.tag), np.array(track.order)
        value = np.array(track.value)
        timed = sentence[2:] in ("GGA", "RMC", "GNS", "GLL") and len(tags)
        if use_stamps and not timed:
            t = _at(stamps, order) - offset
            keep = np.isfinite(t)
        else:
            t = _spread(at, tags)
            keep = at >= 0
        signals.append(Signal(name, t[keep], value[keep], track.unit, f"${sentence}", True))
    signals = [s for s in signals if len(s)]
    if not signals:
        raise LogError(
            f"'{path.name}' has {so_many(len(tags), 'time')} but no value that belongs to one "
            f"of them: "
            f"name a file of sentences such as GGA, HDT."
        )
    first = min(float(s.t.min()) for s in signals)
    epoch = None
    if stream.first_date is not None and len(tags):
        day, date = stream.first_date
        epoch = date.timestamp() - day * _DAY + first
    elif use_stamps:
        epoch = first + offset
    else:
        notes.append("no date in the file (RMC, ZDA): times count from its first sentence")
    signals = [Signal(s.name, s.t - first, s.value, s.unit, s.source, True) for s in signals]
    return Recording(
        path.stem,
        tuple(signals),
        epoch=epoch,
        files=(SourceFile(path.name, sha256(path), "NMEA 0183"),),
        notes=tuple(notes),
    )


def _at(stamps: Array, order: NDArray[np.int64]) -> Array:
    """Return the stamps of lines, NaN (the last item) where they have none."""
    return np.asarray(stamps[np.minimum(order, len(stamps) - 1)])


def _median(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else nan


def _choose(stream: _Stream, notes: list[str]) -> dict[str, str]:
    """Return for each quantity the sentence, talker included, to believe."""
    chosen: dict[str, str] = {}
    names = {name for name, _ in stream.tracks}
    for name in sorted(names):
        offers = {s: len(stream.tracks[n, s].value) for n, s in stream.tracks if n == name}
        most = max(offers.values())
        rank = _PREFERRED.get(name, ())

        # a better kind with few sentences is worth less than one that covers the trial
        enough = [s for s, n in offers.items() if n >= 0.8 * most]
        # by its place among those preferred, others last; then that which sent most
        _, _, best = min(([*rank, s[2:]].index(s[2:]), -offers[s], s) for s in enough)
        chosen[name] = best
        others = [s for s in offers if s != best and s[2:] == best[2:]]
        if others:
            listed = ", ".join(f"{s} ({offers[s]})" for s in others)
            notes.append(f"{name} from {best} ({offers[best]} sentences), not from {listed}")
    for pair in (("lat", "lon"), ("V_q", "dir_q"), ("sog", "cog"), ("V_w", "dir_w")):
        if all(n in chosen for n in pair) and (pair[1], chosen[pair[0]]) in stream.tracks:
            chosen[pair[1]] = chosen[pair[0]]
    return chosen


def _spread(at: NDArray[np.int64], tags: Array) -> Array:
    """Spread those that share a time evenly until the next time."""
    if not len(at) or not len(tags):
        return np.full(len(at), nan)
    first = np.searchsorted(at, at, side="left")
    count = np.searchsorted(at, at, side="right") - first
    index = np.arange(len(at)) - first
    here = np.clip(at, 0, len(tags) - 1)
    start, following = tags[here], tags[np.clip(at + 1, 0, len(tags) - 1)]
    steps = np.diff(tags)
    steps = steps[steps > 0]
    usual = float(np.median(steps)) if len(steps) else 0.0
    # across a hole in the times, those that came went on at their own rate
    groups = count[index == 0]
    rate = float(np.median(groups)) / usual if usual else 0.0
    free = count / rate if rate else np.zeros(len(at))
    until = following - start
    step = np.where((until > 0) & (until <= 1.5 * usual), until, usual)
    step = np.where(until > 1.5 * usual, np.minimum(free, until), step)
    return np.asarray(start + index / count * step)
