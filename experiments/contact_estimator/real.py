"""Judge networks on real film whose camera pans: python experiments/contact_estimator/real.py POSE2SIM TRACKS OUT.

A window slides over each of four films of one person, as a camera that pans. BlazePose finds the person in the window,
and the background tells how it moved. The truth is triangulated. Writes real.json, which table.py takes up.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from real_feet import FPS, HEIGHT, PEOPLE, SPEED, real_feet

from egopose.checkpoint.contacts import load_contact_network
from egopose.motion.rotations import Array
from egopose.scene.camera import CameraTrack, camera_motion
from egopose.scene.camera_file import load_camera, save_camera
from egopose.scene.contacts import LOWER_BODY, ContactEstimator
from egopose.scene.poses.blazepose import BlazePose
from egopose.scene.poses.keypoints import BODY_25
from egopose.scene.poses.mending import fill_gaps
from egopose.scene.poses.sides import mend_sides
from egopose.scene.poses.track import PoseTrack, load_track
from egopose.vision.video import Frame, read_frames

_STEP = 2  # of the film's frames: 30 a second are left
_PERIOD = 2.0  # s, to and fro
_SLACK = 0.3  # share of the film's width that the window slides over, where the person leaves as much
PANS = {"first to the right": 0.0, "first to the left": np.pi}


def windows(track: PoseTrack, phase: float) -> tuple[Array, tuple[int, int]]:
    """Left upper corners ``[T, 2]`` px of a window that slides and always holds the person's whole way; its size."""
    assert track.image_size is not None
    size, boxes = np.array(track.image_size), track.boxes(margin=0.08)
    low = np.clip(np.nanmin(boxes[:, :2], axis=0), 0, size)
    high = np.clip(np.nanmax(boxes[:, 2:], axis=0), 0, size)
    extent = np.maximum(high - low, (1 - _SLACK) * size).astype(int)
    least, most = np.maximum(0, high - extent), np.minimum(size - extent, low)
    swing = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(0, len(track), _STEP) / FPS / _PERIOD + phase)
    return np.rint(least + swing[:, None] * np.maximum(0, most - least)).astype(int), (int(extent[0]), int(extent[1]))


def panned(film: Path, corners: Array, size: tuple[int, int]) -> Iterator[Frame]:
    """What is seen through the window."""
    for t, (_, frame) in enumerate(read_frames(film)):
        if t % _STEP == 0 and t // _STEP < len(corners):
            x, y = corners[t // _STEP]
            yield np.ascontiguousarray(frame[y : y + size[1], x : x + size[0]])


def seen(film: Path, corners: Array, size: tuple[int, int], name: Path) -> tuple[PoseTrack, CameraTrack]:
    """Keypoints and camera of the panning film, kept beside ``name``."""
    poses, camera = name.with_suffix(".npz"), name.with_name(name.name + "_camera.npz")
    if not poses.exists():
        BlazePose(turns=(0,)).estimate(panned(film, corners, size), FPS / _STEP).save(poses)
    track = load_track(poses)
    if not camera.exists():
        save_camera(camera_motion(panned(film, corners, size), track.boxes()), camera)
    return track, load_camera(camera)


def told(network: ContactEstimator, track: PoseTrack, camera: CameraTrack, undone: bool) -> np.ndarray:
    """``[T, 2]`` as ``egopose reconstruct prepare`` reads contacts, from the mended track."""
    mended = fill_gaps(mend_sides(camera.undo_track(track))).to_schema(BODY_25)
    rows = [BODY_25.index(name) for name in LOWER_BODY]
    pixels = camera.redo(mended.pixels)[:, rows]
    confidence = np.where(np.isfinite(pixels).all(axis=-1), mended.confidence[:, rows], 0.0)
    probability = network.probabilities(np.nan_to_num(pixels), confidence, camera.to_first if undone else None)
    return np.asarray(probability > 0.5)


def main() -> None:
    """Print a line a network; write real.json beside this file."""
    pose2sim, tracks, networks = (Path(word) for word in sys.argv[1:4])
    loaded = {folder.name: load_contact_network(folder) for folder in sorted(networks.iterdir())}
    rows: dict[str, dict[str, dict[str, float]]] = {name: {"undone": {}, "as seen": {}} for name in loaded}
    about: dict[str, dict[str, float]] = {}
    person = "man"
    contacts = real_feet(pose2sim, tracks, person).contacts[::_STEP]
    for place in range(1, len(PEOPLE[person][1]) + 1):
        film = pose2sim / PEOPLE[person][0] / "videos" / f"cam0{place}.mp4"
        whole = load_track(tracks / f"{person}_cam0{place}.npz")
        for pan, phase in PANS.items():
            corners, size = windows(whole, phase)
            name = f"cam0{place}, {pan}"
            track, camera = seen(film, corners, size, tracks / f"{person}_cam0{place}_{phase:.0f}")
            off = np.abs(camera.to_first[:, :2, 2] - (corners - corners[0])).max()
            speed = np.linalg.norm(np.diff(corners, axis=0), axis=1).max()
            about[name] = {"width_px": size[0], "fastest_px_a_frame": float(speed), "camera_off_px": float(off)}
            for key, network in loaded.items():
                for way, row in rows[key].items():
                    right = told(network, track, camera, way == "undone") == contacts
                    row[name] = 100 * float(right.mean())
    shares = {key: {way: float(np.mean(list(row.values()))) for way, row in ways.items()} for key, ways in rows.items()}
    for key, ways in shares.items():
        print(f"{key}: {', '.join(f'{way} {share:.1f}' for way, share in ways.items())}")
    touching = float(contacts.mean())
    result = {
        "shares": shares,
        "per_film": rows,
        "films": about,
        "frames": len(contacts),
        "always_the_commoner_label": 100 * max(touching, 1 - touching),
        "label_height_m": HEIGHT,
        "label_speed_m_s": SPEED,
    }
    (Path(__file__).parent / "real.json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
