"""Results as CSV and strict JSON."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def csv_cell(value: float) -> str:
    """Eight digits; empty where the value is not finite."""
    return f"{float(value):.8g}" if np.isfinite(value) else ""


def write_columns_csv(path: Path, columns: Mapping[str, NDArray[np.float64]]) -> None:
    """One row a frame of one take; ``columns`` hold at most one value a frame and end with the take.

    Metrics of velocities and accelerations are differences to the frames before: their first rows are empty.
    """
    length = max(len(v) for v in columns.values())
    padded = {k: [""] * (length - len(v)) + [csv_cell(x) for x in v] for k, v in columns.items()}
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["frame", *padded])
        writer.writerows([t, *(padded[k][t] for k in padded)] for t in range(length))


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Strict JSON: what is not finite becomes null."""
    path.write_text(json.dumps(finite_or_null(values), indent=1, allow_nan=False) + "\n")


def finite_or_null(value: Any) -> Any:
    """``value`` with None in place of every number that is not finite, in nested containers too."""
    if isinstance(value, Mapping):
        return {str(k): finite_or_null(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite_or_null(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
