"""``slave-node check`` as a service manager uses it: real processes, over a router and without."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from protocol.bus.bus import InProcessBus
from protocol.bus.credentials import Role
from protocol.errors import SlaveLostError
from protocol.wire.keys import RouterKey, SlaveKey
from slave_node.certificates import Host, make_certificates
from slave_node.serving.health import check_alive
from tests.support.quarter_car_case import EXAMPLES
from tests.support.waiting import BOUND, wait_until

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="uses signals"),
    pytest.mark.usefixtures("no_process_left"),
]


Start = Callable[..., subprocess.Popen[bytes]]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """``start("router", ...)`` is ``slave-node router ...``, once it says that it is ready."""
    started: list[subprocess.Popen[bytes]] = []

    def start_command(*words: str) -> subprocess.Popen[bytes]:
        log = tmp_path / f"{len(started)}.log"
        with log.open("wb") as file:
            process = subprocess.Popen(
                [sys.executable, "-m", "slave_node", *words],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
            )
        started.append(process)
        wait_until(lambda: " ready: " in log.read_text() or process.poll() is not None)
        assert process.poll() is None, log.read_text()
        return process

    yield start_command
    for process in reversed(started):
        process.terminate()
        process.wait(BOUND)


def check(*words: str) -> tuple[int, str]:
    """``slave-node check``: exit code and what it says."""
    done = subprocess.run(
        [sys.executable, "-m", "slave_node", "check", *words],
        capture_output=True,
        text=True,
        timeout=BOUND,
        check=False,
    )
    return done.returncode, done.stderr


def test_a_slave_is_healthy_from_when_it_serves_to_when_it_ends(
    start: Start, endpoint: str
) -> None:
    """Through a router: exit code 0 while the token is there, 3 before and after."""
    at = ("--connect", endpoint)
    code, text = check("wheel", *at, "--timeout", "0.5")
    assert code == 3
    assert "no connection" in text
    start("router", "--listen", endpoint)
    assert check(*at) == (0, "")
    code, text = check("wheel", *at)
    assert code == 3
    assert "slave-node: wheel: check: is not on the bus; found there: no slave at all" in text
    model = f"{EXAMPLES / 'quarter_car.py'}:Wheel"
    slave = start("serve", model, "--name", "wheel", *at, "--mode", "client")
    assert check("wheel", *at) == (0, "")
    code, text = check("weel", *at)
    assert code == 3
    assert "found there: wheel" in text
    slave.send_signal(signal.SIGTERM)
    assert slave.wait(BOUND) == 0
    assert check("wheel", *at)[0] == 3


def test_a_slave_that_listens_is_asked_itself(start: Start, endpoint: str) -> None:
    """Without a router; and there is none then."""
    model = f"{EXAMPLES / 'quarter_car.py'}:Wheel"
    start("serve", model, "--name", "wheel", "--listen", endpoint)
    assert check("wheel", "--connect", endpoint) == (0, "")
    assert check("--connect", endpoint)[0] == 3


def test_with_certificates_only_who_has_one_is_answered(
    start: Start, endpoint: str, tmp_path: Path
) -> None:
    """A router and a slave with TLS: healthy to who has their roles, out of reach without."""
    host = Host("here", ("127.0.0.1",))
    make_certificates(tmp_path / "lab", [host], [Role.ROUTER, Role.SLAVE], days=1)
    tls = ("--tls", str(tmp_path / "lab" / "here"))
    start("router", "--listen", endpoint, *tls)
    model = f"{EXAMPLES / 'quarter_car.py'}:Wheel"
    start("serve", model, "--name", "wheel", "--connect", endpoint, "--mode", "client", *tls)
    assert check("wheel", "--connect", endpoint, *tls) == (0, "")
    assert check("--connect", endpoint, *tls) == (0, "")
    assert check("chassis", "--connect", endpoint, *tls)[0] == 3
    code, text = check("wheel", "--connect", endpoint, "--timeout", "0.5")
    assert (code, "TLS" in text) == (2, True)


def test_what_cannot_be_asked_for_is_refused() -> None:
    """Exit code 2: a name that is a pattern, an address beyond loopback."""
    assert check("*")[0] == 2
    code, text = check("wheel", "--connect", "tcp/10.0.0.1:7447")
    assert code == 2
    assert "is not a loopback address" in text


def test_the_token_decides() -> None:
    """Law: alive means that this token is up, whoever else is there."""
    bus = InProcessBus()
    for name in ("wheel", ""):
        with pytest.raises(SlaveLostError):
            check_alive(bus, name)
    key = SlaveKey("wheel", "0001")
    bus.announce(key.alive)
    check_alive(bus, "wheel")
    with pytest.raises(SlaveLostError, match="no router"):
        check_alive(bus, "")
    with pytest.raises(SlaveLostError, match="found there: wheel"):
        check_alive(bus, "chassis")
    bus.withdraw(key.alive)
    with pytest.raises(SlaveLostError):
        check_alive(bus, "wheel")
    bus.announce(RouterKey("0002").alive)
    check_alive(bus, "")
