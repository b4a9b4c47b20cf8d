"""The model as flat documented numbers, which need no symbolic program: JSON, and MATLAB's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from greybox.export.ports import Port
from greybox.export.sampled import SampledModel
from greybox.model.disturbances import SHOWN
from greybox.model.model import ManoeuvringModel
from greybox.vessel.toml import vessel_to_dict

FORMAT = "greybox-numbers"
# names of signals in the equations
MEANING = (
    "state(k+1) = state(k) + sum over parameters of its equation of value * regressor, with "
    "regressor = product over signals of signal^power * |signal|^modulus, times the product over "
    "its bumps of max(0, 1 - (max(0, |signal - centre| - flat) / width)^2)^2; u_r, v_r through the "
    "water, u_q, v_q through the air, u_c, v_c of the water, r yaw rate, taux, tauy, taun the "
    "thrusters' force. With rk4 this increment is that of a rate over one sample time, integrated "
    "by the classical rule."
)


def port_rows(ports: Sequence[Port]) -> list[dict[str, Any]]:
    """Return ports as rows of JSON."""
    return [{"name": p.name, "unit": p.unit, "meaning": p.meaning, "value": p.value} for p in ports]


def signals(model: ManoeuvringModel) -> list[str]:
    """Return the signals of the regressors, as the equations name them."""
    used = {f.signal for t in model.structure.terms for f in t.factors}
    order = [*model.structure.states, "uq", "vq", "uc", "vc", *model.structure.inputs]
    return [SHOWN.get(n, n) for n in order if n in used]


def exponents(model: ManoeuvringModel) -> tuple[np.ndarray, np.ndarray]:
    """Return how often each signal, and its modulus, stands in each regressor, (p, ns) each."""
    names = signals(model)
    power = np.zeros((len(model.names), len(names)), int)
    modulus = np.zeros_like(power)
    for i, term in enumerate(model.structure.terms):
        for factor in term.factors:
            if factor.bump:
                continue
            (modulus if factor.modulus else power)[
                i, names.index(SHOWN.get(factor.signal, factor.signal))
            ] += 1
    return power, modulus


def bumps(model: ManoeuvringModel) -> list[list[dict[str, Any]]]:
    """Return the bumps of each regressor, most often none."""
    return [
        [
            {
                "signal": SHOWN.get(f.signal, f.signal),
                "centre": f.centre,
                "width": f.width,
                "flat": f.flat,
            }
            for f in term.factors
            if f.bump
        ]
        for term in model.structure.terms
    ]


def regressor_text(model: ManoeuvringModel) -> list[str]:
    """Return each regressor as text, such as ``|u_r|*u_r``; ``1`` for a constant force."""
    texts = []
    for term in model.structure.terms:
        shown = [str(replace(f, signal=SHOWN.get(f.signal, f.signal))) for f in term.factors]
        texts.append("*".join(shown) or "1")
    return texts


def numbers(model: ManoeuvringModel, sampled: SampledModel) -> dict[str, Any]:
    """Return the tables of the JSON file.

    Parameters
    ----------
    model : ManoeuvringModel
    sampled : SampledModel
        For its ports.
    """
    structure = model.structure
    power, modulus = exponents(model)
    rows = zip(
        model.names, structure.terms, regressor_text(model), model.units, model.theta, model.std,
        power, modulus, bumps(model), strict=True,
    )  # fmt: skip
    vessel = vessel_to_dict(model.vessel)
    return {
        "format": FORMAT,
        "version": 1,
        "vessel": model.vessel.name,
        "length": model.vessel.length,
        "structure": structure.name,
        "reference": structure.reference,
        "integrator": model.integrator,
        "sample_time": model.sample_time,
        "equations": structure.equations(),
        "meaning": MEANING,
        "signals": signals(model),
        "parameters": [
            {
                "name": name,
                "equation": term.state,
                "regressor": text,
                "value": value,
                "std": std,
                "unit": unit,
                "per_second": value / model.sample_time,
                "stands_for": list(model.sums.get(name, (name,))),
                "power": p,
                "modulus": m,
                "bumps": b,
            }
            for name, term, text, unit, value, std, p, m, b in rows
        ],
        "covariance": model.covariance,
        "disturbances": [
            {"name": name, "value": value, "std": std, "unit": "m/s"}
            for name, (value, std) in model.disturbances.items()
        ],
        "changes": [vars(c) for c in model.changes],
        "thrusters": vessel["thruster"],
        "actuation": vessel.get("actuation"),
        "inputs": port_rows(sampled.inputs),
        "outputs": port_rows(sampled.outputs),
        "notes": list(sampled.notes),
    }
