"""Cut cables and restarted routers: the run goes on and ends in the same bits."""

from __future__ import annotations

import os
import queue
import re
import shlex
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from master_node import load_system, simulate
from protocol.bus.endpoints import Endpoints, Mode, free_endpoint
from protocol.bus.zenoh import ZenohBus
from protocol.errors import SlaveLostError
from tests.faults.test_processes import MODELS, Command, system_file, toml
from tests.support.network_namespaces import Hosts, hosts_on_a_bridge, unavailable
from tests.support.places import ROOT
from tests.support.quarter_car_case import EXAMPLES
from tests.support.waiting import BOUND, wait_until

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="uses signals"),
    pytest.mark.usefixtures("no_process_left"),
]


NAP = 0.5
"""Duration of a step during which a cable is pulled [s]."""

SIMULATION = "stop_time = 0.1\nlargest_step_size = 1e-3\n"


class Commands:
    """Starts commands of the project, each on its host if one is given."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._commands: list[Command] = []

    def __call__(self, module: str, *words: object, on: list[str] | None = None) -> Command:
        scratch = self._folder / f"scratch {len(self._commands)}"
        scratch.mkdir()
        self._commands.append(Command(scratch, module, *words, prefix=on or []))
        return self._commands[-1]

    def close(self) -> None:
        """End them all."""
        for command in self._commands:
            command.close()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Commands]:
    """Starts commands; whatever is left is ended after the test."""
    commands = Commands(tmp_path)
    yield commands
    commands.close()


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    """Three hosts on a bridge: master, slave, router."""
    if reason := unavailable():
        pytest.skip(reason)
    with hosts_on_a_bridge(["master", "slave", "router"]) as made:
        yield made


def nap(folder: Path) -> dict[str, object]:
    """The parameters of a chassis that naps once in mid run."""
    return {"sleeps_at": 0.05, "nap": NAP, "bed": str(folder / "asleep")}


def chassis_words(folder: Path) -> list[object]:
    """Words of the command that serves the chassis."""
    parameters = [f"{name}={toml(value)}" for name, value in nap(folder).items()]
    return [
        f"{MODELS}:Napper",
        *("--name", "chassis"),
        *(word for parameter in parameters for word in ("--parameter", parameter)),
    ]


def reference(folder: Path) -> bytes:
    """The results of the same system in process, without naps."""
    (folder / "reference").mkdir()
    file = system_file(folder / "reference", f"{MODELS}:Napper", simulation=SIMULATION)
    simulate(load_system(file), output=folder / "reference" / "out", in_process=True)
    return (folder / "reference" / "out" / "results.csv").read_bytes()


@pytest.mark.slow
def test_a_cut_cable_is_ridden_out(start: Commands, hosts: Hosts, tmp_path: Path) -> None:
    """A direct connection, cut in mid step for longer than the lease: one warning, same bits."""
    where = f"tcp/{hosts.addresses['master']}:7447"
    slave = start(
        *("slave_node", "serve", *chassis_words(tmp_path), "--connect", where, "--insecure"),
        on=hosts.prefix("slave"),
    )
    file = system_file(tmp_path, None, simulation=SIMULATION)
    master = start(
        *("master_node", "run", file, "--no-plot", "--listen", where, "--insecure"),
        *("--output", tmp_path / "out"),
        on=hosts.prefix("master"),
    )
    wait_until((tmp_path / "asleep").exists)
    hosts.cut("slave")
    time.sleep(3.0)
    hosts.heal("slave")
    assert master.wait() == 0, master.text
    assert (tmp_path / "out" / "results.csv").read_bytes() == reference(tmp_path)
    (warning,) = re.findall("WARNING: (.*)", master.text)
    assert warning.startswith("the connection to chassis was lost; waiting for it, 10 s at most")
    assert "INFO: the connection to chassis is back after" in master.text
    slave.wait_for("released by")


@pytest.mark.slow
def test_a_cable_that_stays_cut_ends_the_run(start: Commands, hosts: Hosts, tmp_path: Path) -> None:
    """After ``reconnect_time``: exit code 3 with slave, t, H and cause, and results are kept."""
    where = f"tcp/{hosts.addresses['slave']}:7447"
    slave = start(
        *("slave_node", "serve", *chassis_words(tmp_path), "--listen", where, "--insecure"),
        on=hosts.prefix("slave"),
    )
    slave.wait_for("ready")
    file = system_file(tmp_path, None, simulation=SIMULATION, bus="reconnect_time = 0.5\n")
    master = start(
        *("master_node", "run", file, "--no-plot", "--connect", where, "--insecure"),
        *("--output", tmp_path / "out"),
        on=hosts.prefix("master"),
    )
    wait_until((tmp_path / "asleep").exists)
    hosts.cut("slave")
    assert master.wait() == 3
    last = master.text.splitlines()[-1]
    assert re.match(
        r"master-node: chassis: do_step at t=\S+ s, H=\S+ s: the connection to it was lost and "
        r"did not come back within 0\.5 s; ",
        last,
    ), last
    assert len((tmp_path / "out" / "results.csv").read_text().splitlines()) > 10


# ---- Routers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("chassis", ["by hand", "launched"])
@pytest.mark.slow
def test_a_router_between_all_and_its_restart(
    chassis: str, start: Commands, tmp_path: Path, endpoint: str
) -> None:
    """Two slaves and a master as clients; the router is killed in mid step and started again.

    The slaves are there before the router is. The bits are those of a run in process.
    """
    through = ("--connect", endpoint, "--mode", "client")
    wheel = start(
        *("slave_node", "serve", EXAMPLES / "quarter_car.py:Wheel", "--name", "wheel"), *through
    )
    if chassis == "by hand":
        start("slave_node", "serve", *chassis_words(tmp_path), *through)
    router = start("slave_node", "router", "--listen", endpoint)
    wheel.wait_for("ready")
    launched = chassis == "launched"
    file = system_file(
        tmp_path,
        f"{MODELS}:Napper" if launched else None,
        None,
        simulation=SIMULATION,
        bus=f'mode = "client"\nconnect = ["{endpoint}"]\n',
        chassis_parameters=nap(tmp_path) if launched else None,
    )
    master = start("master_node", "run", file, "--no-plot", "--output", tmp_path / "out")
    wait_until((tmp_path / "asleep").exists)
    router.send(signal.SIGKILL)
    router.wait()
    second = start("slave_node", "router", "--listen", endpoint)
    assert master.wait() == 0, master.text
    assert (tmp_path / "out" / "results.csv").read_bytes() == reference(tmp_path)
    assert re.search(
        "WARNING: the connection to (chassis|wheel|chassis, wheel) was lost", master.text
    )
    second.send(signal.SIGTERM)
    assert second.wait() == 0
    assert "ending: SIGTERM" in second.text


@pytest.mark.slow
def test_a_cut_behind_a_router(start: Commands, hosts: Hosts, tmp_path: Path) -> None:
    """Master, router and slave on three hosts; the slave's cable is cut for 2 s in mid step.

    2 s is Zenoh's lease, so it may or may not be noticed: the bits are the same.
    """
    where = f"tcp/{hosts.addresses['router']}:7447"
    through = ("--connect", where, "--mode", "client", "--insecure")
    start("slave_node", "router", "--listen", where, "--insecure", on=hosts.prefix("router"))
    slave = start(
        *("slave_node", "serve", *chassis_words(tmp_path), *through), on=hosts.prefix("slave")
    )
    file = system_file(tmp_path, None, simulation=SIMULATION)
    master = start(
        *("master_node", "run", file, "--no-plot", "--output", tmp_path / "out", *through),
        on=hosts.prefix("master"),
    )
    wait_until((tmp_path / "asleep").exists)
    hosts.cut("slave")
    time.sleep(2.0)
    hosts.heal("slave")
    assert master.wait() == 0, master.text
    assert (tmp_path / "out" / "results.csv").read_bytes() == reference(tmp_path)
    assert master.text.count("WARNING") <= 1
    slave.wait_for("released by")


def test_clients_go_to_another_router(start: Commands) -> None:
    """Two routers that are connected pass queries on; when one is killed its client moves."""
    first, second = free_endpoint(), free_endpoint()
    routers = [
        start("slave_node", "router", "--listen", first),
        start("slave_node", "router", "--listen", second, "--connect", first),
    ]
    for router in routers:
        router.wait_for("ready")
    slave = ZenohBus(Endpoints(connect=(first, second), mode=Mode.CLIENT), timeout=BOUND)
    master = ZenohBus(Endpoints(connect=(second,), mode=Mode.CLIENT), timeout=BOUND)
    try:
        slave.serve("a/echo", lambda data: data)
        slave.announce("a/alive")
        caller = master.caller("a/echo", BOUND)

        def answers() -> bool:
            try:
                return caller.request(b"x") == b"x"
            except SlaveLostError:
                return False

        wait_until(answers)
        changes: queue.SimpleQueue[bool] = queue.SimpleQueue()
        master.watch("a/alive", lambda _, alive: changes.put(alive))
        assert changes.get(timeout=BOUND)
        routers[0].send(signal.SIGKILL)
        assert not changes.get(timeout=BOUND)
        assert changes.get(timeout=BOUND)
        wait_until(answers)
    finally:
        slave.close()
        master.close()


def test_no_router(start: Commands, tmp_path: Path, endpoint: str) -> None:
    """A master says so after its time; a slave waits, and ends on a signal all the same."""
    through = ("--connect", endpoint, "--mode", "client")
    slave = start("slave_node", "serve", *chassis_words(tmp_path), *through)
    file = system_file(tmp_path, None, simulation=SIMULATION)
    master = start(
        *("master_node", "run", file, "--no-plot", "--output", tmp_path / "out", "--timeout", "1"),
        *through,
    )
    assert master.wait() == 3
    assert f"connect: no connection to {endpoint} within 1 s; start the router" in master.text
    slave.wait_for(f"waiting for a router at {endpoint}")
    slave.send(signal.SIGTERM)
    assert slave.wait() == 0, slave.text
    wrong = start(
        *("slave_node", "serve", *chassis_words(tmp_path)),
        *("--mode", "client", "--listen", endpoint),
    )
    assert wrong.wait() == 2
    assert "a client connects to a router and does not listen" in wrong.text


# ---- The document -------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_deployment_document_works(
    start: Commands, hosts: Hosts, fmu_dir: Path, tmp_path: Path
) -> None:
    """The commands for three hosts, one after the other, each on its host, over TLS."""
    text = (ROOT / "docs" / "deployment.md").read_text(encoding="utf-8")
    text = text.partition("## Three hosts")[2].partition("\n## ")[0]
    for address, host in (("10.0.0.1", "router"), ("10.0.0.2", "slave"), ("10.0.0.3", "master")):
        text = text.replace(address, hosts.addresses[host])
    text = re.sub(r"(?<=[ =])lab(?=[ /])", str(tmp_path / "lab"), text)
    text = re.sub(r"examples/quarter_car/(\w+)\.fmu", rf"{fmu_dir}/\1.fmu", text)
    text = text.replace("examples/", f"{ROOT}/examples/").replace("results", f"{tmp_path}/out")
    lines = [
        shlex.split(line)
        for block in re.findall(r"^```sh\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
        for line in block.splitlines()
    ]
    places = ["router", "router", "router", "slave", "master", "router", "router", "router"]
    assert len(lines) == len(places)
    for (program, *words), place in zip(lines, places, strict=True):
        command = start(program.replace("-", "_"), *words, on=hosts.prefix(place))
        if words[0] in ("serve", "router"):
            command.wait_for("ready")
        else:
            assert command.wait() == 0, command.text
        if words[0] == "list":
            assert {"chassis", "wheel"} <= set(re.findall(r"\w+", command.text))
    system = load_system(ROOT / "examples" / "quarter_car" / "displacement.toml")
    simulate(system.model_copy(update={"base": fmu_dir}), output=tmp_path / "same", in_process=True)
    same = (tmp_path / "same" / "results.csv").read_bytes()
    assert (tmp_path / "out" / "results.csv").read_bytes() == same
