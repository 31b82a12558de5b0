"""A slave that can be brought back to where it stood, in a fresh process.

It stands in front of a link and notes what goes through it. When the process behind it is gone,
a new one is started, restored, and does again what was under way: who sends requests sees nothing
but a pause. When the model itself ended the process, the step is answered as a failed one, and the
slave is restored before the next request; so too when a step did not end in time, and, done again
as it was in a fresh process, did not once more. A host that stood still is not the model's doing.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from time import monotonic

from master_node.slaves.call_log import CallLog, LoggedStep, SavedState, outputs_of, steps_taken
from master_node.slaves.link import SlaveLink
from protocol.calls import (
    Call,
    Configure,
    Describe,
    DeserializeState,
    Examine,
    FreeState,
    GetState,
    Reply,
    SerializeState,
    SetState,
    Terminate,
)
from protocol.description import SlaveDescription, StateKind
from protocol.errors import (
    DeadlineError,
    DoublestepError,
    ModelError,
    SequenceError,
    SlaveCrashedError,
    SlaveError,
    SlaveKilledError,
    SlaveLostError,
    StepRejectedError,
)
from protocol.wire.programs import MAX_CALLS

log = logging.getLogger("master_node")

_TIMES = 3
"""Number of times in a row that a slave is started again for one request."""

_STATE = 15
"""The number under which states are saved for checkpoints; those of steps begin with 0."""

_OTHER_OUTPUTS = "the same steps lead to other outputs"

Restart = Callable[[], SlaveLink]
"""Gives a link to a fresh process with the slave as it was loaded first; raises
`DoublestepError`, after which it may be called again."""

GiveUp = Callable[[str], None]
"""Is told why the slave is lost for good: the run ends, and no other slave is waited for."""


class BrokenStepError(StepRejectedError):
    """A step, or trial steps, that ended the process of a slave, or had to be ended; the slave can
    be restored.

    Attributes:
        original: what happened.
    """

    def __init__(self, original: DoublestepError) -> None:
        super().__init__(original.cause, remedy=original.remedy)
        self.original = original
        self.located(
            slave=original.slave,
            phase=original.phase,
            time=original.time,
            step_size=original.step_size,
        )

    @property
    def is_crash(self) -> bool:
        """True if the process died by itself."""
        return isinstance(self.original, SlaveCrashedError)

    def located(
        self,
        *,
        slave: str = "",
        phase: str = "",
        time: float | None = None,
        step_size: float | None = None,
    ) -> BrokenStepError:
        """See `DoublestepError`; what happened is located, too."""
        for_both = {"slave": slave, "phase": phase}
        self.original.located(**for_both, time=time, step_size=step_size)
        super().located(**for_both, time=time, step_size=step_size)
        return self


class _NotRestoredError(Exception):
    """The fresh process is not where the old one was."""


class RestorableSlave:
    """Implements `SlaveLink` in front of another link.

    Args:
        name: of the slave.
        link: to it, instantiated.
        description: what it said of itself.
        restart: None: it cannot be started again; what it did is noted all the same.
        give_up: told once, when the slave is lost for good.

    Attributes:
        restarts: how often it was started again.
    """

    def __init__(
        self,
        name: str,
        link: SlaveLink,
        description: SlaveDescription,
        restart: Restart | None,
        give_up: GiveUp = lambda _: None,
    ) -> None:
        self.name = name
        self.restarts = 0
        self._link = link
        self._sha256 = description.sha256
        self._restart = restart
        self._give_up = give_up
        self._calls: Sequence[Call] = ()
        self._broken: DoublestepError | None = None
        self._describe(description)

    def _describe(self, description: SlaveDescription) -> None:
        is_native = description.state_kind == StateKind.NATIVE
        self._can_serialize = is_native and description.capabilities.can_serialize_state
        if self._restart is None:
            self.log = CallLog(is_compact=not self._can_serialize, kept_steps=0)
        else:
            self.log = CallLog(is_compact=not self._can_serialize)

    @property
    def can_serialize(self) -> bool:
        """True if its states can be saved outside of it."""
        return self._can_serialize

    # --- requests -------------------------------------------------------------------------------

    @property
    def request(self) -> str:
        """See `SlaveLink`."""
        return self._link.request

    def start(self, calls: Sequence[Call]) -> None:
        """See `SlaveLink`."""
        if self._broken is not None:
            self._recover(self._broken)
            self._broken = None
        self._calls = calls
        self._link.start(calls)

    def finish(self) -> Reply:
        """See `SlaveLink`."""
        was_late = False
        for number in range(_TIMES + 1):
            reply: Reply | None = None
            failure: DoublestepError | None = None
            try:
                reply = self._link.finish()
                if isinstance(reply.error, SlaveCrashedError | SequenceError):
                    failure = reply.error
            except (SlaveLostError, DeadlineError) as error:
                if error.slave not in ("", self.name):
                    raise  # another one is lost for good, and so is the run
                failure = error
            if failure is None:
                assert reply is not None
                self._note(reply)
                return reply
            if type(self._calls[0]) is Terminate:
                return Reply([], failure, 0.0)  # the run is complete: nothing is to be restored
            can_be_broken, is_late = (
                self._can_be_broken(failure),
                isinstance(failure, DeadlineError),
            )
            if can_be_broken and (was_late or not is_late):
                self._broken = failure
                return Reply([], BrokenStepError(failure), 0.0)
            is_repeated = can_be_broken or (self._restart is not None and _is_lost(failure))
            if not is_repeated or number == _TIMES:
                if _is_lost(failure):
                    self._give_up(failure.cause)
                if reply is None:
                    raise failure
                return reply
            was_late |= is_late
            self._locate(failure)
            self._recover(failure)
            self._link.start(self._calls)
        raise AssertionError  # the last turn ends in the loop

    def settle(self) -> None:
        """The run does not go back any more behind where the slave stands."""
        self.log.settle()

    def _note(self, reply: Reply) -> None:
        if type(self._calls[0]) is Configure and reply.results:  # a program of its own
            (result,) = reply.results
            assert isinstance(result, SlaveDescription)
            self._describe(result)
        self.log.note(self._calls, reply.results)

    def _can_be_broken(self, failure: DoublestepError) -> bool:
        """True if a smaller step may help, or the run can do without: it was on trial."""
        if self._restart is None or not self.log.is_running or _is_lost(failure):
            return False
        return bool(steps_taken(self._calls)) or any(type(c) is Examine for c in self._calls)

    def _locate(self, failure: DoublestepError) -> None:
        steps = steps_taken(self._calls)
        if steps:
            step = steps[0]
            failure.located(
                phase=step.verb, time=step.communication_point, step_size=step.step_size
            )
        failure.located(slave=self.name)

    # --- saved states ---------------------------------------------------------------------------

    def start_saving(self) -> None:
        """Have it serialise its state where it stands, right behind `settle`."""
        self._link.start((GetState(_STATE), SerializeState(_STATE), FreeState(_STATE)))

    def finish_saving(self) -> None:
        """Keep that state; one that was lost meanwhile is restored at the next request."""
        try:
            reply = self._link.finish()
        except DoublestepError as error:
            reply = Reply([], error, 0.0)
        if reply.error is None:
            data = reply.results[1]
            assert isinstance(data, bytes)
            self.log.save(data)
        elif isinstance(reply.error, SlaveCrashedError) or _is_lost(reply.error):
            lost = reply.error.located(slave=self.name, phase="serialize_state")
            if self._restart is None:
                raise lost
            self._broken = lost
            self._can_serialize &= _is_lost(lost)
        else:
            log.warning("%s: its state cannot be serialised: %s", self.name, reply.error)
            self._can_serialize = False

    # --- restoring ------------------------------------------------------------------------------

    def resume(self, state: SavedState | None, first: int, steps: Sequence[LoggedStep]) -> None:
        """Bring it from T_0 to where a run was interrupted.

        Args:
            state: to begin with, or None.
            first: number of the first of the ``steps``.
            steps: up to there; those before ``state`` are taken only if it cannot be used.

        Raises:
            DoublestepError: it cannot be restored.
        """
        self.log.resume(state, first, steps)
        try:
            if state is None:
                self._replay(self._link, self.log.steps(0))
            elif not self._goes_on_from(self._link, state):
                if self._restart is None or not self.log.is_complete:
                    raise _NotRestoredError(_OTHER_OUTPUTS)
                self._distrust()
                self._link = self._restored()
        except (DoublestepError, _NotRestoredError) as error:
            raise SlaveError(
                f"it cannot be brought to where the run was interrupted: {_cause(error)}",
                slave=self.name,
                phase="resume",
                remedy="run the system again from its start",
            ) from error

    def _recover(self, cause: DoublestepError) -> None:
        """Start it again and bring it to where it stood before the request that failed.

        Raises:
            SlaveLostError: that is not possible.
        """
        begin = monotonic()
        for number in range(_TIMES):
            try:
                self._link = self._restored()
                break
            except (DoublestepError, _NotRestoredError) as error:
                may_pass = _is_lost(error) or isinstance(error, DeadlineError)
                if not may_pass or number == _TIMES - 1:
                    lost = self._unrestored(cause, error)
                    self._give_up(lost.cause)
                    raise lost from error
        told = DoublestepError(cause.cause).located(
            slave=self.name, phase=cause.phase, time=cause.time, step_size=cause.step_size
        )
        log.warning(
            "%s; started again and restored in %.1f s: the run goes on", told, monotonic() - begin
        )

    def _restored(self) -> SlaveLink:
        state = self.log.state
        if state is not None:
            link = self._restarted()
            _execute(link, self.log.beginning)
            if self._goes_on_from(link, state):
                return link
            if not self.log.is_complete:
                raise _NotRestoredError(_OTHER_OUTPUTS)
            self._distrust()
        link = self._restarted()
        _execute(link, self.log.beginning)
        self._replay(link, self.log.steps(0))
        self._replay(link, [self.log.present])
        return link

    def _goes_on_from(self, link: SlaveLink, state: SavedState) -> bool:
        """Restore a state and do what came after it; False where the outputs are others."""
        try:
            self._deserialize(link, state)
            self._replay(link, self.log.steps(state.number))
            self._replay(link, [self.log.present])
        except (_NotRestoredError, SlaveError) as error:
            if _is_lost(error):
                raise
            return False
        self.log.proven()
        return True

    def _distrust(self) -> None:
        log.warning(
            "%s: its saved state cannot be used in another process; all its steps are taken again",
            self.name,
        )
        self.log.distrust()
        self._can_serialize = False

    def _unrestored(self, cause: DoublestepError, why: Exception) -> SlaveLostError:
        return SlaveLostError(
            f"{cause.cause}; it could not be started again and restored: {_cause(why)}",
            remedy=cause.remedy,
        ).located(slave=self.name, phase=cause.phase, time=cause.time, step_size=cause.step_size)

    @staticmethod
    def _deserialize(link: SlaveLink, state: SavedState) -> None:
        _execute(link, (DeserializeState(_STATE, state.data), SetState(_STATE), FreeState(_STATE)))

    def _replay(self, link: SlaveLink, steps: Iterable[LoggedStep]) -> None:
        for step in steps:
            outputs = outputs_of(step.calls, _execute(link, step.calls))
            if self.log.digest(outputs) != step.digest:
                raise _NotRestoredError(_OTHER_OUTPUTS)

    def _restarted(self) -> SlaveLink:
        assert self._restart is not None
        self.restarts += 1
        link = self._restart()
        (description,) = _execute(link, (Describe(),))
        assert isinstance(description, SlaveDescription)
        if description.sha256 != self._sha256:
            raise ModelError("the model's file has changed since the run began")
        return link


def _execute(link: SlaveLink, calls: Sequence[Call]) -> list[object]:
    """The results of calls that must succeed."""
    results: list[object] = []
    for cut in range(0, len(calls), MAX_CALLS):
        link.start(calls[cut : cut + MAX_CALLS])
        reply = link.finish()
        if reply.error is not None:
            raise reply.error
        results += reply.results
    return results


def _is_lost(error: Exception) -> bool:
    """True if it is gone for a reason that has nothing to do with the model: its process died, or
    it was given back while we were out of reach.
    """
    return isinstance(error, SlaveLostError | SlaveKilledError | SequenceError)


def _cause(error: Exception) -> str:
    return error.cause if isinstance(error, DoublestepError) else str(error)
