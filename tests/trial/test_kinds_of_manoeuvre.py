"""Logs by kind of manoeuvre: what is left out together."""

from __future__ import annotations

from dataclasses import replace

import pytest
from foreign_ships import presets
from foreign_ships.manoeuvres import kinds

from greybox import load_vessel, read_log
from greybox.selection.cross_validation import kinds_left_out, parts_of
from greybox.trial.manoeuvres.kinds import KINDS, kind_of

SAILED = {
    "zigzag-20": "zig-zag",
    "zigzag-10-port": "zig-zag",
    "turn-port": "turn",
    "turn-starboard-15": "turn",
    "speed-steps": "straight course",
    "random": "varied",
}


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kinds")
    preset = presets()["esso-osaka-3m"]
    (folder / "ship.toml").write_text(preset.ship.vessel_toml())
    vessel = load_vessel(folder / "ship.toml")
    return {
        name: read_log(
            preset.sail(kinds()[name], 25 * preset.ship.time_scale, seed=3).write_csv(
                folder / f"{name}.csv", 8
            ),
            vessel,
        )
        for name in SAILED
    }


@pytest.mark.parametrize("name", SAILED)
def test_a_log_is_of_the_kind_that_takes_most_of_it(logs, name):
    assert kind_of(logs[name]).name == SAILED[name]


def test_a_log_may_end_at_any_sample_of_a_zigzag(tmp_path):
    """Speeds on either side steer, and are held for a sample or two."""
    preset = presets()["survey-catamaran-2m"]
    (tmp_path / "ship.toml").write_text(preset.ship.vessel_toml())
    path = preset.sail(kinds()["zigzag-20"], 60.0, seed=5001).write_csv(tmp_path / "a.csv", 5)
    log = read_log(path, load_vessel(tmp_path / "ship.toml"))
    for end in range(len(log) - 30, len(log) + 1):
        assert kind_of(log.window(0, end, "cut")) in KINDS.values()


def test_every_log_is_of_a_kind(logs):
    without = logs["random"].window(0, 10, "short")
    assert kind_of(without) in KINDS.values()


def test_logs_of_one_kind_are_left_out_together(logs):
    several = [logs[n] for n in ("zigzag-20", "random", "zigzag-10-port", "turn-port")]
    left = [{log.name for log in held} for _, held in parts_of(several)]
    assert sorted(map(len, left)) == [1, 1, 2]
    assert {"zigzag-20", "zigzag-10-port"} in left
    assert set(kinds_left_out(several)) == {"zig-zag", "varied", "turn"}
    for fitting, held in parts_of(several):
        assert len(fitting) + len(held) == 4
    # logs without a manoeuvre are like no other
    varied = [logs["random"], logs["zigzag-20"], replace(logs["random"], name="again")]
    assert [len(held) for _, held in parts_of(varied)] == [1, 1, 1]
    # of one kind, logs are left out
    alike = [logs[n] for n in ("zigzag-20", "zigzag-10-port")]
    assert [[log.name for log in held] for _, held in parts_of(alike)] in (
        [["zigzag-20"], ["zigzag-10-port"]], [["zigzag-10-port"], ["zigzag-20"]]
    )  # fmt: skip
    assert kinds_left_out(alike) == ()
