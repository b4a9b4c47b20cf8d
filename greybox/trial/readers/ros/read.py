"""Signals out of ROS 1 bags, ROS 2 bags and MCAP files."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greybox.channels import CHANNELS
from greybox.errors import LogError, so_many, suggestion
from greybox.files import sha256
from greybox.trial.raw_log import Array, Recording, Signal, SourceFile, free_name, shortened
from greybox.trial.readers.limits import limits
from greybox.trial.readers.ros.axes import (
    HANDLERS,
    OTHER_CLOCK,
    Fields,
    SkippedMessageError,
    unsure_fields,
)
from greybox.trial.readers.ros.bags import read_messages, storage_files
from greybox.trial.readers.ros.messages import (
    Decoded,
    DecodeError,
    Long,
    decoder,
    numbers,
)
from greybox.trial.readers.ros.storage import Budget, Channel
from greybox.units import is_unix_time

_UNITS = {"lat": "deg", "lon": "deg", "altitude": "m"} | {
    name: CHANNELS[name].unit for name in ("x_n", "y_n", "psi", "u", "v", "r")
}
_CANONICAL = frozenset({"lat", "lon", "x_n", "y_n", "psi", "u", "v", "r"})


def read_bag(path: Path, topics: Mapping[str, str] | None = None) -> Recording:
    """Read the signals of a ROS 1 bag, a ROS 2 bag or an MCAP file.

    Parameters
    ----------
    path : Path
        ``.bag`` (format 2.0), the directory of a ROS 2 bag, or a single ``.db3`` or
        ``.mcap``; told apart by content. Messages are ROS 1, CDR or JSON.
    topics : mapping of str to str, optional
        Topics to use, and only those; all of them by default. The value says how
        to name what they hold:

        - ``""``: as without `topics`;
        - ``"name"``: the one signal of the topic is called ``name``, several are
          called ``name.field``;
        - ``"field=name, field2=name2"``: only these fields, under these names. A
          field is the path in the message (``twist.twist.linear.x``, unconverted) or
          the canonical name of a converted one (``u``).

    Returns
    -------
    Recording
        ``t`` [s] from the first message, `epoch` its UNIX time, `None` where the
        clock does not count from 1970. NavSatFix gives ``lat``, ``lon`` [deg];
        Odometry ``x_n``, ``y_n`` [m], ``psi`` [rad, 0 to 2π], ``u``, ``v`` [m/s],
        ``r`` [rad/s]; Imu ``r`` and ``psi``; stamped twists ``u``, ``v``, ``r``;
        stamped poses ``x_n``, ``y_n``, ``psi``. Any other number is a signal
        ``topic.field``, of no stated unit; std_msgs/String goes to `text`. Where two
        topics give the same canonical name, that with more messages keeps it.

    Raises
    ------
    LogError
        The file is no bag, is encrypted, cut before its first message or larger than
        the bounds; a topic or field of `topics` is not in it; or no number is.

    References
    ----------
    REP 103 (axes and units), REP 145 (IMU), REP 147 (``_ned``, ``_frd``).
    """
    path = Path(path)
    files, mode, notes = storage_files(path)
    budget = Budget(path.name, sum(f.stat().st_size for f in files))
    collected: dict[str, _Topic] = {}
    seen: dict[str, str] = {}

    def wanted(topic: str) -> bool:
        seen.setdefault(topic, "")
        return topics is None or topic in topics

    stored = _Store()
    for file in files:
        budget.name = file.name
        for channel, time, data in read_messages(file, mode, budget, notes, wanted):
            topic = collected.get(channel.topic)
            if topic is None:
                if len(collected) >= (most := limits().topics):
                    raise LogError(
                        f"'{path.name}' holds more than {most} topics: name those needed."
                    )
                rule = (topics or {}).get(channel.topic, "")
                topic = collected[channel.topic] = _Topic(channel, rule, stored)
            topic.add(channel, time, data)
    for name in topics or {}:
        if name not in seen:
            raise LogError(
                f"'{path.name}' has no topic '{name}'.{suggestion(name, seen)} "
                f"Its topics: {shortened(seen, 20)}."
            )
    signals, text, epoch, unsure = _recording(path, list(collected.values()), notes)
    recorded = [f for f in [path / "metadata.yaml", *files] if path.is_dir()] or [path]
    formats = {".bag": "ROS 1 bag", ".mcap": "MCAP", ".db3": "rosbag2 database"}
    sources = tuple(
        SourceFile(f.name, sha256(f), formats.get(f.suffix, "ROS bag"))
        for f in recorded
        if f.is_file()
    )
    return Recording(
        path.stem, signals, text, epoch, files=sources, notes=tuple(notes), unsure=unsure
    )


@dataclass
class _Store:
    """Counts the numbers that all topics hold."""

    values: int = 0

    def charge(self, count: int) -> None:
        self.values += count
        if self.values > (most := limits().values):
            raise LogError(
                f"the bag holds more than {most} numbers: name the topics that are needed."
            )


@dataclass
class _Topic:
    """What one topic gave so far: times and columns, NaN where a field is absent."""

    channel: Channel
    rule: str
    stored: _Store
    stamp: array[int] = field(default_factory=lambda: array("q"))
    logged: array[int] = field(default_factory=lambda: array("q"))
    columns: dict[str, array[float]] = field(default_factory=dict)
    words: list[str] = field(default_factory=list)
    skipped: dict[str, int] = field(default_factory=dict)
    remarks: dict[str, None] = field(default_factory=dict)
    fields: dict[str, None] = field(default_factory=dict)
    converted: set[str] = field(default_factory=set)
    unsure: set[str] = field(default_factory=set)
    unstamped: int = 0
    stamped: bool = False
    _decoders: dict[Channel, Callable[[bytes], Decoded] | DecodeError] = field(default_factory=dict)

    @property
    def dotted(self) -> str:
        """Name of the topic as the first part of a signal's name."""
        return self.channel.topic.strip("/").replace("/", ".") or "topic"

    def add(self, channel: Channel, time: int, data: bytes) -> None:
        """Decode one message and keep its numbers."""
        decode = self._decoders.get(channel)
        if decode is None:
            try:
                decode = decoder(channel)
            except DecodeError as error:
                decode = error
            self._decoders[channel] = decode
        if isinstance(decode, DecodeError):
            self._skip(str(decode))
            return
        try:
            message = decode(data)
            found = self._extract(message)
        except DecodeError as error:
            # only the kind: bytes and positions differ from message to message
            self._skip(
                "they cannot be decoded" if self.columns else f"they cannot be decoded: {error}"
            )
            return
        except SkippedMessageError as error:
            self._skip(str(error))
            return
        if not found and not self.words:
            return
        self._keep(found, time, _stamp(message))

    def _skip(self, reason: str) -> None:
        if reason not in self.skipped and len(self.skipped) >= 5:
            reason = "for other reasons"
        self.skipped[reason] = self.skipped.get(reason, 0) + 1

    def _extract(self, message: Decoded) -> Fields:
        kind = self.channel.msgtype
        if kind == "std_msgs/msg/String":
            self.stored.charge(32)
            self.words.append(str(message.get("data", ""))[: limits().text])
            return {}
        chosen = _rule_fields(self.rule)
        handle = HANDLERS.get(kind)
        found: Fields = {}
        if handle is not None:
            try:
                found = handle(message, self.remarks)
                self.converted.update(found.keys() & _UNITS.keys())
                self.unsure |= unsure_fields(kind, message) & found.keys()
            # the definition in the file is not that of the type's name
            except (KeyError, TypeError, ValueError, IndexError):
                self.remarks["does not have the fields of its type, so it was not converted"] = None
                handle = None
        if handle is None or chosen:
            for name, value in numbers(message):
                if name.startswith("header."):
                    continue
                if isinstance(value, Long):
                    self.remarks[f"'{name}' has {value.length} elements and was left out"] = None
                elif name not in found:
                    found[name] = value
        if chosen:
            self.fields.update(dict.fromkeys(list(found)[: limits().topic_fields]))
            return {n: v for n, v in found.items() if n in chosen}
        return found

    def _keep(self, found: Fields, time: int, stamp: int | None) -> None:
        before = len(self.logged)
        for name, value in found.items():
            column = self.columns.get(name)
            if column is None:
                if len(self.columns) >= (most := limits().topic_fields):
                    self.remarks[f"only its first {most} fields were kept"] = None
                    continue
                column = self.columns[name] = array("d")
            missing = before - len(column)
            self.stored.charge(missing + 1)
            column.extend(array("d", [math.nan]) * missing)
            column.append(value)
        self.stored.charge(2)
        self.logged.append(time)
        self.stamped |= stamp is not None
        self.unstamped += stamp == 0
        self.stamp.append(stamp or time)

    def clock(self, notes: list[str]) -> NDArray[np.int64]:
        """Return the times [ns] of the messages, (N,)."""
        logged = np.frombuffer(self.logged, np.int64)
        stamps = np.frombuffer(self.stamp, np.int64)
        topic = self.channel.topic
        if self.unstamped:
            notes.append(
                f"{self.unstamped} of {so_many(len(logged), 'message')} of '{topic}' "
                f"{'carries' if self.unstamped == 1 else 'carry'} no time in the header: the "
                f"recorder's time was used for those."
            )
        if not self.stamped:
            return logged
        late = float(np.median((logged.astype(float) - stamps.astype(float)) * 1e-9))
        if abs(late) > OTHER_CLOCK:
            notes.append(
                f"the headers of '{topic}' are {late:.6g} s before the recorder's clock, so they "
                f"come from another clock: the recorder's time was used."
            )
            return logged
        return stamps

    def column(self, name: str) -> Array:
        """Return one column (N,), NaN to the end where its field stopped."""
        column = self.columns[name]
        values = np.full(len(self.logged), np.nan)
        values[: len(column)] = np.frombuffer(column, float)
        return values


def _rule_fields(rule: str) -> dict[str, str]:
    """Return field to name of a rule ``field=name,…``; empty for any other rule."""
    if "=" not in rule:
        return {}
    pairs = (p.partition("=") for p in rule.split(",") if p.strip())
    return {f.strip(): n.strip() for f, _, n in pairs}


def _stamp(message: Decoded) -> int | None:
    """Return the header's time [ns], 0 where it is not set, None without a header."""
    header = message.get("header")
    stamp = header.get("stamp") if isinstance(header, dict) else message.get("timestamp")
    if not isinstance(stamp, dict):
        return None
    seconds, nanos = stamp.get("sec"), stamp.get("nanosec", stamp.get("nsec", 0))
    if not isinstance(seconds, int) or not isinstance(nanos, int):
        return None
    total = seconds * 10**9 + nanos
    return total if 0 <= total < 2**63 else 0


# from topics to a recording


def _recording(
    path: Path, topics: list[_Topic], notes: list[str]
) -> tuple[
    tuple[Signal, ...], dict[str, tuple[Array, NDArray[np.str_]]], float | None, frozenset[str]
]:
    full = [t for t in topics if len(t.logged)]
    for topic in topics:
        _remark(topic, notes)
    _check_rules(topics)
    if not any(t.columns for t in full):
        held = shortened((f"{t.channel.topic} ({t.channel.msgtype})" for t in topics), 20)
        reasons = " ".join(notes[:3])
        raise LogError(
            f"'{path.name}' holds no number that can be read; its topics: {held or 'none'}. "
            f"{reasons}{' ' if reasons else ''}Record navigation topics such as nav_msgs/Odometry."
        )
    clocks = [t.clock(notes) for t in full]
    first = min(int(c.min()) for c in clocks)
    epoch: float | None = first * 1e-9
    if not is_unix_time(first * 1e-9):
        notes.append(f"times begin at {first * 1e-9:.6g} s, so the clock does not count from 1970.")
        epoch = None
    keepers = _keepers(full)
    signals: list[Signal] = []
    used: set[str] = set()
    unsure: set[str] = set()
    text: dict[str, tuple[Array, NDArray[np.str_]]] = {}
    for topic, clock in zip(full, clocks, strict=True):
        # the difference is exact in integers, a float of the epoch would round to 0.2 us
        t: Array = np.asarray((clock - first) * 1e-9, np.float64)
        if topic.words:
            text[free_name(topic.rule or topic.dotted, used)] = (t, np.array(topic.words))
        for name in topic.columns:
            converted = name in topic.converted
            final, canonical = _named(topic, name, converted, keepers, notes)
            unsure |= {final} if canonical and name in topic.unsure else set()
            signals.append(
                Signal(
                    free_name(final, used),
                    t,
                    topic.column(name),
                    _UNITS[name] if converted else None,
                    f"{topic.channel.topic}: {name}",
                    canonical,
                )
            )
    return tuple(signals), text, epoch, frozenset(unsure)


def _keepers(topics: list[_Topic]) -> dict[str, _Topic]:
    """Return by canonical name the topic that keeps it: the first of those with most messages."""
    keepers: dict[str, _Topic] = {}
    for topic in topics:
        if topic.rule:
            continue
        for name in topic.columns.keys() & topic.converted & _CANONICAL:
            if name not in keepers or len(topic.logged) > len(keepers[name].logged):
                keepers[name] = topic
    return keepers


def _named(
    topic: _Topic, name: str, converted: bool, keepers: dict[str, _Topic], notes: list[str]
) -> tuple[str, bool]:
    """Return the name of a column's signal, and whether the format makes it canonical."""
    chosen = _rule_fields(topic.rule)
    if chosen:
        return chosen[name], converted and chosen[name] == name and name in _CANONICAL
    if topic.rule:
        return topic.rule if len(topic.columns) == 1 else f"{topic.rule}.{name}", False
    if converted and name in _CANONICAL:
        keeper = keepers[name]
        if keeper is topic:
            return name, True
        notes.append(
            f"'{name}' is that of '{keeper.channel.topic}' "
            f"({so_many(len(keeper.logged), 'message')}); that "
            f"of '{topic.channel.topic}' ({len(topic.logged)}) is called '{topic.dotted}.{name}'."
        )
    alone = name == "data" and topic.channel.msgtype.startswith("std_msgs/")
    return topic.dotted if alone else f"{topic.dotted}.{name}", False


def _remark(topic: _Topic, notes: list[str]) -> None:
    label = f"'{topic.channel.topic}' ({topic.channel.msgtype or 'no type'})"
    for remark in topic.remarks:
        notes.append(f"{label}: {remark}.")
    for reason, count in topic.skipped.items():
        notes.append(f"{label}: {so_many(count, 'message', 'was', 'were')} skipped: {reason}.")


def _check_rules(topics: list[_Topic]) -> None:
    for topic in topics:
        chosen = _rule_fields(topic.rule)
        lost = [f for f in chosen if f not in topic.columns]
        if lost and (topic.logged or not topic.skipped):
            raise LogError(
                f"topic '{topic.channel.topic}' ({topic.channel.msgtype}) has no numeric field "
                f"'{lost[0]}'.{suggestion(lost[0], topic.fields)} Name the path of a field in "
                f"its message, as in 'twist.twist.linear.x'."
            )
