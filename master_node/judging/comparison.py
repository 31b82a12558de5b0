"""From an attempted double step to its error: EST for each output, ERR over all."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.scheme import CouplingScheme
from master_node.numerics.error_estimators import Comparison, ErrorEstimator, exact_ratio
from master_node.numerics.extrapolation import Nodes, Polynomials
from master_node.numerics.norms import error_scale, first_not_finite, weighted_rms_norm
from master_node.stepping.double_step import DoubleStep
from protocol.signals import FloatArray

_INF = float("inf")


class StepNodes(NamedTuple):
    """Nodes of the input polynomials in a double step, for each kind, as offsets from T_n [s].

    Attributes:
        first: of the first small step.
        second: of the second one.
        comparison: of the comparison solution.
    """

    first: list[Nodes]
    second: list[Nodes]
    comparison: list[Nodes]


class StepError(NamedTuple):
    """The estimated error of a double step.

    Attributes:
        difference: of the two small steps from the comparison solution, shape (m,), unit [y].
        ratio: p, one for all outputs or one for each, shape (m,).
        scale: ATOL_j + RTOL_j |y_j| of equation (8), shape (m,), unit [y].
        norm: ERR of equation (8); inf when a value is not finite.
        limiting_variable: ``slave.variable`` with the largest part in ERR.
        loop_gain: spectral radius of the interface Jacobian as far as the double step tells it; 0
            where it is not looked at, or too small to matter.
    """

    difference: FloatArray
    ratio: FloatArray | float
    scale: FloatArray
    norm: float
    limiting_variable: str
    loop_gain: float = 0.0

    @property
    def estimate(self) -> FloatArray:
        """EST, shape (m,), unit [y]."""
        return ErrorEstimator.estimate(self.difference, self.ratio)


class ErrorControl:
    """Equation (8) for one coupled system, with the estimates' constants.

    Slaves without rollback have not taken their steps when a double step of others is judged:
    their outputs do not count, and have an infinite scale.

    Args:
        coupled: the system, with its tolerances.
        scheme: how its slaves are coupled.
        estimator: EST_Rich or EST_mod.
        constants: ``exact`` or ``paper``, see ``numerics/error_estimators.py``.

    Attributes:
        counts: which outputs ERR is the mean of, shape (m,).
        outputs: how many.
    """

    def __init__(
        self,
        coupled: CoupledSystem,
        scheme: CouplingScheme,
        estimator: ErrorEstimator,
        constants: str,
    ) -> None:
        follows = np.isin(coupled.output_slave, scheme.late_slaves)
        self.counts = coupled.is_controlled & ~follows
        self.outputs = int(self.counts.sum())
        self._counted = None if self.counts.all() else np.flatnonzero(self.counts)
        self._names = coupled.output_names
        self._absolute_tolerance = np.where(follows, _INF, coupled.absolute_tolerance)
        self._relative_tolerance = coupled.relative_tolerance
        self._extrapolation = scheme.extrapolation
        self._known_ahead = scheme.known_ahead
        self._is_long_step = estimator.comparison is Comparison.LONG_STEP
        self._paper_ratios = estimator.paper_ratios if constants == "paper" else None
        self._has_feed_through = bool(scheme.feed_through.any())
        self._ahead = [kind.ahead for kind in scheme.extrapolation.kinds]
        combinations: list[tuple[frozenset[int], bool]] = []
        index = []
        for kinds, direct in zip(scheme.output_kinds, scheme.feed_through.tolist(), strict=True):
            if (kinds, direct) not in combinations:
                combinations.append((kinds, direct))
            index.append(combinations.index((kinds, direct)))
        self._combinations = [(tuple(kinds), direct) for kinds, direct in combinations]
        self._combination_of_output = np.array(index, dtype=np.intp)
        used = frozenset[int]().union(*scheme.output_kinds)
        self._used_kinds = sorted(used)
        self._exponents = lru_cache(self._exponent)

    def exponent(self, polynomials: Polynomials) -> int:
        """P: k + 1 if an output depends directly on extrapolated inputs, else k + 2."""
        return self._exponents(polynomials)

    def _exponent(self, polynomials: Polynomials) -> int:
        order = min([polynomials[i].order for i in self._used_kinds], default=0)
        return order + (1 if self._has_feed_through else 2)

    def judge(self, step: DoubleStep) -> StepError:
        """EST and ERR of a double step."""
        y = step.end[0]
        scale, ratio = self.scale(y), self._ratios(step)
        difference = y - step.comparison
        if isinstance(ratio, float):
            norm, index = self._norm(difference, scale)
            norm /= abs(1.0 - ratio)
        else:
            norm, index = self._norm(ErrorEstimator.estimate(difference, ratio), scale)
        limiting = self._names[index] if self._names else ""
        if not norm < _INF:
            bad = first_not_finite(y)
            if bad is not None:
                norm, limiting = _INF, f"{self._names[bad]} is not finite"
        return StepError(difference, ratio, scale, norm, limiting)

    def _norm(self, error: FloatArray, scale: FloatArray) -> tuple[float, int]:
        """ERR, and the index of the output with most of it."""
        counted = self._counted
        if counted is None:
            return weighted_rms_norm(error, scale)
        if not counted.size:
            return 0.0, 0
        norm, index = weighted_rms_norm(error[counted], scale[counted])
        return norm, int(counted[index])

    def scale(self, y: FloatArray) -> FloatArray:
        """ATOL_j + RTOL_j |y_j| of equation (8), shape (m,), unit [y]."""
        return error_scale(y, self._absolute_tolerance, self._relative_tolerance)

    def nodes(self, step: DoubleStep) -> StepNodes:
        """Where the polynomials of a double step met their inputs."""
        polynomials, ahead = step.polynomials, self._known_ahead
        begin, middle, end = step.times[:3]
        nodes_at = self._extrapolation.nodes_at
        past = tuple([time - begin for time in step.history.times])
        before = past[1:]
        to_middle, to_end = ((middle - begin,), (end - begin,)) if ahead else ((), ())
        first = nodes_at(to_middle + before, polynomials, ahead)
        second = nodes_at(to_end + past, polynomials, ahead)
        if not self._is_long_step:
            return StepNodes(first, second, first)
        return StepNodes(first, second, nodes_at(to_end + before[::2], polynomials, ahead))

    def _ratios(self, step: DoubleStep) -> FloatArray | float:
        """P of each output, or one for all."""
        paper = self._paper_ratios
        if paper is not None:
            ratios = [
                paper[min([step.polynomials[i].order for i in kinds], default=0)]
                for kinds, _ in self._combinations
            ]
        else:
            nodes = self.nodes(step)
            begin, middle, end = step.times[:3]
            middle, end = middle - begin, end - begin
            ratios = [
                self._exact_ratio(nodes, middle, end, kinds, direct)
                for kinds, direct in self._combinations
            ]
        if len(ratios) == 1:
            return ratios[0]
        return np.array(ratios)[self._combination_of_output]

    def _exact_ratio(
        self, nodes: StepNodes, middle: float, end: float, kinds: tuple[int, ...], direct: bool
    ) -> float:
        """P of an output whose slave has inputs of these kinds; offsets from T_n [s].

        Several kinds have several constants, and which part of the error comes from which input
        is not known: the one that makes the estimate largest is taken.
        """
        found, furthest = 2.0, _INF
        first, second, comparison = nodes
        for i in kinds:
            feed_through = direct and not self._ahead[i]
            p = exact_ratio(
                first[i], second[i], comparison[i], middle, end, feed_through=feed_through
            )
            if abs(1.0 - p) < furthest:
                found, furthest = p, abs(1.0 - p)
        return found
