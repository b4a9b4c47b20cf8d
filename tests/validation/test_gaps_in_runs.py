"""Fits and runs on logs with gaps."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from designs import thesis_model
from virtual import virtual_log, write_csv

from greybox.commands.main import main
from greybox.diagnosis.diagnose import DiagnosisOptions, diagnose
from greybox.diagnosis.ship import LogRun, Ship
from greybox.errors import UsageError
from greybox.estimation.output_error import OutputErrorOptions, estimate_oe
from greybox.estimation.output_setup import output_predictor
from greybox.estimation.refined import estimate_refined_iv
from greybox.model.catalogue import get_structure
from greybox.model.predictor import build_predictor
from greybox.model.run.changes import Change
from greybox.model.run.simulation import simulate
from greybox.regression.regression import build_regression
from greybox.selection.estimate import estimate_model
from greybox.selection.fit_single import estimate_iv, estimate_ls
from greybox.selection.request import Request
from greybox.selection.structures import compare_structures
from greybox.trial.log import make_log
from greybox.trial.segments import join_segments, split_segments
from greybox.validation.bands import predict_bands
from greybox.validation.comparison import compare, errors_ahead
from greybox.validation.fit import fit_percent, run_from, run_model
from greybox.vessel.toml import load_vessel

N = 400
GAP = slice(150, 180)
MEASURED = np.r_[0:150, 180:N]


@pytest.fixture(scope="module")
def log():
    return virtual_log(
        5, N, wind=0.0, current=(0.0, 0.0), spread=0.0, without=("Wuu", "Wvv", "Wuv")
    )


@pytest.fixture(scope="module")
def true_model():
    return replace(thesis_model(spread=0.01), vessel=load_vessel("thesis"))


@pytest.fixture(scope="module")
def gapped(log):
    channels = {n: a.copy() for n, a in log.channels.items()}
    for name in ("u", "v", "r", "psi"):
        channels[name][GAP] = np.nan
    return make_log(log.vessel, channels, 1.0, "gapped")


def test_changes_keep_their_time_behind_a_gap(log, true_model):
    model = replace(true_model, changes=(Change("Xmu", 0.5, 300.0),))
    start, tau = log.states(("u", "v", "r"))[0], log.forces(model.structure.inputs)
    run = simulate(
        model.structure, model.theta, start, tau[:-1], 1.0, psi=log["psi"], changes=model.changes
    )
    own = {n: run.x[0][:, i] for i, n in enumerate(("u", "v", "r"))}
    still = {n: a for n, a in log.channels.items() if n not in ("u_q", "v_q")}
    whole = replace(log, channels=still | own)
    joined = join_segments([whole.window(0, 100, "a"), whole.window(200, N, "b")], "gap")
    for ahead in errors_ahead(model, run_model(model, joined)).values():
        assert max(ahead.values()) < 1e-9
    later = split_segments(joined)[1]
    seen = run_from(model, later, np.array([50]), 60, first=200.0)[0]
    np.testing.assert_allclose(seen, run.x[0][250:311], atol=1e-9)


def test_all_horizons_are_told_whichever_log_comes_first(log, true_model):
    logs = [log.window(0, 30, "short"), log.window(30, N, "long")]
    found = compare({"true": true_model}, logs, bands=False).summary()
    told = [line for line in found.splitlines() if " s ahead" in line]
    assert [line.split()[1] for line in told] == ["10", "30", "60"]


def otherwise_bridged(log):
    """The same log with other numbers where nothing was measured."""
    channels = {n: a.copy() for n, a in log.channels.items()}
    for name, gap in log.missing.items():
        channels[name][gap] += 0.3
    return replace(log, channels=channels)


@pytest.mark.parametrize("method", ["ls", "iv", "refined", "oe"])
def test_no_fit_counts_what_was_not_measured(gapped, method):
    found = []
    for one in (gapped, otherwise_bridged(gapped)):
        if method == "oe":
            options = OutputErrorOptions(heading="input", search=False, covariance="white")
            predictor = output_predictor(get_structure("thesis"), "basic", ())
            start = build_predictor(get_structure("thesis"), "basic")
            begin = estimate_ls(start, [gapped], judged=False, covariance="white")
            found.append(estimate_oe(predictor, [one], start=begin, options=options))
            assert found[-1].kept == len(MEASURED)
        else:
            estimate = {"ls": estimate_ls, "iv": estimate_iv, "refined": estimate_refined_iv}[
                method
            ]
            predictor = build_predictor(get_structure("thesis"), "basic")
            quietly = {} if method == "refined" else {"judged": False}
            found.append(estimate(predictor, [one], covariance="white", **quietly))
            # the step into the gap and that out of it hold one measurement only
            assert found[-1].kept == N - 1 - 31
    np.testing.assert_allclose(found[0].theta, found[1].theta, rtol=1e-6)
    np.testing.assert_allclose(found[0].residual_std, found[1].residual_std, rtol=1e-6)


def test_augmented_rows_need_the_heading_too(log):
    channels = {n: a.copy() for n, a in log.channels.items()}
    channels["psi"][GAP] = np.nan
    one = make_log(log.vessel, channels, 1.0)
    kept = [
        build_regression(build_predictor(get_structure("thesis"), kind, regime), [one]).kept
        for kind, regime in (("basic", ()), ("augmented", (("u", (1,)), ("v", (1,)))))
    ]
    assert kept == [N - 1, N - 1 - 30]


def test_a_run_goes_on_where_motions_were_not_measured(log, gapped, true_model):
    whole, run = run_model(true_model, log), run_model(true_model, gapped)
    np.testing.assert_allclose(run.x, whole.x, atol=1e-12)
    want = fit_percent(log["u"][MEASURED], whole.x[MEASURED, 0])
    assert run.fit["u"] == pytest.approx(float(want))
    assert len(run.errors()) == len(MEASURED)
    assert run.to_pandas()["u_measured"].isna().sum() == 30


def test_a_run_begins_anew_after_missing_rows(log, true_model):
    parts = [log.window(0, 200), log.window(210, N)]
    joined = join_segments(parts, "two")
    run = run_model(true_model, joined)
    alone = [run_model(true_model, part) for part in parts]
    np.testing.assert_array_equal(run.x, np.concatenate([r.x for r in alone]))
    bands = predict_bands(true_model, joined, runs=40)
    assert bands.motion.shape == (2, N - 10, 3)
    assert np.isfinite(bands.motion).all()
    found = compare({"m": true_model}, joined, bands=False)
    (gap,) = found.to_dict()["models"][0]["logs"][0]["gaps"]
    assert (gap["run"], gap["samples"], gap["start"]) == ("begins anew", 10, 200.0)
    assert "a run begins anew after it" in found.summary()


def test_a_run_of_a_diagnosis_is_straight_across_a_gap(log, gapped, true_model):
    ship = Ship(true_model.theta, np.zeros(2), log.vessel)
    whole, run = (LogRun(true_model.structure, one, "euler") for one in (log, gapped))
    places = np.arange(2)
    shown = [r.run(ship, whole.start()) for r in (whole, run)]
    slopes = [r.columns(ship, s, places) for r, s in zip((whole, run), shown, strict=True)]
    for one, two in ((shown[0].y, shown[1].y), slopes):
        np.testing.assert_allclose(two[MEASURED], one[MEASURED], atol=1e-12)
        np.testing.assert_allclose(np.diff(two[149:181], 2, axis=0), 0, atol=1e-9)


@pytest.mark.parametrize(("first", "stop", "known"), [(160, 300, 180), (40, 170, 149)])
def test_a_part_of_a_log_may_begin_or_end_within_a_gap(gapped, true_model, first, stop, known):
    part = gapped.window(first, stop, "part")
    run = LogRun(true_model.structure, part, "euler")
    shown = run.run(Ship(true_model.theta, np.zeros(2), gapped.vessel), run.start())
    error = run.y - shown.y
    rows = part.missing["u"]
    assert 0 < rows.sum() < len(part)
    np.testing.assert_allclose(error[rows], np.tile(error[known - first], (rows.sum(), 1)))
    nothing = replace(part, missing=dict.fromkeys(part.missing, np.ones(len(part), bool)))
    run = LogRun(true_model.structure, nothing, "euler")
    shown = run.run(Ship(true_model.theta, np.zeros(2), gapped.vessel), run.start())
    np.testing.assert_array_equal(run.y, shown.y)


def test_a_short_log_is_diagnosed(log):
    found = diagnose(log.window(0, 150), options=DiagnosisOptions(causes=("current",)))
    assert found.verdict in ("none", "named", "unexplained")


def test_commands_say_what_they_do_with_gaps(log, tmp_path, true_model, capsys):
    true_model.save(tmp_path / "m.json")
    r, n = log["r"].copy(), log["n"].copy()
    r[GAP], n[300] = np.nan, np.nan
    path = str(write_csv(log, tmp_path / "trial.csv", r=r, n=n))
    out = str(tmp_path / "run.csv")
    assert main(["simulate", str(tmp_path / "m.json"), path, "--no-bands", "--out", out]) == 0
    said = capsys.readouterr().out
    assert "note: 'trial' lacks r in 1 stretch of 30 samples" in said
    assert "note: 'trial' has 1 gap in which inputs or rows are missing" in said
    assert f"free run of {N - 1} samples" in said
    model = str(tmp_path / "e.json")
    assert main(["estimate", path, "--vessel", "thesis", "--structure", "thesis", "--method", "ls",
                 "--predictor", "basic", "--out", model]) == 0  # fmt: skip
    notes = json.loads((tmp_path / "e.json").read_text())["notes"]
    assert [("lacks r" in n, "1 gap" in n) for n in notes[:2]] == [(False, True), (True, False)]


def test_a_single_log_with_gaps_is_estimated(log):
    joined = join_segments([log.window(0, 200), log.window(210, N)], "two")
    estimate = estimate_model(joined, method="ls", predictor="basic", structure="thesis")
    assert [one["samples"] for one in estimate.logs] == [200, 190]
    with pytest.raises(UsageError, match=r"no parameter 'XU'\. Did you mean 'Xu'"):
        estimate["XU"]


@pytest.mark.parametrize(("method", "prefilter"), [("ls", "none"), ("iv", "none"), ("iv", "noise")])
def test_a_single_sample_between_two_gaps_is_left_out(log, method, prefilter):
    parts = [log.window(0, 150), log.window(160, 161), log.window(170, N)]
    asked = {
        "method": method, "prefilter": prefilter, "predictor": "basic", "structure": "thesis",
        "seed": 0,
    }  # fmt: skip
    estimate = estimate_model(join_segments(parts, "three"), **asked)
    assert [one["samples"] for one in estimate.logs] == [150, 230]


def test_structures_are_compared_on_logs_with_a_short_piece(log):
    pieces = [log.window(0, 200), log.window(205, 210), log.window(215, N)]
    choice = compare_structures(
        [join_segments(pieces, "three")],
        ["linear", "thesis"],
        Request(method="ls", predictor="basic"),
    )
    assert all(np.isfinite(row.behind) for row in choice.rows)


def test_the_fit_of_an_estimate_is_that_of_its_log_however_short_its_segments(log):
    keep = np.r_[0:150, 153:157, 160:N]
    gapped = log.window(0, N, "gapped")
    gapped = replace(
        gapped,
        t=log.t[keep],
        channels={n: a[keep] for n, a in log.channels.items()},
        closed_loop=log.closed_loop[keep],
    )
    asked = {"method": "ls", "predictor": "basic", "structure": "linear"}
    estimate = estimate_model(gapped, **asked)
    run = run_model(estimate.model(), gapped)
    assert estimate.fit == pytest.approx(run.fit, rel=1e-9)
    both = estimate_model([gapped, log], **asked)
    fits = [run_model(both.model(), part).fit for part in (gapped, log)]
    samples = [len(gapped), len(log)]
    mean = {s: np.average([f[s] for f in fits], weights=samples) for s in "uvr"}
    assert both.fit == pytest.approx(mean, rel=1e-9)
