"""Values of frozen dataclasses and named tuples as plain data for JSON and back, bit for bit.

Floats are written with ``repr``, which reads back to the same bits; the sign of zero, infinities
and NaN are kept (as Python's ``json`` writes them). Types come from the annotations, so nothing in
a file chooses what is built.
"""

from __future__ import annotations

from base64 import b64decode, b64encode
from dataclasses import fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

_T = TypeVar("_T")
_SCALARS = (bool, int, float, str)
_NUMPY_SCALARS = {"float64": np.float64, "int64": np.int64, "bool": np.bool_}


def to_plain(value: Any) -> Any:
    """Plain form of a value: dicts, lists, numbers and texts.

    Raises:
        TypeError: there is no such form.
    """
    if value is None or type(value) in _SCALARS:
        return value
    if isinstance(value, np.generic | np.ndarray):
        return _array(value)
    if isinstance(value, bytes):
        return {"base64": b64encode(value).decode()}
    items = value
    if is_dataclass(value):
        items = {field.name: getattr(value, field.name) for field in fields(value)}
    elif hasattr(value, "_fields"):
        items = value._asdict()
    if isinstance(items, dict):
        return {str(key): to_plain(item) for key, item in items.items()}
    if isinstance(items, tuple):
        return [to_plain(item) for item in items]
    raise TypeError(f"{type(value).__name__} has no plain form")


def _array(value: np.generic | np.ndarray[Any, Any]) -> dict[str, Any]:
    if isinstance(value, np.generic):
        return {"numpy": value.dtype.name, "value": value.item()}
    is_transposed = value.flags.f_contiguous and not value.flags.c_contiguous
    return {
        "dtype": value.dtype.name,
        "shape": list(value.shape),
        "order": "F" if is_transposed else "C",
        "values": value.ravel().tolist(),
    }


def from_plain(kind: type[_T], plain: Any) -> _T:
    """The value of type ``kind`` that ``to_plain`` described.

    Raises:
        ValueError: it is none.
    """
    try:
        value: _T = _built(kind, plain)
    except (TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"not a {getattr(kind, '__name__', kind)}: {error!r}") from error
    return value


def _built(kind: Any, plain: Any) -> Any:
    kind = _expanded(kind)
    origin = get_origin(kind)
    kinds = get_args(kind)
    if origin is Union or origin is UnionType:
        value = _of_union(kinds, plain)
    elif origin is np.ndarray:
        value = np.array(plain["values"], np.dtype(plain["dtype"])).reshape(plain["shape"])
        value = np.asfortranarray(value) if plain["order"] == "F" else value
    elif origin is dict:
        value = {key: _built(kinds[1], item) for key, item in plain.items()}
    elif origin is tuple and kinds[1:] == (...,):
        value = tuple(_built(kinds[0], item) for item in plain)
    elif origin is tuple:
        value = tuple(_built(k, item) for k, item in zip(kinds, plain, strict=True))
    elif is_dataclass(kind) or hasattr(kind, "_fields"):
        hints = _hints(kind)
        value = kind(**{name: _built(hints[name], item) for name, item in plain.items()})
    else:
        value = _leaf(plain)
    return value


def _expanded(kind: Any) -> Any:
    """Type that an alias stands for; ``NDArray`` is one since NumPy 2.5, from Python 3.12 on."""
    alias = get_origin(kind) or kind
    if not hasattr(alias, "__value__"):
        return kind
    arguments = get_args(kind)
    return alias.__value__[arguments] if arguments else alias.__value__


def _of_union(kinds: tuple[Any, ...], plain: Any) -> Any:
    if plain is None and NoneType in kinds:
        return None
    others = [kind for kind in kinds if kind is not NoneType]
    return _built(others[0], plain) if len(others) == 1 else _leaf(plain)


def _leaf(plain: Any) -> Any:
    """Types that their plain form itself tells; tuples of them are lists."""
    if plain is None or type(plain) in _SCALARS:
        return plain
    if isinstance(plain, list):
        return tuple(map(_leaf, plain))
    if "numpy" in plain:
        return _NUMPY_SCALARS[plain["numpy"]](plain["value"])
    return b64decode(plain["base64"], validate=True)


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind)
