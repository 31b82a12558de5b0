"""A run that knows how stiff its coupling is, and iterates its double steps where it is.

Explicit double steps go on while the loop gain that they tell is small. Where it is large their
estimate is enlarged to what the loop makes of it, and after a few of them iterated double steps
take over, until the gain is small again (`coupling_memory.py`).
"""

from __future__ import annotations

import numpy as np

from master_node.coupling.outputs import Outputs
from master_node.judging.comparison import StepError
from master_node.judging.iterated import IteratedErrorControl
from master_node.methods.coupling_memory import BLIND, LASTING, CouplingMemory, explicit_jacobian
from master_node.numerics.collocation import MIDDLE
from master_node.numerics.discontinuities import Defects
from master_node.numerics.double_step_times import DoubleStepTimes
from master_node.numerics.error_estimators import ErrorEstimator
from master_node.numerics.extrapolation import CouplingHistory, Polynomials
from master_node.numerics.interface_jacobian import loop_gain_bound
from master_node.numerics.order_control import OrderMemory
from master_node.numerics.step_size_controller import NOTHING, ControllerMemory
from master_node.running.context import RunContext
from master_node.running.controlled_run import ControlledRun, Position
from master_node.stepping.double_step import DoubleStep
from master_node.stepping.iterated_step import IteratedStepper, NotConverged, interface_of
from master_node.stepping.requests import FailedStep

_WHOLE = 0.99
"""Part of the H that was wanted, below which something cut a double step short."""

_KEPT = 1.2
"""Growth of H up to which it stays as it is: the secants of a step of the same size fit."""

_SLOW = 6
"""Iterations from which on the next double step is made smaller."""

_SHORTER = 0.7
"""Factor of H after so many."""


class CouplingRun(ControlledRun):
    """See the module's docstring.

    Args:
        context: what to run.
        estimator: EST_Rich or EST_mod, for the explicit double steps.
        coupling: ``explicit``, ``implicit`` or ``auto``, see `SimulationSettings`.

    Raises:
        ConfigurationError: no step size follows the rules of all slaves.
    """

    def __init__(self, context: RunContext, estimator: ErrorEstimator, coupling: str) -> None:
        super().__init__(context, estimator)
        coupled = context.coupled
        self._method = coupling
        self._interface = interface_of(coupled)
        self._slave_of_source = coupled.output_slave[coupled.source]
        counts = [len(part.connected) for part in coupled.parts]
        self._slave_of_input = np.repeat(np.arange(len(counts)), counts)
        self._implicit = IteratedStepper(self._stepper.requests, coupled, context.scheme)
        self._iterated = IteratedErrorControl(coupled)

    def _first_position(self, outputs: Outputs) -> Position:
        position = super()._first_position(outputs)
        if self._method != "implicit":
            return position
        return position._replace(coupling=CouplingMemory(True, self._implicit.secants))

    def _attempt(
        self, position: Position, times: DoubleStepTimes
    ) -> tuple[Position, Polynomials, DoubleStep | FailedStep]:
        coupling = position.coupling
        if not coupling.is_implicit:
            return super()._attempt(position, times)
        if self._limits.quantum is None:
            moved = times.with_middle(MIDDLE)
            if max(moved.first, moved.second) <= self._limits.largest:
                times = moved
        step = self._implicit.attempt(position.history, times, coupling.secants, position.outputs)
        if isinstance(step, NotConverged):
            learnt = coupling._replace(secants=step.secants)
            return position._replace(coupling=learnt), step.polynomials, step.failed
        return position, step.polynomials, step

    def _judge(self, step: DoubleStep) -> StepError:
        if step.iteration is not None:
            return self._iterated.judge(step)
        error = super()._judge(step)
        inputs, outputs = step.input_difference, step.comparison - step.end[0]
        scale = self._coupled.scale_of_inputs(error.scale)
        answers = self._coupled.changes_of_inputs(outputs) / scale
        slaves = self._slave_of_input, self._slave_of_source
        if loop_gain_bound(inputs / scale, answers, *slaves) < LASTING:
            return error
        jacobian = explicit_jacobian(self._interface, inputs, outputs, scale)
        gain = jacobian.loop_gain
        if gain < BLIND:
            return error._replace(loop_gain=gain)
        enlarged = jacobian.enlargement(self._coupled.changes_of_inputs(error.estimate))
        difference = enlarged * error.difference
        return error._replace(difference=difference, norm=enlarged * error.norm, loop_gain=gain)

    def _decide(
        self, position: Position, step: DoubleStep, error: StepError, target: float
    ) -> Position:
        if step.iteration is None:
            coupling = position.coupling.noted(error.loop_gain)
            position = position._replace(coupling=coupling)
            if coupling.asks_for_iteration and self._method == "auto":
                reason = f"{error.limiting_variable}: stiff coupling"
                self._tell_rejected(step.times, step.polynomials, error.norm, reason)
                coupling = coupling.iterating(self._implicit.secants)
                return position._replace(coupling=coupling)
        return super()._decide(position, step, error, target)

    def _accept(
        self, position: Position, step: DoubleStep, error: StepError, defects: Defects | None
    ) -> Position:
        following = super()._accept(position, step, error, defects)
        return self._accepted(following, position.coupling, step, error)

    def _accept_jump(
        self, position: Position, step: DoubleStep, error: StepError, name: str
    ) -> Position:
        following = super()._accept_jump(position, step, error, name)
        return self._accepted(following, position.coupling, step, error)

    def _accepted(
        self, position: Position, coupling: CouplingMemory, step: DoubleStep, error: StepError
    ) -> Position:
        """The position with what an accepted double step says of the coupling; counts it."""
        iteration = step.iteration
        if iteration is None:
            self._statistics.stiff_double_steps += error.loop_gain >= BLIND
            return position._replace(coupling=coupling.after_explicit(step.times.step_size))
        self._statistics.iterated_double_steps += 1
        after = coupling.after_iterated(
            iteration.secants, iteration.number, step.times.step_size, iteration.loop_gain
        )
        if self._method == "implicit":
            after = CouplingMemory(True, iteration.secants)
        return position._replace(coupling=after)

    def _next(
        self,
        position: Position,
        step: DoubleStep,
        error: StepError,
        defects: Defects | None,
        history: CouplingHistory,
    ) -> tuple[float, OrderMemory, ControllerMemory]:
        iteration = step.iteration
        if iteration is None:
            return super()._next(position, step, error, defects, history)
        factor = self._controller.elementary_factor(error.norm, iteration.collocation.order)
        if 1.0 <= factor < _KEPT or (factor > 1.0 and position.controller.rejected):
            factor = 1.0
        if iteration.number >= _SLOW:
            factor = min(factor, _SHORTER)
        following = step.times.step_size * factor
        if step.times.step_size < _WHOLE * position.step_size:
            following = max(following, position.step_size)
        return self._controller.bounded(following), self._restarted_order(), NOTHING

    def _smaller(
        self, position: Position, step: DoubleStep, error: StepError
    ) -> tuple[float, ControllerMemory]:
        iteration = step.iteration
        if iteration is None:
            return super()._smaller(position, step, error)
        factor = self._controller.elementary_factor(error.norm, iteration.collocation.order)
        following = self._controller.bounded(step.times.step_size * factor)
        return following, ControllerMemory(rejected=True)
