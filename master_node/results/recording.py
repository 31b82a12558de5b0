"""A run kept in memory."""

from __future__ import annotations

from array import array
from collections.abc import Mapping

from master_node.observing.observers import Attempt, DiscreteValue, Points, RunEnd, RunStart
from master_node.results.columns import Columns, Table
from master_node.results.result import Result
from master_node.results.steps_file import Steps
from master_node.results.summary import plain_mapping, summarize
from protocol.errors import ResultsError


class Recording:
    """An observer that keeps the run in memory, for ``result()``.

    Args:
        settings: what the run was asked for, see ``ResultsWriter``.
    """

    def __init__(self, settings: Mapping[str, object] | None = None) -> None:
        self._settings = plain_mapping(settings or {})
        self._start: RunStart | None = None
        self._end: RunEnd | None = None
        self._rows = array("d")  # time and outputs of one row after the other; grows amortised
        self._discrete: list[tuple[DiscreteValue, ...]] = []
        self._steps = Steps()

    def set_settings(self, settings: Mapping[str, object]) -> None:
        """Set the system with which the run goes on, after its slaves were examined."""
        self._settings = plain_mapping(settings)

    def started(self, start: RunStart) -> None:
        """Forget an earlier run and note the row of T_0."""
        self._start, self._end = start, None
        self._rows = array("d", [start.start_time, *start.outputs.tolist()])
        self._discrete = [start.discrete]
        self._steps = Steps()

    def attempted(self, attempt: Attempt) -> None:
        """Note the attempt and the points it reached."""
        self._steps.append(attempt)
        self._note(attempt.points)

    @property
    def rows(self) -> tuple[int, int]:
        """Numbers of result points and of attempts that are kept."""
        start = self._start
        width = 1 if start is None else 1 + len(start.outputs)
        return len(self._rows) // width, len(self._steps)

    def cut(self, points: int, attempts: int) -> None:
        """Keep only so many rows of results and of steps."""
        if self._start is not None:
            del self._rows[points * (1 + len(self._start.outputs)) :]
            del self._discrete[points if self._start.discrete_names else 1 :]
            self._steps.cut(attempts)

    def ended(self, end: RunEnd) -> None:
        """Note how it went."""
        self._note(end.points)
        self._end = end

    def result(self) -> Result:
        """A copy of what is known by now; ``summary`` is empty as long as the run goes on.

        Raises:
            ResultsError: the run has not started.
        """
        start = self._start
        if start is None:
            raise ResultsError("nothing was recorded: the run did not start")
        columns = Columns.of(start)
        by_column = list(zip(*self._discrete, strict=True))
        return Result.of(
            Table.of_rows(columns, self._rows, by_column),
            self._steps,
            {} if self._end is None else summarize(start, self._end, self._settings),
        )

    def _note(self, points: Points) -> None:
        for point in points:
            self._rows.append(point.time)
            self._rows.extend(point.outputs.tolist())
            if point.discrete:
                self._discrete.append(point.discrete)
