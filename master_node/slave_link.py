"""How the master reaches one slave: start a program of calls, then collect its reply."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from protocol.calls import Call, Reply
from protocol.slave import CallExecutor


class SlaveLink(Protocol):
    """A slave, wherever it is. `RemoteSlave` over a bus, `LocalSlave` in this process.

    ``finish`` follows each ``start``. Both raise `SlaveLostError`, `DeadlineError` or
    `ProtocolError` when the slave cannot be reached; what the slave itself had to say is in the
    reply.
    """

    @property
    def request(self) -> str:
        """``epoch:sequence`` of the last program; "" without a bus."""
        ...

    def start(self, calls: Sequence[Call]) -> None:
        """Send a program."""
        ...

    def finish(self) -> Reply:
        """Wait for its reply."""
        ...


class LocalSlave:
    """A slave in the master's own process: no bytes, no bus, the same calls."""

    def __init__(self, executor: CallExecutor) -> None:
        self._executor = executor
        self._reply = Reply([], None, 0.0)

    @property
    def request(self) -> str:
        """See `SlaveLink`."""
        return ""

    def start(self, calls: Sequence[Call]) -> None:
        """See `SlaveLink`; the program runs here and now."""
        self._reply = self._executor.execute(calls)

    def finish(self) -> Reply:
        """See `SlaveLink`."""
        return self._reply
