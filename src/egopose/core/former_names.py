"""Settings that were renamed or removed since a run was saved, in one table: old run directories keep loading."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

#: Former dotted name -> present one.
RENAMED = {
    "collector.worlds": "collector.num_envs",
    "collector.lanes": "collector.env_groups",
    "collector.lanes_from": "collector.env_groups_from",
    "training.evaluation_worlds": "training.evaluation_num_envs",
    "data.preparation.settle": "data.preparation.ground_alignment",
    "regressor.kernel.limbs": "regressor.kernel.body_parts",
    # Of conf/evaluate, estimate, stream and planner: on command lines alone, no run keeps them.
    "survival.worlds": "survival.num_envs",
    "forecast.worlds": "forecast.num_envs",
    "failsafe.kappa": "failsafe.reset_threshold",
    "planner.kappa": "planner.reset_threshold",
    "planner.rescue": "planner.recovery_rounds",
    "planner.sinking": "planner.height_drop",
    "planner.near": "planner.tie_tolerance",
    "planner.knot": "planner.knot_spacing",
}
#: Settings without a successor: what they asked for is gone.
REMOVED = ("training.evaluate_async", "aids")
#: Dotted name -> {former value: present one}.
VALUES: dict[str, dict[Any, Any]] = {"regressor.kernel.body_parts": {"limbs": "body_parts"}}


def upgraded(config: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a configuration, or of some groups of one, under the present names."""
    out: dict[str, Any] = copy.deepcopy(dict(config))
    for old, new in RENAMED.items():
        parent, name = _parent(out, old)
        if parent is not None and name in parent:
            value = parent.pop(name)
            _parent(out, new)[0].setdefault(new.rpartition(".")[2], value)  # type: ignore[union-attr]
    for gone in REMOVED:
        parent, name = _parent(out, gone)
        if parent is not None:
            parent.pop(name, None)
    if isinstance(out.get("reward"), dict) and "kind" in out["reward"]:
        out["reward"] = _reward_table(out["reward"])
    for field, values in VALUES.items():
        parent, name = _parent(out, field)
        if parent is not None and parent.get(name) in values:
            parent[name] = values[parent[name]]
    return out


def _reward_table(former: Mapping[str, Any]) -> dict[str, Any]:
    """A reward of a closed set of terms, ``kind`` ``heading_frame`` or ``world_frame``, as a table of terms."""
    world = former["kind"] == "world_frame"
    names = {"pose": "world_pose", "velocity": "joint_velocity", "end_effector": "world_end_effector"} if world else {}
    scales, terms = former["scales"], {}
    for term, weight in former["weights"].items():
        row = {"weight": weight, "scale": scales.get(term, scales.get("root_linear_velocity"))}
        if term == "root_velocity":
            row["angular_scale"] = scales["root_angular_velocity"]
        terms[names.get(term, term)] = row
    return {
        "combine": "mean",
        "rotation_metric": former["rotation_metric"],
        "decay_horizon": former.get("decay_horizon"),
        "terms": terms,
    }


def _parent(config: dict[str, Any], field: str) -> tuple[dict[str, Any] | None, str]:
    """The mapping that holds a dotted field, None where there is none, and the field's last name."""
    *path, name = field.split(".")
    inner: Any = config
    for part in path:
        inner = inner.get(part) if isinstance(inner, dict) else None
    return (inner if isinstance(inner, dict) else None), name
