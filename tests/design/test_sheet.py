"""What goes on board and what is shown of a plan: right numbers, one page, nothing runs over."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest
from browser import driven, require_legible, without_scripts
from designs import prior_model, random_plan
from matplotlib import image

from experiment_design.constraints.kinds.sea_room import edge_distance
from experiment_design.constraints.limits import Circle, LimitReport, TrialLimits
from experiment_design.feasibility.constraint_satisfaction import ConstraintSatisfaction
from experiment_design.output.pictures import forbidden
from experiment_design.output.prediction import predict_motion
from experiment_design.output.report import design_page
from experiment_design.output.sheet_contents import (
    clock,
    compass,
    plain_name,
    sheet_contents,
    signed,
)
from experiment_design.output.trial_sheet import lay_out, sheet_kind, write_sheet
from greybox.commands.main import main
from greybox.errors import UsageError
from greybox.report.page import render

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
ROOM = np.array([[-400.0, -300], [400, -300], [400, 300], [0, 200], [-400, 300]])
HOSTILE = '</title><script>alert("x")</script> $\\frac{1}$ & 船'


@pytest.fixture(scope="module")
def known(ship, thesis, true_theta):
    return random_plan(prior_model(ship, thesis, true_theta, 0), ship)


@pytest.fixture(scope="module")
def short(ship, thesis, true_theta):
    return random_plan(prior_model(ship, thesis, true_theta, 0), ship, duration=120.0)


@pytest.fixture(scope="module")
def unsure(ship, thesis, true_theta):
    limits = TrialLimits(area=ROOM, clearance=20.0, speed_cap=4.0, yaw_cap=0.2)
    design = random_plan(
        prior_model(ship, thesis, true_theta, 1), ship, limits=limits, current=(0.2, 0.1),
        process_noise=np.array([2e-3, 2e-3, 4e-4]),
    )  # fmt: skip
    return replace(design, request=replace(design.request, seed=4))


def drawn_pages(design, folder):
    """Return the pages of a design's sheet as pictures, grey and from 0 to 1."""
    write_sheet(design, folder / "pages.png")
    picture = image.imread(folder / "pages.png")[:, :, :3].mean(axis=2)
    return picture.reshape(-1, round(picture.shape[1] * 297 / 210), picture.shape[1])


def chromium(*arguments):
    with tempfile.TemporaryDirectory() as profile:
        return subprocess.run(
            [
                CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
                "--no-first-run", "--disable-background-networking", "--disable-component-update",
                "--disable-sync", "--allow-file-access-from-files", f"--user-data-dir={profile}",
                "--enable-logging=stderr", *arguments,
            ],
            capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip


def test_bands_are_nominal_where_nothing_is_uncertain(known):
    (band,) = predict_motion(known)
    assert band.certain
    state = known.motions[0].state[0]
    for i, name in enumerate(("u", "v", "r", "psi", "x_n", "y_n")):
        np.testing.assert_allclose(band[name].nominal, state[:, i], atol=1e-9)
        np.testing.assert_allclose(band[name].low, band[name].high)
    assert band.position_off.max() == 0


def test_bands_repeat_and_hold_new_draws(unsure):
    (band,), (again,) = predict_motion(unsure), predict_motion(unsure)
    np.testing.assert_array_equal(band.low, again.low)
    other = replace(unsure, request=replace(unsure.request, seed=5))
    (fresh,) = predict_motion(other)
    assert np.abs(fresh.low - band.low).max() > 0
    assert (band.low <= band.high).all()
    # widths of independent draws agree within their sampling error
    width = (band.high - band.low)[100:, :3].mean(axis=0)
    np.testing.assert_allclose((fresh.high - fresh.low)[100:, :3].mean(axis=0), width, rtol=0.25)
    assert (np.diff(band.position_off) >= 0).all()
    assert band.lost == 0


def test_positions_start_where_the_trial_does(ship, thesis, true_theta):
    limits = TrialLimits(position=(100.0, -50.0), area=Circle(100.0, -50.0, 500.0))
    design = random_plan(
        prior_model(ship, thesis, true_theta, 0), ship, limits=limits, duration=200.0
    )
    (band,) = predict_motion(design)
    assert (band["x_n"].nominal[0], band["y_n"].nominal[0]) == (100.0, -50.0)
    assert band["edge"].nominal[0] == 500.0


def test_a_model_that_runs_away_is_counted(known):
    wild = np.zeros((len(known.request.theta),) * 2)
    # some draws are pushed by their own square of speed
    k = known.request.structure.index("Xuu")
    wild[k, k] = 0.1**2
    (band,) = predict_motion(
        replace(known, request=replace(known.request, covariance=wild)), draws=50
    )
    assert 0 < band.lost < 50
    assert np.isfinite(band.low).all()
    contents = sheet_contents(replace(known, request=replace(known.request, covariance=wild)), band)
    assert any("run away" in w for w in contents.warnings)


def test_distance_to_the_edge():
    square = np.array([[0.0, 0], [0, 10], [10, 10], [10, 0]])
    north, east = np.array([5.0, 2, 12, -3]), np.array([5.0, 5, 5, -4])
    np.testing.assert_allclose(edge_distance(square, north, east), [5, 2, -2, -5])
    np.testing.assert_allclose(edge_distance(Circle(5, 5, 5), north, east)[:3], [5, 2, -2])


def test_words_of_numbers():
    assert [clock(v) for v in (0, 65, 599.96, 7.5)] == ["0:00", "1:05", "10:00", "0:07.5"]
    assert [compass(np.deg2rad(v)) for v in (-1, 359.7, 725)] == ["359", "000", "005"]
    assert [signed(v) for v in (-0.2, -3.4, 12)] == ["0", "−3", "12"]
    assert plain_name("a\n b\x00" + 80 * "c").startswith("a b c")
    assert len(plain_name(80 * "c")) == 60


def test_way_points_are_the_changes(known):
    (band,) = predict_motion(known)
    same = tuple(np.repeat(v[::2], 2, axis=0) for v in known.levels)
    contents = sheet_contents(replace(known, levels=same), band)
    assert contents.rows == 31
    cells = {c.name: c.cells for c in contents.columns}
    assert cells["time"][:3] == ("0:00", "0:20", "0:40")
    assert cells["time"][-1] == "10:00"
    angle = same[0][0, 1]
    assert cells["alpha1"][0] == f"{np.rad2deg(angle):.1f} ({angle:.2f})"
    k = 20
    assert cells["N"][1] == signed(known.motions[0].state[0, k, 4])
    assert cells["hdg"][1] == compass(known.motions[0].state[0, k, 3])


def test_abort_limits_in_words(unsure, known):
    (band,) = predict_motion(unsure)
    said = "\n".join(sheet_contents(unsure, band).abort)
    assert "Speed over ground above 4.00 m/s (7.8 kn)" in said
    assert "11.5°/s (0.200 rad/s)" in said
    assert "Nearer than 20 m to the edge" in said
    assert "Surge ahead below 0.50 m/s" in said
    assert "columns ±" in said
    facts = dict(sheet_contents(unsure, band).facts)
    assert facts["Expected"] == "current 0.22 m/s (0.4 kn) setting towards 027°"
    (band,) = predict_motion(known)
    said = "\n".join(sheet_contents(known, band).abort)
    assert "Heading more than 10° or position more than 30 m off the table." in said
    assert "no cap was set" in said


def test_a_corridor_wider_than_the_plan_is_not_told(unsure):
    (band,) = predict_motion(unsure)
    half = len(band.t) // 2
    blind = np.where(np.arange(len(band.t)) < half, 0.3, 3.0)
    for off, told in ((40.0, True), (9000.0, False)):
        away = np.where(blind < 1.0, 20.0, off)
        lost = replace(band, heading_off=blind, position_off=away)
        contents = sheet_contents(unsure, lost)
        said = "\n".join(contents.abort)
        assert "After that the model cannot tell the heading within 90°" in said
        assert ("position within 40 m" in said) is told
        assert "9000 m" not in said
        (cells,) = (c.cells for c in contents.columns if (c.name, c.unit) == ("±", "m"))
        assert cells[0] == "30"
        assert cells[-1] == ("40" if told else "–")


@pytest.mark.parametrize(("wide", "over"), [(1.0, 10), (1.2, 32), (4.0, 50)])
def test_without_a_cap_the_plan_itself_sets_the_limits(known, wide, over):
    (band,) = predict_motion(known)
    poor = replace(band, high=wide * band.nominal, low=-wide * band.nominal)
    speed, rate, *_ = sheet_contents(known, poor).abort
    most = (1 + over / 100) * band["speed"].nominal.max()
    turn = (1 + over / 100) * np.rad2deg(np.abs(band["r"].nominal).max())
    assert speed.startswith(f"Speed over ground above {most:.2f} m/s")
    assert rate.startswith(f"Yaw rate above {turn:.1f}°/s")
    for said in (speed, rate):
        assert f"{over} % more than the plan's largest" in said
        assert said.endswith("stop, and tell who planned the trial.")


def test_draws_that_the_misfit_throws_out_of_every_bound_are_lost(known):
    nx = len(known.request.structure.states)

    def misfit(motion, draws):
        off = np.zeros((draws, len(motion.state[0]), nx))
        off[:3, -1, -1] = 20.0
        return off

    zero = np.zeros((len(known.request.theta),) * 2)
    zero[0, 0] = 1e-20
    request = replace(known.request, covariance=zero, misfit=misfit)
    (band,) = predict_motion(replace(known, request=request), draws=50)
    assert band.lost == 3
    np.testing.assert_allclose(band["r"].high, band["r"].nominal, atol=1e-6)


def test_a_steady_start_is_told_with_its_commands(known):
    (band,) = predict_motion(known)
    held = np.array([15.0, np.deg2rad(40.0), np.deg2rad(50.0)])
    steady = replace(known, request=replace(known.request, start_commands=(held,)))
    start = dict(sheet_contents(steady, band).facts)["Start"]
    set_up = "hold n 15.0, alpha1 pushing 40° to starboard, alpha2 pushing 50° to starboard"
    assert start.endswith(f"to set it up, {set_up} until she is steady")
    (told,) = steady.to_dict()["start_commands"]
    assert told == dict(zip(known.request.schedule.commands, held, strict=True))
    assert "hold" not in dict(sheet_contents(known, band).facts)["Start"]
    assert known.to_dict()["start_commands"] == [None]


def test_wind_is_named_by_where_it_comes_from(known):
    design = replace(known, request=replace(known.request, d=np.array([0, 0, -5.0, 0])))
    (band,) = predict_motion(known)
    assert "wind 5.0 m/s (10 kn) from 000°" in dict(sheet_contents(design, band).facts)["Expected"]


def test_broken_limits_are_shouted(known):
    broken = (LimitReport(0, "sea room", 0.0, "m", 16.0),)
    keeping = ConstraintSatisfaction(0.4, 0.3, 0.5, 400, np.zeros(1), {})
    design = replace(known, limits=broken, keeping=keeping)
    (band,) = predict_motion(design)
    warnings = sheet_contents(design, band).warnings
    assert warnings[0] == "This plan breaks its limits: sea room by 16 m."
    assert "probability 0.40 only" in warnings[1]


def test_margins_forbid_what_the_current_takes(unsure):
    (band,) = predict_motion(unsure)
    ((edge, side),) = forbidden(unsure, band, "u")
    psi = band["psi"].nominal
    through = 0.2 * np.cos(psi) + 0.1 * np.sin(psi)
    np.testing.assert_allclose(edge, 0.5 + np.maximum(through, 0))
    assert side == -1
    assert [s for _, s in forbidden(unsure, band, "r")] == [1, -1]


@pytest.mark.long
@pytest.mark.parametrize("which", ["known", "unsure"])
def test_sixty_holds_fit_one_page(request, tmp_path, which):
    design = request.getfixturevalue(which)
    (band,) = predict_motion(design)
    contents = sheet_contents(design, band)
    assert contents.rows == 61
    layout = lay_out(contents, len(design.request.schedule.commands))
    assert layout.capacity >= 61
    assert layout.size >= 5.6
    (page,) = drawn_pages(design, tmp_path)
    # nothing reaches into the margins of 10 mm, and no row into the signature below it
    dark = np.argwhere(page < 0.99) * 297 / len(page)
    assert (dark.min(axis=0) > 9.5).all()
    assert (dark.max(axis=0) < (287.5, 200.5)).all()


def test_a_long_table_goes_on(ship, thesis, true_theta, tmp_path):
    design = random_plan(prior_model(ship, thesis, true_theta, 0), ship, duration=2400.0)
    (band,) = predict_motion(design)
    assert len(drawn_pages(design, tmp_path)) == 2
    write_sheet(design, tmp_path / "sheet.html")
    html = (tmp_path / "sheet.html").read_text()
    times = sheet_contents(design, band).columns[0].cells
    assert tuple(re.findall(r'<th scope="row">([^<]*)</th>', html)) == times
    assert "page 2 of 2" in " ".join(html.split())


@pytest.mark.long
def test_several_trials_are_several_pages(ship, thesis, true_theta, tmp_path):
    design = random_plan(prior_model(ship, thesis, true_theta, 0), ship, duration=120.0, trials=2)
    for kind in ("pdf", "svg", "html"):
        write_sheet(design, tmp_path / f"sheet.{kind}")
    assert (tmp_path / "sheet.pdf").read_bytes().startswith(b"%PDF")
    root = ElementTree.fromstring((tmp_path / "sheet.svg").read_text())
    assert root.get("height") == "594mm"
    html = (tmp_path / "sheet.html").read_text()
    assert html.count("<section ") == 2
    assert "trial 2 of 2" in html
    assert len(drawn_pages(design, tmp_path)) == 2
    ids = re.findall(r'\bid="([^"]+)"', html)
    assert len(ids) == len(set(ids))


@pytest.mark.long
def test_same_design_same_bytes(short, tmp_path):
    for kind in ("pdf", "svg", "html"):
        for name in ("a", "b"):
            write_sheet(short, tmp_path / f"{name}.{kind}")
        assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()


@pytest.mark.long
def test_a_name_cannot_break_a_sheet(short, tmp_path):
    vessel = replace(short.request.vessel, name=HOSTILE)
    design = replace(short, request=replace(short.request, vessel=vessel))
    for kind in ("html", "svg", "pdf"):
        write_sheet(design, tmp_path / f"sheet.{kind}")
    html = (tmp_path / "sheet.html").read_text()
    assert "<script" not in html
    assert "&lt;script&gt;" in html
    assert not re.search(r'(src|href)="(?!#)', html)
    ElementTree.fromstring((tmp_path / "sheet.svg").read_text())
    page = render(design_page(design, ["<b>"], {"program": "<i>"}))
    assert "<script>" not in without_scripts(page)
    assert "&lt;b&gt;." in page


def test_without_a_printer_the_sheet_is_a_page(short, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "plutoprint", None)
    with pytest.raises(
        UsageError, match=r"needs the package plutoprint.* write the sheet as \.html"
    ):
        write_sheet(short, tmp_path / "sheet.pdf")
    write_sheet(short, tmp_path / "sheet.html")
    assert [p.name for p in tmp_path.iterdir()] == ["sheet.html"]


def test_other_endings_are_refused(known, tmp_path):
    with pytest.raises(
        UsageError, match=r"the sheet 'plan\.docx' cannot be written with this ending: use \.pdf"
    ):
        write_sheet(known, tmp_path / "plan.docx")
    assert not list(tmp_path.iterdir())
    assert sheet_kind("a.HTM") == ".html"


@pytest.fixture(scope="module")
def page(unsure):
    """The page of the design whose model is uncertain."""
    return render(design_page(unsure, ["regime chosen"], {"program": "p"}))


def test_the_page_says_what_is_saved(unsure, page):
    html = without_scripts(page)
    assert "This plan saves 150\u00a0s of trial" in html
    assert "at least 0.7 of the best possible" in html
    assert html.count("<svg") == 4
    assert html.count("<figure ") == 4
    assert "tells nothing" in html
    assert "(breaks limits)" in html
    assert f"<td>{unsure.random_std[0]:.2g}</td>" in html
    assert "Regime chosen." in html


def test_the_page_of_a_plan_that_nothing_equals(short):
    design = replace(short, efficiency_vs_random=None)
    page = design_page(design, [], {}, "Tells A from B.")
    assert page.headline == "Tells A from B."
    assert design_page(design, [], {}).headline.startswith("No random two-level sequence")


def test_command_writes_both(ship, thesis, true_theta, tmp_path, monkeypatch, short):
    monkeypatch.setattr("experiment_design.design.design_trial", lambda *a, **k: short)
    prior_model(ship, thesis, true_theta, 0).save(tmp_path / "model.json")
    common = [
        "design", "--vessel", "thesis", "--model", str(tmp_path / "model.json"), "--duration",
        "600", "--regime", "u+v+", "--start", "1.5,1.2,0,0", "--out", str(tmp_path / "plan.csv"),
    ]  # fmt: skip
    sheet, page = tmp_path / "sheet.pdf", tmp_path / "page.html"
    assert main([*common, "--sheet", str(sheet), "--report", str(page)]) == 0
    assert sheet.read_bytes().startswith(b"%PDF")
    assert "<h1>Plan for" in page.read_text()
    assert main([*common, "--sheet", str(tmp_path / "sheet.txt")]) != 0


@pytest.mark.skipif(CHROMIUM is None, reason="no browser installed")
def test_in_a_browser(unsure, page, tmp_path):
    """No complaint on the console, no sideways scrolling on a phone, one page when printed."""
    write_sheet(unsure, tmp_path / "sheet.html")
    (tmp_path / "page.html").write_text(page)
    for name in ("sheet", "page"):
        require_legible(tmp_path / f"{name}.html", 390)
    printed = tmp_path / "printed.pdf"
    chromium("--no-pdf-header-footer", f"--print-to-pdf={printed}", f"file://{tmp_path}/sheet.html")
    assert len(re.findall(rb"/Type\s*/Page\b", printed.read_bytes())) == 1


def test_the_printed_box_of_limits_has_all_its_sides(short, tmp_path):
    write_sheet(short, tmp_path / "sheet.html")
    with driven(tmp_path / "sheet.html") as browser:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
        right, width = browser.execute_script(
            "return ['.abort', 'body'].map("
            "e => document.querySelector(e).getBoundingClientRect().right)"
        )
        # what lies on the edge of the paper's content is cut off
        assert right < width - 1


def test_what_to_do_after_a_plan_follows_its_purpose(short):
    def commands(**given):
        page = design_page(short, [], {"command": {"out": "p.csv", **given}}, "It predicts.")
        return page.next_steps[1].command

    assert commands() == (
        "greybox estimate LOG --vessel V --plan p.csv --out model.json --report model.html"
    )
    for given in (
        {"purpose": "causes"},
        {"causes": ["current"]},
        {"between": ["a.json", "b.json"]},
    ):
        assert commands(**given) == "greybox diagnose LOG --vessel V --report diagnosis.html"
