"""Tables of a system file beside ``[simulation]``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    StrictBool,
    StrictInt,
    StrictStr,
    Tag,
    ValidationInfo,
    field_serializer,
    field_validator,
    model_validator,
)

from master_node.system.fields import (
    AgentName,
    FiniteScalar,
    Formats,
    FrozenTable,
    Labels,
    MappingEntries,
    NotNegative,
    Number,
    Pattern,
    Patterns,
    Positive,
    Reference,
    Sha256,
    Value,
    Wait,
    mapping_entries,
)
from protocol.text.references import split_reference
from protocol.wire.administration import DEFAULT_LOAD_TIMEOUT


class OutputTolerance(FrozenTable):
    """Tolerances of one output; what is not given comes from the slave or the simulation."""

    relative: NotNegative | None = None
    absolute: Positive | None = None


class SlaveSettings(FrozenTable):
    """A ``[slaves.NAME]`` table.

    Attributes:
        model: an ``.fmu`` file, ``package.module:Class`` or ``file.py:Class``, relative to the
            system file; without it the slave is looked for on the bus, by name.
        sha256: that the model's file must have, hexadecimal.
        host: name of the agent that starts the slave; None: any that has what is required.
        requires: labels of the agent that starts the slave; without both the master starts it.
        parameters: start values of parameters and other variables, by name.
        relative_tolerance, absolute_tolerance: for this slave's outputs.
        tolerances: for single outputs, by name.
        step_size: the only communication step size that it takes [s].
        step_multiple: each of its communication steps must be a multiple of this [s].
        smallest_step_size, largest_step_size: bounds of its communication steps [s].
        outputs_follow_inputs: whether its outputs can be read again after inputs were set, without
            a step in between (FMI 2.0 does not promise it); default: what is known of its kind.
        input_substeps: into how many substeps its node splits each step, with constant inputs in
            each, to follow polynomial inputs; 1: the inputs are constant in each step; 0: input
            derivatives where the model takes them, else as many substeps as the accuracy needs.
        largest_substep: its node splits steps so that no step of the model is longer [s].
        state: how its state is saved; default: the best way that the model and its host allow.
        output_derivatives: names of the outputs whose derivatives may be used; default: of all,
            where the model gives any.
        uncontrolled: names of the outputs that do not count in ERR.
        ignore_bounds: take values beyond the ``min`` and ``max`` of its variables, and numbers that
            no item of an enumeration has.
        fmi_logging: patterns of the log categories of its FMU that are written to its log, such as
            ``["*"]``; default: those of warnings and errors.
    """

    model: StrictStr | None = None
    sha256: Sha256 | None = None
    host: AgentName | None = None
    requires: Labels = Field(default_factory=dict)
    parameters: Mapping[str, Value] = Field(default_factory=dict)
    relative_tolerance: NotNegative | None = None
    absolute_tolerance: Positive | None = None
    tolerances: Mapping[str, OutputTolerance] = Field(default_factory=dict)
    step_size: Positive | None = None
    step_multiple: Positive | None = None
    smallest_step_size: Positive | None = None
    largest_step_size: Positive | None = None
    outputs_follow_inputs: StrictBool | None = None
    input_substeps: Annotated[StrictInt, Field(ge=0, le=10_000)] = 0
    largest_substep: Positive | None = None
    state: Literal["native", "fork", "replay", "none"] | None = None
    output_derivatives: tuple[StrictStr, ...] | None = None
    uncontrolled: tuple[StrictStr, ...] = ()
    ignore_bounds: StrictBool = False
    fmi_logging: tuple[StrictStr, ...] = ()

    @model_validator(mode="after")
    def _agent_needs_model(self) -> Self:
        if self.needs_agent and self.model is None:
            raise ValueError("an agent that starts the slave has to know its model")
        return self

    @property
    def needs_agent(self) -> bool:
        """True if an agent has to start it."""
        return self.host is not None or bool(self.requires)


class Connection(FrozenTable):
    """A ``[[connections]]`` table: ``from = "slave.output"``, ``to = "slave.input"``.

    Attributes:
        factor, offset: input = factor * output + offset, in place of a conversion of units.
        ignore_units: hand the value on as it is, whatever the units.
        mapping: what becomes of single values of an output that is a boolean, an integer or an
            enumeration; others are handed on as they are. All are booleans, or integers and items.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    source: Reference = Field(alias="from")
    target: Reference = Field(alias="to")
    factor: Number | None = None
    offset: Number | None = None
    ignore_units: StrictBool = False
    mapping: MappingEntries | None = None

    @field_validator("mapping", mode="plain")
    @classmethod
    def _entries(cls, value: Any, info: ValidationInfo) -> MappingEntries | None:
        beside = [key for key in ("factor", "offset", "ignore_units") if info.data.get(key)]
        if value is not None and beside:
            raise ValueError(f"cannot stand beside {beside[0]}")
        return None if value is None else mapping_entries(value)

    @field_serializer("mapping")
    def _as_table(self, value: MappingEntries | None) -> dict[str, int | str] | None:
        if value is None:
            return None
        return {key if isinstance(key, str) else str(key).lower(): v for key, v in value.items()}

    @model_validator(mode="before")
    @classmethod
    def _from_pair(cls, value: Any) -> Any:
        if isinstance(value, tuple) and len(value) == 2:
            return {"from": value[0], "to": value[1]}
        return value


class Action(FrozenTable):
    """An ``[[actions]]`` table: what a run does by itself at a point in time.

    Attributes:
        at: time of the action, which becomes a communication point [s].
        set: values of tunable parameters and of inputs that nothing drives, by ``slave.variable``.
        override: values of connected inputs, which are cut from their sources.
        release: overridden inputs that follow their sources again.
        stop: end the run there.
    """

    at: Number
    set: Mapping[Reference, Value] = Field(default_factory=dict)
    override: Mapping[Reference, Value] = Field(default_factory=dict)
    release: tuple[Reference, ...] = ()
    stop: StrictBool = False

    @model_validator(mode="after")
    def _does_something(self) -> Self:
        if not (self.set or self.override or self.release or self.stop):
            raise ValueError("say what to do: set, override, release or stop")
        return self

    def __str__(self) -> str:
        changes = {"set": listed_values(self.set), "release": ", ".join(self.release)}
        changes |= {"override": listed_values(self.override), "stop": "the run" * self.stop}
        return "; ".join(f"{verb} {what}" for verb, what in changes.items() if what)


def listed_values(values: Mapping[str, Any]) -> str:
    """Values of variables in words."""
    return ", ".join(f"{name} = {value!r}" for name, value in values.items())


class InputRows:
    """A table of an input as arrays.

    Attributes:
        times: [s].
        values: at these times, of the same shape (n,); of a ``hold`` table for a discrete input
            also booleans or texts.
    """

    def __init__(self, times: Any, values: Any) -> None:
        try:
            self.times = np.array(times, dtype=float)
            self.values = np.array(values)
        except (TypeError, ValueError):
            raise ValueError("write two arrays, times and values") from None
        if self.values.dtype.kind not in "fiubU":
            raise ValueError("write two arrays, times and values: numbers, booleans or texts")
        if self.times.ndim != 1 or self.times.shape != self.values.shape:
            raise ValueError(
                f"times of shape {self.times.shape} and values of shape {self.values.shape} are "
                "not two rows of the same length"
            )

    def __str__(self) -> str:
        return f"{len(self.times)} rows"


class InputSettings(FrozenTable):
    """Signal of an input in ``[inputs]`` that is no constant: a table or a function.

    Attributes:
        table: a file ``.csv``, ``.npy`` or ``.npz``, relative to the system file; in Python also
            times and values, two arrays.
        column: of the values; needed where a table has more than one beside the times.
        time: column of the times [s]; default: the first one.
        interpolation: between the rows.
        extrapolate: what holds where the rows do not cover the simulated time; default: an error.
        function: ``package.module:name`` or ``file.py:name``, relative to the system file, of the
            time [s]; in Python also the function itself.
        breakpoints: times at which the function jumps or has a kink [s].
        order: highest degree of the polynomials that stand for the function.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    table: StrictStr | InputRows | None = None
    column: StrictStr | None = None
    time: StrictStr | None = None
    interpolation: Literal["linear", "hold", "spline"] = "linear"
    extrapolate: Literal["hold"] | None = None
    function: StrictStr | Callable[[float], Any] | None = None
    breakpoints: tuple[Number, ...] = ()
    order: Literal[0, 1, 2, 3] = 3

    @field_validator("table", mode="before")
    @classmethod
    def _rows(cls, value: Any) -> Any:
        if isinstance(value, tuple | list) and len(value) == 2:
            return InputRows(*value)
        return value

    @field_validator("order", mode="before")
    @classmethod
    def _whole_number(cls, value: Any) -> Any:
        if isinstance(value, bool):
            raise ValueError("must be a whole number")  # noqa: TRY004  pydantic wants ValueError
        return value

    def file(self, base: Path) -> str | None:
        """File that it reads: a table, or a Python file with the function, relative to ``base``.

        None where it comes out of a package or from Python, or is not there.
        """
        name: object = self.table
        if isinstance(self.function, str):
            name = (split_reference(self.function) or ("",))[0]
        return name if isinstance(name, str) and (base / name).is_file() else None

    @field_serializer("table", "function")
    def _in_words(self, value: Any) -> str | None:
        """For ``summary.json``: files and functions by name."""
        if callable(value):
            module = getattr(value, "__module__", None) or type(value).__module__
            return f"{module}:{getattr(value, '__qualname__', type(value).__qualname__)}"
        return None if value is None else str(value)

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if (self.table is None) == (self.function is None):
            raise ValueError("give either table or function")
        given = self.model_fields_set
        of_tables = {"column", "time", "interpolation", "extrapolate"}
        of_functions = {"breakpoints", "order"}
        is_table = self.table is not None
        for key in sorted(given & (of_functions if is_table else of_tables)):
            kinds = ("functions", "table") if is_table else ("tables", "function")
            raise ValueError(f"{key} is for {kinds[0]}, and this is a {kinds[1]}")
        return self


def _kind_of_input(value: Any) -> str:
    return "input-value" if isinstance(value, bool | int | float | str) else "input-settings"


def _as_settings(value: Any) -> Any:
    """A function or two arrays, given in Python, as a table of settings."""
    if callable(value):
        return {"function": value}
    return {"table": value} if isinstance(value, tuple) else value


InputValue = Annotated[
    Annotated[FiniteScalar, Tag("input-value")]
    | Annotated[InputSettings, BeforeValidator(_as_settings), Tag("input-settings")],
    Discriminator(_kind_of_input),
]
"""A constant, or a signal over time."""


class BusSettings(FrozenTable):
    """The ``[bus]`` table.

    Attributes:
        mode: ``peer``: connected to each slave; ``client``: connected to a router, as all slaves.
        listen: where slaves that are not started by this master can connect to; default: the
            loopback port 7447 when there are such slaves and nothing to connect to.
        connect: slaves that listen, or the router; default of a client: the loopback port 7447.
        insecure: allow addresses other than loopback without TLS.
        tls: directory with certificates, relative to the system file; None: no TLS.
        discovery_timeout: how long to wait for slaves and agents that are not started here [s].
        load_timeout: how long a model may take to be loaded, loaded anew or reset [s].
        initialization_timeout: how long a request in initialization mode may take [s].
        step_timeout: how long a request of up to three do_steps may take [s].
        reconnect_time: how long to wait in mid run for a slave whose connection was lost [s].
        pin: keep the node and the worker of each launched slave on one processor, so that a
            request is handed over without waking another one. For small models; a model with
            threads of its own would have only that processor.
    """

    mode: Literal["peer", "client"] = "peer"
    listen: tuple[StrictStr, ...] = ()
    connect: tuple[StrictStr, ...] = ()
    insecure: StrictBool = False
    tls: StrictStr | None = None
    discovery_timeout: Wait = 30.0
    load_timeout: Wait = DEFAULT_LOAD_TIMEOUT
    initialization_timeout: Wait = 600.0
    step_timeout: Wait = 60.0
    reconnect_time: Annotated[Number, Field(gt=0, le=3000)] = 10.0
    pin: StrictBool = False


class ResultsSettings(FrozenTable):
    """The ``[results]`` table.

    Attributes:
        variables: patterns for ``slave.variable`` of outputs; those that begin with ``!`` leave
            out. One without a wildcard may name any variable.
        locals: the same for variables that are no outputs: locals, parameters and inputs.
        every: of the points after the first each ``every``-th is a result, and the last.
        formats: of the result files.
    """

    variables: Patterns = ("*",)
    locals: tuple[Pattern, ...] = ()
    every: Annotated[StrictInt, Field(ge=1)] = 1
    formats: Formats = ("csv",)
