"""A relay between two ends of the bus that can be cut, stalled and slowed down."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine
from typing import Any

from protocol.bus.endpoints import free_endpoint
from tests.support.waiting import BOUND

_SLOWNESS = 0.02
"""Delay of all messages while the relay is slowed down [s]."""


class Relay:
    """Hands on what comes over TCP, both ways, in a thread of its own.

    Args:
        target: endpoint to which it leads; it need not be there yet.

    Attributes:
        endpoint: at which it listens.
    """

    def __init__(self, target: str) -> None:
        self.endpoint = free_endpoint()
        self._target = _place(target)
        self._writers: set[asyncio.StreamWriter] = set()
        self._slowness = 0.0
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="relay", daemon=True)
        self._thread.start()
        self._flows = asyncio.Event()
        self._flows.set()
        self._do(self._listen())

    def disturb(self, kind: str, duration: float) -> None:
        """Disturb all connections for so long [s], by ``cut``, ``stall`` or ``delay``."""
        self._do({"cut": self._cut, "stall": self._stall, "delay": self._delay}[kind](duration))

    def close(self) -> None:
        """Cut all connections for ever."""
        self._do(self._end())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(BOUND)
        self._loop.close()

    def _do(self, action: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(action, self._loop).result(BOUND)

    async def _listen(self) -> None:
        self._server = await asyncio.start_server(self._connected, *_place(self.endpoint))

    async def _cut(self, duration: float) -> None:
        self._hang_up()
        await asyncio.sleep(duration)
        await self._listen()

    async def _stall(self, duration: float) -> None:
        self._flows.clear()
        await asyncio.sleep(duration)
        self._flows.set()

    async def _delay(self, duration: float) -> None:
        self._slowness = _SLOWNESS
        await asyncio.sleep(duration)
        self._slowness = 0.0

    async def _end(self) -> None:
        self._hang_up()
        self._flows.set()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    def _hang_up(self) -> None:
        self._server.close()
        for writer in self._writers:
            writer.transport.abort()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        try:
            there, beyond = await asyncio.open_connection(*self._target)
        except OSError:
            self._writers.discard(writer)
            writer.close()
            return
        self._writers.add(beyond)
        await asyncio.gather(self._pump(reader, beyond), self._pump(there, writer))

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(65536):
                await asyncio.sleep(self._slowness)
                await self._flows.wait()
                writer.write(data)
                await writer.drain()
        except OSError:
            pass
        finally:
            self._writers.discard(writer)
            writer.close()


def _place(endpoint: str) -> tuple[str, int]:
    host, _, port = endpoint.rpartition("/")[2].rpartition(":")
    return host, int(port)
