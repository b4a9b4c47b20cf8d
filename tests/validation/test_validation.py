"""Fit, comparison, choice, conversion."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from virtual import virtual_log

from greybox.errors import (
    ExcitationError,
    LogError,
    ModelFileError,
    StructureError,
    UsageError,
)
from greybox.estimation.informative import heading_range, regime_of
from greybox.estimation.solve import UnexcitedBiasError
from greybox.estimation.verdict import NoRegression, TrustLevel, refused
from greybox.model.catalogue import get_structure, structure_for
from greybox.model.conversion import (
    Inertia,
    check_ties,
    estimate_inertia,
    inertia_errors,
    to_continuous,
    to_prime,
)
from greybox.model.model import load_model, model_from_dict
from greybox.model.predictor import build_predictor
from greybox.report.next_steps import after_comparison
from greybox.selection.estimate import estimate_model
from greybox.selection.fit_single import estimate_iv, estimate_ls
from greybox.trial.log import make_log
from greybox.validation.comparison import compare, compare_each, sign_test
from greybox.validation.fit import LogFit, fit_on, fit_percent, mean_fit, run_model
from greybox.validation.gain import gain_over_stretches, stretch_effects


@pytest.fixture(scope="module")
def true_model(thesis_model):
    return thesis_model


@pytest.fixture(scope="module")
def thesis_model():
    log = virtual_log(1, 600, wind=0.0, current=(0.0, 0.0), noise=0.0, spread=0.0)
    predictor = build_predictor(get_structure("thesis"), "basic", (("u", (1,)), ("v", (1,))))
    return estimate_ls(predictor, [log]).model()


def test_fit_is_the_published_formula():
    y = np.array([1.0, 2.0, 4.0, 5.0])
    assert fit_percent(y, y) == 100
    assert fit_percent(y, np.full(4, 3.0)) == pytest.approx(0)
    want = 100 * (1 - np.linalg.norm([1, 0, 0, 0]) / np.linalg.norm(y - 3))
    assert fit_percent(y, y + np.array([1, 0, 0, 0])) == pytest.approx(want)
    assert fit_percent(np.ones(3), np.zeros(3)) == -np.inf


def test_a_true_model_runs_true(thesis_model, clean_log):
    fit = run_model(thesis_model, clean_log).fit
    assert min(fit.values()) > 90  # the start is the mean of five samples


def test_models_survive_their_file(thesis_model, tmp_path):
    path = tmp_path / "model.json"
    thesis_model.save(path)
    again = load_model(path)
    np.testing.assert_array_equal(again.theta, thesis_model.theta)
    np.testing.assert_array_equal(again.covariance, thesis_model.covariance)
    assert again.structure == thesis_model.structure
    assert again.sums == thesis_model.sums
    again.save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == path.read_bytes()
    data = json.loads(path.read_text())
    for key in ("theta", "std", "names", "units", "fit", "tests"):
        assert key in data
    assert len(data["theta"]) == len(data["names"]) == len(data["std"]) == len(data["units"])
    for test in data["tests"].values():
        assert {"statistic", "p_value", "sentence"} <= set(test)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "x"}, "is not a model file"),
        ({"version": 99}, "has version 99"),
        ({"theta": [1.0]}, "15 terms but 1 parameter:"),
        (
            {"disturbance_covariance": [[1.0]]},
            r"15 parameters and 0 disturbances, but a covariance between them of shape \(1, 1\)",
        ),
        ({"vessel": {}}, "damaged model file"),
        ({"structure": {"name": 3}}, "damaged model file"),
    ],
)
def test_bad_model_files(thesis_model, change, message):
    with pytest.raises(ModelFileError, match=message):
        model_from_dict(thesis_model.to_dict() | change)


def test_foreign_model_files(tmp_path):
    with pytest.raises(ModelFileError, match="cannot read"):
        load_model(tmp_path / "none.json")
    (tmp_path / "x.json").write_text("{")
    with pytest.raises(ModelFileError, match="is not a model file"):
        load_model(tmp_path / "x.json")


def test_comparison_tells_models_apart(thesis_model, clean_log, noisy_log):
    worse = replace(thesis_model, theta=thesis_model.theta * 0.8)
    logs = [clean_log, noisy_log]
    c = compare({"worse": worse, "true": thesis_model}, logs)
    assert c.fits()[1]["u"] > c.fits()[0]["u"]
    assert {t.wins for t in c.sign_tests} <= {1, 2}
    assert set(c.ahead[0][0]) == {"10", "30", "60"}
    assert c.ahead[1][0]["10"]["u"] < c.ahead[0][0]["10"]["u"]
    assert c.rmse[1][0]["u"] == pytest.approx(
        float(np.sqrt(np.mean((clean_log["u"] - c.runs[1][0].x[:, 0]) ** 2)))
    )
    json.dumps(c.to_dict())
    assert "fit u [%]" in c.summary()
    assert "rmse u [m/s]" in c.summary()
    assert "rmse r [rad/s]" in c.summary()


def test_long_names_stay_apart_in_the_summary(thesis_model, clean_log):
    log = replace(clean_log, name="zig-zag to starboard, 17 May, run 2")
    names = [f"campaigns/2024-05-17/{run}/model.json" for run in "ab"]
    found = compare(dict.fromkeys(names, thesis_model), [log], bands=False)
    _, *lines = found.summary().splitlines()
    assert lines[0].index("log") == len(names[0]) + 1
    for name in names:
        assert sum(line.startswith(f"{name} {log.name} ") for line in lines) == 1
        assert sum(line.startswith(f"{name} 10 s ahead") for line in lines) == 1


def test_only_tables_are_kept_of_logs_that_are_not_drawn(thesis_model, noisy_log):
    columns = [[noisy_log.window(k, k + 300)] for k in (0, 300, 600)]
    known = {"thesis": thesis_model}
    whole = compare_each(known, columns)
    for most, kept in ((0, 0), (1, 2)):
        found = compare_each(known, columns, whole=most)
        assert sum(run.whole is None for run in found.runs[0]) <= kept
        assert sum(len(run.log) for run in found.runs[0]) <= 300 * kept + 2 * 3
        assert found.to_dict() == whole.to_dict()
        assert found.summary() == whole.summary()


@pytest.fixture(scope="module")
def logged(thesis_model):
    """A log of the model itself with noise of 0.01, and one as a file that it was estimated on."""
    log = virtual_log(5, 600, wind=0.0, current=(0.0, 0.0), noise=0.0, spread=0.0)
    x, rng = run_model(thesis_model, log).x, np.random.default_rng(0)
    noisy = {s: x[:, i] + 0.01 * rng.standard_normal(600) for i, s in enumerate("uvr")}
    log = replace(log, name="sailed", channels={**log.channels, **noisy})
    known = replace(log, provenance=replace(log.provenance, sha256="a1"))
    return log, known


def test_a_model_that_follows_to_within_noise_is_to_be_used(thesis_model, logged):
    found = compare({"m": thesis_model}, logged[0], bands=False)
    told, (step,) = found.verdict, after_comparison(found, [thesis_model], {})
    assert found.summary().startswith(f"verdict: {told.sentence}\nmodel ")
    assert told.sentence.startswith("You can predict with 'm': on this log it has a fit of surge")
    assert not told.beyond_noise
    assert "greybox predict MODEL zigzag" in step.command
    # beside the noise there is the start, a mean of samples in which the ship turned
    assert 0.5 < min(told.shares.values()) <= max(told.shares.values()) <= 1.0
    for s, bound in told.bounds.items():
        measured = logged[0][s]
        assert bound == pytest.approx(100 * (1 - 0.01 / measured.std()), rel=0.05)
        assert bound - 5 < told.fit[s] < bound + 1
    json.dumps(found.to_dict())


def test_of_models_the_better_one_is_told_with_its_interval(thesis_model, logged):
    worse = {f"{k}": replace(thesis_model, theta=thesis_model.theta * k) for k in (0.8, 0.9)}
    known = {**worse, "true": thesis_model}
    found = compare(known, logged[0], bands=False)
    first, last = found.verdict.differences
    assert (found.verdict.best, first.against, last.against) == ("true", "0.9", "0.8")
    assert 0 < first.fit.ci[0] < first.fit.after - first.fit.before < first.fit.ci[1]
    told = found.verdict.sentence
    assert told.startswith("'true' predicts better than the 2 other models: its mean fit is ")
    assert f"higher than that of '0.9' by {first.words}. You can predict with it: " in told
    # the same model is as good as itself, and may be told apart elsewhere
    found = compare({"a": thesis_model, "b": thesis_model}, logged[0], bands=False)
    assert "'a' is not better beyond chance than 'b'" in found.verdict.sentence
    assert "higher by 0.0 (95 %: 0.0 to 0.0)" in found.verdict.sentence
    steps = [s.command for s in after_comparison(found, [thesis_model] * 2, {})]
    assert [c.split()[1] for c in steps] == ["predict", "compare"]


def test_a_poor_model_is_diagnosed_and_one_that_diverges_is_estimated_anew(thesis_model, logged):
    poor = replace(thesis_model, theta=thesis_model.theta * 0.1)
    found = compare({"m": poor}, logged[0], bands=False)
    assert "Do not predict surge" in found.verdict.sentence
    (step,) = after_comparison(found, [poor], {"command": {"models": ["m.json"], "log": ["a b"]}})
    assert step.command.startswith("greybox diagnose 'a b' --vessel V --model m.json")
    short = compare({"m": poor}, logged[0].window(0, 100), bands=False)
    (step,) = after_comparison(short, [poor], {})
    assert step.purpose.startswith("Sail a longer trial, since a diagnosis needs 120 samples")
    away = replace(thesis_model, theta=-20 * thesis_model.theta)
    for known in ({"m": away}, {"m": away, "n": away}):
        found = compare(known, logged[0], bands=False)
        told = found.verdict.sentence
        assert ": its free run diverges after " in told
        assert not found.verdict.differences
        (step,) = after_comparison(found, list(known.values()), {})
        assert "--reduce" in step.command
    found = compare({"m": away, "n": thesis_model}, logged[0], bands=False)
    assert found.verdict.sentence.startswith(
        "'n' predicts better than the other model, whose free runs diverge. You can predict with it"
    )


def test_logs_of_an_estimate_say_nothing_of_its_prediction(thesis_model, logged):
    free, known = logged
    own = replace(thesis_model, record={"logs": [{"sha256": "a1"}]})
    found = compare({"m": own}, known, bands=False)
    assert found.verdict.sentence.startswith(
        "'m' was estimated on this log, so its fit there (surge "
    )
    assert found.notes == (
        "'m' was estimated on this log: how it fits there says little of other logs.",
    )
    (step,) = after_comparison(found, [own], {})
    assert step.command == "greybox compare MODEL… --log LOG --report compare.html"
    # a log that none was estimated on judges alone
    other = replace(thesis_model, theta=0.9 * thesis_model.theta)
    found = compare({"m": own, "n": other}, [known, free], bands=False)
    assert not found.verdict.in_sample
    assert "You can predict with it: on 1 of these 2 logs, kept from every" in (
        found.verdict.sentence
    )
    assert found.verdict.fit == found.runs[0][1].fit
    # what was estimated on the log has no need to be better there, and is no proof where it is
    found = compare({"m": own, "n": other}, known, bands=False)
    assert found.verdict.in_sample == ("m",)
    assert found.verdict.sentence.startswith("'m' fits better than 'n'")
    found = compare({"m": replace(other, record=own.record), "n": thesis_model}, known)
    assert found.verdict.sentence.startswith("'n' predicts better than 'm'")


def test_where_nothing_moves_nothing_is_judged(thesis_model, logged):
    log = logged[0]
    still = {s: np.full(600, np.mean(log[s])) for s in "uvr"}
    rng = np.random.default_rng(1)
    still = {s: y + 0.01 * rng.standard_normal(600) for s, y in still.items()}
    found = compare({"m": thesis_model}, replace(log, channels={**log.channels, **still}))
    assert found.verdict.sentence == (
        "No channel moved beyond its noise, so its prediction was not tested."
    )
    (step,) = after_comparison(found, [thesis_model], {})
    assert step.purpose == "Compare on a log in which the ship moves more"


def test_intervals_between_models_hold_for_errors_with_a_memory():
    """Of models that are equally good, 5 % are told to be better, whatever their errors remember.

    Of 200 that is within 2.6 standard deviations.
    """
    rng, false = np.random.default_rng(3), 0
    log = virtual_log(1, 1000, wind=0.0, current=(0.0, 0.0), noise=0.0, spread=0.0)
    x = log.states(("u", "v", "r"))
    for _ in range(200):
        errors = lfilter([1.0], [1.0, -0.95], rng.standard_normal((2, 3, 1500)))[:, :, 500:]
        runs = [
            LogFit(log, x + 0.1 * x.std(axis=0) * e.T, log["psi"], fit_on(log, "uvr", x), -1)
            for e in errors
        ]
        fits = [fit_on(log, "uvr", run.x) for run in runs]
        one, two = map(stretch_effects, runs)
        told = gain_over_stretches(*map(mean_fit, fits), [(two - one).mean(axis=0)])
        false += not told.ci[0] <= 0 <= told.ci[1]
    assert abs(false - 10) <= 8


def test_sign_test_is_binomial():
    assert sign_test("b", "a", "u", [1], [1]).sentence == "b fits u as well as a in every log."
    t = sign_test("b", "a", "u", [1, 2, 3, 4, 5], [2, 3, 4, 5, 5])
    assert (t.wins, t.of) == (4, 4)
    assert t.p_value == pytest.approx(2 / 16)


@pytest.mark.long
def test_the_theory_chooses_where_its_conditions_hold(noisy_log):
    found = estimate_model([noisy_log])
    e = found.meant
    assert e.method == "iv"
    assert e.predictor.kind in ("wind", "augmented")
    assert any("was chosen" in n and "(chapter 5)" in n for n in e.notes)
    assert e.fit["u"] > 50
    # coefficients of instruments may predict less well than a free run's own
    assert min(found.fit[s] - e.fit[s] for s in e.fit) >= 0


@pytest.mark.long
def test_output_error_takes_over_where_it_is_trusted_and_instruments_are_not():
    """Constant measured wind: its terms move instruments little, the free run enough."""
    log = virtual_log(4, 1500, spread=0.0)
    assert estimate_model([log], method="iv").verdict.level is TrustLevel.DO_NOT_TRUST
    e = estimate_model([log])
    assert e.method == "oe"
    assert e.verdict.text == "trust"
    assert "output error was chosen, because it is judged 'trust' and iv" in e.notes[-1]
    kept = estimate_model([log], zero_mean=False)
    assert kept.method != "oe"


@pytest.mark.long
def test_output_error_that_is_judged_no_better_is_left(monkeypatch):
    log = virtual_log(4, 1500, spread=0.0)
    doubtful = refused([NoRegression("a reason")], ())
    monkeypatch.setattr("greybox.selection.estimate.weighed", lambda *_: doubtful)
    # of two that are not to be trusted the one that simulates is taken …
    e = estimate_model([log], structure="thesis")
    assert e.method == "oe"
    assert "its free run is better than a constant in more of the states" in e.notes[-1]
    # … and the first where both do and nothing speaks against the model
    monkeypatch.setattr("greybox.selection.estimate._poor", lambda fit: [])
    monkeypatch.setattr("greybox.selection.estimate._at_fault", lambda *_: False)
    e = estimate_model([log], structure="thesis")
    assert e.method == "iv"
    assert e.notes[-1] == (
        "output error was tried too, and is judged no better: 'do not trust: a reason'."
    )


def test_output_error_that_fails_is_told(monkeypatch):
    def fail(*_, **__):
        raise ExcitationError("the run leaves every bound.")

    log = virtual_log(4, 1500, spread=0.0)
    monkeypatch.setattr("greybox.estimation.output_error.estimate_oe", fail)
    monkeypatch.setattr("greybox.selection.estimate._at_fault", lambda *_: False)
    e = estimate_model([log], structure="thesis")
    assert e.method != "oe"
    assert "output error was tried too, and failed: the run leaves every bound." in e.notes


@pytest.mark.long
def test_held_out_runs_choose_elsewhere():
    log = virtual_log(4, 900)
    straight = make_log(log.vessel, {**log.channels, "psi": log["psi"] * 0.01}, 1.0, "straight")
    calm = {k: v for k, v in straight.channels.items() if k not in ("u_q", "v_q")}
    without_wind = replace(straight, channels=calm)
    e = estimate_model([without_wind])
    assert any("chosen by the free run on the last third" in n for n in e.notes)
    assert any("bias-capturing terms were left out" in n for n in e.notes)


def test_uninformative_logs_are_refused(noisy_log):
    straight = {**noisy_log.channels, "psi": noisy_log["psi"] * 1e-4}
    log = make_log(noisy_log.vessel, straight, 1.0, "straight")
    with pytest.raises(ExcitationError, match=r"heading stays within \d+ deg"):
        estimate_model([log], method="iv", predictor="augmented")
    dead = {**noisy_log.channels, **{c: 0 * noisy_log[c] + 1 for c in noisy_log.vessel.commands}}
    log = make_log(noisy_log.vessel, dead, 1.0, "dead")
    with pytest.raises(ExcitationError, match="every thruster command is constant"):
        estimate_model([log], method="ls", predictor="basic")
    no_wind = {k: v for k, v in noisy_log.channels.items() if k not in ("u_q", "v_q")}
    log = make_log(noisy_log.vessel, no_wind, 1.0, "calm")
    with pytest.raises(LogError, match="needs the wind"):
        estimate_model([log], predictor="wind")


def test_whole_turns_between_logs_are_no_coverage(noisy_log):
    north = make_log(noisy_log.vessel, {"psi": np.linspace(0.0, 0.1, 50)}, 1.0)
    again = make_log(noisy_log.vessel, {"psi": np.linspace(0.0, 0.1, 50) + 2 * np.pi}, 1.0)
    assert heading_range([north, again]) == pytest.approx(0.1, abs=1e-3)
    assert heading_range([noisy_log]) > 6


@pytest.mark.long
def test_rare_signs_make_no_regime_of_their_own(noisy_log, thesis):
    """A few measured v < 0 would add sgn(v), which the simulated v never changes."""
    v = noisy_log["v"].copy()
    v[::60] = -0.01
    log = make_log(noisy_log.vessel, {**noisy_log.channels, "v": v}, 1.0)
    assert dict(regime_of([log], thesis))["v"] == (1,)
    e = estimate_model([log], method="iv", predictor="augmented", structure="thesis")
    assert "sgn(v)" not in {c.name for c in e.predictor.columns}


def test_bias_columns_that_do_not_vary_are_left_out(thesis, noisy_log, true_theta):
    predictor = build_predictor(thesis, "augmented")
    labels = [c.label for c in predictor.columns]
    column = labels.index("sgn(u)")
    with pytest.raises(UnexcitedBiasError, match=r"sgn\(u\) or its instrument does not vary"):
        estimate_iv(predictor, [noisy_log], start=true_theta)
    smaller = predictor.without_bias(column)
    assert [c.label for c in smaller.columns] == labels[:column] + labels[column + 1 :]
    lengths = {b.state: len(b.shares) for b in smaller.biases}
    assert lengths == {s: len(smaller.equation(s)) for s in "uvr"}


def test_models_of_other_states_are_not_compared(thesis_model, noisy_log):
    surge = estimate_model([noisy_log], method="ls", predictor="basic", structure="surge").model()
    with pytest.raises(UsageError, match="cannot stand in one table"):
        compare({"a": thesis_model, "b": surge}, noisy_log)


def test_models_are_compared_by_name(thesis_model, noisy_log):
    with pytest.raises(UsageError, match="have no names"):
        compare([thesis_model], noisy_log)
    with pytest.raises(UsageError, match=r"'a' is 'model\.json', which is no model"):
        compare({"a": "model.json"}, noisy_log)


def test_rudder_terms_can_be_removed():
    inputs = ("taux", "race", "rudder", "race_drag", "rudder_drag")
    structure = structure_for("thesis-X_race_drag", inputs)
    assert "X_race_drag" not in structure.parameters
    assert {"Y_race", "N_race"} <= set(structure.parameters)
    assert "Ymu" not in structure.parameters


def test_regime_is_read_from_the_log(noisy_log, thesis):
    assert dict(regime_of([noisy_log], thesis)) == {"u": (1,), "v": (1,), "r": (1, -1)}


def test_table_3_1(thesis):
    inertia = Inertia(surge=1.05e5, sway=1.7e5, yaw=9e6)
    theta = {n: 1e-3 * (i + 1) for i, n in enumerate(thesis.parameters)}
    physical = to_continuous(theta, thesis, 0.5, inertia)
    assert physical.keys() == theta.keys()
    for name, mass in (("Xu", 1.05e5), ("Yv", 1.7e5), ("Nr", 9e6)):
        assert physical[name] == pytest.approx(theta[name] * mass / 0.5)
    assert all(
        t.holds for t in check_ties({"Xvr": 0.5 * 1.7 / 1.05, "Yur": -0.5 * 1.05 / 1.7}, 0.5)
    )


def test_masses_follow_from_the_gains():
    theta = {"Xmu": 2e-5, "Ymu": 1e-5, "Nmu": 1e-7}
    inertia = estimate_inertia(theta, 1.0, mass=4e4, thrust_in_newtons=True)
    assert (inertia.surge, inertia.sway, inertia.yaw) == pytest.approx((5e4, 1e5, 1e7))
    assumed = estimate_inertia(theta, 1.0, mass=4e4, thrust_in_newtons=False)
    assert assumed.surge == pytest.approx(4.2e4)
    with pytest.raises(StructureError, match="Ymu is 0"):
        estimate_inertia({"Xmu": 1, "Nmu": 1}, 1.0, mass=1, thrust_in_newtons=True)
    with pytest.raises(StructureError, match=r"Ymu is -0\.2: a force that moves the ship against"):
        estimate_inertia({"Xmu": 1, "Ymu": -0.2, "Nmu": 1}, 1.0, mass=1, thrust_in_newtons=False)


def test_errors_of_the_masses_are_those_of_draws_of_the_gains():
    gains, rng = np.array([2e-5, 1e-5, 1e-7]), np.random.default_rng(1)
    share = np.array([[1.0, 0.8, 0.0], [0.8, 1.0, 0.0], [0.0, 0.0, 4.0]]) * 1e-4
    covariance = share * np.outer(gains, gains)
    draws = rng.multivariate_normal(gains, covariance, 4000)
    for newtons in (True, False):
        masses = [
            estimate_inertia(
                dict(zip(("Xmu", "Ymu", "Nmu"), g, strict=True)),
                1.0,
                mass=4e4,
                thrust_in_newtons=newtons,
            )
            for g in draws
        ]
        errors = inertia_errors(gains, covariance, thrust_in_newtons=newtons)
        for state in "uvr":
            drawn = np.array([m.of(state) for m in masses])
            assert errors.of(state) == pytest.approx(drawn.std() / drawn.mean(), rel=0.05, abs=1e-9)


def test_ties_of_table_6_1_do_not_hold(thesis, true_theta):
    ties = check_ties(dict(zip(thesis.parameters, true_theta, strict=True)), 1.0)
    assert [t.holds for t in ties] == [False, False]
    assert "only nominal" in ties[0].sentence


def test_prime_coefficients(thesis):
    c = {"Xu": 3.0, "Xuu": 5.0, "Nvr": 7.0, "Xmu": 1.0}
    prime = to_prime(c, thesis, length=30.0, speed=4.0, density=1000.0)
    assert prime["Xuu"] == pytest.approx(5.0 / (0.5 * 1000 * 30**2))
    assert prime["Xu"] == pytest.approx(3.0 / (0.5 * 1000 * 30**2 * 4))
    assert prime["Nvr"] == pytest.approx(7.0 / (0.5 * 1000 * 30**4))
    assert "Xmu" not in prime
