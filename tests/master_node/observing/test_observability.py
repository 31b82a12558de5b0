"""Views of a run while it goes on: structured logs, metrics, traces, and slow slaves."""

from __future__ import annotations

import io
import json
import logging
import os
import re
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
from rich.console import Console

from master_node import Result, load_system, simulate
from master_node.observing import progress
from master_node.observing.observers import (
    Attempt,
    Exchange,
    Outcome,
    RunEnd,
    RunStart,
    SlaveStatistics,
    Statistics,
)
from master_node.observing.progress import ProgressBar
from master_node.results.trace import TraceWriter
from master_node.slaves.group import SlaveGroup
from protocol.calls import DoStep, GetOutputs, GetState, Reply, SetState, StepResult, StepStatus
from protocol.errors import ConfigurationError, ResultsError, SlaveCrashedError, SlaveError
from protocol.host.logs import LogFormat, about, add_log_fields, configure_logs
from protocol.host.metrics import Metric, metrics_served
from protocol.wire.programs import encode_program
from protocol.wire.replies import encode_error, encode_reply
from slave_node.serving.metrics import CountingWorker
from tests.faults.test_processes import EXAMPLES, FOREVER, Command, has_stepped, start, system_file
from tests.support.places import SUPPORT
from tests.support.slow import quick_at
from tests.support.waiting import BOUND, wait_until

__all__ = ["start"]  # the fixture

Start = Callable[..., Command]

pytestmark = pytest.mark.usefixtures("no_process_left")


# ---- Logs --------------------------------------------------------------------------------------


@pytest.fixture
def restored_logging() -> Iterator[None]:
    """The loggers as they were."""
    root = logging.getLogger()
    loggers = [root, *map(logging.getLogger, ("protocol", "slave_node", "master_node"))]
    handlers, levels = root.handlers[:], [logger.level for logger in loggers]
    yield
    root.handlers[:] = handlers
    for logger, level in zip(loggers, levels, strict=True):
        logger.setLevel(level)


def test_a_json_line_says_where_it_belongs(
    restored_logging: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """One object a line, also for texts with line ends; numbers that JSON lacks become texts."""
    configure_logs(LogFormat.JSON, "", slave="wheel")
    add_log_fields(run="0123abcd")
    error = SlaveError("broke\ndown", slave="chassis", phase="do_step", time=0.5, step_size=1e-3)
    log = logging.getLogger("master_node")
    log.error("%s", error, extra=about(error))
    log.warning("odd", extra={"t": float("inf"), "request": "3:17"})
    first, second = map(json.loads, capsys.readouterr().err.splitlines())
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}[+-]\d\d:\d\d", first.pop("time"))
    assert first == {
        "level": "error",
        "logger": "master_node",
        "message": str(error),
        "slave": "chassis",
        "run": "0123abcd",
        "phase": "do_step",
        "t": 0.5,
        "H": 1e-3,
    }
    assert (second["slave"], second["t"], second["request"]) == ("wheel", "inf", "3:17")


def test_text_is_as_it_was(restored_logging: None, capsys: pytest.CaptureFixture[str]) -> None:
    """The fields are for programs."""
    configure_logs(LogFormat.TEXT, "%(levelname)s: %(message)s")
    add_log_fields(run="0123abcd")
    logging.getLogger("master_node").info("hello", extra={"slave": "wheel"})
    assert capsys.readouterr().err == "INFO: hello\n"


def test_libraries_are_heard_when_they_warn(
    restored_logging: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """Messages of libraries below a warning are not told, such as of a list of fonts."""
    configure_logs(LogFormat.TEXT, "%(levelname)s: %(message)s")
    for name in ("matplotlib.font_manager", "master_node", "slave_node.fmu", "protocol"):
        logging.getLogger(name).info("of %s", name)
    logging.getLogger("matplotlib.font_manager").warning("no font")
    told = ["INFO: of master_node", "INFO: of slave_node.fmu", "INFO: of protocol"]
    assert capsys.readouterr().err.splitlines() == [*told, "WARNING: no font"]


@pytest.mark.skipif(os.name != "posix", reason="uses signals")
def test_master_and_slave_log_json(start: Start, tmp_path: Path, endpoint: str) -> None:
    """Every line of standard error is an object; claim and crash name run, slave and request."""
    where = ("--connect", endpoint, "--log-format", "json")
    slaves = [
        start("slave_node", "serve", EXAMPLES / f"quarter_car.py:{n.title()}", "--name", n, *where)
        for n in ("chassis", "wheel")
    ]
    file = system_file(tmp_path, None, None, simulation=FOREVER + 'recovery = "off"\n')
    master = start(
        *("master_node", "run", file, "--no-plot", "--listen", endpoint, "--log-format", "json"),
        *("--output", tmp_path / "out"),
    )
    slaves[1].wait_for("claimed by")
    wait_until(lambda: has_stepped(tmp_path / "out"))
    (worker,) = [c for c in slaves[1].process.children() if "spawn_main" in " ".join(c.cmdline())]
    worker.kill()
    assert master.wait() == 3
    slaves[1].wait_for("released by")
    last = json.loads(master.text.splitlines()[-1])
    assert (last["level"], last["slave"], last["phase"]) == ("error", "wheel", "do_step")
    assert last["t"] > 0.0
    assert last["H"] > 0.0
    lines = [json.loads(line) for line in slaves[1].text.splitlines()]
    assert {line["slave"] for line in lines} == {"wheel"}
    (claimed,) = [line for line in lines if line["message"].startswith("claimed by")]
    (crashed,) = [line for line in lines if "SIGKILL" in line["message"]]
    assert claimed["run"] == crashed["run"] == last["run"]
    assert re.fullmatch(r"[0-9a-f]{8}:\d+", crashed["request"])
    assert crashed["level"] == "error"


@pytest.mark.skipif(os.name != "posix", reason="uses signals")
@pytest.mark.slow
def test_agent_and_router_log_json(start: Start, tmp_path: Path, endpoint: str) -> None:
    """From their first line to their last."""
    servers = [
        start("slave_node", "router", "--listen", endpoint, "--log-format", "json"),
        start(
            *("slave_node", "agent", "--models", tmp_path, "--name", "bench-7"),
            *("--mode", "client", "--connect", endpoint, "--log-format", "json"),
        ),
    ]
    for server in servers:
        server.wait_for("ready: ")
    for server in reversed(servers):
        server.process.terminate()
        assert server.wait() == 0
        messages = [json.loads(line)["message"] for line in server.text.splitlines()]
        assert messages[-1] == "ended"


# ---- Metrics -----------------------------------------------------------------------------------


def scraped(url: str) -> dict[str, float]:
    """The samples at a URL, by name with labels."""
    with urlopen(url, timeout=BOUND) as answer:
        text = answer.read().decode()
    rows = [line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#")]
    return {name: float(value) for name, value in rows}


def test_metrics_are_read_when_they_are_asked_for() -> None:
    """Each scrape has the numbers of now; nothing listens after."""
    count = [0]

    def read() -> Iterator[Metric]:
        count[0] += 1
        yield Metric("requests", "in words", "counter", {"wheel": count[0], "chassis": 7.0})
        yield Metric("step_size_seconds", "in words", "gauge", {"": 1e-3})

    with metrics_served(0, "127.0.0.1", read) as url:
        scraped(url)
        before = count[0]
        samples = scraped(url)
        assert samples == {
            'doublestep_requests_total{slave="wheel"}': before + 1,
            'doublestep_requests_total{slave="chassis"}': 7.0,
            "doublestep_step_size_seconds": 1e-3,
        }
    with pytest.raises(OSError, match=r"refused|[Ee]rror"):
        scraped(url)


def test_a_port_in_use_is_named() -> None:
    """The user's mistake, with the remedy."""
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        pytest.raises(ConfigurationError, match=r"cannot serve metrics at .*--metrics-port"),
        metrics_served(server.getsockname()[1], "127.0.0.1", lambda: ()),
    ):
        pass


class _Scripted:
    """A worker that gives the replies it was told to."""

    def __init__(self, *replies: bytes | Exception) -> None:
        self._replies = list(replies)

    def execute(self, program: bytes) -> bytes:
        reply = self._replies.pop(0)
        if isinstance(reply, Exception):
            raise reply
        return reply


def test_a_slave_counts_what_goes_through_it() -> None:
    """Steps, rollbacks, states, failures and times, from the messages alone."""
    calls = [GetState(0), DoStep(0.0, 0.25), GetState(1), SetState(0), DoStep(0.0, 0.125)]
    done = [None, StepResult(StepStatus.OK, 0.25), None, None, StepResult(StepStatus.OK, 0.125)]
    worker = CountingWorker(
        _Scripted(  # type: ignore[arg-type]
            encode_reply(Reply(done, None, 0.5)),
            encode_reply(Reply([], SlaveError("no"), 0.25)),
            SlaveCrashedError("gone"),
            encode_error(SlaveError("no program")),
        ),
        "wheel",
    )
    worker.execute(encode_program(calls))
    worker.execute(encode_program([GetOutputs()]))
    with pytest.raises(SlaveCrashedError):
        worker.execute(encode_program([GetOutputs()]))
    worker.execute(b"\xc1")
    numbers = {metric.name: metric.values["wheel"] for metric in worker.read()}
    assert numbers == {
        "requests": 4.0,
        "failed_requests": 3.0,
        "do_steps": 2.0,
        "rollbacks": 1.0,
        "compute_seconds": 0.75,
        "saved_states": 2.0,
        "time_seconds": 0.125,
        "step_size_seconds": 0.125,
    }


def test_a_stranger_at_the_metrics_port_takes_little() -> None:
    """Connections that say nothing are few and end; other methods and paths give nothing else."""
    threads = threading.active_count()
    with metrics_served(0, "127.0.0.1", lambda: (Metric("a", "b", "gauge", {"": 1.0}),)) as url:
        port = int(url.split(":")[2].split("/")[0])
        silent = [socket.create_connection(("127.0.0.1", port), 10.0) for _ in range(64)]
        try:
            turned_away = [s for s in silent if _has_ended(s)]
            assert len(turned_away) >= 40
            assert threading.active_count() <= threads + 1 + 16
            for connection in silent:
                connection.close()
            wait_until(lambda: b"doublestep_a 1.0" in _said(port, b"GET /metrics"))
            assert b"doublestep_a 1.0" in _said(port, b"GET /../../../etc/passwd")
            for line in (b"POST /metrics", b"DELETE /", b"\xff\x00", b"GET " + b"/" * 70_000):
                assert b"doublestep_a" not in _said(port, line)
        finally:
            for connection in silent:
                connection.close()
    wait_until(lambda: threading.active_count() <= threads)


def _has_ended(connection: socket.socket) -> bool:
    connection.settimeout(0.2)
    try:
        return connection.recv(1) == b""
    except TimeoutError:
        return False
    except ConnectionError:
        return True


def _said(port: int, line: bytes) -> bytes:
    """The answer to a request, whatever it is."""
    with socket.create_connection(("127.0.0.1", port), 10.0) as connection, suppress(OSError):
        connection.sendall(line + b" HTTP/1.0\r\n\r\n")
        answer = b""
        while piece := connection.recv(65536):
            answer += piece
        return answer
    return b""


@pytest.mark.skipif(os.name != "posix", reason="uses signals")
def test_metrics_of_a_run(start: Start, tmp_path: Path, endpoint: str) -> None:
    """Master and slave serve them on loopback, grow, and agree at the end of the run."""
    slave = start(
        *("slave_node", "serve", EXAMPLES / "quarter_car.py:Wheel", "--name", "wheel"),
        *("--connect", endpoint, "--metrics-port", "0"),
    )
    file = system_file(tmp_path, wheel=None, simulation=FOREVER)
    master = start(
        *("master_node", "run", file, "--no-plot", "--listen", endpoint, "--metrics-port", "0"),
        *("--output", tmp_path / "out"),
    )
    urls = []
    for command in (master, slave):
        command.wait_for("metrics at")
        urls.append(re.findall(r"metrics at (http://127\.0\.0\.1:\d+/metrics)", command.text)[0])
    attempts = "doublestep_attempts_total"
    wait_until(lambda: scraped(urls[0])[attempts] > 10)
    first, then = scraped(urls[0]), scraped(urls[0])
    assert first[attempts] <= then[attempts]
    assert then["doublestep_simulated_time_seconds"] > 0.0
    assert then["doublestep_step_size_seconds"] > 0.0
    assert then['doublestep_compute_seconds_total{slave="wheel"}'] > 0.0
    assert scraped(urls[1])['doublestep_saved_states{slave="wheel"}'] in (1.0, 2.0)
    master.send(signal.SIGINT)
    assert master.wait() == 130
    summary = Result.load(tmp_path / "out").summary
    steps = scraped(urls[1])['doublestep_do_steps_total{slave="wheel"}']
    assert steps >= summary["do_steps"]["wheel"]
    slave.send(signal.SIGTERM)
    assert slave.wait() == 0


# ---- Traces ------------------------------------------------------------------------------------


def events_of(path: Path) -> list[dict[str, Any]]:
    """The events in a trace; it must be whole JSON."""
    events = json.loads(path.read_text())
    assert isinstance(events, list)
    return events


def rows_of(events: list[dict[str, Any]]) -> dict[str, int]:
    """The row of each name."""
    return {e["args"]["name"]: e["tid"] for e in events if e["name"] == "thread_name"}


@pytest.mark.parametrize("in_process", [True, False], ids=["in process", "over Zenoh"])
def test_a_trace_has_every_request(in_process: bool, tmp_path: Path) -> None:
    """A row for each slave; computing lies within its request, requests within a round trip."""
    system = load_system(EXAMPLES / "displacement_force_python.toml")
    path = tmp_path / "sub" / "trace.json"
    result = simulate(
        system,
        stop_time=0.05,
        examine=False,
        initial_step_size=1e-3,
        in_process=in_process,
        trace=path,
    )
    events = events_of(path)
    rows = rows_of(events)
    assert set(rows) == {"master", "chassis", "wheel"}
    spans = [e for e in events if e["ph"] == "X"]
    trips = [e for e in spans if e["name"] == "round trip"]
    assert len([e for e in spans if e["name"] == "double step"]) == result.steps["accepted"].sum()
    assert len([e for e in spans if "double step" in e["name"]]) == len(result.steps)
    for slave in ("chassis", "wheel"):
        mine = [e for e in spans if e["tid"] == rows[slave]]
        requests = [e for e in mine if e["name"] != "compute"]
        computed = [e for e in mine if e["name"] == "compute"]
        steps = [e for e in requests if "do_step" in e["name"]]
        assert len(steps) == result.summary["requests"][slave]
        assert len(computed) == len(requests)
        for request, compute in zip(requests, computed, strict=True):
            assert_within(compute, request)
            assert any(is_within(request, trip) for trip in trips)
        total = sum(e["dur"] for e in computed) * 1e-6
        assert total >= 0.5 * result.summary["compute_time"][slave]
        numbers = [e["args"]["request"] for e in requests]
        if in_process:
            assert set(numbers) == {""}
        else:  # one claim, and no request left out
            claim, _, first = numbers[0].partition(":")
            assert numbers == [f"{claim}:{int(first) + i}" for i in range(len(requests))]
        assert all(e["args"]["H"] > 0.0 and e["args"]["t"] >= 0.0 for e in steps)


def is_within(inner: dict[str, Any], outer: dict[str, Any]) -> bool:
    """Up to what numbers in microseconds lose."""
    return bool(
        inner["ts"] >= outer["ts"] - 1e-3
        and inner["ts"] + inner["dur"] <= outer["ts"] + outer["dur"] + 1e-3
    )


def assert_within(inner: dict[str, Any], outer: dict[str, Any]) -> None:
    """Asserts that one span is within another."""
    assert is_within(inner, outer), (inner, outer)


@pytest.mark.skipif(os.name != "posix", reason="uses signals")
@pytest.mark.parametrize("number", quick_at([signal.SIGKILL], [signal.SIGINT, signal.SIGKILL]))
def test_a_trace_is_whole_whatever_ends_the_run(
    number: signal.Signals, start: Start, tmp_path: Path
) -> None:
    """Interrupted or killed: the file is JSON, with what was written until then."""
    path = tmp_path / "trace.json"
    master = start(
        *("master_node", "run", system_file(tmp_path, simulation=FOREVER), "--trace", path),
        *("--output", tmp_path / "out"),
    )
    master.wait_for("simulating")
    wait_until(lambda: path.stat().st_size > 20_000)
    master.send(number)
    master.wait()
    events = events_of(path)
    assert len(events) > 50
    if number is signal.SIGINT:
        (end,) = [e for e in events if e["ph"] == "i"]
        assert end["name"] == "interrupted"


def test_a_trace_survives_strange_names_and_numbers(tmp_path: Path) -> None:
    """A failed request has no time to compute, and JSON has no infinity."""
    writer = TraceWriter(tmp_path / "trace.json")
    nan = float("nan")
    exchange = Exchange('a "b"\n', "1:2", (DoStep(0.0, nan),), 1.0, 2.0, nan, 0.0, nan, "no reply")
    writer.exchanged(0.5, 2.5, [exchange])
    writer.close()
    writer.close()
    (request,) = [e for e in events_of(tmp_path / "trace.json") if e["name"] == "do_step"]
    assert request["dur"] == 1e6
    assert request["args"] == {
        **{"request": "1:2", "calls": 1, "t": 0.0, "H": "nan", "error": "no reply"}
    }


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_trace_on_a_full_disk_is_an_error() -> None:
    """The error names the file."""
    with pytest.raises(ResultsError, match="/dev/full"):
        TraceWriter(Path("/dev/full"))


# ---- Who is slow -------------------------------------------------------------------------------


class _Link:
    """A slave that takes a while and says how long it computed."""

    request = ""

    def __init__(self, take: float, compute: float) -> None:
        self._take = take
        self._compute = compute

    def start(self, calls: object) -> None:
        """Sent at once."""

    def finish(self) -> Reply:
        """Answered later."""
        time.sleep(self._take)
        return Reply([None], None, self._compute)


def test_time_is_split_into_computing_and_the_way() -> None:
    """Time of a request beyond the slave's own is transport, and never negative."""
    group = SlaveGroup({"a": _Link(0.05, 0.03), "b": _Link(0.0, 5.0)})  # type: ignore[dict-item]
    group.execute([(GetState(0),)] * 2)
    a, b = group.statistics["a"], group.statistics["b"]
    assert a.request_time >= 0.05
    assert a.transport_time == pytest.approx(a.request_time - 0.03)
    assert (b.compute_time, b.transport_time) == (5.0, 0.0)


def test_the_summary_has_the_times_of_each_slave(tmp_path: Path) -> None:
    """None is negative or more than the master waited, and in process no two slaves compute at
    once.
    """
    system = load_system(EXAMPLES / "displacement_force_python.toml")
    summary = simulate(system, stop_time=0.2, in_process=True, order=1).summary
    for slave in ("chassis", "wheel"):
        assert summary["transport_time"][slave] >= 0.0
        assert summary["compute_time"][slave] > 0.0
        taken = summary["transport_time"][slave] + summary["compute_time"][slave]
        assert taken <= summary["wait_time"] * (1.0 + 1e-9)
    assert sum(summary["compute_time"].values()) <= summary["wait_time"] * (1.0 + 1e-9)


def test_the_progress_names_the_slowest_slave_and_its_share(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a terminal while the run goes on, elsewhere in the last line."""
    monkeypatch.setattr(progress, "UPDATE_INTERVAL", -1.0)
    slaves = {"fast": SlaveStatistics(compute_time=0.1), "slow": SlaveStatistics(compute_time=0.6)}
    statistics = Statistics(wall_time=1.0, time=2.0, slaves=slaves)
    start_of_run = RunStart((), (), 0.0, 2.0, np.zeros(0), statistics=slaves)
    for terminal, expected in (
        (False, r"completed .*, 1 s, slowest: slow 60%$"),
        (True, r"H = 5\.00e-01 s .* 0 rejected  slowest: slow \d+%"),
    ):
        out = io.StringIO()
        bar = ProgressBar(console=Console(file=out, force_terminal=terminal, width=200))
        bar.started(start_of_run)
        bar.attempted(Attempt(0.0, 0.5, 1, 0, 0.3, True, "slow.x", ()))
        bar.ended(RunEnd(Outcome.COMPLETED, statistics))
        assert re.search(expected, out.getvalue(), re.MULTILINE), out.getvalue()


@pytest.mark.skipif(os.name != "posix", reason="uses processes")
@pytest.mark.slow
def test_a_slow_slave_is_named_at_the_end_of_a_run(start: Start, tmp_path: Path) -> None:
    """It takes nearly all of the time; nothing times out but what the user said."""
    models = SUPPORT / "quarter_car_models.py"
    file = system_file(
        tmp_path,
        f"{models}:Sleeper",
        simulation="stop_time = 0.01\nestimator = 'none'\norder = 0\nexamine = false\n",
        chassis_parameters={"nap": 0.01},
    )
    master = start("master_node", "run", file, "--no-plot", "--output", tmp_path / "out")
    assert master.wait() == 0, master.text
    (share,) = re.findall(r"slowest: chassis (\d+)%", master.text)
    assert int(share) > 50
