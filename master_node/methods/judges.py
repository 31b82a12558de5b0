"""Judges of double steps: extrapolated ones by a comparison solution, iterated ones by Milne."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from master_node.coupling.coupled_system import CoupledSystem
from master_node.judging.comparison import ErrorControl, StepError
from master_node.judging.iterated import IteratedErrorControl
from master_node.methods.coupling_memory import BLIND, LASTING, explicit_jacobian
from master_node.numerics.interface_jacobian import loop_gain_bound
from master_node.stepping.double_step import DoubleStep
from master_node.stepping.iterated_step import interface_of


class StepJudge(Protocol):
    """Estimates errors."""

    def judge(self, step: DoubleStep) -> StepError:
        """EST and ERR of a double step."""
        ...


class CoupledJudge:
    """Enlarges the estimate of an extrapolated double step to what a stiff loop makes of it.

    Args:
        coupled: the system.
        control: estimates the errors of extrapolated double steps.
    """

    def __init__(self, coupled: CoupledSystem, control: ErrorControl) -> None:
        self._coupled = coupled
        self._control = control
        self._iterated = IteratedErrorControl(coupled)
        self._interface = interface_of(coupled)
        counts = [len(part.connected) for part in coupled.parts]
        self._slaves = (
            np.repeat(np.arange(len(counts)), counts),
            coupled.output_slave[coupled.source],
        )

    def judge(self, step: DoubleStep) -> StepError:
        """See `StepJudge`."""
        if step.iteration is not None:
            return self._iterated.judge(step)
        error = self._control.judge(step)
        inputs, outputs = step.input_difference, step.comparison - step.end[0]
        scale = self._coupled.scale_of_inputs(error.scale)
        answers = self._coupled.changes_of_inputs(outputs) / scale
        if loop_gain_bound(inputs / scale, answers, *self._slaves) < LASTING:
            return error
        jacobian = explicit_jacobian(self._interface, inputs, outputs, scale)
        gain = jacobian.loop_gain
        if gain < BLIND:
            return error._replace(loop_gain=gain)
        enlarged = jacobian.enlargement(self._coupled.changes_of_inputs(error.estimate))
        difference = enlarged * error.difference
        return error._replace(difference=difference, norm=enlarged * error.norm, loop_gain=gain)
