"""Balance feedback: which numbers of the tracking error move which hinges, and by how much."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import yaml
from helpers.mocap import default_humanoid
from tensordict import TensorDict

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.envs.mdp.observations import humanoid_state
from egopose.models.feedback import BalanceFeedback, FeedbackSettings

HINGES = [f"{joint.name}_{k}" for joint in default_humanoid().skeleton.joints for k in range(len(joint.dofs))]
STATE = 115
#: Of z = [height 1, quaternion wxyz 4, 52 angles, linear velocity 3, angular velocity 3, 52 rates].
QUATERNION, LINEAR, ANGULAR = 1, 1 + 4 + 52, 1 + 4 + 52 + 3
#: Lean, rate, speed. Pitch turns about y and falls along x; roll turns about x and falls along y.
COLUMNS = {"pitch": (QUATERNION + 2, ANGULAR + 1, LINEAR + 0), "roll": (QUATERNION + 1, ANGULAR + 0, LINEAR + 1)}
LEAN, SPEED = 0, 2
SETTINGS = FeedbackSettings(
    pitch=(("RightFoot_0", "LeftFoot_0"), ("Spine_0",)), roll=(("RightFoot_1", "LeftFoot_1"),), speed=6.0
)


def columns(*names: str) -> list[int]:
    return [HINGES.index(name) for name in names]


def with_gain(group: int, kind: int, value: float = 1.0) -> BalanceFeedback:
    feedback = BalanceFeedback(SETTINGS, HINGES)
    with torch.no_grad():
        feedback.gains[group, kind] = value
    return feedback


def test_at_the_start_it_adds_nothing() -> None:
    out = BalanceFeedback(SETTINGS, HINGES)(torch.randn(7, 3, 2 * STATE))
    assert out.shape == (7, 3, 52)
    assert (out == 0).all()


@pytest.mark.parametrize("kind", [0, 1, 2])
@pytest.mark.parametrize(
    ("group", "plane", "moved"),
    [
        (0, "pitch", ("RightFoot_0", "LeftFoot_0")),
        (1, "pitch", ("Spine_0",)),
        (2, "roll", ("RightFoot_1", "LeftFoot_1")),
    ],
)
def test_a_gain_moves_its_hinges_by_its_number_and_nothing_else(
    group: int, plane: str, moved: tuple[str, ...], kind: int
) -> None:
    feedback = with_gain(group, kind, 0.5)
    error = torch.randn(4, 2 * STATE)
    expected = torch.zeros(4, 52)
    expected[:, columns(*moved)] = 6.0 * 0.5 * error[:, COLUMNS[plane][kind], None]
    torch.testing.assert_close(feedback(error), expected)


def test_it_reads_its_columns_only() -> None:
    feedback = BalanceFeedback(SETTINGS, HINGES)
    torch.nn.init.ones_(feedback.gains)
    error = torch.zeros(2 * STATE, requires_grad=True)
    feedback(error).sum().backward()
    assert error.grad is not None
    assert set(error.grad.nonzero().flatten().tolist()) == set(COLUMNS["pitch"] + COLUMNS["roll"])


def test_groups_that_share_a_hinge_add_up() -> None:
    settings = FeedbackSettings(pitch=(("Spine_0",), ("Spine_0", "Spine1_0")), roll=(), speed=1.0)
    feedback = BalanceFeedback(settings, HINGES)
    torch.nn.init.ones_(feedback.gains)
    error = torch.zeros(2 * STATE)
    error[COLUMNS["pitch"][LEAN]] = 1.0
    assert feedback(error)[columns("Spine_0", "Spine1_0")].tolist() == [2.0, 1.0]


@pytest.mark.parametrize("plane", ["pitch", "roll"])
def test_an_unknown_hinge_is_named(plane: str) -> None:
    groups = {"pitch": (("Spine_0",),), "roll": (("Spine_1",),), plane: (("Spine_0", "Tail_0"),)}
    with pytest.raises(InputError, match="Tail_0") as caught:
        BalanceFeedback(FeedbackSettings(**groups, speed=1.0), HINGES)
    assert caught.value.field == f"feedback.{plane}"


def state(quat: tuple[float, ...], velocity: tuple[float, ...] = (0.0,) * 6) -> torch.Tensor:
    """z ``[115]`` of the default humanoid, turned and moved so."""
    model = default_humanoid().mj_model
    qpos = torch.zeros(1, model.nq, dtype=torch.float64)
    qpos[0, 2], qpos[0, 3:7] = 1.0, torch.tensor(quat, dtype=torch.float64)
    qvel = torch.zeros(1, model.nv, dtype=torch.float64)
    qvel[0, :6] = torch.tensor(velocity, dtype=torch.float64)
    return humanoid_state(TensorDict({"qpos": qpos, "qvel": qvel}, batch_size=[1]))[0]


UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def test_the_columns_are_the_humanoids_lean_rate_and_speed() -> None:
    """Toes point along +x, so a turn about +y is forward and one about +x is to the right."""
    humanoid = default_humanoid()
    soles = torch.from_numpy(humanoid.sole_points)
    assert (soles[:, 1, 0] > soles[:, 0, 0]).all()  # the ball before the heel
    assert state(UPRIGHT).shape == (STATE,)
    forward, right = (0.995, 0.0, 0.0998, 0.0), (0.995, 0.0998, 0.0, 0.0)
    for plane, quat in (("pitch", forward), ("roll", right)):
        change = state(quat) - state(UPRIGHT)
        assert change[COLUMNS[plane][LEAN]] == pytest.approx(0.0998, abs=1e-4)
        others = [c for p in COLUMNS for c in COLUMNS[p] if c != COLUMNS[plane][LEAN]]
        assert change[others].abs().max() < 1e-9
    moving = state(UPRIGHT, (0.1, 0.2, 0.0, 0.3, 0.4, 0.0))
    read = {plane: [round(float(moving[c]), 9) for c in COLUMNS[plane]] for plane in COLUMNS}
    assert read == {"pitch": [0.0, 0.4, 0.1], "roll": [0.0, 0.3, 0.2]}


def test_lean_is_seen_whatever_the_heading() -> None:
    """About the body's own y after a quarter turn to the left."""
    half = 0.5**0.5
    turned = (half * 0.995, -half * 0.0998, half * 0.0998, half * 0.995)
    torch.testing.assert_close(state(turned), state((0.995, 0.0, 0.0998, 0.0)), atol=1e-3, rtol=0.0)


def test_a_forward_lean_moves_the_configured_hinges() -> None:
    values = yaml.safe_load((Path(__file__).parents[2] / "conf" / "model" / "fast.yaml").read_text())["feedback"]
    settings = from_mapping(FeedbackSettings, values, "model.feedback")
    feedback = BalanceFeedback(settings, HINGES)
    torch.nn.init.ones_(feedback.gains)
    error = (state((0.995, 0.0, 0.0998, 0.0)) - state(UPRIGHT)).float()
    added = feedback(torch.cat([error, torch.zeros(STATE)]))
    pitch = columns(*(name for group in settings.pitch for name in group))
    assert (added[pitch] > 0).all()
    assert set(added.abs().gt(1e-6).nonzero().flatten().tolist()) == set(pitch)


def test_the_configured_groups_turn_left_and_right_alike() -> None:
    """Pitch groups hold hinges about y and roll groups hinges about x, whose axes are equal on both sides."""
    values = yaml.safe_load((Path(__file__).parents[2] / "conf" / "model" / "fast.yaml").read_text())["feedback"]
    axes = [dof.axis for joint in default_humanoid().skeleton.joints for dof in joint.dofs]
    for plane, axis in (("pitch", (0.0, 1.0, 0.0)), ("roll", (1.0, 0.0, 0.0))):
        for group in values[plane]:
            for name in group:
                assert axes[HINGES.index(name)] == pytest.approx(axis), name
