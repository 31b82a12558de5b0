"""FMUs for model exchange of FMI 2.0 and 3.0 under one set of names."""

from __future__ import annotations

import ctypes
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from fmpy.fmi2 import FMU2Model
from fmpy.fmi3 import FMU3Model

from protocol.calls import Initialize
from protocol.errors import SlaveError, StepRejectedError
from protocol.signals import FloatArray
from slave_node.fmu.exchange import Buffer
from slave_node.fmu.fmi2 import Fmi2Instance
from slave_node.fmu.fmi3 import MAX_UPDATES, Fmi3Instance
from slave_node.fmu.instance import ADDRESS, FmuInstance
from slave_node.fmu.log import DISCARD

_VECTOR_CALL = [ADDRESS, ctypes.c_size_t]


class ContinuousModel(FmuInstance):
    """The equations x' = f(t, x, u) of an FMU, with event indicators z and events.

    Vectors are passed as addresses. Every method raises `SlaveError` when the FMU refuses, and
    `StepRejectedError` when it discards what was set: a smaller step may succeed.

    Attributes:
        next_event_time: of the next time event [s], infinite if there is none.
    """

    functions: ClassVar[Mapping[str, str]]
    """Full names of the functions by what they do: time, set, states, derivatives, indicators,
    nominals."""

    next_event_time: float

    def _load_functions(self) -> None:
        super()._load_functions()
        names = self.functions
        self._set_time = self.function(names["time"], [ctypes.c_double])
        self._vectors = {
            what: self.function(name, _VECTOR_CALL)
            for what, name in names.items()
            if what != "time"
        }

    def set_time(self, time: float) -> None:
        """The independent variable [s]."""
        status = self._set_time(time)
        if status:
            self._check_evaluation("time", status)

    def transfer(self, what: str, address: Any, count: int) -> None:
        """Set or get a vector of ``count`` numbers, see ``functions``."""
        if count:
            status = self._vectors[what](address, count)
            if status:
                self._check_evaluation(what, status)

    def vector(self, what: str, count: int) -> FloatArray:
        """Get a vector, shape (count,)."""
        values = np.zeros(count)
        self.transfer(what, values.ctypes.data, count)
        return values

    def _check_evaluation(self, what: str, status: int) -> None:
        name = self.functions[what]
        if status == DISCARD:
            raise StepRejectedError(self.log.explain(f"{name} returned {self.prefix}Discard"))
        self.check(name, status)

    @abstractmethod
    def buffers(self, names: Sequence[str], *, sets: bool) -> Buffer:
        """For values of these variables; inputs are filled with what the FMU has."""

    @abstractmethod
    def enter_initialization_mode(self, experiment: Initialize) -> None:
        """Enter initialization mode with an experiment and its start values."""

    @abstractmethod
    def count(self) -> tuple[int, int]:
        """Numbers of continuous states and of event indicators."""

    @abstractmethod
    def update_discrete_states(self) -> tuple[bool, bool, bool]:
        """In event mode, until there is nothing more to update.

        Returns:
            Whether the FMU wants to terminate, whether continuous states have jumped, and whether
            their nominal values have changed.
        """

    def enter_event_mode(self) -> None:
        """From continuous-time mode."""
        self.call(self.fmu.enterEventMode)

    def enter_continuous_time_mode(self) -> None:
        """From event mode."""
        self.call(self.fmu.enterContinuousTimeMode)

    def completed_step(self, no_set_state_prior: bool) -> tuple[bool, bool]:
        """After a step of the solver: whether there is a step event, whether to terminate."""
        event, terminate = self.call(self.fmu.completedIntegratorStep, no_set_state_prior)
        return bool(event), bool(terminate)


class Fmi2Model(ContinuousModel, Fmi2Instance):
    """FMI 2.0, see `ContinuousModel`."""

    functions: ClassVar[Mapping[str, str]] = {
        "time": "fmi2SetTime",
        "set": "fmi2SetContinuousStates",
        "states": "fmi2GetContinuousStates",
        "derivatives": "fmi2GetDerivatives",
        "indicators": "fmi2GetEventIndicators",
        "nominals": "fmi2GetNominalsOfContinuousStates",
    }

    @property
    def _fmpy_class(self) -> Callable[..., Any]:
        return FMU2Model  # type: ignore[no-any-return]

    def enter_initialization_mode(self, experiment: Initialize) -> None:
        """See `ContinuousModel`."""
        Fmi2Instance.enter_initialization_mode(self, experiment)

    def buffers(self, names: Sequence[str], *, sets: bool) -> Buffer:
        """See `ContinuousModel`."""
        return self.buffer(names, "fmi2SetReal" if sets else "fmi2GetReal")

    def count(self) -> tuple[int, int]:
        """See `ContinuousModel`."""
        return self.model.interface.continuous_states, self.model.interface.event_indicators

    def update_discrete_states(self) -> tuple[bool, bool, bool]:
        """See `ContinuousModel`."""
        terminate = jumped = rescaled = False
        for _ in range(MAX_UPDATES):
            more, ends, new_nominals, new_values, has_next, time = self.call(
                self.fmu.newDiscreteStates
            )
            terminate |= ends
            jumped |= new_values
            rescaled |= new_nominals
            if terminate or not more:
                self.next_event_time = time if has_next else np.inf
                return terminate, jumped, rescaled
        raise SlaveError(f"the discrete states do not settle in {MAX_UPDATES} updates")


class Fmi3Model(ContinuousModel, Fmi3Instance):
    """FMI 3.0, see `ContinuousModel`."""

    functions: ClassVar[Mapping[str, str]] = {
        "time": "fmi3SetTime",
        "set": "fmi3SetContinuousStates",
        "states": "fmi3GetContinuousStates",
        "derivatives": "fmi3GetContinuousStateDerivatives",
        "indicators": "fmi3GetEventIndicators",
        "nominals": "fmi3GetNominalsOfContinuousStates",
    }

    @property
    def _fmpy_class(self) -> Callable[..., Any]:
        return FMU3Model  # type: ignore[no-any-return]

    def enter_initialization_mode(self, experiment: Initialize) -> None:
        """See `ContinuousModel`."""
        Fmi3Instance.enter_initialization_mode(self, experiment)

    def buffers(self, names: Sequence[str], *, sets: bool) -> Buffer:
        """See `ContinuousModel`."""
        buffer = self.buffer(names, sets=sets)
        if sets:
            self.check("fmi3GetFloat64", buffer.fill())
        return buffer

    def count(self) -> tuple[int, int]:
        """See `ContinuousModel`."""
        states = self.call(self.fmu.getNumberOfContinuousStates)
        return int(states), int(self.call(self.fmu.getNumberOfEventIndicators))

    def update_discrete_states(self) -> tuple[bool, bool, bool]:
        """See `ContinuousModel`."""
        return Fmi3Instance.update_discrete_states(self)
