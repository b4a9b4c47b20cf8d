"""NMEA 0183: what GNSS, compass, wind, rudder and shaft instruments send.

The sentences are few and flat, and a day at sea holds millions of them: they
are split here rather than by a general parser, which the tests use as oracle.
"""

from __future__ import annotations

import re
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError
from greybox.files import sha256
from greybox.trial.recording import Recording, Signal, SourceFile

Array = NDArray[np.float64]

# the standard allows 82 characters; receivers and tag blocks take more
_MAX_LINE = 1024
_BLOCK = 1 << 22
_DAY = 86400.0
_SPEED_UNITS = {b"K": 1 / 3.6, b"N": 1852 / 3600, b"M": 1.0, b"S": 1609.344 / 3600}
_STAMP = re.compile(rb"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d+)?)|(\d{9,10}(?:\.\d+)?)")
_UNITS = {
    "lat": "deg", "lon": "deg", "psi": "rad", "r": "rad/s", "sog": "m/s", "cog": "rad",
    "V_q": "m/s", "dir_q": "rad", "V_w": "m/s", "dir_w": "rad", "dir_t": "rad",
    "rudder_starboard": "rad", "rudder_port": "rad",
}  # fmt: skip
# which sentence to believe where several give one quantity, best first
_PREFERRED = {
    "lat": ("GGA", "GNS", "RMC", "GLL"), "lon": ("GGA", "GNS", "RMC", "GLL"),
    "sog": ("VTG", "RMC"), "cog": ("VTG", "RMC"), "psi": ("THS", "HDT", "HDG"),
    "V_q": ("MWV", "VWR"), "dir_q": ("MWV", "VWR"),
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


class _Stream:
    """What has been understood so far."""

    def __init__(self) -> None:
        self.tracks: defaultdict[Key, _Track] = defaultdict(_Track)
        self.tags = array("d")
        self.tag_stamp = array("d")
        self.day = 0
        self.first_date: tuple[int, datetime] | None = None
        self.counts: Counter[str] = Counter()
        self.skipped: Counter[str] = Counter()
        self.order = 0
        self.stamps: dict[int, float] = {}
        self.sentence = ""

    def give(self, name: str, value: float) -> None:
        track = self.tracks[name, self.sentence]
        track.tag.append(len(self.tags) - 1)
        track.order.append(self.order)
        track.value.append(value)

    def time(self, field: bytes) -> None:
        """Note the time of day of a sentence; a fall by half a day is midnight."""
        seconds = int(field[0:2]) * 3600 + int(field[2:4]) * 60 + float(field[4:])
        now = self.day * _DAY + seconds
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
        self.tag_stamp.append(self.stamps.get(self.order, np.nan))


def _degrees(value: bytes, side: bytes) -> float:
    whole = float(value)
    degrees = whole // 100
    angle = degrees + (whole - 100 * degrees) / 60
    return -angle if side in (b"S", b"W") else angle


def _gga(s: _Stream, f: Fields) -> None:
    if f[6] in (b"", b"0"):
        s.skipped["GGA without a fix"] += 1
        return
    s.time(f[1])
    s.give("lat", _degrees(f[2], f[3]))
    s.give("lon", _degrees(f[4], f[5]))


def _gns(s: _Stream, f: Fields) -> None:
    if not f[6].strip(b"N"):
        s.skipped["GNS without a fix"] += 1
        return
    s.time(f[1])
    s.give("lat", _degrees(f[2], f[3]))
    s.give("lon", _degrees(f[4], f[5]))


def _gll(s: _Stream, f: Fields) -> None:
    if len(f) > 6 and f[6] == b"V":
        s.skipped["GLL without a fix"] += 1
        return
    s.time(f[5])
    s.give("lat", _degrees(f[1], f[2]))
    s.give("lon", _degrees(f[3], f[4]))


def _rmc(s: _Stream, f: Fields) -> None:
    if f[2] != b"A":
        s.skipped["RMC without a fix"] += 1
        return
    s.time(f[1])
    if s.first_date is None and len(f[9]) == 6:
        date = datetime(
            2000 + int(f[9][4:6]), int(f[9][2:4]), int(f[9][0:2]), tzinfo=UTC
        )
        s.first_date = (s.day, date)
    s.give("lat", _degrees(f[3], f[4]))
    s.give("lon", _degrees(f[5], f[6]))
    s.give("sog", float(f[7]) * 1852 / 3600)
    if f[8]:
        s.give("cog", np.radians(float(f[8])))


def _zda(s: _Stream, f: Fields) -> None:
    s.time(f[1])
    if s.first_date is None and f[4]:
        s.first_date = (s.day, datetime(int(f[4]), int(f[3]), int(f[2]), tzinfo=UTC))


def _vtg(s: _Stream, f: Fields) -> None:
    if len(f) > 9 and f[9] == b"N":
        s.skipped["VTG without a fix"] += 1
        return
    if f[5]:
        s.give("sog", float(f[5]) * 1852 / 3600)
    elif f[7]:
        s.give("sog", float(f[7]) / 3.6)
    if f[1]:
        s.give("cog", np.radians(float(f[1])))


def _hdt(s: _Stream, f: Fields) -> None:
    s.give("psi", np.radians(float(f[1])))


def _ths(s: _Stream, f: Fields) -> None:
    if len(f) > 2 and f[2] not in (b"A", b""):
        s.skipped["THS that is not autonomous"] += 1
        return
    s.give("psi", np.radians(float(f[1])))


def _hdg(s: _Stream, f: Fields) -> None:
    angle = float(f[1])
    for value, side in ((f[2], f[3]), (f[4], f[5])):
        if value:
            angle += float(value) * (-1 if side == b"W" else 1)
    s.give("psi", np.radians(angle))


def _rot(s: _Stream, f: Fields) -> None:
    if len(f) > 2 and f[2] == b"V":
        s.skipped["ROT marked invalid"] += 1
        return
    s.give("r", np.radians(float(f[1])) / 60)


def _mwv(s: _Stream, f: Fields) -> None:
    if len(f) > 5 and f[5] == b"V":
        s.skipped["MWV marked invalid"] += 1
        return
    angle, speed = np.radians(float(f[1])), float(f[3]) * _SPEED_UNITS[f[4]]
    true = f[2] == b"T"
    s.give("dir_t" if true else "dir_q", angle)
    s.give("V_w" if true else "V_q", speed)


def _vwr(s: _Stream, f: Fields) -> None:
    angle = np.radians(float(f[1])) * (-1 if f[2] == b"L" else 1)
    for value, factor in ((f[5], 1.0), (f[3], 1852 / 3600), (f[7], 1 / 3.6)):
        if value:
            s.give("dir_q", angle)
            s.give("V_q", float(value) * factor)
            return
    s.skipped["VWR without a speed"] += 1


def _mwd(s: _Stream, f: Fields) -> None:
    speed = float(f[7]) if f[7] else float(f[5]) * 1852 / 3600
    s.give("dir_w", np.radians(float(f[1])))
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
            s.give(name, np.radians(float(f[k])))


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
    checksums, total, prefixed = 0, 0, 0
    for raw in _lines(path):
        line = raw.strip()
        if not line:
            continue
        total += 1
        stream.order += 1
        start = line.find(b"$")
        if start < 0:
            if line[:1] != b"!":
                stream.skipped["lines without a sentence (truncated?)"] += 1
            continue
        if start:
            stamp = _stamp(line[:start])
            if stamp is not None:
                stream.stamps[stream.order] = stamp
                prefixed += 1
        end = line.rfind(b"*", start)
        if end < 0:
            # believed only in files that carry no checksums at all
            if checksums:
                stream.skipped["truncated sentences"] += 1
                continue
            end = len(line)
        else:
            checksums += 1
            try:
                right = reduce(xor, line[start + 1 : end], 0) == int(line[end + 1 : end + 3], 16)
            except ValueError:
                right = False
            if not right or len(line) < end + 3:
                stream.skipped["wrong checksums"] += 1
                continue
        fields = line[start + 1 : end].split(b",")
        handler = _HANDLERS.get(fields[0][2:])
        if handler is None:
            continue
        stream.sentence = fields[0].decode("ascii", "replace")
        stream.counts[stream.sentence] += 1
        try:
            handler(stream, fields)
        except (ValueError, IndexError, KeyError):
            stream.skipped[f"{stream.sentence} with empty or wrong fields"] += 1
    return _recording(path, stream, total, prefixed)


def looks_like_nmea(head: bytes) -> bool:
    """Whether the first bytes of a file hold NMEA 0183 sentences."""
    lines = head.splitlines()[:50]
    hits = sum(bool(re.search(rb"[$!][A-Z]{2}[A-Z]{3},", line)) for line in lines)
    return hits > 0.3 * max(len(lines), 1)


def _lines(path: Path) -> Iterator[bytes]:
    rest = b""
    with open(path, "rb") as handle:
        while block := handle.read(_BLOCK):
            lines = (rest + block).split(b"\n")
            rest = lines.pop()
            # a line without end is cut here, and fails as a sentence
            rest = rest[-_MAX_LINE:]
            for line in lines:
                yield line if len(line) <= _MAX_LINE else line[:_MAX_LINE]
    if rest:
        yield rest


def _stamp(prefix: bytes) -> float | None:
    found = _STAMP.search(prefix)
    if not found:
        return None
    if found.group(2):
        return float(found.group(2))
    moment = datetime.fromisoformat(found.group(1).decode())
    return moment.replace(tzinfo=UTC).timestamp()


def _recording(path: Path, stream: _Stream, total: int, prefixed: int) -> Recording:
    if not stream.counts:
        raise LogError(
            f"'{path.name}' holds no NMEA 0183 sentence that can be read among {total} lines "
            f"({sum(stream.skipped.values())} skipped): name a file of sentences such as GGA, HDT."
        )
    if not stream.tags:
        raise LogError(
            f"'{path.name}' has {sum(stream.counts.values())} sentences but none with a time "
            f"(GGA, RMC, GLL, ZDA): record a GNSS receiver beside them."
        )
    notes = [f"{n} {what} skipped" for what, n in sorted(stream.skipped.items())]
    tags = np.array(stream.tags)
    stamped = np.array(stream.tag_stamp)
    use_stamps = prefixed > 0.9 * total and np.isfinite(stamped).any()
    offset = float(np.nanmedian(stamped - tags)) if use_stamps else 0.0
    chosen = _choose(stream, notes)
    signals = []
    for name, sentence in sorted(chosen.items()):
        track = stream.tracks[name, sentence]
        at, order = np.array(track.tag), np.array(track.order)
        value = np.array(track.value)
        if use_stamps and not _timed(sentence):
            t = np.array([stream.stamps.get(int(k), np.nan) for k in order]) - offset
        else:
            t = _spread(at, tags)
        keep = (at >= 0) & np.isfinite(t)
        unit = _UNITS.get(name, "rpm" if name.startswith("rpm") else "1")
        signals.append(Signal(name, t[keep], value[keep], unit, f"${sentence}", True))
    signals = [s for s in signals if len(s)]
    first = min(float(s.t.min()) for s in signals)
    epoch = None
    if stream.first_date is not None:
        day, date = stream.first_date
        epoch = date.timestamp() - day * _DAY + first
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
    for pair in (("lat", "lon"), ("V_q", "dir_q"), ("sog", "cog")):
        if all(n in chosen for n in pair) and (pair[1], chosen[pair[0]]) in stream.tracks:
            chosen[pair[1]] = chosen[pair[0]]
    return chosen


def _spread(at: NDArray[np.int64], tags: Array) -> Array:
    """Spread those that share a time evenly until the next time."""
    if not len(at):
        return np.empty(0)
    first = np.searchsorted(at, at, side="left")
    count = np.searchsorted(at, at, side="right") - first
    index = np.arange(len(at)) - first
    start = tags[np.clip(at, 0, len(tags) - 1)]
    following = tags[np.clip(at + 1, 0, len(tags) - 1)]
    usual = float(np.median(np.diff(tags))) if len(tags) > 1 else 0.0
    # across a hole in the times the usual step is all that is known
    step = np.where(following > start, np.minimum(following - start, 1.5 * usual), usual)
    return start + np.asarray(index / count) * step
