"""From a study to runs that are checked: nothing is started before all of them are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points, version
from typing import Any

from master_node.coupling.coupled_system import CoupledSystem, resolve
from master_node.coupling.step_sizes import check_step_sizes, with_fixed_steps
from master_node.inputs.loading import load_signals
from master_node.numerics.reductions import REDUCTIONS_OF_VALUES
from master_node.results.patterns import chosen
from master_node.results.selection import check_variables
from master_node.results.summary import settings_sha256
from master_node.study.case import Case, apply_case
from master_node.study.cases import cases_of
from master_node.study.configuration import Study
from master_node.system.files import open_system
from master_node.system.summary import settings_of
from master_node.system.system import System
from master_node.system.tables import InputSettings
from protocol.description import SlaveDescription
from protocol.errors import ConfigurationError, DoublestepError
from protocol.host.files import file_sha256
from protocol.text.names import nearest
from protocol.variables import VariableType

_NO_INFLUENCE = ("bus", "system_file")
"""Settings that change nothing in the results of a run."""


@dataclass(frozen=True)
class PlannedRun:
    """One run of a study.

    Attributes:
        number: from 1.
        case: its parameters.
        fingerprint: SHA-256 of all that its results depend on: the settings, the models, the
            files of the inputs, and the version of Doublestep.
    """

    number: int
    case: Case
    fingerprint: str


@dataclass(frozen=True)
class Plan:
    """A study whose runs were checked.

    Attributes:
        study: as it was read.
        runs: in the order of their numbers.
        parameters: the names of all parameters, in the order of the columns.
    """

    study: Study
    runs: tuple[PlannedRun, ...]
    parameters: tuple[str, ...]


def make_plan(study: Study) -> Plan:
    """Make the cases of a study and check each as far as it can be without a run.

    FMUs are described without loading their binaries; modules of Python models are imported.

    Raises:
        ConfigurationError: with the name of the study and the number of the run.
    """
    cases = cases_of(study)
    with open_system(study.system_file) as system:
        descriptions = _describe(study, system)
        check = _Check(study, system, descriptions)
        runs = tuple(
            PlannedRun(number, case, check.fingerprint(number, case))
            for number, case in enumerate(cases, start=1)
        )
    names = tuple(dict.fromkeys(name for case in cases for name in case))
    return Plan(study, runs, names)


def _describe(study: Study, system: System) -> dict[str, SlaveDescription]:
    load = entry_points(group="doublestep.in_process")["describe"].load()
    describe = cache(lambda model: load(model, system.base))
    descriptions = {}
    for name, settings in system.slaves.items():
        if settings.model is None:
            raise ConfigurationError(
                f"{study.source}: {system.source}: [slaves.{name}] has no model: runs of a study "
                "start all their slaves"
            )
        try:
            descriptions[name] = describe(settings.model)
        except DoublestepError as error:
            raise error.located(slave=name) from None
    return descriptions


class _Check:
    """Checks the cases of one study, and does but once what is the same for all."""

    def __init__(
        self, study: Study, system: System, descriptions: Mapping[str, SlaveDescription]
    ) -> None:
        if "simulation" in system.slaves:
            raise ConfigurationError(
                f"{study.source}: {system.source} has a slave called 'simulation', which a study "
                "takes for the table: give it another name"
            )
        self._study = study
        self._system = system
        self._descriptions = descriptions
        self._signals: dict[tuple[float, float], Any] = {}
        self._surroundings = {
            "version": version("doublestep"),
            "files": _hashes_of_input_files(system),
        }

    def fingerprint(self, number: int, case: Case) -> str:
        """The fingerprint of a case that has no mistake."""
        try:
            system = apply_case(self._system, case)
            coupled = self._resolve(system)
        except ConfigurationError as error:
            raise ConfigurationError(
                f"{self._study.source}: run {number}: {error}"
            ) from error.__cause__
        if number == 1:
            self._check_outputs(coupled)
        settings = settings_of(system, self._descriptions)
        kept = {key: value for key, value in settings.items() if key not in _NO_INFLUENCE}
        return settings_sha256({"settings": kept, **self._surroundings})

    def _resolve(self, system: System) -> CoupledSystem:
        span = (float(system.simulation.start_time), system.checked().simulation.end)
        check_step_sizes(with_fixed_steps(system, self._descriptions))
        if span not in self._signals:
            self._signals[span] = load_signals(system)
        return resolve(system, self._descriptions, self._signals[span])

    def _check_outputs(self, coupled: CoupledSystem) -> None:
        recorded = coupled.recorded
        discrete = dict(zip(coupled.discrete.names, coupled.discrete.types, strict=True))
        names = (*coupled.output_names, *discrete)
        more = {one.name: one.variable.type for one in recorded.discrete}
        known = [*(one.name for one in recorded.continuous), *more]
        patterns = self._system.results.variables
        check_variables(patterns, names, f"{self._study.source}: {self._system.source}", known)
        known += [
            name for name, is_kept in zip(names, chosen(patterns, names), strict=True) if is_kept
        ]
        discrete |= more
        for name, output in self._study.results.outputs.items():
            where = f"{self._study.source}: [results.outputs.{name}]"
            variable = output.variable
            if variable not in known:
                raise ConfigurationError(
                    f"{where} variable = {variable!r}: no such output{nearest(variable, known)}"
                )
            if discrete.get(variable) in (VariableType.STRING, VariableType.BINARY):
                raise ConfigurationError(f"{where} {variable} is no number")
            if variable in discrete and output.reduce not in REDUCTIONS_OF_VALUES:
                raise ConfigurationError(
                    f"{where} reduce = {output.reduce!r}: {variable} is held between the points",
                    remedy=f"take one of {', '.join(sorted(REDUCTIONS_OF_VALUES))}",
                )


def _hashes_of_input_files(system: System) -> dict[str, str]:
    return {
        name: file_sha256(system.base / file)
        for name, value in system.inputs.items()
        if isinstance(value, InputSettings) and (file := value.file(system.base))
    }
