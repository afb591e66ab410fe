"""A reconstruction as it lies in its folder: the prepared clip, the simulated motion, and what acts in it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.preparation import humanoid_of
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.replayed_forces import ReplayedForces, replay_forces, with_replayed_forces
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.scene.clip import Clip, box_poses, humanoid_in, read_clip
from egopose.scene.movement_numbers import MovementNumbers, movement_numbers
from egopose.scene.scene_file import Scene
from egopose.scene.simulated import as_simulated, load_simulated

#: What `egopose reconstruct` leaves beside the prepared clip: the simulated motion, the scene after fitting, the page.
PLAN, FITTED, PAGE = "plan.npz", "scene.fitted.yaml", "reconstruction.html"


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """What a folder holds.

    Args:
        folder: of `egopose reconstruct`.
        path: of the simulated motion.
        clip: the prepared clip: the kinematic body, contacts and the scene's first guess.
        scene: the clip's scene with the boxes where the simulated body found them.
        humanoid: in a world with these boxes.
        motion: the simulated motion at the control rate, with torques, ground reaction and contacts.
        forces: of every step of physics.
        numbers: read off them.
    """

    folder: Path
    path: Path
    clip: Clip
    scene: Scene
    humanoid: HumanoidModel
    motion: Motion
    forces: ReplayedForces
    numbers: MovementNumbers

    @property
    def box_tops(self) -> Array:
        """``[K, 3]`` m, centres of the boxes' upper faces in the simulation."""
        return box_poses(self.scene)[0]


def reconstruction_folder(source: Path, path: Path | None = None) -> Path | None:
    """The folder of a reconstruction, of it or of its ``plan.npz``; None for anything else.

    ``path`` is a simulated motion that lies elsewhere: the folder then needs no ``plan.npz``.
    """
    folder = source.parent if source.name == PLAN else source
    needed = ("body.npz", "scene.yaml") if path is not None else (PLAN, "body.npz", "scene.yaml")
    return folder if all((folder / name).is_file() for name in needed) else None


def simulated_humanoid(choice: str = "default") -> HumanoidModel:
    """The humanoid that `egopose reconstruct` simulates: of ``conf/humanoid/CHOICE``, at the rate of its settings."""
    return humanoid_of(compose_config("reconstruct", [f"humanoid={choice}"]))


def read_reconstruction(folder: Path, humanoid: HumanoidModel, path: Path | None = None) -> Reconstruction:
    """Read a folder and play its controls again.

    Args:
        folder: with what `egopose reconstruct prepare` leaves, and ``plan.npz``.
        humanoid: bare, at the rate of the simulation.
        path: another simulated motion of the clip, as `egopose evaluate` leaves one; None for ``plan.npz``.

    Raises:
        InputError: a file is missing or damaged, the simulated motion is not of this clip, or its controls do not lead
            through the states.
    """
    path = folder / PLAN if path is None else path
    clip, simulated = read_clip(folder), load_simulated(path)
    if len(simulated.box_tops) != len(clip.scene.boxes):
        cause = f"there are {len(simulated.box_tops)}; scene.yaml has {len(clip.scene.boxes)}"
        raise InputError(path, "box_tops", cause)
    if len(simulated) != len(clip):
        raise InputError(path, "qpos", f"{len(simulated)} frames; the clip has {len(clip)}")
    among = humanoid_in(clip.scene, humanoid)
    try:
        forces = replay_forces(
            among, simulated.qpos, simulated.qvel, simulated.ctrl, simulated.box_tops, simulated.box_headings
        )
    except ValueError as error:
        cause = f"{error}. Was the scene changed after it was made? Then reconstruct again"
        raise InputError(path, "ctrl", cause) from None
    name = clip.body.name or folder.resolve().name
    bare = Motion(humanoid.skeleton, simulated.qpos, 1.0 / humanoid.control_dt, name=name)
    numbers = movement_numbers(among, forces, simulated.box_tops)
    return Reconstruction(
        folder,
        path,
        clip,
        as_simulated(clip.scene, simulated),
        among,
        with_replayed_forces(bare, among, forces),
        forces,
        numbers,
    )
