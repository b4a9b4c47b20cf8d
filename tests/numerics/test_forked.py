"""One map over a few heavy pieces, in copies of the process where that is safe."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from greybox.errors import ExcitationError
from greybox.numerics.forked import lanes, map_forked

# in a process of its own: a test runner has threads, and copies are then not made
SCRIPT = """
import os
from greybox.errors import ExcitationError
from greybox.numerics.forked import lanes, map_forked

seen = []
def piece(k):
    seen.append(k)
    inner = map_forked(lambda i: (i, os.getpid()), range(3))
    return k * k, os.getpid(), len({pid for _, pid in inner} | {os.getpid()})

found = map_forked(piece, range(5))
assert [square for square, _, _ in found] == [0, 1, 4, 9, 16]
assert all(alone == 1 for _, _, alone in found)
apart = lanes() > 1
assert apart == (os.getpid() not in {pid for _, pid, _ in found}), found
assert seen == ([] if apart else list(range(5)))

def fails(k):
    raise ExcitationError(f"piece {k} has no model.")
try:
    map_forked(fails, range(3))
except ExcitationError as error:
    assert str(error) == "piece 0 has no model."
else:
    raise AssertionError("nothing was raised")
"""


def test_pieces_are_computed_in_copies_that_know_everything():
    ran = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr


def test_beside_another_thread_nothing_is_copied():
    done = threading.Event()
    other = threading.Thread(target=done.wait)
    other.start()
    try:
        assert lanes() == 1
        seen: list[int] = []
        assert map_forked(lambda k: seen.append(k) or k, [3, 1, 2]) == [3, 1, 2]
        assert seen == [3, 1, 2]
        with pytest.raises(ExcitationError, match="no model"):
            map_forked(fails, [1, 2])
    finally:
        done.set()
        other.join()


def fails(_: int) -> None:
    raise ExcitationError("no model.")
