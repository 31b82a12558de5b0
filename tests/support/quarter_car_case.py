"""The quarter car as the tests need it: exact slaves, systems, and runs within the test's process.

The models at the end are loaded by their names, as those of a user are.
"""

from __future__ import annotations

import inspect
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import expm

from master_node import Result, System
from master_node.coupling.coupled_system import CoupledSystem, resolve
from master_node.coupling.scheme import CouplingScheme
from master_node.judging.comparison import ErrorControl, StepError
from master_node.numerics.double_step_times import DoubleStepTimes
from master_node.numerics.error_estimators import ESTIMATORS
from master_node.numerics.extrapolation import CouplingHistory, InputPolynomial
from master_node.observing.observers import Observer, Observers
from master_node.preparing.capabilities import check_capabilities
from master_node.preparing.initialization import initialize
from master_node.results import Recording
from master_node.running.co_simulation import CoSimulation
from master_node.slaves.group import SlaveGroup
from master_node.slaves.link import LocalSlave
from master_node.stepping.double_step import DoubleStep, DoubleStepper
from master_node.system.summary import settings_of
from protocol.calls import Initialize, StepResult, StepStatus
from protocol.description import Capabilities, InputDerivatives, SlaveDescription, StateKind
from protocol.signals import InputSignal
from protocol.slave import Slave
from protocol.variables import Causality, Variable
from slave_node.execution.executor import Executor
from slave_node.loading import load_slave
from slave_node.python.loading import load_model_class
from tests.support.places import ROOT

EXAMPLES = ROOT / "examples" / "quarter_car"

_car: Any = inspect.getmodule(load_model_class("quarter_car.py:Chassis", EXAMPLES))

STATES = ("chassis.x", "chassis.v", "wheel.x", "wheel.v")
DISPLACEMENT = (
    ("chassis.x", "wheel.x_c"),
    ("chassis.v", "wheel.v_c"),
    ("wheel.x", "chassis.x_w"),
    ("wheel.v", "chassis.v_w"),
)
FORCE = (("chassis.x", "wheel.x_c"), ("chassis.v", "wheel.v_c"), ("wheel.F", "chassis.F"))

M_W, M_C, K_W, K_C, D_C, Z = 40.0, 400.0, 150000.0, 15000.0, 1000.0, 0.1


def exact_solution(t: float | np.ndarray) -> np.ndarray:
    """`STATES` of the car at the times ``t``, shape (n, 4)."""
    solution: np.ndarray = _car.exact_solution(np.atleast_1d(t))
    return solution


# ---- Slaves without an error of their own -------------------------------------------------------


@dataclass(frozen=True)
class LinearSystem:
    """x' = A x + B u + c and y = C x + D u; without C and D all states are outputs."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    of_states: np.ndarray | None = None
    of_inputs: np.ndarray | None = None
    propagators: dict[tuple[int, float], np.ndarray] = field(default_factory=dict)

    def propagate(self, x: np.ndarray, u: np.ndarray, time: float) -> np.ndarray:
        """The states after ``time`` [s] with polynomial inputs, row j of ``u`` the j-th derivative.

        (x, u, u', ..., 1) obeys one linear autonomous system, whose solution is an exponential.
        """
        n, (rows, m) = len(x), u.shape
        key = (rows, time)
        if key not in self.propagators:
            system = np.zeros((n + rows * m + 1, n + rows * m + 1))
            system[:n, :n], system[:n, n : n + m], system[:n, -1] = self.a, self.b, self.c
            system[n : n + (rows - 1) * m, n + m : n + rows * m] = np.eye((rows - 1) * m)
            if len(self.propagators) > 1000:
                self.propagators.clear()
            self.propagators[key] = expm(system * time)[:n]
        reached: np.ndarray = self.propagators[key] @ np.concatenate([x, u.ravel(), [1.0]])
        return reached

    def read(self, x: np.ndarray, u: np.ndarray, order: int) -> np.ndarray:
        """Outputs and, for order 1, their derivatives, from the states and the inputs' rows."""
        slopes = np.zeros(u.shape[1]) if len(u) < 2 else u[1]
        rows = [(x, u[0]), (self.a @ x + self.b @ u[0] + self.c, slopes)][: order + 1]
        if self.of_states is None or self.of_inputs is None:
            return np.array([states for states, _ in rows])
        return np.array([self.of_states @ s + self.of_inputs @ v for s, v in rows])

    @property
    def feed_through(self) -> dict[str, tuple[str, ...]]:
        """For each output the inputs that it depends on directly."""
        if self.of_inputs is None:
            return {}
        return {
            output: tuple(name for name, d in zip(self.inputs, row, strict=True) if d)
            for output, row in zip(self.outputs, self.of_inputs, strict=True)
            if row.any()
        }

    def slave(self, x: Sequence[float] | np.ndarray = (0.0, 0.0), **options: Any) -> LinearSlave:
        """A slave that starts at ``x``."""
        return LinearSlave(self, np.array(x, dtype=float), **options)


CHASSIS = LinearSystem(
    a=np.array([[0.0, 1.0], [-K_C / M_C, -D_C / M_C]]),
    b=np.array([[0.0, 0.0], [K_C / M_C, D_C / M_C]]),
    c=np.zeros(2),
    inputs=("x_w", "v_w"),
    outputs=("x", "v"),
)
WHEEL = LinearSystem(
    a=np.array([[0.0, 1.0], [-(K_W + K_C) / M_W, -D_C / M_W]]),
    b=np.array([[0.0, 0.0], [K_C / M_W, D_C / M_W]]),
    c=np.array([0.0, K_W * Z / M_W]),
    inputs=("x_c", "v_c"),
    outputs=("x", "v"),
)


CHASSIS_FORCE = LinearSystem(
    a=np.array([[0.0, 1.0], [0.0, 0.0]]),
    b=np.array([[0.0], [1.0 / M_C]]),
    c=np.zeros(2),
    inputs=("F",),
    outputs=("x", "v"),
)
WHEEL_FORCE = LinearSystem(
    a=WHEEL.a,
    b=WHEEL.b,
    c=WHEEL.c,
    inputs=WHEEL.inputs,
    outputs=("x", "v", "F"),
    of_states=np.array([[1.0, 0.0], [0.0, 1.0], [K_C, D_C]]),
    of_inputs=np.array([[0.0, 0.0], [0.0, 0.0], [-K_C, -D_C]]),
)

ALL = Capabilities(
    can_get_and_set_state=True,
    can_interpolate_inputs=True,
    can_handle_variable_step_size=True,
)
"""Capabilities that error control needs, and nothing more: outputs without derivatives."""


class LinearSlave(Slave):
    """A `LinearSystem` as a slave, propagated exactly. Counts its saved states."""

    def __init__(
        self, system: LinearSystem, x: np.ndarray, capabilities: Capabilities | None = None
    ) -> None:
        self.system = system
        self._x0 = x
        self.description = SlaveDescription(
            model="linear",
            kind="test",
            variables=(
                *(Variable(name, Causality.INPUT, start=0.0) for name in system.inputs),
                *(Variable(name, Causality.OUTPUT) for name in system.outputs),
            ),
            capabilities=capabilities or ALL,
            feed_through=system.feed_through,
            initial_feed_through=system.feed_through,
            state_kind=StateKind.NATIVE,
            input_derivatives=(
                InputDerivatives.NATIVE
                if (capabilities or ALL).can_interpolate_inputs
                else InputDerivatives.NONE
            ),
        )
        self.saved: list[object] = []
        self.most_saved = 0
        self.input_rows: set[int] = set()
        self.reset()

    def reset(self) -> None:
        """See `Slave`."""
        self.x, self.u = self._x0, np.zeros((1, len(self.system.inputs)))

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`."""
        assert experiment.inputs == self.system.inputs
        assert experiment.outputs == self.system.outputs

    def exit_initialization_mode(self) -> None:
        """See `Slave`."""

    def set_inputs(self, derivatives: np.ndarray) -> None:
        """See `Slave`."""
        self.input_rows.add(len(derivatives))
        self.u = derivatives

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`."""
        self.x = self.system.propagate(self.x, self.u, step_size)
        self.u = InputSignal(self.u).shifted(step_size).derivatives
        return StepResult(StepStatus.OK, communication_point + step_size)

    def get_outputs(self, order: int) -> np.ndarray:
        """See `Slave`."""
        assert order <= self.description.capabilities.max_output_derivative_order
        return self.system.read(self.x, self.u, order)

    def get_state(self) -> object:
        """See `Slave`."""
        state = (self.x, self.u)
        self.saved.append(state)
        self.most_saved = max(self.most_saved, len(self.saved))
        return state

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        assert any(state is saved for saved in self.saved)
        self.x, self.u = state  # type: ignore[misc]

    def free_state(self, state: object) -> None:
        """See `Slave`."""
        self.saved = [saved for saved in self.saved if saved is not state]

    def serialize_state(self, state: object) -> bytes:
        """See `Slave`."""
        raise NotImplementedError

    def deserialize_state(self, data: bytes) -> object:
        """See `Slave`."""
        raise NotImplementedError

    def terminate(self) -> None:
        """See `Slave`."""

    def close(self) -> None:
        """See `Slave`."""


# ---- Systems and runs ---------------------------------------------------------------------------


def car(
    chassis: str = "quarter_car.py:Chassis",
    wheel: str = "quarter_car.py:Wheel",
    *,
    base: Path = EXAMPLES,
    connections: Iterable[tuple[str, str]] = DISPLACEMENT,
    parameters: Mapping[str, Mapping[str, Any]] | None = None,
    **simulation: Any,
) -> System:
    """The quarter car; tolerances and order are those of the paper unless given."""
    settings = {"stop_time": 4.0, "initial_step_size": 1e-3, "order": 1, **simulation}
    given = parameters or {}
    return System(
        simulation=settings,
        slaves={
            "chassis": {"model": chassis, "parameters": given.get("chassis", {})},
            "wheel": {"model": wheel, "parameters": given.get("wheel", {})},
        },
        connections=tuple(connections),
        base=base,
    )


@dataclass
class Run:
    """A run within this process, with everything in the open."""

    result: Result
    coupled: CoupledSystem
    warnings: list[str]
    error: BaseException | None = None


def run_slaves(
    system: System, slaves: Mapping[str, Slave] | None = None, observers: Sequence[Observer] = ()
) -> Run:
    """Run the system with these slaves, or with those that its models name.

    An error that ends the run after its start is in what is returned, together with all that
    was accepted before.
    """
    with ExitStack() as stack:
        executors = {}
        for name, settings in system.slaves.items():
            scratch = stack.enter_context(tempfile.TemporaryDirectory())
            slave = (slaves or {}).get(name) or load_slave(
                str(settings.model), system.base, name, Path(scratch)
            )
            executors[name] = Executor(slave)
            stack.callback(executors[name].close)
        coupled = resolve(system, {name: e.description for name, e in executors.items()})
        warnings = check_capabilities(coupled, system)
        recording = Recording(settings_of(system, {}))
        group = SlaveGroup({name: LocalSlave(e) for name, e in executors.items()})
        failure: Exception | None = None
        try:
            CoSimulation(group, coupled, system, Observers([recording, *observers])).run()
        except Exception as error:
            failure = error
        try:
            result = recording.result()
        except Exception:
            if failure is not None:
                raise failure from None
            raise
        return Run(result, coupled, warnings, failure)


def global_errors(result: Result) -> np.ndarray:
    """The Euclidean norm of the four states' error at each communication point, shape (n,)."""
    states = np.stack([result[name] for name in STATES], axis=1)
    return np.asarray(np.linalg.norm(states - exact_solution(result.time), axis=1))


# ---- One double step from exact data ------------------------------------------------------------

WHOLE_CAR = LinearSystem(
    a=np.block([[CHASSIS.a, CHASSIS.b], [WHEEL.b, WHEEL.a]]),
    b=np.zeros((4, 0)),
    c=np.array([0.0, 0.0, 0.0, K_W * Z / M_W]),
    inputs=(),
    outputs=STATES,
)


def exact_outputs(names: Sequence[str], time: float) -> np.ndarray:
    """Values and derivatives of some outputs of the exact solution, shape (2, m)."""
    x = exact_solution(time)[0]
    states = np.array([x, WHOLE_CAR.a @ x + WHOLE_CAR.c])
    columns = dict(zip(STATES, states.T, strict=True))
    columns["wheel.F"] = K_C * (columns["wheel.x"] - columns["chassis.x"]) + D_C * (
        columns["wheel.v"] - columns["chassis.v"]
    )
    return np.stack([columns[name] for name in names], axis=1)


@dataclass(frozen=True)
class LocalError:
    """A double step from the exact solution with an exact history, shape (m,) each."""

    names: tuple[str, ...]
    judged: StepError
    error: np.ndarray
    step: DoubleStep

    @property
    def estimate(self) -> np.ndarray:
        """EST."""
        return self.judged.estimate

    def deviation(self, *names: str) -> float:
        """Deviation of the estimates of some outputs from the true errors, relative to these.

        In the norm of all of them. A single one may be slower where its leading term happens to
        be small, and a displacement is one integration further from the inputs than a velocity,
        so its error is one order smaller, with a constant of its own.
        """
        columns = [self.names.index(name) for name in names]
        difference = np.linalg.norm((self.estimate - self.error)[columns])
        return float(difference / np.linalg.norm(self.error[columns]))


def local_error(
    polynomial: InputPolynomial,
    step_size: float,
    *,
    time: float = 0.3,
    last_step_size: float | None = None,
    parts: Mapping[str, LinearSystem] | None = None,
    connections: Iterable[tuple[str, str]] = DISPLACEMENT,
    capabilities: Capabilities | None = None,
    **simulation: Any,
) -> LocalError:
    """Take a double step of the program from ``time`` [s] and compare it with the exact solution.

    Slaves are propagated exactly, so that the inputs' polynomials are all the error there is. The
    history is that of steps of ``last_step_size`` [s], by default the same as ``step_size``.
    """
    parts = parts or {"chassis": CHASSIS, "wheel": WHEEL}
    can = capabilities or replace(ALL, max_output_derivative_order=1)
    settings = {
        "start_time": time,
        "stop_time": time + 1.0,
        "order": polynomial.order,
        "derivative_points": polynomial.derivative_points,
        **simulation,
    }
    system = System(
        simulation=settings, slaves={name: {} for name in parts}, connections=connections
    )
    executors = {}
    for name, part in parts.items():
        x = exact_outputs([f"{name}.x", f"{name}.v"], time)[0]
        executors[name] = Executor(part.slave(x, capabilities=can))
    coupled = resolve(system, {name: e.description for name, e in executors.items()})
    scheme = CouplingScheme.of(coupled, system)
    group = SlaveGroup({name: LocalSlave(e) for name, e in executors.items()})
    initialize(group, coupled, system, scheme.get_outputs)
    estimator = ESTIMATORS[system.simulation.estimator]
    sources = [coupled.output_names[i] for i in coupled.source]
    points = estimator.points(polynomial.order + 1) + 1
    past = [time - i * (last_step_size or step_size) for i in range(points)]
    history = CouplingHistory.start(past[-1], exact_outputs(sources, past[-1]), points)
    for point in past[-2::-1]:
        history = history.pushed(point, exact_outputs(sources, point))
    polynomials = scheme.extrapolation.polynomials(polynomial, estimator.available(points))
    stepper = DoubleStepper(group, coupled, scheme, estimator)
    times = DoubleStepTimes.from_step_size(time, step_size)
    step = stepper.attempt(history, times, polynomials)
    assert isinstance(step, DoubleStep), step
    control = ErrorControl(coupled, scheme, estimator, system.simulation.constants)
    exact = exact_outputs(coupled.output_names, times.end)[0]
    return LocalError(coupled.output_names, control.judge(step), step.end[0] - exact, step)


SIZES = {0: (0.4e-3, 0.2e-3), 1: (0.4e-3, 0.2e-3), 2: (0.4e-3, 0.2e-3), 3: (0.5e-3, 0.25e-3)}
"""For each order two step sizes [s], small enough for the leading terms, large enough for them to
be above rounding."""


def limit_of_deviations(
    polynomial: InputPolynomial, factor: float, outputs: Sequence[str] = STATES, **options: Any
) -> tuple[float, float]:
    """Deviation of the estimate from the true error, at a small H and as H -> 0.

    After a history of steps of H / ``factor``. The deviation being of first order in H, its limit
    is found by extrapolation.
    """
    deviations = [
        local_error(polynomial, h, last_step_size=h / factor, **options).deviation(*outputs)
        for h in SIZES[polynomial.order]
    ]
    return deviations[1], 2.0 * deviations[1] - deviations[0]
