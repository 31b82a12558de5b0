"""Inputs of which the estimates tell nothing: the slaves that get them do not react to them.

A slave that waits for a threshold, or whose output is at a limit, gives the same outputs whatever
its inputs are. ERR is 0 then, H grows, and the inputs go wrong by any number of tolerances, so that
the threshold is met too late. Such inputs are judged by their defects, as those of slaves without
rollback are: they choose the order, and bound H.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.scheme import CouplingScheme
from master_node.judging.comparison import StepError
from master_node.judging.defects import DoubleStepShape
from master_node.numerics.defect_control import defect_coefficients, foreseen_step_size
from master_node.numerics.discontinuities import Defects, Inputs
from master_node.numerics.extrapolation import CouplingHistory, Polynomials
from master_node.numerics.order_control import LARGEST_FACTOR, SMALLEST_FACTOR
from master_node.stepping.double_step import DoubleStep

_REACTION = 1e-6
"""Error in tolerances per tolerance that an input is off: below, a slave does not react."""

Bound = Callable[[Polynomials], float]
"""The largest H with some polynomials over the present H."""


class UnansweredInputs:
    """Finds such inputs, and bounds H by their defects.

    Args:
        coupled: the system.
        scheme: how its slaves are coupled.
    """

    def __init__(self, coupled: CoupledSystem, scheme: CouplingScheme) -> None:
        self._coupled = coupled
        self._extrapolation = scheme.extrapolation
        self._shape = DoubleStepShape(scheme)
        can_follow = np.array([kind.max_order > 0 for kind in scheme.extrapolation.kinds])
        self._can_follow: Inputs = can_follow[scheme.extrapolation.kind_of_input]

    def of(self, defects: Defects, error: StepError) -> Inputs | None:
        """The inputs off by more than a tolerance of which ERR tells nothing, (n,); None: none."""
        if defects.are_within_tolerance:
            return None
        largest = defects.largest
        estimate = np.abs(error.estimate) / error.scale
        found = np.zeros(len(largest), dtype=bool)
        for part in self._coupled.parts:
            most = largest[part.input_slice].max(initial=0.0)
            if most > 1.0 and part.outputs:
                found[part.input_slice] = estimate[part.output_slice].max() <= _REACTION * most
        found &= self._can_follow & (largest > 0.0)
        return found if found.any() else None

    def bound(
        self, inputs: Inputs, history: CouplingHistory, step: DoubleStep, error: StepError
    ) -> Bound:
        """The bound that keeps defects of some inputs within their tolerances in the next step.

        Args:
            inputs: see `of`.
            history: up to the end of the double step.
            step: the double step.
            error: of it.
        """
        taken = step.times.first
        kinds = self._extrapolation.kind_of_input[inputs]
        scale = self._coupled.scale_of_inputs(error.scale)[inputs]
        number = len(self._extrapolation.kinds)

        def largest(polynomials: Polynomials) -> float:
            coefficients = defect_coefficients(self._extrapolation, history, polynomials)
            if coefficients is None:
                return SMALLEST_FACTOR
            sizes = np.zeros(number)
            np.maximum.at(sizes, kinds, coefficients[inputs] / scale)

            def norm(step_size: float) -> float:
                reach = self._shape.reach(history.times, polynomials, step_size)
                return max(size * abs(w) for size, w in zip(sizes.tolist(), reach, strict=True))

            bounds = (SMALLEST_FACTOR * taken, LARGEST_FACTOR * taken)
            return foreseen_step_size(norm, *bounds) / taken

        return largest
