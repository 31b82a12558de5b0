"""What is likely to be asked of a slave next: what followed the same calls the last time.

A master repeats itself from one double step to the next. Whoever knows what comes can have the copy
of a process ready before it is asked for, and need not make one that nobody will ask for. To be
wrong costs time and nothing else.
"""

from __future__ import annotations

from enum import Enum, auto

_LENGTH = 4


class Event(Enum):
    """What is asked of a slave that matters here.

    ``SAVE``, ``RESTORE`` (the state stays saved), ``GIVE_UP`` (it does not), ``STEP``, and ``RUN``:
    any other calls.
    """

    SAVE = auto()
    RESTORE = auto()
    GIVE_UP = auto()
    STEP = auto()
    RUN = auto()


_BEGINS = frozenset((Event.SAVE, Event.RESTORE, Event.GIVE_UP))

Situation = tuple[int, tuple[Event, ...]]
"""How many states are saved, and the events back to when one was last saved or restored, at most
four."""


class Habits:
    """Remembers what followed in which situation. Its memory is bounded.

    Attributes:
        situation: in which the slave is now.
    """

    def __init__(self) -> None:
        self.situation: Situation = (0, ())
        self._followers: dict[Situation, Event] = {}
        self._are_restored: dict[Situation, bool] = {}

    def note(self, event: Event, saved: int) -> None:
        """An event, and how many states are saved at it."""
        self._followers[self.situation] = event
        _, events = self.situation
        events = (event,) if event in _BEGINS else (*events, event)[-_LENGTH:]
        self.situation = (saved, events)

    @property
    def expected(self) -> Event | None:
        """The event that followed here the last time; None: there was no last time."""
        return self._followers.get(self.situation)

    def note_use(self, situation: Situation, *, is_restored: bool) -> None:
        """Whether a state that was saved in a situation was restored before it was freed."""
        self._are_restored[situation] = is_restored

    @property
    def saves_for_nothing(self) -> bool:
        """Whether the last state that was saved in this situation was never restored."""
        return not self._are_restored.get(self.situation, True)
