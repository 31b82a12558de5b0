"""Loop of a run: attempt -> judge -> accept or go back, step by step to the stop time.

The loop is the same for all methods. A rejected attempt is a position that is not put in the place
of the one before.
"""

from __future__ import annotations

from math import inf

from master_node.judging.missing_derivatives import MissingDerivatives
from master_node.methods.base import AnyMethod, Back, Ended
from master_node.methods.position import Position
from master_node.resuming.checkpoints import Checkpoints
from master_node.running.journal import Journal


class Loop:
    """Steps a run forward. It can be stopped behind each accepted step, and go on.

    Args:
        method: how a step is taken.
        position: where the run begins.
        journal: is told of each attempt.
        checkpoints: are told where the run stands.
        missing: is told of outputs whose derivatives are not finite.

    Attributes:
        position: where the run stands.
    """

    def __init__(
        self,
        method: AnyMethod,
        position: Position,
        journal: Journal,
        checkpoints: Checkpoints,
        missing: MissingDerivatives,
    ) -> None:
        self.position = position
        self._method = method
        self._journal = journal
        self._checkpoints = checkpoints
        self._missing = missing
        self.move_to(position)

    def advance(self, until: float = inf) -> Ended | None:
        """Take one step that is accepted, after as many attempts as that needs.

        Args:
            until: point at which steps end, if the method lets them [s].

        Returns:
            How the run has ended; None: it has not.

        Raises:
            DoublestepError: a slave was lost or failed, or H would have to be too small.
        """
        method = self._method
        while True:
            position = self.position
            way = method.way(position, until)
            if way is None:
                return Ended()
            step = method.attempt(position, way)
            if isinstance(step, Ended):
                return step
            verdict = step if isinstance(step, Back) else method.judge(position, way, step)
            if isinstance(verdict, Back):
                self._go_back(verdict)
                continue
            committed = method.commit(position, step, verdict)
            if isinstance(committed, Ended):
                return committed
            self._checkpoints.settle()
            self._journal.accepted(*committed)
            following = method.next(position, way, *committed)
            self.move_to(following.changed_as(position))
            return None

    def move_to(self, position: Position) -> None:
        """Go on from a position where all slaves stand."""
        self._missing.note(position.outputs.y, position.time)
        self._stands_at(position)

    def _go_back(self, back: Back) -> None:
        self._journal.rejected(self.position.time, back)
        if back.error is not None:
            raise back.error
        self._stands_at(back.position)

    def _stands_at(self, position: Position) -> None:
        self.position = position
        self._checkpoints.reached(position, self._journal.results.memory)
