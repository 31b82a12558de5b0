"""Variables and points of a run that become results."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from master_node.observing.observers import Attempt, Observer, Point, RunEnd, RunStart
from master_node.results.patterns import chosen, is_name, matches
from protocol.errors import ConfigurationError
from protocol.text.names import nearest


def check_variables(
    patterns: Sequence[str], names: Sequence[str], source: str, recorded: Collection[str] = ()
) -> None:
    """Refuse patterns that do not fit the variables of a system.

    Args:
        patterns: see `chosen`.
        names: ``slave.variable`` of the outputs.
        source: what to call the system.
        recorded: other variables, which results hold in any case.

    Raises:
        ConfigurationError: one matches no variable, with the nearest names, or none is left.
    """
    known = (*names, *recorded)
    for pattern in patterns:
        bare = pattern.removeprefix("!")
        if bare != "*" and not any(matches(name, bare) for name in known):
            raise ConfigurationError(
                f"{source}: [results] variables: {pattern!r} matches no variable"
                f"{nearest(bare, known)}",
                remedy="" if is_name(pattern) else "locals = [...] is for what is no output",
            )
    if known and not recorded and not any(chosen(patterns, names)):
        raise ConfigurationError(f"{source}: [results] variables leaves no variable")


class SelectionMemory(NamedTuple):
    """Memory of the choice of points.

    Attributes:
        number: of points after the first.
        passed_over: the last point, if it was not wanted.
    """

    number: int = 0
    passed_over: Point | None = None


class SelectedResults:
    """An observer that passes on the variables and the points that are wanted.

    All attempts are passed on. The first and the last point of a run always are.

    Args:
        observer: gets what is left.
        variables: patterns for outputs, see `chosen`.
        every: of the points after the first each ``every``-th is wanted.
        begin: what is remembered of a run that is resumed.
    """

    def __init__(
        self,
        observer: Observer,
        variables: Sequence[str],
        every: int,
        begin: SelectionMemory = SelectionMemory(),  # noqa: B008  immutable
    ) -> None:
        self._observer = observer
        self._variables = tuple(variables)
        self._every = every
        self._outputs: NDArray[np.intp] | None = None
        self._discrete: tuple[int, ...] | None = None
        self._begin = begin
        self._number, self._passed_over = begin

    @property
    def memory(self) -> SelectionMemory:
        """Memory of the choice by now; set it to go on from there."""
        return SelectionMemory(self._number, self._passed_over)

    @memory.setter
    def memory(self, memory: SelectionMemory) -> None:
        self._number, self._passed_over = memory

    def started(self, start: RunStart) -> None:
        """Pass on what is chosen of it."""
        outputs = self._chosen(start.output_names, start.recorded)
        discrete = self._chosen(start.discrete_names, start.recorded)
        some_outputs = len(outputs) < len(start.output_names)
        some_discrete = len(discrete) < len(start.discrete_names)
        self._outputs = outputs if some_outputs else None
        self._discrete = tuple(discrete.tolist()) if some_discrete else None
        self._number, self._passed_over = self._begin
        self._observer.started(
            replace(
                start,
                output_names=tuple(start.output_names[i] for i in outputs),
                output_units=tuple(start.output_units[i] for i in outputs),
                outputs=start.outputs[outputs],
                discrete_names=tuple(start.discrete_names[i] for i in discrete),
                discrete_types=tuple(start.discrete_types[i] for i in discrete),
                discrete_units=tuple(start.discrete_units[i] for i in discrete)
                if start.discrete_units
                else (),
                discrete=tuple(start.discrete[i] for i in discrete),
            )
        )

    def _chosen(self, names: Sequence[str], recorded: frozenset[str]) -> NDArray[np.intp]:
        """Indices of those that are wanted: recorded variables were chosen already."""
        is_chosen = chosen(self._variables, names)
        return np.flatnonzero([c or n in recorded for c, n in zip(is_chosen, names, strict=True)])

    def attempted(self, attempt: Attempt) -> None:
        """Pass on with the points that are wanted."""
        points = attempt.points
        if points and self._every > 1:
            points = tuple(filter(self._is_wanted, points))
        if points and not (self._outputs is None and self._discrete is None):
            points = tuple(map(self._part, points))
        self._observer.attempted(
            attempt if points is attempt.points else attempt._replace(points=points)
        )

    def ended(self, end: RunEnd) -> None:
        """Pass on, with the last point if it was not wanted before."""
        last = self._passed_over
        rest = (*end.points, *(() if last is None else (self._part(last),)))
        self._observer.ended(replace(end, points=rest))

    def _is_wanted(self, point: Point) -> bool:
        self._number += 1
        wanted = self._number % self._every == 0
        self._passed_over = None if wanted else point
        return wanted

    def _part(self, point: Point) -> Point:
        time, outputs, discrete = point
        if self._outputs is not None:
            outputs = outputs[self._outputs]
        if self._discrete is not None:
            discrete = tuple(discrete[i] for i in self._discrete)
        return Point(time, outputs, discrete)
