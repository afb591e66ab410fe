"""Contacts of a filmed person's feet by triangulation: four calibrated cameras of Pose2Sim's demonstration films."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "lifting"))
from calibrated_views import read_cameras, robust_triangulation
from film import PEOPLE, views

from egopose.motion.contacts import contact_labels, point_speeds
from egopose.motion.rotations import Array
from egopose.scene.contacts import FEET

#: Points of a foot that may rest on the floor.
POINTS = ("heel", "foot_index")
FPS = 60.0
#: Frames over which triangulated points are smoothed (a Gaussian's deviation).
_SMOOTHING = 2.0
#: m above where that point rests, and m/s: mocap's are .03 and .5, but a triangulated heel at rest wanders by 4 cm.
HEIGHT, SPEED = 0.07, 0.5
#: A point rests at this percentile of its heights.
_RESTS = 10.0


@dataclass(frozen=True)
class RealFeet:
    """Truth of a film: ``contacts [T, 2]`` (right, left), and what it is read off.

    Args:
        contacts: of both feet.
        heights, speeds: ``[T, 2, 2]`` foot and point: m above where the point rests, m/s.
    """

    contacts: NDArray[np.bool_]
    heights: Array
    speeds: Array


def real_feet(pose2sim: Path, tracks: Path, person: str) -> RealFeet:
    """The feet of one of ``PEOPLE``; ``tracks`` is a folder for the keypoints found in the films."""
    seen = views(pose2sim, tracks, person)
    cameras = read_cameras(pose2sim / PEOPLE[person][0] / "calibration" / "Calib.qca.txt")
    schema = seen[0].mended.schema
    rows = [schema.index(f"{side}_{point}") for side in FEET for point in POINTS]
    pixels = np.stack([view.mended.pixels[:, rows] for view in seen])
    world = robust_triangulation(cameras, pixels, np.stack([view.mended.confidence[:, rows] for view in seen]))
    for column in world.reshape(len(world), -1).T:
        known = np.isfinite(column)
        column[~known] = np.interp(np.flatnonzero(~known), np.flatnonzero(known), column[known])
    world = gaussian_filter1d(world, _SMOOTHING, axis=0)
    world[..., 2] -= np.percentile(world[..., 2], _RESTS, axis=0)
    touching = contact_labels(world, FPS, height=HEIGHT, speed=SPEED, min_frames=4)
    shape = (len(world), 2, 2)
    return RealFeet(
        touching.reshape(shape).any(axis=2), world[..., 2].reshape(shape), point_speeds(world, FPS).reshape(shape)
    )
