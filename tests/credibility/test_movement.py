"""Coefficients of what the logs did not move are never trusted, whatever the units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.errors import ExcitationError
from greybox.model.catalogue import get_structure
from greybox.model.run.simulation import simulate
from greybox.selection.estimate import estimate_model
from greybox.study.chapter6 import TRUE
from greybox.study.inputs import smoothed_pulses
from greybox.trial.log import make_log
from greybox.vessel.force import input_movement
from greybox.vessel.toml import load_vessel

STATES = ("u", "v", "r")


def crossed(apart, units=1.0, samples=500):
    """A trial in which two azimuths push against each other but for `apart` [rad].

    `units` of propeller speed in each of the thesis's.
    """
    structure, vessel = get_structure("thesis"), load_vessel("thesis")
    rng = np.random.default_rng(300)
    speed = smoothed_pulses(rng, samples, 10, 20, widths=(20, 80), smoothing=10)
    angle = smoothed_pulses(rng, samples, -0.6, 0.6, widths=(20, 80), smoothing=10)
    commands = {
        "n": speed, "alpha1": angle, "alpha2": -angle + apart * rng.standard_normal(samples)
    }  # fmt: skip
    tau = make_log(vessel, commands, 1.0).forces(structure.inputs)
    theta = np.array([TRUE[n] for n in structure.parameters])
    run = simulate(structure, theta, np.array([1.5, 0.0, 0.0]), tau[:-1], 1.0)
    noisy = run.x[0] + np.sqrt(2e-4) * rng.standard_normal((samples, 3))
    channels = {**commands, "n": units * speed, "psi": run.psi[0]}
    return make_log(vessel, channels | dict(zip(STATES, noisy.T, strict=True)), 1.0, "crossed")


ASKED = {"structure": "thesis", "predictor": "basic"}


@pytest.mark.parametrize("units", [1.0, 60.0, 1e-6])
@pytest.mark.parametrize("method", ["ls", "iv", "oe"])
def test_a_force_that_is_rounding_is_refused(method, units):
    with pytest.raises(ExcitationError, match="tauy is 4e-13 of what its thrusters push") as told:
        estimate_model(crossed(1e-12, units), method=method, **ASKED)
    assert "parameter Ymu is not excited" in str(told.value)
    assert "--structure 'thesis-Ymu'" in str(told.value)


def test_thrusters_that_cancel_to_nothing_are_named_as_the_cause():
    with pytest.raises(ExcitationError, match=r"Ymu is not .*tauy is 0 of .*its thrusts cancel"):
        estimate_model(crossed(0.0))


@pytest.mark.parametrize("units", [1.0, 60.0])
@pytest.mark.parametrize("method", ["iv", "oe"])
def test_a_force_below_any_misalignment_is_excepted(method, units):
    found = estimate_model(crossed(1e-4, units), method=method, **ASKED)
    assert "Ymu" in found.verdict.excepted
    (told,) = [t for t in found.tests if t.kind == "movement"]
    assert told.passed is False
    assert told.parameters == ("Ymu",)
    assert told.statistic == pytest.approx(4e-5, rel=0.2)
    assert "tauy changes by 4e-05 of its thrusters' force (at least 0.001 is needed), so Ymu" in (
        told.sentence
    )


def test_a_force_that_is_the_noise_of_thrusters_that_cancel_is_excepted():
    found = estimate_model(crossed(0.006), method="iv", **ASKED)
    assert "Ymu" in found.verdict.excepted


def test_all_parameters_that_are_not_excited_are_named_at_once():
    log = crossed(0.3)
    still = log.channels | {"r": np.zeros(len(log))}
    with pytest.raises(ExcitationError) as told:
        estimate_model(make_log(log.vessel, still, 1.0, "still"), method="ls", **ASKED)
    assert "parameters Xvr, Yur, Yvr, Nr, Nvr are not excited" in str(told.value)
    assert "leave them out (--structure 'thesis-Xvr-Yur-Yvr-Nr-Nvr')" in str(told.value)


def test_commands_that_move_by_their_noise_alone_are_refused():
    log, rng = crossed(0.3), np.random.default_rng(5)
    held = {c: 0.7 + 0.003 * rng.standard_normal(len(log)) for c in ("alpha1", "alpha2")}
    held["n"] = 15 + 0.05 * rng.standard_normal(len(log))
    with pytest.raises(ExcitationError, match=r"but for noise, which moves n by 0\.0"):
        estimate_model(make_log(log.vessel, log.channels | held, 1.0, "held"), **ASKED)
    still = log.channels | dict.fromkeys(STATES, np.ones(len(log)))
    with pytest.raises(ExcitationError, match="u, v, r do not change over the whole log"):
        estimate_model(make_log(log.vessel, still, 1.0, "still"), **ASKED)


def test_what_moves_passes():
    found = estimate_model(crossed(0.3), method="iv", **ASKED)
    (told,) = [t for t in found.tests if t.kind == "movement"]
    assert told.passed
    assert "Ymu" not in found.verdict.excepted


def test_movement_has_no_unit():
    vessel = load_vessel("thesis")
    given = crossed(1e-3)
    commands = {c: given[c] for c in vessel.commands}
    one = input_movement(vessel, commands)
    assert one == pytest.approx(input_movement(vessel, commands | {"n": 60 * commands["n"]}))
    # a straight course by both: all of it ahead
    straight = commands | {"alpha1": 0 * commands["n"], "alpha2": 0 * commands["n"]}
    assert input_movement(vessel, straight) == {"taux": pytest.approx(1.0), "tauy": 0, "taun": 0}
    more = replace(vessel, thrusters=tuple(replace(t, gain=3.0) for t in vessel.thrusters))
    assert input_movement(more, commands) == pytest.approx(one)
