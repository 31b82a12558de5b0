"""The quarter car in Python: the same models, variables and parameters as the C FMUs in src/.

::

    chassis   m_c x_c'' = k_c (x_w - x_c) + d_c (v_w - v_c)
    wheel     m_w x_w'' = k_w (z - x_w) - d_w v_w - k_c (x_w - x_c) - d_c (v_w - v_c)

It can be cut in two ways. Displacement-displacement: `Chassis` and `Wheel` tell each other
displacement and velocity. Displacement-force: `WheelForce` tells `ChassisForce` the force
between them, with direct feed-through.

Schierz, Arnold, Clauß: Co-simulation with communication step size control in an FMI compatible
master algorithm, Modelica 2012.
"""
# ruff: noqa: ARG002 - every model has the same signatures, whatever it needs of them

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slave_node.model import Model, real

FloatArray = NDArray[np.float64]

_DISPLACEMENT = real("x", "m", description="Displacement")
_VELOCITY = real("v", "m/s", description="Velocity")
_MAX_STEP = real(
    "max_step", "s", description="Longest communication step that is taken whole. 0: any"
)


class Chassis(Model):
    """The chassis, hung on the wheel by a spring and a damper."""

    inputs = (
        real("x_w", "m", description="Displacement of the wheel"),
        real("v_w", "m/s", description="Velocity of the wheel"),
    )
    states = (_DISPLACEMENT, _VELOCITY)
    outputs = states
    parameters = (
        real("m", "kg", start=400.0, description="Mass of the chassis"),
        real(
            "k", "N/m", start=15000.0, description="Spring between chassis and wheel", tunable=True
        ),
        real(
            "d", "N.s/m", start=1000.0, description="Damper between chassis and wheel", tunable=True
        ),
        _MAX_STEP,
    )

    def derivatives(self, t: float, x: FloatArray, u: FloatArray) -> list[float]:
        """Newton's law."""
        (x_c, v_c), (x_w, v_w) = x.tolist(), u.tolist()
        return [v_c, (self.k * (x_w - x_c) + self.d * (v_w - v_c)) / self.m]


class WheelOnRoad(Model):
    """The equations that both wheels have in common."""

    inputs = (
        real("x_c", "m", description="Displacement of the chassis"),
        real("v_c", "m/s", description="Velocity of the chassis"),
    )
    states = (_DISPLACEMENT, _VELOCITY)
    parameters = (
        real("m", "kg", start=40.0, description="Mass of the wheel"),
        real(
            "k_w", "N/m", start=150000.0, description="Spring between wheel and road", tunable=True
        ),
        real("d_w", "N.s/m", start=0.0, description="Damper between wheel and road", tunable=True),
        real(
            "k_c",
            "N/m",
            start=15000.0,
            description="Spring between chassis and wheel",
            tunable=True,
        ),
        real(
            "d_c",
            "N.s/m",
            start=1000.0,
            description="Damper between chassis and wheel",
            tunable=True,
        ),
        real("z", "m", start=0.1, description="Height of the road", tunable=True),
        _MAX_STEP,
    )

    def force(self, x: FloatArray, u: FloatArray) -> float:
        """The force on the chassis [N]; of derivatives, its derivative [N/s]."""
        (x_w, v_w), (x_c, v_c) = x.tolist(), u.tolist()
        return float(self.k_c * (x_w - x_c) + self.d_c * (v_w - v_c))

    def derivatives(self, t: float, x: FloatArray, u: FloatArray) -> list[float]:
        """Newton's law. The road does not move, so its damper sees the wheel's velocity alone."""
        x_w, v_w = x.tolist()
        return [
            v_w,
            (self.k_w * (self.z - x_w) - self.d_w * v_w - self.force(x, u)) / self.m,
        ]


class Wheel(WheelOnRoad):
    """The wheel, which tells the chassis its displacement and velocity."""

    outputs = WheelOnRoad.states


class WheelForce(WheelOnRoad):
    """The wheel, which tells the chassis the force between them (direct feed-through)."""

    outputs = (real("F", "N", description="Force on the chassis"),)
    feed_through = {"F": ("x_c", "v_c")}  # noqa: RUF012 - a ClassVar of Model

    def output_values(self, t: float, x: FloatArray, u: FloatArray) -> list[float]:
        """F = k_c (x_w - x_c) + d_c (v_w - v_c)."""
        return [self.force(x, u)]

    def output_derivatives(
        self, t: float, x: FloatArray, u: FloatArray, dx: FloatArray, du: FloatArray
    ) -> list[float]:
        """F is linear, so F' is the same form in the derivatives."""
        return [self.force(dx, du)]


class ChassisForce(Model):
    """The chassis as a free mass, moved by the force that the wheel sends."""

    inputs = (real("F", "N", description="Force of the wheel"),)
    states = (_DISPLACEMENT, _VELOCITY)
    outputs = states
    parameters = (real("m", "kg", start=400.0, description="Mass of the chassis"), _MAX_STEP)

    def derivatives(self, t: float, x: FloatArray, u: FloatArray) -> list[float]:
        """Newton's law."""
        return [float(x[1]), float(u[0]) / self.m]


def exact_solution(t: ArrayLike) -> FloatArray:
    """The whole system from rest on a road of height z = 0.1 m, with the default parameters.

    s' = A s + b comes to rest at s_oo = (z, 0, z, 0), so s(t) = s_oo - exp(A t) s_oo, here by the
    eigenvalues of A. Accurate to about 1e-13.

    Args:
        t: times [s], shape (n,), t >= 0.

    Returns:
        chassis.x [m], chassis.v [m/s], wheel.x [m], wheel.v [m/s]: shape (n, 4).
    """
    m_c, m_w, k_w, k_c, d_c, z = 400.0, 40.0, 150000.0, 15000.0, 1000.0, 0.1
    matrix = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [-k_c / m_c, -d_c / m_c, k_c / m_c, d_c / m_c],
            [0.0, 0.0, 0.0, 1.0],
            [k_c / m_w, d_c / m_w, -(k_w + k_c) / m_w, -d_c / m_w],
        ]
    )
    at_rest = np.array([z, 0.0, z, 0.0])
    eigenvalues, eigenvectors = np.linalg.eig(matrix)
    amplitudes = np.linalg.solve(eigenvectors, at_rest)
    modes: NDArray[np.complex128] = (
        np.exp(np.multiply.outer(np.asarray(t, float), eigenvalues)) * amplitudes
    )
    motion: FloatArray = at_rest - (modes @ eigenvectors.T).real
    return motion
