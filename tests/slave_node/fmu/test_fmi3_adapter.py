"""Laws of `Fmi3Slave`, and of values of all types, over real FMUs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from io import StringIO
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from rich.console import Console

from protocol.calls import Configure, Initialize, StepStatus
from protocol.description import InputDerivatives
from protocol.errors import ModelError, SlaveError
from protocol.signals import InputSignal
from protocol.slave import Slave
from protocol.step_sums import step_to
from protocol.variables import Causality, StartValue, VariableType
from slave_node.fmu.description import describe_fmu
from slave_node.fmu.loading import load_fmu
from slave_node.loading import load_slave
from slave_node.validation.report import description_tables

Load = Callable[..., Slave]

CONTINUOUS = {"chassis": ("x_w", "v_w"), "wheel": ("x_c", "v_c")}


@pytest.fixture
def load(capability_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Load]:
    """``load(model)`` instantiates an FMU by name; freed after the test."""
    slaves: list[Slave] = []

    def make(model: str, structural_parameters: Mapping[str, StartValue] | None = None) -> Slave:
        slaves.append(
            load_fmu(
                capability_dir / f"{model}.fmu",
                tmp_path_factory.mktemp("scratch"),
                model,
                structural_parameters=structural_parameters,
            )
        )
        return slaves[-1]

    yield make
    for slave in slaves:
        slave.close()


def initialized(
    slave: Slave,
    *,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    discrete_inputs: Sequence[str] = (),
    discrete_outputs: Sequence[str] = (),
    early_return: bool = False,
    start_values: Mapping[str, StartValue] | None = None,
) -> Slave:
    """The slave in initialization mode."""
    slave.initialize(
        Initialize(
            start_time=0.0,
            stop_time=None,
            relative_tolerance=1e-9,
            start_values=start_values or {},
            inputs=inputs,
            outputs=outputs,
            discrete_inputs=discrete_inputs,
            discrete_outputs=discrete_outputs,
            early_return=early_return,
        )
    )
    return slave


def started(slave: Slave, **arguments: object) -> Slave:
    """The slave at its first communication point, t = 0."""
    initialized(slave, **arguments)  # type: ignore[arg-type]
    slave.exit_initialization_mode()
    return slave


def half_of_a_car(load: Load, name: str) -> Slave:
    """A half of the quarter car with inputs and outputs, disturbed."""
    inputs = CONTINUOUS[name.partition("_")[0]]
    return started(load(name), inputs=inputs, outputs=("x", "v"), start_values={"x": 0.1})


def polynomial(order: int) -> np.ndarray:
    """Some inputs that matter, shape (order + 1, 2)."""
    rows = np.array([[0.05, 0.3], [-0.2, 0.7], [3.0, -4.0], [-20.0, 30.0]])
    return rows[: order + 1]


def march(slave: Slave, begin: float = 0.0, order: int = 0, output_order: int = 0) -> bytes:
    """All that is seen over some steps, bit for bit."""
    seen, t = [], begin
    for i in range(4):
        slave.set_inputs(polynomial(order) * math.cos(i))
        status, t = slave.do_step(t, 0.01 * (i + 1), False)
        assert status is StepStatus.OK
        seen.append(slave.get_outputs(output_order).tobytes())
    return b"".join(seen)


# ---- The quarter car in FMI 3.0 ----------------------------------------------------------------


@pytest.mark.parametrize("half", CONTINUOUS)
def test_the_version_of_fmi_makes_no_difference(load: Load, half: str) -> None:
    """Equal equations with held inputs give equal bits in FMI 2.0 and 3.0."""
    expected = march(half_of_a_car(load, f"{half}_no_derivatives"))
    for variant in ("fmi3", "fmi3_bare"):
        slave = half_of_a_car(load, f"{half}_{variant}")
        assert slave.description.kind == "FMI 3.0 co-simulation"
        assert march(slave) == expected


def test_the_description_says_what_the_file_says(capability_dir: Path) -> None:
    """Variables, feed-through, units, step sizes and capabilities of FMI 3.0."""
    wheel = describe_fmu(capability_dir / "wheel_fmi3.fmu")
    assert wheel.variable("m").type is VariableType.FLOAT64
    assert wheel.variable("m").unit == "kg"
    assert wheel.units["N.s/m"].exponents == (1, 0, -1, 0, 0, 0, 0, 0)
    outputs = [v.name for v in wheel.variables if v.causality is Causality.OUTPUT]
    assert wheel.feed_through.keys().isdisjoint(outputs)
    assert wheel.default_step_size == 0.001
    assert wheel.fixed_step_size is None
    assert wheel.capabilities.can_get_and_set_state
    assert wheel.capabilities.max_output_derivative_order == 1
    assert wheel.input_derivatives is InputDerivatives.NONE
    assert wheel.variable("time").causality is Causality.INDEPENDENT
    bare = describe_fmu(capability_dir / "wheel_fmi3_bare.fmu")
    assert (bare.state_kind, bool(bare.state_reason)) == ("none", True)
    assert describe_fmu(capability_dir / "fixed_step_fmi3.fmu").fixed_step_size == 0.01
    assert describe_fmu(capability_dir / "fixed_step.fmu").fixed_step_size == 0.01
    millimetres = describe_fmu(capability_dir / "units_millimetres.fmu")
    assert millimetres.units["mm"].factor == 0.001
    assert millimetres.units["degC"].offset == 273.15


def test_output_derivatives_are_those_of_the_model(load: Load) -> None:
    """Row 1 is (v, v'): the velocity is the slope of the position, bit for bit."""
    slave = half_of_a_car(load, "wheel_fmi3")
    march(slave)
    y = slave.get_outputs(1)
    assert y[1, 0] == y[0, 1]
    assert y[1, 1] != 0.0
    with pytest.raises(SlaveError, match="order 2 asked for"):
        slave.get_outputs(2)


@pytest.mark.parametrize("variant", ["fmi3", "fmi3_intermediate"])
@pytest.mark.parametrize("half", CONTINUOUS)
def test_a_restored_state_repeats_bit_for_bit(load: Load, half: str, variant: str) -> None:
    """The inputs' polynomials belong to the state: what was set in between leaves no trace."""
    order = 3 if variant.endswith("intermediate") else 0
    slave = half_of_a_car(load, f"{half}_{variant}")
    march(slave, order=order)
    slave.set_inputs(polynomial(order))
    state = slave.get_state()
    slave.do_step(0.1, 0.05, False)
    first = slave.get_outputs(1).tobytes()
    slave.set_inputs(-polynomial(0))
    slave.set_state(state)
    slave.do_step(0.1, 0.05, False)  # with the inputs of the saved state
    assert slave.get_outputs(1).tobytes() == first

    data = slave.serialize_state(state)
    slave.free_state(state)
    other = half_of_a_car(load, f"{half}_{variant}")
    restored = other.deserialize_state(data)
    assert other.serialize_state(restored) == data
    other.set_state(restored)
    other.do_step(0.1, 0.05, False)
    assert other.get_outputs(1).tobytes() == first
    other.free_state(restored)


def test_bytes_that_are_no_state_are_refused(load: Load) -> None:
    """Too few, of something else, and damaged ones; without harm."""
    slave = half_of_a_car(load, "wheel_fmi3")
    state = slave.get_state()
    data = bytearray(slave.serialize_state(state))
    data[-1] ^= 1
    for wrong in (b"", bytes(1000), bytes(data)):
        with pytest.raises(SlaveError, match="state"):
            slave.deserialize_state(wrong)
    slave.free_state(state)
    march(slave)


# ---- Inputs within a step ----------------------------------------------------------------------


@pytest.mark.parametrize("order", [1, 2, 3])
def test_intermediate_updates_follow_the_polynomial(load: Load, order: int) -> None:
    """One step on a polynomial is that of FMI 2.0 with derivatives, to the internal solver's
    accuracy; and the highest derivative matters.
    """
    slave = half_of_a_car(load, "wheel_fmi3_intermediate")
    assert slave.description.input_derivatives is InputDerivatives.NATIVE
    assert slave.description.capabilities.can_interpolate_inputs
    exact = half_of_a_car(load, "wheel_no_state")
    lower = half_of_a_car(load, "wheel_fmi3_intermediate")
    slave.set_inputs(polynomial(order))
    exact.set_inputs(polynomial(order))
    lower.set_inputs(polynomial(order - 1))
    outputs = []
    for one in (slave, exact, lower):
        assert one.do_step(0.0, 0.08, False) == (StepStatus.OK, 0.08)
        outputs.append(one.get_outputs(0)[0])
    np.testing.assert_allclose(outputs[0], outputs[1], rtol=1e-6, atol=2e-7)
    assert np.abs(outputs[0] - outputs[2]).max() > 1e-6


def test_a_polynomial_goes_on_beyond_the_step(load: Load) -> None:
    """Two steps on one polynomial are the same as with its continuation set in between."""
    once, twice = (half_of_a_car(load, "wheel_fmi3_intermediate") for _ in range(2))
    signal = InputSignal(polynomial(3))
    for slave in (once, twice):
        slave.set_inputs(signal.derivatives)
        slave.do_step(0.0, 0.05, False)
    twice.set_inputs(signal.shifted(0.05).derivatives)
    for slave in (once, twice):
        slave.do_step(0.05, 0.05, False)
    np.testing.assert_allclose(once.get_outputs(0), twice.get_outputs(0), rtol=1e-12)


def test_an_error_within_an_update_comes_out(load: Load, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing may be raised through C: the step itself fails with it, and the next one works."""
    slave = half_of_a_car(load, "wheel_fmi3_intermediate")
    state = slave.get_state()
    with monkeypatch.context() as patch:
        patch.setattr(InputSignal, "at", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            slave.do_step(0.0, 0.01, False)
    slave.set_state(state)
    assert slave.do_step(0.0, 0.01, False) == (StepStatus.OK, 0.01)
    slave.free_state(state)


# ---- Values of all types -----------------------------------------------------------------------

SCALARS: dict[str, tuple[StartValue, StartValue]] = {
    "int8": (-128, -127),
    "uint8": (255, 0),
    "int16": (32767, -32768),
    "uint16": (65535, 0),
    "int32": (2**31 - 1, -(2**31)),
    "uint32": (2**32 - 1, 0),
    "int64": (-(2**63), 1 - 2**63),
    "uint64": (2**64 - 1, 0),
    "boolean": (True, False),
    "string": ("Füße 走", "got Füße 走"),
    "binary": (b"\x00\x01\xff", b"\xff\x01\x00"),
    "enumeration": (3, 1),
    "float32": (0.1, 2.0 * float(np.float32(0.1))),
}
"""Inputs at the limits, and outputs by the FMU's rules."""


def test_values_of_all_types_make_the_round_trip(load: Load) -> None:
    """Every integer at its limits, text beyond ASCII, bytes with zeros: in order, bit for bit."""
    names = list(reversed(SCALARS))
    slave = initialized(
        load("all_types3"),
        discrete_inputs=[f"{name}_in" for name in names],
        discrete_outputs=[f"{name}_out" for name in names],
    )
    slave.set_discrete_inputs([SCALARS[name][0] for name in names])
    values = slave.get_discrete_outputs()  # in initialization mode
    assert list(values) == [SCALARS[name][1] for name in names]
    assert [type(value) for value in values] == [type(SCALARS[name][1]) for name in names]
    slave.exit_initialization_mode()
    slave.set_discrete_inputs([_other(SCALARS[name][0]) for name in names])
    assert slave.get_discrete_outputs() != values
    slave.set_discrete_inputs([SCALARS[name][0] for name in names])
    assert slave.get_discrete_outputs() == values
    slave.set_discrete_inputs([b"" if name == "binary" else SCALARS[name][0] for name in names])
    assert slave.get_discrete_outputs()[names.index("binary")] == b""


def _other(value: StartValue) -> StartValue:
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return "other"
    if isinstance(value, bytes):
        return b"other"
    return 1


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("int8_in", 128, "'int8_in' is of type Int8, -128 to 127; it cannot be 128"),
        ("uint64_in", -1, "'uint64_in' is of type UInt64, 0 to 18446744073709551615"),
        ("int32_in", True, "'int32_in' is of type Int32, .* it cannot be True"),
        ("int32_in", 1.0, "'int32_in' is of type Int32, .* it cannot be 1.0"),
        ("boolean_in", 1, "'boolean_in' is of type Boolean; it cannot be 1"),
        ("string_in", b"text", "'string_in' is of type String; it cannot be b'text'"),
        ("string_in", "a\0b", "'string_in' is of type String"),
        ("binary_in", "text", "'binary_in' is of type Binary; it cannot be 'text'"),
        ("enumeration_in", "red", "'enumeration_in' is of type Enumeration"),
        ("float32_in", math.nan, "'float32_in' cannot be NaN"),
        ("float32_in", "1", "'float32_in' is of type Float32; it cannot be '1'"),
    ],
)
def test_a_value_of_another_type_is_refused(
    load: Load, name: str, value: StartValue, message: str
) -> None:
    """With variable, type and value: nothing is cut off or converted silently."""
    slave = started(load("all_types3"), discrete_inputs=(name,))
    with pytest.raises(SlaveError, match=message):
        slave.set_discrete_inputs((value,))
    with pytest.raises(SlaveError, match="2 discrete values for 1 variables"):
        slave.set_discrete_inputs((value, value))
    # Start values of a system file are converted where nothing is lost: 1 is true, red an item.
    if not isinstance(value, float) and (name, value) not in (
        ("boolean_in", 1),
        ("enumeration_in", "red"),
    ):
        with pytest.raises(ModelError, match=message):
            initialized(load("all_types3"), start_values={name: value})


def test_start_values_of_all_types_arrive(load: Load) -> None:
    """Start values of inputs without a connection arrive, in all types."""
    slave = started(
        load("all_types3"),
        start_values={f"{name}_in": value for name, (value, _) in SCALARS.items()},
        discrete_outputs=[f"{name}_out" for name in SCALARS],
    )
    assert list(slave.get_discrete_outputs()) == [value for _, value in SCALARS.values()]


def test_single_precision_is_exchanged_with_the_continuous_variables(load: Load) -> None:
    """Float32 beside Float64 and elements of arrays in one call: each column is its variable."""
    slave = started(
        load("all_types3"),
        inputs=("matrix_in[2,3]", "float32_in", "float64_in", "matrix_in[1,1]"),
        outputs=("float32_out", "matrix_out[1,1]", "matrix_out[2,3]", "matrix_out[1,2]"),
        start_values={"matrix_in[1,2]": 7.0},
    )
    slave.set_inputs(np.array([[5.0, 0.1, 3.0, -1.0]]))
    y = slave.get_outputs(0)[0]
    np.testing.assert_array_equal(y, [2.0 * np.float32(0.1), -2.0, 10.0, 14.0])


def test_a_whole_number_is_no_continuous_variable(load: Load) -> None:
    """It is named with its type."""
    with pytest.raises(ModelError, match="'int8_in' is of type Int8; it is exchanged as a disc"):
        initialized(load("all_types3"), inputs=("int8_in",))
    with pytest.raises(ModelError, match="'float64_in' is listed twice"):
        initialized(load("all_types3"), inputs=("float64_in", "float64_in"))


FMI_2: dict[str, tuple[StartValue, StartValue]] = {
    "integer": (-(2**31), 1 - 2**31),
    "boolean": (True, False),
    "string": ("Füße", "got Füße"),
    "enumeration": (3, 1),
    "real_discrete": (0.1, 0.2),
}
"""Inputs, and outputs by the FMU's rules."""


def test_all_types_of_fmi_2(load: Load) -> None:
    """Integer, Boolean, String, Enumeration and discrete Real make the round trip."""
    slave = started(
        load("all_types2"),
        discrete_inputs=[f"{name}_in" for name in FMI_2],
        discrete_outputs=[f"{name}_out" for name in FMI_2],
    )
    slave.set_discrete_inputs([value for value, _ in FMI_2.values()])
    assert list(slave.get_discrete_outputs()) == [value for _, value in FMI_2.values()]
    with pytest.raises(SlaveError, match="-2147483648 to 2147483647; it cannot be 2147483648"):
        slave.set_discrete_inputs((2**31, False, "", 1, 0.0))
    with pytest.raises(SlaveError, match="'enumeration_in' is of type Enumeration"):
        slave.set_discrete_inputs((1, False, "", 2**31, 0.0))


# ---- Arrays and structural parameters ----------------------------------------------------------


def test_elements_of_arrays_are_variables(load: Load) -> None:
    """With their start values, indices from 1, row by row."""
    description = load("all_types3").description
    names = [v.name for v in description.variables if v.name.startswith("matrix_in")]
    assert names == [f"matrix_in[{i},{j}]" for i in (1, 2) for j in (1, 2, 3)]
    assert [v.name for v in description.variables if v.name.startswith("vector_out")] == [
        "vector_out[1]",
        "vector_out[2]",
        "vector_out[3]",
    ]


def test_a_part_of_an_array_leaves_the_rest(load: Load) -> None:
    """Setting one element, as start value or input, keeps the others where they are."""
    slave = started(
        load("all_types3"),
        inputs=("vector_in[2]",),
        outputs=("vector_out[1]", "vector_out[2]", "vector_out[3]"),
        start_values={"vector_in[1]": 10.0, "vector_in[3]": 30.0},
    )
    slave.set_inputs(np.array([[20.0]]))
    np.testing.assert_array_equal(slave.get_outputs(0), [[11.0, 21.0, 31.0]])
    with pytest.raises(ModelError, match=r"no variable 'vector_in\[4\]'"):
        initialized(load("all_types3"), start_values={"vector_in[4]": 1.0})


def test_a_structural_parameter_sets_the_size(load: Load) -> None:
    """The description has as many elements, and all of them are exchanged."""
    slave = load("all_types3", {"n": 5})
    assert slave.description.variable("n").start == 5
    names = [v.name for v in slave.description.of(Causality.INPUT) if "vector" in v.name]
    assert names == [f"vector_in[{i + 1}]" for i in range(5)]
    outputs = [name.replace("in", "out") for name in names]
    for _ in range(2):
        started(slave, inputs=names, outputs=outputs)
        slave.set_inputs(np.arange(5.0)[np.newaxis])
        np.testing.assert_array_equal(slave.get_outputs(0), [np.arange(5.0) + 1.0])
        slave.reset()  # also forgets the size, which initialization sets again
    partly = started(
        load("all_types3", {"n": 4}), start_values={"vector_in[4]": 4.0}, outputs=("vector_out[4]",)
    )
    assert partly.get_outputs(0) == 5.0


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"m": 3}, "no structural parameter 'm'; there is 'n'"),
        ({"n": -1}, "'n' is of type UInt64, 0 to 18446744073709551615; it cannot be -1"),
        ({"n": 3.0}, "'n' is of type UInt64, .* it cannot be 3.0"),
        ({"n": 10**9}, "more than 100000 variables"),
        ({"boolean_in": True}, "no structural parameter 'boolean_in'"),
    ],
)
def test_a_wrong_structural_parameter_is_named(
    load: Load, parameters: dict[str, StartValue], message: str
) -> None:
    """Before anything is loaded."""
    with pytest.raises(ModelError, match=message):
        load("all_types3", parameters)


def test_a_size_beyond_the_fmus_own_limit_is_its_refusal(load: Load) -> None:
    """With the FMU's own words."""
    slave = load("all_types3", {"n": 17})
    with pytest.raises(SlaveError, match="n is larger than 16"):
        initialized(slave)


def test_a_structural_parameter_is_no_start_value(load: Load) -> None:
    """The message says where it belongs; other models have none at all."""
    with pytest.raises(ModelError, match=r"'n' cannot be set here: .*configuration"):
        initialized(load("all_types3"), start_values={"n": 4})
    with pytest.raises(ModelError, match="no structural parameter 'n'; the FMU has none"):
        load("all_types2", {"n": 4})


def test_the_configuration_reaches_the_fmu(capability_dir: Path, tmp_path: Path) -> None:
    """By the way that a slave node takes."""
    slave = load_slave(
        "all_types3.fmu",
        capability_dir,
        "all",
        tmp_path,
        configuration=Configure(structural_parameters={"n": 2}),
    )
    assert len([v for v in slave.description.variables if v.name.startswith("vector_in")]) == 2
    slave.close()


def test_clocks_are_reported(load: Load) -> None:
    """In the description, for all who load the FMU to tell; they are not exchanged."""
    slave = load("all_types3")
    (remark,) = slave.description.remarks
    assert remark.startswith("clock ")
    assert "is ignored" in remark
    name = remark.split()[1]
    with pytest.raises(SlaveError, match="is of type Clock, which is not exchanged"):
        initialized(slave, discrete_outputs=(name,))


def test_inspection_shows_what_is_not_carried(capability_dir: Path) -> None:
    """Remarks and the only step size stand among what ``slave-node inspect`` shows."""
    for model, words in (
        ("all_types3", "clock clock (triggered) is ignored"),
        ("fixed_step_fmi3", "0.01"),
    ):
        console = Console(file=StringIO(), width=300)
        console.print(*description_tables(describe_fmu(capability_dir / f"{model}.fmu")))
        assert words in console.file.getvalue()  # type: ignore[attr-defined]


# ---- Events ------------------------------------------------------------------------------------

STAIR = 0.35
"""Distance of the steps of the staircase [s]."""


def staircase(time: float) -> float:
    """The lag behind the staircase at a time [s], from y(0) = 1."""
    y, t, level = 1.0, 0.0, 0
    while t + STAIR < time:
        y, t, level = level + (y - level) * math.exp(-STAIR / 0.5), t + STAIR, level + 1
    return level + (y - level) * math.exp(-(time - t) / 0.5)


@pytest.mark.parametrize("step_size", [0.1, 0.35, 1.0, 2.0])
def test_events_within_a_step_are_handled(load: Load, step_size: float) -> None:
    """Whatever the communication step, several events in one or one at its end."""
    slave = started(load("event_mode3"), outputs=("y",), discrete_outputs=("level",))
    t = 0.0
    while t < 2.0 - 1e-9:
        status, t = slave.do_step(t, step_size, False)
        assert status is StepStatus.OK
        np.testing.assert_allclose(slave.get_outputs(0)[0, 0], staircase(t), rtol=1e-12)
    assert slave.get_discrete_outputs() == (int((t + 1e-9) / STAIR),)


@pytest.mark.parametrize("name", ["event_mode3", "rounds_events3"])
@pytest.mark.parametrize("early_return", [False, True])
def test_events_a_rounding_beside_the_end_of_a_step(
    load: Load, name: str, early_return: bool
) -> None:
    """At the end of a step the level has risen, and the FMU is asked to go on from where it stands.

    3 times 0.35 s is a rounding before 1.05 s, and one of the FMUs rounds the other way: it returns
    early at an event that it comes to just beyond the end of the step.
    """
    slave = started(
        load(name), outputs=("y",), discrete_outputs=("level",), early_return=early_return
    )
    event = 3 * STAIR
    ends = {"event_mode3": 1.05, "rounds_events3": math.nextafter(event, 0.0)}
    assert ends[name] != event
    t = 0.0
    for end in (0.2, STAIR, 0.5, 2 * STAIR, 0.9, ends[name], 1.2, 4 * STAIR, 1.6):
        assert slave.do_step(t, step_to(t, end), False) == (StepStatus.OK, end)
        t = end
        assert slave.get_discrete_outputs() == (int((t + 1e-9) / STAIR),)
        np.testing.assert_allclose(slave.get_outputs(0)[0, 0], staircase(t), rtol=1e-12)


@pytest.mark.parametrize("early_return", [False, True])
def test_events_some_roundings_beside_the_end_of_a_step(load: Load, early_return: bool) -> None:
    """Early returns beyond the end by the roundings of many steps are ends of these steps.

    A communication point after n steps differs from the event by one rounding for each, as in a
    Reference FMU that is stepped 300 times by 0.01 s.
    """
    slave = started(
        load("rounds_events3"),
        outputs=("y",),
        discrete_outputs=("level",),
        early_return=early_return,
    )
    t, level = 0.0, 0
    for event in (STAIR, 2 * STAIR, 3 * STAIR):
        before = event - 30 * math.ulp(event)
        for end in (event - 0.1, before, before + 0.1):
            level += end == before
            assert slave.do_step(t, step_to(t, end), False) == (StepStatus.OK, end)
            t = end
            assert slave.get_discrete_outputs() == (level,)
            np.testing.assert_allclose(slave.get_outputs(0)[0, 0], staircase(t + 1e-14), rtol=1e-12)


def test_an_early_return_is_an_event_for_the_master(load: Load) -> None:
    """The step stops at the event; back and with a step up to it, it is over and done."""
    slave = started(
        load("event_mode3"), outputs=("y",), discrete_outputs=("level",), early_return=True
    )
    state = slave.get_state()
    status, event = slave.do_step(0.0, 1.0, False)
    assert (status, event) == (StepStatus.EARLY_RETURN, STAIR)
    slave.set_state(state)
    assert slave.do_step(0.0, event, False) == (StepStatus.OK, event)
    assert slave.get_discrete_outputs() == (1,)
    again = slave.get_state()
    assert slave.do_step(event, 1.0, False) == (StepStatus.EARLY_RETURN, 2 * STAIR)
    slave.set_state(again)
    assert slave.do_step(event, 0.1, False) == (StepStatus.OK, event + 0.1)
    np.testing.assert_allclose(slave.get_outputs(0)[0, 0], staircase(event + 0.1), rtol=1e-12)
    for saved in (state, again):
        slave.free_state(saved)


def test_a_state_knows_the_next_event(load: Load) -> None:
    """Events after a restored state come when they came before, bit for bit."""
    slave = started(load("event_mode3"), outputs=("y",))
    slave.do_step(0.0, 0.3, False)
    state = slave.get_state()
    seen = []
    for _ in range(2):
        slave.do_step(0.3, 0.5, False)
        slave.do_step(0.8, 0.9, False)
        seen.append(slave.get_outputs(0).tobytes())
        slave.set_state(state)
    assert seen[0] == seen[1]
    slave.free_state(state)


def test_a_wish_to_terminate_is_passed_on(load: Load) -> None:
    """With the time where the FMU stands; in FMI 2.0 that is the last successful time."""
    for name, expected in (("terminates3", 0.6), ("terminates2", 0.5)):
        slave = started(load(name), inputs=("u",), outputs=("y",))
        assert slave.do_step(0.0, 0.4, False) == (StepStatus.OK, 0.4)
        status, time = slave.do_step(0.4, 0.2, False)
        assert status is StepStatus.TERMINATED
        assert time == pytest.approx(expected, abs=1e-15)
        slave.get_outputs(0)


# ---- Refusals ----------------------------------------------------------------------------------


def test_a_missing_library_is_named(load: Load, tmp_path: Path) -> None:
    """The library and what to do; and the process stays in its folder."""
    before = Path.cwd()
    with pytest.raises(ModelError) as caught:
        load("missing_library")
    text = str(caught.value)
    assert "missing_library.fmu: needs the shared library libdoublestep_absent.so" in text
    assert "install" in text
    assert Path.cwd() == before


def test_a_missing_licence_is_told_in_the_words_of_the_fmu(load: Load) -> None:
    """The FMU's own log lines come with the refusal."""
    with pytest.raises(ModelError, match=r"licence_error\.fmu: fmi2Instantiate: .*log: .*licence"):
        load("licence_error")


def test_a_tool_that_is_not_here_is_the_remedy(capability_dir: Path, tmp_path: Path) -> None:
    """An FMU that needs its tool, and cannot be instantiated, says which tool it is."""
    fmu = tmp_path / "needs_tool.fmu"
    with ZipFile(capability_dir / "licence_error.fmu") as source, ZipFile(fmu, "w") as copy:
        for entry in source.infolist():
            data = source.read(entry)
            if entry.filename == "modelDescription.xml":
                data = data.replace(b'needsExecutionTool="false"', b'needsExecutionTool="true"')
                data = data.replace(b" modelName", b' generationTool="Workbench 7" modelName')
            copy.writestr(entry, data)
    with pytest.raises(ModelError) as caught:
        load_fmu(fmu, tmp_path / "scratch", "tool")
    assert "licence not found" in caught.value.cause
    assert caught.value.remedy == "it needs Workbench 7 installed on this host"


def test_the_need_of_an_execution_tool_is_remarked(load: Load) -> None:
    """The FMU is tried all the same, as the tool may be there."""
    slave = load("execution_tool")
    assert any("on the host that runs it" in remark for remark in slave.description.remarks)
    started(slave, inputs=("u",), outputs=("y",))
    assert slave.do_step(0.0, 0.1, False) == (StepStatus.OK, 0.1)
