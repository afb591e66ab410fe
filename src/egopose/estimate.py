"""``python -m egopose.estimate video=x.mp4 checkpoint=RUN_OR_CHECKPOINT [out=DIR]``: motion from a video alone."""

from __future__ import annotations

from egopose.runtime import prepare_runtime

prepare_runtime()

import sys  # noqa: E402
from collections.abc import Mapping  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

from omegaconf import DictConfig  # noqa: E402

from egopose.config import command, from_mapping, resolved  # noqa: E402
from egopose.errors import InputError  # noqa: E402

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from egopose.humanoid.model import HumanoidModel
    from egopose.inference.causal import CausalRegression
    from egopose.inference.planner_settings import PlannerSettings
    from egopose.material import Material
    from egopose.models.regressor import StateRegressor
    from egopose.motion.motion import Motion
    from egopose.pipeline import Agent


def causal_regression(
    humanoid: HumanoidModel,
    regressor: StateRegressor,
    made_with: Mapping[str, Any],
    task: Mapping[str, Any],
    lookahead: int,
) -> CausalRegression:
    """The regressor that sees ``lookahead`` frames ahead and no more, for a policy of the group ``task``.

    Args:
        humanoid: the run's.
        regressor: trained, in eval mode.
        made_with: the groups ``vision`` and ``regressor`` it was trained with.
        task: the run's.
        lookahead: frames.
    """
    import torch

    from egopose.inference.causal import CausalRegression

    smoothing = float(task["action"].get("smoothing", 0.0)) / humanoid.control_dt
    joint_range = torch.as_tensor(humanoid.joint_range)
    return CausalRegression(regressor, joint_range, lookahead, _crossed(made_with), smoothing)


def _crossed(made_with: Mapping[str, Any]) -> bool:
    """A policy trained on the tables of several fits reads the regressor's states for a context."""
    return int(made_with["regressor"]["cross_fit"]) > 1


def seen_in(
    humanoid: HumanoidModel, regressor: StateRegressor, flow: np.ndarray, made_with: Mapping[str, Any]
) -> dict[str, Tensor]:
    """What the regressor makes of a whole video.

    Args:
        humanoid: the run's.
        regressor: trained, in eval mode.
        flow: ``[T, 2, S, S]`` of the video at the control rate, with a third plane where the regressor sees limbs.
        made_with: the groups ``vision`` and ``regressor`` it was trained with.

    Returns:
        ``visual_features [T, D]``, ``visual_context [T, C]`` as a policy reads it, ``humanoid_state [T, S]``,
        ``joint_targets [T, nu]`` rad.
    """
    import torch

    from egopose.regression import joint_targets
    from egopose.training.fragments import Span
    from egopose.training.predictions import predict_span

    batch = int(made_with["vision"]["encode_batch"])
    seen = predict_span(regressor, torch.from_numpy(flow), Span(0, len(flow)), batch)
    states = seen["humanoid_state"]
    return {
        "visual_features": seen["visual_features"],
        "visual_context": regressor.normalise(states) if _crossed(made_with) else seen["visual_context"],
        "humanoid_state": states,
        "joint_targets": joint_targets(states, humanoid),
    }


def seen_live(
    causal: CausalRegression, regressor: StateRegressor, flow: np.ndarray, made_with: Mapping[str, Any]
) -> dict[str, Tensor]:
    """As :func:`seen_in`, each frame as it would have been seen live; smoothed where the policy follows that."""
    import torch

    from egopose.vision.features import encode

    encoder, batch = regressor.encoder, int(made_with["vision"]["encode_batch"])
    features = encode(encoder, flow, batch)  # type: ignore[arg-type]  # a regressor of video has a FlowEncoder
    found = [causal.push(frame, row) for frame, row in enumerate(features)]
    rows = [*(row for row in found if row is not None), *causal.drain()]
    keys = ("visual_context", "humanoid_state", "joint_targets")
    return {"visual_features": features, **{key: torch.stack([getattr(row, key) for row in rows]) for key in keys}}


def require_estimation(run: Mapping[str, Any], checkpoint: str | Path) -> None:
    """Raises InputError: the configuration ``run`` of a checkpoint is of a policy that forecasts."""
    if run["task"].get("context") is not None:
        raise InputError(checkpoint, "task", "this run forecasts; an estimation policy is needed here")


def video_material(humanoid: HumanoidModel, seen: Mapping[str, Tensor], name: str) -> tuple[Material, Motion]:
    """What the policy needs of a video: a take whose reference is what the state regressor makes of it by itself.

    There is no mocap. PoseReg's motion, from the origin and heading along x, stands in its place: it gives the policy
    its start, and no figure is taken from the distance to it.

    Args:
        humanoid: the run's.
        seen: of T frames, see :func:`seen_in`.
        name: of the take.

    Returns:
        The material and PoseReg's motion.

    Raises:
        InputError: fewer than 2 frames.
    """
    import numpy as np
    import torch

    from egopose.data.reference import reference_states
    from egopose.data.store import Fragment
    from egopose.envs.problem import TakeTable
    from egopose.material import Material
    from egopose.models.pose_regression import pose_regression

    frames = len(seen["humanoid_state"])
    if frames < 2:
        raise InputError(name, "video", f"has {frames} frames at 30 frames/s; at least 2 are needed")
    states = seen["humanoid_state"].numpy()
    facing = np.array([1.0, 0.0, 0.0, 0.0])
    motion = pose_regression(
        states, humanoid.skeleton, np.zeros(2), facing, 1.0 / humanoid.control_dt, humanoid.joint_range, name
    )
    reference = reference_states(humanoid, motion)
    lowest = reference["xpos"][:, humanoid.head, 2].min().reshape(1)
    whole = [Fragment(0, 0, frames)]
    material = Material(
        humanoid,
        reference,
        TakeTable(torch.tensor([0]), torch.tensor([frames]), lowest),
        train=whole,
        test=whole,
        visual_features=seen["visual_features"],
        visual_context=seen["visual_context"],
        joint_targets=seen["joint_targets"],
        states=seen["humanoid_state"],
    )
    return material, motion


def run_estimate(config: Mapping[str, Any], agent: Agent, pose_motion: Motion, video: Path, out: Path) -> Path:
    """Drive the humanoid through the video and write what came of it.

    Args:
        config: resolved ``conf/estimate.yaml``.
        agent: on :func:`video_material`.
        pose_motion: PoseReg's motion, for the picture.
        video: the MP4.
        out: folder of the results: ``estimate.bvh``, ``estimate.npz``, ``frames.csv``, ``side_by_side.mp4``.

    Returns:
        The folder.

    Raises:
        InputError: a setting is missing or wrong.
        RuntimeError: no OpenGL here.
    """
    import torch

    from egopose.evaluation.report import TakeVideo, write_footage, write_motion_files, write_side_by_side
    from egopose.evaluation.tables import write_columns_csv
    from egopose.inference.estimator import estimate_takes
    from egopose.inference.failsafe import FailSafe, FailSafeSettings
    from egopose.inference.planner_settings import planned_kappa
    from egopose.inference.planning import Planner
    from egopose.vision.lens import Camera

    failsafe = from_mapping(FailSafeSettings, config["failsafe"], "conf/estimate.yaml: failsafe")
    settings = allowed_planner(config)
    guard = FailSafe(1, failsafe.for_run(agent.config, planned_kappa(settings)))
    torch.set_num_threads(1)
    options = {"threads": 1, "whole_fragments": True, "falls_end": False}
    env = agent.make_env("test", worlds=1, **options)
    lookahead, states = allowed_lookahead(config), agent.followed_states()
    planner = None
    if settings is not None:
        copies = agent.make_env("test", worlds=settings.samples, **{**options, "threads": int(config["threads"])})
        planner = Planner(copies, agent.actor, agent.critic, states, settings)
    (estimate,) = estimate_takes(env, agent.actor, agent.critic, states, guard, lookahead, planner=planner)
    env.close()
    if planner is not None:
        planner.close()
    humanoid = agent.material.humanoid
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
    """How the body looks ahead by ``conf/estimate.yaml``, None for not at all.

    What is seen live is known for ``lookahead`` frames, and a planner's horizon is longer: ``causal`` goes without.

    Raises:
        InputError: a setting is missing or wrong.
    """
    from egopose.inference.planner_settings import planner_settings

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


def run_folder(checkpoint: Path) -> Path:
    """The run directory a checkpoint folder ``RUN/checkpoints/NAME`` lies in."""
    return checkpoint.resolve().parents[1]


def estimate_video(values: Mapping[str, Any]) -> Path:
    """The whole way of ``conf/estimate.yaml``, resolved: video, flow, regressor, policy, files.

    Returns:
        The folder of the results.

    Raises:
        InputError: the video, the run or a setting cannot be used; names it.
        RuntimeError: no OpenGL here.
    """
    from egopose.data.preparation import humanoid_of
    from egopose.pipeline import load_agent
    from egopose.regression import load_regressor
    from egopose.sight import load_finder_of
    from egopose.training.checkpoint import find_checkpoint, read_json
    from egopose.vision.features import extract_flow
    from egopose.vision.lens import Camera

    video = Path(str(values["video"]))
    out = video.with_name(f"{video.stem}_estimate") if values["out"] is None else Path(str(values["out"]))
    checkpoint = find_checkpoint(str(values["checkpoint"]), str(values["which"]))
    run = read_json(checkpoint, "config")
    require_estimation(run, checkpoint)
    humanoid = humanoid_of(run)
    regressor, made_with = load_regressor(run_folder(checkpoint) / "regressor")
    lookahead = allowed_lookahead(values)
    camera = Camera.from_mapping(values["camera"], "camera")
    rate, offset = 1.0 / humanoid.control_dt, float(values["offset"])
    finder = load_finder_of(made_with["regressor"])
    flow = extract_flow(video, made_with["vision"]["flow"], rate, offset, camera=camera, finder=finder)
    overrides = None
    if lookahead is None:
        seen = seen_in(humanoid, regressor, flow, made_with)
    else:
        causal = causal_regression(humanoid, regressor, made_with, run["task"], lookahead)
        seen = seen_live(causal, regressor, flow, made_with)
        # What is seen live is smoothed already.
        overrides = {"task": {**run["task"], "action": {**run["task"]["action"], "smoothing": 0.0}}}
    material, pose_motion = video_material(humanoid, seen, video.stem)
    agent = load_agent(checkpoint, material, overrides=overrides)
    return run_estimate(values, agent, pose_motion, video, out)


@command("estimate")
def main(config: DictConfig) -> None:
    """Hydra's entry."""
    try:
        estimate_video(resolved(config))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
