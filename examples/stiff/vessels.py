"""A vessel that exchanges k (p_other - p) with another one."""

# ruff: noqa: ARG002  every model has the same signatures

from __future__ import annotations

from protocol.signals import FloatArray
from slave_node.model import Model, real


class Vessel(Model):
    """C p' = q - leak p + k (p_other - p)."""

    inputs = (real("p_other", unit="bar"),)
    states = (real("p", start=1.0, unit="bar"),)
    outputs = states
    parameters = (
        real("C", start=1.0),
        real("k", start=1.0),
        real("leak", start=0.5),
        real("q", start=0.0),
    )
    solver = "Radau"

    def derivatives(self, t: float, x: FloatArray, u: FloatArray) -> list[float]:
        """P'."""
        return [(self.q - self.leak * x[0] + self.k * (u[0] - x[0])) / self.C]
