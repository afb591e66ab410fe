"""From the camera's axes to the world's: how the camera turned, from where it sees the person, and which way is up.

A pose network sees a cut-out around the person, so its 3D axes are those of a camera that looks straight at them. That
camera is turned against the first picture's by the ray to the person in the first picture, once the camera's motion is
undone. Up is found by balance: on average a body's centre of mass lies straight above the feet that touch something.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.rotations import Array
from egopose.scene.camera import CameraTrack
from egopose.scene.contacts import FEET
from egopose.scene.poses.keypoints import KeypointSchema

#: rad over the longer side of a picture whose lens is not known: telephones have 60 to 70 degrees.
USUAL_FIELD_OF_VIEW = float(np.deg2rad(65.0))
#: rad: bodies further than this from up are not in balance. The second cone is for the first guess, a level camera.
_BALANCED, _MAYBE = float(np.deg2rad(25.0)), float(np.deg2rad(60.0))
#: Of the frames that must show a body in balance, else the camera is taken to be level.
_LEAST_UPRIGHT = 0.1
#: From the first camera (x right, y down, z ahead) to the world (x right, y ahead, z up), of a camera that is level.
_LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class Orientation:
    """How 3D keypoints of each frame lie in the world.

    Args:
        to_world: ``[T, 3, 3]`` from the axes of the frame's keypoints to the world's.
        pitch, roll: rad, of the first camera: below the horizon, and its right side below its left.
        upright: share of the frames by which pitch and roll were found; 0 where they were given, or taken for level.
    """

    to_world: Array
    pitch: float
    roll: float
    upright: float


def focal_length(size: tuple[int, int], field_of_view: float | None) -> float:
    """Focal length (px) of a picture ``(width, height)`` whose longer side spans ``field_of_view`` (rad)."""
    angle = USUAL_FIELD_OF_VIEW if field_of_view is None else field_of_view
    return 0.5 * max(size) / float(np.tan(0.5 * angle))


def view_turns(pelvis: Array, camera: CameraTrack, motion: str, size: tuple[int, int], focal: float) -> Array:
    """``[T, 3, 3]``: from the axes of a camera that looks straight at the person to those of the first camera.

    Args:
        pelvis: ``[T, 2]`` px of each frame's own picture, finite.
        camera: its motion in the pictures.
        motion: one of :data:`egopose.scene.scene_file.CAMERA_MOTIONS`. What moves along does not turn.
        size: width and height of the pictures, px.
        focal: px, in the first frame.
    """
    centre = 0.5 * np.array(size, dtype=np.float64)
    seen = pelvis if motion == "track" else camera.undo(pelvis)
    # A fitted similarity adds up small turns as shifts: an angle is the way over the focal length.
    yaw, pitch = ((seen - centre) / focal).T
    along = camera.to_first[:, :2, 0] / np.linalg.norm(camera.to_first[:, :2, 0], axis=1, keepdims=True)
    roll = np.arctan2(along[:, 1], along[:, 0])
    x, y, z = np.eye(3)
    turn = rot.multiply(rot.from_axis_angle(y, yaw), rot.from_axis_angle(x, -pitch))
    return rot.to_matrix(rot.multiply(turn, rot.from_axis_angle(z, roll)))


def orientation(
    positions: Array,
    contacts: np.ndarray,
    schema: KeypointSchema,
    turns: Array,
    pitch: float | None,
    roll: float | None,
) -> Orientation:
    """The world's axes.

    Args:
        positions: ``[T, K, 3]`` m, axes of each frame's own camera; NaN where unknown.
        contacts: ``[T, 2]`` whether the right and the left foot touch something.
        schema: the keypoints' layout.
        turns: ``[T, 3, 3]`` of :func:`view_turns`.
        pitch, roll: rad, of the first camera, where they are known.
    """
    axis = np.einsum("tij,tj->ti", turns, balance_axis(positions, contacts, schema))
    up, share = _up(axis)
    pitch = -float(np.arcsin(np.clip(up[2], -1.0, 1.0))) if pitch is None else pitch
    roll = float(np.arctan2(-up[0], -up[1])) if roll is None else roll
    return Orientation(first_to_world(pitch, roll) @ turns, pitch, roll, share)


def first_to_world(pitch: float, roll: float) -> Array:
    """``[3, 3]`` from the first camera's axes to the world's."""
    x, _, z = np.eye(3)
    return _LEVEL @ rot.to_matrix(rot.multiply(rot.from_rotvec(-pitch * x), rot.from_rotvec(roll * z)))


def balance_axis(positions: Array, contacts: np.ndarray, schema: KeypointSchema) -> Array:
    """``[T, 3]`` m from the middle of the feet that touch something to the centre of mass; NaN where none does."""
    ankles, toes = (positions[:, [schema.index(f"{side}_{part}") for side in FEET]] for part in ("ankle", "big_toe"))
    feet = np.where(np.isfinite(toes), 0.5 * (ankles + toes), ankles)
    stands = np.asarray(contacts, dtype=bool)
    total = np.where(stands[..., None], feet, 0.0).sum(axis=1)
    carried = total / np.where(stands.any(axis=1), stands.sum(axis=1), np.nan)[:, None]
    centre = np.zeros((len(positions), 3))
    for names, share in _MASSES.items():
        rows = positions[:, [schema.index(name) for name in names]]
        known = np.isfinite(rows).all(axis=(0, 2))
        centre += share * (rows[:, known] if known.any() else rows).mean(axis=1)
    out: Array = centre - carried
    return out


def _sided(*parts: str) -> tuple[str, ...]:
    return tuple(f"{side}_{part}" for part in parts for side in ("left", "right"))


#: Share of the body's mass in each group of keypoints: Winter 2009, table 4.1, a segment's mass at its ends' middle.
_MASSES = {
    ("nose", "neck"): 0.081,
    (*_sided("shoulder"), *_sided("hip")): 0.497,
    _sided("shoulder", "elbow"): 0.056,
    _sided("elbow", "wrist"): 0.044,
    _sided("hip", "knee"): 0.200,
    _sided("knee", "ankle"): 0.093,
    _sided("ankle", "big_toe"): 0.029,
}


def _up(axis: Array) -> tuple[Array, float]:
    """Up ``[3]`` in the first camera's axes by :func:`balance_axis` ``[T, 3]``, and the share of frames that told."""
    level = np.array([0.0, -1.0, 0.0])
    known = axis[np.isfinite(axis).all(axis=1)]
    ways = known / np.maximum(np.linalg.norm(known, axis=1, keepdims=True), 1e-9)
    near = ways @ level > np.cos(_MAYBE)
    up = level
    for _ in range(8):
        if near.sum() < max(1.0, _LEAST_UPRIGHT * len(axis)):
            return level, 0.0
        up = known[near].mean(axis=0)
        up = up / np.linalg.norm(up)
        near = ways @ up > np.cos(_BALANCED)
    return up, float(near.sum()) / len(axis)
