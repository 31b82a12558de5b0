"""How far the inputs at the ends of the small steps are from what their polynomials said."""

from __future__ import annotations

from master_node.coupling_scheme import CouplingScheme
from master_node.double_step import DoubleStep
from master_node.numerics.discontinuities import Defects, measure
from master_node.numerics.error_estimators import node_polynomial
from master_node.numerics.extrapolation import CouplingHistory, highest
from master_node.system import CoupledSystem
from protocol.signals import FloatArray


class InputDefects:
    """Measures the defects of one coupled system.

    Args:
        coupled: the system.
        scheme: how its slaves are coupled.
    """

    def __init__(self, coupled: CoupledSystem, scheme: CouplingScheme) -> None:
        self._coupled = coupled
        self._names = coupled.output_names
        self._extrapolation = scheme.extrapolation
        self._known_ahead = scheme.known_ahead

    def of(
        self,
        step: DoubleStep,
        scale: FloatArray,
        history: CouplingHistory,
        smooth: tuple[float, float] | None,
    ) -> Defects:
        """The defects of a double step.

        Args:
            step: the double step.
            scale: ATOL_j + RTOL_j |y_j| at its end, shape (m,), unit [y].
            history: up to T_n.
            smooth: step size and largest defect of the last accepted step; None: there is none.
        """
        times = step.times
        input_scale = self._coupled.scale_of_inputs(scale)
        foreseen_middle, foreseen_end = step.foreseen
        if self._known_ahead:  # interpolated inputs have no defect that would show a jump
            in_step = self._extrapolation.in_step
            foreseen_middle = in_step(history, step.polynomials, times.first).end[0]
            foreseen_end = in_step(step.history, step.polynomials, times.second).end[0]
        u_middle, u_end = step.history.inputs[0][0], step.end_inputs[0]
        middle, at_middle = measure(u_middle - foreseen_middle, input_scale)
        end, at_end = measure(u_end - foreseen_end, input_scale)
        if not max(middle, end) > 1.0:
            return Defects(middle, end)
        index, foreseen, before = at_end, foreseen_end, u_middle
        if middle > end:
            index, foreseen, before = at_middle, foreseen_middle, history.inputs[0][0]
        change = abs(foreseen[index] - before[index]) / input_scale[index]
        expected = middle * self._growth(step)
        if smooth is not None:
            size, largest = smooth
            order = highest(step.polynomials).order
            expected = max(expected, largest * (times.first / size) ** (order + 1))
        return Defects(middle, end, expected, float(change), index)

    def _growth(self, step: DoubleStep) -> float:
        """How much larger a defect at T_n + 2H is than at T_n + H where everything is smooth."""
        begin, middle, end = step.times[:3]
        past = step.history.times
        first = self._extrapolation.nodes(past[1:], step.polynomials, begin)
        second = self._extrapolation.nodes(past, step.polynomials, begin)
        return max(
            abs(node_polynomial(later, end - begin) / node_polynomial(earlier, middle - begin))
            for earlier, later in zip(first, second, strict=True)
        )

    def name(self, defects: Defects) -> str:
        """``slave.variable`` of the output behind the input with the largest defect."""
        return self._names[int(self._coupled.source[defects.input_number])]
