"""SSP: what is exported is imported as it was, and what cannot be exported is named."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import fmpy.ssp.ssd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lxml import etree

from master_node import System, load_system
from master_node.system.files import export_system, import_system, read_ssp
from master_node.system.ssp.writing import write_package
from protocol.errors import ConfigurationError
from tests.support.quarter_car_case import EXAMPLES
from tests.support.ssp_documents import (
    NESTED,
    SCHEMAS,
    WHEEL,
    Packages,
    described,
    ssd,
    system,
    tables,
)


@pytest.fixture
def packages(tmp_path: Path, fmu_dir: Path) -> Packages:
    """A folder for packages."""
    return Packages(tmp_path, fmu_dir)


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
    read = packages.read_file(package, package_bus=True)
    assert read.notes == ()
    assert tables(read.system) == given
    assert import_system(package, packages.folder / "again.toml", package_bus=True) == ()
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
    read = read_ssp(folder / "law.ssp", folder / "scratch", package_bus=True)
    assert tables(read.system) == with_whole_transformations(tables(system))
    assert read.notes == ()


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
