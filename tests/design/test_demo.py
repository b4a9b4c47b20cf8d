"""The demo: its virtual sea, its page, and that the commands it shows do what it says."""

import hashlib
import json
import shlex
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from browser import needs_browser, require_legible

from experiment_design.demo.loop import EFFECTS, run_demo
from experiment_design.demo.page import headline
from greybox.commands.main import main
from greybox.errors import UsageError
from greybox.study.blind import sail

PLAN = np.tile([14.0, 14.0, 0.8, 0.8], (60, 1))
START = np.array([1.8, 1.0, 0.0, 0.0])


def sailed(seed, effects=(), size=1.0):
    rng = np.random.default_rng(seed)
    return sail(rng, effects, (PLAN, PLAN), (START, START), size=size, single=True)


def test_an_effect_changes_the_ship_and_no_other_draw():
    plain, same, late = sailed(3), sailed(3), sailed(3, ("thruster_lag",))
    assert np.array_equal(plain.estimation["u"], same.estimation["u"])
    assert plain.ship == late.ship
    assert np.array_equal(plain.estimation["n"], late.estimation["n"])
    assert late.truth[0].id == "thruster_lag"
    assert not np.array_equal(sailed(4).estimation["u"], plain.estimation["u"])


def test_a_runaway_is_told():
    rng = np.random.default_rng(0)
    fast = np.tile([400.0, 400.0, 0.8, 0.8], (200, 1))
    with pytest.raises(UsageError, match="runs away on these commands with nothing wrong"):
        sail(rng, (), (fast, fast), (START, START), single=True)


def test_unknown_effects_are_named_with_those_that_exist(tmp_path, capsys):
    assert main(["demo", "--out", str(tmp_path / "d"), "--effect", "curent"]) == 1
    said = capsys.readouterr().err
    assert "did you mean 'current'" in said.lower()
    assert not (tmp_path / "d").exists()
    assert "thruster_lag" in EFFECTS


@pytest.mark.long
def test_ctrl_c_in_a_search_ends_the_loop(tmp_path, monkeypatch):
    """A search that is stopped gives the best plan so far, on which the demo would go on."""

    def stopped(*given, **named):
        raise KeyboardInterrupt

    monkeypatch.setattr("experiment_design.demo.loop._EFFORT", 0.02)
    monkeypatch.setattr("experiment_design.design.certify", stopped)
    with pytest.raises(KeyboardInterrupt):
        run_demo(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["prior.json"]


def test_its_headline_names_effects_by_their_titles():
    lag = SimpleNamespace(id="thruster_lag", title="slow thrusters")
    bias = SimpleNamespace(id="heading_bias", title="compass bias")
    for causes, said in (
        ([lag], "lacked, slow thrusters: the trial was designed, the cause found and named"),
        ([bias], "lacked, slow thrusters; the verdict of these logs is 'named', with compass bias"),
        ([], "lacked, slow thrusters; the verdict of these logs is 'named'."),
    ):
        diagnosis = SimpleNamespace(causes=causes, verdict="named")
        assert said in headline(diagnosis, SimpleNamespace(hidden=[lag]))


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    assert main(["demo", "--out", str(folder)]) == 0
    return folder


@pytest.mark.long
def test_the_demo_goes_once_round(demo):
    for name in ("prior.json", "plan.csv", "trial.csv", "other.csv", "model.json", "better.json",
                 "next_plan.csv", "report.html"):  # fmt: skip
        assert (demo / name).stat().st_size > 0
    page = (demo / "report.html").read_text()
    for heading in (
        "1. Design the trial",
        "4. Estimate",
        "6. Name the cause",
        "8. Design the next",
    ):
        assert heading in page
    assert "the cause found and named" in page
    assert len(page) < 5_000_000
    assert page.count("<svg") >= 8
    assert hashlib.sha256((demo / "plan.csv").read_bytes()).hexdigest() in page


@pytest.mark.long
@needs_browser
def test_its_page_is_legible(demo):
    for width in (390, 1280):
        require_legible(demo / "report.html", width)


@pytest.mark.long
def test_the_commands_it_shows_work(demo, monkeypatch, capsys):
    shown = [
        line.split("</pre>")[0]
        for line in (demo / "report.html").read_text().split('<pre class="marked">greybox ')[1:]
    ]
    assert len(shown) == 7
    monkeypatch.chdir(demo)
    kept = (demo / "plan.csv").read_text()
    for command in shown:
        assert main(shlex.split(command)) == 0, command
    # the demo did just what its commands do
    assert (demo / "plan.csv").read_text() == kept
    capsys.readouterr()
    better = json.loads(Path("better.json").read_text())
    assert better["diagnosis"]["verdict"] == "named"


@pytest.mark.long
def test_other_effects_are_named_too(tmp_path, monkeypatch):
    monkeypatch.setattr("experiment_design.demo.loop._EFFORT", 0.02)
    for effect in ("current", "quadratic_thrust"):
        found = run_demo(tmp_path, effect=effect, seed=5).diagnosis
        assert [c.id for c in found.causes] == [effect]
