"""The life cycle of a slave as one table: {state: {call: next state}}.

It follows the co-simulation state machine of FMI 2.0 (section 4.2.4). What is not in the table
is refused with a `LifeCycleError` before the slave sees it. Besides the table, a `DoStep` that does
not reach its end leads to ``STEP_FAILED``, a failed call to ``ERROR``, and fmi2Fatal to ``FATAL``.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from protocol.calls import (
    Call,
    Configure,
    Describe,
    DeserializeState,
    DoStep,
    Examine,
    ExitInitializationMode,
    FreeState,
    GetDiscreteOutputs,
    GetOutputs,
    GetRecordedVariables,
    GetState,
    Initialize,
    Reset,
    SerializeState,
    SetDiscreteInputs,
    SetInputs,
    SetState,
    SetValues,
    Terminate,
)
from protocol.errors import LifeCycleError


class LifeCycleState(StrEnum):
    """Where a slave stands."""

    INSTANTIATED = "instantiated"
    INITIALIZATION_MODE = "initialization mode"
    STEP_COMPLETE = "step complete"
    STEP_FAILED = "step failed"
    ERROR = "error"
    FATAL = "fatal"
    TERMINATED = "terminated"


_I = LifeCycleState.INSTANTIATED
_M = LifeCycleState.INITIALIZATION_MODE
_C = LifeCycleState.STEP_COMPLETE
_F = LifeCycleState.STEP_FAILED
_E = LifeCycleState.ERROR
_X = LifeCycleState.FATAL
_T = LifeCycleState.TERMINATED

LIFE_CYCLE: Mapping[LifeCycleState, Mapping[type[Call], LifeCycleState]] = {
    _I: {Describe: _I, Configure: _I, Initialize: _M, Reset: _I},
    _M: {
        Describe: _M,
        SetInputs: _M,
        SetDiscreteInputs: _M,
        GetOutputs: _M,
        GetDiscreteOutputs: _M,
        GetRecordedVariables: _M,
        ExitInitializationMode: _C,
        Reset: _I,
    },
    _C: {
        Describe: _C,
        Examine: _C,
        SetInputs: _C,
        SetDiscreteInputs: _C,
        SetValues: _C,
        DoStep: _C,
        GetOutputs: _C,
        GetDiscreteOutputs: _C,
        GetRecordedVariables: _C,
        GetState: _C,
        SetState: _C,
        FreeState: _C,
        SerializeState: _C,
        DeserializeState: _C,
        Terminate: _T,
        Reset: _I,
    },
    _F: {
        Describe: _F,
        GetOutputs: _F,
        GetDiscreteOutputs: _F,
        GetRecordedVariables: _F,
        SetState: _C,
        FreeState: _F,
        SerializeState: _F,
        Terminate: _T,
        Reset: _I,
    },
    _E: {Describe: _E, SetState: _C, FreeState: _E, Reset: _I},
    _X: {Describe: _X},
    _T: {
        Describe: _T,
        GetOutputs: _T,
        GetDiscreteOutputs: _T,
        GetRecordedVariables: _T,
        SetState: _C,
        FreeState: _T,
        SerializeState: _T,
        Reset: _I,
    },
}


def refusal(state: LifeCycleState, call: type[Call]) -> LifeCycleError:
    """The error for a ``call`` that ``state`` does not allow; nothing was done."""
    verbs = ", ".join(sorted(c.verb for c in LIFE_CYCLE[state]))
    return LifeCycleError(f"not allowed in state '{state}', which allows {verbs}", phase=call.verb)
