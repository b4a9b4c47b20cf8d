"""The rotation of numbers and of expressions is one, and its inverse undoes it."""

from __future__ import annotations

import casadi as ca
import numpy as np

from greybox.rotation import body_to_ned, ned_to_body


def test_expressions_turn_as_numbers_do():
    symbols = [ca.SX.sym(n) for n in ("u", "v", "psi")]
    for turn in (body_to_ned, ned_to_body):
        made = ca.Function("turned", symbols, list(turn(*symbols)))
        np.testing.assert_allclose(
            [float(x) for x in made(1.2, -0.4, 2.1)], turn(1.2, -0.4, 2.1), rtol=1e-15
        )


def test_east_is_ahead_of_a_ship_that_heads_east():
    forward, starboard = ned_to_body(*body_to_ned(np.array([1.2]), np.array([0.3]), 0.7), 0.7)
    np.testing.assert_allclose([forward, starboard], [[1.2], [0.3]])
    np.testing.assert_allclose(body_to_ned(2.0, 0.0, np.pi / 2), [0.0, 2.0], atol=1e-15)
