"""Documents of SSP in pieces, and packages of them with the FMUs of the quarter car."""

from __future__ import annotations

import zipfile
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import fmpy.ssp.ssd
import pytest
from typer.testing import CliRunner

from master_node import System
from master_node.cli.app import app
from master_node.system.files import ImportedSystem, read_ssp
from protocol.description import SlaveDescription
from protocol.errors import ConfigurationError

SCHEMAS = Path(fmpy.ssp.__file__).parent / "schema"

NAMESPACES = "".join(
    f' xmlns:{prefix}="http://ssp-standard.org/SSP1/SystemStructure{name}"'
    for prefix, name in (
        ("ssc", "Common"),
        ("ssd", "Description"),
        ("ssv", "ParameterValues"),
        ("ssm", "ParameterMapping"),
        ("ssb", "SignalDictionary"),
    )
)

UNITS = (
    '<ssd:Units><ssc:Unit name="m"><ssc:BaseUnit m="1"/></ssc:Unit>'
    '<ssc:Unit name="mm"><ssc:BaseUnit m="1" factor="0.001"/></ssc:Unit>'
    '<ssc:Unit name="kg"><ssc:BaseUnit kg="1"/></ssc:Unit></ssd:Units>'
)

DIRECT = [
    ("chassis.x", "wheel.x_c"),
    ("chassis.v", "wheel.v_c"),
    ("wheel.x", "chassis.x_w"),
    ("wheel.v", "chassis.v_w"),
]


def ssd(system: str, after: str = UNITS, version: str = "1.0") -> str:
    """A description around what is in its root system."""
    return (
        f'<ssd:SystemStructureDescription{NAMESPACES} version="{version}" name="test">\n'
        f'<ssd:System name="root">\n{system}\n</ssd:System>\n{after}\n'
        "</ssd:SystemStructureDescription>"
    )


def connector(name: str, kind: str, unit: str = "", inner: str = "") -> str:
    """A connector of type Real, or with what is given."""
    attribute = f' unit="{unit}"' if unit else ""
    return (
        f'<ssd:Connector name="{name}" kind="{kind}">'
        f"{inner or f'<ssc:Real{attribute}/>'}</ssd:Connector>"
    )


def component(name: str, connectors: str, bindings: str = "", source: str = "") -> str:
    """A component; its FMU is the one of its name, if no other is given."""
    source = source or f'source="resources/{name}.fmu"'
    return (
        f'<ssd:Component name="{name}" {source}>'
        f"<ssd:Connectors>{connectors}</ssd:Connectors>{bindings}</ssd:Component>"
    )


def connection(start: str, end: str, inner: str = "", attributes: str = "") -> str:
    """A connection between ``element.connector``; a connector alone is one of the system."""
    ends = ""
    for which, reference in (("start", start), ("end", end)):
        element, _, name = reference.rpartition(".")
        if element:
            ends += f' {which}Element="{element}"'
        ends += f' {which}Connector="{name}"'
    return f"<ssd:Connection{ends} {attributes}>{inner}</ssd:Connection>"


def system(elements: str, connections: str = "", before: str = "") -> str:
    """Content of a system; ``before``: its connectors and parameter bindings."""
    return (
        f"{before}<ssd:Elements>{elements}</ssd:Elements>"
        f"<ssd:Connections>{connections}</ssd:Connections>"
    )


def binding(parameters: str, mapping: str = "", attributes: str = "", after: str = "") -> str:
    """An inline parameter binding."""
    entries = (
        f'<ssd:ParameterMapping><ssm:ParameterMapping version="1.0">{mapping}'
        "</ssm:ParameterMapping></ssd:ParameterMapping>"
        if mapping
        else ""
    )
    return (
        f"<ssd:ParameterBinding {attributes}><ssd:ParameterValues>"
        f"{parameter_set(parameters, after)}</ssd:ParameterValues>{entries}</ssd:ParameterBinding>"
    )


def parameter_set(parameters: str, after: str = "") -> str:
    """A parameter set without namespaces, which the description has."""
    return (
        f'<ssv:ParameterSet version="1.0" name="p"><ssv:Parameters>{parameters}</ssv:Parameters>'
        f"{after}</ssv:ParameterSet>"
    )


def real(name: str, value: float | str, unit: str = "") -> str:
    """A parameter of type Real."""
    attribute = f' unit="{unit}"' if unit else ""
    return f'<ssv:Parameter name="{name}"><ssv:Real value="{value}"{attribute}/></ssv:Parameter>'


def bindings(*each: str) -> str:
    """The bindings of an element."""
    return f"<ssd:ParameterBindings>{''.join(each)}</ssd:ParameterBindings>"


def linear(factor: float, offset: float) -> str:
    """A linear transformation."""
    return f'<ssc:LinearTransformation factor="{factor}" offset="{offset}"/>'


INPUTS = connector("x_c", "input") + connector("v_c", "input")

WHEEL = component("wheel", INPUTS)

OUTPUTS = connector("x", "output") + connector("v", "output")

CHASSIS = component("chassis", OUTPUTS)


class Packages:
    """Packages with the FMUs of the quarter car, and how they are read."""

    def __init__(self, folder: Path, fmus: Path) -> None:
        self.folder = folder
        self.fmus = fmus

    def write(
        self, description: str | bytes, name: str = "test.ssp", **files: str | bytes | Path
    ) -> Path:
        """A package; two underscores in a name stand for a dot."""
        path = self.folder / name
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("SystemStructure.ssd", description)
            for model in ("chassis", "wheel"):
                archive.write(self.fmus / f"{model}.fmu", f"resources/{model}.fmu")
            for file, content in files.items():
                entry = f"resources/{file.replace('__', '.')}"
                if isinstance(content, Path):
                    archive.write(content, entry)
                else:
                    archive.writestr(entry, content)
        return path

    def read(self, description: str | bytes, **files: str | bytes | Path) -> ImportedSystem:
        """System read from a package."""
        return self.read_file(self.write(description, **files))

    def read_file(self, path: Path, *, package_bus: bool = False) -> ImportedSystem:
        """System read from a file."""
        scratch = self.folder / f"scratch-{len(list(self.folder.iterdir()))}"
        scratch.mkdir()
        return read_ssp(path, scratch, package_bus=package_bus)

    def refusal(self, description: str | bytes, **files: str | bytes | Path) -> str:
        """Why it is refused."""
        with pytest.raises(ConfigurationError) as caught:
            self.read(description, **files)
        return str(caught.value)


def tables(read: System) -> dict[str, Any]:
    """Settings of a system, without the places of its models."""
    dumped = read.model_dump()
    for table in dumped["slaves"].values():
        table["model"] = Path(table["model"]).name
    return dumped


def pairs(read: System) -> list[tuple[str, str]]:
    """The connections, without transformations."""
    return [(c.source, c.target) for c in read.connections]


def invoke(*arguments: object) -> str:
    """Run the command line; what it printed and logged."""
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


@cache
def described(model: Path) -> SlaveDescription:
    """Description of a model."""
    description: SlaveDescription = entry_points(group="doublestep.in_process")["describe"].load()(
        str(model), Path()
    )
    return description


# ---- Nested systems and transformations ---------------------------------------------------------

WHOLE_WHEEL = component("wheel", INPUTS + OUTPUTS)

WHOLE_CHASSIS = component(
    "chassis", OUTPUTS + connector("x_w", "input") + connector("v_w", "input")
)

PASSED = "".join(
    connector(name, kind)
    for name, kind in (("a", "input"), ("b", "input"), ("c", "output"), ("d", "output"))
)


def passing(name: str, inner: str, ports: tuple[str, str, str, str]) -> str:
    """A system whose connectors a to d pass the signals of one element on.

    Start and end of two of the connections stand against the signal, which SSP allows.
    """
    a, b, c, d = ports
    connections = connection("a", a) + connection(b, "b") + connection(c, "c") + connection("d", d)
    connectors = f"<ssd:Connectors>{PASSED}</ssd:Connectors>"
    return f'<ssd:System name="{name}">{system(inner, connections, connectors)}</ssd:System>'


INNER = passing("inner", WHOLE_WHEEL, ("wheel.x_c", "wheel.v_c", "wheel.x", "wheel.v"))

OUTER = passing("outer", INNER, ("inner.a", "inner.b", "inner.c", "inner.d"))

NESTED = ssd(
    system(
        WHOLE_CHASSIS + OUTER,
        connection("chassis.x", "outer.a")
        + connection("chassis.v", "outer.b")
        + connection("outer.c", "chassis.x_w")
        + connection("outer.d", "chassis.v_w"),
    )
)

SUPPRESSED = 'suppressUnitConversion="true"'


# ---- Mappings of connections, arrays, binaries --------------------------------------------------


def table(kind: str, **entries: object) -> str:
    """A mapping transformation; a name that begins with _ stands for what is behind it."""
    rows = "".join(
        f'<ssc:MapEntry source="{source.removeprefix("_")}" target="{target}"/>'
        for source, target in entries.items()
    )
    return f"<ssc:{kind}MappingTransformation>{rows}</ssc:{kind}MappingTransformation>"


def through(first: str, second: str, inner: str, target_inner: str = "") -> str:
    """chassis.x to a system and on to wheel.x_c, with a transformation each."""
    inside = (
        '<ssd:System name="s">'
        + system(
            component("wheel", connector("x_c", "input", inner=target_inner or inner)),
            connection("a", "wheel.x_c", second),
            f"<ssd:Connectors>{connector('a', 'input', inner=inner)}</ssd:Connectors>",
        )
        + "</ssd:System>"
    )
    source = component("chassis", connector("x", "output", inner=inner))
    enumerations = "".join(
        f'<ssc:Enumeration name="{name}">'
        + "".join(f'<ssc:Item name="{i}" value="{v}"/>' for i, v in items.items())
        + "</ssc:Enumeration>"
        for name, items in (("gear", {"low": 1, "high": 2}), ("mode", {"slow": 7, "fast": 9}))
    )
    return ssd(
        system(source + inside, connection("chassis.x", "s.a", first)),
        f"<ssd:Enumerations>{enumerations}</ssd:Enumerations>",
    )


GEAR, MODE = ('<ssc:Enumeration name="%s"/>' % name for name in ("gear", "mode"))  # noqa: UP031

VECTOR = '<ssc:Float64/><ssc:Dimension size="3"/>'

MATRIX = '<ssc:Float64/><ssc:Dimension size="2"/><ssc:Dimension size="3"/>'


def array_component(name: str, connectors: str, values: str = "") -> str:
    """A component with the FMU of all types of FMI 3.0."""
    return component(name, connectors, values, 'source="resources/all_types3.fmu"')


def array(name: str, kind: str, texts: str, *sizes: int) -> str:
    """A parameter that is an array of numbers."""
    dimensions = "".join(f'<ssc:Dimension size="{size}"/>' for size in sizes)
    return f'<ssv:Parameter name="{name}"><ssv:{kind} value="{texts}"/>{dimensions}</ssv:Parameter>'


# ---- Signal dictionaries ------------------------------------------------------------------------


def dictionary(entries: str, after: str = "") -> str:
    """A signal dictionary."""
    return f'<ssb:SignalDictionary version="1.0">{entries}{after}</ssb:SignalDictionary>'


def signal(name: str, unit: str = "") -> str:
    """An entry of a dictionary."""
    attribute = f' unit="{unit}"' if unit else ""
    return f'<ssb:DictionaryEntry name="{name}"><ssc:Real{attribute}/></ssb:DictionaryEntry>'


def defined(inner: str) -> str:
    """The dictionaries of a system."""
    return (
        '<ssd:SignalDictionaries><ssd:SignalDictionary name="bus" '
        f"{inner}</ssd:SignalDictionary></ssd:SignalDictionaries>"
    )


def reference(name: str, *connectors: str, more: str = "") -> str:
    """A reference to the dictionary."""
    inner = f"<ssd:Connectors>{''.join(connectors)}</ssd:Connectors>{more}" if connectors else more
    return (
        f'<ssd:SignalDictionaryReference name="{name}" dictionary="bus">{inner}'
        "</ssd:SignalDictionaryReference>"
    )


def bus_system(dictionaries: str) -> str:
    """The quarter car, whose signals go over the entries of a dictionary of the root system."""
    names = ("x", "v", "x_w", "v_w")
    outer = reference("r", *(connector(name, "inout") for name in names))
    inner = reference(
        "r",
        *(connector(name, "output") for name in names[:2]),
        *(connector(name, "input") for name in names[2:]),
    )
    axle = (
        '<ssd:System name="axle">'
        + system(
            WHOLE_WHEEL + inner,
            connection("r.x", "wheel.x_c")
            + connection("wheel.v_c", "r.v")
            + connection("wheel.x", "r.x_w")
            + connection("r.v_w", "wheel.v"),
        )
        + "</ssd:System>"
    )
    links = "".join(connection(f"chassis.{name}", f"r.{name}") for name in names)
    return ssd(system(WHOLE_CHASSIS + outer + axle, links) + dictionaries)


ENTRIES = "".join(signal(name) for name in ("x", "v", "x_w", "v_w"))


def entry(source: str, target: str, inner: str = "") -> str:
    """A mapping entry."""
    return f'<ssm:MappingEntry source="{source}" target="{target}">{inner}</ssm:MappingEntry>'


def enumeration(name: str, item: str, type_: str = "gear") -> str:
    """A parameter of an enumeration."""
    return (
        f'<ssv:Parameter name="{name}"><ssv:Enumeration value="{item}" name="{type_}"/>'
        "</ssv:Parameter>"
    )


ENUMERATIONS = (
    '<ssv:Enumerations><ssc:Enumeration name="gear"><ssc:Item name="low" value="1"/>'
    '<ssc:Item name="high" value="2"/></ssc:Enumeration></ssv:Enumerations>'
)
