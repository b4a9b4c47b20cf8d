"""Causes that other packages register, and the catalogue in the documentation."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from virtual import PARAMETERS

from greybox.diagnosis import causes
from greybox.diagnosis.causes import Context, known_causes
from greybox.diagnosis.diagnose import DiagnosisOptions, diagnose
from greybox.errors import UsageError
from greybox.model.catalogue import get_structure, structure_for
from greybox.model.run.simulation import simulate
from greybox.study.chapter6 import TRUE
from greybox.study.inputs import smoothed_pulses
from greybox.trial.log import make_log
from greybox.vessel.force import force_inputs
from greybox.vessel.toml import load_vessel, vessel_from_dict

DOCUMENT = (Path(__file__).parents[2] / "docs" / "causes.md").read_text(encoding="utf-8")


@dataclass
class Entry:
    name: str
    made: Any

    def load(self):
        return self.made


@pytest.fixture
def drift_drag(monkeypatch):
    """The example of the documentation, registered."""
    (code,) = re.findall(r"```python\n(.*?)```", DOCUMENT, re.S)
    found: dict[str, Any] = {}
    exec(code, found)
    register(monkeypatch, found["DriftDrag"])
    return found["DriftDrag"]


def register(monkeypatch, made):
    monkeypatch.setattr(causes, "entry_points", lambda group: [Entry("theirs", made)])


def drifting_log(seed, drag, samples=700):
    structure, vessel = get_structure("thesis").with_terms("X_vv"), load_vessel("thesis")
    rng = np.random.default_rng([300, seed])
    commands = {
        name: smoothed_pulses(rng, samples, low, high, widths=(20, 80), smoothing=10)
        for name, low, high in (("n", 10, 20), ("alpha1", 0.6, 1.1), ("alpha2", 0.6, 1.1))
    }
    tau = make_log(vessel, commands, 1.0).forces(structure.inputs)
    theta = np.array([*(0.0 if n.startswith("W") else TRUE[n] for n in PARAMETERS), drag])
    run = simulate(structure, theta, np.array([1.5, 1.2, 0.0]), tau[:-1], 1.0, d=np.zeros(4))
    states = {n: run.x[0, :, i] for i, n in enumerate(("u", "v", "r"))} | {"psi": run.psi[0]}
    noisy = {n: x + 0.01 * rng.standard_normal(samples) for n, x in states.items()}
    return make_log(vessel, commands | noisy, 1.0, f"day {seed}")


@pytest.mark.long
def test_registered_cause_is_named(drift_drag):
    logs = [drifting_log(k, -0.02) for k in (1, 2)]
    found = diagnose(logs[:1], validate=logs[1:], options=DiagnosisOptions())
    assert found.verdict == "named"
    assert [c.id for c in found.causes] == ["drift_drag"]
    value = found.causes[0].parameters["X_vv"]
    assert abs(value.value + 0.02) < 4 * value.std
    assert "X_vv" in found.model.names


def test_registered_cause_keeps_out_where_its_term_stands(drift_drag):
    structure = get_structure("thesis")
    context = Context(structure, load_vessel("thesis"), ("u", "v", "r"), False, 900.0, 1.0, {})
    assert [a.key for a in drift_drag().hypotheses(context)] == ["drift_drag"]
    taken = Context(
        structure.with_terms("X_vv"), context.vessel, context.outputs, False, 900.0, 1.0, {}
    )
    assert drift_drag().hypotheses(taken) == []


def test_classes_and_objects_register(drift_drag, monkeypatch):
    assert "drift_drag" in known_causes()
    register(monkeypatch, drift_drag())
    assert list(known_causes())[-1] == "drift_drag"


def test_an_id_in_use_is_refused(drift_drag, monkeypatch):
    monkeypatch.setattr(drift_drag, "id", "current")
    with pytest.raises(UsageError, match=r"'theirs' of greybox.causes takes the id 'current'"):
        known_causes()


def test_what_is_no_cause_is_refused(monkeypatch):
    register(monkeypatch, "current")
    with pytest.raises(UsageError, match=r"'theirs' of greybox.causes gives a str, no Cause"):
        known_causes()


def test_every_cause_is_documented():
    described = re.findall(r"^#### `(\w+)`$", DOCUMENT, re.M)
    assert sorted(described) == sorted(known_causes())
    assert len(described) == len(set(described))


def test_documentation_names_every_reference():
    for cause in known_causes().values():
        text = DOCUMENT[DOCUMENT.index(f"#### `{cause.id}`") :].split("\n#")[0]
        flat = " ".join(text.split())
        for author in re.findall(r"([A-Z][a-z]+)[^;(]* \(\d{4}\)", cause.reference):
            assert author in flat, (cause.id, author)


def test_lacking_terms_have_the_names_that_the_extended_structure_gives_them():
    linear, vessel = get_structure("linear"), load_vessel("thesis")
    context = Context(linear, vessel, ("u", "v", "r"), False, 900.0, 1.0, {})
    for cause in known_causes().values():
        for hypothesis in cause.hypotheses(context):
            terms = [n for n in hypothesis.columns if not n.startswith("current_")]
            assert set(terms) <= set(linear.with_terms(*terms).parameters), hypothesis.key


def test_forces_that_no_thruster_makes_are_not_lacking():
    """Two fixed propellers side by side steer without pushing aside."""
    fixed = vessel_from_dict(
        {
            "name": "catamaran",
            "length": 2.0,
            "mass": 100.0,
            "thruster": [
                {"type": "fixed", "x": -1.0, "y": y, "speed": name, "angle": 0.0}
                for name, y in (("n_port", -0.4), ("n_starboard", 0.4))
            ],
        }
    )
    thesis = load_vessel("thesis")
    for vessel, lacks in ((fixed, False), (thesis, True)):
        context = Context(get_structure("linear"), vessel, ("u", "v", "r"), False, 900.0, 1.0, {})
        assert ("N_tauy" in context.lacking("N_tauy", "Y_taun")) == lacks
        assert "Y_taun" in context.lacking("N_tauy", "Y_taun")


@pytest.mark.parametrize("kind", ["propeller_rudder", "azimuth"])
def test_thrusters_that_follow_the_same_columns_are_hypotheses_of_their_own(kind):
    angle = "rudder" if kind == "propeller_rudder" else "angle"
    twins = [{"type": kind, "x": -28.0, "y": y, "speed": "n", angle: "delta"} for y in (4.0, -4.0)]
    vessel = vessel_from_dict({"name": "twin", "length": 60.0, "thruster": twins})
    structure = structure_for("thesis", force_inputs(vessel))
    context = Context(
        structure, vessel, ("u", "v", "r", "psi"), False, 1000.0, 1.0, {"n": 10.0}, False,
        {"n": 5.0, "delta": 0.5}, {"n": 1.0, "delta": 0.1},
    )  # fmt: skip
    for cause in known_causes().values():
        keys = [h.key for h in cause.hypotheses(context)]
        assert len(keys) == len(set(keys)), cause.id


def test_the_null_of_a_lag_or_delay_is_the_vessels_own():
    """A lag that the vessel states and the logs do not show is as wrong as one that it lacks."""
    vessel = load_vessel("thesis")
    vessel = replace(vessel, actuation=replace(vessel.actuation, lag=5.0, delay=3.0))
    context = Context(
        get_structure("thesis"), vessel, ("u", "v", "r", "psi"), False, 1000.0, 1.0, {"n": 10.0},
        False, {"n": 5.0, "alpha1": 0.5, "alpha2": 0.5}, {"n": 1.0, "alpha1": 0.1, "alpha2": 0.1},
    )  # fmt: skip
    for cause, key, own in (
        ("thruster_lag", "thruster_lag:force", 5.0), ("input_delay", "input_delay", 3.0),
    ):  # fmt: skip
        (found,) = (h for h in known_causes()[cause].hypotheses(context) if h.key == key)
        (parameter,) = found.parameters
        begun = [parameter.start, *(s[0] for s in found.starts)]
        assert parameter.null == own
        assert min(begun) < own < max(begun)


def test_columns_that_were_exchanged_are_told_by_their_names() -> None:
    side = [
        {"type": "tunnel", "x": x, "speed": f"n_{end}"} for end, x in (("bow", 4), ("stern", -4))
    ]
    vessel = vessel_from_dict({"name": "ship", "length": 10.0, "thruster": side})
    context = Context(get_structure("linear"), vessel, ("u", "v", "r"), False, 900.0, 1.0, {})
    sign = known_causes()["sign"]
    (swap,) = (h for h in sign.hypotheses(context) if h.key.startswith("sign:swapped"))
    told = sign.evidence_of(swap, {"swapped_n_bow_n_stern": (-1.0, 0.0)})
    assert told == "n_bow and n_stern stand in each other's place"
