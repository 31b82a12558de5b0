"""Certificates: they admit to the bus or say why not, and decide what each peer may do."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import ssl
import stat
import threading
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from master_node import load_system, simulate
from master_node.slaves import remote as remote_slave
from protocol.bus.access import access_control
from protocol.bus.bus import Bus
from protocol.bus.credentials import Credentials, Role
from protocol.bus.endpoints import Endpoints, Mode, free_endpoint
from protocol.bus.reachability import Reach, probe, probe_without_tls
from protocol.bus.zenoh import ZenohBus
from protocol.errors import ConfigurationError, InterruptedRunError, SlaveLostError
from protocol.wire.administration import claim_name
from protocol.wire.keys import STATUS, MasterKey, SlaveKey, alive_slaves
from slave_node import certificates
from slave_node.certificates import Host, make_certificates
from tests.faults.test_network import Commands
from tests.faults.test_processes import system_file
from tests.master_node.resuming.test_resume import Interrupt
from tests.support.quarter_car_case import EXAMPLES
from tests.support.slow import quick_at
from tests.support.waiting import BOUND, wait_until

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="uses file modes"),
    pytest.mark.usefixtures("no_process_left"),
]


ROLES = tuple(Role)


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority with one host that may be anything."""
    folder = tmp_path_factory.mktemp("laboratory")
    make_certificates(folder, [Host.parse("here=127.0.0.1")], ROLES, 30)
    return folder / "here"


@pytest.fixture(scope="module")
def strangers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates of another authority."""
    folder = tmp_path_factory.mktemp("strangers")
    make_certificates(folder, [Host.parse("here")], ROLES, 30)
    return folder / "here"


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Commands]:
    """Starts commands; whatever is left is ended after the test."""
    commands = Commands(tmp_path)
    yield commands
    commands.close()


OpenBus = Callable[..., ZenohBus]


@pytest.fixture
def open_bus(laboratory: Path) -> Iterator[OpenBus]:
    """``open_bus(role, ...)``; closed after the test."""
    buses: list[ZenohBus] = []

    def make(role: Role, mode: Mode = Mode.PEER, folder: Path = laboratory, **where: str) -> Bus:
        endpoints = {name: (endpoint,) for name, endpoint in where.items()}
        buses.append(
            ZenohBus(
                Endpoints(**endpoints, mode=mode, credentials=Credentials(folder, role)),
                timeout=1.0,
            )
        )
        return buses[-1]

    yield make
    for bus in buses:
        bus.close()


# ---- Certificates -------------------------------------------------------------------------------


def test_certificates_are_made_once_and_keys_are_secret(tmp_path: Path) -> None:
    """Each host gets its roles and no more, keys are for the owner, no file is overwritten."""
    laboratory = tmp_path / "laboratory"
    first = Host.parse("laptop=10.0.0.1,laptop.example")
    assert make_certificates(laboratory, [first], [Role.MASTER, Role.ROUTER], 30) == [
        laboratory / "laptop"
    ]
    authority = (laboratory / "ca.pem").read_bytes()
    make_certificates(laboratory, [Host.parse("lab1"), Host.parse("lab2")], [Role.SLAVE], 30)
    assert (laboratory / "ca.pem").read_bytes() == authority
    names = {p.relative_to(laboratory).as_posix() for p in laboratory.rglob("*.pem")}
    assert names == {
        *("ca.pem", "ca-key.pem"),
        *("laptop/ca.pem", "laptop/master.pem", "laptop/master-key.pem"),
        *("laptop/router.pem", "laptop/router-key.pem"),
        *(f"lab{n}/{name}.pem" for n in (1, 2) for name in ("ca", "slave", "slave-key")),
    }
    for key in laboratory.rglob("*-key.pem"):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
    before = {path: path.read_bytes() for path in laboratory.rglob("*.pem")}
    with pytest.raises(ConfigurationError, match=r"lab1/slave\.pem is there already"):
        make_certificates(laboratory, [Host.parse("lab3"), Host.parse("lab1")], [Role.SLAVE], 30)
    assert before == {path: path.read_bytes() for path in laboratory.rglob("*.pem")}
    make_certificates(laboratory, [first], [Role.SLAVE], 30)
    for role in ROLES:
        assert Credentials(laboratory / "laptop", role).role is role


@pytest.mark.parametrize("text", ["", "../up", "a/b", "..", "a b", "lab=", "lab=a,,b", "lab=ä"])
def test_a_host_that_is_none(text: str, tmp_path: Path) -> None:
    """A name is data: it never becomes a path that leads elsewhere."""
    with pytest.raises(ConfigurationError):
        make_certificates(tmp_path / "laboratory", [Host.parse(text)], [Role.SLAVE], 30)
    assert not list(tmp_path.rglob("slave*.pem"))


def test_certificates_that_cannot_be_used_are_named(
    laboratory: Path, strangers: Path, tmp_path: Path
) -> None:
    """Missing, readable by others, of another authority, role or key: before anything opens."""

    def spoilt(name: str, source: Path) -> Path:
        folder = tmp_path / f"spoilt {len(list(tmp_path.iterdir()))}"
        folder.mkdir()
        for path in laboratory.glob("*.pem"):
            copy = folder / path.name
            copy.write_bytes((source if path.name == name else path).read_bytes())
            copy.chmod(0o600)
        return folder

    Credentials(spoilt("", laboratory), Role.SLAVE)
    for folder, message in (
        (tmp_path, r"ca\.pem is not there; make it with `slave-node certificates .* --role slave"),
        (spoilt("ca.pem", strangers / "ca.pem"), r"slave\.pem is not valid here: .*certificate"),
        (spoilt("slave-key.pem", laboratory / "master-key.pem"), r"cannot be read: .*mismatch"),
        (spoilt("slave.pem", laboratory / "ca.pem"), r"cannot be read"),
        (spoilt("slave.pem", Path(__file__)), r"cannot be read"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            Credentials(folder, Role.SLAVE)
    folder = spoilt("slave.pem", laboratory / "master.pem")
    (folder / "slave-key.pem").write_bytes((laboratory / "master-key.pem").read_bytes())
    with pytest.raises(ConfigurationError, match=r"has the common name 'master', not 'slave'"):
        Credentials(folder, Role.SLAVE)
    folder = spoilt("", laboratory)
    (folder / "slave-key.pem").chmod(0o640)
    with pytest.raises(ConfigurationError, match=r"can be read or written by others; chmod 600"):
        Credentials(folder, Role.SLAVE)


# ---- Who connects -------------------------------------------------------------------------------


def test_why_a_connection_does_not_come_about(
    open_bus: OpenBus, laboratory: Path, strangers: Path, endpoint: str
) -> None:
    """Reasons told: no listener, another authority, another name, a host without TLS."""
    secure = endpoint.replace("tcp/", "tls/")
    ours = Credentials(laboratory, Role.SLAVE)
    assert probe(secure, ours, 1.0).reach is Reach.NOT_REACHED
    open_bus(Role.MASTER, listen=endpoint)
    assert probe(secure, ours, 1.0).reach is Reach.REACHED
    theirs = probe(secure, Credentials(strangers, Role.SLAVE), 1.0)
    assert (theirs.reach, "its certificate is not trusted" in theirs.cause) == (Reach.REFUSED, True)
    with pytest.raises(ConfigurationError, match=r"certificates of both sides must come from one"):
        theirs.check()


def test_who_has_no_certificate_or_a_wrong_one_is_not_let_in(
    open_bus: OpenBus, laboratory: Path, strangers: Path, endpoint: str
) -> None:
    """The TLS handshake fails, whatever the other side thinks of ours."""
    open_bus(Role.MASTER, listen=endpoint)
    host, port = endpoint.removeprefix("tcp/").split(":")
    for folder in (None, strangers):
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.load_verify_locations(laboratory / "ca.pem")
        if folder is not None:
            context.load_cert_chain(folder / "slave.pem", folder / "slave-key.pem")
        with (
            socket.create_connection((host, int(port)), BOUND) as connection,
            pytest.raises(ssl.SSLError, match=r"(?i)unknown ca|certificate required"),
            context.wrap_socket(connection, server_hostname=host) as secure,
        ):
            secure.recv(1)
    with pytest.raises(ConfigurationError, match="not trusted"):
        open_bus(Role.SLAVE, folder=strangers, connect=endpoint)
    with pytest.raises(ConfigurationError, match="not trusted"):
        open_bus(Role.SLAVE, Mode.CLIENT, strangers, connect=endpoint)
    with pytest.raises(ConfigurationError, match=r"speaks TLS, and this side does not; .*--tls"):
        ZenohBus(Endpoints(connect=(endpoint,), mode=Mode.CLIENT), timeout=BOUND)


def test_who_speaks_no_tls_is_told_so(
    open_bus: OpenBus, endpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    """A peer tries again for ever; it says why in vain, and once. To a peer it says nothing."""
    open_bus(Role.MASTER, listen=endpoint)
    plain = free_endpoint()
    buses = [ZenohBus(Endpoints(listen=(plain,))), ZenohBus(Endpoints(connect=(plain, endpoint)))]
    try:
        wait_until(lambda: "speaks TLS" in caplog.text)
        (message,) = (record.getMessage() for record in caplog.records)
        assert re.match(
            rf"connect: {endpoint}: it speaks TLS, and this side does not; name", message
        )
    finally:
        for bus in buses:
            bus.close()
    assert probe_without_tls(endpoint, BOUND).reach is Reach.IS_TLS
    assert probe_without_tls(free_endpoint(), BOUND).reach is Reach.NOT_REACHED
    with socket.create_server(("127.0.0.1", 0)) as silent:
        where = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        assert probe_without_tls(where, BOUND).reach is Reach.REACHED


class LongAgo(datetime):
    """The clock of certificates that have expired."""

    @classmethod
    def now(cls, tz: Any = None) -> datetime:
        """Two years before."""
        return datetime.now(tz) - timedelta(days=730)


WRONG = {
    "expired": r"certificate has expired",
    "of another name": r"IP address mismatch",
}


@pytest.fixture
def wrong(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[Path, Path]:
    """Certificates of one authority: those of a host that are wrong, and right ones."""
    folder = tmp_path / "laboratory"
    make_certificates(folder, [Host.parse("right")], ROLES, 30)
    if request.param == "expired":
        monkeypatch.setattr(certificates, "datetime", LongAgo)
    else:
        monkeypatch.setattr(certificates, "_LOOPBACK", ())
    make_certificates(folder, [Host.parse("wrong=elsewhere.example")], ROLES, 30)
    return folder / "wrong", folder / "right"


def tls_context(folder: Path, role: Role, *, server: bool) -> ssl.SSLContext:
    """One end of a connection, whatever its certificate is like."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if server else ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(folder / "ca.pem")
    context.load_cert_chain(folder / f"{role}.pem", folder / f"{role}-key.pem")
    context.verify_mode = ssl.CERT_REQUIRED
    return context


@pytest.mark.parametrize("wrong", WRONG, indirect=True)
def test_a_certificate_that_is_wrong_is_told_to_who_connects(
    wrong: tuple[Path, Path], request: pytest.FixtureRequest
) -> None:
    """With the reason; not its authority but its time or its name is what is wrong."""
    theirs, ours = wrong
    cause = WRONG[request.node.callspec.params["wrong"]]
    context = tls_context(theirs, Role.ROUTER, server=True)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        where = f"tls/127.0.0.1:{listening.getsockname()[1]}"

        def serve() -> None:
            connection, _ = listening.accept()
            with connection, suppress(OSError):
                context.wrap_socket(connection, server_side=True).close()

        server = threading.Thread(target=serve)
        server.start()
        found = probe(where, Credentials(ours, Role.SLAVE), BOUND)
        server.join(BOUND)
    assert found.reach is Reach.REFUSED
    with pytest.raises(ConfigurationError, match=rf"its certificate is not trusted: .*{cause}"):
        found.check()


@pytest.mark.parametrize("wrong", ["expired"], indirect=True)
def test_an_expired_certificate_lets_nobody_in(
    wrong: tuple[Path, Path], open_bus: OpenBus, endpoint: str
) -> None:
    """Neither who uses it as we do, which says so before anything opens, nor who does not look."""
    theirs, ours = wrong
    for role in ROLES:
        with pytest.raises(
            ConfigurationError, match=r"not valid here: certificate has expired.*clock"
        ):
            Credentials(theirs, role)
    open_bus(Role.MASTER, folder=ours, listen=endpoint)
    host, port = endpoint.removeprefix("tcp/").split(":")
    context = tls_context(theirs, Role.SLAVE, server=False)
    with (
        socket.create_connection((host, int(port)), BOUND) as connection,
        pytest.raises(ssl.SSLError, match=r"(?i)certificate expired"),
        context.wrap_socket(connection, server_hostname=host) as secure,
    ):
        secure.recv(1)


def raw_session(folder: Path, name: str, endpoint: str) -> zenoh.Session:
    """Zenoh with a certificate, without our software around it."""
    config, tls = zenoh.Config(), "transport/link/tls"
    for key, value in {
        "mode": "client",
        "connect/endpoints": [endpoint.replace("tcp/", "tls/")],
        "scouting/multicast/enabled": False,
        f"{tls}/root_ca_certificate": str(folder / "ca.pem"),
        f"{tls}/connect_certificate": str(folder / f"{name}.pem"),
        f"{tls}/connect_private_key": str(folder / f"{name}-key.pem"),
        f"{tls}/enable_mtls": True,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@pytest.mark.parametrize("name", ["", "admin", "Master", "master,slave"])
def test_a_certificate_without_a_role_is_good_for_nothing(
    name: str, open_bus: OpenBus, tmp_path: Path, endpoint: str
) -> None:
    """A valid certificate of our authority, nameless or of another name: not heard, not told."""
    laboratory = tmp_path / "laboratory"
    make_certificates(laboratory, [Host.parse("here")], ROLES, 30)
    folder = laboratory / "here"
    authority = certificates._Authority.at(laboratory)
    key = ec.generate_private_key(ec.SECP256R1())
    with pytest.MonkeyPatch.context() as patch:
        if not name:
            patch.setattr(NameOID, "COMMON_NAME", NameOID.LOCALITY_NAME)
        made = authority.sign(name or "x", Host.parse("here"), key.public_key(), 30)  # type: ignore[arg-type]
    (folder / "odd.pem").write_bytes(made)
    (folder / "odd-key.pem").write_bytes(certificates._key_pem(key))
    (folder / "odd-key.pem").chmod(0o600)
    for path in ("odd.pem", "odd-key.pem"):
        (folder / path.replace("odd", "slave")).write_bytes((folder / path).read_bytes())
    with pytest.raises(ConfigurationError, match=rf"has the common name '{name}', not 'slave'"):
        Credentials(folder, Role.SLAVE)
    router = open_bus(Role.ROUTER, Mode.ROUTER, folder, listen=endpoint)
    master = open_bus(Role.MASTER, Mode.CLIENT, folder, connect=endpoint)
    serve_status(router, SLAVES[0])
    wait_until(lambda: ask(master, SLAVES[0]) == b"a")
    with raw_session(folder, "odd", endpoint) as session:
        token = session.liveliness().declare_token(SLAVES[1].alive)
        session.declare_queryable(
            SLAVES[1].verb(STATUS), lambda query: query.reply(query.key_expr, b"odd")
        )
        heard = list(session.get(SLAVES[0].verb(STATUS), timeout=1.0))
        assert not [reply.ok for reply in heard if reply.ok is not None]
        tokens = list(session.liveliness().get(alive_slaves(), timeout=1.0))
        seen = {str(reply.ok.key_expr) for reply in tokens if reply.ok is not None}
        assert seen <= {SLAVES[1].alive}  # its own
        assert ask(master, SLAVES[1]) is None
        assert SLAVES[1].alive not in master.alive(alive_slaves(), BOUND)
        assert token is not None


# ---- What each may do ---------------------------------------------------------------------------

SLAVES = [SlaveKey(name, "0") for name in ("a", "b")]


def serve_status(bus: Bus, key: SlaveKey) -> None:
    """A slave that answers its name."""
    bus.serve(key.verb(STATUS), lambda _: key.name.encode())
    bus.announce(key.alive)


def ask(bus: Bus, key: SlaveKey) -> bytes | None:
    """Answer of a slave; None when there is none."""
    try:
        return bus.caller(key.verb(STATUS), 2.0).request(b"")
    except SlaveLostError:
        return None


@pytest.mark.parametrize("middle", [Role.MASTER, Role.ROUTER])
def test_masters_ask_slaves_and_slaves_ask_nobody(
    middle: Role, open_bus: OpenBus, endpoint: str
) -> None:
    """Through a router as directly, and when a slave's own software does not keep to the rules."""
    where = {"connect": endpoint}
    if middle is Role.ROUTER:
        open_bus(Role.ROUTER, Mode.ROUTER, listen=endpoint)
        master = open_bus(Role.MASTER, Mode.CLIENT, **where)
    else:
        master = open_bus(Role.MASTER, listen=endpoint)
    buses = [open_bus(Role.SLAVE, Mode.CLIENT, **where) for _ in SLAVES]
    for bus, key in zip(buses, SLAVES, strict=True):
        serve_status(bus, key)
    master.announce(MasterKey("r").alive)
    wait_until(lambda: len(master.alive(alive_slaves(), BOUND)) == 2)
    assert [ask(master, key) for key in SLAVES] == [b"a", b"b"]
    assert buses[0].alive(MasterKey("*").alive, BOUND) == [MasterKey("r").alive]
    assert ask(buses[0], SLAVES[1]) is None
    assert ask(buses[1], SLAVES[0]) is None
    # A slave cannot pose as a master, nor serve where only masters do.
    buses[0].announce(MasterKey("false").alive)
    buses[0].serve(MasterKey("false").status, bytes)
    assert ask(master, SLAVES[0]) == b"a"
    assert MasterKey("false").alive not in master.alive(MasterKey("*").alive, BOUND)


def test_the_rules_name_every_role_and_deny_what_they_do_not_name() -> None:
    """The table of `protocol.bus.access` is what Zenoh gets; publications are for nobody."""
    rules = access_control()
    assert rules["default_permission"] == "deny"
    assert {s["id"] for s in rules["subjects"]} == set(Role)
    incoming = [rule for rule in rules["rules"] if "ingress" in rule["flows"]]
    assert not {"put", "delete"} & {m for rule in incoming for m in rule["messages"]}
    (slave,) = (p for p in rules["policies"] if p["subjects"] == ["slave"])
    allowed = {m for rule in incoming if rule["id"] in slave["rules"] for m in rule["messages"]}
    assert "query" not in allowed


# ---- Whole runs ---------------------------------------------------------------------------------


@pytest.mark.parametrize("way", quick_at(["router"], ["direct", "router"]))
def test_a_run_over_tls_has_the_same_bits(
    way: str, start: Commands, laboratory: Path, tmp_path: Path, endpoint: str
) -> None:
    """One slave by hand, one launched, with the results of a run in process."""
    tls = ("--tls", laboratory)
    through: tuple[str, ...] = ("--connect", endpoint)
    if way == "router":
        start("slave_node", "router", "--listen", endpoint, *tls)
        through = (*through, "--mode", "client")
    wheel = ("serve", EXAMPLES / "quarter_car.py:Wheel", "--name", "wheel")
    slave = start("slave_node", *wheel, *through, *tls)
    bus = f'mode = "client"\nconnect = ["{endpoint}"]\n' if way == "router" else ""
    file = system_file(tmp_path, wheel=None, bus=f'{bus}tls = "{laboratory}"\n')
    listen = () if way == "router" else ("--listen", endpoint)
    master = start("master_node", "run", file, "--no-plot", "--output", tmp_path / "out", *listen)
    assert master.wait() == 0, master.text
    slave.wait_for("released by")
    (tmp_path / "reference").mkdir()
    file = system_file(tmp_path / "reference")
    simulate(load_system(file), output=tmp_path / "same", in_process=True)
    assert (tmp_path / "out" / "results.csv").read_bytes() == (
        tmp_path / "same" / "results.csv"
    ).read_bytes()


def test_no_secret_is_written(
    laboratory: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Law: no key, no secret of a claim and no epoch is in a result, checkpoint, trace or log."""
    secrets, names = {"a secret of the test"}, set[str]()

    def named(epoch: int) -> str:
        secrets.add(str(epoch))
        names.add(claim_name(epoch))
        return claim_name(epoch)

    for path in laboratory.glob("*-key.pem"):
        secrets |= {line for line in path.read_text().splitlines() if not line.startswith("-")}
    monkeypatch.setattr(remote_slave, "token_hex", lambda _: "a secret of the test")
    monkeypatch.setattr(remote_slave, "claim_name", named)
    simulation = "stop_time = 1.0\ncheckpoint_interval = 1e-6\n"
    system = load_system(
        system_file(tmp_path, simulation=simulation, bus=f'tls = "{laboratory}"\n')
    )
    where: dict[str, Any] = {"output": tmp_path / "out", "trace": tmp_path / "out" / "trace.json"}
    with pytest.raises(InterruptedRunError):
        simulate(system, observers=(Interrupt(9),), **where)
    assert len(names) == 2
    written = {path.name: path.read_bytes() for path in where["output"].rglob("*.*")}
    with zipfile.ZipFile(where["output"] / "checkpoint" / "run.zip") as archive:
        written |= {name: archive.read(name) for name in archive.namelist()}
    written["standard output and error"] = "".join(capfd.readouterr()).encode()
    assert written.keys() >= {"trace.json", "summary.json", "system.json", "run.json", "wheel.log"}
    assert all(name.encode() in written["trace.json"] for name in names)
    found = [(name, s) for name, data in written.items() for s in secrets if s.encode() in data]
    assert not found


def test_a_slave_of_another_laboratory_is_refused(
    start: Commands, laboratory: Path, strangers: Path, tmp_path: Path, endpoint: str
) -> None:
    """It ends with exit code 2 and says why; one that waited says it when the master comes."""
    slave = ("slave_node", "serve", EXAMPLES / "quarter_car.py:Wheel", "--name", "wheel")
    where = ("--connect", endpoint, "--tls", strangers)
    early = start(*slave, *where)
    early.wait_for("ready")
    file = system_file(tmp_path, wheel=None)
    master = start(
        *(
            "master_node",
            "run",
            file,
            "--no-plot",
            "--output",
            tmp_path / "out",
            "--listen",
            endpoint,
        ),
        *("--tls", laboratory, "--timeout", "3600"),
    )
    early.wait_for("its certificate is not trusted")
    late = start(*slave, *where)
    assert late.wait() == 2, late.text
    last = late.text.splitlines()[-1]
    assert re.match(rf"slave-node: connect: tls/{endpoint[4:]}: its certificate is not", last), last
    master.send(signal.SIGINT)
    assert master.wait() == 130, master.text
    assert "interrupted before the first step" in master.text
