"""The ``[inputs]`` table of a system, checked against the variables of its slaves."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from master_node.coupling.connections import End, ScalarConnection, VariableFinder
from master_node.coupling.units import UnitMismatchError, UnknownUnitError, conversion
from master_node.inputs.continuous import ExternalInput, Signal, SignalFunction
from master_node.inputs.discrete import DrivenInput, HoldRows, driven_input
from master_node.numerics.input_tables import Table
from master_node.system.start_values import IGNORE_BOUNDS
from master_node.system.system import System
from master_node.system.tolerances import tolerance
from protocol.description import InputDerivatives, SlaveDescription
from protocol.errors import ConfigurationError, SlaveError
from protocol.signals import MAX_ORDER
from protocol.text.names import nearest
from protocol.values import BoundsError, checked_value
from protocol.variables import Causality, StartValue, Variable

log = logging.getLogger("master_node")

GivenSignal = StartValue | Table | HoldRows | SignalFunction
"""A constant, a table or a function."""

Signals = Mapping[str, GivenSignal]
"""Signals that drive inputs from outside, by ``slave.variable``, see `load_signals`."""


class SlaveExternals(NamedTuple):
    """Signals that drive the inputs of one slave from outside.

    Attributes:
        continuous: in the order of its variables.
        held: constants for its discrete inputs and tunable parameters, by name.
        driven: its discrete inputs and tunable parameters that change, in the order of its
            variables.
    """

    continuous: list[ExternalInput]
    held: dict[str, StartValue]
    driven: list[DrivenInput]


def resolve_external(
    system: System,
    finder: VariableFinder,
    connections: Sequence[ScalarConnection],
    signals: Signals,
) -> dict[str, SlaveExternals]:
    """The external inputs of each slave.

    Args:
        system: the settings.
        finder: of the slaves' variables.
        connections: all of them.
        signals: what drives which input.

    Raises:
        ConfigurationError: a name, causality, type or value is wrong, or an input is driven twice.
    """
    where = f"{system.source}: [inputs]"
    feeding = {connection.target.key: connection.source for connection in connections}
    found: dict[str, dict[str, ExternalInput]] = {name: {} for name in finder.descriptions}
    held: dict[str, dict[str, StartValue]] = {name: {} for name in finder.descriptions}
    driven: dict[str, dict[str, DrivenInput]] = {name: {} for name in finder.descriptions}
    for reference, given in signals.items():
        for end in finder.find(where, "key", reference):
            slave, variable = end
            description = finder.descriptions[slave]
            if not can_be_driven(variable):
                raise _not_driven(where, reference, variable, description)
            if end.key in feeding:
                raise ConfigurationError(
                    f"{where}: {reference} is driven twice: by {feeding[end.key].reference} and "
                    "from here"
                )
            try:
                signal = _in_unit_of(where, end, given, description)
                if variable.is_continuous_real:
                    found[slave][variable.name] = _continuous(system, end, signal, description)
                elif isinstance(signal, Table | HoldRows | SignalFunction):
                    driven[slave][variable.name] = _driven(system, end, signal)
                else:
                    held[slave][variable.name] = checked_value(
                        variable, signal, ignores_bounds=system.slaves[slave].ignore_bounds
                    )
            except ValueError as error:
                remedy = IGNORE_BOUNDS if isinstance(error, BoundsError) else ""
                raise ConfigurationError(f"{where}: {reference} {error}", remedy=remedy) from None
    return {
        name: SlaveExternals(
            [found[name][v.name] for v in description.variables if v.name in found[name]],
            held[name],
            [driven[name][v.name] for v in description.variables if v.name in driven[name]],
        )
        for name, description in finder.descriptions.items()
    }


def can_be_driven(variable: Variable) -> bool:
    """True if a variable can be given values while a run goes on."""
    is_tunable = variable.causality is Causality.PARAMETER and variable.variability == "tunable"
    return variable.causality is Causality.INPUT or is_tunable


def _not_driven(
    where: str, reference: str, variable: Variable, description: SlaveDescription
) -> ConfigurationError:
    if variable.causality is Causality.PARAMETER:
        return ConfigurationError(
            f"{where}: {reference} is a {variable.variability} parameter, and only inputs and "
            "tunable parameters can change while a run goes on",
            remedy="give its value in `parameters` in the table of the slave",
        )
    names = [v.name for v in description.variables if can_be_driven(v)]
    return ConfigurationError(
        f"{where}: {reference} is neither an input nor a tunable parameter but of causality "
        f"{variable.causality}{nearest(variable.name, names)}"
    )


def _in_unit_of(
    where: str, end: End, signal: GivenSignal, description: SlaveDescription
) -> GivenSignal:
    """The signal in the unit of its variable, if it is a table with another one.

    Raises:
        ValueError: the units measure different things.
    """
    variable = end.variable
    if not isinstance(signal, Table | HoldRows) or not (signal.unit and variable.type.is_real):
        return signal
    units = description.units
    try:
        change = conversion(signal.unit, units, variable.unit, units)
    except UnitMismatchError as error:
        raise ValueError(f"has another unit than the column of its table: {error}") from None
    except UnknownUnitError as error:
        log.warning(
            "%s: the units of %s and of its table are not compared: %s", where, end.reference, error
        )
        return signal
    if change.is_identity:
        return signal
    if isinstance(signal, Table):
        return signal.transformed(*change)
    if signal.numbers is None:
        return signal
    values = signal.values.astype(float) * change.factor + change.offset
    return HoldRows(signal.times, values, signal.numbers.transformed(*change))


def max_order(description: SlaveDescription) -> int:
    """The highest degree of input polynomial that a slave follows."""
    return 0 if description.input_derivatives is InputDerivatives.NONE else MAX_ORDER


def _continuous(
    system: System, end: End, signal: GivenSignal, description: SlaveDescription
) -> ExternalInput:
    """A continuous input with the signal that drives it.

    Raises:
        ValueError: a value is none of the input.
    """
    slave, variable = end
    ignores_bounds = system.slaves[slave].ignore_bounds
    return ExternalInput(
        slave,
        variable.name,
        _driving(variable, signal, float(system.simulation.start_time), ignores_bounds),
        max_order(description),
        *tolerance(system, slave, variable),
        None if ignores_bounds or not variable.has_bounds else variable,
    )


def _driving(variable: Variable, given: GivenSignal, start: float, ignores_bounds: bool) -> Signal:
    """The signal of a continuous input."""
    signal = given.numbers if isinstance(given, HoldRows) else given
    if signal is None:
        raise ValueError(f"is of type {variable.type}, and not all values of its table are numbers")
    if isinstance(signal, Table):
        for value in signal.extremes:
            checked_value(variable, value, ignores_bounds=ignores_bounds)
        return signal
    if isinstance(signal, SignalFunction):
        value = signal.function(start)
        is_number = not isinstance(value, bool | str | bytes)
        checked_value(variable, float(value) if is_number else value, ignores_bounds=ignores_bounds)
        return signal
    return float(checked_value(variable, signal, ignores_bounds=ignores_bounds))


def _driven(system: System, end: End, signal: Table | HoldRows | SignalFunction) -> DrivenInput:
    """A discrete input, or a tunable parameter, with the signal that changes it.

    Raises:
        ConfigurationError: the signal is a function that fails, or has values between its rows.
        ValueError: a value is none of the input.
    """
    slave, variable = end
    if isinstance(signal, Table):
        raise ConfigurationError(
            f"{system.source}: [inputs]: {end.reference} is a {variable.variability} variable of "
            f"type {variable.type}: nothing lies between the rows of its table",
            remedy='say interpolation = "hold"',
        )
    ignores_bounds = system.slaves[slave].ignore_bounds
    driven = driven_input(slave, variable, signal, ignores_bounds=ignores_bounds)
    try:
        driven.signal.at(float(system.simulation.start_time))
    except SlaveError as error:
        raise ConfigurationError(f"{system.source}: [inputs]: {error.cause}") from error
    return driven
