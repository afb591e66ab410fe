"""``conf/planner``: how a body looks ahead (:mod:`egopose.inference.planner`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.envs.mdp.rewards import TERMS, build_reward

#: What a followed path tells of a body in the world, as :class:`egopose.envs.mdp.observations.BodyView` names it.
_ON_THE_PATH = {"place", "yaw"}


@dataclass(frozen=True)
class PlannerSettings:
    """``conf/planner``; each file gives every value and its source.

    Args:
        samples: candidates tried at a time.
        rounds: rounds of so many candidates. Later rounds try candidates between and around the best ones so far.
        recovery_rounds: most further rounds while the head of some body ends more than ``height_drop`` below its target
            in the best candidate. Every second one is drawn anew, the others lie around the best.
        height_drop: m, see ``recovery_rounds``.
        wider: factor of the deviation in recovery rounds.
        horizon: frames that a candidate is simulated for.
        every: frames between plans.
        knot_spacing: frames between the knots of a perturbation, which is linear in between.
        deviation: rad, of the largest perturbations at their knots; others have down to a tenth of it.
        joints: only hinges whose name contains one of these are perturbed.
        acceleration: reward lost per unit (m/s^2, rad/s^2) of the velocities' mean absolute change.
        head: reward lost per metre that the head is below its target.
        lost: m; the value is 0 while the head is further than this below its target, so a fallen body is reset.
        margin: reward by which a candidate must beat the current plan, and either must beat no perturbation.
        tie_tolerance: reward; candidates no further than this below the best are near-ties. Near-ties go to the
            candidate closest to the current plan.
        place_time, heading_time: s; the time constants with which the path that is followed approaches the body, see
            :class:`egopose.inference.followed_path.FollowedPath`. Infinity (``.inf``) for never.
        discount: of a frame.
        reset_threshold: of the fail-safe for a planner's values, if the fail-safe has none of its own.
        reward: as a file of ``conf/reward``: compares the body with the target motion. Its terms are in the heading
            frame, or compare heading or place of the root in the world.
        seed: of the perturbations.
    """

    samples: int
    rounds: int
    recovery_rounds: int
    height_drop: float
    wider: float
    horizon: int
    every: int
    knot_spacing: int
    deviation: float
    joints: tuple[str, ...]
    acceleration: float
    head: float
    lost: float
    margin: float
    tie_tolerance: float
    place_time: float
    heading_time: float
    discount: float
    reset_threshold: float
    reward: Any
    seed: int

    @property
    def control_steps(self) -> float:
        """Simulated for a frame of each body while none falls."""
        return self.rounds * self.samples * self.horizon / self.every

    def __post_init__(self) -> None:
        def check(ok: bool, name: str, cause: str) -> None:
            if not ok:
                raise InputError("planner", name, cause)

        check(self.samples >= 3, "samples", "must be at least 3: no perturbation, the current plan, and a new one")
        check(self.rounds >= 1, "rounds", "must be at least 1")
        check(0 < self.every <= self.horizon, "every", "must lie between 1 and the horizon")
        for name in ("knot_spacing", "deviation", "lost", "height_drop", "wider", "place_time", "heading_time"):
            check(getattr(self, name) > 0, name, "must be positive")
        for name in ("recovery_rounds", "acceleration", "head", "margin", "tie_tolerance"):
            check(getattr(self, name) >= 0, name, "must not be negative")
        check(0 < self.discount <= 1, "discount", "must lie in (0, 1]")
        check(isinstance(self.reward, Mapping) and "terms" in self.reward, "reward", "must be a file of conf/reward")
        try:
            table = build_reward(self.reward)
        except ValueError as error:
            raise InputError("planner", "reward", str(error)) from None
        # The target motion has a path of the root in the world, and no more; a plan is judged by the body alone.
        known = all(set(TERMS[term].reads) <= _ON_THE_PATH for term in table.in_world)
        own = any(weight > 0 for term, weight in table.weights.items() if term not in table.in_world)
        cause = "must be of the body alone, in the heading frame but for heading and path"
        check(known and own and not table.needs, "reward", cause)


def planner_settings(values: Mapping[str, Any] | None) -> PlannerSettings | None:
    """Settings of a resolved ``conf/planner``; None for its file ``none``, or where there is none.

    Raises:
        InputError: a value is missing, unknown or wrong.
    """
    if not values:
        return None
    joints: Sequence[str] = values.get("joints") or ()
    return from_mapping(PlannerSettings, {**values, "joints": tuple(joints)}, "conf/planner")
