"""The planners there are, by ``conf/planner``: random shooting, Gauss-Newton, and iterative LQR."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv

from egopose.envs.problem import Followed
from egopose.inference.gauss_newton_planner import GaussNewtonPlanner, GaussNewtonSettings
from egopose.inference.planner import Planner
from egopose.inference.planner_settings import PlannerSettings, planner_settings
from egopose.inference.trajectory_planner import TrajectoryPlanner, TrajectoryPlannerSettings

AnyPlanner: TypeAlias = Planner | TrajectoryPlanner
AnyPlannerSettings: TypeAlias = PlannerSettings | TrajectoryPlannerSettings


def read_planner(values: Mapping[str, Any] | None) -> AnyPlannerSettings | None:
    """Settings of a resolved ``conf/planner``; None for its file ``none``, or where there is none.

    Raises:
        InputError: a value is missing, unknown or wrong.
    """
    own = {key: value for key, value in (values or {}).items() if key != "kind"}
    match (values or {}).get("kind"):
        case "trajectory":
            return TrajectoryPlannerSettings.from_config(own)
        case "gauss_newton":
            return GaussNewtonSettings.from_config(own)
    return planner_settings(values)


def build_planner(
    env: TransformedEnv,
    actor: TensorDictModuleBase,
    critic: TensorDictModuleBase,
    settings: AnyPlannerSettings,
    followed: Followed | None = None,
) -> AnyPlanner:
    """The planner of these settings; ``env`` holds ``settings.samples`` copies of each body.

    Raises:
        InputError: see :class:`Planner` and :class:`TrajectoryPlanner`.
    """
    if isinstance(settings, TrajectoryPlannerSettings):
        return TrajectoryPlanner(env, actor, critic, settings, followed)
    if isinstance(settings, GaussNewtonSettings):
        return GaussNewtonPlanner(env, actor, critic, settings, followed)
    return Planner(env, actor, critic, settings, followed)


def planned_threshold(settings: AnyPlannerSettings | None) -> float | None:
    """The fail-safe's reset_threshold for a planner's values; None without a planner, or where it has none."""
    return None if settings is None else settings.reset_threshold
