"""Start values that a slave is served with, checked before it is on the bus."""

from __future__ import annotations

from collections.abc import Mapping

from protocol.description import SlaveDescription
from protocol.errors import ConfigurationError
from protocol.text.names import nearest
from protocol.values import BoundsError, checked_value
from protocol.variables import StartValue


def check_parameters(
    description: SlaveDescription,
    parameters: Mapping[str, StartValue],
    *,
    ignores_bounds: bool = False,
) -> None:
    """Check that the model can start with these values.

    Raises:
        ConfigurationError: there is no such variable, or it cannot have the value.
    """
    if not parameters:
        return
    variables = {variable.name: variable for variable in description.variables}
    for name, value in parameters.items():
        if name not in variables:
            raise ConfigurationError(f"--parameter: no variable {name!r}{nearest(name, variables)}")
        try:
            checked_value(variables[name], value, ignores_bounds=ignores_bounds)
        except ValueError as error:
            remedy = "correct it, or say --ignore-bounds" if isinstance(error, BoundsError) else ""
            raise ConfigurationError(f"--parameter: {name!r} {error}", remedy=remedy) from None
