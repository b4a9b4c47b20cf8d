"""The rates of right, wrong and no answers on a fixed set of blind trials.

An oracle, asked after each verdict, says what the true causes would have gained. Limits
are the asked rates less what chance takes from so many trials (binomial, 2.5 %).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import pytest
from scipy.stats import binom

from greybox.study.blind_causes import CAUSES
from greybox.study.blind_conditions import Conditions
from greybox.study.blind_effects import UNKNOWN
from greybox.study.power import Outcome, judge_by_diagnosis, oracle_by_fit, run_power

pytestmark = pytest.mark.long

KINDS = ("manoeuvres", "pulses", "zigzag")
PAIRS = (
    ("current", "thruster_gain"), ("thruster_lag", "current"), ("wind", "current"),
    ("heading_bias", "thruster_gain"), ("lever_arm", "current"), ("input_delay", "crossflow"),
    ("quadratic_thrust", "clock_offset"), ("parameter_change", "current"),
    ("angle_offset", "quadratic_yaw_damping"),
)  # fmt: skip


def in_turn(names: Iterable[str], kinds: int) -> dict[str, list[tuple[str, ...]]]:
    """So many of the three kinds of input for each effect, all met equally often."""
    out: dict[str, list[tuple[str, ...]]] = {kind: [] for kind in KINDS}
    for i, name in enumerate(names):
        for j, kind in enumerate(KINDS):
            if (i + j) % len(KINDS) >= len(KINDS) - kinds:
                out[kind].append((name,))
    return out


def judged(
    effects: Sequence[tuple[str, ...]], kinds: Sequence[str], *, runs: int = 1, none_runs: int = 0,
    oracle: bool = True, **conditions,
) -> list[Outcome]:  # fmt: skip
    study = run_power(
        judge_by_diagnosis, oracle=oracle_by_fit if oracle else None, effects=effects,
        sizes=(1.0,), kinds=kinds, runs=runs, none_runs=none_runs, seed=2027,
        conditions=Conditions(**conditions),
    )  # fmt: skip
    for o in study.outcomes:
        said = o.judgement
        print(
            o.cell.kind, o.cell.label, o.answer, *(() if said is None else (said.ids, said.groups)),
            *(() if o.oracle is None else (f"{o.oracle.fall:.3f}", dict(o.oracle.gain))),
            *(() if said is None else (dict(said.gain),)),
        )  # fmt: skip
    assert not [o.failure for o in study.outcomes if o.failure]
    return list(study.outcomes)


def at_least(rate: float, trials: Sequence[object]) -> int:
    """The fewest of so many trials that a rate leaves to chance."""
    return int(binom.ppf(0.025, len(trials), rate))


def at_most(rate: float, trials: Sequence[object]) -> int:
    return int(binom.ppf(0.975, len(trials), rate))


def size_of_group(o: Outcome) -> int:
    return max((len(g) for g in o.judgement.groups), default=0)


def truths(o: Outcome) -> list[tuple[float, float]]:
    """Errors and standard errors of the parameters of causes that are named rightly."""
    true = {k: v for e in o.truth for k, v in e.parameters.items() if isinstance(v, float)}
    return [(v - true[k], s) for k, (v, s) in o.judgement.parameters.items() if k in true]


def assert_told_and_gained(right: Sequence[Outcome]) -> None:
    """Numbers lie within 3 standard errors, fits within 2 points of the true structure's."""
    numbers = [pair for o in right for pair in truths(o)]
    assert sum(abs(e) <= 3 * s for e, s in numbers) >= at_least(0.95, numbers)
    channels = [(o.oracle.gain[s], o.judgement.gain[s]) for o in right for s in o.oracle.gain]
    assert sum(mine >= best - 2.0 for best, mine in channels) >= at_least(0.95, channels)


def test_one_effect_is_named_and_measured() -> None:
    outcomes = [o for kind, effects in in_turn(CAUSES, 2).items() for o in judged(effects, (kind,))]
    assert len(outcomes) == 2 * len(CAUSES)
    right = [o for o in outcomes if o.answer == "right"]
    # what kinematics mend beforehand shows in no free run
    assert sum(o.oracle.matters or o.answer == "right" for o in outcomes) > 0.75 * len(outcomes)
    # of those that have to be found, whatever was answered
    matters = [o for o in outcomes if o.oracle.matters]
    named = [o for o in matters if o.answer == "right"]
    grouped = [o for o in matters if o.answer == "group" and size_of_group(o) == 2]
    assert len(named) >= at_least(0.90, matters)
    assert len(named) + len(grouped) >= at_least(0.95, matters)
    wrong = [o for o in outcomes if set(o.named) - set(o.cell.effects)]
    assert len(wrong) <= at_most(0.02, outcomes)
    assert_told_and_gained(right)


@pytest.mark.parametrize(
    ("kind", "conditions"),
    [("pulses", {}), ("manoeuvres", {"colour": "memory"}), ("zigzag", {"gusts": True})],
)
def test_nothing_is_named_where_nothing_is_wrong(kind: str, conditions: dict) -> None:
    outcomes = judged([], (kind,), none_runs=12, **conditions)
    none = [o for o in outcomes if o.judgement.verdict == "none"]
    assert len(none) >= at_least(0.95, outcomes)


def test_two_effects_are_both_named() -> None:
    # in manoeuvres and zig-zags in turn
    outcomes = [*judged(PAIRS[::2], ("manoeuvres",)), *judged(PAIRS[1::2], ("zigzag",))]
    assert len(outcomes) == len(PAIRS)
    right = [o for o in outcomes if set(o.named) == set(o.cell.effects)]
    assert len(right) >= at_least(0.80, outcomes)
    assert_told_and_gained(right)


def test_a_second_force_that_leaves_nothing_is_named_without_other_terms() -> None:
    pairs = (("current", "thruster_gain"), ("input_delay", "crossflow"))
    study = run_power(
        judge_by_diagnosis, effects=pairs, sizes=(1.0,), kinds=("zigzag",), runs=1, none_runs=0,
        seed=6067,
    )  # fmt: skip
    assert [o.answer for o in study.outcomes] == ["right", "right"]


def test_effects_without_a_name_get_none() -> None:
    outcomes = [
        o for kind, effects in in_turn(UNKNOWN, 1).items()
        for o in judged(effects, (kind,), oracle=False)
    ]  # fmt: skip
    # what cannot show in pulses is not drawn there
    assert len(UNKNOWN) - 1 <= len(outcomes) <= len(UNKNOWN)
    named = [o for o in outcomes if o.judgement.verdict == "named"]
    assert len(named) <= at_most(0.10, outcomes)
