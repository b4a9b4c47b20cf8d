"""Logs as pandas frames and xarray datasets, and results as tables."""

import numpy as np

import greybox as gb
from greybox.study.blind import draw

trial = draw(np.random.default_rng(4), samples=900)
log, vessel = trial.estimation, trial.vessel

# out, with units; whatever pandas can do; and in again as the same log
frame = log.to_pandas()
print(frame.describe().loc[["min", "mean", "max"]].T, frame.attrs["units"], sep="\n")
assert np.array_equal(gb.log_from_pandas(frame, vessel)["u"], log["u"])

# a frame of other make: degrees and knots, said in attrs; time of day as the index
other = frame.assign(psi=np.degrees(frame["psi"]), u=frame["u"] * 3600 / 1852)
other.index = np.datetime64("2024-05-01T12:00") + (frame.index * 1e9).astype("timedelta64[ns]")
other.attrs = {"units": {"psi": "deg", "u": "kn"}}
print(gb.log_from_pandas(other, vessel, name="other"))

estimate = gb.estimate_model(log, method="ls", predictor="basic")
print(estimate.to_pandas().round(4))
run = gb.run_model(estimate.model(), trial.validation)
print(run.to_pandas()[["u", "u_measured"]].head())
