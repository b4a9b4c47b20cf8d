"""Actuators: delay, lag, limits and gain from command and feedback, and where they are kept."""

from __future__ import annotations

import csv
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from virtual import virtual_log

import greybox as gb
from greybox.trial.actuator_estimate import ActuatorEstimate, known_actuators
from greybox.trial.checks.actuators import measure_actuators
from greybox.trial.raw_log import Recording, Signal
from greybox.trial.store import read_record
from greybox.vessel.toml import vessel_from_dict

DATA = Path(os.environ.get("GREYBOX_DATA", "../shared/data")) / "milliampere1"


def ship(kind):
    """One thruster of which command `c` and feedback `y` are logged."""
    thruster = {
        "speed": {"type": "fixed", "speed": "y", "speed_command": "c"},
        "angle": {"type": "azimuth", "speed": "n", "angle": "y", "angle_command": "c"},
        "rudder": {"type": "propeller_rudder", "speed": "n", "rudder": "y", "rudder_command": "c"},
    }[kind]
    return vessel_from_dict({"name": "s", "length": 5.0, "thruster": [thruster]})


def followed(t, command, at, *, delay, lag, gain=1.0, rate=np.inf, band=0.0, fine=1e-3):
    """What an actuator does after a command that is held, on a clock of its own: step by step."""
    grid = np.arange(t[0], at[-1] + fine, fine)
    held = np.searchsorted(t, grid + fine / 2 - delay, "right") - 1
    target = (gain * command[np.clip(held, 0, None)]).tolist()
    x, out, keep = target[0], [], -np.expm1(-fine / lag) if lag else 1.0
    for goal in target:
        out.append(x)
        error = goal - x
        way = np.sign(error) * max(abs(error) - band, 0.0) if band else error
        x += min(max(way * keep, -rate * fine), rate * fine)
    return np.interp(at, grid, out)


def moved(seed, *, size=100.0, noise=1.0, seconds=200.0, offset=0.0, **truth):
    """A recording of steps every 3 to 15 s: command at 10 Hz, feedback at 5 Hz."""
    rng = np.random.default_rng([31, seed])
    t = np.arange(0, seconds, 0.1)
    at = np.arange(0.03, seconds, 0.2)
    edges = np.cumsum(rng.uniform(3, 15, 200))
    command = rng.uniform(-size, size, 201)[np.searchsorted(edges, t)]
    y = followed(t, command, at, **truth) + offset + noise * rng.standard_normal(len(at))
    return Recording("run", (Signal("c", t, command), Signal("y", at, y)))


def only(recordings, kind="speed"):
    (estimate,), findings, _ = measure_actuators(recordings, ship(kind))
    return estimate, [f for f, _ in findings]


def test_delay_lag_and_gain_are_found_within_their_intervals():
    e, (finding,) = only([moved(1, delay=0.43, lag=0.8, gain=0.9)])
    for found, true in ((e.delay, 0.43), (e.time_constant, 0.8), (e.gain, 0.9), (e.response, 1.23)):
        assert found.ci[0] - 0.002 < true < found.ci[1] + 0.002
        assert found.ci[1] - found.ci[0] < 0.1
    assert e.rate_limit is None
    assert e.dead_band is None
    assert (finding.id, finding.safe, finding.repair) == ("actuator", False, ())
    assert finding.value == e.response.value


def test_a_rate_limit_is_not_taken_for_a_lag():
    log = moved(2, size=0.5, noise=0.003, delay=0.3, lag=0.2, rate=0.08)
    e, _ = only([log], "rudder")
    assert e.rate_limit is not None
    assert e.rate_limit.value == pytest.approx(0.08, rel=0.03)
    assert e.response.value == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(("kind", "size", "noise", "band"), [("rudder", 0.5, 0.003, 0.04)])
def test_an_error_that_is_left_standing_is_a_dead_band(kind, size, noise, band):
    e, _ = only([moved(3, size=size, noise=noise, delay=0.2, lag=0.5, band=band)], kind)
    assert e.dead_band is not None
    assert e.dead_band.value == pytest.approx(band, rel=0.1)


def test_commands_that_a_propeller_does_not_answer():
    log = moved(4, delay=0.2, lag=0.5)
    t, command = log["c"].t, log["c"].value
    silent = np.where(np.abs(command) < 25, 0.0, command)
    y = followed(t, silent, log["y"].t, delay=0.2, lag=0.5)
    e, _ = only([Recording("run", (log["c"], Signal("y", log["y"].t, y)))])
    assert e.dead_band is not None
    assert e.dead_band.ci[0] <= 25 <= e.dead_band.ci[1]


def test_an_azimuth_goes_round_without_harm():
    log = moved(5, size=1.2, noise=0.01, delay=0.4, lag=0.3)
    turned = Recording(
        "run",
        tuple(
            Signal(s.name, s.t, (s.value + 2.8 + np.pi) % (2 * np.pi) - np.pi) for s in log.signals
        ),
    )
    e, _ = only([turned], "angle")
    assert e.response.value == pytest.approx(0.7, abs=0.03)
    assert e.gain.value == pytest.approx(1.0, abs=0.02)


def test_an_ideal_actuator_is_no_finding():
    for seed in range(4):
        log = moved(seed, delay=0.0, lag=0.0)
        same = Recording("run", (log["c"], Signal("y", log["c"].t, np.round(log["c"].value))))
        for recording in (log, same):
            e, findings = only([recording])
            assert not findings
            assert e.delay.ci[0] <= 0.0 <= e.delay.ci[1]


def test_logs_of_one_ship_are_measured_together():
    logs = [moved(k, delay=0.3, lag=0.6, noise=10.0) for k in (6, 7, 8)]
    one, _ = only(logs[:1])
    e, _ = only(logs)
    assert e.logs == ("run", "run", "run")
    assert e.response.ci[1] - e.response.ci[0] < one.response.ci[1] - one.response.ci[0]
    assert e.response.value == pytest.approx(0.9, abs=0.05)


def test_feedback_that_the_recorder_repeats_is_told_apart_from_the_actuator():
    log = moved(9, delay=0.4, lag=0.1, noise=0.5)
    y = log["y"]
    new = np.arange(len(y.t)) // 7 * 7
    e, _ = only([Recording("run", (log["c"], Signal("y", y.t, y.value[new])))])
    assert e.hold == pytest.approx(0.6, abs=0.3)
    assert e.response.value > 0.7
    delay, lag = e.at_renewal
    assert delay.value + lag.value == pytest.approx(0.5, abs=0.1)


def test_a_command_that_its_feedback_does_not_follow_cannot_be_measured():
    log = moved(10, delay=0.2, lag=0.2)
    noise = np.random.default_rng(0).standard_normal(len(log["y"].t))
    still = Recording("run", (log["c"], Signal("y", log["y"].t, noise)))
    estimates, findings, outcome = measure_actuators([still], ship("speed"))
    assert (estimates, findings) == ((), [])
    assert outcome.status == "cannot tell"


def test_estimates_survive_their_record():
    e, _ = only([moved(1, delay=0.43, lag=0.8, size=0.5, noise=0.003, rate=0.1)], "rudder")
    assert ActuatorEstimate.from_dict(json.loads(json.dumps(e.to_dict()))) == e
    assert known_actuators([[e], [e]]) == (e,)


def test_check_reports_and_import_keeps_the_actuators(tmp_path, monkeypatch):
    vessel = ship("speed")
    log = moved(1, delay=0.43, lag=0.8)
    c, y = log["c"], log["y"]
    held = y.value[np.clip(np.searchsorted(y.t, c.t, "right") - 1, 0, None)]
    u = 1 + 0.1 * np.sin(0.1 * c.t)
    v, r = 0.05 * np.cos(0.13 * c.t), 0.01 * np.sin(0.07 * c.t)
    psi = 0.01 / 0.07 * (1 - np.cos(0.07 * c.t))
    rows = np.column_stack([c.t, u, v, r, psi, c.value, held])
    raw = tmp_path / "raw.csv"
    np.savetxt(raw, rows, delimiter=",", header="t,u,v,r,psi,c,y", comments="")
    (report,) = gb.check_files([raw], vessel)
    (estimate,) = report.actuators
    assert "actuator" in [f.id for f in report.findings]
    assert report.to_dict()["actuators"][0]["delay"]["value"] == estimate.delay.value
    assert estimate.sentence in report.summary()
    said = gb.import_files([raw], vessel, tmp_path / "log.csv")
    assert "actuator: y follows c" in said
    record = read_record(tmp_path / "log.csv")
    assert record["actuators"][0]["command"] == "c"
    # in blocks as at once
    monkeypatch.setattr("greybox.trial.convert.two_pass_import._LARGE_CELLS", 0)
    assert gb.import_files([raw], vessel, tmp_path / "blocks.csv") == said
    assert read_record(tmp_path / "blocks.csv")["actuators"] == record["actuators"]
    kept = gb.read_log(tmp_path / "log.csv", vessel)
    kept = kept[0] if isinstance(kept, list | tuple) else kept
    assert kept.provenance.actuators[0].response.value == pytest.approx(estimate.response.value)


def test_a_model_keeps_the_actuators_of_its_logs(tmp_path):
    e, _ = only([moved(1, delay=0.43, lag=0.8)])
    log = virtual_log(3, 400)
    log = replace(log, provenance=replace(log.provenance, actuators=(e,)))
    estimate = gb.estimate_model([log], method="ls", predictor="basic")
    assert e.sentence[:30] in " ".join(estimate.summary().split())
    estimate.model().save(tmp_path / "model.json")
    assert gb.load_model(tmp_path / "model.json").record["actuators"] == [e.to_dict()]


@pytest.mark.parametrize("number", [1, 4])
def test_the_ferry_against_a_fit_by_hand(number):
    """By hand: soft-L1 least squares of delay, lag, gain and offset by SciPy."""
    if not DATA.exists():
        pytest.skip(f"no logs at {DATA}: set GREYBOX_DATA")
    by_hand = {1: (0.704, 1.034), 4: (0.714, 1.456)}[number]
    topics = DATA / "nlp1"

    def times(rows):
        seconds = []
        for stamp in rows:
            clock = stamp.split(" ")[1]
            whole, _, part = clock.partition(".")
            h, m, s = (int(x) for x in whole.split(":"))
            # the recorder writes the nanoseconds without leading zeros
            seconds.append(3600 * h + 60 * m + s + int(part or 0) * 1e-9)
        return np.array(seconds) - seconds[0]

    def columns(name, *wanted):
        with (topics / f"{name}{number}.csv").open() as handle:
            rows = list(csv.DictReader(handle))
        return rows, [np.array([float(r[w]) for r in rows]) for w in wanted]

    asked, (throttle, angle) = columns("ref", "throttle_reference", "angle_reference")
    turned, (azimuth,) = columns("az", "data")
    run, (speed,) = columns("mot", "motor_speed")
    start = times([asked[0]["time"]])
    zero = [asked[0]["time"]]

    def clock(rows):
        return times(zero + [r["time"] for r in rows])[1:] + start[0]

    vessel = vessel_from_dict(
        {
            "name": "ferry", "length": 5.0,
            "thruster": [
                {"type": "azimuth", "speed": "n", "speed_command": "nc", "angle": "a",
                 "angle_command": "ac"}
            ],
        }
    )  # fmt: skip
    recording = Recording(
        "nlp1",
        (
            Signal("nc", clock(asked), throttle),
            Signal("ac", clock(asked), np.radians(angle)),
            Signal("n", clock(run), speed),
            Signal("a", clock(turned), np.radians(azimuth)),
        ),
    )
    found, _, _ = measure_actuators([recording], vessel)
    response = {e.kind: e.response.value for e in found}
    assert response["angle"] == pytest.approx(by_hand[0], abs=0.05)
    assert response["speed"] == pytest.approx(by_hand[1], abs=0.2)


@pytest.mark.long
@pytest.mark.parametrize(
    "case",
    [
        {"delay": 0.35, "lag": 0.7},
        {"delay": 0.35, "lag": 0.4, "rate": 40.0},
    ],
)
def test_intervals_cover(case):
    """40 runs each: 95 % intervals, three standard errors of the coverage."""
    hits = np.zeros(3)
    for seed in range(40):
        (e,), _, _ = measure_actuators([moved(100 + seed, **case)], ship("speed"))
        true = (case["delay"], case["lag"], case["delay"] + case["lag"])
        for k, found in enumerate((e.delay, e.time_constant, e.response)):
            hits[k] += found.ci[0] <= true[k] <= found.ci[1]
        assert (e.rate_limit is not None) == ("rate" in case)
    assert np.all(hits / 40 > 0.95 - 3 * np.sqrt(0.95 * 0.05 / 40))
