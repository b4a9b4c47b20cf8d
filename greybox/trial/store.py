"""Writing a log, and the record of its origin beside it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import IO, Any

import numpy as np

from greybox.channels import LOGGED
from greybox.errors import LogError
from greybox.files import check_targets, replacing, sha256, write_json
from greybox.trial.actuator_estimate import recorded_actuators
from greybox.trial.gaps import joined_spans
from greybox.trial.log import RECORD_FORMAT, RECORD_VERSION, Provenance, TrialLog
from greybox.trial.old_records import steps_of_sentences
from greybox.trial.readers.limits import limits
from greybox.trial.steps import LATEST_DATE, Step, step_from_dict
from greybox.vessel.conditions import Conditions

_ROWS = 1 << 17


def record_path(path: str | Path) -> Path:
    """Return where the record of a log stands: beside it, ``.json`` added to its name."""
    return Path(f"{path}.json")


def write_log(
    segments: Iterable[TrialLog],
    path: str | Path,
    *,
    extra: Mapping[str, Any] | None = None,
    provenance: Callable[[], Provenance] | None = None,
) -> None:
    """Write the segments of a log as one table, and its record beside it.

    Rows that are missing between segments are the gaps. The record is a JSON
    file with sources, hashes, units, what was derived and what was mended.

    Parameters
    ----------
    segments : iterable of TrialLog
        In order of time, of one sample time; written one after another, so that
        they need not be in memory together.
    path : str or Path
        CSV, or Parquet where it ends so.
    extra : mapping, optional
        More entries of the record.
    provenance : callable, optional
        Asked after the last segment; that of the first segment by default.

    Raises
    ------
    LogError
        The file cannot be written.
    """
    path = Path(path)
    check_targets(path, record_path(path))
    if path.exists() and not path.is_file():
        raise LogError(
            f"cannot write a log to '{path}', a device or a pipe: its record stands beside it and "
            f"holds its hash. Name a file."
        )
    iterator = iter(segments)
    first = next(iterator, None)
    if first is None:
        raise LogError("there is no segment to write: import at least one.")
    names = _columns(first)
    spans: list[tuple[float, float, int]] = []
    tables = _tables(chain([first], iterator), first, names, spans)
    try:
        with replacing(path, "wb") as handle:
            _write_tables(tables, path, handle)
    except OSError as error:
        raise LogError(
            f"cannot write '{path}': {error.strerror or error}. Nothing was written: make room, or "
            f"name a file elsewhere."
        ) from None
    record = {
        "format": RECORD_FORMAT,
        "version": RECORD_VERSION,
        "log": path.name,
        "log_sha256": sha256(path),
        "rows": sum(count for _, _, count in spans),
        "sample_time": first.sample_time,
        "units": {n: first.units[n] for n in names},
        "segments": [list(s) for s in joined_spans(spans, first.sample_time)[:1000]],
        **(first.provenance if provenance is None else provenance()).to_dict(),
        **(extra or {}),
    }
    write_json(record, record_path(path))


def _tables(
    segments: Iterable[TrialLog],
    first: TrialLog,
    names: Sequence[str],
    spans: list[tuple[float, float, int]],
) -> Iterator[Any]:
    """Yield the rows of the log as Arrow tables, and note the spans of its segments."""
    import pyarrow as pa

    loop = first.vessel.closed_loop if first.loop_known else None
    fields = [(n, pa.float64()) for n in names]
    if loop is not None:
        fields.append((loop[0], pa.string()))
    schema = pa.schema(fields)
    for log in segments:
        spans.append((float(log.t[0]), float(log.t[-1]), len(log)))
        for start in range(0, len(log), _ROWS):
            part = slice(start, start + _ROWS)
            arrays = [
                pa.array(log.t[part] if n == "t" else log.measured(n)[part], from_pandas=True)
                for n in names
            ]
            if loop is not None:
                words = np.where(log.closed_loop[part], loop[1][0], "open")
                arrays.append(pa.array(words.astype(str)))
            yield pa.Table.from_arrays(arrays, schema=schema)


def _write_tables(tables: Iterator[Any], path: Path, handle: IO[bytes]) -> None:
    """Write tables while the next one is made."""
    table = next(tables)
    if path.suffix.lower() in (".parquet", ".pq"):
        from pyarrow import parquet

        # measured values hardly repeat: dictionaries of them only cost time
        writer: Any = parquet.ParquetWriter(handle, table.schema, use_dictionary=False)
    else:
        from pyarrow import csv

        options = csv.WriteOptions(quoting_style="needed")
        writer = csv.CSVWriter(handle, table.schema, write_options=options)
    with ThreadPoolExecutor(max_workers=1) as pool:
        try:
            written = pool.submit(writer.write_table, table)
            for table in tables:
                written.result()
                written = pool.submit(writer.write_table, table)
            written.result()
        except BaseException:
            # the writer may be at work still: it is the file's end that must not be written
            pool.shutdown(wait=True)
            with suppress(Exception):
                writer.close()
            raise
        writer.close()


def read_record(path: Path) -> dict[str, Any] | None:
    """Return the record beside a log, None where there is none or it is of another file."""
    beside = record_path(path)
    try:
        if not beside.is_file() or beside.stat().st_size > limits().sidecar_bytes:
            return None
        record = json.loads(beside.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(record, dict) or record.get("format") != RECORD_FORMAT:
        return None
    return record if record.get("log_sha256") == sha256(path) else None


def recorded_provenance(record: Mapping[str, Any]) -> Provenance:
    """Return the provenance that a record holds; what is malformed is left out."""

    def words(key: str) -> tuple[str, ...]:
        value = record.get(key)
        return tuple(str(v) for v in value) if isinstance(value, list) else ()

    epoch = record.get("epoch")
    notes = record.get("notes")
    files = record.get("files")
    return Provenance(
        str(record.get("source", "")),
        str(record.get("sha256", "")),
        _recorded_steps(record, words),
        tuple(
            (str(f[0]), str(f[1]), str(f[2]))
            for f in (files if isinstance(files, list) else ())
            if isinstance(f, list) and len(f) == 3
        ),
        words("read"),
        float(epoch) if isinstance(epoch, int | float) and abs(epoch) < LATEST_DATE else None,
        {str(k): str(v) for k, v in notes.items()} if isinstance(notes, dict) else {},
        Conditions.recorded(record),
        recorded_actuators(record),
    )


def _recorded_steps(
    record: Mapping[str, Any], words: Callable[[str], tuple[str, ...]]
) -> tuple[Step, ...]:
    if record.get("version") == 1 or "steps" not in record:
        return steps_of_sentences(words("derived"), words("fixed"))
    steps = record["steps"]
    made = [step_from_dict(s) for s in steps] if isinstance(steps, list) else []
    return tuple(s for s in made if s is not None)


def _columns(log: TrialLog) -> list[str]:
    known = [n for n in LOGGED if n == "t" or n in log]
    return known + [n for n in log.channels if n not in known]
