"""Restless discrete outputs: those that change in every step, as a continuous signal does.

The search for a change halves H until the change lies in one small step alone. An output that
tools declare discrete, and that moves all the time, never lets it end.
"""

from __future__ import annotations

from collections.abc import Set
from typing import NamedTuple

IN_A_ROW = 16
"""So many double steps in a row with changes in both small steps make an output restless. The
search halves H from one to the next: a clock would have ticked 2^16 times in the first of them."""


class RestlessOutputs(NamedTuple):
    """Knowledge of which discrete outputs are restless.

    Attributes:
        counts: of outputs by index, the number of double steps in which both small steps changed
            it, since the last one in which neither did.
    """

    counts: tuple[tuple[int, int], ...] = ()

    @property
    def outputs(self) -> frozenset[int]:
        """Indices of the outputs whose changes are not searched for."""
        return frozenset(index for index, count in self.counts if count >= IN_A_ROW)

    def noted(self, first: Set[int], second: Set[int]) -> RestlessOutputs:
        """The knowledge behind one more double step, be it accepted or not.

        Args:
            first: indices of the outputs that changed in its first small step.
            second: of those that changed in its second one.
        """
        if not first and not second:
            return RestlessOutputs()
        counts = dict(self.counts)
        return RestlessOutputs(
            tuple(
                (index, counts.get(index, 0) + (index in first and index in second))
                for index in sorted(first | second)
            )
        )
