"""Double steps that are iterated where the coupling is stiff.

Explicit double steps go on while the loop gain that they tell is small. Where it is large their
estimate is enlarged to what the loop makes of it, and after a few of them iterated double steps
take over, until the gain is small again (`coupling_memory.py`).
"""

from __future__ import annotations

from master_node.coupling.outputs import Outputs
from master_node.methods.base import Back, Ended, Verdict
from master_node.methods.comparison import ComparedSteps, Way
from master_node.methods.coupling_memory import BLIND, CouplingMemory
from master_node.methods.position import Position
from master_node.numerics.collocation import MIDDLE
from master_node.stepping.double_step import DoubleStep
from master_node.stepping.iterated_step import IteratedStepper, NotConverged
from protocol.calls import Call


class IteratedSteps:
    """A method of double steps whose inputs are extrapolated or iterated.

    Args:
        compared: takes and judges double steps; its parts know both kinds.
        stepper: takes iterated double steps.
        coupling: ``explicit``, ``implicit`` or ``auto``, see `SimulationSettings`.
    """

    def __init__(self, compared: ComparedSteps, stepper: IteratedStepper, coupling: str) -> None:
        self._judge = compared.parts.judge
        self._limits = compared.parts.limits
        self._compared = compared
        self._stepper = stepper
        self._coupling = coupling

    def begin(self, outputs: Outputs) -> Position:
        """See `Method`."""
        position = self._compared.begin(outputs)
        if self._coupling != "implicit":
            return position
        return position._replace(coupling=CouplingMemory(True, self._stepper.secants))

    def has_reached(self, time: float, target: float) -> bool:
        """See `Method`."""
        return self._compared.has_reached(time, target)

    def way(self, position: Position, until: float) -> Way | None:
        """See `Method`."""
        return self._compared.way(position, until)

    def attempt(self, position: Position, way: Way) -> DoubleStep | Back | Ended:
        """See `Method`."""
        coupling = position.coupling
        if not coupling.is_implicit:
            return self._compared.attempt(position, way)
        times = way.times
        if self._limits.quantum is None:
            moved = times.with_middle(MIDDLE)
            if max(moved.first, moved.second) <= self._limits.largest:
                times = moved
        step = self._stepper.attempt(position.history, times, coupling.secants, position.outputs)
        if not isinstance(step, NotConverged):
            return step
        learnt = position._replace(coupling=coupling._replace(secants=step.secants))
        return self._compared.broken(learnt, way, step.polynomials, step.failed)

    def judge(self, position: Position, way: Way, step: DoubleStep) -> Verdict | Back:
        """See `Method`; goes back to iterate where the coupling has been stiff for long."""
        error = self._judge.judge(step)
        coupling = position.coupling
        if step.iteration is None and not way.crossing:
            coupling = coupling.noted(error.loop_gain)
            position = position._replace(coupling=coupling, doubt=None)
            if coupling.asks_for_iteration and self._coupling == "auto":
                reason = f"{error.limiting_variable}: stiff coupling"
                stiff = position._replace(coupling=coupling.iterating(self._stepper.secants))
                return Back(stiff, step.times.step_size, step.polynomials, error.norm, reason)
        verdict = self._compared.decide(position, way, step, error)
        if isinstance(verdict, Back):
            return verdict
        kind = "iterated_double_steps"
        if step.iteration is None:
            kind = "stiff_double_steps" if error.loop_gain >= BLIND else ""
        counted = verdict.counting(**{kind: 1}) if kind else verdict
        return counted._replace(coupling=coupling)

    def commit(
        self, position: Position, step: DoubleStep, verdict: Verdict
    ) -> tuple[DoubleStep, Verdict] | Ended:
        """See `Method`."""
        return self._compared.commit(position, step, verdict)

    def next(self, position: Position, way: Way, step: DoubleStep, verdict: Verdict) -> Position:
        """See `Method`; with what an accepted double step says of the coupling."""
        following = self._compared.next(position, way, step, verdict)
        coupling, iteration = verdict.coupling, step.iteration
        assert coupling is not None  # as of every verdict of this method
        if iteration is None:
            return following._replace(coupling=coupling.after_explicit(step.times.step_size))
        if self._coupling == "implicit":
            return following._replace(coupling=CouplingMemory(True, iteration.secants))
        after = coupling.after_iterated(
            iteration.secants, iteration.number, step.times.step_size, iteration.loop_gain
        )
        return following._replace(coupling=after)

    def behind_event(self, position: Position) -> Position:
        """See `Method`; the coupling is as it was, but for what is known of the slaves."""
        following = self._compared.behind_event(position)
        if self._coupling == "implicit":
            return following._replace(coupling=CouplingMemory(True, self._stepper.secants))
        return following

    def check_target(self, position: Position, time: float) -> None:
        """See `Method`."""
        self._compared.check_target(position, time)

    def way_back(self, slave: int) -> tuple[Call, ...]:
        """See `Method`."""
        return self._compared.way_back(slave)

    def forget(self) -> None:
        """See `Method`."""
        self._compared.forget()
