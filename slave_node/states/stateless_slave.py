"""`StatelessSlave`: a slave whose state is not to be saved, whatever its model can."""

from __future__ import annotations

from dataclasses import replace
from typing import NoReturn

from protocol.description import StateKind
from protocol.errors import SlaveError
from protocol.slave import Slave
from slave_node.wrapped_slave import WrappedSlave


class StatelessSlave(WrappedSlave):
    """Hands on all calls but those to saved states.

    Args:
        slave: closed with this one.
        reason: why its state is not saved.
    """

    def __init__(self, slave: Slave, reason: str) -> None:
        super().__init__(slave)
        self.description = replace(
            slave.description, state_kind=StateKind.NONE, state_reason=reason
        )

    def _refuse(self) -> NoReturn:
        raise SlaveError(
            f"the state of {self.description.model} is not saved: {self.description.state_reason}"
        )

    def get_state(self) -> object:
        """Raises `SlaveError`, as all that is about saved states."""
        self._refuse()

    def set_state(self, state: object) -> None:  # noqa: ARG002
        """See `get_state`."""
        self._refuse()

    def free_state(self, state: object) -> None:  # noqa: ARG002
        """See `get_state`."""
        self._refuse()

    def serialize_state(self, state: object) -> bytes:  # noqa: ARG002
        """See `get_state`."""
        self._refuse()

    def deserialize_state(self, data: bytes) -> object:  # noqa: ARG002
        """See `get_state`."""
        self._refuse()
