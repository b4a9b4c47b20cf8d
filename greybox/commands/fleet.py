"""`greybox fleet`: many ships of one class, with one table."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from greybox.commands.common import (
    add_cluster,
    add_outputs,
    add_seed,
    drawn,
    progress,
    provenance,
    publish,
    require_ending,
)

if TYPE_CHECKING:
    from greybox.commands.time_left import Stage
    from greybox.report.page import Page

HELP = "estimate many ships of a class: what they share, which ship differs, what changes over time"
EXAMPLES = """examples:
  greybox fleet ferries --out ferries.csv --report ferries.html
  greybox fleet ferries --json ferries.json --cluster tcp://host:8786
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "fleet", metavar="DIR",
        help="folder with one sub-folder per ship, each with a vessel file (*.toml) and logs "
        "(CSV, Parquet) in the order of their dates or names",
    )  # fmt: skip
    parser.add_argument(
        "--out", metavar="CSV", help="write a table with a row for each coefficient of each ship"
    )
    add_outputs(parser, "the result", "plots")
    add_cluster(parser)
    add_seed(parser)


def _require_outside(options: argparse.Namespace) -> None:
    """Raise where an output would stand among the logs of a ship."""
    from greybox.errors import UsageError
    from greybox.files import real_path

    fleet = real_path(options.fleet)
    for name in ("out", "json", "report"):
        path = getattr(options, name)
        if path is not None and path != "-" and fleet in real_path(path).parent.parents:
            raise UsageError(
                f"--{name} names '{path}' in the folder of a ship, where it would be taken for one "
                f"of its files: name a file outside."
            )


def stages(options: argparse.Namespace) -> list[Stage]:
    """Return the shares of the time that each stage usually takes."""
    return [("", 35.0), ("ships", 45.0), *drawn(options, 20.0)]


def run(options: argparse.Namespace) -> None:
    """Estimate, pool, report."""
    from greybox.files import check_targets, sha256, write_text
    from greybox.fleet.fleet import estimate_fleet
    from greybox.fleet.ships import fleet_files
    from greybox.report.next_steps import after_fleet

    require_ending(options.out, ".csv", "the table")
    check_targets(options.out, options.json, options.report)
    _require_outside(options)
    fleet = estimate_fleet(options.fleet, seed=options.seed, progress=progress("ships"))
    record = provenance(options)
    record["inputs"] = {str(path): sha256(path) for path in fleet_files(options.fleet)}
    if options.out:
        import pandas as pd

        write_text(pd.DataFrame(fleet.rows()).to_csv(index=False), options.out)

    def page() -> Page:
        from greybox.report.fleet import fleet_page

        return fleet_page(fleet, record)

    told = fleet.to_dict() | {"provenance": record}
    publish(options, told, fleet.summary(), page, after_fleet(fleet, record), [options.out])
