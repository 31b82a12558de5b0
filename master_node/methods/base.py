"""Method: how one step of a run is taken, as the loop sees it (`running/loop.py`).

A method knows no loop, no observer and no checkpoint. It holds what does not change during a run;
what changes is in the `Position`, which it is handed and hands back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple, Protocol, TypeVar

from master_node.coupling.coupled_system import CoupledSystem
from master_node.coupling.outputs import Outputs
from master_node.coupling.result_points import Reached
from master_node.coupling.scheme import CouplingScheme
from master_node.judging.comparison import StepError
from master_node.judging.missing_derivatives import MissingDerivatives
from master_node.methods.coupling_memory import CouplingMemory
from master_node.methods.position import Position
from master_node.numerics.discontinuities import Defects
from master_node.numerics.extrapolation import Polynomials
from master_node.slaves.group import SlaveGroup
from master_node.system.system import System
from protocol.calls import Call
from protocol.errors import DoublestepError

Counts = Mapping[str, int]
"""By how much counters of `Statistics` go up, by their names."""

NO_COUNTS: Counts = {}


@dataclass(frozen=True)
class Setup:
    """Slaves, connections and settings that a method works on.

    Attributes:
        group: the slaves, at their first communication point.
        coupled: their connections.
        scheme: how they are coupled within a step.
        system: the settings.
        missing: is told of outputs whose derivatives are not finite.
    """

    group: SlaveGroup
    coupled: CoupledSystem
    scheme: CouplingScheme
    system: System
    missing: MissingDerivatives = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "missing", MissingDerivatives(self.coupled, self.scheme))

    @property
    def start(self) -> float:
        """T_0 [s]."""
        return float(self.system.simulation.start_time)


class Candidate(Protocol):
    """Solution of one step, as far as the loop looks into it."""

    @property
    def begin(self) -> float:
        """T_n [s]."""
        ...

    @property
    def step_size(self) -> float:
        """H [s], as observers are told."""
        ...

    @property
    def polynomials(self) -> Polynomials:
        """Input polynomials, for each kind."""
        ...

    @property
    def reached(self) -> Reached:
        """Communication points that it leads to."""
        ...

    @property
    def iterations(self) -> int:
        """Number of evaluations that it took to find the inputs; 0: they were extrapolated."""
        ...


class Shape(Enum):
    """Outputs in an accepted step."""

    SMOOTH = "smooth"
    EVENT_AT_END = "smooth up to an event at the end"
    JUMP = "a discontinuity within"


class Verdict(NamedTuple):
    """Acceptance of a step.

    Attributes:
        norm: ERR, or the norm of its defects; NaN when there is neither.
        limiting_variable: ``slave.variable`` with the largest part in it, or what jumps.
        shape: of the outputs.
        counts: counters of the run that go up.
        remark: warning with the first step above the tolerance; "" for none.
        error: of a double step.
        defects: of a double step; None: they are not looked at.
        coupling: memory of the coupling, with what the judgement of the step says.
    """

    norm: float
    limiting_variable: str = ""
    shape: Shape = Shape.SMOOTH
    counts: Counts = NO_COUNTS
    remark: str = ""
    error: StepError | None = None
    defects: Defects | None = None
    coupling: CouplingMemory | None = None

    def counting(self, **more: int) -> Verdict:
        """This verdict with some more counts."""
        return self._replace(counts=summed(self.counts, more))


def summed(counts: Counts, more: Counts) -> Counts:
    """Counts together."""
    return {
        name: counts.get(name, 0) + more.get(name, 0) for name in dict.fromkeys((*counts, *more))
    }


class Back(NamedTuple):
    """Rejection of an attempt: the run goes back to T_n.

    Attributes:
        position: where it goes on.
        step_size: H of the attempt [s].
        polynomials: of its inputs, for each kind.
        norm: ERR; infinite if there is none.
        reason: limiting variable, or what happened.
        counts: counters of the run that go up, besides that of rejections.
        error: with which the run ends all the same, once observers are told; None: it goes on.
    """

    position: Position
    step_size: float
    polynomials: Polynomials
    norm: float
    reason: str
    counts: Counts = NO_COUNTS
    error: DoublestepError | None = None


class Ended(NamedTuple):
    """End of a run.

    Attributes:
        note: why it ended earlier, in words; "": the stop time is reached.
        is_stopped: whether an action ended it, and no slave.
    """

    note: str = ""
    is_stopped: bool = False


def ended_by(slave: str, time: float) -> Ended:
    """The end that a slave wishes, which stands at ``time`` [s]."""
    return Ended(f"{slave} ended the simulation after t={time!r} s")


W = TypeVar("W")
C = TypeVar("C", bound=Candidate)


class Method(Protocol[W, C]):
    """Takes steps of one kind: ways W, solutions C."""

    def begin(self, outputs: Outputs) -> Position:
        """The position at T_0.

        Args:
            outputs: there, those of continuous variables of shape (rows, m).
        """
        ...

    def has_reached(self, time: float, target: float) -> bool:
        """True if ``time`` is ``target`` [s], or nearer to it than any step leads."""
        ...

    def way(self, position: Position, until: float) -> W | None:
        """Where the next attempt leads; not beyond ``until`` [s]. None: the run has ended."""
        ...

    def attempt(self, position: Position, way: W) -> C | Back | Ended:
        """Take the step, or say why it did not come about.

        Raises:
            DoublestepError: a slave is lost, or failed in a way that another attempt cannot help.
        """
        ...

    def judge(self, position: Position, way: W, step: C) -> Verdict | Back:
        """Accept the step or go back; raises DoublestepError where neither is possible."""
        ...

    def commit(self, position: Position, step: C, verdict: Verdict) -> tuple[C, Verdict] | Ended:
        """Make an accepted step final; slaves without rollback follow here.

        Raises:
            DoublestepError: a slave is lost, or did not complete a step.
        """
        ...

    def next(self, position: Position, way: W, step: C, verdict: Verdict) -> Position:
        """Where the run stands behind an accepted step, and what it tries next."""
        ...

    def behind_event(self, position: Position) -> Position:
        """Go on from a position whose past says nothing any more, as something was changed there.

        Args:
            position: with the outputs and overrides that hold behind the change.
        """
        ...

    def check_target(self, position: Position, time: float) -> None:
        """Make sure that steps from a position can end at a later ``time`` [s].

        Raises:
            SteeringError: they cannot.
        """
        ...

    def way_back(self, slave: int) -> tuple[Call, ...]:
        """Calls that bring a slave back to T_n, where it has gone ahead on trial."""
        ...

    def forget(self) -> None:
        """Slaves stand at T_n, and what they have saved of it does not count any more."""
        ...


AnyMethod = Method[Any, Any]


class FinalSteps:
    """Part of a `Method` whose steps cannot be taken back: no slave goes ahead on trial."""

    def commit(
        self,
        position: Position,  # noqa: ARG002
        step: C,
        verdict: Verdict,
    ) -> tuple[C, Verdict]:
        """See `Method`: it is final already."""
        return step, verdict

    def way_back(self, slave: int) -> tuple[Call, ...]:  # noqa: ARG002
        """See `Method`: no slave goes ahead."""
        return ()

    def forget(self) -> None:
        """See `Method`: nothing is saved."""
