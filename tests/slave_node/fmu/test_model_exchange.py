"""Laws of `ModelExchangeSlave` over real FMUs: order, events, exact states."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from fmpy.model_description import read_model_description
from scipy.linalg import expm

from protocol.calls import Initialize, StepStatus
from protocol.description import InputDerivatives, StateKind
from protocol.errors import SlaveError, StepRejectedError
from protocol.signals import InputSignal
from protocol.slave import Slave
from protocol.variables import StartValue
from slave_node.fmu.cvode import CVode, Outcome
from slave_node.fmu.description import describe_fmu
from slave_node.fmu.interfaces import interface_2
from slave_node.fmu.loading import load_fmu

Load = Callable[[str], Slave]

VERSIONS = (2, 3)

# The wheel, x' = A x + B u + c, cut at the displacement.
M_W, K_W, K_C, D_C, Z = 40.0, 150000.0, 15000.0, 1000.0, 0.1
A = np.array([[0.0, 1.0], [-(K_W + K_C) / M_W, -D_C / M_W]])
B = np.array([[0.0, 0.0], [K_C / M_W, D_C / M_W]])
C = np.array([0.0, K_W * Z / M_W])

INPUT = np.array([[0.05, 0.3], [-0.2, 0.7], [3.0, -4.0], [-20.0, 30.0]])
"""Derivatives of a polynomial input that matters."""


def exact_wheel(x: np.ndarray, u: np.ndarray, time: float) -> np.ndarray:
    """The states of the wheel after ``time`` [s]; row j of ``u`` is the input's j-th derivative."""
    system = np.zeros((3 + u.size, 3 + u.size))
    system[:2, :2], system[:2, 2:4], system[:2, -1] = A, B, C
    system[2 : u.size, 4 : 2 + u.size] = np.eye(u.size - 2)
    return np.asarray(expm(system * time) @ np.concatenate([x, u.ravel(), [1.0]]))[:2]


@pytest.fixture
def load(capability_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Load]:
    """``load(model)`` instantiates an FMU by name; freed after the test."""
    slaves: list[Slave] = []

    def make(model: str) -> Slave:
        fmu = capability_dir / f"{model}.fmu"
        slaves.append(load_fmu(fmu, tmp_path_factory.mktemp("scratch"), model))
        return slaves[-1]

    yield make
    for slave in slaves:
        slave.close()


def started(
    slave: Slave,
    *,
    tolerance: float | None = 1e-9,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    discrete_outputs: Sequence[str] = (),
    early_return: bool = False,
    start_values: Mapping[str, StartValue] | None = None,
    stop_time: float | None = None,
) -> Slave:
    """The slave at its first communication point, t = 0."""
    slave.initialize(
        Initialize(
            start_time=0.0,
            stop_time=stop_time,
            relative_tolerance=tolerance,
            start_values=start_values or {},
            inputs=inputs,
            outputs=outputs,
            discrete_outputs=discrete_outputs,
            early_return=early_return,
        )
    )
    slave.exit_initialization_mode()
    return slave


def wheel(load: Load, version: int, tolerance: float | None = 1e-9) -> Slave:
    """The wheel, disturbed."""
    return started(
        load(f"wheel_me{version}"),
        tolerance=tolerance,
        inputs=("x_c", "v_c"),
        outputs=("x", "v"),
        start_values={"x": 0.1},
    )


def ball(
    load: Load, version: int, *, early_return: bool = False, stop_time: float | None = None
) -> Slave:
    """The bouncing ball."""
    return started(
        stop_time=stop_time,
        slave=load(f"bouncing_ball_me{version}"),
        tolerance=1e-10,
        outputs=("h", "v"),
        discrete_outputs=("bounces",),
        early_return=early_return,
    )


# ---- Integration -------------------------------------------------------------------------------


@pytest.mark.parametrize("version", VERSIONS)
def test_the_description_is_that_of_a_slave(load: Load, version: int) -> None:
    """Additions of the solver are declared: polynomial inputs, any step size, saved states."""
    description = load(f"wheel_me{version}").description
    assert description.kind == f"FMI {version}.0 model exchange"
    assert description.state_kind is StateKind.NATIVE
    assert description.input_derivatives is InputDerivatives.NATIVE
    can = description.capabilities
    assert can.can_interpolate_inputs
    assert can.can_handle_variable_step_size
    assert can.can_serialize_state
    assert can.outputs_follow_inputs
    assert can.max_output_derivative_order == 0


@pytest.mark.parametrize("order", [0, 1, 2, 3])
@pytest.mark.parametrize("version", VERSIONS)
def test_the_exact_solution_within_the_tolerance(load: Load, version: int, order: int) -> None:
    """For polynomial inputs of every order; the error falls with the tolerance."""
    u = INPUT[: order + 1]
    expected = exact_wheel(np.array([0.1, 0.0]), u, 0.1)
    errors = []
    for tolerance in (1e-6, 1e-9):
        slave = wheel(load, version, tolerance)
        slave.set_inputs(u)
        assert slave.do_step(0.0, 0.1, False) == (StepStatus.OK, 0.1)
        errors.append(np.abs(slave.get_outputs(0)[0] - expected).max())
    assert errors[0] < 1e-3
    assert errors[1] < 1e-6
    assert errors[1] < errors[0]
    if order:  # and the highest derivative mattered
        lower = exact_wheel(np.array([0.1, 0.0]), u[:-1], 0.1)
        assert np.abs(lower - expected).max() > 1e-5


def test_a_polynomial_goes_on_beyond_the_step(load: Load) -> None:
    """Two steps on one polynomial are the same as with its continuation set in between."""
    once, twice = (wheel(load, 2) for _ in range(2))
    signal = InputSignal(INPUT)
    for slave in (once, twice):
        slave.set_inputs(signal.derivatives)
        slave.do_step(0.0, 0.05, False)
    twice.set_inputs(signal.shifted(0.05).derivatives)
    for slave in (once, twice):
        slave.do_step(0.05, 0.05, False)
    np.testing.assert_allclose(once.get_outputs(0), twice.get_outputs(0), rtol=1e-9)


def test_both_versions_are_the_same_model(load: Load) -> None:
    """Equal equations with one solver give equal bits."""
    outputs = []
    for version in VERSIONS:
        slave = wheel(load, version)
        slave.set_inputs(INPUT)
        slave.do_step(0.0, 0.1, False)
        outputs.append(slave.get_outputs(0).tobytes())
    assert outputs[0] == outputs[1]


def test_a_step_that_makes_no_sense_is_refused(load: Load) -> None:
    """No length, no end, or another beginning."""
    slave = wheel(load, 2)
    for time, h in ((0.0, 0.0), (0.0, -0.1), (0.0, math.inf), (0.5, 0.1)):
        with pytest.raises(SlaveError, match="step"):
            slave.do_step(time, h, False)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_derivative_that_is_not_finite_rejects_the_step(load: Load, version: int) -> None:
    """The solver says why; a saved state leads back."""
    slave = wheel(load, version)
    state = slave.get_state()
    slave.set_inputs(np.array([[math.nan, 0.0]]))
    with pytest.raises(StepRejectedError, match=r"derivative is not finite at t=0\.0 s"):
        slave.do_step(0.0, 0.1, False)
    slave.set_state(state)
    slave.set_inputs(INPUT)
    assert slave.do_step(0.0, 0.1, False) == (StepStatus.OK, 0.1)
    slave.free_state(state)


# ---- Saved states ------------------------------------------------------------------------------


def march(slave: Slave, begin: float) -> bytes:
    """All that is seen over some steps, bit for bit."""
    seen, t = [], begin
    for i in range(4):
        slave.set_inputs(INPUT[: 1 + (i + 3) % 4] * math.cos(i))
        status, t = slave.do_step(t, 0.01 * (i + 1), False)
        assert status is StepStatus.OK
        seen.append(slave.get_outputs(0).tobytes())
    return b"".join(seen)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_restored_state_repeats_bit_for_bit(load: Load, version: int) -> None:
    """Saving leaves no trace, and restoring neither, whatever was done in between."""
    slave, untouched = wheel(load, version), wheel(load, version)
    for one in (slave, untouched):
        march(one, 0.0)
    state = slave.get_state()
    first = march(slave, 0.1)
    assert first == march(untouched, 0.1)
    for h in (0.3, 1e-6):
        slave.set_state(state)
        slave.do_step(0.1, h, False)
        slave.set_state(state)
        assert march(slave, 0.1) == first

    data = slave.serialize_state(state)
    other = wheel(load, version)
    restored = other.deserialize_state(data)
    other.set_state(restored)
    assert march(other, 0.1) == first
    with pytest.raises(SlaveError, match="damaged"):
        other.deserialize_state(data[:-1])
    slave.free_state(state)
    other.free_state(restored)


def without_saved_states(capability_dir: Path, model: str, path: Path) -> Path:
    """The FMU with a model description that declares no saved states."""
    from zipfile import ZipFile  # noqa: PLC0415  used here only

    with ZipFile(capability_dir / f"{model}.fmu") as archive, ZipFile(path, "w") as changed:
        for name in archive.namelist():
            content = archive.read(name)
            if name == "modelDescription.xml":
                for word in (b"FMUstate", b"FMUState"):
                    content = content.replace(word + b'="true"', word + b'="false"')
            changed.writestr(name, content)
    return path


@pytest.mark.parametrize("version", VERSIONS)
def test_continuous_states_are_enough_where_there_are_no_events(
    capability_dir: Path, tmp_path: Path, version: int
) -> None:
    """An FMU that saves nothing but can change nothing at events is saved by its states, and that
    is exact; one with events is not saved.
    """
    fmu = without_saved_states(capability_dir, f"wheel_me{version}", tmp_path / "wheel.fmu")
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    slave = load_fmu(fmu, scratch, "wheel")
    assert slave.description.state_kind is StateKind.NATIVE
    started(slave, inputs=("x_c", "v_c"), outputs=("x", "v"), start_values={"x": 0.1})
    march(slave, 0.0)
    state = slave.get_state()
    first = march(slave, 0.1)
    restored = slave.deserialize_state(slave.serialize_state(state))
    slave.set_state(restored)
    assert march(slave, 0.1) == first
    slave.close()

    bouncing = f"bouncing_ball_me{version}"
    description = describe_fmu(without_saved_states(capability_dir, bouncing, tmp_path / "b.fmu"))
    assert description.state_kind is StateKind.NONE
    assert not description.capabilities.can_get_and_set_state


def test_co_simulation_is_taken_where_both_are_there(capability_dir: Path, tmp_path: Path) -> None:
    """An FMU that brings its own solver is not given another one."""
    path = tmp_path / "both.xml"
    path.write_text(
        """<fmiModelDescription fmiVersion="2.0" modelName="m" guid="g" numberOfEventIndicators="0">
        <ModelExchange modelIdentifier="me"/><CoSimulation modelIdentifier="cs"/>
        <ModelVariables/><ModelStructure/></fmiModelDescription>"""
    )
    description = read_model_description(str(path), validate=False)
    interface = interface_2(description, None)  # type: ignore[arg-type]
    assert (interface.kind, interface.model_identifier) == ("FMI 2.0 co-simulation", "cs")


# ---- Events ------------------------------------------------------------------------------------

G, E = 9.81, 0.7


def bounces(until: float) -> tuple[list[float], float, float]:
    """Times of the bounces up to ``until`` [s], and h and v then, before the ball is at rest."""
    time, speed = math.sqrt(2.0 / G), E * math.sqrt(2.0 * G)
    if until < time:
        return [], 1.0 - G * until**2 / 2.0, -G * until
    times = [time]
    while times[-1] + 2.0 * speed / G < until:
        times.append(times[-1] + 2.0 * speed / G)
        speed *= E
    tau = until - times[-1]
    return times, speed * tau - G * tau**2 / 2.0, speed - G * tau


@pytest.mark.parametrize("step_size", [0.01, 0.1, 0.5, 2.0])
@pytest.mark.parametrize("version", VERSIONS)
def test_bounces_are_located(load: Load, version: int, step_size: float) -> None:
    """Also several in one communication step: the ball is where the exact solution is."""
    slave = ball(load, version)
    t = 0.0
    for _ in range(round(2.0 / step_size)):
        status, t = slave.do_step(t, step_size, False)
        assert status is StepStatus.OK
        times, h, v = bounces(t)
        np.testing.assert_allclose(slave.get_outputs(0), [[h, v]], rtol=1e-6, atol=1e-6)
        assert slave.get_discrete_outputs() == (len(times),)
    assert len(bounces(t)[0]) == 4


@pytest.mark.parametrize("version", VERSIONS)
def test_an_early_return_stops_at_the_bounce(load: Load, version: int) -> None:
    """At the analytic time; back and with a step up to it, the bounce is done."""
    slave = ball(load, version, early_return=True)
    t, (expected, _, _) = 0.0, bounces(2.0)
    for i, bounce in enumerate(expected):
        state = slave.get_state()
        for _ in range(2):
            status, event = slave.do_step(t, 2.0 - t, False)
            assert status is StepStatus.EARLY_RETURN
            assert event == pytest.approx(bounce, abs=1e-7)
            slave.set_state(state)
        slave.free_state(state)
        if i % 2:  # in two steps
            half = (event - t) / 2.0
            assert slave.do_step(t, half, False) == (StepStatus.OK, t + half)
            assert slave.get_discrete_outputs() == (i,)
            t += half
        assert slave.do_step(t, event - t, False) == (StepStatus.OK, t + (event - t))
        t += event - t
        assert slave.get_discrete_outputs() == (i + 1,)
    assert slave.do_step(t, 2.0 - t, False).status is StepStatus.OK


@pytest.mark.parametrize("early_return", [False, True])
@pytest.mark.parametrize("version", VERSIONS)
def test_the_fmu_is_never_beyond_its_stop_time(
    load: Load, version: int, early_return: bool
) -> None:
    """Not even to see whether the ball bounces just behind the end of the step.

    The FMU refuses such a time. A microsecond earlier than the stop time it is looked for.
    """
    (bounce, *_), _, _ = bounces(2.0)
    for ahead, stop_time in ((0, bounce - 1e-6), (early_return, bounce + 1e-6)):
        slave = ball(load, version, early_return=early_return, stop_time=stop_time)
        end = bounce - 1e-6
        assert slave.do_step(0.0, end, False) == (StepStatus.OK, end)
        assert slave.get_discrete_outputs() == (int(ahead),)


@pytest.mark.parametrize("version", VERSIONS)
def test_discrete_states_belong_to_the_saved_state(load: Load, version: int) -> None:
    """Back before a bounce the ball bounces again, bit for bit."""
    slave = ball(load, version)
    slave.do_step(0.0, 0.4, False)
    state = slave.get_state()
    seen = []
    for _ in range(3):
        slave.do_step(0.4, 1.0, False)
        seen.append((slave.get_outputs(0).tobytes(), slave.get_discrete_outputs()))
        slave.set_state(state)
        assert slave.get_discrete_outputs() == (0,)
    assert seen[0][1] == (2,)
    assert seen[1:] == seen[:1] * 2
    slave.free_state(state)


def test_a_ball_at_rest_stays_there(load: Load) -> None:
    """The bounces come ever faster and end; the slave does not."""
    slave = ball(load, 2)
    assert slave.do_step(0.0, 5.0, False) == (StepStatus.OK, 5.0)
    np.testing.assert_array_equal(slave.get_outputs(0), [[0.0, 0.0]])


SLOPES = [0.3, -0.3, 1.7, -1.7, 12.5, -12.5]


def relay(load: Load, *, is_on: bool, early_return: bool = False) -> Slave:
    """The relay, held between its limits 292.15 and 294.15."""
    slave = started(
        load("relay_me2"),
        inputs=("u",),
        discrete_outputs=("is_on", "changes"),
        early_return=early_return,
        start_values={"u": 290.0 if is_on else 293.15},
    )
    assert slave.get_discrete_outputs() == (is_on, int(is_on))
    slave.set_inputs(np.array([[293.15]]))
    slave.do_step(0.0, 0.125, False)
    return slave


@pytest.mark.parametrize("slope", SLOPES)
def test_a_relay_switches_whatever_the_rounding_is(load: Load, slope: float) -> None:
    """It compares strictly. An event that is located where the input *is* the limit would change
    nothing, and never come again.
    """
    slave = relay(load, is_on=slope > 0)
    slave.set_inputs(np.array([[293.15], [slope]]))
    assert slave.do_step(0.125, 4.0 / abs(slope), False).status is StepStatus.OK
    assert slave.get_discrete_outputs() == (slope < 0, 1 + (slope > 0))


@pytest.mark.parametrize("slope", [1.0, -1.0])
@pytest.mark.parametrize("early_return", [False, True])
def test_a_relay_whose_input_rests_at_the_limit(
    load: Load, slope: float, *, early_return: bool
) -> None:
    """At the limit, for whole steps, it does not switch; beyond it does, and back it does not. The
    master is not told of an event where its step begins.
    """
    limit = 294.15 if slope > 0 else 292.15
    is_on = slope > 0
    for way in (slope, -slope):
        slave = relay(load, is_on=is_on, early_return=early_return)
        slave.set_inputs(np.array([[limit]]))
        for begin in (0.125, 0.25):
            assert slave.do_step(begin, 0.125, False) == (StepStatus.OK, begin + 0.125)
            assert slave.get_discrete_outputs()[0] is is_on
        slave.set_inputs(np.array([[limit], [way]]))
        assert slave.do_step(0.375, 0.5, False) == (StepStatus.OK, 0.875)
        assert slave.get_discrete_outputs()[0] is (is_on if way != slope else not is_on)


def test_what_a_slave_was_taken_back_from_leaves_no_trace(load: Load) -> None:
    """Steps give equal bits with and without an event told and taken back, also where they
    end a bit before or behind the event.
    """
    rows = np.array([[293.15], [2.0]])
    for end in (0.625, 0.625 - 1e-8, 0.625 + 1e-8, 0.625 - 1e-5, 0.625 + 1e-5):
        seen = []
        for was_told in (False, True):
            slave = relay(load, is_on=True, early_return=True)
            state = slave.get_state()
            if was_told:
                slave.set_inputs(rows)
                result = slave.do_step(0.125, 1.0, False)
                assert result.status is StepStatus.EARLY_RETURN
                assert result.time == pytest.approx(0.625, abs=1e-12)
                slave.set_state(state)
            slave.set_inputs(rows)
            steps = [slave.do_step(0.125, 0.25, False), slave.do_step(0.375, end - 0.375, False)]
            seen.append((steps, slave.get_discrete_outputs()))
            slave.free_state(state)
        assert seen[0] == seen[1]


def test_a_second_life_is_as_good_as_the_first(load: Load) -> None:
    """Reset forgets solver, events and inputs."""
    slave = wheel(load, 3)
    first = march(slave, 0.0)
    slave.terminate()
    slave.get_outputs(0)
    slave.reset()
    started(slave, inputs=("x_c", "v_c"), outputs=("x", "v"), start_values={"x": 0.1})
    assert march(slave, 0.0) == first


# ---- The solver --------------------------------------------------------------------------------


def test_the_solver_integrates_and_finds_roots() -> None:
    """X' = -x from 1 with the root x = 1/2: at ln 2, just behind it, within the tolerance."""

    def derivative(_time: float, x: object, dx: object) -> None:
        dx[0] = -x[0]  # type: ignore[index]

    def root(_time: float, x: object, value: object) -> None:
        value[0] = x[0] - 0.5  # type: ignore[index]

    solver = CVode(1, 1, derivative, root)
    solver.x[:] = 1.0
    solver.restart(0.0, 1e-10, np.array([1e-10]))
    outcome, time = Outcome.STEP, 0.0
    while outcome is Outcome.STEP:
        outcome, time = solver.step(1.0)
    assert outcome is Outcome.ROOT
    assert time == pytest.approx(math.log(2.0), abs=1e-8)
    assert solver.x[0] <= 0.5
    while outcome is not Outcome.STOP:
        outcome, time = solver.step(1.0)
    assert time == 1.0
    assert solver.x[0] == pytest.approx(math.exp(-1.0), abs=1e-8)
    assert 0.0 < solver.first_step < 0.1
    solver.close()
    solver.close()


def test_an_error_in_the_equations_comes_out_of_the_solver() -> None:
    """Whatever it is, and the solver can be started again after it."""
    errors: list[Exception] = [SlaveError("no"), ZeroDivisionError("zero")]

    def derivative(_time: float, _x: object, dx: object) -> None:
        dx[0] = 0.0  # type: ignore[index]
        if errors:
            raise errors[0]

    solver = CVode(1, 0, derivative, derivative)
    while errors:
        solver.restart(0.0, 1e-6, np.array([1e-6]))
        with pytest.raises(type(errors[0]), match=str(errors[0])):
            solver.step(1.0)
        errors.pop(0)
    solver.restart(0.0, 1e-6, np.array([1e-6]))
    assert solver.step(1.0)[1] > 0.0
    solver.close()
