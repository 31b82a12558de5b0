"""Costs of saved states, and the switches of exporters that make them cheap."""

from __future__ import annotations

from statistics import median

from master_node.checking.report import StateCosts
from master_node.preparing.readiness import Ready
from protocol.calls import FreeState, GetState, SetState
from protocol.description import StateKind
from protocol.errors import FatalSlaveError, SlaveCrashedError

_TIMES = 3
_NUMBER = 0


def state_costs(ready: Ready) -> dict[str, StateCosts]:
    """Costs of a saved state of each slave that saves any, by its own clock at T_0.

    Raises:
        DoublestepError: a slave was lost, or must not be called any more.
    """
    start = float(ready.prepared.system.simulation.start_time)
    found = {}
    for index, part in enumerate(ready.coupled.parts):
        if part.description.state_kind is StateKind.NONE:
            continue
        times: list[list[float]] = []
        refusal = ""
        for _ in range(_TIMES):
            taken = []
            for call in (GetState(_NUMBER), SetState(_NUMBER), FreeState(_NUMBER)):
                (reply,) = ready.group.execute([(call,)], start, slaves=[index])
                if isinstance(reply.error, FatalSlaveError | SlaveCrashedError):
                    raise reply.error
                if reply.error is not None:
                    refusal = f"{reply.error.phase}: {reply.error.cause}"
                    break
                taken.append(reply.compute_time)
            if refusal:
                break
            times.append(taken)
        found[part.name] = (
            StateCosts(refusal=refusal)
            if refusal
            else StateCosts(*(median(column) for column in zip(*times, strict=True)))
        )
    return found


_SWITCHES = {
    "pythonfmu3": "build it anew with `pythonfmu3 build --handle-state`",
    "pythonfmu": "build it anew with `pythonfmu build --handle-state`",
}
"""Remedies by the beginnings of generation tools, in lower case, longer ones first."""


def state_remedy(generation_tool: str) -> str:
    """Switch by which an exporter makes models that save their states; "": none is known."""
    tool = generation_tool.lower().replace(" ", "")
    return next((text for name, text in _SWITCHES.items() if tool.startswith(name)), "")
