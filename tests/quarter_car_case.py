"""The quarter car as the tests need it: exact slaves, systems, and runs within the test's process.

The models at the end are loaded by their names, as those of a user are.
"""

from __future__ import annotations

import inspect
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import expm

from master_node import Result, System
from master_node.co_simulation import CoSimulation, check_capabilities
from master_node.observers import Observer, Observers
from master_node.results import Recording
from master_node.simulation import settings_of
from master_node.slave_group import SlaveGroup
from master_node.slave_link import LocalSlave
from master_node.system import CoupledSystem, resolve
from protocol.calls import StepResult
from protocol.slave import (
    Capabilities,
    Causality,
    Slave,
    SlaveDescription,
    StartValue,
    StepStatus,
    Variable,
)
from slave_node.executor import Executor
from slave_node.loading import load_slave
from slave_node.model_loading import load_model_class

EXAMPLES = Path(__file__).parents[1] / "examples" / "quarter_car"

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
    """x' = A x + B u + c, of which all states are outputs."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def propagate(self, x: np.ndarray, u: np.ndarray, time: float) -> np.ndarray:
        """The states after ``time`` [s] with polynomial inputs, row j of ``u`` the j-th derivative.

        (x, u, u', ..., 1) obeys one linear autonomous system, whose solution is an exponential.
        """
        n, (rows, m) = len(x), u.shape
        system = np.zeros((n + rows * m + 1, n + rows * m + 1))
        system[:n, :n], system[:n, n : n + m], system[:n, -1] = self.a, self.b, self.c
        system[n : n + (rows - 1) * m, n + m : n + rows * m] = np.eye((rows - 1) * m)
        reached: np.ndarray = expm(system * time) @ np.concatenate([x, u.ravel(), [1.0]])
        return reached[:n]

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
            capabilities=capabilities
            or Capabilities(
                can_get_and_set_state=True,
                can_interpolate_inputs=True,
                can_handle_variable_step_size=True,
            ),
            state_kind="native",
        )
        self.saved: list[object] = []
        self.most_saved = 0
        self.input_rows: set[int] = set()
        self.reset()

    def reset(self) -> None:
        """See `Slave`."""
        self.x, self.u = self._x0, np.zeros((1, len(self.system.inputs)))

    def initialize(
        self,
        *,
        start_time: float,
        stop_time: float | None,
        relative_tolerance: float | None,
        start_values: Mapping[str, StartValue],
        inputs: Sequence[str],
        outputs: Sequence[str],
    ) -> None:
        """See `Slave`."""
        assert tuple(inputs) == self.system.inputs
        assert tuple(outputs) == self.system.outputs

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
        return StepResult(StepStatus.OK, communication_point + step_size)

    def get_outputs(self, order: int) -> np.ndarray:
        """See `Slave`."""
        assert order == 0
        return self.x[np.newaxis].copy()

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
        warnings = check_capabilities(coupled, system.simulation)
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
