"""Record of a run of a study: ``run.json`` in its directory, written last.

Where it is, the run has ended by itself. A run that was interrupted leaves none.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal

RECORD_FILE = "run.json"
CASE_FILE = "case.toml"
LOG_FILE = "run.log"


@dataclass(frozen=True)
class RunRecord:
    """Outcome of a run.

    Attributes:
        fingerprint: of what was run, see `PlannedRun`.
        outcome: whether it reached its end.
        exit_code: of its process; negative: the signal that ended it.
        message: why it failed, or "".
        wall_time: of the whole process [s].
    """

    fingerprint: str
    outcome: Literal["completed", "failed"]
    exit_code: int
    message: str
    wall_time: float

    @property
    def is_completed(self) -> bool:
        """True if its results are whole."""
        return self.outcome == "completed"


def write_record(directory: Path, record: RunRecord) -> None:
    """Write ``run.json``; raises OSError."""
    text = json.dumps(asdict(record), indent=2) + "\n"
    (directory / RECORD_FILE).write_text(text, encoding="utf-8", errors="replace")


def read_record(directory: Path) -> RunRecord | None:
    """Read ``run.json``; None where there is none or it is broken, so that the run is repeated."""
    try:
        known = json.loads((directory / RECORD_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    types = {"fingerprint": str, "exit_code": int, "message": str, "wall_time": float}
    if (
        not isinstance(known, dict)
        or known.keys() != {field.name for field in fields(RunRecord)}
        or known["outcome"] not in ("completed", "failed")
        or not all(isinstance(known[key], kind) for key, kind in types.items())
    ):
        return None
    return RunRecord(**known)
