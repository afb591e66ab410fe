"""A live body that looks ahead: what its copies follow, what the clock cuts, policies that read the target's path."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from helpers.live_stand_in import untrained

from egopose.benchmarks import stream as bench
from egopose.core.config import compose_config
from egopose.core.torch_settings import torch_threads
from egopose.envs.problem import Followed, global_frame
from egopose.envs.target_window import TargetWindow
from egopose.envs.test_time import prepare_for_test
from egopose.envs.transforms import TrackingError, VisualContext
from egopose.inference.causal import CausalRegression, Seen
from egopose.inference.estimator import estimate_takes
from egopose.inference.failsafe import FailSafe, FailSafeSettings
from egopose.inference.planner import Planner
from egopose.inference.planner_settings import planner_settings
from egopose.inference.stream.build import ROWS, Trained
from egopose.inference.stream.live_body import LiveBody, LivePose
from egopose.inference.stream.live_rows import LiveRows
from egopose.inference.video_regression import causal_regression, video_dataset
from egopose.models.pose_regression import integrated_path
from egopose.pipeline.environment import build_env

LOOKAHEAD, FRAMES = 4, 9
NEVER = FailSafeSettings("off", 0.3, 0.3)
SMALL = {
    "samples": 24,
    "horizon": 3,
    "head": 0.0,
    "rounds": 2,
    "recovery_rounds": 0,
    "margin": 0.0,
    "tie_tolerance": 0.0,
    "acceleration": 0.0,
}


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    with torch_threads(1):
        yield


def seen_by(trained: Trained, frames: int = FRAMES, later: bool = True) -> list[Seen]:
    """What is known of each frame of a video of noise."""
    causal = causal_regression(
        trained.humanoid, trained.regressor, trained.source_config, trained.config["task"], LOOKAHEAD, later
    )
    features = torch.randn(frames, trained.regressor.context.feature_size, generator=torch.Generator().manual_seed(3))
    found = [causal.push(t, row) for t, row in enumerate(features)]
    return [*(row for row in found if row is not None), *causal.drain()]


def live(trained: Trained, clock: Callable[[], float] = lambda: 0.0, **changed: Any) -> tuple[LiveBody, Planner]:
    values = compose_config("stream", ["source=none", "checkpoint=none"])["planner"]
    settings = planner_settings({**values, **SMALL, **changed})
    assert settings is not None
    copies = trained.copies(settings.samples, 1)
    prepare_for_test(copies, trained.actor, trained.critic)
    still = Followed(trained.env.base_env.problem.states, global_frame)
    planner = Planner(copies, trained.actor, trained.critic, settings, still)
    body = LiveBody(trained.env, trained.actor, trained.critic, NEVER, planner=planner, copies=copies, clock=clock)
    return body, planner


def moved(body: LiveBody, seen: Sequence[Seen], deadline: float = math.inf) -> list[LivePose]:
    return [body.advance(row, deadline) for row in seen]


# --- what is known of later frames ------------------------------------------------------------------------------------


@pytest.mark.parametrize("smoothing", [0.0, 0.06])
def test_later_frames_are_told_as_clips_that_end_now_show_them(smoothing: float) -> None:
    trained = untrained(smoothing=smoothing)
    model, deviation = trained.regressor, smoothing / trained.humanoid.control_dt
    limits = torch.as_tensor(trained.humanoid.joint_range).float()
    features = torch.randn(FRAMES, model.context.feature_size)
    causal = CausalRegression(model, limits, LOOKAHEAD, smoothing=deviation, tells_later=True)
    plain = CausalRegression(model, limits, LOOKAHEAD, smoothing=deviation)
    with torch.no_grad():
        known = [model.from_features(features[None, : t + 1])["humanoid_state"][0] for t in range(FRAMES)]
    for newest, row in enumerate(features):
        seen, alone = causal.push(newest, row), plain.push(newest, row)
        if seen is None or alone is None:
            continue
        torch.testing.assert_close(seen.humanoid_state, alone.humanoid_state)
        torch.testing.assert_close(seen.joint_targets, alone.joint_targets)
        assert alone.later is None
        assert seen.later is not None
        assert len(seen.later.humanoid_state) == LOOKAHEAD
        for ahead, state in enumerate(seen.later.humanoid_state, 1):
            expected = known[newest][seen.frame + ahead]
            if smoothing:
                offsets = np.arange(-LOOKAHEAD, LOOKAHEAD + 1)
                weights = np.exp(-0.5 * (offsets / deviation) ** 2)
                near = np.clip(seen.frame + ahead + offsets, 0, newest)
                # Frames to come as they look now, those gone as they were given out.
                rows = [known[newest if k >= seen.frame else k + LOOKAHEAD][k] for k in near]
                expected = torch.from_numpy(weights / weights.sum() @ torch.stack(rows).numpy())
            torch.testing.assert_close(state, expected, atol=1e-5, rtol=0, check_dtype=False)


def test_rows_end_where_nothing_more_is_known_and_their_path_is_the_states_own() -> None:
    trained = untrained()
    now, following = seen_by(trained)[2:4]
    dt = trained.humanoid.control_dt
    root = torch.tensor([3.0, -1.0, 0.5], dtype=torch.float64)
    rows = LiveRows.of([now, following], 9, root, dt)
    assert following.later is not None
    known = torch.stack([now.humanoid_state, following.humanoid_state, *following.later.humanoid_state])
    assert len(known) == LOOKAHEAD + 2
    assert torch.equal(rows.humanoid_state[: len(known)], known)
    assert torch.equal(rows.humanoid_state[len(known) :], known[-1:].expand(9 - len(known), -1))
    assert rows.path is not None
    path = integrated_path(known.double().numpy(), 1 / dt)
    steps, apart = np.diff(path[:, :2], axis=0), np.diff(rows.path[: len(known), :2].numpy(), axis=0)
    turn = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    np.testing.assert_allclose(apart, steps @ turn, atol=1e-12)
    np.testing.assert_allclose(rows.path[0], root, atol=1e-12)
    np.testing.assert_allclose(rows.path[: len(known), 2], path[:, 2] + 0.5, atol=1e-12)
    assert LiveRows.of([now, following], 3, None, dt).path is None


def test_the_copies_read_the_same_rows_as_the_body() -> None:
    trained = untrained()
    body, planner = live(trained)
    seen = seen_by(trained)
    moved(body, seen[:3])
    copies = planner._env
    for env in (trained.env, copies):
        for part in env.transform:
            if isinstance(part, TrackingError):
                assert torch.equal(part.table[:2], torch.stack([row.humanoid_state for row in seen[1:3]]))
            if isinstance(part, VisualContext):
                assert torch.equal(part.table[1], seen[2].visual_context)
    assert any(isinstance(part, TrackingError) for part in copies.transform)
    assert seen[2].later is not None
    height = planner._followed["root_height"]
    torch.testing.assert_close(height[2 : 2 + LOOKAHEAD], seen[2].later.humanoid_state[:, 0].double())
    assert len(height) == ROWS


# --- time ------------------------------------------------------------------------------------------------------------


class Clock:
    """Passes a second each time it is asked."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 1.0
        return self.now


def test_where_the_time_is_up_the_plan_so_far_goes_on() -> None:
    trained = untrained()
    seen = seen_by(trained)
    body, planner = live(trained, Clock(), every=3)
    moved(body, seen[:2])
    assert planner._plan.any()
    value = planner.value.clone()
    # The plan is a frame old, and the next is due two frames later.
    moved(body, seen[2:4], -math.inf)
    assert body.plans == {"plans": 1, "plans_cut": 0, "plans_missed": 0}
    moved(body, seen[4:6], -math.inf)
    assert body.plans == {"plans": 3, "plans_cut": 0, "plans_missed": 2}, "tried again at the next frame"
    assert not planner._plan.any(), "a plan that is never renewed ends with the policy alone"
    assert torch.equal(planner.value, value)
    moved(body, seen[6:7])
    assert body.plans["plans_missed"] == 2
    assert not torch.equal(planner.value, value)


def test_a_plan_that_is_cut_is_the_plan_of_its_whole_rounds() -> None:
    """The clock is asked once a step: it lets three steps of the first round pass, and two of the second."""
    plans = []
    for rounds, deadline in ((1, math.inf), (2, 6.0), (2, math.inf)):
        trained = untrained()
        body, planner = live(trained, Clock(), rounds=rounds)
        seen = seen_by(trained)
        body.advance(seen[0])
        body.advance(seen[1], deadline)
        plans.append(planner._plan.clone())
        assert body.plans["plans_cut"] == (deadline == 6.0)
        assert body.plans["plans_missed"] == 0
    one, cut, two = plans
    assert torch.equal(one, cut)
    assert not torch.equal(one, two)


def test_looking_ahead_changes_the_motion_and_repeats_itself() -> None:
    runs = []
    for seed in (1, 1, 2):
        trained = untrained()
        body, _ = live(trained, seed=seed)
        runs.append(np.array([pose.qpos for pose in moved(body, seen_by(trained))]))
    assert np.isfinite(runs[0]).all()
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


# --- other policies --------------------------------------------------------------------------------------------------


def test_a_policy_with_a_context_of_its_own_is_planned_for() -> None:
    trained = untrained("paper", "estimation")
    body, planner = live(trained)
    assert np.isfinite([pose.qpos for pose in moved(body, seen_by(trained))]).all()
    assert planner.plans == FRAMES - 1


@pytest.mark.parametrize("triggers", [False, True])
def test_a_policy_that_reads_the_targets_path_moves_as_offline(triggers: bool) -> None:
    """A tracker before training, with one frame ahead: all that offline tables hold of it is known live."""
    trained = untrained("tracking", "tracking")
    with torch.no_grad():  # or what it reads would make no difference
        for weights in trained.actor.parameters():
            weights.add_(0.02 * torch.randn(weights.shape, generator=torch.Generator().manual_seed(7)))
    (window,) = (part for part in trained.env.transform if isinstance(part, TargetWindow))
    seen = seen_by(trained, later=False)
    states = torch.stack([row.humanoid_state for row in seen])
    rows = {name: torch.stack([getattr(row, name) for row in seen]) for name in ("visual_context", "joint_targets")}
    path = torch.from_numpy(integrated_path(states.double().numpy(), 1 / trained.humanoid.control_dt))
    dataset, _ = video_dataset(trained.humanoid, {**rows, "humanoid_state": states}, "noise", path)
    env = build_env(trained.config, dataset, "test", num_envs=1, whole_fragments=True, falls_end=False)
    env.transform.load_state_dict(trained.env.transform.state_dict())
    (offline_window,) = (part for part in env.transform if isinstance(part, TargetWindow))
    window._ahead = offline_window._ahead = np.array([1, 1, 1, 1])
    guard = FailSafeSettings("naive", 0.6, 9.0 if triggers else 0.0)  # higher than any head
    (offline,) = estimate_takes(env, trained.actor, trained.critic, states, FailSafe(1, guard))
    body = LiveBody(trained.env, trained.actor, trained.critic, guard)
    poses = moved(body, seen)
    assert [pose.reset for pose in poses] == offline.resets.tolist()
    assert offline.resets.any() == triggers
    np.testing.assert_allclose([pose.qpos for pose in poses], offline.qpos, atol=1e-6)


def test_a_tracker_is_planned_for_along_the_known_path() -> None:
    trained = untrained("tracking", "tracking")
    body, planner = live(trained)
    assert np.isfinite([pose.qpos for pose in moved(body, seen_by(trained))]).all()
    (window,) = (part for part in planner._env.transform if isinstance(part, TargetWindow))
    path = window._motion.followed().path
    assert path.shape == (ROWS, 3)
    assert path.abs().max() > 0


# --- the bench -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("soak", [False, True])
def test_the_bench_counts_resets_with_the_planner_and_without(monkeypatch: pytest.MonkeyPatch, soak: bool) -> None:
    told: list[dict[str, Any]] = []

    def measured(values: dict[str, Any], trained: Trained, forecaster: Any, progress: bool) -> dict[str, Any]:
        told.append(values)
        counts = {"poses": 900, "resets": 2 if values["planner"] else 21, "dropped": 0, "fps": 30.0, "seconds": 30.0}
        return {**counts, "stages": {"compute": {"p50_ms": 1.0}}}

    monkeypatch.setattr(bench, "_measured", measured)
    monkeypatch.setattr(bench, "untrained", lambda config: untrained())
    words = ["stream.source=a.mp4", "stream.seconds=15", "stream.server.port=0", *(["stream.pace=real_time"] * soak)]
    found = bench.run(words, 2)
    assert found["resets_per_minute"] == pytest.approx(4.0)
    assert found["alone_resets_per_minute"] == (None if soak else pytest.approx(42.0))
    paced = [values for values in told if values["pace"] == "real_time"]
    same = ("source", "seconds", "lookahead", "repeat")
    assert [[values[name] for name in same] for values in paced] == [["a.mp4", 30, 10, True]] * (1 if soak else 2)
    assert [bool(values["planner"]) for values in paced] == [True, False][: len(paced)]
