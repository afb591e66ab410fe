"""The embedded walk as a third person's camera at a known place would see it."""

from __future__ import annotations

import numpy as np

from egopose.motion.rotations import Array
from egopose.scene.poses.from_motion import motion_keypoints
from egopose.scene.poses.keypoints import BODY_25
from egopose.scene.poses.track import PoseTrack
from egopose.scene.upright import first_to_world, focal_length
from helpers.walking import walking

SIZE = (1280, 720)
FPS = 30.0


def filmed_walk(pitch: float = 0.0, roll: float = 0.0, distance: float = 5.0) -> tuple[PoseTrack, Array]:
    """The track, with 3D keypoints in axes that look straight at the hips, and the keypoints in the world.

    Args:
        pitch, roll: rad, of the camera, which stands ``distance`` m before the walk's beginning, 1.2 m high.
        distance: m.
    """
    world = motion_keypoints(walking())
    face = world[:, BODY_25.index("neck")] + [0.0, 0.0, 0.2]
    for name in ("nose", "left_eye", "right_eye", "left_ear", "right_ear"):
        world[:, BODY_25.index(name)] = face
    for side in ("left", "right"):
        ankle, toe = (world[:, BODY_25.index(f"{side}_{part}")] for part in ("ankle", "big_toe"))
        world[:, BODY_25.index(f"{side}_small_toe")] = toe
        world[:, BODY_25.index(f"{side}_heel")] = ankle - 0.3 * (toe - ankle) * [1, 1, 0]
    axes = first_to_world(pitch, roll).T
    hips = world[:, BODY_25.index("mid_hip")]
    place = hips[0] * [1, 1, 0] + [0.0, -distance, 1.2]
    seen = (world - place) @ axes.T
    focal = focal_length(SIZE, None)
    pixels = focal * seen[..., :2] / seen[..., 2:] + 0.5 * np.array(SIZE)
    at = (pixels[:, BODY_25.index("mid_hip")] - 0.5 * np.array(SIZE)) / focal
    relative = seen - seen[:, [BODY_25.index("mid_hip")]]
    turned = np.einsum("tji,tkj->tki", _turns(at), relative)
    return PoseTrack(BODY_25, pixels, np.full(pixels.shape[:2], 0.9), FPS, SIZE, turned), world


def _turns(at: Array) -> Array:
    """``[T, 3, 3]``: first about x, then about y, by the angles at which the hips are seen."""
    yaw, pitch = at.T
    c, s, one, zero = np.cos, np.sin, np.ones_like(yaw), np.zeros_like(yaw)
    about_y = np.array([[c(yaw), zero, s(yaw)], [zero, one, zero], [-s(yaw), zero, c(yaw)]]).transpose(2, 0, 1)
    about_x = np.array([[one, zero, zero], [zero, c(pitch), s(pitch)], [zero, -s(pitch), c(pitch)]]).transpose(2, 0, 1)
    return about_y @ about_x
