"""XML of untrusted documents, read so that nothing in it can be passed over unnoticed.

A `Node` knows which of its attributes and children were asked for; `Node.done` names the rest.
"""

from __future__ import annotations

import math
import re

from lxml import etree

from master_node.system.ssp.structure import Notes
from protocol.errors import ConfigurationError, ModelError
from protocol.host.archives import check_xml

_SSP = "http://ssp-standard.org/SSP1/"
NAMESPACES = {
    "ssc": f"{_SSP}SystemStructureCommon",
    "ssd": f"{_SSP}SystemStructureDescription",
    "ssv": f"{_SSP}SystemStructureParameterValues",
    "ssm": f"{_SSP}SystemStructureParameterMapping",
    "ssb": f"{_SSP}SystemStructureSignalDictionary",
}
"""Namespaces of SSP 1.0; 2.0 has kept them."""

_PREFIXES = {uri: prefix for prefix, uri in NAMESPACES.items()}
_SCHEMA_INSTANCE = "{http://www.w3.org/2001/XMLSchema-instance}"
_QUIET_ATTRIBUTES = {"id", "generationTool", "generationDateAndTime"}
"""They say which element it is and who wrote the file, both of which end with the file."""

_DESCRIPTIVE_ATTRIBUTES = {"description", "author", "fileversion", "copyright", "license"}
_WITHOUT_INFLUENCE = {
    "ssd:ElementGeometry",
    "ssd:SystemGeometry",
    "ssd:ConnectorGeometry",
    "ssd:ConnectionGeometry",
    "ssd:GraphicalElements",
    "ssc:MetaData",
    "ssc:Signature",
    "ssd:MetaData",
    "ssd:Signature",
    "ssv:MetaData",
    "ssv:Signature",
    "ssm:MetaData",
    "ssm:Signature",
    "ssb:MetaData",
    "ssb:Signature",
    "ssd:SSDVariant",
}


def parse(xml: bytes, file: str, root: str, notes: Notes) -> Node:
    """The root of a document.

    Args:
        xml: the document.
        file: what to call it in messages.
        root: the name that its root must have, such as ``ssd:SystemStructureDescription``.
        notes: for what is not carried.

    Raises:
        ModelError: it is too large, no XML, or declares a document type.
        ConfigurationError: it has another root.
    """
    check_xml(file, xml)
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        huge_tree=False,
        remove_comments=True,
        remove_pis=True,
    )
    try:
        element = etree.fromstring(xml, parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        raise ModelError(f"{file} cannot be read: {error}") from None
    node = Node(element, file, notes)
    if node.name != root:
        raise ConfigurationError(
            f"{node.place}: the root is {node.name}, not {root}",
            remedy="export it as SSP 1.0 or 2.0: drafts of the standard cannot be read",
        )
    return node


class Node:
    """An element, with a record of what was read of it."""

    def __init__(self, element: etree._Element, file: str, notes: Notes) -> None:
        self._element = element
        self._file = file
        self._notes = notes
        self._read: set[str] = set()

    @property
    def name(self) -> str:
        """With the usual prefix: ``ssd:System``."""
        qualified = etree.QName(self._element)
        return f"{_PREFIXES.get(qualified.namespace, qualified.namespace)}:{qualified.localname}"

    @property
    def place(self) -> str:
        """File and line."""
        return f"{self._file}, line {self._element.sourceline}"

    @property
    def text(self) -> str:
        """Text between its tags."""
        return self._element.text or ""

    @property
    def is_empty(self) -> bool:
        """True if it has no children."""
        return len(self._element) == 0

    def error(self, cause: str, remedy: str = "") -> ConfigurationError:
        """An error about this element."""
        return ConfigurationError(f"{self.place}: {self.name}: {cause}", remedy=remedy)

    def attribute(self, name: str, default: str = "") -> str:
        """An attribute; ``default`` where it is missing or empty."""
        self._read.add(name)
        return str(self._element.get(name) or default)

    def has(self, name: str) -> bool:
        """True if there is an attribute of that name; tools write empty ones for none."""
        return bool(self.attribute(name))

    def required(self, name: str) -> str:
        """An attribute.

        Raises:
            ConfigurationError: it is missing or empty.
        """
        value = self.attribute(name)
        if not value:
            raise self.error(f"attribute {name!r} is missing")
        return value

    def children(self, *names: str) -> list[Node]:
        """Its children of these names, in order."""
        self._read.update(names)
        return [child for child in self._all_children() if child.name in names]

    def child(self, name: str) -> Node | None:
        """Its child of that name, None if there is none.

        Raises:
            ConfigurationError: there are several.
        """
        found = self.children(name)
        if len(found) > 1:
            raise found[1].error(f"is there twice in {self.name}")
        return found[0] if found else None

    def count(self, name: str) -> None:
        """Note that something without influence is not carried."""
        self._notes.count(name)

    def tell(self, sentence: str) -> None:
        """Note something about this element that its user should know."""
        self._notes.tell(f"{self.place}: {self.name}: {sentence}")

    def with_id(self, identifier: str) -> Node | None:
        """The descendant with that ``id``."""
        for element in self._element.iter(f"{{{NAMESPACES['ssd']}}}System"):
            if element.get("id") == identifier:
                return Node(element, self._file, self._notes)
        return None

    def done(self) -> None:
        """Name everything that was not read.

        Raises:
            ConfigurationError: an element could change what the system does.
        """
        for name in map(str, self._element.attrib):
            if name in self._read | _QUIET_ATTRIBUTES or name.startswith(_SCHEMA_INSTANCE):
                continue
            if name in _DESCRIPTIVE_ATTRIBUTES:
                self._notes.count(name)
            else:
                self._notes.tell(f"{self.place}: {self.name}: attribute {name!r} is not carried")
        for child in self._all_children():
            if child.name in self._read:
                continue
            if child.name in _WITHOUT_INFLUENCE:
                self._notes.count(child.name)
            elif child.name.endswith(":Annotations"):
                for annotation in child._all_children():
                    self._notes.count(f"annotation {annotation._element.get('type')}")
            else:
                raise child.error(
                    f"is not supported in {self.name}", "remove it, or say it in another way"
                )

    def _all_children(self) -> list[Node]:
        return [Node(element, self._file, self._notes) for element in self._element]


def number(node: Node, name: str, default: str = "") -> float:
    """An attribute of type xs:double.

    Raises:
        ConfigurationError: it is missing, no number, or not finite.
    """
    return as_number(node, _given(node, name, default), name)


def integer(node: Node, name: str, default: str = "") -> int:
    """An attribute of an integer type.

    Raises:
        ConfigurationError: it is missing or no whole number.
    """
    return as_integer(node, _given(node, name, default), name)


def boolean(node: Node, name: str, default: str = "") -> bool:
    """An attribute of type xs:boolean.

    Raises:
        ConfigurationError: it is missing, or neither true nor false.
    """
    return as_boolean(node, _given(node, name, default), name)


def as_number(node: Node, text: str, name: str = "value") -> float:
    """``text`` of an attribute of ``node`` as an xs:double.

    Raises:
        ConfigurationError: it is no number, or not finite.
    """
    try:
        value = math.nan if "_" in text else float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise node.error(f"{name} = {text!r:.60} is not a finite number")
    return value


def as_integer(node: Node, text: str, name: str = "value") -> int:
    """``text`` of an attribute of ``node`` as a whole number.

    Raises:
        ConfigurationError: it is none.
    """
    if not re.fullmatch(r"[+-]?[0-9]{1,20}", text):
        raise node.error(f"{name} = {text!r:.60} is not a whole number")
    return int(text)


def as_boolean(node: Node, text: str, name: str = "value") -> bool:
    """``text`` of an attribute of ``node`` as an xs:boolean.

    Raises:
        ConfigurationError: it is neither true nor false.
    """
    if text not in _BOOLEANS:
        raise node.error(f"{name} = {text!r:.60} is neither true nor false")
    return _BOOLEANS[text]


_BOOLEANS = {"true": True, "1": True, "false": False, "0": False}


def _given(node: Node, name: str, default: str) -> str:
    return (node.attribute(name, default) if default else node.required(name)).strip()
