"""Order and step size of the next double step, after one was accepted or rejected."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from master_node.judging.available_polynomials import AvailablePolynomials
from master_node.judging.comparison import ErrorControl, StepError
from master_node.judging.order import OrderSelection
from master_node.judging.unanswered_inputs import Bound, UnansweredInputs
from master_node.methods.base import Setup
from master_node.methods.position import Position
from master_node.numerics.discontinuities import Defects
from master_node.numerics.extrapolation import CouplingHistory
from master_node.numerics.order_control import OrderMemory
from master_node.numerics.step_size_controller import (
    EXPONENTS,
    NOTHING,
    ControllerMemory,
    StepSizeController,
)
from master_node.numerics.step_size_limits import StepSizeLimits
from master_node.stepping.double_step import DoubleStep
from master_node.system.simulation import SimulationSettings

_WHOLE = 0.99
"""Part of the H that was wanted, below which something cut a double step short."""

_KEPT = 1.2
"""Growth of H up to which it stays as it is: the secants of a step of the same size fit."""

_SLOW = 6
"""Iterations from which on the next double step is made smaller."""

_SHORTER = 0.7
"""Factor of H after so many."""


class NextStep(NamedTuple):
    """Choice for the double step that follows an accepted one.

    Attributes:
        step_size: H [s].
        order: memory of the order control; holds the polynomial.
        controller: memory of the step size controller.
    """

    step_size: float
    order: OrderMemory
    controller: ControllerMemory


class StepSizeChoice(Protocol):
    """Chooses H and the order."""

    def after_acceptance(
        self,
        position: Position,
        step: DoubleStep,
        error: StepError,
        defects: Defects | None,
        history: CouplingHistory,
    ) -> NextStep:
        """For the double step that follows an accepted one.

        Args:
            position: from which it was taken.
            step: the accepted double step.
            error: of it.
            defects: of its inputs; None: they are not looked at.
            history: up to its end.
        """
        ...

    def after_rejection(
        self, position: Position, step: DoubleStep, error: StepError
    ) -> tuple[float, ControllerMemory]:
        """H [s] for the next attempt from the same position."""
        ...


def controller(settings: SimulationSettings, limits: StepSizeLimits) -> StepSizeController:
    """The step size controller of a run."""
    present, past = EXPONENTS[settings.controller]
    return StepSizeController(
        settings.alpha,
        settings.theta_min,
        settings.theta_max,
        limits.smallest,
        limits.largest,
        present,
        past,
        grows_after_rejection=settings.controller == "elementary",
    )


class ExtrapolatedChoice:
    """The choice by the error of extrapolated double steps.

    Args:
        setup: of the run.
        limits: of its step sizes.
        control: estimates the errors.
        available: the polynomials that a history allows.
        orders: chooses polynomials; None: the order is given.
    """

    def __init__(
        self,
        setup: Setup,
        limits: StepSizeLimits,
        *,
        control: ErrorControl,
        available: AvailablePolynomials,
        orders: OrderSelection | None,
    ) -> None:
        self._settings = setup.system.simulation
        self._limits = limits
        self._control = control
        self._available = available
        self._orders = orders
        self._controller = controller(self._settings, limits)
        self._unanswered = UnansweredInputs(setup.coupled, setup.scheme)

    def after_acceptance(
        self,
        position: Position,
        step: DoubleStep,
        error: StepError,
        defects: Defects | None,
        history: CouplingHistory,
    ) -> NextStep:
        """See `StepSizeChoice`."""
        times, polynomials = step.times, step.polynomials
        _, following, memory = self._controller.decide(
            times.first, error.norm, self._control.exponent(polynomials), position.controller
        )
        is_cut_short = self._limits.is_cut_short(times, position.step_size)
        if is_cut_short:  # by a target or a bracket
            following = max(following, position.step_size)
        order, bound = position.order, self._bound(step, error, defects, history)
        is_searching = position.search.end is not None
        if self._orders is not None and not (is_searching and is_cut_short):
            order, factor = self._orders.choose(order, step, error, history, bound)
            if factor is not None:
                factor = min(factor, self._settings.theta_max)
                if position.controller.rejected:
                    factor = min(factor, 1.0)
                following = self._limits.bounded(times.first * factor)
                memory = NOTHING
        if bound is not None and order.polynomial.order:  # constants would ask for any number
            polynomials = self._available.of(order.polynomial, history)
            bounded = min(following, times.first * bound(polynomials))
            following = self._limits.bounded(bounded)
        return NextStep(following, order, memory)

    def _bound(
        self,
        step: DoubleStep,
        error: StepError,
        defects: Defects | None,
        history: CouplingHistory,
    ) -> Bound | None:
        """The bound of the next H by inputs of which ERR tells nothing; None: there is none."""
        inputs = None if defects is None else self._unanswered.of(defects, error)
        if inputs is None:
            return None
        return self._unanswered.bound(inputs, history, step, error)

    def after_rejection(
        self, position: Position, step: DoubleStep, error: StepError
    ) -> tuple[float, ControllerMemory]:
        """See `StepSizeChoice`."""
        exponent = self._control.exponent(step.polynomials)
        _, following, memory = self._controller.decide(
            step.times.first, error.norm, exponent, position.controller
        )
        return following, memory


class CoupledChoice:
    """The choice where double steps may be extrapolated or iterated ones.

    Args:
        setup: of the run.
        limits: of its step sizes.
        extrapolated: the choice after extrapolated double steps.
        restarted: order memory with which extrapolation begins.
    """

    def __init__(
        self,
        setup: Setup,
        limits: StepSizeLimits,
        extrapolated: StepSizeChoice,
        restarted: OrderMemory,
    ) -> None:
        self._limits = limits
        self._controller = controller(setup.system.simulation, limits)
        self._extrapolated = extrapolated
        self._restarted = restarted

    def after_acceptance(
        self,
        position: Position,
        step: DoubleStep,
        error: StepError,
        defects: Defects | None,
        history: CouplingHistory,
    ) -> NextStep:
        """See `StepSizeChoice`."""
        iteration = step.iteration
        if iteration is None:
            return self._extrapolated.after_acceptance(position, step, error, defects, history)
        factor = self._controller.elementary_factor(error.norm, iteration.collocation.order)
        if 1.0 <= factor < _KEPT or (factor > 1.0 and position.controller.rejected):
            factor = 1.0
        if iteration.number >= _SLOW:
            factor = min(factor, _SHORTER)
        following = step.times.step_size * factor
        if step.times.step_size < _WHOLE * position.step_size:
            following = max(following, position.step_size)
        return NextStep(self._limits.bounded(following), self._restarted, NOTHING)

    def after_rejection(
        self, position: Position, step: DoubleStep, error: StepError
    ) -> tuple[float, ControllerMemory]:
        """See `StepSizeChoice`."""
        iteration = step.iteration
        if iteration is None:
            return self._extrapolated.after_rejection(position, step, error)
        factor = self._controller.elementary_factor(error.norm, iteration.collocation.order)
        following = self._limits.bounded(step.times.step_size * factor)
        return following, ControllerMemory(rejected=True)
