"""Order in which outputs follow from inputs that follow from outputs: direct feed-through."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter

import numpy as np
from numpy.typing import NDArray

from master_node.coupling.connections import (
    ScalarConnection,
)
from master_node.coupling.discrete import DiscreteCoupling

Key = tuple[str, str]
"""Slave and variable by their names."""


@dataclass(frozen=True)
class FeedThroughOrder:
    """Levels of outputs: an output follows from inputs that follow from outputs of lower levels.

    Attributes:
        levels: the outputs of level l depend on connected inputs fed by outputs of lower levels
            only; shape (m,); empty if there is an algebraic loop.
        discrete_levels: levels of the discrete outputs.
        loop: ``slave.variable`` along an algebraic loop, else empty.
    """

    levels: NDArray[np.intp]
    discrete_levels: NDArray[np.intp]
    loop: tuple[str, ...]

    @property
    def highest(self) -> int:
        """The highest level; 0 without outputs."""
        return int(max(self.levels.max(initial=0), self.discrete_levels.max(initial=0)))


def feed_through_order(
    output_index: Mapping[Key, int],
    discrete: DiscreteCoupling,
    feed_through: Mapping[Key, tuple[str, ...]],
    feeding: Mapping[str, Mapping[str, ScalarConnection]],
) -> FeedThroughOrder:
    """Levels of all outputs of a system.

    Args:
        output_index: place of each continuous output, by slave and name.
        discrete: the coupling of discrete variables.
        feed_through: inputs of its slave on which each output depends directly.
        feeding: connection of each connected input, by slave and input.
    """
    depends = {
        (slave, output): [
            feeding[slave][name].source.key
            for name in feed_through[slave, output]
            if name in feeding[slave]
        ]
        for slave, output in (*output_index, *discrete.keys)
    }
    level: dict[Key, int] = {}
    try:
        for output in TopologicalSorter(depends).static_order():
            level[output] = max((level[source] + 1 for source in depends[output]), default=0)
    except CycleError as error:
        loop = tuple(f"{slave}.{variable}" for slave, variable in error.args[1])
        return FeedThroughOrder(np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp), loop)
    return FeedThroughOrder(
        np.array([level[key] for key in output_index], dtype=np.intp),
        np.array([level[key] for key in discrete.keys], dtype=np.intp),
        (),
    )
