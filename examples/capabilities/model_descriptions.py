"""Write the modelDescription.xml of an FMU in the words of FMI 1.0, 2.0 or 3.0.

What an FMU has and can do is said once, with the types of FMI 3.0: a `Description`. The variables
of an existing FMI 2.0 model description can be taken over with `read_description`.
"""

from __future__ import annotations

import uuid
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

TIME_REFERENCE = 999_999_999
"""Value reference of the independent variable of FMI 3.0."""

_NAMESPACE = uuid.UUID("5b7c1b9e-7a1e-4c39-9d0e-2f6f3e0b8c11")

_FMI2_TYPES = {
    "Float64": "Real",
    "Int32": "Integer",
    "Boolean": "Boolean",
    "String": "String",
    "Enumeration": "Enumeration",
}


def guid_of(name: str) -> str:
    """A GUID that belongs to the name of the FMU, always the same."""
    return f"{{{uuid.uuid5(_NAMESPACE, name)}}}"


@dataclass(frozen=True)
class Variable:
    """A variable of an FMU; attributes that are None are not written."""

    name: str
    reference: int
    causality: str
    type: str = "Float64"
    start: str | None = None
    variability: str | None = None
    initial: str | None = None
    unit: str | None = None
    description: str | None = None
    derivative: str | None = None
    """Variable of which it is the derivative."""
    depends: tuple[str, ...] | None = None
    """Inputs, states and parameters that an output or derivative depends on; None says nothing."""
    declared_type: str | None = None
    dimensions: tuple[int | str, ...] = ()
    """FMI 3.0: the sizes, a number or the name of a structural parameter."""
    extra: dict[str, str] = field(default_factory=dict)
    """Further attributes, as they are called in the version of FMI."""

    @property
    def explicit_variability(self) -> str | None:
        """The variability where it is not continuous, which is the default of FMI 2.0."""
        if self.variability is not None:
            return self.variability
        if self.causality in ("parameter", "calculatedParameter", "structuralParameter"):
            return "fixed"
        return None if self.type in ("Float64", "Float32") else "discrete"

    @property
    def is_initially_unknown(self) -> bool:
        """True if ``initial`` is calculated, given or by default."""
        if self.initial is not None:
            return self.initial != "exact"
        return self.causality in ("output", "local", "calculatedParameter")


@dataclass(frozen=True)
class Unit:
    """A unit: exponents of the SI base units, factor and offset to them."""

    name: str
    base: dict[str, str]


@dataclass(frozen=True)
class Description:
    """Variables and capabilities of an FMU."""

    name: str
    description: str
    variables: tuple[Variable, ...]
    units: tuple[Unit, ...] = ()
    enumerations: tuple[tuple[str, Mapping[str, int] | tuple[str, ...]], ...] = ()
    """Each with the numbers of its items, or items that are numbered from 1 on."""
    experiment: dict[str, str] = field(default_factory=dict)
    """The attributes of DefaultExperiment."""
    capabilities: dict[str, str] = field(default_factory=dict)
    """The attributes of CoSimulation or ModelExchange."""
    event_indicators: tuple[str, ...] = ()
    """Names of the variables that are the event indicators; FMI 2.0 knows their number only."""

    @property
    def guid(self) -> str:
        """The guid or instantiationToken."""
        return guid_of(self.name)


def read_description(path: Path) -> Description:
    """The variables, units and experiment of an FMI 2.0 model description with Reals only.

    The variable ``max_step`` of the FMU framework is left out.
    """
    root = ET.parse(path).getroot()
    scalars = root.findall("ModelVariables/ScalarVariable")
    names = [scalar.attrib["name"] for scalar in scalars]
    depends = {
        names[int(unknown.attrib["index"]) - 1]: tuple(
            names[int(index) - 1] for index in unknown.attrib.get("dependencies", "").split()
        )
        for kind in ("Outputs", "Derivatives")
        for unknown in root.findall(f"ModelStructure/{kind}/Unknown")
    }
    variables = []
    for scalar in scalars:
        real = scalar.find("Real")
        assert real is not None
        derivative = real.get("derivative")
        variables.append(
            Variable(
                name=scalar.attrib["name"],
                reference=int(scalar.attrib["valueReference"]),
                causality=scalar.attrib["causality"],
                variability=scalar.get("variability"),
                initial=scalar.get("initial"),
                description=scalar.get("description"),
                unit=real.get("unit"),
                start=real.get("start"),
                derivative=names[int(derivative) - 1] if derivative else None,
                depends=depends.get(scalar.attrib["name"]),
            )
        )
    experiment = root.find("DefaultExperiment")
    return Description(
        name=root.attrib["modelName"],
        description=root.get("description", ""),
        variables=tuple(variable for variable in variables if variable.name != "max_step"),
        units=tuple(
            Unit(unit.attrib["name"], dict(base.attrib))
            for unit in root.findall("UnitDefinitions/Unit")
            for base in unit.findall("BaseUnit")
        ),
        experiment=dict(experiment.attrib) if experiment is not None else {},
    )


def fmi1(description: Description) -> bytes:
    """The model description of an FMI 1.0 co-simulation FMU, stand-alone."""
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="1.0",
        modelName=description.name,
        modelIdentifier=description.name,
        guid=description.guid,
        description=description.description,
        variableNamingConvention="structured",
        numberOfContinuousStates=str(len(_states(description))),
        numberOfEventIndicators="0",
    )
    experiment = {key: value for key, value in description.experiment.items() if key != "stepSize"}
    if description.units:
        units = ET.SubElement(root, "UnitDefinitions")
        for unit in description.units:
            ET.SubElement(units, "BaseUnit", unit=unit.name)
    if experiment:
        ET.SubElement(root, "DefaultExperiment", experiment)
    variables = ET.SubElement(root, "ModelVariables")
    for variable in description.variables:
        attributes = {"name": variable.name, "valueReference": str(variable.reference)}
        if variable.description:
            attributes["description"] = variable.description
        if variable.causality == "parameter":
            attributes["variability"] = "parameter"
        elif variable.explicit_variability:
            attributes["variability"] = variable.explicit_variability
        attributes["causality"] = {"parameter": "internal", "local": "internal"}.get(
            variable.causality, variable.causality
        )
        scalar = ET.SubElement(variables, "ScalarVariable", attributes)
        value = _present(unit=variable.unit, start=variable.start)
        if variable.start is not None:
            value["fixed"] = "true"
        if variable.causality in ("input", "output"):  # inputs that are set have no fixed value
            value.pop("fixed", None)
        ET.SubElement(scalar, _FMI2_TYPES[variable.type], value)
    implementation = ET.SubElement(root, "Implementation")
    alone = ET.SubElement(implementation, "CoSimulation_StandAlone")
    ET.SubElement(alone, "Capabilities", description.capabilities)
    return _text(root)


def fmi2(description: Description, kind: str = "CoSimulation") -> bytes:
    """The model description of an FMI 2.0 FMU; ``kind`` is CoSimulation or ModelExchange."""
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=description.name,
        guid=description.guid,
        description=description.description,
        variableNamingConvention="structured",
        numberOfEventIndicators=str(len(description.event_indicators)),
    )
    ET.SubElement(root, kind, {"modelIdentifier": description.name} | description.capabilities)
    _write_units(root, description.units)
    if description.enumerations:
        types = ET.SubElement(root, "TypeDefinitions")
        for name, items in description.enumerations:
            simple = ET.SubElement(types, "SimpleType", name=name)
            _write_items(ET.SubElement(simple, "Enumeration"), items)
    _write_log_categories(root)
    if description.experiment:
        ET.SubElement(root, "DefaultExperiment", description.experiment)

    variables = ET.SubElement(root, "ModelVariables")
    index = {variable.name: i for i, variable in enumerate(description.variables, start=1)}
    for variable in description.variables:
        scalar = ET.SubElement(
            variables,
            "ScalarVariable",
            _present(
                name=variable.name,
                valueReference=str(variable.reference),
                causality=variable.causality,
                variability=variable.explicit_variability,
                initial=variable.initial,
                description=variable.description,
            ),
        )
        derivative = str(index[variable.derivative]) if variable.derivative else None
        ET.SubElement(
            scalar,
            _FMI2_TYPES[variable.type],
            _present(
                declaredType=variable.declared_type,
                unit=variable.unit,
                start=variable.start,
                derivative=derivative,
            )
            | variable.extra,
        )
    structure = ET.SubElement(root, "ModelStructure")
    for name, unknowns in (
        ("Outputs", _outputs(description)),
        ("Derivatives", _derivatives(description)),
        ("InitialUnknowns", _initial_unknowns(description)),
    ):
        if unknowns:
            element = ET.SubElement(structure, name)
            for variable in unknowns:
                depends = None if name == "InitialUnknowns" else variable.depends
                ET.SubElement(
                    element,
                    "Unknown",
                    _present(
                        index=str(index[variable.name]),
                        dependencies=None
                        if depends is None
                        else " ".join(str(index[known]) for known in depends),
                    ),
                )
    return _text(root)


def fmi3(description: Description, kind: str = "CoSimulation") -> bytes:
    """The model description of an FMI 3.0 FMU; ``kind`` is CoSimulation or ModelExchange.

    The independent variable ``time`` is added.
    """
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=description.name,
        instantiationToken=description.guid,
        description=description.description,
        variableNamingConvention="structured",
    )
    ET.SubElement(root, kind, {"modelIdentifier": description.name} | description.capabilities)
    _write_units(root, description.units)
    if description.enumerations:
        types = ET.SubElement(root, "TypeDefinitions")
        for name, items in description.enumerations:
            _write_items(ET.SubElement(types, "EnumerationType", name=name), items)
    _write_log_categories(root)
    if description.experiment:
        ET.SubElement(root, "DefaultExperiment", description.experiment)

    reference = {variable.name: str(variable.reference) for variable in description.variables}
    variables = ET.SubElement(root, "ModelVariables")
    ET.SubElement(
        variables,
        "Float64",
        name="time",
        valueReference=str(TIME_REFERENCE),
        causality="independent",
        variability="continuous",
        description="Time",
    )
    for variable in description.variables:
        texts = variable.type in ("String", "Binary")
        element = ET.SubElement(
            variables,
            variable.type,
            _present(
                name=variable.name,
                valueReference=str(variable.reference),
                causality=variable.causality,
                variability=variable.explicit_variability,
                initial=variable.initial,
                description=variable.description,
                declaredType=variable.declared_type,
                unit=variable.unit,
                derivative=reference[variable.derivative] if variable.derivative else None,
                start=None if texts else variable.start,
            )
            | variable.extra,
        )
        for size in variable.dimensions:
            ET.SubElement(
                element,
                "Dimension",
                {"start": str(size)}
                if isinstance(size, int)
                else {"valueReference": reference[size]},
            )
        if texts and variable.start is not None:
            ET.SubElement(element, "Start", value=variable.start)
    structure = ET.SubElement(root, "ModelStructure")
    indicators = dict.fromkeys(description.event_indicators)
    for name, unknowns in (
        ("Output", _outputs(description)),
        ("ContinuousStateDerivative", _derivatives(description)),
        ("InitialUnknown", _initial_unknowns(description)),
        ("EventIndicator", [v for v in description.variables if v.name in indicators]),
    ):
        for variable in unknowns:
            depends = None if name == "InitialUnknown" else variable.depends
            ET.SubElement(
                structure,
                name,
                _present(
                    valueReference=str(variable.reference),
                    dependencies=None
                    if depends is None
                    else " ".join(reference[known] for known in depends),
                ),
            )
    return _text(root)


def build_description(
    name: str, sources: tuple[str, ...], definitions: tuple[tuple[str, str], ...]
) -> bytes:
    """The ``sources/buildDescription.xml`` of an FMI 3.0 FMU."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=name)
    files = ET.SubElement(configuration, "SourceFileSet", language="C99")
    for source in sources:
        ET.SubElement(files, "SourceFile", name=source)
    for definition, value in definitions:
        ET.SubElement(files, "PreprocessorDefinition", name=definition, value=value)
    return _text(root)


def with_variables(description: Description, **extra: dict[str, str]) -> Description:
    """The description with more attributes for all variables of a causality."""
    return replace(
        description,
        variables=tuple(
            replace(variable, extra=variable.extra | extra.get(variable.causality, {}))
            for variable in description.variables
        ),
    )


def _outputs(description: Description) -> list[Variable]:
    return [variable for variable in description.variables if variable.causality == "output"]


def _derivatives(description: Description) -> list[Variable]:
    return [variable for variable in description.variables if variable.derivative]


def _states(description: Description) -> set[str]:
    return {variable.derivative for variable in description.variables if variable.derivative}


def _initial_unknowns(description: Description) -> list[Variable]:
    states = _states(description)
    return [
        variable
        for variable in description.variables
        if variable.is_initially_unknown
        and (
            variable.causality in ("output", "calculatedParameter")
            or variable.derivative
            or variable.name in states
        )
    ]


def _write_units(root: ET.Element, units: tuple[Unit, ...]) -> None:
    if not units:
        return
    definitions = ET.SubElement(root, "UnitDefinitions")
    for unit in units:
        element = ET.SubElement(definitions, "Unit", name=unit.name)
        ET.SubElement(element, "BaseUnit", unit.base)


def _write_items(element: ET.Element, items: Mapping[str, int] | tuple[str, ...]) -> None:
    if isinstance(items, tuple):
        items = {item: value for value, item in enumerate(items, start=1)}
    for item, value in items.items():
        ET.SubElement(element, "Item", name=item, value=str(value))


def _write_log_categories(root: ET.Element) -> None:
    categories = ET.SubElement(root, "LogCategories")
    for status in ("Warning", "Discard", "Error"):
        ET.SubElement(
            categories,
            "Category",
            name=f"logStatus{status}",
            description=f"Messages of calls that return {status}",
        )


def _present(**attributes: str | None) -> dict[str, str]:
    return {name: value for name, value in attributes.items() if value is not None}


def _text(root: ET.Element) -> bytes:
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"
