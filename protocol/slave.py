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

import numpy as np

from protocol.calls import Call, RecordedValues, Reply, StepResult
from protocol.errors import SlaveError
from protocol.signals import FloatArray

StartValue = float | int | bool | str | bytes
"""A value of a variable of any type; an enumeration's is its number."""


class Causality(StrEnum):
    """FMI 2.0, section 2.2.7, and FMI 3.0, section 2.4.7.4."""

    STRUCTURAL_PARAMETER = "structuralParameter"
    PARAMETER = "parameter"
    CALCULATED_PARAMETER = "calculatedParameter"
    INPUT = "input"
    OUTPUT = "output"
    LOCAL = "local"
    INDEPENDENT = "independent"


class VariableType(StrEnum):
    """The types of FMI 2.0 and FMI 3.0. Real is Float64 and Integer is Int32 by another name."""

    REAL = "Real"
    INTEGER = "Integer"
    BOOLEAN = "Boolean"
    STRING = "String"
    ENUMERATION = "Enumeration"
    FLOAT32 = "Float32"
    FLOAT64 = "Float64"
    INT8 = "Int8"
    UINT8 = "UInt8"
    INT16 = "Int16"
    UINT16 = "UInt16"
    INT32 = "Int32"
    UINT32 = "UInt32"
    INT64 = "Int64"
    UINT64 = "UInt64"
    BINARY = "Binary"
    CLOCK = "Clock"

    @property
    def is_real(self) -> bool:
        """Whether its values are floating-point numbers."""
        return self in _REAL_TYPES

    @property
    def integer_range(self) -> tuple[int, int] | None:
        """The smallest and the largest value of an integer type; None for other types."""
        return _INTEGER_RANGES.get(self)


_REAL_TYPES = frozenset({VariableType.REAL, VariableType.FLOAT32, VariableType.FLOAT64})


def _signed(bits: int) -> tuple[int, int]:
    return -(2 ** (bits - 1)), 2 ** (bits - 1) - 1


_INTEGER_RANGES = {
    VariableType.INTEGER: _signed(32),
    VariableType.ENUMERATION: _signed(64),
    VariableType.INT8: _signed(8),
    VariableType.UINT8: (0, 2**8 - 1),
    VariableType.INT16: _signed(16),
    VariableType.UINT16: (0, 2**16 - 1),
    VariableType.INT32: _signed(32),
    VariableType.UINT32: (0, 2**32 - 1),
    VariableType.INT64: _signed(64),
    VariableType.UINT64: (0, 2**64 - 1),
}


class StateKind(StrEnum):
    """How the state of a slave is saved and restored.

    ``NATIVE``: by the model itself. ``FORK``: the process that holds the model forks, and the copy
    stays frozen as the saved state. ``REPLAY``: the model is reset and everything since its
    instantiation done again. ``NONE``: not at all.
    """

    NATIVE = "native"
    FORK = "fork"
    REPLAY = "replay"
    NONE = "none"


class InputDerivatives(StrEnum):
    """How a slave follows polynomial inputs.

    ``NATIVE``: the model takes derivatives. ``EMULATED``: its slave node splits each step into
    substeps, with inputs that are constant in each or of the degree that the model takes. ``NONE``:
    inputs are constant in each step.
    """

    NATIVE = "native"
    EMULATED = "emulated"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit in terms of SI base units: value_SI = factor * value + offset (FMI 2.0, 2.2.2).

    Attributes:
        exponents: of kg, m, s, A, K, mol, cd, rad.
        factor, offset: see above.
    """

    exponents: tuple[int, ...] = (0, 0, 0, 0, 0, 0, 0, 0)
    factor: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, slots=True)
class Variable:
    """A scalar variable of a slave, in FMI's words.

    The elements of an array are variables of their own, named ``array[i,j]`` with indices from 1.

    Attributes:
        name: unique within the slave.
        unit: unit name as declared, "" if none.
        start: start value, None if the model gives none.
        nominal: nominal value, in ``unit``; scales the absolute tolerance.
        minimum, maximum: smallest and largest value [``unit``]; None: no bound is declared.
        items: of an enumeration: the number of each item by its name; empty for other types.
    """

    name: str
    causality: Causality = Causality.LOCAL
    type: VariableType = VariableType.REAL
    variability: str = "continuous"
    unit: str = ""
    start: StartValue | None = None
    nominal: float = 1.0
    description: str = ""
    minimum: float | int | None = None
    maximum: float | int | None = None
    items: Mapping[str, int] = field(default_factory=dict, hash=False)

    @property
    def has_bounds(self) -> bool:
        """True if values are declared that it must not have."""
        return bool(self.items) or self.minimum is not None or self.maximum is not None

    @property
    def is_continuous_real(self) -> bool:
        """True for what takes part in extrapolation and in the error norm."""
        return self.type.is_real and self.variability == "continuous"

    @property
    def is_discrete(self) -> bool:
        """True for what is held between communication points; clocks carry no value."""
        return not self.is_continuous_real and self.type is not VariableType.CLOCK


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What a slave declares that it can do (FMI 2.0, section 4.3.1).

    Attributes:
        outputs_follow_inputs: outputs read after ``set_inputs``, without a step in between, belong
            to the new inputs. FMI 2.0 does not let a master ask for that (section 4.2.4), so a
            co-simulation FMU has it only by the word of its user; model exchange and Python models
            have it.
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
        kind: such as ``FMI 2.0 co-simulation``, ``FMI 3.0 model exchange`` or ``Python model``.
        sha256: of the FMU file or of the Python source, hexadecimal.
        variables: all of them, in the order of the model description.
        feed_through: for each output the inputs on which it depends directly, at a
            communication point (ModelStructure/Outputs); outputs not named depend on none. Also
            for local variables of which that is known, see `direct_inputs`.
        initial_feed_through: the same in initialization mode (ModelStructure/InitialUnknowns).
        state_kind: how its state is saved.
        state_reason: why it is not saved natively; "" if it is.
        input_derivatives: how it follows polynomial inputs.
        fixed_step_size: the only step size that the model takes [s]; its node makes a
            communication step of a whole number of them. None: any.
        default_step_size: that the model recommends [s]; None: it does not.
        units: definitions of the units of its variables, by name; a unit that is not among them
            is only a name.
        remarks: on what of the model is not carried, for the user.
    """

    model: str
    kind: str
    variables: tuple[Variable, ...]
    capabilities: Capabilities = Capabilities()
    feed_through: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    initial_feed_through: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    state_kind: StateKind = StateKind.NONE
    state_reason: str = ""
    input_derivatives: InputDerivatives = InputDerivatives.NONE
    fixed_step_size: float | None = None
    default_step_size: float | None = None
    units: Mapping[str, Unit] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    sha256: str = ""
    guid: str = ""
    generation_tool: str = ""

    def variable(self, name: str) -> Variable:
        """The variable of that name; KeyError if there is none."""
        for variable in self.variables:
            if variable.name == name:
                return variable
        raise KeyError(name)

    def direct_inputs(self, variable: Variable, *, initially: bool = False) -> tuple[str, ...]:
        """The inputs on which a variable depends directly.

        Args:
            variable: an output, or another one; what is not known of a local variable counts as
                depending on all inputs.
            initially: in initialization mode.
        """
        depends = self.initial_feed_through if initially else self.feed_through
        if variable.name not in depends and variable.causality is Causality.LOCAL:
            return tuple(v.name for v in self.of(Causality.INPUT))
        return depends.get(variable.name, ())

    def of(self, causality: Causality) -> tuple[Variable, ...]:
        """The variables of one causality, in order."""
        return tuple(v for v in self.variables if v.causality is causality)


class StepStatus(StrEnum):
    """How a do_step ended when it raised nothing.

    ``EARLY_RETURN``: the slave stands at an event within the step (FMI 3.0, section 4.2.1.2.1).
    """

    OK = "ok"
    DISCARD = "discard"
    EARLY_RETURN = "early_return"
    TERMINATED = "terminated"


class StateVerdict(StrEnum):
    """What a test of saved states showed.

    ``EXACT``: bit for bit as without. ``RESTARTS_SOLVER``: steps after a restore repeat, but differ
    from those without, within the tolerance, because the model's solver starts anew.
    ``DOES_NOT_RESTORE``: they differ by more. ``DOES_NOT_REPEAT``: steps after a restore differ
    from each other. ``BROKEN``: a call failed. ``NOT_TESTED``: no state is saved, or nothing can be
    said before something else is settled.
    """

    EXACT = "exact"
    RESTARTS_SOLVER = "restarts solver"
    DOES_NOT_RESTORE = "does not restore"
    DOES_NOT_REPEAT = "does not repeat"
    BROKEN = "broken"
    NOT_TESTED = "not tested"


@dataclass(frozen=True, slots=True)
class Examination:
    """Findings of the trial steps of a slave.

    Attributes:
        state_verdict: whether its saved states can be trusted.
        state_reason: what was seen, in words.
        has_moved: whether the slave need not stand where it stood before.
        difference: largest difference of an output after a restore from the same step without one,
            relative to the output or its nominal value.
        internal_clock: the outputs move only at multiples of this [s]; None: no such clock.
        step_dependence: how much a step of 2h differs from two of h, weighted by the tolerance:
            far above 1 if the model takes one step of its own in each do_step.
        largest_substep: steps of the model up to this keep that difference within `SUBSTEP_ERROR`
            of the tolerance [s]; None: there is no need.
        input_order: highest order of input derivatives that it takes; None: all that were tried.
        input_refusal: why it takes no higher ones; "" if it does. Nothing else was tried then.
        not_repeating: outputs that no other slave depends on, and that were others each time the
            same step was taken, or by each step however short, such as clocks and counters. Unless
            all of them were known before, nothing else was tried.
        poor_derivatives: outputs whose derivatives are of no use, with the reason in words.
        not_tried: what was left out because steps take long, in words.
    """

    state_verdict: StateVerdict = StateVerdict.NOT_TESTED
    state_reason: str = ""
    has_moved: bool = False
    difference: float = 0.0
    internal_clock: float | None = None
    step_dependence: float = 0.0
    largest_substep: float | None = None
    input_order: int | None = None
    input_refusal: str = ""
    not_repeating: tuple[str, ...] = ()
    poor_derivatives: Mapping[str, str] = field(default_factory=dict)
    not_tried: str = ""


SUBSTEP_ERROR = 0.1
"""Part of the tolerance for the error of one substep: those of a communication step add up."""


class Slave(ABC):
    """One co-simulation slave, in the process that holds it. Not thread-safe.

    Call order: ``life_cycle.py``, also for what is left after an error (state *error*) and after a
    step that was not completed (*step failed*). Any method may raise `SlaveError`.
    Saved states are opaque to the caller; what ``get_state`` returned stays valid until it is
    passed to ``free_state`` or the slave is reset, and may be restored any number of times.

    Continuous Real variables that are connected go through ``set_inputs`` and ``get_outputs``, all
    others through ``set_discrete_inputs`` and ``get_discrete_outputs``.
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
        discrete_inputs: Sequence[str] = (),
        discrete_outputs: Sequence[str] = (),
        early_return: bool = False,
    ) -> None:
        """Set up the experiment, set start values, enter initialization mode.

        ``inputs`` and ``outputs`` fix the order of the columns of all arrays that follow,
        ``discrete_inputs`` and ``discrete_outputs`` that of the values of other types.
        ``early_return``: do_step may end at an event within the step, with ``EARLY_RETURN``.
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

    def set_discrete_inputs(self, values: Sequence[StartValue]) -> None:
        """Set the discrete inputs from here on, one value for each."""
        if values:
            raise SlaveError(f"{self.description.model} has no discrete inputs")

    def get_discrete_outputs(self) -> tuple[StartValue, ...]:
        """The discrete outputs, one value for each."""
        return ()

    def record(self, names: Sequence[str]) -> None:
        """Fix the variables of `get_recorded_variables`, right before ``initialize``.

        They may have any causality; to read them changes nothing of what the slave does.
        """
        if names:
            raise SlaveError(f"{self.description.model} has no variables to record: {[*names]}")

    def get_recorded_variables(self) -> RecordedValues:
        """Their values as they are, finite or not."""
        return RecordedValues(np.zeros((1, 0)), ())

    @abstractmethod
    def get_state(self) -> object:
        """Save the state."""

    @abstractmethod
    def set_state(self, state: object) -> None:
        """Go back to a saved state."""

    def set_state_and_free(self, state: object) -> None:
        """Go back to a saved state and give it up with that."""
        self.set_state(state)
        self.free_state(state)

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


def refuse_discrete(
    description: SlaveDescription, inputs: Sequence[str], outputs: Sequence[str]
) -> None:
    """For a slave that has no discrete variables.

    Raises:
        SlaveError: some were asked for.
    """
    if inputs or outputs:
        raise SlaveError(f"{description.model} has no discrete variables {[*inputs, *outputs]}")


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
