"""A run with slaves that can go back and slaves that cannot.

The first take double steps as in any `ControlledRun`: rejections, jumps and the first step size
concern them alone. When a double step of theirs is accepted, the others follow. What crosses
between the two is judged by its defects afterwards, and bounds the next H.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from master_node.coupling.outputs import Outputs
from master_node.judging.available_polynomials import AvailablePolynomials
from master_node.judging.comparison import ErrorControl, PartialErrorControl, StepError
from master_node.judging.defects import CouplingDefects, DoubleStepShape
from master_node.judging.order import OrderSelection
from master_node.judging.unanswered_inputs import Bound
from master_node.numerics.discontinuities import Defects
from master_node.numerics.error_estimators import ErrorEstimator
from master_node.numerics.extrapolation import CouplingHistory, InputPolynomial
from master_node.numerics.initial_step_size import untried_step_size
from master_node.numerics.order_control import LARGEST_FACTOR, SMALLEST_FACTOR, Candidate
from master_node.running.context import RunContext
from master_node.running.controlled_run import ControlledRun, Position
from master_node.stepping.double_step import DoubleStep, DoubleStepper, PartialDoubleStepper
from master_node.stepping.follower_slaves import LateSlaves
from master_node.stepping.requests import BrokenOffError

if TYPE_CHECKING:
    from master_node.system.simulation import SimulationSettings

_INF = float("inf")


class MixedRun(ControlledRun):
    """See the module's docstring.

    Args:
        context: what to run.
        estimator: EST_Rich or EST_mod, for the slaves that can go back.

    Raises:
        ConfigurationError: no step size follows the rules of all slaves.
    """

    def __init__(self, context: RunContext, estimator: ErrorEstimator) -> None:
        coupled, scheme = context.coupled, context.scheme
        shape = DoubleStepShape(scheme)
        self._late_slaves = LateSlaves(context.group, coupled, scheme)
        self._coupling = CouplingDefects(coupled, scheme, shape)
        super().__init__(context, estimator)

    def run(self, outputs: Outputs) -> str:
        """See `ControlledRun`."""
        try:
            return super().run(outputs)
        except BrokenOffError as broken_off:  # a late slave's wish
            time = self._statistics.time
            return f"{broken_off.failed.slave} ended the simulation after t={time!r} s"

    def _make_stepper(self, context: RunContext, estimator: ErrorEstimator) -> DoubleStepper:
        return PartialDoubleStepper(context.group, context.coupled, context.scheme, estimator)

    def _make_control(self, context: RunContext, estimator: ErrorEstimator) -> ErrorControl:
        constants = context.system.simulation.constants
        return PartialErrorControl(context.coupled, context.scheme, estimator, constants)

    def _make_available(
        self, context: RunContext, estimator: ErrorEstimator
    ) -> AvailablePolynomials:
        return AvailablePolynomials(context.scheme.extrapolation, estimator, self._coupling)

    def _make_orders(self, context: RunContext) -> OrderSelection:
        settings = context.system.simulation
        return _MixedOrderSelection(
            context, self._control, self._available, settings, self._coupling
        )

    def _depth(self, points: int) -> int:
        return super()._depth(points) + 2  # defects are known of the polynomials two points ago

    def _with_initial_step_size(self, position: Position, largest: float) -> Position:
        """The position with an H so small that the first step need not be taken back."""
        y, settings = position.outputs.y, self._settings
        untried = untried_step_size(
            y[0],
            y[1] if len(y) > 1 and self._scheme.has_derivative.all() else None,
            self._coupled.controlled_scale(self._coupling.scale(y[0])),
            settings.end - self._start,
        )
        return position._replace(step_size=self._controller.bounded(min(untried, largest)))

    def _accept(
        self, position: Position, step: DoubleStep, error: StepError, defects: Defects | None
    ) -> Position:
        step = self._late_slaves.follow(position.history, position.outputs, step)
        u_middle, u_end = map(self._coupled.inputs_of, (step.middle, step.end))
        coupling = self._coupling.judge(
            position.history,
            step.polynomials,
            ((step.times.middle, u_middle), (step.times.end, u_end)),
            step.end[0],
        )
        if coupling.norm > error.norm:
            error = error._replace(norm=coupling.norm, limiting_variable=coupling.limiting_variable)
        if not error.norm <= 1.0:
            self._statistics.steps_above_tolerance += 1
        if coupling.has_jumped and self._settings.discontinuities:
            name = f"{coupling.limiting_variable} jumps"
            return super()._accept_jump(position, step, error, name)
        following = super()._accept(position, step, error, defects)
        if len(following.history.times) == 1:  # cut: nothing is known of the next defects
            return self._with_initial_step_size(following, following.step_size)
        taken = step.times.first
        bound = self._coupling.step_size(
            following.history,
            self._polynomials(following),
            following.outputs.y[0],
            smallest=min(SMALLEST_FACTOR * taken, following.step_size),
            largest=following.step_size,
        )
        return following._replace(step_size=self._controller.bounded(bound))

    def _accept_jump(
        self, position: Position, step: DoubleStep, error: StepError, name: str
    ) -> Position:
        if error.norm < _INF:
            step = self._late_slaves.follow(position.history, position.outputs, step)
        return super()._accept_jump(position, step, error, name)


class _MixedOrderSelection(OrderSelection):
    """Bounds each polynomial's H by the defects that it would have."""

    def __init__(
        self,
        context: RunContext,
        control: ErrorControl,
        available: AvailablePolynomials,
        settings: SimulationSettings,
        coupling: CouplingDefects,
    ) -> None:
        super().__init__(
            context.coupled,
            context.scheme,
            control=control,
            available=available,
            largest=settings.polynomial,
            alpha=settings.alpha,
        )
        self._coupling = coupling

    def _bounds(
        self,
        candidates: Sequence[Candidate],
        history: CouplingHistory,
        step: DoubleStep,
        bound: Bound | None,
    ) -> Mapping[InputPolynomial, float]:
        taken = step.times.first
        others = super()._bounds(candidates, history, step, bound)
        bounds = {}
        for polynomial in (candidate.polynomial for candidate in candidates):
            by_defects = self._coupling.step_size(
                history,
                self._available.of(polynomial, history),
                step.end[0],
                smallest=SMALLEST_FACTOR * taken,
                largest=LARGEST_FACTOR * taken,
            )
            bounds[polynomial] = min(by_defects / taken, others.get(polynomial, _INF))
        return bounds
