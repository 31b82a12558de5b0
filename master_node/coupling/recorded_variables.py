"""Variables that are read for results only: which they are, and where their values go.

They take no part in the coupling and in the error norm. They are read in the requests that read the
outputs, and their values travel behind those of the discrete outputs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from master_node.results.patterns import chosen, is_name, matches
from protocol.calls import RecordedValues
from protocol.description import SlaveDescription
from protocol.errors import ConfigurationError
from protocol.signals import FloatArray
from protocol.text.names import nearest
from protocol.variables import StartValue, Variable, VariableType

Values = tuple[StartValue, ...]


class RecordedVariable(NamedTuple):
    """A variable of a slave that is read for results.

    Attributes:
        slave: its name.
        variable: of any causality.
    """

    slave: str
    variable: Variable

    @property
    def name(self) -> str:
        """``slave.variable``."""
        return f"{self.slave}.{self.variable.name}"


class RecordedVariables:
    """All variables that are read for results only.

    Args:
        variables: of each slave, in the order of the slaves.
        discrete_outputs: how many there are, behind which the values travel.
        tolerance: absolute and relative one of a variable.

    Attributes:
        names: for each slave: of its floating-point variables, then of all others.
        continuous: those that change continuously, r of them.
        discrete: all others.
        tolerances: absolute and relative ones of the continuous ones.
    """

    def __init__(
        self,
        variables: Mapping[str, Sequence[Variable]],
        discrete_outputs: int = 0,
        tolerance: Callable[[str, Variable], tuple[float, float]] = lambda *_: (1.0, 1.0),
    ) -> None:
        ordered = {
            slave: sorted(each, key=lambda variable: not variable.type.is_real)
            for slave, each in variables.items()
        }
        self.names = [tuple(variable.name for variable in each) for each in ordered.values()]
        self._slices = []
        continuous: list[tuple[int, RecordedVariable]] = []
        discrete: list[tuple[int, RecordedVariable]] = []
        place = discrete_outputs
        for slave, each in ordered.items():
            self._slices.append(slice(place, place + len(each)))
            for variable in each:
                kind = continuous if variable.is_continuous_real else discrete
                kind.append((place, RecordedVariable(slave, variable)))
                place += 1
        self.continuous = tuple(one for _, one in continuous)
        self.discrete = tuple(one for _, one in discrete)
        found = [tolerance(*one) for one in self.continuous]
        self.tolerances = ([one for one, _ in found], [one for _, one in found])
        self._continuous = [place for place, _ in continuous]
        self._kept = [*range(discrete_outputs), *(place for place, _ in discrete)]

    @cached_property
    def is_empty(self) -> bool:
        """True if there are none."""
        return not any(self.names)

    @staticmethod
    def values(read: RecordedValues) -> Values:
        """Values of a slave, in the order of its names."""
        return (*read.numbers[0].tolist(), *read.others)

    def replaced(self, d: Values, read: Mapping[int, RecordedValues]) -> Values:
        """Values of discrete outputs and recorded variables, with what some slaves gave anew.

        Args:
            d: of all slaves.
            read: by the index of the slave.
        """
        if not read:
            return d
        values = list(d)
        for slave, given in read.items():
            values[self._slices[slave]] = self.values(given)
        return tuple(values)

    def split(self, y: FloatArray, d: Values) -> tuple[FloatArray, Values]:
        """Values of a point that results hold.

        Args:
            y: outputs, shape (rows, m).
            d: discrete outputs and recorded variables.

        Returns:
            Outputs and continuous recorded variables, shape (rows, m + r), without derivatives of
            these, and the values of all others.
        """
        if self.is_empty:
            return y, d
        recorded = np.zeros((len(y), len(self._continuous)))
        recorded[0] = [d[place] for place in self._continuous]
        return np.concatenate([y, recorded], axis=1), tuple([d[place] for place in self._kept])


def wanted_variables(
    source: str,
    descriptions: Mapping[str, SlaveDescription],
    taken: Collection[tuple[str, str]],
    locals_: Sequence[str],
    variables: Sequence[str],
) -> dict[str, list[Variable]]:
    """The variables that are to be recorded, of each slave.

    Args:
        source: what to call the system.
        descriptions: of the slaves.
        taken: slave and name of the variables that results hold anyway.
        locals_: patterns for all others.
        variables: patterns for those that are taken; one without a wildcard may name another.

    Raises:
        ConfigurationError: a pattern of ``locals_`` matches no variable, with the nearest names.
    """
    others = [
        RecordedVariable(slave, variable)
        for slave, description in descriptions.items()
        for variable in description.variables
        if (slave, variable.name) not in taken and variable.type is not VariableType.CLOCK
    ]
    found: dict[str, list[Variable]] = {slave: [] for slave in descriptions}
    single = frozenset(filter(is_name, variables))
    if not (locals_ or single):
        return found
    names = [one.name for one in others]
    for pattern in locals_:
        bare = pattern.removeprefix("!")
        if not any(matches(name, bare) for name in names):
            raise ConfigurationError(
                f"{source}: [results] locals: {pattern!r} matches no variable beside the outputs"
                f"{nearest(bare, names)}"
            )
    is_chosen = chosen(locals_, names) if locals_ else np.zeros(len(names), np.bool_)
    for one, is_one in zip(others, is_chosen.tolist(), strict=True):
        if is_one or one.name in single:
            found[one.slave].append(one.variable)
    return found
