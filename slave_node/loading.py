"""From a model's name to the slave that runs it: the one place that builds concrete slaves."""

from __future__ import annotations

from pathlib import Path

from protocol.errors import ModelError
from protocol.slave import CallExecutor, Slave, SlaveDescription
from slave_node.executor import Executor
from slave_node.model import Model, describe
from slave_node.model_loading import load_model_class


def load_slave(model: str, base: Path, name: str, scratch: Path, *, log_all: bool = False) -> Slave:
    """The slave for ``model``.

    Args:
        model: path of an ``.fmu`` file, or ``package.module:Class`` or ``file.py:Class``; paths
            are relative to ``base``.
        base: directory of the system file, or the working directory.
        name: instance name.
        scratch: an existing empty directory to extract into; the caller removes it after close.
        log_all: let an FMU log all its categories.

    Raises:
        ModelError: the model is missing, unusable, or not for this platform.
    """
    if _is_fmu(model):
        from slave_node.fmu.fmi2 import Fmi2Slave  # noqa: PLC0415  a Python model needs no fmpy

        return Fmi2Slave((base / model).resolve(), scratch, name, log_all=log_all)
    from slave_node.model_slave import ModelSlave  # noqa: PLC0415  and an FMU no scipy

    return ModelSlave(_model_class(model, base))


def describe_model(model: str, base: Path) -> SlaveDescription:
    """The description of ``model`` without loading an FMU's binary, which may be for elsewhere.

    Raises:
        ModelError: the model is missing or cannot be read.
    """
    if _is_fmu(model):
        from slave_node.fmu.description import describe_fmu  # noqa: PLC0415  as above

        return describe_fmu((base / model).resolve())
    return describe(_model_class(model, base))


def _is_fmu(model: str) -> bool:
    return model.lower().endswith(".fmu")


def _model_class(model: str, base: Path) -> type[Model]:
    if ":" not in model:
        raise ModelError(
            f"{model!r} is not a model",
            remedy="name an .fmu file, package.module:Class or file.py:Class",
        )
    return load_model_class(model, base)


def load_executor(model: str, base: Path, name: str, scratch: Path) -> CallExecutor:
    """The same, ready to execute calls: what a master uses that runs a slave in its own process."""
    return Executor(load_slave(model, base, name, scratch))
