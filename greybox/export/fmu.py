"""The model as an FMU for co-simulation: FMI 2.0, sources and a binary in one archive.

Our own wrapper and not CasADi's DaeBuilder: that one exports continuous-time models
for model exchange, and what was identified is a step of one sample time whose
thrusters remember earlier samples.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path

from greybox.export.description import Variables, model_description
from greybox.export.generate import c_functions, filled, template
from greybox.export.names import comment, identifier
from greybox.export.sampled import SampledModel
from greybox.model.model import ManoeuvringModel
from greybox.numerics.compiler import find_compiler, fmi_platform, shared_library

# zip files know no earlier time
_TIME = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class Fmu:
    """An FMU as bytes.

    Parameters
    ----------
    data : bytes
    guid : str
    platform : str
        FMI's name of the platform whose binary is inside, empty where there is none.
    """

    data: bytes
    guid: str
    platform: str


def make_fmu(
    model: ManoeuvringModel, sampled: SampledModel, path: Path, *, binary: bool = True
) -> Fmu:
    """Return the FMU of a model.

    Parameters
    ----------
    model : ManoeuvringModel
    sampled : SampledModel
        With the switches left open.
    path : Path
        Its stem names the model.
    binary : bool
        Whether to compile for this machine, where it has a compiler.

    Raises
    ------
    ExportError
        The compiler failed.
    """
    name = identifier(path.stem)
    variables = Variables.of(sampled)
    texts = {"fmu.c": template("fmu.c"), "fmi2.h": template("fmi2.h")}
    texts["model.c"] = c_functions(
        f"{name}_model",
        [sampled.x, sampled.u, sampled.s, sampled.p],
        {
            f"{name}_model_begin": sampled.rest,
            f"{name}_model_step": sampled.x_next,
            f"{name}_model_read": sampled.y,
        },
    )
    values = {
        "title": comment(model.vessel.name),
        "name": name,
        "guard": f"{name.upper()}_MODEL_H",
        "sample_time": repr(sampled.sample_time),
        "parameters": len(sampled.parameters),
        "motion": sampled.motion,
        "states": len(sampled.states),
        "inputs": len(sampled.inputs),
        "switches": len(sampled.switches),
        "outputs": len(sampled.outputs),
        "start": [repr(v.value) for v in variables.settable],
    }
    guid = _guid(
        *texts.values(), filled("model.h", values | {"guid": ""}),
        model_description(model, sampled, variables, name, "", sorted(texts)),
    )  # fmt: skip
    sources = [n for n in sorted(texts) if n.endswith(".c")]
    texts["model.h"] = filled("model.h", values | {"guid": guid})
    files: dict[str, bytes] = {
        "modelDescription.xml": model_description(
            model, sampled, variables, name, guid, sources
        ).encode(),
        "documentation/index.html": _page(model, sampled).encode(),
    }
    files |= {f"sources/{n}": t.encode() for n, t in texts.items()}
    compiler = find_compiler() if binary else None
    place = ""
    if compiler is not None:
        place, end = fmi_platform()
        library = shared_library(compiler, texts, ("FMI2_OVERRIDE_FUNCTION_PREFIX",))
        files[f"binaries/{place}/{name}{end}"] = library
    return Fmu(archive(files), guid, place)


def archive(files: Mapping[str, bytes]) -> bytes:
    """Return a zip archive whose bytes follow from its contents alone."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as target:
        for name, data in files.items():
            info = zipfile.ZipInfo(name, _TIME)
            info.create_system = 3
            info.external_attr = 0o644 << 16
            info.compress_type = zipfile.ZIP_DEFLATED
            target.writestr(info, data)
    return out.getvalue()


def _guid(*texts: str) -> str:
    digest = hashlib.sha256("\0".join(texts).encode()).hexdigest()
    return (
        "{"
        + "-".join(digest[a:b] for a, b in ((0, 8), (8, 12), (12, 16), (16, 20), (20, 32)))
        + "}"
    )


def _page(model: ManoeuvringModel, sampled: SampledModel) -> str:
    notes = "".join(f"<li>{escape(n)}</li>" for n in sampled.notes)
    summary = escape(model.summary()).encode(errors="replace").decode()
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{escape(comment(model.vessel.name))}</title></head><body>\n"
        f"<pre>{summary}</pre>\n<ul>{notes}</ul>\n</body></html>\n"
    )
