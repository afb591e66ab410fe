"""What ``egopose evaluate`` does with policies of a reconstruction: each acts out its clip, and is compared with it.

Yu, Park & Lee 2021, section 6.2: the error of the joints against the clip's poses (equation 16) and how often contacts
are as they should be. The clip's own root is a guess, so poses are compared with their roots put together.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from egopose.core.atomic_write import write_text_whole
from egopose.core.errors import InputError
from egopose.data.preparation import humanoid_of
from egopose.envs.starts import Piece
from egopose.evaluation import position_metrics
from egopose.evaluation.reports import rollout_report
from egopose.inference.clip_rollout import ClipRollout, after, joined, roll_out, until
from egopose.inference.reconstruction import PAGE
from egopose.inference.scene_values import window_value
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.pipeline.agent import Agent
from egopose.scene.clip import Clip
from egopose.scene.fitting import changed_scene, fit_parameters
from egopose.scene.scene_file import FREE, write_scene
from egopose.tasks.reconstruction import ClipDataset, ranges_of, touches_of, window_of

MOTION, FIGURES, SCENE, FIT = "simulated.npz", "figures.json", "scene_by_values.yaml", "scene_fit.json"


def figures_of(rollout: ClipRollout, dataset: ClipDataset) -> dict[str, Any]:
    """Figures of a rollout against its clip.

    Returns:
        ``frames``; ``survived``, frames until an ending, and ``ended`` by each; ``reward``, the mean of a step, and
        ``terms``; ``mpjpe`` (roots together) and ``pa_mpjpe``, mm; ``contact_accuracy`` of feet and of hands, %.
    """
    clip, humanoid = dataset.clip, dataset.humanoid
    assert clip is not None
    frames, first = len(rollout.motion), rollout.first
    shown_now = slice(first, first + frames)
    motion = Motion(humanoid.skeleton, rollout.motion.qpos, clip.body.fps)
    made, shown = motion.forward_kinematics()[0], clip.body.forward_kinematics()[0][shown_now]
    wanted = touches_of(clip, humanoid).numpy()[shown_now][1:].any(axis=-1)
    right = rollout.touched.any(axis=-1) == wanted
    return {
        "frames": frames,
        "survived": rollout.survived,
        "ended": dict(rollout.ended),
        "reward": float(rollout.rewards.mean()),
        "terms": {name: float(values.mean()) for name, values in rollout.terms.items()},
        "mpjpe": 1e3 * float(position_metrics.mpjpe_root_aligned(made, shown).mean()),
        "pa_mpjpe": 1e3 * float(position_metrics.mpjpe_procrustes(made, shown).mean()),
        "contact_accuracy": {
            "feet": 100.0 * float(np.mean(right[:, :2])),
            "hands": 100.0 * float(np.mean(right[:, 2:])),
        },
    }


def run_reconstruction(
    values: Mapping[str, Any], agents: Sequence[Agent], names: Sequence[str], videos: Sequence[Any], out: Path
) -> str:
    """Let each agent act out its clip, and leave the motions and their figures in ``out``.

    Returns:
        What the terminal shows.
    """
    lines = []
    threads = int(values["threads"])
    for number, agent in enumerate(agents):
        fragment = agent.dataset.train[0]
        rollout = _acted_out(agent, Piece(0, fragment.start, fragment.stop), threads)
        window = agent.config["task"]["window"] is not None
        lines.append(_kept(rollout, agent, out if len(agents) == 1 else out / str(number), until_it_ends=window))
    if len(agents) > 1:
        lines.append("one after the other:\n" + _kept(one_after_the_other(agents, threads), agents[0], out))
    fit = fitted_scene(agents, out)
    return "\n".join([*lines, *([] if fit is None else [fit])])


def write_rollout_page(out: Path, agents: Sequence[Agent]) -> Path:
    """The page of the motion that :func:`run_reconstruction` left in ``out``, beside it.

    Raises:
        InputError: the motion is of a part of the clip alone, or a file of the clip's folder is missing.
    """
    config = agents[0].config
    return rollout_report(Path(str(config["task"]["clip"])), humanoid_of(config), out / MOTION, out / PAGE)


def one_after_the_other(agents: Sequence[Agent], threads: int) -> ClipRollout:
    """The clip by the policies of its windows, each from the state in which the one before hands over.

    Raises:
        InputError: they are not the policies of one clip's windows from the first on, in their order.
    """
    clip = _clip_of(agents)
    rollouts: list[ClipRollout] = []
    for number, agent in enumerate(agents, start=1):
        if agent.config["task"]["window"] != number:
            cause = f"is {agent.config['task']['window']}: checkpoints must be those of windows 1, 2, ... in order"
            raise InputError(agent.path, "task.window", cause)
        window = window_of(agent.config, clip)
        stop = window.stop if number == len(agents) else window.hand_over + 1
        state = (rollouts[-1].motion.qpos[-1], rollouts[-1].motion.qvel[-1]) if rollouts else None
        rollouts.append(_acted_out(agent, Piece(0, window.start, stop), threads, state))
    return joined(rollouts)


def _acted_out(agent: Agent, piece: Piece, threads: int, state: tuple[Array, Array] | None = None) -> ClipRollout:
    env = agent.make_env(num_envs=1, threads=threads, whole_fragments=True, falls_end=False, fragments=[piece])
    rollout = roll_out(env, agent.actor, piece, state)
    env.close()
    return rollout


def _kept(rollout: ClipRollout, agent: Agent, folder: Path, until_it_ends: bool = False) -> str:
    """Leave motion and figures in ``folder``; lines for the terminal.

    With ``until_it_ends`` the motion is cut where an ending would have ended it: the next window's policy begins in its
    states.
    """
    folder.mkdir(parents=True, exist_ok=True)
    assert isinstance(agent.dataset, ClipDataset)
    figures, plan = figures_of(rollout, agent.dataset), agent.dataset.plan
    motion = rollout.motion if plan is None else after(rollout, plan)
    if until_it_ends:
        motion = until(motion, rollout.first + rollout.survived)
    motion.save(folder / MOTION)
    write_text_whole(folder / FIGURES, json.dumps(figures, indent=1))
    return f"{summary(figures)}\nmotion: {folder / MOTION}"


def _clip_of(agents: Sequence[Agent]) -> Clip:
    """Raises InputError: the agents are not of one clip."""
    for agent in agents:
        if agent.config["task"]["clip"] != agents[0].config["task"]["clip"]:
            raise InputError(agent.path, "task.clip", "is another clip than that of the first checkpoint")
    assert isinstance(agents[0].dataset, ClipDataset)
    assert agents[0].dataset.clip is not None
    return agents[0].dataset.clip


def fitted_scene(agents: Sequence[Agent], out: Path) -> str | None:
    """The scene that the value networks of the agents' windows like best, left in ``out``; a line that tells of it.

    None where nothing of the scene is free, or a policy was trained among boxes that stand still.

    Raises:
        InputError: the agents are not of one clip.
    """
    clip = _clip_of(agents)
    ranges = ranges_of(clip.scene)
    if not ranges.size or not all(agent.config["task"]["scene"]["vary"] for agent in agents):
        return None
    values = []
    for agent in agents:
        window = window_of(agent.config, clip)
        hands_over = window.hand_over < len(clip)
        values.append(window_value(agent, ranges, window.start, window.hand_over if hands_over else None))
    fit = fit_parameters(values, ranges.size)
    change = ranges.change_of(torch.from_numpy(fit.parameters))
    tops, headings = ranges.changed(change)
    out.mkdir(parents=True, exist_ok=True)
    write_scene(changed_scene(clip.scene, tops.numpy(), headings.numpy()), out / SCENE)
    names = [f"{box.name}.{name}" for box in clip.scene.boxes for name in FREE if _spans(box.free.get(name))]
    changes = dict(zip(names, change[ranges.free].tolist(), strict=True))
    told = {name: value.tolist() if hasattr(value, "tolist") else value for name, value in vars(fit).items()}
    write_text_whole(out / FIT, json.dumps({"changes": changes, **told}, indent=1))
    gained = f"{fit.gains.sum():.2f}, {fit.guessed.sum():.2f} as guessed"
    each = ", ".join(f"{name} {value:+.2f}" for name, value in changes.items())
    return f"scene by the values ({gained}): {each}\nscene: {out / SCENE}"


def _spans(span: tuple[float, float] | None) -> bool:
    return span is not None and span[1] > span[0]


def summary(figures: Mapping[str, Any]) -> str:
    """A few lines for the terminal."""
    ended = ", ".join(f"{name} at frame {at}" for name, at in figures["ended"].items() if at is not None)
    accuracy = figures["contact_accuracy"]
    return (
        f"frames until an ending: {figures['survived']} of {figures['frames']} ({ended or 'none ends it'})\n"
        f"reward of a step: {figures['reward']:.3f}\n"
        f"MPJPE, roots together: {figures['mpjpe']:.1f} mm; PA-MPJPE: {figures['pa_mpjpe']:.1f} mm\n"
        f"contact accuracy: feet {accuracy['feet']:.1f} %, hands {accuracy['hands']:.1f} %"
    )
