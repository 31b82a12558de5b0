"""Functions of time that drive inputs: u(t), from the time in s."""

from __future__ import annotations

from math import cos, pi


def passengers(t: float) -> float:
    """Two of them get in at t = 3 s: a force [N] that is there at once."""
    return 0.0 if t < 3.0 else -1500.0


def washboard(t: float) -> float:
    """A road in waves of 5 mm that come five times a second [m]."""
    return 0.0025 * (1.0 - cos(2.0 * pi * 5.0 * t))
