"""Steps that depend on their size: one step of 2h against two of h.

For a model that integrates as accurately as it was asked to, both are the same but for its
tolerance. One that takes one step of its own in each do_step differs by a power of h.
"""

from __future__ import annotations

from contextlib import suppress
from math import log

import numpy as np

from protocol.description import SUBSTEP_ERROR
from slave_node.trials.clock import SlowError
from slave_node.trials.steps import Place, Reading, TrialError

_LARGER = 4.0
"""From one h to the next."""

_NOTICED = 1.0
_HALVINGS = 14


def step_counters(place: Place) -> tuple[str, ...]:
    """Outputs that no other slave depends on, and that tell how many steps led to a point.

    With the shortest steps one of 2h and two of h are the same for all others.
    """
    trial = place.trial
    for size in trial.sizes(_LARGER, 0.5 * trial.largest_step):
        try:
            whole, halves = _pair(place, size)
        except TrialError:  # a step that is too short for the model
            continue
        parts = np.abs(whole.values - halves.values)
        apart = parts > trial.scale(whole.values, halves.values)
        names = [*trial.names(apart), *trial.differing_others(whole, halves)]
        return tuple(name for name in names if name not in trial.call.connected)
    return ()


def step_dependence(place: Place) -> tuple[float, float | None]:
    """Difference of one step of 2h from two of h, and the h up to which it does not matter [s].

    That difference is looked for with larger and larger h. When it is more than the tolerance h is
    halved until it is `SUBSTEP_ERROR` of it; None where there is no need, or no such h.

    Raises:
        SlowError: larger steps would take too long, and up to here there is no such difference.
    """
    trial = place.trial
    largest = 0.0
    for size in trial.sizes(_LARGER, 0.5 * trial.largest_step):
        before = trial.time_left
        try:
            difference = _halves(place, size)
        except TrialError:  # a step that is too short, or too long, for the model
            continue
        largest = max(largest, difference)
        if difference > _NOTICED:
            return difference, _allowed_size(place, size, difference)
        if trial.time_left < _LARGER * (before - trial.time_left):
            raise SlowError(f"more than {size:.3g} s")
    return largest, None


def _halves(place: Place, size: float) -> float:
    return place.trial.norm(*_pair(place, size))


def _pair(place: Place, size: float) -> tuple[Reading, Reading]:
    """The outputs behind one step of 2h, and behind two of h."""
    place.restored()
    whole = place.step(2.0 * size)
    place.restored()
    place.step(size)
    return whole, place.step(size)


def _allowed_size(place: Place, size: float, difference: float) -> float | None:
    with suppress(TrialError):
        for _ in range(_HALVINGS):
            size *= 0.5
            last, difference = difference, _halves(place, size)
            if difference <= SUBSTEP_ERROR:  # between this size and twice of it, by a power law
                room = (
                    log(SUBSTEP_ERROR / difference) / log(last / difference) if difference else 0.0
                )
                return float(size * 2.0**room)
    return None
