"""Logs with gaps: motions that were not measured, and rows without inputs."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from virtual import virtual_log, write_csv

from greybox.errors import LogError
from greybox.rotation import body_to_ned
from greybox.trial.convert.options import ImportOptions
from greybox.trial.convert.read import read_log, read_segments
from greybox.trial.dataframe import log_from_pandas
from greybox.trial.import_files import import_files
from greybox.trial.kinematics import decimate
from greybox.trial.log import make_log
from greybox.trial.segments import find_log_gaps
from greybox.trial.store import write_log

N = 120


@pytest.fixture(scope="module")
def log():
    return virtual_log(2, N, name="trial")


def damaged(log, path, **gaps):
    """Write a log without the samples of the gaps, given as (first, stop) by channel."""
    lost = {}
    for name, (a, b) in gaps.items():
        lost[name] = log[name].copy()
        lost[name][a:b] = np.nan
    return write_csv(log, path / "trial.csv", **lost)


def lost(log, name):
    return np.flatnonzero(np.isnan(log.measured(name))).tolist()


def test_a_motion_that_was_not_measured_is_marked_and_bridged(log, tmp_path):
    found = read_log(damaged(log, tmp_path, r=(50, 60), psi=(70, 71)), log.vessel)
    assert len(found) == N
    assert lost(found, "r") == list(range(50, 60))
    assert lost(found, "psi") == [70]
    np.testing.assert_allclose(np.diff(found["r"][49:61], 2), 0, atol=1e-12)
    np.testing.assert_allclose(found["u"], log["u"])
    (r, psi) = find_log_gaps(found)
    assert (r.channels, r.count, r.samples, r.longest, r.start) == (("r",), 1, 10, 10.0, 50.0)
    assert "lacks r in 1 stretch of 10 samples" in r.sentence
    assert psi.to_dict()["run"] == "goes on"


def test_rows_without_inputs_or_wind_part_the_runs(log, tmp_path):
    path = damaged(log, tmp_path, n=(50, 52), u_q=(80, 81))
    one, two, three = read_segments(path, log.vessel)
    assert [len(s) for s in (one, two, three)] == [50, 28, 39]
    assert "3 of 120 rows left out, the first row 52, where n, u_q" in one.provenance.read[-1]
    with pytest.raises(LogError, match="2 gaps in its time"):
        read_log(path, log.vessel)
    whole = read_log(path, log.vessel, gaps=True)
    assert len(whole) == N - 3
    (gap,) = find_log_gaps(whole)
    assert (gap.channels, gap.count, gap.samples, gap.start) == ((), 2, 3, 50.0)
    assert gap.sentence.endswith("a run begins anew after each.")


def test_wind_that_is_hardly_there_is_none(log, tmp_path):
    found = read_log(damaged(log, tmp_path, u_q=(0, 90)), log.vessel)
    assert not found.has_wind
    assert len(found) == N


def test_a_sample_between_two_gaps_is_no_segment(log, tmp_path):
    path = damaged(log, tmp_path, n=(50, 52), alpha1=(53, 55))
    assert [len(s) for s in read_segments(path, log.vessel)] == [50, 65]


def test_a_log_begins_and_ends_where_its_motions_do(log, tmp_path):
    found = read_log(damaged(log, tmp_path, u=(0, 7), v=(110, N)), log.vessel)
    assert (found.t[0], found.t[-1], found.missing) == (7.0, 109.0, {})


def test_numbers_that_no_signal_has_are_none(log, tmp_path):
    u = log["u"].copy()
    u[30] = 1e300
    found = read_log(write_csv(log, tmp_path / "trial.csv", u=u), log.vessel)
    assert lost(found, "u") == [30]


def test_gaps_are_written_and_read_again(log, tmp_path):
    found = read_log(damaged(log, tmp_path, r=(50, 60)), log.vessel)
    write_log([found], tmp_path / "again.csv")
    assert lost(read_log(tmp_path / "again.csv", log.vessel), "r") == list(range(50, 60))
    assert lost(log_from_pandas(found.to_pandas(), log.vessel), "r") == list(range(50, 60))
    assert np.isnan(found.to_xarray()["r"].values).sum() == 10


def test_arrays_may_lack_motions_but_no_inputs(log):
    channels = {n: a.copy() for n, a in log.channels.items()}
    channels["v"][5:8] = np.nan
    assert lost(make_log(log.vessel, channels, 1.0), "v") == [5, 6, 7]
    channels["n"][5] = np.nan
    with pytest.raises(LogError, match="'n' is not finite at sample 5"):
        make_log(log.vessel, channels, 1.0)


def test_a_mean_is_measured_where_most_of_its_samples_are(log, tmp_path):
    found = decimate(read_log(damaged(log, tmp_path, r=(53, 60)), log.vessel), 5.0)
    assert found.t[np.isnan(found.measured("r"))].tolist() == [57.0]


def test_what_is_derived_of_a_gap_is_one(log, tmp_path):
    path = damaged(log, tmp_path, psi=(50, 52))
    table = read_log(path, log.vessel).to_pandas().drop(columns="r").reset_index()
    table.attrs.clear()
    found = log_from_pandas(table, log.vessel)
    assert found.t[np.isnan(found.measured("r"))].tolist() == [49.0, 50.0, 51.0, 52.0]


def test_single_headings_that_are_missing_cost_no_mean(log):
    psi = log["psi"].copy()
    psi[np.arange(N) % 5 == 2] = np.nan
    x, y = (np.cumsum(w) for w in body_to_ned(log["u"], log["v"], log["psi"]))
    channels = {n: log[n] for n in ("n", "alpha1", "alpha2")} | {"x_n": x, "y_n": y, "psi": psi}
    frame = pd.DataFrame({"t": log.t, **channels})
    found = log_from_pandas(frame, log.vessel)
    # turned by the heading of each sample alone, and differences of the positions of its neighbours
    assert set(lost(found, "u")) == set(lost(found, "psi"))
    assert len(lost(found, "r")) == 3 * len(lost(found, "psi"))
    slow = decimate(found, 5.0)
    assert slow.known(("u", "v", "r", "psi")).all()
    frame.loc[50:69, "psi"] = np.nan
    hole = decimate(log_from_pandas(frame, log.vessel), 5.0)
    assert not hole.known(("u",))[(hole.t > 52) & (hole.t < 67)].any()


def test_holes_of_positions_part_no_import(tmp_path, ship):
    t = np.arange(0, 60, 0.1)
    columns = {
        "t": t, "x_n": 2 * t, "y_n": 0 * t, "psi": 0 * t, "u": 2 + 0 * t, "v": 0 * t, "r": 0 * t,
        "n": 5 + 0 * t, "alpha1": 0 * t, "alpha2": 0 * t,
    }  # fmt: skip
    columns["x_n"][200:202] = np.nan
    rows = np.column_stack(list(columns.values()))
    np.savetxt(tmp_path / "raw.csv", rows, delimiter=",", header=",".join(columns), comments="")
    import_files([tmp_path / "raw.csv"], ship, tmp_path / "log.csv", ImportOptions())
    found = read_log(tmp_path / "log.csv", ship)
    assert len(found) == len(t)
    assert lost(found, "x_n") == [200, 201]
    assert find_log_gaps(found) == ()
