"""Live estimation: frames a second, latency by stage, late frames, memory."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import TransformedEnv

from egopose.core.config import compose_config, from_mapping
from egopose.core.errors import InputError
from egopose.data.preparation import humanoid_of, prepare
from egopose.data.spans import Span
from egopose.envs.mdp.observations import humanoid_state
from egopose.humanoid.model import HumanoidModel
from egopose.inference.stream.build import (
    ROWS,
    Forecaster,
    Trained,
    build_loop,
    forecast_settings,
    load_forecaster,
    load_trained,
    settle_memory,
    source_settings,
    still_frames,
)
from egopose.inference.stream.outputs import open_outputs
from egopose.models.regressor_settings import RegressorSettings
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks
from egopose.pipeline.regressor_input import planes_of
from egopose.tasks.task import task_of
from egopose.training.regressor import build_regressor
from egopose.vision.encoders import build_encoder

_PREFIX = "stream."
_SECONDS = 20.0  # of a round, unless told: 600 frames, of which six are beyond the 99th percentile
_TELL_EVERY = 60.0  # s


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """A video as fast as it can be estimated from, then at a camera's pace for ``rounds`` times ``stream.seconds``.

    Without ``stream.checkpoint`` the networks are untrained (their weights' values cost nothing) and of the training
    configuration; without ``stream.source`` the video is the longest rendered take of its data, or of the run's.
    ``stream.forecast.checkpoint=untrained`` puts forecasts beside it, by untrained networks of ``task=forecasting``.
    With a planner the policy alone then does the same at a camera's pace, so that resets can be compared.
    A soak, ``stream.pace=real_time``, leaves the first part and the last one out: it costs what a live camera costs.
    Each minute's memory is then told on standard error.

    Results go nowhere, but for what is named: ``stream.out``, ``stream.forecast.out``, and ``stream.server.port``,
    which is read along by a client of each kind.

    Args:
        overrides: ``stream.KEY=VALUE`` of ``conf/stream.yaml``, all others of the training configuration.
        rounds: see above.

    Returns:
        At full speed: ``fps``, and of a soak as ``paced_fps``. At a camera's pace: ``p50_ms``, ``p95_ms``, ``p99_ms``
        of a frame's computing, ``dropped`` (late frames), ``stages`` (percentiles of each stage; ``delay``: from a
        frame's arrival to the estimate it completes), ``resets_per_minute`` of estimated motion, the same of the policy
        alone as ``alone_resets_per_minute`` (None where nothing plans, and of a soak), ``paced_fps``, ``cores``
        (processor time over time), the counts and memory of
        :meth:`egopose.inference.stream.loop.LiveLoop.status`. Beside them ``source``, ``policy``, ``vision``,
        ``substeps``.

    Raises:
        InputError: a setting is unknown or out of range, the source cannot be read.
    """
    ours = [word.removeprefix(_PREFIX) for word in overrides if word.startswith(_PREFIX)]
    named = {word.split("=")[0] for word in ours}
    # What a command line has to say, a benchmark may leave open.
    values = compose_config(
        "stream", [*(f"{key}=null" for key in {"source", "checkpoint", "server.port"} - named), *ours]
    )
    seconds = _SECONDS if values["seconds"] is None else values["seconds"]
    training = [word for word in overrides if not word.startswith(_PREFIX)]
    if values["checkpoint"] is None:
        trained = untrained(compose_config("train", training))
    elif training:
        raise InputError("bench stream", training[0], "a checkpoint brings its own configuration")
    else:
        trained = load_trained(str(values["checkpoint"]), str(values["which"]))
    if values["forecast"]["checkpoint"] == "untrained":
        forecaster: Forecaster | None = untrained_forecaster(values, trained)
    else:
        forecaster = load_forecaster(values, trained)
    source = longest_take(trained.config) if values["source"] is None else str(values["source"])
    soak = "pace" in named and values["pace"] == "real_time"
    values = {**values, "source": source, "repeat": True}

    quick = None if soak else _measured({**values, "pace": "every", "seconds": seconds}, trained, forecaster, False)
    busy = time.process_time()
    paced = _measured({**values, "pace": "real_time", "seconds": seconds * rounds}, trained, forecaster, soak)
    cores = (time.process_time() - busy) / paced["seconds"]
    alone = None
    if values["planner"] and not soak:
        lone = {"planner": None, "out": None, "server": {**values["server"], "port": None}}
        without = {**values, **lone, "pace": "real_time", "seconds": seconds * rounds}
        alone = _resets_per_minute(_measured(without, trained, None, False), trained.humanoid)
    compute = paced["stages"].get("compute")
    if compute is None:
        raise InputError("bench stream", "stream.seconds", f"{seconds}: too short for a single frame")
    return {
        "fps": (quick or paced)["fps"],
        **compute,
        "dropped": paced["dropped"],
        "stages": paced["stages"],
        "paced_fps": paced["fps"],
        "resets_per_minute": _resets_per_minute(paced, trained.humanoid),
        "alone_resets_per_minute": alone,
        "cores": cores,
        **{key: value for key, value in paced.items() if key not in ("dropped", "stages", "fps")},
        "source": Path(source).name,
        "policy": "untrained" if values["checkpoint"] is None else str(values["checkpoint"]),
        "forecasts_by": str(values["forecast"]["checkpoint"]),
        "vision": str(trained.source_config["vision"]["encoder"]["kind"]),
        "substeps": trained.humanoid.substeps,
        "processors": len(os.sched_getaffinity(0)),
    }


def _measured(
    values: Mapping[str, Any], trained: Trained, forecaster: Forecaster | None, progress: bool
) -> dict[str, Any]:
    """The last status of one stream."""
    source = source_settings(values, trained.config)
    loop = build_loop(values, trained, source, forecaster)
    reported = 0.0
    with contextlib.ExitStack() as stack:
        forecast = None if forecaster is None else forecaster.settings
        sinks = open_outputs(values, trained.humanoid, source, forecast, stack)
        if sinks.port is not None:
            _listen(f"ws://{values['server']['host']}:{sinks.port}", values["server"]["token"])

        def on_status(status: dict[str, Any]) -> None:
            nonlocal reported
            sinks.on_status(status)
            if progress and status["seconds"] - reported >= _TELL_EVERY:
                reported = status["seconds"]
                counts = f"{status['used']} frames, {status['dropped']} dropped, {status['forecasts']} forecasts"
                memory = float("nan") if status["rss_mb"] is None else status["rss_mb"]
                print(f"{reported:.0f} s, {counts}, {memory:.1f} MB", file=sys.stderr, flush=True)

        settle_memory()
        return loop.run(sinks.on_pose, on_status, None, sinks.on_forecast)


def _resets_per_minute(status: Mapping[str, Any], humanoid: HumanoidModel) -> float | None:
    """Of the motion that was given out; None if there is none."""
    minutes = status["poses"] * humanoid.control_dt / 60.0
    return status["resets"] / minutes if minutes else None


def _listen(server: str, token: str | None) -> None:
    """A client of each kind that reads along until the server closes."""
    from websockets.exceptions import WebSocketException
    from websockets.sync.client import connect

    def read(kind: str) -> None:
        address = f"{server}/{kind}" + (f"?token={token}" if token else "")
        with contextlib.suppress(OSError, WebSocketException), connect(address, proxy=None, max_size=None) as client:
            for _ in client:
                pass

    for kind in ("json", "binary"):
        threading.Thread(target=read, args=(kind,), daemon=True).start()


def longest_take(config: Mapping[str, Any]) -> str:
    """The wearer's video of the longest take of a configuration's data, rendered where that has not been done."""
    store = prepare(config, progress=False, flow=False)
    longest = max(range(len(store.takes)), key=lambda i: store.takes[i].length)
    if not store.video(longest).is_file():
        store = prepare(config)
    return str(store.video(longest))


def untrained(config: Mapping[str, Any]) -> Trained:
    """Networks of a training configuration as they are before training; the regressor knows its data's mean state.

    Raises:
        InputError: a setting is wrong, or the data cannot be used.
    """
    torch.manual_seed(0)
    states = humanoid_state(prepare(config, progress=False, flow=False).reference).float()
    return untrained_on(config, humanoid_of(config), states)


def untrained_on(config: Mapping[str, Any], humanoid: HumanoidModel, states: Tensor) -> Trained:
    """As :func:`untrained`, with a regressor that knows the mean and spread of ``states [F, S]``; draws random weights.

    Raises:
        InputError: a setting is wrong.
    """
    encoder = build_encoder(config["vision"]["encoder"])
    settings = from_mapping(RegressorSettings, config["regressor"], "conf/regressor")
    regressor = build_regressor(encoder, states, [Span(0, len(states))], settings, encoder.features).eval()
    source_config = {"vision": config["vision"], "regressor": config["regressor"]}
    dataset = still_frames(humanoid, regressor, source_config, ROWS)

    def made(worlds: int, threads: int) -> TransformedEnv:
        options: dict[str, Any] = {"whole_fragments": True, "falls_end": False}
        return build_env(config, dataset, "test", num_envs=worlds, threads=threads, **options)

    env = made(1, 1)
    actor, critic = build_networks(config, dataset, env)
    return Trained(humanoid, regressor, source_config, env, made, actor.eval(), critic.eval(), config)


def untrained_forecaster(values: Mapping[str, Any], trained: Trained) -> Forecaster:
    """A forecasting policy before training that sees through ``trained``'s own encoder, on its kind of physics.

    Args:
        values: ``conf/stream.yaml``, resolved.
        trained: whose body is forecast.

    Raises:
        InputError: a setting is wrong.
    """
    settings = forecast_settings(values)
    config = compose_config("train", ["experiment=forecasting"])
    config = {**config, **{group: trained.config[group] for group in ("sim", "humanoid")}}
    frames = (task_of(config).context(config) or 0) + int(config["task"]["minimum"])
    dataset = still_frames(trained.humanoid, trained.regressor, trained.source_config, frames)
    worlds = 1 + settings.drawn
    env = build_env(config, dataset, "test", num_envs=worlds, whole_fragments=True, falls_end=False)
    actor, _ = build_networks(config, dataset, env)
    size = int(trained.source_config["vision"]["flow"]["stored_size"])
    seen = (planes_of(trained.source_config["regressor"]), size, size)
    return Forecaster(env, actor.eval(), trained.regressor, seen, settings)
