"""Models as `greybox diagnose` extends them, exported from their file."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from free_runs import calm, program, run_program, wanted

from greybox.diagnosis.diagnose import diagnose
from greybox.model.model import load_model
from greybox.study.blind import draw


@pytest.mark.long
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler 'cc'")
@pytest.mark.parametrize("cause", ["thruster_lag", "input_delay", "current"])
def test_an_extended_model(tmp_path, cause):
    trial = draw(np.random.default_rng([31, 1]), (cause,), kind="manoeuvres", samples=600)
    found = diagnose([trial.estimation], validate=[trial.validation])
    assert [c.id for c in found.causes] == [cause]
    found.model.save(tmp_path / "model.json")
    model = load_model(tmp_path / "model.json")
    log = calm(model, replace(trial.validation, vessel=model.vessel))
    want = wanted(model, log)
    columns = {c: log[c] for c in model.vessel.commands}
    got = run_program(program(model, tmp_path), columns, want[0])
    names = ("u", "v", "r", "psi", "x_n", "y_n")
    found_run = np.column_stack([got[n] for n in names])
    np.testing.assert_allclose(found_run, want, rtol=1e-9, atol=1e-9)
