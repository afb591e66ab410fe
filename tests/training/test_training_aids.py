"""What eases the beginning of training: it does what it says, is gone when it says, and resumes to the bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.env_stand_in import PIECES, environment, group, problem
from helpers.estimation_run import assert_equal, configuration, estimation_dataset
from helpers.humanoid_stand_in import stand_in
from hypothesis import given
from hypothesis import strategies as st

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.envs.aids import AdaptiveStartSettings, Aids, ramp
from egopose.envs.env import EgoPoseEnv
from egopose.envs.mdp import rotations as rot
from egopose.envs.starts import AdaptiveStarts
from egopose.humanoid.physics import BatchedPhysics
from egopose.pipeline.agent import load_agent
from egopose.pipeline.run import build_evaluation, build_run
from egopose.tasks.dataset import Dataset
from egopose.training.loop import iterate, train

STARTS = AdaptiveStartSettings(bin=5, unit=3.0, rate=0.5, floor=0.2)
#: The stand-in weighs 46 kg.
ASSIST = group("aids", "assist")["assist"]
ALL_AIDS = {
    "starts": {"bin": 5, "unit": 3.0, "rate": 0.5, "floor": 0.2},
    "assist": {**ASSIST, "steps": 120},
    "falls": {"head_drop": 0.4, "steps": 120},
    "sigma": {"sigma": 0.2, "steps": 120},
}


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    return estimation_dataset()


def adaptive(settings: AdaptiveStartSettings = STARTS, horizon: int = 15) -> AdaptiveStarts:
    takes = problem().takes
    return AdaptiveStarts(PIECES, takes.offsets, takes.lengths, horizon, 8, settings)


@given(st.integers(0, 10**7), st.integers(1, 10**6), st.floats(0.01, 10), st.floats(0, 10))
def test_a_ramp_ends_exactly_where_it_should(taken: int, steps: int, start: float, end: float) -> None:
    value = float(ramp(start, end, steps, torch.tensor(taken)))
    assert min(start, end) - 1e-9 <= value <= max(start, end) + 1e-9
    if taken >= steps:
        assert value == end
    assert float(ramp(start, end, steps, torch.tensor(0))) == start


def test_untried_starts_are_uniform_over_all_frames_that_leave_room() -> None:
    starts = adaptive()
    drawn = starts(torch.arange(20_000), torch.Generator().manual_seed(0))
    # 33 starts of the 40 frames of one piece, 13 of the 20 of the other, which begins at global frame 45.
    wanted = torch.cat([torch.arange(33), torch.arange(45, 58)])
    frames, counts = drawn.start.unique(return_counts=True)
    assert frames.equal(wanted)
    assert (counts.double() / 20_000 - 1 / len(wanted)).abs().max() < 0.005
    assert (
        drawn.stop == torch.where(drawn.start < 40, (drawn.start + 15).clamp_max(40), drawn.start + 15).clamp_max(65)
    ).all()
    assert drawn.take.equal((drawn.start >= 40).long())


def test_starts_of_quick_falls_are_drawn_more_often_and_none_vanishes() -> None:
    starts = adaptive()
    begun = torch.arange(33)
    for _ in range(20):
        starts.ended(begun, torch.where(begun < 5, 1, 14), begun < 5)
    probability = starts.probability
    torch.testing.assert_close(probability.sum(), torch.tensor(1.0, dtype=torch.float64))
    # By hand: bins of 5 frames, one survives 1 frame, the others of its piece the horizon (15); those of the other
    # piece were never tried. Weights 1 / (n / 3 + 1).
    size = torch.tensor([5.0] * 6 + [3.0] + [5.0] * 2 + [3.0], dtype=torch.float64)
    weight = size * torch.tensor([3 / 4] + [3 / 18] * 6 + [1.0] * 3, dtype=torch.float64)
    torch.testing.assert_close(probability, 0.2 * size / 46 + 0.8 * weight / weight.sum(), atol=1e-4, rtol=0)
    assert (probability >= 0.2 * size / 46).all()


def test_the_environment_tells_its_starts_how_episodes_ended() -> None:
    env = environment(6, aids=Aids(starts=STARTS))
    assert isinstance(env.starts, AdaptiveStarts)
    noted: list[tuple[int, int, bool]] = []
    note = env.starts.ended

    def listen(start: torch.Tensor, frames: torch.Tensor, fell: torch.Tensor) -> None:
        noted.extend(zip(start.tolist(), frames.tolist(), fell.tolist(), strict=True))
        note(start, frames, fell)

    env.starts.ended = listen  # type: ignore[method-assign]
    seen = []
    td = env.reset()
    for _ in range(30):
        td = td.set("action", torch.zeros(env.action_spec.shape))
        stepped, td = env.step_and_maybe_reset(td)
        after = stepped["next"]
        done = after["done"].squeeze(-1)
        rows = after[done]
        seen += zip(*(rows[k].flatten().tolist() for k in ("episode_start", "episode_step", "terminated")), strict=True)
    assert noted == seen
    assert len(seen) > 6
    assert env.starts.survived.any()


def test_a_wrench_is_held_for_one_step_by_the_world_it_is_for() -> None:
    """Outside truth: the free fall of a body's centre of mass under an outside force."""
    humanoid = stand_in()
    model = humanoid.mj_model
    physics = BatchedPhysics(model, 3, humanoid.substeps, 1, body_ids=humanoid.body_ids)
    qpos = np.tile(np.array([0, 0, 5.0, 1, 0, 0, 0] + [0.0] * model.nu), (3, 1))
    physics.set_state(slice(None), qpos, np.zeros((3, model.nv)))
    push = np.zeros((3, 6))
    push[1, :3] = 100.0, -50.0, 30.0
    before = physics.body_state()["com"]
    physics.step(np.zeros((3, model.nu)), push)
    moved = physics.body_state()["com"] - before
    t, n = humanoid.control_dt, humanoid.substeps
    mass = float(model.body_mass.sum())
    # Semi-implicit Euler: n steps of h move a t^2 / 2 (1 + 1 / n).
    expected = push[1, :3] / mass * t * t / 2 * (1 + 1 / n)
    np.testing.assert_allclose(moved[1] - moved[0], expected, rtol=2e-2, atol=1e-5)
    np.testing.assert_array_equal(moved[0], moved[2])
    velocity = physics.qvel[1, :3].copy()
    physics.step(np.zeros((3, model.nu)))
    later = physics.body_state()["com"] - before - moved
    np.testing.assert_allclose((later[1] - later[0])[:2], (push[1, :2] / mass) * t * t, rtol=2e-2)
    assert np.isfinite(velocity).all()


def test_the_wrench_pulls_towards_the_reference_and_is_limited() -> None:
    p = problem()
    env = environment(2, problem=p, aids=Aids.from_config({"assist": ASSIST}))
    env.reset()
    assistance = env._assistance
    assert assistance is not None
    frame = env.frame
    true = p.reference_at(frame)
    nothing = torch.zeros(2, dtype=torch.int64)
    at_rest = assistance.wrench({"qpos": true["qpos"], "qvel": true["qvel"]}, frame, nothing)
    torch.testing.assert_close(at_rest, torch.zeros_like(at_rest), atol=1e-9, rtol=0)
    # Turned about the vertical and moved over the floor: still nothing, as neither is known.
    turn = torch.tensor([[0.6, 0, 0, 0.8]], dtype=torch.float64)
    turned = true["qpos"].clone()
    turned[:, :2] += 3.0
    turned[:, 3:7] = rot.multiply(turn.expand(2, 4), turned[:, 3:7])
    velocity = true["qvel"].clone()
    level = assistance.wrench({"qpos": turned, "qvel": velocity}, frame, nothing)
    torch.testing.assert_close(level, torch.zeros_like(level), atol=1e-9, rtol=0)
    # 5 cm low and leaning 0.1 rad about the world's x: up, and back about x.
    low = true["qpos"].clone()
    low[:, 2] -= 0.05
    tilt = torch.tensor([[np.cos(0.05), np.sin(0.05), 0, 0]], dtype=torch.float64)
    low[:, 3:7] = rot.multiply(tilt.expand(2, 4), low[:, 3:7])
    pull = assistance.wrench({"qpos": low, "qvel": velocity}, frame, nothing)
    torch.testing.assert_close(pull[:, 2], torch.full((2,), 0.05 * ASSIST["stiffness"], dtype=torch.float64))
    torch.testing.assert_close(
        pull[:, 3], torch.full((2,), -0.1 * ASSIST["turning_stiffness"], dtype=torch.float64), rtol=0.1, atol=0
    )
    low[:, 2] -= 10
    assert (assistance.wrench({"qpos": low, "qvel": velocity}, frame, nothing)[:, 2] == ASSIST["force_limit"]).all()
    assert (pull[:, :2] == 0).all()


def test_assistance_anneals_to_exactly_nothing() -> None:
    """From ``steps`` on a step is that of an environment without assistance, to the bit."""
    quick = Aids.from_config({"assist": {**ASSIST, "steps": 40}})
    helped, plain = environment(4, aids=quick), environment(4)
    shares = []
    assert helped._assistance is not None
    action = torch.zeros(helped.action_spec.shape)
    td = helped.reset()
    for _ in range(14):
        shares.append(float(helped._assistance.share(helped._taken(slice(None)))[0]))
        _, td = helped.step_and_maybe_reset(td.set("action", action))
    np.testing.assert_allclose(shares[:10], 1 - np.arange(10) * 4 / 40)
    assert shares[10:] == [0.0] * 4
    wrench = helped._wrench(slice(None))
    assert wrench is not None
    assert (wrench == 0).all()
    plain.load_state_dict(helped.state_dict())
    for env in (helped, plain):
        env.begin_step(action, slice(0, 4))
        env.end_step(slice(0, 4))
    np.testing.assert_array_equal(helped.physics.state, plain.physics.state)
    # While it lasts it is felt.
    early, none = environment(4, aids=Aids.from_config({"assist": ASSIST})), environment(4)
    for env in (early, none):
        env.reset()
        env.begin_step(action, slice(0, 4))
        env.end_step(slice(0, 4))
    assert (early.physics.state != none.physics.state).any()


def test_termination_moves_to_the_tasks_own() -> None:
    p = problem()
    env = environment(2, problem=p, aids=Aids.from_config({"falls": {"head_drop": 0.4, "steps": 8}}))
    assert env._head_drop(slice(None)).tolist() == [0.4, 0.4]
    td = env.reset()
    for _ in range(4):
        td = env.step(td.set("action", torch.zeros(env.action_spec.shape)))["next"].exclude("reward")
    assert env._head_drop(slice(None)).tolist() == [p.termination.head_drop] * 2
    state, take = env.body_state(), torch.zeros(2, dtype=torch.int64)
    state["xpos"][:, p.humanoid.head, 2] = p.takes.lowest_head_height[0] - 0.2
    assert p.fallen(state, take).all()
    assert not p.fallen(state, take, torch.full((2,), 0.4)).any()


def test_workers_share_the_time_that_passes() -> None:
    aids = Aids.from_config({"falls": {"head_drop": 0.4, "steps": 8}})
    env = environment(2, aids=aids, workers=3)
    env.step(env.reset().set("action", torch.zeros(env.action_spec.shape)))
    assert env._taken(slice(0, 1)).tolist() == [6]


def test_no_other_environment_than_the_collectors_is_aided(dataset: Dataset, tmp_path: Path, monkeypatch: Any) -> None:
    made: list[EgoPoseEnv] = []
    before = EgoPoseEnv.__init__

    def remember(self: EgoPoseEnv, *args: Any, **kwargs: Any) -> None:
        before(self, *args, **kwargs)
        made.append(self)

    monkeypatch.setattr(EgoPoseEnv, "__init__", remember)
    config = {**configuration(evaluate_every=1), "aids": ALL_AIDS}
    run = build_run(config, tmp_path, dataset)
    train(run, [], build_evaluation(run, dataset))
    agent = load_agent(tmp_path, dataset)
    for split in ("train", "test"):
        agent.make_env(split, num_envs=2)
        agent.make_env(split, num_envs=2, whole_fragments=True)
    aided = [env for env in made if env._assistance or env._falls or isinstance(env.starts, AdaptiveStarts)]
    assert len(aided) == 1
    assert aided[0] is run.collector.env.base_env
    assert len(made) > 6
    for env in made[1:]:
        if env is not aided[0]:
            assert env._wrench(slice(None)) is None
            assert env._head_drop(slice(None)) is None


@pytest.mark.parametrize("env_groups", [1, 2])
def test_all_aids_resume_to_the_bit(env_groups: int, dataset: Dataset, tmp_path: Path) -> None:
    def make(name: str, seed: int = 5, **training: Any) -> Any:
        config = {**configuration(**training), "aids": ALL_AIDS, "seed": seed}
        config["collector"] = {**config["collector"], "env_groups": env_groups}
        return build_run(config, tmp_path / name, dataset)

    whole = make("whole")
    train(whole, [])
    outcome = train(make("half", iterations=2), [])
    again = make("half", seed=9)
    again.restore(outcome.checkpoint)
    train(again, [])
    for name in ("policy", "critic", "transforms", "simulation"):
        first, second = (run.checkpoint().components[name].state_dict() for run in (whole, again))
        assert_equal(first, second, name)
    assert "survived" in whole.checkpoint().components["simulation"].state_dict()["num_envs"]


def test_sigma_shrinks_between_iterations_and_ppo_knows(dataset: Dataset, tmp_path: Path) -> None:
    config = {**configuration(), "aids": {"sigma": {"sigma": 0.3, "steps": 96}}}
    run = build_run(config, tmp_path, dataset)
    seen: list[float] = []
    learn = run.ppo.update

    def look(rows: Any) -> dict[str, float]:
        scale = rows["scale"].unique()
        assert len(scale) == 1
        seen.append(float(scale))
        # The policy that learns is the one that collected: no divergence before the first gradient step.
        assert abs(run.ppo.divergence(rows)) < 1e-6
        fresh = run.ppo.actor.get_dist(rows).log_prob(rows["action"])
        torch.testing.assert_close(fresh, rows["action_log_prob"], atol=1e-4, rtol=1e-4)
        return learn(rows)

    run.ppo.update = look  # type: ignore[method-assign]
    batches = iter(run.collector)
    for _ in range(4):
        iterate(run, batches)
    np.testing.assert_allclose(seen, [0.3, 0.2, 0.1, 0.1], rtol=1e-6)


@pytest.mark.parametrize(
    ("aids", "field"),
    [
        ({"wings": {}}, "wings"),
        ({"assist": {**ASSIST, "steps": 0}}, "steps"),
        ({"starts": {**ALL_AIDS["starts"], "floor": 0.0}}, "floor"),
        ({"starts": {**ALL_AIDS["starts"], "rate": 1.5}}, "rate"),
        ({"falls": {"head_drop": 0.4}}, "steps"),
    ],
)
def test_bad_aids_are_refused_by_name(aids: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as caught:
        Aids.from_config(aids)
    assert caught.value.field == field


def test_a_learned_sigma_has_no_schedule(dataset: Dataset, tmp_path: Path) -> None:
    config = {**configuration(), "aids": {"sigma": {"sigma": 0.3, "steps": 96}}}
    config["model"] = {**config["model"], "learn_sigma": True}
    with pytest.raises(InputError, match=r"aids\.sigma"):
        build_run(config, tmp_path, dataset)


@pytest.mark.parametrize("name", [p.stem for p in sorted((Path(__file__).parents[2] / "conf" / "aids").glob("*.yaml"))])
def test_every_aid_of_the_configuration_is_read(name: str) -> None:
    assert Aids.from_config(compose_config("train", [f"aids={name}"])["aids"]) != Aids()


def test_aids_are_taken_together() -> None:
    both = Aids.from_config(compose_config("train", ["aids=[assist,adaptive_starts]"])["aids"])
    assert both.assist is not None
    assert both.starts is not None
    assert "aids" not in compose_config("train", [])
