"""The FMUs of examples/capabilities are what their README says, for better or worse.

They are driven call by call, without any code of Doublestep, so that its tests can rest on them.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp

from tests.capability_fmus import (
    ERROR,
    Extracted,
    Model2,
    Model3,
    Slave1,
    Slave2,
    Slave3,
    set_states,
    vector,
)

HALVES = ("chassis", "wheel")
STEPS = (0.01, 0.003, 0.02, 0.0007)

Open = Callable[..., Any]


@pytest.fixture(scope="module")
def extract(
    capability_dir: Path, fmu_dir: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Extracted]:
    """``extract(name)``: the contents of an FMU of this collection or of the quarter car."""
    folder = tmp_path_factory.mktemp("extracted_capabilities")
    made: dict[str, Extracted] = {}

    def find(name: str) -> Extracted:
        if name not in made:
            path = capability_dir / f"{name}.fmu"
            made[name] = Extracted(path if path.exists() else fmu_dir / f"{name}.fmu", folder)
        return made[name]

    return find


@pytest.fixture
def instance(extract: Callable[[str], Extracted]) -> Iterator[Open]:
    """``instance(kind, name, ...)`` instantiates an FMU; all are freed after the test."""
    made: list[Any] = []

    def open_fmu(kind: type, name: str, **arguments: Any) -> Any:
        made.append(kind(extract(name), **arguments))
        return made[-1]

    yield open_fmu
    for each in made:
        each.free()


def bits(values: Sequence[float]) -> bytes:
    """The values bit by bit, so that equal means equal."""
    return struct.pack(f"{len(values)}d", *values)


def refusal(made: Any, call: Callable[[], object], status: int = ERROR) -> str:
    """The message of a call that is refused with this status."""
    before = len(made.messages)
    with pytest.raises(FMICallException) as caught:
        call()
    assert caught.value.status == status
    assert len(made.messages) > before
    return str(made.messages[-1])


# ---- The files ----------------------------------------------------------------------------------


def test_fmus_are_valid(capability_dir: Path) -> None:
    """Archive and model description of every FMU keep the rules of their version of FMI."""
    fmus = sorted(capability_dir.glob("*.fmu"))
    problems = {fmu.stem: validate_fmu(str(fmu)) for fmu in fmus}
    assert len(fmus) >= 18
    assert {name: found for name, found in problems.items() if found} == {}


# ---- The quarter car ----------------------------------------------------------------------------


def inputs(half: str, time: float) -> dict[str, float]:
    """Some smooth motion of the other half: displacement [m] and velocity [m/s]."""
    body = "w" if half == "chassis" else "c"
    return {f"x_{body}": 0.05 * math.sin(9.0 * time), f"v_{body}": 0.45 * math.cos(9.0 * time)}


def held_inputs_run(made: Any, half: str) -> list[float]:
    """States and inputs of a few steps with inputs that are held."""
    seen = []
    for step_size in STEPS:
        made.set(**inputs(half, made.time))
        made.step(step_size)
        seen += made.get("x", "v", "der(x)", "der(v)", *inputs(half, 0.0))
    return seen


@pytest.mark.parametrize("half", HALVES)
def test_all_variants_take_the_same_steps(instance: Open, half: str) -> None:
    """Bit for bit the steps of the quarter car's FMU, with inputs held, in FMI 1.0, 2.0 and 3.0."""
    reference = instance(Slave2, half)
    reference.initialize()
    expected = bits(held_inputs_run(reference, half))
    kinds = {
        "no_state": Slave2,
        "no_derivatives": Slave2,
        "bare": Slave2,
        "fmi3": Slave3,
        "fmi3_bare": Slave3,
        "fmi1": Slave1,
    }
    for variant, kind in kinds.items():
        made = instance(kind, f"{half}_{variant}")
        made.initialize()
        assert bits(held_inputs_run(made, half)) == expected, variant


@pytest.mark.parametrize("kind", [Slave2, Slave1], ids=["no_state", "fmi1"])
def test_input_derivatives_where_declared(instance: Open, kind: type) -> None:
    """wheel_no_state and wheel_fmi1 follow input polynomials bit for bit as the wheel does."""
    seen = []
    for each, name in (
        (Slave2, "wheel"),
        (kind, f"wheel_{'no_state' if kind is Slave2 else 'fmi1'}"),
    ):
        made = instance(each, name)
        made.initialize()
        made.set(x_c=0.02, v_c=0.1)
        for order, value in ((1, 0.3), (2, -5.0), (3, 40.0)):
            made.set_derivatives(order, x_c=value, v_c=-value)
        made.step(0.01)
        made.step(0.02)
        seen.append(bits(made.get("x", "v", "x_c", "v_c")))
    assert seen[0] == seen[1]


@pytest.mark.parametrize("half", HALVES)
@pytest.mark.parametrize(
    ("variant", "kind", "states", "derivatives"),
    [
        ("no_state", Slave2, False, True),
        ("no_derivatives", Slave2, True, False),
        ("bare", Slave2, False, False),
        ("fmi3", Slave3, True, None),
        ("fmi3_bare", Slave3, False, None),
        ("fmi3_intermediate", Slave3, True, None),
    ],
)
def test_capabilities_are_what_they_say(  # noqa: PLR0917
    instance: Open, half: str, variant: str, kind: type, states: bool, derivatives: bool | None
) -> None:
    """What the description denies is refused with a message, what it declares works.

    ``None``: FMI 3.0 has no derivatives of inputs.
    """
    made = instance(kind, f"{half}_{variant}")
    made.initialize()
    flags = made.content.description.coSimulation
    assert flags.canHandleVariableCommunicationStepSize
    assert flags.canGetAndSetFMUstate == flags.canSerializeFMUstate == states
    if states:
        saved = made.save()
        first = held_inputs_run(made, half)
        for _ in range(2):
            made.restore(saved, 0.0)
            assert bits(held_inputs_run(made, half)) == bits(first)
    else:
        assert "saved" in refusal(made, made.save)
    if derivatives is not None:
        name = next(iter(inputs(half, 0.0)))
        assert flags.canInterpolateInputs == derivatives
        assert (flags.maxOutputDerivativeOrder > 0) == derivatives
        if derivatives:
            made.set_derivatives(1, **{name: 1.0})
        else:
            assert "not supported" in refusal(made, lambda: made.set_derivatives(1, **{name: 1.0}))


@pytest.mark.parametrize("half", HALVES)
def test_fmi1_input_derivatives_are_what_they_say(instance: Open, half: str) -> None:
    """wheel_fmi1 takes derivatives of inputs and declares it, chassis_fmi1 neither."""
    made = instance(Slave1, f"{half}_fmi1").initialize()
    root = ElementTree.parse(Path(made.content.folder) / "modelDescription.xml").getroot()
    flags = root.find("Implementation/CoSimulation_StandAlone/Capabilities")
    assert flags is not None
    assert flags.get("canHandleVariableCommunicationStepSize") == "true"
    assert flags.get("canRejectSteps", "false") == "false"
    assert flags.get("canInterpolateInputs") == ("true" if half == "wheel" else "false")
    call = partial(made.set_derivatives, 1, **{next(iter(inputs(half, 0.0))): 1.0})
    if half == "wheel":
        call()
    else:
        assert "not supported" in refusal(made, call)


def test_fmi1_steps_cannot_be_rejected(instance: Open) -> None:
    """NewStep must be true, and the wrong communication point is refused."""
    made = instance(Slave1, "wheel_fmi1").initialize()
    assert "rejected" in refusal(made, lambda: made.step(0.01, new_step=False))
    made.time = 0.5
    assert "stands at" in refusal(made, lambda: made.step(0.01))


@pytest.mark.parametrize("half", HALVES)
def test_serialized_fmi3_state_continues_elsewhere(instance: Open, half: str) -> None:
    """A serialized state, put into another instance, goes on with the same bits."""
    made, other = (instance(Slave3, f"{half}_fmi3") for _ in range(2))
    made.initialize()
    held_inputs_run(made, half)
    block = made.fmu.serializeFMUState(made.save())
    time = made.time
    other.restore(other.fmu.deserializeFMUState(block), time)
    assert bits(held_inputs_run(other, half)) == bits(held_inputs_run(made, half))


def test_fmi3_calls_are_refused_out_of_order(instance: Open) -> None:
    """Steps before initialization, event mode that was not asked for, wrong points, no way back."""
    made = instance(Slave3, "wheel_fmi3")
    made.time = 0.0
    assert "instantiated" in refusal(made, lambda: made.step(0.01))
    assert "initialization mode on" in refusal(made, lambda: made.get("x"))
    made.initialize()
    assert "without event mode" in refusal(made, made.fmu.enterEventMode)
    assert "step mode" in refusal(made, made.fmu.enterStepMode)
    assert "when instantiated" in refusal(made, lambda: made.set(m=1.0))
    assert "not advance" in refusal(made, lambda: made.step(0.0))
    made.time = 1e-9
    assert "stands at 0" in refusal(made, lambda: made.step(0.01))
    made.fmu.terminate()
    assert "terminated" in refusal(made, lambda: made.step(0.01))


# ---- Intermediate update ------------------------------------------------------------------------


class Importer:
    """Sets the inputs of a half at every intermediate update that asks for them."""

    def __init__(self, half: str) -> None:
        self.half = half
        self.calls: list[tuple[float, bool, bool]] = []
        self.outputs: list[float] = []
        self.stop_at = math.inf
        self.made: Any = None

    def __call__(  # noqa: PLR0917  FMI says which arguments there are
        self,
        _environment: object,
        time: float,
        set_requested: bool,
        get_allowed: bool,
        finished: bool,
        can_return_early: bool,
        early_return_requested: Any,
        early_return_time: Any,
    ) -> None:
        self.calls.append((time, set_requested, finished))
        if set_requested:
            self.made.set(**inputs(self.half, time))
        if get_allowed:
            self.outputs += self.made.get("x")
        if can_return_early and time >= self.stop_at:
            early_return_requested[0] = True
            early_return_time[0] = time


def intermediate(instance: Open, half: str) -> tuple[Any, Importer]:
    """A half that asks for its inputs on the way, and who answers."""
    importer = Importer(half)
    content_names = [*inputs(half, 0.0), "x", "v"]
    references = {"chassis": [0, 1, 100, 101], "wheel": [0, 1, 100, 101]}[half]
    made = instance(
        Slave3,
        f"{half}_fmi3_intermediate",
        earlyReturnAllowed=True,
        intermediateUpdate=importer,
        requiredIntermediateVariables=references,
    )
    assert made.content.references(content_names) == references
    importer.made = made
    made.initialize()
    made.set(**inputs(half, 0.0))
    return made, importer


def driven_solution(half: str, end: float) -> np.ndarray:
    """The half under its inputs as they are, by SciPy to the last digits; shape (2,)."""
    m, spring, damper, fixed_spring, z = (
        (400.0, 15000.0, 1000.0, 0.0, 0.0)
        if half == "chassis"
        else (40.0, 15000.0, 1000.0, 150000.0, 0.1)
    )

    def right_hand_side(time: float, state: np.ndarray) -> list[float]:
        other_x, other_v = inputs(half, time).values()
        x, v = state
        force = spring * (other_x - x) + damper * (other_v - v) + fixed_spring * (z - x)
        return [v, force / m]

    solution = solve_ivp(right_hand_side, (0.0, end), [0.0, 0.0], rtol=1e-12, atol=1e-14)
    return np.asarray(solution.y[:, -1])


@pytest.mark.parametrize("half", HALVES)
def test_inputs_at_intermediate_times_make_one_long_step_exact(instance: Open, half: str) -> None:
    """With inputs at every stage a step of 0.2 s is as exact as the solver; held, it is not."""
    expected = driven_solution(half, 0.2)
    made, importer = intermediate(instance, half)
    made.step(0.2)
    np.testing.assert_allclose(made.get("x", "v"), expected, atol=1e-6)
    times = [time for time, _, _ in importer.calls]
    assert times == sorted(times)
    assert sum(finished for _, _, finished in importer.calls) == 200
    assert times[0] == 0.0
    assert times[-1] == 0.2
    assert importer.outputs[-1] == made.get("x")[0]

    alone = instance(Slave3, f"{half}_fmi3_intermediate")
    alone.initialize()
    alone.set(**inputs(half, 0.0))
    alone.step(0.2)
    assert abs(alone.get("x")[0] - expected[0]) > 1e-3


def test_importer_can_end_a_step_early(instance: Open) -> None:
    """An early return ends at the internal step at which it was asked for, and goes on there."""
    made, importer = intermediate(instance, "wheel")
    importer.stop_at = 0.0105
    _, _, early, reached = made.step(0.1)
    assert early
    assert reached == pytest.approx(0.011, rel=1e-12)
    importer.stop_at = math.inf
    assert not made.step(0.05)[2]


def test_only_the_named_variables_can_be_set_in_between(instance: Open) -> None:
    """What is not among the required intermediate variables is refused."""
    messages = []

    def importer(*_arguments: object) -> None:
        messages.append(refusal(made, lambda: made.set(v_c=1.0)))

    made = instance(
        Slave3,
        "wheel_fmi3_intermediate",
        intermediateUpdate=importer,
        requiredIntermediateVariables=[0],
    )
    made.initialize()
    made.step(0.001)
    assert messages
    assert all("required" in message for message in messages)


# ---- Model exchange -----------------------------------------------------------------------------


@pytest.mark.parametrize("half", HALVES)
@pytest.mark.parametrize("kind", [Model2, Model3], ids=["me2", "me3"])
def test_quarter_car_as_model_exchange(instance: Open, half: str, kind: type) -> None:
    """Integrated by SciPy, the model gives the motion that the co-simulation FMU gives."""
    made = instance(kind, f"{half}_{'me2' if kind is Model2 else 'me3'}")
    made.initialize()
    if kind is Model2:
        again, *_ = made.fmu.newDiscreteStates()
        made.fmu.enterContinuousTimeMode()
        derivatives = made.fmu.getDerivatives
    else:
        again, *_ = made.fmu.updateDiscreteStates()
        made.fmu.enterContinuousTimeMode()
        derivatives = made.fmu.getContinuousStateDerivatives
    assert not again
    made.set(**inputs(half, 0.3))

    def right_hand_side(time: float, x: np.ndarray) -> np.ndarray:
        set_states(made, time, x)
        return vector(derivatives, 2)

    solution = solve_ivp(right_hand_side, (0.0, 0.1), [0.0, 0.0], rtol=1e-10, atol=1e-12)
    slave = instance(Slave2, half)
    slave.initialize(tolerance=1e-10)
    slave.set(**inputs(half, 0.3))
    slave.step(0.1)
    np.testing.assert_allclose(solution.y[:, -1], slave.get("x", "v"), rtol=1e-7, atol=1e-9)
