"""A folder as ``egopose reconstruct prepare`` leaves it, made from an embedded walk: no film is needed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from egopose.humanoid.foot_geometry import sole_positions
from egopose.motion.contacts import contact_labels
from egopose.motion.io.native import write_native
from egopose.scene.scene_file import Box, Contact, Scene, write_scene
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
