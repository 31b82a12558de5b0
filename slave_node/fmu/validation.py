"""FMPy's own validation of an FMU's model description."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from fmpy import read_model_description
from fmpy.model_description import ValidationError

from protocol.host.scratch import ScratchDirectory
from slave_node.fmu.archive import extract

MAX_NAMES = 1000
"""FMPy parses a few hundred names of variables per second."""


class DescriptionCheck(NamedTuple):
    """Mistakes in modelDescription.xml, and whether names of variables were parsed too."""

    problems: tuple[str, ...]
    has_parsed_names: bool


def check_description(fmu: Path) -> DescriptionCheck:
    """Look at schema, names, ModelStructure, start values, causalities and units.

    The grammar of names is looked at for up to `MAX_NAMES` variables.

    Raises:
        ModelError: the file is missing, unsafe or no FMU.
    """
    with ScratchDirectory() as directory:
        extract(fmu, directory)
        parses_names = False
        try:
            described = read_model_description(directory, validate=False)
            parses_names = len(described.modelVariables) <= MAX_NAMES
            read_model_description(
                directory,
                validate=True,
                validate_variable_names=parses_names,
                validate_model_structure=True,
            )
        except ValidationError as error:
            problems = error.problems
        except Exception as error:  # fmpy raises whatever its XML and type conversions raise
            problems = [str(error)]
        else:
            problems = []
        return DescriptionCheck(tuple(" ".join(str(p).split()) for p in problems), parses_names)
