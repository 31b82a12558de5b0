"""One instance of an FMU: what the versions of FMI have in common.

A subclass for each version knows its functions. Co-simulation and model exchange build on it.
"""

from __future__ import annotations

import ctypes
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, ClassVar, TypeVar

import numpy as np
from fmpy.fmi1 import FMICallException

from protocol.errors import FatalSlaveError, ModelError, SlaveError
from protocol.host.log_files import SILENT, LogOutput
from protocol.text.names import nearest
from protocol.values import value_of
from protocol.variables import StartValue, Variable, VariableType
from slave_node.floating_point import restore_floating_point
from slave_node.fmu.archive import PLATFORM_FOLDERS, check_binary
from slave_node.fmu.description import FmuModel
from slave_node.fmu.embedded_python import forget_modules, own_modules
from slave_node.fmu.log import FATAL, OK, STATUS, WARNING, FmuLog
from slave_node.fmu.values import DiscreteExchange, ValueType
from slave_node.fmu.variables import Place, settable_variable

_MISSING_LIBRARY = re.compile(r"([^\s:]+): cannot open shared object file")

ADDRESS = ctypes.c_void_p

_only_instances: set[str] = set()
"""Tokens of the FMUs here that declare canBeInstantiatedOnlyOncePerProcess."""

T = TypeVar("T")


class FmuInstance(ABC):
    """One instance of an FMU, instantiated.

    Args:
        model: the FMU.
        name: of the instance.
        output: where its messages go, and which ones it is asked for.

    Attributes:
        model: the FMU.
        fmu: fmpy's object for it.
        component: its address.
        log: its messages.

    Raises:
        ModelError: the FMU cannot be loaded or instantiated here.
    """

    prefix: ClassVar[str]
    """Prefix of the names of the functions, such as ``fmi2``."""
    platform_folder: ClassVar[str] = PLATFORM_FOLDERS[0]
    value_types: ClassVar[Mapping[VariableType, ValueType]]
    state_functions: ClassVar[tuple[str, str, str]] = ("", "", "")
    """Names of those that get, set and free a state."""

    def __init__(self, model: FmuModel, name: str, output: LogOutput = SILENT) -> None:
        self.model = model
        self.log = FmuLog(name, output, self.prefix)
        self.fmu: Any = None
        self._is_fatal = False
        check_binary(
            model.fmu, model.directory, model.interface.model_identifier, self.platform_folder
        )
        if model.interface.is_once_per_process and model.token in _only_instances:
            raise ModelError(
                f"{model.fmu}: can be instantiated only once per process, and is already",
                remedy="give each slave a process of its own: leave out --in-process",
            )
        self.fmu = self._load(name)
        try:
            with own_modules(model.fmu, model.directory):
                self._instantiate()
        except ModelError:
            raise
        except Exception as error:  # fmpy raises plain exceptions for all that can go wrong
            raise ModelError(
                self.log.explain(f"{model.fmu}: {self.prefix}Instantiate: {error}"),
                remedy=self._remedy(),
            ) from error
        self.component: int = self.fmu.component
        if model.interface.is_once_per_process:
            _only_instances.add(model.token)
        try:
            self._load_functions()
        except AttributeError as error:
            raise self._lacks_function(error) from error

    # ---- What a version has to say ------------------------------------------------------------

    @property
    @abstractmethod
    def _fmpy_class(self) -> Callable[..., Any]:
        """Fmpy's class for the interface."""

    @abstractmethod
    def _instantiate(self) -> None:
        """Call fmiXInstantiate..., with the log connected."""

    @abstractmethod
    def exchange(self, function: str, references: Any, arrays: Sequence[Any], values: int) -> None:
        """Call fmiXGet... or fmiXSet...

        Args:
            function: its name without the prefix.
            references: value references, shape (n,).
            arrays: what stands behind their number in the call.
            values: how many values these hold.
        """

    # ---- Loading ------------------------------------------------------------------------------

    def _load(self, name: str) -> Any:
        model = self.model
        folder = os.getcwd()  # noqa: PTH109  which fmpy leaves, and returns to unless it fails
        try:
            return self._fmpy_class(
                guid=model.token,
                modelIdentifier=model.interface.model_identifier,
                unzipDirectory=str(model.directory),
                instanceName=name,
            )
        except AttributeError as error:
            raise self._lacks_function(error) from error
        except Exception as error:  # as above
            missing = _MISSING_LIBRARY.search(str(error))
            if missing:
                raise ModelError(
                    f"{model.fmu}: needs the shared library {missing[1]}, which is not here",
                    remedy="install what brings it, or set LD_LIBRARY_PATH to its folder",
                ) from error
            raise ModelError(f"{model.fmu}: {error}") from error
        finally:
            os.chdir(folder)

    def _lacks_function(self, error: AttributeError) -> ModelError:
        return ModelError(
            f"{self.model.fmu}: its binary lacks a function of {self.model.interface.kind}: {error}"
        )

    def _remedy(self) -> str:
        if not self.model.interface.needs_execution_tool:
            return ""
        tool = self.model.description.generation_tool or "the tool that exported it"
        return f"it needs {tool} installed on this host"

    def _load_functions(self) -> None:
        if self.model.interface.saves_state:
            get, set_, free = (self.function(n, [ADDRESS]) for n in self.state_functions)
            self.get_fmu_state: Callable[..., int] = get
            self.set_fmu_state: Callable[..., int] = set_
            self.free_fmu_state: Callable[..., int] = free

    def function(self, name: str, argument_types: Sequence[Any]) -> Any:
        """The function of that full name, with the component bound.

        ``argument_types``: of the arguments behind the component.
        """
        function = self._function(name)
        function.argtypes = [ADDRESS, *argument_types]
        return partial(function, ADDRESS.from_param(self.component))

    def bound(self, name: str, argument_types: Sequence[Any], *arguments: int) -> Callable[[], int]:
        """Function with all its arguments bound, so that a call has nothing left to convert.

        What the arguments are addresses of must outlive the call.
        """
        converted = [
            kind.from_param(argument)
            for kind, argument in zip(argument_types, arguments, strict=True)
        ]
        return partial(self._function(name), ADDRESS.from_param(self.component), *converted)

    def _function(self, name: str) -> Any:
        function = self.fmu.dll[self.c_name(name)]
        function.restype = ctypes.c_int
        return function

    def c_name(self, name: str) -> str:
        """The name in the binary."""
        return name

    # ---- Calls --------------------------------------------------------------------------------

    def check(self, function: str, status: int, *, remedy: str = "") -> None:
        """Turn any status that is not OK or a warning into an error with the FMU's own words."""
        restore_floating_point()
        if status == WARNING:
            self.log.returned_warning(function)
        if status in (OK, WARNING):
            return
        known = 0 <= status < len(STATUS)
        name = f"{self.prefix}{STATUS[status]}" if known else f"status {status}"
        text = self.log.explain(f"{function} returned {name}")
        self._is_fatal = self._is_fatal or status == FATAL
        raise FatalSlaveError(text) if status == FATAL else SlaveError(text, remedy=remedy)

    def call(self, method: Callable[..., T], *arguments: Any, **named: Any) -> T:
        """Call a method of fmpy; its exception for a status as ours."""
        try:
            return method(*arguments, **named)
        except FMICallException as error:
            self.check(error.function, error.status)
            raise AssertionError from error
        finally:
            restore_floating_point()

    def value_type(self, kind: VariableType, name: str) -> ValueType:
        """Exchange of a variable called ``name``.

        Raises:
            SlaveError: not at all.
        """
        try:
            return self.value_types[kind]
        except KeyError:
            raise SlaveError(f"{name!r} is of type {kind}, which is not exchanged") from None

    def places(self, names: Sequence[str]) -> dict[str, Place]:
        """Where these variables lie, in order.

        Raises:
            ModelError: there is none of a name, or a name comes twice.
        """
        known = self.model.places
        places: dict[str, Place] = {}
        for name in names:
            if name not in known:
                raise ModelError(f"no variable {name!r}{nearest(name, known)}")
            if name in places:
                raise ModelError(f"{name!r} is listed twice")
            places[name] = known[name]
        return places

    def continuous_places(self, names: Sequence[str]) -> list[Place]:
        """Exchange of variables that are floating-point numbers.

        Raises:
            ModelError: as ``places``, or a variable is of another type.
        """
        places = self.places(names)
        for name, place in places.items():
            if not place.type.is_real:
                raise ModelError(
                    f"{name!r} is of type {place.type}; it is exchanged as a discrete variable"
                )
        return list(places.values())

    def discrete(self, names: Sequence[str]) -> DiscreteExchange:
        """The exchange of these variables.

        Raises:
            ModelError: there is none of a name.
            SlaveError: a variable is of a type that is not exchanged.
        """
        return DiscreteExchange(self, self.places(names))

    # ---- Start values -------------------------------------------------------------------------

    def split_start_values(
        self, start_values: Mapping[str, StartValue]
    ) -> tuple[dict[str, StartValue], dict[str, StartValue]]:
        """Those that can be set at once, and those that have to wait for initialization mode.

        An array is set as a whole, with the start values of the elements that are not given. Where
        the FMU says none for them it has to be asked, which FMI does not allow earlier.

        Raises:
            ModelError: a name or a value is wrong.
        """
        description, places = self.model.description, self.model.places
        start_values = {
            name: self._start_value(settable_variable(description, name), value)
            for name, value in start_values.items()
        }
        arrays = {places[name].reference for name in start_values if places[name].size > 1}
        at_once = {n: v for n, v in start_values.items() if places[n].reference not in arrays}
        later: dict[str, StartValue] = {}
        for reference in arrays:
            whole = {
                v.name: start_values.get(v.name, v.start)
                for v in description.variables
                if places[v.name].reference == reference
            }
            given = {name: value for name, value in whole.items() if value is not None}
            if len(given) == len(whole):
                at_once |= given
            else:
                later |= {n: v for n, v in start_values.items() if n in whole}
        return at_once, later

    def _start_value(self, variable: Variable, value: StartValue) -> StartValue:
        """The value in the type of the variable, and of C where that has fewer values."""
        try:
            converted = value_of(variable, value)
        except ValueError as error:
            raise ModelError(f"{variable.name!r} {error}") from None
        bounds = self.value_type(variable.type, variable.name).bounds
        if bounds and not bounds[0] <= converted <= bounds[1]:  # type: ignore[operator]
            raise ModelError(
                f"{variable.name!r} is of type {variable.type}, {bounds[0]} to {bounds[1]}; it "
                f"cannot be {value!r}"
            )
        return converted

    def set_values(self, values: Mapping[str, StartValue]) -> None:
        """Set variables to checked values: of an array the elements that are named.

        Raises:
            SlaveError: the FMU refused; the message says for which variable.
        """
        by_reference: dict[tuple[VariableType, int], dict[str, StartValue]] = {}
        for name, value in values.items():
            place = self.model.places[name]
            by_reference.setdefault((place.type, place.reference), {})[name] = value
        for members in by_reference.values():
            exchange = self.discrete(list(members))
            try:
                exchange.put(list(members.values()), ModelError)
                exchange.send()
            except SlaveError as error:
                name = next(iter(members))
                error.cause = f"{name!r}: {error.cause}"
                raise

    # ---- End ----------------------------------------------------------------------------------

    def close(self) -> None:
        """Free the instance and unload the binary; leave both after a fatal error. Idempotent."""
        if self.fmu is not None:
            fmu, self.fmu = self.fmu, None
            if not self._is_fatal:
                with suppress(FMICallException):
                    fmu.freeInstance()
            forget_modules(self.model.directory)
            _only_instances.discard(self.model.token)


def reference_array(places: Sequence[Place]) -> np.ndarray[Any, np.dtype[np.uint32]]:
    """Value references, shape (n,)."""
    return np.array([place.reference for place in places], dtype=np.uint32)
