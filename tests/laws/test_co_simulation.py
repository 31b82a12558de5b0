"""Laws of the whole algorithm, with exact slaves, Python models and FMUs in the test's process."""

from __future__ import annotations

import math
import re
import signal
from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from master_node import Result, System, load_system, simulate
from master_node.observing.observers import Attempt, RunEnd, RunStart
from protocol.calls import Call, DoStep, Reply, StepResult, StepStatus
from protocol.description import Capabilities
from protocol.errors import (
    ConfigurationError,
    InterruptedRunError,
    SlaveError,
    StepRejectedError,
    StepSizeError,
)
from protocol.slave import Slave
from slave_node.execution.executor import Executor
from tests.support.places import SUPPORT
from tests.support.quarter_car_case import (
    CHASSIS,
    D_C,
    DISPLACEMENT,
    EXAMPLES,
    FORCE,
    K_C,
    K_W,
    M_W,
    STATES,
    WHEEL,
    LinearSlave,
    LinearSystem,
    Run,
    Z,
    car,
    exact_solution,
    global_errors,
    run_slaves,
)
from tests.support.slow import quick_at

MODELS = "quarter_car_models.py"
ESTIMATORS = ("rich", "mod")


def exact_car() -> dict[str, Slave]:
    """Chassis and wheel without an error of their own."""
    return {"chassis": CHASSIS.slave(), "wheel": WHEEL.slave()}


def fmu_car(fmu_dir: Path, **options: Any) -> System:
    """Chassis and wheel as FMUs."""
    return car("chassis.fmu", "wheel.fmu", base=fmu_dir, **options)


def rejected(result: Result) -> np.ndarray:
    """The attempts that were not accepted."""
    return np.asarray(result.steps[~result.steps["accepted"]])


def accepted(result: Result) -> np.ndarray:
    """The attempts that were."""
    return np.asarray(result.steps[result.steps["accepted"]])


def completed(run: Run) -> Result:
    """The result of a run that came to its end."""
    if run.error is not None:
        raise run.error
    assert run.result.summary["outcome"] == "completed"
    return run.result


# ---- Convergence --------------------------------------------------------------------------------

_WHOLE_CAR = LinearSystem(
    a=np.block([[CHASSIS.a, CHASSIS.b], [WHEEL.b, WHEEL.a]]),
    b=np.array([[0.0], [0.0], [0.0], [K_W / M_W]]),
    c=np.zeros(4),
    inputs=("z",),
    outputs=STATES,
)


@pytest.mark.parametrize("k", quick_at([2], range(4)))
def test_global_order_is_k_plus_1(k: int) -> None:
    """Law: with fixed H and an exact start-up history the error falls as H^(k+1).

    The road rises smoothly from t = 0 on and the car rested before, so the history at rest is
    exact. The whole car on that road has a polynomial input, hence an exact solution.
    """
    ramp, power = 0.5, 5  # RAMP_TIME, RAMP_POWER of the models
    derivatives = np.zeros((power + 1, 1))
    derivatives[power] = Z * math.factorial(power) / ramp**power
    exact = _WHOLE_CAR.propagate(np.zeros(4), derivatives, ramp)
    errors = []
    for step_size in (ramp / 128, ramp / 256, ramp / 512):
        system = car(
            f"{MODELS}:SmoothChassis",
            f"{MODELS}:SmoothWheel",
            base=SUPPORT,
            estimator="none",
            order=k,
            stop_time=ramp,
            initial_step_size=step_size,
            slave_tolerance=1e-13,
        )
        result = completed(run_slaves(system))
        errors.append(np.linalg.norm([result[name][-1] for name in STATES] - exact))
    observed = np.log2(np.array(errors[:-1]) / errors[1:])
    assert observed[-1] == pytest.approx(k + 1, abs=0.1)
    assert abs(observed[-1] - (k + 1)) < abs(observed[0] - (k + 1)) + 0.01


TABLE_1 = {  # accepted small steps, rejected double steps, mean error
    ("rich", 0): (1610, 18, 1.05e-3),
    ("rich", 1): (402, 20, 3.20e-4),
    ("rich", 2): (210, 20, 3.18e-4),
    ("mod", 0): (1612, 19, 1.06e-3),
    ("mod", 1): (413, 16, 3.32e-4),
    ("mod", 2): (218, 17, 2.74e-4),
}


@pytest.mark.parametrize(("estimator", "k"), TABLE_1)
def test_table_1_of_the_paper(estimator: str, k: int, fmu_dir: Path) -> None:
    """The paper's benchmark on the FMUs: steps within 15 %, errors at most 1.5 times its own."""
    steps, rejections, error = TABLE_1[estimator, k]
    result = completed(run_slaves(fmu_car(fmu_dir, preset="paper", estimator=estimator, order=k)))
    summary = result.summary
    assert summary["communication_steps"] == pytest.approx(steps, rel=0.15)
    assert summary["rejected_double_steps"] <= rejections + 10
    assert global_errors(result).mean() <= 1.5 * error
    assert result.time[-1] == 4.0
    assert len(result.time) == summary["communication_steps"] + 1


@pytest.mark.parametrize("estimator", quick_at(["mod"], ESTIMATORS))
@pytest.mark.parametrize("how", [{"preset": "paper", "order": 2}, {"order": 2}, {"order": "auto"}])
def test_the_tolerance_controls_the_error(
    estimator: str, how: dict[str, Any], fmu_dir: Path
) -> None:
    """Law: a tolerance 10 times smaller makes the error about 10 times smaller, on and on.

    The error of a double step is kept at the tolerance, so with k = 2 the global error falls with
    its power (k + 1) / (k + 2) = 0.75.
    """
    tolerances = [1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8]
    errors = []
    for tolerance in tolerances:
        system = fmu_car(
            fmu_dir,
            estimator=estimator,
            stop_time=1.0,
            relative_tolerance=tolerance,
            absolute_tolerance=tolerance,
            **how,
        )
        errors.append(global_errors(completed(run_slaves(system))).mean())
    slope = np.polyfit(np.log10(tolerances), np.log10(errors), 1)[0]
    assert 0.65 < slope < 1.25
    assert all(3.0 < a / b < 30.0 for a, b in pairwise(errors))


def test_python_models_and_fmus_agree(fmu_dir: Path) -> None:
    """Equal equations in two languages give equal trajectories within the slaves' tolerance."""
    options = {"estimator": "none", "slave_tolerance": 1e-10, "stop_time": 0.2}
    fmus = completed(run_slaves(fmu_car(fmu_dir, **options)))
    models = completed(run_slaves(car(**options)))
    assert np.array_equal(fmus.time, models.time)
    assert fmus.outputs == pytest.approx(models.outputs, rel=0.0, abs=1e-8)


@pytest.mark.parametrize("estimator", ["none", "mod"])
def test_the_order_of_the_slaves_does_not_matter(estimator: str, fmu_dir: Path) -> None:
    """All slaves step from the same data: which one is named first changes rounding at most."""
    system = fmu_car(fmu_dir, estimator=estimator, stop_time=1.0)
    turned = System(
        simulation=system.simulation,
        slaves=dict(reversed(system.slaves.items())),
        connections=tuple(reversed(system.connections)),
        base=system.base,
    )
    a, b = completed(run_slaves(system)), completed(run_slaves(turned))
    assert b.names == (*a.names[2:], *a.names[:2])
    for name in STATES:
        assert a[name] == pytest.approx(b[name], rel=1e-9, abs=1e-12)
        if estimator == "none":
            assert np.array_equal(a[name], b[name])


# ---- Reject and accept --------------------------------------------------------------------------


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("k", range(4))
def test_reject_then_accept_ends_in_the_same_bits(estimator: str, k: int, fmu_dir: Path) -> None:
    """Law: a rejected step leaves no trace.

    A first step that is too long is rejected; the run goes on bit for bit as one that starts
    with the smaller step. (Without a history at rest, whose points are H_0 apart.)
    """
    options = {
        "preset": "paper",  # what is learnt from a rejection would be used later on
        "estimator": estimator,
        "order": k,
        "initial_history": "none",
        "stop_time": 0.3,
    }
    long = completed(run_slaves(fmu_car(fmu_dir, initial_step_size=0.05, **options)))
    first = int(np.argmax(long.steps["accepted"]))
    assert first > 0
    taken = float(long.steps["step_size"][first])
    short = completed(run_slaves(fmu_car(fmu_dir, initial_step_size=taken, **options)))
    assert long.steps[first:].tolist() == short.steps.tolist()
    assert long.time.tobytes() == short.time.tobytes()
    assert long.outputs.tobytes() == short.outputs.tobytes()
    assert len(rejected(short)) > 0  # so rejections in the midst of it left no trace either


class WatchedSlave(LinearSlave):
    """Notes where each do_step started and in which state."""

    def __init__(self, system: LinearSystem, x: Sequence[float] = (0.0, 0.0)) -> None:
        self.begun: dict[float, set[bytes]] = defaultdict(set)
        self.inputs: list[np.ndarray] = []
        super().__init__(system, np.array(x))

    def set_inputs(self, derivatives: np.ndarray) -> None:
        """See `Slave`."""
        self.inputs.append(derivatives.copy())
        super().set_inputs(derivatives)

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        self.begun[communication_point].add(self.x.tobytes())
        return super().do_step(communication_point, step_size, prior)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_rejection_restores_every_slave(estimator: str) -> None:
    """All attempts from T_n start in the same state, in every slave, and in the accepted one."""
    slaves = {"chassis": WatchedSlave(CHASSIS), "wheel": WatchedSlave(WHEEL)}
    run = run_slaves(car(estimator=estimator, initial_step_size=0.02, stop_time=1.0), slaves)
    result = completed(run)
    repeated = rejected(result)["time"]
    assert len(repeated) > 3
    for name, slave in slaves.items():
        states = np.stack([result[f"{name}.x"], result[f"{name}.v"]], axis=1)
        at = dict(zip(result.time.tolist(), states, strict=True))
        for time in repeated:
            assert slave.begun[time] == {at[time].tobytes()}


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_saved_states_are_few_and_all_freed(estimator: str) -> None:
    """However long the run: a double step holds two at a time."""
    slaves = {"chassis": CHASSIS.slave(), "wheel": WHEEL.slave()}
    completed(run_slaves(car(estimator=estimator, initial_step_size=0.02, stop_time=1.0), slaves))
    for slave in slaves.values():
        assert slave.most_saved <= 2
        assert slave.saved == []


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_step_sizes_follow_the_controller(estimator: str, fmu_dir: Path) -> None:
    """Every H is what the paper's formula makes of the attempt before it, with P = k + 2."""
    result = completed(run_slaves(fmu_car(fmu_dir, preset="paper", estimator=estimator, order=1)))
    assert_controlled(result, exponent=3)


def away_from_the_end(result: Result) -> np.ndarray:
    """The attempts before the last ones, whose H is derived from the stop time."""
    steps = result.steps
    near = steps["time"] + 8.0 * steps["step_size"] >= result.time[-1]
    return np.asarray(steps[: int(np.argmax(near))])


def assert_controlled(result: Result, exponent: int) -> None:
    """H_(n+1) = H_n min(theta_max, max(theta_min, alpha ERR^(-1/P))) all the way."""
    steps = away_from_the_end(result)
    error = steps["error_norm"][:-1]
    with np.errstate(divide="ignore"):
        factors = np.clip(0.85 * error ** (-1.0 / exponent), 0.3, 2.0)
    assert steps["step_size"][1:] == pytest.approx(steps["step_size"][:-1] * factors, rel=1e-12)
    assert np.array_equal(steps["accepted"][:-1], error <= 1.0)
    inner = (factors > 0.3) & (factors < 2.0)
    assert np.count_nonzero(inner) > len(inner) // 2  # it is the exponent that is tested


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("k", quick_at([1, 2], range(3)))
def test_displacement_force_has_one_order_less(estimator: str, k: int, fmu_dir: Path) -> None:
    """The wheel's force contains its inputs, so P = k + 1; the car moves as with the other cut."""
    system = car(
        "chassis_force.fmu",
        "wheel_force.fmu",
        base=fmu_dir,
        connections=FORCE,
        preset="paper",
        estimator=estimator,
        order=k,
        stop_time=0.4,
        relative_tolerance=1e-3,
        absolute_tolerance=1e-3,
    )
    run = run_slaves(system)
    result = completed(run)
    assert run.coupled.feed_through.any()
    assert_controlled(result, exponent=k + 1)
    exact = exact_solution(result.time)
    assert np.abs(result["chassis.x"] - exact[:, 0]).max() < 2e-3
    force = K_C * (exact[:, 2] - exact[:, 0]) + D_C * (exact[:, 3] - exact[:, 1])
    assert np.abs(result["wheel.F"] - force).mean() < 0.02 * np.abs(force).max()


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("k", range(4))
def test_without_a_history_the_order_grows(estimator: str, k: int) -> None:
    """``initial_history = "none"``: order k as soon as there are points enough for it."""
    system = car(estimator=estimator, order=k, initial_history="none", stop_time=0.05)
    result = completed(run_slaves(system, exact_car()))
    orders = accepted(result)["order"].tolist()
    points = [2 * n + 1 for n in range(len(orders))]
    usable = [n - 1 if estimator == "mod" else (n - 1) // 2 for n in points]
    assert orders == [min(k, n) for n in usable]
    at_rest = completed(run_slaves(system.with_simulation(initial_history="rest"), exact_car()))
    assert set(at_rest.steps["order"].tolist()) == {k}


# ---- What slaves refuse -------------------------------------------------------------------------


@pytest.mark.parametrize(("estimator", "steps_of_first"), [("mod", 1), ("rich", 2)])
def test_discard_is_a_rejection(estimator: str, steps_of_first: int, fmu_dir: Path) -> None:
    """After fmi2Discard the next H comes from fmi2LastSuccessfulTime, and the run goes on.

    EST_Rich asks for 2H first, so it is that which must fit into the slave's longest step.
    """
    longest = 4e-3
    system = fmu_car(
        fmu_dir,
        parameters={"wheel": {"max_step": longest}},
        estimator=estimator,
        order=2,
        stop_time=0.5,
    )
    result = completed(run_slaves(system))
    steps = away_from_the_end(result)
    discards = np.flatnonzero(steps["limiting_variable"][:-1] == "wheel: discard")
    assert len(discards) > 3
    for n in discards:
        h = steps["step_size"][n]
        assert not steps["accepted"][n]
        assert steps["error_norm"][n] == np.inf
        assert steps["time"][n + 1] == steps["time"][n]
        part = longest / (steps_of_first * h)
        assert steps["step_size"][n + 1] == pytest.approx(h * max(0.3, 0.85 * part), rel=1e-9)
    assert (accepted(result)["step_size"] * steps_of_first <= longest).all()
    assert np.abs(global_errors(result)).max() < 5e-3


class FailsOnce(LinearSlave):
    """Returns fmi2Error, as it were, from its n-th do_step."""

    def __init__(self, system: LinearSystem, n: int) -> None:
        self.left = n
        super().__init__(system, np.zeros(2))

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        self.left -= 1
        if self.left == 0:
            raise StepRejectedError("fmi2Error")
        return super().do_step(communication_point, step_size, prior)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("n", [4, 5, 6])
def test_an_error_in_one_step_is_repeated_smaller(estimator: str, n: int) -> None:
    """fmi2Error anywhere in a double step: one retry from the saved state, which may succeed."""
    slaves = {"chassis": FailsOnce(CHASSIS, n), "wheel": WHEEL.slave()}
    result = completed(run_slaves(car(estimator=estimator, stop_time=0.05), slaves))
    (failed,) = np.flatnonzero(result.steps["limiting_variable"] == "chassis: fmi2Error")
    assert failed == 1  # the second attempt
    before, after = result.steps[failed], result.steps[failed + 1]
    assert after["time"] == before["time"]
    assert after["step_size"] == pytest.approx(0.3 * before["step_size"])


def test_an_error_in_two_attempts_ends_the_run() -> None:
    """fmi2Error again from the restored state with a smaller step: told with slave, t and cause."""
    system = car(
        f"{MODELS}:BreaksDown",
        f"{EXAMPLES / 'quarter_car.py'}:Wheel",
        base=SUPPORT,
        parameters={"chassis": {"breaks_at": 0.1}},
    )
    run = run_slaves(system)
    assert isinstance(run.error, StepRejectedError)
    assert run.error.slave == "chassis"
    assert run.error.phase == "do_step"
    assert "math domain error" in str(run.error)
    assert run.error.time is not None
    assert 0.05 < run.error.time <= 0.1
    last = run.result.steps[-2:]
    assert not last["accepted"].any() or not run.result.steps["accepted"][-1]
    assert run.result.summary["outcome"] == "failed"
    assert run.result.time[-1] <= 0.1


class NoNumber(LinearSlave):
    """Its second output is ``value`` from ``begin`` to ``end``."""

    def __init__(self, begin: float, end: float, value: float) -> None:
        self.span, self.value = (begin, end), value
        self.time = 0.0
        super().__init__(CHASSIS, np.zeros(2))

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        self.time = communication_point + step_size
        return super().do_step(communication_point, step_size, prior)

    def get_outputs(self, order: int) -> np.ndarray:
        """See `Slave`."""
        y = super().get_outputs(order)
        if self.span[0] <= self.time <= self.span[1]:
            y[0, 1] = self.value
        return y


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_nan_in_an_output_is_a_rejection(estimator: str, value: float) -> None:
    """NaN and infinity are never accepted and never reach another slave as accepted data.

    They stand for a short time, over which the controller steps once it has reduced H: no
    accepted point lies in it.
    """
    slaves = {"chassis": NoNumber(0.0301, 0.0302, value), "wheel": WatchedSlave(WHEEL)}
    result = completed(run_slaves(car(estimator=estimator, stop_time=0.1, order=0), slaves))
    assert np.isfinite(result.outputs).all()
    assert all(np.isfinite(u).all() for u in slaves["wheel"].inputs)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_nan_that_stays_ends_the_run_at_the_smallest_step(estimator: str) -> None:
    """At the smallest H it is an error that names variable, t and H."""
    slaves = {"chassis": NoNumber(0.03, 1.0, math.nan), "wheel": WatchedSlave(WHEEL)}
    system = car(estimator=estimator, stop_time=0.1, smallest_step_size=1e-6)
    run = run_slaves(system, slaves)
    assert isinstance(run.error, StepSizeError)
    assert run.error.exit_code == 4
    assert "chassis.v is not finite" in str(run.error)
    assert run.error.step_size == pytest.approx(1e-6, rel=1e-9)
    assert run.error.time == run.result.time[-1]
    assert 0.03 - 1e-5 < run.result.time[-1] < 0.03
    assert np.isfinite(run.result.outputs).all()
    assert all(np.isfinite(u).all() for u in slaves["wheel"].inputs)
    assert rejected(run.result)["limiting_variable"][-1] == "chassis.v is not finite"
    assert rejected(run.result)["error_norm"][-1] == np.inf


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_the_smallest_step_size_is_an_error_that_names_the_variable(estimator: str) -> None:
    """A tolerance out of reach: which output, how large ERR, where, and what to do."""
    system = car(
        estimator=estimator,
        smallest_step_size=5e-4,
        relative_tolerance=0.0,
        absolute_tolerance=1e-10,
    )
    run = run_slaves(system, exact_car())
    assert isinstance(run.error, StepSizeError)
    text = str(run.error)
    limiting = rejected(run.result)["limiting_variable"][-1]
    assert limiting in STATES
    assert f"most of it from {limiting}" in text
    assert "t=0.0 s, H=0.0005 s" in text
    assert "smallest_step_size" in text
    assert run.result.summary["outcome"] == "failed"


class EndsEarly(LinearSlave):
    """Wants to end the simulation at t = 0.03 s."""

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        if communication_point + step_size > 0.03:
            return StepResult(StepStatus.TERMINATED, communication_point)
        return super().do_step(communication_point, step_size, prior)


@pytest.mark.parametrize("estimator", [*ESTIMATORS, "none"])
def test_a_slave_may_end_the_simulation(estimator: str) -> None:
    """fmi2Terminated is an orderly end with a note that names the slave."""
    slaves = {"chassis": CHASSIS.slave(), "wheel": EndsEarly(WHEEL, np.zeros(2))}
    run = run_slaves(car(estimator=estimator), slaves)
    assert run.error is None
    summary = run.result.summary
    assert summary["outcome"] == "terminated by a slave"
    assert summary["message"].startswith("wheel ended the simulation after t=")
    assert 0.0 < run.result.time[-1] <= 0.03


# ---- What slaves cannot do ----------------------------------------------------------------------


@pytest.mark.parametrize("estimator", [*ESTIMATORS, "none"])
@pytest.mark.parametrize("k", [0, 2])
def test_a_slave_that_takes_no_derivatives_gets_order_0(estimator: str, k: int) -> None:
    """Without canInterpolateInputs: constants for that slave, polynomials for the others.

    It is said aloud, p of its outputs is that of order 0, and so is P.
    """
    simple = Capabilities(can_get_and_set_state=True, can_handle_variable_step_size=True)
    slaves = {"chassis": CHASSIS.slave(), "wheel": WHEEL.slave(capabilities=simple)}
    options = {"preset": "paper", "estimator": estimator, "order": k, "stop_time": 0.2}
    run = run_slaves(car(**options), slaves)
    result = completed(run)
    warning = (
        "wheel cannot interpolate inputs (canInterpolateInputs): its inputs are held constant "
        f"in each step, order 0 instead of {k}"
    )
    assert run.warnings == ([warning] if k else [])
    assert slaves["wheel"].input_rows == {1}
    assert slaves["chassis"].input_rows == {1, k + 1}  # 1 in initialization mode
    if estimator != "none":
        assert_controlled(result, exponent=2)
        assert global_errors(result).max() < 5e-3


def test_what_step_size_control_needs_is_checked_before_the_run() -> None:
    """Named with the slave, and with the remedy, which works."""
    words = "wheel: the model cannot handle variable"
    simple = Capabilities(can_get_and_set_state=True, can_interpolate_inputs=True)
    slaves = {"chassis": CHASSIS.slave(), "wheel": WHEEL.slave(capabilities=simple)}
    with pytest.raises(ConfigurationError, match=f"{words}.*--estimator none"):
        run_slaves(car(), slaves)
    completed(run_slaves(car(estimator="none", stop_time=0.1), slaves))


# ---- Fixed steps, and the end -------------------------------------------------------------------


class Clock(LinearSlave):
    """One output, which stands still; only its communication points matter."""

    def __init__(self) -> None:
        one = np.zeros((1, 1))
        super().__init__(LinearSystem(one, np.zeros((1, 0)), np.zeros(1), (), ("y",)), np.zeros(1))

    def do_step(self, communication_point: float, step_size: float, prior: bool) -> StepResult:
        """See `Slave`."""
        assert step_size > 0.0
        return StepResult(StepStatus.OK, communication_point + step_size)


def clock(**simulation: Any) -> Result:
    """A run of nothing but time."""
    system = System(simulation=simulation, slaves={"clock": {}})
    return completed(run_slaves(system, {"clock": Clock()}))


@given(st.floats(-10.0, 10.0), st.integers(1, 200), st.floats(1e-6, 10.0))
@settings(max_examples=50)
def test_fixed_steps_that_divide_the_time_are_all_of_one_size(
    start: float, n: int, step_size: float
) -> None:
    """From start to start + n H there are n steps of H, however they are rounded."""
    stop = start + n * step_size
    result = clock(start_time=start, stop_time=stop, initial_step_size=step_size, estimator="none")
    assert len(result.time) == n + 1
    assert result.time[:-1].tolist() == [start + i * step_size for i in range(n)]
    assert result.time[-1] == stop


@given(st.floats(-10.0, 10.0), st.floats(0.1, 10.0), st.floats(0.01, 2.0))
@settings(max_examples=50)
def test_fixed_steps_stand_on_their_grid_and_end_on_the_stop_time(
    start: float, duration: float, part: float
) -> None:
    """Points are start + n H, so that rounding does not add up; the last one is the stop time."""
    stop, step_size = start + duration, part * duration
    result = clock(start_time=start, stop_time=stop, initial_step_size=step_size, estimator="none")
    n = np.arange(len(result.time) - 1)
    assert result.time[:-1].tolist() == (start + n * step_size).tolist()
    assert result.time[-1] == stop
    assert (np.diff(result.time) > 0.0).all()


@pytest.mark.parametrize("n", [3, 7, 10, 49, 98, 103, 1000])
@pytest.mark.parametrize("stop", [0.3, 0.7, 1.0, 4.0])
def test_decimal_step_sizes_give_no_sliver_at_the_end(n: int, stop: float) -> None:
    """0.7 / 49 fits 49 times into 0.7, whatever the last bits of 49 * (0.7 / 49) say."""
    result = clock(stop_time=stop, initial_step_size=stop / n, estimator="none")
    assert len(result.time) == n + 1
    assert result.time[-1] == stop


@given(st.floats(-10.0, 10.0), st.floats(0.1, 10.0), st.floats(0.01, 1.0))
@settings(max_examples=50)
def test_controlled_steps_end_exactly_on_the_stop_time(
    start: float, duration: float, part: float
) -> None:
    """The last double step is derived from the end point: the end is exact, and never passed."""
    stop = start + duration
    result = clock(start_time=start, stop_time=stop, initial_step_size=part * duration / 2)
    assert result.time[-1] == stop
    assert (np.diff(result.time) > 0.0).all()


# ---- Initialization -----------------------------------------------------------------------------


def test_the_row_of_t0_is_consistent_with_the_connections(fmu_dir: Path) -> None:
    """F(T_0) contains the chassis' start values, which came along the connections: exactly."""
    x_c, v_c, x_w, v_w = 0.03, -0.2, 0.05, 0.4
    for chassis, wheel, base in (
        ("chassis_force.fmu", "wheel_force.fmu", fmu_dir),
        ("quarter_car.py:ChassisForce", "quarter_car.py:WheelForce", EXAMPLES),
    ):
        system = car(
            chassis,
            wheel,
            base=base,
            connections=FORCE,
            parameters={"chassis": {"x": x_c, "v": v_c}, "wheel": {"x": x_w, "v": v_w}},
            stop_time=0.01,
        )
        result = completed(run_slaves(system))
        assert result["chassis.x"][0] == x_c
        assert result["chassis.v"][0] == v_c
        assert result["wheel.F"][0] == K_C * (x_w - x_c) + D_C * (v_w - v_c)


def gains(*links: tuple[str, str], **slaves: dict[str, float]) -> System:
    """Slaves that are nothing but feed-through."""
    return System(
        simulation={"stop_time": 1.0},
        slaves={
            name: {"model": f"{MODELS}:Gain", "parameters": parameters}
            for name, parameters in slaves.items()
        },
        connections=links,
        base=SUPPORT,
    )


def test_values_propagate_through_any_number_of_slaves() -> None:
    """A chain of feed-through, written from its end: every output is right at T_0."""
    system = gains(
        ("c.y", "d.u"),
        ("b.y", "c.u"),
        ("a.y", "b.u"),
        d={"gain": 3.0},
        c={"gain": -2.0, "offset": 1.0},
        b={"gain": 5.0},
        a={"offset": 7.0},
    )
    result = completed(run_slaves(system))
    assert result.outputs[0].tolist() == [3.0 * -69.0, -69.0, 35.0, 7.0]
    assert result.outputs[-1].tolist() == result.outputs[0].tolist()


def test_an_algebraic_loop_is_solved() -> None:
    """y_a = y_b / 2 + 1 and y_b = y_a / 2 across two slaves: 4/3 and 2/3, and it stays there."""
    system = gains(("a.y", "b.u"), ("b.y", "a.u"), a={"gain": 0.5, "offset": 1.0}, b={"gain": 0.5})
    result = completed(run_slaves(system))
    assert result.outputs[0] == pytest.approx([4 / 3, 2 / 3], rel=1e-11)
    assert result.outputs[-1] == pytest.approx([4 / 3, 2 / 3], rel=1e-8)


@pytest.mark.parametrize("gain", [2.0, -1.0, 30.0])
def test_an_algebraic_loop_is_solved_where_the_plain_iteration_diverges(gain: float) -> None:
    """y_a = g y_b + 1 and y_b = 1.5 g y_a: the loop's gain 1.5 g^2 is above 1.

    At T_0, and with ``evaluate_outputs`` at every communication point; iterated double steps have
    converged at a hundredth of the tolerance, 1e-6 (1 + |y|).
    """
    system = gains(
        ("a.y", "b.u"), ("b.y", "a.u"), a={"gain": gain, "offset": 1.0}, b={"gain": gain * 1.5}
    )
    y_a = 1.0 / (1.0 - 1.5 * gain**2)
    for estimator in ("none", "mod", "rich"):
        options = {"evaluate_outputs": True, "estimator": estimator}
        result = completed(run_slaves(system.with_simulation(**options)))
        for row in result.outputs[[0, len(result.time) // 2, -1]]:
            assert row == pytest.approx([y_a, 1.5 * gain * y_a], rel=2e-6, abs=2e-6)


@pytest.mark.parametrize("gain", [1.0, 1e200])
def test_an_algebraic_loop_that_does_not_converge_is_named(gain: float) -> None:
    """Slaves and variables along the loop, the phase and the remedy; no step is tried.

    With a gain of 1 all around there is no solution; with 1e400 no number.
    """
    system = gains(
        ("a.y", "b.u"), ("b.y", "a.u"), a={"gain": gain, "offset": 1.0}, b={"gain": gain}
    )
    with pytest.raises(SlaveError, match=re.escape("the algebraic loop ")) as info:
        run_slaves(system)
    text = str(info.value)
    assert "a.y -> b.y" in text
    assert "b.y -> a.y" in text
    assert text.startswith("initialization at t=0.0 s: ")


def test_an_output_that_is_no_number_at_t0_is_named() -> None:
    """NaN at the start is an error of the initialization, not of the first step."""
    slaves = {"chassis": NoNumber(0.0, 1.0, math.nan), "wheel": WHEEL.slave()}
    with pytest.raises(SlaveError, match=r"initialization at t=0.0 s: chassis\.v is not finite"):
        run_slaves(car(), slaves)


# ---- What a run costs and tells -----------------------------------------------------------------


class CountingExecutor(Executor):
    """Counts the programs that hold a do_step."""

    programs: dict[int, list[int]] = {}  # noqa: RUF012  shared by the run's slaves

    def execute(self, calls: Sequence[Call]) -> Reply:
        """See `CallExecutor`."""
        steps = sum(isinstance(call, DoStep) for call in calls)
        if steps:
            self.programs.setdefault(id(self), []).append(steps)
        return super().execute(calls)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("k", [0, 3])
def test_a_double_step_is_two_requests(
    estimator: str, k: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exactly 2 per slave and attempt, with 2 do_steps in the first and 1 in the second.

    Whatever the estimator and the order; restoring and freeing states ride along.
    """
    monkeypatch.setattr("tests.support.quarter_car_case.Executor", CountingExecutor)
    monkeypatch.setattr(CountingExecutor, "programs", {})
    system = car(estimator=estimator, order=k, initial_step_size=0.02, stop_time=0.5)
    result = completed(run_slaves(system, exact_car()))
    attempts = len(result.steps)
    assert len(rejected(result)) > 0
    assert list(CountingExecutor.programs.values()) == [[2, 1] * attempts] * 2
    summary = result.summary
    assert summary["round_trips"] == 2 * attempts
    for name in ("chassis", "wheel"):
        assert summary["requests"][name] == 2 * attempts
        assert summary["do_steps"][name] == 3 * attempts
        assert summary["rollbacks"][name] == attempts + len(rejected(result))


def test_a_fixed_step_is_one_request() -> None:
    """Without an estimator nothing is saved, restored or compared."""
    slaves = exact_car()
    result = completed(run_slaves(car(estimator="none", stop_time=0.1), slaves))
    assert result.summary["requests"] == {"chassis": 100, "wheel": 100}
    assert result.summary["rollbacks"] == {"chassis": 0, "wheel": 0}
    assert all(slave.most_saved == 0 for slave in slaves.values())  # type: ignore[attr-defined]
    assert np.isnan(result.steps["error_norm"]).all()


def test_the_summary_agrees_with_the_steps(fmu_dir: Path) -> None:
    """Counters in the summary are those of the attempts that the observers saw."""
    result = completed(run_slaves(fmu_car(fmu_dir, stop_time=1.0)))
    summary = result.summary
    taken = accepted(result)
    assert summary["communication_steps"] == 2 * len(taken)
    assert summary["rejected_double_steps"] == len(rejected(result))
    assert summary["smallest_step_size"] == taken["step_size"].min()
    assert summary["largest_step_size"] == taken["step_size"].max()
    assert summary["simulated_time"] == 1.0
    assert summary["settings"]["simulation"]["order"] == 1
    assert set(taken["limiting_variable"]) <= set(STATES)


class CtrlC:
    """An observer at whose side somebody presses Ctrl-C when it hears of the attempt ``n``."""

    def __init__(self, n: int) -> None:
        self.left = n
        self.end: RunEnd | None = None

    def started(self, start: RunStart) -> None:
        """Nothing yet."""

    def attempted(self, attempt: Attempt) -> None:
        """Now."""
        self.left -= 1
        if self.left == 0:
            signal.raise_signal(signal.SIGINT)

    def ended(self, end: RunEnd) -> None:
        """Note it."""
        self.end = end


@pytest.mark.parametrize("estimator", ["mod", "none"])
def test_ctrl_c_keeps_what_was_accepted(estimator: str, tmp_path: Path) -> None:
    """The run ends with its own error and exit code; the results say so and are readable.

    Who is told of the step later, here the files, hears of all of it: Ctrl-C waits until then.
    What handles it afterwards is what handled it before.
    """
    observer = CtrlC(10)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(InterruptedRunError, match=r"interrupted at t=") as info:
        simulate(
            load_system(EXAMPLES / "displacement_python.toml"),
            output=tmp_path / "out",
            in_process=True,
            observers=[observer],
            estimator=estimator,
        )
    assert info.value.exit_code == 130
    assert signal.getsignal(signal.SIGINT) is before
    result = Result.load(tmp_path / "out")
    assert result.summary["outcome"] == "interrupted"
    assert len(result.steps) == 10
    steps = len(accepted(result)) * (1 if estimator == "none" else 2)
    assert len(result.time) == 1 + steps
    assert result.summary["communication_steps"] == steps
    assert observer.end is not None
    assert observer.end.outcome == "interrupted"


def test_ten_lines_of_python() -> None:
    """Two slaves and their connections, run, and a variable by its name: what the readme shows."""
    system = System(
        simulation={"stop_time": 0.5, "initial_step_size": 1e-3},
        slaves={
            "chassis": {"model": "quarter_car.py:Chassis"},
            "wheel": {"model": "quarter_car.py:Wheel"},
        },
        connections=DISPLACEMENT,
        base=EXAMPLES,
    )
    result = simulate(system, in_process=True, order=2)
    assert result["wheel.x"][-1] == pytest.approx(exact_solution(0.5)[0, 2], abs=1e-3)
    assert result.summary["order"] == 2
