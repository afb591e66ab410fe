"""The batched environment: specs, time, resets, seeds, endings, exact resumption."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.env_stand_in import PIECES, Piece, build_problem, environment, group, problem
from helpers.humanoid_stand_in import reference_motion, stand_in
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs.utils import check_env_specs

from egopose.envs.starts import UniformStarts, WholeFragments

NO_FALL = {"enabled": False, "head_drop": 0.1}


def acted(env, seed: int = 0, scale: float = 0.2):
    generator = torch.Generator().manual_seed(seed)

    def policy(td: TensorDict) -> TensorDict:
        return td.set("action", scale * torch.randn(*env.action_spec.shape, generator=generator))

    return policy


def test_specs_hold() -> None:
    check_env_specs(environment(3))


def test_two_runs_are_equal_to_the_bit() -> None:
    runs = []
    for threads in (1, 2):
        env = environment(5, threads=threads)
        env.set_seed(7)
        runs.append(env.rollout(25, acted(env), break_when_any_done=False))
    assert (runs[0] == runs[1]).all()
    other = environment(5, seed=8)
    assert (other.reset()["frame"] != runs[0]["frame"][:, 0]).any()


def test_time_and_reward_belong_to_the_frame_reached() -> None:
    """At reset the state is the reference's; after a step the reward compares with the next frame."""
    p = problem(termination=NO_FALL)
    env = environment(4, problem=p)
    td = env.reset()
    frame = td["frame"].squeeze(-1)
    z = p.observation(p.reference_at(frame)).float()
    torch.testing.assert_close(td["humanoid_state"], z)
    assert (td["episode_step"] == 0).all()
    td = env.step(td.set("action", torch.zeros(env.action_spec.shape)))["next"]
    assert (td["frame"].squeeze(-1) == frame + 1).all()
    state = env.body_state()
    reward, terms = p.rewards(p.step_view(state, frame + 1, torch.ones(4)))
    torch.testing.assert_close(td["reward"].squeeze(-1), reward.float())
    for name, value in terms.items():
        torch.testing.assert_close(td["reward_terms", name].squeeze(-1), value.float())


def test_a_partial_reset_leaves_the_others_alone() -> None:
    env = environment(4)
    td = env.reset()
    for _ in range(3):
        td = env.step(td.set("action", torch.zeros(env.action_spec.shape)))["next"].exclude("reward")
    before, state = td.clone(), env.physics.state.copy()
    mask = torch.tensor([False, True, False, True])[:, None]
    after = env.reset(td.clone().set("_reset", mask))
    kept = ~mask.squeeze(-1)
    for key in ("humanoid_state", "frame", "episode_step", "episode_start"):
        torch.testing.assert_close(after[key][kept], before[key][kept])
    np.testing.assert_array_equal(env.physics.state[kept.numpy()], state[kept.numpy()])
    assert (after["episode_step"][~kept] == 0).all()
    assert not after["done"].any()


def test_episodes_end_at_the_horizon_and_at_the_fragments_end() -> None:
    env = environment(6, problem=problem(termination=NO_FALL), horizon=15, minimum=4)
    td = env.rollout(60, acted(env, scale=0.0), break_when_any_done=False)
    ended = td["next", "done"].squeeze(-1)
    assert ended.any()
    assert (td["next", "truncated"].squeeze(-1) == ended).all()
    assert not td["next", "terminated"].any()
    length = td["next", "episode_step"].squeeze(-1)[ended] + 1
    assert length.max() == 15
    assert length.min() >= 4
    # Every episode lies in a fragment.
    offsets, frame = [0, 40], td["next", "frame"]
    inside = torch.zeros_like(frame, dtype=torch.bool)
    for piece in PIECES:
        inside |= (frame >= offsets[piece.take] + piece.start) & (frame < offsets[piece.take] + piece.stop)
    assert inside.all()


def test_a_fall_terminates_unless_switched_off() -> None:
    low = TensorDict({}, batch_size=[2])
    for enabled in (True, False):
        env = environment(2, problem=problem(termination={"enabled": enabled, "head_drop": 0.1}))
        qpos = torch.from_numpy(env.physics.qpos.copy())
        qpos[:, 3], qpos[1, 2] = 1.0, 0.5
        low["initial_qpos"], low["initial_qvel"] = qpos, torch.zeros(2, env.physics.model.nv)
        td = env.reset(low)
        torch.testing.assert_close(env.body_state()["qpos"], qpos)
        td = env.step(td.set("action", torch.zeros(env.action_spec.shape)))["next"]
        assert td["fallen"].squeeze(-1).tolist() == [False, True]
        assert td["terminated"].squeeze(-1).tolist() == [False, enabled]
        assert not (td["terminated"] & td["truncated"]).any()


def test_unsound_first_states_are_refused() -> None:
    env = environment(2)
    td = TensorDict({"initial_qpos": torch.full((2, env.physics.model.nq), torch.nan)}, batch_size=[2])
    td["initial_qvel"] = torch.zeros(2, env.physics.model.nv)
    with pytest.raises(ValueError, match="not finite"):
        env.reset(td)


def test_place_moves_a_world_within_its_episode() -> None:
    env = environment(3)
    env.rollout(3, acted(env))
    frame, state = env.frame, env.body_state()
    env.place(torch.tensor([1]), state["qpos"][:1], state["qvel"][:1])
    td = env.observe()
    assert (env.frame == frame).all()
    torch.testing.assert_close(td["humanoid_state"][1], td["humanoid_state"][0])


def test_diverged_physics_ends_the_world_and_training_goes_on(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    env = environment(4, dump_dir=tmp_path / "diverged", threads=2)
    td = env.reset()
    env.physics.qvel[2, 4] = np.nan
    _, after = env.step_and_maybe_reset(td.set("action", torch.zeros(env.action_spec.shape)))
    stepped = td["next"]
    assert stepped["diverged"].squeeze(-1).tolist() == [False, False, True, False]
    assert stepped["terminated"][2].item()
    assert stepped["reward"][2].item() == 0
    assert torch.isfinite(stepped["humanoid_state"]).all()
    assert env.physics.n_diverged == 1
    assert list((tmp_path / "diverged").glob("*.npz"))
    assert after["episode_step"][2].item() == 0
    assert not after["done"].any()
    more = env.rollout(10, acted(env), break_when_any_done=False)
    assert torch.isfinite(more["next", "humanoid_state"]).all()
    assert not more["next", "diverged"].any()


def test_nan_actions_count_as_divergence(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    env = environment(2)
    td = env.reset().set("action", torch.zeros(env.action_spec.shape))
    td["action"][0, 0] = torch.nan
    assert env.step(td)["next", "diverged"].squeeze(-1).tolist() == [True, False]


def test_resuming_is_exact() -> None:
    def run(env, td, policy, steps):
        out = []
        for _ in range(steps):
            stepped, td = env.step_and_maybe_reset(policy(td))
            out.append(stepped.clone())
        return torch.stack(out, 1), td

    env = environment(4)
    policy = acted(env)
    _, td = run(env, env.reset(), policy, 12)
    saved = {k: v.clone() for k, v in env.state_dict().items()}
    go_on = acted(env, seed=3)
    expected, _ = run(env, td.clone(), go_on, 20)

    other = environment(4, seed=99)
    other.load_state_dict(saved)
    assert (other.observe()["humanoid_state"] == td["humanoid_state"]).all()
    resumed, _ = run(other, td.clone(), acted(other, seed=3), 20)
    assert (expected == resumed).all()
    with pytest.raises(ValueError, match="state is"):
        environment(5).load_state_dict(saved)


def test_it_feeds_a_collector() -> None:
    env = environment(4)
    collector = Collector(env, acted(env), frames_per_batch=40, total_frames=120, track_traj_ids=False)
    step = torch.cat([batch["episode_step"] for batch in collector], dim=1).squeeze(-1)
    done_before = torch.roll(step, -1, 1)[:, :-1] == 0
    assert done_before.any()
    assert ((step.diff(dim=1) == 1) | done_before).all()
    collector.shutdown()


def test_evaluation_gives_each_world_its_fragment_and_stays_on_its_last_frame() -> None:
    env = environment(2, problem=problem(termination=NO_FALL), whole_fragments=True)
    td = env.reset()
    assert td["frame"].squeeze(-1).tolist() == [0, 45]
    for _ in range(45):
        td = env.step(td.set("action", torch.zeros(env.action_spec.shape)))["next"]
    assert td["frame"].squeeze(-1).tolist() == [39, 64]
    assert td["truncated"].all()


def test_the_residual_action_starts_from_the_table() -> None:
    humanoid = stand_in()
    reference, _ = reference_motion(humanoid)
    table = reference["qpos"][:, 7:].float()
    action = {"reference": "regressor", "scale": 0.5, "velocity_feedforward": 1.0}
    p = problem(humanoid, action_reference=table, action=action)
    frame = torch.tensor([5, 40])
    noise = torch.full((2, table.shape[1]), 0.1)
    lag = torch.from_numpy(humanoid.kd / humanoid.kp)
    # The first frame of a take is reached with the velocity that leaves it: never across the seam between takes.
    velocity = torch.stack([table[5] - table[4], table[41] - table[40]]).double() * 30
    torch.testing.assert_close(p.target(noise, frame), table[frame].double() + lag * velocity + 0.5 * noise.double())
    limits = torch.from_numpy(humanoid.joint_range)
    far = p.target(torch.full((2, table.shape[1]), 99.0), frame)
    torch.testing.assert_close(far, limits[:, 1].expand_as(far))
    with pytest.raises(ValueError, match="joint targets"):
        problem(humanoid, action=action)


def test_a_reference_of_another_body_is_refused() -> None:
    humanoid = stand_in()
    reference, takes = reference_motion(humanoid)
    reference["qpos"] = reference["qpos"][:, :-1]
    with pytest.raises(ValueError, match="columns"):
        build_problem(humanoid, reference, takes, group("task", "estimation"), group("reward", "estimation"))


@pytest.mark.parametrize("reward", ["forecasting", "pose_and_end_effectors", "pose_only", "deepmimic"])
def test_every_reward_file_runs(reward: str) -> None:
    env = environment(2, problem=problem(reward=reward))
    td = env.rollout(5, acted(env))
    assert ((td["next", "reward"] > 0) & (td["next", "reward"] <= 1)).all()
    assert set(td["next", "reward_terms"].keys()) == set(env.problem.reward.names)


def test_uniform_starts_are_uniform() -> None:
    offsets, lengths = torch.tensor([0, 40]), torch.tensor([40, 25])
    starts = UniformStarts([Piece(0, 10, 30), Piece(1, 0, 5)], offsets, lengths, horizon=12, minimum=8)
    episodes = starts(torch.arange(14000), torch.Generator().manual_seed(0))
    # Thirteen frames of the first fragment leave room for eight; the second is short and starts at its first.
    values, counts = episodes.start.unique(return_counts=True)
    assert values.tolist() == [*range(10, 23), 40]
    assert (counts - 1000).abs().max() < 150
    assert (episodes.stop - episodes.start).max() == 12
    assert (episodes.stop[episodes.take == 1] == 45).all()


def test_bad_fragments_are_refused() -> None:
    offsets, lengths = torch.tensor([0]), torch.tensor([40])
    for pieces in ([], [Piece(0, 0, 41)], [Piece(1, 0, 10)], [Piece(0, 4, 5)], [Piece(0, -1, 5)]):
        with pytest.raises(ValueError, match="fragment"):
            WholeFragments(pieces, offsets, lengths)
    with pytest.raises(ValueError, match="minimum"):
        UniformStarts([Piece(0, 0, 40)], offsets, lengths, horizon=10, minimum=20)
