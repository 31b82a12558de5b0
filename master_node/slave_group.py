"""All slaves of a system: send each its program, collect all replies, name whoever failed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from time import perf_counter

from master_node.observers import SlaveStatistics
from master_node.slave_link import SlaveLink
from protocol.calls import Call, DoStep, Reply, SetState
from protocol.errors import DoublestepError

Program = tuple[Call, ...]


class SlaveGroup:
    """The slaves in a fixed order. One `execute` is one round trip, all slaves in parallel.

    Attributes:
        names: of the slaves.
        round_trips: rounds so far.
        wait_time: seconds spent in them.
        statistics: by slave.
    """

    def __init__(self, links: Mapping[str, SlaveLink]) -> None:
        self.names = tuple(links)
        self._links = tuple(links.values())
        self.restart_statistics()

    def restart_statistics(self) -> None:
        """Count from here on; what was handed out stays as it is."""
        self.statistics = {name: SlaveStatistics() for name in self.names}
        self._statistics = tuple(self.statistics.values())
        self.round_trips = 0
        self.wait_time = 0.0

    def __len__(self) -> int:
        return len(self._links)

    def execute(
        self, programs: Sequence[Program], time: float, step_size: float | None = None
    ) -> list[Reply]:
        """Run one program on each slave.

        Args:
            programs: one for each slave, in order.
            time, step_size: where the run stands, for error messages [s].

        Returns:
            The replies in order. A reply's own ``error`` is located but not raised.

        Raises:
            DoublestepError: a slave could not be reached; all others were waited for.
        """
        begin = perf_counter()
        failure: DoublestepError | None = None
        started = []
        for name, link, program in zip(self.names, self._links, programs, strict=True):
            try:
                link.start(program)
                started.append(True)
            except DoublestepError as error:
                started.append(False)
                failure = failure or error.located(slave=name, phase=_phase(program))
        replies = []
        for index, link in enumerate(self._links):
            if not started[index]:
                continue
            try:
                reply = link.finish()
            except DoublestepError as error:
                phase = _phase(programs[index])
                failure = failure or error.located(slave=self.names[index], phase=phase)
                continue
            replies.append(reply)
            statistics = self._statistics[index]
            statistics.requests += 1
            statistics.compute_time += reply.compute_time
            if reply.error is not None:
                reply.error.located(slave=self.names[index], time=time, step_size=step_size)
        self.wait_time += perf_counter() - begin
        self.round_trips += 1
        if failure is not None:
            raise failure.located(time=time, step_size=step_size)
        return replies

    def execute_all(self, programs: Sequence[Program], time: float) -> list[Reply]:
        """The same for programs that must succeed as a whole.

        Raises:
            DoublestepError: also when a slave returned an error.
        """
        replies = self.execute(programs, time)
        for reply in replies:
            if reply.error is not None:
                raise reply.error
        return replies

    def count(self, programs: Sequence[Program], replies: Sequence[Reply]) -> None:
        """Add the do_steps and rollbacks that were executed to the statistics."""
        for statistics, program, reply in zip(self._statistics, programs, replies, strict=True):
            for call, _ in zip(program, reply.results, strict=False):
                kind = type(call)
                if kind is DoStep:
                    statistics.do_steps += 1
                elif kind is SetState:
                    statistics.rollbacks += 1


def _phase(program: Program) -> str:
    """The call that a lost request was about: its step, if it has one."""
    steps = [call.verb for call in program if isinstance(call, DoStep)]
    return steps[0] if steps else program[0].verb
