"""The page of an estimate: the verdicts first, every test told, escaped, the same every time."""

from __future__ import annotations

import html
from dataclasses import replace

import numpy as np
import pytest
from browser import needs_browser, require_legible, without_scripts
from surge import surge_log
from virtual import virtual_log

from greybox.commands.main import main
from greybox.estimation.prediction_verdict import PredictionLevel, PredictionVerdict
from greybox.estimation.tried import Comparison, TriedModel
from greybox.estimation.verdict import Divergence, TrustLevel, Verdict, refused
from greybox.model.catalogue import get_structure
from greybox.model.predictor import build_predictor
from greybox.report.estimation import estimation_page, headline
from greybox.report.estimation_figures import regime_shares
from greybox.report.next_steps import after_estimate
from greybox.report.page import computed, render
from greybox.selection.estimate import estimate_model
from greybox.selection.fit_single import estimate_ls

HOSTILE = '<script>alert("x")</script> & $x^$'


@pytest.fixture(scope="module")
def log():
    return virtual_log(1, 800, name=HOSTILE)


@pytest.fixture(scope="module")
def estimate(log):
    return estimate_model([log], method="iv", predictor="augmented")


@pytest.fixture(scope="module")
def page(estimate, log):
    return estimation_page(estimate, [log], {"program": "p"}, mass=1e5)


def test_all_is_told(estimate, page):
    shown = html.unescape(without_scripts(render(page)))
    for test in estimate.tests:
        assert test.name.replace("_", " ") in shown
        assert test.sentence[1:] in shown
    for label, value in zip(estimate.labels, estimate.structure_theta(), strict=False):
        assert label in shown
        assert f"{value:.4g}".replace("e-", "e−") in shown or value == 0
    for note in estimate.notes:
        assert note in shown
    assert "Physical quantities for m = 100000 kg" in shown
    assert "a log the model was estimated on" in shown


def test_every_picture_says_what_it_shows(page):
    pictures = [page.lead, *(p for s in page.sections for p in s.pictures)]
    assert len(pictures) == 7
    assert all(len(p.alternative) > len(p.caption) for p in pictures if p.alternative != p.caption)
    assert all(p.alternative for p in pictures)
    assert [p.chart is not None for p in pictures] == [True] + 6 * [False]


def test_what_was_tried_is_a_picture_and_a_table(estimate, log):
    rows = tuple(
        TriedModel(f"linear+{n}", "basic", "ls", 1.0, "n", n, 50.0 + n, 3.0 - n, 0.5, n == 3)
        for n in range(4)
    )
    compared = Comparison("structures", "held-out runs", "the best", rows)
    shown = estimation_page(replace(estimate, tried=(compared,)), [log], {"program": "p"})
    section = next(s for s in shown.sections if "chosen" in s.title)
    (picture,), (one,) = section.pictures, section.tables
    for row in rows:
        assert row.label in picture.alternative
    assert compared.decision in picture.caption
    assert [r[0] for r in one.rows] == ["linear+3", "linear+2", "linear+1", "linear+0"]


def test_names_are_text(page):
    shown = without_scripts(render(page))
    assert "<script>" not in shown
    assert "&lt;script&gt;alert" in shown
    assert len(render(page)) < 5_000_000


@pytest.mark.long
def test_same_estimate_same_bytes(estimate, log, page):
    again = estimation_page(estimate, [log], {"program": "p"}, mass=1e5)
    assert render(again) == render(page)


@pytest.mark.parametrize(
    ("verdict", "first"),
    [
        (Verdict(TrustLevel.TRUST), "Trust its coefficients: no test speaks against them."),
        (
            Verdict(TrustLevel.TRUST_EXCEPT, ("Xu", "Nr")),
            "Trust its coefficients, except for Xu, Nr.",
        ),
        (
            refused([Divergence()], ()),
            "Do not trust its coefficients: its free run diverges on the estimation logs.",
        ),
    ],
)
def test_the_verdicts_stand_first(estimate, page, verdict, first):
    told = headline(replace(estimate, verdict=verdict))
    prediction = f"Prediction is {estimate.prediction.level}: {estimate.prediction.reason}. "
    assert told.startswith(prediction + first)
    assert "(100 is perfect)" in told
    assert headline(replace(estimate, verdict=verdict, fit={}, prediction=None)) == first
    assert [row[0] for row in page.tables[0].rows] == ["surge", "sway", "yaw rate"]


@pytest.mark.usefixtures("undrawn")
def test_the_free_run_is_told_of_as_many_logs_as_there_are(estimate, log, page):
    one = page.sections[0].sentences
    assert one[0].startswith("The model was fitted to this log, ")
    assert one[0].endswith("see the table above.")
    assert one[-1] == "Its free run is drawn at the top of the page."
    assert "fits the log it was estimated on" in page.headline
    # without a table there is none to see
    data = replace(estimate.data, logs=4 * estimate.data.logs)
    four = replace(estimate, data=data, prediction=None, tests=())
    told = estimation_page(four, 4 * [log.window(0, 60)], {})
    assert "see the table above" not in told.sections[0].sentences[0]
    assert told.sections[0].sentences[1:] == [
        "Of 4 logs the first 3 are drawn.",
        "Of those drawn the one of lowest fit stands at the top of the page.",
    ]
    assert "fits the logs it was estimated on" in told.headline


def test_a_log_kept_from_the_estimate_leads(estimate, log):
    other = virtual_log(2, 200, name="kept")
    page = estimation_page(estimate, [log], {}, validate=[other])
    assert (
        "Free run on kept (200 samples of 1 s), a log kept from the estimate" in page.lead.caption
    )
    assert page.sections[0].sentences[-1] == (
        "The log kept from the estimate stands at the top of the page."
    )
    (own,) = page.sections[0].pictures
    assert "a log the model was estimated on" in own.caption
    four = estimation_page(estimate, [log], {}, validate=4 * [other])
    assert four.sections[0].sentences[-2:] == [
        "Of 4 logs kept from the estimate the first 3 are drawn.",
        "Of the logs kept from the estimate the one of lowest fit stands at the top of the page.",
    ]


def test_what_comes_next_of_a_model_of_surge_is_what_it_can_do():
    found = estimate_ls(
        build_predictor(get_structure("surge"), "basic", (("u", (1,)),)), [surge_log(1, 0.5, 300)]
    )
    doubted, good = (
        replace(found, prediction=PredictionVerdict(level))
        for level in (PredictionLevel.POOR, PredictionLevel.GOOD)
    )
    commands = [s.command for e in (doubted, good) for s in after_estimate(e, {})]
    assert commands[0].startswith("greybox diagnose LOG… --vessel V --structure surge ")
    assert commands[-1] == "greybox predict MODEL stopping --report stopping.html"


@pytest.mark.usefixtures("undrawn")
def test_without_tests_the_page_stands(estimate, log):
    bare = estimation_page(replace(estimate, tests=(), notes=(), limits={}), [log], {})
    shown = render(bare)
    assert "No tests were made." in shown
    assert "What do the residuals say?" not in shown


def test_shares_of_regimes():
    shares = regime_shares(np.array([1.0, 1, -1, 1]), np.array([1.0, -1, -1, 1]))
    assert shares == {"u+ v+": 0.5, "u+ v−": 0.25, "u− v+": 0.0, "u− v−": 0.25}


def test_how_it_was_computed():
    record = {
        "program": "greybox-marine 1", "versions": {"numpy": "2", "Python": "3"},
        "command": {"seed": 4, "logs": ["a.csv"]}, "line": "greybox estimate a.csv",
        "inputs": {"a.csv": "ab12"}, "further": 3,
    }  # fmt: skip
    assert computed(record) == {
        "command": "greybox estimate a.csv",
        "seed": "4",
        "read a.csv": "SHA-256 ab12",
        "computed with": "greybox-marine 1, numpy 2, Python 3",
        "further": "3",
    }


def test_by_command(noisy_csv, tmp_path, capsys):
    path = tmp_path / "page.html"
    arguments = ["estimate", str(noisy_csv), "--vessel", "thesis", "--method", "ls", "--predictor",
                 "basic", "--report", str(path)]  # fmt: skip
    pages = []
    for _ in range(2):
        assert main(arguments) == 0
        pages.append(path.read_bytes())
    assert f"wrote {path}" in capsys.readouterr().out
    assert pages[0] == pages[1]
    shown = without_scripts(pages[0].decode())
    assert "casadi" in shown
    assert f"read {noisy_csv}" in shown
    assert "SHA-256 " in shown


@needs_browser
def test_in_a_browser(tmp_path, page):
    path = tmp_path / "page.html"
    path.write_text(render(page))
    require_legible(path, 390)
