"""What a tracker sees of the target motion: a formula by hand, what it does not depend on, and its place in time."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers.env_stand_in import environment
from helpers.humanoid_stand_in import stand_in
from helpers.tracking import tracking_problem, window_of
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from egopose.collection.stepping import TransformedEgoPoseEnv
from egopose.envs import target_window as module
from egopose.envs.mdp.observations import humanoid_state_rows
from egopose.envs.mdp.path import root_on_floor
from egopose.envs.starts import Piece
from egopose.envs.target_window import target_window, window_size
from egopose.envs.transforms import StateNormalizer
from egopose.humanoid.state_layout import StateLayout
from egopose.motion import rotations as rot

DOFS, AHEAD = 3, 2
LAYOUT = StateLayout(DOFS)


def posed(seed: int, count: int = 5) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    qpos, qvel = rng.normal(0.0, 0.2, (count, 7 + DOFS)), rng.normal(0.0, 0.2, (count, 6 + DOFS))
    heading = rot.from_rotvec(np.column_stack([np.zeros((count, 2)), rng.uniform(-3.0, 3.0, count)]))
    qpos[:, 3:7] = rot.multiply(heading, rot.from_rotvec(rng.normal(0.0, 0.1, (count, 3)) * [1.0, 1.0, 0.0]))
    return qpos, qvel


def seen(body: tuple[np.ndarray, np.ndarray], targets: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The window of a body and the frames ahead, all in one world."""
    states = np.stack([humanoid_state_rows(*target) for target in targets], axis=1)
    path = np.stack([root_on_floor(torch.from_numpy(qpos)).numpy() for qpos, _ in targets], axis=1)
    return target_window(humanoid_state_rows(*body), root_on_floor(torch.from_numpy(body[0])).numpy(), states, path)


def test_a_body_on_a_target_that_stands_sees_zeros() -> None:
    qpos, qvel = posed(0)
    window = seen((qpos, qvel), [(qpos, qvel)] * AHEAD)
    assert window.shape == (5, window_size(DOFS, AHEAD))
    assert window.dtype == np.float32
    np.testing.assert_allclose(window, 0.0, atol=1e-6)


def test_the_numbers_are_those_by_hand() -> None:
    """A body at (1, 2) faces along y; the target's root is 0.3 m ahead of it, 0.15 m to its left, turned by -0.1."""
    state, target = np.zeros((1, LAYOUT.size)), np.zeros((1, 1, LAYOUT.size))
    state[0, 0], target[0, 0, 0] = 0.9, 0.95
    state[0, 1] = target[0, 0, 1] = 1.0
    target[0, 0, 2:4] = 0.02, -0.04
    state[0, LAYOUT.joint_angles], target[0, 0, LAYOUT.joint_angles] = 0.1, [0.1, 0.4, -0.2]
    target[0, 0, LAYOUT.root_linear_velocity] = 1.0, 0.0, -0.25
    target[0, 0, LAYOUT.root_angular_velocity] = 0.5, 0.0, 2.0
    state[0, LAYOUT.joint_velocities] = 1.0, 0.0, -1.0
    root = np.array([[1.0, 2.0, math.pi / 2]])
    path = np.array([[[1.0 - 0.15, 2.0 + 0.3, math.pi / 2 - 0.1 + 4 * math.pi]]])
    window = target_window(state, root, target, path)
    expected = [
        *[0.05 / 0.1, 0.3 / 0.3, 0.15 / 0.3, -0.1 / 0.5, 0.02 / 0.1, -0.04 / 0.1],
        *[0.0, 0.3 / 0.3, -0.3 / 0.3],
        *[1.0 / 0.5, 0.0, -0.25 / 0.5, 0.5, 0.0, 2.0],
        *[-0.5, 0.0, 0.5],
    ]
    np.testing.assert_allclose(window[0], expected, atol=1e-5)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.floats(-math.pi, math.pi), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_the_world_may_be_moved_and_turned(seed: int, angle: float, x: float, y: float) -> None:
    """Body and target together: neither place nor direction of the world are in the window."""

    def carried(state: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        turn = rot.from_rotvec(np.array([0.0, 0.0, angle]))
        qpos, qvel = state[0].copy(), state[1].copy()
        qpos[:, :3] = rot.rotate(turn, qpos[:, :3]) + np.array([x, y, 0.0])
        qpos[:, 3:7] = rot.multiply(turn, qpos[:, 3:7])
        qvel[:, :3] = rot.rotate(turn, qvel[:, :3])
        return qpos, qvel

    body, targets = posed(seed), [posed(seed + 1), posed(seed + 2)]
    before, after = seen(body, targets), seen(carried(body), [carried(target) for target in targets])
    # A heading's difference of half a turn is the same on either side.
    half = np.isclose(np.abs(before), math.pi / module.HEADING, atol=1e-3)
    np.testing.assert_allclose(np.where(half, 0.0, after), np.where(half, 0.0, before), atol=2e-5)


def test_what_is_far_away_is_clipped() -> None:
    qpos, qvel = posed(3)
    away = qpos + 0.0
    away[:, :3] += 40.0
    away[:, 7:] -= 40.0
    window = seen((qpos, qvel), [(away, qvel + 100.0)])
    assert np.abs(window).max() == module.CLIP
    assert (window[:, 0] == module.CLIP).all()
    assert (window[:, 6 : 6 + DOFS] == -module.CLIP).all()


def tracked(n: int = 4, last: bool = False) -> TransformedEnv:
    problem = tracking_problem(0.1)
    pieces = (Piece(0, 30, 40), Piece(1, 15, 25)) if last else (Piece(0, 0, 40), Piece(1, 5, 25))
    env = environment(n, problem=problem, fragments=pieces, whole_fragments=last)
    return TransformedEnv(
        env, Compose(window_of(problem, (1, 2, 4)), StateNormalizer(env.observation_spec["humanoid_state"].shape[-1]))
    )


def expected_window(env: TransformedEnv, observation: object) -> torch.Tensor:
    problem, frame = env.base_env.problem, env.base_env.frame
    state = problem.observation(env.base_env.body_state()).numpy()
    last = problem.takes.last()
    rows = [torch.minimum(frame + step, last[frame]) for step in (1, 2, 4)]
    targets, path = (np.stack([table[row].numpy() for row in rows], 1) for table in (problem.states, problem.path))
    root = observation["root_on_path"].double().numpy()  # type: ignore[index]
    return torch.from_numpy(target_window(state, root, targets, path))


@pytest.mark.parametrize("last", [False, True])
def test_the_transform_gives_the_functions_window_at_resets_and_steps(last: bool) -> None:
    """Before the normaliser changes the state; behind a take's end its last frame stands still."""
    env = tracked(2, last)
    observation = env.reset()
    for step in range(8):
        torch.testing.assert_close(
            observation["target_window"], expected_window(env, observation), atol=1e-4, rtol=1e-4
        )
        action = 0.1 * torch.randn(env.action_spec.shape, generator=torch.Generator().manual_seed(step))
        observation = env.step(observation.set("action", action))["next"].exclude("reward")
        if observation["done"].any():
            break
    assert step > 3


def test_at_a_takes_end_all_frames_ahead_are_its_last() -> None:
    problem = tracking_problem(0.1)
    window, humanoid = window_of(problem, (1, 2, 4)), stand_in()
    frame = torch.tensor([[39], [64], [36]])
    entries = TensorDict(
        {
            "frame": frame,
            "episode_start": frame,
            "episode_step": torch.zeros_like(frame),
            "humanoid_state": problem.states[frame[:, 0]],
            "root_on_path": problem.path[frame[:, 0]].float(),
        },
        batch_size=[3],
    )
    rows = window(entries)["target_window"][:, : 3 * (6 + humanoid.mj_model.nu)].unflatten(-1, (3, -1))
    assert rows[:2].abs().max() < 1e-5, "the body is on the last frame"
    assert (rows[2, 0] != rows[2, 1]).any()
    assert (rows[2, 1] != rows[2, 2]).any()


def test_specs_hold() -> None:
    env = tracked(3)
    size = window_size(stand_in().mj_model.nu, 3)
    assert env.observation_spec["target_window"].shape == (3, size)
    assert env.observation_spec["root_on_path"].shape == (3, 3)
    check_env_specs(env)


def test_the_quick_way_to_step_gives_the_same() -> None:
    """A collector's own stepping, with resets, against TorchRL's."""
    runs = []
    for fast in (True, False):
        problem = tracking_problem(0.1)
        base = environment(4, problem=problem, seed=5)
        size = base.observation_spec["humanoid_state"].shape[-1]
        env = TransformedEgoPoseEnv(base, window_of(problem, (1, 2)), StateNormalizer(size))
        env.fast = fast
        generator, rows, seen_now = torch.Generator().manual_seed(2), [], env.reset()
        for _ in range(30):
            seen_now["action"] = 0.3 * torch.randn(env.action_spec.shape, generator=generator)
            transition, seen_now = env.step_and_maybe_reset(seen_now)
            rows.append(torch.cat([transition["next", "target_window"], seen_now["target_window"]], -1))
        runs.append(torch.stack(rows))
    assert torch.equal(*runs)
