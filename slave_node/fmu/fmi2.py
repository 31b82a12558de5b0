"""An FMI 2.0 co-simulation FMU as a `Slave`, on fmpy's low-level layer.

Arrays go to and come from buffers that are made once, so that the hot path neither allocates in
C types nor loops over variables in Python.
"""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from fmpy import calloc, free
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import (
    FMU2Slave,
    fmi2CallbackAllocateMemoryTYPE,
    fmi2CallbackFreeMemoryTYPE,
    fmi2CallbackFunctions,
    fmi2CallbackLoggerTYPE,
)
from fmpy.logging import addLoggerProxy

from protocol.calls import StepResult
from protocol.errors import FatalSlaveError, ModelError, SlaveError, StepRejectedError
from protocol.names import nearest
from protocol.signals import MAX_ORDER, FloatArray
from protocol.slave import (
    Causality,
    Slave,
    SlaveDescription,
    StartValue,
    StepStatus,
    Variable,
    VariableType,
    refuse_discrete,
)
from slave_node.fmu.archive import check_binary, extract
from slave_node.fmu.description import describe, read_description
from slave_node.fmu.exchange import DERIVATIVES_CALL, VALUES_CALL, ExchangeBuffer

_OK, _WARNING, _DISCARD, _ERROR, _FATAL = range(5)
_STATUS = ("fmi2OK", "fmi2Warning", "fmi2Discard", "fmi2Error", "fmi2Fatal", "fmi2Pending")
_STEP_OK = StepStatus.OK
_LAST_SUCCESSFUL_TIME = 2
_TERMINATED = 3
_LOG_LINES = 20
_ERROR_CATEGORIES = {"logStatusWarning", "logStatusDiscard", "logStatusError", "logStatusFatal"}

_ADDRESS = ctypes.c_void_p


_logs: dict[int, deque[str]] = {}
"""The last messages of each FMU, by the componentEnvironment that it was given."""


def _log_message(
    environment: int | None, _name: bytes, _status: int, category: bytes, text: bytes
) -> None:
    log = _logs.get(environment or 0)
    if log is None and len(_logs) == 1:  # an FMU that forgets its environment
        (log,) = _logs.values()
    if log is not None:
        log.append(
            f"[{(category or b'').decode(errors='replace')}] "
            f"{(text or b'').decode(errors='replace').strip()}"
        )


_LOGGER = fmi2CallbackLoggerTYPE(_log_message)
"""One for all and for ever: the proxy of fmpy that formats the messages knows one logger."""


class Fmi2Slave(Slave):
    """One instance of an FMI 2.0 co-simulation FMU.

    Args:
        fmu: the file.
        directory: an empty directory to extract it into; the caller removes it.
        name: instance name.
        log_all: let the FMU log all its categories, not only its errors.

    Raises:
        ModelError: the FMU cannot be loaded or instantiated here.
    """

    def __init__(self, fmu: Path, directory: Path, name: str, *, log_all: bool = False) -> None:
        extract(fmu, directory)
        model_description = read_description(fmu, directory)
        identifier = model_description.coSimulation.modelIdentifier
        check_binary(fmu, directory, identifier)
        self.description: SlaveDescription = describe(fmu, model_description)
        can = self.description.capabilities
        self._max_rows = MAX_ORDER + 1 if can.can_interpolate_inputs else 1
        self._max_order = min(can.max_output_derivative_order, MAX_ORDER)
        self._references = {v.name: v.valueReference for v in model_description.modelVariables}
        self._log: deque[str] = deque(maxlen=_LOG_LINES)
        self._fmu: FMU2Slave | None = None
        try:
            self._fmu = FMU2Slave(
                guid=model_description.guid,
                modelIdentifier=identifier,
                unzipDirectory=str(directory),
                instanceName=name,
            )
        except Exception as error:  # fmpy raises plain exceptions for all that can go wrong
            raise ModelError(f"{fmu}: {error}") from error
        self._instantiate(fmu, model_description.logCategories, log_all=log_all)
        try:
            self._load_functions()
        except AttributeError as error:
            raise ModelError(f"{fmu}: its binary lacks a function of FMI 2.0: {error}") from error
        self._bind((), ())

    def _instantiate(self, fmu: Path, categories: Any, *, log_all: bool) -> None:
        names = [category.name for category in categories]
        wanted = [n for n in names if log_all or n in _ERROR_CATEGORIES]
        callbacks = fmi2CallbackFunctions()
        callbacks.logger = _LOGGER
        callbacks.componentEnvironment = id(self._log)
        callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
        callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
        addLoggerProxy(ctypes.byref(callbacks))
        assert self._fmu is not None
        _logs[id(self._log)] = self._log
        try:
            self._fmu.instantiate(callbacks=callbacks, loggingOn=log_all or bool(wanted))
            if wanted:
                self._fmu.setDebugLogging(True, wanted)
        except Exception as error:  # as above
            raise ModelError(self._with_log(f"{fmu}: fmi2Instantiate: {error}")) from error

    def _with_log(self, text: str) -> str:
        lines = " | ".join(list(self._log)[-5:])
        self._log.clear()
        return f"{text}; the FMU's log: {lines}" if lines else text

    def _load_functions(self) -> None:
        assert self._fmu is not None
        component = self._fmu.component

        def load(name: str, argument_types: list[Any]) -> Any:
            function = self._fmu.dll[name]  # type: ignore[union-attr]
            function.argtypes = argument_types
            function.restype = ctypes.c_int
            return function

        self._component = component
        self._set_real = load("fmi2SetReal", VALUES_CALL)
        self._get_real = load("fmi2GetReal", VALUES_CALL)
        self._set_derivatives = load("fmi2SetRealInputDerivatives", DERIVATIVES_CALL)
        self._get_derivatives = load("fmi2GetRealOutputDerivatives", DERIVATIVES_CALL)
        double, integer = ctypes.c_double, ctypes.c_int
        self._do_step = partial(load("fmi2DoStep", [_ADDRESS, double, double, integer]), component)
        self._saves_state = self.description.capabilities.can_get_and_set_state
        if self._saves_state:
            self._get_state = partial(load("fmi2GetFMUstate", [_ADDRESS, _ADDRESS]), component)
            self._set_state = partial(load("fmi2SetFMUstate", [_ADDRESS, _ADDRESS]), component)
            self._free_state = partial(load("fmi2FreeFMUstate", [_ADDRESS, _ADDRESS]), component)

    def _bind(self, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        """Make the buffers for these inputs and outputs."""
        self._rows_set = 1
        self._inputs = ExchangeBuffer(
            self._component, self._reference_array(inputs), self._set_real, self._set_derivatives
        )
        self._outputs = ExchangeBuffer(
            self._component, self._reference_array(outputs), self._get_real, self._get_derivatives
        )

    def _reference_array(self, names: Sequence[str]) -> np.ndarray[Any, np.dtype[np.uint32]]:
        for name in names:
            if name not in self._references:
                raise ModelError(f"no variable {name!r}{nearest(name, self._references)}")
        return np.array([self._references[name] for name in names], dtype=np.uint32)

    def _check(self, function: str, status: int) -> None:
        """Turn any status that is not OK or a warning into an error with the FMU's own words."""
        if status == _WARNING:
            return
        name = _STATUS[status] if 0 <= status < len(_STATUS) else f"status {status}"
        text = self._with_log(f"{function} returned {name}")
        if status == _FATAL:
            raise FatalSlaveError(text)
        raise SlaveError(text)

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
        early_return: bool = False,  # noqa: ARG002  it never does
    ) -> None:
        """See `Slave`."""
        assert self._fmu is not None
        refuse_discrete(self.description, discrete_inputs, discrete_outputs)
        self._bind(inputs, outputs)
        try:
            self._fmu.setupExperiment(
                tolerance=relative_tolerance, startTime=start_time, stopTime=stop_time
            )
            for name, value in start_values.items():
                self._set_start_value(name, value)
            self._fmu.enterInitializationMode()
        except FMICallException as error:
            self._check(error.function, error.status)

    def _set_start_value(self, name: str, value: StartValue) -> None:
        assert self._fmu is not None
        variable = settable_variable(self.description, name)
        reference = [self._references[name]]
        match variable.type:
            case VariableType.REAL if type(value) in (float, int):
                self._fmu.setReal(reference, [float(value)])
            case VariableType.INTEGER | VariableType.ENUMERATION if type(value) is int:
                self._fmu.setInteger(reference, [value])
            case VariableType.BOOLEAN if type(value) is bool:
                self._fmu.setBoolean(reference, [value])
            case VariableType.STRING if type(value) is str:
                self._fmu.setString(reference, [value])
            case _:
                raise ModelError(f"{name!r} is of type {variable.type}; it cannot be {value!r}")

    def exit_initialization_mode(self) -> None:
        """See `Slave`."""
        assert self._fmu is not None
        try:
            self._fmu.exitInitializationMode()
        except FMICallException as error:
            self._check(error.function, error.status)

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
        if rows < self._rows_set:
            inputs.rows[rows:] = 0.0
        else:
            self._rows_set = rows
        inputs.first[rows][...] = derivatives
        status = inputs.transfer_values()
        if status:
            self._check("fmi2SetReal", status)
        if self._rows_set > 1:
            status = inputs.transfer_derivatives[self._rows_set - 1]()
            if status:
                self._check("fmi2SetRealInputDerivatives", status)

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`."""
        status = self._do_step(communication_point, step_size, no_set_state_prior)
        if 0 <= status <= _WARNING:
            return StepResult(_STEP_OK, communication_point + step_size)
        if status == _DISCARD:
            return self._discarded()
        if status == _ERROR:
            raise StepRejectedError(self._with_log("fmi2DoStep returned fmi2Error"))
        self._check("fmi2DoStep", status)
        raise AssertionError

    def _discarded(self) -> StepResult:
        assert self._fmu is not None
        time = ctypes.c_double(float("nan"))
        terminated = ctypes.c_int(0)
        try:
            self._fmu.fmi2GetRealStatus(self._component, _LAST_SUCCESSFUL_TIME, ctypes.byref(time))
        except (FMICallException, AttributeError, KeyError):
            time.value = float("nan")
        try:
            self._fmu.fmi2GetBooleanStatus(self._component, _TERMINATED, ctypes.byref(terminated))
        except (FMICallException, AttributeError, KeyError):
            terminated.value = 0
        status = StepStatus.TERMINATED if terminated.value else StepStatus.DISCARD
        return StepResult(status, time.value)

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
                self._check("fmi2GetReal", status)
            if order:
                status = outputs.transfer_derivatives[order]()
                if status:
                    self._check("fmi2GetRealOutputDerivatives", status)
        return outputs.first[order + 1].copy()

    def get_state(self) -> object:
        """See `Slave`."""
        if not self._saves_state:
            raise SlaveError(f"the FMU {self.description.model} cannot save its state")
        state = ctypes.c_void_p()
        status = self._get_state(ctypes.byref(state))
        if status:
            self._check("fmi2GetFMUstate", status)
        return state

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        status = self._set_state(state)
        if status:
            self._check("fmi2SetFMUstate", status)

    def free_state(self, state: object) -> None:
        """See `Slave`."""
        status = self._free_state(ctypes.byref(state))  # type: ignore[arg-type]
        if status:
            self._check("fmi2FreeFMUstate", status)

    def serialize_state(self, state: object) -> bytes:
        """See `Slave`."""
        self._require(self.description.capabilities.can_serialize_state, "serialize its state")
        assert self._fmu is not None
        try:
            return bytes(self._fmu.serializeFMUstate(state))
        except FMICallException as error:
            self._check(error.function, error.status)
            raise AssertionError from error

    def deserialize_state(self, data: bytes) -> object:
        """See `Slave`."""
        self._require(self.description.capabilities.can_serialize_state, "deserialize its state")
        assert self._fmu is not None
        try:
            return self._fmu.deSerializeFMUstate(data)
        except FMICallException as error:
            self._check(error.function, error.status)
            raise AssertionError from error

    def _require(self, capability: bool, what: str) -> None:
        if not capability:
            raise SlaveError(f"the FMU {self.description.model} cannot {what}")

    def terminate(self) -> None:
        """See `Slave`."""
        assert self._fmu is not None
        try:
            self._fmu.terminate()
        except FMICallException as error:
            self._check(error.function, error.status)

    def reset(self) -> None:
        """See `Slave`."""
        assert self._fmu is not None
        try:
            self._fmu.reset()
        except FMICallException as error:
            self._check(error.function, error.status)

    def close(self) -> None:
        """See `Slave`."""
        if self._fmu is not None:
            fmu, self._fmu = self._fmu, None
            fmu.freeInstance()
            _logs.pop(id(self._log), None)


def settable_variable(description: SlaveDescription, name: str) -> Variable:
    """The variable called ``name``, if it may be given a start value.

    Raises:
        ModelError: there is none of that name, with the nearest names, or it cannot be set.
    """
    try:
        variable = description.variable(name)
    except KeyError:
        names = [v.name for v in description.variables]
        raise ModelError(f"no variable {name!r}{nearest(name, names)}") from None
    if variable.causality in (Causality.CALCULATED_PARAMETER, Causality.INDEPENDENT) or (
        variable.variability == "constant"
    ):
        raise ModelError(f"{name!r} cannot be set: it is a {variable.variability} variable")
    return variable
