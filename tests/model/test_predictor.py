"""The derived regressors against the thesis's vectors and against Taylor expansions."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.errors import StructureError
from greybox.model.catalogue import get_structure
from greybox.model.predictor import build_predictor
from greybox.model.run.step import StepModel

SIGNS = [(1, 1), (1, -1), (-1, 1), (-1, -1)]


def thesis_vectors(u, v, r, psi, tx, ty, tn, uq, vq, wind):
    """(5.61), (5.64), (5.70), (5.75), (5.85), (5.88), typed from the thesis."""
    a, c, s, sgn = np.abs, np.cos(psi), np.sin(psi), np.sign
    surge = [u, v * r, u * a(u), tx, u * tx, c, s, a(u) * c, a(u) * s, r * c, r * s, tx * c]
    surge += [tx * s, sgn(u) * c**2, sgn(u) * np.sin(2 * psi)]
    sway = [v, u * r, v * a(v), r * a(v), ty, c, s, a(v) * c, a(v) * s, r * c, r * s]
    sway += [sgn(v) * c**2, sgn(v) * np.sin(2 * psi)]
    yaw = [r, u * v, v * a(v), r * a(v), tn, r * c, r * s, v * c, v * s, u * c, u * s]
    yaw += [c**2, np.sin(2 * psi)]
    if wind:
        surge.append(uq * a(uq))
        sway.append(vq * a(vq))
        yaw.append(uq * vq)
    return {"u": surge, "v": sway, "r": yaw}


def samples(sign_u, sign_v, n=300, seed=5):
    rng = np.random.default_rng(seed)
    u = sign_u * rng.uniform(0.3, 2, n)
    v = sign_v * rng.uniform(0.3, 2, n)
    r, tx, ty, tn, uq, vq = rng.uniform(-2, 2, (6, n))
    psi = rng.uniform(-3, 3, n)
    return u, v, r, psi, tx, ty, tn, uq, vq


def rank(columns):
    m = np.array(columns) / np.linalg.norm(columns, axis=1)[:, None]
    return np.linalg.matrix_rank(m, tol=1e-9)


@pytest.mark.parametrize("signs", SIGNS)
@pytest.mark.parametrize("wind", [False, True])
def test_thesis_predictors_have_the_published_span(thesis, signs, wind):
    regime = (("u", (signs[0],)), ("v", (signs[1],)))
    predictor = build_predictor(thesis, "wind" if wind else "augmented", regime)
    u, v, r, psi, tx, ty, tn, uq, vq = samples(*signs)
    derived = predictor.evaluate([u, v, r], psi, [tx, ty, tn], (uq, vq) if wind else None)
    published = thesis_vectors(u, v, r, psi, tx, ty, tn, uq, vq, wind)
    for state, size in zip("uvr", (16, 14, 14) if wind else (15, 13, 13), strict=True):
        mine = derived[predictor.equation(state)]
        assert len(mine) == size == len(published[state])
        assert rank(mine) == size
        # the same span up to the constant that zero-mean instruments remove
        both = [*mine, *published[state], np.ones_like(u)]
        assert rank(both) == rank([*mine, np.ones_like(u)]) == size + 1


def test_small_models_have_the_published_vectors():
    surge = get_structure("surge")
    regime = (("u", (1,)),)
    assert [c.label for c in build_predictor(surge, "augmented", regime).columns] == [
        "Xu", "Xuu+Wuu", "Xmu", "cos(psi)", "sin(psi)", "u*cos(psi)", "u*sin(psi)",
        "cos²(psi)", "sin(2psi)",
    ]  # (5.19)  # fmt: skip
    assert len(build_predictor(surge, "wind", regime).columns) == 10  # (5.48)
    siso = build_predictor(get_structure("siso"), "basic")
    x, given = np.array([-2.0, 0.5]), np.array([1.0, 3.0])
    np.testing.assert_allclose(siso.evaluate([x], 0.0, [given]), [[-4, 0.25], [1, 3]])  # (4.3)


@pytest.mark.parametrize("name", ["thesis", "modulus", "blanke", "abkowitz", "thesis+N_|r|r+X_uuu"])
def test_bias_terms_are_the_exact_taylor_expansion(name):
    """f(x, d) from the step equals the columns with the coefficients the shares give."""
    structure = get_structure(name)
    regime = (("u", (1,)), ("v", (-1,)), ("r", (1, -1)))
    predictor = build_predictor(structure, "augmented", regime)
    rng = np.random.default_rng(3)
    theta = rng.uniform(-1, 1, len(structure.terms))
    d = np.array([0.05, -0.04, 0.1, 0.07])
    n = 40
    x = np.array([rng.uniform(0.5, 2, n), -rng.uniform(0.5, 2, n), rng.uniform(-1, 1, n)])
    psi = rng.uniform(-3, 3, n)
    tau = rng.uniform(-1, 1, (3, n))
    step = StepModel(structure).function
    disturbed = np.array(
        [
            np.array(step(x[:, k], psi[k], tau[:, k], d, [0, 0], theta, 1)).ravel() - x[:, k]
            for k in range(n)
        ]
    ).T
    coefficients = np.zeros(len(predictor.columns))
    for i in predictor.parameter_columns:
        terms = predictor.columns[i].terms
        coefficients[i] = sum(theta[structure.index(t)] for t in terms)
    for share in predictor.biases:
        weight = share.weight * theta[structure.index(share.term)]
        weight *= np.prod([d[m] for m in share.monomial])
        coefficients[predictor.equation(share.state)] += weight * np.array(share.shares)
    phi = predictor.evaluate(list(x), psi, list(tau))
    for row, state in enumerate("uvr"):
        mine = predictor.equation(state)
        rest = disturbed[row] - coefficients[mine] @ phi[mine]
        np.testing.assert_allclose(rest, rest.mean(), atol=1e-10)  # a constant may remain


def test_across_regimes_more_columns_are_needed(thesis):
    narrow = build_predictor(thesis, "augmented", (("u", (1,)), ("v", (1,))))
    wide = build_predictor(thesis, "augmented")
    assert len(wide.equation("r")) == 16 > len(narrow.equation("r")) == 13
    assert "sgn(v)*r*cos(psi)" in {c.name for c in wide.columns}


def test_merged_terms_are_named_as_sums(thesis):
    labels = {c.label for c in build_predictor(thesis, "basic").columns}
    assert {"Xuu+Wuu", "Yvv+Wvv", "Nuv+Wuv"} <= labels
    assert "Wuu" in {c.label for c in build_predictor(thesis, "basic+wind").columns}


def test_second_moments_that_hide_in_a_parameter_are_named():
    assert "Xu" in build_predictor(get_structure("abkowitz"), "augmented").contaminated
    assert build_predictor(get_structure("thesis"), "augmented").contaminated == ()


def test_unknown_predictor_suggests():
    with pytest.raises(StructureError, match="Did you mean 'augmented'"):
        build_predictor(get_structure("thesis"), "augmentd")


def test_wind_predictor_needs_the_wind(thesis):
    predictor = build_predictor(thesis, "wind", (("u", (1,)), ("v", (1,))))
    x = [np.ones(3)] * 3
    with pytest.raises(StructureError, match="needs the measured velocity through the air"):
        predictor.evaluate(x, 0.0, x)
