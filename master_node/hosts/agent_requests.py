"""Requests to agents."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from protocol.bus.bus import Bus
from protocol.wire.agents import AgentStatus, Record
from protocol.wire.keys import AgentKey
from protocol.wire.records import decode_record, encode_record

_R = TypeVar("_R", bound=Record)


@dataclass(frozen=True)
class SeenAgent:
    """An agent on the bus and what it said of itself.

    Attributes:
        key: its address.
        status: when it was asked.
    """

    key: AgentKey
    status: AgentStatus


def ask_agent(
    bus: Bus, key: AgentKey, verb: str, record: Record, answer: type[_R], *, timeout: float
) -> _R:
    """One request to an agent.

    Args:
        bus: opened.
        key: of the agent.
        verb: of the request.
        record: its fields.
        answer: of what class the answer is.
        timeout: bound on the wait [s].

    Raises:
        SlaveLostError, DeadlineError: it does not answer.
        DoublestepError: what it answered, if that is an error, or is malformed.
    """
    reply = bus.caller(key.verb(verb), timeout).request(encode_record(record))
    return decode_record(answer, reply)
