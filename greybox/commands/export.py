"""`greybox export`: a model as C, FMU, CasADi, MATLAB or flat JSON."""

from __future__ import annotations

import argparse

from greybox.commands.common import say

HELP = "write a model as C, an FMU, CasADi functions, a MATLAB file or flat JSON"
EXAMPLES = """examples:
  greybox export model.json --to fmu --out ship.fmu
  greybox export model.json --to c --out ship.c
  greybox export model.json --to c --wind relative --heading measured --out ship.c
  greybox export model.json --to casadi --settled --out ship.casadi
"""
TARGETS = ("c", "fmu", "casadi", "mat", "json")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("model", metavar="MODEL", help="model file of estimate or diagnose")
    parser.add_argument("--to", required=True, choices=TARGETS, help="format to write")
    parser.add_argument("--out", required=True, metavar="F", help="file to write")
    parser.add_argument(
        "--heading",
        choices=("simulated", "measured"),
        help="whether the heading is a state (default, where the model has a yaw rate) or an "
        "input; an FMU has the parameter heading_measured instead",
    )
    parser.add_argument(
        "--wind",
        choices=("earth", "relative"),
        help="wind input over ground, north and east (default), or u_q, v_q through the air; "
        "an FMU has the parameter wind_measured instead",
    )
    parser.add_argument(
        "--settled",
        action="store_true",
        help="export the model as it is after the last change of its parameters",
    )
    parser.add_argument(
        "--no-binary",
        action="store_true",
        help="write an FMU of C source only, even where there is a compiler",
    )


def run(options: argparse.Namespace) -> None:
    """Read the model, write the files, show the ports."""
    from greybox.export.export import export_model
    from greybox.files import check_targets
    from greybox.model.model import load_model

    check_targets(options.out)
    exported = export_model(
        load_model(options.model),
        options.to,
        options.out,
        heading=options.heading,
        wind=options.wind,
        settled=options.settled,
        binary=not options.no_binary,
    )
    say(exported.summary())
