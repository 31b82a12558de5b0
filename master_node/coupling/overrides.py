"""Connected inputs that are cut from their sources, and held at values of their own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.signals import FloatArray
from protocol.variables import StartValue


class HeldValue(NamedTuple):
    """Value of a connected discrete input.

    Attributes:
        slave: index of its slave.
        input: index among the connected discrete inputs of the slave.
        value: of the input.
    """

    slave: int
    input: int
    value: StartValue


class Overrides(NamedTuple):
    """Overridden inputs.

    Attributes:
        columns: indices of continuous ones among the connected inputs of the system.
        values: of these, unit [u].
        held: those that are not continuous.
    """

    columns: tuple[int, ...] = ()
    values: tuple[float, ...] = ()
    held: tuple[HeldValue, ...] = ()

    @property
    def is_empty(self) -> bool:
        """True if no input is overridden."""
        return not self.columns and not self.held


NO_OVERRIDES = Overrides()


class OverriddenInputs:
    """Overrides that hold now: the one thing in a coupled system that changes during a run."""

    def __init__(self) -> None:
        self.set(NO_OVERRIDES)

    def set(self, overrides: Overrides) -> None:
        """Let these hold, and no others."""
        self.present = overrides
        self._columns: NDArray[np.intp] = np.array(overrides.columns, np.intp)
        self._values = np.array(overrides.values)
        self._held = {(one.slave, one.input): one.value for one in overrides.held}

    def put_into(self, u: FloatArray) -> None:
        """Replace columns of connected inputs, shape (n,) or (rows, n); derivatives become 0."""
        if not self.present.columns:
            return
        if u.ndim > 1:
            u[:, self._columns] = 0.0
            u[0, self._columns] = self._values
        else:
            u[self._columns] = self._values

    def without_changes(self, u: FloatArray) -> FloatArray:
        """Changes of connected inputs, shape (..., n), where overridden ones do not change."""
        if self.present.columns:
            u[..., self._columns] = 0.0
        return u

    def of_slave(self, slave: int, values: tuple[StartValue, ...]) -> tuple[StartValue, ...]:
        """Values of the connected discrete inputs of a slave, with those that are overridden."""
        if not self._held:
            return values
        return tuple(self._held.get((slave, i), value) for i, value in enumerate(values))
