"""The files for containers, Kubernetes and systemd: valid, hardened, and their commands work.

What a Docker engine would run is run here without one, too: the same commands, as processes.
"""

from __future__ import annotations

import configparser
import functools
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from typer.main import get_command

import master_node.cli.app
import slave_node.cli.app
from master_node import Result, load_system, simulate
from tests.support.places import ROOT
from tests.support.waiting import BOUND, wait_until

APPS = {"master-node": master_node.cli.app.app, "slave-node": slave_node.cli.app.app}
MANIFESTS = sorted((ROOT / "deploy" / "kubernetes").glob("*.yaml"))
UNITS = sorted((ROOT / "deploy" / "systemd").glob("*.service"))
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text(encoding="utf-8"))
ALL_SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
SERVICES = {name: s for name, s in ALL_SERVICES.items() if "profiles" not in s}
"""Those that ``up`` starts."""


CLUSTER = (*SERVICES, "agent")
"""Workloads that run in pods."""


def documents() -> list[dict[str, Any]]:
    """All objects of the manifests."""
    return [d for path in MANIFESTS for d in yaml.safe_load_all(path.read_text(encoding="utf-8"))]


def check_command(words: Sequence[str]) -> None:
    """A command line that our programs take."""
    program, name, *rest = words
    command = get_command(APPS[program])
    command.commands[name].make_context(name, list(rest))  # type: ignore[attr-defined]


def endpoints(words: Sequence[str]) -> list[str]:
    """The hosts to which a command connects."""
    return [re.fullmatch(r"tcp/(.*):7447", w)[1] for w in words if w.startswith("tcp/")]  # type: ignore[index]


# ---- Compose ------------------------------------------------------------------------------------


def schema_errors(path: Path) -> subprocess.CompletedProcess[str]:
    """Findings of the schema of the Compose specification that check-jsonschema ships."""
    return subprocess.run(
        [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec", path],
        capture_output=True,
        text=True,
        timeout=BOUND,
        check=False,
    )


def test_the_compose_file_is_valid(tmp_path: Path) -> None:
    """By the specification's own schema; and that schema does find a misspelt key."""
    done = schema_errors(ROOT / "docker-compose.yml")
    assert done.returncode == 0, done.stdout
    text = (ROOT / "docker-compose.yml").read_text(encoding="utf-8")
    broken = tmp_path / "docker-compose.yml"
    broken.write_text(text.replace("read_only: true", "readonly: true"), encoding="utf-8")
    assert schema_errors(broken).returncode != 0


@pytest.mark.parametrize("name", ALL_SERVICES)
def test_the_commands_of_a_service_can_be_given(name: str) -> None:
    """Options exist, hosts are services, slaves are called as their service, models are built."""
    service = ALL_SERVICES[name]
    check_command(service["command"])
    known = {*SERVICES, "127.0.0.1", "0.0.0.0"}
    assert set(endpoints(service["command"])) <= known
    assert set(service.get("depends_on", {})) <= set(SERVICES)
    if "healthcheck" in service:
        kind, *words = service["healthcheck"]["test"]
        assert kind == "CMD"
        check_command(words)
        assert set(endpoints(words)) <= known
    if service["command"][1] == "serve":
        assert service["command"][2] == f"{name}.fmu"
        assert service["healthcheck"]["test"][3] == name
        assert (ROOT / "examples" / "quarter_car" / "src" / name).is_dir()


def test_the_services_are_those_of_the_system() -> None:
    """One for each slave, a router and a master, who waits for the slaves to be alive."""
    system = load_system(ROOT / "examples" / "quarter_car" / SERVICES["master"]["command"][2])
    assert set(SERVICES) == {"router", "master", *system.slaves}
    waits = SERVICES["master"]["depends_on"]
    assert waits == {name: {"condition": "service_healthy"} for name in system.slaves}


@pytest.mark.parametrize("name", ALL_SERVICES)
def test_a_service_can_do_no_more_than_it_must(name: str) -> None:
    """No root, no capabilities, nothing to write to but memory and results, bounded in size."""
    service = ALL_SERVICES[name]
    user = re.sub(r"\$\{\w+:-(\d+)\}", r"\1", service["user"])
    assert all(int(number) > 0 for number in user.split(":"))
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert "cap_add" not in service
    assert not service.get("privileged", False)
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["memswap_limit"] == service["mem_limit"]
    assert 0 < service["pids_limit"] <= 512
    (scratch,) = service["tmpfs"]
    assert re.fullmatch(r"/tmp:rw,exec,nosuid,nodev,size=\d+m,mode=1777", scratch)
    assert service["networks"] == ["bus"]
    assert COMPOSE["networks"]["bus"]["internal"] is True
    assert "ports" not in service
    volumes = [volume["target"] for volume in service.get("volumes", [])]
    assert volumes == (["/results"] if name == "master" else [])


def build_stages() -> list[list[str]]:
    """The instructions of the Dockerfile, stage by stage."""
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8").replace("\\\n", " ")
    stages: list[list[str]] = []
    for line in (line.strip() for line in text.splitlines()):
        if line.startswith("FROM "):
            stages.append([])
        if stages and line and not line.startswith("#"):
            stages[-1].append(re.sub(r"\s+", " ", line))
    return stages


def test_the_image_is_pinned_and_has_neither_compiler_nor_root() -> None:
    """An exact tag for all stages; the last installs nothing and ends as a user with a number."""
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    (base,) = re.findall(r"^ARG PYTHON=(.*)$", text, re.MULTILINE)
    assert re.fullmatch(r"python:3\.\d+\.\d+-slim-\w+(@sha256:[0-9a-f]{64})?", base)
    stages = build_stages()
    assert [stage[0] for stage in stages] == ["FROM ${PYTHON} AS build", "FROM ${PYTHON}"]
    last = stages[-1]
    assert not any("apt-get" in line or "gcc" in line or "pip" in line for line in last)
    (user,) = [line for line in last if line.startswith("USER ")]
    assert int(user.removeprefix("USER ").split(":")[0]) > 0
    assert last.index(user) > max(i for i, line in enumerate(last) if line.startswith("RUN "))


def test_what_the_image_is_built_from_is_sent_to_the_builder() -> None:
    """Each source of a COPY exists, and ``.dockerignore`` lets it through."""
    ignore = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert ignore[0] == "*"
    sent = {line[1:] for line in ignore if line.startswith("!")}
    copied = set()
    for line in build_stages()[0]:
        if line.startswith("COPY "):
            copied |= set(line.split()[1:-1])
    assert copied == sent
    assert all((ROOT / name).exists() for name in copied)


@pytest.mark.timeout(1860)
def test_containers_run_where_there_is_an_engine() -> None:
    """The documented script, for real: the results come out on the host."""
    done = subprocess.run(
        ["bash", str(ROOT / "deploy" / "run_compose.sh")],
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
    )
    if done.returncode == 77:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stdout + done.stderr


class Processes:
    """The services as processes of this host: the same commands, with one address for another."""

    def __init__(self, folder: Path, models: Path, endpoint: str) -> None:
        self._folder = folder
        self._models = models
        self._endpoint = endpoint
        self._started: list[subprocess.Popen[bytes]] = []

    def words(self, command: Sequence[str]) -> list[str]:
        """A command of a container, as it is given here."""
        program, *rest = command
        module = program.replace("-", "_")
        changed = [re.sub(r"^tcp/.*:7447$", self._endpoint, word) for word in rest]
        changed = [word.replace("/results", str(self._folder / "results")) for word in changed]
        return [sys.executable, "-m", module, *changed]

    def start(self, command: Sequence[str]) -> subprocess.Popen[bytes]:
        """Start a service that stays."""
        process = subprocess.Popen(self.words(command), cwd=self._models, stdin=subprocess.DEVNULL)
        self._started.append(process)
        return process

    def run(self, command: Sequence[str]) -> int:
        """Run a command to its end: its exit code."""
        return subprocess.run(
            self.words(command), cwd=self._models, timeout=BOUND, check=False
        ).returncode

    def wait_healthy(self, command: Sequence[str]) -> None:
        """Ask for the health until it is there."""

        def is_healthy() -> bool:
            assert all(process.poll() is None for process in self._started)
            return self.run(command) == 0

        wait_until(is_healthy)

    def close(self) -> None:
        """End all, as a stop of the containers would; each must obey."""
        for process in reversed(self._started):
            process.terminate()
        codes = [process.wait(BOUND) for process in self._started]
        assert codes == [0] * len(codes)


@pytest.fixture
def processes(tmp_path: Path, fmu_dir: Path, endpoint: str) -> Iterator[Processes]:
    """In the folder with the FMUs and system files, as ``/models`` of the image is."""
    models = tmp_path / "models"
    shutil.copytree(fmu_dir, models)
    shutil.copy(ROOT / "examples" / "quarter_car" / "displacement.toml", models)
    (tmp_path / "results").mkdir()
    running = Processes(tmp_path, models, endpoint)
    yield running
    running.close()


def containers_of_compose() -> dict[str, tuple[list[str], list[str]]]:
    """Command and health check by name, in the order of the start."""
    return {
        name: (s["command"], s["healthcheck"]["test"][1:] if "healthcheck" in s else [])
        for name, s in SERVICES.items()
    }


def containers_of_kubernetes() -> dict[str, tuple[list[str], list[str]]]:
    """Commands and health checks of all services, out of the manifests."""
    return {name: container_of_pod(name) for name in SERVICES}


def container_of_pod(name: str) -> tuple[list[str], list[str]]:
    """Command and health check of what runs in a pod; a shell is seen through."""
    (container,) = pods()[name]["containers"]
    probe = container.get("livenessProbe", {}).get("exec", {}).get("command", [])
    if probe[:2] == ["sh", "-c"]:
        probe = shlex.split(probe[2].removeprefix("exec "))
    return container["command"] + container["args"], probe


@pytest.mark.skipif(os.name != "posix", reason="uses signals")
@pytest.mark.usefixtures("no_process_left")
@pytest.mark.parametrize(
    "containers",
    [containers_of_compose, pytest.param(containers_of_kubernetes, marks=pytest.mark.slow)],
)
@pytest.mark.slow
def test_the_commands_of_the_containers_simulate_the_quarter_car(
    processes: Processes, tmp_path: Path, containers: Any
) -> None:
    """Router, slaves and master, each healthy before the next: the results of a plain run.

    Bit for bit, and all end when they are told to.
    """
    for name, (command, health) in containers().items():
        if name == "master":
            assert processes.run(command) == 0
            continue
        processes.start(command)
        processes.wait_healthy(health)
    result = Result.load(tmp_path / "results")
    system = load_system(tmp_path / "models" / "displacement.toml")
    known = simulate(system, in_process=True)
    assert result.summary["outcome"] == "completed"
    assert result.time.tobytes() == known.time.tobytes()
    assert result.outputs.tobytes() == known.outputs.tobytes()


def agent_of_compose() -> tuple[list[str], list[str]]:
    """Command and health check of the agent."""
    service = ALL_SERVICES["agent"]
    return service["command"], service["healthcheck"]["test"][1:]


def agent_of_kubernetes() -> tuple[list[str], list[str]]:
    """Command and health check of the first pod of agents, named as its host."""
    command, health = container_of_pod("agent")
    assert "--name" not in command
    assert "$HOSTNAME" in health
    name = f"{pods()['agent']['containers'][0]['name']}-0"
    return [*command, "--name", name], [name if w == "$HOSTNAME" else w for w in health]


@pytest.mark.skipif(os.name != "posix", reason="uses signals")
@pytest.mark.usefixtures("no_process_left")
@pytest.mark.parametrize(
    "agent", [pytest.param(agent_of_compose, marks=pytest.mark.slow), agent_of_kubernetes]
)
@pytest.mark.slow
def test_the_agent_of_the_containers_starts_slaves(
    processes: Processes, tmp_path: Path, agent: Any
) -> None:
    """Router and agent, and a master that names the agent: the results of a plain run."""
    router = ALL_SERVICES["router"]
    command, health = agent()
    for words, check in ((router["command"], router["healthcheck"]["test"][1:]), (command, health)):
        processes.start(words)
        processes.wait_healthy(check)
    name = command[command.index("--name") + 1]
    file = tmp_path / "models" / "displacement.toml"
    known = simulate(load_system(file), in_process=True)
    for model in ("chassis.fmu", "wheel.fmu"):
        text = file.read_text(encoding="utf-8")
        file.write_text(text.replace(f'"{model}"', f'"{model}"\nhost = "{name}"'), encoding="utf-8")
    run = [word for word in SERVICES["master"]["command"] if word != "--no-launch"]
    assert processes.run(run) == 0
    result = Result.load(tmp_path / "results")
    assert result.summary["settings"]["slaves"]["wheel"]["host"] == name
    assert result.time.tobytes() == known.time.tobytes()
    assert result.outputs.tobytes() == known.outputs.tobytes()


# ---- Kubernetes ---------------------------------------------------------------------------------


@functools.cache
def pods() -> Mapping[str, dict[str, Any]]:
    """The specifications of all pods, by the names of what makes them."""
    return {
        d["metadata"]["name"]: d["spec"]["template"]["spec"]
        for d in documents()
        if d["kind"] in ("Deployment", "StatefulSet", "Job")
    }


@pytest.mark.parametrize("path", MANIFESTS, ids=[path.name for path in MANIFESTS])
def test_a_manifest_is_valid(path: Path) -> None:
    """By the schemas of Kubernetes; and these do find a misspelt key."""
    version = kubernetes_validate.latest_version()
    for document in yaml.safe_load_all(path.read_text(encoding="utf-8")):
        kubernetes_validate.validate(document, version, strict=True)
        document["metadata"]["lables"] = {}
        with pytest.raises(kubernetes_validate.ValidationError):
            kubernetes_validate.validate(document, version, strict=True)


def test_the_manifests_belong_together() -> None:
    """One namespace, selectors that match their pods, services for all hosts that are called."""
    found = documents()
    (namespace,) = [d["metadata"]["name"] for d in found if d["kind"] == "Namespace"]
    others = [d for d in found if d["kind"] != "Namespace"]
    assert {d["metadata"]["namespace"] for d in others} == {namespace}
    labels = []
    for d in found:
        if d["kind"] in ("Deployment", "StatefulSet"):
            given = d["spec"]["template"]["metadata"]["labels"]
            assert d["spec"]["selector"]["matchLabels"] == given
            assert d["spec"]["replicas"] == 1
            labels.append(given)
    services = {d["metadata"]["name"]: d for d in found if d["kind"] == "Service"}
    for service in services.values():
        wanted = service["spec"]["selector"].items()
        assert any(wanted <= given.items() for given in labels)
    assert {d["spec"]["serviceName"] for d in found if d["kind"] == "StatefulSet"} <= set(services)
    assert set(pods()) == set(CLUSTER)
    for command, health in map(container_of_pod, CLUSTER):
        check_command(command)
        assert set(endpoints(command)) <= {*services, "0.0.0.0"}
        if health:
            check_command(health)
            assert set(endpoints(health)) <= {*services, "127.0.0.1"}


@pytest.mark.parametrize("name", CLUSTER)
def test_a_pod_keeps_to_the_restricted_standard(name: str) -> None:
    """Pods are restricted, as by the Pod Security Standards, bounded, and have no token."""
    pod = pods()[name]
    security = pod["securityContext"]
    assert security["runAsNonRoot"] is True
    assert security["runAsUser"] > 0
    assert security["seccompProfile"] == {"type": "RuntimeDefault"}
    assert pod["automountServiceAccountToken"] is False
    assert not any(pod.get(key) for key in ("hostNetwork", "hostPID", "hostIPC"))
    (container,) = pod["containers"]
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    assert {"memory", "cpu"} <= set(container["resources"]["limits"])
    kinds = {kind for volume in pod["volumes"] for kind in volume if kind != "name"}
    assert kinds <= {"emptyDir", "persistentVolumeClaim"}
    assert {m["name"] for m in container["volumeMounts"]} == {v["name"] for v in pod["volumes"]}


def test_only_the_router_can_be_reached() -> None:
    """Nothing by default; then all others to the router's port, and names for all."""
    policies = {
        d["metadata"]["name"]: d["spec"] for d in documents() if d["kind"] == "NetworkPolicy"
    }
    assert policies["nothing-by-default"] == {
        "podSelector": {},
        "policyTypes": ["Ingress", "Egress"],
    }
    ingress = [spec for spec in policies.values() if spec.get("ingress")]
    assert [spec["podSelector"]["matchLabels"] for spec in ingress] == [
        {"app.kubernetes.io/component": "router"}
    ]
    assert [rule["ports"] for spec in ingress for rule in spec["ingress"]] == [
        [{"protocol": "TCP", "port": 7447}]
    ]
    components = {
        pod["metadata"]["labels"]["app.kubernetes.io/component"]
        for pod in (d["spec"]["template"] for d in documents() if "template" in d.get("spec", {}))
    }
    (egress,) = [spec for spec in policies.values() if "matchExpressions" in spec["podSelector"]]
    (expression,) = egress["podSelector"]["matchExpressions"]
    assert {*expression["values"], "router"} == components


# ---- systemd ------------------------------------------------------------------------------------

HARDENING = {
    "DynamicUser": "yes",
    "NoNewPrivileges": "yes",
    "CapabilityBoundingSet": "",
    "ProtectSystem": "strict",
    "ProtectHome": "yes",
    "PrivateTmp": "yes",
    "PrivateDevices": "yes",
    "ProtectKernelTunables": "yes",
    "ProtectKernelModules": "yes",
    "ProtectControlGroups": "yes",
    "RestrictNamespaces": "yes",
    "RestrictSUIDSGID": "yes",
    "LockPersonality": "yes",
    "SystemCallArchitectures": "native",
}


def unit(path: Path) -> dict[str, dict[str, list[str]]]:
    """Sections, keys and all their values."""
    found: dict[str, dict[str, list[str]]] = {}
    section = ""
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            section = line.strip("[]")
            found[section] = {}
        elif line and not line.startswith("#"):
            key, equals, value = line.partition("=")
            assert equals, line
            found[section].setdefault(key, []).append(value)
    return found


def environment(path: Path) -> dict[str, str]:
    """Environment that a unit and its file of settings make."""
    service = unit(path)["Service"]
    values = dict(v.split("=", 1) for v in service["Environment"])
    if "CacheDirectory" in service:
        values["CACHE_DIRECTORY"] = f"/var/cache/{service['CacheDirectory'][-1]}"
    (file,) = service["EnvironmentFile"]
    name = Path(file.removeprefix("-").replace("%i", "wheel")).name
    parser = configparser.RawConfigParser(delimiters="=")
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string("[x]\n" + (path.parent / name).read_text(encoding="utf-8"))
    return values | dict(parser["x"])


@pytest.mark.parametrize("path", UNITS, ids=[path.name for path in UNITS])
def test_the_command_of_a_unit_can_be_given(path: Path) -> None:
    """With the settings beside it; ``$OPTIONS`` becomes words, ``${...}`` one."""
    (line,) = unit(path)["Service"]["ExecStart"]
    values = environment(path)
    words: list[str] = []
    for word in line.replace("%i", "wheel").split():
        if word.startswith("$") and not word.startswith("${"):
            words += shlex.split(values[word[1:]])
        else:
            words.append(re.sub(r"\$\{(\w+)\}", lambda m: values[m[1]], word))
    assert "" not in words
    program, *rest = words
    assert program.startswith("/")
    check_command([Path(program).name, *rest])
    assert (rest[0] == "serve") == ("@" in path.name)


@pytest.mark.parametrize("path", UNITS, ids=[path.name for path in UNITS])
def test_a_unit_can_do_no_more_than_it_must(path: Path) -> None:
    """A user of its own, nothing to write to, bounded in size, no restart on a wrong setting."""
    service = unit(path)["Service"]
    assert {key: service[key][-1] for key in HARDENING} == HARDENING
    assert {"MemoryMax", "TasksMax", "SystemCallFilter", "RestrictAddressFamilies"} <= set(service)
    assert service["RestartPreventExitStatus"] == ["2"]


@pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="there is no systemd-analyze here"
)
@pytest.mark.parametrize("path", UNITS, ids=[path.name for path in UNITS])
@pytest.mark.slow
def test_systemd_finds_nothing_wrong(path: Path, tmp_path: Path) -> None:
    """Its own check of keys and values, and its own measure of what a service could do: 2 of 10."""
    text = path.read_text(encoding="utf-8")
    text = text.replace("/opt/doublestep/bin/slave-node", sys.executable)
    copy = tmp_path / path.name.replace("@.", "@wheel.")
    copy.write_text(text, encoding="utf-8")
    for words in (
        ["verify", "--man=no", str(copy)],
        ["security", "--offline=true", "--threshold=20", "--no-pager", str(copy)],
    ):
        done = subprocess.run(
            ["systemd-analyze", *words],
            capture_output=True,
            text=True,
            timeout=BOUND,
            check=False,
        )
        said = done.stdout + done.stderr
        assert done.returncode == 0, said
        assert "Unknown key" not in said
        assert "ignoring" not in said.lower()
