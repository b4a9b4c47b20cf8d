"""Whether errors tell from where the measured wind blew."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_ships import presets
from foreign_ships.environment import Wind, Windage
from foreign_ships.manoeuvres import kinds

from greybox import load_vessel, read_log
from greybox.diagnosis.evidence.remainder import MOTION_AND_COMMANDS, rival
from greybox.diagnosis.evidence.wind_direction import (
    _gains,
    _set_out_alike,
    wind_direction,
)
from greybox.diagnosis.fitting import stacked
from greybox.diagnosis.preparing import Prepared, prepare

NAME = "survey-catamaran-2m"


def prepared(folder: Path, *, blows: bool) -> Prepared:
    """Two trials to fit and one held out, in a wind that was measured and does something or not."""
    preset = presets()[NAME]
    ship = preset.ship
    if not blows:
        ship = replace(ship, windage=Windage(0.0, 0.0, arm=0.0))
    (folder / "vessel.toml").write_text(ship.vessel_toml())
    vessel = load_vessel(folder / "vessel.toml")
    logs = []
    for k, kind in enumerate(("random", "turn-port-15", "zigzag-20")):
        preset = replace(preset, ship=ship)
        wind = Wind(2 * ship.service_speed, 2.0, gusts=0.2 * ship.service_speed)
        trial = preset.sail(kinds()[kind], 200.0, seed=70 + k, wind=wind)
        path = folder / f"{k}.csv"
        trial.write_csv(path, round(0.5 / preset.dt), wind=True)
        logs.append(read_log(path, vessel))
    return prepare(logs[:2], logs[2:], None, "thesis", ["wind"])


@pytest.fixture(scope="module")
def windy(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    return prepared(tmp_path_factory.mktemp("windy"), blows=True)


@pytest.mark.long
def test_errors_tell_from_where_a_wind_blew_that_pushes_the_ship(
    windy: Prepared, tmp_path: Path
) -> None:
    found = []
    for ready in (windy, prepared(tmp_path, blows=False)):
        base = ready.base()
        problem = ready.case.problem(base.integrator)
        held_out = ready.case.held_out(base.integrator)
        (wind,) = ready.hypotheses
        found.append(wind_direction(problem, wind, base, held_out))
    blowing, still = found
    assert blowing < 0.01
    assert still > 0.1


def test_a_wind_that_is_turned_keeps_its_strength(windy: Prepared) -> None:
    run = windy.case.problem("euler").runs[0]
    motion = np.column_stack([run.log["u"], run.log["v"]])
    wind = motion - run.log.air
    for angle in (0.0, 0.7, np.pi):
        turned = motion - run.in_wind_turned(angle)._air
        assert np.allclose(np.hypot(*turned.T), np.hypot(*wind.T))
        cross = wind[:, 0] * turned[:, 1] - wind[:, 1] * turned[:, 0]
        away = np.arctan2(cross, (wind * turned).sum(axis=1))
        assert np.allclose(np.cos(away - angle), 1.0)
    assert run.in_wind_turned(0.7)._simulator is run._simulator


def test_what_a_wind_explains_is_what_all_fitted_together_leave_it(windy: Prepared) -> None:
    # brute force: least squares of errors on the wind, the free numbers, and a generic force
    # whose shares have the prior that made the errors likeliest
    base = windy.base()
    problem = windy.case.problem(base.integrator)
    beside = rival(problem, base, [MOTION_AND_COMMANDS])
    assert beside is not None
    (wind,) = windy.hypotheses
    free = replace(
        wind, parameters=tuple(replace(p, low=-np.inf, high=np.inf) for p in wind.parameters)
    )
    gain = _gains(problem, free, base, beside.taking())[0]
    places = np.array([problem.place(n) for n in wind.columns])
    pushed = stacked(problem.whiten(base.noise, [
        run.columns(base.point.ship, run.run(base.point.ship, start), places)[:, :, :3]
        for run, start in zip(problem.runs, base.point.starts, strict=True)
    ]))  # fmt: skip
    deviations, _ = beside.likeliest(MOTION_AND_COMMANDS)
    force = stacked(beside.rows) / beside.size @ deviations
    prior = np.sqrt(beside.alike) * np.eye(force.shape[1])

    def least(*columns: np.ndarray) -> float:
        free_rows = np.column_stack(columns)
        rows = np.block([[free_rows, force], [np.zeros((len(prior), free_rows.shape[1])), prior]])
        seen = np.concatenate([beside.errors, np.zeros(len(prior))])
        size = np.linalg.norm(rows, axis=0)
        found = np.linalg.lstsq(rows / np.where(size > 0, size, 1.0), seen, rcond=1e-12)[0]
        left = seen - rows / np.where(size > 0, size, 1.0) @ found
        return float(left @ left)

    expected = least(beside.left) - least(beside.left, pushed)
    assert gain == pytest.approx(expected, rel=1e-3)


def test_logs_that_set_out_on_one_angle_to_the_wind_are_turned_together(windy: Prepared) -> None:
    (run, *_) = windy.case.problem("euler").runs

    def setting_out(angle: float):
        air = np.tile([-np.cos(angle), -np.sin(angle)], (len(run.log), 1))
        still = np.zeros(len(run.log))
        channels = {**run.log.channels, "u": still, "v": still, "u_q": air[:, 0], "v_q": air[:, 1]}
        other = run.measuring(run.y)
        other.log = replace(run.log, channels=channels)
        return other

    angles = np.deg2rad([0.0, 350.0, 120.0, 20.0, 215.0])
    assert _set_out_alike([setting_out(a) for a in angles]) == [0, 0, 1, 0, 2]
