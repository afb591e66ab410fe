"""The rewards of a reconstruction against values worked out by hand (Yu, Park & Lee 2021, equations 6-12)."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from egopose.envs.mdp import scene_rewards
from egopose.envs.mdp.clip_hints import ClipHints, hints_of, landings
from egopose.envs.mdp.observations import BodyLayout, BodyView, TouchingPoints
from egopose.envs.mdp.step_view import Contacts, StepView
from egopose.humanoid.link_rates import Rates

#: Bodies of the stand-in: pelvis, right foot, left foot, right hand, left hand, head.
BODIES, HEAD = 6, 5


def f64(*values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


class Rising:
    """A body whose links all move at one velocity."""

    def __init__(self, velocity: tuple[float, float, float]) -> None:
        self.velocity = velocity

    def __call__(self, qpos: Any, qvel: Any) -> Rates:
        import numpy as np

        linear = np.tile(self.velocity, (len(qpos), BODIES, 1))
        return Rates(linear, 0 * linear, linear[:, 0])


def body(
    angles: Tensor | None = None,
    rates: Tensor | None = None,
    points: Tensor | None = None,
    com: tuple[float, float, float] = (0.0, 0.0, 1.0),
    head: tuple[float, float, float] = (0.0, 0.0, 1.6),
    root: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> BodyView:
    """One world. ``points [4, 3]``: of the end effectors, each at its body's origin."""
    angles = f64(0.0, 0.0) if angles is None else angles
    rates = torch.zeros_like(angles) if rates is None else rates
    xpos = torch.zeros(1, BODIES, 3, dtype=torch.float64)
    xpos[0, 0], xpos[0, HEAD] = f64(0.0, 0.0, 1.0), f64(*head)
    xpos[0, 1:5] = f64(*[(0.0, 0.0, 0.0)] * 4) if points is None else points
    state = {
        "qpos": torch.cat([f64(0.0, 0.0, 1.0), f64(*root), angles])[None],
        "qvel": torch.cat([torch.zeros(6, dtype=torch.float64), rates])[None],
        "xpos": xpos,
        "xquat": f64(1.0, 0.0, 0.0, 0.0).expand(1, BODIES, 4),
        "com": f64(*com)[None],
    }
    touching = TouchingPoints(torch.tensor([1, 2, 3, 4]), torch.zeros(4, 3, dtype=torch.float64), HEAD)
    layout = BodyLayout(torch.zeros(0).long(), torch.zeros(0).long(), touching, Rising(velocity))  # type: ignore[arg-type]
    return BodyView(state, layout)


def hints(**told: Any) -> ClipHints:
    """Of one world without boxes, nothing touching, up straight."""
    boxes = told.pop("boxes", 0)
    usual = {
        "up": f64(0.0),
        "touches": torch.zeros(1, 4, 1 + boxes, dtype=torch.bool),
        "landing_after": torch.tensor([0]),
        "landing_effector": torch.tensor([0]),
        "landing_on": torch.tensor([0]),
        "landing_reach": f64(0.0),
        "com_height": f64(1.0),
        "trust": f64(1.0),
        "box_sizes": torch.ones(boxes, 2, dtype=torch.float64),
    }
    return ClipHints(**{**usual, **told})


def view(at: BodyView, told: ClipHints | None = None, **parts: Any) -> StepView:
    reference = {
        "hints": told or hints(),
        "joint_angles": parts.pop("angles", f64(0.0, 0.0)[None]),
        "joint_velocities": parts.pop("rates", f64(0.0, 0.0)[None]),
        "torque_limit": f64(100.0, 50.0),
        "control_dt": 1 / 30,
    }
    return StepView(at, SimpleNamespace(**reference), torch.tensor([1]), **parts)


def touches(*pairs: tuple[int, int], boxes: int = 0) -> Tensor:
    out = torch.zeros(1, 4, 1 + boxes, dtype=torch.bool)
    for effector, what in pairs:
        out[0, effector, what] = True
    return out


def contacts(*pairs: tuple[int, int], boxes: int = 0) -> Contacts:
    """``(body, what)``, the floor being 0."""
    out = torch.zeros(1, BODIES, 1 + boxes, dtype=torch.bool)
    for number, what in pairs:
        out[0, number, what] = True
    return Contacts(out[..., 0], out[..., 1:])


def test_pose_and_velocity_are_of_the_joints_alone() -> None:
    bent = body(angles=f64(0.3, -0.1), rates=f64(1.0, 3.0))
    assert float(scene_rewards.clip_pose(view(bent), scale=12.0, norm="sum")) == pytest.approx(math.exp(-12 * 0.1))
    assert float(scene_rewards.clip_pose(view(bent), scale=12.0, norm="mean")) == pytest.approx(math.exp(-12 * 0.05))
    assert float(scene_rewards.clip_velocity(view(bent), scale=0.6, norm="mean")) == pytest.approx(math.exp(-0.6 * 5))
    unsure = view(bent, hints(trust=f64(0.25)))
    assert float(scene_rewards.clip_pose(unsure, scale=12.0, norm="mean")) == pytest.approx(0.25 * math.exp(-0.6))
    turned = body(angles=f64(0.3, -0.1), root=(0.0, 1.0, 0.0, 0.0), com=(5.0, 0.0, 3.0))
    for name, norm in (("clip_pose", "mean"), ("clip_velocity", "sum")):
        term = getattr(scene_rewards, name)
        still = body(angles=f64(0.3, -0.1))
        assert float(term(view(turned), scale=1.0, norm=norm)) == float(term(view(still), scale=1.0, norm=norm))
    with pytest.raises(ValueError, match="norm must be mean or sum"):
        scene_rewards.clip_pose(view(bent), scale=1.0, norm="max")


def test_up_is_the_angle_of_pelvis_to_head() -> None:
    leaning = body(head=(0.6, 0.0, 1.6))  # 45 degrees
    told = hints(up=f64(math.pi / 4 - 0.2))
    assert float(scene_rewards.up_hint(view(leaning, told), scale=5.0)) == pytest.approx(math.exp(-5 * 0.04))
    # Which way it leans, the hint does not say.
    other = body(head=(0.0, -0.6, 1.6))
    assert float(scene_rewards.up_hint(view(other, told), scale=5.0)) == pytest.approx(math.exp(-5 * 0.04))


def test_contacts_are_compared_end_effector_by_end_effector() -> None:
    told = hints(touches=touches((0, 0), (2, 1), boxes=1), boxes=1)
    # The right foot is right though on a box; the left should not touch; the right hand should; the head is no matter.
    now = contacts((1, 1), (2, 0), (HEAD, 0), boxes=1)
    step = view(body(), told, contacts=now)
    assert scene_rewards.contact_mismatch(step).tolist() == [[False, True, True, False]]
    assert float(scene_rewards.contact_match(step, scale=2.0)) == pytest.approx(math.exp(-4.0))


def test_torques_count_by_their_limits() -> None:
    step = view(body(), torques=f64(50.0, 50.0)[None])
    assert float(scene_rewards.torque_use(step, scale=1.0, norm="sum")) == pytest.approx(math.exp(-1.25))
    assert float(scene_rewards.torque_use(step, scale=1.0, norm="mean")) == pytest.approx(math.exp(-0.625))


@pytest.mark.parametrize(
    ("point", "hand", "expected"),
    [
        ((0.1, 0.2, 0.5), False, 0.0),  # within the centre quarter, on it
        ((0.5, 0.0, 0.5), False, 0.25),  # 0.25 along beyond a zone of +-0.25
        ((0.55, 0.4, 0.5), False, math.hypot(0.3, -0.0)),  # across the zone reaches to +-0.5
        ((0.55, 0.9, 0.5), False, 0.5),  # a corner: 0.3 and 0.4
        ((0.0, 0.0, 0.8), False, 0.3),  # above
        ((0.1, 0.2, 0.5), True, 0.4),  # inside, to the nearer edge, which is along
        ((0.8, 0.0, 0.5), True, 0.3),  # outside
        ((0.5, 0.7, 0.1), True, 0.4),  # below the edge
    ],
)
def test_distance_to_the_zone(point: tuple[float, float, float], hand: bool, expected: float) -> None:
    """A box of 1 x 2 m whose own x is the world's y: its upper face is at (3, 1, 0.5)."""
    half = f64(0.5, 1.0) * (1.0 if hand else 0.5)
    scene = torch.cat([f64(3.0, 1.0, 0.5), f64(math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))])[None, None]
    along, across, height = point
    place = f64(3.0 - across, 1.0 + along, height)
    away = scene_rewards.distance_to_zone(place[None, None], scene, half[None, None], torch.tensor([hand]))
    assert float(away) == pytest.approx(expected, abs=1e-12)


def test_target_zone_counts_wanted_contacts_with_boxes_only() -> None:
    scene = torch.cat([f64(0.0, 0.0, 0.5), f64(1.0, 0.0, 0.0, 0.0)])[None, None]
    points = f64((0.35, 0.0, 0.5), (9.0, 9.0, 9.0), (0.0, 0.0, 0.5), (9.0, 9.0, 9.0))
    told = hints(touches=touches((0, 1), (1, 0), (2, 1), boxes=1), boxes=1)  # the face is 1 x 1 m
    step = view(body(points=points), told, scene=scene)
    assert float(scene_rewards.target_zone(step, scale=15.0, hands="centre")) == pytest.approx(math.exp(-15 * 0.01))
    # The hand, in the middle, is half a metre from the border.
    held = scene_rewards.target_zone(step, scale=15.0, hands="edge")
    assert float(held) == pytest.approx(math.exp(-15 * (0.01 + 0.25)))
    on_the_floor = hints(touches=touches((1, 0), boxes=1), boxes=1)
    step = view(body(points=points), on_the_floor, scene=scene)
    assert float(scene_rewards.target_zone(step, scale=15.0, hands="centre")) == 0.0


def test_alignment_is_of_the_pelvis_and_the_boxs_own_x() -> None:
    turn = 0.4
    scene = torch.cat([f64(0.0, 0.0, 0.5), f64(math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2))])[None, None]
    told = hints(touches=touches((0, 1), boxes=1), boxes=1)
    value = scene_rewards.alignment(view(body(), told, scene=scene), scale=1.0)
    assert float(value) == pytest.approx(math.exp(-((1 - math.cos(turn)) ** 2)))
    off = hints(touches=touches((0, 0), boxes=1), boxes=1)
    assert float(scene_rewards.alignment(view(body(), off, scene=scene), scale=1.0)) == 0.0
    bare = torch.zeros(1, 0, 7, dtype=torch.float64)
    assert float(scene_rewards.alignment(view(body(), scene=bare), scale=1.0)) == 0.0


def test_landing_looks_along_the_ballistic_path() -> None:
    """In 0.2 s from (0, 0, 1.2) at (1, 0, 1) m/s the mass is at (0.2, 0, 1.2 + 0.2 - 0.1962)."""
    scene = torch.cat([f64(0.2, 0.0, 0.3), f64(1.0, 0.0, 0.0, 0.0)])[None, None]
    flight = {
        "landing_after": torch.tensor([6]),
        "landing_on": torch.tensor([1]),
        "landing_reach": f64(0.8),
        "boxes": 1,
    }
    flying = body(com=(0.0, 0.0, 1.2), velocity=(1.0, 0.0, 1.0))
    none = contacts(boxes=1)
    step = view(flying, hints(**flight), contacts=none, scene=scene)
    off = (1.2 + 0.2 - 0.5 * 9.81 * 0.04) - 0.3 - 0.8
    assert float(scene_rewards.landing(step, scale=5.0)) == pytest.approx(math.exp(-5 * off**2))
    # On the floor d_obj is the height, wherever the body comes down.
    step = view(flying, hints(**{**flight, "landing_on": torch.tensor([0])}), contacts=none, scene=scene)
    assert float(scene_rewards.landing(step, scale=5.0)) == pytest.approx(math.exp(-5 * (off + 0.3) ** 2))


def test_landing_is_for_bodies_that_fly_and_should() -> None:
    scene = torch.zeros(1, 0, 7, dtype=torch.float64)
    flight = hints(landing_after=torch.tensor([3]), landing_reach=f64(1.0))
    stands = view(body(), flight, contacts=contacts((2, 0)), scene=scene)
    assert float(scene_rewards.landing(stands, scale=5.0)) == 0.0
    should_stand = view(body(), hints(), contacts=contacts(), scene=scene)
    assert float(scene_rewards.landing(should_stand, scale=5.0)) == 0.0
    assert float(scene_rewards.landing(view(body(), flight, contacts=contacts(), scene=scene), scale=5.0)) > 0.0


def test_landings_of_a_clip() -> None:
    """Contact, two frames of flight, the left hand on box 0, flight to the clip's end: that lands nowhere."""
    clip = torch.zeros(6, 4, 2, dtype=torch.bool)
    clip[0, 0, 0] = clip[3, 3, 1] = True
    after, effector, on = landings(clip)
    assert after.tolist() == [0, 2, 1, 0, 0, 0]
    assert (effector[1:3].tolist(), on[1:3].tolist()) == ([3, 3], [1, 1])
    points = torch.zeros(6, 4, 3, dtype=torch.float64)
    points[3, 3] = f64(0.0, 0.3, 0.6)
    com = f64(0.0, 0.0, 1.0).expand(6, 3)
    lowest, sizes = torch.full((6,), 0.1).double(), torch.ones(1, 2).double()
    told = hints_of(torch.zeros(6).double(), clip, points, com, lowest, torch.ones(6).double(), sizes)
    assert told.landing_reach[1:3].tolist() == pytest.approx([0.5, 0.5])
    assert told.com_height.tolist() == pytest.approx([0.9] * 6)
    assert told.at(torch.tensor([2, 0])).landing_after.tolist() == [1, 0]
