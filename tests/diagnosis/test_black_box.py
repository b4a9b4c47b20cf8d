"""A smooth force without a name: what it gains, where it is zero, and when it stays out."""

from __future__ import annotations

import argparse
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from free_runs import calm, program, run_program, wanted
from schemas import schema

from greybox.commands.common import provenance
from greybox.diagnosis.black_box import _reason, bump_terms, extended_by, fit_black_box, wider
from greybox.diagnosis.diagnose import DiagnosisOptions, diagnose
from greybox.diagnosis.extension import extended_model
from greybox.diagnosis.null_model import run_on
from greybox.diagnosis.preparing import prepare
from greybox.diagnosis.result import Diagnosis, Gain, Remainder
from greybox.model.model import load_model
from greybox.numerics.threads import one_thread
from greybox.report.diagnosis import diagnosis_page
from greybox.report.page import render
from greybox.study.blind import Trial, draw
from greybox.validation.bands import joint_covariance
from greybox.validation.fit import run_model

ASKED = DiagnosisOptions(causes=["crossflow"], remainder=True)


@pytest.fixture(scope="module")
def trial() -> Trial:
    # sway is damped otherwise to port than to starboard, for which no term stands
    return draw(np.random.default_rng([3, 2]), ("uneven_damping",), samples=900)


@pytest.fixture(scope="module")
def fitted(trial):
    """Return the model without and with bumps, and what they were fitted with."""
    with one_thread():
        return _fitted(trial)


def _fitted(trial):
    ready = prepare([trial.estimation], [trial.validation], None, "thesis", ["crossflow"])
    case, fit = ready.case, ready.base()
    problem = case.problem(fit.integrator)
    terms = bump_terms(problem, fit, 0)
    assert bump_terms(problem, fit, 0) == terms
    assert bump_terms(problem, fit, 1) != terms
    wide = wider(case, terms)
    made = fit_black_box(wide.problem(fit.integrator), wide.carried(fit), terms)
    before = extended_model(case.structure, problem, fit, case.logs, {}, {})
    return before, extended_by(before, terms, made), terms, made


def missed(model, log) -> np.ndarray:
    run = run_on(model, log)
    return np.array([((log[s] - run.x[:, i]) ** 2).mean() for i, s in enumerate(run.fit)])


@pytest.mark.long
def test_held_out_errors_fall(fitted, trial) -> None:
    before, after, *_ = fitted
    one, two = missed(before, trial.validation), missed(after, trial.validation)
    assert two[1] < 0.6 * one[1]
    assert np.log(two / one).mean() < np.log(0.75)


@pytest.mark.long
def test_nothing_else_of_the_model_moves(fitted) -> None:
    before, after, terms, _ = fitted
    p = len(before.theta)
    assert after.names[:p] == before.names
    np.testing.assert_array_equal(after.theta[:p], before.theta)
    np.testing.assert_allclose(after.covariance[:p, :p], before.covariance, rtol=1e-9)
    assert set(after.names[p:]) <= {t.name for t in terms}


@pytest.mark.long
def test_away_from_the_logs_the_run_is_that_without_it(fitted, trial) -> None:
    before, after, *_ = fitted
    log = trial.validation
    assert np.abs(run_on(after, log).x - run_on(before, log).x).max() > 1e-3
    # these models' own runs go back to known speeds: a few samples at twice the speed
    far = replace(log.window(0, 120), vessel=before.vessel)
    fast = replace(far, channels=far.channels | {"u": far["u"] + 2 * np.ptp(log["u"])})
    one, two = (run_model(m, fast).x for m in (before, after))
    u = trial.estimation["u"]
    beyond = int(np.argmin(one[:, 0] > u.max() + np.ptp(u) / 2))
    assert beyond > 0
    # more terms are added in another order
    np.testing.assert_allclose(one[:beyond], two[:beyond], rtol=1e-12)


@pytest.mark.long
def test_its_covariance_is_one(fitted) -> None:
    _, after, _, made = fitted
    joint = joint_covariance(after)
    values = np.linalg.eigvalsh(joint / np.outer(*(2 * [np.sqrt(np.diag(joint))])))
    assert values.min() > -1e-9
    p = len(after.theta) - np.count_nonzero(made.deviation)
    # no bump is known worse than its prior and the model's own numbers leave it
    assert (np.diag(made.posterior) <= made.deviation**2 * (1 + 1e-9)).all()
    assert (after.std[p:] > 0).all()


@pytest.mark.long
def test_the_fit_repeats_the_models_run(fitted, trial) -> None:
    _, after, _, made = fitted
    run, start = made.problem.runs[0], made.fit.point.starts[0]
    log = trial.estimation
    x = run.run(made.fit.point.ship, np.append(run_on(after, log).x[0], start[3:])).x
    np.testing.assert_allclose(run_on(after, log).x, x, atol=1e-9)


@pytest.mark.long
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler 'cc'")
def test_a_c_program_repeats_the_run(fitted, trial, tmp_path) -> None:
    _, after, *_ = fitted
    after.save(tmp_path / "model.json")
    model = load_model(tmp_path / "model.json")
    assert model == after
    log = calm(model, replace(trial.validation, vessel=model.vessel))
    want = wanted(model, log)
    columns = {c: log[c] for c in model.vessel.commands}
    got = run_program(program(model, tmp_path), columns, want[0])
    found = np.column_stack([got[n] for n in ("u", "v", "r", "psi", "x_n", "y_n")])
    np.testing.assert_allclose(found, want, rtol=1e-9, atol=1e-9)


def told(found: Diagnosis) -> None:
    """Check what a diagnosis says of it, as JSON, text and page."""
    data = json.loads(json.dumps(found.to_dict()))
    schema("diagnose-1").validate(data | {"provenance": provenance(argparse.Namespace())})
    assert found.remainder is not None
    assert data["remainder"]["reason"] == found.remainder.reason
    assert found.remainder.reason in found.summary()
    assert found.remainder.reason.split(":")[0] in render(diagnosis_page(found, {}))


@pytest.mark.long
@pytest.mark.parametrize("validated", [True, False])
def test_a_diagnosis_adds_it(trial, validated: bool) -> None:
    found = diagnose(
        [trial.estimation], validate=[trial.validation] if validated else [], options=ASKED
    )
    told(found)
    assert found.remainder.added
    assert "is in the model" in found.remainder.reason
    assert found.remainder.gain["v"].ci[0] > 0
    added = sum(found.remainder.terms.values())
    assert sum(t.local for t in found.model.structure.terms) == added
    assert "bumps]" in found.model.summary()
    assert found.model.record["remainder"]["added"]


@pytest.mark.long
def test_where_nothing_is_missing_nothing_is_added() -> None:
    sailed = draw(np.random.default_rng([3, 11]), samples=600)
    plain = replace(ASKED, remainder=False)
    logs = {"validate": [sailed.validation]}
    without = diagnose([sailed.estimation], options=plain, **logs)
    assert without.remainder is None
    assert "remainder" not in without.to_dict()
    found = diagnose([sailed.estimation], options=ASKED, **logs)
    told(found)
    assert not found.remainder.added
    assert "added" in found.remainder.reason
    assert found.model == without.model


@pytest.mark.parametrize(
    ("fall", "low", "high", "said"),
    [
        (0.3, 1.0, 5.0, "is not added: it improves the held-out free run of no state"),
        (0.3, -9.0, -2.0, "but u would be worse"),
        (0.02, 1.0, 5.0, "at least 5 % less are asked for"),
        (-0.1, -9.0, -2.0, "grow by 10 %"),
    ],
)
def test_what_is_not_added_is_said_with_the_reason(fall, low, high, said: str) -> None:
    gain = {"u": Gain(80.0, 80.0, (low, high))}
    assert said in _reason(Remainder(False, {"u": 24}, {"u": 0.1}, gain, "", ""), fall)
