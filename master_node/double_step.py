"""The double step T_n -> T_n + H -> T_n + 2H with its comparison solution: steps (A) to (H).

Everything up to the first small step depends only on what the master knows at T_n, so it is one
request; only (G) needs an answer first. Two round trips, whatever k, the estimator and the number
of slaves:

    EST_Rich  1: GetState, SetInputs(u~), DoStep(T, 2H), SetState, SetInputs(u), DoStep(T, H)
    EST_mod   1: GetState, SetInputs(u), DoStep(T, H), GetState, DoStep(T+H, H), SetState
              2: SetInputs(u_new), DoStep(T+H, H)

What the last attempt left behind rides along in front of request 1: after an accepted step the
old state is freed, after a rejected one it is restored.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from master_node.initialization import gather
from master_node.numerics.error_estimators import Comparison, ErrorEstimator
from master_node.numerics.extrapolation import CouplingHistory
from master_node.slave_group import Program, SlaveGroup
from master_node.system import CoupledSystem
from protocol.calls import (
    DoStep,
    FreeState,
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
_FREE_POINT = FreeState(_AT_POINT)
_SAVE_HALFWAY = GetState(_HALFWAY)
_RESTORE_HALFWAY = SetState(_HALFWAY)
_FREE_HALFWAY = FreeState(_HALFWAY)

_FIRST: Program = (_SAVE_POINT,)
_AFTER_ACCEPTED: Program = (_FREE_POINT, _SAVE_POINT)
_AFTER_REJECTED: Program = (_RESTORE_POINT,)
_AFTER_REJECTED_HALFWAY: Program = (_RESTORE_POINT, _FREE_HALFWAY)


@dataclass(frozen=True, slots=True)
class DoubleStep:
    """The solution of a double step and what it is compared with.

    Attributes:
        middle, end: T_n + H and T_n + 2H [s].
        y_middle, y: outputs of the two small steps there, shape (m,).
        y_comparison: the comparison solution at T_n + 2H, shape (m,).
    """

    middle: float
    end: float
    y_middle: FloatArray
    y: FloatArray
    y_comparison: FloatArray


@dataclass(frozen=True, slots=True)
class FailedStep:
    """A double step that a slave, or a value that is not finite, broke off.

    Attributes:
        slave: its name.
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


_Inputs = Sequence[FloatArray]


class _Request(Protocol):
    """Request 1, (A) to (F), for one comparison solution.

    Attributes:
        MIDDLE, COMPARISON: where in a slave's results the outputs of the first small step and of
            the comparison solution are, counted from the end.
    """

    MIDDLE: int
    COMPARISON: int

    def __call__(
        self, history: CouplingHistory, order: int, middle: float, first: float, second: float
    ) -> tuple[list[InputSignal], Callable[[_Inputs], Program]]:
        """The input signals, and how a slave's program is made of its parts of them."""
        ...


class _LongStepRequest:
    """EST_Rich: the long step first, then back, then the first small step."""

    MIDDLE = -1
    COMPARISON = -5

    def __call__(
        self, history: CouplingHistory, order: int, middle: float, first: float, second: float
    ) -> tuple[list[InputSignal], Callable[[_Inputs], Program]]:
        time = history.times[0]
        long_step = DoStep(time, first + second, True)
        step = DoStep(time, first, True)

        def program(u: _Inputs) -> Program:
            return (
                SetInputs(u[0]),
                long_step,
                _GET_OUTPUTS,
                _RESTORE_POINT,
                SetInputs(u[1]),
                step,
                _GET_OUTPUTS,
            )

        return [history.long_signal(order), history.signal(order)], program


class _SamePolynomialRequest:
    """EST_mod: the first small step, on with its polynomial, then back halfway."""

    MIDDLE = -7
    COMPARISON = -3

    def __call__(
        self, history: CouplingHistory, order: int, middle: float, first: float, second: float
    ) -> tuple[list[InputSignal], Callable[[_Inputs], Program]]:
        time = history.times[0]
        step = DoStep(time, first, True)
        comparison_step = DoStep(middle, second, False)
        signal = history.signal(order)

        def program(u: _Inputs) -> Program:
            return (
                SetInputs(u[0]),
                step,
                _GET_OUTPUTS,
                _SAVE_HALFWAY,
                SetInputs(u[1]),
                comparison_step,
                _GET_OUTPUTS,
                _RESTORE_HALFWAY,
                _FREE_HALFWAY,
            )

        return [signal, signal.shifted(first)], program


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
        self._m = len(coupled.output_names)
        self._parts = [
            (part.input_slice, order) for part, order in zip(coupled.parts, orders, strict=True)
        ]
        self._first_request = _REQUESTS[estimator.comparison]
        self._prelude: list[Program] = [_FIRST] * len(group)

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
        middle = history.times[0] + step_size
        second = step_size if stop_time is None else stop_time - middle
        end = middle + step_size if stop_time is None else stop_time

        request = self._first_request
        signals, program = request(history, order, middle, step_size, second)
        split = zip(*(self._split(signal) for signal in signals), strict=True)
        programs = [prelude + program(u) for prelude, u in zip(self._prelude, split, strict=True)]
        replies = self._group.execute(programs, history.times[0], step_size)
        failed = self._failed(programs, replies)
        if failed is not None:
            return failed
        y_middle = gather(replies, request.MIDDLE, self._m)
        y_comparison = gather(replies, request.COMPARISON, self._m)
        if not np.isfinite(y_middle).all():
            name = self._names[int(np.argmin(np.isfinite(y_middle)))]
            return FailedStep(name.partition(".")[0], None, float("nan"), f"{name} is not finite")

        following = history.pushed(middle, y_middle[self._source]).signal(order)
        step = DoStep(middle, second, False)
        programs = [(SetInputs(u), step, _GET_OUTPUTS) for u in self._split(following)]
        replies = self._group.execute(programs, middle, step_size)
        failed = self._failed(programs, replies)
        if failed is not None:
            return failed
        return DoubleStep(middle, end, y_middle, gather(replies, -1, self._m), y_comparison)

    def accepted(self) -> None:
        """Go on from the end: the state saved at T_n is not needed any more."""
        self._prelude = [_AFTER_ACCEPTED] * len(self._group)

    def rejected(self) -> None:
        """Go back to T_n."""
        self._prelude = [
            prelude if prelude is _AFTER_REJECTED_HALFWAY else _AFTER_REJECTED
            for prelude in self._prelude
        ]

    def _split(self, signal: InputSignal) -> list[FloatArray]:
        """Each slave's part of the input signal, up to the degree that the slave can take."""
        d = signal.derivatives
        return [d[: order + 1, part] for part, order in self._parts]

    def _failed(self, programs: Sequence[Program], replies: Sequence[Reply]) -> FailedStep | None:
        """Count what was executed; the first slave that did not get to the end, if any."""
        self._group.count(programs, replies)
        failed: FailedStep | None = None
        for i, (name, program, reply) in enumerate(
            zip(self._group.names, programs, replies, strict=True)
        ):
            executed = len(reply.results)
            if executed == len(program):
                self._prelude[i] = ()
                continue
            done = program[:executed]
            halfway = _SAVE_HALFWAY in done and _FREE_HALFWAY not in done
            self._prelude[i] = _AFTER_REJECTED_HALFWAY if halfway else _AFTER_REJECTED
            if reply.error is not None and not isinstance(reply.error, StepRejectedError):
                raise reply.error
            if failed is None or failed.status is not StepStatus.TERMINATED:
                failed = _failure(name, program, reply)
        return failed


def _failure(slave: str, program: Program, reply: Reply) -> FailedStep:
    if reply.error is not None:
        return FailedStep(slave, None, float("nan"), f"{slave}: {reply.error.cause}", reply.error)
    call, result = program[len(reply.results) - 1], reply.results[-1]
    assert isinstance(call, DoStep)
    assert isinstance(result, StepResult)
    reached = (result.time - call.communication_point) / call.step_size
    return FailedStep(slave, result.status, reached, f"{slave}: {result.status}")
