"""`greybox design` as a user types it."""

from __future__ import annotations

import json
import re

import numpy as np
import pandas as pd
import pytest
from designs import hasty_search, thesis_model
from schemas import schema

from greybox.commands.main import main
from greybox.model.run.simulation import simulate
from greybox.vessel.force import generalised_force
from greybox.vessel.toml import vessel_to_dict

FAST = ["--effort", "0.05", "--workers", "1"]
SHORT = ["--duration", "100", "--predictor", "basic", "--seed", "3"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    from greybox.model.model import model_from_dict

    where = tmp_path_factory.mktemp("design")
    model = thesis_model()
    model.save(where / "model.json")
    data = model.to_dict()
    data["theta"][list(data["names"]).index("Nvr")] = -0.08
    model_from_dict(data).save(where / "other.json")
    thesis_model("surge").save(where / "surge.json")
    thesis_model(spread=0.1).save(where / "prior.json")
    assert vessel_to_dict(model.vessel)["name"] == "Thesis ship"
    text = (
        'name = "Thesis ship"\nlength = 30.0\n'
        + "".join(
            f'[[thruster]]\ntype = "azimuth"\nx = {x}\ny = 0.0\nspeed = "n"\nangle = "{a}"\n'
            f"speed_limits = [10.0, 20.0]\nangle_limits = [0.6, 1.1]\n"
            for x, a in ((9.0, "alpha1"), (-9.0, "alpha2"))
        )
        + "[sensors]\nu_std = 0.0141\nv_std = 0.0141\nr_std = 0.0141\nheading_std = 0.01\n"
    )
    (where / "ship.toml").write_text(text)
    return where


def run(folder, *options, model="model.json"):
    plan = folder / "plan.csv"
    plan.unlink(missing_ok=True)
    given = ["design", "--vessel", str(folder / "ship.toml"), "--model", str(folder / model)]
    status = main([*given, "--out", str(plan), *FAST, *options])
    return status, plan


@pytest.fixture(scope="module")
def designed(folder):
    """Plan and JSON of a short design."""
    out = folder / "short.json"
    with hasty_search():
        status, plan = run(folder, *SHORT, "--json", str(out))
    assert status == 0
    return plan.read_bytes(), json.loads(out.read_text())


def test_plan_and_json(folder, capsys):
    out = folder / "design.json"
    status, plan = run(
        folder, "--duration", "150", "--predictor", "basic", "--regime", "u+v+", "--margin-u",
        "0.5", "--margin-v", "0.4", "--start", "1.5,1.2,0,0", "--json", str(out),
    )  # fmt: skip
    assert status == 0
    table = pd.read_csv(plan)
    assert list(table) == ["t", "n", "alpha1", "alpha2"]
    np.testing.assert_allclose(table["t"], np.arange(150))
    data = json.loads(out.read_text())
    schema("design-1", "experiment_design").validate(data)
    assert data["efficiency_vs_random"] > 0.9
    # fifteen parameters by zero-mean IV: the bound of ascents says little
    if data["certificate"]["kind"] == "numerical":
        assert 0.1 <= data["efficiency_lower_bound"] <= 1
    else:
        assert data["certificate"] == {"kind": "not informative"}
        assert data["efficiency_lower_bound"] is None
    assert data["margins"]["v"] >= 0.4
    assert data["starts"] == [{"u": 1.5, "v": 1.2, "r": 0.0, "psi": 0.0}]
    assert data["criterion"] == "D"
    assert data["lead_in_s"] == 0
    assert data["parts"] == [{"part": "trial", "trial": 1, "from": 0.0, "to": 150.0, "share": 1}]
    assert "predicted" not in capsys.readouterr().err


@pytest.mark.long
def test_a_start_at_rest_gets_a_lead_in(folder, capsys):
    out, sheet, page = (folder / name for name in ("led.json", "led.html", "page.html"))
    status, plan = run(
        folder, *SHORT, "--regime", "u+v+", "--margin-u", "0.5", "--margin-v", "0.4", "--start",
        "0,0,0,0", "--speed-cap", "2.5", "--json", str(out), "--sheet", str(sheet), "--report",
        str(page), "--legs", model="prior.json",
    )  # fmt: skip
    assert status == 0, capsys.readouterr().err
    said = capsys.readouterr().out
    data = json.loads(out.read_text())
    schema("design-1", "experiment_design").validate(data)
    lead = data["lead_in_s"]
    assert 0 < lead <= 120
    assert data["parts"] == [
        {"part": "lead-in", "trial": 1, "from": 0.0, "to": lead, "share": lead / (lead + 100)},
        {"part": "trial", "trial": 1, "from": lead, "to": lead + 100, "share": 100 / (lead + 100)},
    ]
    assert data["starts"] == [{"u": 0.0, "v": 0.0, "r": 0.0, "psi": 0.0}]
    assert data["duration"] == 100
    table = pd.read_csv(plan)
    assert list(table) == ["t", "part", "n", "alpha1", "alpha2"]
    np.testing.assert_allclose(table["t"], np.arange(lead + 100))
    assert (table["part"] == np.where(table["t"] < lead, "lead-in", "trial")).all()
    # sailed from rest: margins hold behind the lead-in, the cap all the way
    model, samples = thesis_model(), int(lead)
    force = generalised_force(model.vessel, {n: table[n].to_numpy() for n in model.vessel.commands})
    tau = np.stack([force[n] for n in model.structure.inputs], axis=-1)
    x = simulate(model.structure, model.theta, np.zeros(3), tau[None], 1.0, psi0=0.0).x[0]
    np.testing.assert_array_less([0.499, 0.399], x[samples:, :2].min(axis=0))
    assert np.hypot(x[:, 0], x[:, 1]).max() < 2.501
    assert data["margins"]["v"] == pytest.approx(x[samples:, 1].min())
    assert all(x["missed"] <= 1e-3 for x in data["limits"])
    # margins that are missed on the way alone are not missed
    assert data["keeps_limits"]["probability"] > 0
    assert data["legs"]["by_clock"] == pytest.approx(data["keeps_limits"]["probability"], abs=0.1)
    legs = json.loads(plan.with_suffix(".legs.json").read_text())
    assert legs["start"]["u"] == 0
    assert sum(leg["expected"] for leg in legs["legs"]) == pytest.approx(lead + 100, rel=0.2)
    assert f"1 trial of 100 s behind a lead-in of {lead:g} s" in said
    assert f"Before it a lead-in of {lead:g}\u00a0s" in page.read_text()
    assert "lead-in from 0:00 to" in sheet.read_text()


def test_a_plan_with_parts_is_read_as_a_log(folder, tmp_path):
    plan, out = tmp_path / "plan.csv", tmp_path / "run.csv"
    rows = [f"{k},{'lead-in' if k < 3 else 'trial'},{10 + k % 3},0.8,0.9\n" for k in range(20)]
    plan.write_text("t,part,n,alpha1,alpha2\n" + "".join(rows))
    status = main(["simulate", str(folder / "model.json"), str(plan), "--start", "1.5,1.2,0,0",
                   "--heading", "simulated", "--out", str(out)])  # fmt: skip
    assert status == 0
    assert len(pd.read_csv(out)) == 20


@pytest.mark.usefixtures("hasty")
def test_same_seed_same_bytes(folder, designed):
    _, plan = run(folder, *SHORT)
    assert plan.read_bytes() == designed[0]


@pytest.mark.usefixtures("hasty")
def test_surge_model(folder, capsys):
    status, plan = run(folder, "--duration", "200", "--json", "-", model="surge.json")
    assert status == 0
    data = json.loads(capsys.readouterr().out)
    assert set(data["predicted_std"]) == {"Xu", "Xuu", "Xmu"}
    assert list(data["margins"]) == ["u"]
    assert plan.exists()


@pytest.mark.long
def test_campaign_has_a_trial_column(folder):
    status, plan = run(folder, "--duration", "100", "--predictor", "basic", "--trials", "2")
    assert status == 0
    table = pd.read_csv(plan)
    assert list(table)[:2] == ["trial", "t"]
    assert table.groupby("trial").size().to_dict() == {1: 100, 2: 100}


@pytest.mark.usefixtures("hasty")
def test_sea_room_file(folder):
    room = folder / "room.csv"
    room.write_text("x_n,y_n\n-150,-150\n150,-150\n150,150\n-150,150\n")
    status, _ = run(folder, "--duration", "100", "--predictor", "basic", "--area", str(room))
    assert status == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "needs columns x_n and y_n"),
        ("x_n,y_n\n1,2\n3,4\n", "has 2 corners"),
        ("x_n,y_n\n1,x\n3,4\n5,6\n", "no number"),
        ("", "needs columns"),
    ],
)
def test_sea_rooms_that_are_none(folder, capsys, text, message):
    room = folder / "bad.csv"
    room.write_text(text)
    status, plan = run(folder, "--duration", "100", "--area", str(room))
    assert status == 1
    assert message in capsys.readouterr().err
    assert not plan.exists()


@pytest.mark.usefixtures("hasty")
def test_between(folder, capsys):
    pair = [str(folder / "model.json"), str(folder / "other.json")]
    given = ("--duration", "100", "--between", *pair, "--json", "-")
    status, plan = run(folder, *given, model="other.json")
    assert status == 0
    data = json.loads(capsys.readouterr().out)
    assert not any("takes no part" in note for note in data["notes"])
    schema("design-1", "experiment_design").validate(data)
    assert data["discrimination"]["between"] == ["model", "other"]
    assert plan.exists()


@pytest.mark.long
def test_least_time(folder, capsys):
    status, plan = run(folder, "--duration", "400", "--predictor", "basic", "--target", "Yvv=0.03")
    assert status == 0
    assert len(pd.read_csv(plan)) < 400


@pytest.mark.usefixtures("hasty")
def test_one_function_of_the_parameters(folder, capsys):
    status, _ = run(folder, "--duration", "100", "--predictor", "basic", "--of", "Yvv/Ymu",
                    "--json", "-")  # fmt: skip
    assert status == 0
    data = json.loads(capsys.readouterr().out)
    assert data["criterion"] == "c"
    assert set(data["predicted_std"]) == {"Yvv", "Ymu"}


@pytest.mark.usefixtures("hasty")
def test_prior_of_earlier_trials(folder, designed, capsys):
    run(folder, *SHORT, "--json", "-", "--prior", str(folder / "prior.json"))
    both = json.loads(capsys.readouterr().out)
    assert both["logdet"] > designed[1]["logdet"]
    for name, value in both["parameters"].items():
        # merged columns hold two parameters, whose prior errors add
        assert both["predicted_std"][name] < 0.11 * abs(value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([*SHORT, "--margin-v", "3"], "no steady motion keeps the margins"),
        (["--duration", "100", "--area", "nowhere.csv"], "cannot read the sea room"),
        (["--duration", "100", "--circle", "0,0"], "--circle needs three numbers"),
        (["--duration", "100", "--end", "x_n"], "--end 'x_n' cannot be read"),
        (["--duration", "100", "--target", "Yvv"], "--target 'Yvv' cannot be read"),
        (["--duration", "100", "--want", "Yv2"], "Did you mean 'Yv'"),
        ([], "--duration is missing"),
        (["--duration", "1e9"], "50000 is the most"),
        (["--duration", "100", "--end", "u=1:-1"], "has the tolerance -1"),
        (["--duration", "100", "--energy", "2"], "between 0 and 1"),
        (
            ["--duration", "100", "--regime", "u+v+", "--start=-1.5,1.2,0,0"],
            "starts with u = -1.5 m/s and the regime u+v+ asks for more than 0",
        ),
    ],
)
def test_errors_are_one_sentence(folder, capsys, options, message):
    status, plan = run(folder, *options)
    assert status == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not plan.exists()


@pytest.mark.long
@pytest.mark.parametrize(
    ("asked", "duration"),
    [
        (["--margin-u", "0.5", "--margin-v", "3"], "300"),
        (["--margin-u", "0.5", "--margin-v", "1.55", "--start", "1.5,1.6,0,0"], "150"),
    ],
)
def test_advice_on_margins_beyond_reach_can_be_followed(folder, capsys, asked, duration):
    """Beyond every steady motion, and beyond what is kept after a start that still keeps it."""
    asked = ["--duration", duration, "--predictor", "basic", *asked]
    status, _ = run(folder, *asked)
    assert status == 1
    error = capsys.readouterr().err
    advised = re.search(r"Use ((?:--margin-[uv] [\d.]+ ?)+),", error).group(1).split()
    # options that are given again replace the first ones
    status, plan = run(folder, *asked, *advised, "--json", str(folder / "eased.json"))
    assert status == 0, capsys.readouterr().err
    assert plan.exists()
    margins = json.loads((folder / "eased.json").read_text())["margins"]
    wanted = dict(zip(advised[::2], map(float, advised[1::2]), strict=True))
    for option, value in wanted.items():
        assert margins[option[-1]] >= value - 1e-3
    # the advice asks for no less than a third of what a steady motion keeps, 1.51 m/s
    assert wanted["--margin-v"] > 0.5


def test_outputs_never_replace_inputs(folder, capsys):
    model = folder / "model.json"
    before = model.read_bytes()
    status = main(["design", "--vessel", str(folder / "ship.toml"), "--model", str(model),
                   "--duration", "100", "--out", str(model)])  # fmt: skip
    assert status == 1
    assert "would write over" in capsys.readouterr().err
    assert model.read_bytes() == before
    status, plan = run(folder, "--duration", "100", "--json", str(folder / "plan.csv"))
    assert status == 1
    assert not plan.exists()


@pytest.mark.parametrize(
    "options", [["--seed", "-1"], ["--current", "nan,0"], ["--robust", "-3"], ["--workers", "0"]]
)
def test_numbers_that_cannot_be_are_wrong_usage(folder, options):
    with pytest.raises(SystemExit) as stop:
        run(folder, "--duration", "100", *options)
    assert stop.value.code == 2


@pytest.mark.parametrize(
    ("options", "name"),
    [
        (["--end", "u=1.5", "u=1.6"], "u"),
        (["--envelope", "n=12:14", "n=14:16"], "n"),
        (["--for", "coefficients", "--target", "Yvv=1", "Yvv=2"], "Yvv"),
    ],
)
def test_a_name_that_stands_twice_is_refused(folder, capsys, options, name):
    status, plan = run(folder, "--duration", "100", *options)
    assert status == 1
    option = next(o for o in options[::-1] if o.startswith("--"))
    assert f"{option} gives '{name}' twice: keep one of them." in capsys.readouterr().err
    assert not plan.exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--circle", "0,0,300", "--position", "900,0"], "starts 600.0 m outside the sea room"),
        (["--circle", "0,0,300", "--clearance", "400"], "starts 100.0 m short of the clearance"),
        (["--area", "{crossing}"], "crosses itself: name its 4 corners in their order round it"),
        (["--regime", ""], "the regime is empty"),
        (["--end", "u=nan"], "both must be finite"),
    ],
)
def test_a_trial_that_cannot_begin_is_told_before_any_search(
    folder, tmp_path, monkeypatch, capsys, options, message
):
    def search(*given, **named):
        pytest.fail("it is searched for")

    monkeypatch.setattr("experiment_design.for_prediction.search_envelope", search)
    crossing = tmp_path / "crossing.csv"
    crossing.write_text("x_n,y_n\n0,0\n400,400\n400,0\n0,400\n")
    given = [o.replace("{crossing}", str(crossing)) for o in options]
    status, plan = run(folder, "--duration", "100", *given)
    assert status == 1
    assert message in capsys.readouterr().err
    assert not plan.exists()


def test_wrong_usage(folder):
    with pytest.raises(SystemExit) as stop:
        run(folder, "--duration", "-5")
    assert stop.value.code == 2
