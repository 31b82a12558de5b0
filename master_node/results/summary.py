"""``summary.json``: what a run was asked for and how it went."""

from __future__ import annotations

import json
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from master_node.observing.observers import RunEnd, RunStart
from master_node.observing.run_warnings import warnings_of
from master_node.results.columns import Columns
from master_node.results.files import cannot_read, cannot_write, malformed, replacing
from master_node.results.formats import FORMATS

_WITHOUT_TEXTS = [name for name, one in FORMATS.items() if not one.holds_texts]


def summarize(start: RunStart, end: RunEnd, settings: Mapping[str, object]) -> dict[str, Any]:
    """The summary of a run as plain data for JSON; a number that is not finite is None.

    ``state_kind``, ``do_steps``, ``rollbacks``, ``restarts``, ``model_warnings``, ``requests``,
    ``compute_time`` [s] and ``transport_time`` [s] are maps by slave, ``controlled_by`` by the kind
    of control, ``units``, ``discrete_types`` and ``enumerations`` by variable.
    """
    statistics = end.statistics
    simulation = settings.get("simulation")
    simulation = simulation if isinstance(simulation, Mapping) else {}
    slaves = statistics.slaves.items()
    return plain_mapping(
        {
            "outcome": str(end.outcome),
            "message": end.message,
            "start_time": start.start_time,
            "stop_time": start.stop_time,
            "simulated_time": statistics.time - start.start_time,
            "estimator": simulation.get("estimator"),
            "order": simulation.get("order"),
            "communication_steps": statistics.communication_steps,
            "rejected_double_steps": statistics.rejected_double_steps,
            "discontinuities": statistics.discontinuities,
            "double_steps_at_discontinuities": statistics.double_steps_at_discontinuities,
            "double_steps_at_false_alarms": statistics.double_steps_at_false_alarms,
            "late_jumps": statistics.late_jumps,
            "changes_at_smallest_step_size": statistics.changes_at_smallest_step_size,
            "steps_above_tolerance": statistics.steps_above_tolerance,
            "iterated_double_steps": statistics.iterated_double_steps,
            "stiff_double_steps": statistics.stiff_double_steps,
            "double_steps_at_rest": statistics.double_steps_at_rest,
            "warnings": warnings_of(statistics),
            "controlled_by": start.control._asdict(),
            "state_kind": start.state_kinds,
            "smallest_step_size": statistics.smallest_step_size,
            "largest_step_size": statistics.largest_step_size,
            "round_trips": statistics.round_trips,
            "wall_time": statistics.wall_time,
            "wait_time": statistics.wait_time,
            "do_steps": {name: slave.do_steps for name, slave in slaves},
            "rollbacks": {name: slave.rollbacks for name, slave in slaves},
            "restarts": {name: slave.restarts for name, slave in slaves},
            "model_warnings": {name: slave.warnings for name, slave in slaves},
            "requests": {name: slave.requests for name, slave in slaves},
            "compute_time": {name: slave.compute_time for name, slave in slaves},
            "transport_time": {name: slave.transport_time for name, slave in slaves},
            **about_columns(Columns.of(start), settings),
            "settings_sha256": settings_sha256(settings),
            "settings": settings,
        }
    )


def about_columns(columns: Columns, settings: Mapping[str, object]) -> dict[str, object]:
    """The part of a summary that is known at the start."""
    formats = formats_of(settings)
    texts = [name for name, type_ in columns.types.items() if type_ in ("string", "binary")]
    return {
        "formats": list(formats),
        **{f"not_in_{name}": texts if name in formats else [] for name in _WITHOUT_TEXTS},
        "units": columns.all_units,
        "discrete_types": columns.types,
        "enumerations": columns.items,
    }


def formats_of(settings: Mapping[str, object]) -> tuple[str, ...]:
    """In which formats the results of a run are wanted."""
    results = settings.get("results")
    formats = results.get("formats") if isinstance(results, Mapping) else None
    return tuple(dict.fromkeys(formats or ("csv",)))


def settings_sha256(settings: Mapping[str, object]) -> str:
    """A hash of the settings, for files without a summary of their own."""
    return sha256(json.dumps(plain_mapping(settings), sort_keys=True).encode()).hexdigest()


def write_json(path: Path, tables: Mapping[str, object]) -> None:
    """Put a file in place, whole or not at all.

    Raises:
        ResultsError: it cannot be written.
    """
    text = json.dumps(tables, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    try:
        with replacing(path) as file:
            file.write(text.encode(errors="replace"))
    except OSError as error:
        raise cannot_write(path, error) from error


def read_json(path: Path) -> dict[str, Any]:
    """The tables in a file; none where it is missing.

    Raises:
        ResultsError: it cannot be read or is malformed; names the line.
    """
    try:
        tables = json.loads(path.read_text(encoding="utf-8", errors="replace"))
    except FileNotFoundError:
        return {}
    except json.JSONDecodeError as error:
        raise malformed(path, error.msg, error.lineno) from error
    except (ValueError, RecursionError) as error:  # a number or a depth beyond what can be read
        raise malformed(path, str(error)) from error
    except OSError as error:
        raise cannot_read(path, error) from error
    if not isinstance(tables, dict):
        raise malformed(path, "expected a JSON object", 1)
    return tables


def plain_mapping(mapping: Mapping[Any, object]) -> dict[str, Any]:
    """The mapping as JSON knows it; a snapshot, so later changes do not reach it."""
    return {str(key): _plain(value) for key, value in mapping.items()}


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if value is None or isinstance(value, bool | int):
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, Mapping):
        return plain_mapping(value)
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item) for item in value]
    return str(value)
