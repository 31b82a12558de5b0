"""SSP: what is not supported is named, and hostile packages are refused."""

from __future__ import annotations

import stat
import tomllib
import zipfile
from copy import deepcopy
from pathlib import Path
from random import Random

import pytest
from lxml import etree

from master_node.system.files import read_ssp
from master_node.system.ssp.flattening import flatten
from master_node.system.ssp.reading import read_structure
from master_node.system.ssp.structure import Notes
from protocol.errors import ConfigurationError, ModelError
from tests.support.ssp_documents import (
    ENTRIES,
    ENUMERATIONS,
    GEAR,
    INPUTS,
    MATRIX,
    MODE,
    NAMESPACES,
    NESTED,
    OUTPUTS,
    PASSED,
    UNITS,
    VECTOR,
    WHEEL,
    Packages,
    array,
    array_component,
    binding,
    bindings,
    bus_system,
    component,
    connection,
    connector,
    defined,
    described,
    dictionary,
    entry,
    enumeration,
    invoke,
    linear,
    parameter_set,
    real,
    ssd,
    system,
    table,
    through,
)


@pytest.fixture
def packages(tmp_path: Path, fmu_dir: Path) -> Packages:
    """A folder for packages."""
    return Packages(tmp_path, fmu_dir)


# ---- What is not supported is named -------------------------------------------------------------


@pytest.mark.parametrize(
    ("description", "told"),
    [
        (ssd(system(WHEEL), version="Draft20180219"), "version 'Draft20180219' is not known"),
        (ssd(system(WHEEL)).replace("SSP1", "SSP0"), "the root is"),
        (ssd("<ssd:Strange/>"), "ssd:Strange: is not supported in ssd:System"),
        (
            ssd(system(component("wheel", INPUTS, source='type="text/x-modelica" source="a.mo"'))),
            "of type 'text/x-modelica' is not supported",
        ),
        (ssd(system(component("wheel", INPUTS, source=" "))), "component 'wheel' has no source"),
        (
            ssd(system(component("wheel", INPUTS, source='source="resources/evil.py:Evil"'))),
            "leads outside the folder",
        ),
        (
            ssd(system(component("wheel", INPUTS, source='source="resources/evil.py"'))),
            "is not an .fmu file",
        ),
        (
            ssd(system(component("wheel", INPUTS, source='source="resources/gone.fmu"'))),
            "resources/gone.fmu: no such file",
        ),
        (
            ssd(system(component("wheel", INPUTS, source='source="../../wheel.fmu"'))),
            "leads outside the folder",
        ),
        (
            ssd(system(component("wheel", INPUTS, source='source="/etc/wheel.fmu"'))),
            "leads outside the folder",
        ),
        (
            ssd(system(component("wheel", INPUTS, source='source="%2e%2e/wheel.fmu"'))),
            "leads outside the folder",
        ),
        (
            ssd(system(component("wheel", INPUTS, source='source="http://a/wheel.fmu"'))),
            "is not a relative URI",
        ),
        (
            ssd(system(WHEEL.replace("<ssd:Component", '<ssd:Component implementation="X"'))),
            "implementation 'X' is not supported",
        ),
        (
            ssd(system(WHEEL + '<ssd:SignalDictionaryReference name="b" dictionary="d"/>')),
            "no signal dictionary 'd'",
        ),
        (
            ssd(system(component("wheel", connector("x_c", "sideways")))),
            "kind 'sideways' is not known",
        ),
    ],
)
def test_what_is_not_supported_is_refused_by_name(
    packages: Packages, description: str, told: str
) -> None:
    """With file and line; nothing is left out without a word."""
    refused = packages.refusal(description)
    assert told in refused
    assert "test.ssp/SystemStructure.ssd, line " in refused


MAPPED = (
    '<ssc:BooleanMappingTransformation><ssc:MapEntry source="true" target="false"/>'
    "</ssc:BooleanMappingTransformation>"
)

TWICE = '<ssc:MapEntry source="1" target="1"/><ssc:Map'

ENUMERATED = (
    '<ssc:EnumerationMappingTransformation><ssc:MapEntry source="a" target="b"/>'
    "</ssc:EnumerationMappingTransformation>"
)


@pytest.mark.parametrize(
    ("connections", "told"),
    [
        (
            connection("chassis.x", "wheel.x_c", ENUMERATED),
            "EnumerationMappingTransformation: connector 'x' has no item 'a'",
        ),
        (
            connection("chassis.x", "s.in", MAPPED),
            "a BooleanMappingTransformation and a LinearTransformation lie on the way",
        ),
        (
            connection("chassis.x", "wheel.x_c", MAPPED.replace("<ssc:Map", TWICE)),
            "the source True is there twice",
        ),
        (
            connection("chassis.x", "wheel.x_c", MAPPED.replace("ssc:MapEntry", "ssc:Strange")),
            "ssc:BooleanMappingTransformation: has no ssc:MapEntry",
        ),
        (connection("chassis.x", "chassis.v"), "has no direction"),
        (connection("chassis.x", "whel.x_c"), "no element 'whel'; did you mean 'wheel'?"),
        (connection("chassis.x", "wheel.x_d"), "no connector 'x_d'; did you mean 'x_c'?"),
        (
            connection("chassis.x", "wheel.x_c") + connection("chassis.v", "wheel.x_c"),
            "connector 'wheel.x_c' has two sources",
        ),
        (
            connection("chassis.x", "wheel.x_c", attributes='startIndices="1"'),
            "1 indices for connector 'x' of kind 'output', which has 0 dimensions",
        ),
        (
            connection("chassis.x", "wheel.array", attributes='endIndices="0"'),
            "endIndices: an index below 1",
        ),
        (
            connection("chassis.x", "wheel.array", attributes='endIndices="3"'),
            "has no index 3, only 2",
        ),
        (connection("chassis.x", "wheel.array"), "have different dimensions: one value and 2"),
        (connection("chassis.x", "wheel.clocked"), "cannot be connected: a clock"),
        (connection("wheel.any", "s.any"), "of kinds 'unspecified' and 'unspecified' has no dir"),
        (connection("chassis.k", "wheel.x_c"), "from kind 'constant' to kind 'input'"),
        (connection("chassis.x", "wheel.z"), "from kind 'output' to kind 'parameter'"),
        (
            connection("s.out", "s.in"),
            "leads through systems back to itself",
        ),
    ],
)
def test_connections_that_are_not_supported_are_refused_by_name(
    packages: Packages, connections: str, told: str
) -> None:
    """With file and line."""
    wheel = component(
        "wheel",
        INPUTS
        + connector("array", "input", inner='<ssc:Real/><ssc:Dimension size="2"/>')
        + connector("clocked", "input", inner='<ssc:Real/><ssc:Clock name="c"/>')
        + connector("any", "unspecified")
        + connector("z", "parameter"),
    )
    chassis = component("chassis", OUTPUTS + connector("k", "constant"))
    looped = (
        '<ssd:System name="s"><ssd:Connectors>'
        + connector("in", "input")
        + connector("out", "output")
        + connector("any", "unspecified")
        + "</ssd:Connectors><ssd:Elements>"
        + WHEEL
        + "</ssd:Elements><ssd:Connections>"
        + connection("in", "out")
        + connection("in", "wheel.x_c", linear(2, 1))
        + "</ssd:Connections></ssd:System>"
    )
    refused = packages.refusal(ssd(system(wheel + chassis + looped, connections)))
    assert told in refused
    assert "SystemStructure.ssd, line " in refused


@pytest.mark.parametrize(
    ("inner", "told"),
    [
        ('<ssd:ParameterBinding type="text/csv" source="a.csv"/>', "type 'text/csv'"),
        (
            '<ssd:ParameterBinding source="a.ssv" sourceBase="component"/>',
            "resources/wheel.fmu holds no 'a.ssv'",
        ),
        ('<ssd:ParameterBinding source="../a" sourceBase="component"/>', "leads outside"),
        ('<ssd:ParameterBinding source="a.ssv" sourceBase="metaData"/>', "'metaData' is not supp"),
        ('<ssd:ParameterBinding source="../a.ssv"/>', "leads outside"),
        ('<ssd:ParameterBinding source="a.ssv"/>', "a.ssv: cannot be read"),
        ("<ssd:ParameterBinding/>", "has neither a source nor an ssv:ParameterSet"),
        (binding(real("m", 1) + real("m", 2)), "'m' is there twice"),
        (binding(real("m", 1), entry("m", "z") + entry("m", "z")), "are mapped to 'z'"),
        (binding(real("m", 1), entry("m", "z", ENUMERATED)), "Enumeration"),
        (binding(real("m", 1), entry("m", "z", MAPPED)), "a BooleanMappingTransformation of 1.0"),
    ],
)
def test_bindings_that_are_not_supported_are_refused_by_name(
    packages: Packages, inner: str, told: str
) -> None:
    """With file and line."""
    refused = packages.refusal(ssd(system(component("wheel", INPUTS, bindings(inner)))))
    assert told in refused


def test_what_has_no_influence_is_noted_in_one_sentence(packages: Packages) -> None:
    """Geometry, other tools' annotations, descriptions, what a package holds beside."""
    geometry = '<ssd:ConnectorGeometry x="0" y="0.5"/>'
    wheel = component(
        "wheel",
        connector("x_c", "input", inner=f"<ssc:Real/>{geometry}")
        + connector("v_c", "input", inner=f"<ssc:Real/>{geometry}"),
    ).replace("<ssd:Component", '<ssd:Component strange="1" description="a wheel"')
    annotations = (
        '<ssd:Annotations><ssc:Annotation type="com.example"><x xmlns="urn:x"/></ssc:Annotation>'
        "</ssd:Annotations>"
    )
    variant = '<ssd:SSDVariant name="a" baseSSD="SystemStructure.ssd" kind="parameterVariant"/>'
    signed = '<ssc:MetaData kind="general" type="text/plain"/><ssc:Signature role="authenticity"/>'
    path = packages.write(ssd(system(wheel), signed + annotations + variant, version="2.0"))
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("extra/com.example/a.txt", "a")
        archive.writestr("Variant.ssd", "")
        archive.writestr("documentation/index.html", "")
    read = packages.read_file(path)
    *notes, last = read.notes
    assert last.endswith(
        "not carried, as it has no influence here: annotation com.example, "
        "ssd:ConnectorGeometry (2 times), description, ssc:MetaData, ssc:Signature, ssd:SSDVariant"
    )
    assert any("attribute 'strange' is not carried" in note for note in notes)
    assert any("entries that are not carried: 'extra/com.example/a.txt'" in note for note in notes)
    assert any("variants beside SystemStructure.ssd: 'Variant.ssd'" in note for note in notes)
    assert len(notes) == 3


def test_notes_are_shown_at_the_prompt(packages: Packages) -> None:
    """Both by a run and by an import."""
    values = bindings(binding(real("mass", 1)))
    path = packages.write(
        ssd(system(component("wheel", INPUTS, values)), '<ssd:DefaultExperiment stopTime="0.1"/>')
    )
    out = packages.folder / "r"
    told = invoke("run", path, "--in-process", "--quiet", "--no-plot", "--output", out)
    assert "has the name 'mass'" in told
    assert "has the name 'mass'" in invoke("import", path)
    assert tomllib.loads((packages.folder / "test.toml").read_text())["simulation"] == {
        "stop_time": 0.1
    }


# ---- Hostile packages ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["../evil", "resources/../../evil", "/evil", "C:/evil"])
def test_names_that_lead_outside_are_refused(packages: Packages, name: str) -> None:
    """By name, before anything is extracted."""
    path = packages.write(ssd(system(WHEEL)))
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(name, b"evil")
    scratch = packages.folder / "scratch"
    scratch.mkdir()
    with pytest.raises(ModelError, match="leads outside the archive"):
        read_ssp(path, scratch)
    assert list(scratch.iterdir()) == []


def test_links_and_bombs_are_refused(packages: Packages) -> None:
    """A link could lead a later entry anywhere; zeros could fill the disk."""
    path = packages.write(ssd(system(WHEEL)))
    link = zipfile.ZipInfo("resources/link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(link, "/etc")
    with pytest.raises(ModelError, match="is a symbolic link"):
        packages.read_file(path)
    with pytest.raises(ModelError, match="unpacks to 100000000 bytes"):
        packages.read(ssd(system(WHEEL)), zeros=bytes(100_000_000))


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]>'


def test_document_types_are_refused(packages: Packages) -> None:
    """In descriptions, parameter sets and mappings, whatever the encoding."""
    text = ssd(system(WHEEL))
    for encoding in ("utf-8", "utf-16", "iso-8859-1"):
        head = f'<?xml version="1.0" encoding="{encoding}"?>'
        refused = packages.refusal(f"{head}{BOMB}{text}".encode(encoding))
        assert "SystemStructure.ssd declares a document type" in refused
    by_file = bindings('<ssd:ParameterBinding source="resources/a.ssv"/>')
    text = ssd(system(component("wheel", INPUTS, by_file)))
    assert "a.ssv declares a document type" in packages.refusal(text, a__ssv=f"{BOMB}<x/>")
    mapped = by_file.replace("/>", '><ssd:ParameterMapping source="resources/a.ssm"/>', 1)
    mapped = mapped.replace(
        "</ssd:ParameterBindings>", "</ssd:ParameterBinding></ssd:ParameterBindings>"
    )
    values = parameter_set("").replace("<ssv:ParameterSet", f"<ssv:ParameterSet{NAMESPACES}")
    text = ssd(system(component("wheel", INPUTS, mapped)))
    refused = packages.refusal(text, a__ssv=values, a__ssm=f"{BOMB}<x/>")
    assert "a.ssm declares a document type" in refused
    text = ssd(system(WHEEL) + defined('source="resources/a.ssb">'))
    assert "a.ssb declares a document type" in packages.refusal(text, a__ssb=f"{BOMB}<x/>")


@pytest.mark.parametrize(
    ("source", "told"),
    [
        ("http://example.org/a", "is not a relative URI"),
        ("file:///etc/passwd", "is not a relative URI"),
        ("//example.org/a", "is not a relative URI"),
        ("/etc/passwd", "leads outside the folder"),
        ("resources/../../a", "leads outside the folder"),
        ("resources/%2e%2e/%2e%2e/a", "leads outside the folder"),
        ("resources\\..\\..\\a", "leads outside the folder"),
        ("C%3A/a", "leads outside the folder"),
    ],
)
@pytest.mark.parametrize(
    "place", ["component", "package", "description", "values", "mapping", "dictionary"]
)
def test_sources_that_lead_elsewhere_are_refused(
    packages: Packages, place: str, source: str, told: str
) -> None:
    """Wherever a document may name a file: nothing is fetched, nothing read beside the package."""
    named = f'source="{source}"'
    kinds = {"package": "application/x-ssp-package", "description": "application/x-ssp-definition"}
    before = after = ""
    if place == "values":
        before = bindings(f"<ssd:ParameterBinding {named}/>")
    elif place == "mapping":
        text = binding("", entry("a", "b"))
        start, end = text.index("<ssd:ParameterMapping>"), text.index("</ssd:ParameterBinding>")
        before = bindings(f"{text[:start]}<ssd:ParameterMapping {named}/>{text[end:]}")
    elif place == "dictionary":
        after = defined(f"{named}>")
    type_ = f'type="{kinds[place]}" ' if place in kinds else ""
    own = f"{type_}{named}" if place in ("component", *kinds) else ""
    text = ssd(system(component("wheel", INPUTS, source=own), before=before) + after)
    assert told in packages.refusal(text)


def test_arrays_without_end_are_refused(
    packages: Packages, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few lines could stand for more connections than there is memory."""
    monkeypatch.setattr("master_node.system.ssp.graph.MAX_EDGES", 100)
    large = '<ssc:Float64/><ssc:Dimension size="100000"/>'
    parts = component("chassis", connector("x", "output", inner=large) + connector("v", "output"))
    parts += component("wheel", connector("x_c", "input", inner=large))
    links = connection("chassis.v", "wheel.x_c", attributes='endIndices="1"')
    inside = (
        f'<ssd:System name="s">{system(parts, connection("chassis.x", "wheel.x_c"))}</ssd:System>'
    )
    refused = packages.refusal(ssd(system(parts + inside, links), version="2.0"))
    assert "more than 100 connections" in refused


def every_element() -> list[str]:
    """Descriptions that use all that can be read."""
    values = binding(
        enumeration("gear", "low") + array("counts", "Int16", "1 2 3", 3) + real("mass", 2, "mm"),
        entry("counts", "vector_in", table("Integer", _1=7))
        + entry("gear", "enumeration_in", table("Enumeration", low="high"))
        + entry("mass", "float64_in", linear(3, 1)),
        after=ENUMERATIONS + UNITS.replace("ssd:", "ssv:"),
    )
    outs = connector("float64_out", "output") + connector("matrix_out", "output", inner=MATRIX)
    inside = (
        '<ssd:System name="s">'
        + system(
            array_component("b", connector("vector_in", "input", inner=VECTOR)),
            connection("v", "b.vector_in", linear(2, 1)),
            f"<ssd:Connectors>{connector('v', 'input', inner=VECTOR)}</ssd:Connectors>"
            + bindings(binding(array("v", "Real", "1 2 3", 3))),
        )
        + "</ssd:System>"
    )
    links = connection("a.float64_out", "s.v", attributes='endIndices="2"')
    links += connection("a.matrix_out", "s.v", "", 'startIndices="2 3" endIndices="3"')
    elements = ssd(system(array_component("a", outs, bindings(values)) + inside, links))
    shared = bus_system(defined(f">{dictionary(ENTRIES, UNITS.replace('ssd:', 'ssb:'))}"))
    mapped = through(table("Enumeration", low="high"), table("Integer", _2=7), GEAR, MODE)
    return [NESTED, elements, shared, mapped]


WORDS = (
    *("", " ", "1", "2", "-1", "1 2", "1 2 3", "1e400", "nan", "9" * 23, "1.0", "2.0", "true"),
    *("input", "output", "inout", "unspecified", "parameter", "s", "a", "v", "x_c", "bus", "gear"),
    *("m", "mm", "kg", "[1]", "v[1]", "#s", ".", "low", "resources/wheel.fmu"),
)


def mutated(random: Random, description: str) -> bytes:
    """A description in which a few attributes and elements are changed, moved or left out."""
    root = etree.fromstring(description.encode())
    for _ in range(random.randint(1, 4)):
        elements = list(root.iter())
        element, other = random.choice(elements[1:]), random.choice(elements[1:])
        parent = element.getparent()
        match random.choice(("set", "set", "set", "drop", "remove", "repeat", "nest")):
            case "set" if element.attrib:
                element.set(random.choice(list(element.attrib)), random.choice(WORDS))
            case "drop" if element.attrib:
                del element.attrib[random.choice(list(element.attrib))]
            case "remove" if parent is not None:
                parent.remove(element)
            case "repeat" if parent is not None:
                parent.append(deepcopy(element))
            case "nest":
                element.append(deepcopy(other))
    return etree.tostring(root)


def test_damaged_descriptions_are_read_or_refused(tmp_path: Path, capability_dir: Path) -> None:
    """Law: whatever a document says, reading it ends, and with no other error than our own."""
    random, outcomes = Random(3), {"read": 0, "refused": 0}
    (tmp_path / "resources").mkdir()
    for name in ("wheel", "chassis", "all_types3"):
        (tmp_path / "resources" / f"{name}.fmu").touch()
    path = tmp_path / "damaged.ssd"
    descriptions = every_element()
    for description in descriptions:
        path.write_text(description, encoding="utf-8")
        assert outcome(path, capability_dir) == "read"
    for _ in range(500):
        path.write_bytes(mutated(random, random.choice(descriptions)))
        outcomes[outcome(path, capability_dir)] += 1
    assert min(outcomes.values()) > 25, outcomes


def outcome(path: Path, models: Path) -> str:
    """``read`` or ``refused``: outcome of a description whose components are FMUs of all types."""
    notes = Notes(str(path))
    try:
        structure = read_structure(path, path.parent, notes)
        flatten(structure.system, lambda _: described(models / "all_types3.fmu"), notes)
    except ConfigurationError:
        return "refused"
    assert all(notes.sentences())
    return "read"


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 but not more", b"<x/>"])
def test_what_is_no_package_is_refused(packages: Packages, content: bytes) -> None:
    """With what to do."""
    path = packages.folder / "broken.ssp"
    path.write_bytes(content)
    with pytest.raises(ModelError, match=r"broken\.ssp: not a readable SSP archive"):
        packages.read_file(path)
    with pytest.raises(ModelError, match="no such file"):
        packages.read_file(packages.folder / "gone.ssp")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.txt", "")
    with pytest.raises(ModelError, match=r"holds no SystemStructure\.ssd"):
        packages.read_file(path)


def test_a_package_without_end_is_refused(packages: Packages) -> None:
    """Packages in packages are extracted to a bounded depth and number."""
    source = 'type="application/x-ssp-package" source="resources/sub.ssp"'
    text = ssd(system("".join(component(n, PASSED, source=source) for n in "ab")))
    path = packages.write(ssd(system(WHEEL)), "p0.ssp")
    for depth in range(1, 8):
        path = packages.write(text, f"p{depth}.ssp", sub__ssp=path)
    with pytest.raises(ConfigurationError, match="more than 100 packages"):
        packages.read_file(path)
