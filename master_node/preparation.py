"""From instantiated slaves to slaves that a run can rely on: configured, initialized, examined."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from master_node.configuration import System
from master_node.configure_slaves import configuration, reconfigure
from master_node.coupling_scheme import CouplingScheme
from master_node.examinations import (
    LADDER,
    examine,
    is_to_be_examined,
    remedy,
)
from master_node.external_resolution import Signals
from master_node.initialization import initialize
from master_node.outputs import Outputs
from master_node.slave_group import SlaveGroup
from master_node.system import resolve
from protocol.calls import Configure, Reset
from protocol.errors import DoublestepError, ModelError
from protocol.slave import Examination, SlaveDescription, StateKind

log = logging.getLogger("master_node")

_ROUNDS = 4
"""One for each way to save states."""


@dataclass(frozen=True)
class Prepared:
    """Slaves that have shown what they are.

    Attributes:
        system: the settings, with the rules that the slaves' clocks ask for.
        descriptions: of the slaves as they are configured now.
        configurations: by slave.
        examinations: by slave, of those that took trial steps: the last one of each.
        warnings: what the user was told of them.
        outputs: at T_0, where the slaves stand, those of continuous variables of shape (rows, m);
            None: they are instantiated.
    """

    system: System
    descriptions: Mapping[str, SlaveDescription]
    configurations: Mapping[str, Configure]
    examinations: Mapping[str, Examination] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    outputs: Outputs | None = None


def prepare(
    group: SlaveGroup,
    system: System,
    descriptions: Mapping[str, SlaveDescription],
    signals: Signals,
) -> Prepared:
    """Examine the slaves, and do about them what that calls for; warnings go to the log.

    Only where something hangs on it: with an estimator, and unless ``examine = false``.

    Args:
        group: the slaves, instantiated.
        system: the settings.
        descriptions: of the slaves, configured as the system says.
        signals: what drives the external inputs.

    Raises:
        DoublestepError: a slave was lost, refused to be initialized, or cannot be reset.
    """
    configurations = {
        name: configuration(name, system, description) for name, description in descriptions.items()
    }
    prepared = Prepared(system, descriptions, configurations)
    if system.simulation.estimator == "none" or not system.simulation.examine:
        return prepared
    names = {name for name, description in descriptions.items() if is_to_be_examined(description)}
    for _ in range(_ROUNDS):
        if not names:
            break
        prepared, names = _examined(group, prepared, names, signals)
    return prepared


def _examined(
    group: SlaveGroup, prepared: Prepared, names: set[str], signals: Signals
) -> tuple[Prepared, set[str]]:
    """One round; also the slaves that are loaded anew, and so are to be examined again."""
    system, descriptions = prepared.system, prepared.descriptions
    coupled = resolve(system, descriptions, signals)
    scheme = CouplingScheme.of(coupled, system)
    outputs = initialize(group, coupled, system, scheme.get_outputs)
    found = examine(group, coupled, system, outputs.y, names)
    wanted = dict(prepared.configurations)
    warnings = list(prepared.warnings)
    for name, finding in found.items():
        what = remedy(name, finding, descriptions[name], wanted[name], system)
        for warning in what.warnings:
            if warning not in warnings:
                log.warning("%s", warning)
                warnings.append(warning)
        wanted[name] = what.configuration
        if what.step_multiple is not None:
            system = system.with_slave(name, step_multiple=what.step_multiple)
    changed = {name for name in names if wanted[name] != prepared.configurations[name]}
    examinations = dict(prepared.examinations)
    examinations |= {name: finding.examination for name, finding in found.items()}
    prepared = replace(prepared, system=system, examinations=examinations, warnings=tuple(warnings))
    if not changed and all(finding.is_harmless for finding in found.values()):
        return replace(prepared, outputs=outputs), set()
    _reset(group, float(system.simulation.start_time))
    descriptions, wanted = _loaded(group, descriptions, wanted, changed)
    again = {name for name in changed if descriptions[name].state_kind is not StateKind.NONE}
    return replace(prepared, descriptions=descriptions, configurations=wanted), again


def _reset(group: SlaveGroup, time: float) -> None:
    try:
        group.execute_all([(Reset(),)] * len(group), time)
    except DoublestepError as error:
        error.remedy = error.remedy or "leave the trial steps out: [simulation] examine = false"
        raise


def _loaded(
    group: SlaveGroup,
    descriptions: Mapping[str, SlaveDescription],
    wanted: Mapping[str, Configure],
    changed: set[str],
) -> tuple[dict[str, SlaveDescription], dict[str, Configure]]:
    """Load slaves anew; where a way to save states is not to be had, with the next one."""
    loaded, configurations = dict(descriptions), dict(wanted)
    for name in sorted(changed, key=group.names.index):
        while True:
            try:
                loaded |= reconfigure(group, {name: configurations[name]})
                break
            except ModelError as error:
                kind = configurations[name].state_kind
                if not kind or kind == StateKind.NONE:
                    raise
                following = LADDER[LADDER.index(StateKind(kind)) + 1]
                log.warning("%s: no saved states by %s: %s", name, kind, error.cause)
                configurations[name] = replace(configurations[name], state_kind=following)
                group.execute([(Reset(),)], slaves=[group.names.index(name)])
    return loaded, configurations
