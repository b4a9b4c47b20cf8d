"""Forty commands give the numbers that they gave before the package was rebuilt."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from fixed_results.commands import COMMANDS, beyond, difference, read_expected, run
from fixed_results.inputs import write_inputs


@pytest.fixture(scope="module")
def expected():
    return read_expected()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("fixed")
    write_inputs(where)
    return where


def test_forty_commands_are_fixed(expected):
    assert len(COMMANDS) == 40
    assert list(expected) == [f.name for f in COMMANDS]


@pytest.mark.parametrize(
    "fixed",
    [pytest.param(f, id=f.name, marks=() if f.quick else pytest.mark.long) for f in COMMANDS],
)
def test_numbers_stand(fixed, folder, expected):
    if fixed.out.endswith(".c") and shutil.which("cc") is None:
        pytest.skip("there is no C compiler 'cc'")
    off = beyond(fixed, run(fixed, folder), expected[fixed.name])
    assert not off, f"'greybox {fixed.words}': {'; '.join(off)}"


def test_a_number_that_moves_is_seen():
    want = {"theta": [1.0, -2.0, 1e-9], "tests": {"p_value": 0.5}}
    assert difference({"more": 1.0, **want}, want) == (0.0, "")
    apart, where = difference({**want, "theta": [1.0, -2.0 - 4e-9, 1e-9]}, want)
    assert apart == pytest.approx(2e-9, rel=1e-6)
    assert where == "/theta[1]"
    assert difference({"theta": [1.0, -2.0]}, want)[0] == np.inf


@pytest.mark.long
def test_the_last_digit_of_a_log_decides_nothing(folder, tmp_path):
    """Refinements of parts of this log do not converge; where they end must not be chance."""
    (fixed,) = (f for f in COMMANDS if f.name == "iv-nominal")
    found = [run(fixed, folder)]
    for name in ("ship.toml", "plain.json"):
        shutil.copy(folder / name, tmp_path)
    head, *lines = (folder / "pushed.csv").read_text().splitlines()
    rows = np.array([line.split(",") for line in lines], float)
    rows[:, 1:] *= 1 + 1e-12 * np.random.default_rng(1).standard_normal(rows[:, 1:].shape)
    np.savetxt(tmp_path / "pushed.csv", rows, "%.17g", ",", header=head, comments="")
    found.append(run(fixed, tmp_path))
    for key in ("theta", "calibration"):
        assert difference(found[1][key], found[0][key])[0] < 1e-7
