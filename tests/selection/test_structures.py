"""Choice of structure: one-standard-error rule, criteria, reduction."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import statsmodels.api as sm
from virtual import PARAMETERS, virtual_log, write_csv

from greybox.commands.main import main
from greybox.errors import ExcitationError, UsageError
from greybox.estimation.informative import orders_logged, require_informative
from greybox.model.catalogue import get_structure, structure_for
from greybox.model.predictor import build_predictor
from greybox.model.predictor_kinds import PREDICTORS
from greybox.selection.alternatives import structures_to_try
from greybox.selection.estimate import estimate_requested
from greybox.selection.fit_single import estimate_once
from greybox.selection.held_out import folds, rank, score_runs, spread_of
from greybox.selection.reduction import (
    _step,
    bias_terms_without_current,
    least_earning,
    reduce_structure,
    wald,
)
from greybox.selection.request import Request
from greybox.selection.structures import CandidateFit, compare_structures
from greybox.study.chapter7 import REDUCED_BIASES
from greybox.trial.log import TrialLog, make_log
from greybox.validation.criteria import independent_samples, information_criteria
from greybox.validation.fit import run_model
from greybox.vessel.force import force_inputs
from greybox.vessel.toml import vessel_from_dict
from greybox.vessel.vessel import Actuation

ABSENT = ("Xkappa", "Yvr", "Nvv", "Wvv", "Wuv")
STRONG = {"Xvr", "Xmu", "Yur", "Ymu", "Nr", "Nmu"}
LS = Request(method="ls", predictor="basic+wind", structure="thesis")


@pytest.fixture(scope="module")
def quiet():
    """Little noise and steady wind: least squares is nearly consistent."""
    return virtual_log(
        3, 1500, current=(0.0, 0.0), noise=0.05, spread=0.0, wind_spread=1e-3, without=ABSENT
    )


def test_one_standard_error_rule_on_a_table():
    # differences to the first: 1 ± 0 and 2, 0, 4, 2 with mean 2 and standard error 0.816
    scores = [
        np.array([50.0, 60.0, 70.0, 80.0]),
        np.array([49.0, 59.0, 69.0, 79.0]),
        np.array([48.0, 60.0, 66.0, 78.0]),
        np.array([30.0, 80.0, 50.0, 90.0]),
        None,
    ]
    found = rank(scores, [9, 8, 7, 6, 1])
    np.testing.assert_allclose(found.score, [65, 64, 63, 62.5, -np.inf])
    np.testing.assert_allclose(found.behind[:4], [0, 1, 2, 2.5])
    gap = np.array([20.0, -20.0, 20.0, -10.0])
    np.testing.assert_allclose(found.se[:4], [0, 0, np.sqrt(8 / 3 / 4), gap.std(ddof=1) / 2])
    assert (found.best, found.chosen) == (0, 3)
    # without the one that scatters, no smaller one is near enough
    assert rank(scores[:3], [9, 8, 7]).chosen == 0
    # one part alone differs, so that the gap is its own standard error: rounding decides nothing
    for gap in (0.1, 0.3, 0.7):
        other = scores[0] - np.array([0.0, 0.0, gap, 0.0])
        assert rank([scores[0], other], [5, 4]).chosen == 1
    # equal ones: the smaller
    assert rank([scores[0], scores[0]], [5, 4]).chosen == 1
    with pytest.raises(UsageError, match="none of the 2 alternatives"):
        rank([None, None], [1, 2])


def test_criteria_are_those_of_statsmodels():
    rng = np.random.default_rng(1)
    x = sm.add_constant(rng.standard_normal((200, 3)))
    y = x @ [1.0, 0.5, 0.0, -2.0] + rng.standard_normal(200)
    fit = sm.OLS(y, x).fit()
    ours = information_criteria(np.asarray(fit.resid)[:, None], 4)
    np.testing.assert_allclose(ours, [fit.aic, fit.bic], rtol=1e-12)
    two = information_criteria(np.column_stack([fit.resid, fit.resid]), 8)
    assert two[0] == pytest.approx(2 * fit.aic)


def test_coloured_residuals_are_worth_fewer_samples():
    rng = np.random.default_rng(2)
    white = rng.standard_normal((20_000, 1))
    slow = np.zeros_like(white)
    for k in range(1, len(slow)):
        slow[k] = 0.8 * slow[k - 1] + white[k]
    # (1 − ρ) / (1 + ρ) of an autoregression; the standard error of the sum is some 5 %
    assert independent_samples([slow])[0] / len(slow) == pytest.approx(0.2 / 1.8, rel=0.15)
    assert independent_samples([white])[0] == pytest.approx(len(white), rel=0.05)


def test_folds_hold_out_every_sample_once(quiet):
    parts = folds([quiet, quiet.window(0, 333)], 4)
    held = np.concatenate([h[0].t for _, h in parts])
    np.testing.assert_array_equal(held, quiet.t)
    assert [len(f) for f, _ in parts] == [2, 4, 4, 2]
    assert all(sum(len(x) for x in f) + sum(len(x) for x in h) == 1833 for f, h in parts)
    with pytest.raises(UsageError, match="5 parts of 9"):
        folds([quiet.window(0, 48)], 5)


def test_scores_of_blocks_average_the_whole(quiet):
    model = estimate_requested([quiet], LS).model()
    run = run_model(model, quiet)
    spread = spread_of([quiet], ("u", "v", "r"))
    whole = score_runs([run], spread)
    error = np.sqrt(((quiet.states(("u", "v", "r")) - run.x) ** 2).mean(axis=0))
    want = np.mean([100 * (1 - e / s) for e, s in zip(error, spread.values(), strict=True)])
    assert whole[0] == pytest.approx(want)
    assert score_runs([run], spread, 6).shape == (6,)


def test_least_earning_columns_are_jointly_insignificant(quiet):
    estimate = estimate_requested([quiet], LS)
    found = least_earning(estimate)
    # all at once, then half of it, down to one
    sizes = [len(c.columns) for c in found]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] == 1
    names = [estimate.predictor.columns[i].name for i in found[0].columns]
    assert set(names) <= set(ABSENT) | {"Xuu", "Wuu", "Yvv", "Nuv"}
    i = found[-1].columns[0]
    z = estimate.theta[i] / estimate.std[i]
    from scipy.stats import norm

    assert wald(estimate, [i]) == pytest.approx(2 * norm.sf(abs(z)))
    assert all(estimate.predictor.columns[c].name not in STRONG for c in found[0].columns)


@pytest.mark.long
def test_what_the_ship_lacks_is_left_out(quiet):
    choice = reduce_structure([quiet], LS)
    kept = set(choice.estimate.names)
    assert kept >= STRONG
    assert len(kept & set(ABSENT)) <= 1
    assert choice.rows[0].dropped == ()
    assert sum(r.chosen for r in choice.rows) == 1
    chosen = next(r for r in choice.rows if r.chosen)
    assert chosen.structure.startswith("thesis-")
    assert chosen.parameters == len(kept)
    assert get_structure(chosen.structure).parameters == choice.estimate.names
    assert "held-out" in choice.summary()
    assert any("within one standard error of the best" in n for n in choice.estimate.notes)


@pytest.mark.long
def test_comparison_prefers_the_smaller_of_equals(quiet):
    smaller = "thesis-" + "-".join(ABSENT)
    names = ["thesis", smaller, smaller + "-Xvr"]
    choice = compare_structures([quiet], names, LS)
    assert [r.structure for r in choice.rows] == names
    assert choice.estimate.predictor.structure.name == smaller
    full, small, wrong = choice.rows
    assert small.chosen
    assert small.bic < full.bic
    assert wrong.aic > full.aic + 100
    assert wrong.behind > 3 * wrong.se


def test_comparison_refuses_what_cannot_be_compared(quiet):
    with pytest.raises(UsageError, match="1 structures are named"):
        compare_structures([quiet], ["thesis"], LS)
    with pytest.raises(UsageError, match="compare structures of the same states"):
        compare_structures([quiet], ["thesis", "surge"], LS)
    with pytest.raises(UsageError, match="use longer logs"):
        compare_structures([quiet.window(0, 90)], ["thesis", "linear"], LS)
    still = {**quiet.channels, **{c: 0 * quiet[c] + 1 for c in quiet.vessel.commands}}
    from greybox.trial.log import make_log

    with pytest.raises(ExcitationError, match="cannot be estimated on 4 of 5 parts"):
        reduce_structure([make_log(quiet.vessel, still, 1.0)], LS)


def test_reduced_predictors_of_the_thesis_are_candidates():
    """(7.1)-(7.3) keep some of the columns that the derivation gives, up to their spelling."""
    regime = (("u", (1,)), ("v", (1,)), ("r", (1, -1)))
    predictor = build_predictor(get_structure("thesis"), "augmented", regime)
    candidates = {f"{c.state}:{c.name}" for c in predictor.columns if c.is_bias}
    assert set(REDUCED_BIASES) <= candidates


@pytest.mark.long
def test_commands_choose_a_structure(quiet, tmp_path, capsys):
    trial, out = write_csv(quiet, tmp_path / "a.csv"), tmp_path / "m.json"
    base = ["estimate", str(trial), "--vessel", "thesis", "--method", "ls",
            "--predictor", "basic+wind", "--out", str(out)]  # fmt: skip
    assert main([*base, "--compare-structures", "thesis", "linear"]) == 0
    assert "Structures by free runs" in capsys.readouterr().out
    rows = json.loads(out.read_text())["structure_choice"]
    assert [r["structure"] for r in rows] == ["thesis", "linear"]
    assert {"parameters", "score", "se", "aic", "bic", "chosen"} <= set(rows[0])
    assert main([*base, "--structure", "thesis", "--reduce"]) == 0
    rows = json.loads(out.read_text())["structure_choice"]
    assert rows[0]["dropped"] == []
    assert sum(r["chosen"] for r in rows) == 1
    assert main([*base, "--structure", "linear", "--compare-structures", "thesis"]) == 1
    assert "name all structures to compare there" in capsys.readouterr().err


@pytest.mark.long
def test_reduction_drops_what_is_absent_and_never_what_is_strong():
    absent, runs = 0, 4
    for seed in range(runs):
        log = virtual_log(seed, 1200, wind=1.0, spread=0.0, without=ABSENT)
        request = Request(method="oe", predictor="wind", structure="thesis")
        kept = set(reduce_structure([log], request).estimate.names)
        assert kept >= STRONG
        absent += len(set(ABSENT) - kept)
    assert absent > 0.7 * runs * len(ABSENT)


def _in_wind_alone(seed: int, current: tuple[float, float] = (0.0, 0.0)) -> list[TrialLog]:
    return [
        virtual_log(seed + k, 2500, current=current, wind=1.0, spread=0.0, wind_spread=0.5)
        for k in range(2)
    ]


@pytest.mark.long
@pytest.mark.parametrize("predictor", ["wind", "augmented"])
def test_without_a_current_the_reduced_predictors_of_the_thesis_are_left(predictor):
    """What (7.1)-(7.6) keep follows from the derivatives alone, and the joint test agrees."""
    found = {}
    for current in ((0.0, 0.0), (0.2, -0.2)):
        logs = _in_wind_alone(20, current)
        structure = structure_for("thesis", force_inputs(logs[0].vessel))
        request = Request(method="iv", predictor=predictor, structure="thesis")
        estimate = estimate_once(logs, structure, "iv", predictor, request)
        found[current] = bias_terms_without_current(estimate)
    (still,) = found[0.0, 0.0]
    columns = estimate.predictor.columns
    left = {f"{c.state}:{c.name}" for i, c in enumerate(columns)
            if c.is_bias and i not in still.columns}  # fmt: skip
    # section 7.2 says why it put cos, sin for |v| cos, |v| sin: (7.2) as the theory has it
    theory = {b.replace("v:cos(", "v:v*cos(").replace("v:sin(psi", "v:v*sin(psi")
              for b in REDUCED_BIASES}  # fmt: skip
    assert left == (theory if predictor == "augmented" else set())
    assert still.p_value > 0.01
    assert found[0.2, -0.2] == []


@pytest.mark.long
def test_a_reduction_without_a_current_ends_at_the_equations_of_the_thesis():
    """(7.4)-(7.6): the terms with the wind's, and nothing that captures a bias."""
    request = Request(method="iv", predictor="wind", structure="thesis")
    choice = reduce_structure(_in_wind_alone(20), request)
    predictor = choice.estimate.predictor
    assert not predictor.augmented
    # a term may be lost where it earns nothing, none of another kind may come
    assert set(PARAMETERS) - set(choice.estimate.names) <= {"Wuv"}
    assert "u:cos(psi)" in choice.rows[1].dropped


def test_what_was_refused_together_is_not_tried_together_again():
    logs = _in_wind_alone(20)[:1]
    request = Request(method="iv", predictor="wind", structure="thesis", covariance="white")
    structure = structure_for("thesis", force_inputs(logs[0].vessel))
    estimate = estimate_once(logs, structure, "iv", "wind", request)

    class Refusing:
        """Held-out runs in which whatever lacks a column runs badly."""

        def fit(self, request, *, full, dropped):
            return CandidateFit(request, estimate, np.zeros(5), None, dropped)

    tried = [CandidateFit(request, estimate, np.full(5, 80.0), None)]
    assert _step(Refusing(), tried, tried[0], set()) is None
    together = [
        t for t in tried if len(t.dropped) == len(bias_terms_without_current(estimate)[0].columns)
    ]
    assert len(together) == 1
    assert together[0].note == "kept: held-out runs miss it"
    # its columns were tried one by one after it
    assert any(len(t.dropped) == 1 for t in tried)


def test_propellers_to_both_sides_that_turn_alike_have_no_moment_to_estimate():
    rows = [
        {"type": "propeller_rudder", "x": -10.0, "y": y, "speed": "n", "rudder": "delta"}
        for y in (-1.8, 1.8)
    ]
    vessel = vessel_from_dict({"name": "Twin", "length": 30.0, "thruster": rows})
    single = vessel_from_dict({"name": "One", "length": 30.0, "thruster": rows[:1]})
    rng = np.random.default_rng(0)
    hold = np.repeat(rng.uniform(-0.5, 0.5, 60), 10)
    channels = {n: 1.0 + 0.1 * rng.standard_normal(600) for n in ("u", "v", "r", "psi")}
    channels["psi"] = np.linspace(0, 20, 600)
    channels |= {"n": np.repeat(rng.uniform(3, 6, 60), 10), "delta": hold}
    log = make_log(vessel, channels, 1.0)
    names = structures_to_try([log], wind=False)
    assert [name.partition("-")[0] for name in names] == ["thesis", "linear"]
    for name in names:
        left = structure_for(name, force_inputs(vessel))
        assert not any(f.signal == "taun" for t in left.terms for f in t.factors)
        require_informative([log], PREDICTORS["basic"], left)
    # alone, or apart in speed, they have one
    apart = make_log(single, channels, 1.0)
    assert structures_to_try([apart], wind=False) == ["thesis", "linear"]


def test_columns_that_jump_faster_than_their_rate_hold_orders():
    row = {"type": "azimuth", "speed": "n", "angle": "a", "angle_rate": 0.35, "speed_rate": 8.0}
    vessel = vessel_from_dict({"name": "Boat", "length": 6.0, "thruster": [row]})
    angle = np.repeat([0.0, 0.5, -0.5, 0.2], 20)
    speed = np.linspace(4, 20, 80)
    motion = {n: np.ones(80) for n in ("u", "v", "r", "psi")}
    log = make_log(vessel, motion | {"a": angle, "n": speed}, 0.5)
    (said,) = orders_logged([log])
    assert said.startswith(
        "moved faster than the vessel file lets them: a (2 per second, its rate is 0.35). Such"
    )
    ramp = make_log(vessel, motion | {"a": np.linspace(-0.5, 0.5, 80), "n": speed}, 0.5)
    assert orders_logged([ramp]) == []
    lagging = replace(vessel, actuation=Actuation(lag=1.0))
    assert orders_logged([replace(log, vessel=lagging)]) == []
