"""Poses that tremble and slide, put on their footholds: standing soles stay, and the body is nearer to the true one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from helpers.mocap import default_humanoid
from helpers.walking import walking
from scipy.ndimage import gaussian_filter1d

from egopose.evaluation.position_metrics import jitter
from egopose.humanoid.foot_geometry import sole_positions
from egopose.motion.contacts import contact_labels
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.scene.footholds import on_footholds
from egopose.scene.root import Support


def supports_of(motion: Motion) -> list[Support]:
    """Of the walk itself, by height and speed of its soles; 0 is the right foot."""
    humanoid = default_humanoid()
    soles = sole_positions(humanoid, motion)
    stands = contact_labels(soles, motion.fps, height=0.06, speed=1.0).reshape(len(motion), 2, 2).any(axis=2)
    names = [humanoid.skeleton.names[foot] for foot in humanoid.feet]
    out = []
    for foot, name in enumerate(("RightFoot", "LeftFoot")):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], stands[:, names.index(name)].astype(int), [0]])))
        out += [Support(foot, int(a), int(b), 0.0) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return out


def slide(motion: Motion, supports: list[Support]) -> float:
    """m/s, mean over standing feet."""
    humanoid = default_humanoid()
    names = [humanoid.skeleton.names[foot] for foot in humanoid.feet]
    soles = sole_positions(humanoid, motion).reshape(len(motion), 2, 2, 3).mean(axis=2)
    order = [names.index(name) for name in ("RightFoot", "LeftFoot")]
    speeds = [np.linalg.norm(np.diff(soles[s.start : s.stop, order[s.foot], :2], axis=0), axis=1) for s in supports]
    return float(np.concatenate(speeds).mean() * motion.fps)


def joints(motion: Motion) -> Array:
    return motion.forward_kinematics()[0]


def test_feet_stop_sliding_and_poses_come_nearer_to_the_truth() -> None:
    true = walking("deepmimic_walk")
    rng = np.random.default_rng(0)
    noise = gaussian_filter1d(rng.normal(size=true.qpos.shape), 1.5, axis=0)
    qpos = true.qpos.copy()
    qpos[:, 7:] += 0.15 * noise[:, 7:]
    qpos[:, :3] += 0.03 * noise[:, :3]
    seen = replace(true, qpos=qpos)
    supports = supports_of(true)
    found = on_footholds(default_humanoid(), seen, supports, np.ones(len(true)))
    assert slide(found, supports) < 0.4 * slide(seen, supports)
    shaking = [float(jitter(joints(motion), true.fps).mean()) for motion in (true, found, seen)]
    assert shaking[1] - shaking[0] < 0.4 * (shaking[2] - shaking[0])
    off_before, off_after = (np.linalg.norm(joints(m) - joints(true), axis=2).mean() for m in (seen, found))
    assert off_after < off_before


def test_a_frame_without_trust_is_bridged() -> None:
    true = walking("deepmimic_walk")
    qpos, trust = true.qpos.copy(), np.ones(len(true))
    gap = slice(10, 14)
    qpos[gap, 7:] += 1.0
    trust[gap] = 1e-4
    found = on_footholds(default_humanoid(), replace(true, qpos=qpos), supports_of(true), trust)
    before = np.abs(qpos[gap, 7:] - true.qpos[gap, 7:]).mean()
    assert np.abs(found.qpos[gap, 7:] - true.qpos[gap, 7:]).mean() < 0.5 * before
