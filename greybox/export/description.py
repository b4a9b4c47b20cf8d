"""modelDescription.xml of an FMU: each variable with its channel's name and its unit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from xml.etree import ElementTree

from greybox.export.names import distinct, line
from greybox.export.ports import FACTORS, Port, base_units
from greybox.export.sampled import SampledModel
from greybox.model.model import ManoeuvringModel


@dataclass(frozen=True)
class Variables:
    """Real variables in the order of their value references, with names that are all different.

    Parameters
    ----------
    parameters, starts, inputs, outputs : tuple of Port
    switches : tuple of (str, str)
        Boolean variables by name, with their meaning.
    """

    parameters: tuple[Port, ...]
    starts: tuple[Port, ...]
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    switches: tuple[tuple[str, str], ...]

    @classmethod
    def of(cls, sampled: SampledModel) -> Variables:
        """Return the variables of a model; outputs and inputs keep their names first."""
        starts = [
            Port(f"{p.name}_start", p.unit, f"{p.meaning}, at the start", p.value)
            for p in sampled.states[: sampled.motion]
        ]
        groups: list[Sequence[Port]] = [sampled.outputs, sampled.inputs, starts, sampled.parameters]
        switches = [s.name for s in sampled.switches]
        names = iter(distinct([line(p.name) for g in groups for p in g] + switches))
        outputs, inputs, starts_, parameters = (
            tuple(Port(next(names), p.unit, line(p.meaning), p.value) for p in g) for g in groups
        )
        meanings = [s.meaning for s in sampled.switches]
        return cls(parameters, starts_, inputs, outputs, tuple(zip(names, meanings, strict=True)))

    @property
    def settable(self) -> tuple[Port, ...]:
        """Those that a simulator sets."""
        return self.parameters + self.starts + self.inputs


def model_description(
    model: ManoeuvringModel,
    sampled: SampledModel,
    variables: Variables,
    name: str,
    guid: str,
    sources: Sequence[str],
) -> str:
    """Return the text of modelDescription.xml.

    Parameters
    ----------
    model : ManoeuvringModel
    sampled : SampledModel
    variables : Variables
    name : str
        Model identifier.
    guid : str
    sources : sequence of str
        File names of the C sources.
    """
    ts = sampled.sample_time
    notes = "".join(f" Note: {n}." for n in sampled.notes)
    root = ElementTree.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=line(model.vessel.name) or name,
        guid=guid,
        description=line(
            f"Manoeuvring model, structure '{model.structure.name}', {sampled.integrator}. It "
            f"steps on a grid of {ts:g} s from the start of the experiment, takes its inputs at "
            f"each instant of the grid and holds them to the next; communication steps may have "
            f"any length, and between instants the motion is interpolated linearly.{notes}"
        ),
        generationTool=f"greybox-marine {version('greybox-marine')}",
        variableNamingConvention="flat",
        numberOfEventIndicators="0",
    )
    co = ElementTree.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=name,
        needsExecutionTool="false",
        canHandleVariableCommunicationStepSize="true",
        canInterpolateInputs="false",
        maxOutputDerivativeOrder="0",
        canRunAsynchronuously="false",
        canBeInstantiatedOnlyOncePerProcess="false",
        canNotUseMemoryManagementFunctions="true",
        canGetAndSetFMUstate="true",
        canSerializeFMUstate="true",
        providesDirectionalDerivative="false",
    )
    files = ElementTree.SubElement(co, "SourceFiles")
    for file in sources:
        ElementTree.SubElement(files, "File", name=file)
    _units(root, [*variables.settable, *variables.outputs])
    log = ElementTree.SubElement(root, "LogCategories")
    ElementTree.SubElement(log, "Category", name="logStatusError")
    ElementTree.SubElement(
        root, "DefaultExperiment", startTime="0", stopTime=repr(600 * ts), stepSize=repr(ts)
    )
    _variables(root, variables)
    ElementTree.indent(root, "  ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, "unicode") + "\n"


def _units(root: ElementTree.Element, ports: Sequence[Port]) -> None:
    definitions = ElementTree.SubElement(root, "UnitDefinitions")
    for unit in sorted({p.unit for p in ports if p.unit is not None}):
        element = ElementTree.SubElement(definitions, "Unit", name=line(unit))
        base = base_units(unit)
        if base is not None:
            powers = {name: str(power) for name, power in base.items()}
            if unit in FACTORS:
                powers["factor"] = repr(FACTORS[unit])
            ElementTree.SubElement(element, "BaseUnit", powers)
        if unit in ("rad", "rad/s"):
            # display = factor times value
            ElementTree.SubElement(
                element, "DisplayUnit", name=unit.replace("rad", "deg"), factor="57.29577951308232"
            )


def _variables(root: ElementTree.Element, variables: Variables) -> None:
    listed = ElementTree.SubElement(root, "ModelVariables")
    kinds = (
        (variables.parameters, {"causality": "parameter", "variability": "tunable"}),
        (variables.starts, {"causality": "parameter", "variability": "fixed"}),
        (variables.inputs, {"causality": "input", "variability": "continuous"}),
        (
            variables.outputs,
            {"causality": "output", "variability": "continuous", "initial": "calculated"},
        ),
    )
    reference = 0
    for ports, said in kinds:
        for port in ports:
            attributes = {"name": port.name, "valueReference": str(reference)}
            meaning = port.meaning if port.unit else f"{port.meaning} [{port.shown_unit}]"
            scalar = ElementTree.SubElement(
                listed, "ScalarVariable", attributes | {"description": meaning} | said
            )
            real = ElementTree.SubElement(scalar, "Real")
            if port.unit is not None:
                real.set("unit", line(port.unit))
            if said["causality"] != "output":
                real.set("start", repr(port.value))
            reference += 1
    for k, (name, meaning) in enumerate(variables.switches):
        scalar = ElementTree.SubElement(
            listed, "ScalarVariable", name=name, valueReference=str(k), description=meaning,
            causality="parameter", variability="fixed",
        )  # fmt: skip
        ElementTree.SubElement(scalar, "Boolean", start="false")
    structure = ElementTree.SubElement(root, "ModelStructure")
    first = len(variables.settable) + 1
    for part in ("Outputs", "InitialUnknowns"):
        element = ElementTree.SubElement(structure, part)
        for k in range(len(variables.outputs)):
            ElementTree.SubElement(element, "Unknown", index=str(first + k))
