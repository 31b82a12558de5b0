"""Parts of each FMU of the collection: sources, capabilities, model description."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from capabilities.model_descriptions import (
    TIME_REFERENCE,
    Description,
    Unit,
    Variable,
    build_description,
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
    """Capabilities of an FMU, in terms common to the versions of FMI."""

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
    documents: dict[str, bytes] | None = None,
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
    files = (*(SOURCES / name for name in front), *sources)
    macro_items = tuple(sorted(macros.items()))
    documents = dict(documents or {})
    if version == 3:
        compiled = tuple(sorted(path.name for path in files if path.suffix == ".c"))
        documents["sources/buildDescription.xml"] = build_description(
            described.name, compiled, macro_items
        )
    text = fmi1(described) if version == 1 else (fmi2, fmi3)[version - 2](described, kind)
    return Fmu(
        name=described.name,
        description=text,
        sources=files,
        made_by=_MADE_BY,
        fmi_version=version,
        definitions=macro_items,
        libraries=libraries,
        absent_library=absent_library,
        documents=documents,
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
            definitions: dict[str, str] = {}
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


# ---- Lags ---------------------------------------------------------------------------------------

LAG = (SOURCES / "lag.h", SOURCES / "lag.c")
LAG_CAPABILITIES = Capabilities(input_derivatives=1, output_derivatives=1)
LAG_REFERENCES = 10
"""Number of value references that each lag takes (src/lag.h)."""
EXPERIMENT = {"startTime": "0", "stopTime": "2", "tolerance": "1e-6", "stepSize": "0.01"}


def lag_variables(
    *,
    u: str = "u",
    y: str = "y",
    offset: int = 0,
    unit: str | None = None,
    prefix: str = "",
    start: str = "0",
    x_start: str = "1",
) -> tuple[Variable, ...]:
    """The variables of one lag, T y' = u - y (src/lag.h)."""
    return (
        Variable(u, offset, "input", start=start, unit=unit, description="Input"),
        Variable(y, offset + 1, "output", unit=unit, depends=(), description="Follows the input"),
        Variable(
            f"{prefix}T",
            offset + 2,
            "parameter",
            start="0.5",
            unit="s",
            description="Time constant",
        ),
        Variable(
            f"{prefix}x_start",
            offset + 3,
            "parameter",
            start=x_start,
            unit=unit,
            description=f"Value of {y} at the start",
        ),
    )


SECOND = Unit("s", {"s": "1"})


def lag_description(name: str, description: str, **attributes: str) -> Description:
    """An FMU with one lag; ``attributes`` go into DefaultExperiment."""
    return Description(
        name=name,
        description=description,
        variables=lag_variables(),
        units=(SECOND,),
        experiment=EXPERIMENT | attributes,
    )


def lags() -> Iterator[Fmu]:
    """One lag each, and what goes wrong with it."""
    whole = LAG_CAPABILITIES
    held = replace(whole, input_derivatives=0, output_derivatives=0)
    no_state = replace(whole, saved_states=False)
    for name, description, capabilities in (
        ("broken_state", "A lag that does not restore its state", whole),
        ("restarting_solver", "A lag whose solver restarts with a restored state", whole),
        ("not_repeating", "A lag whose steps do not repeat", held),
        ("error_on_restore", "A lag that refuses to restore its state", whole),
        ("starts_thread", "A lag with a thread of its own", no_state),
        ("writes_file", "A lag that writes a file", no_state),
        ("discards", "A lag that takes no step longer than 2 ms", whole),
        ("large_state", "131 072 lags, 1 MiB of state", whole),
        ("internal_clock", "A lag that moves every 10 ms", held),
        ("euler_per_step", "A lag, one explicit Euler step per communication step", held),
        ("licence_error", "A lag that needs a licence", whole),
        ("crashes", "A lag that crashes beyond 0.25 s", whole),
        ("hangs", "A lag with a step without an end beyond 0.25 s", whole),
        ("not_finite", "A lag whose output is infinite beyond 0.25 s", whole),
        ("changes_process", "A lag that changes the process around it", whole),
        ("accident", "A lag that meets with an accident where the environment says", whole),
    ):
        yield make_fmu(
            lag_description(name, description),
            (*LAG, SOURCES / f"{name}.c"),
            capabilities=capabilities,
            libraries=("-pthread",) if name == "starts_thread" else (),
            documents={"resources/README.txt": b"steps.txt appears here.\n"}
            if name == "writes_file"
            else None,
        )
    yield make_fmu(
        lag_description("missing_library", "A lag whose binary cannot be loaded"),
        (*LAG, SOURCES / "missing_library.c"),
        capabilities=whole,
        absent_library="doublestep_absent",
    )
    plain = (*LAG, SOURCES / "plain_lag.c")
    yield make_fmu(
        lag_description("plain_lag", "A lag with nothing special"), plain, capabilities=whole
    )
    yield make_fmu(
        lag_description("execution_tool", "A lag that needs the tool that it comes from"),
        plain,
        capabilities=replace(whole, needs_execution_tool=True),
    )
    yield from _fixed_steps()
    yield from _ends()
    yield from _derivatives()
    yield from _states()


SLOPES = {
    "slopes_nan_at_first": ("NAN_AT_FIRST", "is NaN before the first step"),
    "slopes_nan": ("NAN_ALWAYS", "is NaN at any time"),
    "slopes_infinite": ("INFINITE_CONSTANT", "is right, and that of its constant is infinite"),
    "slopes_thousandfold": ("THOUSANDFOLD", "is a thousand times too large"),
    "slopes_differences": ("DIFFERENCE", "is the difference over the last step"),
    "slopes_noise": ("WITH_NOISE", "is another one each time it is read"),
}


def _derivatives() -> Iterator[Fmu]:
    constant = Variable("c", LAG_REFERENCES, "output", depends=(), description="A constant, 3")
    for name, (macro, what) in SLOPES.items():
        yield make_fmu(
            replace(
                lag_description(name, f"A lag whose output derivative {what}"),
                variables=(*lag_variables(), constant),
            ),
            (*LAG, SOURCES / "slopes.c"),
            capabilities=LAG_CAPABILITIES,
            definitions={"SLOPE": macro},
        )
    for name, description, orders, used, most in (
        ("second_order", "A lag that takes input derivatives up to order 2", 2, 2, ""),
        ("ignores_second_order", "A lag that makes use of those of order 1 only", 3, 1, ""),
        ("ignores_derivatives", "A lag that makes no use of input derivatives", 3, 0, ""),
        ("counts_inputs", "A lag that takes one input derivative in a call", 2, 2, "1"),
    ):
        yield make_fmu(
            lag_description(name, description),
            (*LAG, SOURCES / "some_orders.c"),
            capabilities=Capabilities(input_derivatives=orders, output_derivatives=1),
            definitions={"USED_ORDER": str(used)} | ({"MOST_DERIVATIVES": most} if most else {}),
        )


def _states() -> Iterator[Fmu]:
    clocks = (
        Variable("cpu_time", LAG_REFERENCES, "output", unit="s", depends=()),
        Variable("steps", LAG_REFERENCES + 1, "output", depends=()),
        Variable("number", LAG_REFERENCES + 2, "output", "Int32", depends=()),
    )
    for name, saved_states in (("clocks", True), ("clocks_no_state", False)):
        yield make_fmu(
            replace(
                lag_description(name, "A lag with outputs that are clocks and counters"),
                variables=(*lag_variables(), *clocks),
            ),
            (*LAG, SOURCES / "clocks.c"),
            capabilities=replace(LAG_CAPABILITIES, saved_states=saved_states),
        )
    yield make_fmu(
        lag_description("loses_state", "A lag behind another one that is not saved"),
        (*LAG, SOURCES / "loses_state.c"),
        capabilities=Capabilities(),
    )
    yield make_fmu(
        replace(
            lag_description("saturated_controller", "A controller of single Euler steps"),
            variables=(
                Variable("u", 0, "input", start="0"),
                Variable("y", 1, "output", depends=()),
                Variable("T", 2, "parameter", start="0.002", unit="s"),
                Variable("gain", LAG_REFERENCES, "parameter", start="10"),
            ),
        ),
        (*LAG, SOURCES / "saturated_controller.c"),
        capabilities=Capabilities(),
    )
    for name, version, macro, what in (
        ("reset_keeps_fmi1", 1, "RESET_KEEPS_STATE", "is as it was before"),
        ("reset_keeps_state", 2, "RESET_KEEPS_STATE", "is as it was before"),
        ("reset_spoils_fmi1", 1, "RESET_SPOILS", "is of no use"),
    ):
        yield make_fmu(
            lag_description(name, f"A lag that {what} after a reset"),
            (*LAG, SOURCES / "plain_lag.c"),
            version=version,
            capabilities=Capabilities(saved_states=False),
            definitions={"RESET": macro},
        )


def _fixed_steps() -> Iterator[Fmu]:
    fixed = Capabilities(variable_steps=False)
    sources = (*LAG, SOURCES / "fixed_step.c")
    yield make_fmu(
        lag_description("fixed_step", "A lag with communication steps of 10 ms"),
        sources,
        capabilities=fixed,
    )
    yield make_fmu(
        lag_description("fixed_step_fmi3", "A lag with equal steps, multiples of 10 ms"),
        sources,
        version=3,
        capabilities=replace(fixed, fixed_internal_step_size="0.01"),
        definitions={"ANY_MULTIPLE": "1"},
    )


def _ends() -> Iterator[Fmu]:
    sources = (*LAG, SOURCES / "terminates.c")
    yield make_fmu(
        lag_description("terminates2", "A lag that wants to end at 0.5 s"),
        sources,
        capabilities=LAG_CAPABILITIES,
        definitions={"SHORTENS": "1"},
    )
    yield make_fmu(
        lag_description("terminates3", "A lag that wants to end at 0.5 s"),
        sources,
        version=3,
        capabilities=Capabilities(output_derivatives=1),
    )
    for version in (1, 2, 3):
        yield make_fmu(
            lag_description(f"warns{version}", "A lag that warns from 0.5 s on"),
            (*LAG, SOURCES / "warns.c"),
            version=version,
            capabilities=Capabilities(saved_states=version > 1),
        )
    stairs = (
        ("event_mode3", None),
        ("rounds_events3", {"ROUNDS_EVENTS": "1"}),
        ("loses_indicators3", {"LOSES_INDICATORS": "1"}),
    )
    for name, definitions in stairs:
        yield make_fmu(
            Description(
                name=name,
                description="A staircase with a step every 0.35 s, and a lag that follows it",
                variables=(
                    Variable("level", LAG_REFERENCES, "output", "Int32", depends=()),
                    *lag_variables()[1:],
                ),
                units=(SECOND,),
                experiment=EXPERIMENT,
            ),
            (*LAG, SOURCES / "event_mode.c"),
            version=3,
            capabilities=Capabilities(event_mode=True, returns_early=True),
            definitions=definitions,
        )


# ---- Many variables, units, loops ---------------------------------------------------------------


def many_variables() -> Iterator[Fmu]:
    """Lags side by side, 10 and 5000 of them."""
    for name, count in (("few_variables", 10), ("many_variables", 5000)):
        inputs = [Variable(f"u[{i + 1}]", i, "input", start="0") for i in range(count)]
        outputs = [
            Variable(f"y[{i + 1}]", 10000 + i, "output", initial="exact", start="0", depends=())
            for i in range(count)
        ]
        yield make_fmu(
            Description(
                name=name,
                description=f"{count} lags with a time constant of 1 s",
                variables=(*inputs, *outputs),
                experiment=EXPERIMENT,
            ),
            (SOURCES / "many_variables.c",),
            capabilities=LAG_CAPABILITIES,
            definitions={"VARIABLES": str(count)},
        )


def units() -> Iterator[Fmu]:
    """A length and a temperature, in one unit and in another."""
    metre, kelvin = Unit("m", {"m": "1"}), Unit("K", {"K": "1"})
    millimetre = Unit("mm", {"m": "1", "factor": "0.001"})
    degree = Unit("degC", {"K": "1", "offset": "273.15"})
    for name, length, temperature, start in (
        ("units_metres", metre, kelvin, "273.15"),
        ("units_millimetres", millimetre, degree, "0"),
    ):
        yield make_fmu(
            Description(
                name=name,
                description=f"Two lags, in {length.name} and in {temperature.name}",
                variables=(
                    *lag_variables(unit=length.name),
                    *lag_variables(
                        u="theta_in",
                        y="theta_out",
                        offset=LAG_REFERENCES,
                        unit=temperature.name,
                        prefix="theta_",
                        start=start,
                        x_start=start,
                    ),
                ),
                units=(SECOND, length, temperature),
                experiment=EXPERIMENT,
            ),
            (*LAG, SOURCES / "two_lags.c"),
            capabilities=LAG_CAPABILITIES,
            definitions={"SECOND_START": start},
        )


def loops() -> Iterator[Fmu]:
    """Direct feed-through both ways."""
    for name, a, b in (("loop_a", "0.5", "1"), ("loop_b", "-0.8", "2")):
        yield make_fmu(
            Description(
                name=name,
                description="y = a u + b + c sin(u)",
                variables=(
                    Variable("u", 0, "input", start="0"),
                    Variable("y", 1, "output", depends=("u",)),
                    Variable("a", 2, "parameter", start=a),
                    Variable("b", 3, "parameter", start=b),
                    Variable("c", 4, "parameter", start="0"),
                ),
                experiment=EXPERIMENT,
            ),
            (SOURCES / "loop.c",),
            capabilities=LAG_CAPABILITIES,
            definitions={"START_A": a, "START_B": b},
        )


# ---- Bouncing ball ------------------------------------------------------------------------------


def bouncing_ball() -> Iterator[Fmu]:
    """Model exchange with a state event."""
    for name, version in (("bouncing_ball_me2", 2), ("bouncing_ball_me3", 3)):
        reinit = {"reinit": "true"}
        yield make_fmu(
            Description(
                name=name,
                description="A ball that bounces and comes to rest",
                variables=(
                    Variable(
                        "h",
                        0,
                        "output",
                        start="1",
                        initial="exact",
                        unit="m",
                        depends=("h",),
                        extra=reinit,
                    ),
                    Variable(
                        "v",
                        1,
                        "output",
                        start="0",
                        initial="exact",
                        unit="m/s",
                        depends=("v",),
                        extra=reinit,
                    ),
                    Variable("der(h)", 2, "local", unit="m/s", derivative="h", depends=("v",)),
                    Variable("der(v)", 3, "local", unit="m/s2", derivative="v", depends=("g",)),
                    Variable("g", 4, "parameter", start="9.81", unit="m/s2"),
                    Variable("e", 5, "parameter", start="0.7"),
                    Variable("z", 6, "local", unit="m", depends=("h",)),
                    Variable("bounces", 7, "output", "Int32", depends=()),
                ),
                units=(
                    Unit("m", {"m": "1"}),
                    Unit("m/s", {"m": "1", "s": "-1"}),
                    Unit("m/s2", {"m": "1", "s": "-2"}),
                ),
                experiment=EXPERIMENT | {"stopTime": "4"},
                event_indicators=("z",),
            ),
            (SOURCES / "bouncing_ball.c",),
            version=version,
            kind="ModelExchange",
        )


def relay() -> Fmu:
    """Model exchange with state events from an input, and without states."""
    return make_fmu(
        Description(
            name="relay_me2",
            description="A relay with hysteresis that switches strictly beyond its limits",
            variables=(
                Variable("u", 0, "input", start="293.15"),
                Variable("low", 1, "parameter", start="292.15"),
                Variable("high", 2, "parameter", start="294.15"),
                Variable("is_on", 5, "output", "Boolean", depends=()),
                Variable("changes", 6, "output", "Int32", depends=()),
            ),
            experiment=EXPERIMENT,
            event_indicators=("u - low", "u - high"),
        ),
        (SOURCES / "relay.c",),
        version=2,
        kind="ModelExchange",
    )


# ---- All types ----------------------------------------------------------------------------------

COLOURS = ("Colour", ("red", "green", "blue"))
OUT = 100
"""Offset of the value references of outputs."""


def all_types2() -> Fmu:
    """Every type of FMI 2.0."""
    pairs = (
        Variable("real_continuous", 0, "", start="0"),
        Variable("real_discrete", 1, "", start="0", variability="discrete"),
        Variable("integer", 2, "", "Int32", start="0"),
        Variable("boolean", 3, "", "Boolean", start="false"),
        Variable("string", 4, "", "String", start=""),
        Variable("enumeration", 5, "", "Enumeration", start="1", declared_type="Colour"),
    )
    return make_fmu(
        Description(
            name="all_types2",
            description="Inputs and outputs of every type",
            variables=(
                *_inputs_and_outputs(pairs, state="real_continuous"),
                Variable("counter_out", 106, "output", "Int32", depends=()),
                Variable("toggle_out", 107, "output", "Boolean", depends=()),
            ),
            enumerations=(COLOURS,),
            experiment=EXPERIMENT,
        ),
        (SOURCES / "all_types2.c",),
    )


def all_types3() -> Fmu:
    """Every type of FMI 3.0; value references as in src/all_types3.c."""
    numbers = ("Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64")
    pairs = (
        Variable("float32", 0, "", "Float32", start="0"),
        Variable("float64", 1, "", start="0"),
        *(Variable(kind.lower(), i, "", kind, start="0") for i, kind in enumerate(numbers, 2)),
        Variable("boolean", 10, "", "Boolean", start="false"),
        Variable("string", 11, "", "String", start=""),
        Variable("binary", 12, "", "Binary", start=""),
        Variable("enumeration", 14, "", "Enumeration", start="1", declared_type="Colour"),
        Variable("matrix", 50, "", start="0 0 0 0 0 0", dimensions=(2, 3)),
        Variable("vector", 51, "", start="0 0 0", dimensions=("n",)),
    )
    return make_fmu(
        Description(
            name="all_types3",
            description="Inputs and outputs of every type, arrays and a clock",
            variables=(
                Variable("n", 60, "structuralParameter", "UInt64", start="3", extra={"max": "16"}),
                *_inputs_and_outputs(pairs, state="float64"),
                Variable(
                    "clock",
                    OUT + 13,
                    "output",
                    "Clock",
                    extra={"intervalVariability": "triggered"},
                ),
            ),
            enumerations=(COLOURS,),
            experiment=EXPERIMENT,
        ),
        (SOURCES / "all_types3.c",),
        version=3,
    )


# ---- Drives -------------------------------------------------------------------------------------

MODES = ("Mode", {"reverse": -1, "neutral": 0, "forward": 1, "fast": 5})


def drives() -> Iterator[Fmu]:
    """Variables of every causality: tunable, local and calculated ones, with bounds and items."""
    variables = (
        Variable("u", 0, "input", start="0"),
        Variable(
            "gain",
            1,
            "parameter",
            start="1",
            variability="tunable",
            extra={"min": "0", "max": "10"},
        ),
        Variable("y", 2, "output", start="0", initial="exact", depends=()),
        Variable("flow", 3, "local", derivative="y", depends=("u",)),
        Variable("s", 4, "local", start="0", initial="exact"),
        Variable("der(s)", 5, "local", derivative="s", depends=("y",)),
        Variable("total", 6, "calculatedParameter", variability="tunable"),
        Variable("ratio", 7, "local"),
        Variable(
            "mode",
            10,
            "parameter",
            "Enumeration",
            start="1",
            variability="tunable",
            declared_type="Mode",
        ),
        Variable("n", 11, "parameter", "Int32", start="3", extra={"min": "1", "max": "8"}),
        Variable("is_moving", 12, "local", "Boolean", variability="discrete"),
        Variable("label", 13, "local", "String", variability="discrete"),
    )
    for version in (1, 2, 3):
        without = ("mode", "total") if version == 1 else ()  # FMI 1.0 has none like these
        yield make_fmu(
            Description(
                name=f"drive{version}",
                description="Tunable, local and calculated variables, with bounds and items",
                variables=tuple(v for v in variables if v.name not in without),
                enumerations=(MODES,),
                experiment=EXPERIMENT,
            ),
            (SOURCES / "drive.c",),
            version=version,
            capabilities=Capabilities(saved_states=version > 1, event_mode=version == 3),
            definitions={"MODE_TYPE": "INT64", "MODE_C": "int64_t"} if version == 3 else {},
        )


def _inputs_and_outputs(pairs: tuple[Variable, ...], state: str) -> Iterator[Variable]:
    for pair in pairs:
        yield replace(pair, name=f"{pair.name}_in", causality="input")
    for pair in pairs:
        yield replace(
            pair,
            name=f"{pair.name}_out",
            causality="output",
            reference=pair.reference + OUT,
            start=None,
            depends=() if pair.name == state else (f"{pair.name}_in",),
        )


FMUS = (
    *quarter_car(),
    *lags(),
    *many_variables(),
    *units(),
    *loops(),
    *bouncing_ball(),
    relay(),
    all_types2(),
    all_types3(),
    *drives(),
)
"""All FMUs, in the order of the README."""
