"""Live estimation gives what the causal estimate gives offline, in bounded memory, however late it is."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.live_stand_in import untrained, write_walk
from helpers.video_run import run, settings  # noqa: F401  # a fixture
from torch import nn

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.core.torch_settings import torch_threads
from egopose.inference.causal import CausalRegression, Seen
from egopose.inference.estimator import estimate_takes
from egopose.inference.failsafe import FailSafe, FailSafeSettings
from egopose.inference.stream.build import Trained, build_loop, source_settings, stream
from egopose.inference.stream.live_body import LiveBody, LivePose
from egopose.inference.video import estimate_video
from egopose.inference.video_regression import causal_regression, seen_live, video_dataset
from egopose.motion.io import read_motion
from egopose.pipeline.environment import build_env
from egopose.vision.features import extract_flow

FRAMES, LOOKAHEAD = 40, 10


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    with torch_threads(1):
        yield


def settings_of(**changed: Any) -> dict[str, Any]:
    words = ["source=none", "checkpoint=none", "server.port=null", "planner=none"]
    return {**compose_config("stream", words), **changed}


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "walk.mp4", FRAMES)


def flow_of(trained: Trained, video: Path) -> np.ndarray:
    return extract_flow(video, trained.source_config["vision"]["flow"])


@pytest.mark.parametrize("smoothing", [0.0, 2.0])
def test_a_frame_is_seen_with_its_look_ahead_and_no_more(smoothing: float) -> None:
    trained = untrained()
    model, frames = trained.regressor, 35
    features = torch.randn(frames, model.context.feature_size)
    limits = torch.as_tensor(trained.humanoid.joint_range).float()
    causal = CausalRegression(model, limits, LOOKAHEAD, smoothing=smoothing)
    found = [causal.push(t, row) for t, row in enumerate(features)]
    rows = [*(row for row in found if row is not None), *causal.drain()]
    assert [row.frame for row in rows] == list(range(frames))
    assert found[:LOOKAHEAD] == [None] * LOOKAHEAD

    # All frames as clips that end with each of them show them.
    with torch.no_grad():
        known = [model.from_features(features[None, : t + 1])["humanoid_state"][0] for t in range(frames)]
    ends = [min(t + LOOKAHEAD, frames - 1) for t in range(frames)]
    for t, row in enumerate(rows):
        expected = known[ends[t]][t]
        if smoothing:
            offsets = np.arange(-LOOKAHEAD, LOOKAHEAD + 1)
            weights = np.exp(-0.5 * (offsets / smoothing) ** 2)
            near = np.clip(t + offsets, 0, frames - 1)
            # Frames to come as they look now, those gone as they were given out.
            values = torch.stack([known[min(ends[k], ends[t])][k] for k in near]).numpy()
            expected = torch.from_numpy(weights / weights.sum() @ values)
        np.testing.assert_allclose(row.humanoid_state, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("model", "task", "cross_fit", "smoothing"),
    [("fast", "residual", 1, 0.0), ("fast", "residual", 4, 0.06), ("paper", "estimation", 1, 0.0)],
)
def test_the_body_moves_as_offline(walk: Path, model: str, task: str, cross_fit: int, smoothing: float) -> None:
    trained = untrained(model, task, cross_fit, smoothing)
    causal = causal_regression(
        trained.humanoid, trained.regressor, trained.source_config, trained.config["task"], LOOKAHEAD
    )
    seen = seen_live(causal, trained.regressor, flow_of(trained, walk), trained.source_config)
    dataset, _ = video_dataset(trained.humanoid, seen, "walk")
    action = {**trained.config["task"]["action"], "smoothing": 0.0}
    config = {**trained.config, "task": {**trained.config["task"], "action": action}}
    # Values about 1 that any small drop makes unstable: the body is reset now and then.
    guard = FailSafeSettings("value", 0.999, 0.3)
    with torch.no_grad():
        [part for part in trained.critic.modules() if isinstance(part, nn.Linear)][-1].bias.fill_(1.0)
    env = build_env(config, dataset, "test", num_envs=1, whole_fragments=True, falls_end=False)
    # The live environment has met nothing else than the offline one: both normalise by what they were trained with.
    env.transform.load_state_dict(trained.env.transform.state_dict())
    for network in (trained.actor, trained.critic):
        for part in network.modules():
            if hasattr(part, "features_table"):
                part.features_table, part.take_bounds = dataset.visual_features, torch.tensor([[0, FRAMES]])
    (offline,) = estimate_takes(
        env, trained.actor, trained.critic, dataset.states, FailSafe(1, guard), lookahead=LOOKAHEAD
    )

    body = LiveBody(trained.env, trained.actor, trained.critic, guard)
    poses = []
    for t in range(FRAMES):
        window = seen["visual_features"][t : t + LOOKAHEAD + 1]
        row = (seen[key][t] for key in ("visual_context", "humanoid_state", "joint_targets"))
        poses.append(body.advance(Seen(t, window, *row)))
    assert [pose.reset for pose in poses] == offline.resets.tolist()
    assert 0 < offline.n_resets < FRAMES - 1
    if model == "fast":
        np.testing.assert_array_equal([pose.qpos for pose in poses], offline.qpos)
    else:
        # Its contexts are computed frame by frame here: rounding, which contacts amplify.
        np.testing.assert_allclose([pose.qpos for pose in poses[:15]], offline.qpos[:15], atol=1e-5)
    np.testing.assert_allclose([pose.value for pose in poses[1:16]], offline.value[:15], rtol=1e-4, atol=1e-5)
    assert not body.guard.confidence


def test_a_file_streams_as_it_is_estimated(run: Path, tmp_path: Path) -> None:  # noqa: F811
    video = write_walk(tmp_path / "walk.mp4", FRAMES)
    out = tmp_path / "live.npz"
    chosen = settings_of(source=str(video), checkpoint=str(run), which="latest", pace="every", out=str(out))
    last = stream(chosen)
    assert last["poses"] == last["used"] == FRAMES
    assert last["dropped"] == last["bridged"] == last["lost"] == 0
    assert last["stages"]["compute"]["p50_ms"] > 0
    live = read_motion(out)
    assert not out.with_name("live.npz.part").exists()
    try:
        offline = estimate_video(settings(video, run, causal=True, out=str(tmp_path / "offline")))
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    expected = read_motion(offline / "estimate.npz")
    assert len(live) == len(expected) == FRAMES
    # Encoded one at a time and in batches: rounding, which contacts amplify.
    np.testing.assert_allclose(live.qpos[:8], expected.qpos[:8], atol=1e-5)


def test_features_and_what_is_seen_are_the_offline_ones(walk: Path) -> None:
    trained = untrained()
    chosen = settings_of(source=str(walk), pace="every")
    loop = build_loop(chosen, trained, source_settings(chosen))
    rows: list[Seen] = []
    regression = loop._regression
    advance = loop._body.advance
    loop._body.advance = lambda seen, deadline=0.0: rows.append(seen) or advance(seen)  # type: ignore[method-assign]
    poses: list[LivePose] = []
    loop.run(lambda pose, delay: poses.append(pose), lambda status: None)
    causal = causal_regression(
        trained.humanoid, trained.regressor, trained.source_config, trained.config["task"], LOOKAHEAD
    )
    offline = seen_live(causal, trained.regressor, flow_of(trained, walk), trained.source_config)
    assert len(rows) == len(poses) == FRAMES
    assert not regression.pending
    np.testing.assert_allclose(torch.stack([r.window[0] for r in rows]), offline["visual_features"], atol=1e-5)
    for key in ("visual_context", "humanoid_state", "joint_targets"):
        np.testing.assert_allclose(torch.stack([getattr(r, key) for r in rows]), offline[key], atol=1e-5)


def test_late_frames_are_skipped_and_nothing_piles_up(walk: Path) -> None:
    trained = untrained()
    chosen = settings_of(source=str(walk), repeat=True, seconds=3.0, latency_frames=16, bridge=2)
    loop = build_loop(chosen, trained, source_settings(chosen))
    poses: list[LivePose] = []
    longest = 0

    def slow(pose: LivePose, delay_ms: float) -> None:
        nonlocal longest
        poses.append(pose)
        longest = max(longest, len(loop._regression.pending) + len(loop._body.guard.confidence))
        time.sleep(0.25 if len(poses) == 5 else 0.03)

    last = loop.run(slow, lambda status: None)
    assert last["dropped"] > 5
    assert last["bridged"] > 5
    assert last["lost"] > 0
    assert longest <= LOOKAHEAD + 1
    assert loop.latency._rows.shape[0] == 16
    frames = [pose.frame for pose in poses]
    assert frames == sorted(set(frames))
    # In step with time: control frames passed, not pictures seen. What is not there yet is the look-ahead.
    passed = last["used"] + last["bridged"] + last["lost"]
    # Frames jumped over within the last look-ahead push the last pose back by as many.
    assert passed - 1 - LOOKAHEAD - last["lost"] <= frames[-1] <= passed - 1 - LOOKAHEAD
    assert passed > 1.5 * last["used"]


def test_a_stop_from_outside_ends_it_at_once(walk: Path) -> None:
    trained = untrained()
    chosen = settings_of(source=str(walk), repeat=True)
    loop = build_loop(chosen, trained, source_settings(chosen))
    stop = threading.Event()
    told: list[dict[str, Any]] = []
    poses: list[int] = []

    def third(pose: LivePose, delay_ms: float) -> None:
        poses.append(pose.frame)
        if len(poses) == 3:
            stop.set()

    loop.run(third, told.append, stop)  # of a source that never ends
    assert len(poses) <= 3 + LOOKAHEAD + 1
    json.dumps(told, allow_nan=False)


def test_what_cannot_be_used_is_named(run: Path, tmp_path: Path) -> None:  # noqa: F811
    trained = untrained()
    video = write_walk(tmp_path / "walk.mp4", 3)
    with pytest.raises(InputError, match="lookahead"):
        build_loop(settings_of(lookahead=-1), trained, source_settings(settings_of(source=str(video))))
    with pytest.raises(InputError, match="does not exist"):
        stream(settings_of(source=str(video), checkpoint=str(run / "nothing")))
    with pytest.raises(InputError, match=r"out: is written as \.npz"):
        stream(settings_of(source=str(video), checkpoint=str(run), out="motion.bvh"))
