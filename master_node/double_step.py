"""The double step T_n -> T_n + H -> T_n + 2H with its comparison solution: steps (A) to (H).

Everything up to the first small step depends only on what the master knows at T_n, so it is one
request; only (G) needs an answer first. Two round trips, whatever k, the estimator and the number
of slaves:

    EST_Rich  1: GetState, SetInputs(u~), DoStep(T, 2H), SetState, SetInputs(u), DoStep(T, H)
    EST_mod   1: GetState, SetInputs(u), DoStep(T, H), GetState, DoStep(T+H, H), SetState
              2: SetInputs(u_new), DoStep(T+H, H)

In front of request 1 stands what the last attempt calls for: after an accepted step the state is
saved (over the old one, which is freed with that), after a rejected one the old one is restored.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from master_node.initialization import gather
from master_node.numerics.error_estimators import Comparison, ErrorEstimator
from master_node.numerics.extrapolation import CouplingHistory
from master_node.numerics.norms import first_not_finite
from master_node.slave_group import Program, SlaveGroup
from master_node.system import CoupledSystem
from protocol.calls import (
    Call,
    DoStep,
    GetOutputs,
    GetState,
    Reply,
    SetInputs,
    SetState,
    StepResult,
)
from protocol.errors import DoublestepError, StepRejectedError
from protocol.signals import FloatArray, InputSignal
from protocol.slave import StepStatus

_AT_POINT = 0
_HALFWAY = 1
_GET_OUTPUTS = GetOutputs()
_SAVE_POINT = GetState(_AT_POINT)
_RESTORE_POINT = SetState(_AT_POINT)
_SAVE_HALFWAY = GetState(_HALFWAY)
_RESTORE_HALFWAY = SetState(_HALFWAY)
_STEPS_IN_FIRST = 2


@dataclass(frozen=True, slots=True)
class DoubleStep:
    """The solution of a double step and what it is compared with.

    Attributes:
        middle, end: T_n + H and T_n + 2H [s].
        y_middle, y: outputs of the two small steps there, shape (m,).
        history: inputs at the communication points up to T_n + H.
        y_comparison: the comparison solution at T_n + 2H, shape (m,).
    """

    middle: float
    end: float
    y_middle: FloatArray
    y: FloatArray
    y_comparison: FloatArray
    history: CouplingHistory


@dataclass(frozen=True, slots=True)
class FailedStep:
    """A double step that a slave, or a value that is not finite, broke off.

    Attributes:
        slave: its name; "" when it was a value that is not finite.
        status: ``DISCARD`` or ``TERMINATED`` when the slave said so; None after an error or a
            value that is not finite.
        reached: which part of its step the slave completed, 0 to 1; NaN when unknown.
        reason: for ``steps.csv`` and messages: a variable or a slave, and what happened.
        error: of the slave, if it returned one.
    """

    slave: str
    status: StepStatus | None
    reached: float
    reason: str
    error: DoublestepError | None = None


class _Request(Protocol):
    """Request 1, (A) to (F), for one comparison solution.

    Attributes:
        MIDDLE, COMPARISON: where in a slave's results the outputs of the first small step and of
            the comparison solution are, counted from the end.
    """

    MIDDLE: int
    COMPARISON: int

    def __call__(
        self, history: CouplingHistory, order: int, first: float, second: float
    ) -> tuple[InputSignal, InputSignal, Callable[[FloatArray, FloatArray], Program]]:
        """The two input signals, and how a slave's program is made of its parts of both."""
        ...


class _LongStepRequest:
    """EST_Rich: the long step first, then back, then the first small step."""

    MIDDLE = -1
    COMPARISON = -5

    def __call__(
        self, history: CouplingHistory, order: int, first: float, second: float
    ) -> tuple[InputSignal, InputSignal, Callable[[FloatArray, FloatArray], Program]]:
        time = history.times[0]
        long_step = DoStep(time, first + second, True)
        step = DoStep(time, first, True)

        def program(u_long: FloatArray, u: FloatArray) -> Program:
            return (
                SetInputs(u_long),
                long_step,
                _GET_OUTPUTS,
                _RESTORE_POINT,
                SetInputs(u),
                step,
                _GET_OUTPUTS,
            )

        return history.long_signal(order), history.signal(order), program


class _SamePolynomialRequest:
    """EST_mod: the first small step, on with its polynomial, then back halfway."""

    MIDDLE = -6
    COMPARISON = -2

    def __call__(
        self, history: CouplingHistory, order: int, first: float, second: float
    ) -> tuple[InputSignal, InputSignal, Callable[[FloatArray, FloatArray], Program]]:
        time = history.times[0]
        step = DoStep(time, first, True)
        comparison_step = DoStep(time + first, second, False)
        signal = history.signal(order)

        def program(u: FloatArray, u_middle: FloatArray) -> Program:
            return (
                SetInputs(u),
                step,
                _GET_OUTPUTS,
                _SAVE_HALFWAY,
                SetInputs(u_middle),
                comparison_step,
                _GET_OUTPUTS,
                _RESTORE_HALFWAY,
            )

        return signal, signal.shifted(first), program


_REQUESTS: Mapping[Comparison, _Request] = {
    Comparison.LONG_STEP: _LongStepRequest(),
    Comparison.SAME_POLYNOMIAL: _SamePolynomialRequest(),
}


class DoubleStepper:
    """Takes double steps with one estimator; holds only what the slaves have saved.

    Args:
        group: the slaves, at their first communication point.
        coupled: their connections.
        estimator: which comparison solution to compute.
        orders: for each slave the highest degree of polynomial that it can take.
    """

    def __init__(
        self,
        group: SlaveGroup,
        coupled: CoupledSystem,
        estimator: ErrorEstimator,
        orders: Sequence[int],
    ) -> None:
        self._group = group
        self._source = coupled.source
        self._names = coupled.output_names
        self._slices = [part.input_slice for part in coupled.parts]
        self._rows = [order + 1 for order in orders]
        self._first_request = _REQUESTS[estimator.comparison]
        self._first_call: Call = _SAVE_POINT

    def attempt(
        self, history: CouplingHistory, step_size: float, order: int, stop_time: float | None
    ) -> DoubleStep | FailedStep:
        """One double step from the newest point of ``history``.

        Args:
            history: inputs at the communication points up to T_n.
            step_size: H [s].
            order: k.
            stop_time: where the double step must end exactly [s]; None: at T_n + H + H.

        Returns:
            The solution, or why there is none. `accepted` or `rejected` must follow.

        Raises:
            DoublestepError: a slave is lost, or failed in a way that a smaller step cannot help.
        """
        time = history.times[0]
        middle = time + step_size
        second = step_size if stop_time is None else stop_time - middle
        end = middle + step_size if stop_time is None else stop_time

        request = self._first_request
        signal_1, signal_2, program = request(history, order, step_size, second)
        d_1, d_2 = signal_1.derivatives, signal_2.derivatives
        programs = [  # a slave that gets a constant goes on with it in the comparison solution
            (self._first_call, *program(d_1[:rows, part], (d_2 if rows > 1 else d_1)[:rows, part]))
            for part, rows in zip(self._slices, self._rows, strict=True)
        ]
        replies = self._group.execute(programs, time, step_size)
        rollbacks = 2 if self._first_call is _RESTORE_POINT else 1
        failed = self._failed(programs, replies, _STEPS_IN_FIRST, rollbacks)
        if failed is not None:
            return failed
        y_middle = gather(replies, request.MIDDLE)
        y_comparison = gather(replies, request.COMPARISON)
        bad = first_not_finite(y_middle)
        if bad is not None:
            return FailedStep("", None, float("nan"), f"{self._names[bad]} is not finite")

        history = history.pushed(middle, y_middle[self._source])
        d = history.signal(order).derivatives
        step = DoStep(middle, second, False)
        programs = [
            (SetInputs(d[:rows, part]), step, _GET_OUTPUTS)
            for part, rows in zip(self._slices, self._rows, strict=True)
        ]
        replies = self._group.execute(programs, middle, step_size)
        failed = self._failed(programs, replies, 1, 0)
        if failed is not None:
            return failed
        y = gather(replies, -1)
        return DoubleStep(middle, end, y_middle, y, y_comparison, history)

    def accepted(self) -> None:
        """Go on from the end: the state saved at T_n is not needed any more."""
        self._first_call = _SAVE_POINT

    def rejected(self) -> None:
        """Go back to T_n."""
        self._first_call = _RESTORE_POINT

    def _failed(
        self,
        programs: Sequence[Program],
        replies: Sequence[Reply],
        do_steps: int,
        rollbacks: int,
    ) -> FailedStep | None:
        """Count what was executed; which slave did not get to the end, if any."""
        if all(map(_complete, programs, replies)):
            self._group.count_all(do_steps, rollbacks)
            return None
        failures = []
        for i, (name, program, reply) in enumerate(
            zip(self._group.names, programs, replies, strict=True)
        ):
            done = program[: len(reply.results)]
            self._group.count(i, done)
            if len(done) == len(program):
                continue
            if reply.error is not None and not isinstance(reply.error, StepRejectedError):
                raise reply.error
            failures.append(_failure(name, program, reply))
        terminated = [f for f in failures if f.status is StepStatus.TERMINATED]
        return (terminated or failures)[0]


def _complete(program: Program, reply: Reply) -> bool:
    return len(reply.results) == len(program)


def _failure(slave: str, program: Program, reply: Reply) -> FailedStep:
    if reply.error is not None:
        return FailedStep(slave, None, float("nan"), f"{slave}: {reply.error.cause}", reply.error)
    call, result = program[len(reply.results) - 1], reply.results[-1]
    assert isinstance(call, DoStep)
    assert isinstance(result, StepResult)
    reached = (result.time - call.communication_point) / call.step_size
    return FailedStep(slave, result.status, reached, f"{slave}: {result.status}")
