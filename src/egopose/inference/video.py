"""``python -m egopose.estimate video=x.mp4 checkpoint=RUN_OR_CHECKPOINT [out=DIR]``: motion from a video alone."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from egopose.checkpoint.checkpoint import find_checkpoint, read_json
from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.core.result_files import write_columns_csv
from egopose.core.runtime import settle_heap
from egopose.data.preparation import humanoid_of
from egopose.inference.estimator import estimate_takes, restart_path
from egopose.inference.failsafe import FailSafe, FailSafeSettings
from egopose.inference.film_agreement import film_agreement
from egopose.inference.film_process import Drawing, FilmProcess, FilmSettings, was_rendered
from egopose.inference.film_states import FilmReading, read_states, require_states_for_context, seen_in_film
from egopose.inference.outputs import TakeVideo, write_footage, write_motion_files
from egopose.inference.planners import AnyPlannerSettings, build_planner, planned_threshold, read_planner
from egopose.inference.progress import StageProgress
from egopose.inference.video_regression import (
    causal_regression,
    require_estimation,
    run_folder,
    seen_in,
    seen_live,
    video_dataset,
)
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.pipeline.agent import Agent, load_agent
from egopose.pipeline.regressor import load_regressor
from egopose.pipeline.regressor_input import load_body_part_estimator_of
from egopose.vision.features import with_body_parts
from egopose.vision.video import probe_video

READING, SEEING, MOVING, DRAWING = "reading the film", "seeing the pose", "moving the body", "drawing"
#: What a frame costs in each stage beside the others, without and with a planner (measured, docs/performance.md).
_COSTS, _PLANNED = {READING: 5.0, SEEING: 0.3, MOVING: 4.0, DRAWING: 5.0}, {MOVING: 170.0, DRAWING: 0.3}


def run_estimate(
    config: Mapping[str, Any],
    agent: Agent,
    pose_motion: Motion,
    film: FilmProcess,
    out: Path,
    progress: StageProgress,
    reading: FilmReading | None = None,
) -> Path:
    """Estimate the motion of a video and write the results.

    Args:
        config: resolved ``conf/estimate.yaml``.
        agent: on :func:`video_dataset`.
        pose_motion: PoseReg's motion, for the picture.
        film: whose rows were read; it draws.
        out: folder of the results: ``estimate.bvh``, ``estimate.npz``, ``frames.csv``, ``side_by_side.mp4``.
        progress: is told.
        reading: of the film, with which the motion is compared; None where the head signal was not read.

    Returns:
        The folder.

    Raises:
        InputError: a setting is missing or wrong.
        RuntimeError: no OpenGL here.
    """
    failsafe = from_mapping(FailSafeSettings, config["failsafe"], "conf/estimate.yaml: failsafe")
    settings = allowed_planner(config)
    if settings is not None and reading is not None:
        # A head signal does not drift as the states' own velocities do: its path stays where it was laid.
        settings = replace(settings, place_time=math.inf, heading_time=math.inf)
    guard = FailSafe(1, failsafe.for_run(agent.config, planned_threshold(settings)))
    torch.set_num_threads(1)
    options = {"threads": 1, "whole_fragments": True, "falls_end": False}
    env = agent.make_env("test", num_envs=1, **options)
    lookahead, states = allowed_lookahead(config), agent.followed_states()
    planner = None
    if settings is not None:
        copies = agent.make_env("test", num_envs=settings.samples, **{**options, "threads": int(config["threads"])})
        planner = build_planner(copies, agent.actor, agent.critic, settings)
    humanoid = agent.dataset.humanoid
    seen = TakeVideo(film.settings.video, film.settings.offset, rendered=False, taken_at=film.settings.camera.fps)
    known = {"PoseReg": pose_motion.qpos}
    film.draw(Drawing(out / "side_by_side.mp4", humanoid.mj_model, "estimate", known, seen.label))
    restart = restart_path(failsafe.restart, env, planner)
    settle_heap()
    with progress.stage(MOVING) as advance:

        def watch(qpos: Array) -> None:
            film.add(qpos[0])
            advance(1)

        (estimate,) = estimate_takes(
            env, agent.actor, agent.critic, states, guard, lookahead, planner=planner, restart=restart, watch=watch
        )
    env.close()
    if planner is not None:
        planner.close()
    motion = estimate.motion(humanoid, pose_motion.name)
    out.mkdir(parents=True, exist_ok=True)
    write_motion_files(out, "estimate", motion)
    columns = estimate.columns()
    agreement = None
    if reading is not None and film.settings.worn is not None:
        agreement = film_agreement(humanoid, motion.qpos, reading, film.settings.worn.mount)
        columns |= agreement.columns()
    write_columns_csv(out / "frames.csv", columns)
    write_footage(out, seen, 0, motion.fps)
    with progress.stage(DRAWING) as advance:
        film.finish(advance)
    print(f"{len(motion)} frames, {estimate.n_resets} resets by the fail-safe; written to {out}", flush=True)
    if reading is not None and agreement is not None:
        for note in reading.notes:
            print(f"note: {note}", flush=True)
        print(agreement.sentence, flush=True)
    return out


def warn_of_film(video: Path, body_parts: bool) -> None:
    """Say on standard error that a film is read by what was trained on rendered pictures alone."""
    if body_parts and not was_rendered(video):
        print(
            f"warning: {video} is a film, and the body-part estimator knows rendered pictures only: it takes pavements "
            "for bodies. sees=head_signal leaves it out",
            file=sys.stderr,
            flush=True,
        )


def allowed_planner(config: Mapping[str, Any]) -> AnyPlannerSettings | None:
    """The planner's settings by ``conf/estimate.yaml``; None for no planner.

    ``causal`` has no planner: its look-ahead is ``lookahead`` frames, and a planner's horizon is longer.

    Raises:
        InputError: a setting is missing or wrong.
    """
    settings = read_planner(config.get("planner"))
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


def estimate_video(values: Mapping[str, Any], foreseen: FilmProcess | None = None) -> Path:
    """From video to files, as ``conf/estimate.yaml`` (resolved) says: flow, regressor, policy.

    Args:
        values: resolved.
        foreseen: what already reads the film (:func:`~egopose.inference.film_process.foreseen_film`), which is left if
            the checkpoint asks for anything else. It is closed here.

    Returns:
        The folder of the results.

    Raises:
        InputError: the video, the run or a setting cannot be used; names it.
        RuntimeError: no OpenGL here.
    """
    with ExitStack() as stack:
        if foreseen is not None:
            stack.enter_context(foreseen)
        video = Path(str(values["video"]))
        out = video.with_name(f"{video.stem}_estimate") if values["out"] is None else Path(str(values["out"]))
        checkpoint = find_checkpoint(str(values["checkpoint"]), str(values["which"]))
        run = read_json(checkpoint, "config")
        require_estimation(run, checkpoint)
        humanoid = humanoid_of(run)
        regressor, source_config = load_regressor(run_folder(checkpoint) / "regressor")
        lookahead = allowed_lookahead(values)
        settings = FilmSettings.of(values, source_config, 1.0 / humanoid.control_dt)
        if settings.worn is not None:
            require_states_for_context(source_config)
        finder = load_body_part_estimator_of(source_config["regressor"])
        info = probe_video(video)
        seconds = info.frames / (settings.camera.fps or info.fps) - settings.offset
        planned = {} if allowed_planner(values) is None else _PLANNED
        progress = stack.enter_context(StageProgress({**_COSTS, **planned}, round(seconds * settings.fps)))
        if foreseen is not None and foreseen.settings == settings:
            film = foreseen
        else:
            film = stack.enter_context(FilmProcess(settings))
        with progress.stage(READING) as advance:
            rows = film.rows(advance)
        overrides, reading = None, None
        with progress.stage(SEEING):
            if settings.worn is not None:
                reading = read_states(humanoid, rows, video, settings.camera, settings.worn)
                seen = seen_in_film(humanoid, reading, regressor)
            else:
                warn_of_film(video, finder is not None)
                flow = np.stack([row[0] for row in rows])
                if finder is not None:
                    flow = with_body_parts(finder, [row[1] for row in rows if row[1] is not None], flow)
                if lookahead is None:
                    seen = seen_in(humanoid, regressor, flow, source_config)
                else:
                    causal = causal_regression(humanoid, regressor, source_config, run["task"], lookahead)
                    seen = seen_live(causal, regressor, flow, source_config)
                    # What is seen live is smoothed already.
                    overrides = {"task": {**run["task"], "action": {**run["task"]["action"], "smoothing": 0.0}}}
            dataset, pose_motion = video_dataset(humanoid, seen, video.stem)
            agent = load_agent(checkpoint, dataset, overrides=overrides)
        return run_estimate(values, agent, pose_motion, film, out, progress, reading)
