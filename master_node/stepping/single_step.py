"""One step of all slaves that is not taken back: one request, or one for each group."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.outputs import Outputs
from master_node.coupling.result_points import Reached, ReachedPoint
from master_node.coupling.scheme import CouplingScheme
from master_node.numerics.extrapolation import CouplingHistory, Polynomials
from master_node.slaves.group import SlaveGroup
from master_node.stepping.discrete_requests import step_requests
from master_node.stepping.requests import FailedStep, Piece, StepForm
from protocol.calls import DoStep, StepStatus
from protocol.errors import DoublestepError, SlaveError
from protocol.signals import FloatArray


class SingleStep(NamedTuple):
    """Solution of one step of all slaves.

    Attributes:
        begin, end: communication points [s].
        step_size: H [s], as observers are told.
        polynomials: of the inputs, for each kind.
        outputs: at the end, those of continuous variables of shape (rows, m).
    """

    begin: float
    end: float
    step_size: float
    polynomials: Polynomials
    outputs: Outputs

    @property
    def reached(self) -> Reached:
        """The communication point at its end."""
        return (ReachedPoint(self.end, *self.outputs),)

    @property
    def iterations(self) -> int:
        """Always 0: inputs are extrapolated."""
        return 0


class SingleStepper:
    """Takes steps of all slaves.

    Args:
        group: the slaves, at their first communication point.
        coupled: their connections.
        scheme: how they are coupled within a step.
    """

    def __init__(self, group: SlaveGroup, coupled: CoupledSystem, scheme: CouplingScheme) -> None:
        self._scheme = scheme
        self._coupled = coupled
        self._requests = step_requests(group, coupled, scheme)
        self._request = self._requests.forms(StepForm((), scheme.get_outputs))

    def take(
        self,
        history: CouplingHistory,
        polynomials: Polynomials,
        end: float,
        size: float,
        begin: Outputs,
    ) -> SingleStep:
        """One step from the newest point of ``history``.

        Args:
            history: inputs at the communication points up to the beginning of the step.
            polynomials: of the inputs, for each kind.
            end: of the step [s].
            size: of the step [s].
            begin: outputs at the beginning of the step.

        Raises:
            BrokenOffError: a slave did not get to the end, or an output there is not finite.
            DoublestepError: a slave is lost or failed.
        """
        step = DoStep(history.times[0], size, True)
        inputs = partial(self._inputs, history, polynomials, end)
        external = self._coupled.external.over(step.communication_point, end)
        held = self._coupled.discrete.held(begin.y[0], begin.d, step.communication_point)
        piece = Piece(inputs, external, held, step)
        (outputs,) = self._requests.take(self._request, (piece,))
        return SingleStep(step.communication_point, end, size, polynomials, outputs)

    def _inputs(
        self, history: CouplingHistory, polynomials: Polynomials, end: float, known: FloatArray
    ) -> FloatArray:
        """Derivatives of all inputs in a step to ``end``, with what is ``known`` there."""
        ahead = self._scheme.known_ahead
        past = history.pushed(end, self._coupled.inputs_of(known)) if ahead else history
        return self._scheme.extrapolation.signal(past, polynomials, ahead).derivatives


def unrepeatable(failed: FailedStep, begin: float, size: float, remedy: str) -> DoublestepError:
    """The error that ends a run whose step was not completed and cannot be taken back.

    Args:
        failed: what happened.
        begin: of the step that was to be taken, as far as ``failed`` does not say [s].
        size: of that step [s].
        remedy: what the user can do.
    """
    error = failed.original_error
    if error is not None:
        error.remedy = error.remedy or remedy
        return error
    step = failed.step or DoStep(begin, size, True)
    reason = failed.reason
    if failed.status is StepStatus.DISCARD:
        reached = step.communication_point + failed.reached * step.step_size
        reason = f"fmi2Discard: the step was completed only up to t={reached!r} s"
    return SlaveError(
        reason,
        slave=failed.slave,
        phase="do_step",
        time=step.communication_point,
        step_size=step.step_size,
        remedy=remedy,
    )


def remedy_without_rollback(slave: str) -> str:
    """Remedy for an incomplete step of a slave without rollback."""
    table = f"[slaves.{slave}] " if slave else ""
    return (
        "the step cannot be taken back: lower largest_step_size, or let the slave's state be "
        f'saved ({table}state = "fork")'
    )
