"""Plans as legs: what ends them, how they are sailed and written, and foreign ships on them."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from designs import limited_ship, make_request, thesis_model
from foreign_ships import manoeuvres, presets
from schemas import schema

from experiment_design.certificate.certificate import absent
from experiment_design.constraints.limits import Circle, TrialLimits
from experiment_design.excitation.rollout import Rollout
from experiment_design.for_prediction import design_for_prediction
from experiment_design.output.legs import Leg, drawn_models, legs_of, planned_ends, sail_legs
from experiment_design.output.legs_file import csv_path, legs_path, legs_to_dict, write_legs
from experiment_design.output.prediction import predict_motion
from experiment_design.output.result import Design
from experiment_design.output.sheet_contents import (
    leg_words,
    sheet_contents,
    shown_as,
    signs_words,
    turned_notes,
)
from experiment_design.output.trial_sheet import write_sheet
from experiment_design.prepare import both_sides, prepare_request
from experiment_design.request.request import DesignRequest
from greybox import estimate_model, read_log
from greybox.commands.main import main
from greybox.errors import UsageError
from greybox.model.semi_empirical import semi_empirical_model
from greybox.vessel.toml import load_vessel
from greybox.vessel.vessel import ColumnMapping

# main dimensions of the tanker of the foreign ships, as a crew knows them
DIMENSIONS = "beam = 1.27\nmass = 3270.0\nservice_speed = 1.18\n"
# n and delta of each hold
ZIGZAG = np.array(
    [(11.0, d) for d in (0.0, 0.35, 0.35, -0.35, -0.35, 0.35, 0.35, 0.0, -0.5, -0.5, -0.5, 0.2)]
)


def design_of(request, *levels):
    """A design of given levels, one array a trial; what it is worth is not asked."""
    commands = tuple(request.schedule.expand(x) for x in levels)
    motions = tuple(rollout_of(request, t).run(c[None], late=True) for t, c in enumerate(commands))
    unknown = float("nan")
    return Design(
        request, commands, levels, motions, (), np.zeros(0), np.zeros((0, 0)), unknown, None,
        unknown, 0, absent("no bound was looked for"), {}, (), None, (), "given", (), 0, 0.0,
    )  # fmt: skip


def rollout_of(request, trial=0):
    return Rollout(
        request.vessel, request.structure, request.theta, request.d, request.starts[trial],
        request.sample_time, request.integrator,
    )  # fmt: skip


def tanker_plan(folder, seed):
    """A plan for the foreign tanker by a prior 20 % wrong, beside what published formulas say."""
    path = folder / "ship.toml"
    text = presets()["kvlcc2-7m"].ship.vessel_toml("quadratic")
    path.write_text(text.replace("length = 7\n", f"length = 7\n{DIMENSIONS}"))
    vessel = load_vessel(path)
    model = semi_empirical_model(vessel)
    theta = np.asarray(model.theta)
    wrong = 1 + 0.2 * np.random.default_rng(seed).choice([-1, 1], theta.size)
    model = replace(model, theta=theta * wrong, covariance=np.diag((0.2 * theta) ** 2))
    asked = DesignRequest(duration=180.0, hold=15.0, start=[0.9, 0, 0, 0], limits=TrialLimits())
    request = prepare_request(model, both_sides(asked, model), vessel)
    design = design_of(request, ZIGZAG)
    return design, legs_of(design)


@pytest.fixture(scope="module")
def tanker(tmp_path_factory):
    return tanker_plan(tmp_path_factory.mktemp("tanker"), 1)


def simple_legs(**changes):
    base = Leg({"n": 11.0, "delta": 0.3}, "time", 20.0, 20.0, 20.0)
    return replace(base, **changes)


def test_equal_holds_are_one_leg(tanker) -> None:
    design, plan = tanker
    first, ends = planned_ends(design.levels[0], design.request.schedule)
    assert first.tolist() == [0, 1, 3, 5, 7, 8, 11]
    assert ends[-1] == design.request.schedule.samples
    legs = plan.trials[0]
    assert [leg.commands["delta"] for leg in legs] == ZIGZAG[first, 1].tolist()
    for leg in legs:
        assert leg.at_least < leg.expected <= leg.at_most <= 2 * leg.expected + 1


def test_legs_by_the_clock_are_the_plan(tanker) -> None:
    design, plan = tanker
    request = design.request
    ends = planned_ends(design.levels[0], request.schedule)[1]
    seconds = np.diff([0, *ends]) * request.sample_time
    legs = [
        replace(leg, until="time", value=float(s), at_most=float(s))
        for leg, s in zip(plan.trials[0], seconds, strict=True)
    ]
    thetas = drawn_models(request, 5, 0)
    sailed = sail_legs(rollout_of(request), thetas, legs, request.schedule)
    clock = rollout_of(request).run_models(thetas, design.commands[0], late=True)
    np.testing.assert_array_equal(sailed.ends, np.tile(ends, (5, 1)))
    np.testing.assert_allclose(sailed.motion.state, clock.state, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "leg",
    [
        simple_legs(until="heading", value=0.3, at_most=60.0),
        simple_legs(until="speed", value=0.8, at_most=60.0, rising=False),
        simple_legs(until="yaw_rate", value=0.02, at_most=60.0),
    ],
    ids=lambda leg: leg.until,
)
def test_every_model_ends_where_it_should(tanker, leg) -> None:
    request = tanker[0].request
    thetas = drawn_models(request, 12, 1)
    sailed = sail_legs(rollout_of(request), thetas, [leg], request.schedule)
    state, dt = sailed.motion.state, request.sample_time
    signal = {
        "heading": state[..., 3] - state[:, :1, 3],
        "speed": np.hypot(state[..., 0], state[..., 1]),
        "yaw_rate": state[..., 2],
    }[leg.until]
    sign = 1 if leg.rising else -1
    assert len(set(sailed.ends[:, 0].tolist())) > 2
    for value, end in zip(signal, sailed.ends[:, 0], strict=True):
        if end < round(leg.at_most / dt):
            assert sign * value[end] >= sign * leg.value > sign * value[end - 1]
        else:
            assert (sign * value[1:end] < sign * leg.value).all()


def test_under_the_prior_legs_give_its_plan_back(tanker) -> None:
    design, plan = tanker
    request = design.request
    legs = plan.trials[0]
    sailed = sail_legs(rollout_of(request), request.theta[None], legs, request.schedule)
    ends = planned_ends(design.levels[0], request.schedule)[1]
    expected = np.diff([0, *sailed.ends[0]]) * request.sample_time
    # what was chosen was sailed the same way
    np.testing.assert_allclose(expected, [leg.expected for leg in legs], atol=1e-9)
    psi = design.motions[0].state[0, ends, 3]
    assert np.rad2deg(np.abs(sailed.at_ends()[0, :, 3] - psi)).max() < 5


def test_legs_scatter_less_than_the_clock(tanker) -> None:
    plan = tanker[1]
    assert {leg.until for leg in plan.trials[0]} > {"heading"}
    assert plan.off["psi"] < 0.9 * plan.off_by_clock["psi"]
    assert plan.keeps_limits >= plan.by_clock - 0.05
    assert not plan.assumed


def test_a_misfit_moves_the_models_that_legs_are_chosen_and_judged_by(tanker) -> None:
    design, exact = tanker

    def misfit(motion, draws):
        """A yaw rate that is off by 0.3 deg/s (standard deviation) throughout."""
        off = np.zeros((draws, *motion.state.shape[1:2], 3))
        off[..., 2] = np.deg2rad(0.3) * np.random.default_rng(1).standard_normal((draws, 1))
        return off

    plan = legs_of(replace(design, request=replace(design.request, misfit=misfit)))
    ends = planned_ends(design.levels[0], design.request.schedule)[1] * design.request.sample_time
    # by the clock the heading drifts from end to end, on top of what the coefficients do
    expected = np.deg2rad(0.3) * np.sqrt(np.mean(ends**2))
    drift = np.sqrt(plan.off_by_clock["psi"] ** 2 - exact.off_by_clock["psi"] ** 2)
    # the standard deviation of 200 draws is known to 5 %
    assert drift == pytest.approx(expected, rel=0.2)
    assert plan.trials != exact.trials
    assert "under 200 models drawn from the prior and its misfit" in plan.sentence()
    assert "misfit" not in exact.sentence()


@pytest.mark.long
def test_under_a_misfit_a_foreign_ship_keeps_a_plan_for_prediction_by_legs(tmp_path) -> None:
    preset = presets()["kvlcc2-7m"]
    (tmp_path / "ship.toml").write_text(preset.ship.vessel_toml())
    vessel = load_vessel(tmp_path / "ship.toml")
    steps = manoeuvres.random_steps(hold=(0.5, 2.0))
    preset.sail(steps, 356.0, seed=6100).write_csv(tmp_path / "first.csv", 5)
    model = estimate_model(read_log(tmp_path / "first.csv", vessel)).model()
    asked = DesignRequest(duration=300.0, limits=TrialLimits(), effort=0.3)
    request = prepare_request(model, both_sides(asked, model), vessel)
    design = design_for_prediction(request, model).design.from_first_command()
    plan = legs_of(design)
    blind = legs_of(replace(design, request=replace(design.request, misfit=None)))
    by_legs, by_clock = heading_off(design, plan)
    assert by_legs < 0.6 * by_clock
    assert by_legs < heading_off(design, blind)[0]
    # what is said of the clock holds for this ship, too
    assert by_clock < 2 * np.rad2deg(plan.off_by_clock["psi"])


def steered(legs):
    """Sail the JSON's legs on a ship that knows nothing of the product; times of their ends."""
    ended: list[tuple[float, float]] = []

    def manoeuvre(ship, rng):
        place, since, psi, first, before = 0, 0.0, None, None, None
        turned = 0.0

        def helm(motion):
            nonlocal place, since, psi, first, before, turned
            if before is not None:
                turned += math.remainder(motion.psi - before, 2 * math.pi)
            before = motion.psi
            psi = turned if psi is None else psi
            leg = legs[place]
            end, past = leg["until"], motion.t - since
            signal = {
                "time": past,
                "heading": turned - (psi if end.get("since") == "leg" else 0.0),
                "speed": math.hypot(motion.u, motion.v),
                "yaw_rate": motion.r,
            }[end["kind"]]
            value = end.get("change", end.get("value", end.get("after")))
            sign = 1 if end.get("crossing", "up") == "up" else -1
            done = past >= leg["at_least"] and sign * signal >= sign * value
            if place < len(legs) and (done or past >= leg["at_most"]):
                ended.append((motion.t, turned))
                if place + 1 < len(legs):
                    place, since, psi = place + 1, motion.t, turned
            return list(legs[place]["commands"].values())

        return helm

    return manoeuvre, ended


def heading_off(design, plan):
    """RMS distance [deg] from the plan at ends of legs on the foreign tanker, legs and clock."""
    legs = json.loads(json.dumps(legs_to_dict(design, plan)))["legs"]
    preset, dt = presets()["kvlcc2-7m"], design.request.sample_time
    where = {"start_speed": float(design.request.starts[0][0]), "start_heading": 0.0, "seed": 1}
    manoeuvre, ended = steered(legs)
    preset.sail(manoeuvre, sum(leg["at_most"] for leg in legs), **where)
    times = np.arange(len(design.commands[0])) * dt
    clock = preset.sail(
        manoeuvres.table(times, design.commands[0].tolist()), float(times[-1]) + dt, **where
    )
    ends = planned_ends(design.levels[0], design.request.schedule)[1]
    by_clock = np.interp(ends * dt, clock.t, np.unwrap(clock.true["psi"]))
    by_legs = np.array([psi for _, psi in ended[: len(legs)]])
    planned = design.motions[0].state[0, ends, 3]
    return [float(np.rad2deg(np.sqrt(np.mean((x - planned) ** 2)))) for x in (by_legs, by_clock)]


def test_a_foreign_ship_keeps_the_plan_better_by_legs(tanker, tmp_path) -> None:
    found = [heading_off(*tanker), *(heading_off(*tanker_plan(tmp_path, s)) for s in (2, 3))]
    for by_legs, by_clock in found:
        assert by_legs < by_clock
    by_legs, by_clock = np.mean(found, axis=0)
    assert by_legs < 0.6 * by_clock


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "Rudder starboard 17.2°, n 11.0; for 20 s"),
        ({"commands": {"n": 11.0, "delta": 0.0}}, "Rudder midships, n 11.0; for 20 s"),
        (
            {"until": "heading", "value": math.radians(-20), "at_most": 40.0, "rising": False},
            "until heading has changed 20° to port, at the latest after 40 s",
        ),
        (
            {"until": "heading", "value": math.radians(-20), "at_most": 150.0, "since": "trial"},
            "until heading is 340°, turning to starboard, at the latest after 2:30 min",
        ),
        (
            {"until": "speed", "value": 1.5, "at_most": 40.0, "rising": False},
            "until speed has fallen to 1.5 m/s (2.9 kn), at the latest after 40 s",
        ),
        (
            {"until": "yaw_rate", "value": math.radians(-2), "at_most": 40.0, "rising": False},
            "until yaw rate has risen to 2°/s to port, at the latest after 40 s",
        ),
        (
            {"until": "yaw_rate", "value": math.radians(2), "at_most": 40.0, "rising": False},
            "until yaw rate has fallen to 2°/s to starboard, at the latest after 40 s",
        ),
        (
            {"until": "yaw_rate", "value": 0.0, "at_most": 40.0},
            "until she has stopped turning, at the latest after 40 s",
        ),
    ],
)
def test_words(tanker, changes, words) -> None:
    assert leg_words(simple_legs(**changes), tanker[0], 0).endswith(words)


def test_words_and_sheet_of_a_steered_jet_name_the_side_to_which_the_ship_turns() -> None:
    """Its log shows the other sign: what a crew reads there turns the ship as the plan does."""
    ship = limited_ship(angles=(-0.6, 0.6))
    jet = replace(ship, thrusters=ship.thrusters[1:])
    columns = {"Helm_deg": ColumnMapping("alpha2", "deg", -1)}
    for angle, turns in ((0.3, "port"), (-0.3, "starboard")):
        request = make_request(
            vessel=jet,
            starts=(np.array([1.5, 0.0, 0.0, 0.0]),),
            duration=20.0,
            limits=TrialLimits(),
        )
        design = design_of(request, np.array([(15.0, angle), (15.0, angle)]))
        turned = design.motions[0].state[0, -1, 2]
        assert (turned > 0) == (turns == "starboard")
        leg = simple_legs(commands={"n": 15.0, "alpha2": angle})
        words = leg_words(leg, design, 0)
        assert words == f"N 15.0, alpha2 17.2° to turn her to {turns}; for 20 s"
        assert turned_notes(jet) == []
        mapped = replace(request, vessel=replace(jet, columns=columns))
        design = replace(design, request=mapped)
        read = "−17.2" if angle > 0 else "17.2"
        assert f"turn her to {turns} (Helm_deg {read}°); for" in leg_words(leg, design, 0)
        (band,) = predict_motion(design, draws=1)
        contents = sheet_contents(design, band)
        (shown,) = [c for c in contents.columns if c.name == "Helm_deg"]
        assert shown.cells[0].startswith(read)
        assert contents.note.startswith("Positive Helm_deg turns her to starboard. ")
        assert "alpha2 as the vessel file defines it" in turned_notes(mapped.vessel)[0]
    # the vessel file may take the sign out by [sensors] as well, and both leave what it was
    both = replace(mapped.vessel, sensors={"reversed": ("alpha2",)})
    assert shown_as(both, "alpha2") == ("alpha2", 1)
    assert shown_as(replace(both, columns={}), "alpha2") == ("alpha2 (as logged)", -1)
    # several azimuths turn her together: each pushes to its side
    assert signs_words(ship) == (
        "positive alpha1 pushes to starboard; positive alpha2 pushes to starboard."
    )


def test_files(tanker, tmp_path) -> None:
    design, plan = tanker
    path = legs_path("", tmp_path / "plan.csv")
    assert path.name == "plan.legs.json"
    write_legs(design, plan, path)
    data = json.loads(path.read_text())
    schema("legs-1", "experiment_design").validate(data)
    assert data["start"] == {"u": 0.9, "v": 0, "r": 0, "psi": 0, "x_n": 0, "y_n": 0}
    with open(tmp_path / "plan.legs.csv", newline="") as handle:
        rows = list(csv.DictReader(handle))
    assert [int(row["leg"]) for row in rows] == [*range(1, len(data["legs"]) + 1)]
    for row, leg in zip(rows, data["legs"], strict=True):
        assert row["until"] == leg["until"]["kind"]
        assert row["words"] == leg["words"]
        assert float(row["delta"]) == pytest.approx(leg["commands"]["delta"])


def test_the_csv_never_replaces_the_plan(tmp_path) -> None:
    assert csv_path(legs_path(str(tmp_path / "plan.json"), "plan.csv")).name == "plan.legs.csv"
    with pytest.raises(UsageError, match=r"ends in \.json, such as plan\.legs\.json"):
        legs_path("plan.csv", "plan.csv")


def test_the_sheet_holds_the_legs(tanker, tmp_path) -> None:
    design, plan = tanker
    (band,) = predict_motion(design, 20)
    contents = sheet_contents(design, band, plan.trials[0])
    (do,) = [c for c in contents.columns if c.words]
    assert do.cells[:-1] == tuple(leg_words(leg, design, 0) for leg in plan.trials[0])
    assert contents.columns[0].cells[0] == "0:00"
    write_sheet(design, tmp_path / "sheet.html", plan)
    page = (tmp_path / "sheet.html").read_text()
    assert do.cells[1] in page
    write_sheet(design, tmp_path / "sheet.pdf", plan)
    assert (tmp_path / "sheet.pdf").read_bytes().startswith(b"%PDF")


def test_several_trials_with_ramps_in_a_sea_room_and_no_stated_scatter() -> None:
    regime = (("u", 1),)
    start = np.array([1.5, 1.2, 0.0, 0.0])
    request = make_request(
        vessel=limited_ship(speed=2.0, angle=0.2), regimes=(regime,) * 2, starts=(start,) * 2,
        limits=TrialLimits(area=Circle(0.0, 0.0, 400.0)), duration=80.0,
    )  # fmt: skip
    schedule = request.schedule
    rng = np.random.default_rng(1)
    span = schedule.upper - schedule.lower
    levels = [
        schedule.within_reach(schedule.lower + span * rng.uniform(0, 1, (8, len(span))))
        for _ in range(2)
    ]
    design = design_of(request, *levels)
    plan = legs_of(design)
    assert plan.assumed
    assert [len(legs) for legs in plan.trials] == [8, 8]
    assert "place" in plan.off
    # as sailed, commands keep their rates
    thetas = drawn_models(request, 6, 9)
    commands = sail_legs(rollout_of(request), thetas, plan.trials[0], schedule).motion.commands
    pace = np.abs(np.diff(commands, axis=1)).max(axis=(0, 1))
    assert (pace <= span / np.array(schedule.ramp) + 1e-9).all()
    data = legs_to_dict(design, plan)
    schema("legs-1", "experiment_design").validate(data)
    assert len(data["start"]) == 2
    assert [leg["trial"] for leg in data["legs"]] == [1] * 8 + [2] * 8


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The tanker's vessel file, and models of the thesis's ship."""
    where = tmp_path_factory.mktemp("line")
    text = presets()["kvlcc2-7m"].ship.vessel_toml("quadratic")
    (where / "tanker.toml").write_text(text.replace("length = 7\n", f"length = 7\n{DIMENSIONS}"))
    thesis_model("surge", spread=0.1).save(where / "surge.json")
    thesis_model().save(where / "one.json")
    theta = thesis_model().theta.copy()
    theta[thesis_model().names.index("Nvr")] = -0.08
    replace(thesis_model(), theta=theta).save(where / "other.json")
    return where


@pytest.mark.usefixtures("hasty")
@pytest.mark.parametrize(
    ("options", "duration"),
    [
        ("--vessel tanker.toml --prior none --predictor basic --hold 8", 160),
        ("--vessel thesis --model surge.json --criterion D", 160),
        ("--vessel thesis --between one.json other.json --regime u+v+ --start 1.5,1.2,0,0", 100),
    ],
    ids=["prediction", "coefficients", "between"],
)
def test_from_the_command_line(folder, monkeypatch, capsys, options, duration) -> None:
    monkeypatch.chdir(folder)
    status = main(
        ["design", *options.split(), "--duration", str(duration), "--effort", "0.02", "--workers",
         "1", "--out", "plan.csv", "--legs", "--json", "design.json"]
    )  # fmt: skip
    assert status == 0
    data = json.loads((folder / "design.json").read_text())
    schema("design-1", "experiment_design").validate(data)
    legs = data["legs"]
    assert legs["file"] == "plan.legs.json"
    assert 0 <= legs["keeps_limits"] <= 1
    assert 0 <= legs["by_clock"] <= 1
    written = json.loads((folder / "plan.legs.json").read_text())
    assert sum(leg["expected"] for leg in written["legs"]) == pytest.approx(duration, rel=0.1)
    said = capsys.readouterr()
    assert "as legs, of which" in said.out + said.err
    assert "wrote plan.legs.json\nwrote plan.legs.csv\n" in said.out + said.err
