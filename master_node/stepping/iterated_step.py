"""The iterated double step: its inputs agree with the outputs at both of its nodes.

The inputs of both small steps are one polynomial (`numerics/collocation.py`). Its unknown values at
the nodes are found by iteration: all slaves go back to T_n, take both small steps with the inputs
as they are supposed, and tell their outputs; from these the inputs are corrected
(`numerics/interface_jacobian.py`). One request to each slave, one round trip for an iteration:

    SetState, SetInputs(U), DoStep(T, c 2H), GetOutputs, SetInputs(U), DoStep(T + c 2H, ...), ...

Discrete inputs are held in each small step at the values that belong to its beginning; those in
the middle are iterated too, until they do not change.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.outputs import Outputs
from master_node.coupling.scheme import CouplingScheme
from master_node.numerics.collocation import NODES, Collocation
from master_node.numerics.double_step_times import DoubleStepTimes
from master_node.numerics.extrapolation import (
    CouplingHistory,
    InputPolynomial,
    Polynomials,
    StepInputs,
)
from master_node.numerics.interface_jacobian import (
    Correction,
    Interface,
    InterfaceJacobian,
    Secants,
)
from master_node.numerics.norms import error_scale
from master_node.stepping.double_step import DoubleStep, Iteration
from master_node.stepping.requests import BrokenOffError, FailedStep, Piece, StepForm, StepRequests
from protocol.calls import DoStep
from protocol.errors import StepRejectedError
from protocol.signals import FloatArray

MOST_ITERATIONS = 8
"""After so many a double step is given up, and tried again with a smaller H."""

CONVERGED = 0.01
"""Correction of the inputs, in units of their tolerances, at which an iteration ends."""

_SMALLEST_SECANT = 1e-3
"""Difference of the inputs, in units of their tolerances, below which outputs tell nothing."""

_NAN = float("nan")


class NotConverged(NamedTuple):
    """An iteration that led to no solution.

    Attributes:
        polynomials: of the inputs, for each kind.
        failed: why.
        secants: that were gathered by then.
    """

    polynomials: Polynomials
    failed: FailedStep
    secants: tuple[Secants, ...]


class IteratedStepper:
    """Takes iterated double steps; holds only what the slaves have saved.

    Args:
        requests: to the slaves.
        coupled: their connections.
        scheme: how their outputs are read.

    Attributes:
        secants: of each slave, before the first iteration.
    """

    def __init__(
        self, requests: StepRequests, coupled: CoupledSystem, scheme: CouplingScheme
    ) -> None:
        self._requests = requests
        self._coupled = coupled
        outputs = scheme.get_outputs
        self._form = requests.form((StepForm(None, outputs), StepForm((), outputs)))
        self._kinds = len(scheme.extrapolation.kinds)
        self._interface = interface_of(coupled)
        self._most = [NODES * len(part.connected) + MOST_ITERATIONS for part in coupled.parts]
        self.secants = (Secants(),) * len(coupled.parts)

    def attempt(
        self,
        history: CouplingHistory,
        times: DoubleStepTimes,
        secants: tuple[Secants, ...],
        begin: Outputs,
    ) -> DoubleStep | NotConverged:
        """One iterated double step from the newest point of ``history``.

        Args:
            history: inputs at the communication points up to T_n.
            times: of the double step.
            secants: that are known of each slave.
            begin: outputs at T_n.

        Returns:
            The solution, or why there is none. Unless the state at T_n is forgotten, the next
            attempt goes back to it first.

        Raises:
            DoublestepError: a slave is lost, or failed in a way that a smaller step cannot help.
        """
        coupled, discrete = self._coupled, self._coupled.discrete
        collocation = Collocation.over(history, times)
        polynomials = (InputPolynomial(collocation.order - 1),) * self._kinds
        tolerances = error_scale(begin.y[0], coupled.absolute_tolerance, coupled.relative_tolerance)
        scale = np.tile(coupled.scale_of_inputs(tolerances), (NODES, 1))
        inputs = predicted = collocation.predicted(history)
        before: tuple[FloatArray, FloatArray] | None = None
        middle = begin
        for number in range(1, MOST_ITERATIONS + 1):
            try:
                in_steps = collocation.step_inputs(history, inputs)
                at_middle, end = self._evaluate(in_steps, times, begin, middle)
            except BrokenOffError as broken_off:
                return NotConverged(polynomials, broken_off.failed, secants)
            except StepRejectedError as error:  # of an external input, before anything was sent
                return NotConverged(polynomials, FailedStep("", None, _NAN, error.cause), secants)
            outputs = np.array((at_middle.y[0], end.y[0]))
            if before is not None:
                secants = self._learnt(secants, inputs - before[0], outputs - before[1], scale)
            before = inputs, outputs
            jacobian = InterfaceJacobian(secants, self._interface, scale)
            correction = jacobian.correction(self._inputs_of(outputs) - inputs)
            d_middle = discrete.filled(at_middle.d, begin.d)
            is_settled = not discrete.holds_inputs or d_middle == middle.d
            middle = Outputs(at_middle.y, d_middle)
            if is_settled and max(correction.size, correction.unknown) <= CONVERGED:
                return DoubleStep(
                    times,
                    polynomials,
                    middle.y,
                    end.y,
                    end.y[0],
                    history.pushed(times.middle, coupled.inputs_of(middle.y)),
                    coupled.inputs_of(end.y),
                    (predicted[0], predicted[1]),
                    np.zeros_like(predicted[1]),
                    (d_middle, discrete.filled(end.d, d_middle)),
                    Iteration(collocation, secants, number, self._loop_gain(jacobian, secants)),
                )
            inputs = inputs + correction.inputs
            if not np.isfinite(inputs).all():
                break
        return NotConverged(polynomials, self._failure(correction, scale), secants)

    def _evaluate(
        self, in_steps: StepInputs, times: DoubleStepTimes, begin: Outputs, middle: Outputs
    ) -> list[Outputs]:
        """Outputs at both nodes: one request to each slave."""
        discrete, over = self._coupled.discrete, self._coupled.external.over
        first = Piece(
            lambda _: in_steps.begin,
            over(times.begin, times.middle),
            discrete.held(begin.y[0], begin.d, times.begin),
            DoStep(times.begin, times.first, True),
        )
        second = Piece(
            lambda _: in_steps.end,
            over(times.middle, times.end),
            discrete.held(middle.y[0], middle.d, times.middle),
            DoStep(times.middle, times.second, False),
        )
        return self._requests.request(self._form, (first, second))

    def _inputs_of(self, outputs: FloatArray) -> FloatArray:
        """Inputs at the nodes, shape (nodes, n), that belong to outputs, shape (nodes, m)."""
        return np.array([self._coupled.inputs_of(y) for y in outputs])

    def _learnt(
        self,
        secants: tuple[Secants, ...],
        inputs: FloatArray,
        outputs: FloatArray,
        scale: FloatArray,
    ) -> tuple[Secants, ...]:
        """With the differences between two evaluations, shape (nodes, n) and (nodes, m)."""
        is_large = np.abs(inputs / scale) > _SMALLEST_SECANT
        return tuple(
            own.pushed(inputs[:, columns].ravel(), outputs[:, rows].ravel(), most)
            if is_large[:, columns].any()
            else own
            for own, columns, rows, most in zip(
                secants,
                self._interface.input_slices,
                self._interface.output_slices,
                self._most,
                strict=True,
            )
        )

    def _loop_gain(self, jacobian: InterfaceJacobian, secants: tuple[Secants, ...]) -> float:
        """Infinite where nothing is known of a slave yet."""
        is_known = all(
            own.inputs or not part.connected
            for own, part in zip(secants, self._coupled.parts, strict=True)
        )
        return jacobian.loop_gain if is_known else float("inf")

    def _failure(self, correction: Correction, scale: FloatArray) -> FailedStep:
        worst = int(np.argmax(np.abs(correction.inputs / scale).max(axis=0)))
        name = self._coupled.output_names[int(self._coupled.source[worst])]
        return FailedStep("", None, _NAN, f"{name}: the iteration of the inputs does not converge")


def interface_of(coupled: CoupledSystem) -> Interface:
    """Connected inputs and outputs of each slave."""
    return Interface(
        [part.input_slice for part in coupled.parts],
        [part.output_slice for part in coupled.parts],
        len(coupled.output_names),
        coupled.changes_of_inputs,
    )
