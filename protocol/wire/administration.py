"""Messages beside the calls: the claim of a master, and what participants say of themselves.

All travel as flat maps (`protocol.wire.records.encode_map`), which also hold the protocol version.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from hashlib import sha256
from typing import Any, Final, Self

from protocol.errors import MalformedMessageError
from protocol.text.limits import MAX_HOST
from protocol.variables import StartValue
from protocol.wire.keys import check_name

DEFAULT_ORPHAN_TIME: Final = 15.0
"""Time for which a slave waits for a master that does not say how long [s]."""

DEFAULT_LOAD_TIMEOUT: Final = 120.0
"""Bound on the loading of a model, unless it is said otherwise [s]."""

STATUS_BYTES: Final = 4 * 2**20
"""Length of the largest status that is taken, that of an agent with hundreds of slaves."""

MAX_ORPHAN_TIME: Final = 3600.0
"""A vanished master can keep a slave from others no longer than this [s]."""


@dataclass(frozen=True, slots=True)
class Claim:
    """A master takes a slave for its run.

    Attributes:
        run: id of the run.
        host, pid: the master's process.
        orphan_time: how long the slave waits for a master that vanished [s]; None: as it likes.
        secret: known to this master alone, as everybody can see the id of its run.
    """

    run: str
    host: str
    pid: int
    orphan_time: float | None = None
    secret: str = field(default="", repr=False)

    def to_message(self) -> dict[str, StartValue | None]:
        """Plain data of this value."""
        return {
            "run": self.run,
            "host": self.host,
            "pid": self.pid,
            "orphan_time": self.orphan_time,
            "secret": self.secret,
        }

    @classmethod
    def from_message(cls, message: Mapping[str, StartValue]) -> Self:
        """The claim that ``to_message`` wrote.

        Raises:
            MalformedMessageError: a value is missing or has another type.
            ConfigurationError: the id of the run is not valid.
        """
        run, host, pid = message.get("run"), message.get("host"), message.get("pid")
        secret = message.get("secret", "")
        if not all(type(text) is str for text in (run, host, secret)) or type(pid) is not int:
            raise MalformedMessageError(
                "a claim must hold run, host and secret as texts, and pid as a number"
            )
        orphan_time = _orphan_time(message.get("orphan_time"))
        name = check_name(str(run), "run id")
        return cls(name, check_host(str(host)), pid, orphan_time, str(secret))


@dataclass(frozen=True, slots=True)
class Claimed:
    """A slave says that it was taken.

    Attributes:
        epoch: of all requests of this run.
        host, pid: the slave's process.
    """

    epoch: int
    host: str
    pid: int

    def to_message(self) -> dict[str, StartValue | None]:
        """Status as plain data."""
        return asdict(self)

    @classmethod
    def from_message(cls, message: Mapping[str, StartValue]) -> Self:
        """Value that ``to_message`` wrote.

        Raises:
            MalformedMessageError: a value is missing or has another type.
        """
        epoch, host, pid = (message.get(name) for name in ("epoch", "host", "pid"))
        if type(epoch) is not int or type(host) is not str or type(pid) is not int:
            raise MalformedMessageError(
                "the answer to a claim must hold epoch and pid as numbers, and host as a text"
            )
        return cls(epoch, check_host(host), pid)


def claim_name(epoch: int) -> str:
    """Name of a claim in logs and traces, from which the epoch cannot be told.

    An epoch is enough to drive the slave in the place of its master.
    """
    return sha256(str(epoch).encode()).hexdigest()[:8]


def check_host(host: str) -> str:
    """``host`` itself if it is no longer than the name of a host can be.

    Raises:
        MalformedMessageError: it is longer.
    """
    if len(host) > MAX_HOST:
        raise MalformedMessageError(f"host has {len(host)} characters; the limit is {MAX_HOST}")
    return host


def _orphan_time(value: StartValue | None) -> float | None:
    if value is None:
        return None
    if isinstance(value, int | float) and not isinstance(value, bool):
        seconds = float(value) if abs(value) <= MAX_ORPHAN_TIME else math.inf
        if 0.0 <= seconds <= MAX_ORPHAN_TIME:  # NaN is not
            return seconds
    raise MalformedMessageError(
        f"orphan_time must be from 0 to {MAX_ORPHAN_TIME:g} s, not {value!r:.60}"
    )


class _Status:
    """A flat map with a value for each field; texts, numbers and booleans, and None for nothing."""

    __slots__ = ()

    def to_message(self) -> dict[str, StartValue | None]:
        """Status as plain data."""
        return asdict(self)  # type: ignore[call-overload,no-any-return]  # of a dataclass below

    @classmethod
    def from_message(cls, message: Mapping[str, StartValue]) -> Self:
        """The status that ``to_message`` wrote; values that it does not know are left out.

        Raises:
            MalformedMessageError: a value is missing or has another type.
        """
        values: dict[str, Any] = {}
        for one in fields(cls):  # type: ignore[arg-type]  # of a dataclass below
            value = message.get(one.name)
            if type(value).__name__ not in str(one.type).replace("None", "NoneType").split(" | "):
                raise MalformedMessageError(f"a status must hold {one.name} as {one.type}")
            if one.name == "host":
                check_host(str(value))
            values[one.name] = value
        return cls(**values)


@dataclass(frozen=True, slots=True)
class SlaveStatus(_Status):
    """Status of a slave. Times are seconds since 1970, by its own clock.

    Attributes:
        name, instance: its address.
        host, pid: its process.
        model, kind, sha256: as in its description.
        capabilities: in short, for people.
        state: ``free`` or ``held``.
        busy: whether a request is being executed.
        worker: ``alive`` or ``dead``.
        holder: the master that holds it, for people; None: it is free.
        run: id of that master's run.
        held_since: when it was claimed [s].
        since: when it began to serve [s].
        time: when it said this [s]; only good for comparing clocks.
        protocol_version: of its messages.
    """

    name: str
    instance: str
    host: str
    pid: int
    model: str
    kind: str
    sha256: str
    capabilities: str
    state: str
    busy: bool
    worker: str
    holder: str | None
    run: str | None
    held_since: float | None
    since: float
    time: float
    protocol_version: int


@dataclass(frozen=True, slots=True)
class MasterStatus(_Status):
    """Status of a master and its run. Times are seconds since 1970, by its own clock.

    Attributes:
        run: id of the run.
        host, pid: its process.
        system: the system file.
        slaves: their names, with commas.
        since: when it began [s].
        time: when it said this [s].
    """

    run: str
    host: str
    pid: int
    system: str
    slaves: str
    since: float
    time: float


@dataclass(frozen=True, slots=True)
class RouterStatus(_Status):
    """Status of a router. Times are seconds since 1970, by its own clock.

    Attributes:
        instance: its address.
        host, pid: its process.
        endpoints: where it listens and to what it connects, for people.
        since: when it began [s].
        time: when it said this [s].
    """

    instance: str
    host: str
    pid: int
    endpoints: str
    since: float
    time: float
