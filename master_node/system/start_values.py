"""Start values as a user gives them -> values of single variables, as a slave takes them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from protocol.description import SlaveDescription
from protocol.errors import ConfigurationError
from protocol.values import BoundsError, checked_value
from protocol.variables import Causality, StartValue, Variable

IGNORE_BOUNDS = "correct the value, or say ignore_bounds = true in the table of the slave"

GivenValue = StartValue | Sequence["GivenValue"]
"""A value, or for an array its rows."""

Place = Callable[[str], str]
"""Where the value of a variable is given, for messages."""


def structural_parameters(description: SlaveDescription) -> frozenset[str]:
    """Names of the parameters that size a slave, and are set before all others."""
    return frozenset(v.name for v in description.of(Causality.STRUCTURAL_PARAMETER))


def structural_values(
    description: SlaveDescription,
    given: Mapping[str, GivenValue],
    place: Place = repr,
    *,
    ignores_bounds: bool = False,
) -> dict[str, StartValue]:
    """The values of structural parameters; arguments and errors as for `start_values`."""
    variables = {v.name: v for v in description.of(Causality.STRUCTURAL_PARAMETER)}
    return {
        name: _checked(place(name), variables[name], value, ignores_bounds)
        for name, value in given.items()
        if name in variables and not isinstance(value, tuple)
    }


def start_values(
    description: SlaveDescription,
    given: Mapping[str, GivenValue],
    place: Place = repr,
    *,
    ignores_bounds: bool = False,
) -> dict[str, StartValue]:
    """Start values by the names of single variables, but for those of structural parameters.

    Args:
        description: of the slave.
        given: by variable name, see `value_of`; a list of values, or of rows, for an array.
        place: where the value of a variable is given, for messages.
        ignores_bounds: take values beyond ``min`` and ``max``, and numbers that no item has.

    Raises:
        ConfigurationError: an array has no such element, or a value is none of the variable.
    """
    variables = {variable.name: variable for variable in description.variables}
    values: dict[str, StartValue] = {}
    structural = structural_parameters(description)
    for name, value in given.items():
        if name in structural:
            continue
        for element, number in _elements(name, value):
            where = place(name) if element == name else f"{place(name)}: {element!r}"
            if element not in variables:
                raise ConfigurationError(f"{place(name)}: there is no variable {element!r}")
            values[element] = _checked(where, variables[element], number, ignores_bounds)
    return values


def _checked(where: str, variable: Variable, value: GivenValue, ignores_bounds: bool) -> StartValue:
    try:
        return checked_value(variable, value, ignores_bounds=ignores_bounds)
    except ValueError as error:
        remedy = IGNORE_BOUNDS if isinstance(error, BoundsError) else ""
        raise ConfigurationError(f"{where} {error}", remedy=remedy) from None


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
