"""Requests of steps for systems in which not everything is continuous."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Any

from master_node.coupling_scheme import CouplingScheme
from master_node.discrete_coupling import DiscreteValues
from master_node.slave_group import Program, SlaveGroup
from master_node.step_requests import (
    BrokenOffError,
    FailedStep,
    Piece,
    RequestForm,
    StepForm,
    StepRequests,
)
from master_node.system import CoupledSystem
from protocol.calls import Call, DoStep, GetDiscreteOutputs, GetOutputs, SetDiscreteInputs
from protocol.signals import FloatArray
from protocol.slave import StartValue

_GET_DISCRETE_OUTPUTS = GetDiscreteOutputs()


def step_requests(
    group: SlaveGroup, coupled: CoupledSystem, scheme: CouplingScheme
) -> StepRequests:
    """The requests that a system needs.

    Args:
        group: the slaves, at their first communication point.
        coupled: their connections.
        scheme: how they are coupled within a step.
    """
    kind = StepRequests if coupled.discrete.is_empty else DiscreteStepRequests
    return kind(group, coupled, scheme)


class DiscreteStepRequests(StepRequests):
    """Sets discrete inputs before each step and reads discrete outputs after it.

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

    def _program(
        self, slave: int, form: RequestForm, pieces: Sequence[Piece], inputs: Sequence[FloatArray]
    ) -> Program:
        calls: list[Call] = []
        steps = iter(pieces)
        for call in super()._program(slave, form, pieces, inputs):
            if type(call) is DoStep and self._sets[slave]:
                calls.append(SetDiscreteInputs(next(steps).held[slave]))
            calls.append(call)
            if type(call) is GetOutputs and self._reads[slave]:
                calls.append(_GET_DISCRETE_OUTPUTS)
        return tuple(calls)

    def _places(self, steps: Sequence[StepForm]) -> Sequence[Sequence[int]]:
        (common, *_) = super()._places(steps)
        return [
            [place + sets * (number + 1) + reads * number for number, place in enumerate(common)]
            for sets, reads in zip(self._sets, self._reads, strict=True)
        ]

    def _discrete_outputs(
        self, answers: Sequence[list[Any] | None], places: Sequence[Sequence[int]]
    ) -> list[DiscreteValues]:
        found = []
        for number in range(len(places[0])):
            d: list[Any] = []
            for slave, columns in enumerate(self._discrete.output_slices):
                results = answers[slave]
                if results is not None and self._reads[slave]:
                    d += results[places[slave][number] + 1]
                else:
                    d += [None] * (columns.stop - columns.start)
            self._check_finite(d)
            found.append(tuple(d))
        return found

    def _check_finite(self, d: Sequence[StartValue | None]) -> None:
        for name, value in zip(self._discrete.names, d, strict=True):
            if isinstance(value, float) and not isfinite(value):
                reason = f"{name} is not finite"
                raise BrokenOffError(FailedStep("", None, float("nan"), reason))
