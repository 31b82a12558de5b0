"""Slips in modelDescription.xml that leave no doubt of what is meant, mended for reading.

Tools have exported, and other importers have run, FMUs with them; fmpy refuses to read them.
"""

from __future__ import annotations

from collections.abc import Container, Iterator
from xml.etree.ElementTree import Element

_VARIABLE = ("discrete", "continuous")
_LEGAL = {
    "parameter": ("fixed", "tunable"),
    "calculatedParameter": ("fixed", "tunable"),
    "structuralParameter": ("fixed", "tunable"),
    "input": _VARIABLE,
    "output": ("constant", *_VARIABLE),
    "independent": ("continuous",),
}
"""Variabilities by causality (FMI 2.0, section 2.2.7; FMI 3.0, section 2.4.7.5)."""


def repair(root: Element) -> list[str]:
    """Mend a model description of FMI 2.0 or 3.0 in place.

    * A variability that its causality does not allow is ``tunable`` for parameters,
      ``continuous`` for the independent variable, else ``discrete``.
    * A declared type that is not defined is none.

    Returns:
        What was mended: a sentence for each kind of slip, with the first variable's name.
    """
    version = root.get("fmiVersion", "")
    if version.startswith("1"):
        return []
    default = "continuous" if version.startswith("2") else None
    types = {kind.get("name") for kind in root.iterfind("./TypeDefinitions/*")}
    found: dict[str, list[str]] = {}
    for variable in root.iterfind("./ModelVariables/*"):
        for slip in (*_variability(variable, default), *_declared_type(variable, types)):
            found.setdefault(slip, []).append(variable.get("name", ""))
    return [
        f"{names[0]}{f' and {len(names) - 1} more' if len(names) > 1 else ''}: {slip}"
        for slip, names in found.items()
    ]


def _variability(variable: Element, default: str | None) -> Iterator[str]:
    causality = variable.get("causality", "local")
    variability = variable.get("variability", default)
    legal = _LEGAL.get(causality)
    if legal is None or variability is None or variability in legal:
        return
    meant = next(kind for kind in ("tunable", "discrete", "continuous") if kind in legal)
    variable.set("variability", meant)
    yield f"a variable of causality {causality} cannot be {variability}; it is taken as {meant}"


def _declared_type(variable: Element, types: Container[str | None]) -> Iterator[str]:
    for element in (variable, *variable):
        declared = element.get("declaredType")
        if declared is not None and declared not in types:
            del element.attrib["declaredType"]
            yield f"its type {declared} is not defined; it is left out"
