"""Looking ahead with a tracker: the copies of a body see its path where the body does."""

from __future__ import annotations

import torch
from helpers.env_stand_in import PIECES, environment
from helpers.planner_run import SMALL, settings
from helpers.tracking import tracking_problem, window_of
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import TransformedEnv

from egopose.collection.stepping import TransformedEgoPoseEnv
from egopose.envs.transforms import StateNormalizer
from egopose.inference.planner import Planner


def tracked(num_envs: int) -> TransformedEnv:
    problem = tracking_problem(0.1, enabled=False)
    base = environment(num_envs, problem=problem, fragments=PIECES, whole_fragments=True)
    normalizer = StateNormalizer(base.observation_spec["humanoid_state"].shape[-1], frozen=True)
    return TransformedEgoPoseEnv(base, window_of(problem, (1, 2)), normalizer)


def walked(env: TransformedEnv, steps: int = 4) -> dict[str, Tensor]:
    """Bodies that were placed elsewhere than the reference stands, and have gone on from there."""
    env.reset()
    base = env.base_env
    body = base.body_state()
    qpos = body["qpos"].clone()
    qpos[:, 0] += torch.tensor([3.0, -2.0])
    base.place(torch.arange(2), qpos, body["qvel"])
    observation = env.transform(base.observe())
    for step in range(steps):
        action = 0.1 * torch.randn(env.action_spec.shape, generator=torch.Generator().manual_seed(step))
        observation = env.step(observation.set("action", action))["next"].exclude("reward")
    return dict(observation.items())


def test_copies_see_the_target_motion_as_their_body_does() -> None:
    env, chosen = tracked(2), settings(**SMALL)
    copies = tracked(2 * chosen.samples)
    met: list[Tensor] = []

    def act(window: Tensor) -> Tensor:
        met.append(window.clone())
        return 0.01 * window[:, : env.action_spec.shape[-1]]

    actor = TensorDictModule(act, in_keys=["target_window"], out_keys=["action"])
    critic = TensorDictModule(lambda z: z[:, :1], in_keys=["humanoid_state"], out_keys=["state_value"])
    seen = walked(env)
    base = env.base_env
    Planner(copies, actor, critic, chosen, base.problem.followed()).perturbation(base)
    window = seen["target_window"]
    assert window.abs().max() > 0.1
    torch.testing.assert_close(met[0], window.repeat(len(met[0]) // 2, 1), atol=1e-5, rtol=0)
