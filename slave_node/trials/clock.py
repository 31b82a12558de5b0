"""Internal clocks: of many small steps, which move a continuous output?

Discrete outputs do not count: what changes at events is no clock of the others, and in no estimate.
A model that moves only at multiples of a time is found by steps that are shorter than this; two of
the moments are then bisected.
"""

from __future__ import annotations

from contextlib import suppress
from itertools import pairwise

import numpy as np

from slave_node.trials.steps import Place, Reading, TrialError, freed

_COARSER = 8.0
"""From one level of step sizes to the next."""

_ALL_MOVE = 8
"""After so many steps in a row that move an output there is no clock longer than they are."""

_STEPS = 40
_TICKS = 3
_BISECTIONS = 24

_NO_MATTER = 1e-3
"""Of the tolerance: outputs that move by less, but do move, have no clock that matters."""


class SlowError(Exception):
    """Steps take so long that larger ones are not tried."""


def internal_clock(place: Place) -> float | None:
    """At multiples of which time the outputs move [s]; None if at any time, or not at all.

    From the smallest steps upwards: the first ones of which any moves an output tell.

    Raises:
        SlowError: larger steps would take too long; none of those up to here tells.
    """
    trial = place.trial
    for size in trial.sizes(_COARSER, 0.5 * trial.largest_step):
        before = trial.time_left
        try:
            moves = _moves(place, size)
        except TrialError:  # a step that is too short, or too long, for the model
            continue
        if moves is None or (moves and all(moves)):
            return None
        if len(_clear_ticks(moves)) >= _TICKS:
            with suppress(TrialError):
                return _period(place, size, moves)
            return None
        if trial.time_left < _COARSER * (before - trial.time_left):
            raise SlowError(f"more than {size:.3g} s")
    return None


def _moves(place: Place, size: float) -> list[bool] | None:
    """Which steps move an output, beginning with the second one; None: all, or by little.

    Up to the third one that does so after one that does not.
    """
    place.restored()
    last = place.step(size)
    moves: list[bool] = []
    while len(moves) < (3 * _STEPS if any(moves) else _STEPS):
        following = place.step(size)
        has_moved = _differ(last, following)
        if has_moved and place.trial.norm(last, following) <= _NO_MATTER:
            return None
        moves.append(has_moved)
        last = following
        if len(_clear_ticks(moves)) == _TICKS or (len(moves) == _ALL_MOVE and all(moves)):
            break
    return moves


def _differ(last: Reading, following: Reading) -> bool:
    return not np.array_equal(last.values, following.values)


def _clear_ticks(moves: list[bool]) -> list[int]:
    """The steps that move an output after one that does not: no tiny step is needed to bisect."""
    return [i for i in range(1, len(moves)) if moves[i] and not moves[i - 1]]


def _period(place: Place, size: float, moves: list[bool]) -> float | None:
    """The time between equally distant ticks; None if they are not."""
    ticks = [i for i, moved in enumerate(moves) if moved]
    gaps = [b - a for a, b in pairwise(ticks)]
    clear = _clear_ticks(moves)
    if max(gaps) - min(gaps) > 1:
        return None
    first, last = clear[0], clear[-1]
    begin, end = (_tick(place, size, i) for i in (first, last))
    accuracy = 4.0 * size * 0.5**_BISECTIONS
    return _plain((end - begin) / (ticks.index(last) - ticks.index(first)), accuracy)


def _tick(place: Place, size: float, index: int) -> float:
    """When the outputs move in step ``index``, counted from the second one [s]; after bisection."""
    place.restored()
    for _ in range(index):
        last = place.step(size)
    with freed(place.here()) as here:
        low, high = size, 2.0 * size
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            here.restored()
            moved = _differ(last, here.step(middle))
            low, high = (low, middle) if moved else (middle, high)
    return index * size + 0.5 * (low + high)


def _plain(value: float, accuracy: float) -> float:
    """The number of few digits, or else the reciprocal of a whole number, within ``accuracy``."""
    few = [float(f"{value:.{digits}e}") for digits in range(4)]
    more = [float(f"{value:.{digits}e}") for digits in range(4, 8)]
    for candidate in (*few, 1.0 / max(1, round(1.0 / value)), *more):
        if abs(candidate - value) <= accuracy:
            return candidate
    return value
