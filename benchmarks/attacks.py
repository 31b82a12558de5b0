"""Memory of node, worker, agent, master, router and `list` under attack by who may speak to them.

``python -m benchmarks attacks``. Ends with an error when one of them takes more than it may.
"""

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import psutil
import zenoh

from protocol.bus.endpoints import free_endpoint
from protocol.wire.administration import Claimed
from protocol.wire.agents import CHUNK_BYTES, Upload
from protocol.wire.keys import (
    CLAIM,
    STATUS,
    UPLOAD,
    AgentKey,
    SlaveKey,
    alive_agents,
    alive_slaves,
)
from protocol.wire.records import encode_map, encode_record

_EXAMPLES = Path(__file__).parents[1] / "examples"
_LARGE = bytes(60 * 2**20)
_TIME = 60.0
_MIB = 2**20

LIMITS = {
    "node": 450,
    "worker": 300,
    "agent": 150,
    "master": 400,
    "router": 300,
    "list": 200,
}
"""Resident memory that an attack may add [MiB]."""

_LIST_TIME = 30.0


class Watched:
    """A command of the project, whose resident memory is followed.

    Args:
        folder: for what it says.
        words: of its command line.
    """

    def __init__(self, folder: Path, *words: object) -> None:
        self._log = folder / f"{words[1]}.log"
        with self._log.open("wb") as file:
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-m", *map(str, words)],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env={**os.environ, "TMPDIR": str(folder), "COLUMNS": "200"},
            )
        self.own = psutil.Process(self.process.pid)

    @property
    def text(self) -> str:
        """Its output so far."""
        return self._log.read_text(errors="replace")

    def wait_for(self, words: str) -> None:
        """Until it says so."""
        end = time.monotonic() + _TIME
        while words not in self.text:
            assert time.monotonic() < end, self.text
            assert self.process.poll() is None, self.text
            time.sleep(0.02)

    def worker(self) -> psutil.Process:
        """The process that holds the model."""
        (found,) = (p for p in self.own.children() if "spawn_main" in " ".join(p.cmdline()))
        return found

    def end(self) -> None:
        """End it, whatever it does."""
        if self.process.poll() is None:
            for process in [*self.own.children(recursive=True), self.own]:
                process.kill()
            self.process.wait(_TIME)


@contextmanager
def peak(process: psutil.Process) -> Iterator[Callable[[], tuple[int, int]]]:
    """Follow the resident memory of a process: what it was, and what it is at most [MiB]."""
    before = process.memory_info().rss
    most, ending = [before], threading.Event()

    def look() -> None:
        while not ending.wait(0.005):
            try:
                most[0] = max(most[0], process.memory_info().rss)
            except psutil.Error:
                return

    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield lambda: (before // _MIB, most[0] // _MIB)
    finally:
        ending.set()
        thread.join()


def stranger(mode: str, endpoint: str) -> zenoh.Session:
    """Somebody who keeps to none of our rules; connects, or listens."""
    config = zenoh.Config()
    for key, value in {
        "mode": "peer" if mode == "listen" else "client",
        f"{mode}/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def token(session: zenoh.Session, pattern: str) -> str:
    """The key before ``/alive`` of the only token that matches."""
    end = time.monotonic() + _TIME
    while time.monotonic() < end:
        for reply in session.liveliness().get(pattern, timeout=2.0):
            if reply.ok is not None:
                return str(reply.ok.key_expr).removesuffix("/alive")
    raise TimeoutError(pattern)


def flood(session: zenoh.Session, key: str, payload: bytes, count: int) -> list[object]:
    """Requests that are not waited for."""
    return [session.get(key, payload=payload, timeout=_TIME) for _ in range(count)]


def node_and_worker(folder: Path, count: int) -> dict[str, tuple[int, int]]:
    """Large requests to a node whose worker is in a long step, and then to the worker."""
    endpoint = free_endpoint()
    wheel = _EXAMPLES / "quarter_car" / "quarter_car.py:Wheel"
    slave = Watched(folder, "slave_node", "serve", wheel, "--name", "w", "--listen", endpoint)
    with ExitStack() as stack:
        stack.callback(slave.end)
        slave.wait_for("ready")
        session = stack.enter_context(stranger("connect", endpoint))
        key = token(session, alive_slaves())
        worker = slave.worker()
        with peak(slave.own) as of_node:
            worker.suspend()
            kept = flood(session, f"{key}/describe", b"\x80", 1)
            time.sleep(0.5)
            for verb in ("execute", "get_outputs", "deserialize_state", "claim", "status"):
                kept += flood(session, f"{key}/{verb}", _LARGE, count)
            answers = list(session.get(f"{key}/status", timeout=_TIME))
            assert [a for a in answers if a.ok is not None], "status was not answered"
            worker.resume()
            time.sleep(3.0)
            node = of_node()
        with peak(worker) as of_worker:
            state = b"\x82\xa5state\x00\xa4data\xc6" + len(_LARGE).to_bytes(4, "big") + _LARGE
            for _ in range(4):
                list(session.get(f"{key}/deserialize_state", payload=state, timeout=_TIME))
            return {"node": node, "worker": of_worker()}


def agent(folder: Path, count: int) -> dict[str, tuple[int, int]]:
    """Large requests to an agent, and pieces of uploads that are not waited for."""
    endpoint = free_endpoint()
    router = Watched(folder, "slave_node", "router", "--listen", endpoint)
    words = ("--models", folder, "--allow-upload", "--cache", folder / "cache", "--name", "lab")
    where = ("--connect", endpoint, "--mode", "client")
    watched = Watched(folder, "slave_node", "agent", *words, *where)
    with ExitStack() as stack:
        stack.callback(router.end)
        stack.callback(watched.end)
        watched.wait_for("ready")
        session = stack.enter_context(stranger("connect", endpoint))
        key = token(session, alive_agents())
        with peak(watched.own) as of_agent, peak(router.own) as of_router:
            kept = list[object]()
            for number in range(count):
                kept += flood(session, f"{key}/{UPLOAD}", _LARGE, 1)
                piece = Upload(f"{number:064x}", 400 * 2**20, 0, bytes(CHUNK_BYTES))
                kept += flood(session, f"{key}/{UPLOAD}", encode_record(piece), 20)
            time.sleep(3.0)
            return {"agent": of_agent(), "router": of_router()}


def master(folder: Path, count: int) -> dict[str, tuple[int, int]]:
    """Answers that are as large as a message may be, a hundred of them to one request."""
    endpoint = free_endpoint()
    file = folder / "evil.toml"
    file.write_text(
        "[simulation]\nstop_time = 1.0\n[slaves.evil]\n"
        f'[bus]\nconnect = ["{endpoint}"]\ndiscovery_timeout = 30.0\n'
    )
    key = SlaveKey("evil", "1")
    asked = list[str]()

    def answer(query: zenoh.Query) -> None:
        with query:
            verb = str(query.key_expr).rpartition("/")[2]
            asked.append(verb)
            for _ in range(count):
                query.reply(query.key_expr, _LARGE)
            if verb == CLAIM:
                query.reply(query.key_expr, encode_map(Claimed(1, "h", 1).to_message()))

    with ExitStack() as stack:
        session = stack.enter_context(stranger("listen", endpoint))
        queryable = session.declare_queryable(key.verb("*"), zenoh.handlers.Callback(answer))
        alive = session.liveliness().declare_token(key.alive)
        words = ("run", file, "--output", folder / "out", "--quiet", "--no-plot")
        watched = Watched(folder, "master_node", *words)
        stack.callback(watched.end)
        watched.own.memory_info()
        with peak(watched.own) as of_master:
            code = watched.process.wait(_TIME)
            assert code in (3, 5, 6), (code, watched.text)
            assert asked, watched.text
            assert queryable, alive
            _, most = of_master()
        return {"master": (0, most)}


def listing(folder: Path, count: int) -> dict[str, tuple[int, int]]:
    """Thousands of tokens, and a large answer to whoever asks one of them."""
    endpoint = free_endpoint()
    with ExitStack() as stack:
        session = stack.enter_context(stranger("listen", endpoint))

        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(query.key_expr, _LARGE)

        queryable = session.declare_queryable(
            f"doublestep/slaves/*/*/{STATUS}", zenoh.handlers.Callback(answer)
        )
        tokens = [
            session.liveliness().declare_token(key.alive)
            for i in range(count)
            for key in (SlaveKey(f"s{i}", "0"), AgentKey(f"a{i}", "0"))
        ]
        begin = time.monotonic()
        watched = Watched(folder, "master_node", "list", "--connect", endpoint)
        stack.callback(watched.end)
        with peak(watched.own) as of_list:
            code = watched.process.wait(2 * _TIME)
            taken = time.monotonic() - begin
            assert code == 0, watched.text
            assert taken < _LIST_TIME, f"list took {taken:.0f} s"
            assert queryable, tokens
            _, most = of_list()
        return {"list": (0, most)}


def main(words: list[str]) -> None:
    """Run and print a table.

    Raises:
        AssertionError: a bound was not kept.
    """
    parser = ArgumentParser(prog="python -m benchmarks attacks", description=__doc__)
    parser.add_argument("--requests", type=int, default=24, help="of 60 MiB, for each key")
    parser.add_argument("--tokens", type=int, default=3000, help="of slaves, and as many of agents")
    options = parser.parse_args(words)
    found: dict[str, tuple[int, int]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for attack in (node_and_worker, agent, master):
            place = Path(folder) / attack.__name__
            place.mkdir()
            found |= attack(place, options.requests)
        place = Path(folder) / "listing"
        place.mkdir()
        found |= listing(place, options.tokens)
    print(
        "\n### Memory under attack\n\n| process | before | at its peak | bound |\n|---|---|---|---|"
    )
    for name, (before, most) in found.items():
        bound = (before or _COMMAND) + LIMITS[name]
        shown = f"{before} MiB" if before else "-"
        print(f"| {name} | {shown} | {most} MiB | {bound} MiB |")
    for name, (before, most) in found.items():
        bound = (before or _COMMAND) + LIMITS[name]
        assert most <= bound, f"{name}: {most} MiB"


_COMMAND = 120
"""Resident memory of a command that is attacked from its start [MiB]."""
