"""`ModelSlave`: a Python `Model` as a co-simulation slave, integrated by SciPy.

All that changes from step to step is one immutable `ModelState`. A step computes the next one from
it, so saving a state is keeping it, going back is taking it again, and a step that fails leaves
no trace. A new integrator is built for every step; all that it would remember is the size of
the inner step that it would try next, and that is part of the state.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from contextvars import Context
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.integrate import BDF, DOP853, RK23, RK45, Radau

from protocol.calls import Initialize, RecordedValues, StepResult, StepStatus
from protocol.errors import (
    ConfigurationError,
    DoublestepError,
    ModelError,
    SlaveError,
    StepRejectedError,
)
from protocol.host.user_code import error_text, user_context
from protocol.signals import MAX_ORDER, FloatArray, InputSignal
from protocol.slave import Slave, refuse_discrete
from protocol.text.names import nearest
from protocol.values import value_of
from protocol.variables import Causality, StartValue, Variable
from slave_node.model import Model, describe, real

__all__ = ["Model", "ModelSlave", "ModelState", "real"]

SOLVERS: Mapping[str, Any] = {s.__name__: s for s in (RK45, RK23, DOP853, Radau, BDF)}

DEFAULT_TOLERANCE = 1e-6
MIN_TOLERANCE = 1e-13
"""Below it rounding looks like integration error; SciPy's own limit is 100 machine epsilons."""

MAX_INNER_STEPS = 100_000
"""Some ten seconds of work: a longer step is reported instead of seeming to hang."""

MAX_FACTOR = 10.0
"""SciPy's integrators enlarge a step by no more than this."""

_MAGIC = b"2StepMdl"
_VERSION = 1
_HEADER = struct.Struct("<8sHHII32sI")  # magic, version, k + 1, n_x, n_u, fingerprint, CRC of body
_TIMES = struct.Struct("<dd")  # time, inner step


@dataclass(frozen=True, slots=True, eq=False)
class ModelState:
    """All that determines how a slave goes on, besides the parameters and the tolerance.

    Attributes:
        time: the communication point [s].
        x: states, shape (n_x,), read-only.
        inputs: from ``time`` on, derivatives of shape (k + 1, n_u) over all inputs of the model.
        inner_step: the step that the integrator is to try first [s], 0 if unknown.
        tuned: names and values of tunable parameters that have changed since the start.
    """

    time: float
    x: FloatArray
    inputs: InputSignal
    inner_step: float = 0.0
    tuned: tuple[tuple[str, StartValue], ...] = ()


class ModelSlave(Slave):
    """A slave that integrates a `Model`.

    Args:
        model: the class; the slave makes the instance.
        context: in which its code runs, see `user_context`; None: a new one.

    Raises:
        ModelError: the declarations of the model contradict each other, or its own ``__init__``
            failed.
    """

    def __init__(self, model: type[Model], context: Context | None = None) -> None:
        self._run = (context or user_context()).run
        self.description = describe(model)
        if model.solver not in SOLVERS:
            raise ModelError(
                f"{model.__name__}.solver: no '{model.solver}'{nearest(model.solver, SOLVERS)}"
            )
        self._model_class = model
        self._input_names = [v.name for v in model.inputs]
        self._output_names = [v.name for v in model.outputs]
        self._state_names = [v.name for v in model.states]
        local = [i for i, name in enumerate(self._state_names) if name not in self._output_names]
        self._local_states = np.array(local, dtype=np.intp)
        self._readable_names = [*self._output_names, *(self._state_names[i] for i in local)]
        self._nominal = np.array([v.nominal for v in model.states])
        self._recorded: tuple[str, ...] = ()
        self._tunable = {v.name: v for v in model.parameters if v.variability == "tunable"}
        self.reset()

    # ---- Set up and tear down -----------------------------------------------------------------

    def reset(self) -> None:
        """Back to the start values of the declarations."""
        self._start: dict[str, StartValue] = {
            v.name: _converted(v, v.start)
            for v in self.description.variables
            if v.start is not None
        }
        self._set_up(0.0, DEFAULT_TOLERANCE, self._input_names, self._output_names)

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`. Inputs that are not among ``inputs`` keep their start values, those among
        ``discrete_inputs`` what they are set to: something that is not continuous drives them.

        The relative tolerance is that of the inner solver; times the nominal value of a state
        it is the absolute one. The stop time does not matter: a model goes on as long as asked.

        Raises:
            ConfigurationError: a name that the model does not have, or a value of the wrong type.
            SlaveError: the model's ``prepare`` failed.
        """
        refuse_discrete(self.description, (), experiment.discrete_outputs)
        for name, value in experiment.start_values.items():
            self._start[name] = self._start_value(name, value)
        tolerance = experiment.relative_tolerance
        if tolerance is None:
            tolerance = DEFAULT_TOLERANCE
        if not 0.0 < tolerance < 1.0:
            raise ConfigurationError(f"relative tolerance {tolerance!r} is not between 0 and 1")
        inputs, discrete_inputs = experiment.inputs, experiment.discrete_inputs
        accuracy = max(float(tolerance), MIN_TOLERANCE)
        self._set_up(experiment.start_time, accuracy, inputs, experiment.outputs)
        names = [*self._input_names, *self._tunable]
        self._columns("input", [*inputs, *discrete_inputs], names)  # each but once
        self._held_names = discrete_inputs
        self._prepare()

    def _prepare(self) -> None:
        try:
            self._run(self._model.prepare)
        except DoublestepError:
            raise
        except Exception as error:
            raise SlaveError(f"{self._at('prepare')}: {error_text(error)}") from error

    def _start_value(self, name: str, value: StartValue) -> StartValue:
        settable = {v.name: v for v in self.description.variables if v.start is not None}
        try:
            return _converted(settable[name], value)
        except KeyError:
            known = any(v.name == name for v in self.description.variables)
            raise ConfigurationError(
                f"'{name}' is computed by {self.description.model} and takes no start value"
                if known
                else f"{self.description.model} has no variable '{name}'{nearest(name, settable)}"
            ) from None

    def _set_up(
        self, time: float, tolerance: float, inputs: Sequence[str], outputs: Sequence[str]
    ) -> None:
        """Make the model and its first state from the start values."""
        self._tolerance = tolerance
        self._input_columns = self._columns("input", inputs, self._input_names)
        self._held_names = tuple[str, ...]()
        self._output_columns = self._columns("output", outputs, self._readable_names)
        try:
            self._model = self._run(self._model_class)
        except Exception as error:
            raise ModelError(f"{self._at('__init__')}: {error_text(error)}") from error
        parameters = [v.name for v in self.description.of(Causality.PARAMETER)]
        for name in parameters:
            setattr(self._model, name, self._start[name])
        max_step = self._model.max_step
        if max_step is not None and not max_step >= 0.0:
            raise ConfigurationError(f"max_step is {max_step!r}, not 0 or more")
        self._start_inputs = np.array([[self._start[name] for name in self._input_names]], float)
        self._state = ModelState(
            time=float(time),
            x=_read_only(np.array([self._start[v.name] for v in self._model.states], float)),
            inputs=InputSignal(_read_only(self._start_inputs)),
        )
        experiment = [self._start[name] for name in (*parameters, *self._input_names)]
        self._fingerprint = hashlib.sha256(
            repr((self.description.sha256, self.description.model, tolerance, experiment)).encode()
        ).digest()

    def _columns(self, kind: str, names: Sequence[str], known: list[str]) -> list[int]:
        """Where ``names`` stand in ``known``."""
        for i, name in enumerate(names):
            if name not in known:
                raise ConfigurationError(
                    f"{self.description.model} has no {kind} '{name}'{nearest(name, known)}"
                )
            if name in names[:i]:
                raise ConfigurationError(f"{kind} '{name}' is listed twice")
        return [known.index(name) for name in names]

    def exit_initialization_mode(self) -> None:
        """See `Slave`.

        Raises:
            ModelError: an output turns out to use an input that ``feed_through`` does not name;
                the step size control would rely on a wrong order of the error.
        """
        with np.errstate(all="ignore"):
            self._check_feed_through()

    def _check_feed_through(self) -> None:
        """Change each input by its nominal value and look which outputs move."""
        state, u = self._state, self._state.inputs.derivatives[0]
        try:
            y = self._evaluate("output_values", len(self._output_names), state.time, state.x, u)
            for i, variable in enumerate(self._model.inputs):
                moved = u.copy()
                moved[i] += variable.nominal
                args = (state.time, state.x, moved)
                y_moved = self._evaluate("output_values", len(self._output_names), *args)
                for j in np.flatnonzero(y_moved != y):
                    output = self._output_names[j]
                    declared = self._model.feed_through.get(output, ())
                    if variable.name not in declared and np.isfinite(y[j] + y_moved[j]):
                        raise ModelError(
                            f"output '{output}' depends directly on input '{variable.name}', "
                            f"but {self.description.model}.feed_through does not say so"
                        )
        except StepRejectedError:
            return  # no value here says nothing

    def terminate(self) -> None:
        """Nothing to end."""

    def close(self) -> None:
        """Nothing to free."""

    # ---- Step ---------------------------------------------------------------------------------

    def set_inputs(self, derivatives: FloatArray) -> None:
        """Replace the inputs from here on: shape (k + 1, n_u), k at most 3, [u]/s^j.

        Raises:
            SlaveError: another shape.
        """
        derivatives = np.asarray(derivatives, dtype=float)
        rows, columns = derivatives.shape if derivatives.ndim == 2 else (0, 0)
        if not 1 <= rows <= MAX_ORDER + 1 or columns != len(self._input_columns):
            raise SlaveError(
                f"inputs of shape {derivatives.shape} instead of (1 to {MAX_ORDER + 1}, "
                f"{len(self._input_columns)})"
            )
        u = np.zeros((rows, len(self._input_names)))
        u[0] = self._state.inputs.derivatives[0]  # what is not set stays
        u[:, self._input_columns] = derivatives
        self._state = replace(self._state, inputs=InputSignal(_read_only(u)))

    def set_discrete_inputs(self, values: Sequence[StartValue]) -> None:
        """See `Slave`. They are held until they are set again.

        Raises:
            SlaveError: another number of values, or one that is no number.
        """
        if len(values) != len(self._held_names):
            raise SlaveError(f"{list(values)!r} are no values for {[*self._held_names]}")
        self.set_values(dict(zip(self._held_names, values, strict=True)))

    def set_values(self, values: Mapping[str, StartValue]) -> None:
        """See `Slave`: inputs and tunable parameters.

        Raises:
            SlaveError: a variable is neither, a value is none of it, or ``prepare`` failed.
        """
        u = self._state.inputs.derivatives.copy()
        tuned = dict(self._state.tuned)
        for name, value in values.items():
            if name in self._tunable:
                tuned[name] = self._tunable_value(name, value)
            elif name not in self._input_names:
                raise SlaveError(f"{name!r} is no input and no tunable parameter")
            elif type(value) in (float, int):
                u[0, self._input_names.index(name)] = value
            else:
                raise SlaveError(f"{value!r} is no number for {name!r}")
        inputs = InputSignal(_read_only(u))
        self._go_to(replace(self._state, inputs=inputs, tuned=tuple(tuned.items())))

    def _tunable_value(self, name: str, value: StartValue) -> StartValue:
        try:
            return _converted(self._tunable[name], value)
        except ConfigurationError as error:
            raise SlaveError(error.cause) from None

    def _go_to(self, state: ModelState) -> None:
        """Stand at a state, with the parameters that belong to it."""
        before, self._state = self._state.tuned, state
        if before == state.tuned:
            return
        tuned = dict(state.tuned)
        for name in self._tunable:
            setattr(self._model, name, tuned.get(name, self._start[name]))
        self._prepare()

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`. The inputs go on as the same polynomial beyond the end of the step.

        Raises:
            StepRejectedError: the inner solver failed, or x' has no finite value.
            SlaveError: the slave does not stand at ``communication_point``, or the model is wrong.
        """
        del no_set_state_prior  # saved states are values, nothing can be tidied up
        state, t, h = self._state, float(communication_point), float(step_size)
        if not t < t + h < math.inf:
            raise SlaveError(f"a step of {h!r} s does not advance the time {t!r} s")
        if t != state.time:
            raise SlaveError(f"a step from {t!r} s, but the slave stands at {state.time!r} s")
        reach = min(h, self._model.max_step or math.inf)
        with np.errstate(all="ignore"):  # what is not finite is found and reported by name
            x, inner_step = self._integrate(state, t, reach)
            inputs = state.inputs.shifted(reach)
        inputs.derivatives.setflags(write=False)
        self._state = ModelState(t + reach, _read_only(x), inputs, inner_step, state.tuned)
        return StepResult(StepStatus.OK if reach == h else StepStatus.DISCARD, self._state.time)

    def _integrate(self, state: ModelState, t: float, reach: float) -> tuple[FloatArray, float]:
        """The states at t + reach, shape (n_x,), and the inner step to try next [s].

        The integrator's time is tau = time - t, so it ends exactly at ``reach``.
        """
        n = len(state.x)
        if n == 0:
            return state.x, 0.0
        inputs_at = state.inputs.at

        def right_hand_side(tau: float, x: FloatArray) -> FloatArray:
            tau = float(tau)  # SciPy may hand over a NumPy scalar
            dx = self._evaluate("derivatives", n, t + tau, x, inputs_at(tau))
            if not np.isfinite(dx).all():
                culprit = self._model.states[int(np.argmin(np.isfinite(dx)))].name
                raise StepRejectedError(
                    f"the derivative of '{culprit}' is not finite at t={t + tau!r} s"
                )
            return dx

        proposed = state.inner_step
        try:
            solver = SOLVERS[self._model.solver](
                right_hand_side,
                0.0,
                state.x,
                reach,
                first_step=min(proposed, reach) if proposed else None,
                rtol=self._tolerance,
                atol=self._tolerance * self._nominal,
            )
            for _ in range(MAX_INNER_STEPS):
                message = solver.step()
                if solver.status != "running":
                    break
                proposed = float(solver.h_abs)
            else:
                message = f"more than {MAX_INNER_STEPS} inner steps"
        except (ArithmeticError, ValueError) as error:  # from SciPy, such as a singular matrix
            raise StepRejectedError(f"the inner solver failed: {error_text(error)}") from error
        if solver.status != "finished" or not np.isfinite(solver.y).all():
            raise StepRejectedError(
                f"the inner solver {self._model.solver} got to t={t + float(solver.t)!r} s: "
                f"{message or 'the states are not finite'}",
                remedy="for a stiff model set solver = 'Radau'",
            )
        # A last step cut short by the end, with an error so small that its growth is at the
        # bound, says nothing against the larger step proposed before.
        following = float(solver.h_abs)
        if following >= MAX_FACTOR * float(solver.step_size):
            following = max(following, proposed)
        return solver.y, following

    def get_outputs(self, order: int) -> FloatArray:
        """See `Slave`: shape (order + 1, n_y), [y]/s^j, with the inputs at the communication point.

        States that are no outputs may be read with them.

        Raises:
            SlaveError: ``order`` is beyond ``max_output_derivative_order``, or the model is wrong.
        """
        highest = self.description.capabilities.max_output_derivative_order
        if not 0 <= order <= highest:
            raise SlaveError(
                f"output derivatives of order {order} from a model that has them up to {highest}"
            )
        t, x, u = self._state.time, self._state.x, self._state.inputs.derivatives
        n = len(self._output_names)
        with np.errstate(all="ignore"):
            y = self._evaluate("output_values", n, t, x, u[0])
            rows = [np.concatenate([y, x[self._local_states]])]
            if order == 1:
                dx = self._evaluate("derivatives", len(x), t, x, u[0]) if len(x) else x
                du = u[1] if len(u) > 1 else np.zeros_like(u[0])
                dy = self._evaluate("output_derivatives", n, t, x, u[0], dx, du)
                rows.append(np.concatenate([dy, dx[self._local_states]]))
        return np.array(rows)[:, self._output_columns]

    def _evaluate(self, method: str, size: int, t: float, *args: FloatArray) -> FloatArray:
        """Value of a method of the model, shape (size,); its exceptions as ours."""
        try:
            value = np.asarray(self._run(getattr(self._model, method), t, *args), dtype=float)
        except DoublestepError:
            raise
        except (ArithmeticError, ValueError) as error:
            raise StepRejectedError(f"{self._at(method, t)}: {error_text(error)}") from error
        except Exception as error:
            raise SlaveError(f"{self._at(method, t)}: {error_text(error)}") from error
        if value.shape != (size,):
            raise SlaveError(f"{self._at(method, t)}: shape {value.shape} instead of ({size},)")
        return value

    def _at(self, method: str, t: float | None = None) -> str:
        return f"{self.description.model}.{method}()" + (f" at t={t!r} s" if t is not None else "")

    # ---- Variables that are recorded ----------------------------------------------------------

    def record(self, names: Sequence[str]) -> None:
        """See `Slave`: inputs, outputs, states and parameters.

        Raises:
            ConfigurationError: the model has no variable of a name.
        """
        known = [v.name for v in self.description.variables]
        self._columns("variable", names, known)
        self._recorded = tuple(names)

    def get_recorded_variables(self) -> RecordedValues:
        """See `Slave`.

        Raises:
            StepRejectedError, SlaveError: an output has no value.
        """
        state = self._state
        u = state.inputs.derivatives[0]
        numbers = dict(zip(self._state_names, state.x.tolist(), strict=True))
        numbers |= zip(self._input_names, u.tolist(), strict=True)
        if not set(self._recorded).isdisjoint(self._output_names):
            y = self._evaluate("output_values", len(self._output_names), state.time, state.x, u)
            numbers |= zip(self._output_names, y.tolist(), strict=True)
        others: dict[str, StartValue] = {}
        for parameter in self._model.parameters:
            value = getattr(self._model, parameter.name)
            if parameter.type.is_real:
                numbers[parameter.name] = float(value)
            else:
                others[parameter.name] = value
        return RecordedValues(
            np.array([[numbers[name] for name in self._recorded if name in numbers]]),
            tuple(others[name] for name in self._recorded if name in others),
        )

    # ---- Saved states -------------------------------------------------------------------------

    def get_state(self) -> ModelState:
        """The present state, which never changes."""
        return self._state

    def set_state(self, state: object) -> None:
        """See `Slave`.

        Raises:
            SlaveError: ``state`` is not of this model.
        """
        self._go_to(self._checked(state))

    def free_state(self, state: object) -> None:
        """Nothing to free: a state lives as long as somebody holds it."""

    def serialize_state(self, state: object) -> bytes:
        """See `Slave`. All numbers are little-endian: header, time, inner step, x, inputs; then
        the tuned parameters as JSON, if there are any.

        Raises:
            SlaveError: ``state`` is not of this model.
        """
        saved = self._checked(state)
        u = saved.inputs.derivatives
        body = _TIMES.pack(saved.time, saved.inner_step) + b"".join(
            array.astype("<f8").tobytes() for array in (saved.x, u)
        )
        if saved.tuned:
            body += json.dumps(saved.tuned).encode()
        shape = (len(u), len(saved.x), u.shape[1])
        header = _HEADER.pack(_MAGIC, _VERSION, *shape, self._fingerprint, zlib.crc32(body))
        return header + body

    def deserialize_state(self, data: bytes) -> ModelState:
        """See `Slave`.

        Raises:
            SlaveError: the bytes are damaged, or come from another model, or from this one with
                other parameters or another tolerance.
        """
        if len(data) < _HEADER.size:
            raise SlaveError(f"{len(data)} bytes are not the state of a model")
        magic, version, rows, n_x, n_u, fingerprint, checksum = _HEADER.unpack_from(data)
        body = data[_HEADER.size :]
        if magic != _MAGIC:
            raise SlaveError("these bytes are not the state of a model")
        if version != _VERSION:
            raise SlaveError(f"a saved state of version {version} instead of {_VERSION}")
        if fingerprint != self._fingerprint:
            raise SlaveError(
                f"the saved state is not of this {self.description.model}: its source, its "
                "parameters, the start values of its inputs or its tolerance were others"
            )
        expected = (len(self._nominal), len(self._input_names))
        if (n_x, n_u) != expected or not 1 <= rows <= MAX_ORDER + 1:
            raise SlaveError(f"a saved state of shape {(n_x, n_u)} instead of {expected}")
        numbers = n_x + rows * n_u
        length = _TIMES.size + 8 * numbers
        if len(body) < length or zlib.crc32(body) != checksum:
            raise SlaveError("the saved state is damaged")
        time, inner_step = _TIMES.unpack_from(body)
        values = np.frombuffer(body, "<f8", numbers, _TIMES.size).astype(float)
        return ModelState(
            time=time,
            x=_read_only(values[:n_x]),
            inputs=InputSignal(_read_only(values[n_x:].reshape(rows, n_u))),
            inner_step=inner_step,
            tuned=self._tuned(body[length:]),
        )

    def _tuned(self, data: bytes) -> tuple[tuple[str, StartValue], ...]:
        """Tuned parameters of a saved state."""
        if not data:
            return ()
        try:
            pairs = json.loads(data)
            return tuple((name, self._tunable_value(name, value)) for name, value in pairs)
        except (ValueError, KeyError, TypeError):
            raise SlaveError("the saved state is damaged") from None

    def _checked(self, state: object) -> ModelState:
        if not isinstance(state, ModelState) or state.x.shape != self._nominal.shape:
            raise SlaveError(f"not a saved state of {self.description.model}: {type(state)}")
        return state


def _read_only(array: FloatArray) -> FloatArray:
    array.setflags(write=False)
    return array


def _converted(variable: Variable, value: StartValue) -> StartValue:
    """``value`` in the type of the variable.

    Raises:
        ConfigurationError: it has another type.
    """
    try:
        return value_of(variable, value)
    except ValueError as error:
        raise ConfigurationError(f"{variable.name!r} {error}") from None
