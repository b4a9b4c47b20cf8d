"""Factors that vanish away from a centre: values, files, symmetry."""

from __future__ import annotations

import json

import casadi as ca
import numpy as np
import pytest
from free_runs import with_bumps
from schemas import schema

from greybox.errors import ModelFileError, StructureError
from greybox.model.catalogue import get_structure
from greybox.model.conversion import to_prime
from greybox.model.model import ManoeuvringModel, load_model, model_from_dict
from greybox.model.terms import Factor, Term, parameter_unit
from greybox.model.versions import VERSION
from greybox.vessel.toml import load_vessel

BUMP = Factor("u", centre=0.4, width=0.3)
FLAT = Factor("u", centre=0.4, width=0.3, flat=0.2)


@pytest.fixture(scope="module")
def model() -> ManoeuvringModel:
    structure = get_structure("thesis")
    size = len(structure.parameters)
    plain = ManoeuvringModel(
        structure, np.linspace(-0.1, 0.1, size), 1e-4 * np.eye(size), 0.5, load_vessel("thesis")
    )
    return with_bumps(plain)


def evaluated(factor: Factor, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return values and derivatives."""
    x = ca.SX.sym("x")
    y = factor.of(x)
    both = ca.Function("f", [x], [y, ca.jacobian(y, x)])
    return tuple(np.array(both(values[None])[i]).ravel() for i in range(2))  # type: ignore


@pytest.mark.parametrize("factor", [BUMP, FLAT])
def test_a_bump_is_smooth_and_zero_outside(factor: Factor) -> None:
    x = np.linspace(-1, 2, 301)
    value, slope = evaluated(factor, x)
    away = np.maximum(np.abs(x - 0.4) - factor.flat, 0.0)
    expected = np.where(away < 0.3, (1 - (away / 0.3) ** 2) ** 2, 0.0)
    np.testing.assert_allclose(value, expected, atol=1e-15)
    assert (value[away >= 0.3] == 0).all()
    assert (slope[away >= 0.3] == 0).all()
    step = 1e-6
    up, down = evaluated(factor, x + step)[0], evaluated(factor, x - step)[0]
    np.testing.assert_allclose(slope, (up - down) / (2 * step), atol=1e-4)


@pytest.mark.parametrize("centre", [0.4, -1 / 3, 1e-12, 2.5e17])
def test_a_bump_is_read_as_it_was_written(centre: float) -> None:
    for factor in (
        Factor("taux", centre=centre, width=1 / 7),
        Factor("r", False, centre, 0.1, 0.3),
    ):
        assert Factor.read(str(factor)) == factor
    assert str(BUMP) == "bump(u,0.4,0.3)"
    assert Factor.read("|u|") == Factor("u", modulus=True)


@pytest.mark.parametrize(
    "text",
    [
        "bump(u)", "bump(u,0.4)", "bump(u,0.4,0)", "bump(u,0.4,-1)", "bump(u,nan,1)",
        "bump(u,0.4,inf)", "bump(u,0.4,1e999)", "bump(u,0.4,1,-1)", "bump(u,1,2,3,4)",
        "bump(__import__('os'),1,1)", "bump(u,1_0,1)", "bump(u, 1, 1)", "bump(u,1,1", "bump(w,1,1)",
    ],
)  # fmt: skip
def test_a_damaged_bump_is_one_sentence(model: ManoeuvringModel, text: str) -> None:
    data = json.loads(json.dumps(model.to_dict()))
    data["structure"]["terms"][-1]["factors"] = [text]
    with pytest.raises(ModelFileError, match="damaged model file") as told:
        model_from_dict(data, "m.json")
    assert "\n" not in str(told.value)


def test_a_width_that_is_not_positive_is_refused() -> None:
    with pytest.raises(StructureError, match="the width 0 "):
        Factor("u", width=0.0)


def test_the_file_holds_the_bumps(model: ManoeuvringModel, tmp_path) -> None:
    model.save(tmp_path / "m.json")
    schema(f"model-{VERSION}").validate(json.loads((tmp_path / "m.json").read_text()))
    assert load_model(tmp_path / "m.json") == model


def test_bumps_are_pure_numbers_and_one_line_of_the_equations(model: ManoeuvringModel) -> None:
    first = Term("X_g1", "u", (BUMP, FLAT))
    assert parameter_unit(first) == "m/s"
    assert parameter_unit(Term("X_g1", "u", (BUMP, Factor("u")))) == parameter_unit(
        Term("X_g2", "u", (Factor("u"),))
    )
    assert model.structure.equations()[0].endswith(" + g_u(u_r, v_r, taux)  [1 bump]")
    assert "X_g1" not in model.summary()
    assert "g_u at most" in model.summary()
    assert "X_g1" not in to_prime({"X_g1": 1.0, "Xu": 1.0}, model.structure, length=1, speed=1)


def test_without_its_bumps_a_model_is_what_it_was(model: ManoeuvringModel) -> None:
    plain = model.estimable()
    assert plain.structure == get_structure("thesis")
    p = len(plain.theta)
    np.testing.assert_array_equal(plain.theta, model.theta[:p])
    np.testing.assert_array_equal(plain.covariance, model.covariance[:p, :p])
    assert plain.estimable() is plain


def test_two_bumps_are_two_functions() -> None:
    base = get_structure("thesis")
    wide = base.with_terms(Term("X_g1", "u", (BUMP,)), Term("X_g2", "u", (FLAT,)))
    assert wide.parameters[-2:] == ("X_g1", "X_g2")
    with pytest.raises(StructureError, match="same function"):
        base.with_terms(Term("X_g1", "u", (BUMP,)), Term("X_g2", "u", (BUMP,)))


@pytest.mark.parametrize(
    ("factors", "even", "dissipates"),
    [
        ((Factor("v", width=1.0),), True, False),
        ((Factor("v", centre=0.2, width=1.0),), False, False),
        ((Factor("v"), Factor("u", centre=0.2, width=1.0)), False, True),
        ((Factor("v"), Factor("v", width=1.0)), False, True),
        ((Factor("r"), Factor("v"), Factor("r", width=1.0)), True, False),
    ],
)
def test_symmetry_and_damping(factors, even: bool, dissipates: bool) -> None:
    term = Term("Y_g1", "v", factors)
    assert (term.even, term.dissipates) == (even, dissipates)
