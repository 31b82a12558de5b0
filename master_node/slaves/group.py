"""All slaves of a system: send each its program, collect all replies, name whoever failed."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from time import perf_counter

from master_node.observing.observers import Exchange, ExchangeListener, SlaveStatistics, Statistics
from master_node.slaves.link import SlaveLink
from protocol.calls import Call, DoStep, Examine, ModelWarnings, Reply
from protocol.errors import DoublestepError

log = logging.getLogger("master_node")

Program = tuple[Call, ...]


class SlaveGroup:
    """The slaves in a fixed order. One `execute` is one round trip, all slaves in parallel.

    Args:
        links: to the slaves.
        listeners: are told of every exchange of messages.

    Attributes:
        names: of the slaves.
        round_trips: rounds so far.
        wait_time: seconds spent in them.
        statistics: by slave.
    """

    def __init__(
        self, links: Mapping[str, SlaveLink], listeners: Sequence[ExchangeListener] = ()
    ) -> None:
        self._listeners = tuple(listeners)
        self.names = tuple(links)
        self._links = tuple(links.values())
        self._indices = range(len(self.names))
        self._warned: set[int] = set()
        self.restart_statistics()

    def restart_statistics(self) -> None:
        """Count from here on; what was handed out stays as it is."""
        self.statistics = {name: SlaveStatistics() for name in self.names}
        self._statistics = tuple(self.statistics.values())
        self.round_trips = 0
        self.wait_time = 0.0

    def continue_statistics(self, before: Statistics) -> None:
        """Count on from those of a run that is resumed."""
        self.statistics = {name: replace(before.slaves[name]) for name in self.names}
        self._statistics = tuple(self.statistics.values())
        self.round_trips, self.wait_time = before.round_trips, before.wait_time

    def __len__(self) -> int:
        return len(self._links)

    def execute(
        self,
        programs: Sequence[Program],
        time: float | None = None,
        step_size: float | None = None,
        slaves: Sequence[int] | None = None,
    ) -> list[Reply]:
        """Run one program on each slave, or on some.

        Args:
            programs: one for each of these slaves, in order.
            time: where the run stands [s], for error messages; None: nowhere yet.
            step_size: communication step size H [s], for error messages.
            slaves: indices of the slaves; None: all.

        Returns:
            The replies in order. A reply's own ``error`` is located but not raised.

        Raises:
            DoublestepError: a slave could not be reached; all others were waited for.
        """
        begin = now = perf_counter()
        failure: DoublestepError | None = None
        replies = []
        pending: list[tuple[int, Program, float, float]] = []
        indices = self._indices if slaves is None else slaves
        for index, program in zip(indices, programs, strict=True):
            try:
                self._links[index].start(program)
            except DoublestepError as error:
                failure = failure or self._located(error, index, program)
                break
            before, now = now, perf_counter()
            pending.append((index, program, before, now))
        all_sent = now
        exchanges: list[Exchange] = []
        for index, program, begun, sent in pending:
            reply: Reply | None = None
            try:
                reply = self._links[index].finish()
            except DoublestepError as error:
                failure = failure or self._located(error, index, program)
            now = perf_counter()
            if reply is not None:
                replies.append(reply)
                statistics = self._statistics[index]
                statistics.requests += 1
                statistics.compute_time += reply.compute_time
                if reply.warnings.number:
                    self._note_warnings(index, reply.warnings)
                statistics.request_time += (sent - begun) + (now - all_sent)
                if reply.error is not None:
                    self._located(reply.error, index, program)
                    reply.error.located(time=time, step_size=step_size)
            if self._listeners:
                exchanges.append(self._exchange(index, program, reply, begun, now, time, step_size))
        self.wait_time += now - begin
        self.round_trips += 1
        for listener in self._listeners:
            listener.exchanged(begin, now, exchanges)
        if failure is not None:
            raise failure.located(time=time, step_size=step_size)
        return replies

    def _note_warnings(self, index: int, warnings: ModelWarnings) -> None:
        """Count warnings of a model, and tell the first one."""
        self._statistics[index].warnings += warnings.number
        if index not in self._warned:
            self._warned.add(index)
            log.warning(
                "%s: its model warns: %s; its log has all of them, and model_warnings in "
                "summary.json their number",
                self.names[index],
                warnings.first,
            )

    def _exchange(  # noqa: PLR0917  once for each request
        self,
        index: int,
        program: Program,
        reply: Reply | None,
        sent: float,
        received: float,
        time: float | None,
        step_size: float | None,
    ) -> Exchange:
        error = "no reply" if reply is None else str(reply.error or "")
        return Exchange(
            self.names[index],
            self._links[index].request,
            program,
            sent,
            received,
            float("nan") if reply is None else reply.compute_time,
            time,
            step_size,
            error,
        )

    def _located(self, error: DoublestepError, index: int, program: Program) -> DoublestepError:
        """Name the slave, and the call that a lost request was about: its steps, if it has some."""
        steps = [call.verb for call in program if isinstance(call, DoStep | Examine)]
        return error.located(slave=self.names[index], phase=(steps or [program[0].verb])[0])

    def execute_all(self, programs: Sequence[Program], time: float) -> list[Reply]:
        """Replies to programs that must succeed as a whole.

        Raises:
            DoublestepError: also when a slave returned an error.
        """
        replies = self.execute(programs, time)
        for reply in replies:
            if reply.error is not None:
                raise reply.error
        return replies

    def count(self, index: int, do_steps: int, rollbacks: int) -> None:
        """Add what slave ``index`` executed to its statistics."""
        statistics = self._statistics[index]
        statistics.do_steps += do_steps
        statistics.rollbacks += rollbacks
