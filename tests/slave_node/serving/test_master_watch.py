"""A master that lives is not thrown out, one that is dead is not waited for: in virtual time."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import pytest

from protocol.bus.bus import AliveListener, Bus, Caller, Handler
from protocol.host.processes import PeerProcess
from protocol.wire.keys import alive_master
from slave_node.serving.master_watch import Master, MasterWatch
from tests.support.virtual_clock import VirtualClock

TOKEN = alive_master("r")
ORPHAN_TIME = 10.0
ELSEWHERE = PeerProcess("elsewhere", 1)


@dataclass
class Tokens(Bus):
    """A bus that answers as it is told to; an answer takes a second."""

    clock: VirtualClock
    answers: list[bool] = field(default_factory=list)
    meanwhile: Callable[[], None] = lambda: None
    questions: int = 0
    tell: AliveListener = lambda *_: None

    def alive(self, pattern: str, timeout: float) -> list[str]:
        self.questions += 1
        self.clock.sleep(timeout)
        self.meanwhile()
        return [pattern] if self.answers and self.answers.pop(0) else []

    def watch(self, pattern: str, listener: AliveListener) -> None:
        self.tell = listener

    def caller(self, key: str, timeout: float) -> Caller:
        raise NotImplementedError

    def serve(self, key: str, handler: Handler) -> None:
        raise NotImplementedError

    def serve_here(self, key: str, handler: Handler, ready: Callable[[], None]) -> None:
        raise NotImplementedError

    def announce(self, key: str) -> None:
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError


class World:
    """A watch on a bus, and when it called which master gone."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.bus = Tokens(self.clock)
        self.gone: list[tuple[str, float]] = []
        self.watch = MasterWatch[str](self.bus, self.clock, self._is_gone)
        self.watch.start()

    def _is_gone(self, key: str) -> None:
        self.gone.append((key, self.clock.monotonic()))

    def follow(self, process: PeerProcess = ELSEWHERE, orphan_time: float = ORPHAN_TIME) -> None:
        """Follow the master of run r."""
        self.watch.follow("key", Master("r", process, orphan_time))

    def run(self, main: Callable[[], object], seconds: float = 100.0) -> None:
        """Let it happen, and so much time pass."""

        def whole() -> None:
            main()
            self.clock.sleep(seconds)

        self.clock.run(whole, limit=2.0 * seconds)


@pytest.fixture
def world() -> Iterator[World]:
    """An empty one."""
    made = World()
    yield made
    made.clock.close()


def test_a_master_whose_token_is_known_is_never_asked_for(world: World) -> None:
    """However busy the host is on which it claims."""
    world.bus.tell(TOKEN, True)
    world.run(world.follow, 1000.0)
    assert (world.gone, world.bus.questions) == ([], 0)


@pytest.mark.parametrize("empty", [1, 2])
def test_one_empty_answer_is_no_death(world: World, empty: int) -> None:
    """A master of whom the bus has not told yet: answers come too late at first."""
    world.bus.answers = [False] * empty + [True]
    world.run(world.follow)
    assert (world.gone, world.bus.questions) == ([], empty + 1)


def test_a_master_that_was_never_there_is_gone(world: World) -> None:
    """A claim may arrive after its run: the slave is free again, though not at once."""
    world.run(world.follow)
    ((_, time),) = world.gone
    assert ORPHAN_TIME < time < ORPHAN_TIME + 5.0
    assert world.bus.questions == 3


@pytest.mark.parametrize("comes", ["for good", "for a moment"])
def test_what_changes_during_the_question_is_looked_at(world: World, comes: str) -> None:
    """It appeared while the answer was under way: nothing was lost."""

    def come() -> None:
        world.bus.tell(TOKEN, True)
        if comes == "for a moment":
            world.bus.tell(TOKEN, False)
        world.bus.meanwhile = lambda: None

    def main() -> None:
        world.bus.tell(TOKEN, True)
        world.follow()
        world.bus.tell(TOKEN, False)
        world.bus.meanwhile = come

    world.run(main)
    if comes == "for good":
        assert world.gone == []
    else:
        ((_, time),) = world.gone
        assert time > 2.0 * ORPHAN_TIME, "the second absence is waited for anew"


def test_a_master_that_went_away_is_waited_for_once(world: World) -> None:
    """The bus told so, and an empty answer confirms it."""

    def main() -> None:
        world.bus.tell(TOKEN, True)
        world.follow()
        world.clock.sleep(50.0)
        world.bus.tell(TOKEN, False)

    world.run(main)
    ((key, time),) = world.gone
    assert key == "key"
    assert 50.0 + ORPHAN_TIME <= time < 52.0 + ORPHAN_TIME
    assert world.bus.questions == 1


def test_who_is_not_followed_any_more_is_not_gone(world: World) -> None:
    """Given back, or followed anew in place of the one before."""

    def main() -> None:
        world.follow()
        world.follow()
        world.clock.sleep(5.0)
        world.watch.forget("key")

    world.run(main)
    assert (world.gone, world.bus.questions) == ([], 0)


@pytest.fixture
def process() -> Iterator[subprocess.Popen[bytes]]:
    """A process of this host."""
    made = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    yield made
    made.kill()
    made.communicate()


@pytest.mark.skipif(os.name != "posix", reason="elsewhere it cannot be told")
def test_a_process_that_dies_after_its_token_went_is_not_waited_for(
    world: World, process: subprocess.Popen[bytes]
) -> None:
    """Connections close before a killed process counts as dead: it is looked at more than once."""
    peer = PeerProcess(socket.gethostname(), process.pid)

    def main() -> None:
        world.bus.tell(TOKEN, True)
        world.follow(peer, 1000.0)
        world.bus.tell(TOKEN, False)
        world.clock.sleep(1.0)
        assert world.gone == []
        process.kill()
        process.wait()

    world.run(main)
    ((_, time),) = world.gone
    assert 1.0 <= time < 1.5
    assert world.bus.questions == 0


def test_a_process_that_cannot_be_seen_has_not_ended() -> None:
    """A container may have our host's name and process ids of its own."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    peer = PeerProcess(socket.gethostname(), process.pid)
    assert not peer.is_here
    assert not peer.has_ended
    assert not PeerProcess("elsewhere", os.getpid()).is_here
