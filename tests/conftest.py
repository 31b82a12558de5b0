"""Fixtures that several test modules share."""

from __future__ import annotations

import os
import random

# Threads only get in each other's way on matrices of a few rows. Read where NumPy is imported.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import hashlib
import importlib.util
import shlex
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Collection, Iterator
from importlib import metadata
from pathlib import Path
from secrets import token_hex
from types import ModuleType

import psutil
import pytest
from filelock import FileLock
from hypothesis import HealthCheck, settings

from tests.support.signal_dispositions import default_dispositions
from tests.support.waiting import BOUND, slowdown

EXAMPLES = Path(__file__).parents[1] / "examples"

# Hundreds of processes are started, and each of them would compile the sources again.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# A slow moment of the machine is no counterexample.
settings.register_profile(
    "doublestep",
    deadline=None,
    max_examples=50,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("doublestep")

_MARK = "DOUBLESTEP_TEST_SESSION"
_TIME_TO_END = 3.0


@pytest.fixture(scope="session", autouse=True)
def _signals_as_in_a_login_shell() -> Iterator[None]:
    """Commands that tests start can be interrupted, also where the suite itself cannot."""
    with default_dispositions():
        yield


def _example(folder: str, script: str) -> ModuleType:
    """A script of the examples, from where it lies: examples are not a package."""
    name = f"{folder}_{script}"
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / folder / f"{script}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look there
    spec.loader.exec_module(module)
    return module


Built = Callable[[str], Path]


@pytest.fixture(scope="session")
def built(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Built:
    """``built("oscillators")`` is a folder with the FMUs of this example, for this worker alone.

    They are compiled once for all workers, and kept for later sessions under a digest of what they
    are made from.
    """
    store = request.config.cache.mkdir("fmus") / fmu_sources_digest()

    def copy(example: str) -> Path:
        folder = tmp_path_factory.mktemp(example) / example
        kept, script = store / example, _example(example, "build")
        with FileLock(store.with_name("lock")):
            for other in store.parent.iterdir():
                if other.is_dir() and other != store:
                    shutil.rmtree(other)
            if not kept.exists():
                script.build(folder)
                shutil.copytree(folder, kept.with_suffix(".part"), dirs_exist_ok=True)
                kept.with_suffix(".part").rename(kept)
                return folder
        return Path(shutil.copytree(kept, folder, copy_function=shutil.copy))

    return copy


def fmu_sources_digest() -> str:
    """A digest of all that FMUs of the examples are made from: sources, headers, the compiler."""
    compiler = os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc") or "clang"
    version = subprocess.run(
        [*shlex.split(compiler), "--version"], capture_output=True, timeout=BOUND, check=False
    ).stdout
    digest = hashlib.sha256(f"{compiler} {metadata.version('fmpy')} ".encode() + version)
    for path in sorted(EXAMPLES.rglob("*")):
        if path.suffix in {".c", ".h", ".py", ".xml"}:
            content = path.read_bytes()
            digest.update(f"{path.relative_to(EXAMPLES)} {len(content)} ".encode() + content)
    return digest.hexdigest()[:16]


@pytest.fixture(scope="session")
def build_script() -> ModuleType:
    """The script that builds the FMUs of the quarter car."""
    return _example("quarter_car", "build")


@pytest.fixture(scope="session")
def fmu_dir(built: Built) -> Path:
    """The folder with the four FMUs of the quarter car."""
    return built("quarter_car")


@pytest.fixture(scope="session")
def oscillator_dir(built: Built) -> Path:
    """The folder with the three FMUs of the oscillators."""
    return built("oscillators")


@pytest.fixture(scope="session")
def quarter_car_ssp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package of the example, with a nested system."""
    (package,) = _example("ssp", "build").build(tmp_path_factory.mktemp("ssp"))
    return Path(package)


@pytest.fixture(scope="session")
def capability_dir(built: Built) -> Path:
    """The folder with the FMUs of all capabilities."""
    return built("capabilities")


@pytest.fixture(scope="session")
def capability_fmu(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """``capability_fmu(name)`` builds one of these FMUs alone."""
    folder = tmp_path_factory.mktemp("single")
    example = _example("capabilities", "build")
    fmus = {fmu.name: fmu for fmu in example.FMUS}

    def build(name: str) -> Path:
        (path,) = example.build_fmus.build([fmus[name]], folder)
        return Path(path)

    return build


@pytest.fixture(scope="session")
def no_rollback_dir(fmu_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the example of FMUs whose state cannot be saved."""
    folder = tmp_path_factory.mktemp("examples") / "no_rollback"
    (folder.parent / "quarter_car").symlink_to(fmu_dir)
    _example("no_rollback", "build").build(folder, whole_car=fmu_dir)
    for file in (EXAMPLES / "no_rollback").glob("*.toml"):
        shutil.copy(file, folder)
    return folder


@pytest.fixture(scope="session")
def python_fmu_build() -> ModuleType:
    """The script that builds the FMUs in Python."""
    return _example("python_fmu", "build")


@pytest.fixture(scope="session")
def python_fmu_dir(python_fmu_build: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the example of FMUs in Python."""
    folder = tmp_path_factory.mktemp("python_fmu")
    python_fmu_build.build(folder)
    shutil.copy(EXAMPLES / "python_fmu" / "quarter_car.toml", folder)
    return folder


@pytest.fixture(scope="session")
def oscillators() -> ModuleType:
    """The reference solutions of the oscillators."""
    return _example("oscillators", "oscillators")


@pytest.fixture
def endpoint() -> str:
    """An address on loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


Survivors = Callable[..., list[psutil.Process]]


@pytest.fixture(scope="session", autouse=True)
def survivors() -> Iterator[Survivors]:
    """The processes that tests started and that do not end in a bounded time, but for those known.

    A mark in the environment finds them even when they lost their parent. Asked once more at the
    end of the session: nothing that a test started may outlive it.
    """
    mark = token_hex(8)
    os.environ[_MARK] = mark

    def find(known: Collection[psutil.Process] = ()) -> list[psutil.Process]:
        marked = [p for p in psutil.process_iter() if p not in known and _is_marked(p, mark)]
        _, alive = psutil.wait_procs(marked, timeout=_TIME_TO_END)
        if alive:
            _, alive = psutil.wait_procs(alive, timeout=_TIME_TO_END * slowdown())
        return alive

    yield find
    left = [process.cmdline() for process in find()]
    del os.environ[_MARK]
    assert not left, f"processes are left running: {left}"


def _is_marked(process: psutil.Process, mark: str) -> bool:
    try:
        if process.pid == os.getpid() or process.status() == psutil.STATUS_ZOMBIE:
            return False
        # multiprocessing keeps a resource tracker for as long as the session lives.
        return process.environ().get(_MARK) == mark and not any(
            "resource_tracker" in argument for argument in process.cmdline()
        )
    except psutil.Error:
        return False


@pytest.fixture
def no_process_left(survivors: Survivors) -> Iterator[None]:
    """Fails the test after which a process that it started goes on."""
    known = set(psutil.process_iter())
    yield
    left = survivors(known)
    for process in left:
        process.kill()
    assert not left, f"processes are left running: {left}"


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--sample N --seed TEXT``: N of the tests that are chosen, others for each seed."""
    parser.addoption("--sample", type=int, default=None, help="run so many of the chosen tests")
    parser.addoption("--seed", default="", help="that the sample is drawn by")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the sample; all workers draw the same."""
    number = config.getoption("--sample")
    if number is None or number >= len(items):
        return
    chosen = set(random.Random(config.getoption("--seed")).sample(range(len(items)), number))
    config.hook.pytest_deselected(items=[i for n, i in enumerate(items) if n not in chosen])
    items[:] = [item for n, item in enumerate(items) if n in chosen]
