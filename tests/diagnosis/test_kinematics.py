"""What sensors do wrong, by what ties positions, heading, velocities and yaw rate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_ships import write_campaign

from greybox.diagnosis.causes import known_causes
from greybox.diagnosis.evidence.kinematics import causes_of, judged_by_kinematics, mended
from greybox.diagnosis.preparing import prepare
from greybox.model.catalogue import get_structure
from greybox.model.model import ManoeuvringModel
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


@pytest.mark.long
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


def test_heading_and_yaw_rate_that_agree_have_one_clock(tmp_path: Path) -> None:
    vessel, paths = write_campaign(tmp_path, "workboat-12m", ["zigzag-20"], 3)
    path, ship = paths[0], load_vessel(vessel)
    log = read_log(path, ship)
    # velocities of the antenna that has the positions: nothing to compare these with
    alone = replace(log, channels={n: x for n, x in log.channels.items() if n not in ("u", "v")})
    found = judged_by_kinematics([alone])
    assert found.together == {"r", "psi"}
    assert judged_by_kinematics([log]).together == frozenset()


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


def _stated(effect) -> dict[str, object]:
    true = effect.parameters
    if effect.id == "heading_bias":
        return {"heading_bias": true["heading_bias"]}
    if effect.id == "lever_arm":
        return {"antenna": (true["lever_arm_x"], true["lever_arm_y"])}
    if effect.id == "sign":
        return {"reversed": (true["channel"],)}
    return {"clock": {"u": true["clock_u"]}}


@pytest.mark.parametrize(
    ("effect", "seed"), [("heading_bias", 1), ("lever_arm", 2), ("clock_offset", 0), ("sign", 1)]
)
def test_what_a_model_knows_of_its_sensors_is_not_found_again(effect: str, seed: int) -> None:
    trial = draw(np.random.default_rng([31, seed]), (effect,), samples=400)
    structure = get_structure("thesis").without("Wuu", "Wvv", "Wuv")
    size = len(structure.parameters)
    vessel = trial.estimation.vessel
    vessel = replace(vessel, sensors={**vessel.sensors, **_stated(trial.truth[0])})
    model = ManoeuvringModel(structure, np.zeros(size), np.zeros((size, size)), 1.0, vessel)
    assert judged_by_kinematics([trial.estimation]).findings
    ready = prepare([trial.estimation], [], model, "thesis", [effect])
    assert not ready.findings
    assert ready.case.logs[0].vessel.sensors == vessel.sensors


def test_what_is_found_of_sensors_comes_on_top_of_what_is_stated_but_an_arm() -> None:
    def found(id: str, channel: str, value, *channels: str) -> Finding:
        return Finding(id, channel, value, (0.0, 0.0), "", "", "", channels)

    stated = {
        "heading_bias": 0.1, "antenna": (1.0, 2.0, 3.0), "clock": {"u": 1.0}, "reversed": ("v",),
    }  # fmt: skip
    vessel = replace(load_vessel("ferry"), sensors=stated)
    findings = [
        found("heading_bias", "psi", 0.02), found("lever_arm", "x_n", (4.0, 5.0)),
        found("clock_offset", "u", 0.5, "u", "v"), found("sign", "v", -1.0, "v", "r"),
    ]  # fmt: skip
    sensors = mended(vessel, findings).sensors
    assert sensors["heading_bias"] == pytest.approx(0.12)
    # the checks tell it from the origin, whatever the vessel file says
    assert sensors["antenna"] == (4.0, 5.0, 3.0)
    assert sensors["clock"] == {"u": 1.5, "v": 0.5}
    assert sensors["reversed"] == ("r",)


def test_a_channel_that_is_reversed_in_one_log_is_reversed_in_no_other() -> None:
    trial = draw(np.random.default_rng([31, 7]), (), samples=400)
    logs = [
        replace(log, channels={**log.channels, name: -log[name]})
        for log, name in ((trial.estimation, "v"), (trial.validation, "u"))
    ]
    assert [f.id for f in judged_by_kinematics(logs[:1]).findings] == ["sign"]
    assert not judged_by_kinematics(logs).findings
