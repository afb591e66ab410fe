"""Small settings of the planner."""

from __future__ import annotations

from typing import Any

from egopose.core.config import compose_config
from egopose.inference.planner_settings import PlannerSettings, planner_settings

#: A search in one round, its best way taken.
SMALL = {
    "samples": 12,
    "rounds": 1,
    "tie_tolerance": 0.0,
    "horizon": 8,
    "every": 8,
    "knot_spacing": 3,
    "acceleration": 0.001,
    "recovery_rounds": 0,
}


def settings(**changed: Any) -> PlannerSettings:
    """``conf/planner/ahead.yaml`` but for what is given."""
    made = planner_settings({**compose_config("evaluate", ["checkpoint=none", "planner=ahead"])["planner"], **changed})
    assert made is not None
    return made
