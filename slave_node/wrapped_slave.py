"""`WrappedSlave`: a slave that hands calls on to another one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from protocol.calls import Initialize, ModelWarnings, RecordedValues, StepResult
from protocol.signals import FloatArray
from protocol.slave import Slave
from protocol.variables import StartValue


class WrappedSlave(Slave):
    """Hands on all calls but those to saved states, which a subclass answers.

    Args:
        slave: closed with this one; its description is that of this one too, until a subclass
            gives another.
    """

    def __init__(self, slave: Slave) -> None:
        self._slave = slave
        self.description = slave.description

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`."""
        self._slave.initialize(experiment)

    def exit_initialization_mode(self) -> None:
        """See `Slave`."""
        self._slave.exit_initialization_mode()

    def set_inputs(self, derivatives: FloatArray) -> None:
        """See `Slave`."""
        self._slave.set_inputs(derivatives)

    def set_discrete_inputs(self, values: Sequence[StartValue]) -> None:
        """See `Slave`."""
        self._slave.set_discrete_inputs(values)

    def set_values(self, values: Mapping[str, StartValue]) -> None:
        """See `Slave`."""
        self._slave.set_values(values)

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`."""
        return self._slave.do_step(communication_point, step_size, no_set_state_prior)

    def get_outputs(self, order: int) -> FloatArray:
        """See `Slave`."""
        return self._slave.get_outputs(order)

    def get_discrete_outputs(self) -> tuple[StartValue, ...]:
        """See `Slave`."""
        return self._slave.get_discrete_outputs()

    def record(self, names: Sequence[str]) -> None:
        """See `Slave`."""
        self._slave.record(names)

    def get_recorded_variables(self) -> RecordedValues:
        """See `Slave`."""
        return self._slave.get_recorded_variables()

    def take_warnings(self) -> ModelWarnings:
        """See `Slave`."""
        return self._slave.take_warnings()

    def terminate(self) -> None:
        """See `Slave`."""
        self._slave.terminate()

    def reset(self) -> None:
        """See `Slave`."""
        self._slave.reset()

    def close(self) -> None:
        """See `Slave`."""
        self._slave.close()
