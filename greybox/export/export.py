"""`export_model`: a model for another program, all its files written or none."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from greybox.errors import UsageError, suggestion
from greybox.export.motion import Heading, Wind
from greybox.export.sampled import SampledModel, sampled_model
from greybox.files import check_targets, replacing, to_json
from greybox.model.model import ManoeuvringModel
from greybox.notebook import DisplayMixin, items

TARGETS = ("c", "fmu", "casadi", "mat", "json")
_OPTIONS = {"heading": ("simulated", "measured"), "wind": ("earth", "relative")}


@dataclass(frozen=True, repr=False)
class Exported(DisplayMixin):
    """What was written.

    Parameters
    ----------
    target : str
        One of `TARGETS`.
    files : tuple of Path
        The one that was asked for first.
    inputs, outputs : tuple of str
        Names of the ports, with units.
    notes : tuple of str
        What a user must know.
    """

    target: str
    files: tuple[Path, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    notes: tuple[str, ...]

    def summary(self) -> str:
        """Return files, ports and notes as lines."""
        lines = [f"wrote {', '.join(str(f) for f in self.files)}"]
        lines += [f"in:  {', '.join(self.inputs)}", f"out: {', '.join(self.outputs)}"]
        return "\n".join([*lines, *[f"note: {n}" for n in self.notes]])

    def _parts(self) -> Iterator[str]:
        yield items("Files", self.files)
        yield items("In", self.inputs)
        yield items("Out", self.outputs)
        yield items("Notes", self.notes)


def export_model(
    model: ManoeuvringModel,
    to: str,
    out: str | Path,
    *,
    heading: Heading | None = None,
    wind: Wind | None = None,
    settled: bool = False,
    binary: bool = True,
) -> Exported:
    """Write a model for another program.

    Parameters
    ----------
    model : ManoeuvringModel
    to : {"c", "fmu", "casadi", "mat", "json"}
        C source with a header and an example; an FMU for co-simulation (FMI 2.0);
        serialised CasADi functions; a MATLAB struct; flat numbers.
    out : str or Path
        The file; C and CasADi write others beside it.
    heading : {"simulated", "measured"}, optional
        By default simulated where the structure has a yaw rate. An FMU leaves it to
        whoever runs it.
    wind : {"earth", "relative"}, optional
        Wind over ground (default), or velocity of the ship through the air, as
        logs measure it. An FMU leaves it to whoever runs it.
    settled : bool
        Export the model as it is after its last change.
    binary : bool
        Whether an FMU holds a binary for this machine, where it has a compiler.

    Returns
    -------
    Exported

    Raises
    ------
    UsageError
        The target is unknown, an option does not belong to it, or the file is none.
    StructureError
        The structure is of no ship, or has no yaw rate to simulate the heading with.
    ExportError
        The compiler failed.
    LogError
        The file cannot be written.
    """
    if to not in TARGETS:
        raise UsageError(
            f"a model cannot be exported to '{to}'.{suggestion(to, TARGETS)} "
            f"Targets: {', '.join(TARGETS)}."
        )
    for name, value in (("heading", heading), ("wind", wind)):
        known = _OPTIONS[name]
        if value is not None and to == "fmu":
            raise UsageError(
                f"an FMU chooses its {name} where it runs ({name}_measured), so {name} = "
                f"'{value}' does not belong to it: leave it out."
            )
        if value is not None and value not in known:
            raise UsageError(
                f"{name} is '{value}'.{suggestion(value, known)} Use {' or '.join(known)}."
            )
    if not binary and to != "fmu":
        raise UsageError(f"only an FMU holds a binary, '{to}' does not: leave --no-binary out.")
    if str(out) == "-":
        raise UsageError(f"'{to}' is written to a file: name one instead of '-'.")
    idle: tuple[str, ...] = ()
    if settled and not model.changes:
        idle = ("settled changed nothing, as no parameter of the model changes",)
    if wind is not None and not model.structure.uses_air:
        idle = (*idle, f"wind = '{wind}' changed nothing, as the model has no wind terms")
    model = model.at_final_parameters() if settled else model
    path = Path(out)
    if path.suffix.casefold() in {f".{t}" for t in TARGETS} - {f".{to}"}:
        raise UsageError(
            f"'{out}' ends as another format than '{to}': name a file that ends in .{to}, or "
            f"export to {path.suffix[1:].casefold()}."
        )
    check_targets(out)
    if to == "fmu":
        sampled = sampled_model(model, heading="either", wind="either")
    else:
        sampled = sampled_model(model, heading=heading, wind=wind or "earth")
    notes: tuple[str, ...] = ()
    if to == "fmu":
        files, notes = _fmu(model, sampled, path, binary)
    else:
        files = _WRITERS[to](model, sampled, path)
    check_targets(*files)
    with ExitStack() as stack:
        # each is renamed over its target only after all of them are complete
        handles = [stack.enter_context(replacing(f, "wb")) for f in files]
        for handle, data in zip(handles, files.values(), strict=True):
            handle.write(data)
    return Exported(
        to,
        tuple(files),
        tuple(f"{p.name} [{p.shown_unit}]" for p in sampled.inputs),
        tuple(f"{p.name} [{p.shown_unit}]" for p in sampled.outputs),
        (*idle, *notes, *sampled.notes),
    )


Files = dict[Path, bytes]


def _fmu(
    model: ManoeuvringModel, sampled: SampledModel, path: Path, binary: bool
) -> tuple[Files, tuple[str, ...]]:
    from greybox.export.fmu import make_fmu

    made = make_fmu(model, sampled, path, binary=binary)
    if made.platform:
        note = f"the FMU holds its C source and a binary for {made.platform}"
    elif binary:
        note = (
            "the FMU holds its C source only, because this machine has no C compiler (cc, gcc, "
            "clang or $CC): export it where there is one, or let the importer compile it"
        )
    else:
        note = "the FMU holds its C source only, as asked for"
    return {path: made.data}, (note,)


def _c(model: ManoeuvringModel, sampled: SampledModel, path: Path) -> Files:
    from greybox.export.c import c_sources

    return {f: text.encode() for f, text in c_sources(model, sampled, path).items()}


def _casadi(model: ManoeuvringModel, sampled: SampledModel, path: Path) -> Files:
    from greybox.export.casadi_file import casadi_files, serialised

    functions, side = casadi_files(model, sampled, path)
    files = {f: serialised(function) for f, function in functions.items()}
    return files | {f: to_json(table).encode() for f, table in side.items()}


def _mat(model: ManoeuvringModel, sampled: SampledModel, path: Path) -> Files:
    from greybox.export.mat import mat_file

    return {path: mat_file(model, sampled)}


def _json(model: ManoeuvringModel, sampled: SampledModel, path: Path) -> Files:
    from greybox.export.numbers import numbers

    return {path: to_json(numbers(model, sampled)).encode()}


_WRITERS: dict[str, Callable[[ManoeuvringModel, SampledModel, Path], Files]] = {
    "c": _c,
    "casadi": _casadi,
    "mat": _mat,
    "json": _json,
}
