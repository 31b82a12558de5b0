"""Values as people write them, as values of variables: a number means the same wherever it stands.

In a system file, at the prompt, in a package, in a table or a study: 4.0 is an integer and 4 a
float, an item of an enumeration may be given by its name, and nothing is rounded.
"""

from __future__ import annotations

import re
from math import isfinite
from numbers import Integral, Real
from struct import pack

import numpy as np

from protocol.text.names import nearest
from protocol.variables import StartValue, Variable, VariableType

_TRUTH = {"true": True, "false": False}
_WHOLE = re.compile(r"[+-]?[0-9]+")
_SHOWN_ITEMS = 10


def value_of(variable: Variable, given: object) -> StartValue:
    """A value as one of a variable's type.

    Args:
        variable: that is to have it.
        given: a number, 0 and 1 for a truth value too; the name of an item of an enumeration;
            hexadecimal digits of a binary.

    Raises:
        ValueError: it is none; the message says of which type the variable is.
    """
    try:
        return _converted(variable, _plain(given))
    except (ValueError, OverflowError):
        shown = f"{given!r:.80}"
        near = nearest(given, variable.items) if isinstance(given, str) and variable.items else ""
        raise ValueError(
            f"is of type {type_in_words(variable)}; it cannot be {shown}{near}"
        ) from None


def parsed(variable: Variable, text: str) -> StartValue:
    """A value out of a file of texts: a number, ``true`` or ``false``, or as for `value_of`.

    Raises:
        ValueError: as `value_of`.
    """
    stripped = text.strip()
    if variable.type in (VariableType.STRING, VariableType.BINARY):
        return value_of(variable, text)
    if stripped.lower() in _TRUTH:
        return value_of(variable, _TRUTH[stripped.lower()])
    if _WHOLE.fullmatch(stripped):
        return value_of(variable, int(stripped))
    try:
        return value_of(variable, float(stripped) if "_" not in stripped else stripped)
    except ValueError:
        return value_of(variable, stripped)


class BoundsError(ValueError):
    """A value of the right type is none that the model declares for a variable."""


def checked_value(variable: Variable, given: object, *, ignores_bounds: bool = False) -> StartValue:
    """Value of a variable as `value_of` gives it, within the bounds that the model declares.

    Raises:
        BoundsError: it is beyond ``min`` or ``max``, or the number of no item, unless
            ``ignores_bounds``.
        ValueError: as `value_of`.
    """
    value = value_of(variable, given)
    problem = "" if ignores_bounds else beyond_bounds(variable, value)
    if problem:
        raise BoundsError(problem)
    return value


def beyond_bounds(variable: Variable, value: StartValue) -> str:
    """Why a value is none that the model declares for a variable; "" if it is one."""
    if variable.items:
        known = set(variable.items.values())
        return (
            ""
            if value in known
            else f"is of type {type_in_words(variable)}; {value!r} is none of them"
        )
    if isinstance(value, bool | str | bytes):
        return ""
    if variable.minimum is not None and not value >= variable.minimum:
        return f"must be at least {variable.minimum!r} (min); it cannot be {value!r}"
    if variable.maximum is not None and not value <= variable.maximum:
        return f"must be at most {variable.maximum!r} (max); it cannot be {value!r}"
    return ""


def type_in_words(variable: Variable) -> str:
    """The type of a variable with what its values can be."""
    if variable.items:
        items = [f"{name} ({number})" for name, number in variable.items.items()]
        more = f" and {len(items) - _SHOWN_ITEMS} more" if len(items) > _SHOWN_ITEMS else ""
        return f"Enumeration with the items {', '.join(items[:_SHOWN_ITEMS])}{more}"
    limits = variable.type.integer_range
    return f"{variable.type}, {limits[0]} to {limits[1]}" if limits else str(variable.type)


def item_name(variable: Variable, value: StartValue) -> str:
    """The name of the item that a number stands for; "" if it is none."""
    return next((name for name, number in variable.items.items() if number == value), "")


def _plain(given: object) -> object:
    """A number of NumPy, or of a class derived from a number's, as the number itself."""
    if isinstance(given, bool | np.bool_):
        return bool(given)
    if isinstance(given, Integral):
        return int(given)
    return float(given) if isinstance(given, Real) else given


def _converted(variable: Variable, given: object) -> StartValue:
    kind = variable.type
    if kind is VariableType.STRING:
        if type(given) is not str or "\0" in given:
            raise ValueError
        return given
    if kind is VariableType.BINARY:
        if type(given) is bytes:
            return given
        if type(given) is not str:
            raise ValueError
        return bytes.fromhex(given)
    if kind is VariableType.BOOLEAN:
        if type(given) not in (bool, int, float) or given not in (0, 1):
            raise ValueError
        return bool(given)
    if isinstance(given, str):
        if given not in variable.items:
            raise ValueError
        return variable.items[given]
    if type(given) not in (int, float):
        raise ValueError
    return _number(kind, given)  # type: ignore[arg-type]


def _number(kind: VariableType, given: float | int) -> float | int:
    if kind.is_real:
        value = float(given)
        if kind is VariableType.FLOAT32 and isfinite(value):
            pack("<f", value)  # raises OverflowError
        if type(given) is int and int(value) != given:
            raise ValueError
        return value
    limits = kind.integer_range
    if limits is None or given != int(given) or not limits[0] <= given <= limits[1]:
        raise ValueError
    return int(given)
