"""The first screen of every page: the verdict, a picture that shows it, what to do next."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import driven
from designs import prior_model, random_plan
from fleet.fleets import planted
from manoeuvring import rudder_model
from test_check_page import SHIP, row_case, tie_case
from test_diagnosis_page import BUDGET, RECORD, diagnosis_of
from virtual import PARAMETERS, virtual_log

from experiment_design.demo.page import demo_page
from experiment_design.demo.steps import Demo, Files, Step
from experiment_design.output.report import design_page
from greybox.model.catalogue import get_structure
from greybox.prediction.predict import predict_manoeuvre
from greybox.report.checks import check_page
from greybox.report.comparison import comparison_page
from greybox.report.diagnosis import diagnosis_page
from greybox.report.estimation import estimation_page
from greybox.report.fleet import fleet_page
from greybox.report.page import write_page
from greybox.report.prediction import prediction_page
from greybox.selection.estimate import estimate_model
from greybox.study.blind_causes import Effect
from greybox.study.chapter6 import TRUE
from greybox.validation.comparison import compare
from greybox.validation.gain import Gain
from greybox.vessel.toml import load_vessel

PAGES = ("estimate", "compare", "check", "predict", "design", "diagnose", "fleet", "demo")
# pixels: what a laptop shows of a page without scrolling
SCREEN = (1280, 800)
PHONE = 390


@pytest.fixture(scope="module")
def logs():
    return [virtual_log(seed, 400, name=f"day {seed}") for seed in (1, 2)]


@pytest.fixture(scope="module")
def estimate(logs):
    return estimate_model(logs, method="iv", predictor="basic")


@pytest.fixture(scope="module")
def model():
    theta = np.array([TRUE[n] for n in PARAMETERS])
    return prior_model(load_vessel("thesis"), get_structure("thesis"), theta, 1)


@pytest.fixture(scope="module")
def plan(model):
    return random_plan(model, load_vessel("thesis"), duration=120.0)


GAIN = {s: Gain(71.0, 83.0, (9.0, 15.0)) for s in ("u", "v", "r")}


@pytest.fixture(scope="module")
def story(plan, logs, estimate, tmp_path_factory):
    """The page of the demo."""
    return demo_page(demo_of(tmp_path_factory.mktemp("demo"), plan, logs[0], estimate), {})


def demo_of(folder, plan, log, estimate):
    before, after = (
        compare(dict.fromkeys(names, estimate.model()), log)
        for names in (["model"], ["model", "better"])
    )
    return Demo(
        files=Files(folder), steps=tuple(Step(f"Step {k}", "", ("Told.",)) for k in range(8)),
        design=plan, next_design=plan, trial=log, other=log,
        hidden=(Effect("thruster_lag", {"lag": 8.0}),), check=row_case("gap"), estimate=estimate,
        before=before, after=after, gain=GAIN,
        diagnosis=replace(diagnosis_of("named"), budget=BUDGET),
    )  # fmt: skip


@pytest.fixture
def written(request, tmp_path, logs, estimate, model, plan):
    """One of the pages as a file."""
    path = tmp_path / "page.html"
    record = {"command": {"logs": ["a.csv", "b.csv"], "vessel": "ship.toml", "out": "m.json"}}
    if request.param == "check":
        gap, clock = (
            replace(r, name=n) for r, n in ((row_case("gap"), "a"), (tie_case("clock of r"), "b"))
        )
        check_page([gap, clock], [Path("a.csv"), Path("b.csv")], SHIP, path, record)
        return path
    make = {
        "estimate": lambda: estimation_page(estimate, logs, record),
        "compare": lambda: comparison_page(
            compare({"one": estimate.model(), "two": model}, logs), [model, model], record
        ),
        "predict": lambda: prediction_page(
            predict_manoeuvre(rudder_model(step=0.25, spread=0.03), "turning", speed=2.0, draws=40),
            record,
        ),
        "design": lambda: design_page(plan, ["A note."], record),
        "diagnose": lambda: diagnosis_page(replace(diagnosis_of("named"), budget=BUDGET), RECORD),
        "fleet": lambda: fleet_page(
            planted(12, odd=30.0, change=0.03, left_out=[("ship 13", "its folder has no logs.")]),
            {"command": {"fleet": "ferries"}},
        ),
        "demo": lambda: request.getfixturevalue("story"),
    }[request.param]
    write_page(make(), path)
    return path


_LOWEST = """
    return [".headline", ".lead svg", ".next li"].map(
      (what) => document.querySelector(what).getBoundingClientRect().bottom);
"""
_WIDE = "const e = document.documentElement; return [e.scrollWidth, e.clientWidth]"


@pytest.mark.parametrize(
    "written", [*PAGES[:-1], pytest.param(PAGES[-1], marks=pytest.mark.long)], indirect=True
)
def test_the_first_screen(written):
    """Verdict, picture and next step need no scrolling; a phone scrolls down only."""
    with driven(written) as browser:

        def resize(width, height, phone):
            browser.execute_cdp_cmd(
                "Emulation.setDeviceMetricsOverride",
                {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": phone},
            )

        resize(*SCREEN, False)
        assert browser.execute_script("return innerWidth") == SCREEN[0]
        assert max(browser.execute_script(_LOWEST)) < SCREEN[1]
        command = browser.find_elements("css selector", ".next code")
        assert all(c.text.startswith("greybox ") for c in command)
        resize(PHONE, SCREEN[1], True)
        assert browser.execute_script(_WIDE) == [PHONE, PHONE]
        assert [e["message"] for e in browser.get_log("browser")] == []


def test_the_demo_tells_how_much_of_what_is_left_is_noise(story):
    assert "that is left: surge 33 %" in " ".join(story.sentences)
    assert "Fit of the free run before and after on the other log" in story.lead.caption
    # of the models that its steps compare, not of the one that its diagnosis began with
    assert "surge 71.0 % to 83.0 %" in story.lead.alternative
