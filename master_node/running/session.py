"""Session: a run that is stepped, asked, changed and branched from Python (docs/steering.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Self
from weakref import finalize

from master_node.results import Result
from master_node.running.run import Mark, Run
from master_node.running.variables import Point
from master_node.system.tables import listed_values
from protocol.errors import SteeringError
from protocol.variables import StartValue


class Session:
    """An open run. Its slaves end with it: use it in a ``with`` statement, or `close` it.

    A call that cannot be done raises `SteeringError` and leaves the run as it was. When a slave
    fails, or an observer raises, the run cannot go on; its results up to there can be read.

    Args:
        run: at its first communication point.
        stack: ends it.
        recorded: gives the results so far.
    """

    def __init__(self, run: Run, stack: ExitStack, recorded: Callable[[], Result]) -> None:
        self._run = run
        self._stack = stack
        self._recorded = recorded
        self._steering = run.steering
        self._variables = self._steering.variables
        self._is_open = True
        self._finalize = finalize(self, stack.close)

    # --- beginning and end ----------------------------------------------------------------------

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._is_open = False
        self._finalize.detach()
        self._stack.__exit__(kind, error, trace)

    def close(self) -> None:
        """End the run where it stands, and its slaves. Idempotent.

        Raises:
            DoublestepError: results cannot be written.
        """
        self.__exit__(None, None, None)

    def result(self) -> Result:
        """Results so far; ``summary`` is empty until the session is closed."""
        return self._recorded()

    # --- what is known --------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Communication point T_n where the run stands [s]."""
        return self._run.position.time

    @property
    def step_size(self) -> float:
        """Communication step size H that the next step wants [s]."""
        return self._run.position.step_size

    @property
    def is_ended(self) -> bool:
        """True if the stop time is reached, or a slave has ended the run."""
        return self._run.ended is not None

    @property
    def point(self) -> Point:
        """Values where the run stands; they stay as they are when it goes on."""
        return Point(self._variables, self._run.position)

    def __getitem__(self, name: str) -> StartValue:
        """The value of ``slave.variable`` where the run stands: outputs, inputs, parameters, and
        what ``[results] locals`` records.

        Raises:
            SteeringError: there is no such variable, or its value is not known.
        """
        return self.point[name]

    def __repr__(self) -> str:
        state = "" if self._is_open else "closed "
        return f"<{state}Session at t={self.time!r} s>"

    # --- forward --------------------------------------------------------------------------------

    def step(self) -> bool:
        """Take one accepted step, to the next communication point, or two of a double step.

        Returns:
            True if a step was taken; False: the run has ended.

        Raises:
            DoublestepError: a slave was lost or failed, or H would have to be too small.
        """
        run = self._opened()
        if run.ended is None:
            run.step()
        return run.ended is None

    def until(self, time: float) -> Point:
        """Step until ``time`` [s], which becomes a communication point.

        A run that a slave ends earlier ends there. Nearer to a known event than a double step of
        the smallest H, the run stops behind the event.

        Raises:
            SteeringError: ``time`` lies behind, beyond the stop time or off the grid of H.
            DoublestepError: as of `step`.
        """
        run = self._opened()
        run.check_target(time)
        while run.ended is None and not run.has_reached(time):
            run.step(time)
        if run.ended is None and time >= run.setup.system.simulation.end:
            run.step()  # no way is left: tells that the run has ended
        return self.point

    def __iter__(self) -> Iterator[Point]:
        """Step to the end, with a `Point` behind each accepted step."""
        while self.step():
            yield self.point

    # --- changes --------------------------------------------------------------------------------

    def set(self, values: Mapping[str, Any]) -> None:
        """Set tunable parameters and inputs that nothing drives: an event at this point.

        All values are checked before the first one is set. They hold until they are set again.

        Args:
            values: by ``slave.variable``.

        Raises:
            SteeringError: a variable cannot be set, or a value is none of it.
            DoublestepError: a slave refused; the run cannot go on.
        """
        run = self._opened()
        checked = self._steering.settings(values)
        if checked:
            run.change(f"set {listed_values(values)}", values=checked)

    def override(self, values: Mapping[str, Any]) -> None:
        """Cut connected inputs from their sources and hold them at values: an event at this point.

        Args:
            values: by ``slave.variable``, in the units of the inputs.

        Raises:
            SteeringError: a variable is no connected input, or a value is none of it.
            DoublestepError: a slave refused; the run cannot go on.
        """
        run = self._opened()
        overrides = self._steering.overridden(run.position.overrides, values)
        if values:
            run.change(f"override {listed_values(values)}", overrides=overrides)

    def release(self, *names: str) -> None:
        """Let overridden inputs follow their sources again; without names all of them.

        Raises:
            SteeringError: one is not overridden.
            DoublestepError: a slave refused; the run cannot go on.
        """
        run = self._opened()
        overrides = self._steering.released(run.position.overrides, names)
        run.change(f"release {', '.join(names) or 'all'}", overrides=overrides)

    @property
    def overridden(self) -> dict[str, StartValue]:
        """Overridden inputs with their values, by ``slave.variable``."""
        point = self.point
        names = self._steering.names_of(self._run.position.overrides)
        return {name: point[name] for name in names}

    # --- branches -------------------------------------------------------------------------------

    def save(self) -> Mark:
        """Mark this point, to which `restore` goes back. Slaves keep a state for each mark.

        Raises:
            SteeringError: a slave's state cannot be saved, or there are too many marks.
        """
        return self._opened().save()

    def restore(self, mark: Mark) -> None:
        """Go back to a mark, which stays. What came behind it leaves no trace in the results.

        Raises:
            SteeringError: it is no mark of this run, or was forgotten.
            DoublestepError: a slave refused, or a file cannot be written; the run cannot go on.
        """
        self._opened().restore(mark)

    def forget(self, mark: Mark) -> None:
        """Free what slaves keep for a mark; raises as `restore`."""
        self._opened().forget(mark)

    # --- checks ---------------------------------------------------------------------------------

    def _opened(self) -> Run:
        if not self._is_open:
            raise SteeringError("the session is closed", remedy="open another one with open_run")
        return self._run
