"""The variables of a model description as scalar variables, and where they lie in the FMU."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import prod
from typing import Any
from xml.etree.ElementTree import Element

from protocol.description import SlaveDescription
from protocol.errors import ModelError
from protocol.text.names import nearest
from protocol.variables import Causality, StartValue, Variable, VariableType

MAX_VARIABLES = 100_000
"""Scalar variables of one FMU; a description with more is not sent around."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a scalar variable lies in the FMU.

    Attributes:
        reference: value reference of the variable or its array.
        type: of the variable.
        element: index in the array, row by row from 0; 0 for a scalar.
        size: number of elements of the array, 1 for a scalar.
        is_negated: whether it is the negated variable behind the reference (FMI 1.0).
    """

    reference: int
    type: VariableType
    element: int = 0
    size: int = 1
    is_negated: bool = False


@dataclass(frozen=True, slots=True)
class Variables:
    """All variables of an FMU.

    Attributes:
        scalars: the scalar variables, elements of arrays among them, in order.
        places: for each of them, by name.
        elements: names of the scalar variables of each declared variable, by its name.
        hidden: names of local variables that another variable has too, and has alone here.
    """

    scalars: tuple[Variable, ...]
    places: Mapping[str, Place]
    elements: Mapping[str, tuple[str, ...]]
    hidden: tuple[str, ...] = ()


def read_variables(
    model_description: Any, root: Element, structural_parameters: Mapping[str, StartValue]
) -> Variables:
    """Variables with arrays taken apart into ``name[i]`` or ``name[i,j]``, indices from 1.

    Of variables of one name the one that is not local is kept, or the first one.

    Args:
        model_description: of fmpy.
        root: of the same file, for what fmpy does not read.
        structural_parameters: values that hold instead of the start values.

    Raises:
        ModelError: a structural parameter that there is not, too many variables, or two of one
            name that are not local.
        ValueError: a value is not of its type.
    """
    _check_structural_parameters(model_description, structural_parameters)
    starts = _listed_starts(root)
    _read_unsigned_bounds(model_description, root)
    negated = {v.get("name") for v in root.iterfind("./ModelVariables/*[@alias='negatedAlias']")}
    scalars: dict[str, Variable] = {}
    places: dict[str, Place] = {}
    elements: dict[str, tuple[str, ...]] = {}
    hidden: list[str] = []
    for declared in model_description.modelVariables:
        shape = [_extent(dimension, structural_parameters) for dimension in declared.dimensions]
        size = prod(shape)
        if len(scalars) + size > MAX_VARIABLES:
            raise ModelError(f"{declared.name!r}: more than {MAX_VARIABLES} variables")
        names = [_element_name(declared.name, index) for index in product(*map(range, shape))]
        texts = starts.get(_declared_name(declared)) or _texts(declared, size)
        values = _starts(declared.type, texts, size)
        if declared.name in structural_parameters:
            values = [structural_parameters[declared.name]]
        kind = VariableType(declared.type)
        for element, (name, start) in enumerate(zip(names, values, strict=True)):
            variable = _variable(declared, name, kind, start)
            if name in scalars:
                hidden.append(name)
                if Causality.LOCAL not in (variable.causality, scalars[name].causality):
                    raise ModelError(f"two variables are called {name!r}")
                if variable.causality is Causality.LOCAL:
                    continue
            scalars[name] = variable
            places[name] = Place(
                declared.valueReference, kind, element, size, declared.name in negated
            )
        if declared.causality != Causality.LOCAL or declared.name not in elements:
            elements[declared.name] = tuple(names)
    return Variables(tuple(scalars.values()), places, elements, tuple(dict.fromkeys(hidden)))


def settable_variable(description: SlaveDescription, name: str) -> Variable:
    """The variable called ``name``, if it may be given a start value.

    Raises:
        ModelError: there is none of that name, with the nearest names, or it cannot be set.
    """
    try:
        variable = description.variable(name)
    except KeyError:
        names = [v.name for v in description.variables]
        raise ModelError(f"no variable {name!r}{nearest(name, names)}") from None
    if variable.causality is Causality.STRUCTURAL_PARAMETER:
        raise ModelError(
            f"{name!r} cannot be set here: it is a structural parameter",
            remedy="give it in the configuration of the slave",
        )
    if variable.causality in (Causality.CALCULATED_PARAMETER, Causality.INDEPENDENT) or (
        variable.variability == "constant"
    ):
        raise ModelError(f"{name!r} cannot be set: it is a {variable.variability} variable")
    return variable


def _check_structural_parameters(
    model_description: Any, structural_parameters: Mapping[str, StartValue]
) -> None:
    known = {
        v.name: VariableType(v.type)
        for v in model_description.modelVariables
        if v.causality == Causality.STRUCTURAL_PARAMETER and not v.dimensions
    }
    for name, value in structural_parameters.items():
        if name not in known:
            raise ModelError(
                f"no structural parameter {name!r}"
                f"{nearest(name, known) if known else '; the FMU has none'}"
            )
        bounds = known[name].integer_range
        if bounds and not (type(value) is int and bounds[0] <= value <= bounds[1]):
            raise ModelError(
                f"{name!r} is of type {known[name]}, {bounds[0]} to {bounds[1]}; it cannot be "
                f"{value!r}"
            )


def _extent(dimension: Any, structural_parameters: Mapping[str, StartValue]) -> int:
    """Size of one dimension of an array."""
    if dimension.variable is None:
        extent = int(dimension.start)
    else:
        variable = dimension.variable
        extent = int(structural_parameters.get(variable.name, variable.start))
    if extent < 0:
        raise ValueError(f"an array dimension of {extent}")
    return extent


def _element_name(name: str, index: Sequence[int]) -> str:
    return f"{name}[{','.join(str(i + 1) for i in index)}]" if index else name


def _declared_name(declared: Any) -> str:
    """Name of the variable that an alias of FMI 3.0 stands for, or its own."""
    return str(declared.name if declared.alias is None else declared.alias.name)


def _listed_starts(root: Element) -> dict[str, list[str]]:
    """Start values of strings and binaries of FMI 3.0, by variable: one element for each."""
    return {
        variable.get("name", ""): [start.get("value", "") for start in variable.iterfind("Start")]
        for variable in root.iterfind("./ModelVariables/*")
        if variable.find("Start") is not None
    }


def _read_unsigned_bounds(model_description: Any, root: Element) -> None:
    """Give fmpy's variables of unsigned types their ``min`` and ``max``, which it passes over."""
    elements = {v.get("name"): v for v in root.iterfind("./ModelVariables/*")}
    for declared in model_description.modelVariables:
        if declared.type.startswith("UInt"):
            element = elements[declared.name if declared.alias is None else declared.alias.name]
            declared.min, declared.max = element.get("min"), element.get("max")


def _texts(declared: Any, size: int) -> list[str]:
    if declared.start is None:
        return []
    return str(declared.start).split() if size != 1 or declared.dimensions else [declared.start]


def _starts(kind: str, texts: list[str], size: int) -> list[StartValue | None]:
    """One for each element; None where the FMU says none, or says them for another size."""
    values: list[StartValue | None] = [_PARSERS.get(kind, int)(text) for text in texts]
    if len(values) == 1:
        return values * size
    return values if len(values) == size else [None] * size


def _boolean(text: str) -> bool:
    return text.lower() in ("true", "1")


_PARSERS: Mapping[str, Callable[[str], StartValue]] = {
    "Real": float,
    "Float32": float,
    "Float64": float,
    "Boolean": _boolean,
    "Clock": _boolean,
    "String": str,
    "Binary": bytes.fromhex,
}
"""All others are integers."""


def _variable(declared: Any, name: str, kind: VariableType, start: StartValue | None) -> Variable:
    declared_type = declared.declaredType
    unit = declared.unit or (declared_type.unit if declared_type else None)
    nominal = declared.nominal or (declared_type.nominal if declared_type else None)
    return Variable(
        name=name,
        causality=Causality(declared.causality or "local"),
        type=kind,
        variability=declared.variability or "continuous",
        unit=unit or "",
        start=start,
        nominal=abs(float(nominal)) if nominal and float(nominal) != 0.0 else 1.0,
        description=declared.description or "",
        minimum=_bound(declared, kind, "min"),
        maximum=_bound(declared, kind, "max"),
        items={item.name: int(item.value) for item in declared_type.items}
        if kind is VariableType.ENUMERATION and declared_type
        else {},
    )


def _bound(declared: Any, kind: VariableType, key: str) -> float | int | None:
    """Smallest or largest value of a variable, or of its declared type; None: none is said."""
    text = getattr(declared, key) or (declared.declaredType and getattr(declared.declaredType, key))
    try:
        return int(text) if kind.integer_range is not None else float(text)
    except (TypeError, ValueError):
        return None
