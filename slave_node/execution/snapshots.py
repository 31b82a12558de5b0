"""The saved states of one slave, by the numbers that the master gave them; bounded."""

from __future__ import annotations

from collections.abc import Callable

from protocol.errors import SlaveError
from protocol.slave import Slave

LIMIT = 128
"""A double step holds two, a session up to a hundred marks; more than this is a master that forgets
to free them."""


class SnapshotStore:
    """Owns the saved states: each is freed exactly once, at the latest by `clear`."""

    def __init__(self, slave: Slave, limit: int = LIMIT) -> None:
        self._slave = slave
        self._get_state, self._free_state = slave.get_state, slave.free_state
        self._limit = limit
        self._states: dict[int, object] = {}

    def __len__(self) -> int:
        return len(self._states)

    def save(self, number: int) -> None:
        """Save the slave's state under ``number``; what was saved under it is freed.

        Raises:
            SlaveError: the store is full, or the slave cannot.
        """
        self._put(number, self._get_state)

    def restore(self, number: int, *, free: bool = False) -> None:
        """Let the slave go back to the state; it stays saved unless ``free``."""
        state = self._get(number)
        if free:
            del self._states[number]
            self._slave.set_state_and_free(state)
        else:
            self._slave.set_state(state)

    def free(self, number: int) -> None:
        """Give the state up."""
        state = self._get(number)
        del self._states[number]
        self._slave.free_state(state)

    def serialize(self, number: int) -> bytes:
        """The state as bytes."""
        return self._slave.serialize_state(self._get(number))

    def deserialize(self, number: int, data: bytes) -> None:
        """Make the state from bytes; otherwise as `save`."""
        self._put(number, lambda: self._slave.deserialize_state(data))

    def clear(self) -> None:
        """Free all."""
        while self._states:
            _, state = self._states.popitem()
            self._slave.free_state(state)

    def _get(self, number: int) -> object:
        try:
            return self._states[number]
        except KeyError:
            saved = ", ".join(map(str, sorted(self._states))) or "none"
            raise SlaveError(f"no state is saved under number {number}; saved: {saved}") from None

    def _put(self, number: int, make: Callable[[], object]) -> None:
        states = self._states
        if number in states:
            old = states[number]
            states[number] = make()
            self._free_state(old)
        elif len(states) < self._limit:
            states[number] = make()
        else:
            raise SlaveError(
                f"{self._limit} states are saved already", remedy="free states that are not needed"
            )
