"""``master-node list`` and ``master-node doctor``: who is on the bus, and what is wrong there."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import pytest
from rich.console import Console

from master_node.survey.doctor import diagnose
from master_node.survey.listing import listing_data, listing_tables
from master_node.survey.participants import Participant, measure, survey
from master_node.survey.windows import Window
from protocol.bus.bus import Bus, InProcessBus
from protocol.bus.credentials import Role
from protocol.bus.endpoints import Endpoints
from protocol.bus.zenoh import ZenohBus
from protocol.errors import MalformedMessageError
from protocol.wire.administration import MasterStatus, RouterStatus, SlaveStatus
from protocol.wire.keys import STATUS, MasterKey, RouterKey, SlaveKey
from protocol.wire.packing import PROTOCOL_VERSION
from protocol.wire.records import decode_map, encode_map
from slave_node.certificates import Host, make_certificates
from tests.faults.test_network import Commands
from tests.faults.test_processes import FOREVER, system_file
from tests.support.quarter_car_case import EXAMPLES
from tests.support.waiting import BOUND, is_quick, wait_until

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="uses signals"),
    pytest.mark.usefixtures("no_process_left"),
]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Commands]:
    """Starts commands; whatever is left is ended after the test."""
    commands = Commands(tmp_path)
    yield commands
    commands.close()


def slave_status(name: str, instance: str = "0", **values: Any) -> SlaveStatus:
    """Status as a slave would tell it."""
    status = SlaveStatus(
        name=name,
        instance=instance,
        host="host",
        pid=1,
        model="Model",
        kind="FMI 2.0 co-simulation",
        sha256="",
        capabilities="saves state (native)",
        state="free",
        busy=False,
        worker="alive",
        holder=None,
        run=None,
        held_since=None,
        since=0.0,
        time=time.time(),
        protocol_version=PROTOCOL_VERSION,
    )
    return replace(status, **values)


def serve(bus: Bus, status: SlaveStatus, answer: Callable[[], bytes] | None = None) -> None:
    """Put a slave on the bus that has nothing but a status."""
    key = SlaveKey(status.name, status.instance)
    bus.serve(key.verb(STATUS), lambda _: answer() if answer else encode_map(status.to_message()))
    bus.announce(key.alive)


# ---- What is seen -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "status",
    [
        slave_status("a"),
        slave_status("a", holder="run", run="r", held_since=1.0, busy=True),
        MasterStatus("r", "host", 1, "car.toml", "a, b", 0.0, 1.0),
        RouterStatus("i", "host", 1, "at tcp/127.0.0.1:7447", 0.0, 1.0),
    ],
)
def test_a_status_gets_there_and_back(status: Any) -> None:
    """A status arrives unchanged, without additions of later versions or values of other types."""
    message = decode_map(encode_map({**status.to_message(), "later": "more"}))
    assert type(status).from_message(message) == status
    for name in message.keys() - {"later"}:
        with pytest.raises(MalformedMessageError, match=name):
            type(status).from_message({**message, name: b"bytes"})
    with pytest.raises(MalformedMessageError, match="host"):
        type(status).from_message({k: v for k, v in message.items() if k != "host"})


def test_more_than_256_are_seen_and_the_silent_do_not_hold_up_the_rest(endpoint: str) -> None:
    """300 tokens of which one answers, over Zenoh, each seen once through two windows."""
    others = ZenohBus(Endpoints(listen=(endpoint,)))
    ours = [ZenohBus(Endpoints(connect=(endpoint,))) for _ in range(2)]
    try:
        for i in range(299):
            others.announce(SlaveKey(f"silent{i}", "0").alive)
        serve(others, slave_status("a"))
        seen: list[list[Participant]] = []

        def all_seen() -> bool:
            seen.append(survey(ours))
            return len(seen[-1]) == 300

        wait_until(all_seen)
        (answered,) = (p for p in seen[-1] if p.status is not None)
        assert answered.key == SlaveKey("a", "0")
        timing = measure(answered, 20, BOUND)
        assert len(timing.round_trips) == 20
        assert timing.median > 0.0
        assert is_quick(timing.median, 1.0)
        data = listing_data(seen[-1])
        assert [len(rows) for rows in data.values()] == [1, 0, 0, 0, 299]
    finally:
        for bus in (*ours, others):
            bus.close()


def test_what_a_slave_says_does_nothing_to_the_terminal() -> None:
    """Markup and control characters are shown, not obeyed."""
    bus = InProcessBus()
    serve(bus, slave_status("a", host="[red]x\x1b[2J", since=1e300))
    (table,) = listing_tables(survey([bus]))
    (cell,) = table.columns[1].cells
    assert str(cell) == r"[red]x\x1b[2J"
    assert not cell.spans


def test_nothing_is_cut_off_in_a_narrow_terminal() -> None:
    """Names, process ids and addresses go on in the next line: half of one may be another's."""
    bus = InProcessBus()
    long = "a" * 90
    serve(bus, slave_status(long, pid=4194303))
    key = RouterKey("r" * 30)
    router = RouterStatus(key.instance, "host", 4194303, f"at tcp/{long}:7447", 0.0, time.time())
    bus.serve(key.status, lambda _: encode_map(router.to_message()))
    bus.announce(key.alive)
    console = Console(width=80, color_system=None)
    for tables in (
        listing_tables(survey([bus])),
        diagnose([Window("here", False, bus)]).tables(),
    ):
        with console.capture() as captured:
            console.print(*tables)
        assert "…" not in captured.get()
        assert captured.get().count("a") > 2 * len(long)


# ---- What is wrong ------------------------------------------------------------------------------


def problems(bus: Bus) -> dict[str, str]:
    """The causes by who has them."""
    return {p.where: p.cause for p in diagnose([Window("here", False, bus)]).problems}


def test_a_bus_in_order_has_no_problems() -> None:
    """Different names, right clocks, one version; a run and a router beside them."""
    bus = InProcessBus()
    assert problems(bus) == {"bus": "no slave is in sight"}
    for name in ("a", "b"):
        now = slave_status(name)
        answer = lambda now=now: encode_map(replace(now, time=time.time()).to_message())  # noqa: E731
        serve(bus, now, answer)
    for key, status in (
        (MasterKey("r"), MasterStatus("r", "host", 1, "car.toml", "a, b", 0.0, time.time())),
        (RouterKey("i"), RouterStatus("i", "host", 1, "", 0.0, time.time())),
    ):
        bus.serve(key.status, lambda _, status=status: encode_map(status.to_message()))
        bus.announce(key.alive)
    assert problems(bus) == {}
    diagnosis = diagnose([Window("here", False, bus)])
    assert [table.row_count for table in diagnosis.tables()] == [1, 4]


def test_every_fault_is_named() -> None:
    """Two of a name, another version, a wrong clock, no answer, no sense, a refusal of half."""
    bus = InProcessBus()
    serve(bus, slave_status("twin", "1"))
    serve(bus, slave_status("twin", "2"))
    old = {**slave_status("old").to_message(), "version": PROTOCOL_VERSION + 1}
    serve(bus, slave_status("old"), lambda: msgpack.packb(old))
    serve(bus, slave_status("late", time=time.time() - 3600.0))
    serve(bus, slave_status("odd"), lambda: b"\xc1")
    serve(bus, slave_status("crooked", time=math.nan))
    bus.announce(SlaveKey("mute", "0").alive)
    found = problems(bus)
    assert found.keys() == {f"slave {n}" for n in ("twin", "old", "late", "odd", "mute", "crooked")}
    assert found["slave twin"] == "there are 2 of this name"
    assert "version" in found["slave old"]
    assert found["slave late"].startswith("its clock is -3600.")
    assert "does not let us ask" in found["slave mute"]
    assert "no usable answer" in found["slave odd"]
    assert "clock" in found["slave crooked"]


# ---- The commands -------------------------------------------------------------------------------


@pytest.mark.slow
def test_list_and_doctor_through_a_router(start: Commands, tmp_path: Path, endpoint: str) -> None:
    """A free slave, one that is held, who holds it, and the router, as data and as tables."""
    through = ("--connect", endpoint, "--mode", "client")
    start("slave_node", "router", "--listen", endpoint)
    serve_words = ("slave_node", "serve")
    start(*serve_words, EXAMPLES / "quarter_car.py:Wheel", "--name", "spare", *through).wait_for(
        "ready"
    )
    start(*serve_words, EXAMPLES / "quarter_car.py:Wheel", "--name", "wheel", *through)
    file = system_file(tmp_path, wheel=None, simulation=FOREVER)
    master = start("master_node", "run", file, "--output", tmp_path / "out", *through)
    master.wait_for("simulating")
    listed = start("master_node", "list", "--connect", endpoint, "--json")
    assert listed.wait() == 0, listed.text
    data = json.loads(listed.text)
    slaves = {row["name"]: row for row in data["slaves"]}
    assert slaves.keys() == {"spare", "wheel", "chassis"}
    (run,) = data["runs"]
    (router,) = data["routers"]
    assert (run["system"], run["pid"]) == (str(file), master.process.pid)
    assert router["endpoints"] == f"at {endpoint}"
    assert data["silent"] == []
    assert (slaves["spare"]["state"], slaves["wheel"]["state"]) == ("free", "held")
    assert slaves["wheel"]["run"] == run["run"]
    assert abs(slaves["wheel"]["held_since"] - time.time()) < BOUND
    table = start("master_node", "list", "--connect", endpoint)
    assert table.wait() == 0
    assert f"held by run {run['run']} on " in table.text
    doctor = start("master_node", "doctor", "--connect", endpoint)
    assert doctor.wait() == 0, doctor.text
    assert "no problem found" in doctor.text


def test_a_slave_that_waits_for_a_master_is_seen(start: Commands, endpoint: str) -> None:
    """Where no router is: list takes the master's place for a moment."""
    wheel = EXAMPLES / "quarter_car.py:Wheel"
    start("slave_node", "serve", wheel, "--connect", endpoint).wait_for("ready")
    listed = start("master_node", "list", "--listen", endpoint, "--json")
    assert listed.wait() == 0, listed.text
    assert [row["name"] for row in json.loads(listed.text)["slaves"]] == ["Wheel"]


def test_the_doctor_says_why_nobody_is_reached(
    start: Commands, tmp_path: Path, endpoint: str
) -> None:
    """Exit code 1: nobody listens there, or somebody of another authority."""
    for name in ("ours", "theirs"):
        make_certificates(tmp_path / name, [Host.parse("here")], tuple(Role), 1)
    tls = ("--tls", tmp_path / "ours" / "here")
    empty = start("master_node", "doctor", "--connect", endpoint, *tls)
    assert empty.wait() == 1
    assert f"no connection to tls/{endpoint[4:]} within" in empty.text
    start("slave_node", "router", "--listen", endpoint, *tls).wait_for("ready")
    other = ("--tls", tmp_path / "theirs" / "here")
    doctor = start("master_node", "doctor", "--connect", endpoint, *other)
    assert doctor.wait() == 1
    assert "its certificate is not trusted" in doctor.text
