"""`StatelessSlave`: a slave whose state is not to be saved, whatever its model can."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NoReturn

from protocol.calls import RecordedValues, StepResult
from protocol.description import StateKind
from protocol.errors import SlaveError
from protocol.signals import FloatArray
from protocol.slave import Slave
from protocol.variables import StartValue


class StatelessSlave(Slave):
    """Hands on all calls but those to saved states.

    Args:
        slave: closed with this one.
        reason: why its state is not saved.
    """

    def __init__(self, slave: Slave, reason: str) -> None:
        self._slave = slave
        self.description = replace(
            slave.description, state_kind=StateKind.NONE, state_reason=reason
        )

    def initialize(
        self,
        *,
        start_time: float,
        stop_time: float | None,
        relative_tolerance: float | None,
        start_values: Mapping[str, StartValue],
        inputs: Sequence[str],
        outputs: Sequence[str],
        discrete_inputs: Sequence[str] = (),
        discrete_outputs: Sequence[str] = (),
        early_return: bool = False,
    ) -> None:
        """See `Slave`."""
        self._slave.initialize(
            start_time=start_time,
            stop_time=stop_time,
            relative_tolerance=relative_tolerance,
            start_values=start_values,
            inputs=inputs,
            outputs=outputs,
            discrete_inputs=discrete_inputs,
            discrete_outputs=discrete_outputs,
            early_return=early_return,
        )

    def exit_initialization_mode(self) -> None:
        """See `Slave`."""
        self._slave.exit_initialization_mode()

    def set_inputs(self, derivatives: FloatArray) -> None:
        """See `Slave`."""
        self._slave.set_inputs(derivatives)

    def set_discrete_inputs(self, values: Sequence[StartValue]) -> None:
        """See `Slave`."""
        self._slave.set_discrete_inputs(values)

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`."""
        return self._slave.do_step(communication_point, step_size, no_set_state_prior)

    def get_outputs(self, order: int) -> FloatArray:
        """See `Slave`."""
        return self._slave.get_outputs(order)

    def set_values(self, values: Mapping[str, StartValue]) -> None:
        """See `Slave`."""
        self._slave.set_values(values)

    def get_discrete_outputs(self) -> tuple[StartValue, ...]:
        """See `Slave`."""
        return self._slave.get_discrete_outputs()

    def record(self, names: Sequence[str]) -> None:
        """See `Slave`."""
        self._slave.record(names)

    def get_recorded_variables(self) -> RecordedValues:
        """See `Slave`."""
        return self._slave.get_recorded_variables()

    def _refuse(self) -> NoReturn:
        raise SlaveError(
            f"the state of {self.description.model} is not saved: {self.description.state_reason}"
        )

    def get_state(self) -> object:
        """Raises `SlaveError`, as all that is about saved states."""
        self._refuse()

    def set_state(self, state: object) -> None:  # noqa: ARG002
        """See `get_state`."""
        self._refuse()

    def free_state(self, state: object) -> None:  # noqa: ARG002
        """See `get_state`."""
        self._refuse()

    def serialize_state(self, state: object) -> bytes:  # noqa: ARG002
        """See `get_state`."""
        self._refuse()

    def deserialize_state(self, data: bytes) -> object:  # noqa: ARG002
        """See `get_state`."""
        self._refuse()

    def terminate(self) -> None:
        """See `Slave`."""
        self._slave.terminate()

    def reset(self) -> None:
        """See `Slave`."""
        self._slave.reset()

    def close(self) -> None:
        """See `Slave`."""
        self._slave.close()
