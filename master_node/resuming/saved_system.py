"""System of a checkpoint, and whether the system of today still is that one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from master_node.system.files import open_system
from master_node.system.system import System
from master_node.system.tables import InputSettings
from protocol.description import SlaveDescription
from protocol.errors import ConfigurationError, ResultsError
from protocol.host.files import file_sha256


class RunMode(NamedTuple):
    """Options of a run that are no settings of the system: how slaves are run.

    Attributes:
        in_process: in this process, without a bus.
        launch: start slaves that have a model.
    """

    in_process: bool = False
    launch: bool = True


def can_be_saved(system: System) -> bool:
    """True if a file can say what was run: it cannot hold functions and arrays out of Python."""
    settings = [value for value in system.inputs.values() if isinstance(value, InputSettings)]
    return all(isinstance(given, str | None) for s in settings for given in (s.table, s.function))


def saved_system(
    system: System, mode: RunMode, descriptions: Mapping[str, SlaveDescription]
) -> dict[str, Any]:
    """System and options of a run, as plain data for JSON."""
    tables = system.model_dump(mode="json", by_alias=True, exclude_unset=True, exclude_none=True)
    return {
        "tables": tables,
        "base": str(system.base),
        "unpacked": None if system.unpacked is None else str(system.unpacked),
        "source": system.source,
        "path": str(Path(system.source).absolute()),
        "mode": mode._asdict(),
        "models": {name: told.sha256 for name, told in descriptions.items()},
        "files": {path: _sha256(system.base / path) for path in _input_files(system)},
    }


@contextmanager
def reopened(saved: Mapping[str, Any]) -> Iterator[tuple[System, RunMode]]:
    """The system again; what it unpacked from packages is there within the ``with``.

    Raises:
        ConfigurationError: it cannot be read any more, or a file of its inputs has changed.
        ResultsError: it is malformed.
    """
    try:
        path, base = Path(saved["path"]), Path(saved["base"])
        mode = RunMode(**saved["mode"])
        if saved["unpacked"] is None:
            yield _system(saved["tables"], saved, base), mode
            return
        with open_system(path) as opened:
            tables = _unpacked_again(saved["tables"], Path(saved["unpacked"]), opened)
            yield _system(tables, saved, opened.base, places=opened.places), mode
    except (KeyError, TypeError) as error:
        raise ResultsError(f"the checkpoint is malformed: {error!r}") from error


def programs(system: System) -> list[str]:
    """The models and functions that a system runs, with the slaves and inputs that they are for."""
    models = [f"{name}: {s.model}" for name, s in system.slaves.items() if s.model is not None]
    settings = {n: v for n, v in system.inputs.items() if isinstance(v, InputSettings)}
    return models + [f"{n}: {v.function}" for n, v in settings.items() if v.function is not None]


def check_models(saved: Mapping[str, Any], descriptions: Mapping[str, SlaveDescription]) -> None:
    """Refuse models that are not those with which the run began.

    Raises:
        ConfigurationError: one has changed.
    """
    for name, description in descriptions.items():
        if description.sha256 != saved["models"].get(name):
            raise ConfigurationError(
                f"the model {description.model} is not the one with which the run began",
                slave=name,
                phase="resume",
                remedy="put the old file in its place, or run the system again from its start",
            )


def _unpacked_again(tables: Mapping[str, Any], before: Path, opened: System) -> dict[str, Any]:
    """The tables with the models of packages where they are this time."""
    return {
        **tables,
        "slaves": {
            name: slave | _model_again(slave, before, opened.unpacked)
            for name, slave in tables["slaves"].items()
        },
    }


def _model_again(slave: Mapping[str, Any], before: Path, now: Path | None) -> dict[str, str]:
    model = Path(slave.get("model", ""))
    if now is None or not model.is_relative_to(before):
        return {}
    return {"model": str(now / model.relative_to(before))}


def _system(tables: Mapping[str, Any], saved: Mapping[str, Any], base: Path, **more: Any) -> System:
    system = System(**tables, base=base, source=saved["source"], **more)
    for path, hash_ in saved["files"].items():
        if _sha256(base / path) != hash_:
            raise ConfigurationError(
                f"{path} is not as it was when the run began",
                phase="resume",
                remedy="put the old file in its place, or run the system again from its start",
            )
    return system


def _input_files(system: System) -> list[str]:
    """Tables, and Python files with functions, relative to the system's base."""
    settings = [value for value in system.inputs.values() if isinstance(value, InputSettings)]
    return sorted({name for value in settings if (name := value.file(system.base))})


def _sha256(path: Path) -> str:
    try:
        return file_sha256(path)
    except OSError:
        return ""
