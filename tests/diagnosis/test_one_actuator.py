"""Causes that are of one actuator, or of one group of thrusters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from foreign_ships import manoeuvres, presets

from greybox.diagnosis.causes import Context, known_causes
from greybox.diagnosis.causes.hull import is_coupling
from greybox.diagnosis.diagnose import DiagnosisOptions, diagnose
from greybox.diagnosis.extension import extended_vessel
from greybox.diagnosis.hypothesis import Hypothesis, Parameter
from greybox.diagnosis.quantities import quantities_of
from greybox.diagnosis.result import Quantity, file_word
from greybox.diagnosis.search import Candidate, _taken
from greybox.diagnosis.ship import Sensors, Ship
from greybox.model.catalogue import structure_for
from greybox.model.model import load_model
from greybox.model.terms import parse_term
from greybox.study.blind import draw
from greybox.trial.convert.read import read_log
from greybox.trial.log import make_log
from greybox.vessel.force import force_inputs
from greybox.vessel.toml import load_vessel, vessel_from_dict
from greybox.vessel.vessel import Actuation, Vessel

LATE = ("thruster_lag", "input_delay", "rate_limit", "feedback_sampling")
RUDDER = {"type": "propeller_rudder", "x": -3.0, "speed": "n", "rudder": "delta"}
TUNNEL = {"type": "tunnel", "x": 5.0, "speed": "n_bow"}
PAIR = [
    {"type": "azimuth", "x": -4.0, "y": y, "speed": f"n_{side}", "angle": f"alpha_{side}"}
    for side, y in (("port", -2.0), ("star", 2.0))
]


def vessel(*thrusters: dict) -> Vessel:
    return vessel_from_dict({"name": "ship", "length": 10.0, "thruster": list(thrusters)})


def hypotheses(ship: Vessel, cause: str, **more: object) -> dict[str, Hypothesis]:
    """Return the ways of a cause by their key."""
    structure = structure_for("thesis", force_inputs(ship))
    moving = dict.fromkeys(ship.commands, 1.0)
    context = Context(
        structure, ship, ("u", "v", "r"), False, 900.0, 1.0,
        {t.speed: 5.0 for t in ship.thrusters}, ranges=moving, fastest=moving | more,
    )  # fmt: skip
    return {h.key: h for h in known_causes()[cause].hypotheses(context)}


def test_a_rudder_may_be_late_by_itself() -> None:
    ship = vessel(RUDDER)
    lags = hypotheses(ship, "thruster_lag")
    # a lag of the only propeller is that of the speeds
    assert [h.id for h in lags.values()] == ["thruster_lag"] * 3 + ["thruster_lag:delta"]
    assert list(hypotheses(ship, "input_delay")) == [
        "input_delay", "input_delay:n", "input_delay:delta",
    ]  # fmt: skip
    assert list(hypotheses(ship, "rate_limit", n=0.0)) == ["rate_limit:delta"]
    (limit,) = hypotheses(ship, "rate_limit", n=0.0)["rate_limit:delta"].parameters
    assert (limit.name, limit.unit) == ("rate_delta", "rad/s")
    said = known_causes()["thruster_lag"].evidence_of(
        lags["thruster_lag:delta"], {"lag": (2.0, 0.1)}
    )
    assert said == "delta alone acts with a time constant of 2.00 ± 0.10 s after it is logged"


def test_a_rate_is_told_with_its_unit() -> None:
    limits, cause = hypotheses(vessel(RUDDER), "rate_limit"), known_causes()["rate_limit"]
    for column, rate in (("delta", "12.0 ± 1.0 deg/s"), ("n", "0.209 ± 0.017 n/s")):
        told = {f"rate_{column}": (np.deg2rad(12.0), np.deg2rad(1.0))}
        limit = limits[f"rate_limit:{column}"]
        for way in (limit, limit.held_at(np.array([5.0]))):
            assert cause.evidence_of(way, told) == (
                f"{column} moves by at most {rate}, slower than it is logged"
            )


def test_the_thrust_of_one_thruster_couples_nothing() -> None:
    for ship, all_told in ((vessel(RUDDER), False), (vessel(*PAIR), True)):
        (found,) = hypotheses(ship, "inertia_coupling").values()
        for name in ("Y_r", "N_v", "Y_taun", "N_tauy"):
            told = all_told or "tau" not in name
            assert is_coupling(parse_term(name), ship) == told
            assert (parse_term(name).name in found.columns) == told
        assert not is_coupling(parse_term("N_|taun|"), ship)


def test_sensors_are_told_with_their_errors_and_directions() -> None:
    bias, arm = (known_causes()[c] for c in ("heading_bias", "lever_arm"))
    for sign, word in ((-1, "low"), (1, "high")):
        said = bias.evidence({"heading_bias": (sign * np.deg2rad(1.87), np.deg2rad(0.24))})
        assert said.endswith(f"as by a compass that reads 1.87 ± 0.24 deg too {word}")
    said = arm.evidence({"lever_arm_x": (0.7, 7.3), "lever_arm_y": (-2.34, 0.27)})
    assert "of a point 0.7 ± 7.3 m ahead and 2.34 ± 0.27 m to port of the origin" in said


def test_angles_of_one_make_may_be_late_together() -> None:
    ship = vessel(*PAIR)
    assert "thruster_lag:angle" in hypotheses(ship, "thruster_lag")
    delays = hypotheses(ship, "input_delay")
    assert [h.id for h in delays.values()][:3] == ["input_delay"] * 3
    late = (
        delays["input_delay:angle"]
        .apply(Ship(np.zeros(1), np.zeros(2), ship), np.array([1.5]))
        .vessel
    )
    assert late.delayed_commands == ("alpha_port", "alpha_star")
    assert known_causes()["input_delay"].evidence_of(
        delays["input_delay:angle"], {"delay": (1.5, 0.1)}
    ) == "the angles act 1.50 ± 0.10 s after they are logged"  # fmt: skip


def test_a_ship_has_one_lag_one_delay_and_one_limit() -> None:
    late = Actuation(lag=1.0, delay=1.0, rate_limit=1.0, rate_on="n")
    ship = replace(vessel(RUDDER), actuation=late)
    assert not any(h.place for h in hypotheses(ship, "thruster_lag").values())
    assert not any(h.place for h in hypotheses(ship, "input_delay").values())
    assert not hypotheses(ship, "rate_limit")
    one, two = hypotheses(vessel(RUDDER), "rate_limit").values()
    # of the candidate nothing but its hypothesis is asked
    known = Candidate(one, None, 0.0, 0.0, 0.0, None)  # type: ignore[arg-type]
    assert _taken(two, [known])


def test_speeds_are_all_commands_where_nothing_has_an_angle() -> None:
    pair = [{"type": "fixed", "y": y, "speed": n} for y, n in ((-0.3, "n_port"), (0.3, "n_star"))]
    ship = vessel(*pair)
    lags = list(hypotheses(ship, "thruster_lag"))
    assert lags[:2] == ["thruster_lag:force", "thruster_lag:command"]
    assert next(iter(hypotheses(ship, "input_delay"))) == "input_delay"
    for cause in ("thruster_lag", "input_delay"):
        assert f"{cause}:speed" not in hypotheses(ship, cause)
    own = replace(ship, actuation=Actuation(lag=1.0, lag_on="speed"))
    assert list(hypotheses(own, "thruster_lag")) == ["thruster_lag:force", "thruster_lag:speed"]


def test_a_limit_makes_movements_late_by_more_than_sampling_does() -> None:
    # all the way in a second as logged; late by half of what a movement takes
    (limit, *_) = hypotheses(vessel(RUDDER), "rate_limit").values()
    (time,) = limit.parameters
    assert time.least == pytest.approx(1.0 + 2 * 0.75)


@pytest.mark.parametrize("cause", ["thruster_lag", "input_delay"])
def test_a_lag_of_a_third_of_a_sample_is_more_than_sampling_makes(cause: str) -> None:
    # logged every second: what moves between samples acts half a sample earlier, never later
    for hypothesis in hypotheses(vessel(RUDDER), cause).values():
        (time,) = hypothesis.parameters
        assert time.least == pytest.approx(0.25)


def test_a_cause_held_at_its_value_is_in_force_and_lets_no_other_of_its_kind_in() -> None:
    ship = Ship(np.zeros(1), np.zeros(2), vessel(RUDDER))
    lags = hypotheses(ship.vessel, "thruster_lag")
    held = lags["thruster_lag:delta"].held_at(np.array([2.5]))
    late = held.apply(ship, np.zeros(0)).vessel.actuation
    assert (late.lag, late.lag_on, held.parameters) == (2.5, "delta", ())
    told = {"lag": Quantity(2.5, 0.1, "s")}
    known = Candidate(held, None, 0.0, 0.0, 0.0, None, told=told)  # type: ignore[arg-type]
    assert _taken(lags["thruster_lag:speed"], [known])
    assert not known.unresolved
    assert quantities_of(None, known, None) == told  # type: ignore[arg-type]


def test_a_single_command_is_all_commands() -> None:
    ship = vessel({"type": "fixed", "speed": "n"})
    assert not any(h.place for h in hypotheses(ship, "thruster_lag").values())
    assert list(hypotheses(ship, "input_delay")) == ["input_delay"]


def test_orders_are_held_and_feedback_may_not_be() -> None:
    measured = {**RUDDER, "speed_command": "n_ref", "rudder_command": "delta_ref"}
    ordered = vessel({**measured, "drive": "command"})
    assert not hypotheses(ordered, "feedback_sampling")
    assert len(hypotheses(vessel(measured), "feedback_sampling")) == 1
    known = replace(vessel(RUDDER), actuation=Actuation(between="interpolated"))
    assert not hypotheses(known, "feedback_sampling")


def test_groups_of_thrusters_have_their_own_law_and_strength() -> None:
    ship = vessel(TUNNEL, *PAIR)
    laws = hypotheses(ship, "quadratic_thrust")
    assert [h.id for h in laws.values()] == [
        "quadratic_thrust", "quadratic_thrust:n_bow", "quadratic_thrust:n_port+n_star",
    ]  # fmt: skip
    assert laws["quadratic_thrust:n_port+n_star"].arguments == (
        "n_port", "alpha_port", "n_star", "alpha_star",
    )  # fmt: skip
    gains = hypotheses(ship, "thruster_gain")
    # the strength of the tunnel says that of the pair
    assert [h.parameters[0].high for h in gains.values()] == [10.0, 1.0, 1.0]
    three = vessel(TUNNEL, *PAIR, {**RUDDER, "x": -5.0})
    (pair,) = (h for k, h in hypotheses(three, "thruster_gain").items() if "+" in k)
    assert (pair.key, pair.parameters[0].name) == ("thruster_gain:n_port+n_star", "gain_n_port")
    both = hypotheses(vessel(*PAIR), "quadratic_thrust")
    assert list(both) == ["quadratic_thrust"]
    assert len(hypotheses(vessel(*PAIR), "thruster_gain")) == 2


def test_a_rate_is_told_by_the_time_of_the_whole_way() -> None:
    parameter = Parameter("rate_delta", "rad/s", 1.0, over=2.0)
    assert parameter.told(4.0, 0.4) == pytest.approx((0.5, 0.05))
    assert Parameter("lag", "s", 1.0).told(4.0, 0.4) == (4.0, 0.4)


def test_names_of_files_hold_no_colon() -> None:
    assert file_word("thruster_lag:delta [rad]") == "thruster_lag_delta_rad_"


def test_a_late_column_that_stands_in_another_ones_place_stays_late() -> None:
    ship = replace(vessel(*PAIR), actuation=Actuation(lag=2.0, lag_on="n_port"))
    log = make_log(ship, dict.fromkeys((*ship.commands, "u"), np.zeros(9)), 1.0)
    wires = (("n_port", "n_star", 1.0), ("n_star", "n_port", 1.0))
    found = extended_vessel(ship, Sensors(), wires, log)
    assert [t.speed for t in found.thrusters] == ["n_star", "n_port"]
    assert found.actuation.lag_on == "n_star"


@pytest.mark.long
def test_a_slow_azimuth_is_named_with_its_place(tmp_path) -> None:
    trial = draw(
        np.random.default_rng([77, 1]), ("thruster_lag:alpha1",), kind="manoeuvres", samples=900
    )
    found = diagnose([trial.estimation], validate=[trial.validation])
    assert found.verdict == "named"
    (cause,) = found.to_dict()["causes"]
    assert (cause["id"], cause["place"]) == ("thruster_lag:alpha1",) * 2
    lag, truth = cause["parameters"]["lag"], trial.truth[0].number("lag")
    assert abs(lag["value"] - truth) < 2 * lag["std"]
    assert "alpha1 alone acts with a time constant" in cause["evidence"]
    found.model.save(tmp_path / "model.json")
    late = load_model(tmp_path / "model.json").vessel.actuation
    assert (late.lag, late.lag_on) == (lag["value"], "alpha1")


@pytest.mark.long
@pytest.mark.parametrize(("effect", "seed"), [("rate_limit", 11), ("feedback_sampling", 6)])
def test_what_acts_beside_the_log_is_measured(effect: str, seed: int) -> None:
    trial = draw(np.random.default_rng([77, seed]), (effect,), kind="manoeuvres", samples=900)
    found = diagnose(
        [trial.estimation], validate=[trial.validation], options=DiagnosisOptions(causes=LATE)
    )
    (cause,) = found.causes
    assert cause.id == effect
    for name, truth in trial.truth[0].parameters.items():
        told = cause.parameters[name]
        assert abs(told.value - float(truth)) <= 3 * told.std
    late = found.model.vessel.actuation
    if effect == "rate_limit":
        assert late.rate_limit == pytest.approx(cause.parameters["rate_alpha2"].value)
        assert late.rate_on == "alpha2"
    else:
        assert late == Actuation(between="interpolated")


@pytest.mark.long
@pytest.mark.parametrize("effect", ["input_delay:alpha2", "thruster_lag:n2", "rate_limit"])
def test_one_actuator_is_named_among_all_causes(effect: str) -> None:
    trial = draw(np.random.default_rng([77, 3]), (effect,), kind="manoeuvres", samples=900)
    found = diagnose([trial.estimation], validate=[trial.validation])
    assert [c.id for c in found.causes] == [effect]


@pytest.mark.long
def test_a_slow_rudder_of_a_foreign_ship_is_named(tmp_path) -> None:
    """The log holds orders of the rudder, and the propeller as it turns."""
    preset = presets()["training-ship-105m"]
    ship = replace(preset.ship, rudder_lag=8.0, rudder_rate=5.0)
    (tmp_path / "ship.toml").write_text(ship.vessel_toml())
    file, logs = load_vessel(tmp_path / "ship.toml"), []
    for seed in (1, 2):
        trial = replace(preset, ship=ship).sail(manoeuvres.everyday(), seed=seed)
        columns = trial.columns(round(1.0 / preset.dt), commands=True)
        del columns["n_command"]
        columns["delta"] = columns.pop("delta_command")
        path = tmp_path / f"{seed}.csv"
        head = ",".join(columns)
        table = np.column_stack(list(columns.values()))
        np.savetxt(path, table, delimiter=",", header=head, comments="")
        logs.append(read_log(path, file))
    found = diagnose(logs[:1], validate=logs[1:])
    (cause,) = (c for c in found.causes if c.id.startswith("thruster_lag"))
    assert cause.id == "thruster_lag:delta"
    assert abs(cause.parameters["lag"].value - 8.0) < 2 * cause.parameters["lag"].std
