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

from egopose.core.atomic_write import write_text_whole
from egopose.core.errors import InputError
from egopose.envs.starts import Piece
from egopose.evaluation import position_metrics
from egopose.inference.clip_rollout import ClipRollout, roll_out
from egopose.motion.motion import Motion
from egopose.pipeline.agent import Agent
from egopose.tasks.reconstruction import ClipDataset, touches_of

MOTION, FIGURES = "simulated.npz", "figures.json"


def figures_of(rollout: ClipRollout, dataset: ClipDataset) -> dict[str, Any]:
    """Figures of a rollout against its clip.

    Returns:
        ``frames``; ``survived``, frames until an ending, and ``ended`` by each; ``reward``, the mean of a step, and
        ``terms``; ``mpjpe`` (roots together) and ``pa_mpjpe``, mm; ``contact_accuracy`` of feet and of hands, %.
    """
    clip, humanoid = dataset.clip, dataset.humanoid
    assert clip is not None
    frames = len(rollout.motion)
    motion = Motion(humanoid.skeleton, rollout.motion.qpos, clip.body.fps)
    made, shown = motion.forward_kinematics()[0], clip.body.forward_kinematics()[0][:frames]
    wanted = touches_of(clip, humanoid).numpy()[1:frames].any(axis=-1)
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
        whole = Piece(0, 0, agent.dataset.train[0].stop)
        env = agent.make_env(
            num_envs=1, threads=int(values["threads"]), whole_fragments=True, falls_end=False, fragments=[whole]
        )
        rollout = roll_out(env, agent.actor, whole.stop)
        env.close()
        figures = figures_of(rollout, agent.dataset)
        rollout.motion.save(folder / MOTION)
        write_text_whole(folder / FIGURES, json.dumps(figures, indent=1))
        lines.append(summary(figures) + f"\nmotion: {folder / MOTION}")
    return "\n".join(lines)


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
