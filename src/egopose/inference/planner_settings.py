"""``conf/planner``: how a body looks ahead (:mod:`egopose.inference.planner`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.envs.mdp.rewards import build_reward


@dataclass(frozen=True)
class PlannerSettings:
    """``conf/planner``; each file gives every value and its source.

    Args:
        samples: ways tried at a time.
        rounds: of so many ways each, the later ones between and about the best of those before.
        recovery_rounds: further rounds at most, as long as some body's best way ends with its head lower by ``sinking``
            (m) than what is followed has it; by turns drawn anew and about the best, the deviation ``wider`` times as
            large.
        horizon: frames they are simulated for.
        every: frames between plans.
        knot_spacing: frames between the knots of an addition, which is linear in between.
        deviation: rad, of the largest additions at their knots; others are down to a tenth of it.
        joints: only hinges whose name contains one of these are added to.
        acceleration: reward lost per unit (m/s^2, rad/s^2) of the velocities' mean absolute change.
        head: reward lost per metre by which the head is lower than what is followed has it.
        lost: m; a body whose head is lower than that by more is worth nothing to the fail-safe, whatever its plan.
        margin: reward by which a way must do better than the plan so far to be taken, and either than no addition.
        tie_tolerance: reward; of ways that are worse than the best by no more, the one that changes least of the plan
            so far is taken.
        discount: of a frame.
        reset_threshold: of the fail-safe, where it has none of its own, for the values of plans.
        reward: as a file of ``conf/reward`` in the heading frame: how near the body is to what it follows.
        seed: of the additions.
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
    discount: float
    reset_threshold: float
    reward: Any
    seed: int

    def __post_init__(self) -> None:
        def check(ok: bool, name: str, cause: str) -> None:
            if not ok:
                raise InputError("planner", name, cause)

        check(self.samples >= 3, "samples", "must be at least 3: without an addition, the plan so far, and a new one")
        check(self.rounds >= 1, "rounds", "must be at least 1")
        check(0 < self.every <= self.horizon, "every", "must lie between 1 and the horizon")
        for name in ("knot_spacing", "deviation", "lost", "height_drop", "wider"):
            check(getattr(self, name) > 0, name, "must be positive")
        for name in ("recovery_rounds", "acceleration", "head", "margin", "tie_tolerance"):
            check(getattr(self, name) >= 0, name, "must not be negative")
        check(0 < self.discount <= 1, "discount", "must lie in (0, 1]")
        check(isinstance(self.reward, Mapping) and "terms" in self.reward, "reward", "must be a file of conf/reward")
        try:
            table = build_reward(self.reward)
        except ValueError as error:
            raise InputError("planner", "reward", str(error)) from None
        # What is followed knows no place in the world, and a plan is judged by nothing but the body.
        check(not table.in_world and not table.needs, "reward", "must be of the body alone, in the heading frame")


def planned_threshold(settings: PlannerSettings | None) -> float | None:
    """The fail-safe's reset_threshold for a planner's values; None without a planner."""
    return None if settings is None else settings.reset_threshold


def planner_settings(values: Mapping[str, Any] | None) -> PlannerSettings | None:
    """Settings of a resolved ``conf/planner``; None for its file ``none``, or where there is none.

    Raises:
        InputError: a value is missing, unknown or wrong.
    """
    if not values:
        return None
    joints: Sequence[str] = values.get("joints") or ()
    return from_mapping(PlannerSettings, {**values, "joints": tuple(joints)}, "conf/planner")
