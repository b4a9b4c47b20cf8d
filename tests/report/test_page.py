"""Pages: escaped, self-contained, and legible in a real browser."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from browser import driven, needs_browser, require_legible

from greybox.report.figures import comparison_figure, overview_figure, to_svg
from greybox.report.page import Page, Picture, Table, flatten, render, write_page


def page(width=3):
    figure = overview_figure({"u": np.sin(np.arange(50)), "psi": np.arange(50.0)}, "A log")
    return Page(
        "Title <b>",
        "A headline & more.",
        ["One sentence."],
        [Picture(to_svg(figure, "one"), "Two signals <x>.")],
        [
            Table(
                "Numbers",
                ["name"] + ["value"] * width,
                [["<script>alert(1)</script>"] + ["1.0"] * width],
            )
        ],
        [("Model", "u⁺ = u + Xu·u_r")],
        flatten({"program": "greybox", "command": {"logs": ["a.csv", "b.csv"]}}),
    )


def test_values_are_escaped():
    html = render(page())
    assert "<script>" not in html
    assert "&lt;script&gt;" in html
    assert "Title &lt;b&gt;" in html
    assert "command logs" in html
    assert "a.csv, b.csv" in html


def test_identifiers_of_figures_do_not_collide():
    figures = [overview_figure({"u": np.arange(5.0)}, "x") for _ in range(2)]
    one, two = (to_svg(f, t) for f, t in zip(figures, ("a", "b"), strict=True))
    ids = [set(re.findall(r'\bid="([^"]+)"', s)) for s in (one, two)]
    assert ids[0]
    assert not ids[0] & ids[1]


def test_a_picture_holds_nothing_that_is_not_read():
    figure = overview_figure({"u": np.sin(np.arange(50)), "psi": np.arange(50.0)}, "6 <!-- logs")
    svg = to_svg(figure, "6 logs")
    names = re.findall(r' id="([^"]+)"', svg)
    assert set(names) == set(re.findall(r'(?:href="#|url\(#)([^")]+)', svg))
    assert len(names) == len(set(names))
    assert "<!--" not in svg
    # every look that is named is there, under a name that a style sheet may have
    named = set(re.findall(r'class="([^"]+)"', svg))
    assert named
    assert named == set(re.findall(r"\.(s[^{]+)\{", svg))
    styles = re.findall(r' style="([^"]*)"', svg)
    assert all(styles.count(look) < 3 for look in styles)


def test_comparison_figure_has_labels_and_units(clean_log, thesis, true_theta):
    from greybox.model.predictor import build_predictor
    from greybox.selection.fit_single import estimate_ls
    from greybox.validation.fit import run_model

    model = estimate_ls(
        build_predictor(thesis, "basic", (("u", (1,)), ("v", (1,)))), [clean_log]
    ).model()
    figure = comparison_figure(["m"], [run_model(model, clean_log)])
    labels = [a.get_ylabel() for a in figure.axes]
    assert "surge u\n[m/s]" in labels
    several = [f"{k}_{'x' * 40}" for k in range(3)]
    run = run_model(model, clean_log)
    for names in (["m"], several):
        figure = comparison_figure(names, [run] * len(names))
        assert to_svg(figure, "runs").startswith("<svg")
        assert all(ax.get_position().width > 0.6 for ax in figure.axes)
    assert figure.axes[-1].get_xlabel() == "time from the first sample [s]"


def page_of_noise(page):
    """The rows of a comparison's table of noise: model, log and state."""
    table = page.tables[1]
    assert table.caption.startswith("What sensor noise allows")
    return [row[:3] for row in table.rows]


@pytest.mark.usefixtures("undrawn")
def test_a_comparison_tells_of_gaps_and_of_runs_that_left(clean_log, thesis, true_theta):
    from greybox.model.model import ManoeuvringModel
    from greybox.report.comparison import comparison_page
    from greybox.trial.segments import join_segments
    from greybox.validation.comparison import compare

    model = ManoeuvringModel(thesis, true_theta, np.eye(len(true_theta)), 1.0, clean_log.vessel)
    log = join_segments([clean_log.window(0, 100), clean_log.window(110, 200)], "two")
    found = compare({"m": model}, log, bands=False)
    told = comparison_page(found, [model], {}).sentences
    assert [s for s in told if "a run begins anew after it" in s]
    # a model without noise on a log without noise
    assert page_of_noise(comparison_page(found, [model], {})) == [["m", "two", s] for s in "uvr"]
    (run,) = found.runs[0]
    fit = {"u": -2320.0, "v": -np.inf, "r": -261.4}
    verdict = replace(found.verdict, fit=fit)
    left = replace(found, runs=((replace(run, fit=fit),),), verdict=verdict)
    page = comparison_page(left, [model], {})
    assert "Do not predict surge, sway, yaw rate with 'm'" in page.headline
    assert "it has a fit of yaw rate -261 % and its run of surge, sway diverges" in page.headline
    assert page.tables[0].rows[0][2:5] == ["diverged", "diverged", "-261.4"]
    assert page.lead.alternative.endswith("m surge diverged, sway diverged, yaw rate -261.4 %.")


@needs_browser
@pytest.mark.parametrize("width", [390, 1200])
def test_in_a_browser(tmp_path, width):
    """Opens, shows its figure, and does not scroll sideways."""
    path = tmp_path / "page.html"
    write_page(page(width=12), path)
    require_legible(path, width)


@needs_browser
def test_a_long_name_leaves_the_numbers_beside_it_room(tmp_path):
    """A name without a break neither covers a phone nor widens a printed page."""
    name, numbers = "linear+" + "+".join(["X_|v|r"] * 14), ["-0.0064 to -0.0052"] * 4
    tables = [Table("Tried", ["structure", *"abcd"], [[name, *numbers], ["Xu", *numbers]]),
              Table("Fits", ["model", "log", *"abcd"], [["m", "log " * 30, *numbers]])]  # fmt: skip
    path = tmp_path / "page.html"
    write_page(Page("Title", "Headline", tables=tables), path)
    with driven(path) as browser:
        for media, width in (("screen", 390), ("print", 680)):
            browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": media})
            browser.execute_cdp_cmd(
                "Emulation.setDeviceMetricsOverride",
                {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": False},
            )
            page, box, first, second = browser.execute_script(
                "const [e, f] = document.querySelectorAll('.wide'); return ["
                "document.documentElement.scrollWidth, e.clientWidth, "
                "e.querySelector('td').clientWidth, f.querySelectorAll('td')[1].clientWidth]"
            )
            assert page <= width
            assert max(first, second) < 0.6 * box


@needs_browser
def test_a_printed_table_breaks_neither_its_words_nor_behind_its_head(tmp_path):
    rows = [["duplicate_time", "clean", "nothing found " * 12], ["external_force", "clean", ""]]
    made = [Table("All checks", ["check", "outcome", "what was seen"], rows, sentences=True)]
    path = tmp_path / "page.html"
    write_page(Page("Title", "Headline", tables=made), path)
    with driven(path) as browser:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
        browser.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": 680, "height": 800, "deviceScaleFactor": 1, "mobile": False},
        )
        lines, kept = browser.execute_script(
            "const text = document.createRange(); const t = document.querySelector('.wide table');"
            "text.selectNodeContents(t.querySelector('td'));"
            "return [text.getClientRects().length, [t.caption, t.tHead, t.rows[1]].map("
            "e => getComputedStyle(e).breakAfter)]"
        )
        assert lines == 1
        assert kept == ["avoid"] * 3
