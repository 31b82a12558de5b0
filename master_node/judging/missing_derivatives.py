"""Output derivatives that are not finite: told once for each slave, while a run goes on without."""

from __future__ import annotations

import logging

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.scheme import CouplingScheme
from protocol.signals import FloatArray

log = logging.getLogger("master_node")


class MissingDerivatives:
    """Looks at the outputs of communication points.

    Args:
        coupled: the system.
        scheme: says which derivatives are used.
    """

    def __init__(self, coupled: CoupledSystem, scheme: CouplingScheme) -> None:
        self._names = coupled.output_names
        self._slaves = [coupled.parts[slave].name for slave in coupled.output_slave]
        self._used = np.flatnonzero(scheme.has_derivative)
        self._told: set[str] = set()

    def note(self, y: FloatArray, time: float) -> None:
        """Warn of the derivatives that are missing at a communication point.

        Args:
            y: outputs there, shape (rows, m).
            time: of the point [s].
        """
        if not self._used.size:
            return
        is_missing = ~np.isfinite(y[1].take(self._used))
        if not is_missing.any():
            return
        missing = self._used[is_missing].tolist()
        for slave in dict.fromkeys(self._slaves[output] for output in missing):
            if slave not in self._told:
                self._told.add(slave)
                log.warning(
                    "%s: the derivatives of %s are not finite at t=%r s: where they are not, input "
                    "polynomials meet values only (derivative_points in steps.csv)",
                    slave,
                    ", ".join(self._names[i] for i in missing if self._slaves[i] == slave),
                    time,
                )
