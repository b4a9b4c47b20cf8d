"""Stretches of a stream: those are drawn that tell most beside the others."""

from __future__ import annotations

import numpy as np

from greybox.selection.stretches import _greedy


def moments(*diagonals):
    return np.array([np.diag(d) for d in diagonals], float)


def test_a_stretch_that_moves_what_others_do_not_comes_before_more_of_the_same():
    # the second adds a direction; the third is the first once more, a little weaker
    assert sorted(_greedy(moments((4, 0), (0, 1), (3, 0)), 2)) == [0, 1]


def test_a_stretch_in_which_nothing_moves_is_left_out():
    assert _greedy(moments((0, 0), (2, 1)), 2) == [1]


def test_where_nothing_moves_there_is_a_stretch_to_say_so():
    assert _greedy(moments((0, 0), (0, 0)), 2) == [0]
