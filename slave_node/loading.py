"""From a model's name to the slave that runs it: the one place that builds concrete slaves."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from pathlib import Path
from tempfile import mkdtemp

from protocol.calls import Configure
from protocol.errors import ModelError
from protocol.files import is_fmu
from protocol.slave import CallExecutor, Slave, SlaveDescription
from protocol.user_code import user_context
from slave_node.executor import Executor
from slave_node.model import Model, describe
from slave_node.model_loading import load_model_class
from slave_node.states.ladder import choose, described, with_states
from slave_node.substeps import input_derivatives, with_substeps

DEFAULT = Configure()


def load_slave(
    model: str,
    base: Path,
    name: str,
    scratch: Path,
    *,
    log_all: bool = False,
    configuration: Configure = DEFAULT,
) -> Slave:
    """The slave for ``model``, whose state is saved as the configuration says or as is best.

    Args:
        model: path of an ``.fmu`` file or of an FMU's folder, or ``package.module:Class`` or
            ``file.py:Class``; paths are relative to ``base``.
        base: directory of the system file, or the working directory.
        name: instance name.
        scratch: an existing empty directory to extract into; the caller removes it after close.
        log_all: let an FMU log all its categories.
        configuration: as it is to be run.

    Raises:
        ModelError: the model is missing, unusable, not for this platform, or cannot be run so.
    """
    choice = choose(_describe_alone(model, base), configuration.state_kind)
    alone = replace(configuration, state_kind="")

    def load() -> Slave:
        directory = Path(mkdtemp(prefix="model-", dir=scratch))
        return load_model(model, base, name, directory, log_all=log_all, configuration=alone)

    def load_forking(reason: str) -> Slave:
        from slave_node.states.fork_slave import ForkSlave, HeldModel  # noqa: PLC0415  Linux only

        return ForkSlave(HeldModel(model, base, name, scratch, log_all, alone), reason)

    return with_states(choice, load, load_forking)


def load_model(
    model: str,
    base: Path,
    name: str,
    scratch: Path,
    *,
    log_all: bool = False,
    configuration: Configure = DEFAULT,
) -> Slave:
    """The slave of the model alone: its state is saved natively or not at all.

    Arguments and errors as for `load_slave`, but ``configuration`` names no state kind.
    """
    if is_fmu(model, base):
        from slave_node.fmu.loading import load_fmu  # noqa: PLC0415  a Python model needs no fmpy

        slave: Slave = load_fmu(
            (base / model).resolve(),
            scratch,
            name,
            log_all=log_all,
            structural_parameters=configuration.structural_parameters,
        )
        configuration = replace(configuration, structural_parameters={})
    else:
        from slave_node.model_slave import ModelSlave  # noqa: PLC0415  and an FMU no scipy

        context = user_context()
        slave = ModelSlave(context.run(_model_class, model, base), context)
    rest = Configure(
        state_kind=configuration.state_kind,
        structural_parameters=configuration.structural_parameters,
    )
    if rest != DEFAULT:
        slave.close()
        raise ModelError(f"{model}: cannot be run as {rest}")
    return with_substeps(slave, configuration)


def describe_model(model: str, base: Path) -> SlaveDescription:
    """The description of ``model`` without loading an FMU's binary, which may be for elsewhere.

    Raises:
        ModelError: the model is missing or cannot be read.
    """
    description = _describe_alone(model, base)
    return described(description, choose(description))


def _describe_alone(model: str, base: Path) -> SlaveDescription:
    """The model as it says itself."""
    if is_fmu(model, base):
        from slave_node.fmu.description import describe_fmu  # noqa: PLC0415  as above

        description = describe_fmu((base / model).resolve())
    else:
        description = describe(user_context().run(_model_class, model, base))
    return replace(description, input_derivatives=input_derivatives(description))


def _model_class(model: str, base: Path) -> type[Model]:
    if ":" not in model:
        raise ModelError(
            f"{model!r} is not a model",
            remedy="name an .fmu file, the folder of an FMU, package.module:Class or file.py:Class",
        )
    return load_model_class(model, base)


def load_executor(
    model: str,
    base: Path,
    name: str,
    scratch: Path,
    *,
    log_all: bool = False,
    state_kind: str = "",
) -> CallExecutor:
    """The same, ready to execute calls and to load the model in another configuration.

    What a worker uses, and a master that runs a slave in its own process. ``state_kind`` holds
    where a configuration names none.
    """
    numbers = count()

    def load(configuration: Configure) -> Slave:
        directory = scratch / str(next(numbers))
        directory.mkdir()
        if not configuration.state_kind:
            configuration = replace(configuration, state_kind=state_kind)
        return load_slave(
            model, base, name, directory, log_all=log_all, configuration=configuration
        )

    return Executor(load(DEFAULT), load)
