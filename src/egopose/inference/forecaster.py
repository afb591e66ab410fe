"""From a policy and the state at the end of a context to futures: the mean one, or several drawn.

Yuan & Kitani 2019, section 3.2: the context of the seen video is fixed, and the policy goes on from its own states.
So a future may have any length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from egopose.envs.env import EgoPoseEnv
from egopose.envs.test_time import Controller, prepare_for_test
from egopose.inference.planners import AnyPlanner
from egopose.motion.rotations import Array


@dataclass(frozen=True)
class Forecasts:
    """ReferenceForecasts of W windows, K each.

    Attributes:
        qpos: ``[W, K, H, nq]``; row 0 is the frame after the last one seen.
        fallen: ``[W, K, H]`` frames in which the head is too low for the take.
        diverged: ``[W, K]`` futures whose physics broke; from there they stand still in their last pose.
    """

    qpos: Array
    fallen: NDArray[np.bool_]
    diverged: NDArray[np.bool_]


@torch.no_grad()
def forecast(
    env: TransformedEnv,
    actor: Controller,
    qpos: Tensor,
    qvel: Tensor,
    samples: int = 1,
    horizon: int = 90,
    seed: int = 0,
    noise_time: float = 0.0,
    planner: AnyPlanner | None = None,
) -> Forecasts:
    """Roll the policy out from the given states.

    With one sample the policy's mean action is taken. With more, each future draws its own actions from the policy's
    distribution. Their noise is a first-order process in time, since a person does not tremble.

    Args:
        env: over :class:`EgoPoseEnv` with ``WholeFragments`` starts and falls that do not end the episode; window w is
            the fragment of the worlds ``w * samples .. (w + 1) * samples - 1``. Its end does not end a forecast.
        actor: the policy.
        qpos, qvel: ``[W, nq]`` and ``[W, nv]`` states at the windows' last frames seen.
        samples: K.
        horizon: H, frames.
        seed: of the drawn actions; torch's own generator is left as it was.
        noise_time: s in which the correlation of a drawn action's noise falls to 1/e; 0 for independent steps, as the
            policy was trained with.
        planner: of as many bodies, for the mean action; None for the policy alone.

    Raises:
        ValueError: the environment has not ``W * samples`` worlds, or a count is not positive.
    """
    base = env.base_env
    assert isinstance(base, EgoPoseEnv)
    count = len(qpos) * samples
    if env.batch_size != torch.Size([count]) or min(samples, horizon) < 1:
        raise ValueError(f"{len(qpos)} windows x {samples} futures need as many worlds, not {list(env.batch_size)}")
    prepare_for_test(env, actor)
    first = [part.repeat_interleave(samples, dim=0) for part in (qpos, qvel)]
    observation = env.reset()
    base.place(torch.arange(count), *first)
    observation.update(env.transform(base.observe()))
    rows, falls = [], []
    previous, broken = first[0].double(), torch.zeros(count, dtype=torch.bool)
    kept = math.exp(-base.problem.humanoid.control_dt / noise_time) if noise_time > 0 else 0.0
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(count, *env.action_spec.shape[1:], generator=generator)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(horizon):
            observation = actor(observation)
            if planner is not None:
                observation["action"] = observation["action"] + planner.perturbation(base)
            if samples > 1:
                observation["action"] = observation["loc"] + observation["scale"] * noise
                fresh = torch.randn(noise.shape, generator=generator)
                noise = kept * noise + math.sqrt(1 - kept**2) * fresh
            after = env.step(observation)["next"]
            broken = broken | after["diverged"].squeeze(-1)
            previous = torch.where(broken[:, None], previous, torch.from_numpy(base.physics.qpos))
            rows.append(previous)
            falls.append(after["fallen"].squeeze(-1))
            observation = after.exclude("reward", "action")
    shape = (len(qpos), samples, horizon)
    return Forecasts(
        torch.stack(rows, dim=1).numpy().reshape(*shape, -1),
        torch.stack(falls, dim=1).numpy().reshape(shape),
        broken.numpy().reshape(shape[:2]),
    )
