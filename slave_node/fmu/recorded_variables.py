"""Variables of an FMU that are read for results only: of any causality and type."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from protocol.calls import RecordedValues
from slave_node.fmu.instance import FmuInstance


class RecordedVariables:
    """Reads some variables of an FMU, as they are: finite or not.

    Args:
        instance: the FMU.
        names: of the variables.

    Raises:
        ModelError: there is none of a name.
        SlaveError: a variable is of a type that is not exchanged.
    """

    def __init__(self, instance: FmuInstance, names: Sequence[str]) -> None:
        places = instance.places(names)
        self._reals = instance.discrete([name for name in names if places[name].type.is_real])
        self._others = instance.discrete([name for name in names if not places[name].type.is_real])

    def values(self) -> RecordedValues:
        """Their present values."""
        return RecordedValues(
            np.array([self._reals.receive()], dtype=np.float64), self._others.receive()
        )
