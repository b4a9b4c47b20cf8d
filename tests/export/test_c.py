"""The exported C, compiled by the machine's compiler, against greybox's own free run."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from free_runs import (
    KINDS,
    REAL,
    calm,
    held_heading,
    held_wind,
    program,
    real_model,
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
from greybox.validation.fit import run_model
from greybox.vessel.toml import vessel_from_dict

NAMES = ("u", "v", "r", "psi", "x_n", "y_n")
pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler 'cc'")


@pytest.fixture(scope="module")
def log():
    return virtual_log(3, 200, wind=2.0)


@pytest.mark.parametrize("kind", KINDS)
def test_the_program_repeats_the_free_run(model, log, tmp_path, kind):
    model = variants(model)[kind]
    log = calm(model, log)
    want = wanted(model, log)
    columns = {c: log[c] for c in reversed(model.vessel.commands)}
    got = run_program(program(model, tmp_path), columns, want[0])
    assert tuple(got)[:6] == ("t", *NAMES[:5])
    np.testing.assert_allclose(np.column_stack([got[n] for n in NAMES]), want, rtol=1e-9, atol=1e-9)
    c, s = np.cos(want[:, 3]), np.sin(want[:, 3])
    np.testing.assert_allclose(got["v_n"], c * want[:, 0] - s * want[:, 1], atol=1e-9)
    np.testing.assert_allclose(got["v_e"], s * want[:, 0] + c * want[:, 1], atol=1e-9)
    north, east = model.d[:2]
    np.testing.assert_allclose(got["u_r"], want[:, 0] - (c * north + s * east), atol=1e-9)
    np.testing.assert_allclose(got["v_r"], want[:, 1] - (c * east - s * north), atol=1e-9)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_measured_heading_and_wind_drive_it(model, log, tmp_path, integrator):
    model = replace(model, integrator=integrator)
    want = wanted(model, log, "measured")
    columns = {c: log[c] for c in model.vessel.commands}
    columns |= {n: held_wind(model, log[n]) for n in ("u_q", "v_q")}
    columns["psi"] = held_heading(model, log["psi"])
    start = want[0, [0, 1, 2, 4, 5]]
    ship = program(model, tmp_path, heading="measured", wind="relative")
    got = run_program(ship, columns, start)
    np.testing.assert_allclose(np.column_stack([got[n] for n in NAMES]), want, rtol=1e-9, atol=1e-9)


def test_a_surge_model_on_its_measured_heading(ship, tmp_path, log):
    model = ManoeuvringModel(
        get_structure("surge"), np.array([-0.05, -0.05, -5e-4, 0.02]), np.zeros((4, 4)), 1.0,
        ship, disturbances={"current_north": (0.3, 0.0)},
    )  # fmt: skip
    run = run_model(model, calm(model, log))
    columns = {c: log[c] for c in ship.commands} | {"psi": log["psi"]}
    got = run_program(program(model, tmp_path), columns, run.x[0])
    assert tuple(got) == ("t", "u", "psi", "u_r")
    np.testing.assert_allclose(got["u"], run.x[:, 0], rtol=1e-9)
    with pytest.raises(StructureError, match="no yaw rate, so its heading cannot be simulated"):
        export_model(model, "c", tmp_path / "x.c", heading="simulated")


@pytest.mark.parametrize("folder", REAL)
def test_a_real_log(data_folder, tmp_path, folder):
    model, log = real_model(data_folder, folder)
    want = wanted(model, calm(model, log))
    columns = {c: log[c] for c in model.vessel.commands}
    got = run_program(program(model, tmp_path), columns, want[0])
    found = np.column_stack([got[n] for n in NAMES])
    np.testing.assert_allclose(found, want, rtol=1e-9, atol=1e-9)


def test_two_ships_and_in_place(model, log, tmp_path):
    """States are apart, `next` may be `state`, and a C++ compiler takes the header."""
    program(model, tmp_path)
    (tmp_path / "two.cpp").write_text("""
        #include "ship.h"
        #include <stdio.h>
        int main() {
            ship_input in = {15, 0.8, 0.7, 1, 2};
            ship_state a = {1.5}, b = {-1}, next;
            ship_begin(&a, &in);
            ship_step(&a, &in, &next);
            ship_step(&b, &in, &b);
            ship_step(&a, &in, &a);
            printf("%d %.17g %.17g", a.u == next.u && a.y_n == next.y_n, a.u, b.u);
        }""")
    words = ["-I.", "-x", "c++", "two.cpp", "-x", "c", "ship.c", "-o", "two", "-lm"]
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("there is no C++ compiler 'c++'")
    subprocess.run([compiler, *words], cwd=tmp_path, check=True)
    same, a, b = subprocess.check_output([tmp_path / "two"], text=True).split()
    assert same == "1"
    theta = dict(zip(model.names, model.theta, strict=True))
    for got, u in ((a, 1.5), (b, -1.0)):
        force = 15 * (np.cos(0.8) + np.cos(0.7))
        air = u - 1
        want = u + theta["Xu"] * u + theta["Xuu"] * abs(u) * u + theta["Wuu"] * abs(air) * air
        want += theta["Xmu"] * force + theta["Xkappa"] * u * force
        assert float(got) == pytest.approx(want, rel=1e-12)


def test_the_example_names_what_is_missing(model, tmp_path):
    ship = program(model, tmp_path)

    def said(text, *words):
        done = subprocess.run([ship, *words], input=text, capture_output=True, text=True)
        return done.returncode, done.stderr

    start = ["0"] * 6
    assert said("", *start) == (1, "the log is empty\n")
    assert said("t,n,alpha1\n", *start)[1] == "the log has no column 'alpha2'\n"
    status, error = said("n,alpha1,alpha2\n1,2\n", *start)
    assert status == 1
    assert "column 'wind_north', 0 is taken" in error
    assert "row 2 has 2 cells, 3 are needed" in error
    assert "row 2: 'x' is no number" in said("n,alpha1,alpha2\n1,x,2\n", *start)[1]
    assert said("", "1") == (2, f"usage: {ship} U V R PSI X_N Y_N < LOG > RUN\n")


def test_hostile_names_stay_names(thesis, true_theta, log, tmp_path):
    """Columns and names that would end a comment or a string, or are words of C."""
    names = ['n */ #error "x" \\', "double", "α [rad]%s\n??/"]
    vessel = vessel_from_dict(
        {"name": "*/ bad \n#error \ud800", "length": 1.0, "thruster": [
            {"type": "azimuth", "x": 9.0, "speed": names[0], "angle": names[1]},
            {"type": "azimuth", "x": -9.0, "speed": names[0], "angle": names[2]}]}
    )  # fmt: skip
    model = ManoeuvringModel(thesis, true_theta, np.zeros((18, 18)), 1.0, vessel)
    program(model, tmp_path)
    header = (tmp_path / "ship.h").read_text()
    assert "double x_double;" in header
    assert "double n_error_x;" in header
    (tmp_path / "names.c").write_text(
        '#include "ship.h"\n#include <stdio.h>\n'
        "int main(void) { int i; for (i = 0; i < 3; i++) puts(ship_input_names[i]); return 0; }"
    )
    words = ["cc", "names.c", "ship.c", "-o", "names", "-lm"]
    subprocess.run(words, cwd=tmp_path, check=True)
    shown = subprocess.check_output([tmp_path / "names"]).decode().splitlines()
    assert shown == [names[0], names[1], "α [rad]%s ??/"]


def test_refusals(model, tmp_path):
    with pytest.raises(UsageError, match="is the name of a header"):
        export_model(model, "c", tmp_path / "ship.h")
    with pytest.raises(UsageError, match="cannot be named in C source"):
        export_model(model, "c", tmp_path / 'a"b.c')
    with pytest.raises(UsageError, match=r"is 5000 samples of 1 s of 3 commands.*at most 1000"):
        export_model(with_actuation(model, delay=5000.0), "c", tmp_path / "ship.c")
    assert list(tmp_path.iterdir()) == []
