"""Diagnosis of a bus: problems and their remedies."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from time import monotonic

from rich.table import Table

from master_node.survey.participants import Participant, Timing, measure, survey
from master_node.survey.windows import Window
from protocol.errors import SlaveLostError, VersionError
from protocol.host.tables import plain
from protocol.wire.administration import MasterStatus, RouterStatus, SlaveStatus
from protocol.wire.agents import AgentStatus
from protocol.wire.keys import AgentKey, MasterKey, SlaveKey

_ROUNDS = 20
_TIME_OF_ONE = 3.0
_TIME = 20.0
_CLOCK_DIFFERENCE = 5.0


@dataclass(frozen=True)
class Problem:
    """Something that keeps a run from working.

    Attributes:
        where: an address or a participant.
        cause, remedy: sentences.
    """

    where: str
    cause: str
    remedy: str


@dataclass(frozen=True)
class Diagnosis:
    """Diagnosis of the bus.

    Attributes:
        windows: where was looked.
        timings: who was seen, with the times of status queries.
        problems: that need something done.
    """

    windows: Sequence[Window]
    timings: Sequence[tuple[Participant, Timing]]
    problems: Sequence[Problem]

    def tables(self) -> list[Table]:
        """For people."""
        ways = Table("address", "result", title="Connections", title_justify="left")
        for window in self.windows:
            result = "listening" if window.listens else "connected"
            failure = window.failure
            ways.add_row(
                plain(window.endpoint), plain(result if failure is None else failure.cause)
            )
        there = Table(title="Participants", title_justify="left")
        for column in ("name", "host / pid", "answers", "round trip", "clock", "state"):
            there.add_column(column, overflow="fold")
        for participant, timing in self.timings:
            status = participant.status
            there.add_row(
                plain(described(participant)),
                plain("-" if status is None else f"{status.host} / {status.pid}"),
                f"{len(timing.round_trips)} of {timing.asked}",
                _milliseconds(timing.median),
                _milliseconds(timing.clock_difference, signed=True),
                plain(_state(participant)),
            )
        return [ways, there]


def diagnose(windows: Sequence[Window]) -> Diagnosis:
    """Look through all windows, ask everybody, and judge."""
    problems = [
        Problem(window.endpoint, window.failure.cause, window.failure.remedy)
        for window in windows
        if window.failure is not None
    ]
    participants = survey([window.bus for window in windows if window.bus is not None])
    end = monotonic() + _TIME
    timings = [
        (
            p,
            measure(
                p, _ROUNDS if p.status is not None else 0, min(_TIME_OF_ONE, end - monotonic())
            ),
        )
        for p in participants
    ]
    for participant, timing in timings:
        problems += _problems_of(participant, timing)
    problems += _duplicates(participants)
    if not any(isinstance(p.key, SlaveKey | AgentKey) for p in participants):
        problems.append(
            Problem(
                "bus",
                "no slave is in sight",
                "start one with `slave-node serve MODEL`; slaves that connect to a master are seen "
                "with --listen ADDRESS while that master does not run, or through a router",
            )
        )
    return Diagnosis(windows, timings, problems)


def described(participant: Participant) -> str:
    """Kind and name."""
    key = participant.key
    if isinstance(key, SlaveKey):
        return f"slave {key.name}"
    if isinstance(key, AgentKey):
        return f"agent {key.name}"
    return f"run {key.run}" if isinstance(key, MasterKey) else f"router {key.instance}"


def _problems_of(participant: Participant, timing: Timing) -> list[Problem]:
    where, failure = described(participant), participant.failure
    if isinstance(failure, VersionError):
        return [Problem(where, failure.cause, "install one version of Doublestep everywhere")]
    if isinstance(failure, SlaveLostError):
        return [
            Problem(
                where,
                "it is there but does not let us ask",
                "use a certificate of role master, and the same --tls authority everywhere",
            )
        ]
    if failure is not None:
        return [Problem(where, f"no usable answer: {failure.cause}", "see its log, or restart it")]
    problems = []
    if not timing.asked:
        problems.append(Problem(where, "there was no time left to ask it", "ask again for fewer"))
    elif lost := timing.asked - len(timing.round_trips):
        cause = f"{lost} of {timing.asked} queries were not answered"
        problems.append(Problem(where, cause, "look at the network"))
    if timing.round_trips and not abs(timing.clock_difference) <= _CLOCK_DIFFERENCE:
        problems.append(
            Problem(
                where,
                f"its clock is {timing.clock_difference:+.1f} s off ours",
                "set the clocks: certificates and logs depend on them, results do not",
            )
        )
    return problems


def _duplicates(participants: Sequence[Participant]) -> list[Problem]:
    named = Counter(
        described(p)
        for p in participants
        if isinstance(p.key, AgentKey) or (isinstance(p.key, SlaveKey) and not p.key.is_of_run)
    )
    return [
        Problem(who, f"there are {count} of this name", "end all but one of them")
        for who, count in sorted(named.items())
        if count > 1
    ]


def _state(participant: Participant) -> str:
    match participant.status:
        case SlaveStatus() as slave:
            held = "free" if slave.holder is None else f"held by {slave.holder}"
            return held if slave.worker == "alive" else f"{held}, worker {slave.worker}"
        case AgentStatus() as agent:
            return f"agent with {agent.models} models, {len(agent.slaves)} slaves run"
        case MasterStatus() as master:
            return f"runs {master.system}"
        case RouterStatus() as router:
            return router.endpoints
    return "" if participant.failure is None else participant.failure.cause


def _milliseconds(seconds: float, *, signed: bool = False) -> str:
    if math.isnan(seconds):
        return "-"
    return f"{seconds * 1e3:{'+' if signed else ''}.1f} ms"
