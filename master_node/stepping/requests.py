"""Steps of all slaves as requests: save or restore, set inputs, step, read outputs.

One request to a slave may hold several such pieces. All slaves of a group take theirs at the same
time; the groups of a Gauss-Seidel sequence follow each other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem, SlavePart
from master_node.coupling.discrete import DiscreteValues, Held
from master_node.coupling.outputs import Outputs
from master_node.coupling.scheme import CouplingScheme
from master_node.inputs.continuous import ExternalSignal
from master_node.numerics.norms import first_not_finite
from master_node.slaves.group import Program, SlaveGroup
from master_node.slaves.restorable import BrokenStepError
from master_node.stepping.output_evaluation import OutputEvaluation
from protocol.calls import (
    Call,
    DoStep,
    GetOutputs,
    GetState,
    Reply,
    SetInputs,
    SetState,
    StepResult,
    StepStatus,
)
from protocol.errors import DoublestepError, StepRejectedError
from protocol.signals import FloatArray

_NAN = float("nan")
_AT_POINT = 0
_HALFWAY = 1
SAVE_POINT = GetState(_AT_POINT)
RESTORE_POINT = SetState(_AT_POINT)
SAVE_HALFWAY = GetState(_HALFWAY)
RESTORE_HALFWAY = SetState(_HALFWAY, free=True)
RESTORE_HALFWAY_AND_KEEP = SetState(_HALFWAY)


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
        missing: outputs at T_n + H, shape (rows, m), of which a derivative is not finite that the
            second small step needs, as the first one had polynomials with derivatives; else None.
        follows_restore: whether the step was the first one from a restored state.
    """

    slave: str
    status: StepStatus | None
    reached: float
    reason: str
    error: DoublestepError | None = None
    step: DoStep | None = None
    time: float = _NAN
    missing: FloatArray | None = None
    follows_restore: bool = False

    @property
    def has_doubtful_event(self) -> bool:
        """True if the slave returned early in a step that it may complete when it is repeated."""
        return self.status is StepStatus.EARLY_RETURN and self.follows_restore

    @property
    def has_crashed(self) -> bool:
        """True if the step ended the process of its slave, which can be restored."""
        return isinstance(self.error, BrokenStepError) and self.error.is_crash

    @property
    def original_error(self) -> DoublestepError | None:
        """The error with which a run ends that does not repeat the step."""
        return self.error.original if isinstance(self.error, BrokenStepError) else self.error


Inputs = Callable[[FloatArray], FloatArray]
"""The derivatives of all connected inputs in a step, shape (k + 1, n), from the outputs at its end
as far as they are known by then, shape (rows, m)."""


class StepForm(NamedTuple):
    """Form of all steps of one kind.

    Attributes:
        before: what each slave does first: save or restore; None: what the last attempt calls for.
        get_outputs: what each slave is asked for at the end.
        records: whether recorded variables are read there, too.
    """

    before: tuple[Call, ...] | None
    get_outputs: Sequence[GetOutputs]
    records: bool = True


class RequestForm(NamedTuple):
    """Form of all requests of one kind.

    Attributes:
        steps: that it holds, one or two.
        places: for each slave where the outputs of each step are in its reply.
        outputs: slave and place of all of them, step by step, where all slaves take the request at
            once and are asked for as many rows each time; else empty.
        rollbacks: how many there are, besides that to T_n.
    """

    steps: tuple[StepForm, ...]
    places: Sequence[Sequence[int]]
    outputs: tuple[tuple[int, int], ...]
    rollbacks: int


class Piece(NamedTuple):
    """One step of all slaves: which inputs, which step.

    Attributes:
        inputs: see `Inputs`.
        external: the external inputs in it.
        held: the discrete inputs in it.
        step: the same for all slaves.
    """

    inputs: Inputs
    external: ExternalSignal
    held: Held
    step: DoStep


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
        self._columns = [
            _columns(part, rows)
            for part, rows in zip(coupled.parts, scheme.input_rows, strict=True)
        ]
        self._output_slices = [part.output_slice for part in coupled.parts]
        self._scheme = scheme
        self._recorded = coupled.recorded
        self._slaves = range(len(coupled.parts))
        self._unknown = np.zeros((scheme.output_rows, len(self._names)))
        self._evaluation = OutputEvaluation(group, coupled, scheme)
        self.forget()

    def forget(self) -> None:
        """The state saved at T_n is not needed any more: it is saved anew where a step begins."""
        self._saved = [False] * len(self._columns)

    def way_back(self, slave: int) -> Program:
        """Calls that bring a slave back to T_n from where a trial has led it."""
        return (RESTORE_POINT,) if self._saved[slave] else ()

    def forms(self, *steps: StepForm) -> list[RequestForm]:
        """The requests that take these steps: one, unless outputs are evaluated in between."""
        if self._evaluation.is_needed:
            return [self.form((step,)) for step in steps]
        return [self.form(steps)]

    def form(self, steps: tuple[StepForm, ...]) -> RequestForm:
        """One request that takes all of these steps."""
        places = self._places(steps)
        rows = {get.order + 1 for step in steps for get in step.get_outputs}
        is_even = self._scheme.groups == (tuple(self._slaves),) and rows == {len(self._unknown)}
        outputs = [
            (slave, places[slave][number])
            for number in range(len(steps) if is_even else 0)
            for slave in self._slaves
        ]
        return RequestForm(
            steps, places, tuple(outputs), sum(_rollbacks(step.before or ()) for step in steps)
        )

    def take(self, forms: Sequence[RequestForm], pieces: Sequence[Piece]) -> list[Outputs]:
        """Take steps from where the slaves stand.

        Args:
            forms: see `forms`.
            pieces: the steps.

        Returns:
            The outputs at the end of each piece, those of continuous variables of shape (rows, m).

        Raises:
            BrokenOffError: a slave did not get to the end, or an output there is not finite.
        """
        if not self._evaluation.is_needed:
            return self.request(forms[0], pieces)
        found = []
        for form, piece in zip(forms, pieces, strict=True):
            (outputs,) = self.request(form, [piece])
            step = piece.step
            try:
                recorded = self._evaluation.evaluate(
                    outputs.y,
                    piece.external.end,
                    step.communication_point,
                    step.step_size,
                    records=form.steps[0].records,
                )
            except StepRejectedError as error:
                failed = FailedStep("", None, _NAN, error.cause, error)
                raise BrokenOffError(failed) from None
            self._check_values(outputs.y)
            found.append(Outputs(outputs.y, self._recorded.replaced(outputs.d, recorded)))
        return found

    def request(self, form: RequestForm, pieces: Sequence[Piece]) -> list[Outputs]:
        """One request to each slave, group after group; no outputs are evaluated in between.

        Arguments, result and errors as for `take`.
        """
        if form.outputs:
            return self._request_at_once(form, pieces)
        places = form.places
        values = np.zeros((len(pieces), *self._unknown.shape))
        answers: list[list[Any] | None] = [None] * len(self._slaves)
        for slaves in self._scheme.groups:
            inputs = [piece.inputs(y) for piece, y in zip(pieces, values, strict=True)]
            for slave, results in zip(
                slaves, self._results(form, pieces, inputs, slaves), strict=True
            ):
                answers[slave], columns = results, self._output_slices[slave]
                for y, place in zip(values, places[slave], strict=True):
                    y[: len(results[place]), columns] = results[place]
            self._check_values(values)  # before anyone else gets them
        return list(map(Outputs, values, self._discrete_outputs(answers, form)))

    def _request_at_once(self, form: RequestForm, pieces: Sequence[Piece]) -> list[Outputs]:
        """Outputs of all slaves by one request to all at a time, all answers being of one shape."""
        inputs = [piece.inputs(self._unknown) for piece in pieces]
        answers = self._results(form, pieces, inputs, self._slaves)
        values = np.concatenate([answers[slave][place] for slave, place in form.outputs], axis=1)
        self._check_values(values)
        discrete = self._discrete_outputs(answers, form)
        if len(pieces) == 1:
            return [Outputs(values, discrete[0])]
        first, second = discrete
        width = len(self._names)
        return [Outputs(values[:, :width], first), Outputs(values[:, width:], second)]

    def _check_values(self, values: FloatArray) -> None:
        """Values only: a derivative that is not finite is none."""
        bad = first_not_finite(values[..., 0, :])
        if bad is not None:
            reason = f"{self._names[bad % len(self._names)]} is not finite"
            raise BrokenOffError(FailedStep("", None, _NAN, reason))

    def _places(self, steps: Sequence[StepForm]) -> Sequence[Sequence[int]]:
        """For each slave where the outputs of each step are in its reply."""
        places = []
        length = 0
        for step in steps:
            length += (1 if step.before is None else len(step.before)) + 3
            places.append(length - 1)
        return [places] * len(self._columns)

    def _discrete_outputs(
        self,
        answers: Sequence[list[Any] | None],  # noqa: ARG002  all is continuous
        form: RequestForm,
    ) -> list[DiscreteValues]:
        """Those of each piece, from the results of each slave, None if it was not asked."""
        return [()] * len(form.steps)

    def _program(
        self, slave: int, form: RequestForm, pieces: Sequence[Piece], inputs: Sequence[FloatArray]
    ) -> Program:
        columns = self._columns[slave]
        calls: list[Call] = []
        for (before, get_outputs, _), piece, derivatives in zip(
            form.steps, pieces, inputs, strict=True
        ):
            if before is None:
                calls.append(RESTORE_POINT if self._saved[slave] else SAVE_POINT)
            else:
                calls += before
            calls += (
                SetInputs(columns(derivatives, piece.external.rows)),
                piece.step,
                get_outputs[slave],
            )
        return tuple(calls)

    def _results(
        self,
        form: RequestForm,
        pieces: Sequence[Piece],
        inputs: Sequence[FloatArray],
        slaves: Sequence[int],
    ) -> list[list[Any]]:
        """Results of the programs of these slaves; counts what was executed.

        Raises:
            BrokenOffError: a slave did not get to the end.
            DoublestepError: its error is one that a smaller step cannot help.
        """
        programs = [self._program(slave, form, pieces, inputs) for slave in slaves]
        replies = self._group.execute(
            programs, pieces[0].step.communication_point, pieces[-1].step.step_size, slaves
        )
        do_steps, saved = len(pieces), self._saved
        begins_anew = form.steps[0].before is None
        failures = []
        for slave, program, reply in zip(slaves, programs, replies, strict=True):
            if len(reply.results) < len(program):
                failures.append((slave, program, reply))
                continue
            rollbacks = form.rollbacks
            if begins_anew:
                rollbacks += saved[slave]
                saved[slave] = True
            self._group.count(slave, do_steps, rollbacks)
        if failures:
            raise self._broken_off(failures)
        return [reply.results for reply in replies]

    def _broken_off(self, incomplete: Sequence[tuple[int, Program, Reply]]) -> BrokenOffError:
        """For slaves that did not get to the end of their programs; errors as of `_results`."""
        failures = []
        error: DoublestepError | None = None
        for slave, program, reply in incomplete:
            done = program[: len(reply.results)]
            steps = sum(type(call) is DoStep for call in done)
            self._group.count(slave, steps, _rollbacks(done))
            if done and done[0] is SAVE_POINT:
                self._saved[slave] = True
            if reply.error is not None and not isinstance(reply.error, StepRejectedError):
                error = error or reply.error
            else:
                failures.append(_failure(self._group.names[slave], program, reply))
        if error is not None:
            raise error
        terminated = [f for f in failures if f.status is StepStatus.TERMINATED]
        return BrokenOffError((terminated or failures)[0])


def _rollbacks(calls: Sequence[Call]) -> int:
    return sum(type(call) is SetState for call in calls)


def _columns(part: SlavePart, rows: int) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Columns of the inputs of the system for a slave that takes ``rows`` of derivatives."""
    if part.external_rows:
        return lambda connected, external: part.columns(connected[:rows], external)
    own = slice(rows), part.input_slice
    return lambda connected, _: connected[own]


def _failure(slave: str, program: Program, reply: Reply) -> FailedStep:
    if reply.error is not None:
        return FailedStep(slave, None, _NAN, f"{slave}: {reply.error.cause}", reply.error)
    call, result = program[len(reply.results) - 1], reply.results[-1]
    assert isinstance(call, DoStep)
    assert isinstance(result, StepResult)
    reached = (result.time - call.communication_point) / call.step_size
    reason = f"{slave}: {result.status}"
    done = program[: len(reply.results) - 1]
    last = next((type(c) for c in reversed(done) if isinstance(c, DoStep | SetState)), None)
    return FailedStep(
        slave,
        result.status,
        reached,
        reason,
        step=call,
        time=result.time,
        follows_restore=last is SetState,
    )
