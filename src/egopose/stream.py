"""``python -m egopose.stream source=0|VIDEO|ADDRESS|take:NAME checkpoint=RUN [out=MOTION.npz]``: motion, live."""

from __future__ import annotations

from egopose.runtime import prepare_runtime

prepare_runtime()

import contextlib  # noqa: E402
import gc  # noqa: E402
import signal  # noqa: E402
import sys  # noqa: E402
import threading  # noqa: E402
from collections.abc import Callable, Mapping  # noqa: E402
from dataclasses import dataclass, replace  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

from omegaconf import DictConfig  # noqa: E402

from egopose.config import command, from_mapping, resolved  # noqa: E402
from egopose.errors import InputError  # noqa: E402

if TYPE_CHECKING:
    from tensordict.nn import TensorDictModuleBase
    from torchrl.envs import TransformedEnv

    from egopose.humanoid.model import HumanoidModel
    from egopose.inference.causal import CausalRegression
    from egopose.inference.stream.body import LiveBody, LivePose
    from egopose.inference.stream.loop import LiveLoop, PoseSink, StatusSink
    from egopose.inference.stream.sight import Sight
    from egopose.inference.stream.sources import SourceSettings
    from egopose.material import Material
    from egopose.models.regressor import StateRegressor

_CONFIG = "conf/stream.yaml"


@dataclass(frozen=True)
class Trained:
    """What a run brings to a stream.

    Args:
        humanoid: the run's.
        regressor: in eval mode.
        made_with: the groups ``vision`` and ``regressor``.
        env: one world, on a take of two frames.
        actor, critic: in eval mode.
        config: of the run, resolved.
    """

    humanoid: HumanoidModel
    regressor: StateRegressor
    made_with: Mapping[str, Any]
    env: TransformedEnv
    actor: TensorDictModuleBase
    critic: TensorDictModuleBase
    config: Mapping[str, Any]


def load_trained(checkpoint: str, which: str) -> Trained:
    """A run's networks, ready for a stream.

    Raises:
        InputError: it cannot be used; names the field.
    """
    from egopose.data.preparation import humanoid_of
    from egopose.estimate import run_folder
    from egopose.pipeline import load_agent
    from egopose.regression import load_regressor
    from egopose.training.checkpoint import find_checkpoint, read_json

    folder = find_checkpoint(checkpoint, which)
    config = read_json(folder, "config")
    humanoid = humanoid_of(config)
    regressor, made_with = load_regressor(run_folder(folder) / "regressor")
    agent = load_agent(folder, two_frames(humanoid, regressor, made_with))
    env = agent.make_env("test", worlds=1, threads=1, whole_fragments=True, falls_end=False)
    return Trained(humanoid, regressor, made_with, env, agent.actor, agent.critic, config)


def two_frames(humanoid: HumanoidModel, regressor: StateRegressor, made_with: Mapping[str, Any]) -> Material:
    """The material of a take of two still frames: what an environment needs to be made before anything is seen."""
    import numpy as np

    from egopose.estimate import seen_in, video_material

    size = int(made_with["vision"]["flow"]["stored_size"])
    still = np.zeros((2, 2, size, size), np.float16)
    return video_material(humanoid, seen_in(humanoid, regressor, still, made_with), "stream")[0]


def build_loop(values: Mapping[str, Any], trained: Trained, source: SourceSettings) -> LiveLoop:
    """The loop of ``conf/stream.yaml``, resolved, on a run's networks.

    Raises:
        InputError: a setting is wrong.
    """
    import cv2
    import torch

    from egopose.estimate import causal_regression
    from egopose.inference.failsafe import FailSafeSettings
    from egopose.inference.stream.body import LiveBody
    from egopose.inference.stream.latency import LatencyTable
    from egopose.inference.stream.loop import STAGES, LiveLoop, LoopSettings
    from egopose.inference.stream.sight import Sight
    from egopose.vision.flow import FlowConfig

    for name, least in (("threads", 1), ("opencv_threads", 1), ("lookahead", 0), ("bridge", 0), ("latency_frames", 1)):
        if not isinstance(values[name], int) or values[name] < least:
            raise InputError(_CONFIG, name, f"must be a whole number of at least {least}, not {values[name]!r}")
    torch.set_num_threads(values["threads"])
    cv2.setNumThreads(values["opencv_threads"])
    failsafe = from_mapping(FailSafeSettings, values["failsafe"], f"{_CONFIG}: failsafe").for_run(trained.config)
    limits = {name: values[name] for name in ("seconds", "bridge")}
    settings = from_mapping(LoopSettings, limits, _CONFIG)
    flow = FlowConfig(**dict(trained.made_with["vision"]["flow"]))
    latency = LatencyTable(STAGES, values["latency_frames"])

    def parts(lap: Callable[[str], None]) -> tuple[Sight, CausalRegression, LiveBody]:
        """As at the start: nothing seen yet."""
        task, lookahead = trained.config["task"], values["lookahead"]
        return (
            Sight(trained.regressor, flow),
            causal_regression(trained.humanoid, trained.regressor, trained.made_with, task, lookahead),
            LiveBody(trained.env, trained.actor, trained.critic, failsafe, lap),
        )

    warm_up(*parts(lambda stage: None))
    return LiveLoop(source, *parts(latency.lap), latency, 1.0 / trained.humanoid.control_dt, settings)


def warm_up(sight: Sight, regression: CausalRegression, body: LiveBody) -> None:
    """Let all parts do their work on a still picture: the first time takes a hundred times as long."""
    import numpy as np

    still = np.zeros((64, 64, 3), np.uint8)
    poses = frame = 0
    while poses < 3:
        seen = regression.push(frame, sight.features(sight.flow(still)))
        frame += 1
        if seen is not None:
            body.advance(seen)
            poses += 1


def source_settings(values: Mapping[str, Any], config: Mapping[str, Any] | None = None) -> SourceSettings:
    """What ``source`` names; ``take:NAME`` is the rendered video of a take in the store of a run's ``config``.

    Raises:
        InputError: no such take or file, a file that is no video, an address of an unknown kind.
    """
    from egopose.inference.stream.sources import SourceSettings, check_source

    given = {name: values[name] for name in ("pace", "repeat", "offset")}
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
    from egopose.data.preparation import store_folder
    from egopose.data.store import TakeStore

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
    from egopose.inference.stream.broadcast import ServerSettings

    server = from_mapping(ServerSettings, values["server"], f"{_CONFIG}: server")
    source_settings(values)
    trained = load_trained(str(values["checkpoint"]), str(values["which"]))
    source = source_settings(values, trained.config)
    loop = build_loop(values, trained, source)
    fps = 1.0 / trained.humanoid.control_dt
    with contextlib.ExitStack() as stack:
        on_pose, on_status = _outputs(values, server, trained, source, fps, stack)
        settle_memory()
        last = loop.run(on_pose, on_status, stop)
        on_status({**last, "end": True})
    return last


def settle_memory() -> None:
    """What was loaded stays: the collector need not walk over it while frames come."""
    gc.collect()
    gc.freeze()


def _outputs(
    values: Mapping[str, Any],
    server: Any,
    trained: Trained,
    source: SourceSettings,
    fps: float,
    stack: contextlib.ExitStack,
) -> tuple[PoseSink, StatusSink]:
    """What the loop tells its poses and status; closed by ``stack``."""
    from egopose.inference.stream import messages
    from egopose.inference.stream.broadcast import Broadcast
    from egopose.inference.stream.recording import Recording

    skeleton, recording, broadcast = trained.humanoid.skeleton, None, None
    if values["out"] is not None:
        recording = Recording(Path(str(values["out"])), skeleton, fps)
        stack.callback(recording.close)
    if server.port is not None:
        broadcast = Broadcast(server, messages.hello(skeleton, fps, int(values["lookahead"]), source.source))
        stack.callback(broadcast.close)
        print(f"ws://{server.host}:{broadcast.port}/json and /binary", flush=True)

    def on_pose(pose: LivePose, delay_ms: float) -> None:
        if recording is not None:
            recording.pose(pose)
        if broadcast is not None and (kinds := broadcast.kinds):
            text = messages.frame_json(pose, fps, delay_ms) if False in kinds else None
            binary = messages.frame_binary(pose, fps, delay_ms) if True in kinds else None
            broadcast.send(text, binary)

    def on_status(status: dict[str, Any]) -> None:
        if broadcast is not None:
            broadcast.send(messages.status({**status, "clients_dropped": broadcast.dropped}))

    return on_pose, on_status


def print_report(status: Mapping[str, Any]) -> None:
    """Counts and the latency table, to standard output."""
    counts = ("poses", "used", "dropped", "surplus", "bridged", "lost", "resets")
    print(f"{status['seconds']:.1f} s, " + ", ".join(f"{status[name]} {name}" for name in counts))
    print(f"{'stage':10s} {'p50 ms':>8s} {'p95 ms':>8s} {'p99 ms':>8s}")
    for stage, row in status["stages"].items():
        print(f"{stage:10s} " + " ".join(f"{row[key]:8.2f}" for key in ("p50_ms", "p95_ms", "p99_ms")))


@command("stream")
def main(config: DictConfig) -> None:
    """Hydra's entry."""
    stop = threading.Event()
    # Not an exception out of nowhere: what was seen so far is to be written whole.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        print_report(stream(resolved(config), stop))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
