"""modelDescription.xml, read with fmpy, as a `SlaveDescription`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from fmpy import read_model_description

from protocol.description import Experiment, SlaveDescription, StateKind
from protocol.errors import ModelError
from protocol.host.files import DESCRIPTION, Contents
from protocol.host.scratch import ScratchDirectory
from protocol.variables import Causality, StartValue, VariableType
from slave_node.fmu.archive import extract
from slave_node.fmu.embedded_python import log_categories, slave_module
from slave_node.fmu.interfaces import (
    Interface,
    default_experiment,
    interface_1,
    interface_2,
    interface_3,
)
from slave_node.fmu.repairs import repair
from slave_node.fmu.units import units
from slave_node.fmu.variables import Place, Variables, read_variables

_NO_STATE = "the FMU does not declare that it can save its state"


@dataclass(frozen=True, slots=True)
class FmuModel:
    """An FMU that was extracted and read.

    Attributes:
        fmu: the file, or the folder.
        directory: where it was extracted.
        description: for the master.
        interface: the one that is used.
        places: where each variable lies, by name.
        structural_parameters: values that differ from the start values.
        token: GUID or instantiation token, as the FMU wants to hear it.
        log_categories: all.
        experiment: that it suggests.
    """

    fmu: Path
    directory: Path
    description: SlaveDescription
    interface: Interface
    places: Mapping[str, Place]
    structural_parameters: Mapping[str, StartValue]
    token: str
    log_categories: tuple[str, ...]
    experiment: Experiment


def describe_fmu(fmu: Path) -> SlaveDescription:
    """The description of an FMU, without loading its binary.

    Raises:
        ModelError: the file is missing, unsafe, or not an FMU that can be run.
    """
    with ScratchDirectory() as directory:
        return read_fmu(fmu, directory).description


def read_fmu(
    fmu: Path, directory: Path, structural_parameters: Mapping[str, StartValue] | None = None
) -> FmuModel:
    """Extract an FMU and read its model description.

    Args:
        fmu: the file, or the folder of one that is unpacked.
        directory: an empty one to extract it into.
        structural_parameters: values that hold instead of the start values.

    Raises:
        ModelError: the file is missing or unsafe, the XML cannot be read, the version of FMI is
            unknown, there is no interface that can be run, or no such structural parameter.
    """
    extract(fmu, directory)
    try:
        root = ElementTree.parse(directory / DESCRIPTION).getroot()
        read_interface = _version(root)
        repairs = repair(root)
        model_description = _read(directory, root if repairs else None)
        interface = read_interface(model_description, root)
        variables = read_variables(model_description, root, structural_parameters or {})
        return FmuModel(
            fmu,
            directory,
            _description(
                fmu,
                model_description,
                root,
                interface,
                variables,
                remarks=(
                    *repairs,
                    *_hidden(variables),
                    *_remarks(directory, model_description, interface),
                ),
            ),
            interface,
            variables.places,
            structural_parameters or {},
            model_description.guid or "",
            log_categories(directory, [c.name for c in model_description.logCategories]),
            default_experiment(model_description),
        )
    except ModelError as error:
        raise ModelError(f"{fmu}: {error.cause}", remedy=error.remedy) from error
    except Exception as error:  # fmpy raises whatever its XML and type conversions raise
        raise ModelError(f"{fmu}: {DESCRIPTION} cannot be read: {error}") from error


def _read(directory: Path, mended: Element | None) -> Any:
    """The model description as fmpy reads it; in place of the file one that was mended."""
    if mended is None:
        return read_model_description(str(directory), validate=False)
    with ScratchDirectory() as place:
        file = Path(place) / DESCRIPTION
        ElementTree.ElementTree(mended).write(file, encoding="utf-8", xml_declaration=True)
        return read_model_description(str(file), validate=False)


_INTERFACES: Mapping[str, Callable[[Any, Element], Interface]] = {
    "1": interface_1,
    "2": interface_2,
    "3": interface_3,
}


def _version(root: Element) -> Callable[[Any, Element], Interface]:
    version = root.attrib["fmiVersion"]
    try:
        return _INTERFACES[version.split(".")[0]]
    except KeyError:
        raise ModelError(
            f"is an FMI {version} FMU", remedy="export it with FMI 3.0, 2.0 or 1.0"
        ) from None


def _description(
    fmu: Path,
    model_description: Any,
    root: Element,
    interface: Interface,
    variables: Variables,
    *,
    remarks: tuple[str, ...],
) -> SlaveDescription:
    saves_state = interface.capabilities.can_get_and_set_state
    feed_through = _feed_through(model_description, root, variables, interface.version)
    states = _states(model_description, variables)
    initial = _dependencies(model_description.initialUnknowns, variables)
    return SlaveDescription(
        model=model_description.modelName,
        kind=interface.kind,
        variables=variables.scalars,
        capabilities=interface.capabilities,
        feed_through={name: inputs for name, inputs in feed_through.items() if inputs} | states,
        initial_feed_through={name: i for name, i in feed_through.items() if i} | initial,
        state_kind=StateKind.NATIVE if saves_state else StateKind.NONE,
        state_reason="" if saves_state else _NO_STATE,
        input_derivatives=interface.input_derivatives,
        fixed_step_size=interface.fixed_step_size,
        default_step_size=default_experiment(model_description).step_size,
        units=units(model_description),
        remarks=remarks,
        sha256=Contents.of(fmu).sha256,
        guid=model_description.guid or "",
        generation_tool=model_description.generationTool or "",
    )


def _feed_through(
    model_description: Any, root: Element, variables: Variables, version: int
) -> dict[str, tuple[str, ...]]:
    """Inputs on which each output depends; all of them where the FMU does not say."""
    inputs = _inputs(model_description.modelVariables, variables)
    depends = {
        name: inputs
        for v in model_description.modelVariables
        if v.causality == "output"
        for name in variables.elements[v.name]
    }
    if version == 1:
        return depends | _direct_dependencies(root)
    return depends | _dependencies(model_description.outputs, variables, inputs)


def _states(model_description: Any, variables: Variables) -> dict[str, tuple[str, ...]]:
    """Local continuous states, which depend on no input directly, and their derivatives.

    Those of derivatives are left out where the FMU does not say them: they count as all inputs.
    """
    depends: dict[str, tuple[str, ...]] = {}
    for unknown in model_description.derivatives:
        derivative = unknown.variable
        state = derivative.derivative
        if state is not None and state.causality == Causality.LOCAL:
            depends |= dict.fromkeys(variables.elements[state.name], ())
        if derivative.causality == Causality.LOCAL and unknown.dependencies is not None:
            names = _inputs(unknown.dependencies, variables)
            depends |= dict.fromkeys(variables.elements[derivative.name], names)
    return depends


def _dependencies(
    unknowns: Any, variables: Variables, all_inputs: tuple[str, ...] | None = None
) -> dict[str, tuple[str, ...]]:
    """Inputs on which the outputs among ``unknowns`` depend.

    ``all_inputs``: what holds for an unknown without a list of dependencies; None: it then depends
    on what it depends on otherwise.
    """
    depends: dict[str, tuple[str, ...]] = {}
    for unknown in unknowns:
        if unknown.variable.causality != "output":
            continue
        if unknown.dependencies is not None:
            names: tuple[str, ...] | None = _inputs(unknown.dependencies, variables)
        else:
            names = all_inputs
        if names is not None:
            depends |= dict.fromkeys(variables.elements[unknown.variable.name], names)
    return depends


def _inputs(declared: Any, variables: Variables) -> tuple[str, ...]:
    """The scalar variables of the inputs among ``declared``."""
    return tuple(
        name for v in declared if v.causality == "input" for name in variables.elements[v.name]
    )


def _direct_dependencies(root: Element) -> dict[str, tuple[str, ...]]:
    """FMI 1.0: element DirectDependency."""
    return {
        variable.get("name", ""): tuple(name.text or "" for name in found.iterfind("Name"))
        for variable in root.iterfind("./ModelVariables/ScalarVariable[@causality='output']")
        if (found := variable.find("DirectDependency")) is not None
    }


def _hidden(variables: Variables) -> tuple[str, ...]:
    """Remark on names that stand for several variables."""
    names = variables.hidden
    if not names:
        return ()
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    shown = ", ".join(map(repr, names[:3]))
    return (
        f"several variables are called {shown}{more}: the name stands for the one that is not "
        "local, or for the first one",
    )


def _remarks(directory: Path, model_description: Any, interface: Interface) -> tuple[str, ...]:
    """Remarks on what of the FMU is not carried, and what it needs."""
    remarks = [
        f"clock {v.name} ({v.intervalVariability or 'without interval'}) is ignored"
        for v in model_description.modelVariables
        if v.type == VariableType.CLOCK
    ]
    remarks += [
        f"{v.name} changes with a clock, which is ignored"
        for v in model_description.modelVariables
        if v.clocks and v.causality in (Causality.INPUT, Causality.OUTPUT)
    ]
    if slave_module(directory) is not None:
        remarks.append("its Python code runs in the Python of this slave-node")
    elif interface.needs_execution_tool:
        tool = model_description.generationTool or "the tool that exported it"
        remarks.append(f"it needs {tool} on the host that runs it")
    can_vary = interface.capabilities.can_handle_variable_step_size
    if not can_vary and interface.fixed_step_size is None:
        remarks.append("it takes one communication step size only, and does not say which")
    return tuple(remarks)
