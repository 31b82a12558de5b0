"""From an FMU file to the adapter for its version of FMI and its interface."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from protocol.errors import ModelError
from protocol.host.log_files import SILENT, LogOutput
from protocol.slave import Slave
from protocol.variables import StartValue
from slave_node.fmu.description import FmuModel, read_fmu
from slave_node.fmu.fmi1 import Fmi1Slave
from slave_node.fmu.fmi2 import Fmi2Slave
from slave_node.fmu.fmi3 import Fmi3Slave


def load_fmu(
    fmu: Path,
    directory: Path,
    name: str,
    *,
    output: LogOutput = SILENT,
    structural_parameters: Mapping[str, StartValue] | None = None,
) -> Slave:
    """The slave for an FMU.

    Args:
        fmu: the file, or the folder of one that is unpacked.
        directory: an empty directory to extract it into; the caller removes it.
        name: instance name.
        output: where its messages go, and which ones it is asked for.
        structural_parameters: values that hold instead of the start values (FMI 3.0).

    Raises:
        ModelError: the FMU cannot be read, loaded or instantiated here, or has no such structural
            parameter.
    """
    model = read_fmu(fmu, directory, structural_parameters)
    if model.interface.is_model_exchange:
        return _model_exchange(model, name, output)
    return _CO_SIMULATION[model.interface.version](model, name, output)


_CO_SIMULATION: Mapping[int, Callable[..., Slave]] = {1: Fmi1Slave, 2: Fmi2Slave, 3: Fmi3Slave}


def _model_exchange(model: FmuModel, name: str, output: LogOutput) -> Slave:
    try:
        from slave_node.fmu import model_exchange  # noqa: PLC0415  others need no SUNDIALS
    except OSError as error:
        raise ModelError(
            f"{model.fmu}: {model.interface.kind} needs SUNDIALS, which FMPy does not bring for "
            f"this platform: {error}",
            remedy="export it as co-simulation",
        ) from error
    return model_exchange.ADAPTERS[model.interface.version](model, name, output)
