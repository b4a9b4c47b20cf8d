"""Parts of plans on the logs that sailed them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.errors import LogError
from greybox.trial.log import make_log
from greybox.trial.plan_parts import PlannedTrial, by_parts, read_plan
from greybox.vessel.toml import load_vessel

SHIP = load_vessel("thesis")
HOLD = 10


def planned(seed=0, holds=30, parts=None):
    """A plan of random two-level steps, a lead-in and a crossing among its parts."""
    rng = np.random.default_rng(seed)
    lower, upper = np.array([(10, 0.6, 0.6), (20, 1.1, 1.1)])
    levels = lower + (upper - lower) * rng.integers(0, 2, (holds, 3))
    commands = dict(zip(SHIP.commands, np.repeat(levels, HOLD, axis=0).T, strict=True))
    count = holds * HOLD
    if parts is None:
        parts = ["lead-in"] * 20 + ["trial"] * 80 + ["crossing"] * 20 + ["trial"] * 80
        parts += ["validation"] * (count - 200)
    return PlannedTrial("plan.csv", np.arange(float(count)), commands, tuple(parts))


def sailed(plan, *, before=0, after=0, zero=0.0, noise=0.0, rate=1):
    """The log of a plan, at `rate` samples a second, on a clock that begins at `zero`."""
    rng = np.random.default_rng(5)
    held = {}
    for name, value in plan.commands.items():
        held[name] = np.repeat(np.pad(value, (before, after), mode="edge"), rate)
        held[name] = held[name] + noise * np.ptp(value) * rng.standard_normal(len(held[name]))
    log = make_log(SHIP, held, 1 / rate, "log")
    return replace(log, t=log.t + zero)


@pytest.mark.parametrize("rate", [1, 4])
@pytest.mark.parametrize(
    ("before", "after", "zero", "shift"), [(0, 0, 0.0, 0), (60, 30, 7.0, 67), (0, 0, -50.0, -50)]
)
def test_parts_are_found_on_any_clock(before, after, zero, shift, rate):
    plan = planned()
    log = sailed(plan, before=before, after=after, zero=zero, noise=0.02, rate=rate)
    fit, judges, (told,) = by_parts([log], [plan])
    assert told.shift == pytest.approx(shift)
    assert told.followed > 0.99
    assert [x.name for x in fit] == ["log[1]", "log[2]"]
    assert [(x.t[0] - shift, len(x)) for x in fit] == [(20, 80 * rate), (120, 80 * rate)]
    assert [(x.name, x.t[0] - shift, len(x)) for x in judges] == [
        ("log, validation", 200, 100 * rate)
    ]
    outside = {"outside": (before + after) * rate} if before else {}
    parts = {"lead-in": 20, "trial": 160, "crossing": 20, "validation": 100}
    assert told.samples == {n: k * rate for n, k in parts.items()} | outside
    assert "20 of lead-in and 20 of crossing" in told.sentence or rate > 1


def test_a_trial_that_was_broken_off_still_follows():
    plan = planned()
    fit, judges, (told,) = by_parts([sailed(plan).window(0, 90, "log")], [plan])
    assert (len(fit), len(judges)) == (1, 0)
    assert told.samples == {"lead-in": 20, "trial": 70}


def test_each_log_is_held_against_the_trial_that_it_follows_best():
    plans = [replace(planned(seed), name=f"plan.csv, trial {seed}") for seed in (1, 2)]
    logs = [replace(sailed(p), name=f"log{k}") for k, p in enumerate(plans[::-1])]
    told = by_parts(logs, plans)[2]
    assert [x.plan for x in told] == ["plan.csv, trial 2", "plan.csv, trial 1"]


def test_segments_of_one_file_have_one_shift():
    plan = planned(parts=["trial"] * 300)
    log = sailed(plan, before=40)
    pieces = [log.window(0, 150, "log[1]"), log.window(170, 340, "log[2]")]
    fit, _, (told,) = by_parts(pieces, [plan])
    assert told.shift == 40
    assert [(x.name, x.t[0], len(x)) for x in fit] == [("log[1]", 40, 110), ("log[2]", 170, 170)]


@pytest.mark.parametrize("seed", range(1, 6))
def test_another_trial_does_not_follow(seed):
    with pytest.raises(LogError, match=r"follows the plan 'plan.csv' in \d\d % .* 80 % are needed"):
        by_parts([sailed(planned(seed))], [planned()])


def test_a_plan_without_a_trial_leaves_nothing_to_estimate_on():
    plan = planned(parts=["lead-in"] * 300)
    with pytest.raises(LogError, match="there are 300 lead-in"):
        by_parts([sailed(plan)], [plan])


def test_plans_are_read_as_they_are_written(tmp_path):
    path = tmp_path / "plan.csv"
    path.write_text("t,n,alpha1,alpha2\n0,10,0.6,1.1\n1,20,0.6,1.1\n")
    (plan,) = read_plan(path, SHIP)
    assert plan.parts == ("trial", "trial")
    assert list(plan.commands["n"]) == [10, 20]
    rows = "".join(f"{k},{t},trial,10,1,1\n" for k in (1, 2) for t in range(3))
    path.write_text("trial,t,part,n,alpha1,alpha2\n" + rows)
    assert [p.name for p in read_plan(path, SHIP)] == ["plan.csv, trial 1", "plan.csv, trial 2"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,n\n0,1\n", "no column alpha1, alpha2: it has t, n"),
        ("t,n,alpha1,alpha2\n0,x,1,1\n1,1,1,1\n", "no number"),
        ("t,n,alpha1,alpha2\n0,1,1,1\n1,1,1,1\n5,1,1,1\n", "steps of 1 to 4 s"),
        ("t,n,alpha1,alpha2\n0,1,1,1\n", "has 1 row "),
        ("t,n,alpha1,alpha2\n", "has no rows"),
        ("t,part,n,alpha1,alpha2\n0,rest,1,1,1\n1,rest,1,1,1\n", "the part 'rest'"),
        (None, "cannot read the plan"),
    ],
)
def test_plans_that_are_none(tmp_path, text, message):
    path = tmp_path / "plan.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(LogError, match=message):
        read_plan(path, SHIP)
