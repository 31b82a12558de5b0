"""How far the inputs at the ends of the small steps are from what their polynomials said."""

from __future__ import annotations

from master_node.coupling_scheme import CouplingScheme
from master_node.double_step import DoubleStep
from master_node.error_control import ErrorControl
from master_node.numerics.discontinuities import Defects, measure
from master_node.numerics.error_estimators import node_polynomial
from master_node.numerics.extrapolation import CouplingHistory
from master_node.system import CoupledSystem
from protocol.signals import FloatArray


class InputDefects:
    """Measures the defects of one coupled system.

    Args:
        coupled: the system.
        scheme: how its slaves are coupled.
        control: its error control, for the weights.
    """

    def __init__(
        self, coupled: CoupledSystem, scheme: CouplingScheme, control: ErrorControl
    ) -> None:
        self._coupled = coupled
        self._names = coupled.output_names
        self._extrapolation = scheme.extrapolation
        self._known_ahead = scheme.known_ahead
        self._control = control

    def of(
        self,
        step: DoubleStep,
        history: CouplingHistory,
        y: FloatArray,
        smooth: tuple[float, float] | None,
    ) -> Defects:
        """The defects of a double step.

        Args:
            step: the double step.
            history: up to T_n.
            y: outputs there, shape (rows, m).
            smooth: step size and largest defect of the last accepted step; None: there is none.
        """
        coupled, times = self._coupled, step.times
        weights = coupled.weights_of_inputs(self._control.weights(step.end[0]))
        first, second = step.signals
        if self._known_ahead:  # interpolated inputs have no defect that would show a jump
            first = self._extrapolation.signal(history, step.polynomials)
            second = self._extrapolation.signal(step.history, step.polynomials)
        u_middle, u_end = coupled.inputs_of(step.middle[0]), coupled.inputs_of(step.end[0])
        foreseen_middle, foreseen_end = first.at(times.first), second.at(times.second)
        middle, at_middle = measure(u_middle - foreseen_middle, weights)
        end, at_end = measure(u_end - foreseen_end, weights)
        change = foreseen_end - u_middle
        index = at_end
        if middle > end:
            change = foreseen_middle - coupled.inputs_of(y[0])
            index = at_middle
        expected = middle * self._growth(step)
        if smooth is not None:
            before, largest = smooth
            order = max(polynomial.order for polynomial in step.polynomials)
            expected = max(expected, largest * (times.first / before) ** (order + 1))
        foreseen = float(abs(change[index]) * weights[index]) if len(weights) else 0.0
        return Defects(middle, end, expected, foreseen, index)

    def _growth(self, step: DoubleStep) -> float:
        """How much larger a defect at T_n + 2H is than at T_n + H where everything is smooth."""
        begin, middle, end, _, _ = step.times
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
