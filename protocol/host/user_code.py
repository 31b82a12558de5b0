"""Modules that users write: found by a reference in a file, with their errors in one line."""

from __future__ import annotations

import decimal
import hashlib
import importlib
import importlib.util
import sys
import traceback
from contextvars import Context, copy_context
from pathlib import Path
from types import ModuleType

import numpy as np

from protocol.errors import ConfigurationError
from protocol.text.names import nearest


def load_module(place: str, base: Path) -> ModuleType:
    """The module at a place; loading it runs its code.

    Args:
        place: ``package.module`` for an installed module, or ``path/to/file.py``.
        base: folder that a relative path starts from.

    Raises:
        ConfigurationError: no such module or file, or its import failed.
    """
    return _from_file(base / place) if place.endswith(".py") else _installed(place)


def user_context() -> Context:
    """A context for code of users: what it tells NumPy and `decimal` holds for itself alone.

    It begins with silence about values that are not finite.
    """
    with np.errstate(all="ignore"):
        context = copy_context()
    context.run(lambda: decimal.setcontext(decimal.getcontext().copy()))
    return context


def error_text(error: BaseException) -> str:
    """An exception of a user's code in one line, with the place where it was raised."""
    text = f"{type(error).__name__}: {error}"
    frames = traceback.extract_tb(error.__traceback__)
    return (
        f"{text} ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else text
    )


def _from_file(path: Path) -> ModuleType:
    path = path.resolve()
    if not path.is_file():
        beside = sorted(p.name for p in path.parent.glob("*.py"))
        raise ConfigurationError(f"no file {path}{nearest(path.name, beside)}")
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


def _installed(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = error.name or name
        if name != missing and not name.startswith(missing + "."):
            raise _import_failure(name, error) from error
        raise ConfigurationError(
            f"no module '{missing}'",
            remedy="install its package, or name the file as path/to/file.py:NAME",
        ) from error
    except (Exception, SystemExit) as error:
        raise _import_failure(name, error) from error


def _import_failure(place: str, error: BaseException) -> ConfigurationError:
    return ConfigurationError(f"import of {place} failed: {error_text(error)}")
