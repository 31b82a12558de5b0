"""The FMUs of examples/capabilities are what their README says, for better or worse.

They are driven call by call, without any code of Doublestep, so that its tests can rest on them.
"""

from __future__ import annotations

import math
import re
import struct
import sys
import zipfile
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import psutil
import pytest
from fmpy import fmi2
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu
from lark import Lark
from scipy.integrate import solve_ivp

from tests.support.capability_fmus import (
    DISCARD,
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
from tests.support.waiting import wait_until

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


class NameParser:
    """FMPy's parser of variable names, made once; it sees names that differ in digits once."""

    def __init__(self, grammar: str, start: str) -> None:
        self._parse = cache(Lark(grammar, start=start).parse)

    def parse(self, name: str) -> object:
        """The tree of the name, or an error."""
        return self._parse(re.sub(r"\d+", "1", name))


def test_fmus_are_valid(capability_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Archive and model description of every FMU keep the rules of their version of FMI."""
    monkeypatch.setattr("lark.Lark", cache(NameParser))
    fmus = sorted(capability_dir.glob("*.fmu"))
    problems = {fmu.stem: validate_fmu(str(fmu)) for fmu in fmus}
    assert len(fmus) == 78
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
    """Capabilities that a description denies are refused with a message; those it declares work.

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
    """Variables that are not among the required intermediate variables are refused."""
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


# ---- Lags ---------------------------------------------------------------------------------------


def lag(x: float, u: float, time: float, slope: float = 0.0) -> float:
    """T y' = u + slope t - y with T = 0.5 s, from y = x on."""
    t_c = 0.5
    settled = u + slope * (time - t_c)
    return settled + (x - u + slope * t_c) * math.exp(-time / t_c)


def started(made: Any, u: float = 3.0) -> Any:
    """An initialized lag with its input set."""
    made.initialize()
    made.set(u=u)
    return made


SOUND_LAGS = (
    "broken_state",
    "error_on_restore",
    "starts_thread",
    "writes_file",
    "plain_lag",
    "execution_tool",
)


@pytest.mark.parametrize("name", [*SOUND_LAGS, "restarting_solver"])
def test_lags_follow_their_inputs(instance: Open, name: str) -> None:
    """These lags are right until a state is restored, with an input along a line, too."""
    made = started(instance(Slave2, name))
    made.set_derivatives(1, u=-2.0)
    for step_size in (0.1, 0.03, 0.2):
        made.step(step_size)
    assert made.get("y")[0] == pytest.approx(lag(1.0, 3.0, 0.33, -2.0), rel=1e-7)
    assert made.get("u")[0] == pytest.approx(3.0 - 2.0 * 0.33)
    (slope,) = made.fmu.getRealOutputDerivatives(made.content.references(["y"]), [1])
    assert slope == pytest.approx((made.get("u")[0] - made.get("y")[0]) / 0.5)


def after_restoring(made: Any, step_size: float = 0.05) -> list[float]:
    """The output after a step, and after the same step from the restored state, twice."""
    made.step(0.05)
    saved, time = made.save(), made.time
    outputs = []
    for _ in range(3):
        made.step(step_size)
        outputs += made.get("y")
        made.restore(saved, time)
    return outputs


def test_broken_state_goes_on_from_where_it_stands(instance: Open) -> None:
    """broken_state reports success and does not restore x."""
    outputs = after_restoring(started(instance(Slave2, "broken_state")))
    expected = [lag(1.0, 3.0, 0.05 * n) for n in (2, 3, 4)]
    np.testing.assert_allclose(outputs, expected, rtol=1e-12)


def test_restarting_solver_repeats_itself_but_not_the_first_run(instance: Open) -> None:
    """restarting_solver: bit for bit the same after each restore, other late digits than before."""
    first, second, third = after_restoring(started(instance(Slave2, "restarting_solver")))
    assert bits([second]) == bits([third])
    assert first != second
    assert first == pytest.approx(second, rel=1e-7)


def test_not_repeating_never_repeats(instance: Open) -> None:
    """not_repeating: the same step from the same state ends elsewhere each time, by a millionth."""
    outputs = after_restoring(started(instance(Slave2, "not_repeating")))
    assert len(set(outputs)) == 3
    np.testing.assert_allclose(outputs, lag(1.0, 3.0, 0.1), atol=2e-6)


def test_error_on_restore_is_an_error(instance: Open) -> None:
    """error_on_restore saves its state, refuses to restore it and stays where it is."""
    made = started(instance(Slave2, "error_on_restore"))
    saved = made.save()
    made.step(0.1)
    assert "set back" in refusal(made, lambda: made.restore(saved, 0.0))
    made.step(0.1)
    assert made.get("y")[0] == pytest.approx(lag(1.0, 3.0, 0.2), rel=1e-12)


def test_starts_thread_has_one(instance: Open, extract: Callable[[str], Extracted]) -> None:
    """starts_thread: a thread more with the instance, one less without it; no saved states."""

    def threads() -> int:
        return len(psutil.Process().threads())

    before = threads()
    made = Slave2(extract("starts_thread"))
    assert threads() == before + 1
    assert "saved" in refusal(made, made.save)
    made.free()
    wait_until(lambda: threads() == before)  # joined, but the system may still count it


def test_writes_file_writes_each_step(instance: Open) -> None:
    """writes_file: a line for each step in its resources, and no saved states."""
    made = started(instance(Slave2, "writes_file"))
    assert "saved" in refusal(made, made.save)
    made.step(0.1)
    made.step(0.2)
    text = (Path(made.content.folder) / "resources" / "steps.txt").read_text()
    *_, first, second = (line.split() for line in text.splitlines())
    assert [float(word) for word in first] == [0.0, 0.1, pytest.approx(lag(1.0, 3.0, 0.1))]
    assert [float(word) for word in second] == [0.1, 0.2, *made.get("y")]


@pytest.mark.parametrize(("name", "kind"), [("fixed_step", Slave2), ("fixed_step_fmi3", Slave3)])
def test_fixed_step_takes_no_other(instance: Open, name: str, kind: type) -> None:
    """Steps of 10 ms, whichever way the times are added up, and no others."""
    made = started(instance(kind, name))
    flags = made.content.description.coSimulation
    assert not flags.canHandleVariableCommunicationStepSize
    for step_size in (0.005, 0.0100001, 0.025):
        assert "0.01" in refusal(made, partial(made.step, step_size))
    for i in range(200):
        made.time = i * 0.01
        made.step((i + 1) * 0.01 - i * 0.01)
    assert made.get("y")[0] == pytest.approx(lag(1.0, 3.0, 2.0), rel=1e-12)
    assert "fixed one" in refusal(made, partial(made.step, 0.02))


def test_fixed_step_fmi3_takes_equal_multiples(instance: Open) -> None:
    """fixed_step_fmi3 declares its internal step; the first step chooses the multiple."""
    made = started(instance(Slave3, "fixed_step_fmi3"))
    assert made.content.description.coSimulation.fixedInternalStepSize == "0.01"
    made.step(0.03)
    made.step(0.03)
    assert "fixed one" in refusal(made, partial(made.step, 0.01))
    assert made.get("y")[0] == pytest.approx(lag(1.0, 3.0, 0.06), rel=1e-12)


def test_discards_ends_after_two_milliseconds(instance: Open) -> None:
    """Discards: a longer step ends there, says where, and a restored state leads back."""
    made = started(instance(Slave2, "discards"))
    made.step(0.002)
    saved = made.save()
    refusal(made, partial(made.step, 0.01), DISCARD)
    assert made.fmu.getRealStatus(fmi2.fmi2LastSuccessfulTime) == pytest.approx(0.004)
    assert made.fmu.getStatus(fmi2.fmi2DoStepStatus) == DISCARD
    assert not made.fmu.getBooleanStatus(fmi2.fmi2Terminated)
    assert made.get("y")[0] == pytest.approx(lag(1.0, 3.0, 0.004), rel=1e-12)
    assert "step discarded" in refusal(made, partial(made.step, 0.001))
    made.restore(saved, 0.002)
    made.step(0.002)
    assert made.get("y")[0] == pytest.approx(lag(1.0, 3.0, 0.004), rel=1e-12)


def test_large_state_is_large_and_whole(instance: Open) -> None:
    """large_state: more than 1 MiB, and every part that the output shows is restored."""
    made, other = (started(instance(Slave2, "large_state")) for _ in range(2))
    made.step(0.1)
    block = made.fmu.serializeFMUstate(made.save())
    assert len(block) > 2**20
    made.step(0.1)
    other.restore(other.fmu.deSerializeFMUstate(block), 0.1)
    other.set(u=3.0)
    other.step(0.1)
    assert bits(made.get("y")) == bits(other.get("y"))
    exact = np.mean([3.0 - 2.0 * math.exp(-0.2 / t_c) for t_c in (0.5, 0.75, 1.0)])
    assert made.get("y")[0] == pytest.approx(exact, rel=1e-5)


def test_internal_clock_moves_at_its_ticks_only(instance: Open) -> None:
    """internal_clock: any step is taken, the output moves at multiples of 10 ms by Euler steps."""
    made = started(instance(Slave2, "internal_clock"))
    assert made.content.description.coSimulation.canHandleVariableCommunicationStepSize
    x = 1.0
    for end, ticks in ((0.004, 0), (0.0099, 0), (0.01, 1), (0.019, 0), (0.021, 1), (0.05, 3)):
        for _ in range(ticks):
            x += 0.01 * (3.0 - x) / 0.5
        made.step(end - made.time)
        made.time = end
        assert made.get("y")[0] == pytest.approx(x, rel=1e-14), end
    saved = made.save()
    made.step(0.1)
    once = made.get("y")
    made.restore(saved, 0.05)
    made.step(0.1)
    assert made.get("y") == once


def test_euler_per_step_is_that(instance: Open) -> None:
    """euler_per_step: one Euler step per communication step, exactly."""
    made = started(instance(Slave2, "euler_per_step"))
    made.step(0.25)
    assert made.get("y") == [1.0 + 0.25 * (3.0 - 1.0) / 0.5]
    made.step(0.125)
    assert made.get("y") == [2.0 + 0.125 * (3.0 - 2.0) / 0.5]


@pytest.mark.parametrize("name", ["plain_lag", "execution_tool"])
def test_communication_points_are_compared_bit_by_bit(instance: Open, name: str) -> None:
    """A communication point one unit in the last place beside it is refused."""
    made = started(instance(Slave2, name))
    made.step(0.1)
    made.step(0.2)
    assert made.time == 0.1 + 0.2 != 0.3
    made.time = 0.3
    assert "stands at" in refusal(made, partial(made.step, 0.1))
    made.time = 0.1 + 0.2
    assert "not advance" in refusal(made, partial(made.step, 0.0))
    made.step(0.1)


# ---- Ends and events ----------------------------------------------------------------------------


def test_terminates2_discards_the_step_and_says_why(instance: Open) -> None:
    """terminates2: fmi2Discard, fmi2Terminated, and the last successful time is 0.5."""
    made = started(instance(Slave2, "terminates2"))
    made.step(0.4)
    refusal(made, partial(made.step, 0.2), DISCARD)
    assert made.fmu.getBooleanStatus(fmi2.fmi2Terminated)
    assert made.fmu.getRealStatus(fmi2.fmi2LastSuccessfulTime) == 0.5
    assert made.get("y")[0] == pytest.approx(lag(1.0, 3.0, 0.5), rel=1e-12)
    made.fmu.terminate()


def test_terminates3_takes_the_step_and_asks_for_the_end(instance: Open) -> None:
    """terminates3: terminateSimulation with the step that reaches 0.5, and no step after it."""
    made = started(instance(Slave3, "terminates3"))
    assert made.step(0.4) == (False, False, False, 0.4)
    assert made.step(0.2) == (False, True, False, 0.4 + 0.2)
    assert "step" in refusal(made, partial(made.step, 0.1))
    assert made.get("y")[0] == pytest.approx(lag(1.0, 3.0, 0.6), rel=1e-12)
    made.fmu.terminate()


def staircase(time: float) -> tuple[int, float]:
    """Level and output of event_mode3, which rises at every multiple of 0.35."""
    now, x, level = 0.0, 1.0, 0
    while 0.35 * (level + 1) <= time:
        x = lag(x, level, 0.35 * (level + 1) - now)
        now = 0.35 * (level + 1)
        level += 1
    return level, lag(x, level, time - now)


def test_event_mode3_handles_events_itself_when_told_so(instance: Open) -> None:
    """Without event mode, and without leave to return early, steps pass over the events."""
    for arguments in ({}, {"eventModeUsed": True}):
        made = instance(Slave3, "event_mode3", **arguments)
        made.initialize()
        if arguments:
            made.fmu.updateDiscreteStates()
            made.fmu.enterStepMode()
        for step_size in (0.2, 0.3, 0.6):
            event, terminate, early, _ = made.step(step_size)
            assert (event, terminate, early) == (False, False, False)
            level, y = staircase(made.time)
            assert made.get("level") == [level]
            assert made.get("y")[0] == pytest.approx(y, rel=1e-12)


def test_event_mode3_returns_early_at_its_events(instance: Open) -> None:
    """With event mode a step ends at 0.35, the event is handled there, and the run goes on."""
    made = instance(Slave3, "event_mode3", eventModeUsed=True, earlyReturnAllowed=True)
    made.initialize()
    assert "event mode" in refusal(made, partial(made.step, 0.1))
    assert made.fmu.updateDiscreteStates() == (False, False, False, False, True, 0.35)
    assert made.get("level") == [0]
    made.fmu.enterStepMode()
    assert made.step(0.2) == (False, False, False, 0.2)
    saved = made.save()
    for _ in range(2):
        assert made.step(0.3) == (True, False, True, 0.35)
        assert made.get("level") == [0]
        assert "event mode first" in refusal(made, partial(made.step, 0.1))
        made.fmu.enterEventMode()
        assert made.fmu.updateDiscreteStates() == (False, False, False, False, True, 0.7)
        assert made.get("level") == [1]
        made.fmu.enterStepMode()
        made.step(0.15)
        assert made.get("y")[0] == pytest.approx(staircase(0.5)[1], rel=1e-12)
        made.restore(saved, 0.2)


def test_event_at_the_end_of_a_step_is_no_early_return(instance: Open) -> None:
    """A step that ends at the event needs event handling all the same."""
    made = instance(Slave3, "event_mode3", eventModeUsed=True, earlyReturnAllowed=True)
    made.initialize()
    made.fmu.enterStepMode()
    assert made.step(0.35) == (True, False, False, 0.35)


@pytest.mark.parametrize("kind", [Model2, Model3], ids=["me2", "me3"])
def test_bouncing_ball_bounces_and_comes_to_rest(instance: Open, kind: type) -> None:
    """Integrated with event location by SciPy, it bounces when theory says so, then stays down."""
    made = instance(kind, f"bouncing_ball_{'me2' if kind is Model2 else 'me3'}")
    made.initialize()
    is_fmi2 = kind is Model2
    update = made.fmu.newDiscreteStates if is_fmi2 else made.fmu.updateDiscreteStates
    get_derivatives = made.fmu.getDerivatives if is_fmi2 else made.fmu.getContinuousStateDerivatives
    update()
    made.fmu.enterContinuousTimeMode()

    def right_hand_side(time: float, x: np.ndarray) -> np.ndarray:
        set_states(made, time, x)
        return vector(get_derivatives, 2)

    def indicator(time: float, x: np.ndarray) -> float:
        set_states(made, time, x)
        return float(vector(made.fmu.getEventIndicators, 1)[0])

    indicator.terminal = True  # type: ignore[attr-defined]
    indicator.direction = -1  # type: ignore[attr-defined]
    time, bounces = 0.0, []
    while time < 4.0:
        x = vector(made.fmu.getContinuousStates, 2)
        run = solve_ivp(right_hand_side, (time, 4.0), x, events=indicator, rtol=1e-10, atol=1e-12)
        time = float(run.t[-1])
        at_event = run.y[:, -1]
        if run.status == 0:
            set_states(made, time, at_event)
            break
        set_states(made, time, np.array([min(at_event[0], 0.0), at_event[1]]))
        made.fmu.enterEventMode()
        assert update()[3]  # the states have jumped
        made.fmu.enterContinuousTimeMode()
        bounces.append(time)
        assert made.get("bounces") == [len(bounces)]

    fall = math.sqrt(2.0 / 9.81)
    expected = [fall + 2.0 * fall * sum(0.7**k for k in range(1, n + 1)) for n in range(4)]
    np.testing.assert_allclose(bounces[:4], expected, rtol=1e-7)
    speeds = math.sqrt(2.0 * 9.81) * 0.7 ** np.arange(1, 30)
    assert len(bounces) == 1 + np.count_nonzero(speeds >= 0.1)
    assert made.get("h", "v") == [0.0, 0.0]
    assert not vector(get_derivatives, 2).any()


# ---- Types, units, loops ------------------------------------------------------------------------


def test_all_types2_rules(instance: Open) -> None:
    """Every output of all_types2 follows its rule, restored text and numbers included."""
    made = instance(Slave2, "all_types2")
    made.initialize()
    made.set(
        real_continuous_in=2.0,
        real_discrete_in=1.5,
        integer_in=41,
        boolean_in=True,
        string_in="grün",
        enumeration_in=3,
    )
    made.step(0.5)
    names = [name for name in made.content.names("output") if name != "real_continuous_out"]
    expected = [3.0, 42, 0, "got grün".encode(), 1, 2, 0]
    assert made.get(*names) == expected
    assert made.get("real_continuous_out")[0] == pytest.approx(2.0 - 2.0 * math.exp(-0.5))
    saved = made.save()
    made.set(string_in="x", integer_in=2**31 - 1, boolean_in=False, enumeration_in=1)
    made.step(0.3)
    assert made.get("string_out", "integer_out", "enumeration_out") == [b"got x", -(2**31), 2]
    assert made.get("counter_out", "toggle_out", "boolean_out") == [3, 1, 1]
    made.restore(saved, 0.5)
    assert made.get(*names) == expected


def test_all_types3_rules(instance: Open) -> None:
    """Every output of all_types3 follows its rule; after the largest integer comes the least."""
    made = instance(Slave3, "all_types3")
    made.initialize()
    largest = {
        f"{'u' if unsigned else ''}int{size}": 2 ** (size if unsigned else size - 1) - 1
        for size in (8, 16, 32, 64)
        for unsigned in (False, True)
    }
    for values in (dict.fromkeys(largest, 41), largest):
        made.set(**{f"{name}_in": value for name, value in values.items()})
        for name, value in values.items():
            successor = (
                value + 1 if value == 41 else 0 if name.startswith("u") else -largest[name] - 1
            )
            assert made.get(f"{name}_out") == [successor], name
    made.set(float32_in=1.5, boolean_in=True, string_in="grün", enumeration_in=2)
    assert made.get("float32_out", "boolean_out", "enumeration_out") == [3.0, False, 3]
    assert made.get("string_out") == ["got grün"]
    made.fmu.setBinary(made.content.references(["binary_in"]), [b"\x00\x01\xff"])
    assert list(made.fmu.getBinary(made.content.references(["binary_out"]))) == [b"\xff\x01\x00"]
    made.set(matrix_in=[1.0, 2.0, 3.0, 4.0, 5.0, 6.0], vector_in=[1.0, 2.0, 3.0], float64_in=2.0)
    matrix = made.content.references(["matrix_out"])
    assert made.fmu.getFloat64(matrix, nValues=6) == [2.0, 4.0, 6.0, 8.0, 10.0, 12.0]
    vector_out = made.content.references(["vector_out"])
    assert made.fmu.getFloat64(vector_out, nValues=3) == [2.0, 3.0, 4.0]
    assert "4 values" in refusal(made, lambda: made.fmu.getFloat64(vector_out, nValues=4))
    made.step(0.5)
    assert made.get("float64_out")[0] == pytest.approx(2.0 - 2.0 * math.exp(-0.5))

    saved = made.save()
    made.set(string_in="x", vector_in=[0.0, 0.0, 0.0])
    made.restore(saved, 0.5)
    assert made.get("string_out") == ["got grün"]
    assert made.fmu.getFloat64(vector_out, nValues=3) == [2.0, 3.0, 4.0]


def test_structural_parameter_sizes_the_vector(instance: Open) -> None:
    """N of all_types3 is set in configuration mode, and only there; at most 16."""
    made = instance(Slave3, "all_types3")
    assert made.get("n") == [3]
    assert "configuration mode" in refusal(made, partial(made.set, n=5))
    made.fmu.enterConfigurationMode()
    made.set(n=17)
    assert "larger than 16" in refusal(made, made.fmu.exitConfigurationMode)
    made.set(n=5)
    made.fmu.exitConfigurationMode()
    made.initialize()
    made.set(vector_in=[1.0, 2.0, 3.0, 4.0, 5.0])
    vector_out = made.content.references(["vector_out"])
    assert made.fmu.getFloat64(vector_out, nValues=5) == [2.0, 3.0, 4.0, 5.0, 6.0]


@pytest.mark.parametrize(("name", "count"), [("few_variables", 10), ("many_variables", 5000)])
def test_many_variables_are_all_there(instance: Open, name: str, count: int) -> None:
    """Every one of the lags follows its own input, and all of them are restored.

    So they do when the value references come in any order, one by one or some side by side.
    """
    made = instance(Slave2, name)
    made.initialize()
    inputs_, outputs = made.content.names("input"), made.content.names("output")
    assert len(inputs_) == len(outputs) == count
    u = np.arange(1.0, count + 1.0)
    to, from_ = made.content.references(inputs_), made.content.references(outputs)
    start = made.save()
    third = count // 3
    shuffled = np.r_[count - 1 : 2 * third - 1 : -1, third : 2 * third, 0:third]
    for order in (np.arange(count), shuffled):
        made.fmu.setReal([to[i] for i in order], list(u[order]))
        made.fmu.setRealInputDerivatives([to[i] for i in order], [1] * count, list(-u[order]))
        saved = made.save()
        for _ in range(2):
            made.step(0.3)
            exact = u * (1.0 - 0.3 + 1.0) - u * 2.0 * math.exp(-0.3)  # y' = u (1 - t) - y
            asked = [from_[i] for i in order]
            np.testing.assert_allclose(made.fmu.getReal(asked), exact[order], rtol=1e-12)
            slopes = made.fmu.getRealOutputDerivatives(asked, [1] * count)
            np.testing.assert_allclose(slopes, (0.7 * u - exact)[order], rtol=1e-11)
            made.restore(saved, 0.0)
        made.restore(start, 0.0)


@pytest.mark.parametrize(
    ("name", "length", "temperature"),
    [("units_metres", (1.0, 0.0), (1.0, 0.0)), ("units_millimetres", (1e-3, 0.0), (1.0, 273.15))],
)
def test_units_are_declared(
    instance: Open, name: str, length: tuple[float, float], temperature: tuple[float, float]
) -> None:
    """Factor and offset to the SI unit stand in the description, the temperature at rest at 0 C."""
    made = instance(Slave2, name)
    made.initialize()
    units = {unit.name: unit.baseUnit for unit in made.content.description.unitDefinitions}
    for output, base, (factor, offset) in (("y", "m", length), ("theta_out", "K", temperature)):
        unit = units[made.content.variables[output].unit]
        assert (unit.factor, unit.offset) == (factor, offset)
        assert getattr(unit, base) == 1
    made.step(0.1)
    factor, offset = temperature
    assert made.get("theta_out")[0] * factor + offset == pytest.approx(273.15, rel=1e-12)
    assert made.get("y")[0] == pytest.approx(lag(1.0, 0.0, 0.1), rel=1e-12)


def test_loop_follows_its_input_at_once(instance: Open) -> None:
    """loop_a and loop_b: feed-through without a step, in initialization mode too; c bends it."""
    a, b = instance(Slave2, "loop_a"), instance(Slave2, "loop_b")
    for made, slope, offset, c in ((a, 0.5, 1.0, 0.0), (b, -0.8, 2.0, 0.3)):
        made.fmu.setupExperiment()
        made.set(c=c)
        made.fmu.enterInitializationMode()
        for u in (0.0, 2.0):
            made.set(u=u)
            assert made.get("y")[0] == pytest.approx(slope * u + offset + c * math.sin(u))
        made.fmu.exitInitializationMode()
        made.time = 0.0
        made.set(u=1.0)
        made.set_derivatives(1, u=2.0)
        (rate,) = made.fmu.getRealOutputDerivatives(made.content.references(["y"]), [1])
        assert rate == pytest.approx(2.0 * (slope + c * math.cos(1.0)))
        made.step(0.5)
        assert made.get("y")[0] == pytest.approx(slope * 2.0 + offset + c * math.sin(2.0))
        (structure,) = made.content.description.outputs
        assert [known.name for known in structure.dependencies] == ["u"]


# ---- What cannot be had -------------------------------------------------------------------------


def test_missing_library_cannot_be_loaded(extract: Callable[[str], Extracted]) -> None:
    """The description is sound, the binary asks for a library that is nowhere."""
    content = extract("missing_library")
    with pytest.raises(Exception, match="doublestep_absent"):
        Slave2(content)


def test_licence_error_needs_a_licence(
    extract: Callable[[str], Extracted], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No instance without LICENCE_FILE, and the logger is told why; with it there is one."""
    monkeypatch.delenv("LICENCE_FILE", raising=False)
    logged: list[tuple[bytes, bytes]] = []
    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(lambda *args: logged.append((args[3], args[4])))
    fmu = fmi2.FMU2Slave(**extract("licence_error").arguments())
    with pytest.raises(Exception, match="instantiate"):
        fmu.instantiate(callbacks=callbacks)
    message = b"fmi2Instantiate: licence not found: LICENCE_FILE is not set"
    assert logged == [(b"logStatusError", message)]
    monkeypatch.setenv("LICENCE_FILE", "licence.txt")
    started(Slave2(extract("licence_error"))).free()


def test_execution_tool_says_so(extract: Callable[[str], Extracted]) -> None:
    """execution_tool declares that it needs its tool, and no other FMU does."""
    assert extract("execution_tool").description.coSimulation.needsExecutionTool
    assert not extract("plain_lag").description.coSimulation.needsExecutionTool


# ---- All of them --------------------------------------------------------------------------------

NOT_TO_BE_STARTED = {"missing_library", "licence_error", "changes_process"}


def test_start_values_are_those_of_the_description(
    capability_dir: Path, extract: Callable[[str], Extracted]
) -> None:
    """Whoever sets no start value gets the one that the description names."""
    for path in sorted(capability_dir.glob("*.fmu")):
        if path.stem in NOT_TO_BE_STARTED:
            continue
        content = extract(path.stem)
        version, is_model = content.description.fmiVersion[0], content.description.modelExchange
        kind: Any = {
            ("1", False): Slave1,
            ("2", False): Slave2,
            ("2", True): Model2,
            ("3", False): Slave3,
            ("3", True): Model3,
        }[version, bool(is_model)]
        made = kind(content)
        made.initialize()
        for name, variable in content.variables.items():
            if variable.start is None or variable.type not in ("Real", "Float64", "Integer"):
                continue
            if not getattr(variable, "dimensions", ()):
                assert made.get(name) == [float(variable.start)], (path.stem, name)
        made.free()


def test_archives_hold_their_sources(capability_dir: Path) -> None:
    """Every FMU carries the sources that it was compiled from, and FMI 3.0 how to compile them."""
    for path in capability_dir.glob("*.fmu"):
        with zipfile.ZipFile(path) as archive:
            names = set(archive.namelist())
            description = archive.read("modelDescription.xml")
            if b'fmiVersion="3.0"' in description:
                build = ElementTree.fromstring(archive.read("sources/buildDescription.xml"))
                files = {f"sources/{file.get('name')}" for file in build.iter("SourceFile")}
                assert files == {name for name in names if name.endswith(".c")}
        assert {"sources/behaviour.h", "sources/instance.c", "sources/compile_flags.txt"} <= names
        assert not any("doublestep_absent" in name for name in names)


@pytest.mark.slow
def test_build_is_reproducible(capability_dir: Path, tmp_path: Path) -> None:
    """Equal sources give equal bytes, those of the stand-in library included."""
    catalogue = sys.modules["capabilities.catalogue"]
    names = ("wheel_fmi1", "wheel_me3", "missing_library")
    fmus = [fmu for fmu in catalogue.FMUS if fmu.name in names]
    for made in sys.modules["fmu_framework.build_fmus"].build(fmus, tmp_path):
        assert made.read_bytes() == (capability_dir / made.name).read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(f"{n}.fmu" for n in names)
