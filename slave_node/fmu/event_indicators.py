"""Changes of the domain of an event indicator z (FMI 2.0.4 section 3.1.1, FMI 3.0 section 3.1.1).

The domains are z > 0 and z <= 0, so an exact zero belongs to what is below it. A model may change
sides strictly beyond zero only, and one that asks z < 0 does in both directions. So an event is
not located *at* a zero that is reached from below, and where an indicator stands at zero after an
event, its leaving zero to either side is one more.
"""

from __future__ import annotations

import numpy as np

from protocol.signals import FloatArray

_BELOW = -np.finfo(float).tiny


def root_values(indicators: FloatArray, before: FloatArray) -> FloatArray:
    """Values that change their sign exactly where the indicators make an event, and are never 0.

    Args:
        indicators: z, shape (n_z,).
        before: z at the last event or communication point, shape (n_z,).
    """
    values: FloatArray = np.where(before == 0.0, np.abs(indicators), indicators)
    values[indicators == 0.0] = _BELOW
    return values


def make_event(indicators: FloatArray, before: FloatArray) -> bool:
    """True if any of the indicators has changed its domain, or has left zero; shapes (n_z,)."""
    changed = (indicators > 0.0) != (before > 0.0)
    left_zero = (before == 0.0) & (indicators != 0.0)
    return bool((changed | left_zero).any())
