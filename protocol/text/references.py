"""References to Python code: ``package.module:Name`` and ``path/to/file.py:Name``."""

from __future__ import annotations


def split_reference(reference: str) -> tuple[str, str] | None:
    r"""Place and name of Python code; None where there is no ``:`` but that of a Windows drive.

    ``C:\models\a.py:Class`` is the class of a file on drive C, ``C:\a.fmu`` a file alone. Either
    part may be empty, which is no reference that can be loaded.
    """
    place, colon, name = reference.rpartition(":")
    is_drive = len(place) == 1 and place.isalpha() and not name.isidentifier()
    return None if not colon or is_drive else (place, name)
