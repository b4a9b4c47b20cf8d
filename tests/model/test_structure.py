"""Terms, structures, and the functions that follow from one expression."""

from __future__ import annotations

import pickle

import casadi as ca
import numpy as np
import pytest

from greybox.errors import StructureError
from greybox.model.catalogue import get_structure, structure_names
from greybox.model.disturbances import TURNING
from greybox.model.run.step import StepModel
from greybox.model.terms import Factor, Term, parameter_unit, parse_term
from greybox.numerics.vectorised import Vectorised


def test_one_line_adds_a_term():
    structure = get_structure("thesis").with_terms("N_|r|r")
    assert structure.parameters[-1] == "N_|r|r"
    assert "N_|r|r·|r|·r" in structure.equations()[2]


def test_what_no_regression_can_find_is_left_out_of_it():
    """Without a current the water's own velocity is zero, and tells nothing of its coefficient."""
    plain = get_structure("thesis")
    wider = plain.with_terms(*TURNING)
    assert wider.estimable() == plain
    assert "X_r*vc·r·v_c" in wider.equations()[0]
    s = wider.symbols
    water = ca.substitute(ca.vertcat(*wider.regressors(air_measured=False)[-2:]), s.d, 0 * s.d)
    assert water.is_zero()


@pytest.mark.parametrize(
    ("name", "canonical"),
    [("X_|u|u", "Xuu"), ("Y_r|v|", "Yvr"), ("N_taun", "Nmu"), ("X_uuu", "X_uuu")],
)
def test_spellings(name, canonical):
    assert parse_term(name).name == canonical


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Xuuu", "spell it by equation"),
        ("N_|w|r", "cannot be read at"),
        ("Xm", "Did you mean 'Xmu'"),
        ("Q_u", "is not a term"),
    ],
)
def test_unknown_terms_say_what_to_do(name, message):
    with pytest.raises(StructureError, match=message.replace("|", r"\|")):
        parse_term(name)


def test_unknown_structure_suggests():
    with pytest.raises(StructureError, match="Did you mean 'abkowitz'"):
        get_structure("abkovitz")


def test_a_term_twice_is_refused():
    with pytest.raises(StructureError, match="has Xu 2 times"):
        get_structure("thesis").with_terms("X_u")
    twin = Term("other", "u", (Factor("u"), Factor("u", True)))
    with pytest.raises(StructureError, match="Xuu and other are the same function"):
        get_structure("thesis").with_terms(twin)


def test_names_change_structures():
    structure = get_structure("thesis+X_uuu-Xkappa")
    assert "X_uuu" in structure.parameters
    assert "Xkappa" not in structure.parameters
    assert structure.name == "thesis+X_uuu-Xkappa"


def test_structures_survive_pickling():
    structure = get_structure("thesis")
    _ = structure.symbols
    assert pickle.loads(pickle.dumps(structure)) == structure


def thesis_step(x, psi, tau, d, th):
    """(3.51), typed from the thesis."""
    u, v, r = x
    c, s = np.cos(psi), np.sin(psi)
    ur, vr = u - (c * d[0] + s * d[1]), v - (-s * d[0] + c * d[1])
    uq, vq = u - (c * d[2] + s * d[3]), v - (-s * d[2] + c * d[3])
    return np.array(
        [
            u + th[0] * ur + th[1] * vr * r + th[2] * abs(ur) * ur + th[3] * abs(uq) * uq
            + th[4] * tau[0] + th[5] * ur * tau[0],
            v + th[6] * vr + th[7] * ur * r + th[8] * abs(vr) * vr + th[9] * abs(vr) * r
            + th[10] * abs(vq) * vq + th[11] * tau[1],
            r + th[12] * r + th[13] * ur * vr + th[14] * abs(vr) * vr + th[15] * abs(vr) * r
            + th[16] * uq * vq + th[17] * tau[2],
        ]
    )  # fmt: skip


def test_step_is_the_thesis_model(thesis, true_theta):
    rng = np.random.default_rng(0)
    step = StepModel(thesis).function
    for _ in range(20):
        x, tau, d = rng.normal(size=3), rng.normal(size=3), rng.normal(size=4)
        psi = rng.normal()
        got = np.array(step(x, psi, tau, d, [0, 0], true_theta, 1)).ravel()
        np.testing.assert_allclose(got, thesis_step(x, psi, tau, d, true_theta), rtol=1e-12)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("name", ["thesis", "modulus", "abkowitz"])
def test_jacobians_equal_finite_differences(name, integrator):
    structure = get_structure(name)
    rng = np.random.default_rng(1)
    theta = rng.uniform(-0.3, 0.3, len(structure.terms))
    x, tau, d = rng.uniform(0.5, 1.5, 3), rng.normal(size=3), rng.normal(size=4) * 0.1
    model = StepModel(structure, integrator)
    step = model.function
    a, b, p, e = (np.array(m) for m in model.jacobians(x, 0.4, tau, d, [0, 0], theta, 1))
    h = 1e-6

    def numeric(which, size):
        out = np.zeros((3, size))
        for i in range(size):
            values = []
            for sign in (1, -1):
                args = {"x": x.copy(), "tau": tau.copy(), "theta": theta.copy(), "d": d.copy()}
                args[which][i] += sign * h
                values.append(
                    np.array(
                        step(args["x"], 0.4, args["tau"], args["d"], [0, 0], args["theta"], 1)
                    ).ravel()
                )
            out[:, i] = (values[0] - values[1]) / (2 * h)
        return out

    for matrix, which, size in ((a, "x", 3), (b, "tau", 3), (p, "theta", len(theta)), (e, "d", 4)):
        np.testing.assert_allclose(matrix, numeric(which, size), atol=1e-7)


def test_vectorised_equals_the_virtual_machine():
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    expressions = [
        x * ca.fabs(y), ca.sin(x) ** 2, ca.sign(y) / (1 + x**2), ca.fmax(x, y), ca.SX(3),
        ca.exp(-x) + ca.sqrt(ca.fabs(y)), ca.if_else(x > y, x, y),
        ca.tanh(x) - ca.atan2(y, 1 + x**2),
        x**3 + 2 * x, ca.fmin(x, 0), ca.SX(0),
    ]  # fmt: skip
    rng = np.random.default_rng(2)
    xs, ys = rng.normal(size=(2, 50))
    got = Vectorised(expressions, [x, y])([xs, ys], np.empty((len(expressions), 50)))
    function = ca.Function("f", [x, y], [ca.vertcat(*expressions)])
    want = np.array([np.array(function(a, b)).ravel() for a, b in zip(xs, ys, strict=True)]).T
    np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-14)


def test_units():
    assert parameter_unit(parse_term("Xu")) == "1"
    assert parameter_unit(parse_term("Xuu")) == "s/m"
    assert parameter_unit(parse_term("Xmu"), "N") == "m/(s N)"
    assert parameter_unit(parse_term("Nvv")) == "s/m^2"


def test_every_published_structure_can_be_built():
    for name in structure_names():
        structure = get_structure(name)
        assert structure.reference
        assert len(structure.equations()) == len(structure.states)
