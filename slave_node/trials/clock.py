"""Internal clocks: of many small steps, which move a continuous output?

Discrete outputs do not count: what changes at events is no clock of the others, and in no estimate.
A model that moves only at multiples of a time is found by steps that are shorter than this; two of
the moments are then bisected. Signals that switch at equal distances, whatever the inputs do, are
no clock: their jumps are met one by one.
"""

from __future__ import annotations

from contextlib import suppress
from itertools import pairwise

import numpy as np

from protocol.signals import FloatArray
from slave_node.trials.steps import Place, Reading, TrialError, freed

_COARSER = 8.0
"""From one level of step sizes to the next."""

_ALL_MOVE = 8
"""After so many steps in a row that move an output there is no clock longer than they are."""

_STEPS = 40
_TICKS = 3
_BISECTIONS = 24

_FEWEST_TICKS = 4.0
"""In the longest trial step, a 32nd of the run: fewer of them are jumps, each with a search."""

_ALIKE = 0.75
"""Largest difference of successive changes, relative to the larger one, in a smooth signal."""

_NO_MATTER = 1e-3
"""Part of the tolerance: outputs that move by less, but do move, have no clock that matters."""


class SlowError(Exception):
    """Steps take so long that larger ones are not tried."""


def internal_clock(place: Place) -> float | None:
    """At multiples of which time the outputs move [s]; None if at any time, or not at all.

    From the smallest steps upwards: the first ones of which any moves an output tell. Outputs that
    switch (`_switches`) have no clock.

    Raises:
        SlowError: larger steps would take too long; none of those up to here tells.
    """
    trial = place.trial
    for size in trial.sizes(_COARSER, 0.5 * trial.largest_step):
        before = trial.time_left
        try:
            changes = _changes(place, size)
        except TrialError:  # a step that is too short, or too long, for the model
            continue
        if changes is None:
            return None
        moves = [bool(change.any()) for change in changes]
        if moves and all(moves):
            return None
        if len(_clear_ticks(moves)) >= _TICKS:
            with suppress(TrialError):
                period = _period(place, size, moves)
                if period is None or not _switches(place, size, changes, period):
                    return period
            return None
        if trial.time_left < _COARSER * (before - trial.time_left):
            raise SlowError(f"more than {size:.3g} s")
    return None


def _changes(place: Place, size: float) -> list[FloatArray] | None:
    """Changes of the outputs in steps, beginning with the second one, each of shape (n,).

    Up to the third step that moves any after one that does not; None: they move by little.
    """
    place.restored()
    last = place.step(size)
    changes: list[FloatArray] = []
    moves: list[bool] = []
    while len(moves) < (3 * _STEPS if any(moves) else _STEPS):
        following = place.step(size)
        has_moved = _differ(last, following)
        if has_moved and place.trial.norm(last, following) <= _NO_MATTER:
            return None
        changes.append(following.values - last.values)
        moves.append(has_moved)
        last = following
        if len(_clear_ticks(moves)) == _TICKS or (len(moves) == _ALL_MOVE and all(moves)):
            break
    return changes


def _switches(place: Place, size: float, changes: list[FloatArray], period: float) -> bool:
    """True if outputs jump by themselves: no input waits for ticks, and these are few or unlike.

    A grid on such ticks takes jumps for samples of something smooth: of a signal that is 1 in every
    second period its points see a constant.

    Args:
        place: where the slave stands.
        size: of the trial steps [s].
        changes: of the outputs in these.
        period: between ticks [s].
    """
    are_few = _FEWEST_TICKS * period > place.trial.largest_step
    moves = [bool(change.any()) for change in changes]
    heights = np.array(changes)[moves]
    return (are_few or not _are_samples(heights)) and not _waits_for_ticks(place, size, moves)


def _are_samples(heights: FloatArray) -> bool:
    """True if changes at successive ticks, shape (ticks, n), may be those of one smooth signal."""
    before, behind = heights[:-1], heights[1:]
    larger = np.maximum(np.abs(before), np.abs(behind))
    return bool(np.all(np.abs(behind - before) <= _ALIKE * larger))


def _waits_for_ticks(place: Place, size: float, moves: list[bool]) -> bool:
    """True if the outputs answer to inputs that are moved between two ticks, and not before one."""
    trial = place.trial
    if not trial.call.inputs:
        return False

    def after(steps: int, moved_after: int) -> Reading:
        place.restored()
        for i in range(steps):
            if i == moved_after:
                trial.move_inputs()
            reading = place.step(size)
        return reading

    ticks, end = _clear_ticks(moves), len(moves) + 1
    if any(_differ(after(tick, tick), after(tick + 1, tick)) for tick in ticks):
        return False
    return any(_differ(after(end, end), after(end, tick)) for tick in ticks)


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
    """Time at which the outputs move in step ``index``, counted from the second one [s]."""
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
