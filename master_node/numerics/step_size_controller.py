"""Accept or reject, and the next communication step size (the paper, section 3, and beyond)."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, isfinite, isnan, ulp
from typing import NamedTuple

from master_node.numerics.powers import power


def passes(error_norm: float) -> bool:
    """True if a step with this ERR is within the tolerance; never for NaN or infinity."""
    return error_norm <= 1.0


class ControllerMemory(NamedTuple):
    """Memory of a controller from one attempt to the next.

    Attributes:
        error_norm: ERR of the last accepted step; NaN when there is none to compare with.
        rejected: whether the last attempt was rejected.
    """

    error_norm: float = float("nan")
    rejected: bool = False


NOTHING = ControllerMemory()
"""Before the first attempt."""


class StepDecision(NamedTuple):
    """Decision of the controller on an attempt.

    Attributes:
        accepted: ERR <= 1; never for NaN or infinity.
        step_size: H for the next attempt [s], within the controller's bounds.
        memory: to hand in with the next attempt.
    """

    accepted: bool
    step_size: float
    memory: ControllerMemory


@dataclass(frozen=True, slots=True)
class StepSizeController:
    """H_opt = H min(theta_max, max(theta_min, alpha^(b_1+b_2) ERR^(-b_1/P) ERR_old^(-b_2/P))).

    With (b_1, b_2) = (1, 0) this is the paper's elementary controller, alpha ERR^(-1/P). A PI
    controller, (0.7, -0.4) after Gustafsson (Hairer and Wanner, Solving ODEs II, section IV.2),
    has the same steady state, reacts to how ERR changes, and so rejects less where the error
    varies smoothly. Rejected steps are always answered as the elementary controller does.

    Attributes:
        alpha: safety factor; the paper takes it from [0.8, 0.9].
        theta_min: largest reduction; from [0.2, 0.5].
        theta_max: largest growth; from [1.5, 5].
        smallest_step_size: H never falls below [s].
        largest_step_size: H never grows beyond [s].
        present: b_1, exponent of the present ERR.
        past: b_2, exponent of that of the accepted step before.
        grows_after_rejection: whether H may grow in the first step accepted after a rejection.
    """

    alpha: float
    theta_min: float
    theta_max: float
    smallest_step_size: float
    largest_step_size: float
    present: float = 1.0
    past: float = 0.0
    grows_after_rejection: bool = True

    def decide(
        self,
        step_size: float,
        error_norm: float,
        exponent: int,
        memory: ControllerMemory = NOTHING,
    ) -> StepDecision:
        """Judge an attempt with ``step_size`` H [s] by ERR.

        Args:
            step_size: H of the attempt [s].
            error_norm: ERR; NaN and infinity are rejections with the largest reduction.
            exponent: P = k + 1 if a slave has direct feed-through, else k + 2.
            memory: from the last decision.
        """
        before = memory.error_norm
        if not passes(error_norm):
            factor = self.elementary_factor(error_norm, exponent)
            following = ControllerMemory(before, rejected=True)
            return StepDecision(False, self.bounded(step_size * factor), following)
        if error_norm > 0.0 and before > 0.0:
            factor = power(self.alpha, self.present + self.past) * (
                power(error_norm, -self.present / exponent) * power(before, -self.past / exponent)
            )
            factor = min(self.theta_max, max(self.theta_min, factor))
        else:
            factor = self.elementary_factor(error_norm, exponent)
        if memory.rejected and not self.grows_after_rejection:
            factor = min(factor, 1.0)
        following = ControllerMemory(error_norm)
        return StepDecision(True, self.bounded(step_size * factor), following)

    def elementary_factor(self, error_norm: float, exponent: int) -> float:
        """H_opt / H of the elementary controller."""
        if error_norm == 0.0:
            return self.theta_max
        if not isfinite(error_norm):
            return self.theta_min
        optimal = self.alpha * power(error_norm, -1.0 / exponent)
        return min(self.theta_max, max(self.theta_min, optimal))

    def after_discard(self, step_size: float, reached: float) -> float:
        """H after a slave completed only the part ``reached`` of a step, 0 to 1 (NaN: unknown)."""
        part = 0.0 if isnan(reached) else min(max(reached, 0.0), 1.0)
        return self.bounded(step_size * max(self.theta_min, self.alpha * part))

    def bounded(self, step_size: float) -> float:
        """``step_size`` within the smallest and the largest one."""
        return min(self.largest_step_size, max(self.smallest_step_size, step_size))


EXPONENTS = {"pi": (0.7, -0.4), "elementary": (1.0, 0.0)}
"""(b_1, b_2) of the controllers by their names."""


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
    """Number of steps of H from ``start_time`` to ``stop_time``, a last shorter one included.

    Points start + n H and the stop time are sums with a few rounding errors: a remainder of that
    size is no step.
    """
    whole = round((stop_time - start_time) / step_size)
    rounding = 4.0 * ulp(max(abs(start_time), abs(stop_time)))
    if whole and abs(start_time + whole * step_size - stop_time) <= rounding:
        return whole
    return ceil((stop_time - start_time) / step_size)
