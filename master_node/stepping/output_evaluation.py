"""Outputs with direct feed-through, evaluated again at a communication point with its new inputs.

A slave with feed-through computed its outputs at the end of a step with inputs that were
extrapolated there, or with external ones that it holds constant in each step. As the other
slaves' outputs are known by now, those inputs are too: setting
them and reading the outputs again, in the order of the feed-through graph, removes the direct part
of the error, so that order k + 2 is kept. Where outputs depend on each other in a loop, the loop is
solved.
"""

from __future__ import annotations

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.scheme import CouplingScheme
from master_node.numerics.fixed_point import NoFixedPointError, fixed_point
from master_node.slaves.group import Program, SlaveGroup
from protocol.calls import GetOutputs, GetRecordedVariables, RecordedValues, SetInputs
from protocol.errors import StepRejectedError
from protocol.signals import FloatArray

_READ = (GetOutputs(),)
_READ_ALL = (GetOutputs(), GetRecordedVariables())


class OutputEvaluation:
    """Evaluates the outputs of the slaves that allow it.

    Args:
        group: the slaves.
        coupled: their connections.
        scheme: says which slaves.
    """

    def __init__(self, group: SlaveGroup, coupled: CoupledSystem, scheme: CouplingScheme) -> None:
        self._group = group
        self._coupled = coupled
        self._slaves = scheme.evaluated
        self._parts = [coupled.parts[slave] for slave in self._slaves]
        self._recorded_names = [coupled.recorded.names[slave] for slave in self._slaves]
        order = coupled.at_point
        self._levels = 0 if order.loop else max(1, int(order.levels.max(initial=0)))
        self._loop = order.loop
        self._tolerance = 1e-3 * np.minimum(
            coupled.absolute_tolerance, np.maximum(coupled.relative_tolerance, 1e-12)
        )

    @property
    def is_needed(self) -> bool:
        """True if there is any output to evaluate again."""
        return bool(self._slaves)

    def evaluate(
        self,
        y: FloatArray,
        external: FloatArray,
        time: float,
        step_size: float,
        *,
        records: bool = False,
    ) -> dict[int, RecordedValues]:
        """Make the values of ``y`` consistent with each other, in place.

        Args:
            y: outputs as the slaves gave them at the end of a step, shape (rows, m). Derivatives
                stay: outputs with feed-through have none.
            external: values of the external inputs there, shape (n_e,).
            time: where that step began [s], for messages.
            step_size: its size [s], for messages.
            records: read recorded variables, too.

        Returns:
            What the slaves gave for recorded variables, by their indices.

        Raises:
            StepRejectedError: an algebraic loop has no solution that was found.
            DoublestepError: a slave failed.
        """
        recorded: dict[int, RecordedValues] = {}

        def again(values: FloatArray) -> FloatArray:
            following, found = self._round(values, external, time, step_size, records)
            recorded.update(found)
            return following

        if not self._loop:
            for _ in range(self._levels):
                y[0] = again(y[0])
            return recorded
        try:
            y[0] = fixed_point(again, y[0], tolerance=self._tolerance)
        except NoFixedPointError as error:
            worst = float(np.abs(error.residual).max())
            raise StepRejectedError(
                f"the algebraic loop {' -> '.join(self._loop)} has no solution that was found; "
                f"residual {worst:.3g}",
                phase="evaluate outputs",
                time=time,
                step_size=step_size,
            ) from None
        return recorded

    def _round(
        self, y: FloatArray, external: FloatArray, time: float, step_size: float, records: bool
    ) -> tuple[FloatArray, dict[int, RecordedValues]]:
        u, outside = self._coupled.inputs_of(y)[np.newaxis], external[np.newaxis]
        programs: list[Program] = [
            (SetInputs(part.columns(u, outside)), *(_READ_ALL if records and names else _READ))
            for part, names in zip(self._parts, self._recorded_names, strict=True)
        ]
        replies = self._group.execute(programs, time, step_size, self._slaves)
        following = y.copy()
        recorded = {}
        for slave, part, reply in zip(self._slaves, self._parts, replies, strict=True):
            if reply.error is not None:
                raise reply.error
            following[part.output_slice] = reply.results[1][0]  # type: ignore[index]
            if isinstance(reply.results[-1], RecordedValues):
                recorded[slave] = reply.results[-1]
        return following, recorded
