"""A small batched environment with the keys of the real one, for tests of the training loop: follow a moving target."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import StepCounter
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator

from egopose.collection.collectors import CollectorSettings, build_collector
from egopose.training.loop import LoopSettings, Run
from egopose.training.ppo import PPO, PPOSettings

SETTINGS: dict[str, Any] = {
    "gamma": 0.95,
    "lmbda": 0.95,
    "clip_epsilon": 0.2,
    "entropy_coeff": 0.0,
    "epochs": 3,
    "minibatch_size": 64,
    "policy_lr": 3e-3,
    "value_lr": 3e-3,
    "policy_grad_norm": 40.0,
    "value_grad_norm": None,
    "normalize_advantage": True,
    "target_kl": 0.02,
    "policy_lr_range": [1e-4, 1e-2],
    "smoothness": 0.0,
    "max_nonfinite": 2,
}
LOOP: dict[str, Any] = {
    "iterations": 6,
    "steps_per_iteration": 256,
    "critic_first": 0,
    "total_steps": None,
    "max_seconds": None,
    "checkpoint_every": 3,
    "keep_last": 2,
    "evaluate_every": 0,
}
#: Those of them that stand in the group ``algo``.
LOOP_IN_ALGO = ("iterations", "steps_per_iteration", "critic_first")
COLLECTOR: dict[str, Any] = {
    "kind": "sync",
    "num_envs": 8,
    "physics_threads": 1,
    "workers": 1,
    "threads": 1,
    "update_threads": 1,
}
CONFIG: dict[str, Any] = {"task": {"name": "toy"}, "seed": 3}


class ToyEnv(EnvBase):
    """``humanoid_state [4]`` is moved by ``action [2]``; too far from the origin is a fall, 20 steps the time limit."""

    def __init__(self, num_envs: int = 8, size: int = 2, seed: int = 0) -> None:
        super().__init__(device=None, batch_size=torch.Size([num_envs]))
        self.size = size
        n = (num_envs,)
        flag = Binary(1, (num_envs, 1), dtype=torch.bool)
        self.observation_spec = Composite(
            humanoid_state=Unbounded((num_envs, 2 * size)),
            visual_context=Unbounded((num_envs, 3)),
            episode_step=Unbounded((num_envs, 1), dtype=torch.int64),
            reward_terms=Composite(pose=Unbounded((num_envs, 1)), root_pose=Unbounded((num_envs, 1)), shape=n),
            diverged=flag.clone(),
            shape=n,
        )
        self.action_spec = Unbounded((num_envs, size))
        self.reward_spec = Unbounded((num_envs, 1))
        self.done_spec = Composite({k: flag.clone() for k in ("done", "terminated", "truncated")}, shape=n)
        self.generator = torch.Generator().manual_seed(seed)
        self.x = torch.zeros(num_envs, 2 * size)
        self.t = torch.zeros(num_envs, dtype=torch.int64)

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> TensorDict:
        mask = torch.ones(self.batch_size, dtype=torch.bool)
        if tensordict is not None and "_reset" in set(tensordict.keys()):
            mask = tensordict["_reset"].reshape(self.batch_size)
        fresh = 0.3 * torch.randn(self.x.shape, generator=self.generator)
        self.x = torch.where(mask[:, None], fresh, self.x)
        self.t = torch.where(mask, torch.zeros_like(self.t), self.t)
        return self._observe(torch.zeros(self.batch_size, dtype=torch.bool), torch.zeros(self.batch_size))

    def _observe(self, fallen: torch.Tensor, reward: torch.Tensor) -> TensorDict:
        late = (self.t >= 20) & ~fallen
        t = self.t[:, None].float()
        return TensorDict(
            {
                "humanoid_state": self.x.clone(),
                "visual_context": torch.cat([torch.sin(t), torch.cos(t), t / 20], -1),
                "episode_step": self.t[:, None].clone(),
                "reward_terms": TensorDict(
                    {"pose": reward[:, None], "root_pose": reward[:, None] ** 2}, batch_size=self.batch_size
                ),
                "diverged": torch.zeros(*self.batch_size, 1, dtype=torch.bool),
                "terminated": fallen[:, None],
                "truncated": late[:, None],
                "done": (fallen | late)[:, None],
            },
            batch_size=self.batch_size,
        )

    def _step(self, tensordict: Any) -> TensorDict:
        push = tensordict["action"].detach()
        noise = 0.05 * torch.randn(self.x.shape, generator=self.generator)
        self.x = self.x + torch.cat([push, -push], -1) * 0.3 + noise + 0.05
        self.t = self.t + 1
        distance = self.x[:, : self.size].norm(dim=-1)
        reward = torch.exp(-(distance**2))
        out = self._observe(distance > 2.0, reward)
        out["reward"] = reward[:, None]
        return out

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, torch.Tensor]:
        return {"x": self.x.clone(), "t": self.t.clone(), "generator": self.generator.get_state()}

    def load_state_dict(self, state_dict: dict[str, torch.Tensor], *args: Any, **kwargs: Any) -> None:
        if state_dict["x"].shape != self.x.shape:
            raise ValueError("another number of worlds")
        self.x, self.t = state_dict["x"].clone(), state_dict["t"].clone()
        self.generator.set_state(state_dict["generator"])


def make_env(num_envs: int = 8, size: int = 2) -> TransformedEnv:
    """The toy under a transform with a state of its own."""
    return TransformedEnv(ToyEnv(num_envs, size), StepCounter())


def toy_worker(num_envs: int, size: int, worker: int) -> TransformedEnv:
    """The toy of one worker, at module level for other processes."""
    return TransformedEnv(ToyEnv(num_envs, size, seed=worker), StepCounter())


class _Gaussian(nn.Module):
    def __init__(self, inputs: int, size: int) -> None:
        super().__init__()
        self.mean = MLP(inputs, size, num_cells=[16])

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean = self.mean(*inputs)
        return mean, torch.full_like(mean, 0.3)


def networks(size: int = 2) -> tuple[ProbabilisticActor, ValueOperator]:
    """Actor and critic of the toy."""
    keys = ["humanoid_state", "visual_context"]
    head = TensorDictModule(_Gaussian(2 * size + 3, size), in_keys=keys, out_keys=["loc", "scale"])
    actor = ProbabilisticActor(
        TensorDictSequential(head),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    return actor, ValueOperator(MLP(2 * size + 3, 1, num_cells=[16]), in_keys=keys)


def make_run(folder: Path, size: int = 2, num_envs: int = 8, seed: int = 3, **settings: Any) -> Run:
    """A run on the toy; ``settings`` override :data:`SETTINGS` and :data:`LOOP` by name."""
    torch.manual_seed(seed)
    loop = {k: settings.pop(k, v) for k, v in LOOP.items()}
    config = settings.pop("config", CONFIG)
    actor, critic = networks(size)
    collector_settings = CollectorSettings.from_config({**COLLECTOR, **settings.pop("collector", {})})
    ppo = PPO(actor, critic, PPOSettings.from_config({**SETTINGS, **settings}))
    collector = build_collector(
        collector_settings, partial(toy_worker, num_envs, size), actor, loop["steps_per_iteration"]
    )
    return Run(ppo, collector, LoopSettings.from_config(loop), collector_settings, folder, config, action_size=size)
