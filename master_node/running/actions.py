"""Actions of a system: what a run does by itself at points in time (``[[actions]]``)."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import NamedTuple

from master_node.coupling.overrides import NO_OVERRIDES, Overrides
from master_node.running.steering import Steering, Values
from master_node.system.system import System
from master_node.system.tables import Action
from protocol.errors import ConfigurationError, SteeringError


class Change(NamedTuple):
    """Effect of an action.

    Attributes:
        values: to set, by slave and variable.
        overrides: that hold from there on.
        stops: whether the run ends there.
        text: the action in words.
    """

    values: Values
    overrides: Overrides
    stops: bool
    text: str


class Actions:
    """Actions in the order in which they are done.

    Args:
        system: whose actions they are.
        steering: checks them.

    Attributes:
        steering: as above.

    Raises:
        ConfigurationError: one cannot be done; names it.
    """

    def __init__(self, system: System, steering: Steering) -> None:
        self.steering = steering
        numbered = sorted(enumerate(system.actions, 1), key=lambda pair: pair[1].at)
        self._actions = tuple(action for _, action in numbered)
        self._places = tuple(f"{system.source}: [[actions]] number {n}" for n, _ in numbered)
        overrides, before = NO_OVERRIDES, -inf
        for where, action in zip(self._places, self._actions, strict=True):
            _check_time(where, action.at, before, system)
            before = action.at
            try:
                overrides = self._change(action, overrides).overrides
            except SteeringError as error:
                raise _mistake(where, error) from None

    def check_targets(self, number: int, check: Callable[[float], None]) -> None:
        """Make sure that steps can end at the times of all behind so many.

        Args:
            number: of those that are done.
            check: raises `SteeringError` where they cannot end at a time [s].

        Raises:
            ConfigurationError: they cannot; names the action, and the points nearest to it.
        """
        for where, action in list(zip(self._places, self._actions, strict=True))[number:]:
            try:
                check(float(action.at))
            except SteeringError as error:
                raise _mistake(where, error) from None

    def time(self, number: int) -> float:
        """Time of the next one behind so many [s]; infinite: there is none."""
        return float(self._actions[number].at) if number < len(self._actions) else inf

    def change(self, number: int, overrides: Overrides) -> Change:
        """Effect of the next one behind so many.

        Args:
            number: of those that are done.
            overrides: that hold now.

        Raises:
            SteeringError: an input to release is not overridden, as a user has released it.
        """
        return self._change(self._actions[number], overrides)

    def _change(self, action: Action, overrides: Overrides) -> Change:
        steering = self.steering
        values = steering.settings(action.set)
        if action.release:
            overrides = steering.released(overrides, action.release)
        return Change(
            values, steering.overridden(overrides, action.override), action.stop, str(action)
        )


def _mistake(where: str, error: SteeringError) -> ConfigurationError:
    return ConfigurationError(f"{where}: {error.cause}", remedy=error.remedy)


def _check_time(where: str, at: float, before: float, system: System) -> None:
    simulation = system.simulation
    start, end = float(simulation.start_time), simulation.end
    if not start <= at < end:
        raise ConfigurationError(
            f"{where}: at = {at!r} s is not within the run, from {start!r} s to before {end!r} s",
            remedy="give another time, or another stop_time",
        )
    nearest = 2.0 * simulation.smallest
    if 0.0 < at - max(before, start) < nearest or end - at < nearest:
        raise ConfigurationError(
            f"{where}: at = {at!r} s is nearer to the action before it, or to an end of the run, "
            f"than steps can be, {nearest!r} s",
            remedy="give both the same time, or lower smallest_step_size",
        )
