"""NMEA 0183: what GNSS, compass, wind, rudder and shaft instruments send.

The sentences are few and flat, and a day at sea holds millions of them: they
are split here rather than by a general parser, which the tests use as oracle.
"""

from __future__ import annotations

import re
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import reduce
from math import isfinite, nan, radians
from operator import xor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError
from greybox.files import sha256
from greybox.trial.raw_log import Recording, Signal, SourceFile
from greybox.trial.readers.limits import limits
from greybox.units import UNITS

Array = NDArray[np.float64]

_DAY = 86400.0
_SPEED_UNITS = {b"K": "km/h", b"N": "kn", b"M": "m/s", b"S": "mph"}
_STAMP = re.compile(
    rb"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:[.,]\d+)?)(Z|[+-]\d\d:?\d\d)?"
    rb"|(?<![\d.])(\d{9,10}(?:\.\d+)?|\d{13})(?![\d.])"
)
# a date that jumps further is a receiver that has just woken up
_MAX_DAYS = 366
_UNITS = {
    "lat": "deg", "lon": "deg", "psi": "rad", "r": "rad/s", "sog": "m/s", "cog": "rad",
    "V_q": "m/s", "dir_q": "rad", "V_w": "m/s", "dir_w": "rad", "dir_t": "rad",
    "rudder_starboard": "rad", "rudder_port": "rad",
}  # fmt: skip
# which sentence to believe where several give one quantity, best first
_PREFERRED = {
    "lat": ("GGA", "GNS", "RMC", "GLL"), "lon": ("GGA", "GNS", "RMC", "GLL"),
    "sog": ("VTG", "RMC"), "cog": ("VTG", "RMC"), "psi": ("THS", "HDT", "HDG"),
    "V_q": ("MWV", "VWR"), "dir_q": ("MWV", "VWR"), "V_w": ("MWD", "MWV"),
}  # fmt: skip

_MAGNETIC = "HDG without variation taken for true headings, none"

Fields = list[bytes]
# a quantity by name and the sentence that gave it
Key = tuple[str, str]


class _Track:
    """Values of one quantity from one sentence, with the place in the stream."""

    def __init__(self) -> None:
        self.tag = array("q")
        self.order = array("q")
        self.value = array("d")


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
        self.order = 0
        # stamp before each line, by its number; only as long as the last line that has one
        self.stamps = array("d")
        self.sentence = ""

    def give(self, name: str, value: float) -> None:
        if not isfinite(value):
            raise ValueError(name)
        track = self.tracks[name, self.sentence]
        track.tag.append(len(self.tags) - 1)
        track.order.append(self.order)
        track.value.append(value)

    def place(self, lat: Fields, lon: Fields) -> None:
        """Give a position of value and hemisphere each; both or none."""
        north = _degrees(lat[0], lat[1], b"NS", 90)
        east = _degrees(lon[0], lon[1], b"EW", 180)
        self.give("lat", north)
        self.give("lon", east)

    def stamp(self, value: float) -> None:
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
            elif now > before + _DAY / 2 and self.day > 0:
                # a late sentence of the day before
                now -= _DAY
            if now == before:
                return
        self.tags.append(now)
        self.tag_order.append(self.order)

    def idle_time(self, field: bytes) -> None:
        """Note the time that a receiver without a fix tells: its clock goes on once it was set."""
        if field and self.tags:
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
        if sure and 0 < days <= _MAX_DAYS:
            self.day += days
            if self.tags and self.tag_order[-1] == self.order:
                self.tags[-1] += days * _DAY


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


def _gga(s: _Stream, f: Fields) -> None:
    if f[6] in (b"", b"0"):
        s.skipped["GGA without a fix"] += 1
        s.idle_time(f[1])
        return
    s.time(f[1])
    s.place(f[2:4], f[4:6])


def _gns(s: _Stream, f: Fields) -> None:
    if not f[6].strip(b"N"):
        s.skipped["GNS without a fix"] += 1
        s.idle_time(f[1])
        return
    s.time(f[1])
    s.place(f[2:4], f[4:6])


def _gll(s: _Stream, f: Fields) -> None:
    if len(f) > 6 and f[6] == b"V":
        s.skipped["GLL without a fix"] += 1
        s.idle_time(f[5])
        return
    # version 1.5 has no time
    if len(f) > 5 and f[5]:
        s.time(f[5])
    s.place(f[1:3], f[3:5])


def _rmc(s: _Stream, f: Fields) -> None:
    if f[2] != b"A":
        s.skipped["RMC without a fix"] += 1
        s.idle_time(f[1])
        return
    s.time(f[1])
    if len(f[9]) == 6:
        s.date(2000 + int(f[9][4:6]), int(f[9][2:4]), int(f[9][0:2]), sure=True)
    s.place(f[3:5], f[5:7])
    if f[7]:
        s.give("sog", float(f[7]) * 1852 / 3600)
    if f[8]:
        s.give("cog", radians(float(f[8])))


def _zda(s: _Stream, f: Fields) -> None:
    s.time(f[1])
    if f[4]:
        s.date(int(f[4]), int(f[3]), int(f[2]), sure=False)


def _vtg(s: _Stream, f: Fields) -> None:
    if len(f) > 9 and f[9] == b"N":
        s.skipped["VTG without a fix"] += 1
        return
    if f[5]:
        s.give("sog", float(f[5]) * 1852 / 3600)
    elif f[7]:
        s.give("sog", float(f[7]) / 3.6)
    if f[1]:
        s.give("cog", radians(float(f[1])))


def _hdt(s: _Stream, f: Fields) -> None:
    s.give("psi", radians(float(f[1])))


def _ths(s: _Stream, f: Fields) -> None:
    if len(f) > 2 and f[2] not in (b"A", b""):
        s.skipped["THS that is not autonomous"] += 1
        return
    s.give("psi", radians(float(f[1])))


def _hdg(s: _Stream, f: Fields) -> None:
    angle = float(f[1])
    if not (len(f) > 4 and f[4]):
        s.skipped[_MAGNETIC] += 1
    for value, side in ((f[2], f[3]), (f[4], f[5])):
        if value:
            angle += float(value) * (-1 if side == b"W" else 1)
    s.give("psi", np.radians(angle))


def _rot(s: _Stream, f: Fields) -> None:
    if len(f) > 2 and f[2] == b"V":
        s.skipped["ROT marked invalid"] += 1
        return
    s.give("r", radians(float(f[1])) / 60)


def _mwv(s: _Stream, f: Fields) -> None:
    if len(f) > 5 and f[5] == b"V":
        s.skipped["MWV marked invalid"] += 1
        return
    angle, speed = radians(float(f[1])), float(f[3]) * UNITS[_SPEED_UNITS[f[4]]].factor
    true = f[2] == b"T"
    s.give("dir_t" if true else "dir_q", angle)
    s.give("V_w" if true else "V_q", speed)


def _vwr(s: _Stream, f: Fields) -> None:
    angle = radians(float(f[1])) * {b"L": -1, b"R": 1}[f[2]]
    for value, factor in ((f[5], 1.0), (f[3], 1852 / 3600), (f[7] if len(f) > 7 else b"", 1 / 3.6)):
        if value:
            s.give("dir_q", angle)
            s.give("V_q", float(value) * factor)
            return
    s.skipped["VWR without a speed"] += 1


def _mwd(s: _Stream, f: Fields) -> None:
    speed = float(f[7]) if f[7] else float(f[5]) * 1852 / 3600
    s.give("dir_w", radians(float(f[1])))
    s.give("V_w", speed)


def _rpm(s: _Stream, f: Fields) -> None:
    if len(f) > 5 and f[5] == b"V":
        s.skipped["RPM marked invalid"] += 1
        return
    kind = {b"S": "shaft", b"E": "engine"}[f[1]]
    s.give(f"rpm_{kind}{int(f[2])}", float(f[3]))
    if f[4]:
        s.give(f"pitch_{kind}{int(f[2])}", float(f[4]))


def _rsa(s: _Stream, f: Fields) -> None:
    sides = (("rudder_starboard", 1), ("rudder_port", 3))
    for name, k in sides:
        if len(f) > k and f[k] and (len(f) <= k + 1 or f[k + 1] != b"V"):
            s.give(name, radians(float(f[k])))


_HANDLERS: dict[bytes, Callable[[_Stream, Fields], None]] = {
    b"GGA": _gga, b"GNS": _gns, b"GLL": _gll, b"RMC": _rmc, b"ZDA": _zda, b"VTG": _vtg,
    b"HDT": _hdt, b"THS": _ths, b"HDG": _hdg, b"ROT": _rot, b"MWV": _mwv, b"VWR": _vwr,
    b"MWD": _mwd, b"RPM": _rpm, b"RSA": _rsa,
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
    seen = _Seen()
    for raw in _lines(path):
        line = raw.strip()
        if not line:
            continue
        seen.lines += 1
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
                seen.stamped += 1
        # where an end of line was lost, the sentence behind it is still whole
        for sentence in line[start + 1 :].split(b"$"):
            _take(sentence, stream, seen)
    return _recording(path, stream, seen)


@dataclass
class _Seen:
    """Counts of lines, of those with a stamp, and of sentences with a checksum."""

    lines: int = 0
    stamped: int = 0
    checksums: int = 0


def _take(sentence: bytes, stream: _Stream, seen: _Seen) -> None:
    """Understand one sentence, given without its ``$``, or count why not."""
    body, star, check = sentence.rpartition(b"*")
    if not star:
        # believed only in files that carry no checksums at all
        if seen.checksums:
            stream.skipped["truncated sentences"] += 1
            return
        body = check
    else:
        seen.checksums += 1
        try:
            right = reduce(xor, body, 0) == int(check[:2], 16) and len(check) >= 2
        except ValueError:
            right = False
        if not right:
            stream.skipped["wrong checksums"] += 1
            return
    fields = body.split(b",")
    handler = _HANDLERS.get(fields[0][2:])
    if handler is None:
        return
    stream.sentence = fields[0].decode("ascii", "replace")
    stream.counts[stream.sentence] += 1
    try:
        handler(stream, fields)
    except (ValueError, IndexError, KeyError, OverflowError, TypeError):
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


def _recording(path: Path, stream: _Stream, seen: _Seen) -> Recording:
    if not stream.counts:
        raise LogError(
            f"'{path.name}' holds no NMEA 0183 sentence that can be read among {seen.lines} lines "
            f"({sum(stream.skipped.values())} skipped): name a file of sentences such as GGA, HDT."
        )
    stamped = seen.stamped > 0.9 * seen.lines
    if not len(stream.tags) and not stamped:
        raise LogError(
            f"'{path.name}' has {sum(stream.counts.values())} sentences but none with a time "
            f"(GGA, RMC, GLL, ZDA): record a GNSS receiver beside them."
        )
    notes = [f"{n} {what} skipped" for what, n in sorted(stream.skipped.items())]
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
        if use_stamps and not (_timed(sentence) and len(tags)):
            t = _at(stamps, order) - offset
            keep = np.isfinite(t)
        else:
            t = _spread(at, tags)
            keep = at >= 0
        unit = _UNITS.get(name, "rpm" if name.startswith("rpm") else "1")
        signals.append(Signal(name, t[keep], value[keep], unit, f"${sentence}", True))
    signals = [s for s in signals if len(s)]
    if not signals:
        raise LogError(
            f"'{path.name}' has {len(tags)} times but no value that belongs to one of them: "
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


def _timed(sentence: str) -> bool:
    return sentence[2:] in ("GGA", "RMC", "GNS", "GLL")


def _choose(stream: _Stream, notes: list[str]) -> dict[str, str]:
    """Return for each quantity the sentence, talker included, to believe."""
    chosen: dict[str, str] = {}
    names = {name for name, _ in stream.tracks}
    for name in sorted(names):
        offers = {s: len(stream.tracks[n, s].value) for n, s in stream.tracks if n == name}
        most = max(offers.values())
        rank = _PREFERRED.get(name, ())

        def worth(sentence: str, rank: tuple[str, ...] = rank) -> tuple[int, str]:
            kind = sentence[2:]
            return (rank.index(kind) if kind in rank else len(rank), sentence)

        # a better kind with few sentences is worth less than one that covers the trial
        enough = [s for s, n in offers.items() if n >= 0.8 * most]
        best = min(enough, key=lambda s: (worth(s)[0], -offers[s], s))
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
