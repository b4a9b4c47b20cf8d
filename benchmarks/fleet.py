"""Planted fleets: errors with and without pooling, and how often the odd ship is found.

    python -m benchmarks.fleet [--runs N] [--ships K ...] [--spreads S ...] [--odd D] [--seed N]

One row for each number of ships and spread between them: root mean squared errors in standard
errors of one ship, coverage of the 95 % intervals, and shares of fleets with intervals of Wilson.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from greybox.study.fleets import ODD, SHIPS, SPREADS, study_fleets

_HEAD = ("ships", "spread", "separate", "complete", "partial", "partial - separate",
         "partial - complete", "held", "false", "found", "named", "another")  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.fleet", description=__doc__.split("\n")[0]
    )
    parser.add_argument("--runs", type=int, default=100, help="fleets of each kind (100)")
    parser.add_argument("--ships", type=int, nargs="+", default=list(SHIPS))
    parser.add_argument("--spreads", type=float, nargs="+", default=list(SPREADS),
                        help="between ships, in standard errors of one")  # fmt: skip
    parser.add_argument("--odd", type=float, default=ODD,
                        help=f"deviations of the odd ship ({ODD:g})")  # fmt: skip
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    cells = study_fleets(given.runs, ships=given.ships, spreads=given.spreads,
                         deviation=given.odd, seed=given.seed)  # fmt: skip
    print(f"the odd ship differs by {given.odd:g} standard deviations in one coefficient")
    print(" | ".join(_HEAD))
    for cell in cells:
        held = sum(o.held for o in cell.outcomes) / len(cell.outcomes)
        row = [str(cell.ships), f"{cell.spread:g}", *(f"{e:.3f}" for e in cell.rmse())]
        row += ["{:.3f} to {:.3f}".format(*cell.gain(over)) for over in (0, 1)]
        row.append(f"{100 * held:.1f} %")
        for what in ("false", "found", "named", "also"):
            value, low, high = cell.share(what)
            row.append(f"{100 * value:.0f} % ({100 * low:.0f}-{100 * high:.0f})")
        print(" | ".join(row), flush=True)


if __name__ == "__main__":
    main()
