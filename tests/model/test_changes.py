"""Parameters that change on the way, against a step-by-step run, through files and commands."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from greybox.commands.main import main
from greybox.errors import ModelFileError, StructureError
from greybox.model.model import ManoeuvringModel, load_model, model_from_dict
from greybox.model.run.changes import Change
from greybox.model.run.simulation import simulate
from greybox.validation.bands import predict_bands
from greybox.validation.comparison import errors_ahead
from greybox.validation.fit import run_model

CHANGES = (Change("Xu", 3.0, 40.0), Change("Nr", 0.5, 90.2), Change("Xu", 1.5, 120.0))


@pytest.fixture(scope="module")
def model(thesis, ship, true_theta):
    return ManoeuvringModel(thesis, true_theta, np.zeros((true_theta.size,) * 2), 1.0, ship)


def thetas(model, samples):
    """The parameters at each sample, typed out."""
    rows = np.repeat(model.theta[None], samples, axis=0)
    k = np.arange(samples)
    rows[k >= 40, model.names.index("Xu")] *= 3.0
    rows[k >= 91, model.names.index("Nr")] *= 0.5
    rows[k >= 120, model.names.index("Xu")] *= 0.5
    return rows


def step_by_step(model, log, x, psi, first, last):
    tau = log.forces(model.structure.inputs)
    rows = thetas(model, len(log))
    out = [x]
    for k in range(first, last):
        run = simulate(
            model.structure, rows[k], out[-1], tau[k : k + 1], 1.0,
            psi=psi[k : k + 2], air=log.air[k : k + 1],
        )  # fmt: skip
        out.append(run.x[0, 1])
    return np.array(out)


def test_a_changing_run_equals_steps(model, clean_log):
    """Simulated and measured heading, one run and several."""
    log, changing = clean_log, replace(model, changes=CHANGES)
    got = run_model(changing, log)
    want = step_by_step(model, log, got.x[0], log["psi"], 0, len(log) - 1)
    np.testing.assert_allclose(got.x, want, rtol=1e-12, atol=1e-12)
    tau = log.forces(model.structure.inputs)
    starts = np.array([[1.5, 1.2, 0.0], [1.0, 0.9, 0.01]])
    both = simulate(
        model.structure, np.stack([model.theta, 0.9 * model.theta]), starts, tau, 1.0,
        changes=CHANGES, psi0=np.array([0.0, 0.4]), d=np.array([0.2, 0.1, 0.0, 0.0]),
        process_noise=np.full((2, len(tau), 3), 1e-3),
    )  # fmt: skip
    for run, share in enumerate((1.0, 0.9)):
        rows = share * thetas(model, len(tau))
        x, psi = starts[run], (0.0, 0.4)[run]
        for k in range(200):
            one = simulate(
                model.structure, rows[k], x, tau[k : k + 1], 1.0, psi0=psi,
                d=np.array([0.2, 0.1, 0.0, 0.0]), process_noise=np.full((1, 3), 1e-3),
            )  # fmt: skip
            x, psi = one.x[0, 1], one.psi[0, 1]
            np.testing.assert_allclose(both.x[run, k + 1], x, rtol=1e-11, atol=1e-12)
            np.testing.assert_allclose(both.psi[run, k + 1], psi, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_changes_that_change_nothing_leave_the_plain_run(model, clean_log, integrator):
    tau = clean_log.forces(model.structure.inputs)
    start = np.array([1.5, 1.2, 0.0])
    gusts = np.random.default_rng(5).normal(2.0, 1.0, (len(tau), 2))
    wind = {"integrator": integrator, "air": gusts}
    plain = simulate(model.structure, model.theta, start, tau, 1.0, **wind)
    same = (Change("Xu", 7.0, 1e9), Change("Xu", 1.0, -5.0), Change("Nr", 1.0, 60.0))
    for changes in ((), same):
        run = simulate(model.structure, model.theta, start, tau, 1.0, changes=changes, **wind)
        np.testing.assert_array_equal(run.x, plain.x)
        np.testing.assert_array_equal(run.psi, plain.psi)


def test_a_run_that_diverges_after_a_change_says_where(model, clean_log):
    tau = clean_log.forces(model.structure.inputs)
    run = simulate(
        model.structure, model.theta, np.array([1.5, 1.2, 0.0]), tau, 1.0,
        changes=(Change("Xu", -100.0, 50.0),), bound=np.full(3, 50.0),
    )  # fmt: skip
    assert 50 < run.diverged[0] < 60


def test_errors_ahead_know_when_a_run_meets_the_change(model, clean_log):
    """Starts before, over and after the changes, each step by step."""
    changing = replace(model, changes=CHANGES)
    log = clean_log.window(0, 140)
    fit = run_model(changing, log)
    got = errors_ahead(changing, fit)
    x = log.states(model.structure.states)
    for horizon in (10, 60):
        ends = [
            step_by_step(model, log, x[s], log["psi"], s, s + horizon)[-1]
            for s in range(140 - horizon)
        ]
        want = np.sqrt(((np.array(ends) - x[horizon:]) ** 2).mean(axis=0))
        np.testing.assert_allclose(list(got[str(horizon)].values()), want, rtol=1e-9)


def test_bands_are_of_the_changing_model(model, clean_log):
    """Without uncertainty they are the run, over pieces of the bands' own."""
    log = clean_log.window(0, 300)
    start = log.states(("u", "v", "r"))[0]
    changing = replace(model, changes=CHANGES)
    bands = predict_bands(changing, log, runs=4)
    want = step_by_step(model, log, start, log["psi"], 0, 299)
    np.testing.assert_allclose(bands.motion[0], want, rtol=1e-9, atol=1e-12)


def test_a_settled_model_is_that_after_its_last_change(model):
    changing = replace(model, changes=CHANGES, covariance=np.eye(model.theta.size))
    settled = changing.at_final_parameters()
    xu, nr = (model.names.index(n) for n in ("Xu", "Nr"))
    want = model.theta.copy()
    want[[xu, nr]] *= (1.5, 0.5)
    np.testing.assert_allclose(settled.theta, want)
    np.testing.assert_allclose(settled.std[[xu, nr]], [1.5, 0.5])
    assert settled.changes == ()
    assert model.at_final_parameters() is model
    with pytest.warns(DeprecationWarning, match="at_final_parameters"):
        assert model.settled() is model


def test_the_file_and_the_summary_hold_the_changes(model, tmp_path):
    changing = replace(model, changes=CHANGES)
    changing.save(tmp_path / "model.json")
    assert load_model(tmp_path / "model.json").changes == CHANGES
    assert "Xu is 3 times its value from 40 s on" in changing.summary()
    assert "changes" not in model.to_dict()


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"parameter": "Xu", "factor": 2}, "where parameter, factor and time"),
        ({"parameter": "Xuv", "factor": 2, "time": 3}, "no parameter of the model. Did you mean"),
        ({"parameter": "Xu", "factor": "2", "time": 3}, "factor '2', a finite number"),
        ({"parameter": "Xu", "factor": 2, "time": float("inf")}, "time inf, a finite number"),
        (3, "has the change 3"),
    ],
)
def test_bad_changes(model, row, message):
    data = model.to_dict() | {"changes": [row]}
    with pytest.raises(ModelFileError, match=message):
        model_from_dict(data)


def test_bad_changes_in_code(model):
    with pytest.raises(StructureError, match="the change of Xu has the factor nan"):
        Change("Xu", np.nan, 1.0)
    with pytest.raises(StructureError, match="a change is of 'Xv', which is no parameter"):
        replace(model, changes=(Change("Xv", 2.0, 1.0),))


def test_commands_follow_a_change(model, tmp_path, capsys):
    """A log of the changed ship: the changing model fits it, the other does not."""
    from virtual import virtual_log, write_csv

    log = virtual_log(5, 300, wind=0.0, current=(0.0, 0.0), noise=0.0, spread=0.0)
    changing = replace(model, changes=(Change("Xu", 2.0, 100.0),))
    run = run_model(changing, log, heading="simulated")
    channels = {s: run.x[:, i] for i, s in enumerate(("u", "v", "r"))} | {"psi": run.psi}
    write_csv(replace(log, channels={**log.channels, **channels}), tmp_path / "log.csv")
    changing.save(tmp_path / "changing.json")
    model.save(tmp_path / "plain.json")
    paths = {n: str(tmp_path / n) for n in ("changing.json", "plain.json", "log.csv")}
    run_it = ["simulate", paths["changing.json"], paths["log.csv"]]
    assert main([*run_it, "--out", str(tmp_path / "run.csv")]) == 0
    both = ["compare", paths["plain.json"], paths["changing.json"], "--log", paths["log.csv"]]
    assert main([*both, "--json", str(tmp_path / "c.json")]) == 0
    capsys.readouterr()
    found = json.loads((tmp_path / "c.json").read_text())
    fits = {m["model"]: m["fit"]["u"] for m in found["models"]}
    assert fits["changing"] > 95 > fits["plain"] + 10


def test_a_change_of_no_parameter_is_refused_with_the_nearest(thesis, true_theta):
    with pytest.raises(StructureError, match=r"'XU', which is no parameter.*Did you mean 'Xu'"):
        simulate(
            thesis, true_theta, np.zeros(3), np.zeros((5, 3)), 1.0, changes=[Change("XU", 2.0, 1.0)]
        )
