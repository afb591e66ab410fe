"""The states of the frames a forecast has seen, from three sources, none of which knows what comes after them.

``regressor``: the state regressor on the context as a clip by itself. ``estimator``: an estimation policy that follows
its own regressor through the context (Yuan & Kitani 2019, section 3.2: z_1 is from ego-pose estimation on V_{-f:0}).
``reference``: the true states, as in training.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egopose.checkpoint.checkpoint import find_checkpoint, read_json
from egopose.core.errors import InputError
from egopose.data.preparation import flow_name, store_folder
from egopose.data.store import Fragment, TakeStore
from egopose.data.windows import ForecastWindow
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.problem import TakeTable
from egopose.humanoid.state_layout import StateLayout
from egopose.inference.context_states import context_states
from egopose.inference.estimator import estimate_takes, restart_path
from egopose.inference.failsafe import FailSafe, FailSafeSettings
from egopose.inference.video_regression import require_estimation, run_folder, seen_in
from egopose.models.predictions import Flow
from egopose.motion.motion import finite_difference
from egopose.motion.rotations import Array
from egopose.pipeline.agent import Agent, load_agent
from egopose.pipeline.regressor import load_regressor
from egopose.pipeline.regressor_input import seen_in_store
from egopose.tasks.dataset import Dataset

SOURCES = ("regressor", "estimator", "reference")


def past_states(
    agent: Agent,
    windows: Sequence[ForecastWindow],
    source: str,
    estimator: str | None = None,
    failsafe: FailSafeSettings | None = None,
    threads: int = 1,
) -> Tensor:
    """Humanoid states z ``[W, context, S]`` of the windows' contexts, float64.

    Args:
        agent: the forecasting run, whose state regressor ``regressor`` asks.
        windows: W, all of one context.
        source: one of :data:`SOURCES`.
        estimator: run directory or checkpoint of an estimation policy, trained on the same store.
        failsafe: of the estimator.
        threads: of its physics.

    Raises:
        InputError: a regressor, estimator or the flow they read is not there or does not fit.
    """
    dataset, context = agent.dataset, windows[0].context
    first = [int(dataset.takes.offsets[w.take]) + w.start for w in windows]
    if source == "reference":
        rows = torch.tensor(first)[:, None] + torch.arange(context)
        states = humanoid_state({key: dataset.reference[key][rows.flatten()].double() for key in ("qpos", "qvel")})
        return states.unflatten(0, rows.shape)
    if source == "estimator":
        if estimator is None or failsafe is None:
            raise InputError("conf/evaluate.yaml", "forecast.estimator", "is missing: the run of an estimation policy")
        return _estimated(agent, first, context, estimator, failsafe, threads)
    if dataset.regressor is None:
        raise InputError(agent.path, "regressor", "forecasts begin from the state regressor's state, and there is none")
    model, source_config = load_regressor(dataset.regressor)
    return context_states(model, _seen(agent, source_config), first, context).double()


def _seen(agent: Agent, source_config: Mapping[str, Any]) -> Flow:
    """What a regressor looks at of the store the agent was trained on."""
    config = agent.config
    return seen_in_store(config, source_config["regressor"], TakeStore.open(store_folder(config)), flow_name(config))


def _estimated(
    agent: Agent, first: Sequence[int], context: int, estimator: str, failsafe: FailSafeSettings, threads: int
) -> Tensor:

    checkpoint = find_checkpoint(estimator)
    require_estimation(read_json(checkpoint, "config"), checkpoint)
    model, source_config = load_regressor(run_folder(checkpoint) / "regressor")
    flow, humanoid = _seen(agent, source_config), agent.dataset.humanoid
    result = [seen_in(humanoid, model, np.asarray(flow[at : at + context]), source_config) for at in first]
    seen = {key: torch.cat([clip[key] for clip in result]) for key in result[0]}
    dataset = context_dataset(agent.dataset, first, context, seen)
    policy = load_agent(checkpoint, dataset)
    env = policy.make_env(num_envs=len(first), threads=threads, whole_fragments=True, falls_end=False)
    guard = FailSafe(len(first), failsafe.for_run(policy.config))
    restart = restart_path(failsafe.restart, env, None)
    estimates = estimate_takes(env, policy.actor, policy.critic, policy.followed_states(), guard, restart=restart)
    env.close()
    clips = seen["humanoid_state"].double().unflatten(0, (len(first), context))
    fps = 1.0 / humanoid.control_dt
    return torch.stack([_states(e.qpos, e.resets, clip, fps) for e, clip in zip(estimates, clips, strict=True)])


def _states(qpos: Array, resets: NDArray[np.bool_], regressed: Tensor, fps: float) -> Tensor:
    """z ``[T, S]`` of an estimate ``[T, nq]``; velocities across a jump of the fail-safe are the regressor's."""
    velocity = torch.from_numpy(finite_difference(qpos, fps))
    states = humanoid_state({"qpos": torch.from_numpy(qpos), "qvel": velocity})
    jumps = np.append(resets[1:], resets[-1:])  # differences go forward, and the last frame repeats the one before
    velocities = StateLayout.of_size(states.shape[1]).velocities
    states[jumps, velocities] = regressed[jumps, velocities]
    return states


def context_dataset(whole: Dataset, first: Sequence[int], context: int, seen: dict[str, Tensor]) -> Dataset:
    """Each context as a take by itself, so that nothing an estimation policy reads reaches beyond it.

    Args:
        whole: of the store.
        first: ``[W]`` global first frames.
        context: frames.
        seen: tables ``[W * context, ...]``, see :func:`egopose.inference.video_regression.seen_in`.
    """
    rows = (torch.tensor(first)[:, None] + torch.arange(context)).flatten()
    reference = whole.reference[rows]
    heads = torch.as_tensor(reference["xpos"])[:, whole.humanoid.head, 2].double()
    pieces = [Fragment(number, 0, context) for number in range(len(first))]
    offsets = context * torch.arange(len(first))
    return Dataset(
        whole.humanoid,
        reference,
        TakeTable(offsets, torch.full_like(offsets, context), heads.unflatten(0, (-1, context)).amin(dim=1)),
        train=pieces,
        test=pieces,
        visual_features=seen["visual_features"],
        visual_context=seen["visual_context"],
        joint_targets=seen["joint_targets"],
        states=seen["humanoid_state"],
    )
