"""Simple answers to a third person's film, to compare with: from the same poses and contacts, without pictures' places.

``anchored``: contact-anchored kinematics. The root goes where standing feet stay, and in flight as a thrown body does.
``still``: the root stands still where it begins, as in motion imitated from single pictures (Peng et al. 2018, SFV).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from egopose.humanoid.model import HumanoidModel
from egopose.inference.scene_stages import about_pelvis
from egopose.motion.io.native import read_native
from egopose.motion.motion import Motion
from egopose.scene.clip import Clip
from egopose.scene.root import kinematic_root
from egopose.scene.supports import floor_height, touched


def anchored(folder: Path, clip: Clip, humanoid: HumanoidModel) -> Motion:
    """The poses of a prepared ``folder`` with the root that contacts and gravity alone give; floor at 0."""
    motion = read_native(folder / "motion.npz")
    feet, com = about_pelvis(motion, humanoid)
    root = kinematic_root(feet, clip.touching, com, motion.fps)
    floor = floor_height(root.supports, touched(clip.scene, root.supports))
    qpos = motion.qpos.copy()
    qpos[:, :3] = root.positions - [0.0, 0.0, floor]
    return replace(motion, qpos=qpos)


def still(folder: Path, clip: Clip) -> Motion:
    """The poses of a prepared ``folder`` with the root where the clip begins, in all frames."""
    motion = read_native(folder / "motion.npz")
    qpos = motion.qpos.copy()
    qpos[:, :3] = clip.body.qpos[0, :3]
    return replace(motion, qpos=qpos)
