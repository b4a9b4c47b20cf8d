"""Importing raw files: read, merged or judged together, mended where asked, written as logs."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from greybox.errors import LogError, so_many
from greybox.files import check_targets, real_path
from greybox.trial.checks.actuators import measure_actuators
from greybox.trial.checks.check import check_recordings
from greybox.trial.checks.signal_quality import angle_unit_findings
from greybox.trial.convert.channel_mapping import read_trial
from greybox.trial.convert.convert import Imported, import_recording
from greybox.trial.convert.derived_signals import derive_signals
from greybox.trial.convert.options import ImportOptions
from greybox.trial.convert.two_pass_import import Stream, is_large
from greybox.trial.log import Provenance, TrialLog
from greybox.trial.log_files import ENDINGS, find_logs
from greybox.trial.raw_log import Recording
from greybox.trial.readers.formats import is_bag, open_raw
from greybox.trial.repair import check_ids, repair
from greybox.trial.store import record_path, write_log
from greybox.vessel.vessel import Vessel

# recordings of one trial are not so far apart [s]
_ANOTHER_TRIAL = 3600.0
_NOTE = "note: "


def raw_files(paths: Sequence[str]) -> list[str]:
    """Return the raw files that paths stand for: of a folder its logs, where it is no bag.

    Raises
    ------
    LogError
        A folder holds no CSV or Parquet file.
    """
    files: list[str] = []
    for path in paths:
        logs = Path(path).is_dir() and not is_bag(Path(path))
        files += [f.path for f in find_logs([path])] if logs else [path]
    return files


def import_files(
    paths: Sequence[str | Path],
    vessel: Vessel,
    out: str | Path,
    options: ImportOptions | None = None,
    *,
    fix: bool = False,
    fix_also: tuple[str, ...] = (),
    fix_not: tuple[str, ...] = (),
    reader: Mapping[str, Any] | None = None,
    extra: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> str:
    """Import raw files into one log, or each into a log of a folder.

    Parameters
    ----------
    paths : sequence of str or Path
        Raw files: of one trial, merged on their clocks; where `out` is a folder, each
        of a trial of its own.
    vessel : Vessel
    out : str or Path
        CSV or Parquet, its record is written beside it; or a folder, see `is_folder`, for one
        log a file, ``<stem>.csv``.
    options : ImportOptions
    fix : bool
        Whether to mend what the checks find and what is safe to mend. The logs of a
        folder are judged together: what belongs to the instruments is mended alike.
    fix_also : tuple of str
        Ids of findings to mend although they need judgement.
    fix_not : tuple of str
        Ids of findings to leave.
    reader : mapping, optional
        Handed to the readers, such as ``topics``.
    extra : mapping, optional
        More entries of the record.
    progress : callable
        Called with (done, total) logs that are written.

    Returns
    -------
    str
        What was read, guessed, derived and mended.

    Raises
    ------
    LogError
        A file cannot be read, or no log can be made of them; then nothing is written.
    """
    check_ids(fix_also, fix_not)
    options = options or ImportOptions()
    mending = fix or bool(fix_also)
    folder = Path(out) if is_folder(paths, out) else None
    if folder is None:
        trials = [(list(paths), Path(out))]
    else:
        trials = [([path], target) for path, target in zip(paths, targets(paths, out), strict=True)]
    for path in paths:
        _keep_source(path, [target for _, target in trials])
    summaries: list[str] = []
    with _all_or_none(folder, [target for _, target in trials]) as logs:
        if not mending:
            for (files, _), target in zip(trials, logs, strict=True):
                progress(len(summaries), len(logs))
                summaries.append(_import_trial(files, vessel, target, options, reader, extra))
        else:
            recordings = [read_trial(files, vessel, **(reader or {})) for files, _ in trials]
            reports = check_recordings(recordings, vessel)
            while recordings:
                progress(len(summaries), len(logs))
                recording, target = recordings.pop(0), logs[len(summaries)]
                mended, fixed, left = repair(
                    recording, reports[len(summaries)], also=fix_also, without=fix_not
                )
                lines = [f"mended: {n}" for n in fixed] + [f"left as it is: {n}" for n in left]
                summaries.append(_write(mended, vessel, target, options, extra, lines))
        progress(len(logs), len(logs))
    summaries = _shared_once(summaries)
    summaries += [f"note: {doubt}" for doubt in vessel.doubts]
    return "\n".join(summaries)


def _shared_once(summaries: Sequence[str]) -> list[str]:
    """Return summaries of several logs, of which the notes that all have are told once."""
    lines = [s.splitlines() for s in summaries]
    shared = [
        x for x in dict.fromkeys(lines[0]) if x.startswith(_NOTE) and all(x in y for y in lines)
    ]
    if len(lines) < 2 or not shared:
        return list(summaries)
    own = ["\n".join(x for x in each if x not in shared) for each in lines]
    return [*own, *(f"{_NOTE}all files: {x.removeprefix(_NOTE)}" for x in shared)]


def is_folder(paths: Sequence[str | Path], out: str | Path) -> bool:
    """Whether `out` names a folder: one that exists, ends in a slash, or has several files."""
    if Path(out).is_dir() or str(out).endswith(("/", os.sep)):
        return True
    return len(paths) > 1 and Path(out).suffix.lower() not in ENDINGS


def targets(paths: Sequence[str | Path], out: str | Path) -> list[Path]:
    """Return the log of each raw file in a folder.

    Raises
    ------
    LogError
        Two files would make one log.
    """
    found: dict[Path, str | Path] = {}
    for path in paths:
        target = Path(out) / f"{Path(path).stem}.csv"
        if target in found:
            raise LogError(
                f"'{found[target]}' and '{path}' would both become '{target}': rename one of "
                f"them, or import them into two folders."
            )
        found[target] = path
    return list(found)


@contextmanager
def _all_or_none(folder: Path | None, logs: Sequence[Path]) -> Iterator[list[Path]]:
    """Make a folder of logs, and yield where to write them: they are there once all are made."""
    if folder is None:
        yield list(logs)
        return
    if not folder.absolute().parent.is_dir():
        raise LogError(
            f"cannot make the folder '{folder}': there is no folder '{folder.parent}' to make it "
            f"in. Name a folder in one that exists."
        )
    made = not folder.exists()
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise LogError(
            f"cannot make the folder '{folder}': {error.strerror or error}. Name another folder, "
            f"or one log that ends in .csv or .parquet."
        ) from None
    try:
        check_targets(*logs, *map(record_path, logs))
        with TemporaryDirectory(prefix=".import-", dir=folder) as beside:
            yield [Path(beside) / log.name for log in logs]
            for path in sorted(Path(beside).iterdir()):
                path.replace(folder / path.name)
    except BaseException:
        if made:
            folder.rmdir()
        raise


def _import_trial(
    paths: Sequence[str | Path],
    vessel: Vessel,
    out: Path,
    options: ImportOptions,
    reader: Mapping[str, Any] | None,
    extra: Mapping[str, Any] | None,
) -> str:
    if len(paths) == 1 and Path(paths[0]).is_file():
        table = open_raw(paths[0], **(reader or {}))
        if not isinstance(table, Recording) and is_large(table):
            stream = Stream(table, vessel, options)

            @cache
            def provenance() -> Provenance:
                actuators, _, _ = measure_actuators([stream.moved], vessel)
                return replace(stream.provenance(), actuators=actuators)

            write_log(stream.segments(), out, extra=extra, provenance=provenance)
            assert stream.first is not None
            spans = stream.spans
            notes = [*provenance().read, *(s.sentence for s in stream.steps)]
            notes += [f"actuator: {a.sentence}" for a in provenance().actuators]
            return _summary(
                stream.first,
                sum(count for _, _, count in spans),
                spans[-1][1] - spans[0][0],
                len(spans),
                [f"note: {n}" for n in notes],
            )
    recording = read_trial(paths, vessel, **(reader or {}))
    # what no later step can tell from a large angle, or from a wrong column
    degrees = angle_unit_findings(recording, vessel)
    lines = [f"note: {f.evidence}; {f.fix}" for f in degrees]
    return _write(recording, vessel, out, options, extra, lines)


def _write(
    recording: Recording,
    vessel: Vessel,
    out: Path,
    options: ImportOptions,
    extra: Mapping[str, Any] | None,
    lines: list[str],
) -> str:
    imported = _with_actuators(import_recording(recording, vessel, options), recording, vessel)
    write_log(imported.segments, out, extra=extra)
    first, last = imported.segments[0], imported.segments[-1]
    apart = max((float(b.t[0] - a.t[-1]) for a, b in pairwise(imported.segments)), default=0.0)
    if len(recording.files) > 1 and apart > _ANOTHER_TRIAL:
        lines = [
            *lines,
            f"note: {len(recording.files)} files with {apart / 3600:.3g} h between them became one "
            f"log: if each is of a trial of its own, name a folder, such as --out {out.stem}/, to "
            f"write one log each",
        ]
    return _summary(
        first,
        sum(len(s) for s in imported.segments),
        float(last.t[-1] - first.t[0]),
        len(imported.segments),
        [f"note: {n}" for n in imported.notes] + lines,
    )


def _keep_source(path: str | Path, logs: Sequence[Path]) -> None:
    """Refuse to write a log over a raw file: it could not be imported again."""
    if real_path(path) in {real_path(p) for log in logs for p in (log, record_path(log))}:
        raise LogError(
            f"'{Path(path).name}' is also the log to write: name another file for the log."
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


def _summary(
    first: TrialLog, samples: int, seconds: float, segments: int, lines: Sequence[str]
) -> str:
    return "\n".join(
        [
            f"{first.provenance.source}: {so_many(samples, 'sample')} of {first.sample_time:g} s, "
            f"{seconds:.6g} s, {so_many(segments, 'segment')}",
            f"channels: {', '.join(first.channels)}",
            *lines,
        ]
    )
