"""Where a run stands, kept so that slaves can be restored and the run itself can be resumed.

What is kept in memory costs no more than the slaves' calls since their last saved states. What is
written to files is the same, with the position of the run: a value that says everything about what
comes next. It is written now and then, and at the end of a run that did not get to its end.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from time import monotonic
from typing import Any, NamedTuple, Protocol, TypeVar

from master_node.coupling.result_points import ResultMemory
from master_node.observing.observers import Statistics
from master_node.results.selection import SelectionMemory
from master_node.resuming.files import Checkpoint, CheckpointStore, SavedSlave
from master_node.resuming.json_values import from_plain, to_plain
from master_node.slaves.restorable import RestorableSlave
from protocol.errors import ResultsError

log = logging.getLogger("master_node")

_T = TypeVar("_T")

_STEPS = 100
"""Steps after which states are saved in memory."""

_TIME = 1.0
"""Time after which they are, if there are fewer steps [s]."""

_SHARE = 20.0
"""Saving states may take one part in so many of the time."""

_COUNTERS = (
    "communication_steps",
    "rejected_double_steps",
    "discontinuities",
    "double_steps_at_discontinuities",
    "double_steps_at_false_alarms",
    "late_jumps",
    "changes_at_smallest_step_size",
    "steps_above_tolerance",
    "iterated_double_steps",
    "stiff_double_steps",
    "double_steps_at_rest",
    "time",
    "smallest_step_size",
    "largest_step_size",
)
counted = attrgetter(*_COUNTERS)
"""Counters of `Statistics` that belong to a point of a run."""


def put_back(statistics: Statistics, counters: tuple[object, ...]) -> None:
    """Let counters be what `counted` gave."""
    for name, value in zip(_COUNTERS, counters, strict=True):
        setattr(statistics, name, value)


class ResultPosition(NamedTuple):
    """Extent of a run in its result files.

    Attributes:
        points: rows of results, T_0 among them.
        attempts: rows of steps.
        selection: what the choice of points remembers.
    """

    points: int
    attempts: int
    selection: SelectionMemory


class ResultFiles(Protocol):
    """Where results go to."""

    def position(self) -> ResultPosition:
        """Extent of what was told so far."""
        ...

    def flush(self) -> None:
        """Bring all of it to the disk; `ResultsError`."""
        ...

    def cut(self, position: ResultPosition) -> None:
        """Take back what was told since then; `ResultsError`."""
        ...


@dataclass(frozen=True)
class Resumed:
    """Checkpoint's record of the run.

    Attributes:
        checkpoint: as it was read.
        statistics: counters up to there.
        files: how much of the result files counts.
    """

    checkpoint: Checkpoint
    statistics: Statistics
    files: ResultPosition

    @staticmethod
    def of(checkpoint: Checkpoint) -> Resumed:
        """From what was read.

        Raises:
            ResultsError: it makes no sense.
        """
        run = checkpoint.run
        return Resumed(
            checkpoint,
            _read(Statistics, run, "statistics"),
            _read(ResultPosition, run, "files"),
        )

    @property
    def rows(self) -> tuple[int, int]:
        """Number of rows of results, and of steps, that count."""
        return self.files.points, self.files.attempts

    def place(self, kind: type[_T]) -> tuple[_T, ResultMemory]:
        """The position, a value of type ``kind``, and what the results remember there.

        Raises:
            ResultsError: it makes no sense.
        """
        run = self.checkpoint.run
        return _read(kind, run, "position"), _read(ResultMemory, run, "results")


def _read(kind: type[_T], run: Mapping[str, Any], name: str) -> _T:
    try:
        return from_plain(kind, run[name])
    except (ValueError, KeyError) as error:
        raise ResultsError(f"the checkpoint is malformed: {name}: {error}") from error


class _Place(NamedTuple):
    """Where the run stood when it was last seen; slaves had taken ``number`` steps."""

    number: int
    position: object
    results: ResultMemory
    files: ResultPosition
    counters: tuple[Any, ...]


class Checkpoints:
    """Keeps them. Without arguments: none.

    Args:
        slaves: those that can be restored.
        store: where checkpoints are written; None: nowhere.
        interval: wall-clock time between two of them [s].
        files: of the results.
        number: of steps that the slaves have taken already.
    """

    def __init__(
        self,
        slaves: Sequence[RestorableSlave] = (),
        store: CheckpointStore | None = None,
        interval: float = 0.0,
        files: ResultFiles | None = None,
        number: int = 0,
    ) -> None:
        self._slaves = slaves
        self._store = store
        self._interval = interval
        self._files = files
        self._number = number
        self._saved_number = number
        self._saved_time = self._earliest = self._written = monotonic()
        self._place: _Place | None = None
        self._statistics = Statistics()
        self._update: Callable[[], None] = lambda: None

    def restore(self, resumed: Resumed) -> None:
        """Bring the slaves from T_0 to where the run stood.

        Raises:
            DoublestepError: one cannot be brought there.
        """
        saved = resumed.checkpoint.slaves
        for slave in self._slaves:
            slave.restarts = resumed.statistics.slaves[slave.name].restarts
            state, first, log = saved[slave.name]
            slave.resume(state, first, list(log.steps(first)))

    def begin(self, statistics: Statistics, update: Callable[[], None]) -> None:
        """The run begins.

        Args:
            statistics: are counted up.
            update: brings times and counts of the slaves' requests up to date.
        """
        self._statistics, self._update = statistics, update
        self._saved_time = self._earliest = self._written = monotonic()
        if self._store is not None:
            self._store.begin()

    def restarts(self) -> dict[str, int]:
        """Number of restarts of each slave."""
        return {slave.name: slave.restarts for slave in self._slaves}

    def settle(self) -> None:
        """All slaves stand at a communication point from which the run does not go back.

        Raises:
            DoublestepError: a slave is lost for good.
        """
        for slave in self._slaves:
            slave.settle()
        self._number += 1
        if self._slaves and self._is_due():
            self._save_states()

    def went_back(self, read: Callable[[], object]) -> None:
        """All slaves went back to a state of an earlier step, which logs need not hold any more.

        Args:
            read: reads outputs, which tell whether saved states are restored to the last bit.

        Raises:
            DoublestepError: a slave is lost for good.
        """
        self.settle()
        if any(slave.can_serialize for slave in self._slaves):
            self._save_states()
            read()
            self.settle()

    def reached(self, position: object, results: ResultMemory) -> None:
        """The run goes on from ``position``, a value that says everything about what comes next.

        Slaves stand where they did at the last `settle`, or can go back there.

        Raises:
            ResultsError: a checkpoint cannot be written.
        """
        if self._store is None or self._files is None:
            return
        self._place = _Place(
            self._number, position, results, self._files.position(), counted(self._statistics)
        )
        if monotonic() - self._written >= self._interval:
            self._update()
            self._write()
            self._written = monotonic()

    def files_position(self) -> ResultPosition | None:
        """Numbers of result points and attempts told so far; None: results go nowhere."""
        return None if self._files is None else self._files.position()

    def cut_files(self, position: ResultPosition) -> None:
        """Take back what was told since then.

        Raises:
            ResultsError: a file cannot be written.
        """
        if self._files is not None:
            self._files.cut(position)

    @property
    def remedy(self) -> str:
        """Remedy for a run that was broken off; "" without a store."""
        return "" if self._store is None else self._store.remedy

    def broken_off(self) -> None:
        """The run did not get to its end: it can be resumed from where it stood last."""
        if self._store is None or self._place is None:
            return
        try:
            self._write()
        except ResultsError as error:
            log.warning("%s; resume would go on from the checkpoint before", error)

    def remove(self) -> None:
        """The run got to its end, and its results are complete: nothing is to be resumed."""
        if self._store is not None:
            self._store.remove()

    def _is_due(self) -> bool:
        now = monotonic()
        if now < self._earliest:
            return False
        return self._number - self._saved_number >= _STEPS or now - self._saved_time >= _TIME

    def _save_states(self) -> None:
        begin = monotonic()
        saving = [slave for slave in self._slaves if slave.can_serialize]
        for slave in saving:
            slave.start_saving()
        for slave in saving:
            slave.finish_saving()
        self._saved_number = self._number
        self._saved_time = monotonic()
        self._earliest = self._saved_time + _SHARE * (self._saved_time - begin)

    def _write(self) -> None:
        assert self._store is not None
        assert self._files is not None
        assert self._place is not None
        place = self._place
        self._files.flush()
        counters = dict(zip(_COUNTERS, place.counters, strict=True))
        run: Mapping[str, Any] = {
            "position": to_plain(place.position),
            "results": to_plain(place.results),
            "files": to_plain(place.files),
            "statistics": to_plain(replace(self._statistics, **counters)),
        }
        slaves = {slave.name: SavedSlave.of(slave.log) for slave in self._slaves}
        self._store.write(Checkpoint(place.number, run, slaves))


NO_CHECKPOINTS = Checkpoints()
"""Nothing is kept."""
