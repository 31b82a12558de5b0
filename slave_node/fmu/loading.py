"""From an FMU file to the adapter for its version of FMI and its interface."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from protocol.slave import Slave, StartValue
from slave_node.fmu.description import read_fmu
from slave_node.fmu.fmi1 import Fmi1Slave
from slave_node.fmu.fmi2 import Fmi2Slave
from slave_node.fmu.fmi3 import Fmi3Slave
from slave_node.fmu.model_exchange import model_exchange_2, model_exchange_3

_ADAPTERS: Mapping[str, Callable[..., Slave]] = {
    "FMI 1.0 co-simulation": Fmi1Slave,
    "FMI 2.0 co-simulation": Fmi2Slave,
    "FMI 3.0 co-simulation": Fmi3Slave,
    "FMI 2.0 model exchange": model_exchange_2,
    "FMI 3.0 model exchange": model_exchange_3,
}


def load_fmu(
    fmu: Path,
    directory: Path,
    name: str,
    *,
    log_all: bool = False,
    structural_parameters: Mapping[str, StartValue] | None = None,
) -> Slave:
    """The slave for an FMU.

    Args:
        fmu: the file.
        directory: an empty directory to extract it into; the caller removes it.
        name: instance name.
        log_all: let the FMU log all its categories, not only its errors.
        structural_parameters: values that hold instead of the start values (FMI 3.0).

    Raises:
        ModelError: the FMU cannot be read, loaded or instantiated here, or has no such structural
            parameter.
    """
    model = read_fmu(fmu, directory, structural_parameters)
    return _ADAPTERS[model.interface.kind](model, name, log_all=log_all)
