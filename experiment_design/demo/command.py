"""`greybox demo`: the whole loop on a virtual ship, with a page at its end."""

from __future__ import annotations

import argparse
import logging
import textwrap

from greybox.commands.common import add_seed, provenance, say, tell_drawing
from greybox.commands.time_left import Stage

HELP = "run the whole loop on a virtual ship: design, sail, estimate, diagnose, extend, redesign"
EXAMPLES = """examples:
  greybox demo --open
  greybox demo --effect current --seed 3 --out mydemo
"""
_WIDTH = 92
_log = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--out", default="greybox-demo", metavar="DIR", help="folder of its files (greybox-demo)"
    )
    parser.add_argument(
        "--effect",
        default="thruster_lag",
        metavar="ID",
        help="effect on the ship that its model lacks: current, thruster_lag, "
        "input_delay, quadratic_thrust, cubic_damping, lever_arm, heading_bias or waves "
        "(thruster_lag)",
    )
    parser.add_argument("--open", action="store_true", help="open the page when it is done")
    add_seed(parser)


def stages(options: argparse.Namespace) -> list[Stage]:
    """Return the shares of the time that each stage usually takes."""
    return [
        ("", 1.0), ("designing the first trial", 21.0), ("sailing", 3.0), ("checking the log", 3.0),
        ("estimating", 2.0), ("log checks", 8.0), ("model without causes", 6.0),
        ("designing the next trial", 28.0), ("drawing the page", 10.0),
    ]  # fmt: skip


def run(options: argparse.Namespace) -> None:
    """Go round the loop and write the page."""
    from experiment_design.demo.loop import run_demo
    from experiment_design.demo.page import demo_page
    from experiment_design.demo.steps import Step
    from greybox.numerics.threads import one_thread
    from greybox.report.page import write_page

    count = 0

    def tell(step: Step) -> None:
        nonlocal count
        count += 1
        lines = [f"{count}. {step.title}"]
        if step.command:
            lines.append(f"   $ {step.command}")
        lines += [
            textwrap.fill(t, _WIDTH, initial_indent="   ", subsequent_indent="   ")
            for t in step.told
        ]
        say("\n".join(lines))

    with one_thread():
        demo = run_demo(
            options.out, effect=options.effect, seed=options.seed, tell=tell, progress=_log.info
        )
        tell_drawing()
        report = demo.files.report
        record = provenance(options) | {"files": demo.files.hashes()}
        write_page(demo_page(demo, record), report)
    say(f"wrote {report} and the files of each step beside it")
    if options.open:
        import webbrowser

        webbrowser.open(report.resolve().as_uri())
