"""What trained policies' value networks say of the scene: the functions that the scene is fitted by."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from egopose.collection.stepping import parts_of, run_parts
from egopose.envs.mdp.observations import BodyView
from egopose.envs.problem import Scene
from egopose.envs.reconstruction import ReconstructionProblem
from egopose.envs.scene_ranges import SceneRanges
from egopose.envs.transforms import StateNormalizer
from egopose.humanoid.physics_worker import Placer
from egopose.pipeline.agent import Agent
from egopose.scene.fitting import WindowValue


def window_value(agent: Agent, whole: SceneRanges, start: int, stop: int | None) -> WindowValue:
    """``f(e) = V(s_start, e) - V(s_stop, e)`` of e ``[P]`` within ``whole``, differentiable.

    States are those that episodes begin in at these frames; a body that a box carries moves with it. After the clip's
    end nothing is earned, so there ``V(s_stop, e)`` is 0.

    Args:
        agent: of the window.
        whole: the ranges of all boxes of the scene.
        start, stop: frames in which the policy takes over and hands over; ``stop`` is None for the clip's end.
    """
    env = agent.make_env(num_envs=1)
    problem = env.base_env.problem
    assert isinstance(problem, ReconstructionProblem)
    normalizer = next(module for module in env.transform.modules() if isinstance(module, StateNormalizer))
    env.close()
    frames = torch.tensor([start] if stop is None else [start, stop])
    critic = parts_of(agent.critic)
    placer = Placer(problem.humanoid.mj_model, problem.humanoid.body_ids)

    def value(e: Tensor) -> Tensor:
        tops, headings = whole.changed(whole.change_of(e).expand(len(frames), -1, -1))
        used = torch.ones(headings.shape, dtype=torch.bool)
        qpos, qvel = problem.first_state(frames, Scene(tops, headings, used))
        seen = problem.observations_among(_placed(problem, placer, qpos, qvel), frames, qpos[:, :7], tops, headings)
        state = normalizer.normalize(seen["humanoid_state"].float())
        parts: dict[Any, Tensor] = {"humanoid_state": state, "scene_parameters": seen["scene_parameters"].float()}
        run_parts(critic, parts)
        values = parts["state_value"].squeeze(-1)
        return values[0] - values[1:].sum()

    return value


def _placed(problem: ReconstructionProblem, placer: Placer, qpos: Tensor, qvel: Tensor) -> BodyView:
    """The bodies without gradients: in the root's frame nothing of them depends on where the root is."""
    places, rates = qpos.detach(), qvel.detach()
    xpos, xquat, xipos = placer(places.numpy())
    mass = problem.humanoid.mj_model.body_mass[problem.humanoid.body_ids]
    arrays = {"xpos": xpos, "xquat": xquat, "com": np.asarray(mass @ xipos / mass.sum())}
    state = {"qpos": places, "qvel": rates, **{name: torch.from_numpy(array) for name, array in arrays.items()}}
    return BodyView(state, problem.layout)
