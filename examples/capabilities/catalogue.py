"""What each FMU of the collection is made of: sources, capabilities, model description."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from capabilities.model_descriptions import (
    TIME_REFERENCE,
    Description,
    fmi1,
    fmi2,
    fmi3,
    read_description,
    with_variables,
)
from fmu_framework.build_fmus import FRAMEWORK, Fmu

FOLDER = Path(__file__).resolve().parent
SOURCES = FOLDER / "src"
QUARTER_CAR = FOLDER.parent / "quarter_car" / "src"

_MADE_BY = (Path(__file__), FOLDER / "model_descriptions.py")
_COMMON = ("behaviour.h", "instance.h", "instance.c")
_FRONTS = {
    (1, "CoSimulation"): ("fmi1_co_simulation.c",),
    (2, "CoSimulation"): ("fmi2_front.h", "fmi2_common.c", "fmi2_co_simulation.c"),
    (2, "ModelExchange"): ("fmi2_front.h", "fmi2_common.c", "fmi2_model_exchange.c"),
    (3, "CoSimulation"): (
        "fmi3_front.h",
        "fmi3_common.c",
        "fmi3_co_simulation.c",
        "fmi3_refused.c",
    ),
    (3, "ModelExchange"): (
        "fmi3_front.h",
        "fmi3_common.c",
        "fmi3_model_exchange.c",
        "fmi3_refused.c",
    ),
}


@dataclass(frozen=True)
class Capabilities:
    """What an FMU can do, in terms common to the versions of FMI."""

    saved_states: bool = True
    variable_steps: bool = True
    input_derivatives: int = 0
    """Highest order. FMI 3.0 has none."""
    output_derivatives: int = 0
    event_mode: bool = False
    intermediate_update: bool = False
    returns_early: bool = False
    fixed_internal_step_size: str | None = None
    needs_execution_tool: bool = False

    def attributes(self, version: int, kind: str) -> dict[str, str]:
        """The attributes of the model description."""
        if kind == "ModelExchange":
            spelling = "State" if version == 3 else "state"
            return {
                f"canGetAndSetFMU{spelling}": _word(self.saved_states),
                f"canSerializeFMU{spelling}": _word(self.saved_states),
            }
        common = {
            "canHandleVariableCommunicationStepSize": _word(self.variable_steps),
            "maxOutputDerivativeOrder": str(self.output_derivatives),
        }
        if version == 1:
            return common | {
                "canInterpolateInputs": _word(self.input_derivatives > 0),
                "canNotUseMemoryManagementFunctions": "true",
            }
        if version == 2:
            return common | {
                "needsExecutionTool": _word(self.needs_execution_tool),
                "canInterpolateInputs": _word(self.input_derivatives > 0),
                "canGetAndSetFMUstate": _word(self.saved_states),
                "canSerializeFMUstate": _word(self.saved_states),
                "canNotUseMemoryManagementFunctions": "true",
            }
        intermediate = {
            "providesIntermediateUpdate": "true",
            "canReturnEarlyAfterIntermediateUpdate": "true",
            "mightReturnEarlyFromDoStep": "true",
            "recommendedIntermediateInputSmoothness": "3",
        }
        internal_step = (
            {"fixedInternalStepSize": self.fixed_internal_step_size}
            if self.fixed_internal_step_size
            else {}
        )
        return (
            common
            | {
                "canGetAndSetFMUState": _word(self.saved_states),
                "canSerializeFMUState": _word(self.saved_states),
                "hasEventMode": _word(self.event_mode),
                "mightReturnEarlyFromDoStep": _word(self.returns_early),
            }
            | (intermediate if self.intermediate_update else {})
            | internal_step
        )

    def definitions(self) -> dict[str, str]:
        """The macros by which the C sources know of it."""
        return {
            "CAN_GET_AND_SET_STATE": _digit(self.saved_states),
            "CAN_SERIALIZE_STATE": _digit(self.saved_states),
            "MAX_INPUT_DERIVATIVE_ORDER": str(self.input_derivatives),
            "MAX_OUTPUT_DERIVATIVE_ORDER": str(self.output_derivatives),
            "HAS_EVENT_MODE": _digit(self.event_mode),
            "PROVIDES_INTERMEDIATE_UPDATE": _digit(self.intermediate_update),
            "CAN_RETURN_EARLY_AFTER_INTERMEDIATE_UPDATE": _digit(self.intermediate_update),
        }


def _word(value: bool) -> str:
    return "true" if value else "false"


def _digit(value: bool) -> str:
    return "1" if value else "0"


def make_fmu(
    description: Description,
    sources: tuple[Path, ...],
    *,
    version: int = 2,
    kind: str = "CoSimulation",
    capabilities: Capabilities | None = None,
    definitions: dict[str, str] | None = None,
    libraries: tuple[str, ...] = (),
    absent_library: str | None = None,
) -> Fmu:
    """An FMU from a description, the sources of its behaviour and what it can do."""
    capabilities = capabilities or Capabilities()
    described = replace(
        description,
        capabilities=capabilities.attributes(version, kind) | description.capabilities,
    )
    macros = {
        "FMU_IDENTIFIER": described.name,
        "FMU_GUID": f'"{described.guid}"',
        "TIME_REFERENCE": f"{TIME_REFERENCE}u" if version == 3 else "UINT32_MAX",
        **capabilities.definitions(),
        **(definitions or {}),
    }
    if kind == "ModelExchange":
        macros["MODEL_EXCHANGE"] = "1"
    front = (*_COMMON, *_FRONTS[version, kind])
    text = fmi1(described) if version == 1 else (fmi2, fmi3)[version - 2](described, kind)
    return Fmu(
        name=described.name,
        description=text,
        sources=(*(SOURCES / name for name in front), *sources),
        made_by=_MADE_BY,
        fmi_version=version,
        definitions=tuple(sorted(macros.items())),
        libraries=libraries,
        absent_library=absent_library,
    )


# ---- The quarter car ----------------------------------------------------------------------------


def quarter_car() -> Iterator[Fmu]:
    """Both halves of the quarter car, cut at the displacement, in every way to be spoken to."""
    whole = Capabilities(input_derivatives=3, output_derivatives=1)
    no_derivatives = Capabilities()
    variants = {
        "no_state": (2, replace(whole, saved_states=False)),
        "no_derivatives": (2, no_derivatives),
        "bare": (2, replace(no_derivatives, saved_states=False)),
        "fmi3": (3, Capabilities(output_derivatives=1)),
        "fmi3_bare": (3, Capabilities(saved_states=False)),
        "fmi3_intermediate": (3, Capabilities(output_derivatives=1, intermediate_update=True)),
        "fmi1": (1, Capabilities(saved_states=False)),
        "me2": (2, Capabilities()),
        "me3": (3, Capabilities()),
    }
    for half in ("chassis", "wheel"):
        path = QUARTER_CAR / half
        sources = (
            path / "model.c",
            SOURCES / "equations.c",
            *(FRAMEWORK / name for name in ("model.h", "dormand_prince.c", "dormand_prince.h")),
        )
        description = read_description(path / "modelDescription.xml")
        for variant, (version, capabilities) in variants.items():
            described = replace(description, name=f"{half}_{variant}")
            definitions = {}
            if variant == "fmi3_intermediate":
                definitions["INTERNAL_STEP"] = "0.001"
                described = with_variables(
                    described,
                    input={"intermediateUpdate": "true"},
                    output={"intermediateUpdate": "true"},
                )
            if (half, variant) == ("wheel", "fmi1"):
                capabilities = replace(whole, saved_states=False)  # noqa: PLW2901
            yield make_fmu(
                described,
                sources,
                version=version,
                kind="ModelExchange" if variant.startswith("me") else "CoSimulation",
                capabilities=capabilities,
                definitions=definitions,
            )


FMUS = tuple(quarter_car())
"""All FMUs, in the order of the README."""
