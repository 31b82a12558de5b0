"""Are the slaves what they say they are? Trial steps before the first step, and the remedies.

Before a run each slave that saves its state takes trial steps from its first communication point
and goes back (`Examine`). What that shows may call for

* another way to save states: native -> fork -> replay -> none;
* emulated input derivatives, for a model that declares them and refuses some;
* substeps within the slave's node, for a model whose own steps must not be long;
* communication steps on the grid of an internal clock.

Where nothing is wrong the slaves stand where they stood, and the run goes on from there. Otherwise
all of them are reset and initialized once more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from master_node.configuration import SlaveSettings, System
from master_node.restorable_slave import BrokenStepError
from master_node.slave_group import Program, SlaveGroup
from master_node.step_size_rules import check_step_sizes
from master_node.system import CoupledSystem, SlavePart
from protocol.calls import Configure, Examine, GetState, Reply, SetInputs, SetState
from protocol.errors import ConfigurationError, FatalSlaveError, SlaveCrashedError, SlaveError
from protocol.signals import MAX_ORDER, FloatArray
from protocol.slave import (
    Examination,
    InputDerivatives,
    SlaveDescription,
    StateKind,
    StateVerdict,
)

LADDER = (StateKind.NATIVE, StateKind.FORK, StateKind.REPLAY, StateKind.NONE)
"""How states are saved, the best way first."""

_EXCITATION = 0.01
"""Of an input's size: at an equilibrium nothing moves, and a slave that rests shows nothing."""

_BEFORE = 0
"""The number under which the state is saved meanwhile."""

_TOO_LARGE = 1.0


class Finding(NamedTuple):
    """What a slave showed.

    Attributes:
        examination: of its trial steps.
        refusal: why it does not take input derivatives of the degree that the run may use; "" if it
            does. Without them there were no trial steps.
    """

    examination: Examination
    refusal: str = ""

    @property
    def is_harmless(self) -> bool:
        """Whether the slave stands where it stood, and needs no reset."""
        return self.examination.state_verdict is StateVerdict.EXACT


class Remedy(NamedTuple):
    """What an examination calls for.

    Attributes:
        configuration: the slave is to be loaded like this.
        step_multiple: its communication steps are to be multiples of this [s]; None: any.
        warnings: for the user, each naming the slave.
    """

    configuration: Configure
    step_multiple: float | None = None
    warnings: tuple[str, ...] = ()


def is_to_be_examined(description: SlaveDescription) -> bool:
    """Whether trial steps of a slave can tell anything: a Python model is known to be exact."""
    return description.state_kind is not StateKind.NONE and description.kind != "Python model"


def examine(
    group: SlaveGroup, coupled: CoupledSystem, system: System, y: FloatArray, names: set[str]
) -> dict[str, Finding]:
    """Let some slaves take trial steps, all at once.

    The inputs are moved a little for that, and set back with all the rest.

    Args:
        group: the slaves, at their first communication point.
        coupled: their connections.
        system: the settings.
        y: outputs there, shape (rows, m).
        names: of the slaves.

    Raises:
        DoublestepError: a slave was lost, or must not be called any more.
    """
    start = float(system.simulation.start_time)
    slaves = [i for i, name in enumerate(group.names) if name in names]
    u, external = coupled.inputs_of(y[0]), coupled.external.at(start)
    programs = [_program(coupled.parts[i], system, u, external) for i in slaves]
    replies = group.execute(programs, start, None, slaves)
    return {group.names[i]: _judged(reply) for i, reply in zip(slaves, replies, strict=True)}


def _program(part: SlavePart, system: System, u: FloatArray, external: FloatArray) -> Program:
    simulation = system.simulation
    settings = system.slaves[part.name]
    is_native = part.description.input_derivatives is InputDerivatives.NATIVE
    order = min(part.max_order, simulation.polynomial.order) if is_native else 0
    values = part.columns(u[np.newaxis], external[np.newaxis])[0]
    nominal = [part.description.variable(name).nominal for name in part.inputs]
    moved = np.zeros((order + 1, len(values)))
    moved[0] = values + _EXCITATION * np.maximum(np.abs(values), nominal)
    relative, absolute = settings.relative_tolerance, settings.absolute_tolerance
    return (
        GetState(_BEFORE),
        SetInputs(moved),
        Examine(
            float(simulation.start_time),
            _trial_step_size(simulation.step_size, settings),
            float(simulation.relative_tolerance if relative is None else relative),
            float(simulation.absolute_tolerance if absolute is None else absolute),
        ),
        SetState(_BEFORE, free=True),
    )


def _trial_step_size(step_size: float, settings: SlaveSettings) -> float:
    """A step like those of the run, as the rules of the slave allow it [s]."""
    if settings.step_size is not None:
        return float(settings.step_size)
    if settings.smallest_step_size is not None:
        step_size = max(step_size, float(settings.smallest_step_size))
    if settings.largest_step_size is not None:
        step_size = min(step_size, float(settings.largest_step_size))
    if settings.step_multiple is not None:
        multiple = float(settings.step_multiple)
        step_size = multiple * max(1, round(step_size / multiple))
    return step_size


def _judged(reply: Reply) -> Finding:
    """What a slave showed; an error on the way is a verdict too."""
    examination = next((r for r in reply.results if isinstance(r, Examination)), None)
    error = reply.error
    if error is None:
        assert examination is not None
        return Finding(examination)
    if not isinstance(error, SlaveError) or isinstance(error, FatalSlaveError | SlaveCrashedError):
        raise error
    if error.phase == SetInputs.verb and not isinstance(error, BrokenStepError):
        return Finding(Examination(), error.cause)
    if examination is None or examination.state_verdict is StateVerdict.EXACT:
        return Finding(Examination(StateVerdict.BROKEN, f"{error.phase}: {error.cause}"))
    return Finding(examination)


def remedy(
    name: str,
    finding: Finding,
    description: SlaveDescription,
    configuration: Configure,
    system: System,
) -> Remedy:
    """What to do about a slave.

    Args:
        name: of the slave.
        finding: what it showed.
        description: of the slave as it was examined.
        configuration: as which it was examined.
        system: the settings; what the user says there is left as it is.
    """
    examination, refusal = finding
    verdict, reason = examination.state_verdict, examination.state_reason
    if refusal and description.input_derivatives is InputDerivatives.NATIVE:
        return Remedy(
            replace(configuration, input_substeps=MAX_ORDER + 1),
            warnings=(
                f"{name}: its input derivatives are emulated, as it takes not all: {refusal}",
            ),
        )
    if refusal:
        raise SlaveError(refusal, slave=name, phase=SetInputs.verb)
    if verdict in (StateVerdict.DOES_NOT_REPEAT, StateVerdict.BROKEN):
        what = f"{name}: its saved states ({description.state_kind}) cannot be trusted: {reason}"
        if system.slaves[name].state:
            return Remedy(
                configuration, warnings=(f"{what}; they are used as they were asked for",)
            )
        kind = LADDER[LADDER.index(description.state_kind) + 1]
        instead = "steps cannot be taken back" if kind is StateKind.NONE else f"{kind} instead"
        return Remedy(replace(configuration, state_kind=kind), warnings=(f"{what}; {instead}",))
    warnings = []
    if verdict is StateVerdict.NOT_TESTED:
        warnings.append(f"{name}: its saved states could not be tested: {reason}")
    if verdict is StateVerdict.RESTARTS_SOLVER:
        warnings.append(
            f"{name}: going back to a saved state restarts the model's solver: {reason}; the "
            f"largest relative difference of an output was {examination.difference:.2g}"
        )
    multiple = None
    clock = examination.internal_clock
    if clock is not None:
        multiple, configuration, warning = _clocked(name, clock, description, configuration, system)
        warnings += [warning] if warning else []
    if examination.step_dependence > _TOO_LARGE and configuration.largest_substep is None:
        what = (
            f"{name}: one long step differs from two short ones by "
            f"{examination.step_dependence:.2g} times the tolerance, as if the model took one step "
            "of its own in each"
        )
        if examination.largest_substep is None:
            warnings.append(f"{what}; EST_Rich sees some of that error, EST_mod none of it")
        else:
            largest = _rounded_down(examination.largest_substep)
            configuration = replace(configuration, largest_substep=largest)
            warnings.append(f"{what}; its steps are split into substeps of {largest!r} s at most")
    return Remedy(configuration, multiple, tuple(warnings))


def _clocked(
    name: str,
    clock: float,
    description: SlaveDescription,
    configuration: Configure,
    system: System,
) -> tuple[float | None, Configure, str]:
    """H on the grid of the clock; and with emulated inputs the substeps as well."""
    what = f"{name}: its outputs move only at multiples of {clock!r} s"
    settings = system.slaves[name]
    if settings.step_multiple == clock:
        return clock, configuration, ""
    if settings.step_size is not None or settings.step_multiple is not None:
        return None, configuration, f"{what}; its step sizes are left as they are given"
    try:
        check_step_sizes(system.with_slave(name, step_multiple=clock))
    except ConfigurationError as error:
        return None, configuration, f"{what}, but communication steps cannot be: {error.cause}"
    is_emulated = description.input_derivatives is InputDerivatives.EMULATED
    if is_emulated and configuration.largest_substep is None:
        configuration = replace(configuration, largest_substep=clock)
    return clock, configuration, f"{what}; its communication steps are now multiples of that"


def _rounded_down(value: float) -> float:
    """Two digits are enough for a bound that was measured."""
    rounded = float(f"{value:.1e}")
    return rounded if rounded <= value else float(f"{0.95 * value:.1e}")


def as_plain_data(examinations: Mapping[str, Examination]) -> dict[str, object]:
    """For ``summary.json``."""
    return {
        name: {
            "state_verdict": str(e.state_verdict),
            "state_reason": e.state_reason,
            "difference": e.difference,
            "internal_clock": e.internal_clock,
            "step_dependence": e.step_dependence,
            "largest_substep": e.largest_substep,
        }
        for name, e in examinations.items()
    }
