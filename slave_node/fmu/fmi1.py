"""FMI 1.0 on fmpy's low-level layer, and its co-simulation FMUs as `Slave`.

FMI 1.0 has neither saved states nor an initialization mode: what is set before fmiInitializeSlave
is where it starts.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from fmpy import calloc, free
from fmpy.fmi1 import (
    FMICallException,
    FMU1Slave,
    fmi1CallbackAllocateMemoryTYPE,
    fmi1CallbackFreeMemoryTYPE,
    fmi1CallbackFunctions,
)

from protocol.calls import Initialize, RecordedValues, StepResult, StepStatus
from protocol.errors import StepRejectedError
from protocol.host.log_files import SILENT, LogOutput
from protocol.signals import FloatArray
from protocol.variables import StartValue, VariableType
from slave_node.floating_point import restore_floating_point
from slave_node.fmu.description import FmuModel
from slave_node.fmu.exchange import VALUES_CALL, ExchangeBuffer
from slave_node.fmu.fmu_slave import FmuSlave
from slave_node.fmu.instance import FmuInstance, reference_array
from slave_node.fmu.log import (
    DISCARD,
    ERROR,
    LOGGER_1,
    WARNING,
    add_proxy,
    choose_categories,
    instantiating,
    register,
    unregister,
)
from slave_node.fmu.values import ValueType

_TEXTS = ("fmi1GetVersion", "fmi1GetTypesPlatform")
_LAST_SUCCESSFUL_TIME = 2
_NEW_STEP = 1


class Fmi1Instance(FmuInstance):
    """One instance of an FMI 1.0 FMU, see `FmuInstance`."""

    prefix: ClassVar[str] = "fmi"
    value_types: ClassVar[Mapping[VariableType, ValueType]] = {
        VariableType.REAL: ValueType("Real", ctypes.c_double),
        VariableType.INTEGER: ValueType("Integer", ctypes.c_int),
        VariableType.ENUMERATION: ValueType("Integer", ctypes.c_int),
        VariableType.BOOLEAN: ValueType("Boolean", ctypes.c_ubyte),
        VariableType.STRING: ValueType("String", ctypes.c_char_p),
    }

    @property
    def _fmpy_class(self) -> Callable[..., Any]:
        return FMU1Slave  # type: ignore[no-any-return]

    def _load(self, name: str) -> Any:
        """See `FmuInstance`; FMPy takes the statuses of most functions for texts to read."""
        fmu = super()._load(name)
        for known, function in fmu._functions.items():
            if function.restype is ctypes.c_char_p and known not in _TEXTS:
                function.restype = ctypes.c_int
        return fmu

    def _instantiate(self) -> None:
        callbacks = fmi1CallbackFunctions()
        callbacks.logger = LOGGER_1
        callbacks.allocateMemory = fmi1CallbackAllocateMemoryTYPE(calloc)
        callbacks.freeMemory = fmi1CallbackFreeMemoryTYPE(free)
        add_proxy(callbacks)
        with instantiating(self.log):
            self.fmu.instantiate(functions=callbacks, loggingOn=True)
        if self.fmu.component is None:
            raise RuntimeError("Failed to instantiate model")
        register(self.fmu.component, self.log)
        choose_categories(self.fmu.setDebugLogging, self.log.is_wanted)

    def c_name(self, name: str) -> str:
        """See `FmuInstance`: the names of FMI 1.0 begin with the model identifier."""
        return f"{self.model.interface.model_identifier}_{name}"

    def exchange(self, function: str, references: Any, arrays: Sequence[Any], values: int) -> None:
        """See `FmuInstance`."""
        del values
        name = f"fmi{function}"
        call = self.function(name, VALUES_CALL)
        self.check(name, call(references.ctypes.data, len(references), *arrays))

    def close(self) -> None:
        """See `FmuInstance`."""
        super().close()
        unregister(self.log)


class Fmi1Slave(FmuSlave):
    """One instance of an FMI 1.0 co-simulation FMU.

    In initialization mode outputs are start values. Where the FMU says none for one that is asked
    for, it is initialized then, with the inputs that are set so far.

    Args:
        model: the FMU.
        name: instance name.
        output: where its messages go; any category asked for stands for debug messages.

    Raises:
        ModelError: the FMU cannot be loaded or instantiated here.
    """

    def __init__(self, model: FmuModel, name: str, output: LogOutput = SILENT) -> None:
        self._fmi1 = Fmi1Instance(model, name, output)
        super().__init__(self._fmi1)
        self._do_step = self._fmi1.function(
            "fmiDoStep", [ctypes.c_double, ctypes.c_double, ctypes.c_ubyte]
        )
        self._bind((), ())
        self._times: tuple[float, float | None] = (0.0, None)
        self._is_initialized = False
        self._starts: dict[str, StartValue | None] = {}

    def _bind(self, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        """Make the buffers for these inputs and outputs."""
        instance = self._fmi1
        places = instance.model.places

        def buffer(names: Sequence[str], values: str, derivatives: str) -> ExchangeBuffer:
            references = reference_array(instance.continuous_places(names))
            return ExchangeBuffer(references, instance.bound, values, derivatives)

        def signs(names: Sequence[str]) -> FloatArray:
            return np.array([-1.0 if places[name].is_negated else 1.0 for name in names])

        self._rows_set = 1
        self._inputs = buffer(inputs, "fmiSetReal", "fmiSetRealInputDerivatives")
        self._outputs = buffer(outputs, "fmiGetReal", "fmiGetRealOutputDerivatives")
        self._input_signs, self._output_signs = signs(inputs), signs(outputs)
        self._output_names = tuple(outputs)

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`."""
        self._bind(experiment.inputs, experiment.outputs)
        self._discrete_inputs = self._fmi1.discrete(experiment.discrete_inputs)
        self._discrete_outputs = self._fmi1.discrete(experiment.discrete_outputs)
        self._discrete_names = experiment.discrete_outputs
        self._times = (experiment.start_time, experiment.stop_time)
        self._is_initialized = False
        at_once, _ = self._fmi1.split_start_values(experiment.start_values)
        self._fmi1.set_values(at_once)
        declared = {v.name: v.start for v in self.description.variables}
        self._starts = declared | dict(experiment.start_values)

    def exit_initialization_mode(self) -> None:
        """See `Slave`."""
        if not self._is_initialized:
            start_time, stop_time = self._times
            self._fmi1.call(self._fmi1.fmu.initialize, tStart=start_time, stopTime=stop_time)
            self._is_initialized = True

    def set_inputs(self, derivatives: FloatArray) -> None:
        """See `Slave`."""
        super().set_inputs(derivatives * self._input_signs)

    def get_outputs(self, order: int) -> FloatArray:
        """See `Slave`."""
        if not self._is_initialized:
            starts = [self._starts[name] for name in self._output_names]
            if order == 0 and None not in starts:
                return np.array([starts], dtype=float)
            self.exit_initialization_mode()
        return super().get_outputs(order) * self._output_signs

    def get_discrete_outputs(self) -> tuple[StartValue, ...]:
        """See `Slave`."""
        if not self._is_initialized:
            starts = [self._starts[name] for name in self._discrete_names]
            known = tuple(start for start in starts if start is not None)
            if len(known) == len(starts):
                return known
            self.exit_initialization_mode()
        return super().get_discrete_outputs()

    def get_recorded_variables(self) -> RecordedValues:
        """See `Slave`. FMI 1.0 lets nothing be read before the FMU is initialized."""
        if not self._is_initialized:
            self.exit_initialization_mode()
        return super().get_recorded_variables()

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`. A step is always a new one: there is no way back."""
        del no_set_state_prior
        status = self._do_step(communication_point, step_size, _NEW_STEP)
        restore_floating_point()
        if 0 <= status <= WARNING:
            if status == WARNING:
                self._fmi1.log.returned_warning("fmiDoStep")
            return StepResult(StepStatus.OK, communication_point + step_size)
        if status == DISCARD:
            return StepResult(StepStatus.DISCARD, self._last_successful_time())
        if status == ERROR:
            raise StepRejectedError(self._fmi1.log.explain("fmiDoStep returned fmiError"))
        self._fmi1.check("fmiDoStep", status)
        raise AssertionError

    def _last_successful_time(self) -> float:
        try:
            return float(self._fmi1.fmu.getRealStatus(_LAST_SUCCESSFUL_TIME).value)
        except FMICallException:
            return math.nan

    def reset(self) -> None:
        """See `Slave`. What was never initialized stands where it was instantiated."""
        if self._is_initialized:
            super().reset()
        self._is_initialized = False
