"""Link from the master to one slave: start a program of calls, then collect its reply."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from master_node.slaves.shared_process import SharedProcess
from protocol.calls import Call, DoStep, Reply
from protocol.slave import CallExecutor


class SlaveLink(Protocol):
    """A slave, wherever it is. `RemoteSlave` over a bus, `LocalSlave` in this process.

    ``finish`` follows each ``start``. Both raise `SlaveLostError`, `DeadlineError` or
    `ProtocolError` when the slave cannot be reached; what the slave itself had to say is in the
    reply.
    """

    @property
    def request(self) -> str:
        """``claim:sequence`` of the last program; "" without a bus."""
        ...

    def start(self, calls: Sequence[Call]) -> None:
        """Send a program."""
        ...

    def finish(self) -> Reply:
        """Wait for its reply."""
        ...


class LocalSlave:
    """A slave in the master's own process: no bytes, no bus, the same calls.

    Args:
        executor: of its calls.
        process: that it shares with the master; None: it changes nothing there.
    """

    def __init__(self, executor: CallExecutor, process: SharedProcess | None = None) -> None:
        self._executor = executor
        self._process = process
        self._reply = Reply([], None, 0.0)

    @property
    def request(self) -> str:
        """See `SlaveLink`."""
        return ""

    def start(self, calls: Sequence[Call]) -> None:
        """See `SlaveLink`; the program runs here and now."""
        execute, process = self._executor.execute, self._process
        if process is None:
            self._reply = execute(calls)
        elif any(type(call) is DoStep for call in calls):
            self._reply = process.step(execute, calls)
        else:
            self._reply = process.run(execute, calls)

    def finish(self) -> Reply:
        """See `SlaveLink`."""
        return self._reply
