"""The slave that a model is coupled with: a first-order lag that answers softly and boundedly."""

# ruff: noqa: ARG002 - every model has the same signatures, whatever it needs of them

from __future__ import annotations

from typing import ClassVar

import numpy as np

from slave_node.model import Model, real


class Lag(Model):
    """T x' = -tanh((y - offset) / scale) - x,  u = base + amplitude x.

    Whatever y does, u stays within ``amplitude`` of ``base``, the start value of the input that it
    feeds, so that any model can be coupled with it. x starts at 1 and moves by itself, too.
    """

    inputs = (real("y"),)
    states = (real("x", start=1.0),)
    outputs = (real("u"),)
    parameters = (
        real("T", "s", start=1.0),
        real("offset"),
        real("scale", start=1.0),
        real("base"),
        real("amplitude", start=0.01),
    )
    feed_through: ClassVar[dict[str, tuple[str, ...]]] = {}

    def derivatives(self, t: float, x: np.ndarray, u: np.ndarray) -> list[float]:
        """See `Model`."""
        return [(-np.tanh((u[0] - self.offset) / self.scale) - x[0]) / self.T]

    def output_values(self, t: float, x: np.ndarray, u: np.ndarray) -> list[float]:
        """See `Model`."""
        return [self.base + self.amplitude * x[0]]
