"""Declarations of an FMU on how it is run, for each version of FMI."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Any
from xml.etree.ElementTree import Element

from protocol.description import Capabilities, Experiment, InputDerivatives
from protocol.errors import ModelError

_YES = ("true", "1")


@dataclass(frozen=True, slots=True)
class Interface:
    """The interface of an FMU that is used: co-simulation, if it offers it.

    Attributes:
        version: major version of FMI.
        is_model_exchange: whether a solver has to be brought along.
        model_identifier: base name of the binary.
        capabilities: as a co-simulation slave.
        input_derivatives: how it follows polynomial inputs.
        fixed_step_size: the only communication step size that it takes [s], None: any.
        needs_execution_tool: whether it is only an adapter to a tool.
        is_once_per_process: whether a process may hold one instance only.
        has_event_mode: FMI 3.0, co-simulation.
        saves_state: whether the FMU itself saves its state.
        continuous_states, event_indicators: how many there are (model exchange of FMI 2.0; FMI 3.0
            says it when it runs).
        needs_completed_step: fmi2CompletedIntegratorStep, fmi3CompletedIntegratorStep.
        intermediate_inputs: value references of inputs that are set within a step (FMI 3.0).
    """

    version: int
    is_model_exchange: bool
    model_identifier: str
    capabilities: Capabilities
    input_derivatives: InputDerivatives = InputDerivatives.NONE
    fixed_step_size: float | None = None
    needs_execution_tool: bool = False
    is_once_per_process: bool = False
    has_event_mode: bool = False
    saves_state: bool = False
    continuous_states: int = 0
    event_indicators: int = 0
    needs_completed_step: bool = True
    intermediate_inputs: tuple[int, ...] = ()

    @property
    def kind(self) -> str:
        """In words."""
        what = "model exchange" if self.is_model_exchange else "co-simulation"
        return f"FMI {self.version}.0 {what}"


def interface_1(model_description: Any, root: Element) -> Interface:
    """FMI 1.0: co-simulation only. It has no saved states.

    Raises:
        ModelError: the FMU is for model exchange only.
    """
    if model_description.coSimulation is None:
        raise ModelError(
            "is an FMU for model exchange of FMI 1.0",
            remedy="export it as co-simulation, or with FMI 2.0 or 3.0",
        )
    found = root.find("./Implementation/*/Capabilities")
    declared: Mapping[str, str] = {} if found is None else found.attrib
    can_interpolate = declared.get("canInterpolateInputs") in _YES
    return Interface(
        version=1,
        is_model_exchange=False,
        model_identifier=model_description.coSimulation.modelIdentifier,
        capabilities=Capabilities(
            can_interpolate_inputs=can_interpolate,
            max_output_derivative_order=int(declared.get("maxOutputDerivativeOrder", "0")),
            can_handle_variable_step_size=(
                declared.get("canHandleVariableCommunicationStepSize") in _YES
            ),
        ),
        input_derivatives=_native(can_interpolate),
        needs_execution_tool=root.find("./Implementation/CoSimulation_Tool") is not None,
        is_once_per_process=declared.get("canBeInstantiatedOnlyOncePerProcess") in _YES,
    )


def interface_2(model_description: Any, root: Element) -> Interface:
    """FMI 2.0.

    Raises:
        ModelError: the FMU has no interface.
    """
    del root
    slave = model_description.coSimulation
    if slave is None:
        return _model_exchange(2, model_description)
    has_variable_steps = bool(slave.canHandleVariableCommunicationStepSize)
    return Interface(
        version=2,
        saves_state=bool(slave.canGetAndSetFMUstate),
        is_model_exchange=False,
        model_identifier=slave.modelIdentifier,
        capabilities=Capabilities(
            can_get_and_set_state=bool(slave.canGetAndSetFMUstate),
            can_serialize_state=bool(slave.canSerializeFMUstate),
            can_interpolate_inputs=bool(slave.canInterpolateInputs),
            max_output_derivative_order=int(slave.maxOutputDerivativeOrder or 0),
            can_handle_variable_step_size=has_variable_steps,
        ),
        input_derivatives=_native(bool(slave.canInterpolateInputs)),
        fixed_step_size=None
        if has_variable_steps
        else default_experiment(model_description).step_size,
        needs_execution_tool=bool(slave.needsExecutionTool),
        is_once_per_process=bool(slave.canBeInstantiatedOnlyOncePerProcess),
    )


def interface_3(model_description: Any, root: Element) -> Interface:
    """FMI 3.0. Inputs within a step are set by intermediate updates, if all of them can be.

    Raises:
        ModelError: the FMU has no interface but scheduled execution.
    """
    slave = model_description.coSimulation
    if slave is None:
        return _model_exchange(3, model_description)
    has_variable_steps = bool(slave.canHandleVariableCommunicationStepSize)
    fixed = slave.fixedInternalStepSize
    intermediate = _intermediate_inputs(root) if slave.providesIntermediateUpdate else ()
    return Interface(
        version=3,
        saves_state=bool(slave.canGetAndSetFMUstate),
        is_model_exchange=False,
        model_identifier=slave.modelIdentifier,
        capabilities=Capabilities(
            can_get_and_set_state=bool(slave.canGetAndSetFMUstate),
            can_serialize_state=bool(slave.canSerializeFMUstate),
            can_interpolate_inputs=bool(intermediate),
            max_output_derivative_order=int(slave.maxOutputDerivativeOrder or 0),
            can_handle_variable_step_size=has_variable_steps,
        ),
        input_derivatives=_native(bool(intermediate)),
        fixed_step_size=None if has_variable_steps or fixed is None else float(fixed),
        needs_execution_tool=bool(slave.needsExecutionTool),
        is_once_per_process=bool(slave.canBeInstantiatedOnlyOncePerProcess),
        has_event_mode=bool(slave.hasEventMode),
        intermediate_inputs=intermediate,
    )


def default_experiment(model_description: Any) -> Experiment:
    """The default experiment; what is no number, or makes no sense, is not given."""
    given = model_description.defaultExperiment
    start, stop = _number(given, "startTime"), _number(given, "stopTime")
    step_size = _number(given, "stepSize")
    if stop is not None and stop <= (start or 0.0):
        start = stop = None
    return Experiment(start, stop, step_size if step_size is not None and step_size > 0.0 else None)


def _number(experiment: Any, name: str) -> float | None:
    try:
        number = float(getattr(experiment, name, None))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return None
    return number if isfinite(number) else None


def _model_exchange(version: int, model_description: Any) -> Interface:
    model = model_description.modelExchange
    if model is None:
        raise ModelError(
            "has neither co-simulation nor model exchange",
            remedy=f"export it as FMI {version}.0 co-simulation or model exchange",
        )
    saves_state = bool(model.canGetAndSetFMUstate) or _has_only_continuous_states(model_description)
    return Interface(
        version=version,
        is_model_exchange=True,
        model_identifier=model.modelIdentifier,
        capabilities=Capabilities(
            can_get_and_set_state=saves_state,
            can_serialize_state=bool(model.canSerializeFMUstate)
            or (saves_state and not model.canGetAndSetFMUstate),
            can_interpolate_inputs=True,
            max_output_derivative_order=0,
            can_handle_variable_step_size=True,
            outputs_follow_inputs=True,
        ),
        input_derivatives=InputDerivatives.NATIVE,
        needs_execution_tool=bool(model.needsExecutionTool),
        is_once_per_process=bool(model.canBeInstantiatedOnlyOncePerProcess),
        saves_state=bool(model.canGetAndSetFMUstate),
        continuous_states=int(model_description.numberOfContinuousStates),
        event_indicators=int(model_description.numberOfEventIndicators or 0),
        needs_completed_step=bool(model.needsCompletedIntegratorStep),
    )


def _has_only_continuous_states(model_description: Any) -> bool:
    """True if nothing can change at events, so that states and inputs say all."""
    return not model_description.numberOfEventIndicators and not any(
        v.causality in ("local", "output")
        and v.variability not in ("constant", "fixed")
        and (v.variability == "discrete" or v.type not in ("Real", "Float32", "Float64"))
        for v in model_description.modelVariables
    )


def _intermediate_inputs(root: Element) -> tuple[int, ...]:
    """The continuous inputs if each of them can be set in intermediate updates, else none."""
    inputs = [
        variable
        for kind in ("Float64", "Float32")
        for variable in root.iterfind(f"./ModelVariables/{kind}[@causality='input']")
        if variable.get("variability", "continuous") == "continuous"
    ]
    if not all(variable.get("intermediateUpdate") in _YES for variable in inputs):
        return ()
    return tuple(int(variable.attrib["valueReference"]) for variable in inputs)


def _native(is_native: bool) -> InputDerivatives:
    return InputDerivatives.NATIVE if is_native else InputDerivatives.NONE
