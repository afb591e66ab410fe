"""A clip as the reconstruction takes it up: poses with a first guess of the root, contacts, up-hint, and the scene.

It is read from a folder that ``egopose reconstruct prepare`` wrote. Nothing in it comes from physics.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from egopose.core.errors import InputError
from egopose.humanoid.boxes import with_boxes
from egopose.humanoid.model import HumanoidModel
from egopose.motion.io.native import read_native
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.scene.scene_file import FLOOR, Scene, read_scene

#: End effector of a scene file -> body of the humanoid.
BODIES = {
    "right_foot": "RightFoot",
    "left_foot": "LeftFoot",
    "right_hand": "RightHand",
    "left_hand": "LeftHand",
}


@dataclass(frozen=True)
class Clip:
    """What of a film is known before any physics.

    Args:
        body: the humanoid's poses at the control rate; the root is the kinematic one, world axes of the scene.
        touching: ``[T, 2]`` whether the right and the left foot touch something.
        scene: boxes with place, height and yaw, and contacts.
    """

    body: Motion
    touching: NDArray[np.bool_]
    scene: Scene

    def __len__(self) -> int:
        return len(self.body)


def read_clip(folder: Path) -> Clip:
    """Read what the preparation left in ``folder``: ``body.npz``, ``contacts.npz``, ``scene.yaml``.

    Raises:
        InputError: a file is missing or damaged, a box lacks its place, or contacts lie behind the clip's end.
    """
    for name in ("body.npz", "contacts.npz", "scene.yaml"):
        if not (folder / name).is_file():
            raise InputError(folder / name, "file", "is not there: `egopose reconstruct prepare` makes it")
    body, scene = read_native(folder / "body.npz"), read_scene(folder / "scene.yaml")
    touching = np.asarray(body.contacts, dtype=bool)
    for box in scene.boxes:
        if not box.known:
            raise InputError(folder / "scene.yaml", box.name, "lacks its place, height or yaw, and no foot tells it")
    for k, contact in enumerate(scene.contacts):
        if contact.last >= len(body):
            cause = f"{contact.last} lies behind the last frame, {len(body) - 1}"
            raise InputError(folder / "scene.yaml", f"contacts[{k}].last", cause)
    return Clip(body, touching, scene)


def humanoid_in(scene: Scene, humanoid: HumanoidModel) -> HumanoidModel:
    """The humanoid in worlds with the scene's boxes, with contact sensors on every body."""
    return with_boxes(humanoid, [box.size for box in scene.boxes], humanoid.skeleton.names)


def box_poses(scene: Scene) -> tuple[Array, Array]:
    """Centres of the boxes' upper faces ``[K, 3]`` m and their headings ``[K]`` rad, in the scene's order."""
    tops = [[*(box.place or (0.0, 0.0)), box.height or 0.0] for box in scene.boxes]
    return np.array(tops).reshape(-1, 3), np.array([box.yaw or 0.0 for box in scene.boxes])


def wanted_contacts(scene: Scene, humanoid: HumanoidModel, frames: int) -> NDArray[np.bool_]:
    """``[T, B, 1 + K]``: which of the humanoid's bodies should touch the floor (first) and each box, by the scene."""
    names = [FLOOR, *(box.name for box in scene.boxes)]
    out = np.zeros((frames, len(humanoid.skeleton.names), len(names)), dtype=bool)
    for contact in scene.contacts:
        row = humanoid.skeleton.index(BODIES[contact.effector])
        out[contact.first : contact.last + 1, row, names.index(contact.touches)] = True
    return out
