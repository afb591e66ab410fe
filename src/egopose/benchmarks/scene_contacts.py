"""What a simulated motion touches, read off the contact sensors while physics plays it again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.physics import BatchedPhysics
from egopose.scene.clip import BODIES
from egopose.scene.contacts import FEET
from egopose.scene.scene_file import FLOOR, Contact, Scene
from egopose.scene.simulated import SimulatedMotion


def touching(humanoid: HumanoidModel, simulated: SimulatedMotion) -> NDArray[np.bool_]:
    """``[T, B, 1 + K]``: which body touches the floor (first) and each box, by playing the motion again.

    The first frame is as the second.

    Raises:
        RuntimeError: the motion does not come back to the bit.
    """
    physics = BatchedPhysics(humanoid.mj_model, 1, humanoid.substeps, body_ids=humanoid.body_ids, contacts=True)
    physics.place_boxes([0], simulated.box_tops[None], simulated.box_headings[None])
    physics.set_state([0], simulated.qpos[:1], simulated.qvel[:1])
    rows = []
    for t, ctrl in enumerate(simulated.ctrl):
        physics.step(ctrl[None])
        if not np.array_equal(physics.qpos[0], simulated.qpos[t + 1]):
            raise RuntimeError(f"the simulation does not come back at frame {t + 1}")
        rows.append(np.concatenate([physics.floor_contacts[0][:, None], physics.box_contacts[0]], axis=1))
    physics.close()
    found = np.stack([rows[0], *rows])
    out = np.zeros((len(simulated), len(humanoid.skeleton.names), found.shape[2]), dtype=bool)
    out[:, humanoid.touching] = found
    return out


def true_contacts(
    humanoid: HumanoidModel, scene: Scene, found: NDArray[np.bool_], shortest: int = 2
) -> tuple[Contact, ...]:
    """Contacts of hands and feet from ``found [T, B, 1 + K]``; gaps and contacts of one frame are left out."""
    names = [FLOOR, *(box.name for box in scene.boxes)]
    out = []
    for effector, body in BODIES.items():
        rows = found[:, humanoid.skeleton.index(body)]
        for column, name in enumerate(names):
            edges = np.flatnonzero(np.diff(np.concatenate([[0], rows[:, column].astype(np.int8), [0]])))
            runs = [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
            joined: list[tuple[int, int]] = []
            for first, last in runs:
                if joined and first - joined[-1][1] <= shortest:
                    joined[-1] = (joined[-1][0], last)
                else:
                    joined.append((first, last))
            out += [Contact(effector, name, a, b) for a, b in joined if b - a + 1 >= shortest]
    return tuple(sorted(out, key=lambda one: (one.first, one.effector)))


def feet_touching(humanoid: HumanoidModel, found: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``[T, 2]``: right and left foot touch anything, of ``found [T, B, 1 + K]``."""
    rows = [humanoid.skeleton.index(BODIES[f"{side}_foot"]) for side in FEET]
    return np.asarray(found[:, rows].any(axis=2))
