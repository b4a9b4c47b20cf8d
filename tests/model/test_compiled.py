"""Machine code of a step gives the numbers that CasADi's interpreter gives, or is not taken."""

from __future__ import annotations

import shutil

import casadi as ca
import numpy as np
import pytest
from virtual import virtual_log

from greybox.estimation.informative import regime_of
from greybox.estimation.output_setup import measured, output_model, output_predictor
from greybox.model.catalogue import get_structure
from greybox.model.run import compiled
from greybox.model.run.kernels import FreeRunKernel, FreeRunStep, shallow
from greybox.model.run.output_runs import Filter, Simulator
from greybox.model.run.step import StepModel
from greybox.numerics import machine_code, recursion
from greybox.study.chapter6 import START, TRUE, pulse_forces

STRUCTURE = get_structure("thesis")
STEP = FreeRunStep(StepModel.free(STRUCTURE, "rk4"))
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """Compile each step at once, into a folder of this test."""
    # what all runs share is opened before
    recursion.propagate(np.eye(1)[None], np.eye(1)[None], np.eye(1))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(compiled, "_LOOK", 0)
    monkeypatch.setattr(compiled, "_PAYS", 0)
    compiled.loop_of.cache_clear()
    yield tmp_path / "greybox"
    compiled.loop_of.cache_clear()


@pytest.fixture
def interpreted(monkeypatch):
    """Take no machine code in the calls made by this."""

    def run(work):
        with monkeypatch.context() as inside:
            inside.setattr(compiled.Loop, "pays", lambda *_: False)
            return work()

    return run


def kernel(samples=700):
    made = FreeRunKernel(STEP.function, samples)
    made.read[:] = pulse_forces(samples)
    made.start[:3] = START
    made.constants[0][:] = [TRUE[n] for n in STRUCTURE.parameters]
    made.constants[1][:] = 1.0
    return made


@needs_compiler
def test_a_free_run_is_the_same_to_the_last_bit(cache, interpreted):
    expected = interpreted(lambda: kernel()().copy())
    np.testing.assert_array_equal(kernel()(), expected)
    out = np.empty_like(expected)
    kernel()(out)
    np.testing.assert_array_equal(out, expected)
    (library,) = cache.iterdir()
    assert cache.stat().st_mode & 0o777 == 0o700
    assert library.suffix == ".so"


def chain(step):
    """Return how many operations on two numbers wait for one another."""
    waits, longest = {}, 0
    for k in range(step.n_instructions()):
        source, target = step.instruction_input(k), step.instruction_output(k)
        if step.instruction_id(k) in (ca.OP_INPUT, ca.OP_CONST):
            waits[target[0]] = 0
        elif step.instruction_id(k) != ca.OP_OUTPUT:
            waits[target[0]] = max(waits[i] for i in source) + len(source) - 1
            longest = max(longest, waits[target[0]])
    return longest


def test_sums_in_another_order_are_the_same_to_rounding():
    x, c = ca.SX.sym("x", 3), ca.SX.sym("c", 4)
    a, b, r = x[0] * x[1], x[1], ca.fabs(x[2])
    again = (a + b) + (a + b + c[0])
    halves = ca.sin(0.5 * r + 0.5 * r + c[1] * r) - c[2]
    rows = ca.vertcat(again, halves, c[0] * r + c[3] * r + x[0] + c[2] * b + 2)
    plain = ca.Function("plain", [x, c], [rows])
    given = np.random.default_rng(0).standard_normal((2, 4))
    step = shallow(plain, 1)
    found, expected = (f(given[0, :3], given[1]) for f in (step, plain))
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    assert step.n_instructions() < plain.n_instructions()


@pytest.mark.parametrize("rule", ["euler", "rk4"])
def test_a_step_of_free_runs_is_that_of_the_model_by_a_shorter_chain(rule):
    model = StepModel.free(STRUCTURE, rule)
    step, given = FreeRunStep(model).function, [0.8, -0.1, 0.02, 0.3]
    tau, theta = pulse_forces(30)[25], [TRUE[n] for n in STRUCTURE.parameters]
    still = np.zeros(len(STRUCTURE.disturbances)), given[:2]
    expected = model.function(given[:3], given[3], tau, *still, theta, 1.0)
    np.testing.assert_allclose(step(given, tau, theta, 1.0), expected, rtol=1e-14)
    assert chain(step) < 0.8 * chain(model.function)


@needs_compiler
def test_output_runs_side_by_side_are_the_same(cache, interpreted):
    log = virtual_log(3, 400)
    predictor = output_predictor(STRUCTURE, "wind", regime_of([log], STRUCTURE))
    model = output_model(predictor, log.sample_time)
    data = measured(model, log)
    w, y = np.stack([data.w, data.w[::-1]]), np.stack([data.y, data.y[::-1]])
    z0, use = y[:, 0].copy(), np.ones(w.shape[:2])
    p = np.zeros(len(model.parameters))
    known = dict(zip(STRUCTURE.parameters, [TRUE[n] for n in STRUCTURE.parameters], strict=True))
    p[: len(predictor.columns)] = [known.get(c.name, 0.0) for c in predictor.columns]
    noise = np.full(y.shape[2] + len(model.states), 1e-3)

    def runs():
        return [*Simulator(model, w)(z0, p), *Filter(model, w, y, use)(z0, p, noise)]

    before = len(list(cache.iterdir()))
    for found, expected in zip(runs(), interpreted(runs), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert len(list(cache.iterdir())) == before + 2


@needs_compiler
def test_what_was_compiled_before_is_opened(cache, monkeypatch):
    expected = kernel()().copy()
    compiled.loop_of.cache_clear()
    monkeypatch.setattr(machine_code, "find_compiler", lambda: pytest.fail("it was compiled again"))
    np.testing.assert_array_equal(kernel()(), expected)


def test_steps_are_interpreted_until_compiling_pays(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(machine_code, "find_compiler", lambda: None)
    loop = compiled.loop_of.__wrapped__(STEP.function, 1)
    assert not loop.pays(1)
    assert not (tmp_path / "greybox").exists()
    assert not loop.pays(10**7)


@pytest.mark.parametrize("what", ["no compiler", "open to others", "no library", "no folder"])
def test_without_a_compiler_or_a_folder_of_ones_own_casadi_runs(
    what, cache, interpreted, monkeypatch
):
    expected = interpreted(lambda: kernel()().copy())
    if what == "no compiler":
        monkeypatch.setattr(machine_code, "find_compiler", lambda: None)
    elif what == "open to others":
        cache.mkdir(mode=0o700)
        cache.chmod(0o777)
    elif what == "no folder":
        cache.write_text("")
    else:
        monkeypatch.setattr(machine_code, "shared_library", lambda *_: b"no library")
    np.testing.assert_array_equal(kernel()(), expected)
    assert not compiled.loop_of(STEP.function, 1).pays(1)


@needs_compiler
def test_few_libraries_are_kept(cache, monkeypatch):
    monkeypatch.setattr(machine_code, "_MOST", 1)
    for rule in ("rk4", "euler"):
        step = FreeRunStep(StepModel.free(STRUCTURE, rule)).function
        assert compiled.loop_of(step, 1).pays(1)
    assert len(list(cache.iterdir())) == 1
