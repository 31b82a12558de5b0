"""The `Slave` contract: the narrow waist of the project.

A `Slave` is anything that can be initialized, stepped and rolled back: an FMU, a Python model.
Who calls it (the executor in the slave's process, or the master itself when it runs in process)
keeps the call order of ``life_cycle.py``; a `Slave` need not check it again.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from protocol.calls import (
    NO_WARNINGS,
    Call,
    Initialize,
    ModelWarnings,
    RecordedValues,
    Reply,
    StepResult,
)
from protocol.description import SlaveDescription
from protocol.errors import SlaveError
from protocol.signals import FloatArray
from protocol.variables import StartValue


class Slave(ABC):
    """One co-simulation slave, in the process that holds it. Not thread-safe.

    Call order: ``life_cycle.py``, also for what is left after an error (state *error*) and after a
    step that was not completed (*step failed*). Any method may raise `SlaveError`.
    Saved states are opaque to the caller; what ``get_state`` returned stays valid until it is
    passed to ``free_state`` or the slave is reset, and may be restored any number of times.

    Continuous Real variables that are connected go through ``set_inputs`` and ``get_outputs``, all
    others through ``set_discrete_inputs`` and ``get_discrete_outputs``.
    """

    description: SlaveDescription

    @abstractmethod
    def initialize(self, experiment: Initialize) -> None:
        """Set up the experiment, set start values, enter initialization mode.

        Its ``inputs`` and ``outputs`` fix the order of the columns of all arrays that follow,
        ``discrete_inputs`` and ``discrete_outputs`` that of the values of other types. With
        ``early_return`` do_step may end at an event within the step, with ``EARLY_RETURN``.
        ``recorded`` is for `record`, which comes before.
        """

    @abstractmethod
    def exit_initialization_mode(self) -> None:
        """Leave initialization mode: the slave stands at its first communication point."""

    @abstractmethod
    def set_inputs(self, derivatives: FloatArray) -> None:
        """Set the inputs from here on: shape (k + 1, n_u), see `InputSignal`."""

    @abstractmethod
    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """Step from ``communication_point`` by ``step_size`` [s].

        Returns the status and the time reached: the end of the step, or on ``DISCARD`` the last
        successful time (NaN when the slave does not tell).
        """

    @abstractmethod
    def get_outputs(self, order: int) -> FloatArray:
        """Outputs and their derivatives up to ``order``: shape (order + 1, n_y), [y]/s^j."""

    def set_discrete_inputs(self, values: Sequence[StartValue]) -> None:
        """Set the discrete inputs from here on, one value for each."""
        if values:
            raise SlaveError(f"{self.description.model} has no discrete inputs")

    def set_values(self, values: Mapping[str, StartValue]) -> None:
        """Set tunable parameters, and inputs that are not set otherwise, from here on: an event."""
        raise SlaveError(f"{self.description.model} has no variables to set: {[*values]}")

    def get_discrete_outputs(self) -> tuple[StartValue, ...]:
        """The discrete outputs, one value for each."""
        return ()

    def record(self, names: Sequence[str]) -> None:
        """Fix the variables of `get_recorded_variables`, right before ``initialize``.

        They may have any causality; to read them changes nothing of what the slave does.
        """
        if names:
            raise SlaveError(f"{self.description.model} has no variables to record: {[*names]}")

    def get_recorded_variables(self) -> RecordedValues:
        """Their values as they are, finite or not."""
        return RecordedValues(np.zeros((1, 0)), ())

    @abstractmethod
    def get_state(self) -> object:
        """Save the state."""

    @abstractmethod
    def set_state(self, state: object) -> None:
        """Go back to a saved state."""

    def set_state_and_free(self, state: object) -> None:
        """Go back to a saved state and give it up with that."""
        self.set_state(state)
        self.free_state(state)

    @abstractmethod
    def free_state(self, state: object) -> None:
        """Give up a saved state."""

    @abstractmethod
    def serialize_state(self, state: object) -> bytes:
        """A saved state as bytes."""

    @abstractmethod
    def deserialize_state(self, data: bytes) -> object:
        """A saved state from bytes that ``serialize_state`` of the same model gave."""

    def take_warnings(self) -> ModelWarnings:
        """Warnings of the model since the last call; never raises."""
        return NO_WARNINGS

    @abstractmethod
    def terminate(self) -> None:
        """End the simulation; outputs may still be read."""

    @abstractmethod
    def reset(self) -> None:
        """Back to the state after instantiation."""

    @abstractmethod
    def close(self) -> None:
        """Free the instance and all that belongs to it. Idempotent."""


def refuse_discrete(
    description: SlaveDescription, inputs: Sequence[str], outputs: Sequence[str]
) -> None:
    """For a slave that has no discrete variables.

    Raises:
        SlaveError: some were asked for.
    """
    if inputs or outputs:
        raise SlaveError(f"{description.model} has no discrete variables {[*inputs, *outputs]}")


class CallExecutor(Protocol):
    """Runs a list of calls on the slave that it holds, and never raises but for a defect."""

    @property
    def description(self) -> SlaveDescription:
        """Description of the slave."""
        ...

    def execute(self, calls: Sequence[Call]) -> Reply:
        """Run the calls in order; the reply says how far it got."""
        ...

    def close(self) -> None:
        """Free the slave. Idempotent."""
        ...
