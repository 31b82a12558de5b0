"""Bounds on the time of requests, by what they have the slave do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from master_node.system.system import System
from protocol.calls import (
    Call,
    Configure,
    DoStep,
    Examine,
    ExitInitializationMode,
    Initialize,
    Reply,
    Reset,
    SetState,
)
from protocol.description import SlaveDescription, StateKind

_STEPS_AT_ONCE = 3
"""So many do_steps a request of a double step has at most; one that repeats others has more."""

_TRIALS = 4
"""So many times as long as such a request all trial steps together may take."""

_REPLAY_MARGIN = 2.0
"""A replay may take so much longer than what it repeats."""


@dataclass(frozen=True, slots=True)
class RequestBounds:
    """Bounds on what one slave is asked to do [s]: the keys of the ``[bus]`` table.

    Attributes:
        load_timeout: to load a model, to load it anew, or to reset it.
        initialization_timeout: each request from ``initialize`` to the end of initialization mode.
        step_timeout: a request of up to three do_steps, such as a double step has, or of none.
    """

    load_timeout: float
    initialization_timeout: float
    step_timeout: float

    @staticmethod
    def of(system: System) -> RequestBounds:
        """Bounds of a system, from its ``[bus]`` table."""
        bus = system.bus
        return RequestBounds(
            float(bus.load_timeout), float(bus.initialization_timeout), float(bus.step_timeout)
        )


@dataclass(frozen=True, slots=True)
class Bound:
    """The bound on one request.

    Attributes:
        seconds: it may take [s].
        keys: of the ``[bus]`` table that say so.
    """

    seconds: float
    keys: tuple[str, ...]

    @property
    def remedy(self) -> str:
        """A sentence for the error where it was reached."""
        return f"if the model is only slow, raise {' and '.join(self.keys)} in [bus]"


class RequestClock:
    """The bounds on the requests to one slave, which depend on where it stands.

    Args:
        bounds: by kind of work.
    """

    def __init__(self, bounds: RequestBounds) -> None:
        self._bounds = bounds
        self._is_initializing = False
        self._replays = False
        self._computed = 0.0

    def bound(self, calls: Sequence[Call]) -> Bound:
        """The bound on the next request: of all its kinds of work together.

        One that repeats more do_steps may take accordingly longer, trial steps four times as long,
        and a replayed state as long as all that it repeats.
        """
        bounds = self._bounds
        kinds = {type(call) for call in calls}
        initializes = self._is_initializing or Initialize in kinds
        steps = sum(type(call) is DoStep for call in calls)
        rounds = -(-steps // _STEPS_AT_ONCE) + (_TRIALS if Examine in kinds else 0)
        seconds, keys = 0.0, []
        if kinds & {Configure, Reset}:
            seconds += bounds.load_timeout
            keys.append("load_timeout")
        if initializes:
            seconds += bounds.initialization_timeout
            keys.append("initialization_timeout")
        if rounds or not keys:
            seconds += max(1, rounds) * bounds.step_timeout
            keys.append("step_timeout")
        if self._replays and SetState in kinds:
            while seconds < bounds.step_timeout + _REPLAY_MARGIN * self._computed:
                seconds *= 2.0  # so that there are few different ones
        self._follow(kinds)
        return Bound(seconds, tuple(keys))

    def _follow(self, kinds: set[type[Call]]) -> None:
        """Where the slave stands once it has done these calls."""
        if Initialize in kinds:
            self._is_initializing = True
            self._computed = 0.0
        if kinds & {ExitInitializationMode, Reset, Configure}:
            self._is_initializing = False

    def took(self, reply: Reply) -> None:
        """Note what the slave answered, and how long it computed."""
        self._computed += reply.compute_time
        for result in reply.results:
            if isinstance(result, SlaveDescription):
                self._replays = result.state_kind is StateKind.REPLAY
