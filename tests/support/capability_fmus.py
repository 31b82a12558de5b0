"""FMUs of examples/capabilities driven by hand, call by call, with FMPy's classes.

One class for every interface; all address variables by name and count on a status of fmi1OK.
"""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import POINTER, c_char, c_double, c_int, c_size_t, c_uint, c_void_p
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy import fmi1, fmi2, fmi3
from fmpy.fmi1 import FMICallException

OK, WARNING, DISCARD, ERROR = 0, 1, 2, 3


class Extracted:
    """The contents of an FMU: a folder, the model description, the variables by name."""

    def __init__(self, fmu: Path, folder: Path) -> None:
        self.name = fmu.stem
        self.folder = str(fmpy.extract(str(fmu), unzipdir=str(folder / fmu.stem)))
        self.description: Any = fmpy.read_model_description(self.folder)
        self.variables: dict[str, Any] = {v.name: v for v in self.description.modelVariables}

    def arguments(self) -> dict[str, Any]:
        """Arguments of every class of FMPy."""
        return {
            "guid": self.description.guid,
            "unzipDirectory": self.folder,
            "modelIdentifier": self.name,
            "instanceName": self.name,
        }

    def references(self, names: Sequence[str]) -> list[int]:
        """Value references of variables."""
        return [self.variables[name].valueReference for name in names]

    def names(self, causality: str) -> list[str]:
        """The variables of a causality."""
        return [name for name, v in self.variables.items() if v.causality == causality]


class Slave1:
    """FMI 1.0 co-simulation.

    FMPy 0.3 declares the statuses of most functions as text and mixes up two of them; here they
    are declared anew.
    """

    def __init__(self, content: Extracted) -> None:
        self.content = content
        self.messages: list[str] = []
        self.fmu: Any = fmi1.FMU1Slave(**content.arguments())
        for name, function in self.fmu._functions.items():
            if name not in _NO_STATUS:
                function.restype = c_int
        self.functions = self.fmu._functions
        pointer = [c_void_p, POINTER(c_uint), c_size_t, POINTER(c_int), POINTER(c_double)]
        self.functions["fmi1SetRealInputDerivatives"].argtypes = pointer
        self.functions["fmi1DoStep"].argtypes = [c_void_p, c_double, c_double, c_char]
        callbacks = fmi1.fmi1CallbackFunctions()
        callbacks.logger = fmi1.fmi1CallbackLoggerTYPE(
            lambda _c, _name, _status, _category, message: self.messages.append(message.decode())
        )
        self.fmu.instantiate(functions=callbacks, loggingOn=True)
        assert self.fmu.component

    def initialize(self, stop_time: float | None = None) -> Slave1:
        self.call("fmi1InitializeSlave", 0.0, b"\1" if stop_time else b"\0", stop_time or 0.0)
        self.time = 0.0
        return self

    def call(self, name: str, *arguments: object) -> int:
        """The status of a call; anything but OK and a warning is an exception."""
        status = int(self.functions[name](self.fmu.component, *arguments))
        if status > WARNING:
            raise FMICallException(function=name, status=status)
        return status

    def set(self, **values: float) -> None:
        self.fmu.setReal(self.content.references(list(values)), list(values.values()))

    def get(self, *names: str) -> list[Any]:
        values = []
        for name in names:
            kind = _FMI2_KINDS[self.content.variables[name].type]
            values += list(getattr(self.fmu, f"get{kind}")(self.content.references([name])))
        return values

    def set_derivatives(self, order: int, **values: float) -> None:
        n = len(values)
        self.call(
            "fmi1SetRealInputDerivatives",
            (c_uint * n)(*self.content.references(list(values))),
            n,
            (c_int * n)(*[order] * n),
            (c_double * n)(*values.values()),
        )

    def step(self, step_size: float, *, new_step: bool = True) -> None:
        self.call("fmi1DoStep", self.time, step_size, b"\1" if new_step else b"\0")
        self.time += step_size

    def free(self) -> None:
        self.fmu.freeInstance()


_NO_STATUS = {
    "fmi1GetVersion",
    "fmi1GetTypesPlatform",
    "fmi1InstantiateSlave",
    "fmi1FreeSlaveInstance",
}


class _Instance2:
    fmu: Any

    def __init__(self, fmu: Any, content: Extracted) -> None:
        self.content = content
        self.fmu = fmu
        self.messages: list[str] = []
        callbacks = fmi2.fmi2CallbackFunctions()
        callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(
            lambda _e, _name, _status, _category, message: self.messages.append(message.decode())
        )
        self.fmu.instantiate(callbacks=callbacks, loggingOn=True)

    def initialize(self, tolerance: float | None = None, start_time: float = 0.0) -> None:
        self.fmu.setupExperiment(tolerance=tolerance, startTime=start_time)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        self.time = start_time

    def set(self, **values: Any) -> None:
        for name, value in values.items():
            kind = _FMI2_KINDS[self.content.variables[name].type]
            getattr(self.fmu, f"set{kind}")(self.content.references([name]), [value])

    def get(self, *names: str) -> list[Any]:
        values = []
        for name in names:
            kind = _FMI2_KINDS[self.content.variables[name].type]
            values += list(getattr(self.fmu, f"get{kind}")(self.content.references([name])))
        return values

    def save(self) -> Any:
        return self.fmu.getFMUstate()

    def restore(self, state: Any, time: float) -> None:
        self.fmu.setFMUstate(state)
        self.time = time

    def free(self) -> None:
        self.fmu.freeInstance()


_FMI2_KINDS = {
    "Real": "Real",
    "Integer": "Integer",
    "Enumeration": "Integer",
    "Boolean": "Boolean",
    "String": "String",
}


class Slave2(_Instance2):
    """FMI 2.0 co-simulation."""

    def __init__(self, content: Extracted) -> None:
        super().__init__(fmi2.FMU2Slave(**content.arguments()), content)

    def set_derivatives(self, order: int, **values: float) -> None:
        references = self.content.references(list(values))
        self.fmu.setRealInputDerivatives(references, [order] * len(values), list(values.values()))

    def step(self, step_size: float) -> None:
        self.fmu.doStep(self.time, step_size)
        self.time += step_size


class Model2(_Instance2):
    """FMI 2.0 model exchange."""

    def __init__(self, content: Extracted) -> None:
        super().__init__(fmi2.FMU2Model(**content.arguments()), content)


class _Instance3:
    fmu: Any

    def __init__(self, content: Extracted) -> None:
        self.content = content
        self.messages: list[str] = []

    def log(self, _environment: object, _status: int, _category: bytes, message: bytes) -> None:
        self.messages.append(message.decode())

    def initialize(self, tolerance: float | None = None, start_time: float = 0.0) -> None:
        self.fmu.enterInitializationMode(tolerance=tolerance, startTime=start_time)
        self.fmu.exitInitializationMode()
        self.time = start_time

    def set(self, **values: Any) -> None:
        for name, value in values.items():
            setter = getattr(self.fmu, f"set{_fmi3_kind(self.content.variables[name].type)}")
            setter(self.content.references([name]), value if isinstance(value, list) else [value])

    def get(self, *names: str) -> list[Any]:
        values: list[Any] = []
        for name in names:
            variable = self.content.variables[name]
            getter = getattr(self.fmu, f"get{_fmi3_kind(variable.type)}")
            values += list(getter(self.content.references([name])))
        return values

    def save(self) -> Any:
        return self.fmu.getFMUState()

    def restore(self, state: Any, time: float) -> None:
        self.fmu.setFMUState(state)
        self.time = time

    def free(self) -> None:
        self.fmu.freeInstance()


def _fmi3_kind(type_name: str) -> str:
    return "Int64" if type_name == "Enumeration" else type_name


class Slave3(_Instance3):
    """FMI 3.0 co-simulation."""

    def __init__(self, content: Extracted, **arguments: Any) -> None:
        super().__init__(content)
        self.fmu = fmi3.FMU3Slave(**content.arguments())
        self.fmu.instantiate(loggingOn=True, logMessage=self.log, **arguments)

    def step(self, step_size: float) -> tuple[bool, bool, bool, float]:
        """Event handling needed, terminate simulation, early return, last successful time."""
        event, terminate, early, reached = self.fmu.doStep(self.time, step_size)
        self.time = reached
        return event, terminate, early, reached


class Model3(_Instance3):
    """FMI 3.0 model exchange."""

    def __init__(self, content: Extracted) -> None:
        super().__init__(content)
        self.fmu = fmi3.FMU3Model(**content.arguments())
        self.fmu.instantiate(loggingOn=True, logMessage=self.log)


def vector(function: Any, n: int) -> np.ndarray:
    """Array of ``n`` numbers, filled by a function of model exchange."""
    values = (c_double * n)()
    function(values, n)
    return np.array(values)


def set_states(model: Model2 | Model3, time: float, x: np.ndarray) -> None:
    """Set the time and the continuous states of a model in continuous-time mode."""
    model.fmu.setTime(time)
    model.fmu.setContinuousStates((c_double * len(x))(*x), len(x))
