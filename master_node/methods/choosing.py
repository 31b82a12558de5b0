"""Choice of the method that a system needs."""

from __future__ import annotations

from typing import Any

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.scheme import slaves_without_rollback
from master_node.coupling.step_sizes import step_size_limits
from master_node.judging.available_polynomials import AvailablePolynomials
from master_node.judging.comparison import ErrorControl
from master_node.judging.defects import CouplingDefects, DoubleStepShape
from master_node.judging.order import OrderSelection
from master_node.methods.base import Method, Setup
from master_node.methods.comparison import ComparedSteps, Parts
from master_node.methods.defects import DefectSteps
from master_node.methods.first_step_size import TriedStepSize, UntriedStepSize
from master_node.methods.fixed import FixedSteps
from master_node.methods.followers import FollowedSteps
from master_node.methods.iterated import IteratedSteps
from master_node.methods.judges import CoupledJudge, StepJudge
from master_node.methods.next_step_size import CoupledChoice, ExtrapolatedChoice, StepSizeChoice
from master_node.numerics.collocation import NODES
from master_node.numerics.error_estimators import ESTIMATORS, ErrorEstimator
from master_node.numerics.order_control import DEPTH, OrderMemory
from master_node.stepping.double_step import DoubleStepper, PartialDoubleStepper
from master_node.stepping.iterated_step import IteratedStepper
from master_node.system.system import System


def method_of(setup: Setup) -> Method[Any, Any]:
    """The method for a system and its settings.

    Raises:
        ConfigurationError: no step size follows the rules of all slaves.
    """
    estimator = ESTIMATORS.get(setup.system.simulation.estimator)
    if estimator is None:
        return FixedSteps(setup)
    if len(slaves_without_rollback(setup.coupled)) == len(setup.coupled.parts):
        return DefectSteps(setup)
    if setup.scheme.late_slaves:
        return _followed(setup, estimator)
    return _compared(setup, estimator)


def coupling_of(coupled: CoupledSystem, system: System) -> str:
    """``explicit``, ``implicit`` or ``auto``: as asked for, if all slaves can be iterated."""
    wanted = system.simulation.coupling
    orders = [part.max_order for part in coupled.parts if part.connected]
    return wanted if min(orders, default=0) >= NODES else "explicit"


def _compared(setup: Setup, estimator: ErrorEstimator) -> Method[Any, Any]:
    """Double steps of slaves that can all go back."""
    settings, coupled, scheme = setup.system.simulation, setup.coupled, setup.scheme
    limits = step_size_limits(setup.system)
    stepper = DoubleStepper(setup.group, coupled, scheme, estimator)
    control = ErrorControl(coupled, scheme, estimator, settings.constants)
    available = AvailablePolynomials(scheme.extrapolation, estimator)
    orders = _orders(setup, control, available)
    restarted = OrderMemory(settings.polynomial) if orders is None else orders.restart()
    choice: StepSizeChoice = ExtrapolatedChoice(
        setup, limits, control=control, available=available, orders=orders
    )
    judge: StepJudge = control
    is_coupled = settings.constants != "paper"
    if is_coupled:
        judge = CoupledJudge(coupled, control)
        choice = CoupledChoice(setup, limits, choice, restarted)
    first = TriedStepSize(
        setup, limits, stepper=stepper, judge=judge, control=control, available=available
    )
    parts = Parts(
        limits,
        stepper,
        available,
        judge,
        first,
        choice,
        *_depth(setup, estimator, keeps_most=orders is not None),
        restarted,
    )
    compared = ComparedSteps(setup, parts)
    if not is_coupled:
        return compared
    iterated = IteratedStepper(stepper.requests, coupled, scheme)
    return IteratedSteps(compared, iterated, coupling_of(coupled, setup.system))


def _followed(setup: Setup, estimator: ErrorEstimator) -> Method[Any, Any]:
    """Double steps of the slaves that can go back, with others that follow."""
    settings, coupled, scheme = setup.system.simulation, setup.coupled, setup.scheme
    limits = step_size_limits(setup.system)
    coupling = CouplingDefects(coupled, scheme, DoubleStepShape(scheme))
    stepper = PartialDoubleStepper(setup.group, coupled, scheme, estimator)
    control = ErrorControl(coupled, scheme, estimator, settings.constants)
    available = AvailablePolynomials(scheme.extrapolation, estimator, coupling)
    orders = _orders(setup, control, available, coupling)
    restarted = OrderMemory(settings.polynomial) if orders is None else orders.restart()
    depth, points = _depth(setup, estimator, keeps_most=orders is not None)
    parts = Parts(
        limits,
        stepper,
        available,
        control,
        UntriedStepSize(setup, limits, coupling),
        ExtrapolatedChoice(setup, limits, control=control, available=available, orders=orders),
        depth + 2,  # defects are known of the polynomials two points ago
        points,
        restarted,
    )
    return FollowedSteps(setup, ComparedSteps(setup, parts), coupling)


def _orders(
    setup: Setup,
    control: ErrorControl,
    available: AvailablePolynomials,
    coupling: CouplingDefects | None = None,
) -> OrderSelection | None:
    """Choice of polynomials; None: the order is given."""
    settings = setup.system.simulation
    if settings.order != "auto" or not setup.coupled.output_names:
        return None
    return OrderSelection(
        setup.coupled,
        setup.scheme,
        control=control,
        available=available,
        largest=settings.polynomial,
        alpha=settings.alpha,
        coupling=coupling,
    )


def _depth(setup: Setup, estimator: ErrorEstimator, *, keeps_most: bool) -> tuple[int, int]:
    """Numbers of communication points that are kept, and that polynomials need."""
    points = estimator.points(setup.system.simulation.polynomial.order + 1)
    depth = points + setup.scheme.known_ahead + 1  # and one that a step pushes out
    return max(depth, DEPTH if keeps_most else 0), points
