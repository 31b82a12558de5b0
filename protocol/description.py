"""Description of a slave: all that a master knows of it before it steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from protocol.variables import Causality, Unit, Variable


class StateKind(StrEnum):
    """Kind of saved state: how the state of a slave is saved and restored.

    ``NATIVE``: by the model itself. ``FORK``: the process that holds the model forks, and the copy
    stays frozen as the saved state. ``REPLAY``: the model is reset and everything since its
    instantiation done again. ``NONE``: not at all.
    """

    NATIVE = "native"
    FORK = "fork"
    REPLAY = "replay"
    NONE = "none"


class InputDerivatives(StrEnum):
    """Way in which a slave follows polynomial inputs.

    ``NATIVE``: the model takes derivatives. ``EMULATED``: its slave node splits each step into
    substeps, with inputs that are constant in each or of the degree that the model takes. ``NONE``:
    inputs are constant in each step.
    """

    NATIVE = "native"
    EMULATED = "emulated"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Capabilities that a slave declares (FMI 2.0, section 4.3.1).

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


@dataclass(frozen=True, slots=True)
class Experiment:
    """DefaultExperiment of a model description; None where it says nothing.

    Attributes:
        start_time, stop_time, step_size: [s].
    """

    start_time: float | None = None
    stop_time: float | None = None
    step_size: float | None = None


class StateVerdict(StrEnum):
    """Verdict of a test of saved states.

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
        poor_derivatives: outputs whose derivatives cannot be used, with the reason in words.
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
