"""Directories of others: no link in them is followed when something is written, and nothing that
they name is run unless the user says so.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import stat
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from master_node import Result, load_system, resume, simulate
from master_node.cli.app import app
from master_node.results.formats import FILES
from master_node.study.directory import LOCK_FILE, TABLE_FILE
from master_node.system.files import export_system, import_system, open_system
from protocol.errors import (
    ConfigurationError,
    DoublestepError,
    InterruptedRunError,
    ModelError,
    ResultsError,
)
from protocol.host.files import entry_names
from protocol.host.new_files import open_new, open_old, own_folder, remove_folder
from slave_node.loading import describe_model
from tests.faults.test_processes import system_file
from tests.master_node.resuming.test_resume import Interrupt, car

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="makes links"),
    pytest.mark.usefixtures("no_process_left"),
]

ALL_FORMATS = 'formats = ["csv", "arrow", "parquet", "mat"]\n'
SHORT = "stop_time = 0.3\n"


class Victims:
    """Files and folders outside, to which links lead."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: list[Path] = []
        folder.mkdir()

    def behind(self, link: Path, *, missing: bool = False) -> None:
        """Put a link to a new file there, or to one that is not there yet."""
        victim = self._folder / f"victim{len(self._files)}"
        self._files.append(victim)
        if not missing:
            victim.write_text("precious")
        link.parent.mkdir(parents=True, exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(victim)

    def folder_behind(self, link: Path) -> None:
        """Put a link to a new folder there."""
        victim = self._folder / f"folder{link.name}"
        victim.mkdir()
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(victim)

    def check(self) -> None:
        """Law: each is as it was, and there is no other."""
        there = {path for path in self._folder.rglob("*") if path.is_file()}
        assert all(path.read_text() == "precious" for path in there)
        assert there <= set(self._files)


@pytest.fixture
def victims(tmp_path: Path) -> Victims:
    """See `Victims`."""
    return Victims(tmp_path / "outside")


def test_files_are_opened_only_where_no_link_is(tmp_path: Path, victims: Victims) -> None:
    """The functions that all the others stand on."""
    link = tmp_path / "link"
    for missing in (False, True):
        victims.behind(link, missing=missing)
        for to_append in (False, True):
            with pytest.raises(OSError, match=r"symbolic links|No such file"):
                open_old(link, to_append=to_append)
        with open_new(link) as file:
            file.write(b"new")
        assert not link.is_symlink()
        with open_old(link) as file:
            assert file.read() == b"new"
        with open_old(link, to_append=True) as file:
            file.write(b"er")
        assert link.read_bytes() == b"newer"
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="no file"):
        open_old(tmp_path / "pipe")
    victims.folder_behind(tmp_path / "away")
    with pytest.raises(OSError, match="is a link, which is not followed"):
        own_folder(tmp_path / "away")
    (tmp_path / "outside" / "folderaway" / "more").mkdir()
    remove_folder(tmp_path / "away")
    assert not (tmp_path / "away").exists()
    assert (tmp_path / "outside" / "folderaway" / "more").is_dir()
    assert own_folder(tmp_path / "own").is_dir()
    remove_folder(tmp_path / "own")
    assert not (tmp_path / "own").exists()
    victims.check()


# ---- Results ------------------------------------------------------------------------------------


@pytest.mark.parametrize("missing", [False, True])
def test_a_run_into_a_directory_of_links(missing: bool, tmp_path: Path, victims: Victims) -> None:
    """All names of a results directory: the run takes their places, and what is behind is kept."""
    out = tmp_path / "out"
    for name in FILES:
        victims.behind(out / name, missing=missing)
        victims.behind(out / f"{name}.part", missing=missing)
    victims.folder_behind(out / "checkpoint")
    system = car(tmp_path, SHORT, ALL_FORMATS)
    simulate(system, output=out, in_process=True)
    victims.check()
    assert len(Result.load(out).time) > 3
    assert app_says("plot", out) == 0
    victims.check()
    assert not any(path.is_symlink() for path in out.iterdir() if not path.name.endswith(".part"))


def test_logs_of_slaves_are_no_way_out(tmp_path: Path, victims: Victims) -> None:
    """The log of a slave takes the place of a link; a folder of logs that is one is refused."""
    out = tmp_path / "out"
    system = car(tmp_path, SHORT)
    victims.behind(out / "logs" / "wheel.log")
    victims.behind(out / "logs" / "chassis.log", missing=True)
    simulate(system, output=out)
    victims.check()
    assert "ready" in (out / "logs" / "wheel.log").read_text()
    shutil.rmtree(out / "logs")
    victims.folder_behind(out / "logs")
    with pytest.raises(ResultsError, match=r"logs: it is a link.*; a link is in the way"):
        simulate(system, output=out)
    victims.check()


def app_says(*words: object) -> int:
    """The exit code of a command in this process."""
    result = CliRunner().invoke(app, list(map(str, words)))
    error = result.exception
    return error.exit_code if isinstance(error, DoublestepError) else result.exit_code


def test_a_picture_goes_where_the_user_says_and_nowhere_else(
    tmp_path: Path, victims: Victims
) -> None:
    """A link under the name of the picture is replaced; one that the user names is followed."""
    out = tmp_path / "theirs"
    out.mkdir()
    (out / "results.csv").write_text("time,a.x\n0.0,1.0\n1.0,2.0\n")
    victims.behind(out / "results.png")
    assert app_says("plot", out) == 0
    victims.check()
    assert (out / "results.png").read_bytes().startswith(b"\x89PNG")
    mine = tmp_path / "mine.png"
    (tmp_path / "link.png").symlink_to(mine)
    assert app_says("plot", out, "--file", tmp_path / "link.png") == 0
    assert mine.read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "link.png").is_symlink()


@pytest.mark.parametrize("name", ["results.csv", "steps.csv", "results.arrow", "summary.json"])
def test_a_pipe_in_the_place_of_a_file_is_refused(name: str, tmp_path: Path) -> None:
    """No process writes to it, and a reader would wait for ever."""
    (tmp_path / "results.csv").write_text("time,a.x\n0.0,1.0\n")
    (tmp_path / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / name)
    with pytest.raises(ResultsError, match=f"{name}: it is no file"):
        Result.load(tmp_path)


# ---- Resuming -----------------------------------------------------------------------------------


def broken_off(folder: Path, results: str = "") -> Path:
    """The results of a run that can be resumed."""
    system = car(folder, "stop_time = 1.0\ncheckpoint_interval = 1e-6\n", results)
    with pytest.raises(InterruptedRunError):
        simulate(system, output=folder / "out", in_process=True, observers=(Interrupt(9),))
    return folder / "out"


@pytest.mark.parametrize(
    "name", ["results.csv", "steps.csv", "checkpoint/chassis.0.calls", "checkpoint"]
)
def test_a_run_is_not_resumed_into_what_links_lead_to(name: str, tmp_path: Path) -> None:
    """Even where the files behind them would fit: said with the file, which is as it was."""
    out = broken_off(tmp_path)
    assert (out / name).exists(), list((out / "checkpoint").iterdir())
    twin = tmp_path / "twin"
    (out / name).rename(twin)
    (out / name).symlink_to(twin)
    before = _contents(twin)
    with pytest.raises(ResultsError, match=name):
        resume(out)
    assert _contents(twin) == before
    (out / name).unlink()
    twin.rename(out / name)
    resume(out)
    assert Result.load(out).summary["outcome"] == "completed"


def _contents(path: Path) -> dict[str, bytes]:
    files = [path] if path.is_file() else sorted(path.iterdir())
    return {file.name: file.read_bytes() for file in files}


def test_links_that_wait_for_new_files_of_a_resumed_run(tmp_path: Path, victims: Victims) -> None:
    """Parts and what is made at the end take their places."""
    out = broken_off(tmp_path, ALL_FORMATS)
    for name in ("results.parquet", "results.mat", "results.png"):
        victims.behind(out / name)
    for name in ("results.parquet", "results.mat", "summary.json", ".end.json", ".start.json"):
        victims.behind(out / f"{name}.part")
    victims.behind(out / "checkpoint" / "run.zip.part")
    resume(out)
    victims.check()
    assert Result.load(out).summary["outcome"] == "completed"


@pytest.mark.parametrize(
    ("name", "first"), [("../../evil", 0), ("a/b", 0), ("chassis", "../../evil"), ("chassis", -1)]
)
def test_names_in_a_checkpoint_are_no_paths(name: str, first: object, tmp_path: Path) -> None:
    """A header that leads elsewhere is no checkpoint."""
    out = broken_off(tmp_path)
    path = out / "checkpoint" / "run.zip"
    with zipfile.ZipFile(path) as archive:
        entries = {entry: archive.read(entry) for entry in archive.namelist()}
    header = json.loads(entries["run.json"])
    header["slaves"] = {n: told | {"state": None} for n, told in header["slaves"].items()}
    told = header["slaves"].pop("chassis")
    header["slaves"][name] = told | {"first": first}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("run.json", json.dumps(header))
    with pytest.raises(ResultsError, match=r"run\.zip: .*(not the name|are not numbers)"):
        resume(out)
    assert not list(tmp_path.rglob("evil*"))


@pytest.mark.skipif(os.name != "posix" or os.getuid() != 0, reason="gives files away")
@pytest.mark.parametrize("name", ["", "checkpoint", "checkpoint/system.json", "checkpoint/run.zip"])
def test_what_somebody_else_has_written_is_not_run(name: str, tmp_path: Path) -> None:
    """Refused with the file and the remedy, which then works."""
    out = broken_off(tmp_path)
    os.chown(out / name, 12345, -1)
    with pytest.raises(ConfigurationError, match=r"is of another user \(uid 12345\).*say --trust"):
        resume(out)
    assert app_says("resume", out, "--no-plot", "--quiet") == 2
    assert app_says("resume", out, "--no-plot", "--quiet", "--trust") == 0


def test_what_everybody_can_write_is_not_run(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A sticky folder passes, as users make their own files there only. Programs are logged."""
    caplog.set_level(logging.INFO)
    out = broken_off(tmp_path)
    (out / "checkpoint").chmod(0o777)
    with pytest.raises(ConfigurationError, match="can be written by everybody"):
        resume(out)
    (out / "checkpoint").chmod(0o777 | stat.S_ISVTX)
    resume(out)
    told = [r.getMessage() for r in caplog.records if "names what is run" in r.getMessage()]
    assert "chassis: " in told[-1]
    assert "quarter_car.py:Chassis" in told[-1]


# ---- Studies, packages, FMUs --------------------------------------------------------------------


def test_a_study_in_a_directory_of_links(tmp_path: Path, victims: Victims) -> None:
    """Its table takes the place of a link; a lock or a folder of runs that is one is refused."""
    system_file(tmp_path, simulation=SHORT)
    (tmp_path / "study.toml").write_text(
        'system = "car.toml"\n[parameters]\n"simulation.stop_time" = [0.1]\n'
        "[run]\nin_process = true\nplot = false\n"
    )
    out = tmp_path / "out"
    sweep = ("sweep", tmp_path / "study.toml", "--output", out, "--quiet")
    victims.behind(out / TABLE_FILE)
    victims.behind(out / f"{TABLE_FILE}.part")
    assert app_says(*sweep) == 0
    victims.check()
    victims.behind(out / LOCK_FILE)
    assert app_says(*sweep) == 7
    (out / LOCK_FILE).unlink()
    shutil.rmtree(out / "runs")
    victims.folder_behind(out / "runs")
    assert app_says(*sweep) == 7
    victims.check()


def test_packages_are_written_over_no_link(
    tmp_path: Path, victims: Victims, quarter_car_ssp: Path
) -> None:
    """Import and export: the files, their parts, the folder of models and what is in it."""
    file = tmp_path / "car.toml"
    victims.behind(tmp_path / ".car.toml.part")
    import_system(quarter_car_ssp, file)
    models = tmp_path / "car_models"
    for name in sorted(path.name for path in models.iterdir()):
        victims.behind(models / name)
    victims.behind(file)
    import_system(quarter_car_ssp, file)
    victims.check()
    assert load_system(file).slaves
    for path in (tmp_path / ".out.ssp.part", tmp_path / "out.ssp"):
        victims.behind(path)
    export_system(file, tmp_path / "out.ssp")
    victims.check()
    assert zipfile.is_zipfile(tmp_path / "out.ssp")
    models.rename(tmp_path / "elsewhere")
    models.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ConfigurationError, match="is a link, which is not followed"):
        import_system(quarter_car_ssp, file)


@pytest.mark.parametrize("name", ["resources/secret", "resources", "modelDescription.xml"])
def test_links_in_the_folder_of_an_fmu_are_refused(
    name: str, tmp_path: Path, fmu_dir: Path
) -> None:
    """Files behind links would be copied, and sent to agents, as from archives."""
    folder = tmp_path / "wheel"
    with zipfile.ZipFile(fmu_dir / "wheel.fmu") as archive:
        archive.extractall(folder)
    assert describe_model("wheel", tmp_path).model
    (folder / "resources").mkdir(exist_ok=True)
    target = tmp_path / "secret"
    if (folder / name).exists():
        (folder / name).rename(target)
    else:
        target.write_text("precious")
    (folder / name).symlink_to(target)
    with pytest.raises(ModelError, match=f"{name} is a symbolic link"):
        describe_model("wheel", tmp_path)
    with pytest.raises(OSError, match="symbolic link"):
        list(entry_names(folder))


def test_links_that_lead_to_themselves_end(tmp_path: Path, fmu_dir: Path) -> None:
    """Two of them are 2**40 paths."""
    folder = tmp_path / "wheel"
    with zipfile.ZipFile(fmu_dir / "wheel.fmu") as archive:
        archive.extractall(folder)
    (folder / "resources").mkdir(exist_ok=True)
    for name in "ab":
        (folder / "resources" / name).symlink_to(folder / "resources")
    with pytest.raises(ModelError, match="is a symbolic link"):
        describe_model("wheel", tmp_path)


BUS = """
[bus]
listen = ["tcp/127.0.0.1:7450"]
tls = "/etc/theirs"
step_timeout = 5.0
"""


def test_a_package_says_nothing_of_the_bus_unless_it_is_let(
    tmp_path: Path, quarter_car_ssp: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It chose addresses and certificates; a note names what is left out, and what takes it."""
    file, package = tmp_path / "car.toml", tmp_path / "theirs.ssp"
    import_system(quarter_car_ssp, file)
    file.write_text(file.read_text() + BUS)
    export_system(file, package)
    with open_system(package) as system:
        assert system.bus == type(system.bus)()
    assert "[bus] listen, tls, step_timeout is not taken from a package" in caplog.text
    assert "--package-bus" in caplog.text
    with open_system(package, package_bus=True) as system:
        assert system.bus.listen == ("tcp/127.0.0.1:7450",)
    for words, expected in (((), False), (("--package-bus",), True)):
        again = tmp_path / "again.toml"
        assert app_says("import", package, "--output", again, *words) == 0
        assert ("7450" in again.read_text()) is expected
