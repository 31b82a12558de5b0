"""The ``[inputs]`` table of a system, checked against the variables of its slaves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from master_node.configuration import System
from master_node.connections import End, ScalarConnection, VariableFinder
from master_node.discrete_inputs import DrivenInput, HoldRows, driven_input
from master_node.external_inputs import ExternalInput, Signal, SignalFunction
from master_node.numerics.input_tables import Table
from master_node.tolerances import tolerance
from protocol.errors import ConfigurationError, SlaveError
from protocol.names import nearest
from protocol.signals import MAX_ORDER
from protocol.slave import (
    Causality,
    InputDerivatives,
    SlaveDescription,
    StartValue,
    Variable,
    VariableType,
)

GivenSignal = StartValue | Table | HoldRows | SignalFunction
"""A constant, a table or a function."""

Signals = Mapping[str, GivenSignal]
"""What drives inputs from outside, by ``slave.variable``, see `load_signals`."""


class SlaveExternals(NamedTuple):
    """What drives the inputs of one slave from outside.

    Attributes:
        continuous: in the order of its variables.
        held: constants for its discrete inputs, by name.
        driven: its discrete inputs that change, in the order of its variables.
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
        ConfigurationError: a name, causality or type is wrong, or an input is driven twice.
    """
    where = f"{system.source}: [inputs]"
    feeding = {connection.target.key: connection.source for connection in connections}
    found: dict[str, dict[str, ExternalInput]] = {name: {} for name in finder.descriptions}
    held: dict[str, dict[str, StartValue]] = {name: {} for name in finder.descriptions}
    driven: dict[str, dict[str, DrivenInput]] = {name: {} for name in finder.descriptions}
    start = float(system.simulation.start_time)
    for reference, signal in signals.items():
        for end in finder.find(where, "key", reference):
            slave, variable = end
            description = finder.descriptions[slave]
            if variable.causality is not Causality.INPUT:
                inputs = [v.name for v in description.of(Causality.INPUT)]
                raise ConfigurationError(
                    f"{where}: {reference} is not an input but of causality "
                    f"{variable.causality}{nearest(variable.name, inputs)}"
                )
            if end.key in feeding:
                raise ConfigurationError(
                    f"{where}: {reference} is driven twice: by {feeding[end.key].reference} and "
                    "from here"
                )
            if not variable.is_continuous_real:
                if isinstance(signal, Table | HoldRows | SignalFunction):
                    driven[slave][variable.name] = _driven(where, reference, end, signal, start)
                else:
                    held[slave][variable.name] = _constant(where, reference, variable, signal)
                continue
            found[slave][variable.name] = ExternalInput(
                slave,
                variable.name,
                _driving(where, reference, variable, signal, start),
                max_order(description),
                *tolerance(system, slave, variable),
            )
    return {
        name: SlaveExternals(
            [found[name][v.name] for v in description.of(Causality.INPUT) if v.name in found[name]],
            held[name],
            [
                driven[name][v.name]
                for v in description.of(Causality.INPUT)
                if v.name in driven[name]
            ],
        )
        for name, description in finder.descriptions.items()
    }


def max_order(description: SlaveDescription) -> int:
    """The highest degree of input polynomial that a slave follows."""
    return 0 if description.input_derivatives is InputDerivatives.NONE else MAX_ORDER


def _driving(
    where: str, reference: str, variable: Variable, signal: GivenSignal, start: float
) -> Signal:
    """The signal of a continuous input."""
    if isinstance(signal, HoldRows):
        if signal.numbers is None:
            raise ConfigurationError(
                f"{where}: {reference} is of type {variable.type}, and not all values of its table "
                "are numbers"
            )
        return signal.numbers
    if isinstance(signal, SignalFunction):
        value = signal.function(start)
        if isinstance(value, str | bytes):
            raise _mismatch(where, reference, variable, value)
        return signal
    if isinstance(signal, Table):
        return signal
    if isinstance(signal, bool | str | bytes):
        raise _mismatch(where, reference, variable, signal)
    return float(signal)


def _driven(
    where: str,
    reference: str,
    end: End,
    signal: Table | HoldRows | SignalFunction,
    start: float,
) -> DrivenInput:
    """A discrete input with the signal that changes it."""
    slave, variable = end
    if isinstance(signal, Table):
        raise ConfigurationError(
            f"{where}: {reference} is a {variable.variability} variable of type {variable.type}: "
            "nothing lies between the rows of its table",
            remedy='say interpolation = "hold"',
        )
    try:
        driven = driven_input(slave, variable, signal)
        driven.signal.at(start)
    except ValueError as error:
        raise ConfigurationError(f"{where}: {reference}: {error}") from None
    except SlaveError as error:
        raise ConfigurationError(f"{where}: {error.cause}") from error
    return driven


def _constant(where: str, reference: str, variable: Variable, signal: StartValue) -> StartValue:
    """The value of an input that is not continuous."""
    if variable.type.is_real and type(signal) in (int, float):
        return float(signal)
    if type(signal) in _PYTHON_TYPES.get(variable.type, (int,)):
        return signal
    raise _mismatch(where, reference, variable, signal)


_PYTHON_TYPES: Mapping[VariableType, tuple[type, ...]] = {
    VariableType.REAL: (),
    VariableType.FLOAT32: (),
    VariableType.FLOAT64: (),
    VariableType.BOOLEAN: (bool,),
    VariableType.STRING: (str,),
    VariableType.BINARY: (bytes,),
    VariableType.CLOCK: (),
}


def _mismatch(
    where: str, reference: str, variable: Variable, signal: StartValue
) -> ConfigurationError:
    return ConfigurationError(
        f"{where}: {reference} is of type {variable.type} and cannot be {signal!r}"
    )
