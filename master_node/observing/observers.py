"""Observers of a run: what a run tells to results, progress and recording in memory.

The algorithm calls observers between steps and never reads anything back from them. An observer
that raises ends the run with that error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal, NamedTuple, Protocol

from protocol.calls import Call
from protocol.signals import FloatArray

DiscreteType = Literal["float", "integer", "boolean", "string", "binary"]
"""Value of a discrete variable: FMI's Real, Integer or Enumeration, Boolean, String, Binary."""

DiscreteValue = float | int | bool | str | bytes
"""A value of one of these types, in their order. An ``integer`` has 64 bits and a sign."""


class OutputControl(NamedTuple):
    """Outputs that are controlled, and how, as ``slave.variable``; both may be said of one.

    Attributes:
        double_step: those whose error is estimated with a comparison solution, before the double
            step is accepted.
        input_defects: those of slaves without rollback and of slaves that get inputs from such:
            the defects of these inputs are known after the step, and bound the next one.
    """

    double_step: tuple[str, ...] = ()
    input_defects: tuple[str, ...] = ()


NOT_CONTROLLED = OutputControl()
"""Without an estimator."""


@dataclass(frozen=True, slots=True)
class RunStart:
    """Facts of a run that are known before the first step.

    Attributes:
        output_names: ``slave.variable`` of the m outputs, in the order of all output arrays.
        output_units: their units, "" where none.
        start_time, stop_time: [s].
        outputs: y(T_0), shape (m,).
        control: how the outputs are controlled.
        state_kinds: how the state of each slave is saved, by its name.
        discrete_names: ``slave.variable`` of the d variables beside the outputs that do not
            change continuously, in the order of all tuples of discrete values.
        discrete_types: what they hold, d of them.
        discrete_units: their units, "" where none; empty when none has one.
        discrete: their values at T_0, d of them.
        recorded: names of the variables that were chosen beside the outputs; the continuous ones
            stand behind the outputs, all others behind the discrete ones.
        items: of enumerations: the number of each item by its name, by ``slave.variable``.
        statistics: of each slave, by its name; they go on counting while the run goes on.
    """

    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    start_time: float
    stop_time: float
    outputs: FloatArray
    discrete_names: tuple[str, ...] = ()
    discrete_types: tuple[DiscreteType, ...] = ()
    discrete_units: tuple[str, ...] = ()
    discrete: tuple[DiscreteValue, ...] = ()
    recorded: frozenset[str] = frozenset()
    items: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    control: OutputControl = NOT_CONTROLLED
    state_kinds: Mapping[str, str] = field(default_factory=dict)
    statistics: Mapping[str, SlaveStatistics] = field(default_factory=dict)


class Point(NamedTuple):
    """Where a result is wanted.

    Attributes:
        time: [s].
        outputs: y there, shape (m,).
        discrete: values of the d discrete variables there.
    """

    time: float
    outputs: FloatArray
    discrete: tuple[DiscreteValue, ...] = ()


Points = tuple[Point, ...]
"""In the order of time."""


class Attempt(NamedTuple):
    """One attempted double step (or one single step when there is no estimator).

    Attributes:
        time: communication point T_n from which it started [s].
        step_size: communication step size H [s], the small one.
        order: degree k of the input polynomials.
        derivative_points: at how many points they meet derivatives.
        error_norm: ERR of equation (8); NaN when the step gave none, inf when a value was not
            finite.
        accepted: whether the solution moved on.
        limiting_variable: ``slave.variable`` with the largest part in ERR, or a reason why there
            is no ERR; "" when there is no estimator.
        points: where results are wanted, in (T_n, T_n + 2H], and y there, shape (m,) each: the
            communication points reached, or those of an output grid; empty when rejected.
        iterations: of the inputs at the end of the double step; 0: they were extrapolated.
    """

    time: float
    step_size: float
    order: int
    derivative_points: int
    error_norm: float
    accepted: bool
    limiting_variable: str
    points: Points = ()
    iterations: int = 0


class Outcome(StrEnum):
    """Outcome of a run."""

    COMPLETED = "completed"
    TERMINATED = "terminated by a slave"
    INTERRUPTED = "interrupted"
    FAILED = "failed"
    STOPPED = "stopped"
    STOPPED_BY_ACTION = "stopped by an action"

    @property
    def is_complete(self) -> bool:
        """True if the run got to its end; others may be resumed."""
        return self in (Outcome.COMPLETED, Outcome.TERMINATED, Outcome.STOPPED_BY_ACTION)


@dataclass(slots=True)
class SlaveStatistics:
    """Counters of one slave over a run; times in seconds.

    Attributes:
        do_steps: steps that it took, or broke off.
        rollbacks: how often it went back to a saved state.
        requests: how many it has answered.
        compute_time: that it spent on them, by its own monotonic clock.
        request_time: from sending a request to having its reply. Replies are collected in the
            order of the slaves, so it includes waiting for slower ones before.
        restarts: how often its process was replaced.
        warnings: messages and calls of its model with the status Warning, also in steps that were
            rejected, but not in trial steps.
    """

    do_steps: int = 0
    rollbacks: int = 0
    requests: int = 0
    compute_time: float = 0.0
    request_time: float = 0.0
    restarts: int = 0
    warnings: int = 0

    @property
    def transport_time(self) -> float:
        """Time of its requests in which it did not compute [s]: the way there and back."""
        return max(0.0, self.request_time - self.compute_time)


def slowest(statistics: Mapping[str, SlaveStatistics]) -> str:
    """Name of the slave that has computed for the longest time; "" when none has."""
    name = max(statistics, key=lambda name: statistics[name].compute_time, default="")
    return name if name and statistics[name].compute_time > 0.0 else ""


@dataclass(slots=True)
class Statistics:
    """Counters of a run.

    Attributes:
        communication_steps: accepted small steps.
        rejected_double_steps: attempts that were not accepted.
        round_trips: rounds of requests to all slaves between the first and the last step.
        wait_time: seconds in which the master waited for the slaves.
        wall_time: seconds of the whole stepping phase.
        discontinuities: how many were found or declared.
        double_steps_at_discontinuities: attempts spent on finding and crossing them.
        double_steps_at_false_alarms: those of them in searches that met no jump.
        late_jumps: jumps by which slaves answered to inputs that turned out to be off by more than
            ten tolerances: these may have called for the jump earlier.
        changes_at_smallest_step_size: changes of discrete outputs that are handed over late by more
            than the tolerance, or by an unknown error, because H cannot be smaller.
        steps_above_tolerance: double steps, or single ones where no slave has rollback, that had
            ERR above 1 when it was too late to reject them, or behind an event on a grid of steps,
            where H could not be smaller.
        iterated_double_steps: accepted ones whose inputs were iterated.
        stiff_double_steps: accepted explicit ones with a loop gain above 0.9, of which the estimate
            is uncertain.
        double_steps_at_rest: accepted ones of the largest H that is chosen where no estimate
            bounds it.
        time: the last accepted communication point [s].
        smallest_step_size, largest_step_size: over accepted steps [s]; NaN before the first.
    """

    communication_steps: int = 0
    rejected_double_steps: int = 0
    discontinuities: int = 0
    double_steps_at_discontinuities: int = 0
    double_steps_at_false_alarms: int = 0
    late_jumps: int = 0
    changes_at_smallest_step_size: int = 0
    steps_above_tolerance: int = 0
    iterated_double_steps: int = 0
    stiff_double_steps: int = 0
    double_steps_at_rest: int = 0
    round_trips: int = 0
    wait_time: float = 0.0
    wall_time: float = 0.0
    time: float = 0.0
    smallest_step_size: float = float("nan")
    largest_step_size: float = float("nan")
    slaves: dict[str, SlaveStatistics] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class RunEnd:
    """End of a run: its outcome and counters.

    Attributes:
        outcome: how the run ended.
        statistics: counters of the run.
        message: the error's or the slave's text, "" when completed.
        points: results that are wanted after all, behind those of the last attempt.
    """

    outcome: Outcome
    statistics: Statistics
    message: str = ""
    points: Points = ()


class Observer(Protocol):
    """Gets told; see the module's docstring."""

    def started(self, start: RunStart) -> None:
        """Called once, when the outputs at T_0 are known."""
        ...

    def attempted(self, attempt: Attempt) -> None:
        """Called after every attempt, accepted or not."""
        ...

    def ended(self, end: RunEnd) -> None:
        """Called once if ``started`` was, whatever happened."""
        ...


class Observers:
    """Several observers as one, told in order; all of them hear the end."""

    def __init__(self, observers: Sequence[Observer]) -> None:
        self._observers = tuple(observers)

    def started(self, start: RunStart) -> None:
        """Pass on."""
        for observer in self._observers:
            observer.started(start)

    def attempted(self, attempt: Attempt) -> None:
        """Pass on."""
        for observer in self._observers:
            observer.attempted(attempt)

    def ended(self, end: RunEnd) -> None:
        """Pass on to all; the first error is raised after everyone was told."""
        errors: list[BaseException] = []
        for observer in self._observers:
            try:
                observer.ended(end)
            except (Exception, KeyboardInterrupt) as error:  # each must get to close its files
                errors.append(error)
        if errors:
            raise errors[0]


class Exchange(NamedTuple):
    """One request to a slave and its reply.

    Attributes:
        slave: its name.
        request: ``claim:sequence``, as in the slave's log; "" without a bus.
        program: what was asked.
        sent, received: by the monotonic clock of the master (`time.perf_counter`) [s].
        compute_time: that the slave spent on it [s]; NaN when there is no reply.
        time: communication point t [s], or None.
        step_size: communication step size H [s], or None.
        error: of the slave or of the way to it, "" if none.
    """

    slave: str
    request: str
    program: Sequence[Call]
    sent: float
    received: float
    compute_time: float
    time: float | None
    step_size: float | None
    error: str = ""


class ExchangeListener(Protocol):
    """Gets told of every exchange of messages: traces. Without one, nothing is made for it."""

    def exchanged(self, begin: float, end: float, exchanges: Sequence[Exchange]) -> None:
        """Called after each round trip, from ``begin`` to ``end``, with what it consisted of."""
        ...
