"""Values of variables at a communication point, by ``slave.variable``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import NamedTuple

from master_node.coupling.coupled_system import CoupledSystem, SlavePart
from master_node.inputs.discrete import DrivenInput
from master_node.methods.position import Position
from master_node.system.system import System
from protocol.errors import SteeringError
from protocol.text.names import nearest
from protocol.variables import Causality, StartValue, Variable

_Reader = Callable[[Position], StartValue]


class ConnectedInput(NamedTuple):
    """Place of a connected input.

    Attributes:
        slave: index of its slave.
        variable: the input.
        column: index among the connected continuous inputs of the system; None: it is discrete.
        held: index among the connected discrete inputs of its slave.
        source: ``slave.variable`` of the output that feeds it.
    """

    slave: int
    variable: Variable
    column: int | None
    held: int
    source: str


class Variables:
    """All variables of a system, as far as the master knows their values.

    Args:
        coupled: the system.
        system: its settings.

    Attributes:
        connected: connected inputs, by ``slave.variable``.
        external: names of the variables that the table ``[inputs]`` drives.
        known: all variables of all slaves, by ``slave.variable``, with the names of their slaves.
    """

    def __init__(self, coupled: CoupledSystem, system: System) -> None:
        self._coupled = coupled
        self._system = system
        self.connected: dict[str, ConnectedInput] = {}
        self.external: dict[str, _Reader] = {}
        self.known = {
            f"{part.name}.{variable.name}": (part.name, variable)
            for part in coupled.parts
            for variable in part.description.variables
        }
        for slave, part in enumerate(coupled.parts):
            self._add_inputs(slave, part)
        self._readers: dict[str, _Reader] = dict(self._outputs())
        self._starts = {
            f"{part.name}.{name}": value
            for part in coupled.parts
            for name, value in part.start_values.items()
        }

    def __iter__(self) -> Iterator[str]:
        return (name for name in self.known if self._has_value(name))

    def value(self, name: str, position: Position) -> StartValue:
        """The value of a variable where the run stands.

        Raises:
            SteeringError: there is no such variable, or its value is not known.
        """
        self.check(name)
        if name in self._readers:
            return self._readers[name](position)
        if name in self.external:
            return self.external[name](position)
        if name in self.connected:
            return self._connected_value(self.connected[name], position)
        for one in position.given:
            if one.name == name:
                return one.value
        start = self._starts.get(name, self.known[name][1].start)
        if start is None or not self._stays(name):
            raise SteeringError(
                f"{name}: its value is not read during the run",
                remedy=f'record it: [results] locals = ["{name}"]',
            )
        return start

    def check(self, name: str) -> None:
        """Make sure that there is such a variable; `SteeringError` names the nearest ones."""
        if name not in self.known:
            raise SteeringError(f"no variable {name!r}{nearest(name, [*self.known])}")

    def _has_value(self, name: str) -> bool:
        is_read = name in self._readers or name in self.external or name in self.connected
        return is_read or (self._stays(name) and self.known[name][1].start is not None)

    def _stays(self, name: str) -> bool:
        """True for what changes only when it is set."""
        return self.known[name][1].causality in (
            Causality.PARAMETER,
            Causality.STRUCTURAL_PARAMETER,
            Causality.INPUT,
        )

    def _connected_value(self, one: ConnectedInput, position: Position) -> StartValue:
        y, d = position.outputs
        if one.column is not None:
            return float(self._coupled.inputs_of(y[0])[one.column])
        return self._coupled.discrete.held(y[0], d, position.time)[one.slave][one.held]

    def _outputs(self) -> Iterator[tuple[str, _Reader]]:
        coupled = self._coupled
        recorded = coupled.recorded
        names = (*coupled.output_names, *(one.name for one in recorded.continuous))
        for column, name in enumerate(names):
            yield name, partial(self._continuous, column)
        others = (*coupled.discrete.names, *(one.name for one in recorded.discrete))
        for index, name in enumerate(others):
            yield name, partial(self._discrete, index)

    def _continuous(self, column: int, position: Position) -> StartValue:
        y, _ = self._coupled.recorded.split(*position.outputs)
        return float(y[0, column])

    def _discrete(self, index: int, position: Position) -> StartValue:
        _, d = self._coupled.recorded.split(*position.outputs)
        return d[index]

    def _external(self, column: int, position: Position) -> StartValue:
        return float(self._coupled.external.at(position.time)[column])

    @staticmethod
    def _driven(one: DrivenInput, position: Position) -> StartValue:
        return one.signal.at(position.time)

    def _add_inputs(self, slave: int, part: SlavePart) -> None:
        coupled = self._coupled
        for i, name in enumerate(part.connected):
            column = part.input_slice.start + i
            source = coupled.output_names[int(coupled.source[column])]
            variable = part.description.variable(name)
            place = ConnectedInput(slave, variable, column, 0, source)
            self.connected[f"{part.name}.{name}"] = place
        for i, held in enumerate(coupled.discrete.inputs[slave]):
            if held.output is not None:
                source = coupled.discrete.names[held.output]
            else:
                assert held.continuous_output is not None  # one of both
                source = coupled.output_names[held.continuous_output]
            variable = part.description.variable(held.name)
            place = ConnectedInput(slave, variable, None, i, source)
            self.connected[f"{part.name}.{held.name}"] = place
        for i, name in enumerate(part.external):
            column = part.external_slice.start + i
            self.external[f"{part.name}.{name}"] = partial(self._external, column)
        driven = coupled.discrete.driven[slave] if coupled.discrete.driven else ()
        for one in driven:
            self.external[one.name] = partial(self._driven, one)


class Point(Mapping[str, StartValue]):
    """Communication point that a run has reached.

    Args:
        variables: of the run.
        position: there.

    Attributes:
        time: T_n [s].
        step_size: H that the next step wants [s].
    """

    def __init__(self, variables: Variables, position: Position) -> None:
        self._variables = variables
        self._position = position
        self.time = position.time
        self.step_size = position.step_size

    def __getitem__(self, name: str) -> StartValue:
        """The value of ``slave.variable``; `SteeringError`."""
        return self._variables.value(name, self._position)

    def __contains__(self, name: object) -> bool:
        return name in self._variables.known

    def __iter__(self) -> Iterator[str]:
        return iter(self._variables)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __repr__(self) -> str:
        return f"<Point at t={self.time!r} s>"
