"""The words of an FMU: each message is in its log, warnings are counted and told once."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from master_node import Result, System, simulate
from protocol.errors import InterruptedRunError, ModelError
from protocol.host import log_files
from protocol.host.log_files import LogOutput
from slave_node.fmu.log import FmuLog

WARNING = "fmi{}Warning [logStatusWarning]"
TEXT = "its table ends at 0.5 s"


def run(
    folder: Path, output: Path | None, name: str, *, in_process: bool = True, **slave: Any
) -> Result:
    """A run of one lag; its first steps are short, its last ones begin behind 0.5 s."""
    system = System(
        simulation={"stop_time": 1.0, "examine": False},
        slaves={"lag": {"model": f"{name}.fmu", "parameters": {"u": 1.0}, **slave}},
        base=folder,
    )
    return simulate(system, output=output, in_process=in_process)


def lines_of(output: Path) -> list[str]:
    """The lines of the log."""
    return (output / "logs" / "lag.log").read_text().splitlines()


@pytest.mark.parametrize("in_process", [True, False])
@pytest.mark.parametrize(
    ("version", "state"),
    [(1, "none"), (1, "fork"), (2, "native"), (2, "fork"), (2, "replay"), (3, "native")],
)
def test_warnings_are_written_counted_and_told_once(
    capability_dir: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    version: int,
    state: str,
    *,
    in_process: bool,
) -> None:
    """Law: wherever the FMU is and however its states are saved, each message has its line, with
    status and category; and the summary counts messages and returned statuses.
    """
    name = f"warns{version}"
    result = run(capability_dir, tmp_path, name, in_process=in_process, state=state)
    prefix = "" if version == 1 else version
    written = [line for line in lines_of(tmp_path) if WARNING.format(prefix) in line]
    assert written
    assert all(TEXT in line and " lag: " in line for line in written)
    returned = [line for line in lines_of(tmp_path) if "DoStep returned" in line]
    assert len(returned) == len(written)
    counted = result.summary["model_warnings"]["lag"]
    if state == "replay":  # what is computed anew is said again, and counted once
        assert 0 < counted <= 2 * len(written)
    else:
        assert counted == 2 * len(written)
    told = [r.getMessage() for r in caplog.records if "its model warns" in r.getMessage()]
    assert len(told) == 1
    assert TEXT in told[0]


def test_an_fmu_without_warnings_counts_none(capability_dir: Path, tmp_path: Path) -> None:
    """A run of a silent FMU has the count 0, and in process no log."""
    result = run(capability_dir, tmp_path, "plain_lag")
    assert result.summary["model_warnings"] == {"lag": 0}
    assert not (tmp_path / "logs").exists()


def test_a_run_without_results_leaves_no_log(
    capability_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Law: nothing is written where nothing was asked for."""
    monkeypatch.chdir(tmp_path)
    assert run(capability_dir, None, "warns2").summary["model_warnings"]["lag"] > 0
    assert not list(tmp_path.iterdir())


NAMES = ("logEvents", "logStatusWarning", "logStatusError", "logStatusDiscard", "logAll")


@pytest.mark.parametrize(
    ("patterns", "wanted"),
    [
        ((), NAMES[1:4]),
        (("*",), NAMES),
        (("logStatus*", "logEvents"), NAMES[:4]),
    ],
)
def test_categories_are_chosen_by_patterns(
    patterns: tuple[str, ...], wanted: tuple[str, ...]
) -> None:
    """Without a pattern those of warnings and errors are wanted."""
    log = FmuLog("lag", LogOutput(categories=patterns))
    assert tuple(log.wanted_categories(NAMES)) == wanted
    assert log.is_wanted is bool(patterns)


@pytest.mark.parametrize("in_process", [True, False])
def test_the_choice_reaches_the_fmu(
    capability_dir: Path, tmp_path: Path, *, in_process: bool
) -> None:
    """``fmi_logging`` reaches FMUs however they run; a pattern without a category is an error."""
    run(capability_dir, tmp_path, "discards", in_process=in_process, fmi_logging=["*"])
    assert any("fmi2Discard [logStatusDiscard]" in line for line in lines_of(tmp_path))
    with pytest.raises(ModelError, match="no log category 'logEvents'") as caught:
        run(capability_dir, None, "discards", in_process=in_process, fmi_logging=["logEvents"])
    assert caught.value.slave == "lag"


def test_a_log_of_an_earlier_run_makes_way(capability_dir: Path, tmp_path: Path) -> None:
    """Law: a log is of one run, and a link in its place is not followed."""
    other = tmp_path / "other"
    other.write_text("mine")
    (tmp_path / "results" / "logs").mkdir(parents=True)
    (tmp_path / "results" / "logs" / "lag.log").symlink_to(other)
    run(capability_dir, tmp_path / "results", "warns2")
    first = lines_of(tmp_path / "results")
    run(capability_dir, tmp_path / "results", "warns2")
    assert len(lines_of(tmp_path / "results")) == len(first)
    assert other.read_text() == "mine"


def test_log_files_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Law: no line is lost while a file is moved, and who has it open writes on in it."""
    monkeypatch.setattr(log_files, "MOST_BYTES", 1000)
    file = tmp_path / "a.log"
    file.touch()
    descriptor = os.open(file, os.O_WRONLY | os.O_APPEND)
    for number in range(30):
        log_files.append(file, f"{number:060}")
    os.write(descriptor, b"the end\n")
    os.close(descriptor)
    before, after = (tmp_path / "a.log.1").read_text(), file.read_text()
    numbers = [int(line) for line in (before + after).splitlines()[:-1]]
    assert numbers == list(range(30))
    assert after.endswith("the end\n")
    assert max(len(before), len(after)) < 1100


def test_ctrl_c_while_an_fmu_logs_is_heard(
    capability_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Law: a signal that comes in a callback, through which no exception goes, ends the run."""
    said: list[str] = []

    def interrupted(*_: object) -> None:
        if not said:
            said.append("once")
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(FmuLog, "add", interrupted)
    with pytest.raises(InterruptedRunError):
        run(capability_dir, tmp_path, "warns2")
    assert said == ["once"]
