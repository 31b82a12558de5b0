"""Report of a system that was checked."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any


@dataclass(frozen=True)
class StateCosts:
    """Times that a slave takes to save its state at T_0 and to go back, medians of a few.

    Attributes:
        get, set, free: of one call each [s].
        refusal: why the model refused one; "" if it did not, and times are NaN then.
    """

    get: float = math.nan
    set: float = math.nan
    free: float = math.nan
    refusal: str = ""


@dataclass(frozen=True)
class SlaveReport:
    """One slave.

    Attributes:
        name, model, kind, generation_tool: the last three by its own word.
        host: on which it runs.
        place: ``in process``, ``launched``, ``agent`` or ``found``.
        state_kind: how its state is saved.
        state_reason: why not natively; "" if it is.
        state_verdict: of the trial steps; "" where none were taken.
        state_costs: None where no state is saved.
        state_remedy: switch of its exporter by which it saves states itself; "": none is known.
        input_derivatives: how it follows polynomial inputs.
        input_order: highest degree of its input polynomials.
        output_derivative_order: highest order of output derivatives that it gives; 0: none.
        internal_clock: period of a clock that trial steps have found [s]; None: none, or not tried.
        step_multiple: its steps are multiples of this [s]; None: any.
        inputs, outputs: number of variables of these causalities.
    """

    name: str
    model: str
    kind: str
    generation_tool: str
    host: str
    place: str
    state_kind: str
    state_reason: str
    state_verdict: str
    state_costs: StateCosts | None
    state_remedy: str
    input_derivatives: str
    input_order: int
    output_derivative_order: int
    internal_clock: float | None
    step_multiple: float | None
    inputs: int
    outputs: int


@dataclass(frozen=True)
class ConnectionReport:
    """One scalar connection: input = factor * output + offset.

    Attributes:
        source, target: ``slave.variable``.
        source_unit, target_unit: "" where none.
        factor, offset: 1 and 0 where the value is handed on as it is.
        cast: types on both sides, where they differ; "" else.
        is_mapped: whether single values are mapped.
        is_continuous: whether the input follows a polynomial; else it is held in each step.
    """

    source: str
    target: str
    source_unit: str
    target_unit: str
    factor: float
    offset: float
    cast: str
    is_mapped: bool
    is_continuous: bool


@dataclass(frozen=True)
class InputReport:
    """One input that no output feeds.

    Attributes:
        name: ``slave.variable``.
        unit: "" where none.
        value: at T_0; None: the model gives none, or it cannot be written in JSON.
        given_by: ``parameters``, ``[inputs]``, ``the model``, or ``nothing``.
        description: of what drives it, where it is not a constant.
    """

    name: str
    unit: str
    value: float | int | bool | str | None
    given_by: str
    description: str = ""


class When(StrEnum):
    """Mode of the slaves in which a loop of direct feed-through is closed."""

    ALWAYS = "always"
    INITIALIZATION = "in initialization mode"
    POINTS = "at communication points"


@dataclass(frozen=True)
class LoopReport:
    """Outputs that depend directly on each other, across slaves or through one.

    Attributes:
        outputs: ``slave.variable``, along the loop where there is one way around.
        inputs: through which they depend on each other, sorted.
        when: it is closed.
        gain: product of the derivatives once around, where there is one way around; else the
            spectral radius of the map of all of them; NaN: unknown.
        is_single: whether there is one way around.
        unknown: why the gain is not known; "" if it is.
    """

    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    when: When
    gain: float
    is_single: bool
    unknown: str = ""


@dataclass(frozen=True)
class StepBound:
    """Rule or fact that will bound the communication step size H.

    Attributes:
        what: such as ``largest H``.
        value: [s]; None: it is no number that is known before the run.
        why: who says so.
    """

    what: str
    value: float | None
    why: str


@dataclass(frozen=True)
class SystemReport:
    """All that can be told of a system before its first step.

    Attributes:
        source: name of the system file.
        start_time, stop_time: [s].
        estimator, sequence, coupling, order: of the method.
        slaves: in the order of the system file.
        connections: in that order too.
        unconnected: inputs that no output feeds.
        unused: outputs that feed nothing, as ``slave.variable``.
        loops: of direct feed-through.
        bounds: of H.
        warnings: that a run would give before its first step.
    """

    source: str
    start_time: float
    stop_time: float
    estimator: str
    sequence: str
    coupling: str
    order: str
    slaves: tuple[SlaveReport, ...]
    connections: tuple[ConnectionReport, ...]
    unconnected: tuple[InputReport, ...]
    unused: tuple[str, ...]
    loops: tuple[LoopReport, ...]
    bounds: tuple[StepBound, ...]
    warnings: tuple[str, ...]

    def as_plain_data(self) -> dict[str, Any]:
        """The report for JSON; a number that is not known is None."""
        data = _plain(asdict(self))
        assert isinstance(data, dict)
        return data


def _plain(value: object) -> object:
    match value:
        case float() if not math.isfinite(value):
            return None
        case Mapping():
            return {str(key): _plain(item) for key, item in value.items()}
        case str():
            return str(value)
        case Sequence():
            return [_plain(item) for item in value]
    return value
