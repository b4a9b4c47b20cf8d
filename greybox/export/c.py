"""The model as C source: what CasADi generates behind a small documented interface."""

from __future__ import annotations

from pathlib import Path

from greybox.errors import UsageError
from greybox.export.generate import c_functions, described, filled
from greybox.export.names import comment, identifier, identifiers, string
from greybox.export.sampled import SampledModel
from greybox.model.disturbances import WIND
from greybox.model.model import ManoeuvringModel


def c_sources(model: ManoeuvringModel, sampled: SampledModel, path: Path) -> dict[Path, str]:
    """Return the texts of source, header and example beside `path`.

    Parameters
    ----------
    model : ManoeuvringModel
    sampled : SampledModel
        Without open switches.
    path : Path
        Of the source; what it declares begins with its stem.

    Raises
    ------
    UsageError
        The source would overwrite its header.
    """
    if path.suffix == ".h":
        raise UsageError(
            f"'{path.name}' is the name of a header: name the C source, such as "
            f"'{path.stem}.c'; the header is written beside it."
        )
    if comment(path.name) != path.name or set(path.name) & set('"\\'):
        raise UsageError(
            f"{path.name!r} cannot be named in C source: name a file without quotes, backslashes "
            f"and control characters."
        )
    name = identifier(path.stem)
    header = path.with_name(f"{path.stem}.h")
    example = path.with_name(f"{path.stem}_example.c")
    arguments = [sampled.x, sampled.u]
    generated = c_functions(
        f"{name}_generated",
        arguments,
        {
            f"{name}_generated_begin": sampled.baked(sampled.rest),
            f"{name}_generated_step": sampled.baked(sampled.x_next),
            f"{name}_generated_read": sampled.baked(sampled.y),
        },
    )
    kinds = {"state": sampled.states, "input": sampled.inputs, "output": sampled.outputs}
    motion = [p.name for p in sampled.states[: sampled.motion]]
    values = {
        "title": comment(model.vessel.name),
        "name": name,
        "upper": name.upper(),
        "guard": f"{name.upper()}_H",
        "header": header.name,
        "source": path.name,
        "example": example.name,
        "structure": comment(f"structure '{model.structure.name}'"),
        "integrator": sampled.integrator,
        "sample_time": repr(sampled.sample_time),
        "equations": [comment(e) for e in model.structure.equations()],
        "notes": [comment(n) for n in sampled.notes],
        "motion": sampled.motion,
        "literals": {kind: [string(p.name) for p in ports] for kind, ports in kinds.items()},
        "generated": generated,
        "needed": [int(p.name not in WIND) for p in sampled.inputs],
        "otherwise": [repr(p.value) for p in sampled.inputs],
        "start": " ".join({"u": "1.5"}.get(n, "0") for n in motion),
        "start_names": ", ".join(motion),
        "input_names": comment(", ".join(p.name for p in sampled.inputs)),
    }
    for kind, ports in kinds.items():
        ids = identifiers(p.name for p in ports)
        values[f"{kind}s"] = [(i, described(p)) for i, p in zip(ids, ports, strict=True)]
    return {
        path: filled("interface.c", values),
        header: filled("interface.h", values),
        example: filled("example.c", values),
    }
