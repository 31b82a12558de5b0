"""Python models with inputs to drive from outside, loaded by name as those of a user are."""

from __future__ import annotations

from typing import Any

from slave_node.model import Model, real


class Oscillator(Model):
    """x'' = 30 (u - x) - x'."""

    inputs = (real("u"),)
    states = (real("x"), real("v"))
    outputs = states
    parameters = (real("stiffness", start=30.0),)
    solver = "DOP853"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The states."""
        return [x[1], self.stiffness * (u[0] - x[0]) - x[1]]


class Sum(Model):
    """y = u + w: nothing but direct feed-through."""

    inputs = (real("u", start=7.0), real("w", start=70.0))
    outputs = (real("y"),)
    feed_through = {"y": ("u", "w")}  # noqa: RUF012  as a user writes it

    def output_values(self, t: float, x: Any, u: Any) -> list[float]:
        """The output."""
        return [u[0] + u[1]]


class Room(Model):
    """2 T' = 30 on - (T - 283.15), in K and s: a heater that something else switches."""

    inputs = (real("on"),)
    states = (real("T", "K", start=293.15),)
    outputs = states
    solver = "DOP853"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The temperature."""
        return [(30.0 * u[0] - (x[0] - 283.15)) / 2.0]


class Wave(Model):
    """x = sin(t), which depends on no input."""

    states = (real("x", start=0.0), real("v", start=1.0))
    outputs = (real("x"),)

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The states."""
        return [x[1], -x[0]]
