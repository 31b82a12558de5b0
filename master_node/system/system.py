"""System files: TOML into frozen, validated values, before anything starts.

Every message names file, table and key. ``docs/system-file.md`` explains each key to a user.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    StrictBool,
    StrictFloat,
    StrictInt,
    StrictStr,
    Tag,
    ValidationError,
    ValidationInfo,
    field_serializer,
    field_validator,
    model_validator,
)
from pydantic_core import ErrorDetails

from master_node.numerics.dense_output import OutputGrid
from master_node.numerics.extrapolation import InputPolynomial
from master_node.results.formats import FORMATS
from master_node.system.places import SspPlaces, SystemFilePlaces
from master_node.system.toml_files import read_located_tables
from protocol.errors import ConfigurationError
from protocol.signals import MAX_ORDER
from protocol.text.names import nearest
from protocol.wire.administration import DEFAULT_LOAD_TIMEOUT
from protocol.wire.agents import check_label, is_sha256
from protocol.wire.keys import check_name


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("must be finite")
    return value


def _reference(value: str) -> str:
    slave, dot, variable = value.partition(".")
    if not (slave and dot and variable):
        raise ValueError("write slave.variable")
    return value


def _pattern(value: str) -> str:
    if not value.removeprefix("!"):
        raise ValueError("write a pattern for slave.variable")
    return value


def _agent_name(value: str) -> str:
    try:
        return check_name(value, "agent name")
    except ConfigurationError as error:
        raise ValueError(str(error)) from None


def _labels(value: Mapping[str, str]) -> Mapping[str, str]:
    try:
        for name, text in value.items():
            check_label(name, text)
    except ConfigurationError as error:
        raise ValueError(str(error)) from None
    return value


def _sha256(value: str) -> str:
    value = value.lower()
    if not is_sha256(value):
        raise ValueError("write 64 hexadecimal digits")
    return value


def _format(value: str) -> str:
    if value not in FORMATS:
        *names, last = map(repr, FORMATS)
        raise ValueError(f"write {', '.join(names)} or {last}")
    return value


def _not_empty(value: tuple[Any, ...]) -> tuple[Any, ...]:
    if not value:
        raise ValueError("must not be empty")
    return value


MappingEntries = Mapping[bool, bool] | Mapping[int | str, int | str]
"""Values and what becomes of them: booleans, or integers and items of enumerations."""

_BOOLEAN_KEYS = {"true": True, "false": False}


def _mapping(value: Any) -> MappingEntries:
    """The entries of a mapping; keys of TOML are texts."""
    wrong = ValueError(
        "write { false = true, … } or { 1 = 2, … }: booleans, or whole numbers and items of "
        "enumerations"
    )
    if not isinstance(value, Mapping) or not value:
        raise wrong
    entries: dict[Any, Any] = {}
    for key, target in value.items():
        source = _BOOLEAN_KEYS.get(key, key) if isinstance(key, str) else key
        if isinstance(source, str) and re.fullmatch(r"[+-]?[0-9]{1,20}", source):
            source = int(source)
        if source in entries:
            raise ValueError(f"{key} is there twice")
        entries[source] = target
    kinds = {type(entry) for pair in entries.items() for entry in pair}
    if kinds != {bool} and not kinds <= {int, str}:
        raise wrong
    return entries


Number = Annotated[StrictFloat, AfterValidator(_finite)]
Positive = Annotated[Number, Field(gt=0)]
Wait = Annotated[Number, Field(gt=0, le=1e6)]
NotNegative = Annotated[Number, Field(ge=0)]
Reference = Annotated[StrictStr, AfterValidator(_reference)]
Pattern = Annotated[StrictStr, AfterValidator(_pattern)]
Format = Annotated[StrictStr, AfterValidator(_format)]
Scalar = StrictBool | StrictInt | StrictFloat | StrictStr
Value = Scalar | tuple[Scalar, ...] | tuple[tuple[Scalar, ...], ...]
"""A value, or those of an array with one or two dimensions."""


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


_SHORTEST_TIME = 1e-30
_LONGEST_TIME = 1e30
"""Bounds of the simulated time [s]: fifth powers of step sizes have to be numbers."""

_MAX_POINTS = 1e8
"""Largest number of results that may be asked for by their interval."""

_PAPER: Mapping[str, Any] = {
    "order": 1,
    "derivative_points": 0,
    "constants": "paper",
    "controller": "elementary",
    "discontinuities": False,
    "initial_history": "rest",
    "coupling": "explicit",
}
"""Settings that ``preset = "paper"`` stands for; keys that are given beside it win."""


class SimulationSettings(_Table):
    """The ``[simulation]`` table.

    Attributes:
        preset: ``paper``: the method as Schierz, Arnold and Clauß have it: values only, the
            constants of an equidistant history, the elementary controller.
        start_time, stop_time: [s].
        initial_step_size: H_0 [s]; default: chosen by the system. With estimator ``none`` it is
            the step size of the whole run, by default a thousandth of the simulated time.
        order: degree k of the input polynomials, or ``auto``: chosen for each step.
        derivative_points: at how many of the newest points an input polynomial meets the
            derivatives of the outputs too, where slaves have them; default: 0 with a given
            ``order``, up to 2 with ``auto``.
        estimator: EST_Rich, EST_mod or none (a fixed step).
        constants: of the estimators: ``exact`` for the nodes there are, or the ``paper``'s.
        controller: of the step size: ``pi`` or ``elementary``.
        sequence: ``jacobi``: all slaves take a step at once, with extrapolated inputs;
            ``gauss-seidel``: one after the other, with what the earlier ones have found.
        coupling: ``explicit``: inputs are extrapolated; ``implicit``: each double step is iterated
            until its inputs agree with the outputs; ``auto``: that, where the coupling is stiff.
        evaluate_outputs: evaluate outputs with direct feed-through again at each communication
            point, with the inputs that are known there by then.
        discontinuities: find jumps of the coupled variables, step up to them, and cut the history.
        events: times at which something jumps [s]; a communication point is put there and the
            history cut.
        relative_tolerance, absolute_tolerance: RTOL and ATOL of equation (8) for all outputs;
            ATOL counts in units of a variable's nominal value.
        slave_tolerance: relative tolerance for the slaves' own solvers; default 0.01 RTOL.
        alpha, theta_min, theta_max: of the step size controller (the paper, section 3).
        smallest_step_size, largest_step_size: bounds of H [s]; defaults: 1e-9 of the simulated
            time, and half of it.
        initial_history: ``rest``: the system rested before the start, so order k is used from
            the first step; ``none``: the order grows as communication points come in. Default:
            ``none`` where the order is chosen, else ``rest``.
        output_interval: write results at start_time + i output_interval [s], by dense output,
            instead of at the communication points.
        recovery: ``auto``: a slave process that died is started again, restored, and the run goes
            on; ``off``: it ends the run.
        checkpoint_interval: wall-clock time between two checkpoints for ``master-node resume``
            [s]; 0: none are written.
        examine: let the slaves take trial steps before the first step, see ``examinations.py``.
    """

    preset: Literal["paper"] | None = None
    start_time: Number = 0.0
    stop_time: Number | None = None
    initial_step_size: Positive | None = None
    order: Literal[0, 1, 2, 3, "auto"] = "auto"
    derivative_points: Literal[0, 1, 2] | None = None
    estimator: Literal["rich", "mod", "none"] = "mod"
    constants: Literal["exact", "paper"] = "exact"
    controller: Literal["pi", "elementary"] = "pi"
    sequence: Literal["jacobi", "gauss-seidel"] = "jacobi"
    coupling: Literal["auto", "explicit", "implicit"] = "auto"
    evaluate_outputs: StrictBool = False
    discontinuities: StrictBool = True
    events: tuple[Number, ...] = ()
    relative_tolerance: NotNegative = 1e-4
    absolute_tolerance: Positive = 1e-4
    slave_tolerance: Positive | None = None
    alpha: Annotated[Number, Field(gt=0, lt=1)] = 0.85
    theta_min: Annotated[Number, Field(gt=0, lt=1)] = 0.3
    theta_max: Annotated[Number, Field(gt=1)] = 2.0
    smallest_step_size: Positive | None = None
    largest_step_size: Positive | None = None
    initial_history: Literal["rest", "none"] | None = None
    output_interval: Positive | None = None
    recovery: Literal["auto", "off"] = "auto"
    checkpoint_interval: NotNegative = 10.0
    examine: StrictBool = True

    @model_validator(mode="before")
    @classmethod
    def _preset(cls, value: Any) -> Any:
        if isinstance(value, Mapping) and value.get("preset") == "paper":
            return {**_PAPER, **value}
        return value

    @field_validator("order", "derivative_points", mode="before")
    @classmethod
    def _whole_number(cls, value: Any) -> Any:
        if isinstance(value, bool):
            raise ValueError("must be a whole number")  # noqa: TRY004  pydantic wants ValueError
        return value

    @model_validator(mode="after")
    def _polynomials(self) -> Self:
        if self.derivative_points:
            if self.constants == "paper":
                raise ValueError(
                    'constants = "paper" hold for values only: they need derivative_points = 0'
                )
            if self.order != "auto" and self.derivative_points > (self.order + 1) // 2:
                raise ValueError(
                    f"a polynomial of order {self.order} cannot meet derivatives at "
                    f"{self.derivative_points} points"
                )
        if self.events and self.estimator == "none":
            raise ValueError("events need an estimator: without one all steps have one size")
        if self.constants == "paper" and self.sequence == "gauss-seidel":
            raise ValueError('constants = "paper" hold for sequence = "jacobi" only')
        return self

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.stop_time is None:
            return self
        duration = self.stop_time - self.start_time
        if duration <= 0:
            raise ValueError(
                f"stop_time {self.stop_time:g} must be after start_time {self.start_time:g}"
            )
        if not _SHORTEST_TIME <= duration <= _LONGEST_TIME:
            raise ValueError(
                f"{duration:g} s from start_time to stop_time cannot be computed with: between "
                f"{_SHORTEST_TIME:g} and {_LONGEST_TIME:g} s can"
            )
        if self.output_interval is not None and self.output_interval * _MAX_POINTS < duration:
            raise ValueError(
                f"output_interval {self.output_interval:g} gives more than {_MAX_POINTS:g} result "
                "points"
            )
        smallest, initial, largest = self.smallest, self.initial_step_size, self.largest_step_size
        if largest is not None and smallest > largest:
            raise ValueError(
                f"smallest_step_size {smallest:g} is above largest_step_size {largest:g}"
            )
        if initial is not None and initial < smallest:
            raise ValueError(
                f"initial_step_size {initial:g} is below smallest_step_size {smallest:g}"
            )
        if initial is not None and largest is not None and initial > largest:
            raise ValueError(
                f"initial_step_size {initial:g} is above largest_step_size {largest:g}"
            )
        for event in self.events:
            if not self.start_time < event < self.stop_time:
                raise ValueError(f"the event at {event:g} is not between start and stop time")
        return self

    @property
    def end(self) -> float:
        """The stop time [s].

        Raises:
            ConfigurationError: it is not given.
        """
        if self.stop_time is None:
            raise ConfigurationError(
                "[simulation] stop_time is missing", remedy="give it there, or say --stop-time"
            )
        return float(self.stop_time)

    @property
    def step_size(self) -> float:
        """H_0 [s] as given; else a thousandth of the simulated time, within the bounds of H."""
        if self.initial_step_size is not None:
            return float(self.initial_step_size)
        default = max((self.end - self.start_time) * 1e-3, self.smallest_step_size or 0.0)
        return float(min(default, self.largest_step_size or default))

    @property
    def given_step_size(self) -> float | None:
        """H_0 [s], or that of all steps without an estimator; None: chosen at the start."""
        if self.initial_step_size is None and self.estimator != "none":
            return None
        return self.step_size

    @property
    def smallest(self) -> float:
        """Smallest communication step size [s]."""
        return float(
            self.smallest_step_size or min((self.end - self.start_time) * 1e-9, self.step_size)
        )

    @property
    def largest(self) -> float:
        """Largest communication step size [s]; by default two steps, also in decimal digits."""
        if self.largest_step_size:
            return float(self.largest_step_size)
        start, end = float(self.start_time), self.end
        in_decimals = (Fraction(repr(end)) - Fraction(repr(start))) / 2
        return max((end - start) / 2, float(in_decimals))

    @property
    def polynomial(self) -> InputPolynomial:
        """The input polynomials to use, with ``auto`` the highest that may be chosen.

        Without an estimator there is nothing to choose by, so ``auto`` is order 1 then.
        """
        if self.order != "auto":
            return InputPolynomial(self.order, self.derivative_points or 0)
        if self.estimator == "none":
            return InputPolynomial(1, min(self.derivative_points or 0, 1))
        wanted = 2 if self.derivative_points is None else self.derivative_points
        return InputPolynomial(MAX_ORDER, 0 if self.constants == "paper" else wanted)

    @property
    def rests_before_start(self) -> bool:
        """True if the past of the system is that of one at rest."""
        if self.initial_history is not None:
            return self.initial_history == "rest"
        return self.order != "auto" or self.estimator == "none"

    @property
    def output_grid(self) -> OutputGrid | None:
        """Where results are wanted; None: at the communication points."""
        if self.output_interval is None:
            return None
        return OutputGrid(float(self.start_time), float(self.output_interval), self.end)

    @property
    def slave_relative_tolerance(self) -> float | None:
        """For the slaves' own solvers; None leaves them their default."""
        if self.slave_tolerance is not None:
            return float(self.slave_tolerance)
        return 0.01 * self.relative_tolerance if self.relative_tolerance else None


class OutputTolerance(_Table):
    """Tolerances of one output; what is not given comes from the slave or the simulation."""

    relative: NotNegative | None = None
    absolute: Positive | None = None


class SlaveSettings(_Table):
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
    """

    model: StrictStr | None = None
    sha256: Annotated[StrictStr, AfterValidator(_sha256)] | None = None
    host: Annotated[StrictStr, AfterValidator(_agent_name)] | None = None
    requires: Annotated[Mapping[StrictStr, StrictStr], AfterValidator(_labels)] = Field(
        default_factory=dict
    )
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

    @model_validator(mode="after")
    def _agent_needs_model(self) -> Self:
        if self.needs_agent and self.model is None:
            raise ValueError("an agent that starts the slave has to know its model")
        return self

    @property
    def needs_agent(self) -> bool:
        """True if an agent has to start it."""
        return self.host is not None or bool(self.requires)


class Connection(_Table):
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
        return None if value is None else _mapping(value)

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


class InputSettings(_Table):
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
            name = self.function.rpartition(":")[0]
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


def _finite_value(value: Value) -> Value:
    return _finite(value) if isinstance(value, float) else value


InputValue = Annotated[
    Annotated[Scalar, AfterValidator(_finite_value), Tag("input-value")]
    | Annotated[InputSettings, BeforeValidator(_as_settings), Tag("input-settings")],
    Discriminator(_kind_of_input),
]
"""A constant, or a signal over time."""


class BusSettings(_Table):
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


class ResultsSettings(_Table):
    """The ``[results]`` table.

    Attributes:
        variables: patterns for ``slave.variable`` of outputs; those that begin with ``!`` leave
            out. One without a wildcard may name any variable.
        locals: the same for variables that are no outputs: locals, parameters and inputs.
        every: of the points after the first each ``every``-th is a result, and the last.
        formats: of the result files.
    """

    variables: Annotated[tuple[Pattern, ...], AfterValidator(_not_empty)] = ("*",)
    locals: tuple[Pattern, ...] = ()
    every: Annotated[StrictInt, Field(ge=1)] = 1
    formats: Annotated[tuple[Format, ...], AfterValidator(_not_empty)] = ("csv",)


class System(_Table):
    """A whole system: what a system file holds.

    Attributes:
        inputs: what drives inputs from outside, by ``slave.variable``; in Python also functions of
            the time, and tuples of times and values.
        base: directory to which the models' paths are relative; default: the working directory.
        source: what to call this in messages: the file's name.
        places: what to call its parts there.
        unpacked: directory into which packages were unpacked for this time; None: there are none.

    Raises:
        ConfigurationError: a table is wrong; the message has a line for each mistake.
    """

    simulation: SimulationSettings = SimulationSettings()
    slaves: Mapping[str, SlaveSettings]
    connections: tuple[Connection, ...] = ()
    inputs: Mapping[Reference, InputValue] = Field(default_factory=dict)
    results: ResultsSettings = ResultsSettings()
    bus: BusSettings = BusSettings()
    base: Annotated[Path, AfterValidator(Path.absolute)] = Field(
        default_factory=Path.cwd, exclude=True
    )
    source: str = Field(default="the system", exclude=True)
    places: SystemFilePlaces | SspPlaces = Field(SystemFilePlaces("the system"), exclude=True)
    unpacked: Path | None = Field(None, exclude=True)

    def __init__(self, **tables: Any) -> None:
        source = str(tables.get("source", "the system"))
        tables.setdefault("places", SystemFilePlaces(source))
        try:
            super().__init__(**tables)
        except ValidationError as error:
            raise configuration_error(source, error, _known_keys) from None

    @model_validator(mode="after")
    def _names(self) -> Self:
        if not self.slaves:
            raise ValueError("at least one [slaves.NAME] table is needed")
        for name in self.slaves:
            try:
                check_name(name)
            except ConfigurationError as error:
                raise ValueError(str(error)) from None
        return self

    @property
    def certificates(self) -> Path | None:
        """The directory with certificates for TLS."""
        return None if self.bus.tls is None else self.base / self.bus.tls

    def checked(self) -> Self:
        """The system itself, as nothing more can be added to it.

        Raises:
            ConfigurationError: something is still missing.
        """
        if self.simulation.stop_time is None:
            raise ConfigurationError(
                self.places.no_stop_time, remedy="give it there, or say --stop-time"
            )
        return self

    def with_simulation(self, **settings: Any) -> System:
        """System with other simulation settings; None leaves one as it is.

        A preset here wins over single settings of the system, except for a fixed ``order``.
        """
        given = {name: value for name, value in settings.items() if value is not None}
        simulation = self.simulation.model_dump(exclude_unset=True)
        if given.get("preset") == "paper":
            order = self.simulation.order
            simulation |= {**_PAPER, "order": _PAPER["order"] if order == "auto" else order}
        simulation |= given
        return self._with(simulation=simulation)

    def with_parameters(self, parameters: Mapping[str, Value]) -> System:
        """System with other start values, by ``slave.variable``; they win over its own.

        Raises:
            ConfigurationError: there is no such slave, with the nearest names.
        """
        by_length = sorted(self.slaves, key=len, reverse=True)  # names may hold dots
        given: dict[str, dict[str, Value]] = {}
        for reference, value in parameters.items():
            slave = next((name for name in by_length if reference.startswith(f"{name}.")), None)
            if slave is None:
                name = reference.partition(".")[0]
                near = nearest(name, self.slaves)
                raise ConfigurationError(f"{self.source}: {reference!r}: no slave {name!r}{near}")
            given.setdefault(slave, {})[reference[len(slave) + 1 :]] = value
        slaves = {name: slave.model_dump(exclude_unset=True) for name, slave in self.slaves.items()}
        for name, values in given.items():
            slaves[name]["parameters"] = {**self.slaves[name].parameters, **values}
        return self._with(slaves=slaves)

    def with_slave(self, name: str, **settings: Any) -> System:
        """System with other settings of one slave."""
        changed = self.slaves[name].model_dump(exclude_unset=True) | settings
        return self._with(slaves={**self.slaves, name: changed})

    def with_slaves(self, **settings: Any) -> System:
        """System with other settings of all slaves; None leaves one as it is."""
        given = {name: value for name, value in settings.items() if value is not None}
        slaves = {
            name: slave.model_dump(exclude_unset=True) | given
            for name, slave in self.slaves.items()
        }
        return self._with(slaves=slaves)

    def with_bus(self, **settings: Any) -> System:
        """System with other bus settings; None and empty ones leave one as it is."""
        given = {
            name: value
            for name, value in settings.items()
            if value is not None and value is not False and value != ()
        }
        return self._with(bus=self.bus.model_dump(exclude_unset=True) | given)

    def with_results(self, **settings: Any) -> System:
        """System with other results settings; None and empty ones leave one as it is."""
        given = {name: value for name, value in settings.items() if value not in (None, ())}
        return self._with(results=self.results.model_dump(exclude_unset=True) | given)

    def _with(self, **tables: Any) -> System:
        kept = {"simulation", "slaves", "connections", "inputs", "results", "bus"} - tables.keys()
        return System(
            **{name: getattr(self, name) for name in kept},
            **tables,
            base=self.base,
            source=self.source,
            places=self.places,
            unpacked=self.unpacked,
        )


def load_system(path: Path | str) -> System:
    """Read a system file in TOML; `open_system` reads packages too.

    Raises:
        ConfigurationError: it is missing or wrong; the message has a line for each mistake.
    """
    return System(**read_located_tables(Path(path)))


def configuration_error(
    source: str, error: ValidationError, known_keys: Callable[[list[str]], list[str]]
) -> ConfigurationError:
    """The mistakes in a file, a line for each of the first hundred.

    Args:
        source: the file's name.
        error: what pydantic found.
        known_keys: the keys of the table at a place.
    """
    mistakes: dict[tuple[str, ...], ErrorDetails] = {}
    for detail in error.errors():  # one sentence for all branches of a union
        mistakes.setdefault(_place(detail), detail)
    told = list(mistakes.values())[:_SHOWN_MISTAKES]
    sentences = [_sentence(detail, known_keys) for detail in told]
    if len(mistakes) > len(told):
        sentences.append(f"and {len(mistakes) - len(told)} more mistakes")
    return ConfigurationError.of_mistakes([f"{source}: {text}" for text in sentences])


def _place(detail: ErrorDetails) -> tuple[str, ...]:
    return tuple(str(part) for part in detail["loc"] if part not in _UNION_BRANCHES)


def _sentence(detail: ErrorDetails, known_keys: Callable[[list[str]], list[str]]) -> str:
    """One mistake in the words of the file's author."""
    place = list(_place(detail))
    kind = detail["type"]
    if kind == "extra_forbidden":
        *tables, key = place
        return f"{_table(tables)}unknown key {key!r}{nearest(key, known_keys(tables))}"
    if kind == "missing":
        *tables, key = place
        return f"{_table(tables)}key {key!r} is missing"
    message = _WORDS.get(kind, detail["msg"].removeprefix("Value error, "))
    message = message[:1].lower() + message[1:]
    if len(place) > 3 and place[2] == "parameters":
        message = "must be a number, a boolean, a string or an array of them"
    if not place:
        return message
    if kind == "value_error" and len(place) == 1:
        return f"[{place[0]}] {message}"
    *tables, key = place
    return f"{_table(tables)}{key} = {detail['input']!r:.60}: {message}"


_WORDS = {
    "model_type": "must be a table",
    "dict_type": "must be a table",
    "mapping_type": "must be a table",
    "tuple_type": "must be an array",
}
_SHOWN_MISTAKES = 100
_UNION_BRANCHES = frozenset(
    {
        *("float", "int", "bool", "str", "constrained-float", "constrained-int"),
        *("input-value", "input-settings", "is-instance[InputRows]", "callable"),
        *("one-value", "values", "range", "same"),
    }
)


def _table(place: list[str]) -> str:
    if not place:
        return ""
    if place[0] == "connections":
        number = f" number {int(place[1]) + 1}" if len(place) > 1 else ""
        return f"[[connections]]{number}: "
    return f"[{'.'.join(place)}] "


def _known_keys(place: list[str]) -> list[str]:
    model: type[BaseModel] = System
    match place:
        case ["simulation"]:
            model = SimulationSettings
        case ["results"]:
            model = ResultsSettings
        case ["bus"]:
            model = BusSettings
        case ["slaves", _]:
            model = SlaveSettings
        case ["slaves", _, "tolerances", _]:
            model = OutputTolerance
        case ["connections", _]:
            return [field.alias or name for name, field in Connection.model_fields.items()]
        case ["inputs", _]:
            model = InputSettings
    return [name for name, field in model.model_fields.items() if not field.exclude]
