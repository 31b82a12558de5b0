"""Laws of `Fmi1Slave` over real FMUs."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from protocol.calls import Initialize, StepStatus
from protocol.description import InputDerivatives, StateKind
from protocol.errors import ModelError, SlaveError, StepRejectedError
from protocol.host.log_files import SILENT, LogOutput
from protocol.signals import InputSignal
from protocol.slave import Slave
from protocol.variables import Causality, StartValue
from slave_node.fmu.description import describe_fmu
from slave_node.fmu.loading import load_fmu

Load = Callable[..., Slave]

INPUTS = {"chassis": ("x_w", "v_w"), "wheel": ("x_c", "v_c")}


@pytest.fixture
def load(capability_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Load]:
    """``load(model)`` instantiates an FMU, by name or from another file; freed after the test."""
    slaves: list[Slave] = []

    def make(model: str | Path, output: LogOutput = SILENT) -> Slave:
        fmu = capability_dir / f"{model}.fmu" if isinstance(model, str) else model
        scratch = tmp_path_factory.mktemp("scratch")
        slaves.append(load_fmu(fmu, scratch, fmu.stem, output=output))
        return slaves[-1]

    yield make
    for slave in slaves:
        slave.close()


def initialized(
    slave: Slave,
    *,
    inputs: Sequence[str] = INPUTS["wheel"],
    outputs: Sequence[str] = ("x", "v"),
    discrete_outputs: Sequence[str] = (),
    start_values: Mapping[str, StartValue] | None = None,
) -> Slave:
    """The slave in initialization mode."""
    slave.initialize(
        Initialize(
            start_time=0.0,
            stop_time=None,
            relative_tolerance=None,
            start_values={"x": 0.1} if start_values is None else start_values,
            inputs=inputs,
            outputs=outputs,
            discrete_outputs=discrete_outputs,
        )
    )
    return slave


def started(slave: Slave, **arguments: object) -> Slave:
    """The slave at its first communication point, t = 0."""
    initialized(slave, **arguments)  # type: ignore[arg-type]
    slave.exit_initialization_mode()
    return slave


INPUT = np.array([[0.05, 0.3], [-0.2, 0.7], [3.0, -4.0], [-20.0, 30.0]])
"""Derivatives of a polynomial input that matters."""


def march(slave: Slave, orders: Sequence[int] = (0, 0, 0, 0), output_order: int = 0) -> bytes:
    """All that is seen over some steps, bit for bit."""
    seen, t = [], 0.0
    for i, order in enumerate(orders):
        slave.set_inputs(INPUT[: order + 1] * math.cos(i))
        status, t = slave.do_step(t, 0.01 * (i + 1), False)
        assert status is StepStatus.OK
        seen.append(slave.get_outputs(output_order).tobytes())
    return b"".join(seen)


def changed(capability_dir: Path, path: Path, *changes: tuple[str, str]) -> Path:
    """The wheel of FMI 1.0 with its model description changed."""
    with (
        zipfile.ZipFile(capability_dir / "wheel_fmi1.fmu") as archive,
        zipfile.ZipFile(path, "w") as copy,
    ):
        for name in archive.namelist():
            content = archive.read(name)
            if name == "modelDescription.xml":
                text = content.decode()
                for old, new in changes:
                    assert old in text
                    text = text.replace(old, new, 1)
                content = text.encode()
            copy.writestr(name, content)
    return path


def test_the_description_says_what_the_file_says(capability_dir: Path) -> None:
    """No saved states, and which derivatives there are; parameters are parameters."""
    wheel = describe_fmu(capability_dir / "wheel_fmi1.fmu")
    assert wheel.kind == "FMI 1.0 co-simulation"
    assert wheel.state_kind is StateKind.NONE
    assert wheel.input_derivatives is InputDerivatives.NATIVE
    assert wheel.capabilities.max_output_derivative_order == 1
    assert wheel.capabilities.can_handle_variable_step_size
    assert wheel.variable("m").causality is Causality.PARAMETER
    assert wheel.variable("m").unit == "kg"
    chassis = describe_fmu(capability_dir / "chassis_fmi1.fmu")
    assert chassis.input_derivatives is InputDerivatives.NONE
    # FMI 1.0 says nothing on dependencies here: then everything may depend on everything.
    assert chassis.feed_through == {"x": INPUTS["chassis"], "v": INPUTS["chassis"]}


def test_direct_dependencies_are_read(capability_dir: Path, tmp_path: Path) -> None:
    """An element DirectDependency names all inputs that matter."""
    x = 'causality="output">\n      <Real unit="m" start="0" />'
    dependency = "<DirectDependency><Name>x_c</Name></DirectDependency>"
    fmu = changed(capability_dir, tmp_path / "wheel.fmu", (x, x + dependency))
    feed_through = describe_fmu(fmu).feed_through
    assert feed_through["x"] == ("x_c",)
    assert feed_through["v"] == ("x_c", "v_c")


@pytest.mark.parametrize("half", INPUTS)
def test_the_version_of_fmi_makes_no_difference(load: Load, half: str) -> None:
    """Held inputs and the FMU's own tolerance give the bits of FMI 2.0."""
    expected = march(started(load(f"{half}_bare"), inputs=INPUTS[half]))
    assert march(started(load(f"{half}_fmi1"), inputs=INPUTS[half])) == expected


def test_inputs_of_every_order_arrive(load: Load) -> None:
    """With their derivatives, and outputs with theirs, as in FMI 2.0, bit for bit."""
    orders = (3, 0, 2, 1)
    expected = march(started(load("wheel_no_state")), orders, output_order=1)
    assert march(started(load("wheel_fmi1")), orders, output_order=1) == expected
    with pytest.raises(SlaveError, match="up to 1 rows"):
        started(load("chassis_fmi1"), inputs=INPUTS["chassis"]).set_inputs(INPUT[:2])


def test_a_polynomial_is_shifted(load: Load) -> None:
    """Two steps on a polynomial and its continuation are one step on it."""
    once, twice = started(load("wheel_fmi1")), started(load("wheel_fmi1"))
    signal = InputSignal(INPUT)
    once.set_inputs(signal.derivatives)
    once.do_step(0.0, 0.08, False)
    twice.set_inputs(signal.derivatives)
    twice.do_step(0.0, 0.05, False)
    twice.set_inputs(signal.shifted(0.05).derivatives)
    twice.do_step(0.05, 0.03, False)
    np.testing.assert_allclose(once.get_outputs(0), twice.get_outputs(0), rtol=1e-4, atol=1e-6)


def test_outputs_in_initialization_mode_are_start_values(load: Load) -> None:
    """Those of the master before those of the file; inputs can be set any number of times."""
    slave = initialized(load("wheel_fmi1"), start_values={"x": 0.25})
    for _ in range(2):
        np.testing.assert_array_equal(slave.get_outputs(0), [[0.25, 0.0]])
        slave.set_inputs(INPUT[:1])
    slave.exit_initialization_mode()
    np.testing.assert_array_equal(slave.get_outputs(0), [[0.25, 0.0]])
    status, _ = slave.do_step(0.0, 0.01, False)
    assert status is StepStatus.OK


def test_an_output_without_start_value_is_asked_for(
    capability_dir: Path, tmp_path: Path, load: Load
) -> None:
    """Then the FMU is initialized at once, and goes on as if it had been later."""
    start = 'causality="output">\n      <Real unit="m/s" start="0"'
    fmu = changed(capability_dir, tmp_path / "wheel.fmu", (start, start.removesuffix(' start="0"')))
    slave = initialized(load(fmu))
    assert slave.description.variable("v").start is None
    slave.set_inputs(INPUT[:1])
    np.testing.assert_array_equal(slave.get_outputs(0), [[0.1, 0.0]])
    slave.set_inputs(INPUT[:1])
    slave.exit_initialization_mode()
    assert march(slave) == march(started(load("wheel_fmi1")))


def test_a_negated_alias_has_the_other_sign(
    capability_dir: Path, tmp_path: Path, load: Load
) -> None:
    """A negated alias has the other sign as input, as output, and as start value."""
    text = zipfile.ZipFile(capability_dir / "wheel_fmi1.fmu").read("modelDescription.xml").decode()
    references = {
        name: text[text.index(f'name="{name}" valueReference="') :].split('"')[3]
        for name in ("x", "x_c", "m")
    }
    fmu = changed(
        capability_dir,
        tmp_path / "wheel.fmu",
        (
            "<ModelVariables>",
            "<ModelVariables>"
            + "".join(
                f'<ScalarVariable name="minus_{name}" valueReference="{references[name]}" '
                f'alias="negatedAlias" {kind}><Real start="-1"/></ScalarVariable>'
                for name, kind in (
                    ("x", 'causality="output"'),
                    ("x_c", 'causality="input"'),
                    ("m", 'causality="internal" variability="parameter"'),
                )
            ),
        ),
    )
    plain = started(load("wheel_fmi1"), start_values={"x": 0.1, "m": 50.0})
    negated = started(
        load(fmu),
        inputs=("minus_x_c", "v_c"),
        outputs=("minus_x", "v"),
        start_values={"minus_x": -0.1, "minus_m": -50.0},
    )
    plain.set_inputs(INPUT)
    negated.set_inputs(INPUT * [-1.0, 1.0])
    for slave in (plain, negated):
        slave.do_step(0.0, 0.05, False)
    np.testing.assert_array_equal(plain.get_outputs(1) * [-1.0, 1.0], negated.get_outputs(1))
    description = negated.description
    assert description.variable("minus_x").causality is Causality.OUTPUT


@pytest.fixture
def all_types(capability_dir: Path, tmp_path: Path) -> Path:
    """The FMU with values of all types in FMI 1.0, one of them a negated alias."""
    del capability_dir  # whose building finds the package of the examples
    from capabilities.catalogue import SOURCES, Capabilities, make_fmu  # noqa: PLC0415
    from capabilities.model_descriptions import Description, Variable  # noqa: PLC0415
    from fmu_framework import build_fmus  # noqa: PLC0415

    kinds = {
        "integer": (2, "Int32", "0"),
        "boolean": (3, "Boolean", "false"),
        "string": (4, "String", ""),
    }
    variables = [
        Variable(f"{name}_{direction}", reference + offset, causality, type_, start=start)
        for name, (reference, type_, start) in kinds.items()
        for direction, causality, offset in (("in", "input", 0), ("out", "output", 100))
    ]
    fmu = make_fmu(
        Description("all_types1", "Inputs and outputs of all types", tuple(variables)),
        (SOURCES / "all_types2.c",),
        version=1,
        capabilities=Capabilities(saved_states=False),
    )
    negated = fmu.description.replace(
        b"<ModelVariables>",
        b"<ModelVariables>"
        b'<ScalarVariable name="minus" valueReference="102" alias="negatedAlias" '
        b'causality="output"><Integer start="0"/></ScalarVariable>'
        b'<ScalarVariable name="not" valueReference="103" alias="negatedAlias" '
        b'causality="output"><Boolean start="true"/></ScalarVariable>',
    )
    (path,) = build_fmus.build((replace(fmu, description=negated),), tmp_path)
    return Path(path)


def test_all_types_of_fmi_1(load: Load, all_types: Path) -> None:
    """Integer, Boolean and String make the round trip, negated aliases have the other sign."""
    names = ("integer_in", "boolean_in", "string_in")
    outputs = ("integer_out", "not", "string_out", "boolean_out", "minus")
    slave = load(all_types)
    slave.initialize(
        Initialize(
            start_time=0.0,
            stop_time=None,
            relative_tolerance=None,
            start_values={"integer_in": 6},
            inputs=(),
            outputs=(),
            discrete_inputs=names,
            discrete_outputs=outputs,
        )
    )
    assert slave.get_discrete_outputs() == (0, True, "", False, 0)  # start values
    slave.exit_initialization_mode()
    assert slave.get_discrete_outputs() == (7, False, "got ", True, -7)
    slave.set_discrete_inputs((41, True, "Füße"))
    assert slave.get_discrete_outputs() == (42, True, "got Füße", False, -42)
    with pytest.raises(SlaveError, match="'boolean_in' is of type Boolean; it cannot be 1"):
        slave.set_discrete_inputs((41, 1, ""))


def test_there_is_no_way_back(load: Load) -> None:
    """States are refused by name."""
    slave = started(load("wheel_fmi1"))
    for call in (slave.get_state, lambda: slave.deserialize_state(b"")):
        with pytest.raises(SlaveError, match="wheel_fmi1 cannot"):
            call()


def test_errors_come_with_the_words_of_the_fmu(
    load: Load, capability_dir: Path, tmp_path: Path
) -> None:
    """Errors of a step, a start value and an instantiation have the words of the FMU."""
    one, two = started(load("wheel_fmi1")), started(load("wheel_fmi1"))
    with pytest.raises(StepRejectedError, match=r"fmiDoStep returned fmiError; the FMU's log: .*0"):
        one.do_step(0.5, 0.1, False)
    two.do_step(0.0, 0.1, False)
    with pytest.raises(ModelError, match="no variable 'xx'"):
        initialized(load("wheel_fmi1"), start_values={"xx": 1.0})
    fmu = changed(capability_dir, tmp_path / "wheel.fmu", ('guid="{', 'guid="{0'))
    with pytest.raises(ModelError, match=r"wheel\.fmu: fmiInstantiate: .*log: .*[Gg][Uu][Ii][Dd]"):
        load(fmu)


def test_reset_is_as_good_as_new(load: Load) -> None:
    """After steps, after an error, and before there was anything."""
    slave = load("wheel_fmi1")
    initialized(slave)
    slave.reset()
    started(slave)
    first = march(slave)
    with pytest.raises(StepRejectedError):
        slave.do_step(0.5, 0.1, False)
    slave.reset()
    assert march(started(slave)) == first
    slave.terminate()
    slave.reset()
    assert march(started(slave)) == first
