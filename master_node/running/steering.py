"""Changes of a run by its user or by actions: what can be changed, to which values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property
from math import isfinite
from typing import Any

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.external import can_be_driven
from master_node.coupling.overrides import NO_OVERRIDES, HeldValue, Overrides
from master_node.running.variables import ConnectedInput, Variables
from master_node.system.start_values import IGNORE_BOUNDS
from master_node.system.system import System
from protocol.errors import SteeringError
from protocol.values import BoundsError, checked_value
from protocol.variables import StartValue, Variable

Values = Mapping[str, Mapping[str, StartValue]]
"""Values of variables, by slave and variable."""


class Steering:
    """Checks changes, and changes nothing itself.

    Args:
        coupled: the system.
        system: its settings.
    """

    def __init__(self, coupled: CoupledSystem, system: System) -> None:
        self._coupled = coupled
        self._system = system

    @cached_property
    def variables(self) -> Variables:
        """All variables of the system."""
        return Variables(self._coupled, self._system)

    def settings(self, values: Mapping[str, Any]) -> Values:
        """Values of tunable parameters and of inputs that nothing drives, checked.

        Args:
            values: by ``slave.variable``.

        Raises:
            SteeringError: a variable cannot be set, or a value is none of it.
        """
        checked: dict[str, dict[str, StartValue]] = {}
        for name, value in values.items():
            self.variables.check(name)
            slave, variable = self.variables.known[name]
            self._check_settable(name, variable)
            checked.setdefault(slave, {})[variable.name] = self._value(name, variable, value)
        return checked

    def overridden(self, overrides: Overrides, values: Mapping[str, Any]) -> Overrides:
        """Overrides with those of some inputs more, or with other values.

        Args:
            overrides: that hold.
            values: by ``slave.variable``, in the units of the inputs.

        Raises:
            SteeringError: a variable is no connected input, or a value is none of it.
        """
        for name, value in values.items():
            place = self._connected(name)
            given = self._value(name, place.variable, value)
            overrides = _with(_without(overrides, place), place, given)
        return overrides

    def released(self, overrides: Overrides, names: Iterable[str]) -> Overrides:
        """Overrides without those of some inputs; without names there are none.

        Raises:
            SteeringError: one is not overridden.
        """
        if not names:
            return NO_OVERRIDES
        for name in names:
            shorter = _without(overrides, self._connected(name))
            if shorter == overrides:
                raise SteeringError(
                    f"{name} is not overridden", remedy="see overridden for those that are"
                )
            overrides = shorter
        return overrides

    def names_of(self, overrides: Overrides) -> list[str]:
        """Names of the inputs that are overridden, ``slave.variable``."""
        return [
            name
            for name, place in self.variables.connected.items()
            if _without(overrides, place) != overrides
        ]

    def _connected(self, name: str) -> ConnectedInput:
        self.variables.check(name)
        place = self.variables.connected.get(name)
        if place is None:
            raise SteeringError(
                f"{name} is no connected input: only such can be overridden",
                remedy="use set for tunable parameters and for inputs that nothing drives",
            )
        return place

    def _check_settable(self, name: str, variable: Variable) -> None:
        place = self.variables.connected.get(name)
        if place is not None:
            raise SteeringError(
                f"{name} is connected to {place.source}",
                remedy="use override, which cuts it from its source",
            )
        if name in self.variables.external:
            raise SteeringError(
                f"{name} is driven from outside", remedy="leave it out of [inputs] to set it"
            )
        if not can_be_driven(variable):
            kind = f"{variable.variability} {variable.causality}"
            raise SteeringError(
                f"{name} cannot be set during a run, as it is of the kind: {kind}",
                remedy="only tunable parameters and inputs can; give other parameters before the "
                f"run: [slaves.{name.partition('.')[0]}.parameters]",
            )

    def _value(self, name: str, variable: Variable, value: Any) -> StartValue:
        """A value in the type of its variable; NumPy's numbers are as good as Python's."""
        plain = value.item() if hasattr(value, "item") else value
        if isinstance(plain, float) and not isfinite(plain):
            raise SteeringError(f"{name} cannot be {plain!r}", remedy="give a finite number")
        slave = name.partition(".")[0]
        ignores = self._system.slaves[slave].ignore_bounds
        try:
            return checked_value(variable, plain, ignores_bounds=ignores)
        except ValueError as error:
            remedy = IGNORE_BOUNDS if isinstance(error, BoundsError) else ""
            raise SteeringError(f"{name} {error}", remedy=remedy) from None


def _without(overrides: Overrides, place: ConnectedInput) -> Overrides:
    """All but that of one input."""
    if place.column is None:
        held = [
            one for one in overrides.held if (one.slave, one.input) != (place.slave, place.held)
        ]
        return overrides._replace(held=tuple(held))
    pairs = zip(overrides.columns, overrides.values, strict=True)
    kept = [(column, value) for column, value in pairs if column != place.column]
    return overrides._replace(
        columns=tuple(column for column, _ in kept), values=tuple(value for _, value in kept)
    )


def _with(overrides: Overrides, place: ConnectedInput, value: StartValue) -> Overrides:
    """With that of one input more."""
    if place.column is None:
        held = (*overrides.held, HeldValue(place.slave, place.held, value))
        return overrides._replace(held=held)
    return overrides._replace(
        columns=(*overrides.columns, place.column), values=(*overrides.values, float(value))
    )
