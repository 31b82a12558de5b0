"""A slave on trial: steps from a place to which it goes back, and what is read behind them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.calls import Examine, SetInputs, StepStatus
from protocol.description import InputDerivatives
from protocol.errors import FatalSlaveError, SlaveError
from protocol.signals import FloatArray
from protocol.slave import Slave
from protocol.variables import Causality, StartValue

TIME = 10.0
"""Trial steps may take so long altogether [s]."""

STEPS = 32.0
"""No trial step is longer than so many of the step size that is asked for, if nothing is said."""

SMALLEST = 2.0**-18
"""The shortest trial steps, 4 us, unless the longest ones are less than 512 times as long [s]."""

_FINEST = 2.0**-9
_NOTHING = np.zeros(0)


class TrialError(Exception):
    """A trial step failed, which by itself says nothing about saved states."""


class Reading(NamedTuple):
    """Outputs behind a step; those that are known not to repeat read 0 and None.

    Attributes:
        values: of the continuous ones, shape (n,).
        slopes: their derivatives as they came, shape (n,); empty where none are read.
        others: the discrete ones.
    """

    values: FloatArray
    slopes: FloatArray
    others: tuple[StartValue | None, ...]

    def equals(self, other: Reading) -> bool:
        """Bit for bit; derivatives do not count."""
        return np.array_equal(self.values, other.values) and self.others == other.others


class Trial:
    """A slave, and how it is read and judged.

    Args:
        slave: at a communication point.
        call: what to try.

    Attributes:
        slave, call: see above.
        reads_slopes: whether derivatives of outputs are read too.
        outputs: how many there are, but for those that are known not to repeat.
    """

    def __init__(self, slave: Slave, call: Examine) -> None:
        self.slave = slave
        self.call = call
        description = slave.description
        outputs = description.of(Causality.OUTPUT)
        continuous = [v for v in outputs if v.is_continuous_real]
        self._names = [v.name for v in continuous]
        self._other_names = [v.name for v in outputs if v.is_discrete]
        self._nominal = np.array([v.nominal for v in continuous])
        self.reads_slopes = (
            call.output_derivatives and description.capabilities.max_output_derivative_order > 0
        )
        known = frozenset(call.not_repeating)
        self.outputs = len(known.symmetric_difference((*self._names, *self._other_names)))
        self._ignored = [i for i, name in enumerate(self._names) if name in known]
        self._ignored_others = {i for i, name in enumerate(self._other_names) if name in known}
        self._begin = perf_counter()

    @property
    def takes_any_step(self) -> bool:
        """True if its steps may have any size."""
        description = self.slave.description
        return (
            description.capabilities.can_handle_variable_step_size
            and description.fixed_step_size is None
        )

    @property
    def follows_inputs(self) -> bool:
        """True if it has inputs that it follows within a step."""
        derivatives = self.slave.description.input_derivatives
        is_emulated = derivatives is InputDerivatives.EMULATED
        return bool(self.call.inputs) and (self.call.input_order > 0 or is_emulated)

    @property
    def largest_step(self) -> float:
        """No trial step is longer [s]."""
        largest = self.call.largest_step
        return STEPS * self.call.step_size if largest is None else largest

    def sizes(self, ratio: float, largest: float) -> Iterator[float]:
        """Step sizes up to ``largest``, each ``ratio`` times the one before, and the largest [s].

        The others are powers of 2, whatever the simulated time is: what is found with them does not
        depend on it.
        """
        size = SMALLEST
        while size > _FINEST * largest:
            size /= ratio
        while size < largest:
            yield size
            size *= ratio
        yield largest

    @property
    def time_left(self) -> float:
        """Before trial steps have taken as long as they may [s]."""
        return TIME - (perf_counter() - self._begin)

    # ---- Inputs ---------------------------------------------------------------------------------

    def set_inputs(self, order: int) -> None:
        """Set the inputs to their values, with derivatives up to ``order`` that are 0.

        Raises:
            SlaveError: they are refused; ``phase`` says so.
        """
        if not self.call.inputs:
            return
        rows = np.zeros((order + 1, len(self.call.inputs)))
        rows[0] = self.call.inputs
        try:
            self.slave.set_inputs(rows)
        except SlaveError as error:
            raise error.located(phase=SetInputs.verb) from None

    def move_inputs(self) -> None:
        """Let the inputs jump from their values, until the slave is set back.

        Raises:
            TrialError: it refuses them.
        """
        rows = np.zeros((self.call.input_order + 1, len(self.call.inputs)))
        rows[0] = np.add(self.call.inputs, self.call.input_changes)
        try:
            self.slave.set_inputs(rows)
        except FatalSlaveError:
            raise
        except SlaveError as error:
            raise TrialError(f"inputs of {rows[0].tolist()}: {error.cause}") from None

    def ramp(self, size: float, offset: float = 0.0) -> FloatArray:
        """Inputs that begin at their values and move in ``size`` [s], shape (2, n).

        Args:
            size: of a step [s].
            offset: from the beginning [s].
        """
        slope = np.array(self.call.input_changes) / size
        return np.array((np.array(self.call.inputs) + offset * slope, slope))

    # ---- Reading --------------------------------------------------------------------------------

    def read(self) -> Reading:
        """The outputs where the slave stands."""
        rows = self.slave.get_outputs(int(self.reads_slopes))
        values = rows[0].copy()
        if self._ignored:
            values[self._ignored] = 0.0
        others: tuple[StartValue | None, ...] = self.slave.get_discrete_outputs()
        if self._ignored_others:
            others = tuple(
                None if i in self._ignored_others else value for i, value in enumerate(others)
            )
        return Reading(values, rows[1] if len(rows) > 1 else _NOTHING, others)

    def step(self, time: float, size: float) -> Reading:
        """A step of ``size`` from ``time`` [s], and what is read behind it.

        Raises:
            TrialError: it is shorter than a trial step may be, it was not completed, or a value is
                not finite.
        """
        where = f"a step of {size!r} s at t={time!r} s"
        if size < self.call.smallest_step:
            raise TrialError(f"{where} would be too short for the slave")
        try:
            result = self.slave.do_step(time, size, False)
            if result.status is not StepStatus.OK:
                raise TrialError(f"{where} ended with {result.status}")
            reading = self.read()
        except FatalSlaveError:
            raise
        except SlaveError as error:
            raise TrialError(f"{where}: {error.cause}") from None
        bad = self.names(~np.isfinite(reading.values))
        if bad:
            raise TrialError(f"{where}: {bad[0]} is not finite")
        return reading

    def names(self, where: NDArray[np.bool_]) -> list[str]:
        """The continuous outputs of these columns, shape (n,)."""
        found = np.flatnonzero(where).tolist()
        if len(where) != len(self._names):
            return [f"output {i + 1}" for i in found]
        return [self._names[i] for i in found]

    def of_all(self, text: str) -> dict[str, str]:
        """A text for each continuous output."""
        return dict.fromkeys(self._names, text)

    def differing(self, a: Reading, b: Reading) -> list[str]:
        """The outputs that are not the same to the bit."""
        return [*self.names(a.values != b.values), *self.differing_others(a, b)]

    def differing_others(self, a: Reading, b: Reading) -> list[str]:
        """The discrete ones among them."""
        others = zip(self._other_names, a.others, b.others, strict=False)
        return [name for name, one, other in others if one != other]

    # ---- Judging --------------------------------------------------------------------------------

    def scale(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Tolerances of outputs of these values, shape (n,)."""
        sizes = np.maximum(np.abs(a), np.abs(b))
        tolerances: FloatArray = (
            self.call.absolute_tolerance * self._sizes(len(a))
            + self.call.relative_tolerance * sizes
        )
        return tolerances

    def _sizes(self, n: int) -> FloatArray:
        return self._nominal if len(self._nominal) == n else np.ones(n)

    def norm(self, a: Reading, b: Reading) -> float:
        """The weighted root mean square of a difference; above 1 it is beyond the tolerance."""
        counted = len(a.values) - len(self._ignored)
        if not counted:
            return 0.0
        parts = (a.values - b.values) / self.scale(a.values, b.values)
        return float(np.sqrt(parts.dot(parts) / counted))

    def relative_difference(self, a: Reading, b: Reading) -> float:
        """The largest one of an output, relative to it or its nominal value."""
        values = np.maximum(np.abs(a.values), np.abs(b.values))
        scale = np.maximum(values, self._sizes(len(values)))
        continuous = float(np.max(np.abs(a.values - b.values) / scale, initial=0.0))
        return max(continuous, float(a.others != b.others))


class Place:
    """A communication point to which a slave on trial goes back as often as it is asked.

    Args:
        trial: of the slave, which stands there.
        time: of the point [s].
    """

    def __init__(self, trial: Trial, time: float) -> None:
        self.trial = trial
        self.time = self._now = time
        self._state = trial.slave.get_state()

    def restored(self) -> None:
        """Go back."""
        self.trial.slave.set_state(self._state)
        self._now = self.time

    def step(self, size: float) -> Reading:
        """One step [s] on from where the slave stands; errors as of `Trial.step`."""
        reading = self.trial.step(self._now, size)
        self._now += size
        return reading

    def here(self) -> Place:
        """The point where the slave stands now."""
        return Place(self.trial, self._now)

    def free(self) -> None:
        """Give the saved state up."""
        self.trial.slave.free_state(self._state)


@contextmanager
def freed(place: Place) -> Iterator[Place]:
    """Give a place up at the end; what a failing slave has to say to that does not matter."""
    try:
        yield place
    except BaseException:
        with suppress(SlaveError):
            place.free()
        raise
    place.free()
