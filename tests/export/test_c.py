"""The exported C, compiled by the machine's compiler, against greybox's own free run."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from free_runs import (
    calm,
    held_heading,
    held_wind,
    program,
    run_program,
    variants,
    wanted,
    with_actuation,
)
from virtual import virtual_log

from greybox.errors import StructureError, UsageError
from greybox.export.export import export_model
from greybox.model.catalogue import get_structure
from greybox.model.model import ManoeuvringModel
from greybox.vessel.toml import vessel_from_dict

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler 'cc'")

NAMES = ("u", "v", "r", "psi", "x_n", "y_n")


@pytest.fixture(scope="module")
def model(thesis, ship, true_theta):
    return ManoeuvringModel(thesis, true_theta, np.zeros((18, 18)), 1.0, ship)


@pytest.fixture(scope="module")
def log():
    return virtual_log(3, 200, wind=2.0)


KINDS = tuple(
    variants(
        ManoeuvringModel(
            get_structure("thesis"), np.zeros(18), np.zeros((18, 18)), 1.0,
            vessel_from_dict({"name": "s", "length": 1.0, "thruster": [
                {"type": "fixed", "speed": "n"}, {"type": "azimuth", "speed": "n", "angle": "a"}]}),
        )
    )
)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_the_program_repeats_the_free_run(model, log, tmp_path, kind):
    model = variants(model)[kind]
    log = calm(model, log)
    want = wanted(model, log)
    columns = {c: log[c] for c in reversed(model.vessel.commands)}
    got = run_program(program(model, tmp_path), columns, want[0])
    assert tuple(got)[:6] == ("t", *NAMES[:5])
    np.testing.assert_allclose(
        np.column_stack([got[n] for n in NAMES]), want, rtol=1e-9, atol=1e-9
    )
    c, s = np.cos(want[:, 3]), np.sin(want[:, 3])
    np.testing.assert_allclose(got["v_n"], c * want[:, 0] - s * want[:, 1], atol=1e-9)
    np.testing.assert_allclose(got["v_e"], s * want[:, 0] + c * want[:, 1], atol=1e-9)
    north, east = model.d[:2]
    np.testing.assert_allclose(got["u_r"], want[:, 0] - (c * north + s * east), atol=1e-9)
    np.testing.assert_allclose(got["v_r"], want[:, 1] - (c * east - s * north), atol=1e-9)
