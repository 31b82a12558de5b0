"""From a model's name to the slave of the model alone: an FMU or a Python model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from protocol.calls import Configure
from protocol.description import Experiment, SlaveDescription
from protocol.errors import ModelError
from protocol.host.files import is_fmu
from protocol.host.log_files import SILENT, LogOutput
from protocol.host.scratch import ScratchDirectory
from protocol.host.user_code import user_context
from protocol.slave import Slave
from protocol.text.references import split_reference
from slave_node.model import Model, describe
from slave_node.python.loading import load_model_class
from slave_node.substeps.slave import input_derivatives, with_substeps

DEFAULT = Configure()


def load_model(
    model: str,
    base: Path,
    name: str,
    scratch: Path,
    *,
    output: LogOutput = SILENT,
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
            output=output._replace(categories=configuration.log_categories or output.categories),
            structural_parameters=configuration.structural_parameters,
        )
        configuration = replace(configuration, structural_parameters={})
    else:
        from slave_node.python.model_slave import ModelSlave  # noqa: PLC0415  and an FMU no scipy

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


def describe_alone(model: str, base: Path) -> SlaveDescription:
    """The model as it says itself."""
    if is_fmu(model, base):
        from slave_node.fmu.description import describe_fmu  # noqa: PLC0415  as above

        description = describe_fmu((base / model).resolve())
    else:
        description = describe(user_context().run(_model_class, model, base))
    return replace(description, input_derivatives=input_derivatives(description))


def default_experiment(model: str, base: Path) -> Experiment:
    """Experiment that a model suggests; a Python model suggests none.

    Raises:
        ModelError: the model is missing or cannot be read.
    """
    if not is_fmu(model, base):
        describe_alone(model, base)
        return Experiment()
    from slave_node.fmu.description import read_fmu  # noqa: PLC0415  as above

    with ScratchDirectory() as directory:
        return read_fmu((base / model).resolve(), directory).experiment


def _model_class(model: str, base: Path) -> type[Model]:
    if split_reference(model) is None:
        raise ModelError(
            f"{model!r} is not a model",
            remedy="name an .fmu file, the folder of an FMU, package.module:Class or file.py:Class",
        )
    return load_model_class(model, base)
