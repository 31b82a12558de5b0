"""The quarter car for benchmarks: the FMUs of the examples, steps kept small for many attempts."""

from pathlib import Path
from typing import Any

from master_node import System, load_system

EXAMPLE = Path(__file__).parents[1] / "examples" / "quarter_car"


ESTIMATOR_NAMES = {"mod": "EST_mod", "rich": "EST_Rich"}
"""The paper's names of the estimators."""


def system(**simulation: Any) -> System:
    """Displacement-displacement coupling with EST_mod and k = 1, and what is given."""
    settings = {"estimator": "mod", "order": 1, "largest_step_size": 1e-2, **simulation}
    return load_system(EXAMPLE / "displacement.toml").with_simulation(**settings)
