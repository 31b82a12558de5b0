"""Messages between masters and agents: messages of ``doublestep/agents/...``.

An agent starts slaves on its host. All these records travel as maps of their fields
(`protocol.wire.records.encode_record`), which also hold the protocol version.
"""

from __future__ import annotations

import math
import re
from collections.abc import Container, Mapping
from dataclasses import dataclass
from typing import Final

from protocol.errors import MalformedMessageError
from protocol.wire.administration import DEFAULT_LOAD_TIMEOUT, MAX_ORPHAN_TIME
from protocol.wire.keys import check_name

CHUNK_BYTES: Final = 2**20
"""Length of all pieces of an upload but the last."""

AGENT_MESSAGE_BYTES: Final = 2 * CHUNK_BYTES
"""Length of the largest message to an agent: a piece of an upload and what is around it."""

LICENCE: Final = "licence"
"""The label whose values can be counted."""

_SHA256 = re.compile(r"[0-9a-f]{64}")


def is_sha256(text: str) -> bool:
    """True if ``text`` is a SHA-256 in lower-case hexadecimal digits."""
    return _SHA256.fullmatch(text) is not None


@dataclass(frozen=True, slots=True)
class Licence:
    """A counted licence of an agent.

    Attributes:
        name: the value that ``requires = { licence = ... }`` asks for.
        total: how many slaves may hold it at once.
        holders: slaves that hold it now, in words.
    """

    name: str
    total: int
    holders: tuple[str, ...]

    @property
    def free(self) -> int:
        """Number of further slaves that may hold it."""
        return max(0, self.total - len(self.holders))


@dataclass(frozen=True, slots=True)
class AgentSlave:
    """A slave that an agent started and that runs.

    Attributes:
        name, instance: its address.
        pid: its process.
        run: id of the run for which it was started.
        model: as in the request.
    """

    name: str
    instance: str
    pid: int
    run: str
    model: str


@dataclass(frozen=True, slots=True)
class AgentStatus:
    """Status of an agent. Times are seconds since 1970, by its own clock.

    Attributes:
        name, instance: its address.
        host, pid: its process.
        labels: what it says of its host.
        licences: that are counted.
        models: how many models it has, uploaded ones too.
        upload_limit: length of the largest model that it takes [bytes]; 0: it takes none.
        python: whether it starts Python models.
        slaves: that it started and that run.
        since: when it began to serve [s].
        time: when it said this [s]; only good for comparing clocks.
    """

    name: str
    instance: str
    host: str
    pid: int
    labels: Mapping[str, str]
    licences: tuple[Licence, ...]
    models: int
    upload_limit: int
    python: bool
    slaves: tuple[AgentSlave, ...]
    since: float
    time: float

    def free(self, licence: str) -> float:
        """Number of further slaves that may hold ``licence``, infinity where it is not counted."""
        counted = [known.free for known in self.licences if known.name == licence]
        return counted[0] if counted else math.inf

    def lacks(self, requires: Mapping[str, str]) -> list[str]:
        """Part of ``requires`` that it has not, as ``name = value``; all licences may be taken."""
        missing = lacking(requires, self.labels, {licence.name for licence in self.licences})
        return [f"{name} = {value}" for name, value in missing.items()]


@dataclass(frozen=True, slots=True)
class AgentModel:
    """A model that an agent can load.

    Attributes:
        name: of its file or folder, without the folders above; empty for one that was uploaded.
        sha256: of its file, or of the archive that its folder is packed into.
        size: of the same [bytes].
    """

    name: str
    sha256: str
    size: int


@dataclass(frozen=True, slots=True)
class ModelList:
    """The models of an agent."""

    models: tuple[AgentModel, ...]


@dataclass(frozen=True, slots=True)
class Upload:
    """A piece of a model's file.

    Attributes:
        sha256: of the whole file.
        size: of the whole file [bytes].
        offset: where the piece belongs, a multiple of ``CHUNK_BYTES``.
        data: ``CHUNK_BYTES`` bytes, fewer at the end of the file; empty: only ask how much is
            there.

    Raises:
        MalformedMessageError: not a piece of such a file.
    """

    sha256: str
    size: int
    offset: int
    data: bytes

    def __post_init__(self) -> None:
        if not is_sha256(self.sha256):
            raise MalformedMessageError(
                f"{self.sha256!r:.80} is not a SHA-256 in lower-case hexadecimal digits"
            )
        length = min(CHUNK_BYTES, self.size - self.offset)
        if self.size <= 0 or self.offset % CHUNK_BYTES or length < 0:
            raise MalformedMessageError(
                f"there is no piece at {self.offset} of a file of {self.size} bytes"
            )
        if self.data and len(self.data) != length:
            raise MalformedMessageError(
                f"the piece at {self.offset} must have {length} bytes, not {len(self.data)}"
            )


@dataclass(frozen=True, slots=True)
class UploadState:
    """State of an upload.

    Attributes:
        received: length of what is there, from the beginning [bytes].
        complete: whether the model can be started.
    """

    received: int
    complete: bool


@dataclass(frozen=True, slots=True)
class StartSlave:
    """A master wants a slave.

    Attributes:
        run, host, pid, orphan_time: as in `protocol.wire.administration.Claim`; the slave is ended
            when that run has ended or its master has been gone for ``orphan_time`` [s].
        slave: its name.
        model: name of a file that the agent has, without folders, or the SHA-256 of one; for a
            Python model ``package.module:Class`` or ``file.py:Class``.
        requires: labels that the agent must have; a counted licence is taken.
        restart: how often the run has started this slave before. What an agent has started for a
            smaller number is ended.
        load_timeout: its model may take to be loaded or reset [s].

    Raises:
        ConfigurationError: a name is not valid.
        MalformedMessageError: ``orphan_time``, ``restart`` or ``load_timeout`` is out of range.
    """

    run: str
    host: str
    pid: int
    orphan_time: float
    slave: str
    model: str
    requires: Mapping[str, str]
    restart: int = 0
    load_timeout: float = DEFAULT_LOAD_TIMEOUT

    def __post_init__(self) -> None:
        check_name(self.run, "run id")
        check_name(self.slave)
        if self.restart < 0:
            raise MalformedMessageError("restart must not be negative")
        if not 0.0 <= self.orphan_time <= MAX_ORPHAN_TIME:  # NaN is not
            raise MalformedMessageError(f"orphan_time must be from 0 to {MAX_ORPHAN_TIME:g} s")
        if not 0.0 < self.load_timeout < math.inf:
            raise MalformedMessageError("load_timeout must be positive")
        for name, value in self.requires.items():
            check_label(name, value)


@dataclass(frozen=True, slots=True)
class SlaveStarted:
    """Its address and process; it is on the bus when its model is loaded."""

    instance: str
    pid: int


@dataclass(frozen=True, slots=True)
class StopRun:
    """End all slaves that were started for a run, and forget them."""

    run: str


@dataclass(frozen=True, slots=True)
class OutputRequest:
    """Output of a slave that was started."""

    run: str
    slave: str


@dataclass(frozen=True, slots=True)
class SlaveOutput:
    """Output of a slave.

    Attributes:
        exit_code: of its process, negative for a signal; None while it runs.
        lines: the last that it said.
        log: path of all that it said, on the agent's host; empty when it is not kept.
    """

    exit_code: int | None
    lines: tuple[str, ...]
    log: str


@dataclass(frozen=True, slots=True)
class Done:
    """Nothing more to say."""


Record = (
    AgentStatus
    | ModelList
    | Upload
    | UploadState
    | StartSlave
    | SlaveStarted
    | StopRun
    | OutputRequest
    | SlaveOutput
    | Done
)


def lacking(
    requires: Mapping[str, str], labels: Mapping[str, str], licences: Container[str]
) -> dict[str, str]:
    """Part of ``requires`` that an agent with these labels and counted licences has not."""
    return {
        name: value
        for name, value in requires.items()
        if labels.get(name) != value and not (name == LICENCE and value in licences)
    }


def check_label(name: str, value: str) -> None:
    """Check a label ``name = value``.

    Raises:
        ConfigurationError: one of the two is not a valid name.
    """
    check_name(name, "label")
    check_name(value, f"value of the label {name}")
