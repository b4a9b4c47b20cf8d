"""Every public result is short as text and well-formed, escaped HTML in a notebook."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from virtual import virtual_log

import experiment_design as ed
import greybox as gb
from greybox.diagnosis.result import Diagnosis, Found, Quantity, Symptom
from greybox.estimation.verdict import SharedMoment
from greybox.notebook import interval, number, sparkline, table
from greybox.selection.structures import StructureChoice, StructureRow
from greybox.trial.checks.finding import Outcome
from greybox.trial.raw_log import Signal
from greybox.trial.steps import Step
from greybox.trial.trial_summary import Contents
from greybox.validation.gain import Gain

HOSTILE = "<script>alert('x')</script>&\0\"]]>"


def hostile(value):
    return replace(value, name=HOSTILE)


@pytest.fixture(scope="module")
def results(ship, thesis, true_theta):
    vessel = hostile(ship)
    log = replace(virtual_log(5, 400, name=HOSTILE), vessel=vessel)
    said = Step("smooth", (HOSTILE,), reason=HOSTILE)
    log = replace(
        log,
        loop_known=True,
        closed_loop=log.t < 50,
        provenance=replace(log.provenance, steps=(said, replace(said, decided_by="check"))),
    )
    estimate = gb.estimate_model([log], method="ls", predictor="basic")
    estimate = replace(estimate, notes=(HOSTILE,), current=(("current_north", 0.1, 0.01),))
    model = estimate.model()
    signals = tuple(
        Signal(f"{n}{HOSTILE}", log.t, a, "m/s", HOSTILE) for n, a in log.channels.items()
    )
    recording = gb.Recording(HOSTILE, (*signals, Signal("empty", np.zeros(0), np.zeros(0))))
    finding = gb.Finding("gap", HOSTILE, 3.0, (1.0, 5.0), "s", HOSTILE, HOSTILE)
    frames = replace(finding, value=(1.0, 2.0), ci=((0.0, 2.0), (1.0, 3.0)))
    found = Found(
        "current", "current", HOSTILE, {"current_north": Quantity(0.3, 0.01, "m/s")},
        1e-9, 1e-8, HOSTILE, "", "",
    )  # fmt: skip
    diagnosis = Diagnosis(
        "named", (found,), (), {"u": Gain(10.0, 80.0, (60.0, 80.0))},
        (Symptom(HOSTILE, "u", 3.0),), (), (), model, model, {}, HOSTILE, HOSTILE, (HOSTILE,),
    )  # fmt: skip
    run = gb.run_model(model, log)
    clean = gb.ManoeuvringModel(thesis, true_theta, np.diag((0.1 * true_theta) ** 2), 1.0, vessel)
    prepared = ed.prepare_request(
        clean, ed.DesignRequest(100.0, regime="u+v+", effort=0.02, hold=25.0, predictor="basic")
    )
    design = ed.design_trial(prepared, alternatives=False)
    design = replace(design, notes=(HOSTILE,))
    plan = dict(zip(prepared.schedule.commands, design.commands[0].T, strict=True))
    segments = gb.import_recording(
        gb.Recording(HOSTILE, tuple(Signal(n, log.t, a) for n, a in log.channels.items())), vessel
    )
    row = StructureRow(HOSTILE, (), 18, 18, 90.0, 0.0, 1.0, 1.0, 1.0, True)
    return [
        vessel,
        log,
        estimate,
        estimate.verdict,
        gb.estimate_model([log], method="ls", predictor="basic").prediction,
        estimate.predictor,
        gb.TestResult("wald", HOSTILE, 1.0, 0.3, HOSTILE),
        gb.Verdict(gb.TrustLevel.TRUST_EXCEPT, (HOSTILE,), (SharedMoment(HOSTILE),)),
        model,
        clean,
        hostile(thesis),
        recording,
        finding,
        frames,
        gb.CheckReport(HOSTILE, (finding, frames), (Outcome("sign", "cannot tell", HOSTILE),)),
        gb.CheckReport("clean", (), ()),
        segments,
        Contents(note=HOSTILE),
        diagnosis,
        gb.Given((HOSTILE,), model, model, 0.5, diagnosis.gain, HOSTILE),
        run,
        replace(run, diverged=7),
        gb.simulate(thesis, true_theta, np.zeros(3), np.ones((20, 3)), 1.0),
        gb.compare({HOSTILE: model, "b": model}, [log, log]),
        StructureChoice(estimate, (row,)),
        gb.known_causes()["current"],
        design,
        design.certificate,
        ed.predict_precision(prepared, [plan]),
        ed.Discrimination(design, (HOSTILE, "b"), (3.0, 4.0), (1.0, np.nan), False, np.nan),
        replace(prepared.noise, source=HOSTILE),
        gb.predict_manoeuvre(clean, "turning", limited=False, command=15.0, draws=40),
        gb.Exported("c", (Path(HOSTILE.replace("\0", "")),), (HOSTILE,), (HOSTILE,), (HOSTILE,)),
    ]


def test_every_result_shows_itself(results):
    for result in results:
        name = type(result).__name__
        page = result._repr_html_()
        assert "<script" not in page, name
        tree = ET.fromstring(page)
        assert tree.tag == "div", name
        assert len(page) < 60_000, name
        assert result.summary().strip() or isinstance(result, Contents), name
        line = repr(result)
        assert line.startswith(f"<{name}: "), name
        assert len(line) < 130, name
        assert "\n" not in line, name
        assert "array(" not in line, name


def test_public_results_are_all_there(results):
    shown = {type(r).__name__ for r in results}
    asked = {
        "DiagnosisOptions", "ImportOptions", "OutputErrorOptions", "Request", "Circle",
        "CandidateModel", "PreparedRequest", "TrialLimits", "DesignRequest",
    }  # fmt: skip
    promised = {n for p in (gb, ed) for n in p.__all__ if n[0].isupper()} - asked
    promised -= {"Cause", "TrustLevel", "PredictionLevel"}
    assert promised <= shown


def test_what_matters_comes_first(results):
    by_type = {type(r).__name__: r for r in results}
    estimate = by_type["Estimate"]
    tree = ET.fromstring(estimate._repr_html_())
    assert estimate.verdict.text in "".join(tree[0].itertext())
    body = tree.find("table/tbody")
    names = [row[0].text for row in body]
    assert names == [*estimate.labels, "current_north"]
    low, high = (float(x) for x in body[0][3].text.split(" to "))
    assert low < float(body[0][1].text) < high
    log = ET.fromstring(by_type["TrialLog"]._repr_html_())
    rows = {row[0].text: row for row in log.find("table/tbody")}
    assert rows["psi"][1].text == "rad"
    assert rows["n"][1].text == "as logged"
    shown = [float(cell.text) for cell in rows["n"][2:5]]
    n = by_type["TrialLog"]["n"]
    np.testing.assert_allclose(shown, [n.min(), n.mean(), n.max()], rtol=1e-3)
    assert rows["u"][5][0].tag.endswith("svg")


def test_a_log_of_no_samples_shows_itself():
    nothing = virtual_log(1, 20).window(0, 0)
    assert "0 samples" in repr(nothing)
    assert ET.fromstring(nothing._repr_html_()).find("table") is not None


def test_pieces():
    assert number(None) == number(np.nan) == "–"
    assert interval(1.0, 0.5) == "0.02 to 1.98"
    assert table(("a",), []) == ""
    assert sparkline([]) == sparkline([np.nan]) == ""
    points = ET.fromstring(sparkline([1.0, np.nan, 1.0]))[0].get("points").split()
    assert len(points) == 2
    assert len({p.split(",")[1] for p in points}) == 1
    long = ET.fromstring(sparkline(np.sin(np.arange(100_000.0))))[0].get("points").split()
    assert len(long) == 240
    heights = [float(p.split(",")[1]) for p in long]
    assert (min(heights), max(heights)) == (1.0, 23.0)
