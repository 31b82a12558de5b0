"""Position of a run: a value that says everything about what comes next."""

from __future__ import annotations

from typing import NamedTuple

from master_node.coupling.outputs import Outputs
from master_node.coupling.overrides import NO_OVERRIDES, Overrides
from master_node.judging.restless import RestlessOutputs
from master_node.methods.coupling_memory import CouplingMemory
from master_node.numerics.discontinuities import Search, SmoothStep
from master_node.numerics.extrapolation import CouplingHistory
from master_node.numerics.order_control import OrderMemory
from master_node.numerics.step_size_controller import NOTHING, ControllerMemory
from protocol.variables import StartValue

NO_SEARCH = Search.nothing(0)
"""Knowledge of jumps of a method that looks for none."""


class Doubt(NamedTuple):
    """Early return of a slave in its first step from a restored state.

    Some slaves do so once, because their states lack the past of their event indicators: the step
    is taken again, carefully.

    Attributes:
        slave: its name.
        time: where it stood then [s].
    """

    slave: str
    time: float


class SecondHalf(NamedTuple):
    """Second step over a known event, whose first one was taken.

    Attributes:
        end: of the step [s].
        size: of the step [s].
        name: of the event.
    """

    end: float
    size: float
    name: str


class GivenValue(NamedTuple):
    """Value that a variable was set to.

    Attributes:
        name: ``slave.variable``.
        value: of it.
    """

    name: str
    value: StartValue


class Position(NamedTuple):
    """Communication point where a run stands, with what the next attempt needs to know.

    Attributes:
        history: inputs up to T_n.
        outputs: at T_n, those of continuous variables of shape (rows, m).
        step_size: H that is wanted [s].
        order: the order control's memory; holds the input polynomial.
        search: knowledge of jumps behind T_n.
        controller: the step size controller's memory.
        smooth: defects of the last accepted step; None: nothing is known of them.
        errors_in_a_row: attempts that a slave ended with an error.
        event: where a slave has returned early, and a double step must end [s]; None: nowhere.
        unchanged: up to where discrete outputs are known not to change, and a double step must end
            [s]; None: nowhere.
        crossings: how many more double steps behind an event are kept whatever ERR is, as H is on a
            grid and cannot be made smaller.
        coupling: explicit or implicit, and what is known of it.
        doubt: early return after which the next attempt is a careful one; None: there is none.
        second_half: step that must follow, as the event before it is half crossed; None: none.
        steps: number of steps taken, of a method that counts them.
        overrides: connected inputs that are cut from their sources.
        given: values that variables were set to during the run.
        restless: discrete outputs that change in every step.
        actions: number of actions of the system that are done.
    """

    history: CouplingHistory
    outputs: Outputs
    step_size: float
    order: OrderMemory
    search: Search = NO_SEARCH
    controller: ControllerMemory = NOTHING
    smooth: SmoothStep | None = None
    errors_in_a_row: int = 0
    event: float | None = None
    unchanged: float | None = None
    crossings: int = 0
    coupling: CouplingMemory = CouplingMemory()
    doubt: Doubt | None = None
    second_half: SecondHalf | None = None
    steps: int = 0
    overrides: Overrides = NO_OVERRIDES
    given: tuple[GivenValue, ...] = ()
    restless: RestlessOutputs = RestlessOutputs()
    actions: int = 0

    @property
    def time(self) -> float:
        """T_n [s]."""
        return self.history.times[0]

    def changed_as(self, other: Position) -> Position:
        """This position, with all that users and actions had changed at the other one."""
        return self._replace(overrides=other.overrides, given=other.given, actions=other.actions)
