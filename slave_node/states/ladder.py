"""In which way the state of a model is saved on this host: the best that both allow.

Native, else by forking (on Linux), else by replaying; or as the user says.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from protocol.description import SlaveDescription, StateKind
from protocol.errors import ModelError
from protocol.slave import Slave
from protocol.text.names import nearest
from slave_node.states.replay_slave import ReplaySlave
from slave_node.states.stateless_slave import StatelessSlave

CAN_FORK = sys.platform == "linux"


class StateChoice(NamedTuple):
    """Way in which a state is saved, and why not natively ("" if it is)."""

    kind: StateKind
    reason: str


def choose(
    description: SlaveDescription, wanted: str = "", *, can_fork: bool = CAN_FORK
) -> StateChoice:
    """The way for a model.

    Args:
        description: of the model as it is, ``NATIVE`` or ``NONE``.
        wanted: a `StateKind`; "": the best.
        can_fork: whether processes of this host can.

    Raises:
        ModelError: what is wanted cannot be.
    """
    is_native = description.state_kind is StateKind.NATIVE
    lack = description.state_reason or "the model declares canGetAndSetFMUstate = false"
    match wanted:
        case "":
            return _best(is_native=is_native, can_fork=can_fork, lack=lack)
        case StateKind.NATIVE if is_native:
            return StateChoice(StateKind.NATIVE, "")
        case StateKind.NATIVE:
            raise _impossible(description, wanted, lack)
        case StateKind.FORK if not can_fork:
            raise _impossible(description, wanted, f"{sys.platform} cannot fork processes")
        case StateKind.FORK | StateKind.REPLAY | StateKind.NONE:
            reason = "the configuration asks for it" + ("" if is_native else f"; {lack}")
            return StateChoice(StateKind(wanted), reason)
    known = nearest(wanted, [kind.value for kind in StateKind])
    raise ModelError(f"no state can be saved by {wanted!r:.60}{known}")


def _best(*, is_native: bool, can_fork: bool, lack: str) -> StateChoice:
    if is_native:
        return StateChoice(StateKind.NATIVE, "")
    if can_fork:
        return StateChoice(StateKind.FORK, lack)
    return StateChoice(StateKind.REPLAY, f"{lack}; {sys.platform} cannot fork processes")


def _impossible(description: SlaveDescription, wanted: str, why: str) -> ModelError:
    return ModelError(
        f"{description.model}: its state cannot be saved by {wanted}: {why}",
        remedy="leave the choice to the slave, or choose another of native, fork, replay, none",
    )


def described(description: SlaveDescription, choice: StateChoice) -> SlaveDescription:
    """The description of the model when its state is saved like that."""
    return replace(description, state_kind=choice.kind, state_reason=choice.reason)


def with_states(
    choice: StateChoice, load: Callable[[], Slave], load_forking: Callable[[str], Slave]
) -> Slave:
    """The slave that saves its state as chosen.

    Args:
        choice: see `choose`.
        load: makes the slave of the model alone.
        load_forking: makes a `ForkSlave`, from the reason.
    """
    match choice.kind:
        case StateKind.NATIVE:
            return load()
        case StateKind.FORK:
            return load_forking(choice.reason)
        case StateKind.REPLAY:
            return ReplaySlave(load, choice.reason)
        case StateKind.NONE:
            return StatelessSlave(load(), choice.reason)
