"""Communication steps split into substeps, inside the slave's own process.

For models that take no derivatives of their inputs, and for models whose own steps must not be as
long as communication steps are.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from protocol.calls import Configure, Initialize, StepResult, StepStatus
from protocol.description import InputDerivatives, SlaveDescription
from protocol.errors import SlaveError
from protocol.signals import MAX_ORDER, FloatArray, InputSignal
from protocol.slave import Slave
from protocol.step_sums import step_to
from protocol.variables import Causality
from slave_node.substeps.inputs import scaled, substep_values, substeps_needed
from slave_node.substeps.polynomials import piece_polynomials, pieces_needed
from slave_node.wrapped_slave import WrappedSlave

DEFAULT = Configure()

_OK = StepStatus.OK
_DEFAULT_TOLERANCE = 1e-6
_LAST_SUBSTEP = 1.0 / 16.0
"""Length of the last substep, for outputs with direct feed-through, in equal substeps."""

_ON_GRID = 1e-9
"""Largest distance of a communication step from a whole number of substeps, relative to it."""

_MAGIC = b"2StepSub"
_HEADER = struct.Struct("<8sHId")  # magic, rows, columns, where the slave stands


def input_derivatives(
    description: SlaveDescription, configuration: Configure = DEFAULT
) -> InputDerivatives:
    """Way in which a model follows polynomial inputs, by itself or with the help of its slave node.

    One without input derivatives, or not of all orders, is emulated, unless ``input_substeps`` is
    1. A number that is given holds for a model with input derivatives too.
    """
    derivatives = description.input_derivatives
    if not any(v.is_continuous_real for v in description.of(Causality.INPUT)):
        return derivatives
    if configuration.input_substeps == 1:
        return InputDerivatives.NONE
    is_native = derivatives is InputDerivatives.NATIVE
    takes_all = is_native and configuration.max_input_order >= MAX_ORDER
    if takes_all and not configuration.input_substeps:
        return derivatives
    return InputDerivatives.EMULATED


def with_substeps(slave: Slave, configuration: Configure = DEFAULT) -> Slave:
    """The slave with its steps split as ``configuration`` wants it; itself if they are not.

    A model that takes communication steps of one unknown size only is not split, so it gets the
    mean values of its inputs over each step.
    """
    description = slave.description
    derivatives = input_derivatives(description, configuration)
    splits = configuration.largest_substep is not None or description.fixed_step_size is not None
    if derivatives is description.input_derivatives and not splits:
        return slave
    number = configuration.input_substeps
    if not description.capabilities.can_handle_variable_step_size and not splits:
        number = number or 1
    degree = 0
    if description.input_derivatives is InputDerivatives.NATIVE and not number:
        degree = max(0, min(configuration.max_input_order, MAX_ORDER))
    return SubstepSlave(slave, derivatives, number, configuration.largest_substep, degree=degree)


@dataclass(frozen=True, slots=True, eq=False)
class _SavedState:
    """``inner`` is the wrapped slave's."""

    inner: object
    inputs: InputSignal
    standing: float


@lru_cache(maxsize=256)
def _lengths(number: int, *, meets_end: bool) -> tuple[float, ...]:
    """Lengths of substeps in steps: equal ones, and a short last one if it meets the end."""
    if not meets_end:
        return (1.0 / number,) * number
    last = _LAST_SUBSTEP / number
    return (*((1.0 - last) / number,) * number, last)


class SubstepSlave(WrappedSlave):
    """A slave whose communication steps are substeps of another one.

    With emulated input derivatives each substep has constant inputs, see ``inputs.py``, or
    lines and parabolas, see ``polynomials.py``; with native ones, and with a polynomial of
    a degree that the model takes, it has that around its beginning.

    A communication step that is a whole number of the model's fixed steps, or of
    ``largest_substep``, is split into just these: so a model with an internal clock stays on it.

    Outputs with direct feed-through, and derivatives of outputs, belong to the inputs at the end
    of a step, not to the value of the last substep. Where the model is known to follow its inputs
    between steps they are set there; FMI 2.0 forbids to read outputs then (section 4.2.4), so for
    all others a short last substep has the inputs of the end.

    Args:
        slave: to be wrapped; closed with this one.
        input_derivatives: how it is to follow polynomial inputs.
        number: of substeps where they are emulated; 0: as many as the accuracy needs.
        largest_substep: longest step of the model [s]; None: any.
        degree: of the polynomials that the model itself takes.
    """

    def __init__(
        self,
        slave: Slave,
        input_derivatives: InputDerivatives,
        number: int = 0,
        largest_substep: float | None = None,
        *,
        degree: int = 0,
    ) -> None:
        super().__init__(slave)
        self.description = replace(slave.description, input_derivatives=input_derivatives)
        self._derivatives = input_derivatives
        self._number = number
        self._degree = degree
        self._fixed = slave.description.fixed_step_size
        self._largest = largest_substep
        self._follows = slave.description.capabilities.outputs_follow_inputs
        self._meets_end = False
        self._nominal = np.ones(0)
        self._tolerance = _DEFAULT_TOLERANCE
        self._forget()

    def _forget(self) -> None:
        self._inputs = InputSignal(np.zeros((1, len(self._nominal))))
        self._standing = math.nan

    # ---- Set up and inputs --------------------------------------------------------------------

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`. Its relative tolerance is also that of emulated inputs."""
        self._slave.initialize(experiment)
        description = self.description
        inputs = experiment.inputs
        self._nominal = np.array([description.variable(name).nominal for name in inputs], float)
        self._tolerance = experiment.relative_tolerance or _DEFAULT_TOLERANCE
        depends = any(
            not set(description.feed_through.get(output, ())).isdisjoint(inputs)
            for output in experiment.outputs
        )
        self._meets_end = depends or description.capabilities.max_output_derivative_order > 0
        self._forget()

    def reset(self) -> None:
        """See `Slave`."""
        self._slave.reset()
        self._forget()

    def set_inputs(self, derivatives: FloatArray) -> None:
        """See `Slave`.

        Raises:
            SlaveError: another shape.
        """
        if self._derivatives is not InputDerivatives.EMULATED:
            self._slave.set_inputs(derivatives)
        elif not 1 <= len(derivatives) <= MAX_ORDER + 1:
            raise SlaveError(f"{len(derivatives)} rows of inputs, not 1 to {MAX_ORDER + 1}")
        else:
            self._slave.set_inputs(derivatives[: 1 + self._degree])
        self._inputs = InputSignal(derivatives)

    # ---- Step ---------------------------------------------------------------------------------

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`. A substep that does not reach its end ends the step there."""
        begin, end = self._begin(communication_point, step_size), communication_point + step_size
        inputs = self._inputs
        degree = self._degree
        is_emulated = self._derivatives is InputDerivatives.EMULATED and inputs.order > degree
        rows = scaled(inputs.derivatives, step_size) if is_emulated else None
        number, size, is_free = self._split(rows, step_size)
        meets_end = is_emulated and self._meets_end and not self._follows
        meets_end = meets_end and (is_free or degree > 0)  # of pieces the last one can be as it is
        lengths = _lengths(number, meets_end=meets_end and not degree)
        last = len(lengths) - 1
        if rows is not None and degree:
            values = piece_polynomials(rows, lengths, degree, meets_end=meets_end)
            values = values / step_size ** np.arange(degree + 1)[:, np.newaxis]
        elif rows is not None:
            values = substep_values(rows, lengths, meets_end=meets_end)[:, np.newaxis]
        time, offset = begin, 0.0
        for i, length in enumerate(lengths):
            if rows is not None:
                self._slave.set_inputs(values[i])
            elif i and inputs.order > 0:
                self._slave.set_inputs(inputs.shifted(time - begin).derivatives)
            offset += length
            to = end if i == last else begin + ((i + 1) * size if size else offset * step_size)
            result = self._slave.do_step(
                time, step_to(time, min(to, end), size), no_set_state_prior and i == 0
            )
            time = result.time
            if result.status is not _OK:
                break
        self._standing = time
        if math.isfinite(time):
            self._inputs = inputs.shifted(time - begin)
        if is_emulated and self._meets_end and self._follows and result.status is _OK:
            self._slave.set_inputs(self._inputs.derivatives[: 1 + degree])
        return result

    def _begin(self, communication_point: float, step_size: float) -> float:
        """Where the model stands, if that is the communication point but for rounding.

        Its own sum of substeps may miss the end of the whole step, and a strict model knows only
        that sum.
        """
        rounding = _ON_GRID * step_size + 16.0 * math.ulp(communication_point)
        is_there = abs(self._standing - communication_point) <= rounding
        return self._standing if is_there else communication_point

    def _split(self, rows: FloatArray | None, step_size: float) -> tuple[int, float | None, bool]:
        """Number of substeps, their size if it is given [s], and whether they may have any other.

        ``rows`` are those of the polynomial, `scaled`, if it is to be emulated.
        """
        for size in (self._fixed, self._largest):
            if size is not None:
                number = round(step_size / size)
                if number and abs(number * size - step_size) <= _ON_GRID * step_size:
                    return number, size if number > 1 else step_size, False
        if self._fixed is not None:
            return 1, step_size, False  # for the model to refuse
        number = 1
        if rows is not None and self._degree:
            number = pieces_needed(
                rows, self._degree, self._nominal, self._tolerance, meets_end=self._meets_end
            )
        elif rows is not None:
            number = self._number or substeps_needed(rows, self._nominal, self._tolerance)
        if self._largest is not None:
            number = max(number, math.ceil(step_size / self._largest))
        given = step_size if number == 1 else None
        return number, given, self.description.capabilities.can_handle_variable_step_size

    # ---- Saved states -------------------------------------------------------------------------

    def get_state(self) -> object:
        """See `Slave`."""
        return _SavedState(self._slave.get_state(), self._inputs, self._standing)

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        saved = _checked(state)
        self._slave.set_state(saved.inner)
        self._inputs, self._standing = saved.inputs, saved.standing

    def set_state_and_free(self, state: object) -> None:
        """See `Slave`."""
        saved = _checked(state)
        self._slave.set_state_and_free(saved.inner)
        self._inputs, self._standing = saved.inputs, saved.standing

    def free_state(self, state: object) -> None:
        """See `Slave`."""
        self._slave.free_state(_checked(state).inner)

    def serialize_state(self, state: object) -> bytes:
        """See `Slave`. Header and inputs, little-endian, then the wrapped slave's bytes."""
        saved = _checked(state)
        rows = saved.inputs.derivatives
        return (
            _HEADER.pack(_MAGIC, *rows.shape, saved.standing)
            + rows.astype("<f8").tobytes()
            + self._slave.serialize_state(saved.inner)
        )

    def deserialize_state(self, data: bytes) -> object:
        """See `Slave`.

        Raises:
            SlaveError: the bytes are not such a state, or not one of this model.
        """
        if len(data) < _HEADER.size or data[: len(_MAGIC)] != _MAGIC:
            raise SlaveError("these bytes are not the state of a slave with substeps")
        _, rows, columns, standing = _HEADER.unpack_from(data)
        size = _HEADER.size + 8 * rows * columns
        if not 1 <= rows <= MAX_ORDER + 1 or columns != len(self._nominal) or len(data) < size:
            raise SlaveError(
                f"a saved state with {rows} rows of {columns} inputs, for {len(self._nominal)}"
            )
        values = np.frombuffer(data, "<f8", rows * columns, _HEADER.size).astype(float)
        inner = self._slave.deserialize_state(data[size:])
        return _SavedState(inner, InputSignal(values.reshape(rows, columns)), standing)


def _checked(state: object) -> _SavedState:
    if not isinstance(state, _SavedState):
        raise SlaveError(f"not a saved state of a slave with substeps: {type(state)}")
    return state
