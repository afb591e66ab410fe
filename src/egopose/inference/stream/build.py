"""``python -m egopose.stream source=0|VIDEO|ADDRESS|take:NAME checkpoint=RUN``: motion, live, and forecasts of it."""

from __future__ import annotations

import contextlib
import gc
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv

from egopose.checkpoint.checkpoint import find_checkpoint, read_json
from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.data.preparation import humanoid_of, store_folder
from egopose.data.store import TakeStore
from egopose.envs.problem import Followed, global_frame
from egopose.envs.test_time import prepare_for_test
from egopose.humanoid.model import HumanoidModel
from egopose.inference.causal import CausalRegression
from egopose.inference.failsafe import FailSafeSettings
from egopose.inference.planner import Planner
from egopose.inference.planner_settings import PlannerSettings, planner_settings
from egopose.inference.planners import planned_threshold
from egopose.inference.stream import live_forecasts, loop
from egopose.inference.stream.forecasting import ForecastThread
from egopose.inference.stream.frame_features import FrameFeatures
from egopose.inference.stream.frame_sources import ReconnectSettings, SourceSettings, check_source
from egopose.inference.stream.latency import LatencyTable
from egopose.inference.stream.live_body import LiveBody
from egopose.inference.stream.live_forecasts import ForecastSettings, LiveFutures, Moment
from egopose.inference.stream.loop import LiveLoop, LoopSettings
from egopose.inference.stream.outputs import check_outputs, open_outputs
from egopose.inference.video_regression import causal_regression, run_folder, seen_in, video_dataset
from egopose.models.regressor import StateRegressor
from egopose.pipeline.agent import load_agent
from egopose.pipeline.forecaster import ForecastCurves, still_forecasts
from egopose.pipeline.regressor import load_regressor
from egopose.pipeline.regressor_input import body_part_estimator_name, load_body_part_estimator_of, planes_of
from egopose.tasks.dataset import Dataset
from egopose.tasks.imitation import WINDOW
from egopose.tasks.task import task_name, task_of
from egopose.vision.flow import FlowConfig
from egopose.vision.lens import Camera

_CONFIG = "conf/stream.yaml"
#: Frames of a live body's take: the present one, the next, and look-aheads or horizons of up to a second.
ROWS = 32


@dataclass(frozen=True)
class Trained:
    """What a run brings to a stream.

    Args:
        humanoid: the run's.
        regressor: in eval mode.
        source_config: the groups ``vision`` and ``regressor``.
        env: one world, on a take of :data:`ROWS` frames.
        copies: of that environment, for a planner: of so many worlds, with so many threads of physics.
        actor, critic: in eval mode.
        config: of the run, resolved.
    """

    humanoid: HumanoidModel
    regressor: StateRegressor
    source_config: Mapping[str, Any]
    env: TransformedEnv
    copies: Callable[[int, int], TransformedEnv]
    actor: TensorDictModuleBase
    critic: TensorDictModuleBase
    config: Mapping[str, Any]


def load_trained(checkpoint: str, which: str) -> Trained:
    """A run's networks, ready for a stream.

    Raises:
        InputError: it cannot be used; names the field.
    """
    folder = find_checkpoint(checkpoint, which)
    config = read_json(folder, "config")
    humanoid = humanoid_of(config)
    regressor, source_config = load_regressor(run_folder(folder) / "regressor")
    agent = load_agent(folder, still_frames(humanoid, regressor, source_config, ROWS))

    def made(worlds: int, threads: int) -> TransformedEnv:
        return agent.make_env("test", num_envs=worlds, threads=threads, whole_fragments=True, falls_end=False)

    return Trained(humanoid, regressor, source_config, made(1, 1), made, agent.actor, agent.critic, config)


@dataclass(frozen=True)
class Forecaster:
    """What a forecasting run brings to a stream.

    Args:
        env: ``1 + drawn futures`` worlds, on a take of still frames.
        actor, regressor: in eval mode.
        seen: planes and both sides of what its encoder sees of a frame.
        settings: of the stream's forecasts.
        curves: of a policy that follows kinematic forecasts.
    """

    env: TransformedEnv
    actor: TensorDictModuleBase
    regressor: StateRegressor
    seen: tuple[int, int, int]
    settings: ForecastSettings
    curves: ForecastCurves | None = None


def forecast_settings(values: Mapping[str, Any]) -> ForecastSettings:
    """The group ``forecast`` of ``conf/stream.yaml``, resolved.

    Raises:
        InputError: a value that cannot be.
    """
    beside = ("checkpoint", "which", "out")
    chosen = {name: value for name, value in values["forecast"].items() if name not in beside}
    return from_mapping(ForecastSettings, chosen, f"{_CONFIG}: forecast")


def load_forecaster(values: Mapping[str, Any], trained: Trained) -> Forecaster | None:
    """The forecasting policy ``forecast.checkpoint`` names, for the body of ``trained``; None where it names none.

    Raises:
        InputError: it cannot be used, or is of another body or another flow than the estimating run's.
    """
    settings, checkpoint = forecast_settings(values), values["forecast"]["checkpoint"]
    if checkpoint is None:
        return None
    folder = find_checkpoint(str(checkpoint), str(values["forecast"]["which"]))
    config = read_json(folder, "config")
    follows = config.get("forecaster") is not None
    if task_of(config).protocol != "forecasts" or not (follows or config["model"]["context"]["source"] == "past"):
        cause = "a live forecast is one of `egopose train experiment=forecasting`, or one that follows a forecast"
        cause += "; name such a run, or null for none"
        raise InputError(folder, "task", f"this run's is {task_name(config)}: {cause}")
    humanoid = humanoid_of(config)
    if humanoid.skeleton != trained.humanoid.skeleton or humanoid.control_dt != trained.humanoid.control_dt:
        raise InputError(folder, "humanoid", "another body than the estimating run's: train both with one humanoid")
    regressor, source_config = load_regressor(run_folder(folder) / "regressor")
    flows = ({**dict(made["vision"]["flow"]), "workers": 1} for made in (source_config, trained.source_config))
    if len({tuple(sorted(flow.items())) for flow in flows}) > 1:
        raise InputError(folder, "vision.flow", "another flow than the estimating run's: train both with one vision")
    if body_part_estimator_name(source_config["regressor"]) != body_part_estimator_name(
        trained.source_config["regressor"]
    ):
        cause = "another body-part estimator than the estimating run's: train both with one regressor"
        raise InputError(folder, "regressor.kernel.body_parts", cause)
    frames = (task_of(config).context(config) or 0) + int(config["task"]["minimum"])
    dataset = still_frames(humanoid, regressor, source_config, frames)
    curves = None
    if follows:
        dataset = still_forecasts(config, dataset)
        curves = ForecastCurves(config, dataset, run_folder(folder))
    agent = load_agent(folder, dataset)
    env = agent.make_env("test", num_envs=1 + settings.drawn, threads=1, whole_fragments=True, falls_end=False)
    size = int(source_config["vision"]["flow"]["stored_size"])
    seen = (planes_of(source_config["regressor"]), size, size)
    return Forecaster(env, agent.actor, regressor, seen, settings, curves)


def still_frames(
    humanoid: HumanoidModel, regressor: StateRegressor, source_config: Mapping[str, Any], frames: int
) -> Dataset:
    """The dataset of a take of still frames: what an environment needs to be made before anything is seen.

    Its path stands still as well.
    """
    size = int(source_config["vision"]["flow"]["stored_size"])
    still = np.zeros((frames, planes_of(source_config["regressor"]), size, size), np.float16)
    seen, path = seen_in(humanoid, regressor, still, source_config), torch.zeros(frames, 3, dtype=torch.float64)
    return video_dataset(humanoid, seen, "stream", path)[0]


def build_loop(
    values: Mapping[str, Any], trained: Trained, source: SourceSettings, forecaster: Forecaster | None = None
) -> LiveLoop:
    """The loop of ``conf/stream.yaml``, resolved, on a run's networks, with forecasts beside it where there are any.

    Raises:
        InputError: a setting is wrong.
    """
    least_of = {
        "threads": 1,
        "opencv_threads": 1,
        "physics_threads": 1,
        "lookahead": 0,
        "bridge": 0,
        "latency_frames": 1,
    }
    for name, least in least_of.items():
        if not isinstance(values[name], int) or values[name] < least:
            raise InputError(_CONFIG, name, f"must be a whole number of at least {least}, not {values[name]!r}")
    torch.set_num_threads(values["threads"])
    cv2.setNumThreads(values["opencv_threads"])
    planned = planner_settings(values["planner"])
    failsafe = from_mapping(FailSafeSettings, values["failsafe"], f"{_CONFIG}: failsafe")
    failsafe = failsafe.for_run(trained.config, planned_threshold(planned))
    limits = {name: values[name] for name in ("seconds", "bridge", "plan_until")}
    if values["pace"] == "every":  # no frame is late
        limits["plan_until"] = None
    settings = from_mapping(LoopSettings, limits, _CONFIG)
    flow = FlowConfig(**dict(trained.source_config["vision"]["flow"]))
    camera = Camera.from_mapping(values["camera"], "camera")
    rate = 1.0 / trained.humanoid.control_dt
    latency = LatencyTable(loop.STAGES, values["latency_frames"])
    copies = None if planned is None else trained.copies(planned.samples, values["physics_threads"])

    def parts(lap: Callable[[str], None]) -> tuple[FrameFeatures, CausalRegression, LiveBody]:
        """As at the start: nothing seen yet."""
        finder = load_body_part_estimator_of(trained.source_config["regressor"])
        return (
            FrameFeatures(trained.regressor, flow, camera, rate, finder),
            live_regression(trained, values["lookahead"], planned),
            live_body(trained, failsafe, planned, copies, lap),
        )

    warm_up(*parts(lambda stage: None))
    beside = None if forecaster is None else _forecasts(values, forecaster, failsafe.fallen_height, rate)
    return LiveLoop(source, *parts(latency.lap), latency, rate, settings, beside)


def live_regression(trained: Trained, lookahead: int, planned: PlannerSettings | None) -> CausalRegression:
    """The run's regressor, frame by frame; it tells of the look-ahead where a planner or the policy asks for it."""
    asked = planned is not None or WINDOW in trained.config["model"]["inputs"]
    task = trained.config["task"]
    return causal_regression(trained.humanoid, trained.regressor, trained.source_config, task, lookahead, asked)


def live_body(
    trained: Trained,
    failsafe: FailSafeSettings,
    planned: PlannerSettings | None,
    copies: TransformedEnv | None,
    lap: Callable[[str], None] = lambda stage: None,
) -> LiveBody:
    """The run's body, nothing seen yet, and its planner with ``copies`` of its environment; see :class:`LiveBody`."""
    env, actor, critic = trained.env, trained.actor, trained.critic
    if planned is None or copies is None:
        return LiveBody(env, actor, critic, failsafe, lap)
    prepare_for_test(copies, actor, critic)
    followed = Followed(env.base_env.problem.states, global_frame)
    return LiveBody(env, actor, critic, failsafe, lap, Planner(copies, actor, critic, planned, followed), copies)


def _forecasts(values: Mapping[str, Any], forecaster: Forecaster, fallen_height: float, rate: float) -> ForecastThread:
    """The thread, not yet begun, whose parts have done their work once."""
    settings = forecaster.settings
    every = max(round(settings.every * rate), 1)
    capacity = max(values["latency_frames"] // every, 1)
    latency = LatencyTable(live_forecasts.STAGES, capacity, ("forecast", "forecast_delay"))

    made = forecaster
    futures = LiveFutures(made.env, made.actor, made.regressor, settings, fallen_height, made.curves)
    humanoid = forecaster.env.base_env.problem.humanoid
    still = np.zeros((futures.context, *forecaster.seen), np.float32)
    standing = humanoid.skeleton.rest_qpos()
    standing[2] = 1.0
    futures.roll(Moment(0, standing, np.zeros(humanoid.mj_model.nv), still, time.perf_counter()))
    return ForecastThread(futures, every, values["lookahead"], latency, values["pace"] == "every")


def warm_up(sight: FrameFeatures, regression: CausalRegression, body: LiveBody) -> None:
    """Let all parts do their work on a still picture: the first time takes a hundred times as long."""
    still = np.zeros((64, 64, 3), np.uint8)
    poses = frame = 0
    while poses < 3:
        seen = regression.push(frame, sight.features(sight.flow(still, frame / 30)))
        frame += 1
        if seen is not None:
            body.advance(seen)
            poses += 1


def source_settings(values: Mapping[str, Any], config: Mapping[str, Any] | None = None) -> SourceSettings:
    """What ``source`` names; ``take:NAME`` is the rendered video of a take in the store of a run's ``config``.

    Raises:
        InputError: no such take or file, a file that is no video, an address of an unknown kind.
    """
    given = {name: values[name] for name in ("pace", "repeat", "offset")}
    given["reconnect"] = from_mapping(ReconnectSettings, values["reconnect"], f"{_CONFIG}: reconnect")
    given["fps"] = Camera.from_mapping(values["camera"], "camera").fps
    settings = from_mapping(SourceSettings, {**given, "source": str(values["source"])}, _CONFIG)
    if settings.source.startswith("take:"):
        if config is None:
            return settings
        path, offset = take_video(config, settings.source.removeprefix("take:"))
        settings = replace(settings, source=str(path), offset=settings.offset + offset)
    check_source(settings)
    return settings


def take_video(config: Mapping[str, Any], name: str) -> tuple[Path, float]:
    """The video of a take in the store of a run's ``config``, and its sync offset (s).

    Raises:
        InputError: the store is not prepared or has no such take; names what there is.
    """
    store = TakeStore.open(store_folder(config))
    names = [take.name for take in store.takes]
    if name not in names:
        raise InputError("stream", "source", f"no take {name!r}; there are {', '.join(names)}")
    number = names.index(name)
    return store.video(number), store.takes[number].sync_offset


def stream(values: Mapping[str, Any], stop: threading.Event | None = None) -> dict[str, Any]:
    """The whole way of ``conf/stream.yaml``, resolved, until the source ends or ``stop`` is set.

    Returns:
        The last status, see :meth:`LiveLoop.status`.

    Raises:
        InputError: source, run or setting cannot be used; names it.
    """
    check_outputs(values)
    source_settings(values)
    trained = load_trained(str(values["checkpoint"]), str(values["which"]))
    forecaster = load_forecaster(values, trained)
    source = source_settings(values, trained.config)
    loop = build_loop(values, trained, source, forecaster)
    with contextlib.ExitStack() as stack:
        forecast = None if forecaster is None else forecaster.settings
        sinks = open_outputs(values, trained.humanoid, source, forecast, stack)
        settle_memory()
        last = loop.run(sinks.on_pose, sinks.on_status, stop, sinks.on_forecast)
        sinks.on_status({**last, "end": True})
    return last


def settle_memory() -> None:
    """What was loaded stays: the collector need not walk over it while frames come."""
    gc.collect()
    gc.freeze()


def print_report(status: Mapping[str, Any]) -> None:
    """Counts and the latency table, to standard output."""
    counts = ["poses", "used", "dropped", "surplus", "bridged", "lost", "resets", "reconnects"]
    counts += ["plans", "plans_cut", "plans_missed", "forecasts", "forecasts_skipped"]
    words = (f"{status[name]} {name.replace('_', ' ')}" for name in counts)
    print(f"{status['seconds']:.1f} s, " + ", ".join(words))
    print(f"{'stage':16s} {'p50 ms':>8s} {'p95 ms':>8s} {'p99 ms':>8s}")
    for stage, row in status["stages"].items():
        print(f"{stage:16s} " + " ".join(f"{row[key]:8.2f}" for key in ("p50_ms", "p95_ms", "p99_ms")))
