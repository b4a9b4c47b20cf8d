"""The record beside a log: what it holds, and that records of released versions still load."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import greybox as gb
from greybox.trial.checks.check import check_recording
from greybox.trial.convert.channel_mapping import read_recording
from greybox.trial.steps import RECORDED, Step, mend, step_from_dict

STEP = 0.1
SHIP = {"name": "S", "length": 5, "thruster": [{"type": "azimuth", "speed": "n", "angle": "a"}]}
MADE = [
    "psi smoothed over 1 s (local polynomials of order 2)",
    "r from heading by central differences (3.57)",
    "u, v from positions and heading by central differences (3.57)",
    "[sensors] antenna = [3.0,-1.0]: u, v are those of the body origin",
]
CORRECTED = [
    *MADE,
    '[sensors] reversed = ["a"]: the sign of a turned',
    '[sensors] clock = {"psi":0.3}: earlier by it, psi by 0.3 s, r by 0.3 s',
    "[sensors] heading_bias = 0.08: psi turned back by it [rad]",
]
# as version 1 wrote them: derived and fixed of a record
OLD = {
    "imported": (MADE, []),
    "corrected": (CORRECTED, []),
    "corrected twice and decimated": (
        [
            *CORRECTED,
            "[sensors] heading_bias = 0.1: psi turned back by it [rad]",
            "decimated from 0.1 s to 0.5 s",
        ],
        [],
    ),
    "local polynomials": (
        [MADE[1], "u, v from positions and heading by Savitzky-Golay over 1 s"], []
    ),
    "velocity over ground": ([MADE[1], "u, v from the velocity over ground and the heading"], []),
    "true wind": (
        [
            "u_q, v_q from the true wind, the heading and the velocity over ground",
            "true wind brought from 5 to 10 m (1/7 power law)",
        ],
        [],
    ),
    "anemometer": (["u_q, v_q moved from the anemometer at (1.5, -0.5) m to the origin"], []),
    "apparent wind": (
        [
            "u_q, v_q from V_q, gamma_q (5.41-5.43)",
            "[sensors] velocity_at = [1.0,0.5]: u, v brought to the body origin",
        ],
        [],
    ),
    "mended": (
        [],
        [
            "nan of n: 1 of 601 samples of n holds no number, in 1 stretch, first at t = 25 s",
            "sign of r: r is reversed: only so do heading and the other channels agree "
            "(log-likelihood higher by 470)",
            "lever_arm of x_n, y_n: the positions are those of a point +5.99 m forward and "
            "+0.06 m to starboard of where u and v hold (the vessel file says (0, 0)): they swing "
            "by so much when the ship turns",
            "clock_offset of u, v: u and v come 2.02 s late against the positions and the "
            "heading and the rate: shifted so, positions, velocities and heading agree",
        ],
    ),
    "edited by hand": (
        ["the mast was moved", "[sensors] clock = oops: x", f"[sensors] clock = {'[' * 9999}: x"],
        ["glued"],
    ),
}  # fmt: skip


def ship(**sensors):
    return gb.vessel_from_dict(SHIP | {"sensors": sensors})


def columns(n=300):
    t = np.round(np.arange(n) * STEP, 9)
    psi = 0.7 * np.sin(0.2 * t) + 0.05 * t
    return {
        "t": t, "x_n": 2 * t, "y_n": np.sin(t / 3), "psi": psi, "u": 2 + 0.1 * np.sin(t),
        "v": 0.1 * np.cos(t), "r": 0.14 * np.cos(0.2 * t) + 0.05, "u_q": 3 + 0 * t,
        "v_q": 1 + 0 * t, "n": 5 + np.sin(t), "a": 0.3 * np.sin(t),
    }  # fmt: skip


def old_log(folder, derived, fixed, **more):
    """A log with a record beside it as version 1 wrote it."""
    path = folder / "log.csv"
    pd.DataFrame(columns()).to_csv(path, index=False)
    record = {
        "format": "greybox-log", "version": 1, "log": "log.csv",
        "log_sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "rows": 300,
        "sample_time": STEP, "units": {}, "segments": [[0.0, 29.9, 300]], "source": "raw.csv",
        "sha256": "5ea", "derived": derived, "fixed": fixed,
        "files": [["raw.csv", "5ea", "CSV"]], "read": ["heading taken for psi"], "epoch": None,
        "notes": {"draught": "1.2 m"}, **more,
    }  # fmt: skip
    (folder / "log.csv.json").write_text(json.dumps(record))
    return path


@pytest.mark.parametrize("case", OLD)
def test_records_of_version_1_are_told_as_they_were(tmp_path, case):
    derived, fixed = OLD[case]
    path = old_log(tmp_path, derived, fixed)
    log = gb.read_log(path, ship())
    assert log.provenance.derived == tuple(derived)
    assert log.provenance.fixed == tuple(fixed)
    assert log.provenance.read == ("heading taken for psi",)
    for name, value in columns().items():
        np.testing.assert_array_equal(log.t if name == "t" else log[name], value)
    known = {s.operation for s in log.provenance.steps} - {"recorded"}
    assert bool(known) == (case != "edited by hand")
    # what is written now holds the same, as steps and as sentences
    gb.write_log([log], tmp_path / "new.csv")
    record = json.loads((tmp_path / "new.csv.json").read_text())
    assert (record["version"], record["derived"], record["fixed"]) == (2, derived, fixed)
    assert gb.read_log(tmp_path / "new.csv", ship()).provenance.steps == log.provenance.steps


def test_corrections_of_version_1_are_not_made_twice(tmp_path):
    path = old_log(tmp_path, *OLD["corrected twice and decimated"])
    stated = {
        "antenna": [3.0, -1.0], "heading_bias": 0.1, "clock": {"psi": 0.3}, "reversed": ["a"],
    }  # fmt: skip
    log = gb.read_log(path, ship(**stated))
    for name, value in columns().items():
        np.testing.assert_array_equal(log.t if name == "t" else log[name], value)
    more = gb.read_log(path, ship(**stated | {"heading_bias": 0.13, "reversed": ["a", "n"]}))
    np.testing.assert_allclose(more["psi"], log["psi"] - 0.03, atol=1e-12)
    np.testing.assert_array_equal(more["n"], -log["n"])
    np.testing.assert_array_equal(more["a"], log["a"])


def test_winds_of_version_1_are_not_moved_again(tmp_path):
    mast = ship(anemometer=[1.5, -0.5, 5.0])
    options = gb.ImportOptions(reference_height=10.0)
    for case, moved in (("anemometer", False), ("true wind", False), ("corrected", True)):
        path = old_log(tmp_path, *OLD[case])
        log = gb.read_log(path, mast)
        assert (log["u_q"] != columns()["u_q"]).any() == moved
        gb.import_files([path], mast, tmp_path / "out.csv", options)
        made = gb.read_log(tmp_path / "out.csv", mast).provenance.steps
        heights = [s.parameters["height"] for s in made if s.operation == "wind_height"]
        assert heights == [10.0]


@pytest.mark.parametrize(
    ("case", "key"),
    [("mended", "antenna"), ("mended", "clock"), ("mended", "reversed")],
)
def test_mends_of_version_1_are_left_to_them(tmp_path, case, key):
    path = old_log(tmp_path, *OLD[case])
    value = {"antenna": [6.0, 0.0], "clock": {"u": 2.0}, "reversed": ["r"]}[key]
    log = gb.read_log(path, ship(**{key: value}))
    for name in ("u", "v", "r", "psi"):
        np.testing.assert_array_equal(log[name], columns()[name])
    assert any("is not applied: it was mended" in n for n in log.provenance.read)


def test_derived_velocities_of_version_1_prove_nothing(tmp_path):
    """Velocities that were made of positions cannot show that positions are late."""
    data = {k: np.roll(v, 25) if k in "uv" else v for k, v in columns().items()}
    for case, silent in (("imported", True), ("velocity over ground", True), ("true wind", False)):
        path = old_log(tmp_path, *OLD[case])
        pd.DataFrame(data).to_csv(path, index=False)
        record = json.loads((tmp_path / "log.csv.json").read_text())
        record["log_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
        (tmp_path / "log.csv.json").write_text(json.dumps(record))
        recording = read_recording(path, ship())
        report = check_recording(recording, ship())
        about = {c for f in report.findings for c in f.channels or (f.channel,)}
        assert ({"u", "v"} & about == set()) == silent


def test_what_is_damaged_in_a_record_is_left_out(tmp_path):
    path = old_log(tmp_path, [], [])
    record = json.loads((tmp_path / "log.csv.json").read_text()) | {"version": 2}
    good = mend("shift", ("n",), late=0.5).to_dict()
    bad = [
        {}, None, 3, "x", good | {"operation": "rub"}, good | {"channels": 4},
        good | {"decided_by": "nobody"}, good | {"interval": [1]}, good | {"parameters": []},
        good | {"parameters": {"late": {}}}, good | {"parameters": {"late": [[1]]}},
        good | {"parameters": {"late": float("inf")}}, good | {"parameters": {"late": 1e308}},
    ]  # fmt: skip
    for steps in ([*bad, good], "shift", 4, {}, None):
        (tmp_path / "log.csv.json").write_text(json.dumps(record | {"steps": steps}))
        got = gb.read_log(path, ship()).provenance.steps
        assert got == ((step_from_dict(good),) if isinstance(steps, list) else ())


@pytest.mark.parametrize(
    "damage",
    [
        {"files": [3, None, ["a"], ["a", "b", "c"]]}, {"files": 4}, {"epoch": float("inf")},
        {"epoch": "x"}, {"notes": []}, {"read": {}}, {"conditions": [1]}, {"version": None},
        {"conditions": {"draught": 10**400}}, {"conditions": [], "notes": {"trim": 10**400}},
        {"actuators": [{"thruster": float("inf"), "kind": "speed", "command": "n",
                        "feedback": "m"}]},
        {"version": 1, "derived": [f"[sensors] heading_bias = {10**400}: psi turned back"]},
        {"version": 1, "derived": [f'[sensors] clock = {{"psi":{10**400}}}: earlier by it']},
    ],
)  # fmt: skip
def test_other_damage_does_no_harm(tmp_path, damage):
    path = old_log(tmp_path, [], [])
    record = json.loads((tmp_path / "log.csv.json").read_text()) | {"version": 2, "steps": []}
    (tmp_path / "log.csv.json").write_text(json.dumps(record | damage))
    log = gb.read_log(path, ship())
    np.testing.assert_array_equal(log["u"], columns()["u"])
    gb.write_log([log], tmp_path / "again.csv")
    assert gb.read_log(tmp_path / "again.csv", ship()).provenance == log.provenance


def test_steps_are_the_same_after_writing_and_reading(tmp_path):
    steps = (
        replace(mend("drop", ("n",), times=(1.0, 2.5)), reason="two spikes"),
        Step("scale", ("a",), (), {"factor": -1.0}, (1.0, 2.0), "user"),
        Step("resample", ("psi",), parameters={"how": "held", "sample_time": 0.1}),
        Step("recorded", (), (), {RECORDED: "by hand"}),
    )
    log = gb.make_log(ship(), {k: v for k, v in columns().items() if k != "t"}, STEP)
    log = replace(log, provenance=replace(log.provenance, steps=steps))
    gb.write_log([log], tmp_path / "log.csv")
    record = json.loads((tmp_path / "log.csv.json").read_text())
    assert record["fixed"] == ["samples of n left out: two spikes"]
    assert record["derived"] == [
        "a multiplied by -1 from t = 1 to 2 s",
        "psi held at a sample time of 0.1 s",
        "by hand",
    ]
    assert gb.read_log(tmp_path / "log.csv", ship()).provenance.steps == steps
    # a record stays small, whatever was left out
    long = mend("drop", ("n",), times=tuple(float(k) for k in range(100_000))).to_dict()
    assert len(long["parameters"]["times"]) < 2000
    assert long["parameters"]["times_count"] == 100_000


def test_what_a_check_mended_is_kept_as_steps(tmp_path):
    data = {k: v for k, v in columns().items() if k not in ("x_n", "y_n", "u_q", "v_q")}
    data["v"][40] += 5.0
    pd.DataFrame(data).to_csv(tmp_path / "raw.csv", index=False)
    gb.import_files([tmp_path / "raw.csv"], ship(), tmp_path / "log.csv", fix=True)
    log = gb.read_log(tmp_path / "log.csv", ship())
    (step,) = (s for s in log.provenance.steps if s.operation == "drop")
    assert (step.channels, step.decided_by, step.parameters["times"]) == (("v",), "check", (4.0,))
    assert log.provenance.fixed == (step.sentence,)
    assert "stands out from its neighbours" in step.reason
