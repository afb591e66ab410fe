"""A small forecaster that continues what it saw."""

from __future__ import annotations

from functools import cache
from typing import Any

from helpers.env_stand_in import group


@cache
def fast() -> dict[str, Any]:
    return group("forecaster", "fast")["continued"]


def continued(network: dict[str, Any] | None = None, **changes: Any) -> dict[str, Any]:
    """As ``conf/forecaster/fast.yaml`` has it, but small."""
    given = fast()["network"]
    optimiser = {**given["optimiser"], "batch": 4, "validation_share": 0.2}
    small = {"recurrent": 4, "layers": 1, "context": 5, "horizon": 6, "optimiser": optimiser}
    return {**fast(), "total_frames": 400, "network": {**given, **small, **(network or {})}, **changes}
