"""Input polynomials through past communication points (the paper, section 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
    if k == 0:
        return InputSignal(values[0][np.newaxis])
    differences = list(values)
    newton = [differences[0]]
    for level in range(1, k + 1):
        differences = [
            (differences[i] - differences[i + 1]) / (nodes[i] - nodes[i + level])
            for i in range(k + 1 - level)
        ]
        newton.append(differences[0])
    derivatives = np.empty((k + 1, len(values[0])))
    derivatives[0] = newton[0]
    if k == 1:
        derivatives[1] = newton[1]
        return InputSignal(derivatives)
    coefficients = [newton[k]]  # of powers of the offset, highest degree last
    for level in range(k - 1, -1, -1):
        shifted = [newton[level], *coefficients]
        for i, coefficient in enumerate(coefficients):
            shifted[i] = shifted[i] - nodes[level] * coefficient
        coefficients = shifted
    factorial = 1.0
    for j in range(1, k + 1):
        factorial *= j
        derivatives[j] = coefficients[j] * factorial
    return InputSignal(derivatives)


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
        return self._through(range(order + 1))

    def long_signal(self, order: int) -> InputSignal:
        """u-tilde: through T_n, T_(n-2), ..., T_(n-2k), around T_n, for one step of 2H."""
        return self._through(range(0, 2 * order + 1, 2))

    def _through(self, points: range) -> InputSignal:
        now = self.times[0]
        return interpolate([self.times[i] - now for i in points], [self.inputs[i] for i in points])
