"""Decision for implicit coupling, and the memory that it is made from.

The loop gain is the factor by which an error of the inputs comes back to them after one sweep
through all slaves. An explicit double step is such a sweep: its error is what its estimate says
while the gain is small, and larger by 1 / (1 - gain) where an error comes back with its own sign.
Near 1 its estimate is blind, and beyond it is unstable (docs/numerics.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from master_node.numerics.collocation import NODES
from master_node.numerics.interface_jacobian import Interface, InterfaceJacobian, Secants
from protocol.signals import FloatArray

STIFF = 0.6
"""Loop gain that is not borne for long. Explicit double steps lose their stability there, as the
differences that tell the gain are larger at the end of the step than in its mean."""

BLIND = 0.9
"""Loop gain from which on the estimate of an explicit double step is enlarged to what the loop
makes of it."""

LASTING = 0.25
"""Loop gain that is not borne for ever: polynomials of degree 2 and 3 enlarge an error of their
points so much that a loop with direct feed-through is at its stability limit there."""

CALM = 0.1
"""Loop gain up to which explicit double steps take over again."""

_PATIENCE = 3
"""Explicit double steps in a row with a large loop gain before iterated ones are tried."""

_LASTING_PATIENCE = 8
"""Factor of that patience where the loop gain is a lasting one."""

_RELIEF = 3
"""Double steps with a lasting gain that one with a smaller one makes good."""

_SMOOTHING = 0.05
"""Weight of the newest H in the mean of the explicit ones."""

_CALM_IN_A_ROW = 2
"""Iterated double steps in a row with a small one before explicit ones take over."""

_MOST_POOR = 6
"""Iterated double steps that lead less far for their do_steps than explicit ones did, less those
that lead further, before explicit ones take over."""

_EXPLICIT_DO_STEPS = 3
"""That an explicit double step costs."""

_WORTH = 1.5
"""Factor by which iterated double steps have to lead further: they cost trials, too."""

_MOST_PATIENCE = 24
"""Largest patience: it is doubled each time that iterated double steps were not worth it."""

_SMALLEST_DIFFERENCE = 1e-5
"""Difference of the inputs, in units of their tolerances, below which outputs tell nothing."""


class CouplingMemory(NamedTuple):
    """Memory of a run for the choice between explicit and iterated double steps.

    Attributes:
        is_implicit: whether double steps are iterated.
        secants: of each slave; empty before the first iteration.
        in_a_row: double steps in a row for which the other way speaks.
        lasting: explicit double steps with a lasting loop gain, less what smaller gains made good.
        patience: explicit double steps in a row with a large loop gain that are borne.
        explicit_step_size: mean H of the last explicit double steps that were accepted [s].
        iterated_step_size: the largest H of the iterated ones, since they began [s].
        poor: iterated double steps that led less far for their do_steps than explicit ones, less
            those that led further; with the largest H so far they are not there yet, and do not
            count.
    """

    is_implicit: bool = False
    secants: tuple[Secants, ...] = ()
    in_a_row: int = 0
    lasting: int = 0
    patience: int = _PATIENCE
    explicit_step_size: float = 0.0
    iterated_step_size: float = 0.0
    poor: int = 0

    def noted(self, loop_gain: float) -> CouplingMemory:
        """With the loop gain that an explicit double step tells, accepted or not."""
        lasting = self.lasting + 1 if loop_gain >= LASTING else max(0, self.lasting - _RELIEF)
        in_a_row = self.in_a_row + 1 if loop_gain >= STIFF else 0
        return self._replace(in_a_row=in_a_row, lasting=lasting)

    def after_explicit(self, step_size: float) -> CouplingMemory:
        """After an explicit double step of ``step_size`` H [s] was accepted."""
        mean = self.explicit_step_size or step_size
        mean += _SMOOTHING * (step_size - mean)
        return self._replace(explicit_step_size=mean)

    @property
    def asks_for_iteration(self) -> bool:
        """True if iterated double steps are to be tried."""
        is_stiff = self.in_a_row >= self.patience
        is_lasting = self.lasting >= _LASTING_PATIENCE * self.patience
        return not self.is_implicit and (is_stiff or is_lasting)

    def iterating(self, secants: tuple[Secants, ...]) -> CouplingMemory:
        """Memory at the beginning of iterated double steps, with what is known of each slave."""
        return self._replace(is_implicit=True, secants=secants, in_a_row=0, lasting=0)

    def extrapolating(self, patience: int) -> CouplingMemory:
        """Memory at the time at which explicit double steps take over."""
        return CouplingMemory(
            patience=min(patience, _MOST_PATIENCE), explicit_step_size=self.explicit_step_size
        )

    def after_iterated(
        self, secants: tuple[Secants, ...], iterations: int, step_size: float, loop_gain: float
    ) -> CouplingMemory:
        """After an iterated double step was accepted.

        Args:
            secants: that are known by then.
            iterations: that it took.
            step_size: H [s].
            loop_gain: that it had; infinite where it is not known.
        """
        calm = self.in_a_row + 1 if loop_gain <= CALM else 0
        if calm >= _CALM_IN_A_ROW:
            return self.extrapolating(_PATIENCE)
        explicit = self.explicit_step_size / _EXPLICIT_DO_STEPS
        is_poor = step_size / (NODES * iterations) < _WORTH * explicit
        is_largest = step_size > self.iterated_step_size
        poor = self.poor + (not is_largest) if is_poor else max(0, self.poor - 1)
        if poor >= _MOST_POOR:
            return self.extrapolating(2 * self.patience)
        return self._replace(
            secants=secants,
            in_a_row=calm,
            iterated_step_size=max(step_size, self.iterated_step_size),
            poor=poor,
        )


def explicit_jacobian(
    interface: Interface, inputs: FloatArray, outputs: FloatArray, scale: FloatArray
) -> InterfaceJacobian:
    """Interface Jacobian as far as the two solutions of an explicit double step tell it.

    Each slave has answered to two inputs from the same state: one secant, that of the direction in
    which the extrapolation errs.

    Args:
        interface: which inputs and outputs belong to which slave.
        inputs: mean difference of the inputs in the step, shape (n,), unit [u].
        outputs: difference of the outputs at its end, shape (m,), unit [y].
        scale: tolerances of the inputs, shape (n,), unit [u].
    """
    secants = [
        Secants((inputs[columns],), (outputs[rows],))
        if np.abs(inputs[columns] / scale[columns]).max(initial=0.0) > _SMALLEST_DIFFERENCE
        else Secants()
        for columns, rows in zip(interface.input_slices, interface.output_slices, strict=True)
    ]
    return InterfaceJacobian(secants, interface, scale[np.newaxis])
