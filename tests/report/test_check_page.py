"""The page of `greybox check`: every kind of finding is drawn, and the page says all of it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import driven, needs_browser, require_legible, without_scripts
from virtual import as_recording, recorded

from greybox.commands.main import main
from greybox.errors import UsageError
from greybox.report.agreement import compare, find_widths, shifted, smoothed
from greybox.report.check_ties import make_tie, mended_in_words
from greybox.report.checks import (
    _most_telling,
    alternative,
    caption,
    check_page,
    finding_figure,
    headline,
)
from greybox.report.figures import to_svg
from greybox.report.next_steps import after_check
from greybox.trial.checks.course import course_findings
from greybox.trial.checks.finding import IDS, CheckReport, Finding, Outcome
from greybox.trial.checks.frame_sign_unit import (
    _PSI,
    _RATE,
    _VELOCITY,
    ColumnReading,
    reading_findings,
)
from greybox.trial.checks.heading_wrap import wrap_findings
from greybox.trial.checks.motion import make_motion
from greybox.trial.checks.position_hold import hold_findings
from greybox.trial.checks.position_jump import jump_findings
from greybox.trial.checks.signal_quality import (
    angle_unit_findings,
    coarse_findings,
    missing_findings,
    spike_findings,
    stuck_findings,
    time_findings,
)
from greybox.trial.checks.thruster_response import answer_findings
from greybox.trial.checks.wind_convention import wind_findings
from greybox.trial.raw_log import Recording, Signal, SourceFile
from greybox.trial.steps import mend
from greybox.vessel.toml import load_vessel

SHIP = load_vessel("thesis")
COLUMNS = {wide: recorded(3, seconds=300.0, wide=wide, arm=(0.0, 0.0)) for wide in (False, True)}


def columns(**options):
    wide = options.pop("wide", False)
    made = recorded(3, seconds=300.0, wide=wide, **options) if options else COLUMNS[wide]
    return {n: v.copy() for n, v in made.items()}


def report_of(found, recording, notes=()):
    outcomes = tuple(Outcome(i, "clean", "nothing found") for i in IDS)
    return CheckReport("virtual", tuple(found), outcomes, notes, recording)


def tie_case(name):
    """A log with a defect of its kinematics, and the finding that describes it."""
    options, kind, channels, value, ci, repair = {
        "clock of u, v": (
            {"late": {"u": 1.0, "v": 1.0}}, "clock_offset", ("u", "v"), 1.0, (0.9, 1.1),
            mend("shift", ("u", "v"), late=1.0),
        ),
        "clock of psi": (
            {"late": {"psi": 1.0}}, "clock_offset", ("psi",), 1.0, (0.9, 1.1),
            mend("shift", ("psi",), late=1.0),
        ),
        "clock of r": (
            {"late": {"r": 2.0}}, "clock_offset", ("r",), 2.0, (1.8, 2.2),
            mend("shift", ("r",), late=2.0),
        ),
        "lever arm": (
            {"arm": (3.0, 1.0)}, "lever_arm", ("x_n", "y_n"), (3.0, 1.0), ((2.9, 3.1), (0.8, 1.2)),
            mend("move_antenna", ("x_n", "y_n"), x=3.0, y=1.0),
        ),
        "heading bias": (
            {"heading_bias": 0.1}, "heading_bias", ("psi",), 0.1, (0.09, 0.11),
            mend("turn_heading", ("psi",), angle=0.1),
        ),
    }[name]  # fmt: skip
    finding = Finding(
        kind, channels[0], value, ci, "s", "evidence", "fix", channels, (repair,), True
    )
    return report_of([finding], as_recording(columns(**options)))


def reading_case(name):
    c = columns()
    psi, u, v = c["psi"], c["u"], c["v"]
    if name == "speeds in knots":
        change = next(x for x in _VELOCITY if x.words.startswith("u and v hold kn"))
        c |= {"u": u * 3600 / 1852, "v": v * 3600 / 1852}
    elif name == "velocities north and east":
        change = next(x for x in _VELOCITY if "north and east" in x.words)
        c |= {
            "u": np.cos(psi) * u - np.sin(psi) * v, "v": np.sin(psi) * u + np.cos(psi) * v,
        }  # fmt: skip
    elif name == "rate reversed":
        change, c["r"] = _RATE[0], -c["r"]
    else:
        change, c["psi"] = _PSI[0], -psi
    recording = as_recording(c)
    reading = ColumnReading((change,), make_motion(recording), 100.0)
    return report_of(reading_findings(reading), recording)


def row_case(name):
    c = columns()
    n = len(c["t"])
    if name == "gap":
        c = {k: np.delete(v, np.r_[100:160, 300:310]) for k, v in c.items()}
    elif name == "duplicate_time":
        c = {k: v[np.r_[0:200, 199, 200:400, 395:n]] for k, v in c.items()}
    elif name == "nan":
        c["u"][100:140] = np.nan
        c["x_n"][[300, 301, n - 1]] = np.nan
    elif name == "empty rows":
        c = {k: np.r_[v, np.full(60, np.nan)] for k, v in c.items()}
    elif name == "outlier":
        c["v"][[50, 200, 201]] += [2, -3, -3]
    elif name == "stuck":
        c["psi"][100:200] = c["psi"][100]
    elif name == "quantised":
        c["v"] = np.round(c["v"], 1)
    elif name == "heading_wrap":
        c["psi"] %= 2 * np.pi
        k = int(np.argmax(np.abs(np.diff(c["psi"]))))
        c["psi"][k] = 0.5 * (c["psi"][k - 1] + c["psi"][k + 1])
    elif name == "position_hold":
        for k in (100, 101, 300):
            c["x_n"][k], c["y_n"][k] = c["x_n"][k - 1], c["y_n"][k - 1]
    elif name == "position_jump":
        c["y_n"][200:] += 5.0
    elif name == "unit":
        c["alpha1"] = np.degrees(c["alpha1"])
    recording = as_recording(c)
    make = {
        "gap": time_findings, "duplicate_time": time_findings, "nan": missing_findings,
        "empty rows": missing_findings,
        "outlier": spike_findings, "stuck": stuck_findings,
        "quantised": coarse_findings, "unit": lambda r: angle_unit_findings(r, SHIP),
        "heading_wrap": wrap_findings, "position_hold": hold_findings,
        "position_jump": jump_findings,
    }  # fmt: skip
    of = {"empty rows": "nan"}.get(name, name)
    return report_of([f for f in make[name](recording) if f.id == of], recording)


def answer_case(name):
    c = columns(wide=True)
    if name == "course":
        t = c["t"]
        course = 0.01 * t
        x, y = 200 * np.sin(course), 200 * (1 - np.cos(course))
        recording = as_recording({"t": t, "x_n": x, "y_n": y, "psi": course + 1.3})
        return report_of(course_findings(recording, SHIP)[0], recording)
    if name == "thruster":
        c["alpha1"] *= -1
        recording = as_recording(c)
        return report_of(answer_findings([recording], SHIP, [[]])[0], recording)
    if name == "wind sign":
        c |= {"u_q": -c["u_q"], "v_q": -c["v_q"]}
    else:
        psi, u, v = c["psi"], c["u_q"], c["v_q"]
        c |= {
            "u_q": np.cos(psi) * u - np.sin(psi) * v, "v_q": np.sin(psi) * u + np.cos(psi) * v,
        }  # fmt: skip
    recording = as_recording(c)
    return report_of(wind_findings(recording, []), recording)


TIES = ("clock of u, v", "clock of psi", "clock of r", "lever arm", "heading bias")
READINGS = ("speeds in knots", "velocities north and east", "rate reversed", "heading reversed")
ROWS = (
    "gap", "duplicate_time", "nan", "empty rows", "outlier", "stuck", "quantised", "unit",
    "heading_wrap", "position_hold", "position_jump",
)  # fmt: skip
ANSWERS = ("course", "thruster", "wind sign", "wind frame")


def check_drawn(figure):
    """Every pair of axes has a label with a unit on each side, or those of its neighbours."""
    assert figure.axes
    for ax in figure.axes:
        assert ax.has_data()
        if ax.name == "polar":
            assert ax.get_title()
            continue
        assert ax.get_ylabel()
        assert re.search(r"\[.+\]|row of the file", ax.get_ylabel()), ax.get_ylabel()
        hidden = not ax.xaxis.get_tick_params()["labelbottom"]
        assert hidden or re.search(r"\[.+\]|row of the file", ax.get_xlabel()), ax.get_xlabel()
    # warnings of a layout that does not fit are errors
    assert "<path" in to_svg(figure, "drawn")


@pytest.mark.parametrize(
    ("make", "name"),
    [
        *[(tie_case, n) for n in TIES], *[(reading_case, n) for n in READINGS],
        *[(row_case, n) for n in ROWS], *[(answer_case, n) for n in ANSWERS],
    ],
)  # fmt: skip
def test_every_kind_is_drawn_with_labels(make, name):
    report = make(name)
    assert report.findings, name
    for finding in report.findings:
        check_drawn(finding_figure(finding, report, SHIP))
        assert len(alternative(finding)) > 40


@pytest.mark.parametrize("name", TIES)
def test_the_lower_row_agrees_better(name):
    report = tie_case(name)
    tie = make_tie(report.findings[0], report, SHIP)
    gains = [tie.before.rms(n) / tie.after.rms(n) for n in tie.names]
    assert min(gains) > 1
    # integrated noises of the sensors are left beside a late rate
    assert max(gains) > (1.1 if name == "clock of r" else 1.8)


@pytest.mark.parametrize("name", READINGS)
def test_a_reading_explains_nearly_all(name):
    report = reading_case(name)
    tie = make_tie(report.findings[0], report, SHIP)
    assert all(tie.before.rms(n) > 5 * tie.after.rms(n) for n in tie.names)


@pytest.mark.long
def test_a_repair_that_does_not_help_is_doubted(tmp_path):
    report = tie_case("clock of u, v")
    path = tmp_path / "check.html"
    check_page([report], [Path("a.csv")], SHIP, path)
    assert "judge it before you apply it" not in path.read_text()
    wrong = replace(
        report.findings[0], value=-1.0, ci=(-1.1, -0.9),
        repair=(mend("shift", ("u", "v"), late=-1.0),),
    )  # fmt: skip
    check_page([replace(report, findings=(wrong,))], [Path("a.csv")], SHIP, path)
    assert "judge it before you apply it" in path.read_text()


def test_disagreement_is_least_at_the_offset():
    report = tie_case("clock of u, v")
    motion = make_motion(report.recording)
    widths = find_widths(motion).times(4)
    rms = {}
    for late in (0.0, 0.5, 1.0, 1.5, 2.0):
        parts = smoothed(shifted(motion, ("u", "v"), late), widths, motion)
        agreement = compare(parts)
        rms[late] = agreement.rms("u") + agreement.rms("v")
    assert min(rms, key=rms.get) == 1.0


def test_exact_velocities_agree_while_turning():
    t = np.arange(0, 200, 0.5)
    psi, u, v = 0.05 * t, 2 + 0.3 * np.sin(0.05 * t), 0.4 * np.cos(0.03 * t)
    fine = np.arange(0, 200, 0.005)
    heading = np.interp(fine, t, psi)
    speed = np.interp(fine, t, u) + 1j * np.interp(fine, t, v)
    way = np.cumsum(speed * np.exp(1j * heading)) * 0.005
    x, y = np.interp(t, fine, way.real), np.interp(t, fine, way.imag)
    # an antenna that the vessel file knows is no disagreement
    x, y = x + 4 * np.cos(psi) + np.sin(psi), y + 4 * np.sin(psi) - np.cos(psi)
    motion = make_motion(
        as_recording({"t": t, "x_n": x, "y_n": y, "psi": psi, "u": u, "v": v, "r": 0.05 + 0 * t})
    )
    agreement = compare(smoothed(motion, find_widths(motion), motion), (4.0, -1.0))
    assert agreement.rms("u") < 0.01
    assert agreement.rms("v") < 0.01
    assert agreement.rms("r") < 1e-9


def test_other_findings_are_mended_in_both_rows():
    both = as_recording(columns(arm=(3.0, 1.0), heading_bias=0.1))
    arm, bias = tie_case("lever arm").findings[0], tie_case("heading bias").findings[0]
    alone = make_tie(bias, report_of([bias], both), SHIP)
    beside = make_tie(bias, report_of([arm, bias], both), SHIP)
    assert beside.others
    assert not alone.others
    assert beside.after.rms("v") < 0.7 * alone.after.rms("v")


def test_repairs_in_words():
    assert mended_in_words([mend("shift", ("u", "v"), late=0.6)]) == "u, v shifted by −0.60 s"
    assert mended_in_words([mend("scale", ("v",), factor=-1.0)]) == "v reversed"
    assert mended_in_words([mend("exchange", ("u", "v"))]) == "u and v exchanged"
    assert mended_in_words([]) == "mended"


def test_a_finding_without_repair_or_positions_is_drawn_as_it_is():
    c = columns()
    recording = as_recording({"t": c["t"], "u": c["u"]})
    finding = Finding("sign", "u", -1.0, (-1.0, -1.0), "1", "evidence", "fix", ("u",))
    check_drawn(finding_figure(finding, report_of([finding], recording), SHIP))


def test_a_report_without_recording_is_refused_with_what_to_do():
    finding = tie_case("lever arm").findings[0]
    with pytest.raises(UsageError, match="make it with check_recording"):
        finding_figure(finding, report_of([finding], None), SHIP)


def test_page_says_all_and_escapes_it(tmp_path):
    report = row_case("outlier")
    finding = replace(
        report.findings[0], evidence="<script>alert(1)</script> & more", fix="leave <them> out"
    )
    report = replace(report, findings=(finding,), notes=("column <x> taken for u",))
    path = tmp_path / "check.html"
    check_page([report], [Path("a&b.csv")], SHIP, path)
    html = path.read_text()
    assert "<script>" not in without_scripts(html)
    assert "&lt;script&gt;alert(1)&lt;/script&gt; &amp; more" in html
    assert "leave &lt;them&gt; out" in html
    assert "column &lt;x&gt; taken for u" in html
    assert "a&amp;b.csv" in html
    assert without_scripts(html).count("<svg") == 3
    assert html.index("1 finding in 1 log") < html.index("<svg")
    for kind in IDS:
        assert f"<td>{kind}</td>" in html
    assert not re.search(r'(src|href)="(?!#)', without_scripts(html))


@pytest.mark.usefixtures("undrawn")
def test_what_logs_share_is_drawn_once_and_where_its_repair_does_not_help(tmp_path):
    one = tie_case("lever arm")
    shared = replace(one.findings[0], logs=("a", "b", "c"))
    same = [replace(one, findings=(shared,), name=name) for name in ("a", "b")]
    # of a log without a lever arm
    other = replace(report_of([shared], as_recording(columns())), name="c")
    path = tmp_path / "check.html"
    check_page([*same, other], [Path(n) for n in "abc"], SHIP, path)
    html = without_scripts(path.read_text())
    # track and signals of each log beside them
    assert html.count("<svg") == 2 + 3 * 2
    assert html.count("drawn for a, where it was found, too.") == 1
    assert "This repair brings the velocities of the whole log no closer" in html


@pytest.mark.long
def test_identifiers_of_several_logs_do_not_collide(tmp_path):
    path = tmp_path / "check.html"
    check_page([row_case("gap"), row_case("stuck")], [Path("a"), Path("b")], SHIP, path)
    ids = re.findall(r'\bid="([^"]+)"', path.read_text())
    assert len(ids) == len(set(ids))


def test_what_comes_next_is_a_model_only_of_logs_that_have_a_heading():
    c = columns()
    whole = report_of([], as_recording(c))
    blind = report_of([], as_recording({n: c[n] for n in ("t", "u", "v", "r", "n")}))
    (step,) = after_check([whole], SHIP, {})
    assert step.command.startswith("greybox estimate LOG… ")
    guessed = replace(whole.recording, guessed=frozenset({"psi"}))
    bag = replace(whole.recording, files=(SourceFile("a.bag", "", "ROS bag"),))
    for raw in (guessed, bag):
        (step,) = after_check([whole, replace(whole, recording=raw)], SHIP, {})
        assert step.command == "greybox import LOG… --vessel V --out imported"
    (step,) = after_check([whole, blind], SHIP, {})
    assert step.command == ""
    assert "'virtual' that holds the heading as psi" in step.purpose
    # what is mended before lacks the heading too
    degrees = replace(row_case("gap").findings[0], safe=True)
    first, second = after_check([replace(blind, findings=(degrees,))], SHIP, {})
    assert first.purpose == step.purpose
    assert "import again" in first.purpose
    assert second.command.endswith("--fix")


def test_what_comes_next_is_a_model_only_of_logs_that_have_the_commands():
    still = report_of([], as_recording({k: v for k, v in columns().items() if k != "n"}))
    (step,) = after_check([still], SHIP, {})
    assert step.command == ""
    assert "'virtual' that holds n, with its unit" in step.purpose


def test_headline_names_the_most_serious():
    clean = report_of([], None)
    assert headline([clean, clean]) == "Nothing wrong was found in 2 logs."
    vague = replace(clean, outcomes=(Outcome("lever_arm", "cannot tell", "too straight"),))
    assert (
        headline([vague]) == "Nothing wrong was found in 1 log; nothing can be said of lever_arm."
    )
    serious = reading_case("rate reversed")
    mixed = replace(serious, findings=(*row_case("gap").findings, *serious.findings), name="b")
    said = headline([clean, mixed])
    assert said.startswith("2 findings in 2 logs; the most serious (b): r is reversed")
    assert "Fix: change the sign of r" in caption(serious.findings[0])


def test_a_log_that_cannot_be_imported_still_gives_a_page(tmp_path):
    t = np.arange(100.0)
    recording = Recording("odd", (Signal("temperature", t, 20 + 0 * t),))
    path = tmp_path / "check.html"
    check_page([replace(report_of([], recording), name="odd")], [Path("odd.csv")], SHIP, path)
    html = path.read_text()
    assert "The log as a whole cannot be drawn:" in html
    assert "has no position, heading, velocity or thruster column" in html
    assert "All checks" in html


def write(path, c):
    np.savetxt(
        path, np.column_stack(list(c.values())), delimiter=",", header=",".join(c), comments=""
    )
    return path


@pytest.mark.long
def test_command_on_several_logs(tmp_path, capsys):
    bad = columns()
    bad["r"] *= -1
    logs = [write(tmp_path / "good.csv", columns()), write(tmp_path / "bad.csv", bad)]
    page, found = tmp_path / "check.html", tmp_path / "check.json"
    arguments = ["check", *logs, "--vessel", "thesis", "--report", page, "--json", found]
    assert main([str(a) for a in arguments]) == 0
    assert f"wrote {page}" in capsys.readouterr().out
    html = page.read_text()
    assert re.search(r"the most serious|namely", html)
    assert html.index("<h2>good</h2>") < html.index("<h2>bad</h2>")
    assert html.count("SHA-256") == 2
    assert '"log": "bad"' in found.read_text()


@needs_browser
@pytest.mark.parametrize("width", [390, 1200])
def test_in_a_browser(tmp_path, width):
    """Opens, shows its figures, and does not scroll sideways."""
    path = tmp_path / "page.html"
    check_page([row_case("gap")], [Path("a.csv")], SHIP, path)
    require_legible(path, width)
    with driven(path) as browser:
        size = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        assert browser.execute_script(
            "return document.querySelector('.broad > svg').getBoundingClientRect().width > 600"
        )


def test_a_page_of_many_logs_draws_each_kind_before_it_repeats_one():
    gap, clock = row_case("gap"), tie_case("clock of r")
    drawn = _most_telling([gap] * 30 + [clock])
    assert len(drawn) == 24
    assert (0, 0) in drawn
    assert (30, 0) in drawn
