"""The wheel of the quarter car for PythonFMU, which makes an FMI 2.0 co-simulation FMU of it.

The state that PythonFMU saves is the values of all variables. Here they are all that there is, so
the FMU can declare canGetAndSetFMUstate.
"""

from __future__ import annotations

from pythonfmu import Fmi2Causality, Fmi2Initial, Fmi2Slave, Fmi2Variability, Real
from runge_kutta import integrate

_PARAMETERS = {"m": 40.0, "k_w": 150000.0, "d_w": 0.0, "k_c": 15000.0, "d_c": 1000.0, "z": 0.1}


class Wheel(Fmi2Slave):
    """The wheel, which tells the chassis its displacement and velocity."""

    def __init__(self, **kwargs: object) -> None:
        super().__init__(**kwargs)
        self.modelName = "wheel"
        self.description = "Wheel of a quarter car"
        self.x_c = self.v_c = self.x = self.v = 0.0
        for name in ("x_c", "v_c"):
            self.register_variable(
                Real(name, causality=Fmi2Causality.input, variability=Fmi2Variability.continuous)
            )
        for name in ("x", "v"):
            self.register_variable(
                Real(
                    name,
                    causality=Fmi2Causality.output,
                    variability=Fmi2Variability.continuous,
                    initial=Fmi2Initial.exact,
                )
            )
        for name, value in _PARAMETERS.items():
            setattr(self, name, value)
            self.register_variable(
                Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable)
            )

    def do_step(self, current_time: float, step_size: float) -> bool:  # noqa: ARG002
        """Newton's law, with the inputs held."""
        self.x, self.v = integrate(self._derivatives, [self.x, self.v], step_size)
        return True

    def _derivatives(self, states: list[float]) -> list[float]:
        x, v = states
        force = self.k_c * (x - self.x_c) + self.d_c * (v - self.v_c)
        return [v, (self.k_w * (self.z - x) - self.d_w * v - force) / self.m]
