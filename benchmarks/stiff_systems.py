"""Stiff coupled systems of our own, and the solution of each as one whole.

The slaves' models are put together by what they declare, so a reference is no second copy of their
equations: all states in one system of ordinary differential equations, solved by Radau's method.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from benchmarks import stiff_models
from master_node import System
from slave_node.model import Model

FloatArray = NDArray[np.float64]

_MODELS = Path(stiff_models.__file__)
_RELATIVE, _ABSOLUTE = 1e-10, 1e-12


@dataclass(frozen=True)
class StiffSystem:
    """A system, as its file would say.

    Attributes:
        slaves: model and parameters, by the slave's name.
        connections: outputs and the inputs that they lead to, both as ``slave.variable``.
        stop_time: [s].
    """

    slaves: Mapping[str, tuple[type[Model], Mapping[str, float]]]
    connections: Sequence[tuple[str, str]]
    stop_time: float

    def system(self, tolerance: float, **simulation: Any) -> System:
        """To be run, with RTOL and ATOL, and what else is given."""
        return System(
            slaves={
                name: {"model": f"{_MODELS}:{model.__name__}", "parameters": dict(parameters)}
                for name, (model, parameters) in self.slaves.items()
            },
            connections=tuple({"from": a, "to": b} for a, b in self.connections),
            simulation={
                "stop_time": self.stop_time,
                "relative_tolerance": tolerance,
                "absolute_tolerance": tolerance,
                **simulation,
            },
        )


class Whole:
    """A system as one: x' = f(t, x) for all states, and all outputs of them.

    Args:
        system: of which no outputs feed through to themselves.
    """

    def __init__(self, system: StiffSystem) -> None:
        self.names: list[str] = []
        self._parts: list[tuple[Model, slice, slice]] = []
        start: list[float] = []
        for name, (model, parameters) in system.slaves.items():
            states, outputs = len(start), len(self.names)
            start += [parameters.get(state.name, state.start or 0.0) for state in model.states]
            self.names += [f"{name}.{output.name}" for output in model.outputs]
            one = model()
            for key, value in parameters.items():
                if key not in {state.name for state in model.states}:
                    setattr(one, key, value)
            one.prepare()
            own_outputs = slice(outputs, len(self.names))
            self._parts.append((one, slice(states, len(start)), own_outputs))
        self.start = np.array(start)
        sources = {target: self.names.index(source) for source, target in system.connections}
        self._inputs = [
            [(sources.get(f"{name}.{v.name}"), v.start or 0.0) for v in model.inputs]
            for name, (model, _) in system.slaves.items()
        ]
        self.scale = np.array(
            [state.nominal for model, _ in system.slaves.values() for state in model.states]
        )

    def outputs(self, t: float, x: FloatArray) -> FloatArray:
        """All outputs, shape (m,): as many sweeps as there are slaves settle what feeds through."""
        y = np.zeros(len(self.names))
        for _ in self._parts:
            before = y.copy()
            for (model, states, outputs), inputs in zip(self._parts, self._inputs, strict=True):
                y[outputs] = model.output_values(t, x[states], self._of(y, inputs))
            if np.array_equal(y, before):
                break
        return y

    def derivatives(self, t: float, x: FloatArray) -> FloatArray:
        """x', shape (n_x,)."""
        y, dx = self.outputs(t, x), np.zeros_like(x)
        for (model, states, _), inputs in zip(self._parts, self._inputs, strict=True):
            if model.states:
                dx[states] = model.derivatives(t, x[states], self._of(y, inputs))
        return dx

    @staticmethod
    def _of(y: FloatArray, inputs: Sequence[tuple[int | None, float]]) -> FloatArray:
        return np.array([start if row is None else y[row] for row, start in inputs])


@dataclass(frozen=True)
class Reference:
    """The solution of a whole.

    Attributes:
        whole: the system.
        states: at any time, by dense output.
        span: largest minus smallest value of each output, the largest value at least, shape (m,).
    """

    whole: Whole
    states: Any
    span: FloatArray

    def at(self, times: FloatArray) -> FloatArray:
        """All outputs, shape (n, m), in the order of ``whole.names``."""
        return np.array([self.whole.outputs(t, self.states(t)) for t in times])


@cache
def reference(name: str) -> Reference:
    """The solution of one of `SYSTEMS`, computed once."""
    system = SYSTEMS[name]
    whole = Whole(system)
    solved = solve_ivp(
        whole.derivatives,
        (0.0, system.stop_time),
        whole.start,
        method="Radau",
        rtol=_RELATIVE,
        atol=_ABSOLUTE * whole.scale,
        dense_output=True,
    )
    assert solved.success, solved.message
    every = max(1, len(solved.t) // 2000)
    values = np.array(
        [whole.outputs(t, x) for t, x in zip(solved.t[::every], solved.y.T[::every], strict=True)]
    )
    span = np.maximum(np.ptp(values, axis=0), np.abs(values).max(axis=0))
    return Reference(whole, solved.sol, span)


def _vessels(k: float) -> StiffSystem:
    return StiffSystem(
        {
            "a": (stiff_models.Vessel, {"k": k, "q": 1.0}),
            "b": (stiff_models.Vessel, {"k": k, "p": 0.0, "C": 2.0}),
        },
        (("a.p", "b.p_other"), ("b.p", "a.p_other")),
        10.0,
    )


def _pipe(k: float) -> StiffSystem:
    return StiffSystem(
        {
            "a": (stiff_models.Tank, {"q": 1.0}),
            "b": (stiff_models.Tank, {"p": 0.0, "C": 2.0}),
            "pipe": (stiff_models.Pipe, {"k": k}),
        },
        (
            ("a.p", "pipe.p_1"),
            ("b.p", "pipe.p_2"),
            ("pipe.to_1", "a.inflow"),
            ("pipe.to_2", "b.inflow"),
        ),
        10.0,
    )


def _rod(pieces: int) -> StiffSystem:
    connections = []
    for i in range(1, pieces):
        connections += [
            (f"piece_{i}.last", f"piece_{i + 1}.before"),
            (f"piece_{i + 1}.first", f"piece_{i}.after"),
        ]
    slaves: dict[str, tuple[type[Model], dict[str, float]]] = {
        f"piece_{i}": (stiff_models.RodPiece, {}) for i in range(1, pieces + 1)
    }
    slaves["piece_1"] = (stiff_models.RodPiece, {"heat": 1e3})
    return StiffSystem(slaves, connections, 2.0)


def _contact(glued: float) -> StiffSystem:
    start = {} if glued else {"x": -0.1, "rest": 0.05}
    return StiffSystem(
        {
            "ball": (stiff_models.Ball, {"v": 1.0, **start}),
            "plate": (
                stiff_models.Plate,
                {"glued": glued, **({"v": 1.0, "m": 2.0} if glued else {})},
            ),
        },
        (("ball.x", "plate.x_ball"), ("ball.v", "plate.v_ball"), ("plate.F", "ball.F")),
        2.0,
    )


def _grid() -> StiffSystem:
    connections = []
    for i in (1, 2, 3):
        connections += [
            (f"machine_{i}.delta", f"grid.delta_{i}"),
            (f"machine_{i}.E", f"grid.E_{i}"),
            (f"grid.P_{i}", f"machine_{i}.P"),
            (f"grid.V_{i}", f"machine_{i}.V"),
        ]
    return StiffSystem(
        {
            "machine_1": (stiff_models.Machine, {"P_mech": 1.0, "delta": 0.2}),
            "machine_2": (stiff_models.Machine, {"P_mech": 0.8, "M": 0.1}),
            "machine_3": (stiff_models.Machine, {"P_mech": 0.7, "delta": -0.1}),
            "grid": (stiff_models.Grid, {}),
        },
        connections,
        5.0,
    )


SYSTEMS: dict[str, StiffSystem] = {
    **{f"vessels, k = {k:g}": _vessels(k) for k in (1.0, 1e2, 1e3, 1e4, 1e5, 1e6)},
    **{f"pipe, k = {k:g}": _pipe(k) for k in (1e2, 1e3)},
    **{f"heat rod of {pieces}": _rod(pieces) for pieces in (3, 12)},
    "DC motor": StiffSystem(
        {"windings": (stiff_models.Windings, {}), "rotor": (stiff_models.Rotor, {})},
        (("windings.i", "rotor.i"), ("rotor.w", "windings.w")),
        2.0,
    ),
    "glued masses": _contact(1.0),
    "contact": _contact(0.0),
    "hydraulics": StiffSystem(
        {
            "valve": (stiff_models.Valve, {}),
            "cylinder": (stiff_models.Cylinder, {}),
            "load": (stiff_models.Load, {}),
        },
        (
            ("load.y", "valve.y"),
            ("cylinder.p", "valve.p"),
            ("valve.flow", "cylinder.flow"),
            ("load.v", "cylinder.v"),
            ("cylinder.F", "load.F"),
        ),
        5.0,
    ),
    "van der Pol, mu = 1000": StiffSystem(
        {"x": (stiff_models.Amplitude, {}), "v": (stiff_models.Speed, {})},
        (("x.x", "v.x"), ("v.v", "x.v")),
        700.0,
    ),
    "feed-through chain": StiffSystem(
        {
            "lag": (stiff_models.Lag, {}),
            "one": (stiff_models.Gain, {"gain": -2.0}),
            "two": (stiff_models.Gain, {"gain": 5.0}),
            "three": (stiff_models.Gain, {"gain": 2.0}),
        },
        (("lag.x", "one.u"), ("one.y", "two.u"), ("two.y", "three.u"), ("three.y", "lag.u")),
        10.0,
    ),
    "power grid": _grid(),
    "control loop": StiffSystem(
        {"controller": (stiff_models.Controller, {}), "plant": (stiff_models.Plant, {})},
        (("controller.u", "plant.u"), ("plant.y", "controller.y")),
        5.0,
    ),
    "RLC circuit": StiffSystem(
        {"coil": (stiff_models.Coil, {}), "capacitor": (stiff_models.Capacitor, {})},
        (("coil.i", "capacitor.i"), ("capacitor.v", "coil.v")),
        2.0,
    ),
}
"""By name."""
