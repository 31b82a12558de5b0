"""Messages beside the calls: the claim of a master, and what a slave says of itself.

All travel as flat maps (`protocol.codec.encode_map`), which also hold the protocol version.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Self

from protocol.errors import MalformedMessageError
from protocol.keys import check_name
from protocol.slave import StartValue

DEFAULT_ORPHAN_TIME: Final = 15.0
"""How long a slave waits for a master that does not say how long [s]."""

MAX_ORPHAN_TIME: Final = 3600.0
"""A vanished master can keep a slave from others no longer than this [s]."""


@dataclass(frozen=True, slots=True)
class Claim:
    """A master takes a slave for its run.

    Attributes:
        run: id of the run.
        host, pid: the master's process.
        orphan_time: how long the slave waits for a master that vanished [s]; None: as it likes.
    """

    run: str
    host: str
    pid: int
    orphan_time: float | None = None

    def to_message(self) -> dict[str, StartValue | None]:
        """As plain data."""
        return {
            "run": self.run,
            "host": self.host,
            "pid": self.pid,
            "orphan_time": self.orphan_time,
        }

    @classmethod
    def from_message(cls, message: Mapping[str, StartValue]) -> Self:
        """The claim that ``to_message`` wrote.

        Raises:
            MalformedMessageError: a value is missing or has another type.
            ConfigurationError: the id of the run is not valid.
        """
        run, host, pid = message.get("run"), message.get("host"), message.get("pid")
        if type(run) is not str or type(host) is not str or type(pid) is not int:
            raise MalformedMessageError(
                "a claim must hold run and host as texts, and pid as a number"
            )
        return cls(check_name(run, "run id"), host, pid, _orphan_time(message.get("orphan_time")))


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
