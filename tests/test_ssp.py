"""SSP: what is read of a package, that it runs, and that nothing in it is dropped silently."""

from __future__ import annotations

import stat
import tomllib
import zipfile
from copy import deepcopy
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from random import Random
from typing import Any

import fmpy.ssp.ssd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lxml import etree
from typer.testing import CliRunner

from master_node import System, load_system, open_system, simulate
from master_node.cli import app
from master_node.ssp.flattening import flatten
from master_node.ssp.reading import read_structure
from master_node.ssp.structure import Linear, Notes, Table, Unit
from master_node.ssp.writing import write_package
from master_node.system_files import ImportedSystem, export_system, import_system, read_ssp
from protocol.errors import ConfigurationError, ModelError
from protocol.slave import SlaveDescription
from tests.quarter_car_case import EXAMPLES

pytestmark = pytest.mark.timeout(300)  # the first one pays for the build of the FMUs

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
    """What is in a system; ``before``: its connectors and parameter bindings."""
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
        """What is read of a package."""
        return self.read_file(self.write(description, **files))

    def read_file(self, path: Path) -> ImportedSystem:
        """What is read of a file."""
        scratch = self.folder / f"scratch-{len(list(self.folder.iterdir()))}"
        scratch.mkdir()
        return read_ssp(path, scratch)

    def refusal(self, description: str | bytes, **files: str | bytes | Path) -> str:
        """Why it is refused."""
        with pytest.raises(ConfigurationError) as caught:
            self.read(description, **files)
        return str(caught.value)


@pytest.fixture
def packages(tmp_path: Path, fmu_dir: Path) -> Packages:
    """A folder for packages."""
    return Packages(tmp_path, fmu_dir)


def tables(read: System) -> dict[str, Any]:
    """What is set in a system, without the places of its models."""
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


@pytest.fixture
def displacement(fmu_dir: Path) -> Path:
    """The system file of the quarter car, where its FMUs are."""
    path = fmu_dir / "displacement.toml"
    path.write_bytes((EXAMPLES / "displacement.toml").read_bytes())
    return path


# ---- Running, importing, exporting --------------------------------------------------------------


def test_a_package_runs_as_the_system_that_it_was_made_of(
    displacement: Path, tmp_path: Path
) -> None:
    """Export, run, and the same run from TOML: equal files, byte for byte."""
    invoke("export", displacement, "-o", tmp_path / "car.ssp")
    for name, file in (("ssp", tmp_path / "car.ssp"), ("toml", displacement)):
        invoke("run", file, "--in-process", "--quiet", "--no-plot", "--output", tmp_path / name)
    results = [(tmp_path / name / "results.csv").read_bytes() for name in ("ssp", "toml")]
    assert results[0] == results[1]
    assert results[0].count(b"\n") > 100


def test_the_package_runs_in_processes_of_its_own(
    quarter_car_ssp: Path, tmp_path: Path, no_process_left: None
) -> None:
    """Launched slaves find the extracted models; those are gone afterwards."""
    arguments = ("--stop-time", "0.1", "--quiet", "--no-plot")
    for name, more in (("bus", ()), ("here", ("--in-process",))):
        invoke("run", quarter_car_ssp, *arguments, *more, "--output", tmp_path / name)
    results = [(tmp_path / name / "results.csv").read_bytes() for name in ("bus", "here")]
    assert results[0] == results[1]
    with open_system(quarter_car_ssp) as car:
        base = car.base
        assert base.is_dir()
    assert not base.exists()


def test_the_example_is_the_quarter_car(quarter_car_ssp: Path, tmp_path: Path) -> None:
    """Through a nested system and its connectors, with nothing to be noted."""
    read = read_ssp(quarter_car_ssp, tmp_path)
    assert read.notes == ()
    renamed = {(s.replace("axle.", ""), t.replace("axle.", "")) for s, t in pairs(read.system)}
    assert renamed == set(DIRECT)
    assert read.system.slaves["axle.wheel"].parameters == {"z": 0.1}
    assert (read.system.simulation.start_time, read.system.simulation.stop_time) == (0.0, 4.0)


FULL = """
[simulation]
start_time = 1
stop_time = 4.5
order = 2
estimator = "rich"
events = [2.0, 3.0]
relative_tolerance = 1e-5

[slaves."left.wheel"]
model = "wheel.fmu"
parameters = { z = 0.1, m = 40 }
absolute_tolerance = 1e-3
tolerances = { x = { relative = 1e-5 } }
outputs_follow_inputs = true

[slaves.other-wheel]
model = "wheel.fmu"

[slaves.chassis]
model = "chassis.fmu"
largest_step_size = 0.25

[[connections]]
from = "left.wheel.x"
to = "chassis.x_w"
factor = 2.0

[[connections]]
from = "chassis.x"
to = "left.wheel.x_c"
factor = -1.0
offset = 0.1

[[connections]]
from = "chassis.x"
to = "other-wheel.x_c"
offset = 0.5

[[connections]]
from = "chassis.v"
to = "left.wheel.v_c"
ignore_units = true

[[connections]]
from = "left.wheel.v"
to = "chassis.v_w"

[bus]
listen = ["tcp/127.0.0.1:7450"]
step_timeout = 5.0
"""


def with_whole_transformations(table: dict[str, Any]) -> dict[str, Any]:
    """A missing factor is 1 and a missing offset 0 where the other one is given."""
    for one in table["connections"]:
        if one["factor"] is not None or one["offset"] is not None:
            one["factor"] = 1.0 if one["factor"] is None else one["factor"]
            one["offset"] = one["offset"] or 0.0
    return table


@pytest.fixture
def full(fmu_dir: Path) -> Path:
    """A system file that uses all tables."""
    path = fmu_dir / "full.toml"
    path.write_text(FULL, encoding="utf-8")
    return path


def test_export_and_import_lose_nothing(full: Path, packages: Packages) -> None:
    """Every setting comes back; TOML from the package is the same system again."""
    given = with_whole_transformations(tables(load_system(full)))
    package = packages.folder / "full.ssp"
    export_system(full, package)
    read = packages.read_file(package)
    assert read.notes == ()
    assert tables(read.system) == given
    assert import_system(package, packages.folder / "again.toml") == ()
    again = load_system(packages.folder / "again.toml")
    assert tables(again) == given
    assert {s.model for s in again.slaves.values()} == {
        "again_models/wheel.fmu",
        "again_models/chassis.fmu",
    }
    for name in ("wheel", "chassis"):
        copied = packages.folder / "again_models" / f"{name}.fmu"
        assert copied.read_bytes() == (full.parent / f"{name}.fmu").read_bytes()


TYPED = """
[slaves.a]
model = "all_types3.fmu"

[slaves.a.parameters]
n = 4
boolean_in = true
int64_in = -5000000000
uint64_in = 18446744073709551615
binary_in = "00ff"
string_in = "a & b"
enumeration_in = 2
matrix_in = [[1.0, 2.5, 3.0], [4.0, 5.0, 6.0]]
"vector_in[4]" = 1e300

[slaves.b]
model = "all_types3.fmu"

[[connections]]
from = "a.vector_out"
to = "b.vector_in"
factor = 2.0

[[connections]]
from = "a.matrix_out[1,2]"
to = "b.float64_in"

[[connections]]
from = "a.boolean_out"
to = "b.boolean_in"
mapping = { true = false, false = true }

[[connections]]
from = "a.int8_out"
to = "b.int32_in"
mapping = { -1 = 7, 3 = 0 }

[inputs]
"a.float64_in" = 2.5

[results]
variables = ["a.*", "!a.vector_out*"]
every = 2
formats = ["csv", "arrow"]
"""


@pytest.fixture
def typed(tmp_path: Path, capability_dir: Path) -> Path:
    """A system file with values of all types, arrays and mappings."""
    (tmp_path / "all_types3.fmu").write_bytes((capability_dir / "all_types3.fmu").read_bytes())
    path = tmp_path / "typed.toml"
    path.write_text(TYPED, encoding="utf-8")
    return path


def test_all_types_come_back(typed: Path, packages: Packages) -> None:
    """By a package and by a system file made of it; SSP 2.0 is written for what 1.0 has not."""
    given = with_whole_transformations(tables(load_system(typed)))
    given["simulation"]["start_time"] = 0.0
    package = typed.with_name("typed.ssp")
    export_system(typed, package)
    read = packages.read_file(package)
    assert read.notes == ()
    assert tables(read.system) == given
    import_system(package, typed.with_name("again.toml"))
    assert tables(load_system(typed.with_name("again.toml"))) == given
    with zipfile.ZipFile(package) as archive:
        roots = {n: etree.fromstring(archive.read(n)) for n in archive.namelist()[:2]}
    assert {root.get("version") for root in roots.values()} == {"2.0"}
    assert b"AAD/" not in etree.tostring(roots["resources/a.ssv"])
    binary = roots["resources/a.ssv"].find(".//{*}Binary")
    assert binary is not None
    assert binary.get("value") == "00ff"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('[inputs]\n"a.float64_in" = { table = "road.csv" }', "cannot be put into a package"),
        (
            '[inputs]\n"a.float64_in" = { function = "m.py:f" }',
            "a table or a function cannot be put into a package; export the system without it",
        ),
        (
            "[slaves.a.parameters]\nmatrix_in = [[1.0], [1.0, 2.0]]",
            "its rows have different sizes",
        ),
        ("[slaves.a.parameters]\nvector_in = [1.0, true]", "an array of Boolean and Real"),
        ("[slaves.a.parameters]\nint64_in = 18446744073709551616", "has more than 64 bits"),
        ('[slaves.a.parameters]\n"vector_inn[1]" = 1.0', "did you mean 'vector_in[1]'"),
    ],
)
def test_what_ssp_cannot_hold_is_named(typed: Path, text: str, told: str) -> None:
    """With file and table, and no package is left behind."""
    typed.write_text(f'[slaves.a]\nmodel = "all_types3.fmu"\n{text}\n', encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"typed\.toml: \[") as caught:
        export_system(typed, typed.with_name("typed.ssp"))
    assert told in str(caught.value)
    assert not typed.with_name("typed.ssp").exists()


FINITE = st.floats(allow_nan=False, allow_infinity=False)
NAMES = st.sampled_from(["a", "b", "left.wheel", "x-1", "A_b"])
INTEGERS = st.integers(-(2**31), 2**31 - 1)
MAPPINGS = st.none() | st.dictionaries(INTEGERS, INTEGERS, min_size=1, max_size=3)
TEXTS = st.text(st.characters(exclude_categories=("Cs", "Cc")), max_size=9)
VALUES = st.fixed_dictionaries(
    {},
    optional={
        "float64_in": FINITE,
        "float32_in": FINITE,
        "int64_in": st.integers(-(2**63), 2**63 - 1),
        "uint64_in": st.integers(0, 2**64 - 1),
        "int8_in": st.integers(-128, 127),
        "boolean_in": st.booleans(),
        "string_in": TEXTS,
        "binary_in": st.binary(max_size=9).map(bytes.hex),
        "enumeration_in": st.integers(1, 3),
        "vector_in": st.tuples(FINITE, FINITE, FINITE),
        "matrix_in": st.tuples(*[st.tuples(FINITE, FINITE, FINITE)] * 2),
        "n": st.integers(1, 9),
    },
)
LINEAR = st.fixed_dictionaries({"factor": FINITE, "offset": FINITE})
UNITS_AS_THEY_ARE = st.fixed_dictionaries({"ignore_units": st.booleans()})
WAYS = {
    "float64": LINEAR | UNITS_AS_THEY_ARE,
    "vector": LINEAR | UNITS_AS_THEY_ARE,
    "matrix": LINEAR | UNITS_AS_THEY_ARE,
    "matrix[2,3]": LINEAR | UNITS_AS_THEY_ARE,
    "int32": st.fixed_dictionaries({"mapping": MAPPINGS}),
    "enumeration": st.fixed_dictionaries({"mapping": MAPPINGS}),
    "boolean": st.fixed_dictionaries(
        {"mapping": st.none() | st.dictionaries(st.booleans(), st.booleans(), min_size=1)}
    ),
    "string": st.just({}),
    "binary": st.just({}),
}
SETTINGS = st.fixed_dictionaries(
    {"start_time": st.floats(-1e3, 1e3)},
    optional={
        "stop_time": st.floats(2e3, 1e9),
        "order": st.sampled_from([0, 1, 2, 3, "auto"]),
        "estimator": st.sampled_from(["rich", "mod"]),
        "relative_tolerance": st.floats(1e-12, 1.0),
        "events": st.lists(st.floats(1.1e3, 1.9e3), max_size=2).map(tuple),
    },
)


def variable(name: str, causality: str) -> str:
    """A variable of the FMU of all types: ``matrix_out[2,3]`` of ``matrix[2,3]``."""
    name, bracket, indices = name.partition("[")
    return f"{name}_{causality}{bracket}{indices}"


@st.composite
def systems(draw: st.DrawFn) -> dict[str, Any]:
    """Tables of a system of FMUs of all types."""
    slaves = draw(st.lists(NAMES, min_size=1, max_size=3, unique=True))
    connections = []
    for target in slaves:
        for way in draw(st.lists(st.sampled_from(list(WAYS)), max_size=3, unique=True)):
            source = draw(st.sampled_from(slaves))
            ends = {
                "from": f"{source}.{variable(way, 'out')}",
                "to": f"{target}.{variable(way, 'in')}",
            }
            connections.append(ends | draw(WAYS[way]))
    return {
        "simulation": draw(SETTINGS),
        "slaves": {
            name: {"model": "all_types3.fmu", "parameters": draw(VALUES)} for name in slaves
        },
        "connections": connections,
        "inputs": draw(st.dictionaries(st.just(f"{slaves[0]}.float32_in"), FINITE)),
        "results": draw(st.sampled_from([{}, {"every": 3}, {"formats": ("arrow",)}])),
        "bus": draw(st.sampled_from([{}, {"step_timeout": 5.0, "pin": True}])),
    }


@given(given_tables=systems())
@settings(max_examples=40)
def test_what_is_exported_is_imported_as_it_was(
    tmp_path_factory: pytest.TempPathFactory, capability_dir: Path, given_tables: dict[str, Any]
) -> None:
    """Any system of FMUs: all settings, values, connections and transformations come back.

    The description of the FMU is read once, and the FMU itself is not packed: what an archive does
    to it other tests show.
    """
    folder = tmp_path_factory.mktemp("law")
    system = System(**given_tables, base=folder, source="law.toml")
    model = capability_dir / "all_types3.fmu"
    (folder / "all_types3.fmu").symlink_to(model)
    write_package(
        system,
        dict.fromkeys(system.slaves, "all_types3.fmu"),
        lambda *_: described(model),
        "law",
        folder / "law.ssp",
    )
    (folder / "scratch").mkdir()
    read = read_ssp(folder / "law.ssp", folder / "scratch")
    assert tables(read.system) == with_whole_transformations(tables(system))
    assert read.notes == ()


@cache
def described(model: Path) -> SlaveDescription:
    """What a model says of itself."""
    description: SlaveDescription = entry_points(group="doublestep.in_process")["describe"].load()(
        str(model), Path()
    )
    return description


def test_equal_systems_give_equal_packages(full: Path, tmp_path: Path) -> None:
    """Nothing in a package depends on when it was written."""
    contents = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        export_system(full, tmp_path / folder / "car.ssp")
        contents.append((tmp_path / folder / "car.ssp").read_bytes())
    assert contents[0] == contents[1]


def test_exported_documents_keep_the_schemas(full: Path, tmp_path: Path) -> None:
    """The schemas of SSP 1.0, as FMPy has them; FMPy reads the package too."""
    package = tmp_path / "full.ssp"
    export_system(full, package)
    with zipfile.ZipFile(package) as archive:
        documents = {n: archive.read(n) for n in archive.namelist() if not n.endswith(".fmu")}
    assert sorted(documents) == ["SystemStructure.ssd", "resources/left.wheel.ssv"]
    for name, xml in documents.items():
        kind = "Description" if name.endswith(".ssd") else "ParameterValues"
        schema = etree.XMLSchema(file=str(SCHEMAS / f"SystemStructure{kind}.xsd"))
        schema.assertValid(etree.fromstring(xml))
    assert len(fmpy.ssp.ssd.read_ssd(str(package)).system.elements) == 3


def test_the_documents_of_the_tests_keep_the_schemas_too() -> None:
    """So what is read here is what other tools write."""
    schema = etree.XMLSchema(file=str(SCHEMAS / "SystemStructureDescription.xsd"))
    example = EXAMPLES.parent / "ssp"
    for text in (NESTED, (example / "SystemStructure.ssd").read_text("utf-8")):
        schema.assertValid(etree.fromstring(text.encode()))
    for file, kind in (("road.ssv", "ParameterValues"), ("road.ssm", "ParameterMapping")):
        schema = etree.XMLSchema(file=str(SCHEMAS / f"SystemStructure{kind}.xsd"))
        schema.assertValid(etree.parse(example / "resources" / file))


def test_what_is_no_fmu_cannot_be_exported(full: Path, tmp_path: Path) -> None:
    """Python models and slaves without a model are named, and nothing is written."""
    for line, told in (('model = "m.py:Wheel"', "'m.py:Wheel'"), ("", "has no FMU")):
        path = full.parent / "python.toml"
        path.write_text(f"[slaves.w]\n{line}\n", encoding="utf-8")
        with pytest.raises(ConfigurationError, match=r"\[slaves\.w\] has no FMU") as caught:
            export_system(path, tmp_path / "python.ssp")
        assert told in str(caught.value)
        assert "export the model as one" in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("parameters = { mm = 1.0 }", "no such variable; did you mean 'm'"),
        ("parameters = { m = nan }", "is not a finite number"),
    ],
)
def test_parameters_that_cannot_be_exported_are_named(
    fmu_dir: Path, tmp_path: Path, line: str, told: str
) -> None:
    """By slave and name, and no package is left behind."""
    path = fmu_dir / "wrong.toml"
    path.write_text(f'[slaves.w]\nmodel = "wheel.fmu"\n{line}\n', encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"\[slaves\.w\.parameters\] 'mm?'") as caught:
        export_system(path, tmp_path / "wrong.ssp")
    assert told in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_description_alone_keeps_its_paths(packages: Packages, fmu_dir: Path) -> None:
    """Without a package the models stay where they are."""
    path = packages.folder / "car.ssd"
    path.write_text(ssd(system(WHEEL)), encoding="utf-8")
    (packages.folder / "resources").mkdir()
    fmu = packages.folder / "resources" / "wheel.fmu"
    fmu.write_bytes((fmu_dir / "wheel.fmu").read_bytes())
    import_system(path, packages.folder / "car.toml")
    assert load_system(packages.folder / "car.toml").slaves["wheel"].model == "resources/wheel.fmu"
    (packages.folder / "elsewhere").mkdir()
    import_system(path, packages.folder / "elsewhere" / "car.toml")
    moved = load_system(packages.folder / "elsewhere" / "car.toml")
    assert (moved.base / str(moved.slaves["wheel"].model)).resolve() == fmu.resolve()


def test_a_package_cannot_open_the_bus_to_others(full: Path, packages: Packages) -> None:
    """A package comes from elsewhere: ``insecure`` is for who runs it to say."""
    text = full.read_text().replace("step_timeout = 5.0", "insecure = true")
    full.with_name("insecure.toml").write_text(text)
    export_system(full.with_name("insecure.toml"), packages.folder / "a.ssp")
    read = packages.read_file(packages.folder / "a.ssp")
    assert not read.system.bus.insecure
    assert "[bus] insecure = true is not taken from a package" in read.notes[0]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('[slaves.wheel]\nmodel = "evil.py:Evil"', "cannot give [slaves.wheel] a model"),
        ("[slaves.other]\nstep_size = 0.1", "settings of 'other', no slave"),
        ("[simulation]\nordr = 1", "unknown key 'ordr'; did you mean 'order'"),
        ("x = 1", "holds more than"),
        ('[inputs]\n"wheel.x_c" = { function = "os:system" }', "more than a number"),
        ('[inputs]\n"wheel.x_c" = { table = "/etc/passwd" }', "more than a number"),
        ("[", "is not TOML"),
    ],
)
def test_settings_in_an_annotation_are_checked(packages: Packages, text: str, told: str) -> None:
    """They cannot name models, nor slaves that are not there, nor keys that do not exist."""
    annotation = (
        '<ssd:Annotations><ssc:Annotation type="org.doublestep.system">'
        f'<d:Settings xmlns:d="urn:doublestep:system">{text}</d:Settings>'
        "</ssc:Annotation></ssd:Annotations>"
    )
    assert told in packages.refusal(ssd(system(WHEEL), annotation))


def test_a_broken_import_leaves_no_file(packages: Packages) -> None:
    """The system file is written when all is known."""
    path = packages.write(ssd(system(WHEEL + WHEEL)))
    with pytest.raises(ConfigurationError, match="two elements 'wheel'"):
        import_system(path, packages.folder / "new" / "car.toml")
    with pytest.raises(ConfigurationError, match=r"must be a file \.toml"):
        import_system(path, packages.folder / "car.ssp")
    assert sorted(p.name for p in packages.folder.iterdir()) == ["test.ssp"]


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


def test_nested_systems_become_connections_of_components(packages: Packages) -> None:
    """Through two levels, whatever is called start and what end."""
    read = packages.read(NESTED)
    assert list(read.system.slaves) == ["chassis", "outer.inner.wheel"]
    expected = {
        (s.replace("wheel", "outer.inner.wheel", 1), t.replace("wheel", "outer.inner.wheel", 1))
        for s, t in DIRECT
    }
    assert set(pairs(read.system)) == expected
    assert len(read.system.connections) == 4
    assert read.notes == ()


def chain(steps: list[tuple[str, str]], units: list[str]) -> str:
    """chassis.x through one system per inner step to wheel.x_c.

    Args:
        steps: transformation and attributes of each connection, from the source on.
        units: of each connector on the way, both ends included.
    """
    inner = component("wheel", connector("x_c", "input", units[-1]))
    target = "wheel.x_c"
    for number in range(len(steps) - 1, 0, -1):
        name = f"s{number}"
        inner = (
            f'<ssd:System name="{name}">'
            + system(
                inner,
                connection("a", target, *steps[number]),
                f"<ssd:Connectors>{connector('a', 'input', units[number])}</ssd:Connectors>",
            )
            + "</ssd:System>"
        )
        target = f"{name}.a"
    source = component("chassis", connector("x", "output", units[0]))
    return ssd(system(source + inner, connection("chassis.x", target, *steps[0])))


@given(
    factors=st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), min_size=1, max_size=4),
    value=st.floats(-1e3, 1e3),
)
def test_transformations_are_composed(
    tmp_path_factory: pytest.TempPathFactory,
    fmu_dir: Path,
    factors: list[tuple[float, float]],
    value: float,
) -> None:
    """What one connection does is what all on the way do, one after the other."""
    steps = [(linear(*pair), "") for pair in factors]
    packages = Packages(tmp_path_factory.mktemp("chain"), fmu_dir)
    read = packages.read(chain(steps, ["m"] * (len(steps) + 1)))
    (one,) = read.system.connections
    expected = value
    for factor, offset in factors:
        expected = factor * expected + offset
    assert one.factor is not None
    assert one.offset is not None
    bound = 1e-12 * 1e3 ** (len(factors) + 1)
    assert one.factor * value + one.offset == pytest.approx(expected, rel=1e-12, abs=bound)


SUPPRESSED = 'suppressUnitConversion="true"'


@pytest.mark.parametrize(
    ("steps", "units", "expected"),
    [
        ([("", "")], ["m", "m"], (None, None, False)),
        ([("", "")], ["m", "mm"], (None, None, False)),  # the master converts between FMUs
        ([("", SUPPRESSED)], ["m", "mm"], (None, None, True)),
        ([("", ""), ("", "")], ["m", "mm", "m"], (None, None, False)),
        ([("", SUPPRESSED), ("", SUPPRESSED)], ["m", "mm", "m"], (None, None, True)),
        ([(linear(2, 5), SUPPRESSED)], ["m", "mm"], (2.0, 5.0, False)),
        ([(linear(2, 5), "")], ["m", "mm"], (2000.0, 5.0, False)),
        ([("", ""), (linear(2, 5), "")], ["m", "mm", "m"], (2.0, 5.0, False)),
        ([(linear(2, 5), ""), ("", "")], ["m", "mm", "m"], (2.0, 0.005, False)),
        ([("", SUPPRESSED), ("", "")], ["m", "mm", "m"], (0.001, 0.0, False)),
        ([(linear(2, 5), ""), ("", "")], ["m", "", "mm"], (2000.0, 5000.0, False)),
    ],
)
def test_units_on_the_way(
    packages: Packages,
    steps: list[tuple[str, str]],
    units: list[str],
    expected: tuple[float | None, float | None, bool],
) -> None:
    """Converted before a linear transformation, unless the connection says otherwise."""
    read = packages.read(chain(steps, units))
    (one,) = read.system.connections
    assert (one.factor, one.offset, one.ignore_units) == (
        pytest.approx(expected[0]) if expected[0] is not None else None,
        pytest.approx(expected[1]) if expected[1] is not None else None,
        expected[2],
    )
    assert read.notes == ()


def test_units_that_are_not_declared_are_noted(packages: Packages) -> None:
    """A transformation may then stand for too little."""
    read = packages.read(chain([(linear(2, 5), "")], ["m", ""]))
    assert "the units of 'x' and 'x_c' are not both declared" in read.notes[0]
    assert packages.read(chain([(linear(2, 5), SUPPRESSED)], ["m", ""])).notes == ()


def test_units_of_other_dimensions_are_refused(packages: Packages) -> None:
    """A metre is no kilogram."""
    text = packages.refusal(chain([(linear(2, 5), "")], ["m", "kg"]))
    assert "unit 'm' cannot be converted to 'kg'" in text


@given(
    numbers=st.tuples(*[st.floats(0.1, 10.0), st.floats(-10.0, 10.0)] * 3), value=st.floats(-10, 10)
)
def test_units_are_converted_by_their_base_units(
    numbers: tuple[float, float, float, float, float, float], value: float
) -> None:
    """By way of a third unit it is the same, and the base value stays."""
    a, b, c = (
        Unit(name, (0, 1), numbers[2 * i], numbers[2 * i + 1]) for i, name in enumerate("abc")
    )
    to_b, to_c, direct = a.to(b), b.to(c), a.to(c)
    assert to_b is not None
    assert to_c is not None
    assert direct is not None
    assert to_b.then(to_c)(value) == pytest.approx(direct(value), rel=1e-9, abs=1e-9)
    assert b.factor * to_b(value) + b.offset == pytest.approx(
        a.factor * value + a.offset, rel=1e-9, abs=1e-9
    )
    assert a.to(a) == Linear()
    assert a.to(Unit("kg", (1, 0), 1.0, 0.0)) is None


def test_one_system_can_be_there_twice(packages: Packages, fmu_dir: Path) -> None:
    """By its id, as a description of its own, and as a package in the package."""
    inner = passing("inner", WHOLE_WHEEL, ("wheel.x_c", "wheel.v_c", "wheel.x", "wheel.v"))
    first = inner.replace('<ssd:System name="inner"', '<ssd:System name="inner" id="once"')
    type_ = 'type="application/x-ssp-definition"'
    by_id = component("again", PASSED, source=f'{type_} source="#once"')
    beside = component("beside", PASSED, source=f'{type_} source="resources/sub%20one.ssd"')
    packed = component(
        "packed", PASSED, source='type="application/x-ssp-package" source="resources/sub.ssp"'
    )
    experiment = '<ssd:DefaultExperiment stopTime="9"/>'
    apart = ssd(
        f"<ssd:Connectors>{PASSED}</ssd:Connectors><ssd:Elements>{inner}</ssd:Elements>"
        "<ssd:Connections>"
        + "".join(connection(c, f"inner.{c}") for c in "ab")
        + "".join(connection(f"inner.{c}", c) for c in "cd")
        + "</ssd:Connections>",
        experiment,
    )
    subpackage = packages.write(apart, "sub.ssp")
    # A description in resources/ refers to what is beside it.
    text = apart.replace("resources/wheel.fmu", "wheel.fmu")
    links = connection("inner.c", "again.a") + connection("again.c", "beside.a")
    links += connection("beside.c", "packed.a")
    read = packages.read(
        ssd(system(first + by_id + beside + packed, links)),
        **{"sub one__ssd": text, "sub__ssp": subpackage},
    )
    assert list(read.system.slaves) == [
        "inner.wheel",
        "again.wheel",
        "beside.inner.wheel",
        "packed.inner.wheel",
    ]
    assert pairs(read.system) == [
        ("inner.wheel.x", "again.wheel.x_c"),
        ("again.wheel.x", "beside.inner.wheel.x_c"),
        ("beside.inner.wheel.x", "packed.inner.wheel.x_c"),
    ]
    assert read.system.simulation.stop_time is None
    assert sum("default experiment" in note for note in read.notes) == 2
    models = [read.system.base / str(s.model) for s in read.system.slaves.values()]
    assert all(m.read_bytes() == (fmu_dir / "wheel.fmu").read_bytes() for m in models)


def test_a_system_that_refers_to_itself_is_refused(packages: Packages) -> None:
    """Within a bounded time, by id and by file."""
    type_ = 'type="application/x-ssp-definition"'
    by_file = component("me", PASSED, source=f'{type_} source="SystemStructure.ssd"')
    assert "refers to itself" in packages.refusal(ssd(system(by_file)))
    by_id = "".join(component(n, PASSED, source=f'{type_} source="#me"') for n in "ab")
    loop = f'<ssd:System name="s" id="me">{system(by_id)}</ssd:System>'
    assert "refers to itself" in packages.refusal(ssd(system(loop)))


def test_names_that_slaves_cannot_have(packages: Packages) -> None:
    """Are replaced with a note, or refused where two would become one."""
    source = 'source="resources/wheel.fmu"'
    read = packages.read(ssd(system(component("my wheel", INPUTS, source=source))))
    assert list(read.system.slaves) == ["my_wheel"]
    assert "'my wheel' is called 'my_wheel' here" in read.notes[0]
    two = component("my wheel", INPUTS, source=source) + component("my_wheel", "", source=source)
    two = two.replace("<ssd:Connectors></ssd:Connectors>", "")
    assert "two components get the name 'my_wheel'" in packages.refusal(ssd(system(two)))


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


@pytest.mark.parametrize(
    ("description", "mapping"),
    [
        (
            through(table("Boolean", true="0", false="1"), "", "<ssc:Boolean/>"),
            {True: False, False: True},
        ),
        (
            through(table("Integer", _1=2, _2=3), table("Integer", _3=5, _4=4), "<ssc:Int32/>"),
            {1: 2, 2: 5, 3: 5, 4: 4},
        ),
        (
            through("", table("Enumeration", low="fast", high="slow"), GEAR, MODE),
            {1: 9, 2: 7},
        ),
        (
            through(table("Enumeration", low="high"), table("Integer", _2=7), GEAR, MODE),
            {1: 7, 2: 7},
        ),
    ],
)
def test_mapping_transformations_of_connections(
    packages: Packages, description: str, mapping: dict[int, int]
) -> None:
    """Composed on the way of a signal; what has no entry stays, items become numbers."""
    read = packages.read(description)
    (one,) = read.system.connections
    assert one.mapping == mapping
    assert list(map(type, one.mapping or ())) == list(map(type, mapping))
    assert read.notes == ()


@given(
    tables=st.lists(
        st.dictionaries(st.integers(0, 5), st.integers(0, 5), min_size=1), min_size=1, max_size=4
    )
)
def test_tables_are_composed(tables: list[dict[int, int]]) -> None:
    """Each value becomes what all on its way make of it, one after the other."""
    whole = Table(tables[0], is_boolean=False)
    for entries in tables[1:]:
        whole = whole.then(Table(entries, is_boolean=False))
    for value in range(8):
        expected = value
        for entries in tables:
            expected = entries.get(expected, expected)
        assert whole(value) == expected


VECTOR = '<ssc:Float64/><ssc:Dimension size="3"/>'
MATRIX = '<ssc:Float64/><ssc:Dimension size="2"/><ssc:Dimension size="3"/>'
SIZED = '<ssc:Float64/><ssc:Dimension sizeConnector="n"/>'


def array_component(name: str, connectors: str, values: str = "") -> str:
    """A component with the FMU of all types of FMI 3.0."""
    return component(name, connectors, values, 'source="resources/all_types3.fmu"')


def array(name: str, kind: str, texts: str, *sizes: int) -> str:
    """A parameter that is an array of numbers."""
    dimensions = "".join(f'<ssc:Dimension size="{size}"/>' for size in sizes)
    return f'<ssv:Parameter name="{name}"><ssv:{kind} value="{texts}"/>{dimensions}</ssv:Parameter>'


def test_arrays_and_binaries_run(packages: Packages, capability_dir: Path) -> None:
    """Whole arrays through a nested system, single elements, start values in rows, a binary."""
    values = bindings(
        binding(
            array("matrix_in", "Float64", "1 2 3 4 5 6", 2, 3)
            + '<ssv:Parameter name="binary_in"><ssv:Binary value="00FF10"/></ssv:Parameter>'
            + array("vector_in", "Real", "7 8 9", 3)
        )
    )
    outs = (
        connector("matrix_out", "output", inner=MATRIX)
        + connector("vector_out", "output", inner=SIZED)
        + connector("binary_out", "output", inner='<ssc:Binary mime-type="image/png"/>')
    )
    ins = (
        connector("matrix_in", "input", inner=MATRIX)
        + connector("vector_in", "input", inner=VECTOR)
        + connector("binary_in", "input", inner='<ssc:Binary mime-type="image/gif"/>')
    )
    passing_on = (
        '<ssd:System name="s">'
        + system(
            array_component("b", ins),
            connection("m", "b.matrix_in"),
            f"<ssd:Connectors>{connector('m', 'input', inner=MATRIX)}</ssd:Connectors>",
        )
        + "</ssd:System>"
    )
    text = ssd(
        system(
            array_component("a", outs, values) + passing_on + array_component("c", ins),
            connection("a.matrix_out", "s.m")
            + connection("a.vector_out", "c.vector_in")
            + connection("a.binary_out", "c.binary_in"),
        ),
        '<ssd:DefaultExperiment stopTime="0.5"/>',
        version="2.0",
    )
    read = packages.read(text, all_types3__fmu=capability_dir / "all_types3.fmu")
    assert set(pairs(read.system)) == {
        ("a.matrix_out", "s.b.matrix_in"),
        ("a.vector_out", "c.vector_in"),
        ("a.binary_out", "c.binary_in"),
    }
    assert read.system.slaves["a"].parameters == {
        "matrix_in": ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)),
        "binary_in": "00ff10",
        "vector_in": (7.0, 8.0, 9.0),
    }
    result = simulate(read.system, in_process=True, estimator="none", initial_step_size=0.25)
    (note,) = read.notes
    assert "of mime-type 'image/png' and 'image/gif'" in note
    for i in (1, 2):
        for j in (1, 2, 3):
            first = result[f"a.matrix_out[{i},{j}]"][-1]
            assert first == 2.0 * (3 * i - 3 + j)
            assert result[f"s.b.matrix_out[{i},{j}]"][-1] == 2.0 * first
    assert result["c.vector_out[2]"][-1] == (8.0 + 1.0) + 1.0
    assert result["a.binary_out"][-1] == b"\x10\xff\x00"
    assert result["c.binary_out"][-1] == b"\x00\xff\x10"


def test_elements_of_arrays_are_connected(packages: Packages, capability_dir: Path) -> None:
    """Two scalars fill the array of a system, which goes on as a whole; an element comes out."""
    inside = (
        '<ssd:System name="s">'
        + system(
            array_component("b", connector("vector_in", "input", inner=VECTOR)),
            connection("v", "b.vector_in", linear(2, 1), SUPPRESSED),
            f"<ssd:Connectors>{connector('v', 'input', inner=VECTOR)}</ssd:Connectors>"
            + bindings(binding(array("v", "Real", "1 2 3", 3))),
        )
        + "</ssd:System>"
    )
    outs = connector("float64_out", "output") + connector("matrix_out", "output", inner=MATRIX)
    ends = connection("a.float64_out", "s.v", attributes=f'endIndices="2" {SUPPRESSED}')
    more = f'startIndices="2 3" endIndices="3" {SUPPRESSED}'
    text = ssd(
        system(
            array_component("a", outs) + inside, ends + connection("a.matrix_out", "s.v", "", more)
        ),
        version="2.0",
    )
    read = packages.read(text, all_types3__fmu=capability_dir / "all_types3.fmu")
    assert pairs(read.system) == [
        ("a.float64_out", "s.b.vector_in[2]"),
        ("a.matrix_out[2,3]", "s.b.vector_in[3]"),
    ]
    assert {(c.factor, c.offset) for c in read.system.connections} == {(2.0, 1.0)}
    assert read.system.slaves["s.b"].parameters == {
        "vector_in[1]": 3.0,
        "vector_in[2]": 5.0,
        "vector_in[3]": 7.0,
    }
    assert read.notes == ()


@pytest.mark.parametrize(
    ("source", "target", "attributes", "told"),
    [
        (VECTOR, MATRIX, "", "different dimensions: 3 and 2 x 3"),
        (VECTOR, '<ssc:Float64/><ssc:Dimension size="4"/>', "", "different dimensions: 3 and 4"),
        (MATRIX, VECTOR, 'startIndices="1"', "1 indices for connector"),
        (MATRIX, VECTOR, 'startIndices="1 1"', "different dimensions: one value and 3"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(
    packages: Packages, source: str, target: str, attributes: str, told: str
) -> None:
    """With both dimensions and the line."""
    parts = component("chassis", connector("x", "output", inner=source)) + component(
        "wheel", connector("x_c", "input", inner=target)
    )
    text = ssd(system(parts, connection("chassis.x", "wheel.x_c", "", attributes)), version="2.0")
    refused = packages.refusal(text)
    assert told in refused
    assert "SystemStructure.ssd, line " in refused


@pytest.mark.parametrize(
    ("values", "told"),
    [
        (real("v", 1), "a value of dimensions one value for connector 's.v' of dimensions 3"),
        (array("v", "Real", "1 2", 2), "a value of dimensions 2 for connector 's.v'"),
    ],
)
@pytest.mark.parametrize("attributes", ["", 'startIndices="1"'])
def test_values_of_another_size_are_refused(
    packages: Packages, values: str, told: str, attributes: str
) -> None:
    """Both where arrays are connected as a whole and element by element."""
    inner = connector("x_c", "input", inner="" if attributes else VECTOR)
    inside = (
        '<ssd:System name="s">'
        + system(
            component("wheel", inner),
            connection("v", "wheel.x_c", "", attributes),
            f"<ssd:Connectors>{connector('v', 'input', inner=VECTOR)}</ssd:Connectors>"
            + bindings(binding(values)),
        )
        + "</ssd:System>"
    )
    assert told in packages.refusal(ssd(system(inside), version="2.0"))


def test_a_value_that_leads_nowhere_is_noted(packages: Packages) -> None:
    """A connector may be declared and not connected."""
    whole = f"<ssd:Connectors>{connector('u', 'input')}</ssd:Connectors>"
    read = packages.read(ssd(system(WHEEL, before=whole + bindings(binding(real("u", 1))))))
    (note,) = read.notes
    assert "connector 'u' leads to nothing that could take its value; not applied" in note


def test_a_size_must_be_known_where_elements_are_connected(packages: Packages) -> None:
    """Else nobody could say which elements the whole array stands for."""
    parts = component(
        "chassis",
        connector("x", "output", inner=SIZED) + connector("v", "output", inner=VECTOR),
    ) + component("wheel", connector("x_c", "input", inner=SIZED) + connector("v_c", "input"))
    links = connection("chassis.x", "wheel.x_c")
    links += connection("chassis.v", "wheel.v_c", attributes='startIndices="1"')
    refused = packages.refusal(ssd(system(parts, links), version="2.0"))
    assert "the size of connector 'x' of kind 'output' is not declared" in refused


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


def test_signals_of_a_dictionary_become_connections(packages: Packages) -> None:
    """Shared by systems of several levels; inline, or in a file of its own."""
    expected = {
        (s.replace("wheel", "axle.wheel", 1), t.replace("wheel", "axle.wheel", 1))
        for s, t in DIRECT
    }
    inline = packages.read(bus_system(defined(f">{dictionary(ENTRIES)}")))
    file = dictionary(ENTRIES).replace(
        "<ssb:SignalDictionary", f"<ssb:SignalDictionary{NAMESPACES}"
    )
    by_file = packages.read(bus_system(defined('source="resources/b.ssb">')), b__ssb=file)
    for read in (inline, by_file):
        assert set(pairs(read.system)) == expected
        assert len(read.system.connections) == 4
        assert read.notes == ()
    schema = etree.XMLSchema(file=str(SCHEMAS / "SystemStructureSignalDictionary.xsd"))
    schema.assertValid(etree.fromstring(file))


def test_units_of_a_dictionary_are_converted(packages: Packages) -> None:
    """From the component to the entry to another component, transformed on the way."""
    units = UNITS.replace("ssd:", "ssb:")
    parts = (
        component("chassis", connector("x", "output", "m"))
        + component("wheel", connector("x_c", "input", "m"))
        + reference("r", connector("x", "inout"))
    )
    links = connection("chassis.x", "r.x", linear(2, 5)) + connection("r.x", "wheel.x_c")
    text = ssd(system(parts, links) + defined(f">{dictionary(signal('x', 'mm'), units)}"))
    (one,) = packages.read(text).system.connections
    assert (one.factor, one.offset) == (pytest.approx(2.0), pytest.approx(0.005))


def test_a_signal_that_nobody_gives_is_noted(packages: Packages) -> None:
    """A value that is bound to the entry is the start value of what it leads to."""
    parts = component("wheel", INPUTS) + reference("r", connector("x", "output"))
    links = connection("r.x", "wheel.x_c")
    more = defined(f">{dictionary(signal('x'))}")
    read = packages.read(ssd(system(parts, links) + more))
    assert "nothing drives entry 'x' of signal dictionary 'bus'" in read.notes[0]
    given = parts.replace(
        "</ssd:Connectors></ssd:SignalD",
        f"</ssd:Connectors>{bindings(binding(real('x', 4)))}</ssd:SignalD",
    )
    read = packages.read(ssd(system(given, links) + more))
    assert read.system.slaves["wheel"].parameters == {"x_c": 4.0}
    assert read.notes == ()


@pytest.mark.parametrize(
    ("parts", "links", "told"),
    [
        (reference("r", connector("y", "inout")), "", "'bus' has no entry 'y'"),
        (
            reference("r", connector("x", "inout")).replace('"bus"', '"buss"'),
            "",
            "no signal dictionary 'buss'; did you mean 'bus'?",
        ),
        (
            reference("r", connector("x", "inout")) + CHASSIS,
            connection("chassis.x", "r.x") + connection("chassis.v", "r.x"),
            "entry 'x' of signal dictionary 'bus' has two sources",
        ),
        (
            reference("r", connector("x", "inout")) + reference("q", connector("x", "inout")),
            connection("r.x", "q.x"),
            "a connection of kinds 'inout' and 'inout' has no direction",
        ),
    ],
)
def test_references_that_fit_nothing_are_refused(
    packages: Packages, parts: str, links: str, told: str
) -> None:
    """With the line."""
    refused = packages.refusal(ssd(system(parts, links) + defined(f">{dictionary(signal('x'))}")))
    assert told in refused
    assert "SystemStructure.ssd, line " in refused


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


def entry(source: str, target: str, inner: str = "") -> str:
    """A mapping entry."""
    return f'<ssm:MappingEntry source="{source}" target="{target}">{inner}</ssm:MappingEntry>'


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
        (
            ssd(system(component("wheel", connector("x_c", "input", "furlong")))),
            "unit 'furlong' is not in the Units of the file",
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
        ('<ssd:ParameterBinding source="a.ssv" sourceBase="component"/>', "sourceBase"),
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
    assert any("'extra/com.example/a.txt' is not carried" in note for note in notes)
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
    monkeypatch.setattr("master_node.ssp.graph.MAX_EDGES", 100)
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
    """Whether a description is read or refused, with FMUs of all types for its components."""
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
