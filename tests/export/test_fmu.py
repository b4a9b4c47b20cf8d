"""The FMU under FMPy: valid, and its runs those of greybox."""

from __future__ import annotations

import shutil
import subprocess
import zipfile
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from free_runs import (
    REAL,
    calm,
    held_heading,
    held_wind,
    real_model,
    variants,
    wanted,
)
from virtual import virtual_log

from greybox.errors import ExportError
from greybox.export.export import export_model
from greybox.model.catalogue import get_structure
from greybox.model.model import ManoeuvringModel
from greybox.validation.fit import run_model
from greybox.vessel.toml import vessel_from_dict

fmpy = pytest.importorskip("fmpy", reason="fmpy is not installed")
from fmpy.fmi2 import FMU2Slave  # noqa: E402
from fmpy.simulation import FMICallException  # noqa: E402
from fmpy.validation import validate_fmu  # noqa: E402

NAMES = ("u", "v", "r", "psi", "x_n", "y_n")
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")


@pytest.fixture(scope="module")
def log():
    return virtual_log(3, 120, wind=2.0)


@pytest.fixture(scope="module")
def plain(model, tmp_path_factory):
    """The FMU of the plain model."""
    path = tmp_path_factory.mktemp("fmu") / "ship.fmu"
    export_model(model, "fmu", path)
    return path


def start_of(row):
    return {f"{n}_start": float(v) for n, v in zip(NAMES, row, strict=True)}


def simulated(path, log, columns, start, **values):
    """Run an FMU on columns of a log, one communication step a sample."""
    dtype = [("time", float), *[(n, float) for n in columns]]
    t = np.arange(len(log)) * log.sample_time
    signals = np.array(list(zip(t, *columns.values(), strict=True)), dtype=dtype)
    result = fmpy.simulate_fmu(
        str(path), stop_time=t[-1], output_interval=log.sample_time, input=signals,
        start_values=start_of(start) | values, output=list(NAMES),
    )  # fmt: skip
    np.testing.assert_allclose(result["time"], t, atol=1e-9)
    return np.column_stack([result[n] for n in NAMES])


@contextmanager
def instance(path, **values):
    """An initialised instance, its value references by name, and setters that take names."""
    folder = fmpy.extract(str(path))
    description = fmpy.read_model_description(folder)
    where = {v.name: v.valueReference for v in description.modelVariables}

    def another(name="one", **values):
        made = FMU2Slave(
            guid=description.guid, unzipDirectory=folder, instanceName=name,
            modelIdentifier=description.coSimulation.modelIdentifier,
        )  # fmt: skip
        made.instantiate()
        made.setupExperiment(startTime=0.0)
        ship = SimpleNamespace(
            fmu=made,
            set=lambda **v: made.setReal([where[n] for n in v], list(v.values())),
            get=lambda *n: made.getReal([where[k] for k in n]),
            another=another,
        )
        ship.set(**values)
        made.enterInitializationMode()
        made.exitInitializationMode()
        return ship

    try:
        yield another(**values)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def test_it_is_valid(plain):
    assert validate_fmu(str(plain)) == []
    description = fmpy.read_model_description(str(plain))
    by_name = {v.name: v for v in description.modelVariables}
    assert by_name["n"].causality == "input"
    assert by_name["n"].unit is None
    assert "[unit of the log]" in by_name["n"].description
    assert by_name["alpha1"].unit == "rad"
    assert by_name["Xuu"].unit == "s/m"
    assert (by_name["Xuu"].causality, by_name["Xuu"].variability) == ("parameter", "tunable")
    assert float(by_name["Xuu"].start) == -0.05
    assert by_name["psi"].unit == "rad"
    units = {u.name: u.baseUnit for u in description.unitDefinitions}
    assert (units["s/m"].s, units["s/m"].m) == (1, -1)
    assert (units["rad/s"].rad, units["rad/s"].s) == (1, -1)
    assert units["m/(s n)"] is None
    assert float(description.defaultExperiment.stepSize) == 1.0


@needs_compiler
@pytest.mark.parametrize("kind", ["wind", "late", "thrusters"])
def test_it_repeats_the_free_run(model, log, tmp_path, kind):
    model = variants(model)[kind]
    export_model(model, "fmu", tmp_path / "ship.fmu")
    assert validate_fmu(str(tmp_path / "ship.fmu")) == []
    log = calm(model, log)
    want = wanted(model, log)
    columns = {c: log[c] for c in model.vessel.commands}
    got = simulated(tmp_path / "ship.fmu", log, columns, want[0])
    np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-9)


@needs_compiler
def test_coefficients_are_set_and_heading_and_wind_measured(model, plain, log):
    """One FMU runs as the plain model, and as another of the same structure."""
    columns = {c: log[c] for c in model.vessel.commands}
    want = wanted(model, calm(model, log))
    np.testing.assert_allclose(simulated(plain, log, columns, want[0]), want, rtol=1e-9, atol=1e-9)
    other = replace(model, theta=0.9 * model.theta, disturbances={"current_east": (0.4, 0.0)})
    values = dict(zip(other.names, other.theta, strict=True)) | {"current_east": 0.4}
    measured = columns | {n: held_wind(model, log[n]) for n in ("u_q", "v_q")}
    measured["psi_measured"] = held_heading(model, log["psi"])
    want = wanted(other, log, "measured")
    got = simulated(
        plain, log, measured, want[0], heading_measured=True, wind_measured=True, **values
    )
    # the recorder reads the outputs before it sets the inputs of that time
    got[1:, 3] = np.append(got[2:, 3], want[-1, 3])
    np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-9)


@needs_compiler
def test_a_surge_model(ship, log, tmp_path):
    """Without a yaw rate the heading is always measured, and there is no position."""
    model = ManoeuvringModel(
        get_structure("surge"), np.array([-0.05, -0.05, -5e-4, 0.02]), np.zeros((4, 4)), 1.0,
        ship, disturbances={"current_north": (0.3, 0.0)},
    )  # fmt: skip
    export_model(model, "fmu", tmp_path / "ship.fmu")
    assert validate_fmu(str(tmp_path / "ship.fmu")) == []
    want = run_model(model, calm(model, log)).x[:, 0]
    with instance(tmp_path / "ship.fmu", u_start=want[0]) as one:
        for k in range(len(log) - 1):
            one.set(psi_measured=log["psi"][k], **{c: log[c][k] for c in ship.commands})
            one.fmu.doStep(float(k), 1.0)
            assert one.get("u")[0] == pytest.approx(want[k + 1], rel=1e-9)


@needs_compiler
@pytest.mark.parametrize("folder", REAL)
def test_a_real_log(data_folder, tmp_path, folder):
    model, log = real_model(data_folder, folder)
    log = log.window(0, 250)
    export_model(model, "fmu", tmp_path / "ship.fmu")
    columns = {c: log[c] for c in model.vessel.commands}
    if log.has_wind:
        columns |= {n: log[n] for n in ("u_q", "v_q")}
        assert validate_fmu(str(tmp_path / "ship.fmu")) == []
    want = wanted(model, replace(log, vessel=model.vessel))
    choice = {"wind_measured": True} if log.has_wind else {}
    got = simulated(tmp_path / "ship.fmu", log, columns, want[0], **choice)
    np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-9)


@needs_compiler
def test_communication_steps_of_any_length(model, plain):
    """On the grid always the same run; between its instants on a straight line."""
    values = start_of([1.5, 1.2, 0, 0, 0, 0]) | {"n": 15.0, "alpha1": 0.8, "alpha2": 0.9}

    def run(steps):
        found, time = {}, 0.0
        with instance(plain, **values) as ship:
            for step in steps:
                ship.fmu.doStep(time, step)
                time += step
                found[round(time, 6)] = np.array(ship.get(*NAMES))
        return found

    ones = run([1.0] * 6)
    for steps in ([6.0], [0.3] * 20, [0.7, 0.3, 1.6, 1.4, 2.0], [0.0, 2.5, 3.5]):
        other = run(steps)
        for time in ones.keys() & other.keys():
            np.testing.assert_array_equal(other[time], ones[time])
    fine = run([0.25] * 8)
    np.testing.assert_allclose(fine[1.25], 0.75 * ones[1.0] + 0.25 * ones[2.0], rtol=1e-14)


@needs_compiler
def test_inputs_between_instants_act_from_the_next_on(model, plain):
    values = {"u_start": 1.0, "n": 15.0, "alpha1": 0.8, "alpha2": 0.8}
    with instance(plain, **values) as late, instance(plain, **values) as plain_ship:
        late.fmu.doStep(0.0, 0.5)
        late.set(n=20.0)
        late.fmu.doStep(0.5, 0.5)
        plain_ship.fmu.doStep(0.0, 1.0)
        assert late.get("u") == plain_ship.get("u")
        plain_ship.set(n=20.0)
        for ship in (late, plain_ship):
            ship.fmu.doStep(1.0, 1.0)
        assert late.get("u") == plain_ship.get("u")


@needs_compiler
def test_instances_reset_and_states(model, log, tmp_path):
    """Two ships side by side; reset; a state kept, serialised and taken up again."""
    model = variants(model)["late"]
    export_model(model, "fmu", tmp_path / "ship.fmu")
    values = {"n": 15.0, "alpha1": 0.8, "alpha2": 0.8}

    def sail(ship, first, last):
        for k in range(first, last):
            ship.set(n=12.0 + k % 5)
            ship.fmu.doStep(0.4 * k, 0.4)
        return ship.get(*NAMES)

    with instance(tmp_path / "ship.fmu", u_start=1.0, **values) as one:
        two = one.another("two", u_start=2.0, **values)
        sail(one, 0, 20)
        state = one.fmu.getFMUstate()
        frozen = one.fmu.serializeFMUstate(state)
        end = sail(one, 20, 40)
        assert sail(two, 0, 40) != end
        one.fmu.setFMUstate(state)
        assert sail(one, 20, 40) == end
        thawed = two.fmu.deSerializeFMUstate(frozen)
        two.fmu.setFMUstate(thawed)
        assert sail(two, 20, 40) == end
        for ship, kept in ((one, state), (two, thawed)):
            ship.fmu.freeFMUstate(kept)
        one.fmu.reset()
        one.fmu.setupExperiment(startTime=0.0)
        one.set(u_start=1.0, **values)
        one.fmu.enterInitializationMode()
        one.fmu.exitInitializationMode()
        assert sail(one, 0, 40) == end
        with pytest.raises(FMICallException):
            two.fmu.deSerializeFMUstate(frozen[:-1])
        for ship in (one, two):
            ship.fmu.terminate()
            ship.fmu.freeInstance()


@needs_compiler
def test_wrong_calls_are_refused_with_a_sentence(plain, capfd):
    def refused(call, *arguments):
        with pytest.raises(FMICallException):
            call(*arguments)
        return capfd.readouterr().out

    with instance(plain, n=15.0) as ship:
        fmu = ship.fmu
        ship.fmu.doStep(0.0, 1.0)
        assert "begins at 3 s, but the last step ended at 1 s" in refused(fmu.doStep, 3.0, 1.0)
        assert "a step of -1 s, it must be positive" in refused(fmu.doStep, 1.0, -1.0)
        assert "set before the initialisation ends" in refused(lambda: ship.set(u_start=1.0))
        assert "only parameters and inputs can be set" in refused(lambda: ship.set(u=1.0))
        assert "no such value reference" in refused(fmu.getReal, [999])
        assert "no variable of this type" in refused(fmu.getInteger, [0])
        assert "was initialised before" in refused(fmu.enterInitializationMode)
        ship.set(Xu=50.0)
        assert "the motion diverged after" in refused(fmu.doStep, 1.0, 1e4)
        assert "is not initialised, or has ended" in refused(fmu.doStep, 1.0, 1.0)


@needs_compiler
def test_same_model_same_bytes(model, plain, tmp_path):
    export_model(model, "fmu", tmp_path / "ship.fmu")
    assert (tmp_path / "ship.fmu").read_bytes() == plain.read_bytes()
    export_model(replace(model, theta=model.theta * 1.01), "fmu", tmp_path / "ship.fmu")
    one, two = (fmpy.read_model_description(str(p)).guid for p in (plain, tmp_path / "ship.fmu"))
    assert one != two


def test_without_a_compiler_there_is_source_only(model, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    exported = export_model(model, "fmu", tmp_path / "ship.fmu")
    assert any("source only, because this machine has no C compiler" in n for n in exported.notes)
    assert validate_fmu(str(tmp_path / "ship.fmu")) == []
    names = zipfile.ZipFile(tmp_path / "ship.fmu").namelist()
    assert not [n for n in names if n.startswith("binaries")]
    assert {"sources/fmu.c", "sources/model.c", "sources/model.h", "sources/fmi2.h"} <= set(names)
    monkeypatch.setenv("CC", "nocc -m32")
    with pytest.raises(ExportError, match="CC is 'nocc -m32', and there is no program 'nocc'"):
        export_model(model, "fmu", tmp_path / "ship.fmu")


@needs_compiler
def test_a_compiler_that_fails(model, tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "false")
    with pytest.raises(ExportError, match=r"'false' ended with status 1 \(and said nothing\)"):
        export_model(model, "fmu", tmp_path / "ship.fmu")
    assert list(tmp_path.iterdir()) == []
    exported = export_model(model, "fmu", tmp_path / "ship.fmu", binary=False)
    assert "the FMU holds its C source only, as asked for" in exported.notes


@needs_compiler
@pytest.mark.skipif(shutil.which("cmake") is None, reason="there is no cmake")
def test_an_importer_can_compile_the_sources(model, log, tmp_path):
    """FMPy's own build of a source FMU, with every warning on."""
    from fmpy.build import build_platform_binary

    export_model(model, "fmu", tmp_path / "ship.fmu", binary=False)
    folder = fmpy.extract(str(tmp_path / "ship.fmu"), unzipdir=str(tmp_path / "ship"))
    (tmp_path / "build").mkdir()
    build_platform_binary(folder, build_dir=tmp_path / "build")
    result = fmpy.simulate_fmu(folder, stop_time=2.0, output_interval=1.0)
    assert len(result) == 3


@needs_compiler
def test_two_models_in_one_program(model, tmp_path):
    """Compiled into a program, the functions carry the model's name."""
    for name in ("one", "two"):
        export_model(model, "fmu", tmp_path / f"{name}.fmu", binary=False)
        with zipfile.ZipFile(tmp_path / f"{name}.fmu") as archive:
            archive.extractall(tmp_path / name)
    (tmp_path / "main.c").write_text("""
        #include <stdio.h>
        const char *one_fmi2GetVersion(void), *two_fmi2GetVersion(void);
        int main(void) { return printf("%s %s", one_fmi2GetVersion(), two_fmi2GetVersion()) < 0; }
    """)
    sources = [str(p) for n in ("one", "two") for p in (tmp_path / n / "sources").glob("*.c")]
    subprocess.run(["cc", "main.c", *sources, "-o", "main", "-lm"], cwd=tmp_path, check=True)
    assert subprocess.check_output([tmp_path / "main"]) == b"2.0 2.0"


@needs_compiler
def test_hostile_names_stay_names(true_theta, log, tmp_path):
    """Names with markup, quotes, no characters of XML, and names of outputs."""
    names = ['<n> & "x" \x01', "psi_start", "Xu"]
    vessel = vessel_from_dict(
        {"name": "</a> ]]> \ud800 */", "length": 1.0, "thruster": [
            {"type": "azimuth", "x": 9.0, "speed": names[0], "angle": names[1]},
            {"type": "azimuth", "x": -9.0, "speed": names[0], "angle": names[2]}]}
    )  # fmt: skip
    model = ManoeuvringModel(get_structure("thesis"), true_theta, np.zeros((18, 18)), 1.0, vessel)
    export_model(model, "fmu", tmp_path / "int.fmu")
    assert validate_fmu(str(tmp_path / "int.fmu")) == []
    description = fmpy.read_model_description(str(tmp_path / "int.fmu"))
    assert description.coSimulation.modelIdentifier == "x_int"
    inputs = [v.name for v in description.modelVariables if v.causality == "input"]
    assert inputs[:3] == ['<n> & "x" ?', "psi_start", "Xu"]
    parameters = [v.name for v in description.modelVariables if v.causality == "parameter"]
    assert {"psi_start_2", "Xu_2"} <= set(parameters)
    with instance(tmp_path / "int.fmu", u_start=1.0) as ship:
        ship.fmu.doStep(0.0, 1.0)
        assert np.isfinite(ship.get("u")).all()
