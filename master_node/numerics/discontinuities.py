"""Finding jumps of the coupled variables and stepping up to them.

A jump shows in how far an input is from what its polynomial said: the defect. Where everything is
smooth it shrinks with H at least in proportion, and the defects of both small steps are alike. A
jump keeps its size however small H is (repeated rejection), or appears in the second small step
only, where neither solution of a double step has noticed it.

The jump is then known to lie in a bracket (T_n, b]. Steps that reach half of it tell in which half
it lies, until the smallest H is reached; one last double step of that size crosses it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from master_node.numerics.double_step_times import DoubleStepTimes
from protocol.signals import FloatArray

_MUCH_SMALLER = 0.25
"""Part of H at which the defect of a smooth input is less than half of what it was."""

_PART = 0.5
"""Of a change that was foreseen: a smaller defect is one of a smooth input."""

_SURPRISE, _TWICE = 10.0, 2.0
"""How many times larger than expected, and than the change that was foreseen, a defect is that only
a jump explains."""


class Defects(NamedTuple):
    """How far the inputs at T_n + H and T_n + 2H are from their polynomials' values there.

    Attributes:
        middle, end: largest weighted defects; above 1 an input is off by more than the tolerance
            of the output behind it.
        expected: ``end`` as ``middle`` and the step before let expect it, were everything smooth.
        change: weighted change that the polynomial said for the input with the largest defect.
        input_number: index of that input.

    The last three say something only where one of the first two is above 1: else nothing jumps.
    """

    middle: float
    end: float
    expected: float = 0.0
    change: float = 0.0
    input_number: int = -1

    @property
    def largest(self) -> float:
        """Of both points."""
        return max(self.middle, self.end)

    @property
    def is_like_a_jump(self) -> bool:
        """Whether an input is off by more than its tolerance and a part of the foreseen change."""
        return self.largest > max(1.0, _PART * self.change)


class Bracket(NamedTuple):
    """What is known of a jump.

    Attributes:
        end: the jump lies after T_n and not after this [s]; None: no jump is looked for.
        rejected: step size and largest defect of the first attempt from T_n that was rejected.
        confirmed: whether the search has met the jump again since it began; until then it may be
            a false alarm.
        size: largest defect when the search began.
    """

    end: float | None = None
    rejected: tuple[float, float] | None = None
    confirmed: bool = False
    size: float = 0.0

    def shows_jump(self, defects: Defects) -> bool:
        """Whether the jump that is looked for is in a step with these defects."""
        is_as_large = defects.largest > _PART * self.size
        return self.end is not None and is_as_large and defects.is_like_a_jump

    def after_rejection(self, times: DoubleStepTimes, defects: Defects) -> Bracket:
        """The jump lies in the step that was rejected."""
        is_in_first = defects.middle >= 0.5 * defects.largest
        return Bracket(
            times.middle if is_in_first else times.end,
            (times.first, defects.largest),
            self.end is not None,
            defects.largest if self.end is None else self.size,
        )

    def after_acceptance(self, time: float) -> Bracket:
        """The jump lies behind the new T_n ``time`` [s], if there is any."""
        if self.end is None or time >= self.end:
            return Bracket()
        return self._replace(rejected=None)


def measure(defect: FloatArray, scale: FloatArray) -> tuple[float, int]:
    """The largest defect over its tolerance, and its input; 0 and -1 without inputs.

    Args:
        defect: shape (n,), unit [u]; overwritten.
        scale: the tolerances, shape (n,), unit [u].
    """
    if not len(defect):
        return 0.0, -1
    np.abs(defect, out=defect)
    defect /= scale
    index = int(defect.argmax())
    return float(defect[index]), index


def has_jumped_unnoticed(defects: Defects) -> bool:
    """Whether an input jumped in the second small step, of which ERR knows nothing."""
    is_at_end = defects.end == defects.largest and defects.end > _SURPRISE * defects.expected
    return is_at_end and defects.end > max(1.0, _TWICE * defects.change)


def does_not_shrink(bracket: Bracket, step_size: float, defects: Defects) -> bool:
    """Whether rejections from the same T_n show a defect that has nothing to do with H."""
    if bracket.rejected is None or not defects.is_like_a_jump:
        return False
    larger, before = bracket.rejected
    return step_size <= _MUCH_SMALLER * larger and defects.largest > _PART * before


def step_within(bracket: Bracket, time: float, step_size: float, smallest: float) -> float:
    """H for the next attempt: not more than leads to the middle of the bracket [s].

    After a first step that met no jump, all that is left is tried at once: it may be a false alarm.
    """
    if bracket.end is None:
        return step_size
    half = 4.0 if bracket.confirmed or bracket.rejected is not None else 2.0
    return max(smallest, min(step_size, (bracket.end - time) / half))


NO_JUMP = Bracket()
"""Nothing is looked for."""
