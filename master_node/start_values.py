"""Start values as a user gives them -> values of single variables, as a slave takes them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from protocol.errors import ConfigurationError
from protocol.slave import Causality, SlaveDescription, StartValue, Variable, VariableType

GivenValue = StartValue | Sequence["GivenValue"]
"""A value, or for an array its rows."""


def structural_parameters(description: SlaveDescription) -> frozenset[str]:
    """Names of the parameters that size a slave, and are set before all others."""
    return frozenset(v.name for v in description.of(Causality.STRUCTURAL_PARAMETER))


def start_values(
    description: SlaveDescription, given: Mapping[str, GivenValue]
) -> dict[str, StartValue]:
    """Start values by the names of single variables, but for those of structural parameters.

    Args:
        description: of the slave.
        given: by variable name; a list of values, or of rows, for an array; a text of hexadecimal
            digits for a binary variable.

    Raises:
        ConfigurationError: an array has no such element, or a text is not hexadecimal.
    """
    variables = {variable.name: variable for variable in description.variables}
    values: dict[str, StartValue] = {}
    structural = structural_parameters(description)
    for name, value in given.items():
        if name in structural:
            continue
        for element, number in _elements(name, value):
            variable = variables.get(element)
            if variable is None:
                raise ConfigurationError(f"parameters: there is no variable {element!r}")
            values[element] = _value(variable, number)
    return values


def _elements(name: str, value: GivenValue) -> Iterator[tuple[str, StartValue]]:
    """Names and values of an array's elements, ``name[i,j]`` with indices from 1."""
    if isinstance(value, str | bytes) or not isinstance(value, Sequence):
        yield name, value
        return
    stack: list[tuple[str, GivenValue]] = [("", value)]
    while stack:
        indices, part = stack.pop()
        if isinstance(part, str | bytes) or not isinstance(part, Sequence):
            yield f"{name}[{indices}]", part
        else:
            comma = "," if indices else ""
            rows = [(f"{indices}{comma}{i}", row) for i, row in enumerate(part, start=1)]
            stack += reversed(rows)


def _value(variable: Variable, value: StartValue) -> StartValue:
    if variable.type is VariableType.BINARY and isinstance(value, str):
        try:
            return bytes.fromhex(value)
        except ValueError:
            raise ConfigurationError(
                f"parameters: {variable.name} is binary, and {value!r:.40} is no hexadecimal text"
            ) from None
    return value
