"""What every ship's trials have in common: chance, sea, logs as a user reads them."""

from __future__ import annotations

import ast
import json
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest

from foreign_ships import (
    DEVELOPMENT,
    FINAL,
    SILENT,
    Current,
    Faults,
    Noise,
    Waves,
    Wind,
    manoeuvres,
    presets,
    simulate,
    write_campaign,
)
from greybox.commands.main import main

SHIPS = presets()
ONE_OF_EACH = ("kvlcc2-7m", "survey-catamaran-2m", "workboat-12m")


def test_the_simulators_import_nothing_of_the_product():
    for file in Path(__file__).parent.glob("*.py"):
        if file.name.startswith("test_"):
            continue
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = [a.name for a in node.names] + [getattr(node, "module", "") or ""]
                assert not any(n.startswith(("greybox", "experiment_design")) for n in names)


def test_the_last_ships_are_no_ships_of_development():
    assert set(DEVELOPMENT) | set(FINAL) == set(SHIPS)
    assert not set(DEVELOPMENT) & set(FINAL)
    kinds = {n: type(p.ship) for n, p in SHIPS.items()}
    assert not {kinds[n] for n in DEVELOPMENT} & {kinds[n] for n in FINAL}


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_the_same_seed_gives_the_same_log(name, tmp_path):
    preset = SHIPS[name]
    files = []
    for seed in (3, 3, 4):
        trial = preset.sail(
            manoeuvres.everyday(), 30, seed=seed, **preset.weather(seed, waves=True)
        )
        files.append(trial.write_csv(tmp_path / f"{len(files)}.csv", wind=True).read_bytes())
    assert files[0] == files[1] != files[2]


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_a_steady_current_carries_the_ship_and_nothing_else(name):
    ship = SHIPS[name].ship
    drive = manoeuvres.table([0.0], [ship.helm(0.8, 0.5)])
    still, carried = (
        simulate(ship, drive, 40, 0.1, seed=1, start_heading=0.4, current=c, noise=SILENT)
        for c in (None, Current(0.3, math.radians(120)))
    )
    for column in ("u_r", "v_r", "r", "psi"):
        np.testing.assert_allclose(still.true[column], carried.true[column], atol=1e-9)
    drift = carried.true["x_n"] - still.true["x_n"]
    np.testing.assert_allclose(drift, 0.3 * math.cos(math.radians(120)) * still.t, atol=1e-6)


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_a_beam_wind_pushes_to_lee_and_waves_shake(name):
    ship = SHIPS[name].ship
    stopped = manoeuvres.steady(0.0)
    common = {"start_speed": 0.0, "start_heading": 0.0, "noise": SILENT, "seed": 1}
    lee = simulate(ship, stopped, 40, 0.1, wind=Wind(3.0, math.pi / 2), **common).true
    assert lee["y_n"][-1] < 0  # from the east: to the west
    assert lee["v_q"][0] == pytest.approx(3.0)  # the air comes from starboard
    shaken = simulate(ship, stopped, 40, 0.1, waves=Waves(0.05, 3.0, 0.5), **common).true
    assert all(np.std(shaken[n]) > 0 for n in "uvr")


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_positions_velocities_and_heading_belong_together(name):
    """Simpson's rule over velocities over ground gives the way, current and gusts included."""
    preset = SHIPS[name]
    trial = preset.sail(manoeuvres.everyday(), 60, seed=2, noise=SILENT, **preset.weather(2))
    x, dt = trial.true, preset.dt
    north = np.cos(x["psi"]) * x["u"] - np.sin(x["psi"]) * x["v"]
    end = len(trial.t) - 1 - (len(trial.t) - 1) % 2
    steps = dt / 3 * (north[0:end:2] + 4 * north[1:end:2] + north[2 : end + 1 : 2])
    np.testing.assert_allclose(np.diff(x["x_n"][: end + 1 : 2]), steps, atol=1e-4)


def test_noise_has_the_spread_that_was_asked_for():
    noise = Noise(0.1, 0.01, 0.02, 0.03, 0.004, 0.5, 2.0, 0.02)
    trial = SHIPS["workboat-12m"].sail(manoeuvres.everyday(), 200, noise=noise, wind=Wind(5.0))
    spread = {n: np.std(trial.measured[n] - trial.true[n]) for n in trial.measured}
    expected = {"x_n": 0.1, "psi": 0.01, "u": 0.02, "v": 0.03, "r": 0.004, "u_q": 0.5}
    expected |= {"n_bow": 2.0, "alpha_port": 0.02}
    for column, std in expected.items():
        assert spread[column] == pytest.approx(std, rel=0.08), column


def test_faults_are_those_of_the_instruments():
    preset = SHIPS["workboat-12m"]
    good = preset.sail(manoeuvres.everyday(), 60, noise=SILENT)
    faults = Faults(0.05, (2.0, -1.0), {"u": 0.5}, {"alpha_port": 0.1})
    bad = good.measured_again(1, SILENT, faults).measured
    psi = good.true["psi"]
    np.testing.assert_allclose(bad["psi"] - psi, 0.05)
    np.testing.assert_allclose(bad["x_n"] - good.true["x_n"], 2 * np.cos(psi) + np.sin(psi))
    np.testing.assert_allclose(bad["u"][5:], good.true["u"][:-5])
    np.testing.assert_allclose(bad["alpha_port"] - good.true["alpha_port"], 0.1)
    np.testing.assert_array_equal(bad["r"], good.true["r"])


@pytest.mark.parametrize("name", SHIPS)
def test_actuators_keep_their_limits_and_rates(name):
    preset = SHIPS[name]
    drive = manoeuvres.random_steps(ahead=(-0.8, 1.2), turn=1.0, side=1.0, hold=(0.5, 2.0))
    trial = preset.sail(drive, 8 * preset.ship.time_scale, noise=SILENT)
    for a in preset.ship.actuators:
        values = trial.true[a.column]
        assert values.min() >= a.limits[0] - 1e-9
        assert values.max() <= a.limits[1] + 1e-9
        assert np.abs(np.diff(values)).max() <= a.rate * preset.dt * (1 + 1e-9)


@pytest.mark.parametrize("name", SHIPS)
def test_positive_turn_is_to_starboard(name):
    preset = SHIPS[name]
    trial = preset.sail(
        manoeuvres.turning_circle(0.6, approach=0), 8 * preset.ship.time_scale, start_heading=0.0
    )
    assert trial.true["r"][-1] > 0
    assert trial.true["y_n"][-1] > 0
    assert trial.true["v"][-1] < 0  # the stern swings out
    assert trial.true["u"][-1] < preset.ship.service_speed


def test_vessel_files_hold_what_a_crew_knows():
    for preset in SHIPS.values():
        table = tomllib.loads(preset.ship.vessel_toml())
        columns = {t[k] for t in table["thruster"] for k in ("speed", "angle", "rudder") if k in t}
        columns = {c for c in columns if isinstance(c, str)}
        assert columns == {a.column for a in preset.ship.actuators}
        assert "thrust" not in table["thruster"][0]
        given = tomllib.loads(preset.ship.vessel_toml(thrust="quadratic"))
        assert {t["thrust"] for t in given["thruster"]} == {"quadratic"}


def test_a_campaign_is_a_vessel_file_and_a_log_for_each_manoeuvre(tmp_path):
    kinds = ["turn-port", "random"]
    vessel, logs = write_campaign(tmp_path, "kvlcc2-7m", kinds, 1, weather=0.5, every=10)
    assert tomllib.loads(vessel.read_text())["length"] == 7
    assert [log.stem for log in logs] == ["00-turn-port", "01-random"]
    header = logs[0].read_text().split("\n")[0]
    assert header == "t,x_n,y_n,psi,u,v,r,u_q,v_q,n,delta"
    table = np.loadtxt(logs[0], delimiter=",", skiprows=1)
    np.testing.assert_allclose(np.diff(table[:, 0]), 1.0)
    assert table[-1, 3] < table[0, 3] - math.pi


AXES = {"frame", "sign", "unit", "clock_offset", "lever_arm", "heading_bias", "heading_wrap"}


def findings(name, folder, seed, lengths, samples):
    """Return the ids that `greybox check` finds in a random trial, as a user runs it."""
    preset = SHIPS[name]
    vessel, found = folder / "ship.toml", folder / "found.json"
    vessel.write_text(preset.ship.vessel_toml())
    trial = preset.sail(
        manoeuvres.random_steps(side=0.5), lengths * preset.ship.time_scale, seed=seed
    )
    every = max(1, len(trial.t) // samples)
    log = trial.write_csv(folder / "log.csv", every)
    assert main(["check", str(log), "--vessel", str(vessel), "--json", str(found), "-q"]) == 0
    return {f["id"] for f in json.loads(found.read_text())["findings"]}


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_check_finds_axes_signs_and_units_right(name, tmp_path):
    assert not findings(name, tmp_path, 5, 40, 400) & AXES


@pytest.mark.long
@pytest.mark.parametrize("name", ["esso-osaka-3m", "kvlcc2-320m", "azimuth-ferry-18m"])
def test_check_finds_them_right_in_other_logs(name, tmp_path):
    assert not findings(name, tmp_path, 6, 100, 1000) & AXES
