"""Types of fields in system files, each with its check."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    StrictBool,
    StrictFloat,
    StrictInt,
    StrictStr,
)

from master_node.results.formats import FORMATS
from protocol.errors import ConfigurationError
from protocol.wire.agents import check_label, is_sha256
from protocol.wire.keys import check_name


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("must be finite")
    return value


def _finite_scalar(value: Scalar) -> Scalar:
    return _finite(value) if isinstance(value, float) else value


def _reference(value: str) -> str:
    slave, dot, variable = value.partition(".")
    if not (slave and dot and variable):
        raise ValueError("write slave.variable")
    return value


def _pattern(value: str) -> str:
    if not value.removeprefix("!"):
        raise ValueError("write a pattern for slave.variable")
    return value


def _agent_name(value: str) -> str:
    try:
        return check_name(value, "agent name")
    except ConfigurationError as error:
        raise ValueError(str(error)) from None


def _labels(value: Mapping[str, str]) -> Mapping[str, str]:
    try:
        for name, text in value.items():
            check_label(name, text)
    except ConfigurationError as error:
        raise ValueError(str(error)) from None
    return value


def _sha256(value: str) -> str:
    value = value.lower()
    if not is_sha256(value):
        raise ValueError("write 64 hexadecimal digits")
    return value


def one_of(*names: str) -> AfterValidator:
    """Check of a text that is one of ``names``."""

    def check(value: str) -> str:
        if value not in names:
            *others, last = map(repr, names)
            raise ValueError(f"write {', '.join(others)} or {last}")
        return value

    return AfterValidator(check)


def _not_empty(value: tuple[Any, ...]) -> tuple[Any, ...]:
    if not value:
        raise ValueError("must not be empty")
    return value


MappingEntries = Mapping[bool, bool] | Mapping[int | str, int | str]
"""Values and what becomes of them: booleans, or integers and items of enumerations."""

_BOOLEAN_KEYS = {"true": True, "false": False}


def mapping_entries(value: Any) -> MappingEntries:
    """The entries of a mapping; keys of TOML are texts."""
    wrong = ValueError(
        "write { false = true, … } or { 1 = 2, … }: booleans, or whole numbers and items of "
        "enumerations"
    )
    if not isinstance(value, Mapping) or not value:
        raise wrong
    entries: dict[Any, Any] = {}
    for key, target in value.items():
        source = _BOOLEAN_KEYS.get(key, key) if isinstance(key, str) else key
        if isinstance(source, str) and re.fullmatch(r"[+-]?[0-9]{1,20}", source):
            source = int(source)
        if source in entries:
            raise ValueError(f"{key} is there twice")
        entries[source] = target
    kinds = {type(entry) for pair in entries.items() for entry in pair}
    if kinds != {bool} and not kinds <= {int, str}:
        raise wrong
    return entries


Number = Annotated[StrictFloat, AfterValidator(_finite)]
Positive = Annotated[Number, Field(gt=0)]
Wait = Annotated[Number, Field(gt=0, le=1e6)]
NotNegative = Annotated[Number, Field(ge=0)]
Reference = Annotated[StrictStr, AfterValidator(_reference)]
Pattern = Annotated[StrictStr, AfterValidator(_pattern)]
Format = Annotated[StrictStr, one_of(*FORMATS)]
Scalar = StrictBool | StrictInt | StrictFloat | StrictStr
FiniteScalar = Annotated[Scalar, AfterValidator(_finite_scalar)]
AgentName = Annotated[StrictStr, AfterValidator(_agent_name)]
Labels = Annotated[Mapping[StrictStr, StrictStr], AfterValidator(_labels)]
Sha256 = Annotated[StrictStr, AfterValidator(_sha256)]
Patterns = Annotated[tuple[Pattern, ...], AfterValidator(_not_empty)]
Formats = Annotated[tuple[Format, ...], AfterValidator(_not_empty)]
Value = Scalar | tuple[Scalar, ...] | tuple[tuple[Scalar, ...], ...]
"""A value, or those of an array with one or two dimensions."""


class FrozenTable(BaseModel):
    """Table of a file: unknown keys are mistakes, values stay as they are."""

    model_config = ConfigDict(frozen=True, extra="forbid")
