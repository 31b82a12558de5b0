"""Several hosts on one machine: network namespaces on a bridge, with cables that can be pulled.

Needs Linux, root and iproute2; `unavailable` says what is missing.
"""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from secrets import token_hex

_BOUND = 10.0


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, timeout=_BOUND)


@functools.cache
def unavailable() -> str:
    """Why there cannot be network namespaces here; empty when there can."""
    if sys.platform != "linux":
        return "network namespaces are a thing of Linux"
    if shutil.which("ip") is None:
        return "needs the command ip (package iproute2)"
    if os.geteuid() != 0:
        return "needs root for network namespaces"
    try:
        with hosts_on_a_bridge(["probe"]):
            return ""
    except (subprocess.SubprocessError, OSError) as error:
        return f"network namespaces cannot be made here: {error}"


@dataclass(frozen=True)
class Hosts:
    """Hosts with an address each, all on one bridge.

    Attributes:
        mark: what the names of these namespaces begin with.
        addresses: by the name of the host.
    """

    mark: str
    addresses: dict[str, str]

    def prefix(self, host: str) -> list[str]:
        """Words before a command that run it on ``host``."""
        return ["ip", "netns", "exec", f"{self.mark}-{host}"]

    def cut(self, host: str) -> None:
        """Pull the cable: what is sent to or by ``host`` is lost, and nobody is told."""
        _ip("-n", f"{self.mark}-bridge", "link", "set", "dev", host, "down")

    def heal(self, host: str) -> None:
        """Put it back."""
        _ip("-n", f"{self.mark}-bridge", "link", "set", "dev", host, "up")


@contextmanager
def hosts_on_a_bridge(names: Sequence[str]) -> Iterator[Hosts]:
    """Make the hosts; nothing of them is left afterwards.

    Args:
        names: of the hosts, short, as they also name network interfaces.

    Raises:
        SubprocessError: the system refuses.
    """
    mark = f"ds{token_hex(3)}"
    bridge = f"{mark}-bridge"
    addresses = {name: f"10.77.0.{number}" for number, name in enumerate(names, 1)}
    made = []
    try:
        for namespace in (bridge, *(f"{mark}-{name}" for name in names)):
            _ip("netns", "add", namespace)
            made.append(namespace)
            _ip("-n", namespace, "link", "set", "lo", "up")
        _ip("-n", bridge, "link", "add", "br0", "type", "bridge")
        _ip("-n", bridge, "link", "set", "br0", "up")
        for name, address in addresses.items():
            host = f"{mark}-{name}"
            _ip(
                "-n",
                host,
                "link",
                "add",
                "eth0",
                "type",
                "veth",
                "peer",
                "name",
                name,
                "netns",
                bridge,
            )
            _ip("-n", bridge, "link", "set", "dev", name, "master", "br0")
            _ip("-n", bridge, "link", "set", "dev", name, "up")
            _ip("-n", host, "address", "add", f"{address}/24", "dev", "eth0")
            _ip("-n", host, "link", "set", "eth0", "up")
        yield Hosts(mark, addresses)
    finally:
        for namespace in made:
            _ip("netns", "del", namespace)
