"""A raw log with a hole, degrees and an outlier: read, checked, mended, imported."""

import tempfile
from pathlib import Path

import numpy as np

import greybox as gb
from greybox.study.blind import draw

trial = draw(np.random.default_rng(2), samples=600)
raw = trial.estimation.to_pandas().reset_index()
raw["heading [deg]"] = np.degrees(raw.pop("psi")) % 360
raw.loc[200:219, "u"] = np.nan  # the velocity log was silent
raw.loc[300, "v"] = 40.0  # and sway has an outlier

with tempfile.TemporaryDirectory() as folder:
    path, out = Path(folder) / "raw.csv", Path(folder) / "trial.csv"
    raw.to_csv(path, index=False)
    (report,) = gb.check_files([path], trial.vessel)
    print(report.summary())
    print(gb.import_files([path], trial.vessel, out, fix=True))
    for segment in gb.read_segments(out, trial.vessel):
        print(segment.summary())
