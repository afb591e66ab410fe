"""The demonstration films of Pose2Sim: four calibrated cameras, two people, their keypoints and 3D truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from calibrated_views import Camera, read_cameras, robust_triangulation
from scipy.ndimage import gaussian_filter1d
from scores import KEYPOINTS

from egopose.motion.rotations import Array
from egopose.scene.poses.blazepose import BlazePose
from egopose.scene.poses.sides import mend_sides
from egopose.scene.poses.track import PoseTrack, load_track
from egopose.vision.video import probe_video, read_frames

#: Frames over which the triangulated points are smoothed (a Gaussian's deviation, at 60 frames/s).
_SMOOTHING = 1.5
#: Folder of the films and, in each camera's first frame, a place on the person (px).
PEOPLE = {
    "man": ("Demo_SinglePerson", (None,) * 4),
    "woman": ("Demo_MultiPerson", ((770, 1363), (150, 1155), (276, 740), (560, 657))),
}


@dataclass(frozen=True)
class View:
    """One camera's film: ``track`` as BlazePose gives it, ``mended`` with sides put right, ``truth [T, 12, 3]`` m.

    The truth has the camera's axes and is relative to the middle of the hips.
    """

    camera: Camera
    track: PoseTrack
    mended: PoseTrack
    truth: Array
    off_px: float


def views(pose2sim: Path, tracks: Path, person: str) -> list[View]:
    """The four views of a person.

    Args:
        pose2sim: the package's folder.
        tracks: folder of keypoints; those that are missing are found and written.
        person: one of :data:`PEOPLE`.
    """
    folder, places = PEOPLE[person]
    cameras = read_cameras(pose2sim / folder / "calibration" / "Calib.qca.txt")
    found = []
    for camera, at in zip(cameras, places, strict=True):
        path = tracks / f"{person}_{camera.name}.npz"
        if not path.exists():
            tracks.mkdir(parents=True, exist_ok=True)
            film = pose2sim / folder / "videos" / f"{camera.name}.mp4"
            frames = (frame for _, frame in read_frames(film))
            BlazePose(turns=(0,), at=at).estimate(frames, probe_video(film).fps).save(path)
        found.append(load_track(path))
    mended = [mend_sides(track) for track in found]
    rows = [found[0].schema.index(name) for name in KEYPOINTS]
    pixels = np.stack([track.pixels[:, rows] for track in mended])
    world = robust_triangulation(cameras, pixels, np.stack([track.confidence[:, rows] for track in mended]))
    world = gaussian_filter1d(_without_gaps(world), _SMOOTHING, axis=0)
    hips = [KEYPOINTS.index("left_hip"), KEYPOINTS.index("right_hip")]
    out = []
    for camera, track, better, seen in zip(cameras, found, mended, pixels, strict=True):
        truth = (world - world[:, hips].mean(axis=1, keepdims=True)) @ camera.axes.T
        off = np.linalg.norm(camera.project(world) - seen, axis=-1)
        out.append(View(camera, track, better, truth, float(np.nanmedian(off))))
    return out


def _without_gaps(points: Array) -> Array:
    out = points.copy()
    for column in out.reshape(len(out), -1).T:
        known = np.isfinite(column)
        column[~known] = np.interp(np.flatnonzero(~known), np.flatnonzero(known), column[known])
    return out
