"""From an attempted double step to a verdict: ERR, accepted or not, and the next step size."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from master_node.configuration import SimulationSettings
from master_node.double_step import DoubleStep, FailedStep
from master_node.numerics.error_estimators import ErrorEstimator
from master_node.numerics.norms import first_not_finite, weighted_rms_norm
from master_node.numerics.step_size_controller import StepSizeController
from master_node.system import CoupledSystem

_INF = float("inf")


class Verdict(NamedTuple):
    """What is made of an attempt.

    Attributes:
        accepted: whether to go on from its end.
        step_size: H for the next attempt [s].
        error_norm: ERR; inf when there is none.
        limiting_variable: ``slave.variable`` with the largest part in ERR, or why there is none.
    """

    accepted: bool
    step_size: float
    error_norm: float
    limiting_variable: str


class ErrorControl:
    """Equation (8) and the step size controller for one coupled system.

    Args:
        coupled: the system, with its tolerances.
        settings: of the controller.
        estimator: EST_Rich or EST_mod.
        orders: for each slave the highest degree of input polynomial that it takes.
    """

    def __init__(
        self,
        coupled: CoupledSystem,
        settings: SimulationSettings,
        estimator: ErrorEstimator,
        orders: Sequence[int],
    ) -> None:
        self._names = coupled.output_names
        self._absolute_tolerance = coupled.absolute_tolerance
        self._relative_tolerance = coupled.relative_tolerance
        self._estimate = estimator.estimate
        self._ratios = [
            estimator.ratio(np.minimum(np.array(orders), k)[coupled.output_slave])
            for k in range(settings.order + 1)
        ]
        smoothing = 1 if coupled.has_feed_through else 2
        self._exponents = [min(*orders, k) + smoothing for k in range(settings.order + 1)]
        self._controller = StepSizeController(
            settings.alpha,
            settings.theta_min,
            settings.theta_max,
            settings.smallest,
            settings.largest,
        )

    def judge(self, attempt: DoubleStep | FailedStep, step_size: float, order: int) -> Verdict:
        """The verdict on an attempt with ``step_size`` H [s] and input polynomials of ``order``."""
        if isinstance(attempt, FailedStep):
            following = self._controller.after_discard(step_size, attempt.reached)
            return Verdict(False, following, _INF, attempt.reason)
        y = attempt.y
        error = self._estimate(y, attempt.y_comparison, self._ratios[order])
        norm, index = weighted_rms_norm(
            error, y, self._absolute_tolerance, self._relative_tolerance
        )
        accepted, following = self._controller.decide(step_size, norm, self._exponents[order])
        limiting = self._names[index]
        if norm == _INF and first_not_finite(y) is not None:
            limiting += " is not finite"
        return Verdict(accepted, following, norm, limiting)
