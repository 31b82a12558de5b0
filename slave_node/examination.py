"""Trial steps that show whether a slave can be trusted."""

from __future__ import annotations

import numpy as np

from protocol.errors import SlaveError
from protocol.signals import FloatArray
from protocol.slave import Examination, Slave, StateKind, StateVerdict, StepStatus


def examine(
    slave: Slave,
    time: float,
    step_size: float,
) -> Examination:
    """Take trial steps from ``time`` [s], with the inputs that are set, and go back.

    Args:
        slave: at a communication point.
        time: where it stands [s].
        step_size: of the trial steps [s].
    """
    if slave.description.state_kind is StateKind.NONE:
        return Examination(state_reason=slave.description.state_reason)
    try:
        return _test_states(slave, time, step_size)
    except SlaveError as error:
        return Examination(StateVerdict.BROKEN, str(error))


def _test_states(slave: Slave, time: float, step_size: float) -> Examination:
    """Compare a second step with and without a restore before it, and twice after one."""
    middle = time + step_size
    begin = slave.get_state()
    _step(slave, time, step_size)
    without = _step(slave, middle, step_size)
    slave.set_state(begin)
    _step(slave, time, step_size)
    halfway = slave.get_state()
    first = _step(slave, middle, step_size)
    slave.set_state(halfway)
    second = _step(slave, middle, step_size)
    slave.free_state(halfway)
    slave.set_state(begin)
    slave.free_state(begin)
    if not np.array_equal(first, second):
        return Examination(
            StateVerdict.DOES_NOT_REPEAT,
            "the same step gave other outputs the second time",
            _difference(first, second),
        )
    if not np.array_equal(without, second):
        return Examination(
            StateVerdict.RESTARTS_SOLVER,
            "a step after a restore differs from the same step without one",
            _difference(without, second),
        )
    return Examination(StateVerdict.EXACT)


def _step(slave: Slave, time: float, step_size: float) -> FloatArray:
    result = slave.do_step(time, step_size, False)
    if result.status is not StepStatus.OK:
        raise SlaveError(f"a trial step ended with {result.status}", time=time, step_size=step_size)
    return slave.get_outputs(0)


def _difference(a: FloatArray, b: FloatArray) -> float:
    scale = np.maximum(np.abs(a), np.abs(b))
    scale[scale == 0.0] = 1.0
    return float(np.max(np.abs(a - b) / scale, initial=0.0))
