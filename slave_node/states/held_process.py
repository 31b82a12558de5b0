"""`HeldProcess`: a process that holds a model, and how to get another one like it."""

from __future__ import annotations

import socket
from collections import deque

from protocol.errors import DoublestepError, SlaveCrashedError, SlaveError, SlaveKilledError
from protocol.wire.replies import decode_reply
from slave_node.execution.exit_codes import death, how_ended
from slave_node.states.channel import DURATION, PROCESS, Message
from slave_node.states.fork_family import HolderFamily
from slave_node.states.fork_trail import Task, Trail


class HeldProcess:
    """One holder of a family, see ``fork_holder.py``: the slave itself, or a saved state.

    Args:
        family: to which it belongs.
        connection: our end of the socket that it serves.
        process: its process id; 0: it is still to say that it is there, see `meet`.
        original: of which it is a copy.
        birth: number of births in the family when it was made.
    """

    def __init__(
        self,
        family: HolderFamily,
        connection: socket.socket,
        process: int = 0,
        original: HeldProcess | None = None,
        birth: int = 0,
    ) -> None:
        self._family = family
        self._channel = family.channel(connection)
        self._process = process
        self._original = original
        self._birth = birth
        self._owed: deque[Task] = deque()

    def send(self, kind: Message, payload: bytes = b"") -> None:
        """Ask it.

        Raises:
            OSError: it is gone.
        """
        self._channel.send(kind, payload)

    def receive(self) -> tuple[Message, bytes]:
        """Answer of the process.

        Raises:
            EOFError, OSError: it is gone.
            SlaveError: as `meet`.
        """
        self.meet()
        return self._channel.receive()

    def wait(self, timeout: float) -> bool:
        """True if it answers, or is gone, within ``timeout`` seconds."""
        return self._channel.wait(timeout)

    def copy(self) -> HeldProcess:
        """A copy of it, as it will stand after all that it was asked before; not waited for.

        Raises:
            OSError: it is gone.
        """
        birth = self._family.count_birth()
        ours, theirs = socket.socketpair()
        with theirs:
            try:
                self._channel.send(Message.FORK)
                self._channel.send_socket(theirs)
            except OSError:
                ours.close()
                raise
        return HeldProcess(self._family, ours, original=self, birth=birth)

    def follow(self, trail: Trail) -> None:
        """Let it do all that again; not waited for.

        Raises:
            OSError: it is gone.
        """
        for task in trail.tasks:
            self._channel.send(task.kind, task.payload)
        self._owed.extend(trail.tasks)

    def meet(self) -> None:
        """Wait until it is there, and has done all again that it was to follow.

        Raises:
            SlaveKilledError: it, or its original, died before: whatever comes next is not to
                blame.
            SlaveError: it could not be forked; or it did not end where it ended the first time.
        """
        try:
            if not self._process:
                kind, answer = self._channel.receive()
                if kind is not Message.DONE:
                    raise refusal(answer)
                (self._process,) = PROCESS.unpack(answer)
            while self._owed:
                task = self._owed.popleft()
                kind, answer = self._channel.receive()
                part = self._family.repeating.of
                if kind is not Message.DONE or task.answer != part(
                    task.kind, task.payload, answer[DURATION.size :]
                ):
                    raise _did_not_repeat(task)
        except (EOFError, OSError):
            raise self._never_met() from None
        self._original = None

    def death(self) -> SlaveCrashedError:
        """The error that it died of what it was asked; not to be closed before.

        Raises:
            SlaveError: as `meet`.
        """
        self.meet()  # it may have told its number and died then
        return death(self._exit_code)

    def loss(self) -> SlaveKilledError:
        """The error that it died while it was asked for nothing; not to be closed before.

        Raises:
            SlaveError: as `meet`.
        """
        self.meet()
        return SlaveKilledError(f"the process that held the model {how_ended(self._exit_code)}")

    @property
    def _exit_code(self) -> int | None:
        return self._family.exit_code(self._process, self._birth)

    def _never_met(self) -> SlaveKilledError:
        """The error that it died before it stood where it was to stand."""
        who, dead = "the process that was to hold a saved state", self
        if not self._process and self._original is not None:
            who, dead = f"{who} is not there: its original", self._original
        return SlaveKilledError(f"{who} {how_ended(dead._exit_code)}")

    def close(self) -> None:
        """Let it end. Idempotent."""
        self._channel.close()


def refusal(answer: bytes) -> DoublestepError:
    """The error in an answer that is not `Message.DONE`."""
    error = decode_reply([], answer).error
    assert error is not None
    return error


def _did_not_repeat(task: Task) -> SlaveError:
    what = "a step" if task.kind is Message.STEP else "what it did"
    return SlaveError(
        f"the model does not repeat: {what}, done again from the same state, ended otherwise",
        remedy='let its state not be saved: state = "none"',
    )
