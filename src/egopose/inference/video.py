"""``python -m egopose.estimate video=x.mp4 checkpoint=RUN_OR_CHECKPOINT [out=DIR]``: motion from a video alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from egopose.checkpoint.checkpoint import find_checkpoint, read_json
from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.core.result_files import write_columns_csv
from egopose.data.preparation import humanoid_of
from egopose.inference.estimator import estimate_takes, restart_path
from egopose.inference.failsafe import FailSafe, FailSafeSettings
from egopose.inference.outputs import TakeVideo, write_footage, write_motion_files, write_side_by_side
from egopose.inference.planner import Planner
from egopose.inference.planner_settings import PlannerSettings, planned_threshold, planner_settings
from egopose.inference.video_regression import (
    causal_regression,
    require_estimation,
    run_folder,
    seen_in,
    seen_live,
    video_dataset,
)
from egopose.motion.motion import Motion
from egopose.pipeline.agent import Agent, load_agent
from egopose.pipeline.regressor import load_regressor
from egopose.pipeline.regressor_input import load_body_part_estimator_of
from egopose.vision.features import extract_flow
from egopose.vision.lens import Camera


def run_estimate(config: Mapping[str, Any], agent: Agent, pose_motion: Motion, video: Path, out: Path) -> Path:
    """Estimate the motion of a video and write the results.

    Args:
        config: resolved ``conf/estimate.yaml``.
        agent: on :func:`video_dataset`.
        pose_motion: PoseReg's motion, for the picture.
        video: the MP4.
        out: folder of the results: ``estimate.bvh``, ``estimate.npz``, ``frames.csv``, ``side_by_side.mp4``.

    Returns:
        The folder.

    Raises:
        InputError: a setting is missing or wrong.
        RuntimeError: no OpenGL here.
    """
    failsafe = from_mapping(FailSafeSettings, config["failsafe"], "conf/estimate.yaml: failsafe")
    settings = allowed_planner(config)
    guard = FailSafe(1, failsafe.for_run(agent.config, planned_threshold(settings)))
    torch.set_num_threads(1)
    options = {"threads": 1, "whole_fragments": True, "falls_end": False}
    env = agent.make_env("test", num_envs=1, **options)
    lookahead, states = allowed_lookahead(config), agent.followed_states()
    planner = None
    if settings is not None:
        copies = agent.make_env("test", num_envs=settings.samples, **{**options, "threads": int(config["threads"])})
        planner = Planner(copies, agent.actor, agent.critic, settings)
    restart = restart_path(failsafe.restart, env, planner)
    (estimate,) = estimate_takes(
        env, agent.actor, agent.critic, states, guard, lookahead, planner=planner, restart=restart
    )
    env.close()
    if planner is not None:
        planner.close()
    humanoid = agent.dataset.humanoid
    motion = estimate.motion(humanoid, pose_motion.name)
    out.mkdir(parents=True, exist_ok=True)
    write_motion_files(out, "estimate", motion)
    write_columns_csv(out / "frames.csv", estimate.columns())
    motions = {"estimate": motion, "PoseReg": pose_motion}
    camera = Camera.from_mapping(config["camera"], "camera")
    seen = TakeVideo(video, float(config["offset"]), rendered=False, taken_at=camera.fps)
    write_footage(out, seen, 0, motion.fps)
    write_side_by_side(out / "side_by_side.mp4", humanoid, motions, seen, 0, int(config["size"]))
    print(f"{len(motion)} frames, {estimate.n_resets} resets by the fail-safe; written to {out}", flush=True)
    return out


def allowed_planner(config: Mapping[str, Any]) -> PlannerSettings | None:
    """The planner's settings by ``conf/estimate.yaml``; None for no planner.

    ``causal`` has no planner: its look-ahead is ``lookahead`` frames, and a planner's horizon is longer.

    Raises:
        InputError: a setting is missing or wrong.
    """
    settings = planner_settings(config.get("planner"))
    return None if config["causal"] else settings


def allowed_lookahead(config: Mapping[str, Any]) -> int | None:
    """Future frames a frame's context may see by ``conf/estimate.yaml``, None for all.

    Raises:
        InputError: it is no number of frames.
    """
    lookahead = config["lookahead"]
    if not config["causal"]:
        return None
    if not isinstance(lookahead, int) or lookahead < 0:
        raise InputError("conf/estimate.yaml", "lookahead", f"must be a number of frames, not {lookahead!r}")
    return lookahead


def estimate_video(values: Mapping[str, Any]) -> Path:
    """From video to files, as ``conf/estimate.yaml`` (resolved) says: flow, regressor, policy.

    Returns:
        The folder of the results.

    Raises:
        InputError: the video, the run or a setting cannot be used; names it.
        RuntimeError: no OpenGL here.
    """
    video = Path(str(values["video"]))
    out = video.with_name(f"{video.stem}_estimate") if values["out"] is None else Path(str(values["out"]))
    checkpoint = find_checkpoint(str(values["checkpoint"]), str(values["which"]))
    run = read_json(checkpoint, "config")
    require_estimation(run, checkpoint)
    humanoid = humanoid_of(run)
    regressor, source_config = load_regressor(run_folder(checkpoint) / "regressor")
    lookahead = allowed_lookahead(values)
    camera = Camera.from_mapping(values["camera"], "camera")
    rate, offset = 1.0 / humanoid.control_dt, float(values["offset"])
    finder = load_body_part_estimator_of(source_config["regressor"])
    flow = extract_flow(video, source_config["vision"]["flow"], rate, offset, camera=camera, finder=finder)
    overrides = None
    if lookahead is None:
        seen = seen_in(humanoid, regressor, flow, source_config)
    else:
        causal = causal_regression(humanoid, regressor, source_config, run["task"], lookahead)
        seen = seen_live(causal, regressor, flow, source_config)
        # What is seen live is smoothed already.
        overrides = {"task": {**run["task"], "action": {**run["task"]["action"], "smoothing": 0.0}}}
    dataset, pose_motion = video_dataset(humanoid, seen, video.stem)
    agent = load_agent(checkpoint, dataset, overrides=overrides)
    return run_estimate(values, agent, pose_motion, video, out)
