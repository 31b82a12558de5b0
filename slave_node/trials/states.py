"""Saved states: the same steps with and without going back first, and twice after going back.

Each begins where the slave stands, and afterwards it stands there again.
"""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import numpy as np

from protocol.description import StateKind, StateVerdict
from protocol.errors import SlaveError
from slave_node.trials.steps import Place, Reading, Trial, TrialError, freed

GOES_BACK = (StateVerdict.EXACT, StateVerdict.RESTARTS_SOLVER)


class States(NamedTuple):
    """Observation of saved states.

    Attributes:
        verdict, reason, difference: see `Examination`.
        not_repeating: outputs that no other slave depends on and that did not repeat; where there
            are any nothing else is said.
        slopes_repeat: whether the derivatives of the outputs repeated, and, where all values are
            exact, were after a restore what they were without one.
    """

    verdict: StateVerdict
    reason: str = ""
    difference: float = 0.0
    not_repeating: tuple[str, ...] = ()
    slopes_repeat: bool = True


def compare(trial: Trial, origin: Place, size: float) -> States:
    """Steps after going back to T and to T + h, with those that had nothing before them.

    The second state is saved after a step: by then a model's solver has a past, and outputs may
    be read (FMI 2.0 forbids it between setting inputs and a step).

    Raises:
        TrialError: a step from T was not completed.
        SlaveError: a call failed, or a step that had been taken before.
    """
    first = origin.step(size)
    origin.restored()
    from_origin = origin.step(size)
    origin.restored()
    once_more = origin.step(size)
    clocks = _clocks(trial, [(from_origin, once_more)])
    if clocks:
        return States(StateVerdict.NOT_TESTED, not_repeating=clocks)
    if not _same_slopes(from_origin, once_more):
        trial.reads_slopes = False
    with freed(origin.here()) as place:
        without = [place.step(size) for _ in range(2)]
        try:
            place.restored()
            there = trial.read()
            once = place.step(size)
            place.restored()
            again = [place.step(size), place.step(size)]
            with suppress(TrialError):
                place.step(2.0 * size if trial.takes_any_step else size)
            origin.restored()
            at_last = origin.step(size)
            origin.restored()
        except TrialError as error:
            raise SlaveError(f"after a restore {error}") from None
    repeated = [(from_origin, once_more), (once, again[0]), (once_more, at_last)]
    restored = [*zip(without, again, strict=True), (first, from_origin)]
    states = _judged(trial, repeated, restored, stood=(once_more, there))
    clocks = _clocks(trial, repeated)
    if not clocks and trial.slave.description.state_kind is not StateKind.NATIVE:
        clocks = _clocks(trial, restored)  # a copy of the process, or all of its past, is exact
    if clocks:
        return States(StateVerdict.NOT_TESTED, not_repeating=clocks)
    moves = any(not reading.equals(once_more) for reading in without)
    if states.verdict is StateVerdict.EXACT and not moves:
        if trial.call.not_repeating and trial.slave.description.state_kind is StateKind.NATIVE:
            return States(
                StateVerdict.DOES_NOT_REPEAT,
                f"{_listed(trial.call.not_repeating)} gave other values for the same step, and no "
                "other output moved that could show that the rest repeats",
            )
        states = states._replace(reason=states.reason or "no output moved in the trial steps")
    slopes = repeated if states.verdict is not StateVerdict.EXACT else [*repeated, *restored]
    return states._replace(slopes_repeat=all(_same_slopes(a, b) for a, b in slopes))


def _judged(
    trial: Trial,
    repeated: list[tuple[Reading, Reading]],
    restored: list[tuple[Reading, Reading]],
    stood: tuple[Reading, Reading],
) -> States:
    """Verdict on pairs of readings that are to be the same.

    Args:
        trial: of the slave.
        repeated: both after a restore.
        restored: without one, and after one.
        stood: before a restore, and right after it.
    """
    different = next(((a, b) for a, b in repeated if not a.equals(b)), None)
    if different is not None:
        return States(
            StateVerdict.DOES_NOT_REPEAT,
            "the same step after a restore gave other outputs the second time"
            + ("" if stood[0].equals(stood[1]) else "; outputs are wrong already before that step"),
            trial.relative_difference(*different),
        )
    if not all(a.equals(b) for a, b in restored):
        difference = max(trial.relative_difference(a, b) for a, b in restored)
        beyond = max(trial.norm(a, b) for a, b in restored)
        if beyond > 1.0 or any(a.others != b.others for a, b in restored):
            return States(
                StateVerdict.DOES_NOT_RESTORE,
                "steps after a restore repeat, but differ from the same steps without one by "
                + (f"{beyond:.2g} times the tolerance" if beyond > 1.0 else "a discrete output"),
                difference,
            )
        return States(
            StateVerdict.RESTARTS_SOLVER,
            "steps after a restore repeat, but differ from the same steps without one",
            difference,
        )
    if not stood[0].equals(stood[1]):
        return States(
            StateVerdict.EXACT,
            "outputs right after a restore are not those that were saved; after a step they are",
            trial.relative_difference(*stood),
        )
    return States(StateVerdict.EXACT)


def _clocks(trial: Trial, pairs: list[tuple[Reading, Reading]]) -> tuple[str, ...]:
    """The outputs that differ, if no other slave depends on any of them.

    Where all of them differ, it is rather the state that is not restored. The copy of a process,
    or all of its past, lacks nothing but what comes from outside.
    """
    found = dict.fromkeys(name for a, b in pairs for name in trial.differing(a, b))
    is_connected = not found.keys().isdisjoint(trial.call.connected)
    is_native = trial.slave.description.state_kind is StateKind.NATIVE
    if is_connected or (is_native and len(found) == trial.outputs):
        return ()
    return tuple(found)


def _same_slopes(a: Reading, b: Reading) -> bool:
    return np.array_equal(a.slopes, b.slopes, equal_nan=True)


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(names)
