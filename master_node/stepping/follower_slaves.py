"""The slaves without rollback, which take their steps when those of the others are accepted.

They take the two small steps once, with inputs from the others that are known at the ends of both,
as behind a first group in a Gauss-Seidel sequence. What they send each other is extrapolated, and
only then known halfway: two requests. Without such inputs one request holds both steps.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.discrete import Held
from master_node.coupling.outputs import Outputs
from master_node.coupling.scheme import CouplingScheme
from master_node.numerics.extrapolation import CouplingHistory
from master_node.slaves.group import SlaveGroup
from master_node.stepping.discrete_requests import step_requests
from master_node.stepping.double_step import DoubleStep
from master_node.stepping.requests import BrokenOffError, Piece, StepForm
from master_node.stepping.single_step import remedy_without_rollback, unrepeatable
from protocol.calls import DoStep, StepStatus
from protocol.signals import FloatArray


class LateSlaves:
    """Takes them over double steps, once and for all.

    Args:
        group: all slaves of the system.
        coupled: their connections.
        scheme: how they are coupled within a step.
    """

    def __init__(self, group: SlaveGroup, coupled: CoupledSystem, scheme: CouplingScheme) -> None:
        self._coupled = coupled
        self._scheme = scheme
        self._requests = step_requests(
            group, coupled, replace(scheme, groups=(scheme.late_slaves,), evaluated=())
        )
        form = StepForm((), scheme.get_outputs)
        self._one_step = self._requests.forms(form)
        self._two_steps = self._requests.forms(form, form)
        is_late = np.isin(coupled.output_slave, scheme.late_slaves)
        self._outputs = np.flatnonzero(is_late)
        self._send_each_other = coupled.discrete.holds_inputs or any(
            is_late[coupled.source[coupled.parts[slave].input_slice]].any()
            for slave in scheme.late_slaves
        )

    def follow(self, history: CouplingHistory, begin: Outputs, step: DoubleStep) -> DoubleStep:
        """Take the same two steps.

        Args:
            history: inputs at the communication points up to T_n.
            begin: outputs at T_n.
            step: the accepted double step of the others.

        Returns:
            The double step with the outputs of all slaves.

        Raises:
            BrokenOffError: a slave wants to end the simulation.
            DoublestepError: a slave is lost, or did not complete a step.
        """
        start, middle, end, first, second, _ = step.times
        discrete = self._coupled.discrete
        d_middle, d_end = step.discrete
        held = discrete.held(begin.y[0], begin.d, start)
        signal = self._scheme.extrapolation.signal
        pushed = history.pushed(middle, self._coupled.inputs_of(step.middle))
        to_middle = self._piece(
            signal(pushed, step.polynomials, 1).derivatives,
            DoStep(start, first, True),
            held,
            middle,
        )
        to_end = DoStep(middle, second, True)
        u_end = self._coupled.inputs_of(step.end)
        try:
            if self._send_each_other:
                (at_middle,) = self._requests.take(self._one_step, [to_middle])
                y_middle = self._merged(step.middle, at_middle.y)
                pushed = history.pushed(middle, self._coupled.inputs_of(y_middle))
                inputs = signal(pushed.pushed(end, u_end), step.polynomials, 1).derivatives
                d_middle = discrete.filled(at_middle.d, d_middle)
                held = discrete.held(y_middle[0], d_middle, middle)
                following = self._piece(inputs, to_end, held, end)
                (late,) = self._requests.take(self._one_step, [following])
            else:
                inputs = signal(pushed.pushed(end, u_end), step.polynomials, 1).derivatives
                held = discrete.held(step.middle[0], d_middle, middle)
                at_middle, late = self._requests.take(
                    self._two_steps, [to_middle, self._piece(inputs, to_end, held, end)]
                )
                y_middle = self._merged(step.middle, at_middle.y)
                d_middle = discrete.filled(at_middle.d, d_middle)
                pushed = history.pushed(middle, self._coupled.inputs_of(y_middle))
        except BrokenOffError as broken_off:
            failed = broken_off.failed
            if failed.status is StepStatus.TERMINATED:
                raise
            remedy = remedy_without_rollback(failed.slave)
            raise unrepeatable(failed, start, first, remedy) from failed.error
        y_end = self._merged(step.end, late.y)
        return step._replace(
            middle=y_middle,
            end=y_end,
            history=pushed,
            end_inputs=self._coupled.inputs_of(y_end),
            discrete=(d_middle, discrete.filled(late.d, d_end)),
        )

    def _piece(self, inputs: FloatArray, step: DoStep, held: Held, end: float) -> Piece:
        external = self._coupled.external.over(step.communication_point, end)
        return Piece(lambda _: inputs, external, held, step)

    def _merged(self, y: FloatArray, late: FloatArray) -> FloatArray:
        """The outputs of the others with those of the late slaves."""
        merged = y.copy()
        merged[:, self._outputs] = late[:, self._outputs]
        return merged
