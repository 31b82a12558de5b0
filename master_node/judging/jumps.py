"""Distances of inputs at the ends of the small steps from what their polynomials said."""

from __future__ import annotations

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.scheme import CouplingScheme
from master_node.judging.comparison import StepError
from master_node.numerics.discontinuities import Defects, Inputs, SmoothStep
from master_node.numerics.error_estimators import node_polynomial
from master_node.numerics.extrapolation import CouplingHistory, highest
from master_node.stepping.double_step import DoubleStep
from protocol.signals import FloatArray

_GAIN = 1e6
"""Tolerances by which an output jumps, at most, that answers to an input that is off by one."""


_LATE = 10.0
"""Tolerances by which an input is off that a slave should have answered to earlier."""


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
        self._is_ahead = np.array([kind.ahead for kind in scheme.extrapolation.kinds])[
            scheme.extrapolation.kind_of_input
        ]
        self._is_direct = scheme.feed_through.take(coupled.source)
        self._has_direct = bool(self._is_direct.any())
        self._none = np.zeros(len(coupled.source))
        self._slave_behind = coupled.output_slave.take(coupled.source)
        self.number = len(coupled.source)

    def of(
        self,
        step: DoubleStep,
        scale: FloatArray,
        history: CouplingHistory,
        smooth: SmoothStep | None,
    ) -> Defects:
        """The defects of a double step.

        Args:
            step: the double step.
            scale: ATOL_j + RTOL_j |y_j| at its end, shape (m,), unit [y].
            history: up to T_n.
            smooth: the last accepted step; None: there is none.
        """
        times = step.times
        input_scale = self._coupled.scale_of_inputs(scale)
        foreseen_middle, foreseen_end = step.foreseen
        if self._known_ahead:  # interpolated inputs have no defect that would show a jump
            in_step = self._extrapolation.in_step
            foreseen_middle = in_step(history, step.polynomials, times.first).end[0]
            foreseen_end = in_step(step.history, step.polynomials, times.second).end[0]
        u_middle, u_end = step.history.inputs[0][0], step.end_inputs[0]
        middle = np.abs(u_middle - foreseen_middle) / input_scale
        end = np.abs(u_end - foreseen_end) / input_scale
        if not (middle > 1.0).any() and not (end > 1.0).any():
            return Defects.within_tolerance(middle, end, input_scale)
        expected = (
            np.full(self.number, np.inf)
            if smooth is None
            else smooth.expected(times.first, highest(step.polynomials).order)
        )
        grown = middle * self._growth(step)
        return Defects(
            middle,
            end,
            np.abs(foreseen_middle - history.inputs[0][0]) / input_scale,
            np.abs(foreseen_end - u_middle) / input_scale,
            expected,
            grown if smooth is None else np.maximum(expected, grown),
            input_scale,
        )

    def _growth(self, step: DoubleStep) -> FloatArray:
        """Defects at T_n + 2H over those at T_n + H where all is smooth, shape (n,)."""
        begin, middle, end = step.times[:3]
        past = step.history.times
        first = self._extrapolation.nodes(past[1:], step.polynomials, begin)
        second = self._extrapolation.nodes(past, step.polynomials, begin)
        growth = [
            abs(node_polynomial(later, end - begin) / node_polynomial(earlier, middle - begin))
            for earlier, later in zip(first, second, strict=True)
        ]
        return np.array(growth)[self._extrapolation.kind_of_input]

    def of_accepted(self, step: DoubleStep, defects: Defects, error: StepError) -> SmoothStep:
        """The defects to come, as an accepted double step lets expect them."""
        echoes, corrections = self._none, defects.end
        if self._has_direct:
            weighted = np.abs(error.estimate).take(self._coupled.source)
            weighted *= np.abs(self._coupled.factor)
            weighted /= self._coupled.scale_of_inputs(error.scale)
            echoes = np.where(self._is_direct, weighted, 0.0)
        if self._known_ahead:
            corrections = np.where(self._is_ahead, 0.0, corrections)
        return SmoothStep(step.times.first, defects.largest, echoes, corrections)

    def are_answers(self, defects: Defects, jumping: Inputs, smooth: SmoothStep | None) -> bool:
        """Tell whether inputs that jump at T_n are outputs that answer there to other inputs.

        The polynomials of these had gone wrong by more than rounding up to T_n, where the next ones
        begin with the true values.
        """
        off = self._corrections(smooth)
        return bool((_GAIN * off >= defects.largest)[jumping].all())

    def are_late(self, jumping: Inputs, smooth: SmoothStep | None) -> bool:
        """Tell whether slaves behind inputs that jump had inputs off by over ten tolerances."""
        return bool((self._corrections(smooth)[jumping] > _LATE).any())

    def _corrections(self, smooth: SmoothStep | None) -> FloatArray:
        """The largest correction at T_n of the inputs of the slave behind each input, (n,)."""
        off = np.zeros(len(self._coupled.parts))
        if smooth is not None:
            for i, part in enumerate(self._coupled.parts):
                off[i] = smooth.corrections[part.input_slice].max(initial=0.0)
        return off[self._slave_behind]

    def name(self, defects: Defects, jumping: Inputs) -> str:
        """``slave.variable`` of the output behind the jumping input with the largest defect."""
        index = int(np.where(jumping, defects.largest, -1.0).argmax())
        return self._names[int(self._coupled.source[index])]
