"""A folder as ``egopose reconstruct prepare`` leaves it, made from an embedded walk: no film is needed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from egopose.core.config import compose_config
from egopose.data.preparation import humanoid_of
from egopose.humanoid.foot_geometry import sole_positions
from egopose.humanoid.physics import BatchedPhysics
from egopose.motion.contacts import contact_labels
from egopose.motion.io.native import write_native
from egopose.scene.clip import box_poses, humanoid_in, read_clip
from egopose.scene.scene_file import Box, Contact, Scene, write_scene
from egopose.scene.simulated import SimulatedMotion
from helpers.mocap import default_humanoid
from helpers.walking import walking


def clip_folder(folder: Path, scene: Scene | None = None, frames: int = 24, clip: str = "deepmimic_walk") -> Path:
    """``body.npz``, ``contacts.npz`` and ``scene.yaml`` of the first ``frames`` of a walk on a bare floor."""
    folder.mkdir(parents=True, exist_ok=True)
    motion = walking(clip).slice(0, frames)
    soles = sole_positions(default_humanoid(), motion)
    stands = contact_labels(soles, motion.fps, height=0.06, speed=1.0).reshape(len(motion), 2, 2).any(axis=2)
    names = [default_humanoid().skeleton.names[foot] for foot in default_humanoid().feet]
    touching = stands[:, [names.index("RightFoot"), names.index("LeftFoot")]]
    write_native(replace(motion, contacts=touching, contact_names=("RightFoot", "LeftFoot")), folder / "body.npz")
    np.savez_compressed(folder / "contacts.npz", probability=touching.astype(float), touching=touching)
    write_scene(scene or Scene(), folder / "scene.yaml")
    return folder


def scene_of_a_step(frames: int = 24) -> Scene:
    """A box ahead that the right foot steps on after half of the clip."""
    box = Box("step", (0.4, 0.8), (0.8, 0.0), 0.2, 0.0, {"along": (-0.3, 0.3), "height": (-0.1, 0.2)})
    contacts = (
        Contact("left_foot", "floor", 0, frames // 2),
        Contact("right_foot", "step", frames // 2 + 3, frames - 1),
    )
    return Scene(boxes=(box,), contacts=contacts)


def scene_of_two_steps(frames: int = 24) -> Scene:
    """:func:`scene_of_a_step`, and a box beyond it for the left foot in the last frames."""
    one = scene_of_a_step(frames)
    second = Box("second", (0.4, 0.8), (1.5, 0.0), 0.3, 0.0, {"height": (-0.2, 0.2)})
    return replace(
        one,
        boxes=(*one.boxes, second),
        contacts=(*one.contacts, Contact("left_foot", "second", frames - 4, frames - 1)),
    )


def standing_plan(folder: Path, frames: int) -> SimulatedMotion:
    """A simulated motion of a clip's folder: its first frames by the clip's joint angles as controls."""
    clip = read_clip(folder)
    humanoid = humanoid_in(clip.scene, humanoid_of(compose_config("train")))
    physics = BatchedPhysics(humanoid.mj_model, 1, humanoid.substeps)
    tops, headings = box_poses(clip.scene)
    qvel = np.zeros((1, humanoid.mj_model.nv))
    physics.set_state(slice(None), clip.body.qpos[:1], qvel)
    if len(headings):
        physics.place_boxes(slice(None), tops[None], headings[None])
    states, rates = [physics.qpos[0].copy()], [physics.qvel[0].copy()]
    ctrl = clip.body.qpos[1:frames, 7:]
    for target in ctrl:
        physics.step(target[None])
        states.append(physics.qpos[0].copy())
        rates.append(physics.qvel[0].copy())
    physics.close()
    return SimulatedMotion(np.stack(states), np.stack(rates), ctrl, tops, headings)
