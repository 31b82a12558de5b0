"""A system as an SSP package, of version 1.0 where that has the words for it, else of 2.0."""

from __future__ import annotations

import math
import shutil
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import tomli_w
from lxml import etree

from master_node.system.ssp.reading import (
    DEFAULT_SSD,
    FMU_TYPE,
    SETTINGS_ANNOTATION,
    SETTINGS_ELEMENT,
    SSV_TYPE,
)
from master_node.system.ssp.xml_nodes import NAMESPACES
from master_node.system.start_values import GivenValue, structural_parameters
from master_node.system.system import System
from master_node.system.tables import Connection, SlaveSettings
from protocol.description import SlaveDescription
from protocol.errors import ConfigurationError
from protocol.host.files import as_file
from protocol.text.names import nearest
from protocol.variables import StartValue, Variable, VariableType

_Describe = Callable[[str, Path], SlaveDescription]
_SSD, _SSC, _SSV = (f"{{{NAMESPACES[prefix]}}}" for prefix in ("ssd", "ssc", "ssv"))
_TIME = (1980, 1, 1, 0, 0, 0)
"""Date of all entries, so that equal systems give equal packages."""

_TYPES = {
    **dict.fromkeys(("Real", "Float32", "Float64"), "Real"),
    **dict.fromkeys(("Integer", "Int8", "UInt8", "Int16", "UInt16", "Int32"), "Integer"),
    **{name: name for name in ("Boolean", "String", "Binary")},
}
"""Names of types of variables in SSP 1.0, as far as it has them."""

_SMALLEST_INTEGER, _LARGEST_INTEGER = -(2**31), 2**31 - 1
_KINDS = ("Boolean", "String", "Binary", "Integer", "Int64", "UInt64", "Real")
"""Types; of two for numbers the later one is for all of an array that has both."""

_NUMBERS = frozenset(_KINDS[3:])
_NOT_IN_1_0 = {f"{_SSC}Dimension", *(f"{_SSV}{sign}Int64" for sign in ("", "U"))}


def write_package(
    system: System, models: Mapping[str, str], describe: _Describe, name: str, path: Path
) -> None:
    """Write ``system`` as a package to ``path``.

    Args:
        system: all its slaves have FMUs.
        models: file name of each slave's FMU in the package, by slave.
        describe: gives the description of a slave's model from its path and the base directory.
        name: of the whole system.
        path: of the package; what is there is overwritten.

    Raises:
        ConfigurationError: something cannot be said in SSP, with slave or connection.
        OSError: the package cannot be written, or a model cannot be read.
    """
    _check_inputs(system)
    descriptions = {}
    for slave, settings in system.slaves.items():
        try:
            descriptions[slave] = describe(str(settings.model), system.base)
        except ConfigurationError as error:
            raise error.located(slave=slave) from None
    documents = {DEFAULT_SSD: _description(system, name, models, descriptions)} | {
        f"resources/{slave}.ssv": _parameter_set(system, slave, settings, descriptions[slave])
        for slave, settings in system.slaves.items()
        if settings.parameters
    }
    with zipfile.ZipFile(path, "w") as archive:
        for document, xml in documents.items():
            archive.writestr(_entry(document, zipfile.ZIP_DEFLATED), xml)
        for file in dict.fromkeys(models.values()):
            slave = next(slave for slave, name in models.items() if name == file)
            with as_file(system.base / str(system.slaves[slave].model)) as fmu:
                entry = _entry(f"resources/{file}", zipfile.ZIP_STORED)
                entry.file_size = fmu.stat().st_size
                with fmu.open("rb") as source, archive.open(entry, "w") as target:
                    shutil.copyfileobj(source, target)


def _entry(name: str, compression: int) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name, _TIME)
    entry.compress_type = compression
    return entry


def _description(
    system: System,
    name: str,
    models: Mapping[str, str],
    descriptions: Mapping[str, SlaveDescription],
) -> bytes:
    root = etree.Element(
        f"{_SSD}SystemStructureDescription",
        {"version": "1.0", "name": name, "generationTool": "Doublestep"},
        nsmap={prefix: NAMESPACES[prefix] for prefix in ("ssd", "ssc")},
    )
    whole = etree.SubElement(root, f"{_SSD}System", name=name)
    elements = etree.SubElement(whole, f"{_SSD}Elements")
    ends = [_ends(system, number, descriptions) for number in range(len(system.connections))]
    for slave, settings in system.slaves.items():
        component = etree.SubElement(
            elements,
            f"{_SSD}Component",
            name=slave,
            type=FMU_TYPE,
            source=f"resources/{models[slave]}",
            implementation="CoSimulation",
        )
        kinds: dict[str, str] = {}
        for source, target in ends:
            if source[0] == slave:
                (first, *_) = _elements(descriptions[slave], source[1])
                kinds[source[1]] = str(first.causality)
            if target[0] == slave:
                kinds[target[1]] = "input"
        _add_connectors(component, kinds, descriptions[slave], settings)
        if settings.parameters:
            bindings = etree.SubElement(component, f"{_SSD}ParameterBindings")
            etree.SubElement(
                bindings,
                f"{_SSD}ParameterBinding",
                type=SSV_TYPE,
                source=f"resources/{slave}.ssv",
            )
    if ends:
        connections = etree.SubElement(whole, f"{_SSD}Connections")
        for (source, target), connection in zip(ends, system.connections, strict=True):
            _add_connection(connections, source, target, connection, descriptions)
    _add_experiment(root, system)
    _add_settings(root, system)
    return _text(root)


def _add_connectors(
    component: etree._Element,
    kinds: Mapping[str, str],
    description: SlaveDescription,
    settings: SlaveSettings,
) -> None:
    if not kinds:
        return
    connectors = etree.SubElement(component, f"{_SSD}Connectors")
    is_resized = not structural_parameters(description).isdisjoint(settings.parameters)
    for name, kind in kinds.items():
        connector = etree.SubElement(connectors, f"{_SSD}Connector", name=name, kind=kind)
        elements = _elements(description, name)
        # An enumeration would have to be defined here, and a unit as well: without them those of
        # the FMU hold.
        type_ = _TYPES.get(elements[-1].type)
        if type_ is not None:
            etree.SubElement(connector, f"{_SSC}{type_}")
        for size in _sizes(name, elements[-1].name):
            known = {} if is_resized else {"size": size}
            etree.SubElement(connector, f"{_SSC}Dimension", known)


def _add_connection(
    connections: etree._Element,
    source: tuple[str, str],
    target: tuple[str, str],
    connection: Connection,
    descriptions: Mapping[str, SlaveDescription],
) -> None:
    element = etree.SubElement(
        connections,
        f"{_SSD}Connection",
        startElement=source[0],
        startConnector=source[1],
        endElement=target[0],
        endConnector=target[1],
    )
    transformed = connection.factor is not None or connection.offset is not None
    if transformed or connection.ignore_units:
        element.set("suppressUnitConversion", "true")
    if transformed:
        etree.SubElement(
            element,
            f"{_SSC}LinearTransformation",
            factor=repr(float(1.0 if connection.factor is None else connection.factor)),
            offset=repr(float(connection.offset or 0.0)),
        )
    if connection.mapping is not None:
        ends = [_elements(descriptions[slave], name)[0] for slave, name in (source, target)]
        _add_mapping(
            element,
            {
                _numbered(ends[0], one): _numbered(ends[1], other)
                for one, other in connection.mapping.items()
            },
        )


def _add_mapping(connection: etree._Element, mapping: Mapping[StartValue, StartValue]) -> None:
    kind = "Boolean" if isinstance(next(iter(mapping)), bool) else "Integer"
    table = etree.SubElement(connection, f"{_SSC}{kind}MappingTransformation")
    for source, target in mapping.items():
        entry = {"source": str(source).lower(), "target": str(target).lower()}
        etree.SubElement(table, f"{_SSC}MapEntry", entry)


def _add_experiment(root: etree._Element, system: System) -> None:
    simulation = system.simulation
    experiment = etree.SubElement(root, f"{_SSD}DefaultExperiment")
    experiment.set("startTime", repr(float(simulation.start_time)))
    if simulation.stop_time is not None:
        experiment.set("stopTime", repr(float(simulation.stop_time)))


def _add_settings(root: etree._Element, system: System) -> None:
    """All that SSP has no element for, as the text of a system file."""
    slaves = {
        name: settings.model_dump(
            exclude_unset=True, exclude_none=True, exclude={"model", "parameters"}
        )
        for name, settings in system.slaves.items()
    }
    tables = {
        "simulation": system.simulation.model_dump(
            exclude_unset=True, exclude_none=True, exclude={"start_time", "stop_time"}
        ),
        "slaves": {name: table for name, table in slaves.items() if table},
        "inputs": dict(system.inputs),
        "results": system.results.model_dump(exclude_unset=True),
        "bus": system.bus.model_dump(exclude_unset=True, exclude_none=True),
    }
    text = tomli_w.dumps({name: table for name, table in tables.items() if table})
    if not text:
        return
    annotations = etree.SubElement(root, f"{_SSD}Annotations")
    annotation = etree.SubElement(annotations, f"{_SSC}Annotation", type=SETTINGS_ANNOTATION)
    settings = etree.SubElement(
        annotation, f"{{{SETTINGS_ELEMENT}}}Settings", nsmap={"doublestep": SETTINGS_ELEMENT}
    )
    settings.text = text


def _parameter_set(
    system: System, slave: str, settings: SlaveSettings, description: SlaveDescription
) -> bytes:
    root = etree.Element(
        f"{_SSV}ParameterSet",
        {"version": "1.0", "name": slave, "generationTool": "Doublestep"},
        nsmap={prefix: NAMESPACES[prefix] for prefix in ("ssv", "ssc")},
    )
    parameters = etree.SubElement(root, f"{_SSV}Parameters")
    for name, value in settings.parameters.items():
        where = system.places.parameter(slave, name)
        elements = _elements(description, name)
        if not elements:  # an element that is there when a structural parameter has sized the array
            elements = _elements(description, name.rpartition("[")[0])
        if not elements:
            names = [variable.name for variable in description.variables]
            raise ConfigurationError(f"{where}: no such variable{nearest(name, names)}")
        try:
            parameter = etree.SubElement(parameters, f"{_SSV}Parameter", name=name)
            _add_value(parameter, value, elements[0], where)
        except ValueError as error:  # characters that XML does not have
            raise ConfigurationError(f"{where}: cannot be written as XML: {error}") from None
    return _text(root)


def _add_value(
    parameter: etree._Element, value: GivenValue, variable: Variable, where: str
) -> None:
    values, sizes = _flat(value, where)
    pairs = [_value(_numbered(variable, one), variable.type, where) for one in values]
    kinds = sorted({kind for kind, _ in pairs}, key=_KINDS.index)
    kind = kinds[-1]
    if len(kinds) > 1 and not _NUMBERS.issuperset(kinds):
        raise ConfigurationError(f"{where}: an array of {' and '.join(kinds)}")
    texts = [text for _, text in pairs]
    if kind in ("String", "Binary") and sizes:
        element = etree.SubElement(parameter, f"{_SSV}{kind}")
        for text in texts:
            etree.SubElement(element, f"{_SSV}Value", value=text)
    else:
        etree.SubElement(parameter, f"{_SSV}{kind}", value=" ".join(texts) if sizes else texts[0])
    for size in sizes:
        etree.SubElement(parameter, f"{_SSC}Dimension", size=str(size))


def _flat(value: GivenValue, where: str) -> tuple[list[StartValue], list[int]]:
    """The values of an array in row-major order, and its sizes; none for a single value."""
    if isinstance(value, str | bytes) or not isinstance(value, Sequence):
        return [value], []
    parts = [_flat(part, where) for part in value]
    sizes = [inner for _, inner in parts]
    if not parts or any(inner != sizes[0] for inner in sizes):
        raise ConfigurationError(
            f"{where} = {value!r:.60}: its rows have different sizes, or none",
            remedy="give all elements of the array",
        )
    return [one for values, _ in parts for one in values], [len(parts), *sizes[0]]


def _numbered(variable: Variable, value: StartValue) -> StartValue:
    """The number of an enumeration's item: SSP wants its items defined where they are named."""
    return variable.items.get(value, value) if isinstance(value, str) else value


def _value(value: StartValue, type_: VariableType, where: str) -> tuple[str, str]:
    """The SSV type and text of a start value."""
    if isinstance(value, bool):
        return "Boolean", "true" if value else "false"
    if isinstance(value, str):
        return "Binary" if type_ is VariableType.BINARY else "String", value
    if not isinstance(value, int | float):
        raise ConfigurationError(f"{where} = {value!r:.60}: SSP has no such value")
    if not math.isfinite(value):
        raise ConfigurationError(f"{where} = {value}: is not a finite number")
    if isinstance(value, float) or _TYPES.get(type_) == "Real":
        return "Real", repr(float(value))
    if _SMALLEST_INTEGER <= value <= _LARGEST_INTEGER:
        return "Integer", str(value)
    for kind, bits in (("Int64", VariableType.INT64), ("UInt64", VariableType.UINT64)):
        smallest, largest = bits.integer_range or (0, 0)
        if smallest <= value <= largest:
            return kind, str(value)
    raise ConfigurationError(f"{where} = {value}: has more than 64 bits")


def _check_inputs(system: System) -> None:
    for name, value in system.inputs.items():
        if not isinstance(value, int | float):
            raise ConfigurationError(
                f"{system.source}: [inputs] {name!r}: a table or a function cannot be put into a "
                "package",
                remedy="export the system without it, and name it again in the imported file",
            )


def _elements(description: SlaveDescription, name: str) -> list[Variable]:
    """The variable of that name, or all elements of that array; empty if there is none."""
    found = [v for v in description.variables if v.name == name]
    return found or [v for v in description.variables if v.name.startswith(f"{name}[")]


def _sizes(name: str, last: str) -> list[str]:
    """The sizes of the array ``name`` by its last element; none for a single variable."""
    return last.removeprefix(name)[1:-1].split(",") if last != name else []


def _ends(
    system: System, number: int, descriptions: Mapping[str, SlaveDescription]
) -> tuple[tuple[str, str], tuple[str, str]]:
    connection = system.connections[number]
    where = system.places.connection(number)
    return (
        _variable(f"{where}: from = {connection.source!r}", connection.source, descriptions),
        _variable(f"{where}: to = {connection.target!r}", connection.target, descriptions),
    )


def _variable(
    where: str, reference: str, descriptions: Mapping[str, SlaveDescription]
) -> tuple[str, str]:
    """Slave and variable of ``slave.variable``; both names may hold dots."""
    slaves: Iterable[str] = sorted(
        (name for name in descriptions if reference.startswith(f"{name}.")), key=len, reverse=True
    )
    for slave in slaves:
        name = reference.removeprefix(f"{slave}.")
        if _elements(descriptions[slave], name):
            return slave, name
    raise ConfigurationError(f"{where}: no slave has a variable of that name")


def _text(root: etree._Element) -> bytes:
    """The document, of version 2.0 if it has an element or a kind that 1.0 has not."""
    if any(e.tag in _NOT_IN_1_0 or e.get("kind") == "local" for e in root.iter()):
        root.set("version", "2.0")
    text: bytes = etree.tostring(root, encoding="UTF-8", xml_declaration=True, pretty_print=True)
    return text
