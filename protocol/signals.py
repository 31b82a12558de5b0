"""Polynomial input signals, the form in which a master tells a slave its inputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

MAX_ORDER = 3
"""Highest polynomial degree that goes over the wire."""


@dataclass(frozen=True, slots=True)
class InputSignal:
    """u(T + tau) = sum_j derivatives[j] * tau**j / j!, around one communication point T.

    Attributes:
        derivatives: shape (k + 1, n_u); row j is d^j u / dt^j at T, unit [u]/s^j. This is what
            ``fmi2SetReal`` (row 0) and ``fmi2SetRealInputDerivatives`` (rows 1 to k) take.
    """

    derivatives: FloatArray

    @property
    def order(self) -> int:
        """Degree k of the polynomial."""
        return len(self.derivatives) - 1

    def at(self, offset: float) -> FloatArray:
        """u(T + offset), shape (n_u,)."""
        value: FloatArray = self.derivatives[-1]
        for j in range(self.order, 0, -1):
            value = self.derivatives[j - 1] + value * (offset / j)
        return value

    def mean(self, span: float) -> FloatArray:
        """Mean of u from T to T + span, shape (n_u,)."""
        value: FloatArray = self.derivatives[-1] / (self.order + 1)
        for j in range(self.order, 0, -1):
            value = self.derivatives[j - 1] / j + value * (span / j)
        return value

    def shifted(self, offset: float) -> InputSignal:
        """Polynomial around T + offset."""
        d = self.derivatives
        k = len(d) - 1
        if k == 0:
            return self
        rows = d.copy()
        if k == 1:
            value, slope = rows
            value += slope * offset
            return InputSignal(rows)
        for j in range(k):
            value = d[k]
            for i in range(k, j, -1):
                value = d[i - 1] + value * (offset / (i - j))
            rows[j] = value
        return InputSignal(rows)
