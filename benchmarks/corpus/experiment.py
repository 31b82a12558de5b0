"""The experiment that a model is tried with: the first steps of its own default experiment."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import floor
from pathlib import Path
from typing import Any

import fmpy

STEPS = 100
STEP_SIZE = 1e-2
TOLERANCE = 1e-6
"""Handed to the model's own solver, by Doublestep and by FMPy."""


@dataclass(frozen=True, slots=True)
class Experiment:
    """Times and variables.

    Attributes:
        start_time, stop_time: [s].
        step_size: of the run with a fixed communication step size [s].
        inputs, outputs: continuous reals, with the inputs' start values.
        is_co_simulation: whether the model has a solver of its own.
        problem: why the model description could not be read; "" if it could.
    """

    start_time: float = 0.0
    stop_time: float = STEPS * STEP_SIZE
    step_size: float = STEP_SIZE
    inputs: dict[str, float] = field(default_factory=dict)
    outputs: tuple[str, ...] = ()
    is_co_simulation: bool = True
    problem: str = ""


def experiment_of(fmu: Path, steps: int = STEPS) -> Experiment:
    """At most so many steps of the size that the model asks for, or of a hundredth of its time."""
    try:
        description = fmpy.read_model_description(str(fmu), validate=False)
        return _experiment(description, steps)
    except Exception as error:  # fmpy raises whatever its XML and type conversions raise
        return Experiment(problem=f"{type(error).__name__}: {error}")


def _experiment(description: Any, steps: int) -> Experiment:
    declared = description.defaultExperiment
    co_simulation = description.coSimulation
    start = _number(declared, "startTime") or 0.0
    stop = _number(declared, "stopTime")
    h = _number(co_simulation, "fixedInternalStepSize") or _number(declared, "stepSize")
    span = stop - start if stop is not None and stop > start else None
    h = h or (span / STEPS if span else STEP_SIZE)
    number = steps if span is None else max(1, min(steps, floor(span / h * (1.0 + 1e-9))))
    continuous = [v for v in description.modelVariables if _is_continuous(v)]
    return Experiment(
        start_time=start,
        stop_time=start + number * h,
        step_size=h,
        inputs={v.name: float(v.start or 0.0) for v in continuous if v.causality == "input"},
        outputs=tuple(v.name for v in continuous if v.causality == "output"),
        is_co_simulation=co_simulation is not None,
    )


def _number(element: Any, attribute: str) -> float | None:
    """A number of the model description; None: it has none."""
    text = getattr(element, attribute, None)
    return None if text is None else float(text)


def _is_continuous(variable: Any) -> bool:
    """True if a scalar variable takes part in an error-controlled coupling."""
    is_scalar = variable.type in ("Real", "Float64") and not variable.dimensions
    return is_scalar and variable.variability in (None, "continuous")
