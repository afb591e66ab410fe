"""Pictures of what `egopose reconstruct prepare` did, a strip of moments for each stage."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from egopose.inference.scene_stages import Sources, clip_camera, clip_of, load_projection
from egopose.motion.io._npz import read_arrays
from egopose.motion.io.native import read_native
from egopose.motion.rotations import Array
from egopose.scene.camera import CameraTrack
from egopose.scene.contacts import FEET
from egopose.scene.drawing import body_points, box_corners, draw_bones, draw_box, draw_floor
from egopose.scene.poses.drawing import draw_pose
from egopose.scene.poses.keypoints import BODY_25
from egopose.scene.poses.track import PoseTrack, load_track
from egopose.scene.scene_file import Scene
from egopose.vision.rendering import label_frame
from egopose.vision.video import Frame

_TOUCH, _FREE = (230, 40, 30), (240, 240, 240)
_KEYPOINTS, _MODEL = (150, 150, 150), (20, 110, 220)
_WIDEST = 1600  # px of a mosaic
_PAPER = 250  # grey of what has no picture
_METRES = 2.6  # of a panel of a body


@dataclass(frozen=True)
class Moments:
    """Some frames of the clip: their numbers, and the film's pictures there, grey without a film."""

    numbers: tuple[int, ...]
    frames: tuple[Frame, ...]

    def strip(self, height: int, draw: Callable[[Frame, int], Frame], start: int = 0) -> Frame:
        """All of them beside each other in rows of four; ``draw`` gets a picture and its frame number."""
        panels = []
        for number, frame in zip(self.numbers, self.frames, strict=True):
            panels.append(label_frame(_scaled(draw(frame, number), height), str(number + start)))
        return rows_of(panels)


def read_moments(sources: Sources, folder: Path, count: int) -> Moments:
    """Evenly over the clip."""
    start, stop = clip_of(folder)
    numbers = tuple(dict.fromkeys(np.linspace(0, stop - start - 1, count).round().astype(int).tolist()))
    if sources.video is None:
        size = _extent(load_track(folder / "poses.npz"))
        return Moments(numbers, tuple(np.full((size[1], size[0], 3), _PAPER // 2, np.uint8) for _ in numbers))
    wanted, frames = {number + start for number in numbers}, []
    for number, frame in enumerate(sources.frames()):
        if number in wanted:
            frames.append(frame)
        if number >= max(wanted):
            break
    frames += [frames[-1]] * (len(numbers) - len(frames))
    return Moments(numbers, tuple(frames))


def rows_of(panels: Sequence[Frame], across: int = 4) -> Frame:
    """Panels of one size in rows."""
    blank = np.full_like(panels[0], _PAPER)
    padded = [*panels, *[blank] * (-len(panels) % min(across, len(panels)))]
    width = min(across, len(panels))
    return np.concatenate([np.concatenate(padded[k : k + width], axis=1) for k in range(0, len(padded), width)])


def found_poses(moments: Moments, folder: Path, height: int) -> Frame:
    track = load_track(folder / "poses.npz")
    start, _ = clip_of(folder)
    return moments.strip(height, lambda frame, t: draw_pose(frame, track, t + start))


def mended_poses(moments: Moments, folder: Path, height: int) -> Frame:
    track = seen_track(folder, "mended.npz")
    return moments.strip(height, lambda frame, t: draw_pose(frame, track, t))


def seen_track(folder: Path, name: str) -> PoseTrack:
    """A track of the clip with the pixels of each frame's own picture."""
    track = load_track(folder / name)
    return replace(track, pixels=clip_camera(folder).redo(track.pixels))


def mosaic(moments: Moments, folder: Path) -> Frame:
    """The pictures laid where the first one's camera would see them, and the hips' way through them."""
    camera, track = clip_camera(folder), load_track(folder / "mended.npz")
    height, width = moments.frames[0].shape[:2]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    placed = np.stack([_placed(camera, t, corners) for t in moments.numbers])
    low, high = placed.min(axis=(0, 1)), placed.max(axis=(0, 1))
    low, high = np.maximum(low, -4.0 * width), np.minimum(high, 5.0 * width)
    scale = min(1.0, _WIDEST / float((high - low).max()))
    to_canvas = np.array([[scale, 0, -scale * low[0]], [0, scale, -scale * low[1]], [0, 0, 1]])
    size = (int(np.ceil(scale * (high - low)[0])), int(np.ceil(scale * (high - low)[1])))
    canvas = np.full((size[1], size[0], 3), _PAPER, np.uint8)
    for t, frame in zip(moments.numbers, moments.frames, strict=True):
        matrix = to_canvas @ camera.to_first[t]
        warped = cv2.warpPerspective(frame, matrix, size, flags=cv2.INTER_AREA)
        inside = cv2.warpPerspective(np.full((height, width), 255, np.uint8), matrix, size) > 250
        canvas[inside] = warped[inside]
    hips = track.to_schema(BODY_25).pixels[:, BODY_25.index("mid_hip")] * scale - scale * low
    known = hips[np.isfinite(hips).all(axis=1)].round().astype(np.int32)
    cv2.polylines(canvas, [known], False, _TOUCH, 2, cv2.LINE_AA)
    return canvas


def _placed(camera: CameraTrack, t: int, points: Array) -> Array:
    return replace(camera, to_first=camera.to_first[t : t + 1]).undo(points[None])[0]


def contacts_seen(moments: Moments, folder: Path, touching: NDArray[np.bool_], height: int) -> Frame:
    """Red: a foot that touches something."""
    track = seen_track(folder, "joints.npz")
    ankles = track.pixels[:, [BODY_25.index(f"{side}_ankle") for side in FEET]]

    def draw(frame: Frame, t: int) -> Frame:
        out = frame.copy()
        radius = max(3, frame.shape[0] // 60)
        for place, on in zip(ankles[t], touching[t], strict=True):
            if np.isfinite(place).all():
                middle = (int(place[0]), int(place[1]))
                cv2.circle(out, middle, radius, _TOUCH if on else _FREE, -1 if on else 2, cv2.LINE_AA)
        return out

    return moments.strip(height, draw)


def bodies(moments: Moments, folder: Path, height: int) -> Frame:
    """Each moment from the first camera's side and, below, from the right: keypoints grey, the humanoid blue."""
    points = read_arrays(folder / "orientation.npz", ("positions",))["positions"]
    motion = read_native(folder / "motion.npz")
    joints, parents = body_points(motion)
    panels = []
    for axes, name in (((0, 2), "front"), ((1, 2), "side")):
        for t in moments.numbers:
            panel = np.full((height, height, 3), _PAPER, np.uint8)
            places = [(values[t][:, axes] * [1, -1] / _METRES + [0.5, 0.45]) * height for values in (points, joints)]
            for a, b in BODY_25.limbs:
                if np.isfinite(places[0][[a, b]]).all():
                    ends = [(int(x), int(y)) for x, y in places[0][[a, b]].round()]
                    cv2.line(panel, ends[0], ends[1], _KEYPOINTS, 2, cv2.LINE_AA)
            panels.append(label_frame(draw_bones(panel, places[1], parents, _MODEL), f"{t} {name}"))
    return rows_of(panels, len(moments.numbers))


def scene_seen(moments: Moments, folder: Path, scene: Scene, height: int) -> Frame:
    """The humanoid, the floor's metres and the boxes in the film."""
    body, projection = read_native(folder / "body.npz"), load_projection(folder / "projection.npz")
    joints, parents = body_points(body)
    places = projection.pixels(joints)

    def draw(frame: Frame, t: int) -> Frame:
        out = draw_floor(frame, body.qpos[t, :2], projection, t)
        for box in scene.boxes:
            if box.known:
                out = draw_box(out, box, projection, t)
        return draw_bones(out, places[t], parents)

    return moments.strip(height, draw)


def plan(folder: Path, scene: Scene, height: int) -> Frame:
    """From above and from the side: the pelvis's way, where feet stood, and the boxes; a square is a metre."""
    body = read_native(folder / "body.npz")
    joints, _ = body.forward_kinematics()
    feet = joints[:, [body.skeleton.index(f"{side.capitalize()}Foot") for side in FEET]]
    assert body.contacts is not None
    boxes = [box_corners(box) for box in scene.boxes if box.known]
    every = np.concatenate([joints[:, 0], feet.reshape(-1, 3), *boxes])
    panels = []
    for axes, name in (((0, 1), "from above: y away from the camera"), ((0, 2), "from the camera: height")):
        low, high = every[:, axes].min(axis=0) - 0.5, every[:, axes].max(axis=0) + 0.5
        scale = min(2 * height / (high - low)[1], 3 * height / (high - low)[0])
        size = (int(scale * (high - low)[0]), int(scale * (high - low)[1]))
        panel = np.full((size[1], size[0], 3), _PAPER, np.uint8)

        def to_panel(
            points: Array, low: Array = low, scale: float = scale, top: int = size[1], a: tuple[int, int] = axes
        ) -> np.ndarray:
            flat = (points[..., a] - low) * scale
            return np.stack([flat[..., 0], top - flat[..., 1]], axis=-1).round().astype(np.int32)

        for axis in (0, 1):
            for metre in range(int(np.ceil(low[axis])), int(np.floor(high[axis])) + 1):
                at = round((metre - low[axis]) * scale)
                ends = ((0, size[1] - at), (size[0], size[1] - at)) if axis else ((at, 0), (at, size[1]))
                cv2.line(panel, ends[0], ends[1], (215, 215, 215), 1 if metre else 2)
        for corners in boxes:
            cv2.polylines(panel, [cv2.convexHull(to_panel(corners))], True, (200, 130, 0), 2, cv2.LINE_AA)
        cv2.polylines(panel, [to_panel(joints[:, 0])], False, _MODEL, 2, cv2.LINE_AA)
        for foot, colour in enumerate(((230, 120, 40), (40, 150, 230))):
            for place in to_panel(feet[body.contacts[:, foot], foot]):
                cv2.circle(panel, (int(place[0]), int(place[1])), 3, colour, -1, cv2.LINE_AA)
        panels.append((panel, name))
    width = max(2 * height, *(panel.shape[1] for panel, _ in panels))
    wide = [(np.pad(p, ((0, 8), (0, width - p.shape[1]), (0, 0)), constant_values=_PAPER), name) for p, name in panels]
    return np.concatenate([label_frame(panel, name) for panel, name in wide])


def _scaled(frame: Frame, height: int) -> Frame:
    scale = height / frame.shape[0]
    return np.asarray(cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _extent(track: PoseTrack) -> tuple[int, int]:
    """Of the pictures, or of all that was seen in them."""
    if track.image_size is not None:
        return track.image_size
    width, height = np.nanmax(np.where(np.isfinite(track.pixels), track.pixels, 1.0), axis=(0, 1)) * 1.1
    return int(np.clip(width, 64, 4096)), int(np.clip(height, 64, 4096))
