"""Slaves with the faults that examinations are there to find, built on exact linear ones."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from protocol.calls import Examine, StepResult, StepStatus
from protocol.description import Examination
from protocol.errors import SlaveError, StepRejectedError
from protocol.slave import Slave
from slave_node.execution import examination
from tests.support.quarter_car_case import CHASSIS, LinearSlave, LinearSystem


class TimedSlave(LinearSlave):
    """Knows its time, and refuses a step from anywhere else; a saved state holds it too."""

    def __init__(self, system: LinearSystem = CHASSIS, x: Any = (0.1, 0.0), **options: Any) -> None:
        super().__init__(system, np.array(x, dtype=float), **options)

    def reset(self) -> None:
        """See `Slave`."""
        super().reset()
        self.time: float | None = None
        self.steps: list[tuple[float, float]] = []

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`."""
        if self.time is not None and communication_point != self.time:
            raise SlaveError(f"stands at {self.time!r}, not {communication_point!r}")
        self.steps.append((communication_point, step_size))
        result = self.advance(communication_point, step_size, no_set_state_prior)
        self.time = result.time
        return result

    def advance(self, time: float, step_size: float, no_set_state_prior: bool) -> StepResult:
        """The step itself."""
        return super().do_step(time, step_size, no_set_state_prior)

    def get_state(self) -> object:
        """See `Slave`."""
        state = (super().get_state(), self.time)
        self.saved[-1] = state
        return state

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        assert any(state is saved for saved in self.saved)
        (self.x, self.u), self.time = state  # type: ignore[misc]


class EulerSlave(TimedSlave):
    """Takes one explicit Euler step for each do_step."""

    def advance(self, time: float, step_size: float, no_set_state_prior: bool) -> StepResult:
        """See `TimedSlave`."""
        system = self.system
        self.x = self.x + step_size * (system.a @ self.x + system.b @ self.u[0] + system.c)
        return StepResult(StepStatus.OK, time + step_size)


class ClockedSlave(TimedSlave):
    """Moves only at multiples of ``period`` [s], counted from 0."""

    def __init__(self, period: float, **options: Any) -> None:
        self.period = period
        super().__init__(**options)

    def advance(self, time: float, step_size: float, no_set_state_prior: bool) -> StepResult:
        """See `TimedSlave`."""
        for _ in range(self._ticks(time + step_size) - self._ticks(time)):
            self.x = self.system.propagate(self.x, self.u, self.period)
        return StepResult(StepStatus.OK, time + step_size)

    def _ticks(self, time: float) -> int:
        return math.floor(time / self.period + 1e-9)


class RestartingSlave(TimedSlave):
    """A solver whose steps depend on how many it has taken since it was started or restored."""

    def reset(self) -> None:
        """See `Slave`."""
        super().reset()
        self.past = 0

    def advance(self, time: float, step_size: float, no_set_state_prior: bool) -> StepResult:
        """See `TimedSlave`."""
        result = super().advance(time, step_size, no_set_state_prior)
        self.x = self.x * (1.0 + 1e-9 * min(self.past, 3))
        self.past += 1
        return result

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        super().set_state(state)
        self.past = 0


class LosingSlave(TimedSlave):
    """A part of its state is lost in a restore: its steps repeat, and lead elsewhere."""

    def reset(self) -> None:
        """See `Slave`."""
        super().reset()
        self.lost = 0.0

    def advance(self, time: float, step_size: float, no_set_state_prior: bool) -> StepResult:
        """See `TimedSlave`."""
        result = super().advance(time, step_size, no_set_state_prior)
        self.x = self.x + self.lost
        self.lost += 1.0
        return result

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        super().set_state(state)
        self.lost = 0.0


class NotRepeatingSlave(TimedSlave):
    """A part of its state is not saved."""

    def reset(self) -> None:
        """See `Slave`."""
        super().reset()
        self.calls = 0

    def advance(self, time: float, step_size: float, no_set_state_prior: bool) -> StepResult:
        """See `TimedSlave`."""
        self.calls += 1
        result = super().advance(time, step_size, no_set_state_prior)
        self.x = self.x * (1.0 + 1e-6 * self.calls)
        return result


class BrokenSlave(TimedSlave):
    """Returns ``error`` when a state is restored."""

    def __init__(self, error: type[SlaveError] = SlaveError) -> None:
        self.error = error
        super().__init__()

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        raise self.error("fmi2SetFMUstate returned fmi2Error")


class StaleSlave(TimedSlave):
    """Its outputs are those of its last step, also after a restore."""

    def reset(self) -> None:
        """See `Slave`."""
        super().reset()
        self.shown = super().get_outputs(0)

    def advance(self, time: float, step_size: float, no_set_state_prior: bool) -> StepResult:
        """See `TimedSlave`."""
        result = super().advance(time, step_size, no_set_state_prior)
        self.shown = super().get_outputs(0)
        return result

    def get_outputs(self, order: int) -> np.ndarray:
        """See `Slave`."""
        return self.shown


class BoundedSlave(TimedSlave):
    """Refuses steps longer than ``largest`` [s]."""

    def __init__(self, largest: float) -> None:
        self.largest = largest
        super().__init__()

    def advance(self, time: float, step_size: float, no_set_state_prior: bool) -> StepResult:
        """See `TimedSlave`."""
        if step_size > self.largest:
            raise StepRejectedError("too long")
        return super().advance(time, step_size, no_set_state_prior)


def examine(
    slave: Slave, time: float, step_size: float, *tolerances: float, **more: Any
) -> Examination:
    """The examination with inputs as they are; tolerances are the relative and the absolute one."""
    return examination.examine(slave, Examine(time, step_size, *tolerances, **more))


def described(slave: Slave, **fields: Any) -> Slave:
    """The slave with another description."""
    slave.description = replace(slave.description, **fields)
    return slave
