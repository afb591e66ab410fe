"""A trained agent on whole fragments as a live stream runs it: frame by frame, with a look-ahead and no more.

Nothing waits for a clock, so the figures do not depend on the machine. How much of a plan there is time for, a stream's
own status tells.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torchrl.envs import TransformedEnv

from egopose.core.errors import InputError
from egopose.data.fragments import FragmentLike
from egopose.data.preparation import flow_name, store_folder
from egopose.data.store import TakeStore
from egopose.inference.causal import CausalRegression
from egopose.inference.estimator import Estimate
from egopose.inference.failsafe import FailSafeSettings
from egopose.inference.planner_settings import PlannerSettings
from egopose.inference.planners import AnyPlannerSettings, planned_threshold
from egopose.inference.stream.build import live_body, live_regression, load_trained
from egopose.inference.stream.live_body import LiveBody, LivePose
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array
from egopose.pipeline.agent import Agent
from egopose.pipeline.regressor_input import seen_in_store
from egopose.vision.features import encode


def live_estimates(
    agent: Agent,
    fragments: Sequence[FragmentLike],
    failsafe: FailSafeSettings,
    lookahead: int,
    threads: int,
    planner: AnyPlannerSettings | None,
) -> list[Estimate]:
    """One estimate a fragment, begun at the reference's place and heading.

    Args:
        agent: see :func:`egopose.pipeline.agent.load_agent`.
        fragments: of its dataset.
        failsafe: when the body restarts; at its own place.
        lookahead: frames.
        threads: of the planner's physics.
        planner: None for the policy alone.

    Raises:
        InputError: a planner or a restart that a stream does not have.
    """
    if planner is not None and type(planner) is not PlannerSettings:  # a stream has no other planner's way of searching
        raise InputError("conf/evaluate.yaml", "planner", "causal=true plans as a stream does: planner=live or none")
    if failsafe.restart != "own":
        raise InputError("failsafe", "restart", "causal=true restarts at the body's own place, as a stream: own")
    trained = load_trained(str(agent.path), "best")
    guard = failsafe.for_run(agent.config, planned_threshold(planner))
    copies = None if planner is None else trained.copies(planner.samples, threads)
    store = TakeStore.open(store_folder(agent.config))
    flow = seen_in_store(agent.config, trained.source_config["regressor"], store, flow_name(agent.config))
    batch = int(trained.source_config["vision"]["encode_batch"])
    found = []
    for fragment in fragments:
        start = int(agent.dataset.takes.offsets[fragment.take]) + fragment.start
        rows = slice(start, start + fragment.stop - fragment.start)
        features = encode(trained.regressor.encoder, flow[rows], batch)  # type: ignore[arg-type]  # it reads video
        body = live_body(trained, guard, planner, copies)
        poses = _poses(live_regression(trained, lookahead, planner), body, features)
        truth = torch.as_tensor(agent.dataset.reference["qpos"][start]).double().numpy()
        found.append(_estimate(trained.env, fragment, start, poses, truth, agent.dataset.takes.lowest_head_height))
    return found


def begun_at(qpos: Array, where: Array) -> Array:
    """``qpos [T, nq]`` moved on the floor so that its first row stands and faces as ``where [nq]`` does."""
    turn = rot.multiply(rot.heading(where[3:7]), rot.conjugate(rot.heading(qpos[0, 3:7])))
    level = np.array([1.0, 1.0, 0.0])
    moved = qpos.copy()
    moved[:, :3] = rot.rotate(turn, qpos[:, :3] - level * qpos[0, :3]) + level * where[:3]
    moved[:, 3:7] = rot.multiply(turn, qpos[:, 3:7])
    return moved


@torch.no_grad()
def _poses(regression: CausalRegression, body: LiveBody, features: Tensor) -> list[LivePose]:
    """The body at every frame with ``features [T, D]``."""
    seen = [regression.push(frame, row) for frame, row in enumerate(features)]
    return [body.advance(row) for row in [*(row for row in seen if row is not None), *regression.drain()]]


def _estimate(
    env: TransformedEnv,
    fragment: FragmentLike,
    start: int,
    poses: Sequence[LivePose],
    truth: Array,
    lowest_head_height: Tensor,
) -> Estimate:
    """``poses`` moved so that the first stands at the place and heading of ``truth [nq]``.

    ``lowest_head_height [takes]`` m is the data's: ``env``, the live body's, has but one take of its own.
    """
    qpos = begun_at(np.stack([pose.qpos for pose in poses]), truth)
    reset = np.array([pose.reset for pose in poses])
    value, confidence = (
        np.array([np.nan if one is None else one for one in column], dtype=np.float64)
        for column in zip(*((pose.value, pose.confidence) for pose in poses), strict=True)
    )
    base = env.base_env
    head = base.bodies(qpos, np.zeros((len(qpos), base.physics.model.nv))).xpos[:, base.problem.humanoid.head, 2]
    lowest = float(lowest_head_height[fragment.take]) - base.problem.termination.head_drop
    return Estimate(
        start=start,
        qpos=qpos,
        value=value,
        confidence=confidence,
        triggered=np.append(reset[1:], False),  # a restart is decided at the frame before
        resets=reset,
        fallen=(head < lowest).numpy(),
        diverged=0,
    )
