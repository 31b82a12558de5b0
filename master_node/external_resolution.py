"""The ``[inputs]`` table of a system, checked against the variables of its slaves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from master_node.configuration import System
from master_node.connections import ScalarConnection, VariableFinder
from master_node.external_inputs import ExternalInput, Signal, SignalFunction
from master_node.numerics.input_tables import Table
from master_node.tolerances import tolerance
from protocol.errors import ConfigurationError
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

Signals = Mapping[str, StartValue | Table | SignalFunction]
"""What drives inputs from outside, by ``slave.variable``, see `load_signals`."""


class SlaveExternals(NamedTuple):
    """What drives the inputs of one slave from outside.

    Attributes:
        continuous: in the order of its variables.
        held: constants for its discrete inputs, by name.
    """

    continuous: list[ExternalInput]
    held: dict[str, StartValue]


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
                held[slave][variable.name] = _constant(where, reference, variable, signal)
                continue
            found[slave][variable.name] = ExternalInput(
                slave,
                variable.name,
                _driving(where, reference, variable, signal),
                max_order(description),
                *tolerance(system, slave, variable),
            )
    return {
        name: SlaveExternals(
            [found[name][v.name] for v in description.of(Causality.INPUT) if v.name in found[name]],
            held[name],
        )
        for name, description in finder.descriptions.items()
    }


def max_order(description: SlaveDescription) -> int:
    """The highest degree of input polynomial that a slave follows."""
    return 0 if description.input_derivatives is InputDerivatives.NONE else MAX_ORDER


def _driving(
    where: str, reference: str, variable: Variable, signal: StartValue | Table | SignalFunction
) -> Signal:
    """The signal of a continuous input."""
    if isinstance(signal, Table | SignalFunction):
        return signal
    if isinstance(signal, bool | str | bytes):
        raise _mismatch(where, reference, variable, signal)
    return float(signal)


def _constant(
    where: str, reference: str, variable: Variable, signal: StartValue | Table | SignalFunction
) -> StartValue:
    """The value of an input that is not continuous."""
    if isinstance(signal, Table | SignalFunction):
        raise ConfigurationError(
            f"{where}: {reference} is held in each step, and only a constant can drive it: it is a "
            f"{variable.variability} variable of type {variable.type}"
        )
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
