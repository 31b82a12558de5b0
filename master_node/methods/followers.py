"""Double steps of slaves that can go back, which slaves that cannot follow.

The first take double steps as in any system: rejections, jumps and the first step size concern them
alone. When a double step of theirs is accepted, the others follow. What crosses between the two is
judged by its defects afterwards, and bounds the next H.
"""

from __future__ import annotations

from master_node.coupling.outputs import Outputs
from master_node.judging.defects import CouplingDefects
from master_node.methods.base import Back, Ended, Setup, Shape, Verdict, ended_by
from master_node.methods.comparison import ComparedSteps, Way
from master_node.methods.position import Position
from master_node.numerics.order_control import SMALLEST_FACTOR
from master_node.numerics.step_size_controller import passes
from master_node.stepping.double_step import DoubleStep
from master_node.stepping.follower_slaves import LateSlaves
from master_node.stepping.requests import BrokenOffError
from protocol.calls import Call


class FollowedSteps:
    """A method of double steps where some slaves have no rollback.

    Args:
        setup: what to run.
        compared: takes and judges the double steps of the slaves that can go back.
        coupling: defects of the inputs between these and the others.
    """

    def __init__(self, setup: Setup, compared: ComparedSteps, coupling: CouplingDefects) -> None:
        self._settings = setup.system.simulation
        self._coupled = setup.coupled
        self._compared = compared
        self._coupling = coupling
        self._late_slaves = LateSlaves(setup.group, setup.coupled, setup.scheme)

    def begin(self, outputs: Outputs) -> Position:
        """See `Method`."""
        return self._compared.begin(outputs)

    def has_reached(self, time: float, target: float) -> bool:
        """See `Method`."""
        return self._compared.has_reached(time, target)

    def way(self, position: Position, until: float) -> Way | None:
        """See `Method`."""
        return self._compared.way(position, until)

    def attempt(self, position: Position, way: Way) -> DoubleStep | Back | Ended:
        """See `Method`."""
        return self._compared.attempt(position, way)

    def judge(self, position: Position, way: Way, step: DoubleStep) -> Verdict | Back:
        """See `Method`; outputs of the followers do not count yet."""
        return self._compared.judge(position, way, step)

    def commit(
        self, position: Position, step: DoubleStep, verdict: Verdict
    ) -> tuple[DoubleStep, Verdict] | Ended:
        """See `Method`; the verdict tells of the defects, too."""
        try:
            step = self._late_slaves.follow(position.history, position.outputs, step)
        except BrokenOffError as broken_off:  # the wish of a slave
            return ended_by(broken_off.failed.slave, position.time)
        if verdict.shape is not Shape.JUMP:
            verdict = self._with_defects(position, step, verdict)
        return self._compared.commit(position, step, verdict)

    def _with_defects(self, position: Position, step: DoubleStep, verdict: Verdict) -> Verdict:
        """The verdict of a double step that all slaves have taken."""
        error = verdict.error
        assert error is not None  # as of every double step
        u_middle, u_end = map(self._coupled.inputs_of, (step.middle, step.end))
        coupling = self._coupling.judge(
            position.history,
            step.polynomials,
            ((step.times.middle, u_middle), (step.times.end, u_end)),
            step.end[0],
        )
        if coupling.norm > error.norm:
            error = error._replace(norm=coupling.norm, limiting_variable=coupling.limiting_variable)
        above = int(not passes(error.norm))
        if coupling.has_jumped and self._settings.discontinuities:
            name = f"{coupling.limiting_variable} jumps"
            jump = self._compared.over_jump(step, error, None, name)
            return jump.counting(steps_above_tolerance=above)._replace(remark="")
        verdict = verdict.counting(steps_above_tolerance=above)
        return verdict._replace(
            norm=error.norm, limiting_variable=error.limiting_variable, error=error
        )

    def next(self, position: Position, way: Way, step: DoubleStep, verdict: Verdict) -> Position:  # noqa: ARG002
        """See `Method`; H is bounded by the defects that it would have."""
        following = self._compared.following(position, step, verdict)
        if verdict.shape is Shape.JUMP:
            return following
        bounded = self._bounded(following, step.times.first)
        return self._compared.forgetting(position, bounded, verdict)

    def _bounded(self, following: Position, taken: float) -> Position:
        """The position with an H for which the defects behind a step of ``taken`` [s] allow."""
        parts = self._compared.parts
        if len(following.history.times) == 1:  # cut: nothing is known of the next defects
            return parts.first.chosen(following, following.step_size)
        bound = self._coupling.step_size(
            following.history,
            parts.available.of(following.order.polynomial, following.history),
            following.outputs.y[0],
            smallest=min(SMALLEST_FACTOR * taken, following.step_size),
            largest=following.step_size,
        )
        return following._replace(step_size=parts.limits.bounded(bound))

    def behind_event(self, position: Position) -> Position:
        """See `Method`."""
        return self._compared.behind_event(position)

    def check_target(self, position: Position, time: float) -> None:
        """See `Method`."""
        self._compared.check_target(position, time)

    def way_back(self, slave: int) -> tuple[Call, ...]:
        """See `Method`."""
        return self._compared.way_back(slave)

    def forget(self) -> None:
        """See `Method`."""
        self._compared.forget()
