"""Input polynomials of an iterated step: through its beginning, and through two nodes ahead.

An iterated step leads from T to T + h in two small steps, with a node at the end of each. Its input
polynomial meets the inputs at T and the unknown ones at both nodes, and, with degree 3, those at
one earlier communication point too. Two limits decide what such a step is worth:

- a *follower*, a slave that settles on its inputs within much less than h, makes the polynomial a
  collocation method for what is slow: its derivative is right at both nodes;
- an *integrator*, whose inputs are flows, makes it a quadrature of the flow.

With `MIDDLE` = 0.7 both are A-stable for degree 2, and damped where h is large: a follower
forgets at once (L-stable), an integrator keeps 3/7. With degree 3 they are A(80 degrees)-stable
where the earlier point is no nearer than `NEAREST` of h; an undamped oscillation grows by up to a
fifth in a step where it is nearer than h, as while h grows, and by 0.05 % beyond. The middle at
1/2 would have the smallest errors, but an integrator would keep everything (Lobatto's points lack
the damping that Radau's have, Hairer and Wanner, *Solving ODEs II*, section IV.3); at 1/3, Radau's
own node, it would grow.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from master_node.numerics.double_step_times import DoubleStepTimes
from master_node.numerics.extrapolation import CouplingHistory, StepInputs, interpolate
from protocol.signals import FloatArray, InputSignal

MIDDLE = 0.7
"""Where the first node lies, as a part of h. See the module's docstring."""

NODES = 2
"""Number of nodes: the ends of both small steps."""

NEAREST = 0.5
"""Distance of an earlier point from T, as a part of h, below which degree 3 is not stable."""

FARTHEST = 4.0
"""Distance of an earlier point from T, as a part of h, beyond which it gains nothing."""

TELLING = 1.5
"""Error of the predictor over that of the polynomial of degree 3, below which their distance does
not tell it. For degree 2 it is 1 / 0.55 at least."""


def earlier_point(offsets: Sequence[float], size: float) -> int | None:
    """Number of the earlier communication point through which a polynomial of degree 3 goes.

    Args:
        offsets: of communication points from T, newest first, the first of them 0 [s].
        size: h [s].

    Returns:
        The newest one that is far enough; None: there is none within `NEAREST` to `FARTHEST`.
    """
    for number, offset in enumerate(offsets):
        if -offset >= NEAREST * size:
            return number if -offset <= FARTHEST * size else None
    return None


def follower_constant(known: Sequence[float], nodes: Sequence[float]) -> float:
    """Error at the last node of a follower, for an input t^q with q conditions, unit s^q.

    The polynomial of degree q - 1 meets t^q at ``known``, and its derivative meets that of t^q at
    the nodes; to leading order the error of any smooth input is this times u^(q) / q!.

    Args:
        known: distinct offsets from T at which inputs are known, 0 among them [s].
        nodes: offsets of both nodes [s].
    """
    size = nodes[-1]
    q = len(known) + len(nodes)
    powers = np.arange(q)
    met = [(offset / size) ** powers for offset in known]
    ends = np.asarray(nodes) / size
    slopes = [powers * node ** np.maximum(powers - 1, 0) for node in ends]
    exact = [(offset / size) ** q for offset in known] + [q * node ** (q - 1) for node in ends]
    coefficients = np.linalg.solve(np.array([*met, *slopes]), np.array(exact))
    return float(size**q * (1.0 - coefficients.sum()))


def predictor_constant(past: Sequence[float], end: float) -> float:
    """Error at ``end`` of the polynomial through ``past``, for an input t^q with q = len(past).

    Args:
        past: distinct offsets from T [s].
        end: offset [s].

    Returns:
        The product of the distances, unit s^q.
    """
    return float(np.prod([end - offset for offset in past]))


def milne_factor(known: Sequence[float], nodes: Sequence[float], past: Sequence[float]) -> float:
    """Error of a converged input over its distance from the predicted one (Milne's device).

    Predictor and corrector err by C_p and C_c times the same derivative, so their distance is
    C_p - C_c times it, and the corrector's error is C_c / (C_p - C_c) of that distance. C_c is the
    one of a follower: an integrator's is smaller by a power of h over what is slow. Both constants
    are positive, so the distance tells nothing where they are equal, see `TELLING`.

    Args:
        known: offsets at which inputs are known, see `follower_constant` [s].
        nodes: offsets of both nodes [s].
        past: as many offsets as the corrector has conditions, those of the predictor [s].

    Returns:
        |C_c / (C_p - C_c)|.
    """
    corrector = follower_constant(known, nodes)
    predictor = predictor_constant(past, nodes[-1])
    return abs(corrector / (predictor - corrector))


def _tells(known: Sequence[float], nodes: Sequence[float], past: Sequence[float]) -> bool:
    """True if the distance from the predictor tells the error, or the predictor has no points."""
    order = len(known) + len(nodes)
    if len(past) < order:
        return True
    predictor = predictor_constant(past[:order], nodes[-1])
    return predictor >= TELLING * abs(follower_constant(known, nodes))


class Collocation(NamedTuple):
    """Through which points the input polynomial of one iterated step goes, and its predictor's.

    Attributes:
        past: offsets of the communication points from T, newest first [s].
        nodes: offsets of both nodes [s].
        known: numbers of the communication points through which it goes, the newest first.
        predicting: numbers of those through which the polynomial goes that predicts it.
    """

    past: tuple[float, ...]
    nodes: tuple[float, float]
    known: tuple[int, ...]
    predicting: tuple[int, ...]

    @staticmethod
    def over(history: CouplingHistory, times: DoubleStepTimes) -> Collocation:
        """The highest degree that is stable, for a step from the newest point of ``history``."""
        past = tuple(time - times.begin for time in history.times)
        nodes = times.middle - times.begin, times.end - times.begin
        known: tuple[int, ...] = (0,)
        earlier = earlier_point(past, nodes[-1])
        if earlier is not None and _tells((0.0, past[earlier]), nodes, past):
            known = (0, earlier)
        predicting = tuple(range(min(len(known) + NODES, len(past))))
        return Collocation(past, nodes, known, predicting)

    @property
    def order(self) -> int:
        """q: how many conditions the polynomial meets; its error is of order h^q."""
        return len(self.known) + NODES

    def predicted(self, history: CouplingHistory) -> FloatArray:
        """Inputs at the nodes by the polynomial through past points, shape (nodes, n)."""
        offsets = [self.past[number] for number in self.predicting]
        values = [history.inputs[number][0] for number in self.predicting]
        signal = InputSignal(interpolate(offsets, values))
        return np.array([signal.at(node) for node in self.nodes])

    def step_inputs(self, history: CouplingHistory, inputs: FloatArray) -> StepInputs:
        """The polynomial around the beginnings of both small steps.

        Args:
            history: with the known points.
            inputs: at the nodes, shape (nodes, n).
        """
        newest, *earlier = self.known
        offsets = [0.0, *self.nodes, *(self.past[number] for number in earlier)]
        values = [history.inputs[newest][0], *inputs]
        values += [history.inputs[number][0] for number in earlier]
        signal = InputSignal(interpolate(offsets, values))
        return StepInputs(signal.derivatives, signal.shifted(self.nodes[0]).derivatives)

    def error(self, known: FloatArray, found: FloatArray, predicted: FloatArray) -> FloatArray:
        """Error of the inputs at the last node, shape (n,).

        By Milne's device; where there are too few past points for it, the distance from the line
        through T and the first node: more than the error, as that is of a higher order.

        Args:
            known: inputs at T, shape (n,).
            found: at the nodes, shape (nodes, n).
            predicted: at the nodes, shape (nodes, n).
        """
        if len(self.predicting) < self.order:
            first, last = self.nodes
            line = known + (found[0] - known) * (last / first)
            distance: FloatArray = found[1] - line
            return distance
        past = [self.past[number] for number in self.predicting]
        factor = milne_factor([self.past[number] for number in self.known], self.nodes, past)
        far: FloatArray = found[1] - predicted[1]
        return factor * far
