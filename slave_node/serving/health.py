"""Health of a slave, agent or router, told by its liveliness token: for service managers."""

from __future__ import annotations

from protocol.bus.bus import Bus
from protocol.errors import SlaveLostError
from protocol.text.names import some
from protocol.wire.keys import AgentKey, SlaveKey, alive_agents, alive_routers, alive_slaves

_TOKEN_TIME = 1.0


def check_alive(bus: Bus, name: str, *, agent: bool = False) -> None:
    """Look for the token of the slave called ``name``, or of any router where it is empty.

    Args:
        bus: connected to the router, or to the slave or agent itself.
        name: of the slave or agent, or "".
        agent: look for an agent.

    Raises:
        SlaveLostError: the token is not there: its owner has not begun to serve, or is gone.
    """
    alive_named, kind = (alive_agents, "agent") if agent else (alive_slaves, "slave")
    if bus.alive(alive_named(name) if name else alive_routers(), _TOKEN_TIME):
        return
    if not name:
        raise SlaveLostError("no router is on the bus", phase="check")
    from_alive = AgentKey.from_alive if agent else SlaveKey.from_alive
    keys = map(from_alive, bus.alive(alive_named("*"), _TOKEN_TIME))
    there = some(sorted({key.name for key in keys if key is not None}))
    raise SlaveLostError(
        f"is not on the bus; found there: {there or f'no {kind} at all'}",
        slave=name,
        phase="check",
    )
