"""Several calibrated cameras that see one person: the cameras' file, and the person's 3D keypoints by triangulation.

The file is Qualisys' ``.qca.txt``: focal lengths in 1/64 px, places in mm; a camera there looks against its z. Here
camera axes are x right, y down, z ahead.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from egopose.motion.rotations import Array


@dataclass(frozen=True)
class Camera:
    """A pinhole.

    Args:
        name: of its film.
        intrinsics: ``[3, 3]`` px.
        axes: ``[3, 3]``; the rows are the camera's x, y, z in the world.
        position: ``[3]`` m.
    """

    name: str
    intrinsics: Array
    axes: Array
    position: Array

    @property
    def matrix(self) -> Array:
        """``[3, 4]``: homogeneous pixels of homogeneous world points."""
        return self.intrinsics @ np.concatenate([self.axes, -(self.axes @ self.position)[:, None]], axis=1)

    def project(self, points: Array) -> Array:
        """Pixels ``[..., 2]`` of world points ``[..., 3]``."""
        seen = (points - self.position) @ self.axes.T @ self.intrinsics.T
        return np.asarray(seen[..., :2] / seen[..., 2:])


def read_cameras(path: Path) -> list[Camera]:
    """The cameras of a Qualisys file, by name. Distortion is left out: below a pixel on these cameras."""
    out = []
    for camera in ElementTree.parse(path).getroot().iterfind("cameras/camera"):
        place, lens = camera.find("transform"), camera.find("intrinsic")
        assert place is not None
        assert lens is not None
        rows = np.array([[float(place.attrib[f"r{i}{j}"]) for j in (1, 2, 3)] for i in (1, 2, 3)])
        names = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
        fu, fv, cu, cv = (float(lens.attrib[name]) / 64 for name in names)
        position = np.array([float(place.attrib[axis]) for axis in "xyz"]) / 1000
        intrinsics = np.array([[fu, 0.0, cu], [0.0, fv, cv], [0.0, 0.0, 1.0]])
        out.append(Camera(camera.attrib["serial"], intrinsics, np.diag([1.0, -1.0, -1.0]) @ rows, position))
    return sorted(out, key=lambda one: one.name)


def triangulate(cameras: list[Camera], pixels: Array, weights: Array) -> Array:
    """``[..., 3]`` m: points by weighted linear triangulation (Hartley & Zisserman 2004, section 12.2).

    Args:
        cameras: C of them.
        pixels: ``[C, ..., 2]``.
        weights: ``[C, ...]``; 0 leaves a sight out.
    """
    matrices = np.stack([camera.matrix for camera in cameras])
    lead = pixels.shape[1:-1]
    p = matrices.reshape(len(cameras), *(1,) * len(lead), 3, 4)
    rows = pixels[..., None] * p[..., 2:3, :] - p[..., :2, :]
    # In units of a pixel, so that cameras count alike.
    rows = rows / np.linalg.norm(rows[..., :3], axis=-1, keepdims=True) * weights[..., None, None]
    rows = np.moveaxis(rows, 0, -3).reshape(*lead, 2 * len(cameras), 4)
    last = np.linalg.svd(rows)[2][..., -1, :]
    return np.asarray(last[..., :3] / last[..., 3:])


def robust_triangulation(cameras: list[Camera], pixels: Array, confidence: Array, near: float = 25.0) -> Array:
    """``[T, K, 3]`` m: of all sets of two cameras or more, the largest one that agrees.

    Args:
        cameras: C of them.
        pixels: ``[C, T, K, 2]``.
        confidence: ``[C, T, K]``.
        near: px, what a camera of an agreeing set is off at most.

    Returns:
        NaN where no two cameras agree.
    """
    pixels = np.nan_to_num(pixels)
    best, best_score = np.full((*pixels.shape[1:3], 3), np.nan), np.full(pixels.shape[1:3], -np.inf)
    for size in range(len(cameras), 1, -1):
        for chosen in combinations(range(len(cameras)), size):
            used = np.zeros(len(cameras), dtype=bool)
            used[list(chosen)] = True
            points = triangulate(cameras, pixels, confidence * used[:, None, None])
            off = np.stack(
                [np.linalg.norm(c.project(points) - p, axis=-1) for c, p in zip(cameras, pixels, strict=True)]
            )
            worst = np.where(used[:, None, None], off, 0.0).max(axis=0)
            # More cameras first; among as many, those that agree best.
            score = np.where(worst < near, size - worst / near, -np.inf)
            better = score > best_score
            best[better], best_score[better] = points[better], score[better]
    return best
