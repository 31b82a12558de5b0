"""FMPy's own validation of an FMU's model description."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from fmpy.validation import validate_fmu

from slave_node.fmu.archive import extract


def description_problems(fmu: Path) -> list[str]:
    """What is wrong with modelDescription.xml: schema, names, ModelStructure, start values, units.

    Raises:
        ModelError: the file is missing, unsafe or no FMU.
    """
    with TemporaryDirectory(prefix="doublestep-") as directory:
        extract(fmu, Path(directory))
        return [" ".join(str(problem).split()) for problem in validate_fmu(directory)]
