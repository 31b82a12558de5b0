"""First step sizes, at the start and behind discontinuities, where no step tells one."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from master_node.judging.available_polynomials import AvailablePolynomials
from master_node.judging.comparison import ErrorControl
from master_node.judging.defects import CouplingDefects
from master_node.methods.base import Setup
from master_node.methods.judges import StepJudge
from master_node.methods.position import Position
from master_node.numerics.initial_step_size import (
    initial_step_size,
    trial_step_size,
    untried_step_size,
)
from master_node.numerics.step_size_limits import StepSizeLimits
from master_node.stepping.double_step import DoubleStep, DoubleStepper
from master_node.stepping.requests import FailedStep
from protocol.errors import DeadlineError
from protocol.signals import FloatArray

_INF = float("inf")
_TRIALS = 5

_COMPARABLE = 16.0
"""Factor by which a first H is above the smallest one, so that a smaller one tells a jump."""


class FirstStepSize(Protocol):
    """Chooses H where the past tells nothing."""

    def chosen(self, position: Position, largest: float) -> Position:
        """The position with an H for what is known there, ``largest`` at most [s]."""
        ...


class TriedStepSize:
    """H from double steps that are tried and taken back.

    Args:
        setup: of the run.
        limits: of its step sizes.
        stepper: takes the trials.
        judge: of their errors.
        control: says which outputs count, and how.
        available: the polynomials that a history allows.
    """

    def __init__(
        self,
        setup: Setup,
        limits: StepSizeLimits,
        *,
        stepper: DoubleStepper,
        judge: StepJudge,
        control: ErrorControl,
        available: AvailablePolynomials,
    ) -> None:
        self._coupled, self._scheme = setup.coupled, setup.scheme
        self._missing = setup.missing
        self._start, self._stop = setup.start, setup.system.simulation.end
        self._limits = limits
        self._stepper = stepper
        self._judge = judge
        self._control = control
        self._available = available

    def chosen(self, position: Position, largest: float) -> Position:
        """See `FirstStepSize`; the position has no slopes where they turn out to be missing."""
        y, stop = position.outputs.y, self._stop
        scale = self._coupled.controlled_scale(self._control.scale(y[0]))
        slope = np.where(self._scheme.trusts_derivative, y[1], np.nan) if len(y) > 1 else None
        trial = trial_step_size(y[0], slope, scale, stop - self._start)
        deadlines = 0
        for _ in range(_TRIALS):
            trial = min(trial, largest, (stop - position.time) / 2.0)
            times = self._limits.times(
                self._start, position.time, max(trial, self._limits.smallest), stop
            )
            polynomials = self._available.of(position.order.polynomial, position.history)
            step = self._stepper.attempt(position.history, times, polynomials, position.outputs)
            if isinstance(step, FailedStep) and isinstance(step.original_error, DeadlineError):
                deadlines += 1
                if deadlines > 1:
                    raise step.original_error
            if isinstance(step, FailedStep) and step.missing is not None:
                self._missing.note(step.missing, times.middle)
                position = position._replace(history=position.history.without_slopes())
                continue
            if isinstance(step, DoubleStep):
                error = self._judge.judge(step)
                if error.norm < _INF:
                    step_size = initial_step_size(
                        y[0],
                        step.middle[0],
                        step.end[0],
                        scale,
                        trial=times.first,
                        error_norm=error.norm,
                        exponent=self._control.exponent(polynomials),
                    )
                    step_size = max(step_size, _COMPARABLE * self._limits.smallest)
                    bounded = self._limits.bounded(min(step_size, largest))
                    return position._replace(step_size=bounded)
            trial = 0.1 * times.first
        return position._replace(step_size=self._limits.bounded(trial))


class UntriedStepSize:
    """H so small that the first step need not be taken back.

    Args:
        setup: of the run.
        limits: of its step sizes.
        coupling: defects of the inputs.
    """

    def __init__(self, setup: Setup, limits: StepSizeLimits, coupling: CouplingDefects) -> None:
        self._coupled = setup.coupled
        self._is_known = bool(setup.scheme.has_derivative.all())
        self._span = setup.system.simulation.end - setup.start
        self._limits = limits
        self._coupling = coupling

    def chosen(self, position: Position, largest: float) -> Position:
        """See `FirstStepSize`."""
        untried = self.step_size(position.outputs.y)
        return position._replace(step_size=self._limits.bounded(min(untried, largest)))

    def step_size(self, y: FloatArray) -> float:
        """H for outputs, shape (rows, m), before the bounds of the run [s]."""
        return untried_step_size(
            y[0],
            y[1] if len(y) > 1 and self._is_known else None,
            self._coupled.controlled_scale(self._coupling.scale(y[0])),
            self._span,
        )
