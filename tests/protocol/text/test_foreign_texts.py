"""Texts of others on our terminal: every command of both programs shows them and obeys none."""

from __future__ import annotations

import ast
import json
import logging
import os
import shutil
import signal
import sys
import unicodedata
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

import master_node.cli.app
import slave_node.cli.app
from protocol.bus.bus import InProcessBus
from protocol.bus.endpoints import Endpoints
from protocol.bus.zenoh import ZenohBus
from protocol.errors import ConfigurationError, DoublestepError, SlaveError
from protocol.host.logs import LogFormat, configure_logs
from protocol.host.processes import ending_signals
from protocol.text.plain_text import printable, shortened
from protocol.wire.administration import SlaveStatus
from protocol.wire.keys import CLAIM, START, STATUS, AgentKey, SlaveKey
from protocol.wire.packing import PROTOCOL_VERSION
from protocol.wire.records import encode_map
from tests.faults.test_network import Commands
from tests.support.places import ROOT
from tests.support.quarter_car_case import EXAMPLES
from tests.support.ssp_documents import ssd, system
from tests.support.waiting import wait_until

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="uses signals"),
    pytest.mark.usefixtures("no_process_left"),
]

EVIL = (
    "\x1b]0;owned\x07\x1b[2J\r\nmaster-node: all is well\x9b31m\x85\u202egnihton\u2028\u2066x\x7f"
)
"""Window title, cleared screen, a line of ours, colours and line ends of C1, turned letters."""

EVIL_IN_XML = "".join(c for c in EVIL if c >= " ")
"""XML 1.0 holds no others of the first set."""

SHOWN = ("owned", "gnihton")
"""Parts of it that must be seen: nothing is hidden from who looks."""


def check(output: str, *shown: str) -> None:
    """Fails unless the output is lines of visible characters, with what is expected in them."""
    ours = {"\n"}
    found = {c for c in output if not c.isprintable() and c not in ours}
    assert all(unicodedata.category(c) == "Zs" for c in found), (found, output)
    assert not any(line.startswith("master-node: all is well") for line in output.splitlines())
    for text in shown:
        assert text in output, output


# ---- The one place ------------------------------------------------------------------------------


def test_every_character_is_visible_or_escaped() -> None:
    """Law: what comes out has no character that does something, and the visible ones are kept."""
    every = "".join(map(chr, range(sys.maxunicode + 1)))
    shown = printable(every)
    assert all(c.isprintable() or unicodedata.category(c) == "Zs" for c in shown)
    assert shown.encode()  # no halves of characters
    visible = "Größe 速度 \N{IDEOGRAPHIC SPACE}скорость (m/s²) 🚗"
    assert printable(visible) == visible
    assert printable("a\x1b[31m\nb\u202e") == r"a\x1b[31m\nb\u202e"
    assert shortened("abcdef", 4) == "abc…"
    assert shortened("abcd", 4) == "abcd"


def test_errors_and_logs_are_printable(capsys: pytest.CaptureFixture[str]) -> None:
    """One line for an error and for a message, whatever is in them; several mistakes, several."""
    error = SlaveError(EVIL, slave=EVIL, phase=EVIL, remedy=EVIL)
    check(str(error), *SHOWN)
    assert "\n" not in str(error)
    check(str(DoublestepError.from_reply(error.to_reply())), *SHOWN)
    mistakes = ConfigurationError.of_mistakes(["first", EVIL])
    assert len(str(mistakes).split("\n")) == 2
    for style in LogFormat:
        configure_logs(style, "%(levelname)s: %(message)s", slave="a")
        logging.getLogger("master_node").warning("%s says %s", "peer", EVIL, extra={"run": EVIL})
        try:
            raise ValueError(EVIL)
        except ValueError:
            logging.getLogger("master_node").warning("failed", exc_info=True)
        text = capsys.readouterr().err
        check(text, *SHOWN)
        if style is LogFormat.JSON:
            first, second = map(json.loads, text.splitlines())
            check(first["message"] + first["run"], *SHOWN)
            assert second["message"] == "failed"


def test_nothing_else_prints() -> None:
    """Law: no other module writes to a terminal, or makes cells for it."""
    places = {"say": "protocol/host/terminal.py", "cell": "protocol/host/tables.py"}
    for package in ("protocol", "slave_node", "master_node"):
        for path in (ROOT / package).rglob("*.py"):
            if path.relative_to(ROOT).as_posix() in places.values():
                continue
            for node in ast.walk(ast.parse(path.read_text())):
                called = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
                assert called not in ("typer.echo", "print", "Text", "Text.from_markup"), path
                assert not called.endswith(("stdout.write", "stderr.write")), path
                if called == "os.write" and isinstance(node, ast.Call):
                    to, text = map(ast.unparse, node.args)
                    assert to not in ("1", "2") or "printable" in text, path


# ---- Every command ------------------------------------------------------------------------------


class World:
    """Surroundings of a hostile test: commands in this process and in others, files, a bus."""

    def __init__(  # noqa: PLR0917  what the fixture has
        self,
        folder: Path,
        commands: Commands,
        endpoint: str,
        monkeypatch: pytest.MonkeyPatch,
        capfd: pytest.CaptureFixture[str],
        fmu: Path,
    ) -> None:
        self.folder = folder
        self.start = commands
        self.endpoint = endpoint
        self.fmu = fmu
        self._monkeypatch = monkeypatch
        self._capfd = capfd
        self._buses: list[ZenohBus] = []

    def run(self, program: str, *words: object) -> str:
        """Output of a command, whatever its exit code."""
        app = {"master-node": master_node.cli.app, "slave-node": slave_node.cli.app}[program]
        self._monkeypatch.setattr(sys, "argv", [program, *map(str, words)])
        self._capfd.readouterr()
        with pytest.raises(SystemExit):
            app.main()
        return "".join(self._capfd.readouterr())

    def write(self, name: str, text: str) -> Path:
        """A file."""
        path = self.folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
        return path

    def hostile_fmu(self) -> Path:
        """The wheel, with our text in all that its description says of it."""
        path = self.folder / "evil.fmu"
        with zipfile.ZipFile(self.fmu) as source, zipfile.ZipFile(path, "w") as target:
            for entry in source.infolist():
                data = source.read(entry)
                if entry.filename == "modelDescription.xml":
                    text = data.decode()
                    evil = f'modelName="{EVIL_IN_XML}" generationTool="{EVIL_IN_XML}"'
                    changed = text.replace('modelName="wheel"', evil)
                    assert changed != text
                    data = changed.replace('description="', f'description="{EVIL_IN_XML}').encode()
                target.writestr(entry, data)
        return path

    def hostile_system(self, fail_at: float) -> Path:
        """A system with a model that fails with our text."""
        self.write(
            "model.py",
            "from slave_node.model import Model, real\n"
            "class Bad(Model):\n"
            "    outputs = (real('y'),)\n"
            "    def output_values(self, t, x, u):\n"
            f"        if t >= {fail_at}: raise ValueError({EVIL!r})\n"
            "        return [t]\n",
        )
        return self.write(
            "system.toml",
            "[simulation]\nstop_time = 1.0\nestimator = 'none'\ninitial_step_size = 0.1\n"
            "checkpoint_interval = 1e-9\nexamine = false\n"
            '[slaves.bad]\nmodel = "model.py:Bad"\n',
        )

    def hostile_results(self, name: str) -> Path:
        """A directory of results whose columns have our text in their names."""
        column = '"' + EVIL.replace("\n", " ").replace("\r", " ") + '"'
        return self.write(f"{name}/results.csv", f"time,{column}\n0.0,1.0\n1.0,2.0\n").parent

    def hostile_package(self) -> Path:
        """A package that holds what is not carried, under our text."""
        path = self.folder / "system.ssp"
        with zipfile.ZipFile(path, "w") as package:
            where = 'name="wheel" source="resources/w.fmu"'
            text = f'<ssd:Component {where} description="{EVIL_IN_XML}"/>'
            package.writestr("SystemStructure.ssd", ssd(system(text)))
            package.write(self.fmu, "resources/w.fmu")
            package.writestr(f"{EVIL.replace(chr(13), '').replace('2J', '')}.txt", "x")
        return path

    def peers(self) -> None:
        """A slave and an agent, of which nothing is true but the address."""
        bus = ZenohBus(Endpoints(listen=(self.endpoint,)))
        self._buses.append(bus)
        slave, agent = SlaveKey("wheel", "1"), AgentKey("lab", "2")
        evil = {"error": "SlaveError", **dict.fromkeys(("cause", "remedy", "slave", "phase"), EVIL)}
        status = SlaveStatus(
            *("wheel", "1", EVIL, 1, EVIL, EVIL, EVIL, EVIL, EVIL, False, EVIL, EVIL, EVIL),
            *(None, 0.0, 0.0, PROTOCOL_VERSION),
        )
        bus.serve(slave.verb(STATUS), lambda _: encode_map(status.to_message()))
        bus.serve(slave.verb(CLAIM), lambda _: encode_map(evil))
        bus.serve(agent.verb(STATUS), lambda _: encode_map(evil))
        bus.announce(slave.alive)
        bus.announce(agent.alive)

    def ask(self, key: str, message: Mapping[str, Any]) -> None:
        """Send a hostile message to a command that listens."""
        bus = ZenohBus(Endpoints(connect=(self.endpoint,)))
        self._buses.append(bus)
        wait_until(lambda: bool(bus.alive(f"{key.rpartition('/')[0]}/alive", 5.0)))
        bus.caller(key, 10.0).request(encode_map(message))

    def close(self) -> None:
        """Leave the bus."""
        for bus in self._buses:
            bus.close()


@pytest.fixture
def world(
    tmp_path: Path,
    endpoint: str,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    fmu_dir: Path,
) -> Iterator[World]:
    """In a folder of its own, which is the working directory."""
    monkeypatch.setenv("COLUMNS", "4000")
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.chdir(tmp_path)
    handlers = {number: signal.getsignal(number) for number in ending_signals()}
    commands = Commands(tmp_path)
    made = World(tmp_path, commands, endpoint, monkeypatch, capfd, fmu_dir / "wheel.fmu")
    yield made
    made.close()
    commands.close()
    for number, handler in handlers.items():
        signal.signal(number, handler)


def master_run(world: World) -> str:
    """A model that fails, in process and over the bus; a slave that refuses; a package."""
    file = world.hostile_system(0.0)
    said = world.run("master-node", "run", file, "--in-process", "--no-plot")
    check(said, *SHOWN)
    check(world.run("master-node", "run", file, "--no-plot", "--log-format", "json"), "owned")
    world.peers()
    file = world.write(
        "peers.toml",
        f'[simulation]\nstop_time = 1.0\n[slaves.wheel]\n[bus]\nconnect = ["{world.endpoint}"]\n',
    )
    check(world.run("master-node", "run", file, "--no-plot"), *SHOWN)
    text = '[simulation]\nstop_time = 1.0\n[slaves.wheel]\nmodel = "w.fmu"\nhost = "lab"\n'
    bus = f'[bus]\nconnect = ["{world.endpoint}"]\ndiscovery_timeout = 0.5\n'
    shutil.copy(world.fmu, world.folder / "w.fmu")
    check(world.run("master-node", "run", world.write("a.toml", text + bus), "--no-plot"), "owned")
    return world.run("master-node", "run", world.hostile_package(), "--in-process", "--no-plot")


def master_check(world: World) -> str:
    """Texts of an FMU in the report, as data and in the graph; a model that fails."""
    text = '[simulation]\nstop_time = 1.0\nexamine = false\n[slaves.wheel]\nmodel = "evil.fmu"\n'
    world.hostile_fmu()
    file = world.write("evil.toml", text)
    check(world.run("master-node", "check", file, "--in-process", "--graph", "graph.mmd"), *SHOWN)
    said = world.run("master-node", "check", file, "--json")
    assert json.loads(said)["slaves"][0]["name"] == "wheel"
    lines = (world.folder / "graph.mmd").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "flowchart LR"
    return world.run("master-node", "check", world.hostile_system(0.0), "--in-process")


def master_resume(world: World) -> str:
    """The run fails again where it failed before."""
    file = world.hostile_system(0.5)
    check(world.run("master-node", "run", file, "--no-plot"), *SHOWN)
    return world.run("master-node", "resume", "results", "--no-plot")


def master_sweep(world: World) -> str:
    """The last words of each run that fails are told."""
    world.hostile_system(0.0)
    text = '[parameters]\n"simulation.stop_time" = [1.0]\n[run]\nin_process = true\nplot = false\n'
    study = world.write("study.toml", f'system = "system.toml"\n{text}')
    return world.run("master-node", "sweep", study)


def master_plot(world: World) -> str:
    """Names in a picture and in what is said of names that are not there."""
    directory = world.hostile_results("a")
    check(world.run("master-node", "plot", directory))
    return world.run("master-node", "plot", directory, "--variable", "owned all is well gnihton")


def master_compare(world: World) -> str:
    """Names of variables."""
    return world.run("master-node", "compare", *map(world.hostile_results, "ab"))


def master_import(world: World) -> str:
    """Names of entries that are not carried."""
    return world.run("master-node", "import", world.hostile_package())


def master_export(world: World) -> str:
    """Keys of a system file."""
    text = json.dumps(EVIL, ensure_ascii=True).replace("\\u007f", "\\u007F")
    file = world.write("evil.toml", f"[simulation]\nstop_time = 1.0\n[slaves.{text}]\n")
    return world.run("master-node", "export", file)


def master_list(world: World) -> str:
    """All that participants say of themselves, as tables and as JSON."""
    world.peers()
    check(world.run("master-node", "list", "--connect", world.endpoint, "--json"), *SHOWN)
    return world.run("master-node", "list", "--connect", world.endpoint)


def master_doctor(world: World) -> str:
    """All that participants say of themselves, and what is wrong with it."""
    world.peers()
    return world.run("master-node", "doctor", "--connect", world.endpoint)


def slave_inspect(world: World) -> str:
    """All texts of a description, as tables and as JSON."""
    fmu = world.hostile_fmu()
    check(world.run("slave-node", "inspect", fmu, "--json"), *SHOWN)
    return world.run("slave-node", "inspect", fmu)


def slave_validate(world: World) -> str:
    """Errors of a model that is tried."""
    world.hostile_system(0.0)
    return world.run("slave-node", "validate", "model.py:Bad")


def slave_serve(world: World) -> str:
    """The host in a claim."""
    wheel = EXAMPLES / "quarter_car.py:Wheel"
    where = ("--name", "wheel", "--listen", world.endpoint, "--instance", "1")
    slave = world.start("slave_node", "serve", wheel, *where)
    slave.wait_for("ready")
    claim = {"run": "r", "host": EVIL, "pid": 1, "orphan_time": 0.0}
    world.ask(SlaveKey("wheel", "1").verb(CLAIM), claim)
    slave.wait_for("reset; free for another master")
    slave.send(signal.SIGTERM)
    assert slave.wait() == 0
    return slave.text


def slave_agent(world: World) -> str:
    """The model and the host in a request for a slave."""
    (world.folder / "models").mkdir()
    where = ("--listen", world.endpoint, "--models", "models", "--name", "lab")
    agent = world.start("slave_node", "agent", *where)
    agent.wait_for("ready")
    instance = agent.text.rpartition("instance ")[2].strip()
    request = {
        **{"run": "r", "host": EVIL, "pid": 1, "orphan_time": 1.0, "slave": "s", "model": EVIL},
        **{"requires": {}, "restart": 0, "load_timeout": 1.0},
    }
    world.ask(AgentKey("lab", instance).verb(START), request)
    agent.wait_for("refused")
    agent.send(signal.SIGTERM)
    assert agent.wait() == 0
    return agent.text


def slave_router(world: World) -> str:
    """It passes on and says nothing of it."""
    return world.run("slave-node", "router", "--listen", f"tcp/{EVIL}")


def slave_check(world: World) -> str:
    """A name that is none."""
    return world.run("slave-node", "check", EVIL)


def slave_certificates(world: World) -> str:
    """A host that is none."""
    return world.run("slave-node", "certificates", world.folder / "ca", "--host", EVIL)


SCENARIOS: dict[tuple[str, str], tuple[Callable[[World], str], tuple[str, ...]]] = {
    ("master-node", "run"): (master_run, SHOWN),
    ("master-node", "check"): (master_check, SHOWN),
    ("master-node", "resume"): (master_resume, SHOWN),
    ("master-node", "sweep"): (master_sweep, SHOWN),
    ("master-node", "plot"): (master_plot, SHOWN),
    ("master-node", "compare"): (master_compare, SHOWN),
    ("master-node", "import"): (master_import, SHOWN),
    ("master-node", "export"): (master_export, SHOWN),
    ("master-node", "list"): (master_list, SHOWN),
    ("master-node", "doctor"): (master_doctor, SHOWN),
    ("slave-node", "inspect"): (slave_inspect, SHOWN),
    ("slave-node", "validate"): (slave_validate, SHOWN),
    ("slave-node", "serve"): (slave_serve, SHOWN),
    ("slave-node", "agent"): (slave_agent, ("owned",)),
    ("slave-node", "router"): (slave_router, SHOWN),
    ("slave-node", "check"): (slave_check, SHOWN),
    ("slave-node", "certificates"): (slave_certificates, SHOWN),
}


@pytest.mark.parametrize(("program", "command"), SCENARIOS)
def test_a_command_shows_texts_of_others_and_obeys_none(
    program: str, command: str, world: World
) -> None:
    """Law: all that a command prints is visible, and holds what was said."""
    walk, shown = SCENARIOS[program, command]
    check(walk(world), *shown)


def test_no_command_is_left_out() -> None:
    """A new command needs a hostile test of its own."""
    apps = {"master-node": master_node.cli.app.app, "slave-node": slave_node.cli.app.app}
    names = {
        (program, c.name or str(getattr(c.callback, "__name__", "")))
        for program, app in apps.items()
        for c in app.registered_commands
    }
    assert names == set(SCENARIOS)


def test_titles_of_pictures_are_printable(world: World) -> None:
    """Law: no text of a picture holds what is no visible character."""
    from matplotlib.text import Text  # noqa: PLC0415  a second

    from master_node.results import Result  # noqa: PLC0415
    from master_node.results.plots import plot_result  # noqa: PLC0415

    result = Result.load(world.hostile_results("a"))
    figure = plot_result(result, None, show=False, variables=None)
    texts = [str(item.get_text()) for item in figure.findobj(Text)]
    assert all(c.isprintable() for text in texts for c in text), texts
    assert any("owned" in text for text in texts)


def test_the_test_would_find_it() -> None:
    """The check fails for each kind of character by itself."""
    for evil in "\x1b\x07\r\x7f\x85\x9b\u200b\u202e\u2028\u2066\ufeff":
        with pytest.raises(AssertionError):
            check(f"a{evil}b")
    with pytest.raises(AssertionError):
        check("x\nmaster-node: all is well")
    InProcessBus().close()
