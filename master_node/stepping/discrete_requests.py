"""Requests of steps for systems in which not everything is continuous, or more is recorded."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Any

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.discrete import DiscreteValues
from master_node.coupling.scheme import CouplingScheme
from master_node.slaves.group import Program, SlaveGroup
from master_node.stepping.requests import (
    BrokenOffError,
    FailedStep,
    Piece,
    RequestForm,
    StepForm,
    StepRequests,
)
from protocol.calls import (
    Call,
    DoStep,
    GetDiscreteOutputs,
    GetOutputs,
    GetRecordedVariables,
    SetDiscreteInputs,
)
from protocol.signals import FloatArray
from protocol.variables import StartValue

_GET_DISCRETE_OUTPUTS = GetDiscreteOutputs()
_GET_RECORDED_VARIABLES = GetRecordedVariables()


def step_requests(
    group: SlaveGroup, coupled: CoupledSystem, scheme: CouplingScheme
) -> StepRequests:
    """The requests that a system needs.

    Args:
        group: the slaves, at their first communication point.
        coupled: their connections.
        scheme: how they are coupled within a step.
    """
    is_plain = coupled.discrete.is_empty and coupled.recorded.is_empty
    kind = StepRequests if is_plain else DiscreteStepRequests
    return kind(group, coupled, scheme)


class DiscreteStepRequests(StepRequests):
    """Sets discrete inputs before each step, and reads discrete outputs and recorded variables
    after it.

    Args:
        group: the slaves, at their first communication point.
        coupled: their connections.
        scheme: how they are coupled within a step.
    """

    def __init__(self, group: SlaveGroup, coupled: CoupledSystem, scheme: CouplingScheme) -> None:
        super().__init__(group, coupled, scheme)
        self._discrete = coupled.discrete
        self._reads = [bool(part.discrete_outputs) for part in coupled.parts]
        self._sets = [bool(part.discrete_inputs) for part in coupled.parts]
        self._records = list(map(bool, coupled.recorded.names))

    def _program(
        self, slave: int, form: RequestForm, pieces: Sequence[Piece], inputs: Sequence[FloatArray]
    ) -> Program:
        calls: list[Call] = []
        steps, records = iter(pieces), iter(step.records for step in form.steps)
        for call in super()._program(slave, form, pieces, inputs):
            if type(call) is DoStep and self._sets[slave]:
                calls.append(SetDiscreteInputs(next(steps).held[slave]))
            calls.append(call)
            if type(call) is GetOutputs:
                if self._reads[slave]:
                    calls.append(_GET_DISCRETE_OUTPUTS)
                if next(records) and self._records[slave]:
                    calls.append(_GET_RECORDED_VARIABLES)
        return tuple(calls)

    def _places(self, steps: Sequence[StepForm]) -> Sequence[Sequence[int]]:
        (common, *_) = super()._places(steps)
        recorded = np.cumsum([0, *(step.records for step in steps)])[:-1].tolist()
        return [
            [
                place + sets * (number + 1) + reads * number + records * recorded[number]
                for number, place in enumerate(common)
            ]
            for sets, reads, records in zip(self._sets, self._reads, self._records, strict=True)
        ]

    def _discrete_outputs(
        self, answers: Sequence[list[Any] | None], form: RequestForm
    ) -> list[DiscreteValues]:
        return [
            self._values(answers, [places[number] for places in form.places], step.records)
            for number, step in enumerate(form.steps)
        ]

    def _values(
        self, answers: Sequence[list[Any] | None], places: Sequence[int], records: bool
    ) -> DiscreteValues:
        """Those of one piece, whose continuous outputs are at these places of the answers."""
        d: list[Any] = []
        recorded: list[Any] = []
        for slave, (columns, names) in enumerate(
            zip(self._discrete.output_slices, self._recorded.names, strict=True)
        ):
            results, place = answers[slave], places[slave] + 1
            if results is not None and self._reads[slave]:
                d += results[place]
                place += 1
            else:
                d += [None] * (columns.stop - columns.start)
            if results is not None and records and names:
                recorded += self._recorded.values(results[place])
            else:
                recorded += [None] * len(names)
        self._check_finite(d)
        return (*d, *recorded)

    def _check_finite(self, d: Sequence[StartValue | None]) -> None:
        for name, value in zip(self._discrete.names, d, strict=True):
            if isinstance(value, float) and not isfinite(value):
                reason = f"{name} is not finite"
                raise BrokenOffError(FailedStep("", None, float("nan"), reason))
