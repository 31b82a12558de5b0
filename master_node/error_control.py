"""From an attempted double step to its error: EST for each output, ERR over all."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from master_node.coupling_scheme import CouplingScheme
from master_node.double_step import DoubleStep
from master_node.numerics.error_estimators import Comparison, ErrorEstimator, exact_ratio
from master_node.numerics.extrapolation import Nodes, Polynomials
from master_node.numerics.norms import first_not_finite, weighted_rms_norm
from master_node.system import CoupledSystem
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
        estimate: EST, shape (m,), unit [y].
        norm: ERR of equation (8); inf when a value is not finite.
        limiting_variable: ``slave.variable`` with the largest part in ERR.
    """

    estimate: FloatArray
    norm: float
    limiting_variable: str


class ErrorControl:
    """Equation (8) for one coupled system, with the estimates' constants.

    Args:
        coupled: the system, with its tolerances.
        scheme: how its slaves are coupled.
        estimator: EST_Rich or EST_mod.
        constants: ``exact`` or ``paper``, see ``numerics/error_estimators.py``.

    Attributes:
        outputs: how many outputs ERR is the mean of.
    """

    def __init__(
        self,
        coupled: CoupledSystem,
        scheme: CouplingScheme,
        estimator: ErrorEstimator,
        constants: str,
    ) -> None:
        self.outputs = len(coupled.output_names)
        self._names = coupled.output_names
        self._absolute_tolerance = coupled.absolute_tolerance
        self._relative_tolerance = coupled.relative_tolerance
        self._estimate = estimator.estimate
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
        self._combinations = combinations
        self._combination_of_output = np.array(index, dtype=np.intp)
        used = frozenset[int]().union(*scheme.output_kinds)
        self._used_kinds = sorted(used)

    def exponent(self, polynomials: Polynomials) -> int:
        """P: k + 1 if an output depends directly on extrapolated inputs, else k + 2."""
        order = min([polynomials[i].order for i in self._used_kinds], default=0)
        return order + (1 if self._has_feed_through else 2)

    def judge(self, step: DoubleStep) -> StepError:
        """EST and ERR of a double step."""
        y = step.end[0]
        error = self._estimate(y, step.comparison, self._ratios(step))
        norm, index = self._norm(error, y)
        limiting = self._names[index]
        bad = first_not_finite(step.end)
        if bad is not None:
            return StepError(error, _INF, f"{self._names[bad]} is not finite")
        return StepError(error, norm, limiting)

    def _norm(self, error: FloatArray, y: FloatArray) -> tuple[float, int]:
        """ERR, and the index of the output with most of it."""
        return weighted_rms_norm(error, y, self._absolute_tolerance, self._relative_tolerance)

    def weights(self, y: FloatArray) -> FloatArray:
        """1 / (ATOL_j + RTOL_j |y_j|) of equation (8), shape (m,)."""
        return 1.0 / (self._absolute_tolerance + self._relative_tolerance * np.abs(y))

    def nodes(self, step: DoubleStep) -> StepNodes:
        """Where the polynomials of a double step met their inputs."""
        polynomials, ahead = step.polynomials, self._known_ahead
        begin, middle, end, _, _ = step.times
        past = step.history.times
        before = past[1:]

        def nodes(points: tuple[float, ...], known: float) -> list[Nodes]:
            points = (known, *points) if ahead else points
            return self._extrapolation.nodes(points, polynomials, begin, ahead)

        first = nodes(before, middle)
        comparison = nodes(before[::2], end) if self._is_long_step else first
        return StepNodes(first, nodes(past, end), comparison)

    def _ratios(self, step: DoubleStep) -> FloatArray | float:
        """P of each output, or one for all."""
        if self._paper_ratios is not None:
            ratios = [
                self._paper_ratios[min([step.polynomials[i].order for i in kinds], default=0)]
                for kinds, _ in self._combinations
            ]
        else:
            nodes = self.nodes(step)
            ratios = [
                self._exact_ratio(step, nodes, kinds, direct)
                for kinds, direct in self._combinations
            ]
        if len(ratios) == 1:
            return ratios[0]
        return np.array(ratios)[self._combination_of_output]

    def _exact_ratio(
        self, step: DoubleStep, nodes: StepNodes, kinds: frozenset[int], direct: bool
    ) -> float:
        """P of an output whose slave has inputs of these kinds.

        Several kinds have several constants, and which part of the error comes from which input
        is not known: the one that makes the estimate largest is taken.
        """
        origin = step.times.begin
        middle, end = step.times.middle - origin, step.times.end - origin
        candidates = [
            exact_ratio(
                nodes.first[i],
                nodes.second[i],
                nodes.comparison[i],
                middle,
                end,
                feed_through=direct and not self._ahead[i],
            )
            for i in kinds
        ]
        return min(candidates, key=lambda p: abs(1.0 - p), default=2.0)


class PartialErrorControl(ErrorControl):
    """The same over the outputs of the slaves that take double steps, where not all do.

    The others have not taken their steps when a double step is judged: their outputs do not count,
    and have the weight 0.

    Args:
        coupled: the system, with its tolerances.
        scheme: how its slaves are coupled.
        estimator: EST_Rich or EST_mod.
        constants: ``exact`` or ``paper``.
    """

    def __init__(
        self,
        coupled: CoupledSystem,
        scheme: CouplingScheme,
        estimator: ErrorEstimator,
        constants: str,
    ) -> None:
        super().__init__(coupled, scheme, estimator, constants)
        takes_part = ~np.isin(coupled.output_slave, scheme.late_slaves)
        self._counted = np.flatnonzero(takes_part)
        self._counts = takes_part.astype(float)
        self.outputs = len(self._counted)

    def weights(self, y: FloatArray) -> FloatArray:
        """See `ErrorControl`; 0 for outputs that do not count."""
        weights: FloatArray = super().weights(y) * self._counts
        return weights

    def _norm(self, error: FloatArray, y: FloatArray) -> tuple[float, int]:
        counted = self._counted
        if not counted.size:
            return 0.0, 0
        norm, index = weighted_rms_norm(
            error[counted],
            y[counted],
            self._absolute_tolerance[counted],
            self._relative_tolerance[counted],
        )
        return norm, int(counted[index])
