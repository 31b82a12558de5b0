"""ERR of an iterated double step: Milne's device on the coupled variables.

Its inputs have been predicted from past points, and are known when the iteration has converged.
Both have errors of the same order, so their distance tells the error (`numerics/collocation.py`).
It sees what a comparison of two solutions cannot: a slow exchange that both follow alike.
"""

from __future__ import annotations

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem
from master_node.judging.comparison import StepError
from master_node.numerics.norms import error_scale, weighted_rms_norm
from master_node.stepping.double_step import DoubleStep

TARGET = 0.25
"""Local error that counts as ERR = 1, in units of the tolerance: a stiff exchange hands local
errors on with hardly any damping, and so keeps the global one below three tolerances
(``python -m benchmarks stiff``)."""


class IteratedErrorControl:
    """Judges the iterated double steps of one coupled system.

    Args:
        coupled: the system, with its tolerances.
    """

    def __init__(self, coupled: CoupledSystem) -> None:
        self._coupled = coupled
        self._sources, self._first_input = np.unique(coupled.source, return_index=True)

    def judge(self, step: DoubleStep) -> StepError:
        """EST and ERR of a converged double step; outputs that are not connected do not count."""
        assert step.iteration is not None  # it was iterated
        coupled, chosen, sources = self._coupled, self._first_input, self._sources
        y = step.end[0]
        scale = coupled.controlled_scale(
            error_scale(y, coupled.absolute_tolerance, coupled.relative_tolerance)
        )
        known, middle = (inputs[0] for inputs in step.history.inputs[1::-1])
        found, predicted = np.array((middle, step.end_inputs[0])), np.array(step.foreseen)
        error = step.iteration.collocation.error(known, found, predicted)
        difference = np.zeros_like(y)
        difference[sources] = error[chosen] / coupled.factor[chosen]
        norm, index = weighted_rms_norm(difference[sources], TARGET * scale[sources])
        name = coupled.output_names[int(sources[index])]
        return StepError(difference, 0.0, scale, norm, name)
