"""Find the class of a Python model by a reference from a system file."""

from __future__ import annotations

import inspect
from pathlib import Path
from types import ModuleType

from protocol.errors import ConfigurationError, ModelError
from protocol.host.user_code import load_module
from protocol.text.names import nearest
from protocol.text.references import split_reference
from slave_node.model import Model


def load_model_class(reference: str, base: Path) -> type[Model]:
    """The `Model` class that ``reference`` names.

    Loading a model runs its code.

    Args:
        reference: ``package.module:Class`` for an installed module, or ``path/to/file.py:Class``.
        base: folder that a relative path starts from.

    Raises:
        ModelError: no such module, file or class, the import failed, or no `Model`.
    """
    place, name = split_reference(reference) or ("", "")
    if not (place and name):
        raise ModelError(
            f"'{reference}' does not name a model",
            remedy="write package.module:Class or path/to/file.py:Class",
        )
    try:
        module = load_module(place, base)
    except ConfigurationError as error:
        raise ModelError(error.cause, remedy=error.remedy) from error
    return _model_class(module, name, reference)


def _model_class(module: ModuleType, name: str, reference: str) -> type[Model]:
    models = [
        key
        for key, value in vars(module).items()
        if inspect.isclass(value) and issubclass(value, Model) and value is not Model
    ]
    found = getattr(module, name, None)
    if found is None:
        raise ModelError(f"'{reference}': no class '{name}' there{nearest(name, models)}")
    if not (inspect.isclass(found) and issubclass(found, Model)):
        raise ModelError(
            f"'{reference}': '{name}' is not a subclass of Model{nearest(name, models)}"
        )
    return found
