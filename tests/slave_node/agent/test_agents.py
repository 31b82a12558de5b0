"""Agents: slaves that other hosts start for a master, models that are sent there, licences.

The processes are real, and so are the FMUs. Nothing may be left running after any test.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest

from master_node import System, load_system, simulate
from master_node.hosts.agent_models import ModelPlacing, Sent, WantedModel
from master_node.hosts.agent_requests import SeenAgent
from master_node.hosts.agents import Agents
from master_node.simulation import run as run_system
from protocol.bus.bus import InProcessBus
from protocol.bus.credentials import Role
from protocol.bus.endpoints import Mode
from protocol.errors import (
    ConfigurationError,
    DoublestepError,
    MalformedMessageError,
    ModelError,
    ProtocolError,
    SlaveBusyError,
    SlaveLostError,
    VersionError,
)
from protocol.wire.agents import (
    CHUNK_BYTES,
    AgentModel,
    AgentSlave,
    AgentStatus,
    Done,
    Licence,
    ModelList,
    OutputRequest,
    Record,
    SlaveOutput,
    SlaveStarted,
    StartSlave,
    StopRun,
    Upload,
    UploadState,
)
from protocol.wire.keys import MODELS, OUTPUT, START, STOP, UPLOAD, AgentKey, MasterKey, SlaveKey
from protocol.wire.packing import PROTOCOL_VERSION
from protocol.wire.records import decode_record, encode_error_map, encode_map, encode_record
from slave_node.agent import upload_cache
from slave_node.agent.agent import Agent, Offer, Surroundings
from slave_node.agent.model_store import ModelStore
from slave_node.agent.options import default_cache, parse_labels, parse_licences, places_of
from slave_node.agent.upload_cache import UploadCache
from slave_node.certificates import Host, make_certificates
from tests.faults.test_network import Commands
from tests.faults.test_processes import FOREVER, Command, Gates, endpoints, has_stepped, toml
from tests.support.quarter_car_case import DISPLACEMENT, EXAMPLES
from tests.support.slow import quick_at
from tests.support.waiting import BOUND, wait_until

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="uses signals"),
    pytest.mark.usefixtures("no_process_left"),
]


SHORT = "stop_time = 0.1\n"
MB = 10**6


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Commands]:
    """Starts commands; whatever is left is ended after the test."""
    commands = Commands(tmp_path)
    yield commands
    commands.close()


@pytest.fixture
def models(tmp_path: Path, fmu_dir: Path) -> Path:
    """Models that an agent may start: chassis and wheel."""
    folder = tmp_path / "models"
    folder.mkdir()
    for name in ("chassis.fmu", "wheel.fmu"):
        shutil.copy(fmu_dir / name, folder)
    return folder


@pytest.fixture
def reference(tmp_path: Path, fmu_dir: Path) -> bytes:
    """results.csv of the short run with both slaves in process."""
    slaves = {name: {"model": fmu_dir / f"{name}.fmu"} for name in ("chassis", "wheel")}
    file = system_file(tmp_path, **slaves)
    simulate(load_system(file), output=tmp_path / "reference", in_process=True)
    return (tmp_path / "reference" / "results.csv").read_bytes()


def system_file(
    folder: Path,
    chassis: dict[str, Any],
    wheel: dict[str, Any],
    *,
    simulation: str = SHORT,
    bus: str = "",
) -> Path:
    """The quarter car, with all keys of the two slaves."""
    text = f"[simulation]\ninitial_step_size = 1e-3\n{simulation}"
    for name, table in (("chassis", chassis), ("wheel", wheel)):
        text += f"[slaves.{name}]\n"
        text += "".join(f"{key} = {toml(value)}\n" for key, value in table.items())
    for source, target in DISPLACEMENT:
        text += f'[[connections]]\nfrom = "{source}"\nto = "{target}"\n'
    path = folder / "car.toml"
    path.write_text(f"{text}[bus]\n{bus}")
    return path


def listening(endpoint: str, **more: object) -> str:
    """A ``[bus]`` table of a master to which agents connect."""
    lines = [f'listen = ["{endpoint}"]', *(f"{key} = {value}" for key, value in more.items())]
    return "\n".join(lines) + "\n"


StartAgent = Callable[..., Command]


@pytest.fixture
def start_agent(start: Commands, models: Path, tmp_path: Path) -> StartAgent:
    """``start_agent("winbox", ...)``; returns when it is ready."""

    def begin(name: str, *words: object, directory: Path = models) -> Command:
        cache = () if "--allow-upload" not in words else ("--cache", tmp_path / f"cache {name}")
        agent = start(
            *("slave_node", "agent", "--name", name, "--models", directory, *words, *cache)
        )
        agent.wait_for("ready")
        return agent

    return begin


def slave_processes(agent: Command) -> dict[str, psutil.Process]:
    """The nodes that an agent started, by the names of their slaves."""
    nodes = {}
    for child in agent.process.children():
        words = child.cmdline()
        if "serve" in words:
            nodes[words[words.index("--name") + 1]] = child
    return nodes


# ---- Runs ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "way",
    quick_at(
        ["through an agent with TLS"],
        ["agents connect", "agents listen", "through an agent with TLS"],
    ),
)
def test_the_same_bits_with_slaves_of_two_agents(  # noqa: PLR0917  fixtures
    way: str,
    start: Commands,
    start_agent: StartAgent,
    tmp_path: Path,
    fmu_dir: Path,
    reference: bytes,
) -> None:
    """Law: results.csv does not depend on who starts the slaves, nor on the way to them.

    One slave by the name of its agent, one by a licence. After the run nothing of it is left.
    """
    one, two = endpoints(2)
    first: tuple[object, ...] = ("--connect", one)
    then = first
    bus = listening(one)
    if way == "agents listen":
        first, then = ("--listen", one), ("--listen", two)
        bus = f'connect = ["{one}", "{two}"]\n'
    elif way == "through an agent with TLS":
        make_certificates(tmp_path / "laboratory", [Host.parse("here")], tuple(Role), 1)
        tls = ("--tls", tmp_path / "laboratory" / "here")
        first, then = ("--listen", one, *tls), (*then, "--mode", "client", *tls)
        bus = f'mode = "client"\nconnect = ["{one}"]\ntls = "{tls[1]}"\n'
    agents = [
        start_agent("winbox", "--label", "os=windows", *first),
        start_agent("lab", "--label", "licence=other", "--licence", "dymola=2", *then),
    ]
    file = system_file(
        tmp_path,
        {"model": fmu_dir / "chassis.fmu", "host": "winbox"},
        {"model": fmu_dir / "wheel.fmu", "requires": {"licence": "dymola"}},
        bus=bus,
    )
    master = start("master_node", "run", file, "--output", tmp_path / "out", "--no-plot")
    assert master.wait() == 0, master.text
    assert (tmp_path / "out" / "results.csv").read_bytes() == reference
    assert "chassis is started by agent winbox" in master.text
    assert "wheel is started by agent lab" in master.text
    for agent in agents:
        assert slave_processes(agent) == {}
        agent.send(signal.SIGTERM)
    for agent in agents:
        assert agent.wait() == 0, agent.text
        assert "ended " in agent.text


@pytest.mark.slow
def test_an_agent_has_the_model_that_is_not_here(
    start_agent: StartAgent, tmp_path: Path, fmu_dir: Path, reference: bytes, endpoint: str
) -> None:
    """A file name is enough where the agent has the file; another file of that name is not it."""
    start_agent("winbox", "--connect", endpoint)
    chassis = {"model": fmu_dir / "chassis.fmu"}
    there = {"model": "elsewhere/wheel.fmu", "host": "winbox"}
    file = system_file(tmp_path, chassis, there, bus=listening(endpoint))
    simulate(load_system(file), output=tmp_path / "out")
    assert (tmp_path / "out" / "results.csv").read_bytes() == reference
    file = system_file(tmp_path, chassis, {**there, "model": "w.fmu"}, bus=listening(endpoint))
    with pytest.raises(ModelError, match=r"winbox on .*: it has no model w\.fmu, and there is"):
        simulate(load_system(file))
    (tmp_path / "elsewhere").mkdir()
    shutil.copy(fmu_dir / "wheel.fmu", tmp_path / "elsewhere")
    with zipfile.ZipFile(tmp_path / "elsewhere" / "wheel.fmu", "a") as archive:
        archive.comment = b"another one"
    file = system_file(tmp_path, chassis, there, bus=listening(endpoint))
    with pytest.raises(ModelError, match=r"its wheel\.fmu is another one, and models may not be"):
        simulate(load_system(file))


def test_a_model_that_is_exchanged_on_the_way_is_found_out(
    start_agent: StartAgent, models: Path, tmp_path: Path, fmu_dir: Path, endpoint: str
) -> None:
    """The slave says what it has loaded, and the master compares: the agent need not be right."""
    for path, comment in ((models / "wheel.fmu", b"a"), (tmp_path / "b.fmu", b"b")):
        shutil.copy(fmu_dir / "wheel.fmu", path)
        with zipfile.ZipFile(path, "a") as archive:
            archive.comment = comment
    shutil.copy(models / "wheel.fmu", tmp_path)
    start_agent("winbox", "--connect", endpoint)
    times = (models / "wheel.fmu").stat()
    (models / "wheel.fmu").write_bytes((tmp_path / "b.fmu").read_bytes())
    os.utime(models / "wheel.fmu", ns=(times.st_atime_ns, times.st_mtime_ns))
    file = system_file(
        tmp_path,
        {"model": fmu_dir / "chassis.fmu"},
        {"model": "wheel.fmu", "host": "winbox"},
        bus=listening(endpoint),
    )
    with pytest.raises(ModelError, match="agent winbox loaded a model with SHA-256"):
        simulate(load_system(file))


@pytest.mark.slow
def test_python_models_need_permission_and_the_same_file(
    start: Commands, start_agent: StartAgent, tmp_path: Path, fmu_dir: Path, endpoint: str
) -> None:
    """Refused without ``--allow-python``; with it the same bits, and never another file's class."""
    programs = tmp_path / "programs"
    programs.mkdir()
    shutil.copy(EXAMPLES / "quarter_car.py", programs)
    agents = [
        start_agent("plain", "--connect", endpoint),
        start_agent("python", "--allow-python", "--connect", endpoint, directory=programs),
    ]
    chassis = {"model": fmu_dir / "chassis.fmu"}
    wheel = {"model": EXAMPLES / "quarter_car.py:Wheel"}
    file = system_file(tmp_path, chassis, {**wheel, "host": "plain"}, bus=listening(endpoint))
    with pytest.raises(ModelError, match=r"plain on .*: it starts no Python models; .*export the"):
        simulate(load_system(file))
    results = []
    for host in ({"host": "python"}, {}):
        file = system_file(tmp_path, chassis, {**wheel, **host}, bus=listening(endpoint))
        simulate(load_system(file), output=tmp_path / f"out {len(results)}")
        results.append((tmp_path / f"out {len(results)}" / "results.csv").read_bytes())
    assert results[0] == results[1]
    with (programs / "quarter_car.py").open("a") as program:
        program.write("# another one\n")
    file = system_file(tmp_path, chassis, {**wheel, "host": "python"}, bus=listening(endpoint))
    with pytest.raises(ModelError, match=r"its quarter_car\.py is another one: SHA-256"):
        simulate(load_system(file))
    for agent in agents:
        agent.send(signal.SIGTERM)
        assert agent.wait() == 0


# ---- Models that are sent ------------------------------------------------------------------------


@pytest.fixture
def long_wheel(tmp_path: Path, fmu_dir: Path) -> Path:
    """A wheel that takes three pieces to send."""
    path = tmp_path / "long_wheel.fmu"
    shutil.copy(fmu_dir / "wheel.fmu", path)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("resources/padding", os.urandom(2 * CHUNK_BYTES + 100))
    return path


@pytest.mark.slow
def test_a_model_is_sent_once_and_only_with_permission(
    start_agent: StartAgent, tmp_path: Path, fmu_dir: Path, long_wheel: Path, endpoint: str
) -> None:
    """Refused with a remedy; sent in pieces; then it is there, also for a later master."""
    start_agent("no", "--connect", endpoint)
    start_agent("small", "--connect", endpoint, "--allow-upload", "--upload-limit", 1)
    start_agent("large", "--connect", endpoint, "--allow-upload")
    sent: list[Sent] = []

    def run(host: str, output: Path | None = None) -> None:
        file = system_file(
            tmp_path,
            {"model": fmu_dir / "chassis.fmu"},
            {"model": long_wheel, "host": host},
            bus=listening(endpoint),
        )
        run_system(load_system(file), output, uploading=sent.append)

    with pytest.raises(ConfigurationError) as info:
        run("no")
    assert re.search(
        r"wheel: start: agent no on .*: it has no model with the SHA-256 of long_wheel\.fmu, "
        r"[0-9a-f]{64}, and models may not be sent to it; copy long_wheel\.fmu into its --models "
        "directory, or start it with --allow-upload",
        str(info.value),
    )
    size = long_wheel.stat().st_size
    with pytest.raises(ModelError, match=rf"up to 1000000 bytes, and this one has {size}; .*limit"):
        run("small")
    assert sent == []
    run("large", tmp_path / "out")
    assert [(s.slave, s.agent, s.model, s.size) for s in sent] == [
        ("wheel", "large", "long_wheel.fmu", size)
    ] * 3
    assert [s.sent for s in sent] == [CHUNK_BYTES, 2 * CHUNK_BYTES, size]
    sent.clear()
    run("large", tmp_path / "again")
    assert sent == []
    results = [(tmp_path / name / "results.csv").read_bytes() for name in ("out", "again")]
    assert results[0] == results[1]


@pytest.mark.slow
def test_the_folder_of_an_fmu_is_sent_packed(
    start_agent: StartAgent, tmp_path: Path, fmu_dir: Path, endpoint: str, reference: bytes
) -> None:
    """An agent that has the folder loads its own, another one is sent the archive: equal bits."""
    with zipfile.ZipFile(fmu_dir / "wheel.fmu") as archive:
        archive.extractall(tmp_path / "here" / "wheel")
        archive.extractall(tmp_path / "there" / "wheel")
    start_agent("has", "--connect", endpoint, directory=tmp_path / "there")
    start_agent("takes", "--connect", endpoint, "--allow-upload")
    sent: list[Sent] = []
    for host in ("has", "takes"):
        file = system_file(
            tmp_path,
            {"model": fmu_dir / "chassis.fmu"},
            {"model": "here/wheel/", "host": host},
            bus=listening(endpoint),
        )
        run_system(load_system(file), tmp_path / host, uploading=sent.append)
        assert (tmp_path / host / "results.csv").read_bytes() == reference
    assert [(one.agent, one.model) for one in sent] == [("takes", "wheel")]


def pieces(data: bytes, sha256: str | None = None) -> list[Upload]:
    """All of a file."""
    sha256 = sha256 or hashlib.sha256(data).hexdigest()
    return [
        Upload(sha256, len(data), i, data[i : i + CHUNK_BYTES])
        for i in range(0, len(data), CHUNK_BYTES)
    ]


def test_an_upload_goes_on_where_it_was_and_two_may_send_at_once(tmp_path: Path) -> None:
    """Pieces that are there, or do not come next, are left, and the whole is the file; several
    threads that send it get it there once.
    """
    cache = UploadCache(tmp_path / "cache", 10 * MB, 20 * MB)
    data = os.urandom(2 * CHUNK_BYTES + 5)
    first, second, third = pieces(data)
    assert cache.receive(first) == UploadState(CHUNK_BYTES, False)
    assert cache.receive(third) == UploadState(CHUNK_BYTES, False)
    ask = Upload(first.sha256, len(data), 0, b"")
    assert cache.receive(ask) == cache.receive(first) == UploadState(CHUNK_BYTES, False)
    with pytest.raises(ProtocolError, match="is being sent with"):
        cache.receive(Upload(first.sha256, len(data) + 1, 0, b""))
    assert cache.path(first.sha256) is None
    assert cache.models() == ()
    assert cache.receive(second) == UploadState(2 * CHUNK_BYTES, False)
    assert cache.receive(third) == cache.receive(first) == UploadState(len(data), True)
    path = cache.path(first.sha256)
    assert path is not None
    assert path.read_bytes() == data
    assert cache.models() == (AgentModel("", first.sha256, len(data)),)
    other = os.urandom(4 * CHUNK_BYTES)

    def send() -> None:
        for piece in pieces(other):
            cache.receive(piece)

    threads = [threading.Thread(target=send) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(BOUND)
    path = cache.path(hashlib.sha256(other).hexdigest())
    assert path is not None
    assert path.read_bytes() == other
    assert len(list(cache.directory.iterdir())) == 2


def test_what_has_another_hash_is_never_loaded(tmp_path: Path) -> None:
    """Neither when it arrives so, nor when the file in the cache is changed later."""
    cache = UploadCache(tmp_path / "cache", 10 * MB, 20 * MB)
    announced = hashlib.sha256(b"good").hexdigest()
    with pytest.raises(ModelError, match=f"not {announced}: thrown away"):
        cache.receive(*pieces(b"evil", announced))
    assert cache.path(announced) is None
    assert cache.receive(*pieces(b"good")).complete
    path = cache.path(announced)
    assert path is not None
    path.write_bytes(b"evil")
    assert cache.path(announced) is None
    assert list(cache.directory.iterdir()) == []
    assert cache.path("../../etc/passwd") is None


def test_the_cache_is_bounded_and_keeps_what_is_in_use(tmp_path: Path) -> None:
    """The least recently used goes; what is in use or just arriving stays, and then there is no
    room.
    """
    cache = UploadCache(tmp_path / "cache", 4 * CHUNK_BYTES, 5 * CHUNK_BYTES)
    data = [bytes([i]) * 2 * CHUNK_BYTES for i in range(4)]
    hashes = [hashlib.sha256(item).hexdigest() for item in data]

    def send(item: bytes, *in_use: str) -> None:
        for piece in pieces(item):
            cache.receive(piece, set(in_use))

    def there() -> list[bool]:
        return [any(m.sha256 == h for m in cache.models()) for h in hashes]

    send(data[0])
    send(data[1])
    for i, age in ((0, 100), (1, 200)):
        path = cache.path(hashes[i])
        assert path is not None
        os.utime(path, (time.time() - age,) * 2)
    assert cache.path(hashes[1]) is not None  # used just now: 0 is the older one
    send(data[2])
    assert there() == [False, True, True, False]
    with pytest.raises(ConfigurationError, match=r"no room .*; raise --cache-limit"):
        send(data[3], *hashes)
    cache.receive(pieces(data[3])[0], {hashes[2]})
    assert there() == [False, False, True, False]
    with pytest.raises(SlaveBusyError, match=r"no room .* while others are being sent"):
        cache.receive(Upload(hashes[0], 2 * CHUNK_BYTES, 0, b""), {hashes[2]})
    with pytest.raises(ConfigurationError, match=r"is not taken, only up to 4194304; .*--upload"):
        cache.receive(Upload(hashes[0], 4 * CHUNK_BYTES + 1, 0, b""))
    cache.close()
    assert len(list(cache.directory.iterdir())) == 1


@pytest.mark.parametrize("lack", ["places", "room"])
def test_uploads_that_were_given_up_hold_up_nobody(
    lack: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sixteen that were begun, or two that announce all the room: others wait for a while, then
    the one goes that was heard of the longest ago. Who comes back to it begins again.
    """
    begun, size, capacity = (16, 2 * MB, 100 * MB) if lack == "places" else (2, 10 * MB, 20 * MB)
    cache = UploadCache(tmp_path / "cache", 10 * MB, capacity)
    data = [bytes([i]) * size for i in range(begun)]
    for item in data:
        cache.receive(pieces(item)[0])
    cache.receive(Upload(hashlib.sha256(data[0]).hexdigest(), size, 0, b""))  # heard of again
    new = b"new" * 1000
    with pytest.raises(SlaveBusyError, match="being sent"):
        cache.receive(*pieces(new if lack == "places" else new * 400))
    monkeypatch.setattr(upload_cache, "_GIVEN_UP_TIME", 0.0)
    assert cache.receive(*pieces(new)).complete
    for number, (item, is_left) in enumerate(zip(data, (True, False), strict=False)):
        state = cache.receive(pieces(item)[-1])
        assert (state.received > 0) == is_left, number


def test_a_model_is_sent_again_whose_upload_others_displaced(
    serve_agent: ServeAgent, models: Path, tmp_path: Path, long_wheel: Path
) -> None:
    """From its beginning, a few times; then the error says so."""
    cache = UploadCache(tmp_path / "cache", 10 * MB, 20 * MB)
    served = serve_agent(Offer({}, {}, ModelStore(models), cache))
    seen = SeenAgent(KEY, served.agent.status())
    sha256 = hashlib.sha256(long_wheel.read_bytes()).hexdigest()
    size = long_wheel.stat().st_size
    wanted = WantedModel("wheel", long_wheel, "long_wheel.fmu", "", sha256, size)
    sent: list[int] = []
    often = 1

    def lose(told: Sent) -> None:
        sent.append(told.sent)
        if told.sent == 2 * CHUNK_BYTES and sent.count(told.sent) <= often:
            cache.close()

    placing = ModelPlacing(served.bus, 1.0, lose)
    assert placing.place(seen, wanted) == (sha256, sha256)
    assert sent == [CHUNK_BYTES, 2 * CHUNK_BYTES, 0, CHUNK_BYTES, 2 * CHUNK_BYTES, size]
    path = cache.path(sha256)
    assert path is not None
    path.unlink()
    often = 100
    with pytest.raises(ProtocolError, match="did not take the piece"):
        placing.place(seen, wanted)


def test_a_cache_for_others_is_refused_and_old_pieces_go(tmp_path: Path) -> None:
    """Writers of a cache could choose what is loaded; pieces of a killed agent are removed."""
    folder = tmp_path / "cache"
    UploadCache(folder, MB, MB)
    assert folder.stat().st_mode & 0o777 == 0o700
    for name, age in (("old.part", 90_000.0), ("new.part", 10.0)):
        (folder / name).touch()
        os.utime(folder / name, (time.time() - age,) * 2)
    UploadCache(folder, MB, MB)
    assert [path.name for path in folder.iterdir()] == ["new.part"]
    folder.chmod(0o770)
    with pytest.raises(ConfigurationError, match="others can write into"):
        UploadCache(folder, MB, MB)


@pytest.mark.parametrize(
    "values",
    [
        ("A" * 64, 1, 0, b"x"),
        ("a" * 63, 1, 0, b"x"),
        ("../" + "a" * 61, 1, 0, b"x"),
        ("a" * 64, 0, 0, b""),
        ("a" * 64, 10, CHUNK_BYTES, b""),
        ("a" * 64, 10, 1, b"x"),
        ("a" * 64, 10, 0, b"x"),
        ("a" * 64, 10, 0, b"x" * 11),
        ("a" * 64, CHUNK_BYTES * 3, CHUNK_BYTES, b"x" * 10),
    ],
)
def test_a_piece_that_is_none(values: tuple[Any, ...]) -> None:
    """Refused before anything is kept, whichever way it comes."""
    with pytest.raises(MalformedMessageError):
        Upload(*values)
    sha256, size, offset, data = values
    message = encode_map({"sha256": sha256, "size": size, "offset": offset, "data": data})
    with pytest.raises(MalformedMessageError):
        decode_record(Upload, message)


# ---- What the network may ask for ----------------------------------------------------------------

KEY = AgentKey("winbox", "0")


class Served:
    """An agent on a bus within this process; processes that it starts are real."""

    def __init__(self, tmp_path: Path, offer: Offer) -> None:
        self.scratch = tmp_path / "slaves"
        self.scratch.mkdir()
        self.bus = InProcessBus()
        self._ending = threading.Event()
        # Nobody listens there: the slaves wait for a router until they are ended.
        connection = ["--connect", "tcp/127.0.0.1:1", "--mode", "client"]
        self.agent = Agent(self.bus, KEY, offer, Surroundings(connection, self.scratch))
        self._thread = threading.Thread(target=self.agent.serve, args=(self._ending,))
        self._thread.start()
        wait_until(lambda: bool(self.bus.alive(KEY.alive, 0.0)))

    def ask(self, verb: str, record: Record, answer: type[Any]) -> Any:
        """One request."""
        return decode_record(
            answer, self.bus.caller(KEY.verb(verb), BOUND).request(encode_record(record))
        )

    def close(self) -> None:
        """End it."""
        self._ending.set()
        self._thread.join(BOUND)
        assert not self._thread.is_alive()


@pytest.fixture
def serve_agent(tmp_path: Path) -> Iterator[Callable[[Offer], Served]]:
    """``serve_agent(offer)``; ended after the test."""
    served: list[Served] = []

    def serve(offer: Offer) -> Served:
        served.append(Served(tmp_path, offer))
        return served[-1]

    yield serve
    for agent in served:
        agent.close()


ServeAgent = Callable[[Offer], Served]


def request(slave: str = "wheel", model: str = "wheel.fmu", **values: Any) -> StartSlave:
    """A start by a master that lives: this process."""
    given: dict[str, Any] = {
        "run": "r",
        "host": socket.gethostname(),
        "pid": os.getpid(),
        "orphan_time": 60.0,
        "requires": {},
    }
    return StartSlave(slave=slave, model=model, **{**given, **values})


HOSTILE = (
    *("", ".", "..", "../secret.fmu", "/etc/passwd", "sub/inner.fmu", "..\\secret.fmu"),
    *("wheel.fmu\0", "wheel.fmu ", "./wheel.fmu", "WHEEL.FMU", "odd name.fmu", "--help.fmu"),
    *("program.py", "program.py:Wheel", "os:system", "sub.program:Wheel", "secret", "a" * 64),
    *("../program.py:Wheel", "/tmp/program.py:Wheel", "program.py:Wheel()", ":", "os:"),
)


@pytest.mark.parametrize("python", [False, True])
def test_names_are_looked_up_and_never_become_paths(
    python: bool, models: Path, tmp_path: Path, serve_agent: ServeAgent
) -> None:
    """Files outside the directory, in subfolders and of other kinds are not there; a Python model
    only with permission, as an installed module or a file of the directory. Nothing is started.
    """
    (models / "sub").mkdir()
    for path in ("sub/inner.fmu", "odd name.fmu", "--help.fmu", "../secret.fmu", "secret"):
        shutil.copy(models / "wheel.fmu", models / path)
    (models / "program.py").write_text("")
    served = serve_agent(Offer({}, {}, ModelStore(models, python=python), python=python))
    allowed = {"program.py:Wheel", "os:system", "sub.program:Wheel"} if python else set()
    for model in HOSTILE:
        if model not in allowed:
            with pytest.raises(ModelError, match=r"it (has|starts) no (Python )?models?"):
                served.ask(START, request(model=model), SlaveStarted)
    for name in ("../wheel", "", "a/b", "*"):
        message = encode_record(request())
        message = message.replace(b"\xa5wheel", bytes([0xA0 + len(name)]) + name.encode())
        with pytest.raises(ConfigurationError, match="is not a valid slave name"):
            decode_record(SlaveStarted, served.bus.caller(KEY.verb(START), BOUND).request(message))
    with pytest.raises(ConfigurationError, match=r"may not be sent; .*--allow-upload"):
        served.ask(UPLOAD, *pieces(b"x"), UploadState)  # type: ignore[call-arg,misc]
    status = served.agent.status()
    assert status.slaves == ()
    assert status.upload_limit == 0
    assert list((tmp_path / "slaves").iterdir()) == []
    assert [m.name for m in served.agent.models().models] == ["chassis.fmu"] + (
        ["program.py"] if python else []
    ) + ["wheel.fmu"]


def test_the_store_sees_what_comes_and_changes(models: Path) -> None:
    """A file has the hash that it has now, under its name."""
    store = ModelStore(models)
    (models / "new.fmu").write_bytes(b"1")
    one, two = (hashlib.sha256(text).hexdigest() for text in (b"1", b"22"))
    assert store.name_of(one) == "new.fmu"
    (models / "new.fmu").write_bytes(b"22")
    assert (store.name_of(one), store.name_of(two)) == (None, "new.fmu")
    assert store.count() == len(store.models()) == 3
    (models / "new.fmu").unlink()
    assert not store.has("new.fmu")
    with pytest.raises(ConfigurationError, match="no such directory"):
        ModelStore(models / "none")


def test_a_repeated_start_takes_effect_once_and_a_dead_process_holds_no_licence(
    models: Path, serve_agent: ServeAgent
) -> None:
    """One process for one request, whose reply may be lost; licences count processes that run."""
    served = serve_agent(Offer({"os": "linux"}, {"dymola": 1}, ModelStore(models)))
    wanted = request(requires={"licence": "dymola"})
    started = served.ask(START, wanted, SlaveStarted)
    assert served.ask(START, wanted, SlaveStarted) == started
    with pytest.raises(SlaveBusyError, match=r"all 1 licences dymola are taken: wheel of run r on"):
        served.ask(START, request("other", requires={"licence": "dymola"}), SlaveStarted)
    with pytest.raises(SlaveBusyError, match="another such slave"):
        served.ask(START, request(model="chassis.fmu"), SlaveStarted)
    again = served.ask(START, replace(wanted, restart=1), SlaveStarted)
    assert again != started
    assert not psutil.pid_exists(started.pid)
    left = {path.name for path in served.scratch.iterdir()}
    assert left == {again.instance, f"wheel.{again.instance}.log"}
    with pytest.raises(SlaveBusyError, match="another such slave"):
        served.ask(START, wanted, SlaveStarted)
    started = again
    with pytest.raises(ConfigurationError, match=r"it has no os = windows; .*--label os=windows"):
        served.ask(START, request("other", requires={"os": "windows"}), SlaveStarted)
    psutil.Process(started.pid).kill()
    wait_until(lambda: served.agent.status().licences[0].free == 1)
    output = served.ask(OUTPUT, OutputRequest("r", "wheel"), SlaveOutput)
    assert output.exit_code == -signal.SIGKILL
    other = served.ask(START, request("other", requires={"licence": "dymola"}), SlaveStarted)
    with pytest.raises(SlaveLostError, match="no slave 'wheel'"):
        served.ask(OUTPUT, OutputRequest("another", "wheel"), SlaveOutput)
    served.ask(STOP, StopRun("another"), Done)
    assert psutil.pid_exists(other.pid)
    served.ask(STOP, StopRun("r"), Done)
    assert not psutil.pid_exists(other.pid)
    assert served.agent.status().licences == (Licence("dymola", 1, ()),)
    with pytest.raises(SlaveLostError, match="no slave 'wheel'"):
        served.ask(OUTPUT, OutputRequest("r", "wheel"), SlaveOutput)


def test_slaves_of_a_master_that_is_gone_are_ended(models: Path, serve_agent: ServeAgent) -> None:
    """At once when its process on this host has ended, else after its ``orphan_time``; and also
    when it was never seen. One that comes back in time keeps its slaves.
    """
    served = serve_agent(Offer({}, {}, ModelStore(models)))
    key = MasterKey("r")
    for orphan_time in (1.0, 4.0, 16.0, 64.0):
        served.bus.announce(key.alive)
        served.ask(START, request(orphan_time=orphan_time), SlaveStarted)
        gone = time.monotonic()
        served.bus.withdraw(key.alive)
        served.bus.announce(key.alive)
        absence = time.monotonic() - gone
        never = served.ask(START, request(run="unseen", orphan_time=0.1), SlaveStarted)
        wait_until(lambda: not psutil.pid_exists(never.pid))  # noqa: B023  called here only
        time.sleep(max(0.0, gone + 1.2 * orphan_time - time.monotonic()))
        if absence < orphan_time:  # else the machine was too busy to come back in time
            break
    assert [slave.run for slave in served.agent.status().slaves] == ["r"]
    served.bus.withdraw(key.alive)
    wait_until(lambda: served.agent.status().slaves == ())
    served.bus.announce(MasterKey("dead").alive)
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        served.ask(START, request(run="dead", pid=process.pid), SlaveStarted)
        served.bus.withdraw(MasterKey("dead").alive)  # as connections close before it is dead
        process.kill()
    wait_until(lambda: served.agent.status().slaves == ())


STATUS = AgentStatus(
    name="winbox",
    instance="0",
    host="host",
    pid=1,
    labels={"os": "windows"},
    licences=(Licence("dymola", 2, ("wheel of run r",)),),
    models=3,
    upload_limit=MB,
    python=True,
    slaves=(AgentSlave("wheel", "1", 2, "r", "wheel.fmu"),),
    since=0.0,
    time=1.0,
)


@pytest.mark.parametrize(
    "record",
    [
        STATUS,
        ModelList((AgentModel("a.fmu", "a" * 64, 5),)),
        *pieces(b"x"),
        UploadState(5, True),
        request(requires={"os": "windows"}),
        SlaveStarted("1", 2),
        StopRun("r"),
        OutputRequest("r", "wheel"),
        SlaveOutput(-9, ("a", "b"), "/log"),
        SlaveOutput(None, (), ""),
        Done(),
    ],
    ids=lambda record: type(record).__name__,
)
def test_a_record_gets_there_as_it_was_or_not_at_all(record: Record) -> None:
    """Another version, a missing, unknown or ill-typed field is refused; an error is raised."""
    data = encode_record(record)
    assert decode_record(type(record), data) == record
    with pytest.raises(MalformedMessageError):
        decode_record(type(record), encode_map({"unknown": 1}))
    with pytest.raises(VersionError):
        decode_record(type(record), data.replace(b"version\x01", b"version\x02", 1))
    with pytest.raises(SlaveBusyError, match="taken"):
        decode_record(type(record), encode_error_map(SlaveBusyError("taken")))
    with pytest.raises(DoublestepError):
        decode_record(type(record), data[:-1])
    assert PROTOCOL_VERSION == 1


def test_what_an_agent_lacks() -> None:
    """Labels as they are; a counted licence is a label too, taken or not."""
    assert STATUS.lacks({"os": "windows", "licence": "dymola"}) == []
    assert STATUS.lacks({"os": "linux", "gpu": "yes"}) == ["os = linux", "gpu = yes"]
    assert STATUS.free("dymola") == 1.0
    assert STATUS.free("other") == float("inf")


# ---- Licences and names --------------------------------------------------------------------------


@pytest.mark.slow
def test_a_master_waits_for_a_licence_and_says_who_has_it(
    start: Commands, start_agent: StartAgent, tmp_path: Path, fmu_dir: Path
) -> None:
    """One licence, two masters: the second gives up after ``discovery_timeout``, or gets it when
    the first has ended. A system that needs more than there are is told so at once.

    A slave without the licence runs meanwhile, under the same name: each run has its own.
    """
    mine, theirs = endpoints(2)
    start_agent(*("lab", "--licence", "dymola=1", "--connect", mine, "--connect", theirs))
    chassis = {"model": fmu_dir / "chassis.fmu"}
    wheel = {"model": fmu_dir / "wheel.fmu", "requires": {"licence": "dymola"}}
    folder = tmp_path / "first"
    folder.mkdir()
    gates = Gates(folder, 0.02)
    busy = {"model": gates.model, "parameters": gates.parameters}
    file = system_file(folder, busy, wheel, bus=listening(theirs))
    first = start("master_node", "run", file, "--output", folder / "out", "--no-plot")
    gates.wait_at(0)
    file = system_file(tmp_path, chassis, wheel, bus=listening(mine, discovery_timeout=1.5))
    begin = time.monotonic()
    with pytest.raises(SlaveBusyError, match=r"all 1 licences dymola are taken: wheel of run .*"):
        simulate(load_system(file))
    assert time.monotonic() - begin >= 1.5
    free = {"model": fmu_dir / "wheel.fmu", "host": "lab"}
    simulate(load_system(system_file(tmp_path, chassis, free, bus=listening(mine))))
    file = system_file(tmp_path, chassis, wheel, bus=listening(mine))
    second = start("master_node", "run", file, "--output", tmp_path / "out", "--no-plot")
    second.wait_for("wheel waits: agent lab on")
    first.send(signal.SIGTERM)
    assert first.wait() == 130
    assert second.wait() == 0, second.text
    both = {**chassis, "requires": {"licence": "dymola"}}
    file = system_file(tmp_path, both, wheel, bus=listening(mine, discovery_timeout=3600.0))
    begin = time.monotonic()
    with pytest.raises(ConfigurationError, match=r"1 licences dymola, and the system needs more"):
        simulate(load_system(file))
    assert time.monotonic() - begin < BOUND


def test_two_agents_of_one_name_are_refused(
    start: Commands, start_agent: StartAgent, models: Path, endpoint: str
) -> None:
    """By the second where it sees the first, else by the master, who says where they are."""
    start_agent("twin", "--listen", endpoint)
    words = ("slave_node", "agent", "--name", "twin", "--models", models)
    second = start(*words, "--connect", endpoint, "--mode", "client")
    assert second.wait() == 2
    assert "an agent named 'twin' is on the bus already" in second.text
    bus = InProcessBus()
    for name, instance in (("twin", "1"), ("twin", "2"), ("winbox", "3")):
        key = AgentKey(name, instance)
        status = replace(STATUS, name=name, instance=instance, pid=int(instance))
        bus.serve(key.status, lambda _, status=status: encode_record(status))
        bus.announce(key.alive)
    system = System(slaves={"wheel": {"model": "wheel.fmu", "host": "twin"}})
    with pytest.raises(ProtocolError, match=r"2 agents are called 'twin': host/1, host/2; end all"):
        Agents(bus, "r", system).start("wheel")


class Listed:
    """Agents on a bus that say what they have, and note what they are to start."""

    def __init__(self, *statuses: AgentStatus, models: dict[str, tuple[AgentModel, ...]]) -> None:
        self.bus = InProcessBus()
        self.started: list[tuple[str, str]] = []
        for status in statuses:
            key = AgentKey(status.name, status.instance)
            listed = ModelList(models.get(status.name, ()))
            self.bus.serve(key.status, lambda _, status=status: encode_record(status))
            self.bus.serve(key.verb(MODELS), lambda _, listed=listed: encode_record(listed))
            self.bus.serve(key.verb(START), lambda data, name=key.name: self._start(name, data))
            self.bus.announce(key.alive)

    def _start(self, agent: str, data: bytes) -> bytes:
        self.started.append((agent, decode_record(StartSlave, data).model))
        return encode_record(SlaveStarted("r-0", 1))


def test_which_agent_is_taken() -> None:
    """The agent with the most free licences, then the first by name; one that has the model."""
    wheel = AgentModel("wheel.fmu", "a" * 64, 1)
    held = ("a", "b", "c")

    def lab(name: str, total: int, holders: tuple[str, ...] = ()) -> AgentStatus:
        return replace(STATUS, name=name, licences=(Licence("dymola", total, holders),))

    agents = Listed(
        *(lab("a", 1), lab("c", 3, held[:1]), lab("b", 2), lab("d", 5, held), lab("e", 9)),
        replace(STATUS, name="f", labels={}, licences=()),
        models=dict.fromkeys("abcdf", (wheel,)),
    )
    system = System(
        slaves={
            "wheel": {"model": "wheel.fmu", "requires": {"licence": "dymola"}},
            "windows": {"model": "wheel.fmu", "requires": {"os": "windows"}},
            "f": {"model": "folder/wheel.fmu", "host": "f"},
        }
    )
    starter = Agents(agents.bus, "r", system)
    for name in system.slaves:
        starter.start(name)
    assert agents.started == [("b", wheel.sha256), ("a", wheel.sha256), ("f", wheel.sha256)]


def test_an_upload_outlives_a_lost_connection(tmp_path: Path) -> None:
    """Pieces that arrived are not sent again, and the model that arrives is the one from here."""
    bus = InProcessBus()
    cache = UploadCache(tmp_path / "cache", 10 * MB, 10 * MB)
    status = replace(STATUS, licences=(), upload_limit=10 * MB)
    received: list[int] = []

    def upload(data: bytes) -> bytes:
        piece = decode_record(Upload, data)
        received.append(piece.offset if piece.data else -1)
        return encode_record(cache.receive(piece))

    def serve() -> None:
        bus.serve(KEY.status, lambda _: encode_record(status))
        bus.serve(KEY.verb(MODELS), lambda _: encode_record(ModelList(())))
        bus.serve(KEY.verb(UPLOAD), upload)
        bus.serve(KEY.verb(START), lambda _: encode_record(SlaveStarted("r-0", 1)))
        bus.announce(KEY.alive)

    def lose(sent: Sent) -> None:
        if sent.sent == CHUNK_BYTES:
            bus.withdraw(KEY.alive)
            threading.Timer(0.3, serve).start()

    data = os.urandom(3 * CHUNK_BYTES)
    (tmp_path / "wheel.fmu").write_bytes(data)
    system = System(slaves={"wheel": {"model": "wheel.fmu", "host": "winbox"}}, base=tmp_path)
    serve()
    assert Agents(bus, "r", system, lose).start("wheel") == SlaveKey("wheel", "r-0")
    assert received == [-1, 0, CHUNK_BYTES, 2 * CHUNK_BYTES]
    path = cache.path(hashlib.sha256(data).hexdigest())
    assert path is not None
    assert path.read_bytes() == data


def test_no_agent_has_what_is_required(
    start_agent: StartAgent, tmp_path: Path, fmu_dir: Path, endpoint: str
) -> None:
    """After ``discovery_timeout`` the master says which agents there are and what they lack."""
    start_agent("winbox", "--label", "os=windows", "--connect", endpoint)
    for table, message in (
        ({"host": "other"}, r"no agent with host = other .*winbox on .*, which has another name"),
        (
            {"requires": {"os": "windows", "licence": "dymola"}},
            r"no agent with os = windows, licence = dymola within 1 s; found on the bus: winbox on "
            r".*, which lacks licence = dymola",
        ),
    ):
        file = system_file(
            tmp_path,
            {"model": fmu_dir / "chassis.fmu"},
            {"model": fmu_dir / "wheel.fmu", **table},
            bus=listening(endpoint, discovery_timeout=1.0),
        )
        with pytest.raises(SlaveLostError, match=message):
            simulate(load_system(file))


# ---- Ends ----------------------------------------------------------------------------------------


def test_what_became_of_a_slave_is_told_by_its_agent(
    start: Commands, start_agent: StartAgent, models: Path, tmp_path: Path, endpoint: str
) -> None:
    """A model that cannot be loaded: exit code 2 and its own words. A process that is killed in
    mid run: exit code 3, the signal, its last words, slave, phase, t and H.
    """
    with zipfile.ZipFile(models / "broken.fmu", "w") as archive:
        archive.writestr("readme", "no model")
    agent = start_agent("winbox", "--connect", endpoint, "--logs", tmp_path / "logs")
    chassis = {"model": models / "chassis.fmu"}
    file = system_file(
        tmp_path, chassis, {"model": "broken.fmu", "host": "winbox"}, bus=listening(endpoint)
    )
    with pytest.raises(ModelError, match=r"wheel: on .* \(agent winbox\): .*modelDescription\.xml"):
        simulate(load_system(file))
    wheel = {"model": "wheel.fmu", "host": "winbox"}
    forever = FOREVER + "recovery = 'off'\n"
    file = system_file(tmp_path, chassis, wheel, simulation=forever, bus=listening(endpoint))
    out = tmp_path / "out"
    master = start("master_node", "run", file, "--output", out, "--no-plot")
    wait_until(lambda: has_stepped(out))
    slave_processes(agent)["wheel"].kill()
    assert master.wait() == 3, master.text
    logs = (tmp_path / "logs").iterdir()
    (log,) = (path for path in logs if "claimed by" in path.read_text())
    last = master.text.splitlines()[-1]
    assert re.match(
        r"master-node: wheel: do_step at t=[\d.e+-]+ s, H=[\d.e+-]+ s: on .* \(agent winbox\): its "
        r"process died by signal 9; its log ends: .*claimed by run .*; see "
        + re.escape(f"{log} on {socket.gethostname()}"),
        last,
    ), last


@pytest.mark.parametrize("victim", quick_at(["agent"], ["slave", "agent"]))
def test_a_slave_that_is_lost_is_started_again_elsewhere_if_need_be(  # noqa: PLR0917  fixtures
    victim: str,
    start: Commands,
    start_agent: StartAgent,
    tmp_path: Path,
    fmu_dir: Path,
    endpoint: str,
) -> None:
    """SIGKILL in mid run: by the same agent, or by another one with the labels; the same bits."""
    gates = Gates(tmp_path, 0.03, 0.06)
    chassis = {"model": gates.model, "parameters": gates.parameters}
    agents = {
        name: start_agent(name, "--label", "os=any", "--connect", endpoint) for name in ("a", "b")
    }
    file = system_file(
        tmp_path,
        chassis,
        {"model": "wheel.fmu", "requires": {"os": "any"}},
        bus=listening(endpoint),
    )
    out = tmp_path / "out"
    master = start("master_node", "run", file, "--output", out, "--no-plot")
    gates.wait_at(0)
    if victim == "agent":
        agents["a"].send(signal.SIGKILL)
    else:
        slave_processes(agents["a"])["wheel"].kill()
    gates.open(0)
    master.wait_for("started again and restored")
    gates.wait_at(1)
    where = slave_processes(agents["b" if victim == "agent" else "a"])
    assert list(where) == ["wheel"]
    gates.open(1)
    assert master.wait() == 0, master.text
    wheel = {"model": fmu_dir / "wheel.fmu"}
    undisturbed = load_system(system_file(tmp_path, chassis, wheel))
    simulate(undisturbed, output=tmp_path / "undisturbed", in_process=True)
    for name in ("results.csv", "steps.csv"):
        assert (out / name).read_bytes() == (tmp_path / "undisturbed" / name).read_bytes()
    assert slave_processes(agents["b"]) == {}


@pytest.mark.slow
def test_an_agent_that_stops_while_it_is_asked_to_start_a_slave(
    start_agent: StartAgent, tmp_path: Path, fmu_dir: Path, endpoint: str, reference: bytes
) -> None:
    """SIGSTOP when the model is there: another agent starts the slave, and the run is the same.

    When the first one goes on it is as good as new.
    """
    words = ("--label", "os=any", "--connect", endpoint, "--allow-upload")
    (tmp_path / "empty").mkdir()
    agents = {n: start_agent(n, *words, directory=tmp_path / "empty") for n in ("a", "b")}
    file = system_file(
        tmp_path,
        {"model": fmu_dir / "chassis.fmu"},
        {"model": fmu_dir / "wheel.fmu", "requires": {"os": "any"}},
        bus=listening(endpoint, reconnect_time=0.5),
    )
    sent: list[str] = []

    def stop(piece: Sent) -> None:
        sent.append(piece.agent)
        if piece.agent == "a" and piece.sent == piece.size:
            agents["a"].send(signal.SIGSTOP)

    run_system(load_system(file), tmp_path / "out", uploading=stop)
    assert sent == ["a", "b"]
    assert (tmp_path / "out" / "results.csv").read_bytes() == reference
    agents["a"].send(signal.SIGCONT)
    for agent in agents.values():
        agent.send(signal.SIGTERM)
        assert agent.wait() == 0, agent.text


@pytest.mark.parametrize("victim", quick_at(["agent"], ["agent", "master"]))
def test_nothing_outlives_who_it_works_for(  # noqa: PLR0917  fixtures
    victim: str,
    start: Commands,
    start_agent: StartAgent,
    tmp_path: Path,
    fmu_dir: Path,
    endpoint: str,
) -> None:
    """An agent that is killed takes its slaves with it, and the master says so; the slaves of a
    master that is killed are ended by the agent, which goes on.
    """
    agent = start_agent("winbox", "--connect", endpoint)
    file = system_file(
        tmp_path,
        {"model": fmu_dir / "chassis.fmu"},
        {"model": fmu_dir / "wheel.fmu", "host": "winbox"},
        simulation=FOREVER + "recovery = 'off'\n",
        bus=listening(endpoint),
    )
    out = tmp_path / "out"
    master = start("master_node", "run", file, "--output", out, "--no-plot")
    wait_until(lambda: has_stepped(out))
    slave = slave_processes(agent)["wheel"]
    if victim == "agent":
        agent.send(signal.SIGKILL)
        assert master.wait() == 3, master.text
        assert "wheel: do_step at t=" in master.text
    else:
        master.send(signal.SIGKILL)
        agent.wait_for("ended wheel of run")
    psutil.wait_procs([slave], timeout=BOUND)
    assert not slave.is_running()


def test_an_agent_is_listed(start: Commands, start_agent: StartAgent, endpoint: str) -> None:
    """Labels, licences, models, as data and as a table; the doctor has nothing to say."""
    start_agent(
        *("winbox", "--label", "os=windows", "--licence", "dymola=2", "--allow-upload"),
        *("--listen", endpoint),
    )
    listed = start("master_node", "list", "--connect", endpoint, "--json")
    assert listed.wait() == 0, listed.text
    (agent,) = json.loads(listed.text)["agents"]
    assert agent["labels"] == {"os": "windows"}
    assert agent["licences"] == [{"name": "dymola", "total": 2, "holders": []}]
    assert (agent["models"], agent["upload_limit"], agent["slaves"]) == (2, 500 * MB, [])
    table = start("master_node", "list", "--connect", endpoint)
    assert table.wait() == 0
    assert re.search(r"winbox .*os = windows .*dymola 2 of 2 .*2, uploads", table.text)
    doctor = start("master_node", "doctor", "--connect", endpoint)
    assert doctor.wait() == 0, doctor.text
    assert "agent winbox" in doctor.text


# ---- The command line ----------------------------------------------------------------------------


def test_options_that_are_wrong_are_named() -> None:
    """Labels and licences in another form, or twice; addresses that are not allowed."""
    assert parse_labels(["os=windows", "licence=dymola"]) == {"os": "windows", "licence": "dymola"}
    assert parse_licences(["dymola=2", "amesim=1"]) == {"dymola": 2, "amesim": 1}
    for labels in (["os"], ["os="], ["=x"], ["a b=c"], ["os=a", "os=b"], ["os=a\nb"]):
        with pytest.raises(ConfigurationError):
            parse_labels(labels)
    for licences in ("dymola", "a=0", "a=-1", "a=1.5", "a=²", "a=99999"):
        with pytest.raises(ConfigurationError, match="--licence"):
            parse_licences([licences])
    with pytest.raises(ConfigurationError, match="a is counted already"):
        parse_licences(["a=1", "a=2"])
    with pytest.raises(ConfigurationError, match="not a loopback address"):
        places_of((), ["tcp/0.0.0.0:7447"], Mode.PEER)
    with pytest.raises(ConfigurationError, match="does not listen"):
        places_of(["tcp/127.0.0.1:1"], ["tcp/127.0.0.1:2"], Mode.CLIENT)


def test_slaves_come_to_the_bus_as_their_agent_or_through_it() -> None:
    """The options of the slaves for each way of an agent."""
    peer = places_of(["tcp/127.0.0.1:1", "tcp/127.0.0.1:2"], (), Mode.PEER)
    both = ["--connect", "tcp/127.0.0.1:1", "--connect", "tcp/127.0.0.1:2"]
    assert peer.of_slaves == both
    client = places_of(["tcp/127.0.0.1:1"], (), Mode.CLIENT)
    assert client.of_slaves == ["--mode", "client", "--connect", "tcp/127.0.0.1:1"]
    for listen, here in (("0.0.0.0", "127.0.0.1"), ("[::]", "[::1]"), ("10.0.0.1", "10.0.0.1")):
        places = places_of((), [f"tcp/{listen}:7"], Mode.PEER, insecure=True)
        assert places.own.mode is Mode.PEER
        assert places.own.connect == ()
        assert places.of_slaves == ["--mode", "client", "--connect", f"tcp/{here}:7", "--insecure"]
    assert places_of((), (), Mode.PEER).of_slaves == ["--connect", "tcp/127.0.0.1:7447"]


def test_the_cache_of_an_agent_is_the_users(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the platform keeps such things, one folder for each agent."""
    monkeypatch.setenv("XDG_CACHE_HOME", "/caches")
    assert default_cache("winbox") == Path("/caches/doublestep/agents/winbox")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert default_cache("winbox") == Path.home() / ".cache/doublestep/agents/winbox"
