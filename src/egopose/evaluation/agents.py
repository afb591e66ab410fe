"""A trained agent on whole fragments: its estimates, PoseReg's, and the figures of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torchrl.envs import TransformedEnv

from egopose.core.errors import InputError
from egopose.core.torch_settings import torch_threads
from egopose.data.fragments import FragmentLike
from egopose.envs.test_time import Controller
from egopose.evaluation.live_run import live_estimates
from egopose.evaluation.protocols import ContactSettings, TakeScores, score_take
from egopose.evaluation.resets import TakeTriggers, as_dict, take_triggers
from egopose.inference.counterfactuals import CounterfactualRollouts
from egopose.inference.estimator import Estimate, estimate_takes, restart_path
from egopose.inference.failsafe import FailSafe, FailSafeSettings
from egopose.inference.planners import AnyPlannerSettings, build_planner, planned_threshold
from egopose.models.pose_regression import pose_regression
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.pipeline.agent import Agent
from egopose.training.survival import base_tracking, frames_survived, reference_tracking

SHORTEST = 4  # frames that every metric needs
_PLANNED_TOGETHER = 4  # fragments: with 64 copies each enough to keep the physics' threads busy


@dataclass(frozen=True)
class FragmentResult:
    """One fragment: what was true, what the policy and what PoseReg made of it, and the figures of all three.

    ``triggers`` are the fail-safe's, judged; None where that was not asked for.
    """

    fragment: FragmentLike
    reference: Motion
    estimate: Estimate
    motion: Motion
    pose_regression: Motion
    scores: TakeScores
    pose_regression_scores: TakeScores
    reference_scores: TakeScores
    triggers: TakeTriggers | None = None


def evaluate_agent(
    agent: Agent,
    fragments: Sequence[FragmentLike],
    names: Sequence[str],
    split: str,
    failsafe: FailSafeSettings,
    contact: ContactSettings,
    threads: int,
    window: int | None = None,
    planner: AnyPlannerSettings | None = None,
    lookahead: int | None = None,
) -> list[FragmentResult]:
    """Estimate every fragment in one pass, all side by side, and score it beside PoseReg.

    Args:
        agent: see :func:`egopose.pipeline.agent.load_agent`.
        fragments: those of ``split``, in the dataset's order.
        names: one a fragment.
        split: ``test`` or ``train``.
        failsafe: when the humanoid restarts.
        contact: when a sole stands.
        threads: of the physics.
        window: frames after a trigger within which the body must have fallen without it; None to judge no triggers.
        planner: how the body looks ahead; None for the policy alone.
        lookahead: frames that a live stream sees ahead, to estimate as it does, one fragment after the other; no
            trigger is judged then. None: every frame sees the whole take.

    Raises:
        InputError: there are no regressed states, or a fragment is shorter than 4 frames.
    """
    dataset = agent.dataset
    if dataset.states is None:
        raise InputError(agent.path, "regressor", "the policy starts from the state regressor, and there is none")
    for fragment, name in zip(fragments, names, strict=True):
        if fragment.stop - fragment.start < SHORTEST:
            raise InputError(name, "length", f"{fragment.stop - fragment.start} frames; metrics need {SHORTEST}")
    estimates: Sequence[Estimate]
    triggers: Sequence[TakeTriggers | None]
    if lookahead is not None:
        estimates = live_estimates(agent, fragments, failsafe, lookahead, threads, planner)
        triggers = [None] * len(estimates)
    else:
        estimates, triggers = estimate_and_judge(agent, len(fragments), split, failsafe, threads, window, planner)
    return [
        _result(agent, fragment, name, estimate, contact, judged)
        for fragment, name, estimate, judged in zip(fragments, names, estimates, triggers, strict=True)
    ]


def estimate_and_judge(
    agent: Agent,
    num_envs: int,
    split: str,
    failsafe: FailSafeSettings,
    threads: int,
    window: int | None,
    planner: AnyPlannerSettings | None = None,
) -> tuple[list[Estimate], Sequence[TakeTriggers | None]]:
    """Estimates of the first ``num_envs`` fragments of ``split``, and the fail-safe's triggers, judged.

    Other arguments as of :func:`evaluate_agent`.
    """
    dataset = agent.dataset
    fragments = list(dataset.train if split == "train" else dataset.test)[:num_envs]
    by_length = sorted(range(num_envs), key=lambda i: fragments[i].stop - fragments[i].start)
    # All worlds are stepped until the longest fragment ends, and with a planner each has dozens of copies: those of
    # like length go together.
    groups = [list(range(num_envs))]
    if planner is not None:
        groups = [by_length[at : at + _PLANNED_TOGETHER] for at in range(0, num_envs, _PLANNED_TOGETHER)]
    estimates: dict[int, Estimate] = {}
    triggers: dict[int, TakeTriggers | None] = {}
    for group in groups:
        chosen = [fragments[i] for i in group]
        with torch_threads(1):
            result, judged = _together(agent, chosen, split, failsafe, threads, window, planner)
        estimates |= dict(zip(group, result, strict=True))
        triggers |= dict(zip(group, judged, strict=True))
    return [estimates[i] for i in range(num_envs)], [triggers[i] for i in range(num_envs)]


def _together(
    agent: Agent,
    fragments: Sequence[FragmentLike],
    split: str,
    failsafe: FailSafeSettings,
    threads: int,
    window: int | None,
    planner: AnyPlannerSettings | None,
) -> tuple[list[Estimate], Sequence[TakeTriggers | None]]:
    """:func:`estimate_and_judge` of these fragments, in one pass."""
    worlds = len(fragments)

    def make_env(count: int) -> TransformedEnv:
        options = {"threads": threads, "whole_fragments": True, "falls_end": False}
        return agent.make_env(split, num_envs=count, fragments=fragments, **options)

    env, counterfactuals = make_env(worlds), CounterfactualRollouts()
    guard, states = (
        FailSafe(worlds, failsafe.for_run(agent.config, planned_threshold(planner))),
        agent.followed_states(),
    )
    ahead = None
    if planner is not None:
        ahead = build_planner(make_env(worlds * planner.samples), agent.actor, agent.critic, planner)
    restart = restart_path(failsafe.restart, env, ahead)
    estimates = estimate_takes(
        env,
        agent.actor,
        agent.critic,
        states,
        guard,
        counterfactuals=counterfactuals,
        planner=ahead,
        restart=restart,
    )
    env.close()
    if ahead is not None:
        ahead.close()
    if window is None:
        return estimates, [None] * worlds
    to_fall: list[dict[int, int | None]] = [{} for _ in estimates]
    falls = counterfactuals.frames_to_fall(make_env, agent.actor, window)
    for (world, frame), frames in zip(counterfactuals.places, falls, strict=True):
        to_fall[world][frame - estimates[world].start] = frames
    return estimates, [take_triggers(e, result, window) for e, result in zip(estimates, to_fall, strict=True)]


def _result(
    agent: Agent,
    fragment: FragmentLike,
    name: str,
    estimate: Estimate,
    contact: ContactSettings,
    triggers: TakeTriggers | None,
) -> FragmentResult:
    humanoid, rows = agent.dataset.humanoid, slice(estimate.start, estimate.start + len(estimate.qpos))
    fps = 1.0 / humanoid.control_dt
    truth: Array = torch.as_tensor(agent.dataset.reference["qpos"][rows]).double().numpy()
    assert agent.dataset.states is not None
    regressed = pose_regression(
        agent.dataset.states[rows].numpy(),
        humanoid.skeleton,
        truth[0, :2],
        rot.heading(truth[0, 3:7]),
        fps,
        humanoid.joint_range,
        name,
    )
    return FragmentResult(
        fragment,
        Motion(humanoid.skeleton, truth, fps, name),
        estimate,
        estimate.motion(humanoid, name),
        regressed,
        score_take(name, estimate.qpos, truth, humanoid, contact, estimate.n_resets),
        score_take(name, regressed.qpos, truth, humanoid, contact),
        score_take(name, truth, truth, humanoid, contact),
        triggers,
    )


def failsafe_figures(results: Sequence[FragmentResult], settings: FailSafeSettings, window: int) -> dict[str, Any]:
    """A run's fail-safe for JSON: mode, reset_threshold and window, and :func:`egopose.evaluation.resets.as_dict` of it
    all."""
    judged = [(one.motion.name, one.triggers) for one in results if one.triggers is not None]
    names, takes = [name for name, _ in judged], [result for _, result in judged]
    about = {"mode": settings.mode, "reset_threshold": settings.reset_threshold, "window_frames": window}
    return about | as_dict(names, takes, results[0].motion.fps)


def survival_figures(
    agent: Agent, start_policy: Controller, split: str, num_envs: int, seed: int, threads: int
) -> dict[str, dict[str, float]]:
    """Frames until a fall of the policy and of what it must beat, all from the same starts on the reference.

    ``policy``: the mean action. ``start_policy``: the networks before any training. ``base_tracking``: PD towards what
    actions are added to, without a policy. ``reference_tracking``: PD towards the true motion's own joint angles.
    The last two only where actions are targets of PD controllers.

    Args:
        agent: see :func:`egopose.pipeline.agent.load_agent`.
        start_policy: an actor as training found it.
        split: ``test`` or ``train``.
        num_envs: episodes.
        seed: of the starts.
        threads: of the physics.

    Returns:
        ``{controller: {"frames": mean frames survived, "fell": share of episodes}}``.
    """
    env = agent.make_env(split, num_envs=num_envs, threads=threads)
    controllers: dict[str, Controller] = {"policy": agent.actor, "start_policy": start_policy}
    if env.base_env.problem.actions_move_targets:
        controllers |= {"base_tracking": base_tracking(env), "reference_tracking": reference_tracking(env)}
    out = {}
    for name, controller in controllers.items():
        survival = frames_survived(env, controller, seed)
        out[name] = {"frames": survival.mean, "fell": float(survival.fell.double().mean())}
    env.close()
    return out
