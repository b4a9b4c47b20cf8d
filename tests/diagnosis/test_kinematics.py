"""What sensors do wrong, by what ties positions, heading, velocities and yaw rate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from foreign_ships import write_campaign

from greybox.diagnosis.causes import known_causes
from greybox.diagnosis.evidence.kinematics import causes_of, judged_by_kinematics
from greybox.diagnosis.preparing import prepare
from greybox.study.blind import draw
from greybox.trial.checks.finding import Finding
from greybox.trial.convert.read import read_log
from greybox.vessel.toml import load_vessel


def trial_of(variant: str):
    """A lever arm of positions alone, or of positions and velocities."""
    for seed in range(20):
        trial = draw(np.random.default_rng([31, seed]), ("lever_arm",), samples=600)
        if trial.truth[0].parameters["variant"] == variant:
            return trial
    raise AssertionError(variant)


def test_an_arm_of_the_positions_alone_is_proved() -> None:
    trial = trial_of("positions")
    found = judged_by_kinematics([trial.estimation, trial.validation])
    (arm,) = (f for f in found.findings if f.id == "lever_arm")
    assert "lever_arm" not in found.agreeing
    for i, name in enumerate(("lever_arm_x", "lever_arm_y")):
        low, high = arm.ci[i]
        half = (high - low) / 2
        assert abs(arm.value[i] - trial.truth[0].parameters[name]) < 2 * half


def test_sensors_that_share_a_place_agree_and_forces_must_tell() -> None:
    trial = trial_of("antenna")
    ready = prepare([trial.estimation], [trial.validation], None, "thesis", None)
    assert "lever_arm" in ready.agreeing
    assert any(h.cause == "lever_arm" for h in ready.hypotheses)
    assert not any(h.cause == "lever_arm" for h in ready.of_forces)


@pytest.mark.parametrize("ship", ["training-ship-105m", "research-catamaran-29m"])
def test_sensors_of_foreign_ships_agree(ship: str, tmp_path: Path) -> None:
    vessel, paths = write_campaign(tmp_path, ship, ["zigzag-20"], 3)
    logs = [read_log(path, load_vessel(vessel)) for path in paths]
    found = judged_by_kinematics(logs)
    assert not found.findings
    assert {"lever_arm", "heading_bias"} <= found.agreeing


def test_without_positions_nothing_is_known() -> None:
    trial = draw(np.random.default_rng(3), positions=False, samples=200)
    found = judged_by_kinematics([trial.estimation])
    assert not found.findings
    assert not found.agreeing


def test_two_late_clocks_are_both_told() -> None:
    findings = [
        Finding("clock_offset", name, value, (value - 0.1, value + 0.1), "s", "late", "shift it")
        for name, value in (("x_n", 2.0), ("y_n", 3.0))
    ]
    told = causes_of(findings, known_causes(), 40)
    assert [c.key for c in told] == ["clock_offset:x_n:kinematics", "clock_offset:y_n:kinematics"]
    assert [q.value for c in told for q in c.parameters.values()] == [2.0, 3.0]
