"""`greybox import`: raw files of one trial become one log."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from greybox.commands.common import (
    VESSEL_HELP,
    by_name,
    is_named,
    positive,
    progress,
    provenance,
    require_log_ending,
    say,
    show_next,
)

if TYPE_CHECKING:
    from greybox.commands.time_left import Stage
    from greybox.trial.convert.options import ImportOptions

HELP = "convert raw files to logs: CSV, Parquet, NMEA 0183, MATLAB, ROS bags, MCAP"
EXAMPLES = """examples:
  greybox import trial.nmea --vessel ship.toml --out trial.csv
  greybox import gnss.nmea thrusters.csv --vessel ship.toml --sample-time 0.5 --out trial.parquet
  greybox import raw.csv --vessel ship.toml --fix --out trial.csv --note draught="1.2 m"
  greybox import raw.csv --vessel ship.toml --smooth r=2 --smooth psi=1 --out trial.csv
  greybox import trials/*.csv --vessel ship.toml --fix --out logs/

Files of one trial are merged on their clocks; where --out is a folder, each file becomes a log.
Columns are found by the vessel file's [columns], by canonical name, or guessed; every guess is
stated. Gaps stay gaps.

A vessel file, such as ship.toml, needs name, length and thrusters; [columns] says what the raw
files call a column, and in which unit it is. docs/vessel.md has the other keys:

  name = "My ship"
  length = 8.0                          # m
  [[thruster]]
  type = "propeller_rudder"             # or azimuth (angle in place of rudder), fixed, tunnel
  x = -3.5                              # m from the origin of the velocities, forward positive
  speed = "n"                           # the log's columns
  rudder = "delta"
  [columns]
  "Shaft RPM" = "n"
  "Rudder angle" = { name = "delta", unit = "deg" }
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "raw",
        nargs="+",
        metavar="RAW",
        help="raw files of one trial; where --out is a folder, each file is a trial; a folder "
        "stands for the CSV and Parquet files in it",
    )
    parser.add_argument("--vessel", required=True, metavar="V", help=VESSEL_HELP)
    parser.add_argument(
        "--out",
        required=True,
        metavar="LOG",
        help="the log to write, .csv or .parquet; or a folder, in which each raw file becomes a "
        "log and --fix judges them together",
    )
    parser.add_argument(
        "--sample-time",
        type=positive,
        metavar="S",
        help="sample time of the log [s]; by default that of the slowest motion sensor",
    )
    parser.add_argument(
        "--hole",
        type=positive,
        metavar="S",
        help="longest time without samples that is interpolated [s], longer ones are gaps; by "
        "default 2.5 usual steps of the sensor",
    )
    parser.add_argument(
        "--fix", action="store_true", help="mend what greybox check finds, where that is safe"
    )
    parser.add_argument(
        "--fix-also",
        action="append",
        default=[],
        metavar="ID",
        help="mend this finding too although it needs your judgement, such as heading_bias",
    )
    parser.add_argument(
        "--fix-not",
        action="append",
        default=[],
        metavar="ID",
        help="leave this finding as it is although --fix would mend it (may be repeated)",
    )
    parser.add_argument(
        "--velocities",
        choices=("central", "savgol"),
        default="central",
        help="velocities from positions: central differences (3.57), or Savitzky-Golay (central)",
    )
    parser.add_argument(
        "--window",
        type=positive,
        default=2.0,
        metavar="S",
        help="window of Savitzky-Golay [s] (2)",
    )
    parser.add_argument(
        "--smooth",
        action="append",
        default=[],
        metavar="CHANNEL=S",
        help="smooth this channel by local polynomials over a window [s], before anything is "
        "derived from it; by default nothing is smoothed (may be repeated)",
    )
    parser.add_argument(
        "--reference-height",
        type=positive,
        metavar="M",
        help="convert the wind to this height [m] by the 1/7 power law; by default as measured",
    )
    parser.add_argument(
        "--origin",
        metavar="LAT,LON",
        help="latitude and longitude of x_n = y_n = 0 [deg]; by default the first position",
    )
    parser.add_argument(
        "--topic",
        action="append",
        default=[],
        metavar="TOPIC[=NAME]",
        help="topic of a bag to use, and the name of its signal or field=name,... (may be "
        "repeated)",
    )
    parser.add_argument(
        "--note",
        action="append",
        default=[],
        metavar="KEY=TEXT",
        help="a condition of the trial (draught, trim, loading, water_depth, sea_state), or a "
        "note in words (may be repeated)",
    )
    parser.add_argument("--json", metavar="F", help="write the record as JSON; - is stdout")


def stages(options: argparse.Namespace) -> list[Stage]:
    """Return the shares of the time that each stage usually takes."""
    if not (options.fix or options.fix_also):
        return [("", 10.0), ("logs made", 25.0)]
    return [("", 2.0), ("samples of", 10.0), ("axes", 60.0), ("wind", 25.0), ("logs made", 8.0)]


def run(options: argparse.Namespace) -> None:
    """Read, merge, mend, resample, write."""
    from pathlib import Path

    from greybox.errors import UsageError, suggestion
    from greybox.files import check_targets, write_json
    from greybox.report.next_steps import after_import
    from greybox.trial.checks.check import require_each_once
    from greybox.trial.import_files import import_files, is_folder, raw_files, targets
    from greybox.trial.readers.formats import has_topics
    from greybox.trial.store import read_record, record_path
    from greybox.vessel.conditions import UNITS
    from greybox.vessel.toml import load_vessel

    if options.fix_not and not (options.fix or options.fix_also):
        raise UsageError(
            f"--fix-not names {', '.join(options.fix_not)}, and nothing is mended without --fix or "
            f"--fix-also: add one of them, or leave --fix-not out."
        )
    raw = raw_files(options.raw)
    require_each_once(raw)
    topics = pairs(options.topic, "--topic", "TOPIC=NAME")
    if topics and not any(map(has_topics, raw)):
        raise UsageError(
            f"--topic names {', '.join(topics)}, and no raw file is a ROS bag or an MCAP "
            f"file: name the bag, or leave --topic out."
        )
    folder = is_folder(raw, options.out)
    logs = targets(raw, options.out) if folder else [Path(options.out)]
    if folder:
        check_targets(options.json)
    else:
        require_log_ending(options.out)
        check_targets(options.out, record_path(options.out), options.json)
    vessel = load_vessel(options.vessel)
    summary = import_files(
        raw,
        vessel,
        options.out,
        import_options(options),
        fix=options.fix,
        fix_also=tuple(options.fix_also),
        fix_not=tuple(options.fix_not),
        reader={"topics": topics} if topics else {},
        extra=provenance(options),
        progress=progress("logs made"),
    )
    records: list[Any] = [read_record(log) for log in logs]
    if options.json:
        write_json({"logs": records} if folder else records[0], options.json)
    if options.json != "-":
        say(summary)
        if (options.fix or options.fix_also) and "\nmended: " not in summary:
            say("mended: nothing, as the checks found nothing of what was to be mended")
        for option in _idle(options, records):
            say(f"note: {option} changed nothing, as {_NEEDS[option]}")
        for key in pairs(options.note, "--note"):
            if key not in UNITS and (near := suggestion(key, UNITS)):
                say(f"note: '{key}' is kept in words, as no condition.{near}")
        written = ", ".join(str(log) for log in logs)
        beside = "its record" if len(logs) == 1 else "their records"
        say(f"wrote {written} and {record_path(logs[0]).name if not folder else beside}")
        needed = ("psi", *vessel.commands)
        lacking = [c for c in needed if any(c not in r["units"] for r in records)]
        show_next([after_import(options.out, options.vessel, lacking)])


# options of what many logs lack, with what was not there where nothing was done
_NEEDS = {
    "--velocities savgol": "no velocity was made from positions",
    "--reference-height": "the log has no wind",
    "--origin": "no position came from latitude and longitude",
}


def _idle(options: argparse.Namespace, records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the options that acted on no log."""
    steps = {s["operation"] for r in records for s in r["steps"]}
    idle = {
        "--velocities savgol": options.velocities == "savgol" and "local_polynomials" not in steps,
        "--reference-height": options.reference_height is not None
        and not any("u_q" in r["units"] for r in records),
        "--origin": options.origin is not None and "tangent_plane" not in steps,
    }
    return [option for option, unused in idle.items() if unused]


def import_options(options: argparse.Namespace) -> ImportOptions:
    """Return the options of the import, checked."""
    from greybox.errors import LogError, UsageError
    from greybox.trial.convert.options import ImportOptions
    from greybox.vessel.conditions import Conditions

    try:
        Conditions.read(notes := pairs(options.note, "--note"))
    except LogError as error:
        raise UsageError(f"--note: {error}") from None
    if is_named(options, "window") and options.velocities != "savgol":
        raise UsageError(
            f"--window is {options.window:g} s, and --velocities {options.velocities} has none: "
            f"add --velocities savgol, or leave --window out."
        )
    return ImportOptions(
        sample_time=options.sample_time,
        max_gap=options.hole,
        velocities=options.velocities,
        window=options.window,
        reference_height=options.reference_height,
        origin=_origin(options.origin),
        notes=notes,
        smooth=_windows(options.smooth),
    )


def _windows(given: list[str]) -> dict[str, float]:
    from greybox.errors import UsageError

    windows = {}
    for channel, text in pairs(given, "--smooth", "CHANNEL=S").items():
        try:
            windows[channel] = positive(text)
        except ValueError:
            raise UsageError(
                f"--smooth {channel} has a window of '{text}', it must be a positive number of "
                f"seconds: write --smooth {channel}=2."
            ) from None
    return windows


def pairs(given: list[str], option: str, form: str = "KEY=TEXT") -> dict[str, str]:
    """Return KEY=TEXT options as a dictionary; a topic may stand alone.

    Raises
    ------
    UsageError
        There is no ``=``, or a key stands twice.
    """
    from greybox.errors import UsageError

    found = []
    for item in given:
        key, sign, text = item.partition("=")
        if not key.strip() or not (sign or option == "--topic"):
            raise UsageError(f"{option} {item} has no value: write {option} {form}.")
        found.append((key.strip(), text.strip()))
    return by_name(option, found)


def _origin(text: str | None) -> tuple[float, float] | None:
    from greybox.errors import UsageError

    if text is None:
        return None
    try:
        lat, lon = (float(x) for x in text.split(","))
    except ValueError:
        raise UsageError(
            f"--origin is '{text}', it must be latitude and longitude in degrees: "
            f"write --origin 63.44,10.42."
        ) from None
    if not (-90 <= lat <= 90 and -180 <= lon <= 360):
        raise UsageError(
            f"--origin is {lat:g}, {lon:g} deg, latitude must be within 90 and longitude within "
            f"360: write --origin LAT,LON."
        )
    return lat, lon
