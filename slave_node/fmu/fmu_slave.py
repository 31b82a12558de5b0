"""Slaves of FMUs: what all have in common, whatever their version of FMI and their interface.

Arrays go to and come from buffers that are made once, so that the hot path neither allocates in
C types nor loops over variables in Python.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence

from protocol.calls import ModelWarnings, RecordedValues
from protocol.description import SlaveDescription
from protocol.errors import SlaveError
from protocol.signals import MAX_ORDER, FloatArray
from protocol.slave import Slave
from protocol.variables import StartValue
from slave_node.floating_point import restore_floating_point
from slave_node.fmu.exchange import Buffer
from slave_node.fmu.instance import FmuInstance
from slave_node.fmu.recorded_variables import RecordedVariables


class FmuSlave(Slave):
    """One instance of an FMU.

    A subclass makes the buffers and says how to initialize and to step.

    Args:
        instance: the FMU; the slave closes it.
    """

    _inputs: Buffer
    _outputs: Buffer

    def __init__(self, instance: FmuInstance) -> None:
        self._instance = instance
        self.description: SlaveDescription = instance.model.description
        can = self.description.capabilities
        self._saves_state = can.can_get_and_set_state
        self._max_rows = MAX_ORDER + 1 if can.can_interpolate_inputs else 1
        self._max_order = min(can.max_output_derivative_order, MAX_ORDER)
        self._rows_set = 1
        self._discrete_inputs = instance.discrete(())
        self._discrete_outputs = instance.discrete(())
        self._recorded = RecordedVariables(instance, ())

    def set_inputs(self, derivatives: FloatArray) -> None:
        """See `Slave`. A derivative once set stays set, so those above the order are zeroed."""
        inputs = self._inputs
        rows, columns = derivatives.shape
        if columns != inputs.size or rows > self._max_rows:
            raise SlaveError(
                f"{rows} rows of {columns} input values; it takes up to {self._max_rows} rows of "
                f"values for {inputs.size} inputs"
            )
        if columns == 0:
            return
        inputs.rows[rows:] = 0.0
        inputs.first[rows][...] = derivatives
        status = inputs.transfer_values()
        if status:
            self._instance.check(inputs.values_function, status)
        for order in range(1, max(rows, self._rows_set)):
            status = inputs.transfer_derivatives[order]()
            if status:
                self._instance.check(f"{inputs.derivatives_function} of order {order}", status)
            self._rows_set = max(order + 1, self._rows_set)
        restore_floating_point()

    def get_outputs(self, order: int) -> FloatArray:
        """See `Slave`."""
        if not 0 <= order <= self._max_order:
            raise SlaveError(
                f"output derivatives of order {order} asked for; it gives orders up to "
                f"{self._max_order}"
            )
        outputs = self._outputs
        if outputs.size:
            status = outputs.transfer_values()
            if status:
                self._instance.check(outputs.values_function, status)
            for k in range(1, order + 1):
                status = outputs.transfer_derivatives[k]()
                if status:
                    self._instance.check(
                        f"{outputs.derivatives_function} of order {k}",
                        status,
                        remedy="leave output derivatives out: derivative_points = 0",
                    )
            restore_floating_point()
        return outputs.first[order + 1].copy()

    def set_discrete_inputs(self, values: Sequence[StartValue]) -> None:
        """See `Slave`.

        Raises:
            SlaveError: a value is not of the type of its variable, or the FMU refused.
        """
        self._discrete_inputs.put(values, SlaveError)
        self._discrete_inputs.send()

    def set_values(self, values: Mapping[str, StartValue]) -> None:
        """See `Slave`.

        Raises:
            SlaveError: there is no such variable, a value is not of its type, or the FMU refused.
        """
        unknown = [name for name in values if name not in self._instance.model.places]
        if unknown:
            raise SlaveError(f"{self.description.model} has no variables {unknown}")
        self._instance.set_values(values)

    def get_discrete_outputs(self) -> tuple[StartValue, ...]:
        """See `Slave`."""
        return self._discrete_outputs.receive()

    def take_warnings(self) -> ModelWarnings:
        """See `Slave`."""
        return self._instance.log.take_warnings()

    def record(self, names: Sequence[str]) -> None:
        """See `Slave`.

        Raises:
            ModelError: there is no variable of a name.
            SlaveError: a variable is of a type that is not exchanged.
        """
        self._recorded = RecordedVariables(self._instance, names)

    def get_recorded_variables(self) -> RecordedValues:
        """See `Slave`."""
        return self._recorded.values()

    def get_state(self) -> object:
        """See `Slave`."""
        self._require_state()
        instance = self._instance
        state = ctypes.c_void_p()
        status = instance.get_fmu_state(ctypes.byref(state))
        if status:
            instance.check(instance.state_functions[0], status)
        return state

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        instance = self._instance
        status = instance.set_fmu_state(state)
        if status:
            instance.check(instance.state_functions[1], status)

    def free_state(self, state: object) -> None:
        """See `Slave`."""
        instance = self._instance
        status = instance.free_fmu_state(ctypes.byref(state))  # type: ignore[arg-type]
        if status:
            instance.check(instance.state_functions[2], status)

    def serialize_state(self, state: object) -> bytes:
        """See `Slave`."""
        self._require_serialization("serialize")
        return bytes(self._instance.call(self._instance.fmu.serializeFMUState, state))

    def deserialize_state(self, data: bytes) -> object:
        """See `Slave`."""
        self._require_serialization("deserialize")
        state: object = self._instance.call(self._instance.fmu.deserializeFMUState, data)
        return state

    def _require_state(self) -> None:
        if not self._saves_state:
            raise SlaveError(f"the FMU {self.description.model} cannot save its state")

    def _require_serialization(self, what: str) -> None:
        if not self.description.capabilities.can_serialize_state:
            raise SlaveError(f"the FMU {self.description.model} cannot {what} its state")

    def terminate(self) -> None:
        """See `Slave`."""
        self._instance.call(self._instance.fmu.terminate)

    def reset(self) -> None:
        """See `Slave`."""
        self._instance.call(self._instance.fmu.reset)

    def close(self) -> None:
        """See `Slave`."""
        self._instance.close()
