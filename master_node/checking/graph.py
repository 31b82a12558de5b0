"""Topology of a system as a graph: Mermaid, Graphviz dot, and SVG by Graphviz.

Slaves are boxes, hosts are frames around them. Connections from one slave to another are one arrow
with their number; arrows of a loop of direct feed-through are marked.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from master_node.checking.report import SystemReport
from protocol.errors import ConfigurationError, DeadlineError, ResultsError
from protocol.text.names import number_of
from protocol.text.plain_text import shortened

_LAYOUT_TIME = 60.0
"""Bound on the layout by Graphviz [s]."""

_LONGEST = 60
_MARK = "#c0392b"


@dataclass(frozen=True)
class _Arrow:
    """Bundle of connections.

    Attributes:
        source, target: slaves; None: driven from outside.
        label: number of connections, and the gain of a loop.
        in_loop: whether a loop of direct feed-through goes through it.
    """

    source: str | None
    target: str
    label: str
    in_loop: bool = False


def write_graph(report: SystemReport, path: Path) -> None:
    """Write the topology in the format that the suffix of ``path`` names.

    Raises:
        ConfigurationError: the suffix is none of ours, or Graphviz is needed and not there.
        DeadlineError: Graphviz does not end.
        ResultsError: the file cannot be written.
    """
    check_graph_path(path)
    text = _WRITERS[path.suffix](report)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ResultsError(f"cannot write {path}: {error.strerror}") from error


def check_graph_path(path: Path) -> None:
    """Make sure that a graph can be made for ``path``, before anything is started.

    Raises:
        ConfigurationError: as `write_graph`.
    """
    if path.suffix not in _WRITERS:
        raise ConfigurationError(
            f"--graph {path}: the suffix is none of {', '.join(_WRITERS)}",
            remedy="take .mmd for Mermaid, .dot for Graphviz, .svg for a picture",
        )
    if path.suffix == ".svg" and shutil.which("dot") is None:
        raise ConfigurationError(
            f"--graph {path}: SVG is drawn by Graphviz, and its command dot is not on the PATH",
            remedy="install Graphviz, or take .mmd or .dot",
        )


def mermaid(report: SystemReport) -> str:
    """The topology as a flowchart of Mermaid."""
    ids = _ids(report)
    lines = ["flowchart LR"]
    for number, (host, slaves) in enumerate(_hosts(report).items()):
        lines.append(f'  subgraph h{number}["{_in_mermaid(host)}"]')
        lines += [f'    {ids[s]}["{_in_mermaid(s)}<br/>{_in_mermaid(k)}"]' for s, k in slaves]
        lines.append("  end")
    arrows = _arrows(report)
    if any(arrow.source is None for arrow in arrows):
        lines.append(f'  {ids[None]}(["inputs from outside"])')
    lines += [f'  {ids[a.source]} -->|"{_in_mermaid(a.label)}"| {ids[a.target]}' for a in arrows]
    marked = ",".join(str(i) for i, arrow in enumerate(arrows) if arrow.in_loop)
    if marked:
        lines.append(f"  linkStyle {marked} stroke:{_MARK},stroke-width:3px")
    return "\n".join(lines) + "\n"


def dot(report: SystemReport) -> str:
    """The topology as a digraph of Graphviz."""
    ids = _ids(report)
    lines = ["digraph system {", "  rankdir=LR", "  node [shape=box]"]
    for number, (host, slaves) in enumerate(_hosts(report).items()):
        lines += [f"  subgraph cluster_{number} {{", f'    label="{_in_dot(host)}"']
        lines += [f'    {ids[s]} [label="{_in_dot(s)}\\n{_in_dot(k)}"]' for s, k in slaves]
        lines.append("  }")
    arrows = _arrows(report)
    if any(arrow.source is None for arrow in arrows):
        lines.append(f'  {ids[None]} [label="inputs from outside", shape=plaintext]')
    for arrow in arrows:
        mark = f', color="{_MARK}", penwidth=3' if arrow.in_loop else ""
        label = _in_dot(arrow.label)
        lines.append(f'  {ids[arrow.source]} -> {ids[arrow.target]} [label="{label}"{mark}]')
    return "\n".join([*lines, "}"]) + "\n"


def svg(report: SystemReport) -> str:
    """The topology as a picture, laid out by Graphviz; raises as `write_graph`."""
    command = shutil.which("dot")
    assert command is not None
    try:
        done = subprocess.run(
            [command, "-Tsvg"],
            input=dot(report),
            capture_output=True,
            encoding="utf-8",
            timeout=_LAYOUT_TIME,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise DeadlineError(
            f"Graphviz has made no layout in {_LAYOUT_TIME:g} s", remedy="take .mmd or .dot"
        ) from None
    if done.returncode:
        cause = shortened(done.stderr.strip(), 200)
        raise ConfigurationError(f"Graphviz refused the graph: {cause}", remedy="take .mmd or .dot")
    return done.stdout


_WRITERS: Mapping[str, Callable[[SystemReport], str]] = {".mmd": mermaid, ".dot": dot, ".svg": svg}


def _ids(report: SystemReport) -> dict[str | None, str]:
    """Names of nodes that any format takes, by slave; None: what comes from outside."""
    return {None: "outside", **{s.name: f"s{i}" for i, s in enumerate(report.slaves)}}


def _hosts(report: SystemReport) -> dict[str, list[tuple[str, str]]]:
    """Slaves and their kinds, by host."""
    hosts: dict[str, list[tuple[str, str]]] = {}
    for slave in report.slaves:
        hosts.setdefault(slave.host, []).append((slave.name, slave.kind))
    return hosts


def _arrows(report: SystemReport) -> list[_Arrow]:
    slaves = [slave.name for slave in report.slaves]
    bundles: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for connection in report.connections:
        ends = _slave_of(connection.source, slaves), _slave_of(connection.target, slaves)
        bundles.setdefault(ends, []).append((connection.source, connection.target))
    outside: dict[str, int] = {}
    for one in report.unconnected:
        if one.given_by == "[inputs]":
            slave = _slave_of(one.name, slaves)
            outside[slave] = outside.get(slave, 0) + 1
    arrows = []
    for (source, target), pairs in bundles.items():
        loops = [
            loop
            for loop in report.loops
            if any(out in loop.outputs and into in loop.inputs for out, into in pairs)
        ]
        label = str(len(pairs))
        if loops:
            gains = ["unknown" if one.unknown else f"{one.gain:.3g}" for one in loops]
            label += f" ({number_of(len(loops), 'loop')}, gain {', '.join(gains)})"
        arrows.append(_Arrow(source, target, label, bool(loops)))
    return arrows + [_Arrow(None, slave, str(number)) for slave, number in outside.items()]


def _slave_of(reference: str, slaves: Sequence[str]) -> str:
    """Slave of ``slave.variable``; names may hold dots."""
    return max((s for s in slaves if reference.startswith(f"{s}.")), key=len)


def _in_mermaid(text: str) -> str:
    """Text within quotation marks; what could end them, or be markup, by its number."""
    shown = shortened(text, _LONGEST)
    return "".join(c if c.isalnum() or c in " ._-+,:/()" else f"#{ord(c)};" for c in shown)


def _in_dot(text: str) -> str:
    return shortened(text, _LONGEST).replace("\\", "\\\\").replace('"', '\\"')
