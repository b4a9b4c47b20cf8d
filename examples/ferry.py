"""A real log: estimate on the first two thirds, run freely on the last.

Looks for the log in $GREYBOX_DATA (default ../shared/data) and stops where it is absent.
"""

import os
from pathlib import Path

import greybox as gb

path = Path(os.environ.get("GREYBOX_DATA", "../shared/data")) / "milliampere1/maneuvering1.csv"
if path.exists():
    log = gb.decimate(gb.read_log(path, gb.load_vessel("ferry")), 1.0)
    cut = 2 * len(log) // 3
    estimate = gb.estimate_model([log.window(0, cut)])
    print(estimate.summary())
    print(gb.run_model(estimate.model(), log.window(cut, len(log))).fit)
else:
    print(f"no log at {path}: set GREYBOX_DATA")
