"""A choice keeps to its time, names what it could not try, and always ends with an estimate."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import pytest
from virtual import virtual_log

from greybox.errors import GreyboxError, OutOfTimeError, UsageError
from greybox.numerics import effort
from greybox.numerics.effort import Shares, require_time, seconds_left, within
from greybox.selection.cross_validation import Refit
from greybox.selection.estimate import estimate_model
from greybox.selection.reduction import reduce_structure
from greybox.selection.request import Request
from greybox.selection.structures import compare_structures
from greybox.selection.term_selection import select_terms


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test sets."""
    now = SimpleNamespace(at=0.0)
    monkeypatch.setattr(effort, "time", SimpleNamespace(monotonic=lambda: now.at))
    return now


def test_the_earlier_end_holds(clock):
    assert seconds_left() == float("inf")
    with within(10):
        with within(20):
            assert seconds_left() == 10
        with within(5):
            clock.at = 5
            with pytest.raises(OutOfTimeError, match="--effort"):
                require_time()
            with effort.without_limit():
                require_time()
        assert seconds_left() == 5
    require_time()


def test_tasks_share_the_time_that_is_left(clock):
    with within(30):
        shares = Shares(3)
        with shares.next():
            assert seconds_left() == 10
            clock.at = 2
        with shares.next():
            assert seconds_left() == 14
            clock.at = 16
        with shares.next():
            assert seconds_left() == 14


def test_where_time_is_over_at_once_the_first_estimate_ends_and_the_rest_is_named(monkeypatch):
    ticks = itertools.count(0, 1000)
    monkeypatch.setattr(effort, "time", SimpleNamespace(monotonic=lambda: next(ticks)))
    log = virtual_log(1, 200, wind=0.0, current=(0.0, 0.0), without=("Yur",))
    found = estimate_model(log, structure="linear", predictor="basic", effort=10)
    assert set(found.fit) == {"u", "v", "r"}
    assert found.prediction is not None
    told = "\n".join(found.notes)
    assert "output error was tried too, and failed: time ran out" in told
    assert "time ran out; allow more with --effort" in told
    assert "estimators were not compared by held-out runs: time ran out" in told
    with within(1), pytest.raises(OutOfTimeError):
        select_terms([log], "none", 0, Refit(lambda _: found.model()))


@pytest.mark.parametrize(
    "choose",
    [lambda *a: compare_structures(a[0], ["linear", "thesis"], a[1]), reduce_structure],
    ids=["compare", "reduce"],
)
def test_structures_are_compared_within_the_time_too(monkeypatch, choose):
    ticks = itertools.count(0, 1000)
    monkeypatch.setattr(effort, "time", SimpleNamespace(monotonic=lambda: next(ticks)))
    log = virtual_log(1, 200, wind=0.0, current=(0.0, 0.0))
    asked = Request(method="iv", predictor="basic", structure="linear", effort=10)
    choice = choose(log, asked)
    assert choice.rows[0].chosen
    assert "time ran out (--effort)" in choice.rows[0].note
    told = "\n".join(choice.estimate.notes)
    assert "'linear' was compared with no other: time ran out (--effort)" in told
    assert "not refined by the noise: time was too short for it (--effort)" in told
    assert "nothing was held out, because time was too short" in choice.estimate.prediction.text


def test_ample_time_changes_nothing():
    log = virtual_log(1, 300, wind=0.0, current=(0.0, 0.0))
    asked = {"structure": "linear", "predictor": "basic", "judged": False}
    found, again = (estimate_model(log, effort=seconds, **asked) for seconds in (1e6, 1e9))
    assert found.model() == again.model()


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan")])
def test_effort_is_a_positive_number_of_seconds(seconds):
    with pytest.raises(UsageError, match="effort is"):
        Request(effort=seconds)
    assert issubclass(OutOfTimeError, GreyboxError)
