"""Databases of ROS 2 bags: a stranger's SQLite file, of which only plain tables are read."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

from greybox.errors import LogError
from greybox.trial.readers.limits import limits
from greybox.trial.readers.ros.storage import (
    Budget,
    Channel,
    CutError,
    Message,
    Wanted,
    normal_type,
)

MAGIC = b"SQLite format 3\0"


def read_database(path: Path, budget: Budget, wanted: Wanted) -> Iterator[Message]:
    """Yield the messages of a database in the order of its table.

    Parameters
    ----------
    path : Path
    budget : Budget
        Charged with all that is read.
    wanted : callable
        Whether the messages of a topic are needed.

    Raises
    ------
    CutError
        The database is damaged.
    LogError
        It cannot be opened, holds no plain tables of a bag, or exceeds the budget.
    """
    try:
        database = sqlite3.connect(
            f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1", uri=True
        )
    except sqlite3.Error as error:
        raise LogError(f"cannot open '{budget.name}' ({error}): copy the file again.") from None
    try:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limits().held_bytes)
        database.text_factory = lambda raw: raw.decode("utf-8", "replace")
        channels = _tables(database, budget)
        chosen = [n for n, c in channels.items() if wanted(c.topic)]
        marks = ",".join("?" * len(chosen))
        rows = database.execute(
            f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks})", chosen
        )
        for number, time, data in rows:
            if isinstance(time, int) and isinstance(data, bytes):
                budget.charge(len(data))
                budget.message()
                yield channels[number], time, data
    except (sqlite3.Error, TypeError, ValueError) as error:
        if isinstance(error, LogError):
            raise
        raise CutError(f"is a damaged database ({error})") from None
    finally:
        database.close()


def _tables(database: sqlite3.Connection, budget: Budget) -> dict[int, Channel]:
    """Return the channels by number, once the tables are known to be plain tables."""
    database.execute("PRAGMA trusted_schema=OFF")
    database.execute("PRAGMA cell_size_check=ON")
    made = dict(database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
    # a view, a virtual table or a computed column runs the stranger's SQL
    for name in ("topics", "messages", "message_definitions"):
        sql = made.get(name)
        if sql is None and name == "message_definitions":
            continue
        if sql is None or re.search(r"\bVIRTUAL\b|\bAS\b", str(sql), re.IGNORECASE):
            raise LogError(
                f"'{budget.name}' is a database without a plain table '{name}', so it is no "
                f"rosbag2 storage: name a .db3 file of a bag."
            )
    definitions: dict[str, tuple[str, str]] = {}
    if "message_definitions" in made:
        for kind, language, text in database.execute(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        ):
            definitions[str(kind)] = (str(text), "msg" if language == "ros2msg" else str(language))
    return {
        int(number): Channel(
            str(topic), normal_type(str(kind)), str(encoding), *definitions.get(str(kind), ("",))
        )
        for number, topic, kind, encoding in database.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        )
    }
