"""modelDescription.xml, read with fmpy, as a `SlaveDescription`."""

from __future__ import annotations

import hashlib
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fmpy import read_model_description

from protocol.errors import ModelError
from protocol.slave import (
    Capabilities,
    Causality,
    InputDerivatives,
    SlaveDescription,
    StartValue,
    StateKind,
    Variable,
    VariableType,
)
from slave_node.fmu.archive import extract


def describe_fmu(fmu: Path) -> SlaveDescription:
    """The description of an FMU file, without loading its binary.

    Raises:
        ModelError: the file is missing, unsafe, or not an FMI 2.0 co-simulation FMU.
    """
    with TemporaryDirectory(prefix="doublestep-") as directory:
        extract(fmu, Path(directory))
        return describe(fmu, read_description(fmu, Path(directory)))


def read_description(fmu: Path, directory: Path) -> Any:
    """Fmpy's model description of the FMU extracted in ``directory``.

    Raises:
        ModelError: the XML cannot be read, or the FMU is not an FMI 2.0 co-simulation FMU.
    """
    try:
        model_description = read_model_description(str(directory), validate=False)
    except Exception as error:  # fmpy raises whatever its XML and type conversions raise
        raise ModelError(f"{fmu}: modelDescription.xml cannot be read: {error}") from error
    version = str(model_description.fmiVersion)
    if not version.startswith("2."):
        raise ModelError(
            f"{fmu}: is an FMI {version} FMU", remedy="export it as FMI 2.0 co-simulation"
        )
    if model_description.coSimulation is None:
        raise ModelError(
            f"{fmu}: is an FMU for model exchange only",
            remedy="export it as FMI 2.0 co-simulation",
        )
    return model_description


def describe(fmu: Path, model_description: Any) -> SlaveDescription:
    """What a master needs to know about the FMU.

    Raises:
        ModelError: a value in the model description is not of its type.
    """
    try:
        return _described(fmu, model_description)
    except ValueError as error:
        raise ModelError(f"{fmu}: modelDescription.xml cannot be read: {error}") from error


def _described(fmu: Path, model_description: Any) -> SlaveDescription:
    slave = model_description.coSimulation
    inputs = tuple(v.name for v in model_description.modelVariables if v.causality == "input")
    feed_through = _feed_through(model_description, model_description.outputs, inputs)
    return SlaveDescription(
        model=model_description.modelName,
        kind="FMI 2.0 co-simulation",
        variables=tuple(_variable(v) for v in model_description.modelVariables),
        capabilities=Capabilities(
            can_get_and_set_state=bool(slave.canGetAndSetFMUstate),
            can_serialize_state=bool(slave.canSerializeFMUstate),
            can_interpolate_inputs=bool(slave.canInterpolateInputs),
            max_output_derivative_order=int(slave.maxOutputDerivativeOrder or 0),
            can_handle_variable_step_size=bool(slave.canHandleVariableCommunicationStepSize),
        ),
        feed_through=feed_through,
        initial_feed_through=feed_through
        | _feed_through(model_description, model_description.initialUnknowns, inputs, listed=True),
        state_kind=StateKind.NATIVE if slave.canGetAndSetFMUstate else StateKind.NONE,
        input_derivatives=(
            InputDerivatives.NATIVE if slave.canInterpolateInputs else InputDerivatives.NONE
        ),
        sha256=hashlib.sha256(fmu.read_bytes()).hexdigest(),
        guid=model_description.guid or "",
        generation_tool=model_description.generationTool or "",
    )


def _feed_through(
    model_description: Any, unknowns: Any, inputs: tuple[str, ...], *, listed: bool = False
) -> dict[str, tuple[str, ...]]:
    """Inputs on which each output depends; all of them where the FMU does not say.

    ``listed``: only the outputs among ``unknowns``, for a list that need not have them all.
    """
    depends: dict[str, tuple[str, ...]] = {
        v.name: inputs
        for v in model_description.modelVariables
        if v.causality == "output" and not listed
    }
    for unknown in unknowns:
        if unknown.variable.causality == "output":
            depends[unknown.variable.name] = (
                inputs
                if unknown.dependencies is None
                else tuple(v.name for v in unknown.dependencies if v.causality == "input")
            )
    return {name: names for name, names in depends.items() if names or listed}


def _variable(variable: Any) -> Variable:
    declared = variable.declaredType
    unit = variable.unit or (declared.unit if declared else None)
    nominal = variable.nominal or (declared.nominal if declared else None)
    return Variable(
        name=variable.name,
        causality=Causality(variable.causality or "local"),
        type=VariableType(variable.type),
        variability=variable.variability or "continuous",
        unit=unit or "",
        start=_start(variable),
        nominal=abs(float(nominal)) if nominal and float(nominal) != 0.0 else 1.0,
        description=variable.description or "",
    )


def _start(variable: Any) -> StartValue | None:
    if variable.start is None:
        return None
    match variable.type:
        case "Real":
            return float(variable.start)
        case "Integer" | "Enumeration":
            return int(variable.start)
        case "Boolean":
            return str(variable.start).lower() in ("true", "1")
        case _:
            return str(variable.start)
