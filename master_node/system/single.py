"""System of one model alone: what ``master-node run MODEL.fmu`` runs."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from master_node.system.system import System
from protocol.errors import ConfigurationError
from protocol.host.files import DESCRIPTION, is_fmu
from protocol.text.references import split_reference
from protocol.wire.keys import check_name

_NAME = "model"
"""Name of a slave whose model has none that a slave can have."""


def is_model(path: Path) -> bool:
    """True if a name means a model instead of a system: an FMU, or a Python class."""
    if path.suffix.lower() == ".fmu":
        return True
    if path.is_dir():
        return (path / DESCRIPTION).is_file()
    return split_reference(str(path)) is not None and not path.exists()


def single_system(path: Path) -> System:
    """System of one model, with fixed steps, as nothing is coupled that an estimator could judge.

    Start time, stop time and step size are those of its default experiment, where it has one; else
    the stop time is missing, and the step size is a thousandth of the simulated time.

    Raises:
        ModelError: the model is missing or cannot be read.
    """
    model, base = str(path), Path.cwd()
    load = entry_points(group="doublestep.in_process")["experiment"].load()
    experiment = load(model, base)
    simulation: dict[str, Any] = {"estimator": "none"}
    given = (
        ("start_time", experiment.start_time),
        ("stop_time", experiment.stop_time),
        ("initial_step_size", experiment.step_size),
    )
    simulation |= {key: value for key, value in given if value is not None}
    return System(
        simulation=simulation,
        slaves={_name(path, base): {"model": model}},
        base=base,
        source=model,
    )


def _name(path: Path, base: Path) -> str:
    """Name of the slave: of the class, or of the file."""
    reference = None if is_fmu(str(path), base) else split_reference(str(path))
    name = path.stem if reference is None else reference[1]
    try:
        return check_name(name)
    except ConfigurationError:
        return _NAME
