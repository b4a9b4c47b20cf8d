"""Figures that zoom: what they hold, how they move in a browser, names that cannot break out."""

from __future__ import annotations

import base64
import gzip
import json
import re
import time

import numpy as np
import pytest
from browser import driven, without_scripts
from matplotlib.figure import Figure

from greybox.report.chart import chart_of
from greybox.report.figures import STYLES, new_figure, to_svg
from greybox.report.interactive import chart_json
from greybox.report.page import Page, Picture, render, write_page
from greybox.report.thinning import points_for

HOSTILE = '</script><script>document.title="broken"</script><img src=x onerror=alert(1)> $x^$ $$a$$'
SENTENCE = 'A log called "& <b>".'


def stacked():
    """Two panels with one time axis, a band, a strip, a level, a map and words."""
    t = np.arange(500.0)
    figure = Figure(figsize=(6, 5))
    grid = figure.add_gridspec(3, 1)
    top = figure.add_subplot(grid[0])
    below = figure.add_subplot(grid[1], sharex=top)
    plan = figure.add_subplot(grid[2])
    top.plot(t, np.sin(t / 40), label=HOSTILE)
    top.plot(t, np.cos(t / 40), "--", color="#D55E00", label="model")
    top.fill_between(t, np.sin(t / 40) - 0.1, np.sin(t / 40) + 0.1, alpha=0.2)
    top.legend()
    top.set_ylabel(HOSTILE)
    below.plot([0, 100, 500], [0, 1, 0], drawstyle="steps-post", label="_hidden")
    below.axhline(0.5)
    below.broken_barh([(10, 20)], (0, 1), transform=below.get_xaxis_transform(), label="gap")
    below.set_xlabel("time [min:s]")
    plan.plot(t, t, "o", label="track")
    plan.set_aspect("equal")
    plan.text(3, 4, HOSTILE)
    return figure


def zoomable():
    figure = stacked()
    picture = Picture(to_svg(figure, "stacked"), HOSTILE, SENTENCE, chart=chart_of(figure))
    return Page(HOSTILE, HOSTILE, [HOSTILE], [picture], computed={HOSTILE: HOSTILE})


def arrays_of(item):
    """Every packed array of a chart's JSON, by its type of number."""
    if isinstance(item, dict):
        if item.get("type") == "ndarray":
            raw = gzip.decompress(base64.b64decode(item["array"]["data"]))
            yield item["dtype"], np.frombuffer(raw, item["dtype"])
        item = list(item.values())
    for part in item if isinstance(item, list) else ():
        yield from arrays_of(part)


def test_far_coordinates_keep_their_steps():
    figure = new_figure(4, 4)
    way = 0.1 * np.arange(50.0)
    figure.subplots().plot(598765 + way, np.r_[6512345 + way[:-1], np.nan])
    figure.axes[0].plot(np.full(3, 0.1), [0.0, np.nan, 1500.2])
    found = list(arrays_of(json.loads(chart_json(chart_of(figure), "zoom0"))))
    assert [kind for kind, _ in found] == ["float64", "float64", "float64", "float32"]
    assert np.diff(found[1][1][:-1]) == pytest.approx(0.1, abs=1e-6)


def test_a_chart_holds_what_the_figure_shows():
    top, below, plan = chart_of(stacked()).panels
    assert [line.dash for line in top.lines] == ["solid", "dashed"]
    assert top.lines[1].colour == "#d55e00"
    np.testing.assert_array_equal(top.lines[0].y, np.sin(np.arange(500.0) / 40))
    assert top.areas[0].opacity == pytest.approx(0.2)
    assert top.areas[0].polygons[0][:, 1].max() == pytest.approx(1.1, abs=1e-3)
    assert (top.legend, below.legend) == (True, False)
    assert (top.together, below.together, plan.together) == (0, 0, 2)
    np.testing.assert_array_equal(below.lines[0].x, [0, 100, 100, 500, 500])
    np.testing.assert_array_equal(below.lines[0].y, [0, 0, 1, 1, 0])
    assert below.lines[0].label == ""
    assert below.levels == (0.5,)
    np.testing.assert_allclose(below.strips[0].spans, [[10, 30]])
    assert plan.equal
    assert plan.words == ((3.0, 4.0, HOSTILE),)
    assert plan.lines[0].marker == "circle"


def test_errorbars_and_bars_are_held():
    figure = new_figure(4, 3)
    ax = figure.subplots()
    ax.errorbar([1, 2], [3, 4], yerr=[0.5, 1.0], fmt="s")
    ax.barh([1], [5], 0.5)
    (panel,) = chart_of(figure).panels
    bars = [line for line in panel.lines if np.isnan(line.y).any()]
    np.testing.assert_allclose(bars[0].y, [2.5, 3.5, np.nan, 3, 5, np.nan])
    assert panel.areas[0].polygons[0][:, 0].max() == 5


def test_what_cannot_be_held_is_left_out():
    figure = new_figure(4, 3)
    one, two = figure.subplots(1, 2)
    one.plot([1, 10], [1, 10])
    one.set_yscale("log")
    two.quiver([0], [0], [1], [1])
    two.plot([0, 1], [0, 1])
    (panel,) = chart_of(figure).panels
    assert not panel.areas
    assert len(panel.lines) == 1


def test_names_cannot_break_out():
    html = render(zoomable())
    assert html.count("<script") == 3
    shown = without_scripts(html)
    assert "<img" not in shown
    data = re.findall(r'<script type="application/json">(.*?)</script>', shown, re.S)
    assert len(data) == 1
    # what looks like a formula is kept from being one
    assert HOSTILE.replace("$$", "$\u200b$") in json.dumps(json.loads(data[0])).encode().decode(
        "unicode_escape"
    )


def test_the_same_figure_gives_the_same_bytes():
    assert render(zoomable()) == render(zoomable())
    one, two = (chart_json(chart_of(stacked()), name) for name in ("a", "b"))
    assert one == two.replace('"b-', '"a-').replace('"b"', '"a"')


def test_a_page_without_charts_has_no_script():
    page = zoomable()
    html = render(Page("t", "h", pictures=[Picture(page.pictures[0].svg, "c")]))
    assert "<script" not in html
    assert "script-src &#39;none&#39;" in html
    assert len(html) < 300_000


def test_the_policy_forbids_the_network():
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', render(zoomable())).group(1)
    assert policy.startswith("default-src &#39;none&#39;")
    assert "unsafe-inline&#39;; script-src &#39;sha256-" in policy
    assert "http" not in policy


def test_points_are_shared_by_the_curves_of_a_page():
    assert points_for(1) == 2000
    assert points_for(1000) == 150
    assert points_for(100, most=10_000, room=200_000) == 2000
    assert len(set(STYLES)) == 4


_VIEW = """
    const grid = Bokeh.documents[0].roots()[0];
    return grid.children.map(([p]) => [p.x_range.start, p.x_range.end, p.y_range.start]);
"""
_CANVASES = """
    const found = [];
    const look = (root) => root.querySelectorAll("*").forEach((e) => {
      if (e.tagName === "CANVAS") found.push(e.getAttribute("aria-label"));
      if (e.shadowRoot) look(e.shadowRoot);
    });
    look(document.querySelector(".zoom"));
    return found;
"""
_TOLD = """
    const found = [];
    const look = (root) => root.querySelectorAll("*").forEach((e) => {
      if (e.shadowRoot) { found.push(e.shadowRoot.textContent); look(e.shadowRoot); }
    });
    look(document);
    return found;
"""
_ACTIVE = """
    return Bokeh.documents[0].roots()[0].toolbar.tools
      .filter((t) => t.active).map((t) => (t.tools ? t.tools[0] : t).type);
"""


def opened(browser):
    """Press the button and wait for the drawing."""
    browser.find_element("css selector", "figure button").click()
    for _ in range(100):
        if browser.execute_script(_CANVASES) and all(browser.execute_script(_CANVASES)):
            time.sleep(0.3)
            return browser.find_element("css selector", ".zoom")
        time.sleep(0.1)
    raise AssertionError("the figure did not open")


def test_zoom_in_a_browser(tmp_path):
    """Wheel and drag move both panels of one time axis; names are text; nothing complains."""
    path = tmp_path / "page.html"
    write_page(zoomable(), path)
    with driven(path) as browser:
        from selenium.webdriver import ActionChains
        from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

        place = opened(browser)
        before = browser.execute_script(_VIEW)
        assert before[0][:2] == before[1][:2]
        assert set(browser.execute_script(_CANVASES)) == {SENTENCE}
        assert set(browser.execute_script(_ACTIVE)) >= {"WheelZoomTool", "BoxZoomTool"}
        browser.execute_script("arguments[0].scrollIntoView()", place)
        # within the first panel, whatever the height of the whole
        rise = -place.size["height"] // 2 + 130
        origin = ScrollOrigin.from_element(place, 0, rise)
        ActionChains(browser).scroll_from_origin(origin, 0, -300).perform()
        time.sleep(0.5)
        zoomed = browser.execute_script(_VIEW)
        assert zoomed[0][1] - zoomed[0][0] < 0.9 * (before[0][1] - before[0][0])
        assert zoomed[0][:2] == zoomed[1][:2]
        (
            ActionChains(browser).move_to_element_with_offset(place, -100, rise)
            .click_and_hold().move_by_offset(150, 0).release().perform()
        )  # fmt: skip
        time.sleep(0.5)
        boxed = browser.execute_script(_VIEW)
        assert boxed[1][1] - boxed[1][0] < 0.5 * (zoomed[1][1] - zoomed[1][0])
        ActionChains(browser).move_to_element_with_offset(place, 60, rise).perform()
        time.sleep(0.5)
        assert any(HOSTILE.replace("$$", "$\u200b$") in t for t in browser.execute_script(_TOLD))
        assert browser.title == HOSTILE
        assert browser.execute_script("return document.images.length") == 0
        assert [e["message"] for e in browser.get_log("browser")] == []


@pytest.mark.long
def test_a_finger_scrolls_the_page(tmp_path):
    """On a phone no tool takes a drag before it is asked to; nothing runs over the side."""
    path = tmp_path / "page.html"
    write_page(zoomable(), path)
    with driven(path, 390, touch=True) as browser:
        place = opened(browser)
        active = browser.execute_script(_ACTIVE)
        assert not {"WheelZoomTool", "BoxZoomTool", "PanTool"} & set(active)
        sizes = "const e = document.documentElement; return [e.scrollWidth, e.clientWidth]"
        assert browser.execute_script(sizes) == [390, 390]
        browser.execute_script("arguments[0].scrollIntoView()", place)
        before, view = browser.execute_script("return scrollY"), browser.execute_script(_VIEW)
        for step in range(11):
            point = [{"x": 195, "y": 500 - 20 * step}]
            kind = "touchMove" if step else "touchStart"
            browser.execute_cdp_cmd(
                "Input.dispatchTouchEvent", {"type": kind, "touchPoints": point}
            )
        browser.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        time.sleep(0.5)
        assert browser.execute_script("return scrollY") > before + 100
        assert browser.execute_script(_VIEW) == view
