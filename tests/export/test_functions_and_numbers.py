"""CasADi functions, MATLAB struct, flat JSON: read back and run."""

from __future__ import annotations

import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from free_runs import CURRENT, KINDS, calm, variants, wanted, with_actuation
from scipy.io import loadmat
from virtual import virtual_log

from greybox.export.casadi_file import casadi_functions
from greybox.export.export import export_model
from greybox.export.sampled import sampled_model
from greybox.model.model import ManoeuvringModel
from greybox.vessel.vessel import Actuation

NAMES = ("u", "v", "r", "psi", "x_n", "y_n")


@pytest.fixture(scope="module")
def model(thesis, ship, true_theta):
    rng = np.random.default_rng(5)
    root = 1e-3 * rng.standard_normal((18, 18))
    return ManoeuvringModel(thesis, true_theta, root @ root.T, 1.0, ship)


@pytest.fixture(scope="module")
def log():
    return virtual_log(3, 150, wind=2.0)


def loaded(path):
    side = json.loads((path.parent / f"{path.stem}.casadi.json").read_text())
    at = {name: path.parent / f["file"] for name, f in side["functions"].items()}
    return side, {name: ca.Function.load(str(p)) for name, p in at.items()}


def values(rows):
    return np.array([row["value"] for row in rows])


@pytest.mark.parametrize("kind", KINDS)
def test_the_step_repeats_the_free_run(model, log, tmp_path, kind):
    model = variants(model)[kind]
    log = calm(model, log)
    want = wanted(model, log)
    export_model(model, "casadi", tmp_path / "ship.casadi")
    side, functions = loaded(tmp_path / "ship.casadi")
    step = functions["step"]
    assert step.name_in() == ["x", "u", "p"]
    assert step.name_out() == ["x_next", "y"]
    first = (tmp_path / "ship.casadi").read_bytes()
    export_model(model, "casadi", tmp_path / "ship.casadi")
    assert first == (tmp_path / "ship.casadi").read_bytes()
    p = values(side["p"])
    inputs = np.tile(values(side["u"]), (len(log), 1))
    for i, row in enumerate(side["u"]):
        if row["name"] in log:
            inputs[:, i] = log[row["name"]]
    x = values(side["x"])
    x[: side["motion"]] = want[0]
    if len(x) > side["motion"]:
        x = functions["begin"](x, inputs[0], p)
    run = step.mapaccum("run", len(log), [0], [0])(x, inputs.T, p)[1]
    y = np.array(run).T
    assert [row["name"] for row in side["y"]][:6] == list(NAMES)
    np.testing.assert_allclose(y[:, :6], want, rtol=1e-9, atol=1e-9)


def test_it_drops_into_an_optimal_control_problem(model, tmp_path):
    """Derivatives exist, and a small problem is solved: the surge force that keeps a speed."""
    export_model(model, "casadi", tmp_path / "ship.casadi")
    side, functions = loaded(tmp_path / "ship.casadi")
    opti = ca.Opti()
    x, n = opti.variable(6, 21), opti.variable(20)
    opti.subject_to(x[:, 0] == [1.0, 0, 0, 0, 0, 0])
    for k in range(20):
        u = ca.vertcat(n[k], 0.0, 0.0, 0.0, 0.0)
        opti.subject_to(x[:, k + 1] == functions["step"](x[:, k], u, values(side["p"]))[0])
    opti.minimize(ca.sumsqr(x[0, 1:] - 2.0) + 1e-6 * ca.sumsqr(n))
    opti.solver("ipopt", {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"})
    solution = opti.solve()
    speed = solution.value(x)[0]
    assert speed[-1] == pytest.approx(2.0, abs=0.01)


def test_the_rate_is_that_of_the_step(model, tmp_path):
    """Euler's rule on it is the Euler model, the classical rule the other, lag and all."""
    rng = np.random.default_rng(6)
    u = np.array([15.0, 0.7, 0.9, 2.0, -1.0])
    for integrator in ("euler", "rk4"):
        kind = replace(variants(model)["changes"], integrator=integrator, disturbances=CURRENT)
        export_model(kind, "casadi", tmp_path / "ship.casadi")
        side, functions = loaded(tmp_path / "ship.casadi")
        p = values(side["p"])
        x = np.append(rng.standard_normal(6), 50.0)

        def f(x, rhs=functions["rhs"], p=p):
            return np.array(rhs(x, u, p)).ravel()

        after = np.array(functions["step"](x, u, p)[0]).ravel()
        if integrator == "euler":
            np.testing.assert_allclose(x + f(x), after, rtol=1e-12, atol=1e-12)
        else:
            k1, k2 = f(x), f(x + f(x) / 2)
            k3 = f(x + k2 / 2)
            want = x + (k1 + 2 * k2 + 2 * k3 + f(x + k3)) / 6
            # positions are Euler's in both, as the free run's
            np.testing.assert_allclose(want[:4], after[:4], rtol=1e-12, atol=1e-12)
    lagged = variants(model)["lag of speeds"]
    export_model(lagged, "casadi", tmp_path / "lag.casadi")
    side, functions = loaded(tmp_path / "lag.casadi")
    x = np.append(rng.standard_normal(6), 12.0)
    rate = np.array(functions["rhs"](x, u, values(side["p"]))).ravel()
    assert rate[6] == pytest.approx((15.0 - 12.0) / 4.0)
    force = 12.0 * (np.cos(0.7) + np.cos(0.9))
    zero = x.copy()
    zero[6] = 0.0
    still = np.array(functions["rhs"](zero, u, values(side["p"]))).ravel()
    theta = dict(zip(model.names, model.theta, strict=True))
    assert rate[0] - still[0] == pytest.approx((theta["Xmu"] + theta["Xkappa"] * x[0]) * force)


def test_a_rate_limit_has_no_rate(model, tmp_path):
    limited = with_actuation(model, rate_limit=0.05, rate_on="alpha1")
    export_model(limited, "casadi", tmp_path / "ship.casadi")
    side, functions = loaded(tmp_path / "ship.casadi")
    assert set(functions) == {"step", "begin"}
    assert "limits the rate of alpha1 from sample to sample, which a rate" in side["no_rhs"]


def test_a_delay_has_no_rate(model, tmp_path):
    exported = export_model(variants(model)["delay"], "casadi", tmp_path / "ship.casadi")
    side, functions = loaded(tmp_path / "ship.casadi")
    assert set(functions) == {"step", "begin"}
    assert "delays its commands by 2.6 s" in side["no_rhs"]
    assert [f.name for f in exported.files] == [
        "ship.casadi", "ship_begin.casadi", "ship.casadi.json",
    ]  # fmt: skip


def test_the_mat_file_holds_the_model(model, tmp_path):
    kind = replace(variants(model)["late"], covariance=model.covariance)
    export_model(kind, "mat", tmp_path / "ship.mat")
    struct = loadmat(tmp_path / "ship.mat", squeeze_me=True, simplify_cells=True)["model"]
    assert list(struct["names"]) == list(model.names)
    assert list(struct["units"]) == model.units
    np.testing.assert_array_equal(struct["theta"], model.theta)
    np.testing.assert_array_equal(struct["covariance"], model.covariance)
    np.testing.assert_allclose(struct["std"], model.std)
    assert struct["sample_time"] == 1.0
    assert struct["integrator"] == "rk4"
    assert list(struct["equations"]) == model.structure.equations()
    assert dict(zip(struct["disturbance_names"], struct["disturbances"], strict=True)) == {
        "current_north": 0.3, "current_east": -0.2,
    }  # fmt: skip
    assert (struct["lag"], struct["lag_held"], struct["delay"]) == (3.0, "mean", 0.4)
    assert (struct["delay_on"], struct["rate_limit"]) == ("command", np.inf)
    assert list(struct["change_names"]) == ["Xu", "Nr", "Xu"]
    assert struct["thrusters"][0]["speed"] == "n"
    assert list(struct["input_names"][:3]) == ["n", "alpha1", "alpha2"]
    first = (tmp_path / "ship.mat").read_bytes()
    export_model(kind, "mat", tmp_path / "again.mat")
    assert first == (tmp_path / "again.mat").read_bytes()


@pytest.mark.parametrize("kind", ["terms", "bumps"])
def test_regressors_follow_from_the_exponents(model, log, tmp_path, kind):
    """The increments of a run, computed from the file's numbers alone."""
    model = replace(variants(model)[kind], disturbances={})
    export_model(model, "mat", tmp_path / "ship.mat")
    struct = loadmat(tmp_path / "ship.mat", squeeze_me=True, simplify_cells=True)["model"]
    export_model(model, "json", tmp_path / "ship.json")
    table = json.loads((tmp_path / "ship.json").read_text())
    for name, rows in (("power", struct["power"]), ("modulus", struct["modulus"])):
        np.testing.assert_array_equal([p[name] for p in table["parameters"]], rows)
    log = calm(model, log)
    want = wanted(model, log)
    tau = log.forces(model.structure.inputs)
    known = {"u_r": want[:, 0], "v_r": want[:, 1], "r": want[:, 2]}
    known |= {"u_q": want[:, 0], "v_q": want[:, 1]}
    known |= {n: tau[:, i] for i, n in enumerate(model.structure.inputs)}
    signals = np.array([known[n] for n in struct["signals"]])[None]
    power, modulus = struct["power"][..., None], struct["modulus"][..., None]
    phi = np.prod(signals**power * np.abs(signals) ** modulus, axis=1)
    for i, k, centre, width, flat in struct["bumps"].reshape(-1, 5):
        away = np.maximum(np.abs(signals[0, int(k) - 1] - centre) - flat, 0.0)
        phi[int(i) - 1] *= np.maximum(1 - (away / width) ** 2, 0.0) ** 2
    told = [(i + 1, b) for i, p in enumerate(table["parameters"]) for b in p["bumps"]]
    np.testing.assert_array_equal(
        [[i, b["centre"], b["width"], b["flat"]] for i, b in told],
        struct["bumps"].reshape(-1, 5)[:, [0, 2, 3, 4]] if told else [],
    )
    for i, state in enumerate(model.structure.states):
        mine = struct["equation"] == state
        change = struct["theta"][mine] @ phi[mine]
        np.testing.assert_allclose(np.diff(want[:, i]), change[:-1], rtol=1e-9, atol=1e-12)


def test_the_json_is_flat_and_documented(model, tmp_path):
    export_model(variants(model)["current"], "json", tmp_path / "ship.json")
    table = json.loads((tmp_path / "ship.json").read_text())
    by_name = {p["name"]: p for p in table["parameters"]}
    assert by_name["Xuu"] == {
        "name": "Xuu", "equation": "u", "regressor": "|u_r|*u_r", "value": -0.05,
        "std": pytest.approx(model.std[2]), "unit": "s/m", "per_second": -0.05,
        "stands_for": ["Xuu"], "power": by_name["Xuu"]["power"],
        "modulus": by_name["Xuu"]["modulus"], "bumps": [],
    }  # fmt: skip
    assert table["disturbances"][0] == {
        "name": "current_north", "value": 0.3, "std": 0.01, "unit": "m/s",
    }  # fmt: skip
    assert np.shape(table["covariance"]) == (18, 18)
    assert table["inputs"][1]["unit"] == "rad"


@pytest.mark.parametrize(
    "actuation",
    [Actuation(), Actuation(lag=4.0, lag_on="force", delay=2.3), Actuation(lag=4.0)],
    ids=["prompt", "late", "slow"],
)
def test_the_file_steps_as_the_function_for_controllers(ship, thesis, true_theta, actuation):
    late = replace(ship, actuation=actuation)
    model = ManoeuvringModel(
        thesis, true_theta, np.zeros((18, 18)), 1.0, late,
        disturbances={"current_north": (0.2, 0.01), "current_east": (-0.1, 0.01)},
    )  # fmt: skip
    sampled = sampled_model(model, heading="simulated", wind="earth")
    written, own = casadi_functions(sampled)["step"], model.step_function()
    rng = np.random.default_rng(3)
    for _ in range(5):
        x = rng.uniform(0.5, 1.5, own.size1_in(0))
        command, wind = rng.uniform(0.6, 1.1, 3), rng.uniform(-3, 3, 2)
        one = own(x, command, wind)
        other = written(x, np.concatenate([command, wind]), [p.value for p in sampled.parameters])
        assert np.allclose(np.array(one), np.array(other[0]), rtol=1e-12, atol=1e-12)
