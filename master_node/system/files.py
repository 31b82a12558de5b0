"""System files of all kinds: TOML, and SSP packages and descriptions.

`open_system` reads any of them, `import_system` and `export_system` turn one kind into the other.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import tomli_w

from master_node.system.places import SspPlaces
from master_node.system.single import is_model, single_system
from master_node.system.ssp.flattening import FlatConnection, Slave, flatten
from master_node.system.ssp.reading import read_structure
from master_node.system.ssp.structure import Notes, Structure
from master_node.system.ssp.writing import write_package
from master_node.system.system import System, load_system
from protocol.description import SlaveDescription
from protocol.errors import ConfigurationError, DoublestepError
from protocol.host.files import as_file, is_fmu
from protocol.host.new_files import open_new, own_folder
from protocol.host.scratch import ScratchDirectory
from protocol.host.toml_text import parse_toml
from protocol.text.names import listed
from protocol.wire.keys import check_name

log = logging.getLogger("master_node")

_SSP_SUFFIXES = (".ssp", ".ssd")


@dataclass(frozen=True)
class ImportedSystem:
    """Content of an SSP file.

    Attributes:
        system: its models are where they were extracted to.
        notes: a sentence for all that is not carried.
    """

    system: System
    notes: tuple[str, ...]


@contextmanager
def open_system(path: Path | str, *, package_bus: bool = False) -> Iterator[System]:
    """The system in a ``.toml``, ``.ssp`` or ``.ssd`` file, or of one model alone.

    ``package.ssp#Variant.ssd`` is another description of a package than its
    ``SystemStructure.ssd``. The models of a package are extracted into a temporary directory,
    which is removed at the end: run the system within the ``with``. What an SSP file holds that is
    not carried is logged.

    Args:
        path: the file; or an FMU, or ``package.module:Class``, see `single_system`.
        package_bus: take ``[bus]`` from the annotation of an SSP file: to whom it connects, where
            it listens, with which certificates.

    Raises:
        ConfigurationError: the file is missing or wrong, or holds what is not supported.
    """
    path = Path(path)
    if is_model(path):
        yield single_system(path)
        return
    if not is_ssp(path):
        yield load_system(path)
        return
    with ScratchDirectory() as scratch:
        imported = read_ssp(path, scratch, package_bus=package_bus)
        for note in imported.notes:
            log.warning("%s", note)
        try:
            yield imported.system
        except DoublestepError as error:
            package, _ = _package(path)
            error.cause = error.cause.replace(f"{scratch}{os.sep}", f"{package}{os.sep}")
            raise


def is_ssp(path: Path) -> bool:
    """True if the name of a system means a package, a variant in one, or a description."""
    return path.suffix.lower() in _SSP_SUFFIXES


def is_package(path: Path) -> bool:
    """True if the name of a system means a package, or a variant in one."""
    return _package(path)[0].suffix.lower() == ".ssp"


def _package(path: Path) -> tuple[Path, str]:
    """The file that a name means, and the variant in it; "" where none is said."""
    name, mark, variant = path.name.rpartition("#")
    if mark and name.lower().endswith(".ssp") and not path.exists():
        return path.with_name(name), variant
    return path, ""


def read_ssp(path: Path, scratch: Path, *, package_bus: bool = False) -> ImportedSystem:
    """The system in an ``.ssp`` or ``.ssd`` file.

    Args:
        path: the file, or ``package.ssp#Variant.ssd``.
        scratch: an existing empty directory, into which packages are extracted.
        package_bus: as for `open_system`.

    Raises:
        ConfigurationError: as `open_system`.
    """
    notes = Notes(str(path))
    file, variant = _package(path)
    structure = read_structure(file, scratch, notes, variant)
    load = entry_points(group="doublestep.in_process")["describe"].load()
    describe: Callable[[Path], SlaveDescription] = cache(lambda fmu: load(str(fmu), Path()))
    slaves, connections = flatten(structure.system, describe, notes)
    base = scratch if is_package(path) else path.absolute().parent
    tables = _settings(structure, path, notes, package_bus=package_bus)
    unknown = sorted(tables["slaves"].keys() - {slave.name for slave in slaves})
    if unknown:
        raise ConfigurationError(f"{path}: the annotation has settings of {unknown[0]!r}, no slave")
    more = {name: tables[name] for name in ("inputs", "results") if tables[name]}
    system = System(
        **more,
        simulation=tables["simulation"],
        slaves={slave.name: _slave(slave, base, tables["slaves"], path) for slave in slaves},
        connections=tuple(connection.table for connection in connections),
        bus=tables["bus"],
        base=base,
        source=str(path),
        places=_places(path, slaves, connections),
        unpacked=scratch,
    )
    return ImportedSystem(system, notes.sentences())


def import_system(path: Path, output: Path, *, package_bus: bool = False) -> tuple[str, ...]:
    """Write an ``.ssp`` or ``.ssd`` file, or a variant of a package, as a TOML file.

    FMUs out of packages are copied to a folder beside it, named after it with ``_models``; what
    is there of these names is replaced.

    Args:
        path: the file.
        output: the TOML file.
        package_bus: as for `open_system`.

    Returns:
        A sentence for all that is not carried.

    Raises:
        ConfigurationError: as `open_system`, or a file cannot be written.
    """
    _check_suffix(path, *_SSP_SUFFIXES)
    _check_suffix(output, ".toml")
    with ScratchDirectory() as scratch:
        imported = read_ssp(path, scratch, package_bus=package_bus)
        system = imported.system
        names = _file_names(system)
        tables = _tables(system)
        folder = output.parent / f"{output.stem}_models"
        try:
            for name in system.slaves:
                model = system.base / str(system.slaves[name].model)
                if model.is_relative_to(scratch):
                    own_folder(folder)
                    with (
                        as_file(model) as file,
                        file.open("rb") as source,
                        open_new(folder / names[name]) as target,
                    ):
                        shutil.copyfileobj(source, target)
                    model = folder / names[name]
                relative = os.path.relpath(model, output.parent)
                tables["slaves"][name]["model"] = Path(relative).as_posix()
            _replace(output, lambda file: file.write_text(_toml(tables), encoding="utf-8"))
        except OSError as error:
            raise ConfigurationError(f"{output}: cannot be written: {error}") from error
    return imported.notes


def export_system(path: Path, output: Path) -> None:
    """Write a system as an ``.ssp`` package, with its FMUs.

    Raises:
        ConfigurationError: a slave has no FMU, a name is wrong, or a file cannot be written.
    """
    _check_suffix(output, ".ssp")
    describe = entry_points(group="doublestep.in_process")["describe"].load()
    with open_system(path) as system:
        for name, settings in system.slaves.items():
            if settings.model is None or not is_fmu(settings.model, system.base):
                raise ConfigurationError(
                    f"{system.places.slave(name)} has no FMU"
                    + (f" but {settings.model!r}" if settings.model else ""),
                    remedy="only FMUs can be put into an SSP: export the model as one",
                )
        names = _file_names(system)
        try:
            _replace(output, lambda file: write_package(system, names, describe, output.stem, file))
        except OSError as error:
            raise ConfigurationError(f"{output}: cannot be written: {error}") from error


def _places(path: Path, slaves: list[Slave], connections: list[FlatConnection]) -> SspPlaces:
    return SspPlaces(
        str(path),
        {slave.name: slave.place for slave in slaves},
        {
            (slave.name, name): place
            for slave in slaves
            for name, place in slave.parameter_places.items()
        },
        tuple(connection.place for connection in connections),
    )


def _settings(
    structure: Structure, path: Path, notes: Notes, *, package_bus: bool
) -> dict[str, dict[str, Any]]:
    """The tables of our own annotation, with the times of the default experiment."""
    where = f"{path}: the annotation of Doublestep"
    try:
        given = parse_toml(structure.settings)
    except ValueError as error:
        raise ConfigurationError(f"{where} is not TOML: {error}") from None
    names = ("simulation", "slaves", "inputs", "results", "bus")
    tables = {name: given.pop(name, {}) for name in names}
    if given or not all(isinstance(table, dict) for table in tables.values()):
        raise ConfigurationError(f"{where} holds more than {listed(list(names))}")
    for name, value in tables["inputs"].items():
        if not isinstance(value, int | float):  # a function is a program, a table any file
            raise ConfigurationError(f"{where} cannot give [inputs] {name!r} more than a number")
    if tables["bus"].pop("insecure", False):
        notes.tell(
            f"{path}: [bus] insecure = true is not taken from a package; say --insecure if you "
            "trust the network"
        )
    if tables["bus"] and not package_bus:
        notes.tell(
            f"{path}: [bus] {', '.join(tables['bus'])} is not taken from a package; say it "
            "yourself, or say --package-bus if you trust the package with your network"
        )
        tables["bus"] = {}
    if structure.start_time is not None:
        tables["simulation"]["start_time"] = structure.start_time
    if structure.stop_time is not None:
        tables["simulation"]["stop_time"] = structure.stop_time
    return tables


def _slave(slave: Slave, base: Path, settings: dict[str, Any], path: Path) -> dict[str, Any]:
    given = settings.get(slave.name, {})
    if not isinstance(given, dict) or given.keys() & {"model", "parameters"}:
        raise ConfigurationError(
            f"{path}: the annotation of Doublestep cannot give [slaves.{slave.name}] a model or "
            "parameters"
        )
    inside = slave.model.is_relative_to(base)
    model = slave.model.relative_to(base).as_posix() if inside else str(slave.model)
    table: dict[str, Any] = {"model": model}
    if slave.parameters:
        table["parameters"] = dict(slave.parameters)
    return table | given


def _file_names(system: System) -> dict[str, str]:
    """A safe file name for the FMU of each slave; one for slaves that share it."""
    names: dict[Path, str] = {}
    result = {}
    for slave, settings in system.slaves.items():
        model = (system.base / str(settings.model)).resolve()
        if model not in names:
            names[model] = _free_name(model, slave, {name.casefold() for name in names.values()})
        result[slave] = names[model]
    return result


def _free_name(model: Path, slave: str, taken: set[str]) -> str:
    stem = model.stem
    try:
        check_name(stem)
    except ConfigurationError:
        stem = slave
    name, number = f"{stem}.fmu", 1
    while name.casefold() in taken:
        number += 1
        name = f"{stem}_{number}.fmu"
    return name


def _tables(system: System) -> dict[str, Any]:
    """Settings of a system, as plain tables."""
    tables: dict[str, Any] = system.model_dump(
        mode="python", by_alias=True, exclude_unset=True, exclude_none=True
    )
    return tables


def _toml(tables: dict[str, Any]) -> str:
    """A system file, with its tables in the usual order."""
    parts = [{name: tables[name]} for name in ("simulation", "slaves") if tables.get(name)]
    texts = [tomli_w.dumps(part) for part in parts]
    texts += [_connection(table) for table in tables["connections"]]
    texts += [tomli_w.dumps({"actions": [table]}) for table in tables.get("actions", ())]
    texts += [
        tomli_w.dumps({name: tables[name]})
        for name in ("inputs", "results", "bus")
        if tables.get(name)
    ]
    return "\n".join(texts)


def _connection(table: dict[str, Any]) -> str:
    """With an inline table for its mapping, whose keys need not be texts."""
    mapping = table.pop("mapping", {})
    text = f"[[connections]]\n{tomli_w.dumps(table)}"
    entries = ", ".join(f"{_entry(key)} = {_entry(value)}" for key, value in mapping.items())
    return f"{text}mapping = {{ {entries} }}\n" if mapping else text


def _entry(value: bool | int | str) -> str:
    return json.dumps(value) if isinstance(value, str) else str(value).lower()


def _replace(output: Path, write: Callable[[Path], object]) -> None:
    """Write a file beside ``output`` and put it in its place when it is whole."""
    part = output.with_name(f".{output.name}.part")
    try:
        part.unlink(missing_ok=True)  # a link would be followed
        write(part)
        part.replace(output)
    finally:
        part.unlink(missing_ok=True)


def _check_suffix(path: Path, *suffixes: str) -> None:
    if path.suffix.lower() not in suffixes:
        raise ConfigurationError(f"{path}: must be a file {' or '.join(suffixes)}")
