"""The `Slave` contract and the description of a slave: the narrow waist of the project.

A `Slave` is anything that can be initialized, stepped and rolled back: an FMU, a Python model.
Who calls it (the executor in the slave's process, or the master itself when it runs in process)
keeps the call order of ``life_cycle.py``; a `Slave` need not check it again.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

from protocol.calls import Call, Reply, StepResult
from protocol.signals import FloatArray

StartValue = float | int | bool | str


class Causality(StrEnum):
    """FMI 2.0, section 2.2.7."""

    PARAMETER = "parameter"
    CALCULATED_PARAMETER = "calculatedParameter"
    INPUT = "input"
    OUTPUT = "output"
    LOCAL = "local"
    INDEPENDENT = "independent"


class VariableType(StrEnum):
    """The base types of FMI 2.0."""

    REAL = "Real"
    INTEGER = "Integer"
    BOOLEAN = "Boolean"
    STRING = "String"
    ENUMERATION = "Enumeration"


@dataclass(frozen=True, slots=True)
class Variable:
    """A variable of a slave, in FMI's words.

    Attributes:
        name: unique within the slave.
        unit: unit name as declared, "" if none.
        start: start value, None if the model gives none.
        nominal: nominal value, in ``unit``; scales the absolute tolerance.
    """

    name: str
    causality: Causality = Causality.LOCAL
    type: VariableType = VariableType.REAL
    variability: str = "continuous"
    unit: str = ""
    start: StartValue | None = None
    nominal: float = 1.0
    description: str = ""

    @property
    def is_continuous_real(self) -> bool:
        """True for what takes part in extrapolation and in the error norm."""
        return self.type is VariableType.REAL and self.variability == "continuous"


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What a slave declares that it can do (FMI 2.0, section 4.3.1).

    Attributes:
        outputs_follow_inputs: outputs read after ``set_inputs``, without a step in between, belong
            to the new inputs. FMI 2.0 does not let a master ask for that (section 4.2.4), so an
            FMU has it only by the word of its user; Python models have it.
    """

    can_get_and_set_state: bool = False
    can_serialize_state: bool = False
    can_interpolate_inputs: bool = False
    max_output_derivative_order: int = 0
    can_handle_variable_step_size: bool = False
    outputs_follow_inputs: bool = False


@dataclass(frozen=True, slots=True)
class SlaveDescription:
    """All static information on a slave that a master needs.

    Attributes:
        model: model name.
        kind: ``FMI 2.0 co-simulation`` or ``Python model``.
        sha256: of the FMU file or of the Python source, hexadecimal.
        variables: all of them, in the order of the model description.
        feed_through: for each output the inputs on which it depends directly, at a
            communication point (ModelStructure/Outputs); outputs not named depend on none.
        initial_feed_through: the same in initialization mode (ModelStructure/InitialUnknowns).
        state_kind: how its state is saved: ``native`` or ``none``.
    """

    model: str
    kind: str
    variables: tuple[Variable, ...]
    capabilities: Capabilities = Capabilities()
    feed_through: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    initial_feed_through: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    state_kind: str = "none"
    sha256: str = ""
    guid: str = ""
    generation_tool: str = ""

    def variable(self, name: str) -> Variable:
        """The variable of that name; KeyError if there is none."""
        for variable in self.variables:
            if variable.name == name:
                return variable
        raise KeyError(name)

    def of(self, causality: Causality) -> tuple[Variable, ...]:
        """The variables of one causality, in order."""
        return tuple(v for v in self.variables if v.causality is causality)


class StepStatus(StrEnum):
    """How a do_step ended when it raised nothing."""

    OK = "ok"
    DISCARD = "discard"
    TERMINATED = "terminated"


class Slave(ABC):
    """One co-simulation slave, in the process that holds it. Not thread-safe.

    Call order: ``life_cycle.py``. Any method may raise `SlaveError`; after a `StepRejectedError`
    or a discarded step only ``set_state``, ``reset`` and ``terminate`` are meaningful.
    Saved states are opaque to the caller; what ``get_state`` returned stays valid until it is
    passed to ``free_state`` or the slave is reset, and may be restored any number of times.
    """

    description: SlaveDescription

    @abstractmethod
    def initialize(
        self,
        *,
        start_time: float,
        stop_time: float | None,
        relative_tolerance: float | None,
        start_values: Mapping[str, StartValue],
        inputs: Sequence[str],
        outputs: Sequence[str],
    ) -> None:
        """Set up the experiment, set start values, enter initialization mode.

        ``inputs`` and ``outputs`` fix the order of the columns of all arrays that follow.
        """

    @abstractmethod
    def exit_initialization_mode(self) -> None:
        """Leave initialization mode: the slave stands at its first communication point."""

    @abstractmethod
    def set_inputs(self, derivatives: FloatArray) -> None:
        """Set the inputs from here on: shape (k + 1, n_u), see `InputSignal`."""

    @abstractmethod
    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """Step from ``communication_point`` by ``step_size`` [s].

        Returns the status and the time reached: the end of the step, or on ``DISCARD`` the last
        successful time (NaN when the slave does not tell).
        """

    @abstractmethod
    def get_outputs(self, order: int) -> FloatArray:
        """Outputs and their derivatives up to ``order``: shape (order + 1, n_y), [y]/s^j."""

    @abstractmethod
    def get_state(self) -> object:
        """Save the state."""

    @abstractmethod
    def set_state(self, state: object) -> None:
        """Go back to a saved state."""

    @abstractmethod
    def free_state(self, state: object) -> None:
        """Give up a saved state."""

    @abstractmethod
    def serialize_state(self, state: object) -> bytes:
        """A saved state as bytes."""

    @abstractmethod
    def deserialize_state(self, data: bytes) -> object:
        """A saved state from bytes that ``serialize_state`` of the same model gave."""

    @abstractmethod
    def terminate(self) -> None:
        """End the simulation; outputs may still be read."""

    @abstractmethod
    def reset(self) -> None:
        """Back to the state after instantiation."""

    @abstractmethod
    def close(self) -> None:
        """Free the instance and all that belongs to it. Idempotent."""


class CallExecutor(Protocol):
    """Runs a list of calls on the slave that it holds, and never raises but for a defect."""

    @property
    def description(self) -> SlaveDescription:
        """Of the slave."""
        ...

    def execute(self, calls: Sequence[Call]) -> Reply:
        """Run the calls in order; the reply says how far it got."""
        ...

    def close(self) -> None:
        """Free the slave. Idempotent."""
        ...
