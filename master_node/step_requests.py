"""Steps of all slaves as requests: save or restore, set inputs, step, read outputs.

One request to a slave may hold several such pieces. All slaves of a group take theirs at the same
time; the groups of a Gauss-Seidel sequence follow each other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from master_node.coupling_scheme import CouplingScheme
from master_node.discrete_coupling import DiscreteValues, Held
from master_node.external_inputs import ExternalSignal
from master_node.numerics.norms import first_not_finite
from master_node.output_evaluation import OutputEvaluation
from master_node.outputs import Outputs
from master_node.restorable_slave import BrokenStepError
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
from protocol.signals import FloatArray
from protocol.slave import StepStatus

_AT_POINT = 0
_HALFWAY = 1
SAVE_POINT = GetState(_AT_POINT)
RESTORE_POINT = SetState(_AT_POINT)
SAVE_HALFWAY = GetState(_HALFWAY)
RESTORE_HALFWAY = SetState(_HALFWAY, free=True)


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
        step: that was not completed; None when it was a value that is not finite.
        time: where the slave stands [s]; NaN when unknown.
    """

    slave: str
    status: StepStatus | None
    reached: float
    reason: str
    error: DoublestepError | None = None
    step: DoStep | None = None
    time: float = float("nan")

    @property
    def has_crashed(self) -> bool:
        """Whether the step ended the process of its slave, which can be restored."""
        return isinstance(self.error, BrokenStepError) and self.error.is_crash

    @property
    def original_error(self) -> DoublestepError | None:
        """The error with which a run ends that does not repeat the step."""
        return self.error.original if isinstance(self.error, BrokenStepError) else self.error


Inputs = Callable[[FloatArray], FloatArray]
"""The derivatives of all connected inputs in a step, shape (k + 1, n), from the outputs at its end
as far as they are known by then, shape (rows, m)."""


class Piece(NamedTuple):
    """One step of all slaves: what comes first, which inputs, which step, which outputs.

    Attributes:
        before: what each slave does first: save or restore; None: what the last attempt calls for.
        inputs: see `Inputs`.
        external: the external inputs in it.
        held: the discrete inputs in it.
        step: the same for all slaves.
        get_outputs: for each slave.
        rows: of its output arrays.
    """

    before: tuple[Call, ...] | None
    inputs: Inputs
    external: ExternalSignal
    held: Held
    step: DoStep
    get_outputs: Sequence[GetOutputs]
    rows: int


class BrokenOffError(Exception):
    """Carries a failed step out of a request."""

    def __init__(self, failed: FailedStep) -> None:
        super().__init__(failed.reason)
        self.failed = failed


class StepRequests:
    """Sends the slaves the requests of their steps, and knows which state each has saved.

    Args:
        group: the slaves, at their first communication point.
        coupled: their connections.
        scheme: how they are coupled within a step.
    """

    def __init__(self, group: SlaveGroup, coupled: CoupledSystem, scheme: CouplingScheme) -> None:
        self._group = group
        self._names = coupled.output_names
        self._columns = [part.columns for part in coupled.parts]
        self._output_slices = [part.output_slice for part in coupled.parts]
        self._scheme = scheme
        self._evaluation = OutputEvaluation(group, coupled, scheme)
        self.forget()

    def forget(self) -> None:
        """The state saved at T_n is not needed any more: it is saved anew where a step begins."""
        self._saved = [False] * len(self._columns)

    def take(self, pieces: Sequence[Piece]) -> list[Outputs]:
        """Take steps from where the slaves stand.

        Returns:
            The outputs at the end of each piece, those of continuous variables of shape (rows, m).

        Raises:
            BrokenOffError: a slave did not get to the end, or an output there is not finite.
        """
        outputs = [np.zeros((piece.rows, len(self._names))) for piece in pieces]
        if not self._evaluation.is_needed:
            discrete = self._request(pieces, outputs)
            return list(map(Outputs, outputs, discrete))
        discrete = []
        for piece, y in zip(pieces, outputs, strict=True):
            discrete += self._request([piece], [y])
            step = piece.step
            try:
                self._evaluation.evaluate(
                    y, piece.external.end, step.communication_point, step.step_size
                )
            except StepRejectedError as error:
                failed = FailedStep("", None, float("nan"), error.cause, error)
                raise BrokenOffError(failed) from None
        return list(map(Outputs, outputs, discrete))

    def _request(
        self, pieces: Sequence[Piece], outputs: Sequence[FloatArray]
    ) -> list[DiscreteValues]:
        """One request to each slave, group after group; fills ``outputs`` of each piece.

        Returns:
            The discrete outputs of each piece.
        """
        places = self._places(pieces)
        answers: dict[int, list[object]] = {}
        for slaves in self._scheme.groups:
            inputs = [piece.inputs(y) for piece, y in zip(pieces, outputs, strict=True)]
            programs = [self._program(slave, pieces, inputs) for slave in slaves]
            replies = self._group.execute(
                programs, pieces[0].step.communication_point, pieces[-1].step.step_size, slaves
            )
            self._check(slaves, programs, replies)
            for slave, reply in zip(slaves, replies, strict=True):
                columns = self._output_slices[slave]
                answers[slave] = results = reply.results
                for y, place in zip(outputs, places[slave], strict=True):
                    values: Any = results[place]
                    y[: len(values), columns] = values
            for y in outputs:
                bad = first_not_finite(y)
                if bad is not None:  # before anyone else gets it
                    reason = f"{self._names[bad]} is not finite"
                    raise BrokenOffError(FailedStep("", None, float("nan"), reason))
        return self._discrete_outputs(answers, places)

    def _places(self, pieces: Sequence[Piece]) -> Sequence[Sequence[int]]:
        """For each slave where the outputs of each piece are in its reply."""
        places = []
        length = 0
        for piece in pieces:
            length += (1 if piece.before is None else len(piece.before)) + 3
            places.append(length - 1)
        return [places] * len(self._columns)

    def _discrete_outputs(
        self,
        answers: Mapping[int, list[object]],  # noqa: ARG002  all is continuous
        places: Sequence[Sequence[int]],
    ) -> list[DiscreteValues]:
        """Those of each piece, from the results of each slave that was asked."""
        return [()] * len(places[0])

    def _program(
        self, slave: int, pieces: Sequence[Piece], inputs: Sequence[FloatArray]
    ) -> Program:
        rows, columns = self._scheme.input_rows[slave], self._columns[slave]
        calls: list[Call] = []
        for piece, derivatives in zip(pieces, inputs, strict=True):
            if piece.before is None:
                calls.append(RESTORE_POINT if self._saved[slave] else SAVE_POINT)
            else:
                calls.extend(piece.before)
            calls += (
                SetInputs(columns(derivatives[:rows], piece.external.rows)),
                piece.step,
                piece.get_outputs[slave],
            )
        return tuple(calls)

    def _check(
        self, slaves: Sequence[int], programs: Sequence[Program], replies: Sequence[Reply]
    ) -> None:
        """Count what was executed.

        Raises:
            BrokenOffError: a slave did not get to the end.
            DoublestepError: its error is one that a smaller step cannot help.
        """
        failures = []
        for slave, program, reply in zip(slaves, programs, replies, strict=True):
            done = program[: len(reply.results)]
            self._group.count(slave, done)
            if done and done[0] is SAVE_POINT:
                self._saved[slave] = True
            if len(done) == len(program):
                continue
            if reply.error is not None and not isinstance(reply.error, StepRejectedError):
                raise reply.error
            failures.append(_failure(self._group.names[slave], program, reply))
        if failures:
            terminated = [f for f in failures if f.status is StepStatus.TERMINATED]
            raise BrokenOffError((terminated or failures)[0])


def _failure(slave: str, program: Program, reply: Reply) -> FailedStep:
    if reply.error is not None:
        return FailedStep(slave, None, float("nan"), f"{slave}: {reply.error.cause}", reply.error)
    call, result = program[len(reply.results) - 1], reply.results[-1]
    assert isinstance(call, DoStep)
    assert isinstance(result, StepResult)
    reached = (result.time - call.communication_point) / call.step_size
    reason = f"{slave}: {result.status}"
    return FailedStep(slave, result.status, reached, reason, step=call, time=result.time)
