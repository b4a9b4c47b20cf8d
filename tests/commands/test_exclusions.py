"""Options of `greybox design` that do not go together: each is honoured or refused."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

import pytest
from designs import make_request, thesis_model
from virtual import virtual_log, write_csv

from experiment_design import (
    CandidateModel,
    DesignRequest,
    TrialLimits,
    design_between,
    prepare_request,
)
from experiment_design.command import add_arguments
from experiment_design.for_prediction import design_for_prediction
from experiment_design.request.exclusions import RULES, spelt
from greybox.commands.main import main
from greybox.errors import UsageError
from greybox.trial.log import make_log

SHIP = """name = "Thesis ship"
length = 30.0
beam = 6.0
mass = 300000.0
service_speed = 3.0
[conditions]
draught = 2.0
[sensors]
u_std = 0.0141
v_std = 0.0141
r_std = 0.0141
heading_std = 0.01
""" + "".join(
    f'[[thruster]]\ntype = "azimuth"\nx = {x}\ny = 0.0\nspeed = "n"\nangle = "{angle}"\n'
    f"speed_limits = [10.0, 20.0]\nangle_limits = [-1.1, 1.1]\n"
    for x, angle in ((9.0, "alpha1"), (-9.0, "alpha2"))
)
WIND = ("--predictor", "wind", "--wind", "5,3")
ROOM = ("--circle", "0,0,400")
# arguments of each option, and what has to stand beside it for a choice to be made
VALUES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "model": (("--model", "earlier.json"), ()),
    "duration": (("--duration", "80"), ()),
    "remaining": (("--remaining", "60"), ()),
    "after": (("--after", "log.csv"), ()),
    "save_model": (("--save-model", "saved.json"), ()),
    "purpose": (("--for", "prediction"), ()),
    "diagnosis": (("--diagnosis", "diagnosis.json"), ()),
    "causes": (("--causes", "current"), ()),
    "envelope": (("--envelope", "n=14:17"), ()),
    "criterion": (("--criterion", "E"), ()),
    "want": (("--want", "Yvv", "Yv"), ()),
    "of": (("--of", "Yvv/Ymu"), ()),
    "target": (("--target", "Xuu=10"), ()),
    "predictor": (("--predictor", "basic+wind", "--wind", "5,3"), ("--wind", "5,3")),
    "estimator": (("--estimator", "iv-white"), ()),
    "prior": (("--prior", "earlier.json"), ()),
    "between": (("--between", "model.json", "other.json"), ()),
    "regime": (("--regime", "u+v-"), ()),
    "margin_u": (("--margin-u", "0.9"), ()),
    "margin_v": (("--margin-v", "0.3"), ()),
    "margin_air": (("--margin-air", "0.3"), WIND),
    "hold": (("--hold", "15"), ()),
    "start": (("--start", "1.6,0.9,0,0.3"), ()),
    "trials": (("--trials", "2"), ()),
    "area": (("--area", "room.csv"), ()),
    "circle": (ROOM, ()),
    "position": (("--position", "20,10"), ROOM),
    "clearance": (("--clearance", "30"), ROOM),
    "speed_cap": (("--speed-cap", "3.5"), ()),
    "yaw_cap": (("--yaw-cap", "0.2"), ()),
    "end": (("--end", "u=1.5:1"), ()),
    "energy": (("--energy", "0.9"), ()),
    "headings": (("--headings", "0.2"), ()),
    "current": (("--current", "0.05,0.02"), ()),
    "wind": (("--wind", "0.05,0.03"), ()),
    "gust": (("--gust", "2"), WIND),
    "process_noise": (("--process-noise", "0.01,0.01,0.002"), ()),
    "robust": (("--robust", "2"), ()),
    "worst_case": (("--worst-case",), ("--robust", "2")),
    "probability": (("--probability", "0.99"), ROOM),
    "best_effort": (("--best-effort",), ()),
    "effort": (("--effort", "0.5"), ()),
    "cluster": (("--cluster", "tcp://127.0.0.1:9"), ()),
    "workers": (("--workers", "1"), ()),
    "seed": (("--seed", "5"), ()),
}
# options that may leave PLAN and JSON as they are, and why
UNCHANGED = {
    "vessel": "needed in every way",
    "out": "names PLAN",
    "json": "names the JSON",
    "sheet": "names another output",
    "report": "names another output",
    "legs": "names another output",
    "help": "designs nothing",
    "duration": "given in every way, as --remaining with --after",
    "remaining": "another name of --duration",
    "save_model": "names another output",
    "model": "given in every way that takes one",
    "purpose": "is the way",
    "after": "is the way",
    "between": "is the way",
    "causes": "given in the way that takes them",
    "diagnosis": "names causes by its file",
    "position": "moves the sheet's picture where the sea room has room for the trial",
    "probability": "acts where limits would be kept less surely",
    "best_effort": "acts where limits cannot be kept",
    "cluster": "says where it is computed, never what",
    "workers": "says how many compute, never what",
}
WAYS = {
    "coefficients": ("--for", "coefficients", "--model", "model.json", "--regime", "u+v+"),
    "prediction": ("--for", "prediction", "--model", "model.json"),
    "causes": (
        "--for",
        "causes",
        "--causes",
        "thruster_lag:alpha1",
        "heading_bias",
        "--model",
        "model.json",
    ),
    "between": ("--between", "model.json", "other.json"),
    "after": ("--after", "log.csv", "--model", "model.json"),
    "prior none": ("--prior", "none", "--predictor", "basic"),
}


def options_of_design() -> list[str]:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return [a.dest for a in parser._actions]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    from greybox.model.model import model_from_dict
    from greybox.vessel.toml import load_vessel

    where = tmp_path_factory.mktemp("exclusions")
    (where / "ship.toml").write_text(SHIP)
    ship = load_vessel(where / "ship.toml")
    model = replace(thesis_model(spread=0.05), vessel=ship)
    model.save(where / "model.json")
    replace(thesis_model(spread=0.1), vessel=ship).save(where / "earlier.json")
    replace(thesis_model(), vessel=ship).save(where / "exact.json")
    replace(thesis_model("surge", spread=0.1), vessel=ship).save(where / "surge.json")
    data = model.to_dict()
    data["theta"][list(data["names"]).index("Nvr")] = -0.08
    model_from_dict(data).save(where / "other.json")
    log = virtual_log(1, 200, wind=0.0, current=(0.0, 0.0), spread=1e-6)
    channels = {n: x for n, x in log.channels.items() if n not in ("u_q", "v_q")}
    write_csv(make_log(ship, channels, 1.0, "log"), where / "log.csv")
    (where / "room.csv").write_text("x_n,y_n\n-300,-300\n300,-300\n300,300\n-300,300\n")
    causes = [
        {"id": "current", "place": "current", "parameters": {}},
        {"id": "heading_bias", "place": "heading_bias", "parameters": {}},
    ]
    told = {"verdict": "confused", "tried": 40, "partial": [], "candidates": causes}
    (where / "diagnosis.json").write_text(json.dumps(told))
    return where


@pytest.fixture
def design(folder, monkeypatch, capsys):
    """Run the command in the folder: its status, what it wrote, and what it said of an error."""
    monkeypatch.chdir(folder)
    # no cluster is there to answer
    monkeypatch.setattr("greybox.numerics.parallel._client", lambda address: None)

    def run(*options):
        for name in ("plan.csv", "plan.json"):
            (folder / name).unlink(missing_ok=True)
        given = ["design", "--vessel", "ship.toml", "--out", "plan.csv", "--json", "plan.json"]
        status = main([*given, *options])
        error = capsys.readouterr().err
        if status:
            assert not (folder / "plan.csv").exists()
            return status, None, error
        data = json.loads((folder / "plan.json").read_text())
        for name in ("provenance", "wall_s"):
            data.pop(name, None)
        return status, ((folder / "plan.csv").read_text(), data), error

    return run


# what makes a condition not met
UNMET = {
    "a yaw rate": ("--model", "surge.json"),
    "a covariance": ("--model", "exact.json", "--regime", "u+v+"),
    "a measured wind": ("--model", "model.json", "--wind", "5,3"),
    "an estimator of regressors": ("--model", "model.json", *WIND, "--estimator", "oe"),
    "a sign of surge": ("--model", "model.json", "--regime", "v+"),
    "a sign of sway": ("--model", "model.json", "--regime", "u+"),
}
# what makes a rule the only one that is broken, where its two options alone do not
BESIDE = {
    ("of", "criterion c"): ("--criterion", "A"),
    ("causes", "for causes"): ("--for", "coefficients"),
    ("diagnosis", "for causes"): ("--for", "coefficients"),
    ("envelope", "for prediction"): ("--for", "coefficients"),
    ("save_model", "model"): ("--after", "log.csv"),
}
PAIRS = [
    (rule, option, other)
    for rule in RULES
    for option in rule.options
    for other in rule.against or rule.needs[:1]
]


def arguments(name: str, other: str) -> tuple[str, ...]:
    """Return how an option, a purpose or a value is asked for on the command line."""
    if name.startswith("for "):
        causes = ("--causes", "current") if name == "for causes" and other != "diagnosis" else ()
        return ("--for", name.removeprefix("for "), *causes)
    written = {
        "prior none": ("--prior", "none", "--predictor", "basic"),
        "criterion c": ("--criterion", "c"),
    }
    return written.get(name) or VALUES[name][0]


@pytest.mark.parametrize(
    ("rule", "option", "other"), PAIRS, ids=[f"{spelt(a)} {spelt(b)}" for _, a, b in PAIRS]
)
def test_every_rule_is_told_in_one_sentence(design, rule, option, other):
    asked = [*arguments(option, other), *BESIDE.get((option, other), UNMET.get(other, ()))]
    if other in rule.against:
        asked += arguments(other, option)
    if not {"--model", "--between", "--after", "none"}.intersection(asked):
        asked += ("--model", "model.json")
    status, _, error = design("--duration", "60", *asked)
    assert status == 1
    assert error.startswith("greybox design: ")
    assert error.count("\n") == 1
    said = rule.told(spelt(option), "" if rule.needs else spelt(other)).rsplit(":", 1)
    assert said[0] in error
    assert error.endswith(f":{said[1]}\n")


@pytest.mark.parametrize(
    ("structure", "spread", "asked", "message"),
    [
        ("thesis", 0.1, {"worst_case": True}, "--worst-case .* that --robust draws"),
        ("thesis", 0.0, {"robust": 3}, "--robust .* and it has none"),
        ("thesis", 0.0, {"probability": 0.99}, "--probability .* and it has none"),
        ("thesis", 0.1, {"gust": 2.0, "wind": (5.0, 3.0)}, "'augmented' does not measure it"),
        ("thesis", 0.1, {"limits": TrialLimits(clearance=5.0)}, "--clearance .* --area or"),
        ("surge", 0.1, {"limits": TrialLimits(yaw_cap=0.1)}, "structure 'surge' has none"),
        ("surge", 0.1, {"limits": TrialLimits(headings=1.0)}, "structure 'surge' has none"),
        (
            "thesis", 0.1, {"limits": TrialLimits(margins={"v": 0.3}), "regime": "u+"},
            "--margin-v .* regime 'u\\+' has none",
        ),
        ("thesis", 0.1, {"criterion": "c"}, "name it, such as --of"),
        ("thesis", 0.1, {"combination": {"Yv": 1.0}}, "use --criterion c"),
        (
            "thesis", 0.1, {"criterion": "c", "combination": {"Yv": 1.0}, "wanted": ("Yvv",)},
            "leave out --want",
        ),
    ],
)  # fmt: skip
def test_a_request_meets_the_same_rules(structure, spread, asked, message):
    with pytest.raises(UsageError, match=message):
        prepare_request(thesis_model(structure, spread), DesignRequest(150.0, **asked))


def test_two_models_and_predictions_meet_the_same_rules():
    request = make_request(wanted=("Yv",))
    rival = CandidateModel("b", request.structure, request.theta, request.d)
    with pytest.raises(UsageError, match=r"--between .* leave out --want"):
        design_between(request, rival, ("a", "b"))
    with pytest.raises(UsageError, match=r"--for prediction .* leave out --want"):
        design_for_prediction(request, thesis_model())


# what every design of the next test is asked for, beside its way
BRIEF = ("--duration", "60", "--effort", "0.001", "--workers", "1", "--seed", "3")


def test_every_option_has_a_value_to_try():
    assert set(VALUES) | set(UNCHANGED) == set(options_of_design())


@pytest.mark.long
@pytest.mark.parametrize("way", WAYS)
def test_every_option_is_honoured_or_refused(hasty, design, way):
    """In each way of designing it changes PLAN or JSON, or whether there is one, or is refused."""
    usual = {}
    ignored = []
    judged = 0
    for name in sorted(VALUES.keys() - UNCHANGED.keys()):
        value, beside = VALUES[name]
        if beside not in usual:
            usual[beside] = design(*BRIEF, *WAYS[way], *beside)
        status, found, error = design(*BRIEF, *WAYS[way], *beside, *value)
        if status:
            assert error.count("\n") == 1
            told = any(spelt(n) in error for n in (name, *rule_names(beside)))
            # without any trial behind it a minute is too short for some that stand beside others
            assert told or way == "prior none", f"{name}: {error}"
            # a plan that is there without it and not with it does not ignore it
            judged += told or usual[beside][0] == 0
        elif usual[beside][0] == 0:
            judged += 1
            if found == usual[beside][1]:
                ignored.append(name)
    assert ignored == []
    # where there is no plan either way there is nothing to compare
    assert judged > len(VALUES.keys() - UNCHANGED.keys()) // 2


def rule_names(beside):
    """Return the options among arguments."""
    return [a[2:].replace("-", "_") for a in beside if a.startswith("--")]
