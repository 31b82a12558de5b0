"""SSP: parameter sets and mappings, on their way to the variables of components."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import pytest

from protocol.errors import ConfigurationError
from tests.support.ssp_documents import (
    ENUMERATIONS,
    INPUTS,
    MODE,
    NAMESPACES,
    SUPPRESSED,
    UNITS,
    Packages,
    array,
    array_component,
    binding,
    bindings,
    component,
    connection,
    connector,
    entry,
    enumeration,
    linear,
    parameter_set,
    real,
    ssd,
    system,
    table,
)


@pytest.fixture
def packages(tmp_path: Path, fmu_dir: Path) -> Packages:
    """A folder for packages."""
    return Packages(tmp_path, fmu_dir)


# ---- Parameters ---------------------------------------------------------------------------------


def test_parameters_by_name_prefix_and_level(packages: Packages) -> None:
    """Files and inline, on components and systems: the outermost and the last one win."""
    inner = component(
        "wheel",
        INPUTS + connector("z", "parameter"),
        bindings(binding(real("m", 1) + real("k_w", 1) + real("x", 1) + real("v", 1))),
    )
    road = "<ssd:Connectors>" + connector("road", "parameter") + "</ssd:Connectors>"
    axle = (
        '<ssd:System name="axle">'
        + system(
            inner,
            connection("road", "wheel.z"),
            road
            + bindings(
                binding(real("wheel.k_w", 2) + real("wheel.x", 2) + real("wheel.v", 2)),
                binding(real("x", 3) + real("v", 3), attributes='prefix="wheel."'),
            ),
        )
        + "</ssd:System>"
    )
    root = bindings(
        '<ssd:ParameterBinding source="resources/a.ssv" prefix="axle."/>',
    )
    values = parameter_set(real("wheel.v", 4) + real("road", 0.25)).replace(
        "<ssv:ParameterSet", f"<ssv:ParameterSet{NAMESPACES}"
    )
    read = packages.read(ssd(system(axle, before=root)), a__ssv=values)
    assert read.system.slaves["axle.wheel"].parameters == {
        "m": 1.0,
        "k_w": 2.0,
        "x": 3.0,
        "v": 4.0,
        "z": 0.25,
    }
    assert read.notes == ()


def test_parameters_inside_an_fmu(packages: Packages, fmu_dir: Path) -> None:
    """A set and a mapping that the component brings with it."""
    values = parameter_set(real("mass", 7)).replace(
        "<ssv:ParameterSet", f"<ssv:ParameterSet{NAMESPACES}"
    )
    mapping = (
        f'<ssm:ParameterMapping{NAMESPACES} version="1.0">{entry("mass", "m")}'
        "</ssm:ParameterMapping>"
    )
    model = packages.folder / "with_parameters.fmu"
    model.write_bytes((fmu_dir / "wheel.fmu").read_bytes())
    with zipfile.ZipFile(model, "a") as archive:
        archive.writestr("resources/a.ssv", values)
        archive.writestr("extra/a.ssm", mapping)
    inside = (
        '<ssd:ParameterBinding source="resources/a.ssv" sourceBase="component">'
        '<ssd:ParameterMapping source="extra/a.ssm" sourceBase="component"/>'
        "</ssd:ParameterBinding>"
    )
    source = 'source="resources/with_parameters.fmu"'
    text = ssd(system(component("wheel", INPUTS, bindings(inside), source)))
    read = packages.read(text, with_parameters__fmu=model)
    assert read.system.slaves["wheel"].parameters == {"m": 7.0}
    assert read.notes == ()


def test_parameters_are_mapped_and_transformed(packages: Packages) -> None:
    """Only what is mapped is applied, one source to several targets."""
    mapping = (
        entry("mass", "m", linear(1000, 5))
        + entry("mass", "k_w")
        + entry("gone", "c")
        + entry(
            "flag",
            "z",
            '<ssc:IntegerMappingTransformation><ssc:MapEntry source="1" '
            'target="7"/></ssc:IntegerMappingTransformation>',
        )
    )
    values = (
        real("mass", 0.04)
        + '<ssv:Parameter name="flag"><ssv:Integer value="1"/></ssv:Parameter>'
        + real("other", 1)
    )
    text = ssd(system(component("wheel", INPUTS, bindings(binding(values, mapping)))))
    read = packages.read(text)
    assert read.system.slaves["wheel"].parameters == {"m": 45.0, "k_w": 0.04, "z": 7}
    assert "no parameter 'gone' is there to be mapped" in read.notes[0]
    assert "not mapped, so not applied: 'other'" in read.notes[1]
    file = (
        f'<ssm:ParameterMapping{NAMESPACES} version="2.0">{entry("mass", "m")}'
        "</ssm:ParameterMapping>"
    )
    inline = binding(values, entry("mass", "m"))
    start, end = inline.index("<ssd:ParameterMapping>"), inline.index("</ssd:ParameterBinding>")
    by_file = inline[:start] + '<ssd:ParameterMapping source="resources/m.ssm"/>' + inline[end:]
    read = packages.read(ssd(system(component("wheel", INPUTS, bindings(by_file)))), m__ssm=file)
    assert read.system.slaves["wheel"].parameters == {"m": 0.04}


def test_all_transformations_of_parameters(packages: Packages, capability_dir: Path) -> None:
    """Each for its type; what has no entry stays as it is, and elements of arrays are mapped."""
    values = (
        '<ssv:Parameter name="flag"><ssv:Boolean value="true"/></ssv:Parameter>'
        + array("counts", "Int16", "1 2 3", 3)
        + enumeration("gear", "low")
        + real("mass", 2)
    )
    mapping = (
        entry("flag", "boolean_in", table("Boolean", true="false"))
        + entry("counts", "vector_in", table("Integer", _1=7))
        + entry("gear", "enumeration_in", table("Enumeration", low="high", high="low"))
        + entry("gear", "int8_in", table("Integer", _1=5))
        + entry("gear", "uint8_in")
        + entry("mass", "float64_in", linear(3, 1))
    )
    text = binding(values, mapping, after=ENUMERATIONS)
    read = packages.read(
        ssd(system(array_component("a", connector("float64_in", "input"), bindings(text)))),
        all_types3__fmu=capability_dir / "all_types3.fmu",
    )
    assert read.system.slaves["a"].parameters == {
        "boolean_in": False,
        "vector_in": (7, 2, 3),
        "enumeration_in": 2,
        "int8_in": 5,
        "uint8_in": 1,
        "float64_in": 7.0,
    }
    assert read.notes == ()


def test_items_get_the_numbers_of_the_connector(packages: Packages, capability_dir: Path) -> None:
    """Where the component says which enumeration its variable has, that counts."""
    text = binding(enumeration("enumeration_in", "high"), after=ENUMERATIONS)
    text = ssd(
        system(
            array_component("a", connector("enumeration_in", "input", inner=MODE), bindings(text))
        ),
        '<ssd:Enumerations><ssc:Enumeration name="mode"><ssc:Item name="high" value="3"/>'
        "</ssc:Enumeration></ssd:Enumerations>",
    )
    fmu = {"all_types3__fmu": capability_dir / "all_types3.fmu"}
    read = packages.read(text, **fmu)
    assert read.system.slaves["a"].parameters == {"enumeration_in": 3}
    refused = packages.refusal(text.replace('value="high"', 'value="odd"'), **fmu)
    assert "Enumeration item 'odd' has no number" in refused


def test_units_of_parameters_are_converted(packages: Packages) -> None:
    """To the unit of the variable, before a linear transformation, unless that is suppressed."""
    units = (
        '<ssv:Units><ssc:Unit name="g"><ssc:BaseUnit kg="1" factor="0.001"/></ssc:Unit>'
        '<ssc:Unit name="m"><ssc:BaseUnit m="1"/></ssc:Unit></ssv:Units>'
    )

    def mass(mapping: str) -> Any:
        text = binding(real("mass", 500, "g"), mapping, after=units)
        read = packages.read(ssd(system(component("wheel", INPUTS, bindings(text)))))
        assert read.notes == ()
        return read.system.slaves["wheel"].parameters["m"]

    assert mass(entry("mass", "m")) == pytest.approx(0.5)
    assert mass(entry("mass", "m", linear(2, 1))) == pytest.approx(2.0)
    suppressed = entry("mass", "m", linear(2, 1)).replace(" target", f" {SUPPRESSED} target")
    assert mass(suppressed) == 1001.0
    with pytest.raises(ConfigurationError, match="unit 'g' cannot be converted to 'm'"):
        mass(entry("mass", "x"))


def test_parameters_pass_connectors_with_their_transformations(packages: Packages) -> None:
    """A value for a connector reaches every variable behind it, converted and transformed."""
    inside = (
        '<ssd:System name="axle"><ssd:Connectors>'
        + connector("height", "parameter", "mm")
        + connector("push", "input")
        + "</ssd:Connectors><ssd:Elements>"
        + component("wheel", connector("z", "parameter", "m") + INPUTS)
        + "</ssd:Elements><ssd:Connections>"
        + connection("height", "wheel.z", linear(2, 1))
        + connection("push", "wheel.x_c")
        + "</ssd:Connections></ssd:System>"
    )
    outside = (
        "<ssd:Connectors>"
        + connector("push", "input")
        + connector("free", "input")
        + "</ssd:Connectors>"
        + bindings(binding(real("axle.height", 100, "mm") + real("push", 0.5)))
    )
    read = packages.read(
        ssd(system(inside, connection("push", "axle.push"), outside)).replace(
            "</ssv:Parameters>",
            '</ssv:Parameters><ssv:Units><ssc:Unit name="mm"><ssc:BaseUnit '
            'm="1" factor="0.001"/></ssc:Unit></ssv:Units>',
        )
    )
    parameters = read.system.slaves["axle.wheel"].parameters
    assert parameters == {"z": pytest.approx(1.2), "x_c": 0.5}
    assert read.notes == ()


def test_what_does_not_fit_is_noted(packages: Packages) -> None:
    """Names that nothing has, another unit, and inputs of the whole system."""
    values = real("m", 40000, "g") + real("mass", 1)
    whole = "<ssd:Connectors>" + connector("u", "input") + "</ssd:Connectors>"
    read = packages.read(
        ssd(
            system(
                component("wheel", INPUTS, bindings(binding(values))),
                connection("u", "wheel.x_c"),
                whole,
            )
        )
    )
    assert read.system.slaves["wheel"].parameters == {"m": 40000.0}
    assert "wheel.m has the unit 'g', which is not converted to its unit 'kg'" in read.notes[0]
    assert "no variable of 'wheel' has the name 'mass'; not applied" in read.notes[1]
    assert "inputs of the whole system 'u': nothing drives them" in read.notes[2]
    assert read.system.connections == ()


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ('<ssv:Float32 value=" 2.5 "/>', 2.5),
        ('<ssv:UInt16 value="7"/>', 7),
        ('<ssv:Boolean value="1"/>', True),
        ('<ssv:String value="a b"/>', "a b"),
        ("<ssv:String><ssv:Value>a</ssv:Value></ssv:String>", "a"),
        ('<ssv:Enumeration value="on" name="switch"/>', 3),
    ],
)
def test_types_of_values(packages: Packages, value: str, expected: object) -> None:
    """Those of SSP 1.0 and 2.0, with their types."""
    after = (
        '<ssv:Enumerations><ssc:Enumeration name="switch"><ssc:Item name="on" value="3"/>'
        "</ssc:Enumeration></ssv:Enumerations>"
    )
    text = binding(f'<ssv:Parameter name="m">{value}</ssv:Parameter>', after=after)
    read = packages.read(ssd(system(component("wheel", INPUTS, bindings(text)))))
    given_value = read.system.slaves["wheel"].parameters["m"]
    assert given_value == expected
    assert type(given_value) is type(expected)


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ('<ssv:Real value="NaN"/>', "'NaN' is not a finite number"),
        ('<ssv:Real value="INF"/>', "'INF' is not a finite number"),
        ('<ssv:Real value="1_0"/>', "'1_0' is not a finite number"),
        ('<ssv:Real value=""/>', "'value' is missing"),
        ('<ssv:Integer value="1.5"/>', "'1.5' is not a whole number"),
        ('<ssv:Boolean value="yes"/>', "'yes' is neither true nor false"),
        ('<ssv:Binary value="00"/>', "a Binary for wheel.m, which is of type Real"),
        ('<ssv:Binary value="0"/>', "value = '0' is not hexadecimal"),
        ('<ssv:Enumeration value="on"/>', "Enumeration item 'on' has no number"),
        ('<ssv:Real value="1 2"/><ssc:Dimension size="2"/>', "an array for wheel.m"),
        ('<ssv:Real value="1 2"/>', "has 2 values in place of one value"),
        ('<ssv:Real value="1 2 3"/><ssc:Dimension size="2"/>', "has 3 values in place of 2"),
        ('<ssv:Real value="1 2"/><ssc:Dimension/>', "needs a size"),
        ('<ssv:Real value="1"/><ssc:Dimension size="0"/>', "an array of size 0"),
        ('<ssv:Real value="1"/><ssc:Dimension size="100001"/>', "1 to 100000 elements"),
        (
            '<ssv:Real value="1"/><ssc:Dimension size="1" sizeConnector="n"/>',
            "has both size and sizeConnector",
        ),
        ('<ssv:Real value="1" unit="mm"/>', "unit 'mm' cannot be converted to 'kg'"),
        ('<ssv:Real value="1"/><ssv:Integer value="1"/>', "needs one element"),
        ('<ssv:Complex value="1"/>', "needs one element"),
    ],
)
def test_values_that_cannot_be_used_are_named(packages: Packages, value: str, told: str) -> None:
    """With file and line."""
    units = UNITS.replace("ssd:", "ssv:")
    text = binding(f'<ssv:Parameter name="m">{value}</ssv:Parameter>', after=units)
    refused = packages.refusal(ssd(system(component("wheel", INPUTS, bindings(text)))))
    assert told in refused
    assert "SystemStructure.ssd, line 3" in refused
