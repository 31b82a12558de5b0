"""Slaves of the stiff systems in ``stiff_systems.py``, written in Python."""
# ruff: noqa: ARG002, RUF012  as a user writes models

from __future__ import annotations

import math
from typing import Any

from slave_node.model import Model, real


class Vessel(Model):
    """C p' = q - leak p + k (p_other - p): two of them exchange k (p_1 - p_2)."""

    inputs = (real("p_other"),)
    states = (real("p", start=1.0),)
    outputs = states
    parameters = (
        real("C", start=1.0),
        real("k", start=1.0),
        real("leak", start=0.5),
        real("q", start=0.0),
    )
    solver = "Radau"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The pressure."""
        return [(self.q - self.leak * x[0] + self.k * (u[0] - x[0])) / self.C]


class Tank(Model):
    """C p' = q + inflow - leak p: a vessel that is told the flow."""

    inputs = (real("inflow"),)
    states = (real("p", start=1.0),)
    outputs = states
    parameters = (real("C", start=1.0), real("leak", start=0.5), real("q", start=0.0))
    solver = "DOP853"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The pressure."""
        return [(self.q + u[0] - self.leak * x[0]) / self.C]


class Pipe(Model):
    """q = k (p_1 - p_2), by direct feed-through: to_1 = -q, to_2 = q."""

    inputs = (real("p_1"), real("p_2"))
    outputs = (real("to_1"), real("to_2"))
    parameters = (real("k", start=100.0),)
    feed_through = {"to_1": ("p_1", "p_2"), "to_2": ("p_1", "p_2")}

    def output_values(self, t: float, x: Any, u: Any) -> list[float]:
        """The flows."""
        flow = self.k * (u[0] - u[1])
        return [-flow, flow]

    def output_derivatives(self, t: float, x: Any, u: Any, dx: Any, du: Any) -> list[float]:
        """Their derivatives."""
        flow = self.k * (du[0] - du[1])
        return [-flow, flow]


class RodPiece(Model):
    """Three cells of a heat rod: T_i' = k (T_(i-1) - 2 T_i + T_(i+1)) + heat in the first one."""

    inputs = (real("before"), real("after"))
    states = (real("first"), real("middle"), real("last"))
    outputs = states[::2]
    parameters = (real("k", "1/s", start=100.0), real("heat", "K/s"))
    solver = "Radau"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The temperatures."""
        first, middle, last = x
        return [
            self.k * (u[0] - 2.0 * first + middle) + self.heat,
            self.k * (first - 2.0 * middle + last),
            self.k * (middle - 2.0 * last + u[1]),
        ]


class Windings(Model):
    """L i' = V(t) - R i - K w: the electric half of a DC motor."""

    inputs = (real("w", "rad/s", nominal=10.0),)
    states = (real("i", "A"),)
    outputs = states
    parameters = (
        real("L", "H", start=1e-4),
        real("R", "Ohm", start=1.0),
        real("K", "V.s", start=0.5),
    )
    solver = "Radau"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The current."""
        voltage = 12.0 + 3.0 * math.sin(6.0 * t)
        return [(voltage - self.R * x[0] - self.K * u[0]) / self.L]


class Rotor(Model):
    """J w' = K i - d w: the mechanical half."""

    inputs = (real("i", "A"),)
    states = (real("w", "rad/s", nominal=10.0),)
    outputs = states
    parameters = (
        real("J", "kg.m2", start=1e-2),
        real("K", "V.s", start=0.5),
        real("d", "N.m.s", start=1e-2),
    )
    solver = "DOP853"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The speed."""
        return [(self.K * u[0] - self.d * x[0]) / self.J]


class Ball(Model):
    """m x'' = F - c x - d v: a mass on a soft spring, pushed by F."""

    inputs = (real("F", "N", nominal=10.0),)
    states = (real("x", "m"), real("v", "m/s"))
    outputs = states
    parameters = (
        real("m", "kg", start=1.0),
        real("c", "N/m", start=10.0),
        real("d", "N.s/m", start=0.5),
        real("rest", "m"),
    )
    solver = "DOP853"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """Position and speed."""
        return [x[1], (u[0] - self.c * (x[0] - self.rest) - self.d * x[1]) / self.m]


class Plate(Model):
    """A mass on a soft spring, pushed through a contact that is a hundred thousand times stiffer.

    The contact is one-sided unless it is ``glued``: F = C s + D s' while s = x_ball - x > 0.
    """

    inputs = (real("x_ball", "m"), real("v_ball", "m/s"))
    states = (real("x", "m"), real("v", "m/s"))
    outputs = (*states, real("F", "N", nominal=10.0))
    parameters = (
        real("m", "kg", start=1.0),
        real("c", "N/m", start=10.0),
        real("d", "N.s/m", start=0.5),
        real("C", "N/m", start=1e6),
        real("D", "N.s/m", start=2e3),
        real("glued"),
    )
    feed_through = {"F": ("x_ball", "v_ball")}
    solver = "Radau"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """Position and speed."""
        return [x[1], (self._push(x, u) - self.c * x[0] - self.d * x[1]) / self.m]

    def output_values(self, t: float, x: Any, u: Any) -> list[float]:
        """With the force on the ball."""
        return [x[0], x[1], -self._push(x, u)]

    def _push(self, x: Any, u: Any) -> float:
        depth = u[0] - x[0]
        push = float(self.C * depth + self.D * (u[1] - x[1]))
        return push if self.glued else max(0.0, push) if depth > 0.0 else 0.0


class Valve(Model):
    """A PI controller of the position, and the valve that it moves: flow = G s (supply - p)."""

    inputs = (real("y", "m"), real("p", "MPa", nominal=1.0))
    states = (real("sum", "m.s"), real("s"))
    outputs = (real("flow", "l/s"),)
    parameters = (
        real("wanted", "m", start=0.1),
        real("gain", "1/m", start=4.0),
        real("reset", "1/(m.s)", start=2.0),
        real("lag", "s", start=0.02),
        real("G", "l/(s.MPa)", start=0.05),
        real("supply", "MPa", start=10.0),
    )
    feed_through = {"flow": ("p",)}
    solver = "DOP853"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The controller's sum, and the valve's position."""
        error = self.wanted - u[0]
        return [error, (self.gain * error + self.reset * x[0] - x[1]) / self.lag]

    def output_values(self, t: float, x: Any, u: Any) -> list[float]:
        """The flow; a valve at s < 0 lets it out to the tank."""
        return [self.G * x[1] * ((self.supply - u[0]) if x[1] > 0.0 else (u[0] + 2.0))]


class Cylinder(Model):
    """V/B p' = flow - A v - leak p: a stiff column of oil that moves a load; F = A p."""

    inputs = (real("flow", "l/s"), real("v", "m/s"))
    states = (real("p", "MPa"),)
    outputs = (*states, real("F", "kN"))
    parameters = (
        real("A", "l/m", start=1.0),
        real("stiffness", "MPa/l", start=1e4),
        real("leak", "l/(s.MPa)", start=0.01),
    )
    solver = "Radau"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The pressure."""
        return [self.stiffness * (u[0] - self.A * u[1] - self.leak * x[0])]

    def output_values(self, t: float, x: Any, u: Any) -> list[float]:
        """With the force on the load."""
        return [x[0], self.A * x[0]]

    def output_derivatives(self, t: float, x: Any, u: Any, dx: Any, du: Any) -> list[float]:
        """Their derivatives."""
        return [dx[0], self.A * dx[0]]


class Load(Model):
    """m y'' = F - c y - d v, in kN and t."""

    inputs = (real("F", "kN"),)
    states = (real("y", "m"), real("v", "m/s"))
    outputs = states
    parameters = (
        real("m", "t", start=0.1),
        real("c", "kN/m", start=10.0),
        real("d", "kN.s/m", start=1.0),
    )
    solver = "DOP853"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """Position and speed."""
        return [x[1], (u[0] - self.c * x[0] - self.d * x[1]) / self.m]


class Amplitude(Model):
    """x' = v: the slow half of a van der Pol oscillator."""

    inputs = (real("v", nominal=1e-3),)
    states = (real("x", start=2.0),)
    outputs = states
    solver = "DOP853"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The amplitude."""
        return [u[0]]


class Speed(Model):
    """v' = mu (1 - x^2) v - x: the fast half, that follows x within 1 / mu."""

    inputs = (real("x", start=2.0),)
    states = (real("v", nominal=1e-3),)
    outputs = states
    parameters = (real("mu", start=1e3),)
    solver = "Radau"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The speed."""
        return [self.mu * (1.0 - u[0] * u[0]) * x[0] - u[0]]


class Gain(Model):
    """y = gain u, by direct feed-through."""

    inputs = (real("u"),)
    outputs = (real("y"),)
    parameters = (real("gain", start=1.0),)
    feed_through = {"y": ("u",)}

    def output_values(self, t: float, x: Any, u: Any) -> list[float]:
        """The output."""
        return [self.gain * u[0]]

    def output_derivatives(self, t: float, x: Any, u: Any, dx: Any, du: Any) -> list[float]:
        """Its derivative."""
        return [self.gain * du[0]]


class Lag(Model):
    """T x' = 20 sin(t) + u - x."""

    inputs = (real("u"),)
    states = (real("x"),)
    outputs = states
    parameters = (real("T", "s", start=1.0),)
    solver = "DOP853"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The output."""
        return [(20.0 * math.sin(t) + u[0] - x[0]) / self.T]


class Machine(Model):
    """A generator: swing equation, field, and a fast exciter that holds its terminal voltage."""

    inputs = (real("P"), real("V", start=1.0))
    states = (
        real("delta", "rad"),
        real("w", "rad/s"),
        real("E", start=1.1),
        real("field", start=1.1),
    )
    outputs = (states[0], states[2], states[1])
    parameters = (
        real("P_mech", start=0.8),
        real("M", "s2", start=0.05),
        real("D", "s", start=0.1),
        real("T_field", "s", start=0.5),
        real("T_exciter", "s", start=5e-3),
        real("gain", start=50.0),
        real("V_wanted", start=1.05),
    )
    solver = "Radau"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """Angle, speed, voltage behind the reactance, field voltage."""
        _, w, voltage, field = x
        asked = self.gain * (self.V_wanted - u[1])
        return [
            w,
            (self.P_mech - u[0] - self.D * w) / self.M,
            (field - voltage) / self.T_field,
            (asked - field) / self.T_exciter,
        ]


_AT_MACHINES = tuple(real(f"{name}_{i}") for i in (1, 2, 3) for name in ("delta", "E"))
_OF_GRID = tuple(real(f"{name}_{i}") for i in (1, 2, 3) for name in ("P", "V"))


class Grid(Model):
    """The network between three machines: their powers and terminal voltages, by feed-through."""

    inputs = _AT_MACHINES
    outputs = _OF_GRID
    feed_through = dict.fromkeys((v.name for v in _OF_GRID), tuple(v.name for v in _AT_MACHINES))
    parameters = (real("B", start=2.0), real("load", start=0.7), real("X", start=0.1))

    def output_values(self, t: float, x: Any, u: Any) -> list[float]:
        """Machines in a triangle of lines B, with a load and a reactance X at each."""
        phasors = [
            e * complex(math.cos(d), math.sin(d)) for d, e in zip(u[::2], u[1::2], strict=True)
        ]
        values = []
        for own in phasors:
            current = self.load * own + sum(-1j * self.B * (own - other) for other in phasors)
            values += [(own * current.conjugate()).real, abs(own - 1j * self.X * current)]
        return values


class Controller(Model):
    """u = K (e + sum / T), e = wanted - y: the integrator of a control loop."""

    inputs = (real("y"),)
    states = (real("sum"),)
    outputs = (real("u"),)
    parameters = (real("K", start=20.0), real("T", "s", start=0.5), real("wanted", start=1.0))
    feed_through = {"u": ("y",)}
    solver = "DOP853"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The sum of the errors."""
        return [self.wanted - u[0]]

    def output_values(self, t: float, x: Any, u: Any) -> list[float]:
        """Set point of the plant."""
        return [self.K * (self.wanted - u[0] + x[0] / self.T)]

    def output_derivatives(self, t: float, x: Any, u: Any, dx: Any, du: Any) -> list[float]:
        """Its derivative."""
        return [self.K * (-du[0] + dx[0] / self.T)]


class Plant(Model):
    """Two lags in series, of which one is fast."""

    inputs = (real("u"),)
    states = (real("inner"), real("y"))
    outputs = (states[1],)
    parameters = (real("fast", "s", start=2e-3), real("slow", "s", start=1.0))
    solver = "Radau"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """Both lags."""
        return [(u[0] - x[0]) / self.fast, (x[0] - x[1]) / self.slow]


class Coil(Model):
    """L i' = V(t) - R i - v: the half of an RLC circuit with the source."""

    inputs = (real("v", "V"),)
    states = (real("i", "A"),)
    outputs = states
    parameters = (real("L", "H", start=1e-3), real("R", "Ohm", start=1.0))
    solver = "Radau"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The current."""
        return [(math.sin(12.0 * t) - self.R * x[0] - u[0]) / self.L]


class Capacitor(Model):
    """C v' = i - v / R: the other half."""

    inputs = (real("i", "A"),)
    states = (real("v", "V"),)
    outputs = states
    parameters = (real("C", "F", start=1e-3), real("R", "Ohm", start=2.0))
    solver = "Radau"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The voltage."""
        return [(u[0] - x[0] / self.R) / self.C]
