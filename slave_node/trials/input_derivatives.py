"""Input derivatives: up to which order a slave takes them, and makes use of them."""

from __future__ import annotations

from collections.abc import Callable
from math import factorial

import numpy as np

from protocol.errors import FatalSlaveError, SlaveError
from protocol.signals import FloatArray
from slave_node.trials.steps import Place, Reading, Trial, TrialError


def highest_order_below(
    trial: Trial,
    refused: int,
    refusal: str,
    accepts: Callable[[], object],
    begin: Callable[[], None] = lambda: None,
) -> tuple[int, str]:
    """The highest order that is taken, below one that was refused.

    Args:
        trial: of the slave.
        refused: order.
        refusal: what was said to it.
        accepts: does after inputs were set what tells whether they are taken.
        begin: brings the slave back to where it stood.

    Returns:
        The order, and what was said to the next higher one.

    Raises:
        TrialError: inputs without derivatives are not taken either.
    """
    for order in range(refused - 1, -1, -1):
        try:
            begin()
            trial.set_inputs(order)
            accepts()
        except FatalSlaveError:
            raise
        except (TrialError, SlaveError) as error:
            refusal = error.cause if isinstance(error, SlaveError) else str(error)
        else:
            return order, refusal
    raise TrialError(refusal)


def highest_order_used(place: Place, order: int, size: float) -> int:
    """Up to which order derivatives of the inputs change what a step leads to.

    Tools take orders that they do not know, and ignore them.

    Args:
        place: where the slave stands.
        order: the highest one that it takes.
        size: of the steps to take [s].

    Returns:
        ``order`` too where the inputs change nothing at all.

    Raises:
        TrialError: a step was not completed.
    """
    trial = place.trial
    held = np.zeros((order + 1, len(trial.call.inputs)))
    held[0] = trial.call.inputs
    changes = np.array(trial.call.input_changes)

    def behind(inputs: FloatArray) -> Reading:
        place.restored()
        trial.slave.set_inputs(inputs)
        return place.step(size)

    def is_used(k: int) -> bool:
        inputs = held.copy()
        inputs[k] += changes * factorial(k) / size**k
        return not behind(inputs).equals(without)

    without = behind(held)
    if not is_used(0):
        return order
    return next((k - 1 for k in range(1, order + 1) if not is_used(k)), order)
