"""Input polynomials through past communication points (the paper, section 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import factorial

import numpy as np

from protocol.signals import FloatArray, InputSignal


def interpolate(nodes: Sequence[float], values: Sequence[FloatArray]) -> InputSignal:
    """The polynomial of degree k through k + 1 points, as derivatives at offset 0.

    Newton's divided differences, so that constant values have derivatives that are exactly zero,
    then Horner's scheme to powers of the offset.

    Args:
        nodes: k + 1 distinct offsets s_i from the communication point [s], the first one 0.
        values: the inputs there, shape (n_u,) each.

    Returns:
        Shape (k + 1, n_u), see `InputSignal`; row 0 is ``values[0]``, bit for bit.
    """
    k = len(nodes) - 1
    newest = values[0]
    derivatives = np.empty((k + 1, newest.size))
    derivatives[0] = newest
    if k == 1:
        slope = derivatives[1]
        np.subtract(newest, values[1], slope)
        slope /= nodes[0] - nodes[1]
    elif k > 1:
        _taylor(_divided_differences(nodes, values), nodes, derivatives)
    return InputSignal(derivatives)


def _divided_differences(nodes: Sequence[float], values: Sequence[FloatArray]) -> list[FloatArray]:
    """Newton's coefficients [s_0], [s_0, s_1], ..., shape (n_u,) each."""
    differences = list(values)
    newton = [differences[0]]
    for level in range(1, len(nodes)):
        differences = [
            (newer - older) / (nodes[i] - nodes[i + level])
            for i, (newer, older) in enumerate(pairwise(differences))
        ]
        newton.append(differences[0])
    return newton


def _taylor(newton: Sequence[FloatArray], nodes: Sequence[float], derivatives: FloatArray) -> None:
    """Rows 1 to k of ``derivatives`` from Newton's coefficients."""
    k = len(nodes) - 1
    powers = [newton[k]]  # coefficients of powers of the offset
    for level in range(k - 1, -1, -1):
        multiplied = [newton[level], *powers]
        for i, coefficient in enumerate(powers):
            multiplied[i] = multiplied[i] - nodes[level] * coefficient
        powers = multiplied
    for j in range(1, k + 1):
        np.multiply(powers[j], factorial(j), derivatives[j])


@dataclass(frozen=True, slots=True)
class CouplingHistory:
    """The inputs at the last communication points. Immutable: rejecting a step is keeping it.

    Attributes:
        times: T_n, T_(n-1), ..., newest first [s].
        inputs: u there, shape (n_u,) each, all slaves' inputs one after the other.
        depth: how many points are kept at most.
    """

    times: tuple[float, ...]
    inputs: tuple[FloatArray, ...]
    depth: int

    @staticmethod
    def start(time: float, inputs: FloatArray, depth: int) -> CouplingHistory:
        """Only the first communication point: the order grows as points come in."""
        return CouplingHistory((time,), (inputs,), depth)

    @staticmethod
    def at_rest(time: float, inputs: FloatArray, depth: int, step_size: float) -> CouplingHistory:
        """A system that rested before T_0: u(T_0) at T_0 - i H_0 for i = 0 ... depth - 1."""
        times = tuple(time - i * step_size for i in range(depth))
        return CouplingHistory(times, (inputs,) * depth, depth)

    def pushed(self, time: float, inputs: FloatArray) -> CouplingHistory:
        """With a newer communication point, without the oldest one where the depth is reached."""
        keep = self.depth - 1
        return CouplingHistory(
            (time, *self.times[:keep]), (inputs, *self.inputs[:keep]), self.depth
        )

    def signal(self, order: int) -> InputSignal:
        """u-bar: through T_n, T_(n-1), ..., T_(n-k), around T_n."""
        return self._through(slice(order + 1))

    def long_signal(self, order: int) -> InputSignal:
        """u-tilde: through T_n, T_(n-2), ..., T_(n-2k), around T_n, for one step of 2H."""
        return self._through(slice(0, 2 * order + 1, 2))

    def _through(self, points: slice) -> InputSignal:
        now = self.times[0]
        return interpolate([time - now for time in self.times[points]], self.inputs[points])
