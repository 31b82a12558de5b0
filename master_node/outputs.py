"""The outputs of all slaves at one communication point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from master_node.discrete_coupling import DiscreteValues
from master_node.system import CoupledSystem
from protocol.calls import Reply
from protocol.signals import FloatArray
from protocol.slave import StartValue


class Outputs(NamedTuple):
    """What the slaves gave.

    Attributes:
        y: continuous outputs, shape (m,) or (rows, m), with derivatives in further rows.
        d: discrete outputs.
    """

    y: FloatArray
    d: DiscreteValues = ()


NO_OUTPUTS = Outputs(np.zeros((1, 0)))
"""Of a system without discrete variables, where those at the beginning of a step are not needed."""


def gather(coupled: CoupledSystem, replies: Sequence[Reply], rows: int = 1) -> Outputs:
    """The outputs at the end of each reply: of `GetOutputs`, then of `GetDiscreteOutputs`.

    Args:
        coupled: the system.
        replies: of all slaves; only those that have discrete outputs were asked for them.
        rows: of the array; rows that were not read are 0.
    """
    y = np.zeros((rows, len(coupled.output_names)))
    d: list[StartValue] = []
    for part, reply in zip(coupled.parts, replies, strict=True):
        results: list[Any] = reply.results
        if part.discrete_outputs:
            d += results[-1]
        values = results[-2 if part.discrete_outputs else -1]
        y[: len(values), part.output_slice] = values
    return Outputs(y, tuple(d))
