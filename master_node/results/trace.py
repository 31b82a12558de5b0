"""Traces of a run in the Trace Event Format, for Perfetto and chrome://tracing.

The file is written while the run goes on, and is whole JSON after every write: also when the
master is killed it can be opened.
"""

from __future__ import annotations

import errno
import json
import math
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from time import perf_counter

from master_node.observing.observers import Attempt, Exchange, RunEnd, RunStart
from master_node.results.files import cannot_write
from protocol.calls import Call, DoStep
from protocol.errors import ResultsError

_FLUSH_TIME = 0.5
_FLUSH_EVENTS = 5000
_PROCESS = 1
_MASTER = 0
_END = b"\n]\n"


class TraceWriter:
    """Writes what is told to it as an `Observer` and as an `ExchangeListener`.

    The first row is the master: round trips, double steps, H and ERR. Each slave has a row of its
    own: its requests, from sending to reply, and in each the time that it computed. When the
    slave began to compute within a request is not known here: the span stands in the middle.

    Args:
        path: of the file; one that is there is replaced.

    Raises:
        ResultsError: it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb", buffering=0)
        except OSError as error:
            raise cannot_write(path, error) from error
        self._begin = perf_counter()
        self._events: list[str] = []
        self._rows: dict[str, int] = {}
        self._end = 0
        self._flushed = -math.inf
        self._attempt_begin = self._begin
        self._name(_MASTER, "master")
        try:
            self._flush()
        except ResultsError:
            self._file.close()
            raise

    # --- Observer

    def started(self, _: RunStart) -> None:
        """The first double step begins."""
        self._attempt_begin = perf_counter()

    def attempted(self, attempt: Attempt) -> None:
        """A double step, from the end of the last one."""
        now = perf_counter()
        self._span(
            _MASTER,
            "double step" if attempt.accepted else "rejected double step",
            self._attempt_begin,
            now,
            t=attempt.time,
            H=attempt.step_size,
            ERR=attempt.error_norm,
            k=attempt.order,
            limiting_variable=attempt.limiting_variable,
        )
        self._add(ph="C", name="H", ts=self._microseconds(now), args={"H": attempt.step_size})
        self._attempt_begin = now
        self._flush_now_and_then(now)

    def ended(self, end: RunEnd) -> None:
        """The outcome; what comes after it is still written."""
        now = self._microseconds(perf_counter())
        arguments = {"message": end.message}
        self._add(ph="i", s="g", name=str(end.outcome), ts=now, tid=_MASTER, args=arguments)
        self._flush()

    # --- ExchangeListener

    def exchanged(self, begin: float, end: float, exchanges: Sequence[Exchange]) -> None:
        """A round trip with its requests."""
        self._span(_MASTER, "round trip", begin, end, requests=len(exchanges))
        for exchange in exchanges:
            row = self._row(exchange.slave)
            sent, received = exchange.sent, exchange.received
            self._span(
                row,
                _what(exchange.program),
                sent,
                received,
                request=exchange.request,
                calls=len(exchange.program),
                t=exchange.time,
                H=exchange.step_size,
                error=exchange.error or None,
            )
            if exchange.compute_time > 0.0:
                compute = min(exchange.compute_time, received - sent)
                middle = 0.5 * (sent + received)
                self._span(row, "compute", middle - 0.5 * compute, middle + 0.5 * compute)
        self._flush_now_and_then(end)

    def close(self) -> None:
        """Write the rest. Idempotent."""
        if not self._file.closed:
            try:
                self._flush()
            finally:
                self._file.close()

    # --- events

    def _row(self, slave: str) -> int:
        row = self._rows.get(slave)
        if row is None:
            row = self._rows[slave] = len(self._rows) + 1
            self._name(row, slave)
        return row

    def _name(self, row: int, name: str) -> None:
        self._add(ph="M", name="thread_name", tid=row, args={"name": name})
        self._add(ph="M", name="thread_sort_index", tid=row, args={"sort_index": row})

    def _span(self, row: int, name: str, begin: float, end: float, **arguments: object) -> None:
        known = {key: _plain(value) for key, value in arguments.items() if value is not None}
        duration = (end - begin) * 1e6
        self._add(
            ph="X", name=name, ts=self._microseconds(begin), dur=duration, tid=row, args=known
        )

    def _add(self, **event: object) -> None:
        self._events.append(json.dumps({"pid": _PROCESS, **event}, allow_nan=False))

    def _microseconds(self, time: float) -> float:
        return (time - self._begin) * 1e6

    def _flush_now_and_then(self, now: float) -> None:
        if now > self._flushed + _FLUSH_TIME or len(self._events) > _FLUSH_EVENTS:
            self._flush()

    def _flush(self) -> None:
        """Write the events over the end of the list, and the end again, in one go."""
        self._flushed = perf_counter()
        if not self._events:
            return
        start = b",\n" if self._end else b"[\n"
        data = start + ",\n".join(self._events).encode("utf-8", "backslashreplace")
        self._events.clear()
        try:
            self._file.seek(self._end)
            if self._file.write(data + _END) < len(data + _END):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            with suppress(OSError):  # end where the list was whole
                self._file.truncate(self._end)
                self._file.seek(self._end)
                self._file.write(_END)
            raise cannot_write(self._path, error) from error
        self._end += len(data)


def _what(program: Sequence[Call]) -> str:
    """A program by the call that takes time: its steps, or what comes first."""
    steps = sum(isinstance(call, DoStep) for call in program)
    if steps:
        return DoStep.verb if steps == 1 else f"{steps} x {DoStep.verb}"
    return program[0].verb if program else "nothing"


def _plain(value: object) -> object:
    """Value as JSON knows it."""
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
