"""The splits of real logs that tools are compared on."""

from __future__ import annotations

import runpy
from itertools import pairwise
from pathlib import Path

import pytest

HELD_OUT = runpy.run_path(
    str(Path(__file__).parents[2] / "benchmarks" / "held_out.py"), run_name="held_out"
)
SPLITS, SHIPS = HELD_OUT["SPLITS"], HELD_OUT["SHIPS"]


def test_no_log_is_on_both_sides():
    assert len(SPLITS) >= 12
    assert {split.ship for split in SPLITS.values()} == set(SHIPS)
    for name, split in SPLITS.items():
        both = [*split.train, *split.held_out]
        assert split.train, name
        assert split.held_out, name
        assert len(set(both)) == len(both), name


def test_stretches_of_a_log_do_not_overlap():
    for ship in SHIPS.values():
        stretches = sorted((ship.parts or {}).values())
        for (one, _, end), (other, begin, _) in pairwise(stretches):
            assert one != other or end <= begin


@pytest.mark.parametrize("name", SPLITS)
def test_logs_of_a_split_are_there(name, data_folder):
    split = SPLITS[name]
    ship = SHIPS[split.ship]
    there = set(ship.parts or ()) or {
        p.stem for p in (data_folder / ship.folder).glob(ship.pattern)
    }
    assert {*split.train, *split.held_out} <= there
