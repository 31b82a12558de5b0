"""Peers on the bus of a run: hostile ones and many of them change no bit of it."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from master_node import load_system, simulate
from tests.faults.test_network import Commands
from tests.faults.test_processes import endpoints, has_stepped, system_file
from tests.support.hostile_peer import Heard, HostilePeer
from tests.support.quarter_car_case import EXAMPLES
from tests.support.waiting import BOUND, wait_until

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="uses signals"),
    pytest.mark.usefixtures("no_process_left"),
]

REQUESTS = 3000
LONG = "stop_time = 8.0\nlargest_step_size = 2e-3\n"
SHORT = "stop_time = 0.3\n"
FILES = ("results.csv", "steps.csv")


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Commands]:
    """Starts commands; whatever is left is ended after the test."""
    commands = Commands(tmp_path)
    yield commands
    commands.close()


def contents(folder: Path) -> list[bytes]:
    """The rows of a run."""
    return [(folder / name).read_bytes() for name in FILES]


def flooded_run(
    start: Commands, tmp_path: Path, simulation: str, count: int, seed: int
) -> tuple[Path, Heard]:
    """A run on two slaves that were served by hand, both of which a hostile peer reaches.

    Returns:
        The results, and what the peer heard until the run ended.
    """
    places = endpoints(2)
    for place, model in zip(places, ("Chassis", "Wheel"), strict=True):
        words = (EXAMPLES / f"quarter_car.py:{model}", "--name", model.lower(), "--listen", place)
        start("slave_node", "serve", *words).wait_for("ready")
    file = system_file(tmp_path, None, None, simulation=simulation)
    out = tmp_path / "out"
    connect = [word for place in places for word in ("--connect", place)]
    master = start("master_node", "run", file, "--output", out, "--no-plot", *connect)
    peer = HostilePeer(places, seed)
    ending = threading.Event()
    codes: list[int] = []

    def wait() -> None:
        codes.append(master.wait(BOUND))
        ending.set()

    waiter = threading.Thread(target=wait)
    try:
        wait_until(lambda: len(peer.slaves()) == 2)
        wait_until(lambda: has_stepped(out))
        waiter.start()
        heard = peer.flood(peer.slaves(), count, ending)
        waiter.join(BOUND)
    finally:
        peer.close()
    assert codes == [0], master.text
    return out, heard


def check_flooded(out: Path, heard: Heard, tmp_path: Path) -> None:
    """Fails unless most was refused in few words, and the files are those of a run alone."""
    assert heard.answers["refused"] > heard.sent // 2
    assert heard.largest < 100_000
    whole = tmp_path / "whole"
    if not whole.is_dir():
        whole.mkdir()
        system = load_system(system_file(whole, simulation=LONG))
        simulate(system, output=whole / "out", in_process=True)
    assert contents(out) == contents(whole / "out")


@pytest.mark.slow
def test_hostile_requests_during_a_run_change_no_bit(start: Commands, tmp_path: Path) -> None:
    """Law: thousands of malformed, forged, replayed and guessed requests: the same files."""
    out, heard = flooded_run(start, tmp_path, LONG, REQUESTS, 1)
    assert heard.sent > REQUESTS // 10  # while the run went on
    check_flooded(out, heard, tmp_path)


@pytest.mark.slow
def test_a_hundred_thousand_hostile_requests_change_no_bit(start: Commands, tmp_path: Path) -> None:
    """Law: as above, in run after run until as many were sent."""
    sent = seed = 0
    while sent < 100_000:
        seed += 1
        folder = tmp_path / str(seed)
        folder.mkdir()
        out, heard = flooded_run(start, folder, LONG, 100_000 - sent, seed)
        check_flooded(out, heard, tmp_path)
        sent += heard.sent


@pytest.mark.slow
def test_many_masters_on_one_bus(start: Commands, tmp_path: Path, endpoint: str) -> None:
    """Four runs of one system at once through one router, each with slaves of its own."""
    router = start("slave_node", "router", "--listen", endpoint)
    router.wait_for("ready")
    bus = f'mode = "client"\nconnect = ["{endpoint}"]\n'
    file = system_file(tmp_path, simulation=SHORT, bus=bus)
    outs = [tmp_path / f"out{number}" for number in range(4)]
    words = ("--no-plot", "--timeout", "120")
    masters = [
        start("master_node", "run", file, "--no-plot", "--output", out, *words) for out in outs
    ]
    for master in masters:
        assert master.wait(BOUND) == 0, master.text
    simulate(load_system(file), output=tmp_path / "whole", in_process=True)
    _all_same([*outs, tmp_path / "whole"])


def _all_same(folders: Sequence[Path]) -> None:
    first, *others = [contents(folder) for folder in folders]
    assert all(other == first for other in others)
