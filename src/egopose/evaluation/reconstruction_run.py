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
from egopose.envs.starts import Piece
from egopose.evaluation import position_metrics
from egopose.inference.clip_rollout import ClipRollout, after, roll_out
from egopose.inference.scene_values import window_value
from egopose.motion.motion import Motion
from egopose.pipeline.agent import Agent
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
    if values["report"]:
        raise InputError("conf/evaluate.yaml", "report", "there is no such page of a reconstruction")
    lines = []
    for number, agent in enumerate(agents):
        folder = out if len(agents) == 1 else out / str(number)
        folder.mkdir(parents=True, exist_ok=True)
        assert isinstance(agent.dataset, ClipDataset)
        fragment, plan = agent.dataset.train[0], agent.dataset.plan
        piece = Piece(0, fragment.start, fragment.stop)
        env = agent.make_env(
            num_envs=1, threads=int(values["threads"]), whole_fragments=True, falls_end=False, fragments=[piece]
        )
        rollout = roll_out(env, agent.actor, piece)
        env.close()
        figures = figures_of(rollout, agent.dataset)
        motion = rollout.motion if plan is None else after(rollout, plan)
        motion.save(folder / MOTION)
        write_text_whole(folder / FIGURES, json.dumps(figures, indent=1))
        lines.append(summary(figures) + f"\nmotion: {folder / MOTION}")
    fit = fitted_scene(agents, out)
    return "\n".join([*lines, *([] if fit is None else [fit])])


def fitted_scene(agents: Sequence[Agent], out: Path) -> str | None:
    """The scene that the value networks of the agents' windows like best, left in ``out``; a line that tells of it.

    None where nothing of the scene is free, or a policy was trained among boxes that stand still.

    Raises:
        InputError: the agents are not of one clip.
    """
    datasets = [agent.dataset for agent in agents]
    clip = datasets[0].clip if isinstance(datasets[0], ClipDataset) else None
    assert clip is not None
    if len({str(agent.config["task"]["clip"]) for agent in agents}) > 1:
        raise InputError(agents[1].path, "task.clip", "is another clip than that of the first checkpoint")
    ranges = ranges_of(clip.scene)
    if not ranges.size or not all(agent.config["task"]["scene"]["vary"] for agent in agents):
        return None
    values = []
    for agent in agents:
        window = window_of(agent.config, clip)
        last = agent.dataset.train[0].stop - 1
        values.append(window_value(agent, ranges, window.start, min(window.hand_over, last)))
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
