"""The hot path between a slave and its holder: inputs, a step and its outputs as one flat message.

After a fork every page that is written to is copied first, and Python writes to whatever it looks
at. So the holder does as little here as it can; all other calls travel as programs of the codec.
"""

from __future__ import annotations

from collections.abc import Callable
from struct import Struct

import numpy as np

from protocol.calls import DoStep, GetOutputs, SetInputs, StepResult, StepStatus
from protocol.errors import DoublestepError, SlaveError
from protocol.signals import FloatArray
from protocol.slave import Slave

_STEP = Struct("<dd?bb5x")  # communication point, step size, no_set_state_prior, rows, order
_RESULT = Struct("<bd")  # status, time
_STATUSES = tuple(StepStatus)
_NO_OUTPUTS = -1


def encode_step(inputs: FloatArray | None, step: DoStep, order: int | None) -> bytes:
    """A step with the inputs to set before it, and the order of the outputs to read after it."""
    return _STEP.pack(
        step.communication_point,
        step.step_size,
        step.no_set_state_prior,
        0 if inputs is None else len(inputs),
        _NO_OUTPUTS if order is None else order,
    ) + (b"" if inputs is None else inputs.tobytes())


def execute_step(slave: Slave, message: bytes) -> bytes:
    """Do what a message of `encode_step` says.

    Returns:
        The result, for `decode_stepped`; outputs are read only after a step that is ok.

    Raises:
        DoublestepError: the slave failed; ``phase`` says where.
    """
    time, step_size, no_set_state_prior, rows, order = _STEP.unpack_from(message)
    phase = SetInputs.verb
    try:
        if rows:
            numbers = np.frombuffer(message, np.float64, offset=_STEP.size)
            slave.set_inputs(numbers.reshape(rows, -1))
        phase = DoStep.verb
        result = slave.do_step(time, step_size, no_set_state_prior)
        answer = _RESULT.pack(_STATUSES.index(result.status), result.time)
        if order == _NO_OUTPUTS or result.status is not StepStatus.OK:
            return answer
        phase = GetOutputs.verb
        return answer + slave.get_outputs(order).tobytes()
    except DoublestepError as error:
        raise error.located(phase=phase, time=time, step_size=step_size) from None
    except Exception as exception:
        raise SlaveError(
            f"{type(exception).__name__}: {exception}",
            phase=phase,
            time=time,
            step_size=step_size,
        ) from exception


def with_outputs(answer: bytes, number: int, change: Callable[[FloatArray], FloatArray]) -> bytes:
    """The answer of `execute_step` with other outputs.

    Args:
        answer: see `decode_stepped`.
        number: of the outputs, n.
        change: gives them, from those that there are, shape (rows, n).
    """
    outputs = np.frombuffer(answer, np.float64, offset=_RESULT.size)
    if not outputs.size:
        return answer
    return answer[: _RESULT.size] + change(outputs.reshape(-1, number)).tobytes()


def decode_stepped(answer: bytes, order: int | None) -> tuple[StepResult, FloatArray | None]:
    """Result of the step, and the outputs if they were asked for and the step is ok."""
    status, time = _RESULT.unpack_from(answer)
    result = StepResult(_STATUSES[status], time)
    if order is None or result.status is not StepStatus.OK:
        return result, None
    outputs = np.frombuffer(answer, np.float64, offset=_RESULT.size)
    return result, outputs.reshape(order + 1, -1)
