"""The unit definitions of a model description."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from protocol.variables import Unit

_BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


def units(model_description: Any) -> Mapping[str, Unit]:
    """Units in terms of SI base units, by name; those that are only names are left out.

    FMI 1.0 defines no unit in terms of others.
    """
    return {
        unit.name: Unit(
            exponents=tuple(int(getattr(unit.baseUnit, name)) for name in _BASE_UNITS),
            factor=float(unit.baseUnit.factor),
            offset=float(unit.baseUnit.offset),
        )
        for unit in model_description.unitDefinitions
        if unit.name and unit.baseUnit is not None
    }
