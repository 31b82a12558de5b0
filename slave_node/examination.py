"""Trial steps that show whether a slave can be trusted: its saved states, its clock, its steps.

Three tests, all with held inputs. Each begins where the slave stands, and afterwards it stands
there again.

*Saved states.* The same steps with and without going back first, and twice after going back.

*Internal clock.* Of many small steps, which move an output? A model that moves only at multiples of
a time is found by steps that are shorter than this; two of the moments are then bisected.

*Step dependence.* One step of 2h against two of h. For a model that integrates as accurately as it
was asked to, both are the same but for its tolerance. One that takes one step of its own in each
do_step differs by a power of h.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from math import log
from time import perf_counter
from typing import NamedTuple

import numpy as np

from protocol.errors import FatalSlaveError, SlaveError
from protocol.signals import FloatArray
from protocol.slave import (
    Causality,
    Examination,
    Slave,
    StartValue,
    StateKind,
    StateVerdict,
    StepStatus,
)

_TIME = 10.0
"""After this a test is not begun any more [s]."""

_SHRINKS = 4
_SHRINK = 0.1
"""So often, and by so much, the trial steps are made smaller if the slave does not take them."""


_GOES_BACK = (StateVerdict.EXACT, StateVerdict.RESTARTS_SOLVER)


class _TrialError(Exception):
    """A trial step failed, which by itself says nothing about saved states."""


def examine(
    slave: Slave,
    time: float,
    step_size: float,
    relative_tolerance: float = 1e-4,
    absolute_tolerance: float = 1e-4,
) -> Examination:
    """Take trial steps from ``time`` [s], with the inputs that are set, and go back.

    Args:
        slave: at a communication point.
        time: where it stands [s].
        step_size: of the trial steps [s].
        relative_tolerance: of the coupling; weighs differences.
        absolute_tolerance: of the coupling, in nominal values.

    Raises:
        FatalSlaveError: the slave must not be called any more.
    """
    if slave.description.state_kind is StateKind.NONE:
        return Examination(state_reason=slave.description.state_reason)
    fixed = slave.description.fixed_step_size
    if fixed is not None:
        step_size = fixed * max(1, round(step_size / fixed))
    begin = perf_counter()
    try:
        states, step_size = _test_states(slave, time, step_size)
        clock: float | None = None
        dependence: tuple[float, float | None] = (0.0, None)
        if states.verdict in _GOES_BACK and _takes_any_step(slave):
            norm = _norm(slave, relative_tolerance, absolute_tolerance)
            with _place(slave, time) as place:
                if perf_counter() - begin < _TIME:
                    clock = _internal_clock(place, step_size)
                if clock is not None and clock > step_size:
                    place.restored()
                    with suppress(_TrialError):
                        states = _compare(slave, place, time, clock)
                if clock is None and perf_counter() - begin < _TIME:
                    dependence = _step_dependence(place, step_size, norm)
    except _TrialError as error:
        return Examination(state_reason=str(error))
    except FatalSlaveError:
        raise
    except SlaveError as error:
        return Examination(StateVerdict.BROKEN, str(error))
    return Examination(states.verdict, states.reason, states.difference, clock, *dependence)


# ---- Trial steps --------------------------------------------------------------------------------


class _Reading(NamedTuple):
    """Outputs: continuous ones with what derivatives there are, shape (rows, n), and others."""

    values: FloatArray
    others: tuple[StartValue, ...]

    def equals(self, other: _Reading) -> bool:
        return np.array_equal(self.values, other.values) and self.others == other.others

    def has_moved_from(self, other: _Reading) -> bool:
        """Derivatives do not count."""
        return not np.array_equal(self.values[0], other.values[0]) or self.others != other.others


def _read(slave: Slave) -> _Reading:
    order = min(1, slave.description.capabilities.max_output_derivative_order)
    return _Reading(slave.get_outputs(order), slave.get_discrete_outputs())


def _step(slave: Slave, time: float, step_size: float) -> _Reading:
    where = f"a step of {step_size!r} s at t={time!r} s"
    try:
        result = slave.do_step(time, step_size, False)
        if result.status is not StepStatus.OK:
            raise _TrialError(f"{where} ended with {result.status}")
        reading = _read(slave)
    except FatalSlaveError:
        raise
    except SlaveError as error:
        raise _TrialError(f"{where}: {error.cause}") from None
    if not np.isfinite(reading.values).all():
        raise _TrialError(f"{where}: an output is not finite")
    return reading


class _Place:
    """A communication point to which the slave goes back as often as it is asked."""

    def __init__(self, slave: Slave, time: float) -> None:
        self._slave = slave
        self._time = self._now = time
        self._state = slave.get_state()

    def restored(self) -> None:
        """Go back."""
        self._slave.set_state(self._state)
        self._now = self._time

    def step(self, step_size: float) -> _Reading:
        """One step [s] on from where the slave stands."""
        reading = _step(self._slave, self._now, step_size)
        self._now += step_size
        return reading

    def here(self) -> _Place:
        """The point where the slave stands now."""
        return _Place(self._slave, self._now)

    def free(self) -> None:
        """Give the saved state up."""
        self._slave.free_state(self._state)


@contextmanager
def _place(slave: Slave, time: float) -> Iterator[_Place]:
    """Where the slave stands; it stands there again at the end."""
    place = _Place(slave, time)
    with _freed(place):
        yield place
        place.restored()


@contextmanager
def _freed(place: _Place) -> Iterator[None]:
    """Give a place up at the end; what a failing slave has to say to that does not matter."""
    try:
        yield
    except BaseException:
        with suppress(SlaveError):
            place.free()
        raise
    place.free()


# ---- Saved states -------------------------------------------------------------------------------


class _States(NamedTuple):
    verdict: StateVerdict
    reason: str = ""
    difference: float = 0.0


def _test_states(slave: Slave, time: float, step_size: float) -> tuple[_States, float]:
    """What saved states are worth, and the size of steps that the slave takes [s]."""
    origin = _Place(slave, time)
    with _freed(origin):
        for _ in range(_SHRINKS if _takes_any_step(slave) else 1):
            try:
                states = _compare(slave, origin, time, step_size)
            except _TrialError as error:
                reason = str(error)
                step_size *= _SHRINK
                origin.restored()
            else:
                return states, step_size
    raise _TrialError(f"no trial step succeeded, the last one: {reason}")


def _compare(slave: Slave, origin: _Place, time: float, step_size: float) -> _States:
    """Steps after going back to T + h, and to T, with those that had nothing before them.

    The state is saved after a first step: by then a model's solver has a past, and outputs may be
    read (FMI 2.0 forbids it between setting inputs and a step).
    """
    first = _step(slave, time, step_size)
    middle = time + step_size
    place = _Place(slave, middle)
    with _freed(place):
        without = [_step(slave, middle + i * step_size, step_size) for i in range(2)]
        try:
            place.restored()
            there = _read(slave)
            once = place.step(step_size)
            place.restored()
            again = [place.step(step_size), place.step(step_size)]
            with suppress(_TrialError):
                place.step(2.0 * step_size if _takes_any_step(slave) else step_size)
            origin.restored()
            from_origin = origin.step(step_size)
            origin.restored()
        except _TrialError as error:
            raise SlaveError(f"after a restore {error}") from None
    if not once.equals(again[0]):
        return _States(
            StateVerdict.DOES_NOT_REPEAT,
            "the same step after a restore gave other outputs the second time"
            + ("" if first.equals(there) else "; outputs are wrong already before that step"),
            _difference(once, again[0]),
        )
    pairs = [*zip(without, again, strict=True), (first, from_origin)]
    if not all(a.equals(b) for a, b in pairs):
        return _States(
            StateVerdict.RESTARTS_SOLVER,
            "steps after a restore repeat, but differ from the same steps without one",
            max(_difference(a, b) for a, b in pairs),
        )
    if not first.equals(there):
        return _States(
            StateVerdict.EXACT,
            "outputs right after a restore are not those that were saved; after a step they are",
            _difference(first, there),
        )
    moves = any(reading.has_moved_from(first) for reading in without)
    return _States(StateVerdict.EXACT, "" if moves else "no output moved in the trial steps")


def _takes_any_step(slave: Slave) -> bool:
    description = slave.description
    return (
        description.capabilities.can_handle_variable_step_size
        and description.fixed_step_size is None
    )


def _difference(a: _Reading, b: _Reading) -> float:
    scale = np.maximum(np.abs(a.values), np.abs(b.values))
    scale[scale == 0.0] = 1.0
    continuous = float(np.max(np.abs(a.values - b.values) / scale, initial=0.0))
    return max(continuous, float(a.others != b.others))


# ---- Internal clock -----------------------------------------------------------------------------

_LEVELS = 4
_FINER = 8.0
"""Clocks from `_STEPS` trial steps down to one of `_FINER`**(`_LEVELS` - 1)-th are looked for."""

_ALL_MOVE = 8
"""After so many steps in a row that move an output there is no clock longer than they are."""

_STEPS = 40
_TICKS = 3
_BISECTIONS = 24


def _internal_clock(place: _Place, step_size: float) -> float | None:
    """At multiples of which time the outputs move [s]; None if at any time, or not at all."""
    size = step_size
    with suppress(_TrialError):  # a step that is too short for the model
        for _ in range(_LEVELS):
            moves = _moves(place, size)
            if not any(moves):
                return None
            if not all(moves):
                return _period(place, size, moves)
            size /= _FINER
    return None


def _moves(place: _Place, size: float) -> list[bool]:
    """Which steps move an output, beginning with the second one.

    Up to the third one that does so after one that does not.
    """
    place.restored()
    last = place.step(size)
    moves: list[bool] = []
    while len(moves) < (3 * _STEPS if any(moves) else _STEPS):
        following = place.step(size)
        moves.append(following.has_moved_from(last))
        last = following
        if len(_clear_ticks(moves)) == _TICKS or (len(moves) == _ALL_MOVE and all(moves)):
            break
    return moves


def _clear_ticks(moves: list[bool]) -> list[int]:
    """The steps that move an output after one that does not: no tiny step is needed to bisect."""
    return [i for i in range(1, len(moves)) if moves[i] and not moves[i - 1]]


def _period(place: _Place, size: float, moves: list[bool]) -> float | None:
    """The time between equally distant ticks; None if they are not."""
    ticks = [i for i, moved in enumerate(moves) if moved]
    gaps = [b - a for a, b in pairwise(ticks)]
    clear = _clear_ticks(moves)
    if len(clear) < _TICKS or max(gaps) - min(gaps) > 1:
        return None
    first, last = clear[0], clear[-1]
    begin, end = (_tick(place, size, i) for i in (first, last))
    accuracy = 4.0 * size * 0.5**_BISECTIONS
    return _plain((end - begin) / (ticks.index(last) - ticks.index(first)), accuracy)


def _tick(place: _Place, size: float, index: int) -> float:
    """When the outputs move in step ``index``, counted from the second one [s]; after bisection."""
    place.restored()
    for _ in range(index):
        last = place.step(size)
    here = place.here()
    with _freed(here):
        low, high = size, 2.0 * size
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            here.restored()
            moved = here.step(middle).has_moved_from(last)
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


# ---- Step dependence ----------------------------------------------------------------------------

_LARGER = (1.0, 4.0, 16.0)
LARGEST_STEP = 2.0 * _LARGER[-1]
"""Of all trial steps, in terms of the step size that is asked for."""

_NOTICED = 1.0
_ALLOWED = 0.1
"""Of the tolerance: the errors of the substeps of a communication step add up."""

_HALVINGS = 14

Norm = Callable[[FloatArray, FloatArray], float]


def _norm(slave: Slave, relative: float, absolute: float) -> Norm:
    """The weighted root mean square of the difference of two arrays of outputs, shape (n,)."""
    outputs = slave.description.of(Causality.OUTPUT)
    nominal = np.array([v.nominal for v in outputs if v.is_continuous_real])

    def norm(a: FloatArray, b: FloatArray) -> float:
        sizes = nominal if len(nominal) == len(a) else np.ones(len(a))
        scale = absolute * sizes + relative * np.maximum(np.abs(a), np.abs(b))
        return float(np.sqrt(np.mean(((a - b) / scale) ** 2))) if len(a) else 0.0

    return norm


def _step_dependence(place: _Place, step_size: float, norm: Norm) -> tuple[float, float | None]:
    """How much one step of 2h differs from two of h, and up to which h it does not matter [s].

    That difference is looked for with larger and larger h. When it is more than the tolerance h is
    halved until it is `_ALLOWED` of it; None where there is no need, or no such h.
    """
    largest = 0.0
    with suppress(_TrialError):  # a step that is too long for the model
        for factor in _LARGER:
            size = factor * step_size
            difference = _halves(place, size, norm)
            largest = max(largest, difference)
            if difference > _NOTICED:
                return difference, _allowed_size(place, size, difference, norm)
    return largest, None


def _halves(place: _Place, size: float, norm: Norm) -> float:
    place.restored()
    whole = place.step(2.0 * size)
    place.restored()
    place.step(size)
    halves = place.step(size)
    return norm(whole.values[0], halves.values[0])


def _allowed_size(place: _Place, size: float, difference: float, norm: Norm) -> float | None:
    with suppress(_TrialError):
        for _ in range(_HALVINGS):
            size *= 0.5
            last, difference = difference, _halves(place, size, norm)
            if difference <= _ALLOWED:  # between this size and twice of it, by a power law
                room = log(_ALLOWED / difference) / log(last / difference) if difference else 0.0
                return float(size * 2.0**room)
    return None
