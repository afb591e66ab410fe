"""Live estimation: frames a second, latency by stage, late frames, memory."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egopose.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from egopose.humanoid.model import HumanoidModel
    from egopose.stream import Trained

_PREFIX = "stream."
_SECONDS = 20.0  # of a round, unless told: 600 frames, of which six are beyond the 99th percentile


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """A video as fast as it can be estimated from, then at a camera's pace for ``rounds`` times ``stream.seconds``.

    Without ``stream.checkpoint`` the networks are untrained (their weights' values cost nothing) and of the training
    configuration; without ``stream.source`` the video is the longest rendered take of its data, or of the run's.

    Args:
        overrides: ``stream.KEY=VALUE`` of ``conf/stream.yaml``, all others of the training configuration.
        rounds: see above.

    Returns:
        At full speed: ``fps``. At a camera's pace: ``p50_ms``, ``p95_ms``, ``p99_ms`` of a frame's computing,
        ``dropped`` (late frames), ``stages`` (percentiles of each stage; ``delay``: from a frame's arrival to the
        estimate it completes), ``paced_fps``, ``cores`` (processor time over time), the counts and memory of
        :meth:`egopose.inference.stream.loop.LiveLoop.status`. Beside them ``source``, ``policy``, ``vision``,
        ``substeps``.

    Raises:
        InputError: a setting is unknown or out of range, the source cannot be read.
    """
    from egopose.config import compose_config
    from egopose.stream import build_loop, load_trained, settle_memory, source_settings

    ours = [word.removeprefix(_PREFIX) for word in overrides if word.startswith(_PREFIX)]
    named = {word.split("=")[0] for word in ours}
    # What a command line has to say, a benchmark may leave open.
    values = compose_config("stream", [*(f"{key}=null" for key in {"source", "checkpoint"} - named), *ours])
    seconds = _SECONDS if values["seconds"] is None else values["seconds"]
    training = [word for word in overrides if not word.startswith(_PREFIX)]
    if values["checkpoint"] is None:
        trained = untrained(compose_config("train", training))
    elif training:
        raise InputError("bench stream", training[0], "a checkpoint brings its own configuration")
    else:
        trained = load_trained(str(values["checkpoint"]), str(values["which"]))
    source = longest_take(trained.config) if values["source"] is None else str(values["source"])
    values = {**values, "source": source, "repeat": True}

    def measured(pace: str, length: float) -> dict[str, Any]:
        chosen = {**values, "pace": pace, "seconds": length}
        loop = build_loop(chosen, trained, source_settings(chosen, trained.config))
        settle_memory()
        return loop.run(lambda pose, delay: None, lambda status: None)

    quick = measured("every", seconds)
    busy = time.process_time()
    paced = measured("real_time", seconds * rounds)
    compute = paced["stages"].get("compute")
    if compute is None:
        raise InputError("bench stream", "stream.seconds", f"{seconds}: too short for a single frame")
    return {
        "fps": quick["fps"],
        **compute,
        "dropped": paced["dropped"],
        "stages": paced["stages"],
        "paced_fps": paced["fps"],
        "cores": (time.process_time() - busy) / paced["seconds"],
        **{key: value for key, value in paced.items() if key not in ("dropped", "stages", "fps")},
        "source": Path(source).name,
        "policy": "untrained" if values["checkpoint"] is None else str(values["checkpoint"]),
        "vision": str(trained.made_with["vision"]["encoder"]["kind"]),
        "substeps": trained.humanoid.substeps,
        "processors": len(os.sched_getaffinity(0)),
    }


def longest_take(config: Mapping[str, Any]) -> str:
    """The wearer's video of the longest take of a configuration's data, rendered where that has not been done."""
    from egopose.data.preparation import prepare

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
    import torch

    from egopose.data.preparation import humanoid_of, prepare
    from egopose.envs.mdp.observations import humanoid_state

    torch.manual_seed(0)
    states = humanoid_state(prepare(config, progress=False, flow=False).reference).float()
    return untrained_on(config, humanoid_of(config), states)


def untrained_on(config: Mapping[str, Any], humanoid: HumanoidModel, states: Tensor) -> Trained:
    """As :func:`untrained`, with a regressor that knows the mean and spread of ``states [F, S]``; draws random weights.

    Raises:
        InputError: a setting is wrong.
    """
    from egopose.config import from_mapping
    from egopose.pipeline import build_env, build_networks
    from egopose.stream import Trained, two_frames
    from egopose.training.fragments import Span
    from egopose.training.regressor_settings import RegressorSettings
    from egopose.training.supervised import build_regressor
    from egopose.vision.encoders import build_encoder

    encoder = build_encoder(config["vision"]["encoder"])
    settings = from_mapping(RegressorSettings, config["regressor"], "conf/regressor")
    regressor = build_regressor(encoder, states, [Span(0, len(states))], settings, encoder.features).eval()
    made_with = {"vision": config["vision"], "regressor": config["regressor"]}
    material = two_frames(humanoid, regressor, made_with)
    env = build_env(config, material, "test", worlds=1, whole_fragments=True, falls_end=False)
    actor, critic = build_networks(config, material, env)
    return Trained(humanoid, regressor, made_with, env, actor.eval(), critic.eval(), config)
