"""Descriptions of slaves and what examinations found, as fields of replies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from protocol.description import (
    Capabilities,
    Examination,
    InputDerivatives,
    SlaveDescription,
    StateKind,
    StateVerdict,
)
from protocol.errors import MalformedMessageError, ModelError
from protocol.text.limits import MAX_NAME, MAX_SENTENCE, cut
from protocol.variables import Causality, Unit, Variable, VariableType
from protocol.wire import checks


def examination_within_limits(examination: Examination) -> Examination:
    """Examination with its sentences cut to their limit."""
    return replace(
        examination,
        state_reason=cut(examination.state_reason),
        input_refusal=cut(examination.input_refusal),
        not_tried=cut(examination.not_tried),
        poor_derivatives={n: cut(why) for n, why in examination.poor_derivatives.items()},
    )


def description_within_limits(description: SlaveDescription) -> SlaveDescription:
    """Description with its sentences cut to their limit; names travel whole.

    Raises:
        ModelError: a name is too long.
    """
    names = [description.model, description.guid, *description.units]
    for variable in description.variables:
        names += (variable.name, variable.unit, *variable.items)
    if longest := max(names, key=len)[MAX_NAME:]:
        raise ModelError(
            f"a name in its description has {MAX_NAME + len(longest)} characters; the limit is "
            f"{MAX_NAME}"
        )
    return replace(
        description,
        variables=tuple(
            v if len(v.description) <= MAX_SENTENCE else replace(v, description=cut(v.description))
            for v in description.variables
        ),
        state_reason=cut(description.state_reason),
        remarks=tuple(map(cut, description.remarks)),
        generation_tool=cut(description.generation_tool, MAX_NAME),
    )


def _bound(value: Any, what: str) -> float | int | None:
    if value is None or type(value) in (float, int):
        return value  # type: ignore[no-any-return]
    raise MalformedMessageError(f"{what} must be a number, not {checks.shown(value)}")


def _items(value: Any, what: str) -> dict[str, int]:
    items = checks.mapping(value, what)
    if all(type(number) is int for number in items.values()):
        return items
    raise MalformedMessageError(f"{what} must be a map of names to integers")


def _exponents(value: Any, what: str) -> tuple[int, ...]:
    if type(value) is list and len(value) == 8 and all(type(item) is int for item in value):
        return tuple(value)
    raise MalformedMessageError(f"{what} must be eight integers, not {checks.shown(value)}")


UNIT_FIELDS: Mapping[str, checks.Check] = {
    "exponents": _exponents,
    "factor": checks.number,
    "offset": checks.number,
}


VARIABLE_FIELDS: Mapping[str, checks.Check] = {
    "name": checks.name,
    "causality": checks.member(Causality),
    "type": checks.member(VariableType),
    "variability": checks.name,
    "unit": checks.name,
    "start": checks.optional(checks.start_value),
    "nominal": checks.number,
    "description": checks.sentence,
    "minimum": _bound,
    "maximum": _bound,
    "items": _items,
}


CAPABILITY_FIELDS: Mapping[str, checks.Check] = {
    "can_get_and_set_state": checks.boolean,
    "can_serialize_state": checks.boolean,
    "can_interpolate_inputs": checks.boolean,
    "max_output_derivative_order": checks.integer,
    "can_handle_variable_step_size": checks.boolean,
    "outputs_follow_inputs": checks.boolean,
}


_variable = checks.record(Variable, VARIABLE_FIELDS)


def _variables(value: Any, what: str) -> tuple[Variable, ...]:
    if type(value) is not list:
        raise MalformedMessageError(f"{what} must be a list")
    return tuple(_variable(item, what) for item in value)


DESCRIPTION_FIELDS: Mapping[str, checks.Check] = {
    "model": checks.name,
    "kind": checks.name,
    "variables": _variables,
    "capabilities": checks.record(Capabilities, CAPABILITY_FIELDS),
    "feed_through": checks.map_of(checks.names),
    "initial_feed_through": checks.map_of(checks.names),
    "state_kind": checks.member(StateKind),
    "state_reason": checks.sentence,
    "input_derivatives": checks.member(InputDerivatives),
    "fixed_step_size": checks.optional(checks.number),
    "default_step_size": checks.optional(checks.number),
    "units": checks.map_of(checks.record(Unit, UNIT_FIELDS)),
    "remarks": checks.sentences,
    "sha256": checks.name,
    "guid": checks.name,
    "generation_tool": checks.name,
}


EXAMINATION_FIELDS: Mapping[str, checks.Check] = {
    "state_verdict": checks.member(StateVerdict),
    "state_reason": checks.sentence,
    "has_moved": checks.boolean,
    "difference": checks.number,
    "internal_clock": checks.optional(checks.number),
    "step_dependence": checks.number,
    "largest_substep": checks.optional(checks.number),
    "input_order": checks.optional(checks.integer),
    "input_refusal": checks.sentence,
    "not_repeating": checks.names,
    "poor_derivatives": checks.map_of(checks.sentence),
    "not_tried": checks.sentence,
}


DESCRIPTION = checks.record(SlaveDescription, DESCRIPTION_FIELDS)
EXAMINATION = checks.record(Examination, EXAMINATION_FIELDS)
