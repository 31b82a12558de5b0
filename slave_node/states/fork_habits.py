"""Forecast of what is asked of a slave next: what followed the same calls the last time.

A master repeats itself from one double step to the next. Whoever knows what comes can have the copy
of a process ready before it is asked for, and need not make one that is never asked for. To be
wrong costs time and nothing else.
"""

from __future__ import annotations

from enum import Enum, auto

_LENGTH = 4


class Event(Enum):
    """Event in the life of a slave that matters here.

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
"""Number of saved states, and at most four events, back to when one was last saved or restored."""


class Habits:
    """Remembers what followed in which situation. Its memory is bounded.

    Attributes:
        situation: in which the slave is now.
    """

    def __init__(self) -> None:
        self.situation: Situation = (0, ())
        self._followers: dict[Situation, Event] = {}
        self._uses: dict[Situation, Event | None] = {}

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

    def note_use(self, situation: Situation, use: Event | None) -> None:
        """First use of a state that was saved in a situation: ``RESTORE``, ``GIVE_UP``.

        None: it was freed.
        """
        self._uses[situation] = use

    def use(self, situation: Situation) -> Event | None:
        """Use of the last state saved in this situation; that of the first one is ``GIVE_UP``."""
        return self._uses.get(situation, Event.GIVE_UP)
