"""The vocabulary: FMI's verbs as frozen dataclasses, and the reply to a list of them.

A request is a short program: a list of these calls that a slave executes in order. Saved states
are named by the caller with small integers, so that a program can save a state and go back to it
without a round trip in between.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from protocol.signals import MAX_ORDER, FloatArray

if TYPE_CHECKING:
    from protocol.errors import DoublestepError
    from protocol.variables import StartValue


@dataclass(frozen=True, slots=True)
class Describe:
    """Ask for the `SlaveDescription`. Result: `SlaveDescription`."""

    verb: ClassVar[str] = "describe"


@dataclass(frozen=True, slots=True)
class Configure:
    """Load the model anew, as it is to be run. Result: the `SlaveDescription` that holds now.

    Attributes:
        state_kind: how to save its state, a `StateKind`; "": the best way that it allows.
        structural_parameters: by variable name; set in FMI 3's configuration mode.
        largest_substep: steps of the model are at most this long [s]; longer communication steps
            are split. None: they are not.
        input_substeps: into how many substeps a communication step is split where polynomial
            inputs are emulated; 0: as many as the accuracy needs.
        max_input_order: highest order of input derivatives that the model is to be given, where it
            takes any: polynomials of higher degree are emulated with pieces of this degree.
        not_repeating: names of outputs that do not repeat, such as clocks: what they give is
            compared with nothing.
        log_categories: patterns of the log categories that an FMU is asked for; empty: those of
            warnings and errors.
    """

    verb: ClassVar[str] = "configure"
    state_kind: str = ""
    structural_parameters: Mapping[str, StartValue] = field(default_factory=dict)
    largest_substep: float | None = None
    input_substeps: int = 0
    max_input_order: int = MAX_ORDER
    not_repeating: tuple[str, ...] = ()
    log_categories: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Initialize:
    """fmi2SetupExperiment, start values, fmi2EnterInitializationMode. Result: None.

    Attributes:
        start_time: first communication point [s].
        stop_time: last one [s], None if open.
        relative_tolerance: for the slave's own solver, None for its default.
        start_values: by variable name, parameters and others.
        inputs: names of the inputs that the master will set, in the order of `SetInputs`.
        outputs: names of the outputs that the master will read, in the order of `GetOutputs`.
        discrete_inputs: the same for `SetDiscreteInputs`.
        discrete_outputs: the same for `GetDiscreteOutputs`.
        early_return: whether a step may end at an event within it.
        recorded: names of the variables that are read for results only, see
            `GetRecordedVariables`.
    """

    verb: ClassVar[str] = "initialize"
    start_time: float = 0.0
    stop_time: float | None = None
    relative_tolerance: float | None = None
    start_values: Mapping[str, StartValue] = field(default_factory=dict)
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    discrete_inputs: tuple[str, ...] = ()
    discrete_outputs: tuple[str, ...] = ()
    early_return: bool = False
    recorded: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ExitInitializationMode:
    """fmi2ExitInitializationMode. Result: None."""

    verb: ClassVar[str] = "exit_initialization_mode"


@dataclass(frozen=True, slots=True)
class Examine:
    """Take trial steps and go back: can the slave be trusted? Result: `Examination`.

    Where the answer says that it has moved, the slave need not stand where it stood: reset it then.

    Attributes:
        communication_point: where the slave stands [s].
        step_size: of the trial steps that show whether saved states can be trusted [s].
        relative_tolerance, absolute_tolerance: of the coupling; weights for differences.
        largest_step: no trial step is longer [s]; None: 32 of ``step_size``.
        smallest_step: no trial step is shorter [s].
        inputs: values of the continuous inputs, in the order of `SetInputs`; empty: they stay.
        input_changes: by how much each of them may be moved in a trial step.
        input_order: highest order of input derivatives to try.
        output_derivatives: whether those of the outputs are of interest.
        connected: names of the outputs on which other slaves depend.
        not_repeating: names of outputs that are known not to repeat, see `Configure`.
    """

    verb: ClassVar[str] = "examine"
    communication_point: float
    step_size: float
    relative_tolerance: float = 1e-4
    absolute_tolerance: float = 1e-4
    largest_step: float | None = None
    smallest_step: float = 0.0
    inputs: tuple[float, ...] = ()
    input_changes: tuple[float, ...] = ()
    input_order: int = 0
    output_derivatives: bool = True
    connected: tuple[str, ...] = ()
    not_repeating: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SetInputs:
    """Input values and derivatives at the current communication point. Result: None.

    Attributes:
        derivatives: shape (k + 1, n_u), k in 0 to 3; row j is d^j u / dt^j, unit [u]/s^j.
    """

    verb: ClassVar[str] = "set_inputs"
    derivatives: FloatArray


@dataclass(frozen=True, slots=True)
class SetDiscreteInputs:
    """Values of the discrete inputs from the current communication point on. Result: None."""

    verb: ClassVar[str] = "set_discrete_inputs"
    values: tuple[StartValue, ...]


@dataclass(frozen=True, slots=True)
class SetValues:
    """Values of tunable parameters and of inputs that are not set otherwise, from here on.

    Result: None.

    Attributes:
        values: by variable name.
    """

    verb: ClassVar[str] = "set_values"
    values: Mapping[str, StartValue]


@dataclass(frozen=True, slots=True)
class DoStep:
    """fmi2DoStep. Result: `StepResult`. Anything but ``ok`` ends the program there.

    Attributes:
        communication_point: where the slave stands [s].
        step_size: communication step size H [s].
        no_set_state_prior: noSetFMUStatePriorToCurrentPoint: no state older than
            ``communication_point`` will be restored any more.
    """

    verb: ClassVar[str] = "do_step"
    communication_point: float
    step_size: float
    no_set_state_prior: bool = False


@dataclass(frozen=True, slots=True)
class GetOutputs:
    """Outputs and their derivatives up to ``order``. Result: shape (order + 1, n_y)."""

    verb: ClassVar[str] = "get_outputs"
    order: int = 0


@dataclass(frozen=True, slots=True)
class GetDiscreteOutputs:
    """Values of the discrete outputs. Result: a tuple of them."""

    verb: ClassVar[str] = "get_discrete_outputs"


@dataclass(frozen=True, slots=True)
class GetRecordedVariables:
    """Values of the variables that are read for results only. Result: `RecordedValues`."""

    verb: ClassVar[str] = "get_recorded_variables"


@dataclass(frozen=True, slots=True)
class GetState:
    """fmi2GetFMUstate: save the state under the number ``state``. Result: None.

    A state that was saved under that number before is freed.
    """

    verb: ClassVar[str] = "get_state"
    state: int


@dataclass(frozen=True, slots=True)
class SetState:
    """fmi2SetFMUstate: go back to the saved state ``state``. Result: None.

    It stays saved, unless ``free``.
    """

    verb: ClassVar[str] = "set_state"
    state: int
    free: bool = False


@dataclass(frozen=True, slots=True)
class FreeState:
    """fmi2FreeFMUstate: give up the saved state ``state``. Result: None."""

    verb: ClassVar[str] = "free_state"
    state: int


@dataclass(frozen=True, slots=True)
class SerializeState:
    """fmi2SerializeFMUstate of the saved state ``state``. Result: bytes."""

    verb: ClassVar[str] = "serialize_state"
    state: int


@dataclass(frozen=True, slots=True)
class DeserializeState:
    """fmi2DeSerializeFMUstate: make ``data`` the saved state ``state``. Result: None.

    A state that was saved under that number before is freed.
    """

    verb: ClassVar[str] = "deserialize_state"
    state: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Terminate:
    """fmi2Terminate. Result: None."""

    verb: ClassVar[str] = "terminate"


@dataclass(frozen=True, slots=True)
class Reset:
    """fmi2Reset: back to the state after instantiation; saved states are freed. Result: None.

    Attributes:
        loads: load the model anew instead, where its own reset is broken.
    """

    verb: ClassVar[str] = "reset"
    loads: bool = False


Call = (
    Describe
    | Configure
    | Initialize
    | ExitInitializationMode
    | Examine
    | SetInputs
    | SetDiscreteInputs
    | SetValues
    | DoStep
    | GetOutputs
    | GetDiscreteOutputs
    | GetRecordedVariables
    | GetState
    | SetState
    | FreeState
    | SerializeState
    | DeserializeState
    | Terminate
    | Reset
)

CALLS: tuple[type[Call], ...] = (
    Describe,
    Configure,
    Initialize,
    ExitInitializationMode,
    Examine,
    SetInputs,
    SetDiscreteInputs,
    SetValues,
    DoStep,
    GetOutputs,
    GetDiscreteOutputs,
    GetRecordedVariables,
    GetState,
    SetState,
    FreeState,
    SerializeState,
    DeserializeState,
    Terminate,
    Reset,
)


class StepStatus(StrEnum):
    """Status of a do_step that raised nothing.

    ``EARLY_RETURN``: the slave stands at an event within the step (FMI 3.0, section 4.2.1.2.1).
    """

    OK = "ok"
    DISCARD = "discard"
    EARLY_RETURN = "early_return"
    TERMINATED = "terminated"


class StepResult(NamedTuple):
    """Result of a `DoStep`.

    Attributes:
        status: ok, discard, early_return or terminated.
        time: where the slave stands [s]; on discard the last successful time, NaN if not told.
    """

    status: StepStatus
    time: float


class RecordedValues(NamedTuple):
    """Values of variables that are read for results only.

    Attributes:
        numbers: of those with a floating-point type, in order, shape (1, n).
        others: of all others, in order.
    """

    numbers: FloatArray
    others: tuple[StartValue, ...]


class ModelWarnings(NamedTuple):
    """Messages and calls of a model with the status Warning, since they were asked for last.

    Attributes:
        number: of them.
        first: text of the first one.
    """

    number: int = 0
    first: str = ""

    def after(self, text: str) -> ModelWarnings:
        """These and one more."""
        return ModelWarnings(self.number + 1, self.first or text)


NO_WARNINGS = ModelWarnings()


class Reply(NamedTuple):
    """Reply to a program of calls.

    Attributes:
        results: one for each call that was executed, in order.
        error: why the next call failed, or None. A step that was not ``ok`` is not an error:
            it is the last result.
        compute_time: seconds that the slave spent on the program, by its monotonic clock.
        warnings: of the model, since the last reply.
    """

    results: list[object]
    error: DoublestepError | None
    compute_time: float
    warnings: ModelWarnings = NO_WARNINGS
