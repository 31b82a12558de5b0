"""Trail of a process: calls since it was a copy of another, and their answers.

A copy of the same original that is asked the same stands where that process stands: what steps of
microseconds have changed is done again sooner than it is copied.
"""

from __future__ import annotations

from typing import NamedTuple

from slave_node.states.channel import Message

_MOST_STEPS = 64
_LONGEST = 5e-3  # [s], a few times what it costs to copy a process and to end it
_LARGEST = 2**15  # less than what sockets hold: it is sent, and answered, without waiting


class Task(NamedTuple):
    """A message to a process that holds a model, and of its answer what is to repeat."""

    kind: Message
    payload: bytes
    answer: bytes


class Trail(NamedTuple):
    """All since the original, in order.

    Attributes:
        tasks: what was asked.
        duration: what it took [s].
        size: bytes of messages and answers.
    """

    tasks: tuple[Task, ...] = ()
    duration: float = 0.0
    size: int = 0

    def after(self, task: Task, duration: float) -> Trail | None:
        """With one more; None if a copy of the process is cheaper."""
        duration += self.duration
        size = self.size + len(task.payload) + len(task.answer)
        if len(self.tasks) == _MOST_STEPS or duration > _LONGEST or size > _LARGEST:
            return None
        return Trail((*self.tasks, task), duration, size)


START = Trail()
"""Trail of a copy that was asked nothing yet."""
