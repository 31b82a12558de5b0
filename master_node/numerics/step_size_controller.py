"""Accept or reject, and the next communication step size (the paper, section 3)."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, isfinite, isnan, ulp
from typing import NamedTuple


class StepDecision(NamedTuple):
    """What the controller says of an attempt.

    Attributes:
        accepted: ERR <= 1; never for NaN or infinity.
        step_size: H for the next attempt [s], within the controller's bounds.
    """

    accepted: bool
    step_size: float


@dataclass(frozen=True, slots=True)
class StepSizeController:
    """H_opt = H min(theta_max, max(theta_min, alpha ERR^(-1/P))).

    Attributes:
        alpha: safety factor; the paper takes it from [0.8, 0.9].
        theta_min: largest reduction; from [0.2, 0.5].
        theta_max: largest growth; from [1.5, 5].
        smallest_step_size: H never falls below [s].
        largest_step_size: H never grows beyond [s].
    """

    alpha: float
    theta_min: float
    theta_max: float
    smallest_step_size: float
    largest_step_size: float

    def decide(self, step_size: float, error_norm: float, exponent: int) -> StepDecision:
        """Judge an attempt with ``step_size`` H [s] by ERR.

        Args:
            step_size: H of the attempt [s].
            error_norm: ERR; NaN and infinity are rejections with the largest reduction.
            exponent: P = k + 1 if a slave has direct feed-through, else k + 2.
        """
        if error_norm == 0.0:
            factor = self.theta_max
        elif isfinite(error_norm):
            optimal = self.alpha * error_norm ** (-1.0 / exponent)
            factor = min(self.theta_max, max(self.theta_min, optimal))
        else:
            factor = self.theta_min
        return StepDecision(error_norm <= 1.0, self.bounded(step_size * factor))

    def after_discard(self, step_size: float, reached: float) -> float:
        """H after a slave completed only the part ``reached`` of a step, 0 to 1 (NaN: unknown)."""
        part = 0.0 if isnan(reached) else min(max(reached, 0.0), 1.0)
        return self.bounded(step_size * max(self.theta_min, self.alpha * part))

    def bounded(self, step_size: float) -> float:
        """``step_size`` within the smallest and the largest one."""
        return min(self.largest_step_size, max(self.smallest_step_size, step_size))


def last_step_size(time: float, stop_time: float, step_size: float) -> float:
    """H for a double step from T_n, so that the last one ends exactly on ``stop_time`` [s].

    When less than two double steps are left they share what is left, so that the last one is not
    arbitrarily small. The caller sets the end point of a step that reaches ``stop_time``.
    """
    left = stop_time - time
    if 2.0 * step_size >= left:
        return left / 2.0
    if 4.0 * step_size > left:
        return left / 4.0
    return step_size


def fixed_steps(start_time: float, stop_time: float, step_size: float) -> int:
    """How many steps of H lead from ``start_time`` to ``stop_time``, a last shorter one included.

    Points start + n H and the stop time are sums with a few rounding errors: a remainder of that
    size is no step.
    """
    whole = round((stop_time - start_time) / step_size)
    rounding = 4.0 * ulp(max(abs(start_time), abs(stop_time)))
    if whole and abs(start_time + whole * step_size - stop_time) <= rounding:
        return whole
    return ceil((stop_time - start_time) / step_size)
