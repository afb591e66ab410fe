"""A body that stands on a box, crouches and jumps off it, simulated: folders as a reconstruction leaves them."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path

import numpy as np

from egopose.core.config import compose_config
from egopose.data.preparation import humanoid_of
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.physics import BatchedPhysics
from egopose.inference.scene_stages import save_projection
from egopose.motion.io.native import write_native
from egopose.motion.motion import Motion
from egopose.scene.clip import box_poses, humanoid_in
from egopose.scene.poses.keypoints import BODY_25
from egopose.scene.poses.track import PoseTrack
from egopose.scene.projection import Projection
from egopose.scene.scene_file import Box, Contact, Scene, write_scene
from egopose.scene.simulated import SimulatedMotion
from egopose.vision.video import write_video

UPRIGHT = 0.0222 + 0.4767 + 0.4982 + 0.075  # m, of the root with straight legs, soles at height zero
STEP = Box("step", (0.6, 0.8), (0.0, 0.0), 0.3, 0.2)
FAR = Box("far", (0.5, 0.5), (3.0, 1.0), 0.5, 0.0)


@lru_cache
def bare() -> HumanoidModel:
    """The humanoid of ``conf/reconstruct.yaml``."""
    return humanoid_of(compose_config("reconstruct"))


def simulated(scene: Scene, root: tuple[float, float, float], bends: list[float], lean: float = 0.0) -> SimulatedMotion:
    """PD targets: hips and ankles bent by ``bends [T - 1]`` rad, knees by twice that; ``lean`` rad at the ankles."""
    humanoid = humanoid_in(scene, bare())
    first = humanoid.mj_model.qpos0.copy()
    first[:3] = root
    targets = np.zeros((len(bends), humanoid.mj_model.nu))
    for side in ("Right", "Left"):
        for part, share in (("UpLeg", -1.0), ("Leg", 2.0), ("Foot", -1.0)):
            column = humanoid.skeleton.dof_slices[humanoid.skeleton.index(side + part)].start
            targets[:, column] = share * np.array(bends) - (lean if part == "Foot" else 0.0)
    return _played(scene, first, targets)


def thrown(scene: Scene, qpos: np.ndarray, up: float, frames: int) -> SimulatedMotion:
    """From ``qpos [nq]`` upwards with ``up`` m/s, held straight."""
    return _played(scene, qpos, np.zeros((frames - 1, bare().mj_model.nu)), up)


def _played(scene: Scene, first: np.ndarray, targets: np.ndarray, up: float = 0.0) -> SimulatedMotion:
    humanoid = humanoid_in(scene, bare())
    physics = BatchedPhysics(humanoid.mj_model, 1, humanoid.substeps, body_ids=humanoid.body_ids)
    tops, headings = box_poses(scene)
    physics.place_boxes(slice(None), tops[None], headings[None])
    speeds = np.zeros((1, humanoid.mj_model.nv))
    speeds[0, 2] = up
    physics.set_state(slice(None), first[None], speeds)
    states = [(physics.qpos[0].copy(), physics.qvel[0].copy())]
    for target in targets:
        physics.step(target[None])
        states.append((physics.qpos[0].copy(), physics.qvel[0].copy()))
    qpos, qvel = (np.stack(values) for values in zip(*states, strict=True))
    return SimulatedMotion(qpos, qvel, targets, tops, headings)


@lru_cache
def standing(frames: int = 45, height: float = 0.0) -> SimulatedMotion:
    """Straight and still, on the floor or on the step, which then is ``height`` m high."""
    scene = scene_at(height or STEP.height or 0.0)
    x = 0.0 if height else -2.0
    return simulated(scene, (x, 0.0, UPRIGHT + height), [0.0] * (frames - 1))


@lru_cache
def jumping() -> SimulatedMotion:
    """Stands on the step, crouches, jumps straight up, and lands on it again."""
    crouch = [0.6 * min(1.0, t / 15) for t in range(20)]
    return simulated(scene_at(0.3), (0.0, 0.0, UPRIGHT + 0.3), [0.0] * 10 + crouch + [-0.1] * 3 + [0.25] * 27)


def scene_at(height: float) -> Scene:
    """The step at a height, and a box far away."""
    step = Box(STEP.name, STEP.size, STEP.place, height, STEP.yaw)
    contacts = tuple(
        Contact(f"{side}_foot", "step", *span) for side in ("right", "left") for span in ((0, 30), (41, 60))
    )
    return Scene(boxes=(step, FAR), contacts=contacts)


def write_folder(folder: Path, motion: SimulatedMotion, scene: Scene, film: bool = False) -> Path:
    """As `egopose reconstruct` leaves it: the motion itself is the clip, slid by 0.1 m along x in its course.

    The film, where there is one, is red.
    """
    folder.mkdir(parents=True, exist_ok=True)
    frames = len(motion)
    qpos = motion.qpos.copy()
    qpos[:, 0] += 0.1 * np.linspace(0, 1, frames)
    touching = np.zeros((frames, 2), bool)
    for contact in scene.contacts:
        touching[contact.first : contact.last + 1, int(contact.effector == "left_foot")] = True
    body = Motion(bare().skeleton, qpos, 30.0, "jump", touching, ("RightFoot", "LeftFoot"))
    write_native(body, folder / "body.npz")
    np.savez(folder / "contacts.npz", touching=touching, probability=touching.astype(float))
    matrix = np.tile(np.array([[40.0, 0, 0], [0, 0, -40.0]]), (frames, 1, 1))
    save_projection(Projection(matrix, np.tile([80.0, 100.0], (frames, 1))), folder / "projection.npz")
    pixels = np.full((frames, len(BODY_25), 2), 80.0)
    PoseTrack(BODY_25, pixels, np.ones(pixels.shape[:2]), 30.0, (160, 120)).save(folder / "poses.npz")
    if film:
        red = np.broadcast_to(np.array([200, 0, 0], np.uint8), (frames, 120, 160, 3)).copy()
        write_video(folder / "film.mp4", red, 30.0)
    video = str(folder / "film.mp4") if film else None
    (folder / "clip.json").write_text(json.dumps({"start": 0, "stop": frames, "of": frames, "video": video}))
    write_scene(scene, folder / "scene.yaml")
    motion.save(folder / "plan.npz")
    return folder
