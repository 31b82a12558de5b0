"""FMUs for model exchange as slaves: integrated by CVode.

The solver starts anew at every communication point and behind every event. So what a step gives
depends on nothing but the state at its beginning, and a restored state repeats bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from protocol.calls import Initialize, StepResult, StepStatus
from protocol.errors import SlaveError, StepRejectedError
from protocol.host.log_files import SILENT, LogOutput
from protocol.signals import FloatArray
from protocol.slave import Slave
from protocol.variables import StartValue
from slave_node.floating_point import restore_floating_point
from slave_node.fmu.continuous_model import ContinuousModel, Fmi2Model, Fmi3Model
from slave_node.fmu.cvode import CVode, Outcome
from slave_node.fmu.description import FmuModel
from slave_node.fmu.event_indicators import make_event, root_values
from slave_node.fmu.exchange import InputPolynomials
from slave_node.fmu.fmu_slave import FmuSlave
from slave_node.fmu.saved_state import SavedState, pack, unpack
from slave_node.fmu.times import SLACK, is_at_border, meet

DEFAULT_TOLERANCE = 1e-6
MIN_TOLERANCE = 1e-13
"""Below it rounding looks like integration error."""

MAX_INNER_STEPS = 100_000
"""In one communication step: a longer one is reported instead of seeming to hang."""

MAX_EVENTS = 10_000
"""In one communication step: more are a model that stands still at events without end."""

_HALVINGS = 30
"""Number of times that the slack behind a step is halved to locate an event in it."""

_STEPS_WITHOUT_STATES = 20
"""Internal steps in a communication step of a model that has indicators and no states."""


class ModelExchangeSlave(FmuSlave):
    """One instance of an FMU for model exchange with a solver of its own.

    Inputs follow their polynomials exactly. State events are located within the step, time events
    hit; both are handled on the way, unless the master wants to know of them (``early_return``).

    Args:
        model: the FMU, instantiated; the slave closes it.
    """

    def __init__(self, model: ContinuousModel) -> None:
        super().__init__(model)
        self._model = model
        self._needs_completed_step = model.model.interface.needs_completed_step
        self._saves_by_fmu = model.model.interface.saves_state
        self._solver: CVode | None = None
        self._bind((), ())
        self._start(Initialize())

    def _bind(self, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        """Make the buffers for these inputs and outputs."""
        self._inputs = self._model.buffers(inputs, sets=True)
        self._polynomials = InputPolynomials(self._inputs, self._model.buffers(inputs, sets=True))
        self._outputs = self._model.buffers(outputs, sets=False)

    def _start(self, experiment: Initialize) -> None:
        self._time = self._inputs_time = self._model_time = experiment.start_time
        self._stop_time = math.inf if experiment.stop_time is None else experiment.stop_time
        tolerance = experiment.relative_tolerance or DEFAULT_TOLERANCE
        self._tolerance = max(tolerance, MIN_TOLERANCE)
        self._returns_early = experiment.early_return
        self._is_initializing = True
        self._rows_set = 1
        self._first_step = 0.0
        self._indicators = np.zeros(0)

    # ---- Initialization -----------------------------------------------------------------------

    def initialize(self, experiment: Initialize) -> None:
        """See `Slave`. Its relative tolerance is that of the solver; times the nominal value of a
        state it is the absolute one.
        """
        self._discrete_inputs = self._model.discrete(experiment.discrete_inputs)
        self._discrete_outputs = self._model.discrete(experiment.discrete_outputs)
        self._model.continuous_places([*experiment.inputs, *experiment.outputs])
        self._start(experiment)
        self._model.enter_initialization_mode(experiment)
        self._bind(experiment.inputs, experiment.outputs)

    def exit_initialization_mode(self) -> None:
        """See `Slave`. The event at the start is handled."""
        self._model.call(self._model.fmu.exitInitializationMode)
        self._is_initializing = False
        self._size, self._indicator_count = self._model.count()
        self._make_solver()
        if self._leave_event_mode():
            raise SlaveError("the FMU wants to terminate at the start")

    def _make_solver(self) -> None:
        """Without states there is a dummy, x' = 0, for the solver to locate state events with."""
        if self._solver is not None:
            self._solver.close()
        self._solver = CVode(
            max(self._size, 1), self._indicator_count, self._derivatives, self._roots
        )

    # ---- Equations ----------------------------------------------------------------------------

    def _set_point(self, time: float, states: Any) -> None:
        """Time, inputs and states (an address)."""
        self._model.set_time(time)
        status = self._polynomials.set(self._rows_set, time - self._inputs_time)
        if status:
            self._model.check(self._polynomials.values_function, status)
        self._model.transfer("set", states, self._size)
        restore_floating_point()

    def _derivatives(self, time: float, states: Any, result: Any) -> None:
        if self._size == 0:
            result[0] = 0.0
            return
        self._set_point(time, states)
        self._model.transfer("derivatives", result, self._size)
        restore_floating_point()

    def _roots(self, time: float, states: Any, result: Any) -> None:
        self._set_point(time, states)
        self._model.transfer("indicators", result, self._indicator_count)
        restore_floating_point()
        values = np.ctypeslib.as_array(result, (self._indicator_count,))
        values[:] = root_values(values, self._indicators)

    # ---- Events -------------------------------------------------------------------------------

    def _handle_event(self) -> bool:
        """Go through event mode; returns whether the FMU wants to terminate."""
        self._model.enter_event_mode()
        return self._leave_event_mode()

    def _leave_event_mode(self) -> bool:
        terminate, _, _ = self._model.update_discrete_states()
        if not terminate:
            self._model.enter_continuous_time_mode()
            self._indicators = self._model.vector("indicators", self._indicator_count)
        return terminate

    def _changed_domains(self) -> bool:
        """True if an event indicator has changed its domain since the last event or point."""
        if not self._indicator_count:
            return False
        return make_event(self._model.vector("indicators", self._indicator_count), self._indicators)

    def set_discrete_inputs(self, values: Sequence[StartValue]) -> None:
        """See `Slave`. A change is an event."""
        if self._is_initializing:
            super().set_discrete_inputs(values)
        elif self._discrete_inputs.put_changes(values):
            self._model.enter_event_mode()
            self._discrete_inputs.send()
            if self._leave_event_mode():
                raise SlaveError("the FMU wants to terminate after its discrete inputs changed")

    def set_values(self, values: Mapping[str, StartValue]) -> None:
        """See `Slave`; goes through event mode."""
        self._model.enter_event_mode()
        super().set_values(values)
        if self._leave_event_mode():
            raise SlaveError("the FMU wants to terminate after variables were set")

    # ---- Steps --------------------------------------------------------------------------------

    def set_inputs(self, derivatives: FloatArray) -> None:
        """See `Slave`."""
        super().set_inputs(derivatives)
        self._inputs_time = self._time

    def do_step(
        self, communication_point: float, step_size: float, no_set_state_prior: bool
    ) -> StepResult:
        """See `Slave`.

        Raises:
            StepRejectedError: the solver failed, or there are too many steps or events.
        """
        begin, end = communication_point, communication_point + step_size
        if not begin < end < math.inf:
            raise SlaveError(f"a step of {step_size!r} s does not advance the time {begin!r} s")
        if begin != self._time:
            raise SlaveError(f"a step from {begin!r} s, but the slave stands at {self._time!r} s")
        time = max(begin, self._model_time)
        if self._changed_domains() and self._handle_event():
            return StepResult(StepStatus.TERMINATED, time)
        for _ in range(MAX_EVENTS):
            stop = max(min(end, self._model.next_event_time), time)
            time, has_event, ends = self._integrate(time, stop, step_size, no_set_state_prior)
            is_last = time >= end or meet(time, end)
            self._model_time, self._time = time, end if is_last else time
            if ends:
                return StepResult(StepStatus.TERMINATED, self._time)
            if has_event and self._returns_early and not is_at_border(time, begin, end):
                return StepResult(StepStatus.EARLY_RETURN, time)
            if is_last and not has_event and self._returns_early:
                ahead = min(SLACK * step_size, self._stop_time - time)
                has_event = ahead > 0.0 and self._reach_event_ahead(time, ahead)
            if has_event and self._handle_event():
                return StepResult(StepStatus.TERMINATED, self._time)
            if is_last:
                self._indicators = self._model.vector("indicators", self._indicator_count)
                return StepResult(StepStatus.OK, end)
        raise StepRejectedError(f"more than {MAX_EVENTS} events in one step")

    def _reach_event_ahead(self, time: float, slack: float) -> bool:
        """True if an event comes within ``slack`` [s] behind the end of a step, at ``time``.

        The FMU then stands at the event, a bit ahead of the communication point. On so short a
        way the states move along their derivatives.
        """
        if not self._indicator_count:
            return False
        states, slopes = self._model.vector("states", self._size), np.zeros(self._size)
        self._model.transfer("derivatives", slopes.ctypes.data, self._size)

        def is_behind(ahead: float) -> bool:
            moved = states + ahead * slopes
            self._set_point(time + ahead, moved.ctypes.data)
            return self._changed_domains()

        if not is_behind(slack):
            self._set_point(time, states.ctypes.data)
            return False
        before, behind = 0.0, slack
        for _ in range(_HALVINGS):
            middle = 0.5 * (before + behind)
            before, behind = (before, middle) if is_behind(middle) else (middle, behind)
        is_behind(behind)
        self._model_time = time + behind
        return True

    def _integrate(
        self, time: float, stop: float, step_size: float, no_set_state_prior: bool
    ) -> tuple[float, bool, bool]:
        """From ``time`` to ``stop`` or to the first event before that.

        Returns:
            The time reached [s], whether there is an event, whether the FMU wants to terminate.
        """
        model, solver = self._model, self._solver
        assert solver is not None
        is_time_event = model.next_event_time <= stop
        if meet(time, stop):
            self._set_point(stop, model.vector("states", self._size).ctypes.data)
            return stop, is_time_event, False
        model.transfer("states", solver.x.ctypes.data, self._size)
        nominals = model.vector("nominals", self._size) if self._size else np.ones(1)
        solver.restart(
            time,
            self._tolerance,
            self._tolerance * np.abs(nominals),
            first_step=self._first_step,
            largest_step=0.0 if self._size else step_size / _STEPS_WITHOUT_STATES,
        )
        step_event = terminate = False
        for _ in range(MAX_INNER_STEPS):
            outcome, time = solver.step(stop)
            self._set_point(time, solver.x.ctypes.data)
            if self._needs_completed_step:
                step_event, terminate = model.completed_step(no_set_state_prior)
            if outcome is not Outcome.STEP or step_event or terminate:
                break
        else:
            raise StepRejectedError(
                f"more than {MAX_INNER_STEPS} internal steps, up to t={time!r} s"
            )
        if time < stop or outcome is not Outcome.STOP:
            is_time_event = False
        self._first_step = solver.first_step
        return time, is_time_event or step_event or outcome is Outcome.ROOT, terminate

    # ---- Saved states -------------------------------------------------------------------------

    def get_state(self) -> object:
        """See `Slave`. Beside the FMU's state: times, states, indicators, inputs."""
        self._require_state()
        numbers = np.concatenate(
            [
                (self._time, self._model_time, self._inputs_time, self._model.next_event_time),
                (self._rows_set, self._first_step),
                self._model.vector("states", self._size),
                self._indicators,
                self._inputs.rows.ravel(),
            ]
        )
        return SavedState(super().get_state() if self._saves_by_fmu else None, numbers)

    def set_state(self, state: object) -> None:
        """See `Slave`."""
        saved = self._checked(state)
        n, n_z = self._size, self._indicator_count
        times, states, self._indicators, rows = np.split(saved.numbers, [6, 6 + n, 6 + n + n_z])
        self._time, self._model_time, self._inputs_time = times[:3].tolist()
        self._model.next_event_time, rows_set, self._first_step = times[3:].tolist()
        self._rows_set = int(rows_set)
        self._inputs.rows[...] = rows.reshape(self._inputs.rows.shape)
        if self._saves_by_fmu:
            super().set_state(saved.fmu)
        else:
            self._set_point(self._model_time, np.ascontiguousarray(states).ctypes.data)

    def free_state(self, state: object) -> None:
        """See `Slave`."""
        saved = self._checked(state)
        if self._saves_by_fmu:
            super().free_state(saved.fmu)

    def serialize_state(self, state: object) -> bytes:
        """See `Slave`."""
        saved = self._checked(state)
        fmu = super().serialize_state(saved.fmu) if self._saves_by_fmu else b""
        return pack(saved.numbers, fmu)

    def deserialize_state(self, data: bytes) -> object:
        """See `Slave`."""
        count = 6 + self._size + self._indicator_count + self._inputs.rows.size
        numbers, fmu = unpack(data, count)
        return SavedState(super().deserialize_state(fmu) if self._saves_by_fmu else None, numbers)

    def _checked(self, state: object) -> SavedState:
        if not isinstance(state, SavedState):
            raise SlaveError(f"not a saved state of {self.description.model}: {type(state)}")
        return state

    def close(self) -> None:
        """See `Slave`."""
        if self._solver is not None:
            self._solver.close()
            self._solver = None
        super().close()


def _adapter(instance: type[ContinuousModel]) -> Callable[..., Slave]:
    def load(model: FmuModel, name: str, output: LogOutput = SILENT) -> Slave:
        return ModelExchangeSlave(instance(model, name, output))

    return load


ADAPTERS: Mapping[int, Callable[..., Slave]] = {2: _adapter(Fmi2Model), 3: _adapter(Fmi3Model)}
"""By major version of FMI: from the FMU, a name and the output of its log to the slave."""
