"""Metrics of a slave, for Prometheus: a worker that counts what goes through it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from protocol.calls import (
    Call,
    DeserializeState,
    DoStep,
    FreeState,
    GetState,
    Reply,
    Reset,
    SetState,
    StepResult,
)
from protocol.description import SlaveDescription
from protocol.errors import DoublestepError
from protocol.host.metrics import Metric
from protocol.wire.programs import decode_program
from protocol.wire.replies import decode_reply
from slave_node.worker.process import Worker


class CountingWorker:
    """Implements `Worker` with another one, and counts. Costs a look at every message.

    Args:
        worker: that does the work.
        name: of the slave.
    """

    def __init__(self, worker: Worker, name: str) -> None:
        self._worker = worker
        self._name = name
        self._counts = dict.fromkeys(_COUNTERS, 0.0)
        self._states: set[int] = set()
        self._time = self._step_size = float("nan")

    def start(self) -> SlaveDescription:
        """See `Worker`."""
        self._states.clear()
        return self._worker.start()

    def execute(self, program: bytes) -> bytes:
        """See `Worker`."""
        self._counts["requests"] += 1
        try:
            reply = self._worker.execute(program)
        except DoublestepError:
            self._counts["failed_requests"] += 1
            raise
        try:
            calls = decode_program(program)
            self._count(calls, decode_reply(calls, reply))
        except DoublestepError:  # a program that is none
            self._counts["failed_requests"] += 1
        return reply

    def kill(self) -> None:
        """See `Worker`."""
        self._worker.kill()

    def stop(self) -> None:
        """See `Worker`."""
        self._worker.stop()

    def _count(self, calls: Sequence[Call], reply: Reply) -> None:
        self._counts["compute_seconds"] += reply.compute_time
        if reply.error is not None:
            self._counts["failed_requests"] += 1
        for call, result in zip(calls, reply.results, strict=False):
            match call:
                case DoStep():
                    self._counts["do_steps"] += 1
                    self._step_size = call.step_size
                    if isinstance(result, StepResult):
                        self._time = result.time
                case SetState():
                    self._counts["rollbacks"] += 1
                    if call.free:
                        self._states.discard(call.state)
                case GetState() | DeserializeState():
                    self._states.add(call.state)
                case FreeState():
                    self._states.discard(call.state)
                case Reset():
                    self._states.clear()

    def read(self) -> Iterator[Metric]:
        """The metrics as they are now."""
        for name, description in _COUNTERS.items():
            yield Metric(name, description, "counter", {self._name: self._counts[name]})
        for name, description, value in (
            ("saved_states", "States that are saved now", float(len(self._states))),
            ("time_seconds", "Where the slave stands", self._time),
            ("step_size_seconds", "Of its last step", self._step_size),
        ):
            yield Metric(name, description, "gauge", {self._name: value})


_COUNTERS = {
    "requests": "Programs of calls that were executed, repetitions not among them",
    "failed_requests": "Of these, those that ended with an error",
    "do_steps": "Steps",
    "rollbacks": "How often it went back to a saved state",
    "compute_seconds": "Time that the model computed",
}
