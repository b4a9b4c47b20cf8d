"""Each folder of real logs: import it, check it, say what is wrong and what is in it.

Looks for the logs in $GREYBOX_DATA (default ../shared/data); what is absent is passed over.
Name folders on the command line to do some of them only.
"""

import os
import sys
import tempfile
from pathlib import Path

import greybox as gb

DATA = Path(os.environ.get("GREYBOX_DATA", "../shared/data"))
PAIR = [[-948, -330], [-480, -80], [0, 0], [478, 135], [913, 425]]  # rpm, N

TRIALS = {
    "milliampere1": (
        {
            "name": "5 m ferry", "length": 5.0,
            "thruster": [
                {"type": "azimuth", "x": x, "y": y, "speed": f"rpm{i}", "angle": f"az{i}_deg",
                 "thrust": PAIR}
                for i, x, y in ((1, 1.8, -0.8), (2, 1.8, 0.8), (3, -1.8, 0.8), (4, -1.8, -0.8))
            ],
            "columns": {f"az{i}_deg": {"name": f"az{i}_deg", "unit": "deg"} for i in (1, 2, 3, 4)},
            "closed_loop": {"column": "mode", "values": ["dp"]},
        },
        ["maneuvering1.csv", "maneuvering1.nmea"],
    ),
    "esso_osaka": (
        {
            "name": "3 m tanker model", "length": 3.0, "mass": 244.6,
            "thruster": [
                {"type": "propeller_rudder", "x": -1.5, "speed": "n_prop [rps]",
                 "rudder": "delta_rudder [rad]"}
            ],
        },
        ["turn_14-Sep-2020_14_16_04.csv", "zigzag_31-Jul-2020_13_50_28.csv"],
    ),
    "blueboat": (
        {
            "name": "1.2 m catamaran", "length": 1.2, "mass": 15.0,
            "thruster": [
                {"type": "fixed", "y": y, "speed": f"{side}_force"}
                for side, y in (("left", -0.285), ("right", 0.285))
            ],
        },
        ["fixed_00000220.csv", "fixed_00000235.csv"],
    ),
    "kvlcc2": (
        {
            "name": "7 m tanker model", "length": 7.0,
            "thruster": [
                {"type": "propeller_rudder", "x": -3.5, "speed": "n_rps", "rudder": "delta_deg"}
            ],
            "columns": {"delta_deg": {"name": "delta_deg", "unit": "deg"}},
        },
        ["hsva_Z_20_05.csv"],
    ),
    "nmea": (
        {"name": "USV", "length": 2.0, "thruster": [{"type": "fixed", "speed": "n"}]},
        ["usv_202412051751.nmea", "usv_202412071021.nmea"],
    ),
}  # fmt: skip


def show(vessel, path, out):
    """Check one raw file, import it with the safe fixes, and check what came out."""
    (report,) = gb.check_files([path], vessel)
    print(report.summary())
    print(gb.import_files([path], vessel, out, fix=True))
    (after,) = gb.check_files([out], vessel)
    print(f"after the safe fixes: {', '.join(f.id for f in after.findings) or 'clean'}")
    print(gb.survey_recording(after.recording, vessel).summary() + "\n")


for folder in sys.argv[1:] or TRIALS:
    tables, names = TRIALS[folder]
    vessel = gb.vessel_from_dict(tables)
    for name in names:
        if (DATA / folder / name).exists():
            with tempfile.TemporaryDirectory() as scratch:
                show(vessel, DATA / folder / name, Path(scratch) / "trial.csv")
        else:
            print(f"no log at {DATA / folder / name}: set GREYBOX_DATA")
