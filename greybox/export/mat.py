"""The model as a MATLAB file (level 5, compressed: what MATLAB calls v7), one struct."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from greybox.export.numbers import MEANING, bumps, exponents, numbers, regressor_text, signals
from greybox.export.sampled import SampledModel
from greybox.model.model import ManoeuvringModel

# the first bytes of a file are free text; scipy writes the time of day there
_TEXT = b"MATLAB 5.0 MAT-file, written by greybox-marine"


def mat_file(model: ManoeuvringModel, sampled: SampledModel) -> bytes:
    """Return the bytes of a MAT file with the struct ``model``.

    Parameters
    ----------
    model : ManoeuvringModel
    sampled : SampledModel
        For its ports.
    """
    from scipy.io import savemat

    power, modulus = exponents(model)
    names = signals(model)
    found = [(i, b) for i, row in enumerate(bumps(model)) for b in row]
    tables = numbers(model, sampled)
    struct = {
        "vessel": model.vessel.name,
        "structure": model.structure.name,
        "reference": model.structure.reference,
        "integrator": model.integrator,
        "sample_time": model.sample_time,
        "equations": _cells(model.structure.equations()),
        "meaning": MEANING,
        "names": _cells(model.names),
        "theta": _column(model.theta),
        "std": _column(model.std),
        "per_second": _column(model.theta / model.sample_time),
        "units": _cells(model.units),
        "covariance": model.covariance,
        "equation": _cells([t.state for t in model.structure.terms]),
        "regressors": _cells(regressor_text(model)),
        "signals": _cells(names),
        "power": power.astype(float),
        "modulus": modulus.astype(float),
        # a row a bump: number of its regressor and of its signal, centre, width, flat
        "bumps": np.array(
            [
                [i + 1, names.index(b["signal"]) + 1, b["centre"], b["width"], b["flat"]]
                for i, b in found
            ]
        ).reshape(-1, 5),
        "disturbance_names": _cells(list(model.disturbances)),
        "disturbances": _column([v for v, _ in model.disturbances.values()]),
        "disturbance_std": _column([e for _, e in model.disturbances.values()]),
        "change_names": _cells([c.parameter for c in model.changes]),
        "change_factors": _column([c.factor for c in model.changes]),
        "change_times": _column([c.time for c in model.changes]),
        "thrusters": _cells([_thruster(t) for t in tables["thrusters"]]),
        "lag": model.vessel.actuation.lag,
        "lag_on": model.vessel.actuation.lag_on,
        "lag_held": model.vessel.actuation.lag_held,
        "delay": model.vessel.actuation.delay,
        "delay_on": model.vessel.actuation.delay_on,
        "rate_limit": model.vessel.actuation.rate_limit or np.inf,
        "rate_on": model.vessel.actuation.rate_on or "",
        "input_names": _cells([p.name for p in sampled.inputs]),
        "input_units": _cells([p.shown_unit for p in sampled.inputs]),
        "output_names": _cells([p.name for p in sampled.outputs]),
        "output_units": _cells([p.shown_unit for p in sampled.outputs]),
        "notes": _cells(sampled.notes),
    }
    out = io.BytesIO()
    savemat(out, {"model": struct}, do_compression=True, long_field_names=True, oned_as="column")
    return _TEXT.ljust(116) + out.getvalue()[116:]


def _cells(values: Any) -> np.ndarray:
    """Return values as a column of cells."""
    cells = np.empty((len(values), 1), object)
    for i, value in enumerate(values):
        cells[i, 0] = value
    return cells


def _column(values: Any) -> np.ndarray:
    return np.asarray(values, float).reshape(-1, 1)


def _thruster(row: dict[str, Any]) -> dict[str, Any]:
    """Return one thruster as a struct; a bollard table is a matrix."""
    return {k: np.asarray(v, float) if isinstance(v, list) else v for k, v in row.items()}
