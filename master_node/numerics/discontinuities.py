"""Finding jumps of the coupled variables and stepping up to them.

A jump shows in how far an input is from what its polynomial said: the defect. Where an input is
smooth its defect shrinks with H at least in proportion, and it is alike in both small steps and in
the step before. So each input is compared with itself, and a jump of it shows in one of three ways:

- its defect at T_n + 2H is far above what the first small step and the step before let expect. The
  source has jumped after the last exchange, and ERR knows nothing of it;
- ERR is within the tolerance, and the defect at T_n + H is far above what the step before lets
  expect: the slaves that it feeds do not react yet, or the estimate says too little of a jump;
- rejections from the same T_n make H smaller, and the defect stays.

The jump is then known to lie in a bracket (T_n, b]. Steps that reach half of it tell in which half
it lies, until the smallest H is reached; one last double step of that size crosses it. A jump that
seems to lie at T_n itself is looked at with a step of the smallest size at once.
"""

from __future__ import annotations

from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from master_node.numerics.double_step_times import DoubleStepTimes
from protocol.signals import FloatArray

Inputs = NDArray[np.bool_]
"""Some of the inputs, shape (n,)."""

_MUCH_SMALLER = 0.25
"""Part of H at which the defect of a smooth input is less than half of what it was."""

_PART = 0.5
"""Fraction of a change that was foreseen: a smaller defect is one of a smooth input."""

_SHARE = 0.1
"""Part of the jump that is looked for, above which another one beside it is met too: several jumps
of an input may lie in one bracket."""

_SURPRISE, _TWICE = 10.0, 2.0
"""Factor by which a defect exceeds what was expected, and the change that was foreseen, that only
a jump explains."""

_FAR, _GREAT_SURPRISE = 10.0, 50.0
"""Tolerances, and defects as expected, that a jump in the first small step is larger than: ERR is
content with smaller ones."""

_OVERSHOOT = 0.1
"""Part of the defect at T_n + 2H that the one at T_n + H is, where it comes from the same jump."""

_MISSES = 2
"""Accepted double steps in a row that meet no jump, after which the rest is tried at once."""

_DOUBT = 4.0
"""Factor by which a defect must be larger after a false alarm of the same input."""

_FIRSTS = 2
"""Attempts from T_n with the jump in their first steps, after which it may lie at T_n itself."""

_LONGER = 64.0
"""Factor by which a step is above the smallest H, for a look at T_n itself to save steps."""


class SmoothStep(NamedTuple):
    """The defects to come, as the last accepted step lets expect them. Arrays have shape (n,).

    Attributes:
        step_size: H [s].
        defects: the larger ones of both small steps.
        echoes: defects at its end of outputs that depend directly on inputs, as estimated. Such an
            output changes at once by its error when the next step begins with the true input.
        corrections: defects at its end of the inputs whose polynomials were wrong there: by so much
            they change at once when the next step begins.
    """

    step_size: float
    defects: FloatArray
    echoes: FloatArray
    corrections: FloatArray

    def expected(self, step_size: float, order: int) -> FloatArray:
        """The defects in a small step of H with polynomials of degree k, shape (n,).

        Args:
            step_size: H [s].
            order: k.
        """
        growth = (step_size / self.step_size) ** (order + 1)
        larger: FloatArray = np.maximum(self.defects * growth, self.echoes)
        return larger


class Defects(NamedTuple):
    """Distances of the inputs at T_n + H and T_n + 2H from the values of their polynomials there.

    All have shape (n,) and, but for the last, count in tolerances of the outputs behind the inputs.

    Attributes:
        middle, end: the defects.
        changes_middle, changes_end: that the polynomials said from the beginning of each small
            step to its end.
        expected_middle, expected_end: the defects, were everything smooth; not finite where
            nothing is known.
        scale: these tolerances, unit [u].

    Where no defect is above 1 nothing jumps, and the four before the scale are those defects
    themselves.
    """

    middle: FloatArray
    end: FloatArray
    changes_middle: FloatArray
    changes_end: FloatArray
    expected_middle: FloatArray
    expected_end: FloatArray
    scale: FloatArray

    @staticmethod
    def within_tolerance(middle: FloatArray, end: FloatArray, scale: FloatArray) -> Defects:
        """Where no defect is above 1."""
        return Defects(middle, end, middle, end, middle, end, scale)

    @property
    def are_within_tolerance(self) -> bool:
        """True if no defect is above 1."""
        return self.expected_end is self.end

    @property
    def largest(self) -> FloatArray:
        """The larger ones of both points."""
        larger: FloatArray = np.maximum(self.middle, self.end)
        return larger

    @property
    def are_in_middle(self) -> Inputs:
        """Inputs that jumped in the first small step, if they jumped.

        The second polynomial goes through such a jump, and overshoots by a few times its size.
        """
        return self.middle >= _OVERSHOOT * self.end

    @property
    def sizes(self) -> FloatArray:
        """Sizes of the jumps, if the inputs jumped, shape (n,), unit [u]."""
        return np.where(self.are_in_middle, self.middle, self.end) * self.scale

    @property
    def like_jumps(self) -> Inputs:
        """Inputs that are off by more than their tolerance and a part of the foreseen change."""
        return _are_above(self.middle, 1.0, _PART * self.changes_middle) | _are_above(
            self.end, 1.0, _PART * self.changes_end
        )

    def jumps_at_end(self, doubts: FloatArray) -> Inputs:
        """Inputs that jumped in the second small step, of which ERR knows nothing."""
        return (self.end > self.middle) & are_jumps(
            self.end / doubts, self.changes_end, self.expected_end
        )

    def jumps_in_middle(self, doubts: FloatArray) -> Inputs:
        """Inputs that jumped in the first small step, by more than ERR need know of."""
        believed = self.middle / doubts
        is_great = _are_above(believed, _FAR, _GREAT_SURPRISE * self.expected_middle)
        return is_great & (believed > _TWICE * self.changes_middle)


def are_jumps(defects: FloatArray, changes: FloatArray, expected: FloatArray) -> Inputs:
    """Inputs whose defects only jumps explain, shape (n,).

    Args:
        defects: in tolerances, as all others, shape (n,).
        changes: that the polynomials foresaw, shape (n,).
        expected: defects where everything is smooth, shape (n,).
    """
    return _are_above(defects, 1.0, _TWICE * changes, _SURPRISE * expected)


def _are_above(defects: FloatArray, *bounds: FloatArray | float) -> Inputs:
    """Defects above all bounds; never above one that is not a number."""
    above = np.ones(len(defects), dtype=bool)
    for bound in bounds:
        above &= defects > bound
    return above


class Search(NamedTuple):
    """Knowledge of jumps behind T_n.

    Attributes:
        doubts: how many times larger than usual a defect must be to be taken for a jump, after
            false alarms of the same input, shape (n,).
        end: the jump lies after T_n and not after this [s]; None: no jump is looked for.
        sizes: of the jumps when the search began, infinite for inputs that are not searched, shape
            (n,), unit [u].
        rejected: step size and sizes, as if inputs had jumped, of the first attempt from T_n that
            was rejected.
        is_confirmed: whether the search has met the jump again since it began; until then it may
            be a false alarm.
        firsts: attempts from T_n in a row with the jump in their first small steps.
        misses: accepted double steps in a row that met no jump, since the search has met it.
        looks_at_point: whether the next attempt is of the smallest size, and is there to tell
            whether the jump lies at T_n itself.
        has_looked: whether there was such an attempt from T_n.
        is_at_point: whether inputs turned out to jump at T_n itself, as slaves answer there to
            what their own inputs are: no step size helps, and ERR decides.
        attempts: double steps that the search has taken.
    """

    doubts: FloatArray
    end: float | None = None
    sizes: FloatArray | None = None
    rejected: tuple[float, FloatArray] | None = None
    is_confirmed: bool = False
    firsts: int = 0
    misses: int = 0
    looks_at_point: bool = False
    has_looked: bool = False
    is_at_point: bool = False
    attempts: int = 0

    @staticmethod
    def nothing(number: int) -> Search:
        """The beginning for ``number`` inputs: nothing is looked for, no false alarm is known."""
        return Search(np.ones(number))

    def ended(self) -> Search:
        """Nothing is looked for; what false alarms have taught stays."""
        return Search(self.doubts)

    @property
    def is_near(self) -> bool:
        """Tell whether a jump is known where ERR > 1 shows one that no defect shows.

        The solutions of a double step may meet a jump at its end in one of them alone.
        """
        return self.is_at_point or self.end is not None

    def jumps(self, defects: Defects, step_size: float, *, is_accurate: bool) -> Inputs:
        """The inputs that jump in an attempt from T_n, shape (n,).

        Args:
            defects: of the attempt.
            step_size: its H [s].
            is_accurate: whether ERR is within the tolerance.
        """
        jumping = np.zeros(len(self.doubts), dtype=bool)
        if defects.are_within_tolerance:
            return jumping
        if is_accurate:
            jumping |= defects.jumps_at_end(self.doubts)
            if not self.is_at_point:
                jumping |= defects.jumps_in_middle(self.doubts)
        if self.sizes is not None:
            stay = (defects.sizes > _PART * self.sizes) & defects.like_jumps
            jumping &= ~np.isfinite(self.sizes) | (defects.sizes > _SHARE * self.sizes)
            jumping |= np.isfinite(self.sizes) & stay
        elif self.rejected is not None and self._is_much_smaller(step_size):
            stay = (defects.sizes > _PART * self.rejected[1]) & (not self.is_at_point)
            jumping |= stay & defects.like_jumps
        return jumping

    def _is_much_smaller(self, step_size: float) -> bool:
        """Tell whether defects of smooth inputs have shrunk since the first rejection from T_n."""
        return self.rejected is not None and step_size <= _MUCH_SMALLER * self.rejected[0]

    def after_rejection(self, step_size: float, defects: Defects) -> Search:
        """After an attempt that ERR has rejected and that showed no jump."""
        if self.rejected is not None or self.end is not None:
            return self
        return self._replace(rejected=(step_size, defects.sizes))

    def found(
        self, times: DoubleStepTimes, defects: Defects, jumping: Inputs, smallest: float
    ) -> Search:
        """After an attempt in which inputs jump: one of them lies in it.

        Args:
            times: of the attempt.
            defects: of the attempt.
            jumping: the inputs, shape (n,).
            smallest: H [s].
        """
        is_in_first = bool((jumping & defects.are_in_middle).any())
        sizes = np.where(jumping, defects.sizes, np.inf)
        if self.sizes is not None:
            sizes = np.where(np.isfinite(self.sizes), self.sizes, sizes)
        firsts = 0
        if is_in_first:
            has_stayed = self.end is None and self._is_much_smaller(times.first)
            firsts = _FIRSTS if has_stayed else self.firsts + 1
        return self._replace(
            end=times.middle if is_in_first else times.end,
            sizes=sizes,
            rejected=(times.first, defects.sizes),
            is_confirmed=self.end is not None,
            firsts=firsts,
            misses=0,
            looks_at_point=(
                firsts >= _FIRSTS and not self.has_looked and times.first > _LONGER * smallest
            ),
            attempts=self.attempts + 1,
        )

    def not_at_point(self) -> Search:
        """After a look at T_n that met no jump: it lies behind it."""
        return self._replace(looks_at_point=False, has_looked=True, attempts=self.attempts + 1)

    def at_point(self, jumping: Inputs) -> Search:
        """After a jump that lies at T_n itself: a false alarm, that is not to be raised again."""
        return Search(np.where(jumping, _DOUBT * self.doubts, self.doubts), is_at_point=True)

    def passed(self, time: float) -> Search:
        """After an accepted double step to ``time`` [s] that met no jump."""
        if self.end is None:
            return self.ended()
        if time < self.end:
            return self._replace(
                rejected=None,
                firsts=0,
                misses=self.misses + 1,
                has_looked=False,
                attempts=self.attempts + 1,
            )
        assert self.sizes is not None  # as for every search
        doubts = np.where(np.isfinite(self.sizes), _DOUBT * self.doubts, self.doubts)
        return Search(doubts)

    def crossed(self) -> Search:
        """Behind a jump: inputs that did jump are not doubted."""
        if self.sizes is None:
            return self.ended()
        return Search(np.where(np.isfinite(self.sizes), 1.0, self.doubts))

    def step_size(self, time: float, wanted: float, smallest: float) -> float:
        """H for the next attempt: not more than leads to the middle of the bracket [s].

        After a first step that met no jump, or two later ones, all that is left is tried at once,
        or in equal steps where H is smaller: it may be a false alarm.

        Args:
            time: T_n [s].
            wanted: H without a search [s].
            smallest: H [s].
        """
        if self.end is None:
            return wanted
        if self.looks_at_point:
            return smallest
        rest = (self.end - time) / 2.0
        if self.rejected is None and (self.misses >= _MISSES or not self.is_confirmed):
            rest /= max(1.0, ceil(rest / wanted))  # no tiny step is left at the end
        else:
            rest /= 2.0
        return max(smallest, min(wanted, rest))
