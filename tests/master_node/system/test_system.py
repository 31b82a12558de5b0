"""From names to index arrays: `resolve`, and every connection that cannot be."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from master_node import System
from master_node.coupling.coupled_system import CoupledSystem, resolve
from protocol.description import SlaveDescription
from protocol.errors import ConfigurationError
from protocol.variables import Causality, Unit, Variable, VariableType
from tests.support.quarter_car_case import STATES, car, load_slave

INPUT, OUTPUT, LOCAL = Causality.INPUT, Causality.OUTPUT, Causality.LOCAL


SECOND = (0, 0, 1, 0, 0, 0, 0, 0)
KELVIN = (0, 0, 0, 0, 1, 0, 0, 0)


def described(
    inputs: str = "",
    outputs: str = "",
    *others: Variable,
    feed_through: Mapping[str, tuple[str, ...]] | None = None,
    initial: Mapping[str, tuple[str, ...]] | None = None,
) -> SlaveDescription:
    """A slave with these inputs and outputs; feed-through holds in initialization mode too."""
    return SlaveDescription(
        model="test",
        kind="test",
        variables=(
            *(Variable(name, INPUT, start=0.0) for name in inputs.split()),
            *(Variable(name, OUTPUT) for name in outputs.split()),
            *others,
        ),
        feed_through=feed_through or {},
        initial_feed_through=feed_through or {} if initial is None else initial,
    )


def resolved(
    descriptions: Mapping[str, SlaveDescription],
    *connections: tuple[str, str],
    slaves: Mapping[str, Any] | None = None,
    **simulation: Any,
) -> CoupledSystem:
    """The system with these slaves and connections."""
    system = System(
        simulation={"stop_time": 1.0, **simulation},
        slaves={name: (slaves or {}).get(name, {}) for name in descriptions},
        connections=connections,
        source="car.toml",
    )
    return resolve(system, descriptions)


TWO = {"a": described("u w", "y z"), "b": described("u", "y")}

# ---- Index arrays -------------------------------------------------------------------------------


def test_indices_of_the_quarter_car(tmp_path: Any) -> None:
    """The inputs are y[source], outputs in the order of the slaves and of their variables."""
    system = car()
    descriptions = {
        name: load_slave(str(slave.model), system.base, name, tmp_path).description
        for name, slave in system.slaves.items()
    }
    coupled = resolve(system, descriptions)
    assert coupled.output_names == STATES
    assert coupled.output_units == ("m", "m/s", "m", "m/s")
    chassis, wheel = coupled.parts
    assert (chassis.inputs, wheel.inputs) == (("x_w", "v_w"), ("x_c", "v_c"))
    assert (chassis.input_slice, wheel.input_slice) == (slice(0, 2), slice(2, 4))
    assert (chassis.output_slice, wheel.output_slice) == (slice(0, 2), slice(2, 4))
    assert coupled.source.tolist() == [2, 3, 0, 1]
    assert coupled.output_slave.tolist() == [0, 0, 1, 1]
    assert not coupled.feed_through.any()
    assert coupled.initialization.loop == ()


@given(st.data())
def test_every_input_gets_the_output_that_is_connected_to_it(data: st.DataObject) -> None:
    """Law: in any system, in whatever order its connections are written, u = y[source] is right."""
    names = data.draw(st.lists(st.sampled_from("abcdef"), min_size=1, max_size=4, unique=True))
    variables = st.lists(st.sampled_from("pqrst"), min_size=1, max_size=3, unique=True)
    descriptions = {
        name: described(
            " ".join(f"u_{v}" for v in data.draw(variables)),
            " ".join(f"y_{v}" for v in data.draw(variables)),
        )
        for name in names
    }
    outputs = [f"{s}.{v.name}" for s, d in descriptions.items() for v in d.of(OUTPUT)]
    inputs = [f"{s}.{v.name}" for s, d in descriptions.items() for v in d.of(INPUT)]
    connected = data.draw(st.permutations(inputs))[: data.draw(st.integers(0, len(inputs)))]
    feeding = {name: data.draw(st.sampled_from(outputs)) for name in connected}
    coupled = resolved(descriptions, *((source, target) for target, source in feeding.items()))

    assert list(coupled.output_names) == outputs
    assert sum(len(part.inputs) for part in coupled.parts) == len(coupled.source) == len(feeding)
    for index, part in enumerate(coupled.parts):
        assert part.name == list(descriptions)[index]
        for name, source in zip(part.inputs, coupled.source[part.input_slice], strict=True):
            assert coupled.output_names[source] == feeding[f"{part.name}.{name}"]
        mine = coupled.output_names[part.output_slice]
        assert mine == tuple(f"{part.name}.{name}" for name in part.outputs)
        assert (coupled.output_slave[part.output_slice] == index).all()


def test_inputs_that_nobody_feeds_keep_their_start_values() -> None:
    """They are no part of u; connected ones have their start values for the first round."""
    descriptions = {
        "a": described("", "y"),
        "b": described(
            "", "", Variable("free", INPUT, start=3.0), Variable("fed", INPUT, start=7.0)
        ),
    }
    coupled = resolved(descriptions, ("a.y", "b.fed"))
    assert coupled.parts[1].inputs == ("fed",)
    assert coupled.parts[1].input_starts.tolist() == [7.0]
    assert coupled.parts[1].outputs == ()


def test_names_may_hold_dots() -> None:
    """The longest slave name for which there is such a variable is meant."""
    descriptions = {
        "a": described("b.u", "b.y"),
        "a.b": described("u", "y"),
        "c": described("u w", ""),
    }
    coupled = resolved(descriptions, ("a.b.y", "c.u"), ("a.b.y", "a.b.u"))
    assert [coupled.output_names[i] for i in coupled.source] == ["a.b.y", "a.b.y"]
    assert coupled.output_slave[coupled.source].tolist() == [1, 1]
    assert [part.inputs for part in coupled.parts] == [(), ("u",), ("u",)]


def test_outputs_that_are_not_continuous_and_real_take_no_part() -> None:
    """Integers, booleans and discrete reals are neither extrapolated nor controlled."""
    descriptions = {
        "a": described(
            "",
            "y",
            Variable("gear", OUTPUT, VariableType.INTEGER, "discrete"),
            Variable("mode", OUTPUT, VariableType.REAL, "discrete"),
            Variable("on", OUTPUT, VariableType.BOOLEAN, "discrete"),
        )
    }
    assert resolved(descriptions).output_names == ("a.y",)


# ---- Tolerances ---------------------------------------------------------------------------------


def test_the_nearest_tolerance_counts_and_nominals_scale_the_absolute_one() -> None:
    """Tolerances are the variable's, else the slave's, else the run's; ATOL times the nominal."""
    descriptions = {
        "a": described("", "x", Variable("F", OUTPUT, nominal=1e3)),
        "b": described("", "x y", Variable("F", OUTPUT, nominal=1e3)),
    }
    coupled = resolved(
        descriptions,
        relative_tolerance=1e-3,
        absolute_tolerance=1e-4,
        slaves={
            "b": {
                "relative_tolerance": 1e-5,
                "absolute_tolerance": 1e-6,
                "tolerances": {
                    "y": {"relative": 0.0},
                    "F": {"absolute": 1e-8},
                },
            }
        },
    )
    assert coupled.output_names == ("a.x", "a.F", "b.x", "b.y", "b.F")
    assert coupled.relative_tolerance.tolist() == [1e-3, 1e-3, 1e-5, 0.0, 1e-5]
    expected = [1e-4, 1e-1, 1e-6, 1e-6, 1e-5]
    assert coupled.absolute_tolerance == pytest.approx(expected, rel=1e-15)


# ---- Feed-through and levels --------------------------------------------------------------------


def test_feed_through_counts_for_connected_inputs_only() -> None:
    """P = k + 1 only where an output contains an input that is extrapolated."""
    spring = described("x v", "F", feed_through={"F": ("x", "v")})
    descriptions = {"a": described("", "y"), "spring": spring}
    assert not resolved(descriptions).feed_through.any()
    assert resolved(descriptions, ("a.y", "spring.v")).feed_through.any()
    unrelated = described("x v", "F", feed_through={"F": ("x",)})
    coupled = resolved({"a": described("", "y"), "spring": unrelated}, ("a.y", "spring.v"))
    assert not coupled.feed_through.any()


def test_levels_follow_the_feed_through_across_slaves() -> None:
    """An output is one level above the highest output that it contains, through any slaves."""
    gain = {"feed_through": {"y": ("u",)}}
    descriptions = {
        "last": described("u", "y", **gain),
        "first": described("", "y"),
        "middle": described("u", "y z", **gain),
    }
    coupled = resolved(descriptions, ("first.y", "middle.u"), ("middle.y", "last.u"))
    levels = dict(zip(coupled.output_names, coupled.initialization.levels.tolist(), strict=True))
    assert levels == {"first.y": 0, "middle.z": 0, "middle.y": 1, "last.y": 2}
    assert coupled.initialization.loop == ()


@given(st.data())
def test_levels_are_consistent_in_any_system_without_a_loop(data: st.DataObject) -> None:
    """Law: level l contains outputs of lower levels only, and the lowest level is 0."""
    n = data.draw(st.integers(1, 6))
    order = data.draw(st.permutations(range(n)))
    descriptions = {
        f"s{i}": described("u w", "y", feed_through={"y": data.draw(st.sampled_from([(), ("u",)]))})
        for i in order
    }
    connections = [(f"s{data.draw(st.integers(0, i - 1))}.y", f"s{i}.u") for i in range(1, n)] + [
        (f"s{data.draw(st.integers(0, n - 1))}.y", f"s{i}.w") for i in range(n)
    ]
    coupled = resolved(descriptions, *connections)
    levels = dict(zip(coupled.output_names, coupled.initialization.levels.tolist(), strict=True))
    feeding = {target: source for source, target in connections}
    for i in range(n):
        contains = descriptions[f"s{i}"].feed_through["y"] and feeding.get(f"s{i}.u")
        assert levels[f"s{i}.y"] == (levels[str(contains)] + 1 if contains else 0)


def test_an_algebraic_loop_is_named() -> None:
    """A loop across slaves in initialization mode is found, and told along its connections."""
    gain = described("u", "y", feed_through={"y": ("u",)})
    coupled = resolved({"a": gain, "b": gain, "c": gain}, ("a.y", "b.u"), ("b.y", "a.u"))
    assert coupled.initialization.levels.size == 0
    assert len(coupled.initialization.loop) == 3
    assert set(coupled.initialization.loop) == {"a.y", "b.y"}
    assert coupled.initialization.loop[0] == coupled.initialization.loop[-1]


def test_a_loop_only_in_initialization_mode_is_one_there_only() -> None:
    """ModelStructure tells the two modes apart, and so do we."""
    gain = described("u", "y", initial={"y": ("u",)})
    coupled = resolved({"a": gain, "b": gain}, ("a.y", "b.u"), ("b.y", "a.u"))
    assert coupled.initialization.loop
    assert not coupled.feed_through.any()


def test_a_cycle_of_connections_without_feed_through_is_no_loop() -> None:
    """The quarter car's displacements: each slave feeds the other, nothing is implicit."""
    coupled = resolved(TWO, ("a.y", "b.u"), ("b.y", "a.u"))
    assert coupled.initialization.loop == ()
    assert coupled.initialization.levels.tolist() == [0, 0, 0]
    assert np.issubdtype(coupled.source.dtype, np.integer)


# ---- Mistakes -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("connection", "words"),
    [
        (("c.y", "b.u"), "from = 'c.y': no slave 'c'; there is 'a', 'b'"),
        (("a.y", "bb.u"), "to = 'bb.u': no slave 'bb'; did you mean 'b'?"),
        (("a.x", "b.u"), "from = 'a.x': a has no variable 'x'; there is "),
        (("a.y", "b.uu"), "to = 'b.uu': b has no variable 'uu'; did you mean 'u'?"),
        (("a.u", "b.u"), "from = 'a.u' is not an output but of causality input; there is 'y', 'z'"),
        (("a.y", "b.y"), "to = 'b.y' is not an input but of causality output; there is 'u'"),
        (("b.y", "b.y"), "to = 'b.y' is not an input but of causality output"),
    ],
)
def test_wrong_connections_name_the_nearest_right_one(
    connection: tuple[str, str], words: str
) -> None:
    """File, which connection, which end of it, and what there is instead."""
    expected = f"^{re.escape(f'car.toml: [[connections]] number 2: {words}')}"
    with pytest.raises(ConfigurationError, match=expected):
        resolved(TWO, ("a.y", "a.w"), connection)


def test_an_input_driven_twice() -> None:
    """The second driver is refused and both are named, even if they are the same."""
    for second in ("b.y", "a.y"):
        with pytest.raises(
            ConfigurationError,
            match=rf"number 3: a\.u is driven twice: by a\.y and by {second}$",
        ):
            resolved(TWO, ("a.y", "a.u"), ("a.y", "b.u"), (second, "a.u"))


@pytest.mark.parametrize(
    ("output", "input_", "words"),
    [
        (
            Variable("y", OUTPUT),
            Variable("u", INPUT, VariableType.INTEGER, "discrete"),
            "a.y is of type Real, b.u of type Integer, and values could be lost",
        ),
        (
            Variable("y", OUTPUT, VariableType.STRING, "discrete"),
            Variable("u", INPUT, VariableType.BOOLEAN, "discrete"),
            "a.y is of type String, b.u of type Boolean, and values could be lost",
        ),
    ],
)
def test_types_must_match(output: Variable, input_: Variable, words: str) -> None:
    """Both ends are named with their types where a value could be lost."""
    descriptions = {"a": described("", "x", output), "b": described("", "", input_)}
    with pytest.raises(ConfigurationError, match=re.escape(f"number 1: {words}")):
        resolved(descriptions, ("a.y", "b.u"))


def test_what_is_not_continuous_goes_beside() -> None:
    """Discrete variables have their own indices, and reach inputs by casts that lose nothing."""
    descriptions = {
        "a": described(
            "",
            "x",
            Variable("n", OUTPUT, VariableType.INTEGER, "discrete"),
            Variable("on", OUTPUT, VariableType.BOOLEAN, "discrete"),
        ),
        "b": described(
            "",
            "y",
            Variable("n", INPUT, VariableType.INT64, "discrete"),
            Variable("level", INPUT),
            Variable("sampled", INPUT, variability="discrete"),
        ),
    }
    coupled = resolved(descriptions, ("a.n", "b.n"), ("a.on", "b.level"), ("a.x", "b.sampled"))
    assert coupled.output_names == ("a.x", "b.y")
    assert coupled.discrete.names == ("a.n", "a.on")
    assert coupled.parts[1].inputs == ()
    assert coupled.parts[1].discrete_inputs == ("n", "level", "sampled")
    values = coupled.discrete.held(np.array([2.5, 7.0]), (3, True), 0.0)[1]
    assert values == (3, 1.0, 2.5)
    assert [type(value) for value in values] == [int, float, float]


def test_arrays_are_connected_element_by_element() -> None:
    """The name of an array stands for its elements in order; sizes must agree."""
    elements = [f"A[{i},{j}]" for i in (1, 2) for j in (1, 2, 3)]
    descriptions = {
        "a": described("", " ".join(elements)),
        "b": described(" ".join(elements), "y"),
        "c": described("A[1] A[2]", ""),
    }
    coupled = resolved(descriptions, ("a.A", "b.A"))
    assert coupled.parts[1].inputs == tuple(elements)
    assert [coupled.output_names[i] for i in coupled.source] == [f"a.{name}" for name in elements]
    with pytest.raises(ConfigurationError, match=re.escape("elements up to [2,3], c.A has")):
        resolved(descriptions, ("a.A", "c.A"))


def test_units_are_converted() -> None:
    """U = factor y + offset by both units' definitions; weights keep their meaning."""
    millimetre, celsius = Unit((0, 1, 0, 0, 0, 0, 0, 0), 1e-3), Unit(KELVIN, 1.0, 273.15)
    source = replace(
        described("", "", Variable("x", OUTPUT, unit="mm"), Variable("T", OUTPUT, unit="degC")),
        units={"mm": millimetre, "degC": celsius},
    )
    target = replace(
        described("", "y", Variable("x", INPUT, unit="m"), Variable("T", INPUT, unit="K")),
        units={"m": Unit((0, 1, 0, 0, 0, 0, 0, 0)), "K": Unit(KELVIN)},
    )
    coupled = resolved({"a": source, "b": target}, ("a.x", "b.x"), ("a.T", "b.T"))
    y = np.array([[1500.0, 20.0, 0.0], [4.0, 5.0, 0.0]])
    assert coupled.inputs_of(y[0]).tolist() == [1.5, 293.15]
    assert coupled.inputs_of(y).tolist() == [[1.5, 293.15], [0.004, 5.0]]
    assert coupled.scale_of_inputs(np.array([1.0, 1.0, 1.0])).tolist() == [0.001, 1.0]


@pytest.mark.parametrize(
    ("settings", "u"), [({"ignore_units": True}, 3.0), ({"factor": 2.0, "offset": 1.0}, 7.0)]
)
def test_a_connection_can_say_how_to_convert(settings: dict[str, Any], u: float) -> None:
    """``factor`` and ``offset`` are the whole transformation; ``ignore_units`` is none."""
    source = replace(described("", "", Variable("x", OUTPUT, unit="s")), units={"s": Unit(SECOND)})
    target = replace(described("", "y", Variable("u", INPUT, unit="K")), units={"K": Unit(KELVIN)})
    descriptions = {"a": source, "b": target}
    with pytest.raises(ConfigurationError, match="'s' is s, 'K' is K"):
        resolved(descriptions, ("a.x", "b.u"))
    system = System(
        simulation={"stop_time": 1.0},
        slaves={"a": {}, "b": {}},
        connections=[{"from": "a.x", "to": "b.u", **settings}],
    )
    assert resolve(system, descriptions).inputs_of(np.array([3.0, 0.0])).tolist() == [u]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            {"parameters": {"yy": 1.0}},
            "[slaves.b.parameters] 'yy': no such variable; did you mean 'y'?",
        ),
        (
            {"tolerances": {"u": {"relative": 1.0}}},
            "[slaves.b.tolerances] 'u': no such variable; there is 'y'",
        ),
    ],
)
def test_unknown_variables_in_a_slaves_table(settings: dict[str, Any], words: str) -> None:
    """Parameters may be any variable, tolerances belong to outputs."""
    with pytest.raises(ConfigurationError, match=re.escape(f"car.toml: {words}")):
        resolved(TWO, slaves={"b": settings})
