"""The model as serialised CasADi functions, for optimal control and estimation."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import casadi as ca

from greybox.export.numbers import port_rows
from greybox.export.sampled import SampledModel
from greybox.model.model import ManoeuvringModel

FORMAT = "greybox-casadi"


def casadi_functions(sampled: SampledModel) -> dict[str, ca.Function]:
    """Return the functions of a model by name.

    ``step`` is ``(x, u, p) -> (x_next, y)`` over one sample time, ``y`` at its
    start; ``rhs`` is ``(x, u, p) -> (x_dot)``, where the model has a rate; ``begin``
    is ``(x, u, p) -> (x_begin)``, which puts the thrusters at rest on the first commands,
    where they remember something. ``p`` are the model's parameters.

    Parameters
    ----------
    sampled : SampledModel
        Without open switches.
    """
    given = [sampled.x, sampled.u, sampled.p]
    names = ["x", "u", "p"]
    options = {"cse": True}
    functions = {
        "step": ca.Function(
            "step", given, [sampled.x_next, sampled.y], names, ["x_next", "y"], options
        )
    }
    if sampled.rate is not None:
        rate = [ca.densify(sampled.rate)]
        functions["rhs"] = ca.Function("rhs", given, rate, names, ["x_dot"], options)
    if len(sampled.states) > sampled.motion:
        functions["begin"] = ca.Function(
            "begin", given, [sampled.rest], names, ["x_begin"], options
        )
    return functions


def serialised(function: ca.Function) -> bytes:
    """Return the bytes of the file that ``casadi.Function.load`` reads."""
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "function.casadi"
        function.save(str(file))
        return file.read_bytes()


def casadi_files(
    model: ManoeuvringModel, sampled: SampledModel, path: Path
) -> tuple[dict[Path, ca.Function], dict[Path, dict[str, Any]]]:
    """Return the functions by file, and the table that tells what is in them.

    The step is `path`; others stand beside it, their name behind its stem.
    """
    functions = casadi_functions(sampled)
    files = {
        path if name == "step" else path.with_name(f"{path.stem}_{name}.casadi"): function
        for name, function in functions.items()
    }
    side = {
        "format": FORMAT,
        "version": 1,
        "vessel": model.vessel.name,
        "structure": model.structure.name,
        "integrator": model.integrator,
        "sample_time": model.sample_time,
        "functions": {f.name(): {"file": at.name, "signature": str(f)} for at, f in files.items()},
        "no_rhs": sampled.no_rate or None,
        "x": port_rows(sampled.states),
        "motion": sampled.motion,
        "u": port_rows(sampled.inputs),
        "p": port_rows(sampled.parameters),
        "y": port_rows(sampled.outputs),
        "notes": list(sampled.notes),
    }
    return files, {path.with_name(f"{path.stem}.casadi.json"): side}
