"""Find the class of a Python model by a reference from a system file."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import sys
from pathlib import Path
from types import ModuleType

from protocol.errors import ModelError
from protocol.names import nearest
from slave_node.model import Model, error_text


def load_model_class(reference: str, base: Path) -> type[Model]:
    """The `Model` class that ``reference`` names.

    Loading a model runs its code.

    Args:
        reference: ``package.module:Class`` for an installed module, or ``path/to/file.py:Class``.
        base: folder that a relative path starts from.

    Raises:
        ModelError: no such module, file or class, the import failed, or no `Model`.
    """
    place, separator, name = reference.rpartition(":")
    if not (separator and place and name):
        raise ModelError(
            f"'{reference}' does not name a model",
            remedy="write package.module:Class or path/to/file.py:Class",
        )
    is_file = place.endswith(".py")
    module = _module_from_file(base / place) if is_file else _installed_module(place)
    return _model_class(module, name, reference)


def _module_from_file(path: Path) -> ModuleType:
    path = path.resolve()
    if not path.is_file():
        beside = sorted(p.name for p in path.parent.glob("*.py"))
        raise ModelError(f"no file {path}{nearest(path.name, beside)}")
    # A name of its own, so that it can neither hide nor be hidden by an installed module.
    name = f"{path.stem}_{hashlib.sha256(bytes(path)).hexdigest()[:16]}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None  # a path that ends in .py always has a loader
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses and inspect look there
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise _import_failure(str(path), error) from error
    return module


def _installed_module(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = error.name or name
        if name != missing and not name.startswith(missing + "."):
            raise _import_failure(name, error) from error
        raise ModelError(
            f"no module '{missing}'",
            remedy="install its package, or name the file as path/to/file.py:Class",
        ) from error
    except (Exception, SystemExit) as error:
        raise _import_failure(name, error) from error


def _import_failure(place: str, error: BaseException) -> ModelError:
    return ModelError(f"import of {place} failed: {error_text(error)}")


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
