"""Loops of direct feed-through, and their gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import nan

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from master_node.checking.report import LoopReport, When
from master_node.coupling.connections import ScalarConnection
from master_node.coupling.outputs import Outputs
from master_node.preparing.initialization import initialize_call
from master_node.preparing.readiness import Ready
from protocol.calls import Call, GetOutputs, Reset, SetDiscreteInputs, SetInputs
from protocol.errors import FatalSlaveError, SlaveCrashedError, SlaveError
from protocol.signals import FloatArray
from protocol.variables import Causality

Key = tuple[str, str]
"""Slave and variable by their names."""

_CHANGE = 1e-4
"""Change of an input for a difference, relative to the input or its nominal value."""


@dataclass(frozen=True)
class _Edge:
    """Direct dependency of an output on another one, through an input of its slave."""

    source: Key
    target: Key
    connection: ScalarConnection

    @property
    def name(self) -> str:
        """Name of the input."""
        return self.connection.target.variable.name


def loops_of(
    ready: Ready, connections: Sequence[ScalarConnection], outputs: Outputs
) -> list[LoopReport]:
    """All loops, with gains from differences in initialization mode at T_0.

    Slaves in loops are loaded anew for that and stand in initialization mode afterwards: no run can
    go on from there.

    Args:
        ready: the slaves, at T_0.
        connections: of the system.
        outputs: at T_0.

    Raises:
        DoublestepError: a slave was lost, or must not be called any more.
    """
    edges = {initially: _edges(ready, connections, initially) for initially in (False, True)}
    both = list({(e.source, e.target, e.name): e for e in (*edges[False], *edges[True])}.values())
    reports = []
    for nodes in _components(both):
        inside = [e for e in both if e.source in nodes and e.target in nodes]
        closed = [bool(_components([e for e in edges[mode] if e in inside])) for mode in edges]
        when = When.ALWAYS if all(closed) else When.POINTS if closed[0] else When.INITIALIZATION
        reports.append(_report(ready, nodes, inside, when, outputs))
    return reports


def _edges(ready: Ready, connections: Sequence[ScalarConnection], initially: bool) -> list[_Edge]:
    """Direct dependencies of outputs on outputs, at communication points or in initialization."""
    feeding = {connection.target.key: connection for connection in connections}
    sources = {connection.source.key for connection in connections}
    return [
        _Edge(feeding[slave, name].source.key, (slave, variable.name), feeding[slave, name])
        for slave, description in ready.prepared.descriptions.items()
        for variable in description.variables
        if variable.causality is Causality.OUTPUT or (slave, variable.name) in sources
        for name in description.direct_inputs(variable, initially=initially)
        if (slave, name) in feeding
    ]


def _components(edges: Sequence[_Edge]) -> list[set[Key]]:
    """Sets of outputs that depend on each other, in the order of the edges."""
    keys = list(dict.fromkeys(key for edge in edges for key in (edge.source, edge.target)))
    index = {key: number for number, key in enumerate(keys)}
    rows = [index[edge.source] for edge in edges]
    columns = [index[edge.target] for edge in edges]
    graph = csr_array((np.ones(len(edges)), (rows, columns)), shape=(len(keys), len(keys)))
    count, labels = connected_components(graph, directed=True, connection="strong")
    loops = [{keys[i] for i in np.flatnonzero(labels == label)} for label in range(count)]
    itself = {edge.source for edge in edges if edge.source == edge.target}
    found = [nodes for nodes in loops if len(nodes) > 1 or nodes & itself]
    return sorted(found, key=lambda nodes: min(index[key] for key in nodes))


def _report(
    ready: Ready, nodes: set[Key], edges: Sequence[_Edge], when: When, outputs: Outputs
) -> LoopReport:
    ways = [[edge for edge in edges if edge.target == node] for node in nodes]
    is_single = all(len(way) == 1 for way in ways)
    order = _around(edges) if is_single else sorted(nodes)
    names = tuple(f"{slave}.{variable}" for slave, variable in order)
    unknown = _hindrance(ready, edges, when)
    gain = nan
    if not unknown:
        try:
            gain = _gain(_matrix(ready, order, edges, outputs), is_single=is_single)
        except (FatalSlaveError, SlaveCrashedError):
            raise
        except SlaveError as error:
            unknown = f"{error.slave} refused to be asked in initialization mode: {error.cause}"
    if not unknown and not np.isfinite(gain):
        unknown = "an output is not finite where its input was moved"
    inputs = tuple(sorted({edge.connection.target.reference for edge in edges}))
    return LoopReport(names, inputs, when, nan if unknown else gain, is_single, unknown)


def _around(edges: Sequence[_Edge]) -> list[Key]:
    """Outputs along a loop with one way around."""
    following = {edge.source: edge.target for edge in edges}
    order = [edges[0].source]
    while following[order[-1]] != order[0]:
        order.append(following[order[-1]])
    return order


def _hindrance(ready: Ready, edges: Sequence[_Edge], when: When) -> str:
    """Reason why the gain of a loop cannot be measured; "" if it can."""
    if not all(edge.connection.is_continuous for edge in edges):
        return "it goes through discrete variables"
    if when is When.POINTS:
        return "it is closed at communication points only, where FMI promises no answer to a step"
    kinds = ready.prepared.descriptions
    old = sorted({e.target[0] for e in edges if kinds[e.target[0]].kind.startswith("FMI 1.0")})
    return f"{old[0]} is of FMI 1.0, which has no initialization mode" if old else ""


def _gain(matrix: FloatArray, *, is_single: bool) -> float:
    """Product of the derivatives once around, or the spectral radius.

    Args:
        matrix: derivatives of outputs with respect to outputs, shape (p, p), in the order of a loop
            with one way around.
        is_single: whether there is one way around.
    """
    if not np.isfinite(matrix).all():
        return nan
    if is_single:
        columns = np.roll(np.arange(len(matrix)), 1)
        return float(matrix[np.arange(len(matrix)), columns].prod())
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def _matrix(
    ready: Ready, order: Sequence[Key], edges: Sequence[_Edge], outputs: Outputs
) -> FloatArray:
    """Derivatives of outputs with respect to outputs in a loop, shape (p, p)."""
    coupled, system = ready.coupled, ready.prepared.system
    start = float(system.simulation.start_time)
    place = {key: number for number, key in enumerate(order)}
    y = outputs.y[0]
    u, external = coupled.inputs_of(y), coupled.external.at(start)
    held = coupled.discrete.held(y, outputs.d, start) or ((),) * len(coupled.parts)
    matrix = np.zeros((len(order), len(order)))
    for index, part in enumerate(coupled.parts):
        own = [edge for edge in edges if edge.target[0] == part.name]
        if not own:
            continue
        names = list(dict.fromkeys(edge.name for edge in own))
        values = part.columns(u[np.newaxis], external[np.newaxis])[0]
        changes = {
            name: _CHANGE
            * max(abs(values[part.inputs.index(name)]), _nominal(ready, part.name, name))
            for name in names
        }
        moved: list[Call] = []
        for name, change in changes.items():
            for sign in (1.0, -1.0):
                row = values.copy()
                row[part.inputs.index(name)] += sign * change
                moved += [SetInputs(row[np.newaxis]), GetOutputs()]
        program = (
            Reset(loads=True),
            initialize_call(part, coupled.recorded.names[index], system),
            *((SetDiscreteInputs(held[index]),) if held[index] else ()),
            *moved,
        )
        (reply,) = ready.group.execute([program], start, slaves=[index])
        if reply.error is not None:
            raise reply.error
        answers = [r[0] for r in reply.results if isinstance(r, np.ndarray)]
        slopes: Mapping[str, FloatArray] = {
            name: (answers[2 * n] - answers[2 * n + 1]) / (2.0 * changes[name])
            for n, name in enumerate(names)
        }
        for edge in own:
            slope = slopes[edge.name]
            factor = edge.connection.transformation.factor
            row_, column = place[edge.target], place[edge.source]
            matrix[row_, column] += factor * slope[part.outputs.index(edge.target[1])]
    return matrix


def _nominal(ready: Ready, slave: str, name: str) -> float:
    return abs(ready.prepared.descriptions[slave].variable(name).nominal)
