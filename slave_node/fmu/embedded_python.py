"""FMUs of PythonFMU and PythonFMU3: their Python code runs in the interpreter of this process.

The binary puts the folder ``resources`` in front of ``sys.path`` and imports the module that
``slavemodule.txt`` names. Left alone, an FMU would get whatever has that name here already: a
module of another FMU, of another build of itself, or of Doublestep. And where the import fails, the
binary goes on without a module, which ends the process.
"""

from __future__ import annotations

import importlib
import os
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from protocol.errors import ModelError
from slave_node.fmu.log import UNNAMED

_MODULE_FILE = "slavemodule.txt"
_COMPILED = (".so", ".pyd", ".dylib")
_importing = threading.RLock()


def slave_module(directory: Path) -> str | None:
    """The module of an extracted FMU in Python; None for any other FMU."""
    file = directory / "resources" / _MODULE_FILE
    if not file.is_file():
        return None
    return next(iter(file.read_text(encoding="utf-8", errors="replace").splitlines()), "").strip()


def log_categories(directory: Path, declared: Sequence[str]) -> tuple[str, ...]:
    """Categories that an extracted FMU can be asked to log.

    The binary of an FMU in Python gives the text of an exception no category, and keeps it back
    where named ones are asked for only.
    """
    return (*declared, *([UNNAMED] if slave_module(directory) is not None else []))


@contextmanager
def own_modules(fmu: Path, directory: Path) -> Iterator[None]:
    """While an FMU in Python is instantiated: it imports its own modules, whatever else is here.

    Afterwards names that stood for something else do so again, and the FMU's folder is the last
    one to be searched: for its later imports, and not in front of ours, here or in a process that
    this one starts. For other FMUs nothing happens.

    Args:
        fmu: the file.
        directory: it was extracted into.

    Raises:
        ModelError: its module cannot be imported; the message says why.
    """
    module = slave_module(directory)
    if module is None:
        yield
        return
    resources = directory / "resources"
    with _importing:
        names = _module_names(resources)
        aside = {name: sys.modules.pop(name) for name in list(sys.modules) if _top(name) in names}
        sys.path.insert(0, str(resources))
        importlib.invalidate_caches()
        try:
            _import(fmu, module, names)
            yield
            _search(resources, last=True)
        except BaseException:
            forget_modules(directory)
            raise
        finally:
            sys.modules.update(aside)


def forget_modules(directory: Path) -> None:
    """Let nothing be found any more that was imported from an extracted FMU."""
    resources = directory / "resources"
    if str(resources) not in sys.path:
        return
    _search(resources, last=False)
    folder = str(resources) + os.sep
    for name, module in list(sys.modules.items()):
        if _origin(module).startswith(folder):
            del sys.modules[name]
    for entry in [e for e in sys.path_importer_cache if (e + os.sep).startswith(folder)]:
        del sys.path_importer_cache[entry]


def _search(resources: Path, *, last: bool) -> None:
    """Search an FMU's folder for modules after all others, or not at all."""
    sys.path[:] = [entry for entry in sys.path if entry != str(resources)]
    if last:
        sys.path.append(str(resources))


def _import(fmu: Path, module: str, names: set[str]) -> None:
    """Import a module as the FMU's binary will, with an error that says why it cannot."""
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        missing = _top(error.name or "")
        remedy = "" if missing in names else f"install {missing} in the Python of this slave-node"
        raise ModelError(
            f"{fmu}: its Python module {module!r} cannot be imported: {error}", remedy=remedy
        ) from error
    except (Exception, SystemExit) as error:
        raise ModelError(
            f"{fmu}: its Python module {module!r} cannot be imported: "
            f"{type(error).__name__}: {error}"
        ) from error


def _module_names(resources: Path) -> set[str]:
    """Modules and packages in Python.

    Compiled packages are not among them: they can be loaded only once in a process.
    """
    return {path.stem for path in resources.glob("*.py")} | {
        path.parent.name
        for path in resources.glob("*/__init__.py")
        if not any(file.suffix in _COMPILED for file in path.parent.rglob("*"))
    }


def _top(name: str) -> str:
    return name.partition(".")[0]


def _origin(module: ModuleType | None) -> str:
    return str(getattr(module, "__file__", None) or "")
