"""Packages and system structure descriptions (SSD), read with all they refer to."""

from __future__ import annotations

import posixpath
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, urlsplit
from zipfile import ZipFile, ZipInfo

from master_node.system.ssp.definitions import Definitions, read_connector, read_definitions
from master_node.system.ssp.parameters import (
    MappingEntry,
    check_version,
    mapped,
    read_mapping,
    read_parameter_set,
)
from master_node.system.ssp.structure import (
    Binding,
    Component,
    ConnectionElement,
    Connector,
    Dictionary,
    DictionaryReference,
    Notes,
    Parameter,
    Structure,
    SystemElement,
)
from master_node.system.ssp.transformations import read_transformation
from master_node.system.ssp.xml_nodes import Node, as_integer, boolean, number, parse
from protocol.errors import ModelError
from protocol.host.archives import MAX_TOTAL_BYTES, MAX_XML_BYTES, checked_archive
from protocol.host.files import is_fmu
from protocol.text.names import listed, nearest

SETTINGS_ANNOTATION = "org.doublestep.system"
SETTINGS_ELEMENT = "urn:doublestep:system"
"""Namespace of the element in that annotation, whose text is TOML."""

DEFAULT_SSD = "SystemStructure.ssd"
FMU_TYPE = "application/x-fmu-sharedlibrary"
SSD_TYPE = "application/x-ssp-definition"
SSP_TYPE = "application/x-ssp-package"
SSV_TYPE = "application/x-ssp-parameter-set"
SSM_TYPE = "application/x-ssp-parameter-mapping"
SSB_TYPE = "application/x-ssp-signal-dictionary"

MAX_DEPTH = 32
MAX_ELEMENTS = 10_000
MAX_PACKAGES = 100
_ELEMENTS = ("ssd:Component", "ssd:SignalDictionaryReference", "ssd:System")
_KINDS = {
    *("input", "output", "parameter", "calculatedParameter", "inout"),
    *("structuralParameter", "constant", "local", "unspecified"),
}


def read_structure(path: Path, scratch: Path, notes: Notes, variant: str = "") -> Structure:
    """Read an ``.ssp`` or ``.ssd`` file with all that it refers to.

    Args:
        path: the file.
        scratch: an existing empty directory. A package is extracted into it, nested packages
            into folders of it; models are there as long as it lives.
        notes: for what is not carried.
        variant: name of the description in a package; "": ``SystemStructure.ssd``.

    Raises:
        ModelError: an archive or a document is missing, cannot be read, or is unsafe.
        ConfigurationError: something in a document is wrong or not supported, with file and line.
    """
    reader = _Reader(scratch, notes)
    if path.suffix.lower() == ".ssd":
        return reader.document(_Place(path.absolute().parent, path.name, str(path.parent)))
    description = reader.extract(path, scratch, variant)
    structure = reader.document(_Place(scratch, description, str(path)))
    reader.tell_loose()
    return structure


@dataclass(frozen=True, slots=True)
class _Place:
    """A file of a package or below a folder.

    Attributes:
        root: directory of the extracted package, or of the SSD.
        file: relative to it.
        shown: what to call ``root`` in messages.
    """

    root: Path
    file: str
    shown: str

    @property
    def path(self) -> Path:
        return self.root / self.file

    def __str__(self) -> str:
        return f"{self.shown}/{self.file}"

    def refer(self, node: Node, uri: str) -> tuple[_Place, str]:
        """The file that a URI means, relative to this one, and the URI's fragment."""
        parts = urlsplit(uri)
        name = unquote(parts.path).replace("\\", "/")
        if parts.scheme or parts.netloc or parts.query:
            raise node.error(
                f"source {uri!r:.200} is not a relative URI",
                "put the file into the package, or beside the SSD",
            )
        joined = posixpath.normpath(posixpath.join(posixpath.dirname(self.file), name))
        if (
            name.startswith("/")
            or ".." in PurePosixPath(joined).parts
            or any(character in name for character in ":\0")
        ):
            raise node.error(f"source {uri!r:.200} leads outside the folder of the SSD")
        return replace(self, file=joined), unquote(parts.fragment)


class _Reader:
    def __init__(self, scratch: Path, notes: Notes) -> None:
        self._scratch = scratch
        self._notes = notes
        self._loose: dict[tuple[Path, str], Path] = {}
        self._used: set[Path] = set()
        self._packages = 0
        self._elements = 0
        self._room = MAX_TOTAL_BYTES

    def extract(self, package: Path, directory: Path, variant: str = "") -> str:
        """Extract what a system can refer to, and give the name of the description to read.

        FMUs belong into ``resources``, and tools put them elsewhere too.

        Args:
            package: the file.
            directory: an existing empty one.
            variant: name of the description; "": the default one.
        """
        with checked_archive(package, "SSP") as archive:
            for entry in archive.infolist():
                folder, slash, _ = entry.filename.partition("/")
                is_description = not slash and entry.filename.lower().endswith(".ssd")
                if entry.is_dir() or (slash and folder == "documentation"):
                    continue
                self._unpack(package, archive, entry, directory)
                if not is_description and folder != "resources":
                    self._loose[package, entry.filename] = directory / entry.filename
            names = archive.namelist()
        variants = [n for n in names if "/" not in n and n.lower().endswith(".ssd")]
        wanted = variant or DEFAULT_SSD
        others = [name for name in variants if name != wanted]
        choice = f"{listed(others)}; choose one as {package.name}#{others[0]}" if others else ""
        if wanted not in variants:
            what = (
                f"{package} holds no {wanted!r:.200}"
                if variant
                else (f"{package}: not an SSP: it holds no {DEFAULT_SSD}")
            )
            raise ModelError(f"{what}, but {choice}" if choice else what)
        if others:
            self._notes.tell(f"{package}: variants beside {wanted}: {choice}")
        return wanted

    def tell_loose(self) -> None:
        """Name what lies outside of ``resources`` and is not part of the system."""
        loose: dict[Path, list[str]] = {}
        for (package, name), path in self._loose.items():
            if not any(path == used or used in path.parents for used in self._used):
                loose.setdefault(package, []).append(name)
        for package, names in loose.items():
            self._notes.tell(f"{package}: entries that are not carried: {listed(names)}")

    def document(self, place: _Place, depth: int = 0) -> Structure:
        """A system structure description."""
        root = self._parse(place, "ssd:SystemStructureDescription")
        check_version(root)
        root.attribute("name")
        definitions = read_definitions(root, "ssd")
        system = root.child("ssd:System")
        if system is None:
            raise root.error("holds no ssd:System")
        settings = _settings(root)
        experiment = root.child("ssd:DefaultExperiment")
        start_time = stop_time = None
        if experiment is not None:
            if experiment.has("startTime"):
                start_time = number(experiment, "startTime")
            if experiment.has("stopTime"):
                stop_time = number(experiment, "stopTime")
            if stop_time is not None and not (start_time or 0.0) < stop_time:
                raise experiment.error(
                    f"stopTime {stop_time!r} is not after startTime {start_time or 0.0!r}"
                )
            experiment.done()
        read = _Document(self, place, root, definitions).system(system, depth)
        root.done()
        return Structure(read, start_time, stop_time, settings)

    def nested(self, node: Node, place: _Place, depth: int) -> SystemElement:
        """The system of a description that a component refers to, without its experiment."""
        structure = self.document(place, depth + 1)
        times = (structure.start_time, structure.stop_time)
        if structure.settings or times != (None, None):
            self._notes.tell(
                f"{node.place}: settings and default experiment of {place} are not carried: "
                "those of the outer system hold"
            )
        return structure.system

    def package(self, node: Node, place: _Place, fragment: str) -> _Place:
        """A nested package, extracted; gives the description in it."""
        if fragment and ("/" in fragment or not fragment.lower().endswith(".ssd")):
            raise node.error(f"{fragment!r:.200} does not name an SSD of the package")
        directory = self._directory(node)
        self._used.add(place.path)
        return _Place(directory, self.extract(place.path, directory, fragment), str(place))

    def inside(self, node: Node, fmu: _Place, uri: str) -> _Place:
        """A file in an FMU, extracted; the URI is relative to the root of the FMU."""
        if fmu.path.is_dir():
            place, _ = _Place(fmu.path, "", str(fmu)).refer(node, uri)
            return place
        directory = self._directory(node)
        place, _ = _Place(directory, "", str(fmu)).refer(node, uri)
        with checked_archive(fmu.path, "FMU") as archive:
            if place.file not in archive.namelist():
                raise node.error(f"{fmu} holds no {place.file!r:.200}")
            self._unpack(fmu.path, archive, archive.getinfo(place.file), directory)
        return place

    def _unpack(self, package: Path, archive: ZipFile, entry: ZipInfo, directory: Path) -> None:
        """Extract an entry, as long as all nested packages together stay within the limit."""
        self._room -= entry.file_size
        if self._room < 0:
            raise ModelError(
                f"{package}: entry {entry.filename!r:.200}: all packages together unpack to more "
                f"than {MAX_TOTAL_BYTES} bytes"
            )
        archive.extract(entry, directory)

    def _directory(self, node: Node) -> Path:
        """A new one for what is extracted."""
        self._packages += 1
        if self._packages > MAX_PACKAGES:
            raise node.error(f"more than {MAX_PACKAGES} packages, or files in FMUs, are needed")
        directory = self._scratch / "packages" / str(self._packages)
        directory.mkdir(parents=True)
        return directory

    def count(self, node: Node, depth: int) -> None:
        """Bound what references to systems can grow to."""
        self._elements += 1
        if depth > MAX_DEPTH or self._elements > MAX_ELEMENTS:
            raise node.error(
                f"the system has more than {MAX_ELEMENTS} elements, or is deeper than {MAX_DEPTH}",
                "look for a system that refers to itself",
            )

    def parameter_set(self, place: _Place) -> tuple[Parameter, ...]:
        return read_parameter_set(self._parse(place, "ssv:ParameterSet"))

    def mapping(self, place: _Place) -> tuple[MappingEntry, ...]:
        return read_mapping(self._parse(place, "ssm:ParameterMapping"))

    def dictionary(self, place: _Place) -> dict[str, Connector]:
        return _entries(self._parse(place, "ssb:SignalDictionary"))

    def tell(self, sentence: str) -> None:
        self._notes.tell(sentence)

    def binding(
        self,
        node: Node,
        parameters: tuple[Parameter, ...],
        mapping: tuple[MappingEntry, ...] | None,
    ) -> Binding:
        """Prefix and mapping applied to the parameters of a source."""
        prefix = node.attribute("prefix")
        parameters = tuple(replace(p, name=prefix + p.name) for p in parameters)
        if mapping is not None:
            parameters = mapped(parameters, mapping, node.place, self._notes)
        return Binding(parameters, node.place)

    def fmu(self, node: Node, place: _Place, fragment: str) -> Path:
        """The FMU that a component refers to: a file, or the folder of one that is unpacked."""
        if fragment or not is_fmu(place.file, place.root):
            raise node.error(f"{place} is not an .fmu file", "rename it, and its source too")
        if not place.path.exists():
            raise ModelError(f"{node.place}: {place}: no such file{self._beside(place)}")
        self._used.add(place.path)
        return place.path

    @staticmethod
    def _beside(place: _Place) -> str:
        """FMUs of the package with names like that of one that is missing."""
        found = (path for pattern in ("*.fmu", "*/*.fmu") for path in place.root.glob(pattern))
        return nearest(place.file, (path.relative_to(place.root).as_posix() for path in found))

    def _parse(self, place: _Place, root: str) -> Node:
        self._used.add(place.path)
        try:
            size = place.path.stat().st_size
            if size > MAX_XML_BYTES:
                raise ModelError(f"{place} of {size} bytes; limit {MAX_XML_BYTES}")
            xml = place.path.read_bytes()
        except OSError as error:
            raise ModelError(f"{place}: cannot be read: {error.strerror}") from None
        return parse(xml, str(place), root, self._notes)


@dataclass(frozen=True)
class _Document:
    """One SSD while it is read."""

    reader: _Reader
    place: _Place
    root: Node
    definitions: Definitions

    def system(self, node: Node, depth: int) -> SystemElement:
        self.reader.count(node, depth)
        name = node.required("name")
        connectors = self._connectors(node)
        bindings = self._bindings(node)
        elements: dict[str, Component | DictionaryReference | SystemElement] = {}
        container = node.child("ssd:Elements")
        for child in _children(container, *_ELEMENTS):
            element = self._element(child, depth + 1)
            if element.name in elements:
                raise child.error(f"there are two elements {element.name!r}")
            elements[element.name] = element
        if container is not None:
            container.done()
        connections = node.child("ssd:Connections")
        read = tuple(self._connection(c) for c in _children(connections, "ssd:Connection"))
        if connections is not None:
            connections.done()
        dictionaries = self._dictionaries(node.child("ssd:SignalDictionaries"))
        node.done()
        return SystemElement(name, connectors, elements, read, dictionaries, bindings, node.place)

    def _element(self, node: Node, depth: int) -> Component | DictionaryReference | SystemElement:
        match node.name:
            case "ssd:Component":
                return self._component(node, depth)
            case "ssd:SignalDictionaryReference":
                self.reader.count(node, depth)
                reference = DictionaryReference(
                    name=node.required("name"),
                    dictionary=node.required("dictionary"),
                    connectors=self._connectors(node),
                    bindings=self._bindings(node),
                    place=node.place,
                )
                node.done()
                return reference
        return self.system(node, depth)

    def _dictionaries(self, node: Node | None) -> dict[str, Dictionary]:
        dictionaries: dict[str, Dictionary] = {}
        for child in _children(node, "ssd:SignalDictionary"):
            name = child.required("name")
            if name in dictionaries:
                raise child.error(f"there are two signal dictionaries {name!r}")
            place = self._source(child, SSB_TYPE)
            if place is not None:
                entries = self.reader.dictionary(place)
                child.done()
            else:
                entries = _entries(_inline(child, "ssb:SignalDictionary"))
            dictionaries[name] = Dictionary(name, entries, child.place)
        if node is not None:
            node.done()
        return dictionaries

    def _component(self, node: Node, depth: int) -> Component | SystemElement:
        name = node.required("name")
        kind = node.attribute("type", FMU_TYPE).partition(";")[0].strip()
        if kind not in (FMU_TYPE, SSD_TYPE, SSP_TYPE):
            raise node.error(
                f"component {name!r} of type {kind!r:.100} is not supported",
                "export it as an FMU",
            )
        if not node.has("source"):
            raise node.error(f"component {name!r} has no source", "add the FMU that it stands for")
        source = node.required("source")
        implementation = node.attribute("implementation", "any")
        if implementation == "ModelExchange":
            self.reader.tell(
                f"{node.place}: {name!r} asks for ModelExchange; what its FMU offers is taken"
            )
        elif implementation not in ("any", "CoSimulation"):
            raise node.error(f"implementation {implementation!r:.60} is not supported")
        connectors = self._connectors(node)
        target, fragment = self.place.refer(node, source)
        bindings = self._bindings(node, target if kind == FMU_TYPE else None)
        if kind == FMU_TYPE:
            self.reader.count(node, depth)
            component = Component(
                name, self.reader.fmu(node, target, fragment), connectors, bindings, node.place
            )
            node.done()
            return component
        system = self._referred(node, kind, target, fragment, depth)
        for connector in connectors:
            if connector not in system.connectors:
                self.reader.tell(
                    f"{connectors[connector].place}: connector {connector!r} of {name!r} is not "
                    f"one of the system that it refers to{nearest(connector, system.connectors)}"
                )
        node.done()
        return replace(system, name=name, bindings=(*system.bindings, *bindings))

    def _referred(
        self, node: Node, kind: str, target: _Place, fragment: str, depth: int
    ) -> SystemElement:
        if kind == SSP_TYPE:
            return self.reader.nested(node, self.reader.package(node, target, fragment), depth)
        if target.path.is_dir() and fragment:  # a source of nothing but a fragment
            system = self.root.with_id(fragment)
            if system is None:
                raise node.error(f"no ssd:System has the id {fragment!r:.100}")
            return self.system(system, depth + 1)
        if fragment:
            raise node.error(f"fragment {fragment!r:.100} of another SSD is not supported")
        return self.reader.nested(node, target, depth)

    def _connectors(self, node: Node) -> dict[str, Connector]:
        connectors: dict[str, Connector] = {}
        container = node.child("ssd:Connectors")
        for child in _children(container, "ssd:Connector"):
            connector = self._connector(child)
            first = connectors.setdefault(connector.name, connector)
            if first is connector:
                continue
            if first != replace(connector, place=first.place):
                raise child.error(f"there are two connectors {connector.name!r}")
            child.tell(f"connector {connector.name!r} is there twice")
        if container is not None:
            container.done()
        return connectors

    def _connector(self, node: Node) -> Connector:
        kind = node.required("kind")
        if kind not in _KINDS:
            raise node.error(f"kind {kind!r:.60} is not known")
        connector = read_connector(node, kind, self.definitions)
        node.done()
        return connector

    def _connection(self, node: Node) -> ConnectionElement:
        connection = ConnectionElement(
            start=_end(node, "start"),
            end=_end(node, "end"),
            start_indices=_indices(node, "startIndices"),
            end_indices=_indices(node, "endIndices"),
            transformation=read_transformation(node),
            suppress_unit_conversion=boolean(node, "suppressUnitConversion", "false"),
            place=node.place,
        )
        node.done()
        return connection

    def _bindings(self, node: Node, fmu: _Place | None = None) -> tuple[Binding, ...]:
        container = node.child("ssd:ParameterBindings")
        bindings = tuple(
            self._binding(child, fmu) for child in _children(container, "ssd:ParameterBinding")
        )
        if container is not None:
            container.done()
        return bindings

    def _binding(self, node: Node, fmu: _Place | None) -> Binding:
        place = self._source(node, SSV_TYPE, fmu)
        if place is not None:
            parameters = self.reader.parameter_set(place)
        else:
            parameters = read_parameter_set(
                _inline(node.child("ssd:ParameterValues") or node, "ssv:ParameterSet")
            )
        mapping = None
        element = node.child("ssd:ParameterMapping")
        if element is not None:
            place = self._source(element, SSM_TYPE, fmu)
            mapping = (
                self.reader.mapping(place)
                if place is not None
                else read_mapping(_inline(element, "ssm:ParameterMapping"))
            )
            element.done()
        binding = self.reader.binding(node, parameters, mapping)
        node.done()
        return binding

    def _source(self, node: Node, type_: str, fmu: _Place | None = None) -> _Place | None:
        """The file that an element refers to, None if its content stands inline.

        Args:
            node: the element.
            type_: the only one that can be read.
            fmu: of the component that the element belongs to.
        """
        given = node.attribute("type", type_)
        if given != type_:
            raise node.error(f"type {given!r:.100} is not supported", f"give it as {type_}")
        if not node.has("source"):
            return None
        source, base = node.required("source"), node.attribute("sourceBase", "SSD")
        if base == "SSD":
            place, _ = self.place.refer(node, source)
            return place
        if base == "component" and fmu is not None:
            return self.reader.inside(node, fmu, source)
        raise node.error(
            f"sourceBase = {base!r:.60} is not supported here", "put the file beside the SSD"
        )


def _children(node: Node | None, *names: str) -> list[Node]:
    return node.children(*names) if node is not None else []


def _inline(node: Node, name: str) -> Node:
    child = node.child(name)
    if child is None:
        raise node.error(f"has neither a source nor an {name}")
    node.done()
    return child


def _end(node: Node, which: str) -> tuple[str | None, str]:
    element = node.attribute(f"{which}Element") or None
    return element, node.required(f"{which}Connector")


def _indices(node: Node, name: str) -> tuple[int, ...]:
    indices = tuple(as_integer(node, text, name) for text in node.attribute(name).split())
    if any(index < 1 for index in indices):
        raise node.error(f"{name}: an index below 1", "indices count from 1")
    return indices


def _entries(node: Node) -> dict[str, Connector]:
    """The entries of an ``ssb:SignalDictionary``, by name."""
    check_version(node)
    definitions = read_definitions(node, "ssb")
    entries: dict[str, Connector] = {}
    for child in node.children("ssb:DictionaryEntry"):
        entry = read_connector(child, "", definitions)
        if entry.name in entries:
            raise child.error(f"{entry.name!r} is there twice")
        entries[entry.name] = entry
        child.done()
    node.done()
    return entries


def _settings(root: Node) -> str:
    """The TOML text in our own annotation; the other annotations are told."""
    settings = ""
    container = root.child("ssd:Annotations")
    for annotation in _children(container, "ssc:Annotation"):
        kind = annotation.required("type")
        if kind == SETTINGS_ANNOTATION:
            element = annotation.child(f"{SETTINGS_ELEMENT}:Settings")
            if element is None:
                raise annotation.error("holds no Settings")
            settings = element.text
            annotation.done()
        else:
            root.count(f"annotation {kind}")
    if container is not None:
        container.done()
    return settings
