"""FMI 2.0 on fmpy's low-level layer, and its co-simulation FMUs as `Slave`."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

from fmpy import calloc, free
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import (
    FMU2Slave,
    fmi2CallbackAllocateMemoryTYPE,
    fmi2CallbackFreeMemoryTYPE,
    fmi2CallbackFunctions,
)

from protocol.calls import Initialize, StepResult, StepStatus
from protocol.errors import StepRejectedError
from protocol.host.log_files import SILENT, LogOutput
from protocol.variables import VariableType
from slave_node.floating_point import restore_floating_point
from slave_node.fmu.description import FmuModel
from slave_node.fmu.exchange import VALUES_CALL, ExchangeBuffer
from slave_node.fmu.fmu_slave import FmuSlave
from slave_node.fmu.instance import FmuInstance, reference_array
from slave_node.fmu.log import (
    DISCARD,
    ERROR,
    LOGGER_2,
    WARNING,
    add_proxy,
    choose_categories,
    register,
    unregister,
)
from slave_node.fmu.values import ValueType

_STEP_OK = StepStatus.OK
_LAST_SUCCESSFUL_TIME = 2
_TERMINATED = 3


class Fmi2Instance(FmuInstance):
    """One instance of an FMI 2.0 FMU, see `FmuInstance`."""

    prefix: ClassVar[str] = "fmi2"
    state_functions: ClassVar[tuple[str, str, str]] = (
        "fmi2GetFMUstate",
        "fmi2SetFMUstate",
        "fmi2FreeFMUstate",
    )
    value_types: ClassVar[Mapping[VariableType, ValueType]] = {
        VariableType.REAL: ValueType("Real", ctypes.c_double),
        VariableType.INTEGER: ValueType("Integer", ctypes.c_int),
        VariableType.ENUMERATION: ValueType("Integer", ctypes.c_int),
        VariableType.BOOLEAN: ValueType("Boolean", ctypes.c_int),
        VariableType.STRING: ValueType("String", ctypes.c_char_p),
    }

    @property
    def _fmpy_class(self) -> Callable[..., Any]:
        return FMU2Slave  # type: ignore[no-any-return]

    def _instantiate(self) -> None:
        wanted = self.log.wanted_categories(self.model.log_categories)
        callbacks = fmi2CallbackFunctions()
        callbacks.logger = LOGGER_2
        callbacks.componentEnvironment = id(self.log)
        callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
        callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
        add_proxy(callbacks)
        register(id(self.log), self.log)
        try:
            self.fmu.instantiate(callbacks=callbacks, loggingOn=self.log.is_wanted or bool(wanted))
            if wanted:
                choose_categories(self.fmu.setDebugLogging, True, wanted)
        except Exception:
            unregister(self.log)
            raise

    def exchange(self, function: str, references: Any, arrays: Sequence[Any], values: int) -> None:
        """See `FmuInstance`."""
        del values
        name = f"fmi2{function}"
        call = self.function(name, VALUES_CALL)
        self.check(name, call(references.ctypes.data, len(references), *arrays))

    def enter_initialization_mode(self, experiment: Initialize) -> None:
        """Set up the experiment, set start values, enter initialization mode."""
        at_once, _ = self.split_start_values(
            experiment.start_values
        )  # there are no arrays in FMI 2.0
        fmu = self.fmu
        self.call(
            fmu.setupExperiment,
            tolerance=experiment.relative_tolerance,
            startTime=experiment.start_time,
            stopTime=experiment.stop_time,
        )
        self.set_values(at_once)
        self.call(fmu.enterInitializationMode)

    def buffer(self, names: Sequence[str], values: str, derivatives: str = "") -> ExchangeBuffer:
        """For these variables, with the functions of these names."""
        references = reference_array(self.continuous_places(names))
        return ExchangeBuffer(references, self.bound, values, derivatives)

    def close(self) -> None:
        """See `FmuInstance`."""
        super().close()
        unregister(self.log)


class Fmi2Slave(FmuSlave):
    """One instance of an FMI 2.0 co-simulation FMU.

    Args:
        model: the FMU.
        name: instance name.
        output: where its messages go, and which ones it is asked for.

    Raises:
        ModelError: the FMU cannot be loaded or instantiated here.
    """

    def __init__(self, model: FmuModel, name: str, output: LogOutput = SILENT) -> None:
        self._fmi2 = Fmi2Instance(model, name, output)
        super().__init__(self._fmi2)
        function = self._fmi2.function
        self._do_step = function("fmi2DoStep", [ctypes.c_double, ctypes.c_double, ctypes.c_int])
        self._bind((), ())

    def _bind(self, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        """Make the buffers for these inputs and outputs."""
        instance = self._fmi2

        self._rows_set = 1
        self._inputs = instance.buffer(inputs, "fmi2SetReal", "fmi2SetRealInputDerivatives")
        self._outputs = instance.buffer(outputs, "fmi2GetReal", "fmi2GetRealOutputDerivatives")

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`."""
        self._bind(experiment.inputs, experiment.outputs)
        self._discrete_inputs = self._fmi2.discrete(experiment.discrete_inputs)
        self._discrete_outputs = self._fmi2.discrete(experiment.discrete_outputs)
        self._fmi2.enter_initialization_mode(experiment)

    def exit_initialization_mode(self) -> None:
        """See `Slave`."""
        self._fmi2.call(self._fmi2.fmu.exitInitializationMode)

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`."""
        status = self._do_step(communication_point, step_size, no_set_state_prior)
        restore_floating_point()
        if 0 <= status <= WARNING:
            if status == WARNING:
                self._fmi2.log.returned_warning("fmi2DoStep")
            return StepResult(_STEP_OK, communication_point + step_size)
        if status == DISCARD:
            return self._discarded()
        if status == ERROR:
            raise StepRejectedError(self._fmi2.log.explain("fmi2DoStep returned fmi2Error"))
        self._fmi2.check("fmi2DoStep", status)
        raise AssertionError

    def _discarded(self) -> StepResult:
        fmu, component = self._fmi2.fmu, self._fmi2.component
        time = ctypes.c_double(float("nan"))
        terminated = ctypes.c_int(0)
        try:
            fmu.fmi2GetRealStatus(component, _LAST_SUCCESSFUL_TIME, ctypes.byref(time))
        except (FMICallException, AttributeError, KeyError):
            time.value = float("nan")
        try:
            fmu.fmi2GetBooleanStatus(component, _TERMINATED, ctypes.byref(terminated))
        except (FMICallException, AttributeError, KeyError):
            terminated.value = 0
        status = StepStatus.TERMINATED if terminated.value else StepStatus.DISCARD
        return StepResult(status, time.value)
