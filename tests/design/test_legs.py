"""Plans as legs that end by what the ship does: what they hold, and what they gain."""

from __future__ import annotations

import csv
import json
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from designs import make_request, thesis_model
from foreign_ships import manoeuvres, presets

from experiment_design.excitation.rollout import Rollout
from experiment_design.for_prediction import design_for_prediction
from experiment_design.output.legs import (
    MISFIT,
    Leg,
    LegPlan,
    csv_twin,
    drawn_models,
    legs_of,
    read_legs,
    sail_legs,
    write_legs,
)
from experiment_design.output.prediction import predict_motion
from experiment_design.output.sheet_contents import sheet_contents
from experiment_design.output.trial_sheet import sheet_figures
from experiment_design.prepare import Wishes, both_sides, prepare_request
from greybox.commands.main import main
from greybox.errors import LogError
from greybox.model.semi_empirical import semi_empirical_model
from greybox.vessel.toml import vessel_from_dict
from greybox.vessel.vessel import Actuation

HELD = {"n": 15.0, "alpha1": 0.8, "alpha2": 0.9}


def leg(kind, value, at_most=40.0, rising=True):
    return Leg(HELD, kind, value, at_most, 30.0, rising)


def plan_of(levels, **changes):
    """What legs ask of a design, of levels (K, nc)."""
    levels = np.asarray(levels, float)
    request = make_request(duration=10.0 * len(levels), **changes)
    rollout = rollout_of(request)
    commands = request.schedule.expand(levels)
    motion = rollout.run(commands[None], late=True)
    return SimpleNamespace(
        request=request, levels=(levels,), commands=(commands,), motions=(motion,), limits=(),
        keeping=None, margins={},
    )  # fmt: skip


def rollout_of(request):
    return Rollout(
        request.vessel, request.structure, request.theta, request.d, request.starts[0],
        request.sample_time, request.integrator,
    )  # fmt: skip


@pytest.fixture(scope="module")
def plan():
    rng = np.random.default_rng(3)
    levels = rng.uniform([10, 0.6, 0.6], [20, 1.1, 1.1], (12, 3))
    return plan_of(np.repeat(levels, 2, axis=0))


@pytest.fixture(scope="module")
def legs(plan):
    return legs_of(plan)


def test_equal_holds_are_one_leg(legs, plan) -> None:
    (trial,) = legs.trials
    assert len(trial) == 12
    assert [leg.expected for leg in trial] == [20.0] * 12
    nearly = plan.levels[0] + 0.002 * np.arange(24)[:, None] % 2
    assert len(legs_of(plan_of(nearly)).trials[0]) == 12
    np.testing.assert_allclose(list(trial[3].commands.values()), plan.levels[0][6])


@pytest.mark.parametrize(
    "late",
    [{}, {"lag": 2.0, "lag_on": "force"}, {"lag": 1.5, "lag_on": "command", "delay": 1.4},
     {"rate_limit": 0.05, "rate_on": "alpha1"}],
)  # fmt: skip
def test_legs_by_time_are_the_plan_itself(plan, late) -> None:
    vessel = replace(plan.request.vessel, actuation=Actuation(**late))
    request = replace(plan.request, vessel=vessel)
    held = [
        Leg(dict(zip(HELD, level, strict=True)), "time", 10.0, 10.0, 10.0)
        for level in plan.levels[0]
    ]
    models = drawn_models(request, 4)
    sailed = sail_legs(rollout_of(request), models, held)
    by_clock = rollout_of(request).run_models(models, plan.commands[0], late=True)
    # what a lag keeps of commands long before is left out
    np.testing.assert_allclose(sailed.ends, by_clock.state[:, 10::10, :4], atol=1e-3)
    if not late:
        np.testing.assert_allclose(sailed.ends, by_clock.state[:, 10::10, :4], atol=1e-9)
    assert sailed.stable.all()
    np.testing.assert_array_equal(sailed.seconds, 10.0)


def test_models_are_off_in_their_damping(plan) -> None:
    request = plan.request
    models = drawn_models(request, 6)
    share = models[1:] / request.theta - 1
    names = request.structure.parameters
    np.testing.assert_allclose(np.abs(share[:, names.index("Yvv")]), MISFIT)
    np.testing.assert_allclose(share[:, names.index("Ymu")], 0, atol=1e-12)
    np.testing.assert_allclose(models.mean(axis=0), request.theta)


def test_legs_end_by_their_triggers(plan) -> None:
    path = np.array([[0.0, 0.1, 0.2, 0.3, 0.25, 0.2], [0.0, -0.2, -0.3, -0.4, -0.5, -0.5]])
    ends = [
        leg("time", 3.0, 3.0), leg("heading", 0.2), leg("heading", -0.3), leg("speed", 0.25),
        leg("speed", -0.2, rising=False), leg("yaw_rate", 0.9, at_most=2.0),
    ]  # fmt: skip
    found = [list(e.first(path, 1.0)) for e in ends]
    assert found == [[3, 3], [2, 5], [5, 2], [3, 5], [5, 1], [2, 2]]
    # change of heading counts from where the leg began
    assert list(leg("heading", 0.2).first(path + 3, 1.0)) == [2, 5]
    rollout = rollout_of(plan.request)
    two = [leg("heading", -0.3), leg("time", 5.0, 5.0)]
    models = drawn_models(plan.request, 8)
    sailed = sail_legs(rollout, models, two)
    turned = sailed.ends[:, 0, -1] - plan.request.starts[0][-1]
    early = sailed.seconds[:, 0] < 40
    assert early.any()
    assert (turned[early] <= -0.3 + 1e-9).all()
    assert (sailed.seconds[:, 1] == 5).all()


def test_words_of_a_seaman() -> None:
    assert leg("time", 30.0).words == "for 30 s"
    turn = leg("heading", np.deg2rad(20))
    assert turn.words == (
        "until the heading has changed 20° to starboard, at the latest after 40 s"
    )
    assert turn.short == "until heading 20° to starboard, at most 40 s"
    assert "speed has fallen to 1.20 m/s," in leg("speed", 1.2, rising=False).words
    assert "speed has fallen to 0.50 m/s astern," in leg("speed", -0.5).words
    assert "yaw rate has risen to 1.50°/s to port," in (
        leg("yaw_rate", np.deg2rad(-1.5), rising=False).words
    )
    assert "yaw rate is zero," in leg("yaw_rate", 0.0).words


def test_a_file_of_legs_reads_back(legs, plan, tmp_path) -> None:
    mixed = LegPlan(
        ((leg("heading", -0.3, rising=False), leg("speed", 1.2, rising=False)),
         (leg("yaw_rate", 0.02), leg("time", 30.0))), 0.1, 0.2,
    )  # fmt: skip
    for which in (legs, mixed):
        path = tmp_path / "plan.legs.json"
        write_legs(which, plan, path)
        assert read_legs(path) == which.trials
        data = json.loads(path.read_text())
        assert (data["format"], data["version"]) == ("greybox-legs", 1)
        assert data["start"]["u"] == 1.5
        with open(csv_twin(path), encoding="utf-8") as handle:
            rows = list(csv.DictReader(handle))
        assert [r["words"] for r in rows] == [x["words"] for x in data["legs"]]
        assert [int(r["trial"]) for r in rows] == [x["trial"] for x in data["legs"]]
    assert data["legs"][0]["until"] == {"kind": "heading", "change": -0.3}
    assert data["legs"][1]["until"] == {"kind": "speed", "value": 1.2, "when": "falling"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "is no file of legs"),
        ("[", "is no file of legs"),
        ('{"format": "greybox-legs", "version": 2, "legs": []}', "greybox-legs 1 is needed"),
        ('{"format": "greybox-legs", "version": 1, "legs": [{"until": {"kind": "x"}}]}', "'x'"),
    ],
)
def test_files_that_hold_no_legs(tmp_path, text, message) -> None:
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(LogError, match=message):
        read_legs(path)
    with pytest.raises(LogError, match="cannot read the legs"):
        read_legs(tmp_path / "none.json")


def test_the_sheet_has_a_row_a_leg(legs, plan) -> None:
    (band,) = predict_motion(plan)
    contents = sheet_contents(plan, band, legs.trials[0])
    cells = {c.name: c.cells for c in contents.columns}
    assert cells["hold"] == (*(leg.words for leg in legs.trials[0]), "")
    assert cells["time"][:3] == ("0:00", "0:20", "0:40")
    assert cells["time"][-1] == "4:00"
    assert "go on with the next row" in contents.note
    assert "hold" not in {c.name for c in sheet_contents(plan, band).columns}
    (figure,) = sheet_figures(plan, band, legs.trials[0])
    written = [t.get_text() for t in figure.axes[0].texts]
    assert legs.trials[0][0].words in written or legs.trials[0][0].short in written


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    place = tmp_path_factory.mktemp("legs")
    thesis_model(spread=0.02).save(place / "model.json")
    (place / "ship.toml").write_text(
        'name = "Thesis ship"\nlength = 30.0\n'
        + "".join(
            f'[[thruster]]\ntype = "azimuth"\nx = {x}\ny = 0.0\nspeed = "n"\nangle = "{a}"\n'
            f"speed_limits = [10.0, 20.0]\nangle_limits = [0.6, 1.1]\n"
            for x, a in ((9.0, "alpha1"), (-9.0, "alpha2"))
        )
        + "[sensors]\nu_std = 0.0141\nv_std = 0.0141\nr_std = 0.0141\n"
    )
    return place


def asked(files, *options):
    return [
        "design", "--vessel", str(files / "ship.toml"), "--model", str(files / "model.json"),
        "--duration", "100", "--out", str(files / "plan.csv"), "--effort", "0.05",
        "--workers", "1", *options,
    ]  # fmt: skip


def test_the_command_for_coefficients(files, capsys) -> None:
    out, sheet = files / "design.json", files / "sheet.html"
    given = ["--predictor", "basic", "--regime", "u+v+", "--trials", "2", "--legs"]
    assert main(asked(files, *given, "--json", str(out), "--sheet", str(sheet))) == 0
    told = json.loads(out.read_text())["legs"]
    assert told["file"] == str(files / "plan.legs.json")
    assert 0 <= told["scatter"]["legs"] <= told["scatter"]["clock"]
    trials = read_legs(told["file"])
    assert len(trials) == 2
    assert all(sum(leg.expected for leg in t) == pytest.approx(100) for t in trials)
    assert csv_twin(told["file"]).exists()
    page = sheet.read_text()
    assert trials[0][0].words in page or trials[0][0].short in page
    assert "as legs: " in capsys.readouterr().out


def test_the_command_for_prediction(files, capsys) -> None:
    path = files / "own.json"
    assert main(asked(files, "--for", "prediction", "--json", "-", "--legs", str(path))) == 0
    assert json.loads(capsys.readouterr().out)["legs"]["file"] == str(path)
    assert read_legs(path)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("plan.json", "which another option names"),
        ("legs.csv", "has no ending .json"),
        ("model.json", "would write over"),
    ],
)
def test_files_that_legs_cannot_have(files, capsys, name, message) -> None:
    assert main(asked(files, "--legs", str(files / name))) == 1
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def autopilot(legs, columns, reached):
    """Sail legs as a crew does, and note the heading at the end of each."""

    def manoeuvre(ship, rng):
        now = [0, 0.0, None]

        def helm(motion):
            if now[2] is None:
                now[2] = motion.psi
            if now[0] < len(legs):
                leg = legs[now[0]]
                spent = motion.t - now[1]
                done = spent >= leg.at_most - 1e-6
                if leg.kind == "heading":
                    done |= np.sign(leg.value) * (motion.psi - now[2]) >= abs(leg.value)
                elif leg.kind in ("speed", "yaw_rate") and spent > 0:
                    seen = motion.u if leg.kind == "speed" else motion.r
                    done |= seen >= leg.value if leg.rising else seen <= leg.value
                if done:
                    reached.append(motion.psi)
                    now[:] = [now[0] + 1, motion.t, motion.psi]
            leg = legs[min(now[0], len(legs) - 1)]
            return [leg.commands[c] for c in columns]

        return helm

    return manoeuvre


def test_a_foreign_ship_keeps_nearer_to_the_plan_by_legs() -> None:
    preset = presets()["kvlcc2-7m"]
    ship = preset.ship
    tables = tomllib.loads(ship.vessel_toml()) | {
        "beam": ship.beam, "mass": ship.inertia[0], "service_speed": ship.service_speed,
        "conditions": {"draught": ship.draught},
    }  # fmt: skip
    vessel = vessel_from_dict(tables)
    model = semi_empirical_model(vessel)
    dt = model.sample_time
    hold, duration = (dt * round(k * ship.time_scale / dt) for k in (4, 100))
    off = {"legs": [], "clock": []}
    columns = [a.column for a in ship.actuators]
    for seed in range(2):
        wishes = both_sides(Wishes(duration=duration, seed=seed, effort=0.1), model, hold)
        request = prepare_request(model, wishes, vessel).request
        design = design_for_prediction(request, model).design
        found = legs_of(design)
        assert found.scatter < found.by_clock
        (legs,) = found.trials
        assert {leg.kind for leg in legs} > {"time"}
        ends = np.cumsum([leg.expected for leg in legs])
        planned = design.motions[0].state[0, np.rint(ends / dt).astype(int), 3]
        begin = design.request.starts[0]
        where = {"start_speed": float(begin[0]), "start_heading": float(begin[-1])}
        reached: list[float] = []
        preset.sail(autopilot(legs, columns, reached), 1.5 * duration, **where)
        assert len(reached) == len(legs)
        off["legs"].append(np.array(reached) - planned)
        rows = [[leg.commands[c] for c in columns] for leg in legs]
        table = manoeuvres.table([0.0, *ends[:-1]], rows)
        sailed = preset.sail(table, duration + 1, **where)
        off["clock"].append(np.interp(ends, sailed.t, sailed.true["psi"]) - planned)
    rms = {k: float(np.sqrt(np.mean(np.concatenate(v) ** 2))) for k, v in off.items()}
    assert rms["legs"] < rms["clock"]
