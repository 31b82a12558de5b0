"""Slaves that jump, switch and act stiffly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import cos, factorial, sin

import numpy as np

from protocol.calls import Initialize, StepResult, StepStatus
from protocol.description import InputDerivatives, SlaveDescription, StateKind
from protocol.signals import InputSignal
from protocol.slave import Slave
from protocol.variables import Causality, Variable
from tests.support.quarter_car_case import ALL


class ExactSlave(Slave):
    """A slave of states x and inputs u whose subclass says how they move and what is read.

    Args:
        inputs, outputs: names.
        x: states at the start.
        derivatives: whether outputs come with derivatives.
        feed_through: for each output the inputs that it depends on directly.
    """

    def __init__(
        self,
        inputs: Sequence[str],
        outputs: Sequence[str],
        x: Sequence[float] = (),
        *,
        derivatives: bool = False,
        feed_through: Mapping[str, tuple[str, ...]] | None = None,
    ) -> None:
        self._x0 = np.array(x, dtype=float)
        self._names = tuple(inputs)
        direct = dict(feed_through or {})
        self.description = SlaveDescription(
            model=type(self).__name__,
            kind="test",
            variables=(
                *(Variable(name, Causality.INPUT, start=0.0) for name in inputs),
                *(Variable(name, Causality.OUTPUT) for name in outputs),
            ),
            capabilities=replace(ALL, max_output_derivative_order=int(derivatives)),
            feed_through=direct,
            initial_feed_through=direct,
            state_kind=StateKind.NATIVE,
            input_derivatives=InputDerivatives.NATIVE,
        )
        self.reset()

    # ---- What subclasses say ------------------------------------------------------------------

    def moved(self, t: float, x: np.ndarray, u: InputSignal, h: float) -> np.ndarray:
        """The states at t + h."""
        return x

    def read(self, t: float, x: np.ndarray, u: np.ndarray) -> Sequence[Sequence[float]]:
        """Outputs, and their derivatives."""
        raise NotImplementedError

    # ---- What all have in common --------------------------------------------------------------

    def reset(self) -> None:
        """See `Slave`."""
        self.t, self.x, self.u = 0.0, self._x0, np.zeros((1, len(self._names)))

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`."""
        assert experiment.inputs == self._names
        self.t = experiment.start_time

    def exit_initialization_mode(self) -> None:
        """See `Slave`."""

    def set_inputs(self, derivatives: np.ndarray) -> None:
        """See `Slave`."""
        self.u = derivatives

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`."""
        signal = InputSignal(self.u)
        self.x = self.moved(communication_point, self.x, signal, step_size)
        self.u = signal.shifted(step_size).derivatives
        self.t = communication_point + step_size
        return StepResult(StepStatus.OK, self.t)

    def get_outputs(self, order: int) -> np.ndarray:
        """See `Slave`."""
        u = self.u if len(self.u) > 1 else np.vstack([self.u, np.zeros_like(self.u)])
        rows = self.read(self.t, self.x, u)
        return np.array(rows[: order + 1], dtype=float)

    def get_state(self) -> object:
        """See `Slave`."""
        return self.t, self.x, self.u

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        self.t, self.x, self.u = state  # type: ignore[misc]

    def free_state(self, state: object) -> None:
        """See `Slave`."""

    def serialize_state(self, state: object) -> bytes:
        """See `Slave`."""
        raise NotImplementedError

    def deserialize_state(self, data: bytes) -> object:
        """See `Slave`."""
        raise NotImplementedError

    def terminate(self) -> None:
        """See `Slave`."""

    def close(self) -> None:
        """See `Slave`."""


Train = Sequence[tuple[float, float]]
"""Times at which a signal jumps [s], increasing, and its values from then on; 0 before."""


class PulseTrains(ExactSlave):
    """Outputs s_0, s_1, ... that are constant but for jumps."""

    def __init__(self, trains: Sequence[Train], *, derivatives: bool = False) -> None:
        self.trains = trains
        super().__init__((), [f"s_{i}" for i in range(len(trains))], derivatives=derivatives)

    def read(self, t: float, x: np.ndarray, u: np.ndarray) -> Sequence[Sequence[float]]:
        """See `ExactSlave`."""
        values = [([0.0] + [v for at, v in train if t >= at])[-1] for train in self.trains]
        return [values, [0.0] * len(values)]


class Cosine(ExactSlave):
    """y = cos t, whatever happens."""

    def __init__(self) -> None:
        super().__init__((), ("y",))

    def read(self, t: float, x: np.ndarray, u: np.ndarray) -> Sequence[Sequence[float]]:
        """See `ExactSlave`."""
        return [[cos(t)], [-sin(t)]]


class Product(ExactSlave):
    """x' = gain u_0 u_1 ... of its inputs u_0, u_1, ..., integrated exactly; its output is x."""

    def __init__(
        self, factors: int, gain: float = 1.0, x: float = 0.0, *, derivatives: bool = False
    ) -> None:
        self.gain = gain
        names = [f"u_{i}" for i in range(factors)]
        super().__init__(names, ["x"], [x], derivatives=derivatives)

    def moved(self, t: float, x: np.ndarray, u: InputSignal, h: float) -> np.ndarray:
        """See `ExactSlave`."""
        nodes, weights = np.polynomial.legendre.leggauss(8)
        rates = [float(np.prod(u.at(0.5 * h * (1.0 + node)))) for node in nodes]
        return x + self.gain * 0.5 * h * float(np.dot(weights, rates))

    def read(self, t: float, x: np.ndarray, u: np.ndarray) -> Sequence[Sequence[float]]:
        """See `ExactSlave`."""
        return [[x[0]], [self.gain * float(np.prod(u[0]))]]


class Threshold(ExactSlave):
    """y = high while u is below a limit, else low: no rate, and no reaction but at the limit."""

    def __init__(self, limit: float, low: float, high: float) -> None:
        self.limit, self.low, self.high = limit, low, high
        super().__init__(("u",), ("y",), feed_through={"y": ("u",)})

    def read(self, t: float, x: np.ndarray, u: np.ndarray) -> Sequence[Sequence[float]]:
        """See `ExactSlave`."""
        return [[self.high if u[0, 0] < self.limit else self.low], [0.0]]


class LimitedController(ExactSlave):
    """y = k (e + x / t_i) within +-limit, with e = r - w and x' = e: a PI controller."""

    def __init__(self, k: float, t_i: float, limit: float) -> None:
        self.k, self.t_i, self.limit = k, t_i, limit
        super().__init__(("r", "w"), ("y",), [0.0], feed_through={"y": ("r", "w")})

    def moved(self, t: float, x: np.ndarray, u: InputSignal, h: float) -> np.ndarray:
        """See `ExactSlave`."""
        reached = x.copy()
        for j, row in enumerate(u.derivatives):
            reached = reached + (row[0] - row[1]) * h ** (j + 1) / factorial(j + 1)
        return reached

    def read(self, t: float, x: np.ndarray, u: np.ndarray) -> Sequence[Sequence[float]]:
        """See `ExactSlave`."""
        wanted = self.k * (u[0, 0] - u[0, 1] + x[0] / self.t_i)
        return [[min(self.limit, max(-self.limit, wanted))], [0.0]]
