"""The page of a diagnosis: its story, its statistics, and legible in a real browser."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from virtual import PARAMETERS, virtual_log

from greybox.diagnosis.result import (
    Diagnosis,
    Found,
    Gain,
    Quantity,
    Ranked,
    Runs,
    Symptom,
)
from greybox.model.catalogue import get_structure
from greybox.model.changes import Change
from greybox.model.model import ManoeuvringModel
from greybox.report.diagnosis import diagnosis_page
from greybox.report.page import render
from greybox.study.chapter6 import TRUE
from greybox.validation.fit import run_model
from greybox.vessel.toml import load_vessel
from greybox.vessel.vessel import Actuation

HOSTILE = '<script>alert("x")</script> & $x^$'
SIDE = {"v": -1, "r": -1, "psi": -1}
VERDICTS = ("named", "none", "confused", "unexplained")
RECORD = {"program": "greybox-marine 0.1.0", "command": {"logs": ["day1.csv"], "seed": 0},
          "logs": ["day1.csv 0123456789ab"]}  # fmt: skip


def model_of(names=PARAMETERS, **more):
    structure = get_structure("thesis")
    structure = structure.with_terms(*[n for n in names if n not in PARAMETERS])
    theta = np.array([TRUE.get(n, -0.002) for n in structure.parameters])
    return ManoeuvringModel(
        structure, theta, np.diag((0.02 * theta) ** 2), 1.0, load_vessel("thesis"), **more
    )


def extended():
    vessel = load_vessel("thesis")
    first = replace(vessel.thrusters[0], gain=0.83, angle_offset=0.05)
    vessel = replace(
        vessel, thrusters=(first, *vessel.thrusters[1:]), actuation=Actuation(lag=2.5, delay=1.0),
        sensors={**vessel.sensors, "heading_bias": 0.06, "clock": {"u": 1.5}, "reversed": ("r",),
                 "velocity_at": (3.0, -1.0)},
    )  # fmt: skip
    model = model_of(
        (*PARAMETERS, "N_|r|r"),
        disturbances={"current_north": (0.2, 0.004), "current_east": (-0.2, 0.005)},
        changes=(Change("Xu", 1.6, 600.0),),
    )
    return replace(model, vessel=vessel)


def runs_of(before, after, names):
    out = []
    for i, name in enumerate(names):
        log = virtual_log(i, 1200, wind=0.0, name=name)
        x, y = (run_model(m, log).x.T for m in (before, after))
        states = ("u", "v", "r")
        if i:  # another day to port
            log = replace(log, channels={k: SIDE.get(k, 1) * v for k, v in log.channels.items()})
            x, y = (
                [SIDE.get(s, 1) * row for s, row in zip(states, z, strict=True)] for z in (x, y)
            )
        out.append(
            Runs(log, i > 0, {s: log[s] for s in states}, dict(zip(states, x, strict=True)),
                 dict(zip(states, y, strict=True)))
        )  # fmt: skip
    return tuple(out)


CURRENT = Found(
    "current", "current", "current",
    {"current_north": Quantity(0.203, 0.004, "m/s"), "current_east": Quantity(-0.197, 0.005, "m/s")},
    0.0, 1e-300, "the errors of surge and sway turn with the heading as in a current of 0.28 m/s "
    "towards 316 deg", "the mean current, north and east", "Fossen (2011)", 5210.4, 1804.2, 95.1,
)  # fmt: skip
BIAS = Found(
    "heading_bias", "heading_bias", "compass bias",
    {"heading_bias": Quantity(0.0612, 0.0021, "rad")}, 3e-8, 1.2e-6,
    "surge and sway are turned against the ship's axes by 3.5 ± 0.1 deg",
    "the bias of the compass in the vessel", "Fossen (2011)", 61.2, 22.8, 9.4,
)  # fmt: skip
STEPS = (
    (
        Ranked("current", 4800.0, 5210.4, 1804.2, 95.1),
        Ranked("heading_bias", 900.0, 1210.0, -240.0, 80.0),
        Ranked("parameter_change:Xu", 610.0, 700.0, 30.0, 60.0),
        Ranked("crossflow:Y_|r|v", 210.0, 180.0, 12.0, 21.0),
        *[Ranked(f"thruster_gain:n:alpha{k}", 80.0 - 5 * k) for k in range(9)],
    ),
    (
        Ranked("heading_bias", 55.0, 61.2, 22.8, 9.4),
        Ranked("advance_speed:X_u*taux+Y_u*tauy+N_u*taun", 4.0),
        Ranked("clock_offset:psi", 0.4),
    ),
)


def diagnosis_of(verdict, name="day 2", thesis=None):
    base = model_of()
    current = {"current_north": (0.2, 0.004), "current_east": (-0.2, 0.005)}
    flown = model_of((*PARAMETERS, "N_|r|r"), disturbances=current)
    flown = replace(flown, theta=np.append(base.theta, -1e-6))
    if verdict == "none":
        flown = base
    runs = runs_of(base, flown, ("day 1", name))
    same = verdict in ("none",)
    gain = {
        "u": Gain(41.2, 41.2 if same else 88.1, (0.0, 0.0) if same else (43.0, 50.1)),
        "v": Gain(-3e4 if verdict == "confused" else 35.0, 35.0 if same else 79.3, (31.0, 55.0)),
        "r": Gain(81.0, 81.0 if same else 81.3, (-0.4, 1.0)),
    }
    return Diagnosis(
        verdict=verdict,
        causes=(CURRENT, BIAS) if verdict == "named" else (),
        groups=(("current", "heading_bias"),) if verdict == "confused" else (),
        gain=gain,
        wrong=()
        if same
        else (
            Symptom("surge is over-predicted by 0.21 m/s when heading south", "u", 14.2),
            Symptom("sway is under-predicted by 0.19 m/s when heading east", "v", 12.9),
        ),
        partial=(CURRENT,) if verdict == "unexplained" else (),
        candidates=(CURRENT, BIAS) if verdict == "confused" else (),
        base=base,
        model=flown,
        alternatives={},
        remaining="What remains of the error is noise (p = 0.41).",
        validated_on=f"on {name}, which nothing was fitted to",
        next_steps=("Turn through all headings at one speed.", "Calibrate the compass."),
        steps=STEPS[:1] if same else STEPS,
        runs=runs,
        notes=("The sample time of 1 s hides lags below 0.75 s.",),
        tried=52,
        record={"seed": 7},
    )


@pytest.fixture(scope="module")
def pages():
    return {v: render(diagnosis_page(diagnosis_of(v, HOSTILE), RECORD)) for v in VERDICTS}
