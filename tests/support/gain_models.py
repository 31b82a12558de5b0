"""Models without states whose outputs are linear in their inputs: loops of known gain."""

from __future__ import annotations

from typing import ClassVar

from protocol.signals import FloatArray
from slave_node.model import Model, real


class Gain(Model):
    """y = k u + c."""

    inputs = (real("u", nominal=10.0),)
    outputs = (real("y"),)
    parameters = (real("k", start=0.5), real("c", start=1.0))
    feed_through: ClassVar = {"y": ("u",)}

    def output_values(self, t: float, x: FloatArray, u: FloatArray) -> list[float]:
        """The line."""
        return [self.k * float(u[0]) + self.c]


class Mixer(Model):
    """y_1 = u_1 / 4 + u_2 / 2, y_2 = u_1 / 8."""

    inputs = (real("u_1"), real("u_2"))
    outputs = (real("y_1"), real("y_2"))
    feed_through: ClassVar = {"y_1": ("u_1", "u_2"), "y_2": ("u_1",)}

    def output_values(self, t: float, x: FloatArray, u: FloatArray) -> list[float]:
        """The matrix."""
        return [0.25 * float(u[0]) + 0.5 * float(u[1]), 0.125 * float(u[0])]
