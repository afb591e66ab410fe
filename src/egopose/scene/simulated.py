"""A motion that a simulated body has made among boxes, with the controls that made it: physics can play it again."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from egopose.core.errors import InputError
from egopose.motion.io._npz import read_arrays
from egopose.motion.rotations import Array
from egopose.scene.scene_file import Scene


@dataclass(frozen=True)
class SimulatedMotion:
    """States at the control rate and what led from each to the next; world axes and floor of the scene.

    Args:
        qpos: ``[T, nq]``.
        qvel: ``[T, nv]``.
        ctrl: ``[T - 1, nu]`` rad, PD targets held from a frame to the next.
        box_tops: ``[K, 3]`` m, centres of the boxes' upper faces, in the order of the scene's boxes.
        box_headings: ``[K]`` rad.

    Raises:
        ValueError: shapes do not agree, or a value is not finite.
    """

    qpos: Array
    qvel: Array
    ctrl: Array
    box_tops: Array
    box_headings: Array

    def __post_init__(self) -> None:
        frames, boxes = len(self.qpos), len(self.box_headings)
        if len(self.qvel) != frames or len(self.ctrl) != frames - 1 or self.box_tops.shape != (boxes, 3):
            shapes = {name: list(value.shape) for name, value in vars(self).items()}
            raise ValueError(f"a simulated motion has T states, T - 1 controls and K boxes, got {shapes}")
        for name, value in vars(self).items():
            if not np.isfinite(value).all():
                raise ValueError(f"{name} is not finite")

    def __len__(self) -> int:
        return len(self.qpos)

    def save(self, path: Path) -> None:
        """Write ``path``, an ``.npz`` without pickle."""
        np.savez_compressed(path, **asdict(self))


def as_simulated(scene: Scene, motion: SimulatedMotion) -> Scene:
    """The scene with its boxes where the simulation had them; a box that it does not have stays."""
    moved = [
        replace(box, place=(float(top[0]), float(top[1])), height=float(top[2]), yaw=float(heading))
        for box, top, heading in zip(scene.boxes, motion.box_tops, motion.box_headings, strict=False)
    ]
    return replace(scene, boxes=(*moved, *scene.boxes[len(moved) :]))


def load_simulated(path: Path) -> SimulatedMotion:
    """Read what :meth:`SimulatedMotion.save` wrote.

    Raises:
        InputError: the file is missing or damaged.
    """
    names = ("qpos", "qvel", "ctrl", "box_tops", "box_headings")
    arrays = read_arrays(path, names)
    if missing := [name for name in names if name not in arrays]:
        raise InputError(path, missing[0], "is missing")
    try:
        return SimulatedMotion(**arrays)
    except ValueError as error:
        raise InputError(path, "simulated motion", str(error)) from None
