"""Slaves that cost nothing, for tests in which the messages between master and slave matter.

Two of them make a damped oscillator: x_1' = -x_1 + 2 x_2, x_2' = -2 x_1 - x_2.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from protocol.calls import Initialize, StepResult, StepStatus
from protocol.description import Capabilities, InputDerivatives, SlaveDescription, StateKind
from protocol.errors import SlaveCrashedError, SlaveError
from protocol.signals import FloatArray
from protocol.slave import Slave
from protocol.variables import Causality, Variable
from slave_node.execution.executor import Executor
from slave_node.worker.process import ModelReference, execute_program

COUPLINGS = {"left": 2.0, "right": -2.0}
"""b of x' = -x + b u of the two slaves."""

STARTS = {"left": 1.0, "right": 0.0}
"""x at t = 0."""

CONNECTIONS = (("right.x", "left.u"), ("left.x", "right.u"))


def description_of(name: str) -> SlaveDescription:
    """Description of the slave ``name``."""
    return SlaveDescription(
        model=name,
        kind="light",
        variables=(
            Variable("u", Causality.INPUT),
            Variable("x", Causality.OUTPUT),
            Variable("p", Causality.PARAMETER, start=0.0),
        ),
        capabilities=Capabilities(
            can_get_and_set_state=True,
            can_serialize_state=True,
            can_interpolate_inputs=True,
            can_handle_variable_step_size=True,
            outputs_follow_inputs=True,
        ),
        state_kind=StateKind.NATIVE,
        input_derivatives=InputDerivatives.NATIVE,
        sha256="0" * 64,
    )


class LightSlave(Slave):
    """x' = -x + b u with the classical Runge-Kutta step; y = x."""

    def __init__(self, name: str) -> None:
        self.description = description_of(name)
        self._coupling = COUPLINGS[name]
        self._start = STARTS[name]
        self.reset()

    def reset(self) -> None:
        """See `Slave`."""
        self._time = 0.0
        self._x = self._start
        self._inputs: list[float] = []

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`."""
        inputs, outputs = experiment.inputs, experiment.outputs
        unknown = experiment.start_values.keys() - {"p"}
        if inputs not in ((), ("u",)) or outputs != ("x",) or unknown:
            raise SlaveError("no such variable")
        self._time = experiment.start_time

    def exit_initialization_mode(self) -> None:
        """See `Slave`."""

    def set_inputs(self, derivatives: FloatArray) -> None:
        """See `Slave`."""
        if derivatives.shape[1] > 1:
            raise SlaveError("there is one input")
        self._inputs = derivatives.ravel().tolist()

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`. It trusts the communication point, as many FMUs: a step too many shows."""
        h, x = step_size, self._x
        k_1 = self._slope(x, 0.0)
        k_2 = self._slope(x + 0.5 * h * k_1, 0.5 * h)
        k_3 = self._slope(x + 0.5 * h * k_2, 0.5 * h)
        k_4 = self._slope(x + h * k_3, h)
        self._x = x + h / 6.0 * (k_1 + 2.0 * (k_2 + k_3) + k_4)
        self._inputs = [self._input(h)] if self._inputs else []
        self._time = communication_point + h
        return StepResult(StepStatus.OK, self._time)

    def _slope(self, x: float, since: float) -> float:
        return -x + self._coupling * self._input(since)

    def _input(self, since: float) -> float:
        value, factor = 0.0, 1.0
        for j, derivative in enumerate(self._inputs):
            value += derivative * factor
            factor *= since / (j + 1)
        return value

    def get_outputs(self, order: int) -> FloatArray:
        """See `Slave`."""
        if order:
            raise SlaveError("no derivatives")
        return np.array([[self._x]])

    def get_state(self) -> object:
        """See `Slave`."""
        return self._time, self._x, self._inputs

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        self._time, self._x, self._inputs = state  # type: ignore[misc]

    def free_state(self, state: object) -> None:
        """See `Slave`."""

    def serialize_state(self, state: object) -> bytes:
        """See `Slave`."""
        time, x, inputs = state  # type: ignore[misc]
        return np.array([time, x, *inputs]).tobytes()

    def deserialize_state(self, data: bytes) -> object:
        """See `Slave`."""
        if len(data) % 8 or len(data) < 16:
            raise SlaveError("this is no state")
        time, x, *inputs = np.frombuffer(data).tolist()
        return time, x, inputs

    def terminate(self) -> None:
        """See `Slave`."""

    def close(self) -> None:
        """See `Slave`."""


class LightWorker:
    """Implements `Worker` with a `LightSlave` in this process."""

    def __init__(self, name: str) -> None:
        self._reference = ModelReference(name, Path(), name)
        self._executor: Executor | None = None

    def start(self) -> SlaveDescription:
        """See `Worker`."""
        self._executor = Executor(LightSlave(self._reference.name))
        return self._executor.description

    def execute(self, program: bytes) -> bytes:
        """See `Worker`."""
        if self._executor is None:
            raise SlaveCrashedError("the process that held the model died by SIGKILL")
        return execute_program(self._executor, self._reference, program)

    def kill(self) -> None:
        """See `Worker`."""
        self._executor = None

    stop = kill


def system_of_light_slaves(**simulation: Any) -> dict[str, Any]:
    """The arguments of `System` for the oscillator."""
    return {
        "simulation": {"stop_time": 1.0, **simulation},
        "slaves": {name: {} for name in COUPLINGS},
        "connections": CONNECTIONS,
    }
