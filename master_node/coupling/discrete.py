"""Discrete variables: integers, booleans, strings, enumerations, binaries, discrete reals.

Such an output is read at communication points, and an input that it feeds is held until the next
one. It takes no part in extrapolation and in the error norm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from functools import cached_property

from master_node.coupling.connections import ScalarConnection
from master_node.coupling.overrides import OverriddenInputs
from master_node.coupling.type_casts import Cast, ItemCast
from master_node.coupling.units import Transformation
from master_node.inputs.continuous import Jump
from master_node.inputs.discrete import DrivenInput
from protocol.errors import SlaveError
from protocol.signals import FloatArray
from protocol.variables import StartValue, Variable, VariableType

DiscreteValues = tuple[StartValue, ...]
"""Values of the discrete outputs, then of the recorded variables; None stands for one that was not
read."""

Held = tuple[DiscreteValues, ...]
"""For each slave the values of its discrete inputs; empty where no slave has any."""


@dataclass(frozen=True, slots=True)
class HeldInput:
    """Where the value of a discrete input comes from.

    Attributes:
        slave, name: of the input.
        output: index among the discrete outputs; None if the output is continuous.
        continuous_output: index among the continuous outputs; None if it is discrete.
        start: of the input, where its output is not known yet; None: it has none.
    """

    slave: str
    name: str
    output: int | None
    continuous_output: int | None
    cast: Cast
    transformation: Transformation
    start: StartValue | None

    def value(self, y: FloatArray, d: DiscreteValues, time: float) -> StartValue:
        """The value that belongs to outputs.

        Args:
            y: continuous outputs, shape (m,).
            d: discrete outputs.
            time: of the outputs [s].

        Raises:
            SlaveError: a mapping knows no such value, and the types have no cast.
        """
        if self.output is not None:
            try:
                value = self.cast(d[self.output])
            except KeyError:
                raise self._no_entry(d[self.output], time) from None
        else:
            value = float(y[self.continuous_output])
        if self.transformation.is_identity:
            return value
        assert isinstance(value, float)
        return self.transformation.factor * value + self.transformation.offset

    def _no_entry(self, value: StartValue, time: float) -> SlaveError:
        if isinstance(self.cast, ItemCast):
            cause = (
                f"input {self.name!r} is an Enumeration, and no item of it has the number {value!r}"
            )
            remedy = "give the connection a mapping that says which item is meant"
        else:
            cause = (
                f"the mapping of input {self.name!r} has no entry for the value {value!r:.60}, and "
                "the types allow no other way"
            )
            remedy = "add the value to the mapping of the connection"
        return SlaveError(
            cause, slave=self.slave, phase="set_discrete_inputs", time=time, remedy=remedy
        )


@dataclass(frozen=True)
class DiscreteCoupling:
    """The discrete side of a coupled system.

    Attributes:
        keys: slave and variable of each discrete output.
        types, units: of the discrete outputs.
        output_slices: for each slave where its discrete outputs are among all of them.
        inputs: for each slave its discrete inputs that are connected, in order.
        driven: for each slave those that change from outside, in order, behind the connected ones.
        overrides: connected inputs that are cut from their sources now.
    """

    keys: tuple[tuple[str, str], ...]
    types: tuple[VariableType, ...]
    units: tuple[str, ...]
    output_slices: tuple[slice, ...]
    inputs: tuple[tuple[HeldInput, ...], ...]
    driven: tuple[tuple[DrivenInput, ...], ...] = ()
    overrides: OverriddenInputs = field(default_factory=OverriddenInputs)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """``slave.variable`` of each discrete output."""
        return tuple(f"{slave}.{variable}" for slave, variable in self.keys)

    @cached_property
    def is_empty(self) -> bool:
        """True if all of the system is continuous."""
        return not self.keys and not self.holds_inputs

    @cached_property
    def holds_inputs(self) -> bool:
        """True if any slave has discrete inputs that are connected, or change from outside."""
        return any(self.inputs) or any(self.driven)

    @cached_property
    def jumps(self) -> tuple[Jump, ...]:
        """Known changes of inputs that are driven from outside, in order of time."""
        return tuple(sorted({jump for each in self.driven for one in each for jump in one.jumps}))

    @cached_property
    def _searched(self) -> tuple[DrivenInput, ...]:
        return tuple(one for each in self.driven for one in each if one.is_searched)

    @cached_property
    def _connected(self) -> tuple[int, ...]:
        """Indices of the discrete outputs that feed an input."""
        feeding = {held.output for inputs in self.inputs for held in inputs}
        return tuple(sorted(index for index in feeding if index is not None))

    def held(self, y: FloatArray, d: DiscreteValues, time: float) -> Held:
        """The discrete inputs that belong to outputs.

        Args:
            y: continuous outputs, shape (m,).
            d: discrete outputs.
            time: of both [s].

        Raises:
            SlaveError: a mapping of a connection has no entry for a value, or a function that
                drives an input from outside failed.
        """
        if not self.holds_inputs:
            return ()
        connected = (
            self.overrides.of_slave(slave, tuple(held.value(y, d, time) for held in inputs))
            for slave, inputs in enumerate(self.inputs)
        )
        if not any(self.driven):
            return tuple(connected)
        return tuple(
            values + outside
            for values, outside in zip(connected, self.from_outside(time), strict=True)
        )

    def from_outside(self, time: float) -> Held:
        """For each slave the values of its inputs that are driven from outside, at a time [s]."""
        return tuple(tuple(one.signal.at(time) for one in each) for each in self.driven)

    def filled(self, known: DiscreteValues, before: DiscreteValues) -> DiscreteValues:
        """Discrete outputs and recorded variables, with those of ``before`` where none was read."""
        if not known:
            return ()
        return tuple(b if k is None else k for k, b in zip(known, before, strict=True))

    def changing(self, before: DiscreteValues, after: DiscreteValues) -> frozenset[int]:
        """Indices of the discrete outputs that feed an input and have changed."""
        return frozenset(index for index in self._connected if before[index] != after[index])

    def changed(
        self,
        before: DiscreteValues,
        after: DiscreteValues,
        begin: float,
        end: float,
        restless: Set[int] = frozenset(),
    ) -> str:
        """``slave.variable`` of what has changed, or "".

        That is a discrete output that feeds an input, or an input that a function drives.

        Args:
            before: discrete outputs at ``begin``.
            after: discrete outputs at ``end``.
            begin: when those before were read [s].
            end: when those behind were read [s].
            restless: indices of the outputs that change all the time, and do not count.
        """
        for index in self._connected:
            if before[index] != after[index] and index not in restless:
                return self.names[index]
        for one in self._searched:
            if one.signal.at(begin) != one.signal.at(end):
                return one.name
        return ""


def couple_discrete(
    read: Mapping[str, Sequence[Variable]],
    feeding: Sequence[Sequence[ScalarConnection]],
    continuous_outputs: Mapping[tuple[str, str], int],
    driven: Sequence[Sequence[DrivenInput]],
    overrides: OverriddenInputs,
) -> DiscreteCoupling:
    """Give every discrete output its index.

    Args:
        read: the variables of each slave that are read, in order.
        feeding: for each slave the connections of its discrete inputs, in order.
        continuous_outputs: indices of the continuous outputs by slave and variable.
        driven: for each slave its inputs that change from outside, in order.
        overrides: connected inputs that are cut from their sources now.
    """
    keys: list[tuple[str, str]] = []
    types: list[VariableType] = []
    units: list[str] = []
    slices = []
    for slave, variables in read.items():
        outputs = [v for v in variables if v.is_discrete]
        slices.append(slice(len(keys), len(keys) + len(outputs)))
        keys += [(slave, variable.name) for variable in outputs]
        types += [variable.type for variable in outputs]
        units += [variable.unit for variable in outputs]
    index = {key: i for i, key in enumerate(keys)}
    return DiscreteCoupling(
        tuple(keys),
        tuple(types),
        tuple(units),
        tuple(slices),
        tuple(
            tuple(
                HeldInput(
                    feed.target.slave,
                    feed.target.variable.name,
                    index.get(feed.source.key),
                    continuous_outputs.get(feed.source.key),
                    feed.cast,
                    feed.transformation,
                    feed.target.variable.start,
                )
                for feed in feeds
            )
            for feeds in feeding
        ),
        tuple(map(tuple, driven)),
        overrides,
    )
