"""FMI 3.0 on fmpy's low-level layer, and its co-simulation FMUs as `Slave`."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from fmpy.fmi3 import FMU3Slave

from protocol.calls import Initialize, StepResult, StepStatus
from protocol.errors import SlaveError, StepRejectedError
from protocol.host.log_files import SILENT, LogOutput
from protocol.signals import FloatArray
from protocol.step_sums import step_to
from protocol.variables import StartValue, VariableType
from slave_node.floating_point import restore_floating_point
from slave_node.fmu.archive import PLATFORM_FOLDERS
from slave_node.fmu.description import FmuModel
from slave_node.fmu.exchange import VALUES_CALL_3, ArrayExchangeBuffer, InputPolynomials
from slave_node.fmu.fmu_slave import FmuSlave
from slave_node.fmu.instance import ADDRESS, FmuInstance
from slave_node.fmu.log import DISCARD, ERROR, WARNING, FmuLog, choose_categories
from slave_node.fmu.saved_state import SavedState, pack, unpack
from slave_node.fmu.times import is_at_border, is_within, meet
from slave_node.fmu.values import ValueType

MAX_EVENTS = 10_000
"""In one step: more are a model that stands still at events without end."""

MAX_UPDATES = 1000
"""Largest number of updates of the discrete states at one event."""

_STEP_OK = StepStatus.OK
_BINARY_CALL = [ADDRESS, ctypes.c_size_t, ADDRESS, ADDRESS, ctypes.c_size_t]


class Fmi3Instance(FmuInstance):
    """One instance of an FMI 3.0 FMU, see `FmuInstance`."""

    prefix: ClassVar[str] = "fmi3"
    platform_folder: ClassVar[str] = PLATFORM_FOLDERS[1]
    state_functions: ClassVar[tuple[str, str, str]] = (
        "fmi3GetFMUState",
        "fmi3SetFMUState",
        "fmi3FreeFMUState",
    )
    value_types: ClassVar[Mapping[VariableType, ValueType]] = {
        VariableType.FLOAT32: ValueType("Float32", ctypes.c_float),
        VariableType.FLOAT64: ValueType("Float64", ctypes.c_double),
        VariableType.INT8: ValueType("Int8", ctypes.c_int8),
        VariableType.UINT8: ValueType("UInt8", ctypes.c_uint8),
        VariableType.INT16: ValueType("Int16", ctypes.c_int16),
        VariableType.UINT16: ValueType("UInt16", ctypes.c_uint16),
        VariableType.INT32: ValueType("Int32", ctypes.c_int32),
        VariableType.UINT32: ValueType("UInt32", ctypes.c_uint32),
        VariableType.INT64: ValueType("Int64", ctypes.c_int64),
        VariableType.UINT64: ValueType("UInt64", ctypes.c_uint64),
        VariableType.ENUMERATION: ValueType("Int64", ctypes.c_int64),
        VariableType.BOOLEAN: ValueType("Boolean", ctypes.c_bool),
        VariableType.STRING: ValueType("String", ctypes.c_char_p),
        VariableType.BINARY: ValueType("Binary", ctypes.c_void_p),
    }

    def __init__(self, model: FmuModel, name: str, output: LogOutput = SILENT) -> None:
        self.next_event_time = math.inf
        super().__init__(model, name, output)

    @property
    def _fmpy_class(self) -> Callable[..., Any]:
        return FMU3Slave  # type: ignore[no-any-return]

    def _instantiate(self) -> None:
        wanted = self.log.wanted_categories(self.model.log_categories)
        is_on = self.log.is_wanted or bool(wanted)
        self._instantiate_interface(loggingOn=is_on, logMessage=_logger(self.log))
        if wanted:
            choose_categories(self.fmu.setDebugLogging, True, wanted)

    def _instantiate_interface(self, **arguments: Any) -> None:
        self.fmu.instantiate(**arguments)

    def exchange(self, function: str, references: Any, arrays: Sequence[Any], values: int) -> None:
        """See `FmuInstance`."""
        name = f"fmi3{function}"
        call = self.function(name, _BINARY_CALL if len(arrays) == 2 else VALUES_CALL_3)
        self.check(name, call(references.ctypes.data, len(references), *arrays, values))

    def enter_initialization_mode(self, experiment: Initialize) -> None:
        """Set structural parameters and start values, enter initialization mode."""
        at_once, later = self.split_start_values(experiment.start_values)
        if self.model.structural_parameters:
            self.call(self.fmu.enterConfigurationMode)
            self.set_values(self.model.structural_parameters)
            self.call(self.fmu.exitConfigurationMode)
        self.set_values(at_once)
        self.call(
            self.fmu.enterInitializationMode,
            tolerance=experiment.relative_tolerance,
            startTime=experiment.start_time,
            stopTime=experiment.stop_time,
        )
        self.set_values(later)

    def buffer(
        self, names: Sequence[str], *, sets: bool = False, derivatives: bool = False
    ) -> ArrayExchangeBuffer:
        """For these variables, see `ArrayExchangeBuffer`."""
        places = self.continuous_places(names)
        return ArrayExchangeBuffer(places, self.bound, sets=sets, derivatives=derivatives)

    def update_discrete_states(self) -> tuple[bool, bool, bool]:
        """In event mode, fmi3UpdateDiscreteStates until there is nothing more to update.

        ``next_event_time`` is the next time event then [s].

        Returns:
            Whether the FMU wants to terminate, whether continuous states have jumped, and whether
            their nominal values have changed.
        """
        terminate = jumped = rescaled = False
        for _ in range(MAX_UPDATES):
            more, ends, new_nominals, new_values, has_next, time = self.call(
                self.fmu.updateDiscreteStates
            )
            terminate |= ends
            jumped |= new_values
            rescaled |= new_nominals
            if terminate or not more:
                self.next_event_time = time if has_next else math.inf
                return terminate, jumped, rescaled
        raise SlaveError(f"the discrete states do not settle in {MAX_UPDATES} updates")


def _logger(log: FmuLog) -> Callable[..., None]:
    def receive(_environment: Any, status: int, category: bytes, text: bytes) -> None:
        log.add(status, category, text)

    return receive


class _SlaveInstance(Fmi3Instance):
    """For co-simulation: with event mode and intermediate update where the FMU has them."""

    def __init__(
        self,
        model: FmuModel,
        name: str,
        output: LogOutput,
        intermediate_update: Callable[..., None],
    ) -> None:
        self._intermediate_update = intermediate_update
        super().__init__(model, name, output)

    def _instantiate_interface(self, **arguments: Any) -> None:
        interface = self.model.interface
        if interface.intermediate_inputs:
            arguments |= {
                "intermediateUpdate": self._intermediate_update,
                "requiredIntermediateVariables": interface.intermediate_inputs,
            }
        self.fmu.instantiate(
            eventModeUsed=interface.has_event_mode, earlyReturnAllowed=True, **arguments
        )


class Fmi3Slave(FmuSlave):
    """One instance of an FMI 3.0 co-simulation FMU.

    Event mode is used where the FMU has it. An event within a step is handled and the step goes on
    behind it, unless the master wants to know of it (``early_return``).

    Args:
        model: the FMU.
        name: instance name.
        output: where its messages go, and which ones it is asked for.

    Raises:
        ModelError: the FMU cannot be loaded or instantiated here.
    """

    _inputs: ArrayExchangeBuffer

    def __init__(self, model: FmuModel, name: str, output: LogOutput = SILENT) -> None:
        self._failure: Exception | None = None
        self._fmi3 = _SlaveInstance(model, name, output, self._intermediate_update)
        super().__init__(self._fmi3)
        self._has_event_mode = model.interface.has_event_mode
        self._event, self._end, self._early = (ctypes.c_bool() for _ in range(3))
        self._reached = ctypes.c_double()
        results = [
            ctypes.addressof(self._event),
            ctypes.addressof(self._end),
            ctypes.addressof(self._early),
            ctypes.addressof(self._reached),
        ]
        fmi3_do_step = self._fmi3.function(
            "fmi3DoStep", [ctypes.c_double, ctypes.c_double, ctypes.c_bool, *[ADDRESS] * 4]
        )
        self._do_step: Callable[[float, float, bool], int] = lambda t, h, no_prior: fmi3_do_step(
            t, h, no_prior, *results
        )
        self._bind((), ())
        self._start(Initialize())

    def _bind(self, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        """Make the buffers for these inputs and outputs."""
        instance = self._fmi3

        self._rows_set = 1
        self._inputs = instance.buffer(inputs, sets=True)
        self._inputs_within = instance.buffer(inputs, sets=True)
        self._polynomials = InputPolynomials(self._inputs, self._inputs_within)
        self._outputs = instance.buffer(outputs, derivatives=self._max_order > 0)

    def _start(self, experiment: Initialize) -> None:
        self._time = self._inputs_time = experiment.start_time
        self._returns_early = experiment.early_return
        self._is_initializing = True

    # ---- Initialization -----------------------------------------------------------------------

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`."""
        self._bind(experiment.inputs, experiment.outputs)
        self._discrete_inputs = self._fmi3.discrete(experiment.discrete_inputs)
        self._discrete_outputs = self._fmi3.discrete(experiment.discrete_outputs)
        self._start(experiment)
        self._fmi3.enter_initialization_mode(experiment)
        for buffer in (self._inputs, self._inputs_within):
            self._fmi3.check("fmi3GetFloat64", buffer.fill())

    def exit_initialization_mode(self) -> None:
        """See `Slave`. With event mode, the event at the start is handled."""
        self._fmi3.call(self._fmi3.fmu.exitInitializationMode)
        self._is_initializing = False
        if self._has_event_mode and self._leave_event_mode():
            raise SlaveError("the FMU wants to terminate at the start")

    # ---- Events -------------------------------------------------------------------------------

    def _handle_event(self) -> bool:
        """Go through event mode; returns whether the FMU wants to terminate."""
        self._fmi3.call(self._fmi3.fmu.enterEventMode)
        return self._leave_event_mode()

    def _leave_event_mode(self) -> bool:
        terminate, _, _ = self._fmi3.update_discrete_states()
        if not terminate:
            self._fmi3.call(self._fmi3.fmu.enterStepMode)
        return terminate

    def set_discrete_inputs(self, values: Sequence[StartValue]) -> None:
        """See `Slave`. With event mode a change is an event."""
        if self._is_initializing or not self._has_event_mode:
            super().set_discrete_inputs(values)
        elif self._discrete_inputs.put_changes(values):
            self._fmi3.call(self._fmi3.fmu.enterEventMode)
            self._discrete_inputs.send()
            if self._leave_event_mode():
                raise SlaveError("the FMU wants to terminate after its discrete inputs changed")

    def set_values(self, values: Mapping[str, StartValue]) -> None:
        """See `Slave`; goes through event mode if there is one."""
        if not self._has_event_mode:
            super().set_values(values)
            return
        self._fmi3.call(self._fmi3.fmu.enterEventMode)
        super().set_values(values)
        if self._leave_event_mode():
            raise SlaveError("the FMU wants to terminate after variables were set")

    # ---- Steps --------------------------------------------------------------------------------

    def set_inputs(self, derivatives: FloatArray) -> None:
        """See `Slave`. Derivatives take effect by intermediate updates."""
        super().set_inputs(derivatives)
        self._inputs_time = self._time

    def _intermediate_update(
        self,
        _environment: Any,
        time: float,
        set_requested: bool,
        _get_allowed: bool,
        _step_finished: bool,
        _can_return: bool,
        return_requested: Any,
        _return_time: Any,
    ) -> None:
        """Called by the FMU within a step: set the inputs along their polynomials."""
        return_requested[0] = False
        if not set_requested or self._failure is not None:
            return
        try:
            polynomials = self._polynomials
            status = polynomials.set(self._rows_set, time - self._inputs_time)
            self._fmi3.check(polynomials.values_function, status)
        except Exception as error:  # nothing may go through the FMU
            self._failure = error

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`. An event is not stepped over, and be it a rounding before the end."""
        end = communication_point + step_size
        stands_there = is_within(self._time, communication_point, communication_point)
        time = self._time if stands_there else communication_point
        for _ in range(MAX_EVENTS):
            target, has_event = end, self._fmi3.next_event_time <= end
            if has_event:
                target = max(self._fmi3.next_event_time, time)
            reached = time
            if target > time:
                h = step_to(time, target, step_size)
                result = self._step(time, h, no_set_state_prior)
                if result.status is not _STEP_OK:
                    return result
                has_event = self._event.value or (has_event and not self._early.value)
                reached = self._reached.value if self._early.value else time + h
            self._time = reached
            if reached >= end or meet(reached, end):
                ends = has_event and self._has_event_mode and self._handle_event()
                return StepResult(StepStatus.TERMINATED if ends else _STEP_OK, end)
            if self._returns_early and not is_at_border(reached, communication_point, end):
                return StepResult(StepStatus.EARLY_RETURN, reached)
            if has_event and self._has_event_mode and self._handle_event():
                return StepResult(StepStatus.TERMINATED, reached)
            time = reached
        raise StepRejectedError(f"more than {MAX_EVENTS} events in one step")

    def _step(self, time: float, h: float, no_set_state_prior: bool) -> StepResult:
        """One fmi3DoStep; ``ok`` also if it returned early."""
        self._reached.value = math.nan
        status = self._do_step(time, h, no_set_state_prior)
        restore_floating_point()
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure
        if status == WARNING:
            self._fmi3.log.returned_warning("fmi3DoStep")
        elif status:
            if status == DISCARD:
                return StepResult(StepStatus.DISCARD, self._reached.value)
            if status == ERROR:
                raise StepRejectedError(self._fmi3.log.explain("fmi3DoStep returned fmi3Error"))
            self._fmi3.check("fmi3DoStep", status)
        if self._end.value:
            return StepResult(StepStatus.TERMINATED, self._reached.value)
        reached, end = self._reached.value, time + h
        if self._early.value and not is_within(reached, time, end):
            raise SlaveError(
                f"fmi3DoStep returned early at {reached!r} s, beside the step from {time!r} s to "
                f"{end!r} s"
            )
        return StepResult(_STEP_OK, time + h)

    # ---- Saved states -------------------------------------------------------------------------

    def get_state(self) -> object:
        """See `Slave`. Beside the FMU's state: times and the inputs' polynomials."""
        state = super().get_state()
        times = (self._time, self._inputs_time, self._fmi3.next_event_time, self._rows_set)
        return SavedState(state, np.concatenate([times, self._inputs.rows.ravel()]))

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        saved = self._checked(state)
        super().set_state(saved.fmu)
        self._time, self._inputs_time, self._fmi3.next_event_time, rows = saved.numbers[:4].tolist()
        self._rows_set = int(rows)
        self._inputs.rows[...] = saved.numbers[4:].reshape(self._inputs.rows.shape)

    def free_state(self, state: object) -> None:
        """See `Slave`."""
        super().free_state(self._checked(state).fmu)

    def serialize_state(self, state: object) -> bytes:
        """See `Slave`."""
        saved = self._checked(state)
        return pack(saved.numbers, super().serialize_state(saved.fmu))

    def deserialize_state(self, data: bytes) -> object:
        """See `Slave`."""
        numbers, fmu = unpack(data, 4 + self._inputs.rows.size)
        return SavedState(super().deserialize_state(fmu), numbers)

    def _checked(self, state: object) -> SavedState:
        if not isinstance(state, SavedState):
            raise SlaveError(f"not a saved state of {self.description.model}: {type(state)}")
        return state
