"""SSP: connections through nested systems, mappings, arrays, signal dictionaries."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree

from master_node import simulate
from master_node.system.ssp.structure import Linear, Table, Unit
from tests.support.ssp_documents import (
    CHASSIS,
    DIRECT,
    ENTRIES,
    GEAR,
    INPUTS,
    MATRIX,
    MODE,
    NAMESPACES,
    NESTED,
    PASSED,
    SCHEMAS,
    SUPPRESSED,
    UNITS,
    VECTOR,
    WHEEL,
    WHOLE_WHEEL,
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
    dictionary,
    linear,
    pairs,
    passing,
    real,
    reference,
    signal,
    ssd,
    system,
    table,
    through,
)


@pytest.fixture
def packages(tmp_path: Path, fmu_dir: Path) -> Packages:
    """A folder for packages."""
    return Packages(tmp_path, fmu_dir)


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
    """One connection transforms as all on the way do, one after the other."""
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


SIZED = '<ssc:Float64/><ssc:Dimension sizeConnector="n"/>'


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
