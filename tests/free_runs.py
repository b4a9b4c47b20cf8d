"""Models and the runs that their exports must repeat."""

from __future__ import annotations

import csv
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np

from greybox.export.export import export_model
from greybox.model.catalogue import structure_for
from greybox.model.model import ManoeuvringModel
from greybox.model.predictor import build_predictor
from greybox.model.run.changes import Change
from greybox.model.run.simulation import positions
from greybox.model.run.step import held
from greybox.model.terms import Factor, Term
from greybox.selection.fit_single import estimate_ls
from greybox.trial.convert.read import read_log
from greybox.trial.kinematics import decimate
from greybox.trial.log import TrialLog
from greybox.validation.fit import run_model
from greybox.vessel.force import force_inputs
from greybox.vessel.thrust import ThrustLaw
from greybox.vessel.toml import vessel_from_dict
from greybox.vessel.vessel import Actuation

CURRENT = {"current_north": (0.3, 0.01), "current_east": (-0.2, 0.01)}
CHANGES = (Change("Xu", 3.0, 40.0), Change("Nr", 0.5, 90.2), Change("Xu", 1.5, 120.0))


REAL = {
    "esso_osaka": (
        "zigzag_31-Jul-2020_13_29_19.csv",
        {"name": "3 m tanker", "length": 3.0,
         "thruster": [{"type": "propeller_rudder", "x": -1.5, "speed": "n_prop [rps]",
                       "rudder": "delta_rudder [rad]"}],
         "columns": {"t [s]": {"name": "t", "unit": "s"},
                     "x_position_mid [m]": {"name": "x_n", "unit": "m"},
                     "y_position_mid [m]": {"name": "y_n", "unit": "m"},
                     "u_velo [m/s]": {"name": "u", "unit": "m/s"},
                     "vm_velo [m/s]": {"name": "v", "unit": "m/s"},
                     "psi_hat [rad]": {"name": "psi", "unit": "rad"},
                     "r_angvelo [rad/s]": {"name": "r", "unit": "rad/s"},
                     "n_prop [rps]": {"name": "n_prop [rps]", "unit": "rps"},
                     "wind_velo_relative_mid [m/s]": {"name": "V_q", "unit": "m/s"},
                     "wind_dir_relative_mid [rad]": {"name": "dir_q", "unit": "rad"}}},
    ),
    "kvlcc2": (
        "hsva_Z_20_05.csv",
        {"name": "7 m tanker", "length": 7.0,
         "thruster": [{"type": "propeller_rudder", "x": -3.5, "speed": "n_rps",
                       "rudder": "delta_deg"}],
         "columns": {"t_s": {"name": "t", "unit": "s"},
                     "u_mps": {"name": "u", "unit": "m/s"},
                     "v_mps": {"name": "v", "unit": "m/s"},
                     "r_degps": {"name": "r", "unit": "deg/s"},
                     "psi_deg": {"name": "psi", "unit": "deg"},
                     "delta_deg": {"name": "delta_deg", "unit": "deg"}}},
    ),
}  # fmt: skip


def real_model(data_folder: Path, folder: str) -> tuple[ManoeuvringModel, TrialLog]:
    """Return a model of a real ship by least squares, and the log that it is of."""
    name, tables = REAL[folder]
    vessel = vessel_from_dict(tables)
    log = decimate(read_log(data_folder / folder / name, vessel), 0.5)
    # a propeller of constant speed leaves these of the tanker apart
    plain = "linear-X_race_drag-X_|u|u*rudder_drag-Xmu"
    terms = "linear+Wuu+Wvv+Wuv" if log.has_wind else plain
    kind = "basic+wind" if log.has_wind else "basic"
    predictor = build_predictor(structure_for(terms, force_inputs(vessel)), kind)
    return estimate_ls(predictor, [log], judged=False).model(), log


def with_actuation(model: ManoeuvringModel, **late) -> ManoeuvringModel:
    return replace(model, vessel=replace(model.vessel, actuation=Actuation(**late)))


def with_thrusters(model: ManoeuvringModel, *changed: dict) -> ManoeuvringModel:
    thrusters = [replace(t, **c) for t, c in zip(model.vessel.thrusters, changed, strict=True)]
    return replace(model, vessel=replace(model.vessel, thrusters=tuple(thrusters)))


KINDS = (
    "plain", "rk4", "current", "wind", "changes", "changes of rk4", "lag", "lag of speeds",
    "lag of commands", "delay", "whole delay", "late", "one late", "thrusters", "terms", "bumps",
    "bumps of rk4",
)  # fmt: skip


def variants(model: ManoeuvringModel) -> dict[str, ManoeuvringModel]:
    """Return every kind of extension that a diagnosis can make of a model."""
    law = ThrustLaw("linear", (), 0.4, 15.0)
    table = ThrustLaw("table", ((0.0, 0.0), (12.0, 9.0), (20.0, 25.0)))
    wide = model.structure.with_terms("N_|r|r", "Y_|r|v", "X_uuu", "Y_0")
    more = np.array([-0.3, 0.05, -1e-3, 1e-4])
    humped = with_bumps(model)
    return {
        "plain": model,
        "rk4": replace(model, integrator="rk4"),
        "current": replace(model, disturbances=CURRENT),
        "wind": replace(model, disturbances=CURRENT | {"wind_north": (3.0, 0.1)}),
        "changes": replace(model, changes=CHANGES),
        "changes of rk4": replace(model, changes=CHANGES, integrator="rk4", disturbances=CURRENT),
        "lag": with_actuation(model, lag=4.0),
        "lag of speeds": with_actuation(model, lag=4.0, lag_on="speed", lag_held="mean"),
        "lag of commands": with_actuation(model, lag=2.5, lag_on="command", lag_held="end"),
        "delay": with_actuation(model, delay=2.6),
        "one late": with_actuation(
            model, lag=3.0, lag_on="alpha1", lag_held="mean", delay=1.3, delay_on="n",
            rate_limit=0.02, rate_on="alpha2",
        ),
        "whole delay": with_actuation(model, delay=3.0),
        "late": replace(
            with_actuation(model, lag=3.0, lag_held="mean", delay=0.4),
            disturbances=CURRENT, integrator="rk4", changes=CHANGES,
        ),
        "thrusters": with_thrusters(
            model, {"thrust": law, "gain": 0.8}, {"thrust": table, "angle_offset": 0.05}
        ),
        "terms": replace(
            model, structure=wide, theta=np.concatenate([model.theta, more]),
            covariance=np.zeros((22, 22)),
        ),
        "bumps": humped,
        "bumps of rk4": replace(humped, integrator="rk4", disturbances=CURRENT),
    }  # fmt: skip


def with_bumps(model: ManoeuvringModel) -> ManoeuvringModel:
    """A force without a name that the runs of these tests go in and out of."""
    around = [Factor("u", centre=1.5, width=0.6), Factor("v", centre=0.6, width=1.5, flat=0.1)]
    thrust = Factor("taux", centre=12.0, width=30.0)
    terms = [
        Term("X_g1", "u", (*around, thrust)),
        Term("Y_g1", "v", tuple(around)),
        Term("N_g1", "r", (*around, Factor("r", centre=0.01, width=0.2))),
    ]
    return replace(
        model, structure=model.structure.with_terms(*terms),
        theta=np.append(model.theta, [0.02, -0.03, 0.004]),
        covariance=np.diag(np.append(np.diag(model.covariance), [1e-5, 1e-5, 1e-7])),
    )  # fmt: skip


def wanted(model: ManoeuvringModel, log: TrialLog, heading: str = "simulated") -> np.ndarray:
    """Return u, v, r, psi, x_n, y_n of greybox's own free run from (10, -5) m, (N, 6)."""
    run = run_model(model, log, heading=heading)
    psi = held_heading(model, log["psi"]) if heading == "measured" else run.psi
    way = positions(run.x, psi, model.sample_time, np.array([10.0, -5.0]))
    return np.column_stack([run.x, psi, way])


def held_heading(model: ManoeuvringModel, psi: np.ndarray) -> np.ndarray:
    """Return the measured heading as a step of the free run holds it."""
    return held(psi, model.integrator)


def held_wind(model: ManoeuvringModel, value: np.ndarray) -> np.ndarray:
    """Return measured wind as a step holds it; the run reads none after its last step."""
    return np.append(held(value[:-1], model.integrator), value[-1])


def calm(model: ManoeuvringModel, log: TrialLog) -> TrialLog:
    """Return the log of the model's vessel, without wind."""
    kept = {k: v for k, v in log.channels.items() if k not in ("u_q", "v_q")}
    return replace(log, vessel=model.vessel, channels=kept)


def program(model: ManoeuvringModel, folder: Path, **options) -> Path:
    """Export C, compile its example, return the program."""
    export_model(model, "c", folder / "ship.c", **options)
    out = folder / "ship"
    words = ["-std=c99", "-Wall", "-Werror", "-O0", "-o", out]
    subprocess.run(
        [shutil.which("cc"), *words, folder / "ship_example.c", folder / "ship.c", "-lm"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    return out


def run_program(
    program: Path, columns: dict[str, np.ndarray], start: np.ndarray
) -> dict[str, np.ndarray]:
    """Run the example on columns from a start and return its columns."""
    rows = zip(*columns.values(), strict=True)
    # names in quotes, as logs are written
    head = ",".join(f'"{name}"' for name in columns)
    text = "\n".join([head, *[",".join(f"{v:.17g}" for v in row) for row in rows]])
    done = subprocess.run(
        [program, *[f"{v:.17g}" for v in start]], input=text, check=True, capture_output=True,
        text=True,
    )  # fmt: skip
    table = list(csv.reader(done.stdout.splitlines()))
    return dict(zip(table[0], np.array(table[1:], float).T, strict=True))
