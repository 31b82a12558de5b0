"""From instantiated slaves to slaves that a run can rely on: configured, initialized, examined."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem, resolve
from master_node.coupling.external import Signals
from master_node.coupling.outputs import Outputs
from master_node.coupling.scheme import CouplingScheme
from master_node.preparing.configuring import configuration, reconfigure
from master_node.preparing.examinations import LADDER, examine, is_to_be_examined, remedy
from master_node.preparing.initialization import initialize
from master_node.slaves.group import SlaveGroup
from master_node.system.system import System
from protocol.calls import Configure, GetOutputs, Reset
from protocol.description import Examination, SlaveDescription, StateKind
from protocol.errors import (
    FatalSlaveError,
    ModelError,
    SlaveCrashedError,
    SlaveError,
    SlaveLostError,
)

log = logging.getLogger("master_node")

_ROUNDS = 10
"""For each slave one for each way to save states, two for its inputs, two for clocks among its
outputs, one for its steps."""


@dataclass(frozen=True)
class Prepared:
    """Slaves that have shown what they are.

    Attributes:
        system: the settings, with the rules that the slaves' clocks ask for, and without the
            derivatives and tolerances that make no sense.
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
    names = {name for name, d in descriptions.items() if is_to_be_examined(d, system)}
    return _Preparation(group, prepared, signals).result(names) if names else prepared


class _Preparation:
    """Rounds of trial steps, until nothing more is to be done about any slave.

    Args:
        group: the slaves, instantiated.
        prepared: as they are configured.
        signals: what drives the external inputs.
    """

    def __init__(self, group: SlaveGroup, prepared: Prepared, signals: Signals) -> None:
        self._group = group
        self._prepared = prepared
        self._signals = signals
        self._first: Outputs | None = None
        self._were_reset: set[str] = set()
        self._loads: set[str] = set()

    def result(self, names: set[str]) -> Prepared:
        """The slaves at T_0, after these were examined."""
        for _ in range(_ROUNDS):
            outputs = self._initialized()
            if not names:
                break
            found, changed = self._examined(names, outputs)
            if not changed and not any(examination.has_moved for examination in found.values()):
                break
            self._begin_anew()
            names = self._loaded(changed)
        else:
            outputs = self._initialized()
        return replace(self._prepared, outputs=outputs)

    def _say(self, warning: str) -> None:
        if warning not in self._prepared.warnings:
            log.warning("%s", warning)
            warnings = (*self._prepared.warnings, warning)
            self._prepared = replace(self._prepared, warnings=warnings)

    # ---- Beginnings -----------------------------------------------------------------------------

    def _initialized(self) -> Outputs:
        """Outputs at T_0: the same each time, or a slave's reset is broken."""
        while True:
            system = self._prepared.system
            coupled = resolve(system, self._prepared.descriptions, self._signals)
            scheme = CouplingScheme.of(coupled, system)
            try:
                outputs = initialize(self._group, coupled, system, scheme.get_outputs)
            except (SlaveLostError, SlaveCrashedError, FatalSlaveError):
                raise
            except SlaveError as error:
                if self._goes_on_without_derivatives(error, scheme):
                    continue
                if error.slave not in self._were_reset:
                    raise
                broken = {error.slave: f"{error.phase}: {error.cause}"}
            else:
                if self._first is None:
                    self._first = outputs
                different = self._beginning_elsewhere(coupled, outputs)
                broken = dict.fromkeys(different, "its outputs at the start are others than before")
                if not broken:
                    return outputs
            for name, reason in broken.items():
                self._say(_broken_reset(name, reason))
            self._loads |= broken.keys()
            self._begin_anew()

    def _goes_on_without_derivatives(self, error: SlaveError, scheme: CouplingScheme) -> bool:
        """True if a slave refused its output derivatives, without which all begins anew."""
        reads = dict(zip(self._group.names, scheme.get_outputs, strict=True))
        if error.phase != GetOutputs.verb or not reads[error.slave].order:
            return False
        self._say(f"{error.slave}: its output derivatives are not used: {error.cause}")
        system = self._prepared.system.with_slave(error.slave, output_derivatives=())
        self._prepared = replace(self._prepared, system=system)
        self._begin_anew()
        return True

    def _beginning_elsewhere(self, coupled: CoupledSystem, outputs: Outputs) -> set[str]:
        """The slaves that were reset and have other outputs now, nearest to where it begins."""
        first = self._first
        assert first is not None
        levels = coupled.initialization
        keys = [(part.name, output) for part in coupled.parts for output in part.outputs]
        of_level: dict[int, set[tuple[str, str]]] = {}
        for index in np.flatnonzero(outputs.y[0] != first.y[0]).tolist():
            level = int(levels.levels[index]) if levels.levels.size else 0
            of_level.setdefault(level, set()).add(keys[index])
        for index, (one, other) in enumerate(zip(outputs.d, first.d, strict=True)):
            if one != other:
                level = int(levels.discrete_levels[index]) if levels.discrete_levels.size else 0
                of_level.setdefault(level, set()).add(coupled.discrete.keys[index])
        not_repeating = {
            (name, output)
            for name, configured in self._prepared.configurations.items()
            for output in configured.not_repeating
        }
        for _, outputs_there in sorted(of_level.items()):
            slaves = {name for name, _ in outputs_there - not_repeating}
            if slaves & self._were_reset:
                return slaves & self._were_reset
        return set()

    def _begin_anew(self) -> None:
        """Bring all slaves back to where they were instantiated."""
        time = float(self._prepared.system.simulation.start_time)
        names = self._group.names
        programs = [(Reset(loads=name in self._loads),) for name in names]
        replies = self._group.execute(programs, time)
        self._were_reset = {name for name in names if name not in self._loads}
        for number, (name, reply) in enumerate(zip(names, replies, strict=True)):
            if reply.error is None:
                continue
            (again,) = self._group.execute([(Reset(loads=True),)], time, slaves=[number])
            if name in self._loads or again.error is not None:
                error = reply.error
                error.remedy = error.remedy or _REMEDY
                raise error
            self._say(_broken_reset(name, reply.error.cause))
            self._loads.add(name)
            self._were_reset.discard(name)

    # ---- Trial steps ----------------------------------------------------------------------------

    def _examined(
        self, names: set[str], outputs: Outputs
    ) -> tuple[dict[str, Examination], dict[str, Configure]]:
        """Findings about these slaves, and the configurations that change by them."""
        prepared = self._prepared
        system, descriptions = prepared.system, prepared.descriptions
        configurations = prepared.configurations
        coupled = resolve(system, descriptions, self._signals)
        found = examine(
            self._group,
            coupled,
            system,
            outputs.y[0],
            {name: configurations[name] for name in names},
        )
        changed = {}
        for name in (name for name in self._group.names if name in found):
            what = remedy(name, found[name], descriptions[name], configurations[name], system)
            for warning in what.warnings:
                self._say(warning)
            if what.configuration != configurations[name]:
                changed[name] = what.configuration
            if what.settings:
                system = system.with_slave(name, **what.settings)
        examinations = {**prepared.examinations, **found}
        self._prepared = replace(self._prepared, system=system, examinations=examinations)
        return found, changed

    def _loaded(self, wanted: Mapping[str, Configure]) -> set[str]:
        """Load slaves anew; where there is no such way to save states, with the next one.

        Returns:
            Those that are to be examined as they are now.
        """
        prepared, group = self._prepared, self._group
        loaded, configurations = dict(prepared.descriptions), dict(prepared.configurations)
        for name in sorted(wanted, key=group.names.index):
            configured = wanted[name]
            while True:
                try:
                    loaded |= reconfigure(group, {name: configured})
                    break
                except ModelError as error:
                    kind = configured.state_kind
                    if not kind or kind == StateKind.NONE:
                        raise
                    following = LADDER[LADDER.index(StateKind(kind)) + 1]
                    log.warning("%s: no saved states by %s: %s", name, kind, error.cause)
                    configured = replace(configured, state_kind=following)
                    group.execute([(Reset(),)], slaves=[group.names.index(name)])
            configurations[name] = configured
            self._were_reset.discard(name)
        self._prepared = replace(prepared, descriptions=loaded, configurations=configurations)
        return {name for name in wanted if is_to_be_examined(loaded[name], prepared.system)}


def _broken_reset(name: str, reason: str) -> str:
    return f"{name}: its reset is broken: {reason}; it is loaded anew instead"


_REMEDY = "leave the trial steps out: [simulation] examine = false"
