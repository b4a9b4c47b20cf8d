"""Importing the raw files of a trial: read, merged, mended where asked, written as one log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from greybox.errors import LogError
from greybox.trial.checks.actuators import measure_actuators
from greybox.trial.checks.check import check_recording
from greybox.trial.convert.channel_mapping import read_trial
from greybox.trial.convert.convert import Imported, import_recording
from greybox.trial.convert.derived_signals import derive_signals
from greybox.trial.convert.options import ImportOptions
from greybox.trial.convert.two_pass_import import Stream, is_large
from greybox.trial.log import TrialLog
from greybox.trial.raw_log import Recording
from greybox.trial.readers.formats import open_raw
from greybox.trial.readers.topic_files import TopicTable
from greybox.trial.repair import repair
from greybox.trial.store import record_path, write_log
from greybox.vessel.vessel import Vessel


def import_files(
    paths: Sequence[str | Path],
    vessel: Vessel,
    out: str | Path,
    options: ImportOptions | None = None,
    *,
    fix: bool = False,
    fix_also: tuple[str, ...] = (),
    reader: Mapping[str, Any] | None = None,
    extra: Mapping[str, Any] | None = None,
) -> str:
    """Import the raw files of one trial into one log file.

    Parameters
    ----------
    paths : sequence of str or Path
        Raw files; several are merged on their clocks.
    vessel : Vessel
    out : str or Path
        CSV or Parquet; its record is written beside it.
    options : ImportOptions
    fix : bool
        Whether to mend what the checks find and what is safe to mend.
    fix_also : tuple of str
        Ids of findings to mend although they need judgement.
    reader : mapping, optional
        Handed to the readers, such as ``topics``.
    extra : mapping, optional
        More entries of the record.

    Returns
    -------
    str
        What was read, guessed, derived and mended.

    Raises
    ------
    LogError
        A file cannot be read, or no log can be made of them.
    """
    options = options or ImportOptions()
    _keep_sources(paths, out)
    if len(paths) == 1 and not fix and not fix_also and Path(paths[0]).is_file():
        table = open_raw(paths[0], **(reader or {}))
        # axes that only the other signals tell need all of them
        unsure = isinstance(table, TopicTable) and bool(table.unsure)
        if not isinstance(table, Recording) and is_large(table) and not unsure:
            stream = Stream(table, vessel, options)
            write_log(stream.segments(), out, extra=extra, provenance=stream.provenance)
            assert stream.first is not None
            spans = stream.spans
            notes = [*stream.provenance().read, *(s.sentence for s in stream.steps)]
            return _summary(
                stream.first,
                sum(count for _, _, count in spans),
                spans[-1][1] - spans[0][0],
                len(spans),
                [f"note: {n}" for n in notes],
            )
    recording = read_trial(paths, vessel, **(reader or {}))
    fixed: tuple[str, ...] = ()
    left: list[str] = []
    if fix or fix_also:
        report = check_recording(recording, vessel)
        recording, fixed, left = repair(recording, vessel, report, also=fix_also)
    imported = _with_actuators(import_recording(recording, vessel, options), recording, vessel)
    write_log(imported.segments, out, extra=extra)
    first, last = imported.segments[0], imported.segments[-1]
    return _summary(
        first,
        sum(len(s) for s in imported.segments),
        float(last.t[-1] - first.t[0]),
        len(imported.segments),
        [f"note: {n}" for n in imported.notes]
        + [f"mended: {n}" for n in fixed]
        + [f"left as it is: {n}" for n in left],
    )


def _with_actuators(imported: Imported, recording: Recording, vessel: Vessel) -> Imported:
    """Return the segments with what command and feedback tell of the actuators."""
    actuators, _, _ = measure_actuators([derive_signals(recording)], vessel)
    if not actuators:
        return imported
    segments = tuple(
        replace(s, provenance=replace(s.provenance, actuators=actuators)) for s in imported.segments
    )
    told = tuple(f"actuator: {a.sentence}" for a in actuators)
    return replace(imported, segments=segments, notes=(*imported.notes, *told))


def _keep_sources(paths: Sequence[str | Path], out: str | Path) -> None:
    """Refuse to write the log over a raw file: it could not be imported again."""
    targets = {Path(out).resolve(), record_path(out).resolve()}
    for path in paths:
        if Path(path).resolve() in targets:
            raise LogError(
                f"'{Path(path).name}' is also the log to write: name another file for the log."
            )


def _summary(
    first: TrialLog, samples: int, seconds: float, segments: int, lines: Sequence[str]
) -> str:
    return "\n".join(
        [
            f"{first.provenance.source}: {samples} samples of {first.sample_time:g} s, "
            f"{seconds:.6g} s, {segments} segment{'s' if segments > 1 else ''}",
            f"channels: {', '.join(first.channels)}",
            *lines,
        ]
    )
