"""Estimates from sums of segments are those from all samples at a time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from virtual import virtual_log

from greybox.errors import ExcitationError, LogError, UsageError
from greybox.estimation.normal_equations import Sums, solve_stacked
from greybox.estimation.solve import _structure_theta, solve_iv, solve_ls
from greybox.estimation.streamed import _Passes, estimate_sums, solve_sums
from greybox.estimation.values import EstimationData
from greybox.model.predictor import build_predictor
from greybox.regression.problem import RegressionProblem, RegressionSettings
from greybox.trial import stream as streams
from greybox.trial.convert.read import read_segments
from greybox.trial.log_files import LogFile, find_logs
from greybox.trial.readers.parquet import ParquetFile
from greybox.trial.store import write_log
from greybox.trial.stream import open_stream

REGIME = (("u", (1,)), ("v", (1,)), ("r", (1, -1)))


def rows(rng, n, p=4):
    z = rng.standard_normal((p, n))
    phi = z + 0.3 * rng.standard_normal((p, n))
    return z, phi, np.arange(1, p + 1) @ phi + 0.1 * rng.standard_normal(n)


def test_sums_solve_what_all_samples_do():
    z, phi, y = rows(np.random.default_rng(1), 5000)
    parts = [
        Sums.of(z[:, a : a + 700], phi[:, a : a + 700], y[a : a + 700]) for a in range(0, 5000, 700)
    ]
    found, whole = Sums.together(parts).solve(), solve_stacked([z], [phi], [y])
    np.testing.assert_allclose(found.theta, whole.theta, rtol=1e-11)
    np.testing.assert_allclose(found.information, whole.information, rtol=1e-10)
    np.testing.assert_allclose(found.singular_values, whole.singular_values, rtol=1e-11)


def test_scores_and_squares_are_those_of_the_samples():
    z, phi, y = rows(np.random.default_rng(2), 900)
    sums = Sums.of(z, phi, y)
    found = sums.solve()
    weights = sums.combination(found)
    error = y - found.theta @ phi
    projected = weights @ z
    np.testing.assert_allclose(projected @ phi.T, found.information, rtol=1e-9)
    half = Sums.of(z[:, :400], phi[:, :400], y[:400])
    score, moments = half.scores(weights, found.theta)
    np.testing.assert_allclose(score, projected[:, :400] @ error[:400], atol=1e-9)
    np.testing.assert_allclose(moments, projected[:, :400] @ projected[:, :400].T, rtol=1e-9)
    assert sums.squares(found.theta, centred=False) == pytest.approx(float(error @ error))
    assert sums.squares(found.theta, centred=True) == pytest.approx(900 * float(error.var()))


def test_without_instruments_the_sums_are_least_squares():
    _, phi, y = rows(np.random.default_rng(3), 900)
    expected = np.linalg.lstsq(phi.T, y, rcond=None)[0]
    np.testing.assert_allclose(Sums.of(None, phi, y).solve().theta, expected, rtol=1e-11)


def test_regressors_that_are_nearly_one_lose_no_digits():
    # their difference is 1e-7 of them: squared moments keep 2 of 16 digits of it
    rng = np.random.default_rng(4)
    first, other = rng.standard_normal((2, 40_000))
    phi = np.array([first, first + 1e-7 * other])
    y = np.array([1.0, 2.0]) @ phi
    parts = [
        Sums.of(phi[:, a : a + 9000], phi[:, a : a + 9000], y[a : a + 9000])
        for a in range(0, 40_000, 9000)
    ]
    theta = Sums.together(parts).solve().theta
    np.testing.assert_allclose(theta, [1.0, 2.0], rtol=1e-7)
    squared = np.linalg.solve(phi @ phi.T, phi @ y)
    assert np.abs(squared - [1.0, 2.0]).max() > 1e-4


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three days of one file each, the first with a gap, in Parquet."""
    where = tmp_path_factory.mktemp("stream")
    for k in range(3):
        log = virtual_log(k, 6000, wind=0.0, name=f"day{k}")
        parts = [log] if k else [log.window(0, 2500), log.window(2600, 6000)]
        write_log(parts, where / f"day{k}.parquet")
    return where


@pytest.fixture
def small(monkeypatch):
    """Read windows of 1500 rows."""
    monkeypatch.setattr(streams, "_LEAST_ROWS", 1500)
    monkeypatch.setattr(streams, "_MOST_ROWS", 1500)


@pytest.fixture
def whole(monkeypatch):
    """Read files of this size in one window."""
    monkeypatch.setattr(streams, "_LEAST_ROWS", 6000)


def opened(folder: Path, ship):
    return open_stream(find_logs([str(folder)]), ship)


def data(samples=0):
    return EstimationData(samples, samples)


def test_a_stream_of_whole_files_holds_the_segments_of_the_files(folder, ship, whole):
    stream, found = opened(folder, ship).run(len)
    logs = [s for f in find_logs([str(folder)]) for s in read_segments(f.path, ship)]
    assert [n for _, n in found] == [len(log) for log in logs]
    for log, own in zip(stream.read([p for p, _ in found]), logs, strict=True):
        assert log.name == own.name
        assert log.provenance == own.provenance
        assert all(np.array_equal(log[c], own[c]) for c in log.channels)


def test_windows_end_at_gaps_and_hold_every_row_once(folder, ship, small):
    stream, found = opened(folder, ship).run(_times)
    assert stream.files[0].cuts == (0, 1500, 2500, 4000, 5500, 5900)
    times = np.concatenate([t for p, t in found if p.file == 0])
    np.testing.assert_array_equal(times, np.delete(np.arange(6000.0), np.arange(2500, 2600)))


def _times(log):
    return log.t


def test_least_squares_of_a_stream_is_that_of_all_samples(folder, ship, thesis):
    predictor = build_predictor(thesis, "augmented", REGIME, intercept=True)
    stream = opened(folder, ship)
    _, found = stream.run(len)
    logs = tuple(stream.read([p for p, _ in found]))
    whole = solve_ls(RegressionProblem(predictor, logs, zero_mean=False)).estimate("cluster")
    problem = RegressionSettings(predictor, zero_mean=False)
    own = estimate_sums(problem, stream, data(), None).estimate
    np.testing.assert_allclose(own.theta, whole.theta, rtol=1e-8)
    np.testing.assert_allclose(own.residual_std, whole.residual_std, rtol=1e-9)
    assert own.samples == whole.samples


def test_one_segment_is_estimated_as_it_is_in_memory(folder, ship, thesis):
    # in memory every log has instruments of its own; of one log they are those of the stream
    predictor = build_predictor(thesis, "augmented", REGIME)
    stream = open_stream([LogFile(str(folder / "day1.parquet"))], ship)
    one = replace(stream, files=(replace(stream.files[0], cuts=(0, 6000), numbers=(0,)),))
    log = read_segments(folder / "day1.parquet", ship)
    expected = solve_iv(RegressionProblem(predictor, tuple(log)), refine=20)
    passes = estimate_sums_of(predictor, one, expected)
    np.testing.assert_allclose(passes, expected.theta, rtol=2e-3)


def estimate_sums_of(predictor, stream, expected):
    """One segment has no spread between segments, so only its equations are solved."""
    start = _structure_theta(predictor, expected.theta)
    sums = _Passes(RegressionSettings(predictor), stream).sums(start, "measured")
    return np.concatenate([s.theta for s in solve_sums(predictor, sums)])


def test_a_stream_solves_with_its_instruments_summed_over_all_segments(
    folder, ship, thesis, true_theta, small
):
    predictor = build_predictor(thesis, "augmented", REGIME)
    stream = opened(folder, ship)
    _, found = stream.run(len)
    logs = tuple(stream.read([p for p, _ in found]))
    sums = _Passes(RegressionSettings(predictor), stream).sums(true_theta, "measured")
    problem = RegressionProblem(predictor, logs)
    made = problem.instruments(true_theta)
    experiments = problem.regression.experiments
    for row, (state, solution) in enumerate(
        zip(thesis.states, solve_sums(predictor, sums), strict=True)
    ):
        mine = predictor.equation(state)
        z, phi = np.hstack([z[mine] for z in made.z]), np.hstack([e.phi[mine] for e in experiments])
        expected = solve_stacked([z], [phi], [np.concatenate([e.y[row] for e in experiments])])
        np.testing.assert_allclose(solution.theta, expected.theta, rtol=1e-7)


def test_standard_errors_are_about_those_in_memory(folder, ship, thesis, small):
    predictor = build_predictor(thesis, "augmented", REGIME)
    stream = opened(folder, ship)
    _, found = stream.run(len)
    logs = tuple(stream.read([p for p, _ in found]))
    expected = solve_iv(RegressionProblem(predictor, logs)).estimate("cluster")
    problem = RegressionSettings(predictor)
    own = estimate_sums(problem, stream, data(), expected.structure_theta()).estimate
    assert own.converged
    # the first move tells nothing of the next one
    assert own.iterations >= 2
    # a dozen segments tell a standard error to a fifth, and the median of forty better
    assert 0.7 < np.median(own.std / expected.std) < 1.4


def test_rows_in_memory_are_those_of_a_window(folder, ship, small, monkeypatch, limited):
    """Of what is read no more is held than a window and the batch that reaches beyond it."""
    limited(block_rows=500)
    given, held = 0, []
    read = ParquetFile.batches

    def counted(self, columns):
        nonlocal given
        for batch in read(self, columns):
            given += len(batch[columns[0]])
            yield batch

    def seen(log):
        nonlocal given
        held.append(given)
        given = 0
        return len(log)

    stream = opened(folder, ship)
    monkeypatch.setattr(ParquetFile, "batches", counted)
    monkeypatch.setattr(streams, "map_pieces", map)
    _, found = stream.run(seen)
    assert sum(n for _, n in found) == 17_900
    assert max(held) <= 1500 + 500


def test_a_file_that_vanishes_is_named_and_the_rest_is_estimated(
    folder, ship, thesis, tmp_path, whole
):
    for file in folder.glob("*.parquet"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    stream = opened(tmp_path, ship)
    (tmp_path / "day1.parquet").unlink()
    predictor = build_predictor(thesis, "augmented", REGIME, intercept=True)
    made = estimate_sums(RegressionSettings(predictor, zero_mean=False), stream, data(), None)
    assert made.estimate.samples == 11_897
    (told,) = made.sums.stream.left_out
    assert "day1.parquet" in told
    assert "its 6000 rows take no part" in told


def test_a_broken_file_is_left_out_by_the_index(folder, ship, tmp_path):
    whole = (folder / "day2.parquet").read_bytes()
    (tmp_path / "day2.parquet").write_bytes(whole)
    (tmp_path / "torn.parquet").write_bytes(whole[:-1000])
    stream = opened(tmp_path, ship)
    assert [f.file.name for f in stream.files] == ["day2.parquet"]
    assert stream.left_out[0].startswith("'torn.parquet' was left out: ")
    with pytest.raises(LogError, match=r"torn\.parquet"):
        open_stream([LogFile(str(tmp_path / "torn.parquet"))], ship)


def test_a_file_that_stands_twice_is_refused(folder, ship, tmp_path):
    for name in ("a.parquet", "b.parquet"):
        (tmp_path / name).write_bytes((folder / "day2.parquet").read_bytes())
    with pytest.raises(UsageError, match=r"'a\.parquet' and 'b\.parquet' hold the same 6000 rows"):
        opened(tmp_path, ship)


def test_one_segment_has_no_spread(folder, ship, thesis):
    predictor = build_predictor(thesis, "augmented", REGIME, intercept=True)
    stream = open_stream([LogFile(str(folder / "day1.parquet"))], ship)
    one = replace(stream, files=(replace(stream.files[0], cuts=(0, 6000), numbers=(0,)),))
    with pytest.raises(ExcitationError, match="the stream holds 1 segment"):
        estimate_sums(RegressionSettings(predictor, zero_mean=False), one, data(), None)


def test_a_stream_is_read_from_csv_too(folder, ship, tmp_path, small):
    log = read_segments(folder / "day1.parquet", ship)
    write_log(log, tmp_path / "day1.csv")
    stream, found = opened(tmp_path, ship).run(_times)
    assert len(found) == 4
    np.testing.assert_array_equal(np.concatenate([t for _, t in found]), log[0].t)
    (last,) = stream.read([found[-1][0]])
    np.testing.assert_array_equal(last.t, log[0].t[4500:])
