"""The outputs of all slaves at one communication point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.discrete import DiscreteValues
from protocol.calls import (
    Call,
    GetDiscreteOutputs,
    GetOutputs,
    GetRecordedVariables,
    RecordedValues,
    Reply,
)
from protocol.signals import FloatArray
from protocol.variables import StartValue


class Outputs(NamedTuple):
    """Outputs of all slaves at one point.

    Attributes:
        y: continuous outputs, shape (m,) or (rows, m), with derivatives in further rows.
        d: discrete outputs, then recorded variables; None stands for one that was not read.
    """

    y: FloatArray
    d: DiscreteValues = ()


NO_OUTPUTS = Outputs(np.zeros((1, 0)))
"""Outputs where nothing is discrete, and those at the beginning of a step are not needed."""


def gather(coupled: CoupledSystem, replies: Sequence[Reply], rows: int = 1) -> Outputs:
    """The outputs at the end of each reply.

    Args:
        coupled: the system.
        replies: of all slaves, to `reading_calls`.
        rows: of the array; rows that were not read are 0.
    """
    y = np.zeros((rows, len(coupled.output_names)))
    d: list[StartValue] = []
    recorded: list[StartValue | None] = []
    for part, names, reply in zip(coupled.parts, coupled.recorded.names, replies, strict=True):
        results: list[Any] = list(reply.results)
        if isinstance(results[-1], RecordedValues):
            recorded += coupled.recorded.values(results.pop())
        else:
            recorded += [None] * len(names)
        if part.discrete_outputs:
            d += results.pop()
        values = results.pop()
        y[: len(values), part.output_slice] = values
    return Outputs(y, (*d, *recorded))  # type: ignore[arg-type]


def reading_calls(
    coupled: CoupledSystem, get_outputs: Sequence[GetOutputs], *, records: bool = False
) -> list[tuple[Call, ...]]:
    """The calls that read all outputs of each slave, and the recorded variables if ``records``."""
    return [
        (
            get,
            *((GetDiscreteOutputs(),) if part.discrete_outputs else ()),
            *((GetRecordedVariables(),) if names and records else ()),
        )
        for part, names, get in zip(coupled.parts, coupled.recorded.names, get_outputs, strict=True)
    ]
