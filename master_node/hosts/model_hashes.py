"""The models of the slaves against the hashes that the user gave."""

from __future__ import annotations

from collections.abc import Mapping

from master_node.system.system import System
from protocol.description import SlaveDescription
from protocol.errors import ConfigurationError


def check_hashes(system: System, descriptions: Mapping[str, SlaveDescription]) -> None:
    """A slave that was given a ``sha256`` must run the file that has it.

    Raises:
        ConfigurationError: it runs another one, such as an old version on another host.
    """
    for name, settings in system.slaves.items():
        description = descriptions[name]
        if settings.sha256 is not None and settings.sha256 != description.sha256:
            raise ConfigurationError(
                f"{system.source}: [slaves.{name}] sha256 = {settings.sha256!r}: its model "
                f"{description.model} has {description.sha256 or 'none'!r}",
                slave=name,
                phase="describe",
                remedy="serve the right file, or correct the hash (`sha256sum FILE`)",
            )
