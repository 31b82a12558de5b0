"""The chassis of the quarter car for PythonFMU3, which makes an FMI 3.0 co-simulation FMU of it.

The FMU declares no saved states, as it is with PythonFMU unless one asks for them.
"""

from __future__ import annotations

from pythonfmu3 import Float64, Fmi3Causality, Fmi3Initial, Fmi3Slave, Fmi3Variability, Unit
from runge_kutta import integrate


class Chassis(Fmi3Slave):
    """The chassis, hung on the wheel by a spring and a damper."""

    def __init__(self, **kwargs: object) -> None:
        super().__init__(**kwargs)
        self.modelName = "chassis"
        self.description = "Chassis of a quarter car"
        self.register_units(
            [
                Unit("m", m=1),
                Unit("m/s", m=1, s=-1),
                Unit("kg", kg=1),
                Unit("N/m", kg=1, s=-2),
                Unit("N.s/m", kg=1, s=-1),
                Unit("s", s=1),
            ]
        )
        self.time = self.x_w = self.v_w = self.x = self.v = 0.0
        self.m, self.k, self.d = 400.0, 15000.0, 1000.0
        continuous = Fmi3Variability.continuous
        self.register_variable(
            Float64("time", causality=Fmi3Causality.independent, variability=continuous, unit="s")
        )
        for name, unit in (("x_w", "m"), ("v_w", "m/s")):
            self.register_variable(
                Float64(name, causality=Fmi3Causality.input, variability=continuous, unit=unit)
            )
        for name, unit in (("x", "m"), ("v", "m/s")):
            self.register_variable(
                Float64(
                    name,
                    causality=Fmi3Causality.output,
                    variability=continuous,
                    initial=Fmi3Initial.exact,
                    unit=unit,
                )
            )
        for name, unit in (("m", "kg"), ("k", "N/m"), ("d", "N.s/m")):
            self.register_variable(
                Float64(
                    name,
                    causality=Fmi3Causality.parameter,
                    variability=Fmi3Variability.fixed,
                    unit=unit,
                )
            )

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Newton's law, with the inputs held."""
        self.x, self.v = integrate(self._derivatives, [self.x, self.v], step_size)
        self.time = current_time + step_size
        return True

    def _derivatives(self, states: list[float]) -> list[float]:
        x, v = states
        return [v, (self.k * (self.x_w - x) + self.d * (self.v_w - v)) / self.m]
