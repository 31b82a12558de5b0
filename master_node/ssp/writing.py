"""A system as an SSP 1.0 package."""

from __future__ import annotations

import math
import shutil
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import tomli_w
from lxml import etree

from master_node.configuration import Connection, SlaveSettings, System
from master_node.ssp.reading import (
    DEFAULT_SSD,
    FMU_TYPE,
    SETTINGS_ANNOTATION,
    SETTINGS_ELEMENT,
    SSV_TYPE,
)
from master_node.ssp.xml_nodes import NAMESPACES
from protocol.errors import ConfigurationError
from protocol.names import nearest
from protocol.slave import SlaveDescription, VariableType

_Describe = Callable[[str, Path], SlaveDescription]
_SSD, _SSC, _SSV = (f"{{{NAMESPACES[prefix]}}}" for prefix in ("ssd", "ssc", "ssv"))
_TIME = (1980, 1, 1, 0, 0, 0)
"""Of all entries, so that equal systems give equal packages."""

_TYPES = {
    **dict.fromkeys(("Real", "Float32", "Float64"), "Real"),
    **dict.fromkeys(("Integer", "Int8", "UInt8", "Int16", "UInt16", "Int32"), "Integer"),
    **{name: name for name in ("Boolean", "String", "Binary")},
}
"""What SSP 1.0 calls the types of variables, as far as it has them."""

_SMALLEST_INTEGER, _LARGEST_INTEGER = -(2**31), 2**31 - 1


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
            fmu = system.base / str(system.slaves[slave].model)
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
                kinds[source[1]] = "output"
            if target[0] == slave:
                kinds[target[1]] = "input"
        _add_connectors(component, kinds, descriptions[slave])
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
            _add_connection(connections, source, target, connection)
    _add_experiment(root, system)
    _add_settings(root, system)
    return _text(root)


def _add_connectors(
    component: etree._Element, kinds: Mapping[str, str], description: SlaveDescription
) -> None:
    if not kinds:
        return
    connectors = etree.SubElement(component, f"{_SSD}Connectors")
    for name, kind in kinds.items():
        connector = etree.SubElement(connectors, f"{_SSD}Connector", name=name, kind=kind)
        # An enumeration would have to be defined here, and a unit as well: without them those of
        # the FMU hold.
        type_ = _TYPES.get(description.variable(name).type)
        if type_ is not None:
            etree.SubElement(connector, f"{_SSC}{type_}")


def _add_connection(
    connections: etree._Element,
    source: tuple[str, str],
    target: tuple[str, str],
    connection: Connection,
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
        nsmap={"ssv": NAMESPACES["ssv"]},
    )
    parameters = etree.SubElement(root, f"{_SSV}Parameters")
    names = [variable.name for variable in description.variables]
    for name, value in settings.parameters.items():
        where = f"{system.source}: [slaves.{slave}.parameters] {name!r}"
        if name not in names:
            raise ConfigurationError(f"{where}: no such variable{nearest(name, names)}")
        try:
            parameter = etree.SubElement(parameters, f"{_SSV}Parameter", name=name)
            kind, text = _value(value, description.variable(name).type, where)
            etree.SubElement(parameter, f"{_SSV}{kind}", value=text)
        except ValueError as error:  # characters that XML does not have
            raise ConfigurationError(f"{where}: cannot be written as XML: {error}") from None
    return _text(root)


def _value(value: object, type_: VariableType, where: str) -> tuple[str, str]:
    """The SSV type and text of a start value."""
    if isinstance(value, bool):
        return "Boolean", "true" if value else "false"
    if isinstance(value, str):
        return "String", value
    if not isinstance(value, int | float):
        raise ConfigurationError(f"{where} = {value!r:.60}: SSP 1.0 has no such value")
    if not math.isfinite(value):
        raise ConfigurationError(f"{where} = {value}: is not a finite number")
    if isinstance(value, float) or _TYPES.get(type_) == "Real":
        return "Real", repr(float(value))
    if not _SMALLEST_INTEGER <= value <= _LARGEST_INTEGER:
        raise ConfigurationError(f"{where} = {value}: has more than 32 bits")
    return "Integer", str(value)


def _ends(
    system: System, number: int, descriptions: Mapping[str, SlaveDescription]
) -> tuple[tuple[str, str], tuple[str, str]]:
    connection = system.connections[number]
    where = f"{system.source}: [[connections]] number {number + 1}"
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
        if any(variable.name == name for variable in descriptions[slave].variables):
            return slave, name
    raise ConfigurationError(f"{where}: no slave has a variable of that name")


def _text(root: etree._Element) -> bytes:
    text: bytes = etree.tostring(root, encoding="UTF-8", xml_declaration=True, pretty_print=True)
    return text
