"""The coupling with slaves that cannot go back, judged by the defects of its inputs.

No comparison solution tells what the inputs' polynomials do to such a slave, or what the unknown
outputs of such a slave do to the others. What is known, once all have taken their steps, is how far
these inputs were from what their polynomials said. For an input that was known ahead this is taken
from the polynomial that would have been extrapolated, times the ratio of the nodes' products: its
own polynomial meets the value at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.scheme import CouplingScheme, slaves_without_rollback
from master_node.numerics.defect_control import (
    TARGET,
    defect_coefficients,
    foreseen_step_size,
    largest_between,
)
from master_node.numerics.discontinuities import are_jumps
from master_node.numerics.error_estimators import node_polynomial
from master_node.numerics.extrapolation import CouplingHistory, Extrapolation, Polynomials
from master_node.numerics.norms import error_scale
from protocol.signals import FloatArray

_INF = float("inf")


class CouplingError(NamedTuple):
    """Norm of the defects of a step.

    Attributes:
        norm: root mean square of the weighted defects; above 1 they are beyond the tolerance.
        limiting_variable: ``slave.variable`` behind the input with the largest one, of those that
            have jumped if any has.
        has_jumped: whether one is so much larger than foreseen that only a jump explains it.
    """

    norm: float
    limiting_variable: str
    has_jumped: bool


class Measured(NamedTuple):
    """Defects of a step, one per input, shape (n,) each, unit [u].

    Attributes:
        defects: largest distances from the polynomials.
        changes: that the polynomials said.
    """

    defects: FloatArray
    changes: FloatArray


class StepShape(Protocol):
    """Use of polynomials in a step of one shape or another: their defects, and w there."""

    def reach(
        self, past: tuple[float, ...], polynomials: Polynomials, step_size: float
    ) -> list[float]:
        """For each kind the largest |w| in a step of H from ``past[0]`` [s]."""
        ...

    def measure(
        self,
        history: CouplingHistory,
        polynomials: Polynomials,
        reached: Sequence[tuple[float, FloatArray]],
    ) -> Measured:
        """The defects in a step from the newest point of ``history``.

        Args:
            history: inputs up to the beginning of the step.
            polynomials: of each kind.
            reached: communication points [s] and the inputs there, shape (rows, n).
        """
        ...


class SingleStepShape:
    """One step of all slaves: all inputs are extrapolated, or known at its end.

    Args:
        scheme: how the slaves are coupled.
    """

    def __init__(self, scheme: CouplingScheme) -> None:
        self._extrapolation = scheme.extrapolation
        self._kind_of_input = scheme.extrapolation.kind_of_input

    def reach(
        self, past: tuple[float, ...], polynomials: Polynomials, step_size: float
    ) -> list[float]:
        """See `StepShape`."""
        now = past[0]
        nodes = self._extrapolation.nodes((now + step_size, *past), polynomials, now, 1)
        return [
            largest_between(offsets, 0.0, step_size)
            if kind.ahead
            else node_polynomial(offsets, step_size)
            for kind, offsets in zip(self._extrapolation.kinds, nodes, strict=True)
        ]

    def measure(
        self,
        history: CouplingHistory,
        polynomials: Polynomials,
        reached: Sequence[tuple[float, FloatArray]],
    ) -> Measured:
        """See `StepShape`; one point is reached."""
        ((time, inputs),) = reached
        now = history.times[0]
        foreseen = self._extrapolation.signal(history, polynomials).at(time - now)
        parts = _parts_of_extrapolation(
            self._extrapolation,
            history.times,
            polynomials,
            time - now,
            self.reach(history.times, polynomials, time - now),
        )
        return Measured(
            np.abs(inputs[0] - foreseen) * parts[self._kind_of_input],
            np.abs(foreseen - history.inputs[0][0]),
        )


class DoubleStepShape:
    """A double step; slaves that cannot go back take the same two steps when it is accepted.

    The inputs that the others get from these have one polynomial for both steps.

    Args:
        scheme: how the slaves are coupled.
    """

    def __init__(self, scheme: CouplingScheme) -> None:
        self._extrapolation = scheme.extrapolation
        self._kind_of_input = scheme.extrapolation.kind_of_input
        self._is_late = np.array([kind.late for kind in self._extrapolation.kinds])[
            self._kind_of_input
        ]

    def reach(
        self, past: tuple[float, ...], polynomials: Polynomials, step_size: float
    ) -> list[float]:
        """See `StepShape`."""
        first, second = self._of_both_steps(past, polynomials, step_size)
        return [max(pair) for pair in zip(first, second, strict=True)]

    def _of_both_steps(
        self, past: tuple[float, ...], polynomials: Polynomials, step_size: float
    ) -> tuple[list[float], list[float]]:
        """`reach` of each small step."""
        extrapolation = self._extrapolation
        begin, middle, end = past[0], past[0] + step_size, past[0] + 2.0 * step_size
        first, second = [], []
        for kind, of_first, of_second in zip(
            extrapolation.kinds,
            extrapolation.nodes((middle, *past), polynomials, begin, 1),
            extrapolation.nodes((end, middle, *past), polynomials, begin, 1),
            strict=True,
        ):
            if kind.ahead:
                first.append(largest_between(of_first, 0.0, step_size))
                second.append(largest_between(of_second, step_size, 2.0 * step_size))
            else:
                first.append(node_polynomial(of_first, step_size))
                second.append(
                    node_polynomial(of_first if kind.late else of_second, 2.0 * step_size)
                )
        return first, second

    def measure(
        self,
        history: CouplingHistory,
        polynomials: Polynomials,
        reached: Sequence[tuple[float, FloatArray]],
    ) -> Measured:
        """See `StepShape`; the middle and the end are reached."""
        extrapolation, kinds = self._extrapolation, self._kind_of_input
        (middle, at_middle), (end, at_end) = reached
        begin = history.times[0]
        first, second = middle - begin, end - middle
        pushed = history.pushed(middle, at_middle)
        signal = extrapolation.signal(history, polynomials)
        foreseen = np.where(
            self._is_late,
            signal.at(end - begin),
            extrapolation.signal(pushed, polynomials).at(second),
        )
        reach_first, reach_second = self._of_both_steps(history.times, polynomials, first)
        in_first = _parts_of_extrapolation(
            extrapolation, history.times, polynomials, first, reach_first
        )
        in_second = _parts_of_extrapolation(
            extrapolation, pushed.times, polynomials, second, reach_second
        )
        defects = np.maximum(
            np.abs(at_middle[0] - signal.at(first)) * in_first[kinds],
            np.abs(at_end[0] - foreseen) * in_second[kinds],
        )
        return Measured(defects, np.abs(foreseen - history.inputs[0][0]))


def _parts_of_extrapolation(
    extrapolation: Extrapolation,
    past: tuple[float, ...],
    polynomials: Polynomials,
    step_size: float,
    reach: Sequence[float],
) -> FloatArray:
    """For each kind how much smaller its defects are than those of an extrapolation, <= 1."""
    extrapolated = extrapolation.nodes(past, polynomials, past[0])
    return np.array(
        [
            size / node_polynomial(nodes, step_size) if kind.ahead else 1.0
            for kind, nodes, size in zip(extrapolation.kinds, extrapolated, reach, strict=True)
        ]
    )


class CouplingDefects:
    """Judges steps by the defects of the inputs between slaves of which one cannot go back.

    Args:
        coupled: the system, with its tolerances.
        scheme: how its slaves are coupled.
        shape: of the steps.
    """

    def __init__(self, coupled: CoupledSystem, scheme: CouplingScheme, shape: StepShape) -> None:
        self._extrapolation = scheme.extrapolation
        self._kind_of_input = scheme.extrapolation.kind_of_input
        self._shape = shape
        self._coupled = coupled
        self._absolute_tolerance = coupled.absolute_tolerance
        self._relative_tolerance = coupled.relative_tolerance
        self._names = coupled.output_names
        slave_of_input = np.repeat(
            np.arange(len(coupled.parts)), [len(part.connected) for part in coupled.parts]
        )
        without = slaves_without_rollback(coupled)
        concerned = np.isin(slave_of_input, without) | np.isin(
            coupled.output_slave[coupled.source], without
        )
        self._inputs: NDArray[np.intp] = np.flatnonzero(concerned)
        self._sources = coupled.source[self._inputs]
        self._kinds = self._kind_of_input[self._inputs]

    def points(self, history: CouplingHistory) -> int:
        """Through how many points the next polynomials may go.

        One less than there are: the defect of such a polynomial at the newest point is known.
        """
        return max(1, len(history.times) - 1)

    def scale(self, y: FloatArray) -> FloatArray:
        """ATOL_j + RTOL_j |y_j| of equation (8), shape (m,), unit [y]."""
        return error_scale(y, self._absolute_tolerance, self._relative_tolerance)

    def _scale_of_inputs(self, y: FloatArray) -> FloatArray:
        return self._coupled.scale_of_inputs(self.scale(y))[self._inputs]

    def judge(
        self,
        history: CouplingHistory,
        polynomials: Polynomials,
        reached: Sequence[tuple[float, FloatArray]],
        y: FloatArray,
    ) -> CouplingError:
        """Norm of the defects of a step that all slaves have taken.

        Args:
            history: inputs up to the beginning of the step.
            polynomials: of each kind.
            reached: communication points [s] and the inputs there, shape (rows, n).
            y: outputs at the last of them, shape (m,).
        """
        inputs = self._inputs
        if not inputs.size:
            return CouplingError(0.0, "", has_jumped=False)
        measured = self._shape.measure(history, polynomials, reached)
        scale = self._scale_of_inputs(y)
        weighted = measured.defects[inputs] / scale
        index = int(weighted.argmax())
        norm = sqrt(weighted.dot(weighted) / len(weighted))
        has_jumped = False
        if weighted[index] > 1.0:
            foreseen = self._foreseen(history, polynomials, reached[0][0]) / scale
            changes = measured.changes[inputs] / scale
            jumping = are_jumps(weighted, changes, np.maximum(TARGET, foreseen))
            has_jumped = bool(jumping.any())
            if has_jumped:
                index = int(np.where(jumping, weighted, 0.0).argmax())
        return CouplingError(norm, self._names[self._sources[index]], has_jumped)

    def _foreseen(
        self, history: CouplingHistory, polynomials: Polynomials, time: float
    ) -> FloatArray:
        """The defects that were foreseen for a (small) step to ``time``, shape (n_d,), unit [u]."""
        sizes = self._sizes(history, polynomials)
        if sizes is None:
            return np.full(len(self._inputs), _INF)
        now = history.times[0]
        reach = self._shape.reach(history.times, polynomials, time - now)
        foreseen: FloatArray = sizes * np.array(reach)[self._kinds]
        return foreseen

    def step_size(
        self,
        history: CouplingHistory,
        polynomials: Polynomials,
        y: FloatArray,
        *,
        smallest: float,
        largest: float,
    ) -> float:
        """H for the next step with these polynomials, so that its defects are within tolerance.

        Args:
            history: inputs up to its beginning.
            polynomials: of each kind, through no more than `points`.
            y: outputs there, shape (m,).
            smallest: bound of H [s]; taken where nothing is known of the polynomials.
            largest: bound of H [s].
        """
        if not self._inputs.size:
            return largest
        sizes = self._sizes(history, polynomials)
        if sizes is None:
            return smallest
        weighted = sizes / self._scale_of_inputs(y)
        squares = np.bincount(
            self._kinds, np.square(weighted), len(self._extrapolation.kinds)
        ).tolist()
        number = len(weighted)

        def norm(step_size: float) -> float:
            reach = self._shape.reach(history.times, polynomials, step_size)
            return sqrt(sum(s * r * r for s, r in zip(squares, reach, strict=True)) / number)

        return foreseen_step_size(norm, smallest, largest)

    def _sizes(self, history: CouplingHistory, polynomials: Polynomials) -> FloatArray | None:
        """|u^(q+1) / (q+1)!| of each input, shape (n_d,), unit [u]/s^(q+1); None: not known."""
        sizes = defect_coefficients(self._extrapolation, history, polynomials)
        return None if sizes is None else sizes[self._inputs]
