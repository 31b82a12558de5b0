"""Are the slaves what they say they are? Trial steps before the first step, and the remedies.

Before a run each slave that saves its state takes trial steps from its first communication point
and goes back (`Examine`). What that shows may call for, in this order,

* input derivatives of lower orders, or emulated ones, for a model that refuses those it declares;
* outputs that are compared with nothing and do not count in ERR, as they do not repeat;
* another way to save states: native -> fork -> replay -> none;
* polynomials without the derivatives of some outputs;
* substeps within the slave's node, for a model whose own steps must not be long;
* communication steps on the grid of an internal clock.

Where nothing is wrong the slaves stand where they stood, and the run goes on from there. Otherwise
all of them are reset and initialized once more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem, SlavePart
from master_node.coupling.step_sizes import check_step_sizes
from master_node.slaves.group import Program, SlaveGroup
from master_node.system.system import System
from master_node.system.tables import SlaveSettings
from protocol.calls import Configure, Examine, GetState, Reply, SetInputs, SetState
from protocol.description import (
    SUBSTEP_ERROR,
    Examination,
    InputDerivatives,
    SlaveDescription,
    StateKind,
    StateVerdict,
)
from protocol.errors import ConfigurationError, FatalSlaveError, SlaveCrashedError, SlaveError
from protocol.signals import FloatArray
from protocol.variables import Causality

LADDER = (StateKind.NATIVE, StateKind.FORK, StateKind.REPLAY, StateKind.NONE)
"""Ways of saving states, the best first."""

_EXCITATION = 0.01
"""Fraction of an input's size by which trials move it: a slave at rest would show nothing."""

_GOLDEN = 0.6180339887498949
"""Inputs are moved by different parts of that, from half of it to all: what a slave makes of them
may be a difference."""

_STEP_SIZE = 1e-2
"""Size of the trial steps, where neither the user nor the model says anything [s]."""

_SHARE = 32.0
"""Parts of the simulated time, of which the longest trial step is one."""

_BEFORE = 0
"""The number under which the state is saved meanwhile."""

_TOO_LARGE = 1.0
_NAMED = 3
"""So many outputs are named in a warning."""


class Remedy(NamedTuple):
    """Consequences of an examination.

    Attributes:
        configuration: the slave is to be loaded like this.
        settings: of the slave, by their keys in the system file, where they are to be others.
        warnings: for the user, each naming the slave.
    """

    configuration: Configure
    settings: Mapping[str, Any] = {}
    warnings: tuple[str, ...] = ()


def is_to_be_examined(description: SlaveDescription, system: System) -> bool:
    """True if trial steps of a slave can tell anything: a Python model is known to be exact."""
    if description.kind == "Python model":
        return False
    return (
        description.state_kind is not StateKind.NONE
        or description.input_derivatives is InputDerivatives.NATIVE
        or _wants_output_derivatives(description, system)
    )


def _wants_output_derivatives(description: SlaveDescription, system: System) -> bool:
    has_any = description.capabilities.max_output_derivative_order > 0
    return has_any and system.simulation.polynomial.derivative_points > 0


def examine(
    group: SlaveGroup,
    coupled: CoupledSystem,
    system: System,
    y: FloatArray,
    configurations: Mapping[str, Configure],
) -> dict[str, Examination]:
    """Let some slaves take trial steps, all at once.

    The inputs are moved a little for that, and set back with all the rest.

    Args:
        group: the slaves, at their first communication point.
        coupled: their connections.
        system: the settings.
        y: values of the outputs there, shape (m,).
        configurations: of the slaves to examine, by their names.

    Raises:
        DoublestepError: a slave was lost, or must not be called any more.
    """
    start = float(system.simulation.start_time)
    slaves = [i for i, name in enumerate(group.names) if name in configurations]
    u, external = coupled.inputs_of(y), coupled.external.at(start)
    connected = _connected_outputs(coupled)
    programs = []
    for i in slaves:
        part = coupled.parts[i]
        values = part.columns(u[np.newaxis], external[np.newaxis])[0]
        call = _call(part, system, values, configurations[part.name].not_repeating)
        call = replace(call, connected=tuple(connected[part.name]))
        programs.append(_program(part, call))
    replies = group.execute(programs, start, None, slaves)
    return {group.names[i]: _judged(reply) for i, reply in zip(slaves, replies, strict=True)}


def _connected_outputs(coupled: CoupledSystem) -> dict[str, list[str]]:
    """For each slave the names of the outputs on which other inputs depend."""
    keys = [(part.name, output) for part in coupled.parts for output in part.outputs]
    feeding = {keys[i] for i in coupled.source.tolist()}
    for held in (one for each in coupled.discrete.inputs for one in each):
        if held.output is not None:
            feeding.add(coupled.discrete.keys[held.output])
        elif held.continuous_output is not None:
            feeding.add(keys[held.continuous_output])
    found: dict[str, list[str]] = {part.name: [] for part in coupled.parts}
    for slave, variable in sorted(feeding):
        found[slave].append(variable)
    return found


def _call(
    part: SlavePart, system: System, values: FloatArray, not_repeating: Sequence[str]
) -> Examine:
    simulation, settings = system.simulation, system.slaves[part.name]
    description = part.description
    is_native = description.input_derivatives is InputDerivatives.NATIVE
    order = max(simulation.polynomial.order, part.external_rows - 1)
    nominal = [description.variable(name).nominal for name in part.inputs]
    parts = 1.0 - 0.5 * np.modf(_GOLDEN * np.arange(len(values)))[0]
    changes = _EXCITATION * parts * np.maximum(np.abs(values), nominal)
    relative, absolute = settings.relative_tolerance, settings.absolute_tolerance
    largest = min(
        (simulation.end - float(simulation.start_time)) / _SHARE,
        simulation.largest,
        float(settings.largest_step_size or np.inf),
    )
    return Examine(
        float(simulation.start_time),
        _trial_step_size(description, largest, system, settings),
        float(simulation.relative_tolerance if relative is None else relative),
        float(simulation.absolute_tolerance if absolute is None else absolute),
        largest_step=largest,
        smallest_step=float(settings.smallest_step_size or 0.0),
        inputs=tuple((values + changes).tolist()),
        input_changes=tuple(changes.tolist()),
        input_order=min(part.max_order, order) if is_native else 0,
        output_derivatives=_wants_output_derivatives(description, system)
        and settings.output_derivatives != (),
        not_repeating=tuple(not_repeating),
    )


def _program(part: SlavePart, call: Examine) -> Program:
    if part.description.state_kind is StateKind.NONE:
        return (call,)
    return (GetState(_BEFORE), call, SetState(_BEFORE, free=True))


def _trial_step_size(
    description: SlaveDescription, largest: float, system: System, settings: SlaveSettings
) -> float:
    """A step for the test of saved states, as the rules of the slave allow it [s]."""
    if settings.step_size is not None:
        return float(settings.step_size)
    given = system.simulation.initial_step_size
    step_size = float(given or description.default_step_size or _STEP_SIZE)
    step_size = min(step_size, 0.25 * largest)
    if settings.smallest_step_size is not None:
        step_size = max(step_size, float(settings.smallest_step_size))
    if settings.step_multiple is not None:
        multiple = float(settings.step_multiple)
        step_size = multiple * max(1, round(step_size / multiple))
    return step_size


def _judged(reply: Reply) -> Examination:
    """Examination of a slave; an error on the way is a verdict too."""
    examination = next((r for r in reply.results if isinstance(r, Examination)), None)
    error = reply.error
    if error is None:
        assert examination is not None
        return examination
    if not isinstance(error, SlaveError) or isinstance(error, FatalSlaveError | SlaveCrashedError):
        raise error
    if examination is None or examination.state_verdict is StateVerdict.EXACT:
        reason = f"{error.phase}: {error.cause}"
        return Examination(StateVerdict.BROKEN, reason, has_moved=True)
    return examination


# ---- Remedies -----------------------------------------------------------------------------------


def remedy(
    name: str,
    examination: Examination,
    description: SlaveDescription,
    configuration: Configure,
    system: System,
) -> Remedy:
    """Remedies for a slave: the first one that is to be settled before others, or all others.

    Args:
        name: of the slave.
        examination: what it showed.
        description: of the slave as it was examined.
        configuration: as which it was examined.
        system: the settings; what the user says there is left as it is.

    Raises:
        SlaveError: it refuses its inputs.
    """
    if examination.input_refusal:
        return _with_lower_orders(name, examination, description, configuration)
    new = [n for n in examination.not_repeating if n not in configuration.not_repeating]
    if new:
        return _with_clocks(name, new, description, configuration, system)
    verdict, reason = examination.state_verdict, examination.state_reason
    if verdict in _NOT_TRUSTED:
        what = f"{name}: its saved states ({description.state_kind}) cannot be trusted: {reason}"
        if system.slaves[name].state:
            warning = f"{what}; they are used as they were asked for"
            return Remedy(configuration, warnings=(warning,))
        kind = LADDER[LADDER.index(description.state_kind) + 1]
        instead = "steps cannot be taken back" if kind is StateKind.NONE else f"{kind} instead"
        return Remedy(replace(configuration, state_kind=kind), warnings=(f"{what}; {instead}",))
    warnings = []
    if verdict is StateVerdict.NOT_TESTED and description.state_kind is not StateKind.NONE:
        warnings.append(f"{name}: its saved states could not be tested: {reason}")
    if verdict is StateVerdict.RESTARTS_SOLVER:
        warnings.append(
            f"{name}: going back to a saved state restarts the model's solver: {reason}; the "
            f"largest relative difference of an output was {examination.difference:.2g}"
        )
    settings: dict[str, Any] = {}
    if examination.poor_derivatives:
        settings, warning = _without_derivatives(name, examination, description, system)
        warnings.append(warning)
    clock = examination.internal_clock
    if clock is not None:
        multiple, configuration, warning = _clocked(name, clock, description, configuration, system)
        settings |= {} if multiple is None else {"step_multiple": multiple}
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
            warnings.append(
                f"{what}; its steps are split into substeps of {largest!r} s at most; up to "
                f"{SUBSTEP_ERROR:g} of the tolerance may be left in each and adds up unseen: "
                "compare with a smaller 'largest_substep'"
            )
    if examination.not_tried:
        warnings.append(f"{name}: its trial steps take long: {examination.not_tried}")
    return Remedy(configuration, settings, tuple(warnings))


_NOT_TRUSTED = (StateVerdict.DOES_NOT_REPEAT, StateVerdict.DOES_NOT_RESTORE, StateVerdict.BROKEN)


def _with_lower_orders(
    name: str, examination: Examination, description: SlaveDescription, configuration: Configure
) -> Remedy:
    order, refusal = examination.input_order or 0, examination.input_refusal
    if description.input_derivatives is not InputDerivatives.NATIVE:
        raise SlaveError(refusal, slave=name, phase=SetInputs.verb)
    warning = f"{name}: its input derivatives are emulated, as it makes no use of any: {refusal}"
    if order:
        warning = (
            f"{name}: it makes use of input derivatives up to order {order} only, so polynomials "
            f"of higher degree are followed in substeps of that order: {refusal}"
        )
    return Remedy(replace(configuration, max_input_order=order), warnings=(warning,))


def _with_clocks(
    name: str,
    new: Sequence[str],
    description: SlaveDescription,
    configuration: Configure,
    system: System,
) -> Remedy:
    """Outputs that do not repeat, and that nothing depends on: compared with nothing from here."""
    settings = system.slaves[name]
    continuous = [n for n in new if description.variable(n).is_continuous_real]
    left_out = tuple(n for n in continuous if n not in settings.tolerances)
    what = (
        f"{name}: {_listed(new)} tell of the computation, not of the model, as clocks and counters "
        "do: they do not repeat, or change with the number of steps; nothing is connected to them"
    )
    if left_out:
        what += f"; kept out of ERR: {_listed(left_out)}"
    if len(left_out) < len(continuous):
        what += "; those that have tolerances of their own stay in it"
    return Remedy(
        replace(configuration, not_repeating=(*configuration.not_repeating, *new)),
        {"uncontrolled": (*settings.uncontrolled, *left_out)} if left_out else {},
        (what,),
    )


def _without_derivatives(
    name: str, examination: Examination, description: SlaveDescription, system: System
) -> tuple[dict[str, Any], str]:
    """The outputs of which derivatives are used from here on, and what to say."""
    poor = examination.poor_derivatives
    by_reason: dict[str, list[str]] = {}
    for output, reason in poor.items():
        by_reason.setdefault(reason, []).append(output)
    texts = [f"those of {_listed(outputs)} are {reason}" for reason, outputs in by_reason.items()]
    what = f"{name}: not all of its output derivatives are derivatives: {'; '.join(texts)}"
    given = system.slaves[name].output_derivatives
    outputs = [v.name for v in description.of(Causality.OUTPUT) if v.is_continuous_real]
    used = tuple(o for o in (outputs if given is None else given) if o not in poor)
    return {"output_derivatives": used}, f"{what}; they are not used"


def _listed(names: Sequence[str]) -> str:
    if len(names) <= _NAMED:
        return ", ".join(names)
    return f"{', '.join(names[:_NAMED])} and {len(names) - _NAMED} more"


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
        name: asdict(examination) | {"state_verdict": str(examination.state_verdict)}
        for name, examination in examinations.items()
    }
