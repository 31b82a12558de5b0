"""Tables of ``master-node list``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime

from rich.table import Column, Table

from master_node.survey.participants import Participant
from protocol.host.tables import plain
from protocol.wire.administration import MasterStatus, RouterStatus, SlaveStatus
from protocol.wire.agents import AgentStatus
from protocol.wire.keys import AgentKey, MasterKey, SlaveKey

_SHOWN_SILENT = 20


def listing_tables(participants: Sequence[Participant]) -> list[Table]:
    """Slaves, agents, runs and routers; no table for what there is none of."""
    slaves = _table("Slaves", "name", "host", "model", "kind", "capabilities", "state", "since")
    columns = ("name", "host", "labels", "licences free", "models", "slaves", "since")
    agents = _table("Agents", *columns)
    runs = _table("Runs", "run", "host", "system", "slaves", "since")
    routers = _table("Routers", "host", "addresses", "since")
    silent = _table("No answer", "key", "cause")
    silences = 0
    for participant in participants:
        match participant.status:
            case SlaveStatus() as s:
                held = "" if s.holder is None else f" by {s.holder.partition(' since')[0]}"
                since = _clock(s.since if s.held_since is None else s.held_since)
                row = (s.name, s.host, s.model, s.kind, s.capabilities, s.state + held, since)
                _add(slaves, *row)
            case AgentStatus() as a:
                _add(agents, *_agent_cells(a))
            case MasterStatus() as m:
                _add(runs, m.run, f"{m.host} / {m.pid}", m.system, m.slaves, _clock(m.since))
            case RouterStatus() as r:
                _add(routers, f"{r.host} / {r.pid}", r.endpoints, _clock(r.since))
            case None:
                silences += 1
                if silences <= _SHOWN_SILENT:
                    _add(silent, participant.key.alive, participant.failure)
    if silences > _SHOWN_SILENT:
        _add(silent, f"and {silences - _SHOWN_SILENT} more", "--json shows all")
    return [table for table in (slaves, agents, runs, routers, silent) if table.row_count]


def listing_data(participants: Sequence[Participant]) -> dict[str, list[dict[str, object]]]:
    """Participants as plain data, with times in seconds since 1970."""
    data: dict[str, list[dict[str, object]]] = {
        kind: [] for kind in ("slaves", "agents", "runs", "routers", "silent")
    }
    for participant in participants:
        if participant.status is None:
            data["silent"].append({"key": participant.key.alive, "cause": str(participant.failure)})
        elif isinstance(participant.key, SlaveKey):
            data["slaves"].append(asdict(participant.status))
        elif isinstance(participant.key, AgentKey):
            data["agents"].append(asdict(participant.status))
        elif isinstance(participant.key, MasterKey):
            data["runs"].append(asdict(participant.status))
        else:
            data["routers"].append(asdict(participant.status))
    return data


def _agent_cells(agent: AgentStatus) -> tuple[object, ...]:
    taken = "uploads" if agent.upload_limit else ""
    python = "Python" if agent.python else ""
    return (
        agent.name,
        f"{agent.host} / {agent.pid}",
        ", ".join(f"{name} = {value}" for name, value in agent.labels.items()),
        ", ".join(f"{x.name} {x.free} of {x.total}" for x in agent.licences),
        ", ".join(part for part in (str(agent.models), taken, python) if part),
        ", ".join(f"{slave.name} of run {slave.run}" for slave in agent.slaves),
        _clock(agent.since),
    )


def _table(title: str, *columns: str) -> Table:
    """Whole at any width: a name or a number that is cut off may be another's."""
    cells = (Column(name, overflow="fold") for name in columns)
    return Table(*cells, title=title, title_justify="left")


def _add(table: Table, *cells: object) -> None:
    table.add_row(*map(plain, cells))


def _clock(seconds: float) -> str:
    """A time of day for people; whatever a slave sends is shown."""
    try:
        return datetime.fromtimestamp(seconds).astimezone().isoformat(" ", timespec="seconds")
    except (OverflowError, ValueError, OSError):
        return str(seconds)
