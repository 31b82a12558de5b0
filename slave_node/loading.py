"""From a model's name to the slave that runs it: the one place that builds concrete slaves."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from pathlib import Path
from tempfile import mkdtemp

from protocol.calls import Configure
from protocol.description import Experiment, SlaveDescription
from protocol.host.log_files import SILENT, LogOutput
from protocol.slave import CallExecutor, Slave
from slave_node.execution.executor import Executor
from slave_node.models import DEFAULT, default_experiment, describe_alone, load_model
from slave_node.states.ladder import choose, described, with_states


def load_slave(
    model: str,
    base: Path,
    name: str,
    scratch: Path,
    *,
    output: LogOutput = SILENT,
    configuration: Configure = DEFAULT,
) -> Slave:
    """The slave for ``model``, whose state is saved as the configuration says or as is best.

    Args:
        model: path of an ``.fmu`` file or of an FMU's folder, or ``package.module:Class`` or
            ``file.py:Class``; paths are relative to ``base``.
        base: directory of the system file, or the working directory.
        name: instance name.
        scratch: an existing empty directory to extract into; the caller removes it after close.
        output: where the messages of an FMU go, and which ones it is asked for.
        configuration: as it is to be run.

    Raises:
        ModelError: the model is missing, unusable, not for this platform, or cannot be run so.
    """
    choice = choose(describe_alone(model, base), configuration.state_kind)
    alone = replace(configuration, state_kind="")

    def load() -> Slave:
        directory = Path(mkdtemp(prefix="model-", dir=scratch))
        return load_model(model, base, name, directory, output=output, configuration=alone)

    def load_forking(reason: str) -> Slave:
        from slave_node.states.fork_slave import ForkSlave, HeldModel  # noqa: PLC0415  Linux only

        return ForkSlave(HeldModel(model, base, name, scratch, output, alone), reason)

    return with_states(choice, load, load_forking)


def describe_model(model: str, base: Path) -> SlaveDescription:
    """The description of ``model`` without loading an FMU's binary, which may be for elsewhere.

    Raises:
        ModelError: the model is missing or cannot be read.
    """
    description = describe_alone(model, base)
    return described(description, choose(description))


def experiment(model: str, base: Path) -> Experiment:
    """Experiment that ``model`` suggests; raises as `describe_model`."""
    return default_experiment(model, base)


def load_executor(
    model: str,
    base: Path,
    name: str,
    scratch: Path,
    *,
    output: LogOutput = SILENT,
    state_kind: str = "",
) -> CallExecutor:
    """Executor of a model, ready for calls and to load the model in another configuration.

    What a worker uses, and a master that runs a slave in its own process. ``state_kind`` holds
    where a configuration names none.
    """
    numbers = count()

    def load(configuration: Configure) -> Slave:
        directory = scratch / str(next(numbers))
        directory.mkdir()
        if not configuration.state_kind:
            configuration = replace(configuration, state_kind=state_kind)
        return load_slave(model, base, name, directory, output=output, configuration=configuration)

    return Executor(load(DEFAULT), load)
