"""``order = "auto"`` for one coupled system: hands its grid and its errors to the order control."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.scheme import CouplingScheme
from master_node.judging.available_polynomials import AvailablePolynomials
from master_node.judging.comparison import ErrorControl, StepError
from master_node.judging.defects import CouplingDefects
from master_node.judging.unanswered_inputs import Bound
from master_node.numerics.error_estimators import node_polynomial, small_steps_integral
from master_node.numerics.extrapolation import CouplingHistory, InputPolynomial, Nodes, Polynomials
from master_node.numerics.order_control import (
    LARGEST_FACTOR,
    NO_BOUNDS,
    SMALLEST_FACTOR,
    Candidate,
    Choice,
    OrderMemory,
    beginning,
    choose,
    input_magnitudes,
    ladder,
)
from master_node.stepping.double_step import DoubleStep
from protocol.signals import FloatArray

_INF = float("inf")


class OrderSelection:
    """Chooses the input polynomial of the next double step; outputs are grouped by their slaves.

    Args:
        coupled: the system.
        scheme: how its slaves are coupled.
        control: its error control.
        available: the polynomials that a history allows.
        largest: the highest polynomial that may be chosen.
        alpha: safety factor of the step size controller.
        coupling: defects that bound H, too; None: all slaves can go back.
    """

    def __init__(
        self,
        coupled: CoupledSystem,
        scheme: CouplingScheme,
        *,
        control: ErrorControl,
        available: AvailablePolynomials,
        largest: InputPolynomial,
        alpha: float,
        coupling: CouplingDefects | None = None,
    ) -> None:
        self._coupled = coupled
        self._scheme = scheme
        self._control = control
        self._available = available
        self._alpha = alpha
        self._coupling = coupling
        kinds = scheme.extrapolation.kinds
        self._ladder = ladder(
            has_derivatives=any(kind.has_derivative for kind in kinds),
            derivative_points=largest.derivative_points,
        )
        slaves = range(len(coupled.parts))
        self._has_derivative = scheme.input_has_derivative
        self._slave_of_input = np.repeat(slaves, [len(part.connected) for part in coupled.parts])
        kinds_of = {slave: frozenset[int]() for slave in slaves}
        direct = dict.fromkeys(slaves, False)
        for slave, output_kinds, feed_through in zip(
            coupled.output_slave.tolist(),
            scheme.output_kinds,
            scheme.feed_through.tolist(),
            strict=True,
        ):
            kinds_of[slave] = output_kinds
            direct[slave] |= feed_through
        self._groups = [(min(kinds_of[slave], default=None), direct[slave]) for slave in slaves]

    def restart(self) -> OrderMemory:
        """The polynomial to begin with, where only one communication point says anything."""
        return OrderMemory(beginning(self._ladder))

    def choose(
        self,
        memory: OrderMemory,
        step: DoubleStep,
        error: StepError,
        history: CouplingHistory,
        bound: Bound | None = None,
    ) -> Choice:
        """After a double step was accepted.

        Args:
            memory: from the last choice.
            step: the double step.
            error: its estimated error.
            history: up to its end.
            bound: of H with some polynomials, by inputs of which the estimate tells nothing.
        """
        coupled = self._coupled
        slaves = len(coupled.parts)
        weighted = np.square(error.estimate / error.scale)
        squares = np.bincount(coupled.output_slave, weighted * self._control.counts, slaves)
        magnitudes = input_magnitudes(
            history,
            self._has_derivative,
            coupled.scale_of_inputs(error.scale),
            self._slave_of_input,
            slaves,
        )
        begin, middle, end, step_size = step.times[:4]
        nodes = self._control.nodes(step)
        taken = self._candidate(
            memory.polynomial,
            step.polynomials,
            first=nodes.first,
            second=nodes.second,
            middle=middle - begin,
            end=end - begin,
        )
        candidates = [
            self._next(polynomial, history, step_size)
            for polynomial in self._ladder
            if abs(polynomial.order - memory.polynomial.order) <= 1
            and self._available.allow(polynomial, history)
        ]
        return choose(
            memory,
            candidates,
            magnitudes,
            taken=taken,
            error=np.sqrt(squares / self._control.outputs),
            step_size=step_size,
            alpha=self._alpha,
            bounds=self._bounds(candidates, history, step, bound),
        )

    def _bounds(
        self,
        candidates: Sequence[Candidate],
        history: CouplingHistory,
        step: DoubleStep,
        bound: Bound | None,
    ) -> Mapping[InputPolynomial, float]:
        """Bounds of H over the present H, apart from the estimated error."""
        if bound is None and self._coupling is None:
            return NO_BOUNDS
        return {
            candidate.polynomial: self._bound(candidate.polynomial, history, step, bound)
            for candidate in candidates
        }

    def _bound(
        self,
        polynomial: InputPolynomial,
        history: CouplingHistory,
        step: DoubleStep,
        bound: Bound | None,
    ) -> float:
        polynomials, taken = self._available.of(polynomial, history), step.times.first
        largest = _INF if bound is None else bound(polynomials)
        if self._coupling is None:
            return largest
        by_defects = self._coupling.step_size(
            history,
            polynomials,
            step.end[0],
            smallest=SMALLEST_FACTOR * taken,
            largest=LARGEST_FACTOR * taken,
        )
        return min(by_defects / taken, largest)

    def _next(
        self, polynomial: InputPolynomial, history: CouplingHistory, step_size: float
    ) -> Candidate:
        """A polynomial over the next double step, were it of the same H."""
        extrapolation, ahead = self._scheme.extrapolation, self._scheme.known_ahead
        polynomials = self._available.of(polynomial, history)
        now = history.times[0]
        grid = (now + 2.0 * step_size, now + step_size, *history.times)
        first = extrapolation.nodes(grid[2 - ahead :], polynomials, now, ahead)
        second = extrapolation.nodes(grid[1 - ahead :], polynomials, now, ahead)
        return self._candidate(
            polynomial,
            polynomials,
            first=first,
            second=second,
            middle=step_size,
            end=2.0 * step_size,
        )

    def _candidate(
        self,
        polynomial: InputPolynomial,
        polynomials: Polynomials,
        *,
        first: list[Nodes],
        second: list[Nodes],
        middle: float,
        end: float,
    ) -> Candidate:
        sizes = {
            (kind, direct): abs(
                node_polynomial(second[kind], end)
                if direct and not self._scheme.extrapolation.kinds[kind].ahead
                else small_steps_integral(first[kind], second[kind], middle, end)
            )
            for kind, direct in set(self._groups)
            if kind is not None
        }
        return Candidate(
            polynomial,
            self._control.exponent(polynomials),
            np.array([0 if kind is None else polynomials[kind].order for kind, _ in self._groups]),
            self._array(sizes),
        )

    def _array(self, sizes: dict[tuple[int, bool], float]) -> FloatArray:
        return np.array(
            [0.0 if kind is None else sizes[kind, direct] for kind, direct in self._groups]
        )
