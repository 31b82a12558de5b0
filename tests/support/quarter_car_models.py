"""Python models for the tests, loaded by name as those of a user are."""

from __future__ import annotations

from pathlib import Path
from time import monotonic, sleep
from typing import Any

from protocol.variables import Variable, VariableType
from slave_node.model import Model, real
from slave_node.python.loading import load_model_class

_EXAMPLES = Path(__file__).parents[2] / "examples" / "quarter_car"
_Chassis: Any = load_model_class("quarter_car.py:Chassis", _EXAMPLES)
_Wheel: Any = load_model_class("quarter_car.py:Wheel", _EXAMPLES)

_PATIENCE = 600.0
"""No model waits longer for a test [s]."""

RAMP_TIME = 0.5
RAMP_POWER = 5


class SmoothChassis(_Chassis):
    """The chassis, integrated nearly exactly when the tolerance asks for it."""

    solver = "DOP853"


class SmoothWheel(_Wheel):
    """The wheel on a road that rises as z (t / T)^5 from t = 0 on.

    Before that the car really rests, and the motion has its first four derivatives at 0: a start-up
    history at rest is exact, and the polynomials of degree up to 3 see no kink.
    """

    solver = "DOP853"

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """Newton's law, with the height of the road at t instead of z."""
        v, acceleration = super().derivatives(t, x, u)
        rise = self.z * ((t / RAMP_TIME) ** RAMP_POWER - 1.0)
        return [v, acceleration + self.k_w * rise / self.m]


class Gain(Model):
    """y = gain u + offset: nothing but direct feed-through."""

    inputs = (real("u"),)
    outputs = (real("y"),)
    parameters = (real("gain", start=1.0), real("offset", start=0.0))
    feed_through = {"y": ("u",)}  # noqa: RUF012  as a user writes it

    def output_values(self, t: float, x: Any, u: Any) -> list[float]:
        """The output."""
        return [self.gain * u[0] + self.offset]


class BreaksDown(_Chassis):
    """A chassis whose equations have no value from ``breaks_at`` on: do_step fails."""

    parameters = (*_Chassis.parameters, real("breaks_at", "s", start=0.1))

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """A logarithm of a negative number, as it were."""
        if t >= self.breaks_at:
            raise ValueError("math domain error")
        return list(super().derivatives(t, x, u))


class Sleeper(_Chassis):
    """A chassis that takes ``nap`` seconds for every step from ``sleeps_at`` on, and says so."""

    parameters = (
        *_Chassis.parameters,
        real("sleeps_at", "s", start=0.0),
        real("nap", "s", start=0.0),
        Variable("bed", type=VariableType.STRING, start=""),
    )

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The chassis' equations, later."""
        if t >= self.sleeps_at:
            if self.bed:
                Path(self.bed).touch()
            sleep(self.nap)
        return list(super().derivatives(t, x, u))


class Napper(Sleeper):
    """A chassis that sleeps for ``nap`` seconds once, at ``sleeps_at``, where no ``bed`` is yet."""

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The chassis' equations, once later."""
        if self.bed and Path(self.bed).exists():
            return list(_Chassis.derivatives(self, t, x, u))
        return super().derivatives(t, x, u)


class Gated(_Chassis):
    """A chassis that stops at each of its ``gates``, such as "0.03, 0.06", until a test opens it.

    A file in ``folder`` tells that the model is there, another one that it may go on.
    """

    parameters = (
        *_Chassis.parameters,
        Variable("gates", type=VariableType.STRING, start=""),
        Variable("folder", type=VariableType.STRING, start=""),
    )

    def prepare(self) -> None:
        """All gates are ahead."""
        super().prepare()
        self._ahead = list(enumerate(map(float, self.gates.split(","))))

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The chassis' equations, behind the gate."""
        while self._ahead and t >= self._ahead[0][1]:
            number, _ = self._ahead.pop(0)
            Path(self.folder, f"at gate {number}").touch()
            end = monotonic() + _PATIENCE
            while not Path(self.folder, f"gate {number} is open").exists():
                if monotonic() > end:
                    raise TimeoutError("the gate stays closed")
                sleep(0.005)
        return list(super().derivatives(t, x, u))


class Filter(Model):
    """x' = u - x and y = x + gain u: its output follows its input at once, and late."""

    inputs = (real("u"),)
    outputs = (real("y"),)
    states = (real("x", start=1.0),)
    parameters = (real("gain", start=0.5),)
    feed_through = {"y": ("u",)}  # noqa: RUF012  as a user writes it

    def derivatives(self, t: float, x: Any, u: Any) -> list[float]:
        """The state."""
        return [u[0] - x[0]]

    def output_values(self, t: float, x: Any, u: Any) -> list[float]:
        """The output."""
        return [x[0] + self.gain * u[0]]


class LateLoop(Filter):
    """From t = 0.5 s on y = x + u: two of them contain each other without a solution."""

    def output_values(self, t: float, x: Any, u: Any) -> list[float]:
        """The output."""
        return [x[0] + (self.gain if t < 0.5 else 1.0) * u[0]]
