"""Run of a coupled system that its caller steps, asks, changes and branches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf

import numpy as np

from master_node.coupling.outputs import gather, reading_calls
from master_node.coupling.overrides import Overrides
from master_node.coupling.result_points import ResultMemory
from master_node.methods.base import AnyMethod, Ended, Setup
from master_node.methods.position import GivenValue, Position
from master_node.observing.observers import Outcome, Statistics
from master_node.resuming.checkpoints import Checkpoints, ResultPosition, counted, put_back
from master_node.running.actions import Actions
from master_node.running.journal import Journal
from master_node.running.loop import Loop
from master_node.running.steering import Values
from master_node.slaves.group import Program
from protocol.calls import Call, FreeState, GetState, Reply, SetState, SetValues
from protocol.description import StateKind
from protocol.errors import SteeringError

_FIRST_MARK = 16
"""Number of the first mark's saved states; those below are of steps and checkpoints."""

MOST_MARKS = 100
"""Number of marks that are kept at a time: slaves hold a state for each."""

NOTHING: Values = {}


@contextmanager
def ignored_overflow() -> Iterator[None]:
    """No warnings of NumPy: what is not finite is found by its norm."""
    with np.errstate(over="ignore", invalid="ignore"):
        yield


@dataclass(frozen=True, eq=False, repr=False)
class Mark:
    """Point of a run to which it can go back.

    Attributes:
        number: under which the states of the slaves are saved.
        position: of the run.
        results: memory of the results.
        files: how much was told.
        counters: see `counted`.
        ended: how the run had ended; None: it had not.
    """

    number: int
    position: Position
    results: ResultMemory
    files: ResultPosition | None
    counters: tuple[object, ...]
    ended: Ended | None

    @property
    def time(self) -> float:
        """T_n [s]."""
        return self.position.time

    def __repr__(self) -> str:
        return f"<Mark at t={self.time!r} s>"


class Run:
    """Steps forward, and back to marks.

    Args:
        setup: what is run.
        method: how a step is taken.
        loop: takes them.
        journal: is told of them.
        checkpoints: are told where the run stands.
        actions: are done by the run itself.

    Attributes:
        steering: checks changes.
        statistics: counters.
        ended: how the run has ended; None: it has not.
    """

    def __init__(
        self,
        setup: Setup,
        method: AnyMethod,
        loop: Loop,
        journal: Journal,
        checkpoints: Checkpoints,
        *,
        actions: Actions,
    ) -> None:
        self.steering = actions.steering
        self._actions = actions
        self._setup = setup
        self._method = method
        self._loop = loop
        self._journal = journal
        self._checkpoints = checkpoints
        self.statistics: Statistics = journal.statistics
        self.ended: Ended | None = None
        self._broken = ""
        self._marks: dict[int, Mark] = {}

    @property
    def setup(self) -> Setup:
        """Slaves, their connections and the settings."""
        return self._setup

    @property
    def position(self) -> Position:
        """Where the run stands."""
        return self._loop.position

    @property
    def outcome(self) -> tuple[Outcome, str]:
        """Outcome of the run, and a slave's wish to end earlier in words."""
        if self.ended is None:
            return Outcome.STOPPED, f"stopped at t={self.position.time!r} s"
        note = self.ended.note
        if self.ended.is_stopped:
            return Outcome.STOPPED_BY_ACTION, note
        return (Outcome.TERMINATED if note else Outcome.COMPLETED), note

    # --- forward --------------------------------------------------------------------------------

    def through(self) -> None:
        """Step to the end; raises as `Loop.advance`."""
        with self._journal.interrupts.deferrable(), ignored_overflow():
            while self.ended is None:
                self._advance(inf)

    def step(self, until: float = inf) -> None:
        """One accepted step; Ctrl-C waits for it, a second one breaks it off.

        Raises:
            SteeringError: an earlier step was broken off.
            DoublestepError: as `Loop.advance`; the run cannot go on.
        """
        with self._whole("a step"):
            self._advance(until)

    def begin(self) -> None:
        """Do what actions do where the run begins.

        Raises:
            ConfigurationError: no step can end at the time of an action.
            DoublestepError: a slave refused.
        """
        self._actions.check_targets(self.position.actions, self.check_target)
        with self._whole("an action"):
            self._act()

    def _advance(self, until: float) -> None:
        """One accepted step, and the actions that are due behind it."""
        due = self._actions.time(self.position.actions)
        self.ended = self._loop.advance(min(until, due))
        self._act()

    def _act(self) -> None:
        while self.ended is None and self.has_reached(self._actions.time(self.position.actions)):
            done = self.position.actions
            change = self._actions.change(done, self.position.overrides)
            with self._journal.interrupts:
                self._change(change.text, change.values, change.overrides, done + 1)
            if change.stops:
                note = f"stopped by an action at t={self.position.time!r} s"
                self.ended = Ended(note, is_stopped=True)

    @contextmanager
    def _whole(self, action: str) -> Iterator[None]:
        """An action after which the run can only go on if it was done as a whole.

        Ctrl-C waits for its end, a second one breaks it off.
        """
        if self._broken:
            raise SteeringError(
                f"the run cannot go on: {self._broken}", remedy="close it, and open another one"
            )
        interrupts = self._journal.interrupts
        with interrupts.deferrable(), ignored_overflow(), interrupts.until_step_ends():
            try:
                yield
            except BaseException as error:
                self._broken = f"{action} was broken off by {type(error).__name__}: {error}"
                raise

    def check_target(self, time: float) -> None:
        """Make sure that steps can end at ``time`` [s]; `SteeringError` says where they can."""
        position = self.position
        if time < position.time:
            raise SteeringError(
                f"t={time!r} s is before the point where the run stands, t={position.time!r} s",
                remedy="save a mark there and restore it, or open a run anew",
            )
        end = self._setup.system.simulation.end
        if time > end:
            raise SteeringError(
                f"t={time!r} s is behind the stop time, {end!r} s", remedy="raise stop_time"
            )
        if not self._method.has_reached(position.time, time):
            self._method.check_target(position, time)

    def has_reached(self, time: float) -> bool:
        """True if the run stands at ``time`` [s] or behind it."""
        return self._method.has_reached(self.position.time, time)

    # --- back -----------------------------------------------------------------------------------

    def save(self) -> Mark:
        """Save the states of all slaves, and the position.

        Raises:
            SteeringError: a slave's state cannot be saved, or there are `MOST_MARKS` already.
            DoublestepError: a slave refused.
        """
        for part in self._setup.coupled.parts:
            if part.description.state_kind is StateKind.NONE:
                raise SteeringError(
                    f"{part.name}: its state cannot be saved, so the run cannot go back",
                    remedy=f'try state = "fork" in [slaves.{part.name}]',
                )
        if len(self._marks) >= MOST_MARKS:
            raise SteeringError(
                f"{MOST_MARKS} marks are saved already", remedy="forget those that are not needed"
            )
        number = next(
            n for n in range(_FIRST_MARK, _FIRST_MARK + MOST_MARKS) if n not in self._marks
        )
        with self._whole("saving"):
            self._at_point(self._each(GetState(number)))
        mark = Mark(
            number,
            self.position,
            self._journal.results.memory,
            self._checkpoints.files_position(),
            counted(self.statistics),
            self.ended,
        )
        self._marks[number] = mark
        return mark

    def restore(self, mark: Mark) -> None:
        """Go back to a mark, which stays; results behind it are taken back.

        Raises:
            SteeringError: it is no mark of this run, or was forgotten.
            DoublestepError: a slave refused, or a file cannot be written.
        """
        number = self._number(mark)
        with self._whole("going back"):
            self._at_point(self._each(SetState(number)), goes_back=False)
            self._setup.coupled.overrides.set(mark.position.overrides)
            put_back(self.statistics, mark.counters)
            self._journal.results.memory = mark.results
            if mark.files is not None:
                self._checkpoints.cut_files(mark.files)
            self.ended = mark.ended
            self._checkpoints.went_back(lambda: self._at_point(self._reading(), goes_back=False))
            self._loop.move_to(mark.position)

    def forget(self, mark: Mark) -> None:
        """Free the states of a mark.

        Raises:
            SteeringError: it is no mark of this run, or was forgotten already.
            DoublestepError: a slave refused.
        """
        number = self._number(mark)
        del self._marks[number]
        with self._whole("freeing a mark"):
            self._at_point(self._each(FreeState(number)))

    def _number(self, mark: Mark) -> int:
        if self._marks.get(mark.number) is not mark:
            raise SteeringError(
                f"{mark!r} is no mark of this run, or it was forgotten",
                remedy="restore marks in the run that saved them, before it is closed",
            )
        return mark.number

    # --- changes --------------------------------------------------------------------------------

    def change(
        self, text: str, *, values: Values = NOTHING, overrides: Overrides | None = None
    ) -> None:
        """Set variables, and cut inputs from their sources, where the run stands: an event.

        Args:
            text: the change in words.
            values: checked, by slave and variable.
            overrides: that hold from here on, and no others; None: they stay.

        Raises:
            DoublestepError: a slave refused; the run cannot go on.
        """
        with self._whole("a change"):
            self._change(text, values, overrides, self.position.actions)

    def _change(self, text: str, values: Values, overrides: Overrides | None, actions: int) -> None:
        position, coupled = self.position, self._setup.coupled
        if values:
            calls = [
                ((SetValues(values[part.name]),) if part.name in values else ()) + calls
                for part, calls in zip(coupled.parts, self._reading(), strict=True)
            ]
            outputs = gather(coupled, self._at_point(calls), self._setup.scheme.output_rows)
            given = {one.name: one for one in position.given}
            for slave, those in values.items():
                for name, value in those.items():
                    given[f"{slave}.{name}"] = GivenValue(f"{slave}.{name}", value)
            position = position._replace(outputs=outputs, given=tuple(given.values()))
        else:
            self._at_point(self._each())
        if overrides is not None:
            coupled.overrides.set(overrides)
            position = position._replace(overrides=overrides)
        position = position._replace(actions=actions)
        self._journal.changed(position, text)
        self._checkpoints.settle()
        self._loop.move_to(self._method.behind_event(position).changed_as(position))

    # --- requests -------------------------------------------------------------------------------

    def _reading(self) -> list[Program]:
        setup = self._setup
        return reading_calls(setup.coupled, setup.scheme.get_outputs, records=True)

    def _each(self, *calls: Call) -> list[Program]:
        return [calls] * len(self._setup.coupled.parts)

    def _at_point(self, programs: Sequence[Program], *, goes_back: bool = True) -> list[Reply]:
        """Let slaves execute programs at the point where the run stands.

        Args:
            programs: one for each slave.
            goes_back: whether slaves that have gone ahead on trial go back to the point first.
        """
        if goes_back:
            programs = [
                (*self._method.way_back(slave), *program) for slave, program in enumerate(programs)
            ]
        assert all(programs) or not any(programs)  # slaves of a double step go ahead together
        replies = []
        if all(programs):
            replies = self._setup.group.execute_all(programs, self.position.time)
        self._method.forget()
        return replies
