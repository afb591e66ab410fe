"""The stages from a film to a scene: each takes results of earlier ones and leaves files. See scene_preparation."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egopose.core.config import convert
from egopose.core.errors import InputError
from egopose.data.reference import reference_states
from egopose.humanoid.foot_geometry import sole_positions
from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.contacts import without_short_runs
from egopose.motion.io._npz import entry_names, read_arrays
from egopose.motion.io.native import read_native, write_native
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.scene.articulation import articulated
from egopose.scene.camera import CameraTrack, camera_motion
from egopose.scene.camera_file import given_camera, load_camera, save_camera
from egopose.scene.contacts import FEET, LOWER_BODY, ContactEstimator
from egopose.scene.footholds import on_footholds
from egopose.scene.lifting import LiftingNetwork, lifted_track
from egopose.scene.poses.blazepose import BlazePose
from egopose.scene.poses.keypoints import BODY_25, HUMANOID_JOINTS
from egopose.scene.poses.mending import MADE_UP, fill_gaps
from egopose.scene.poses.readers import read_poses
from egopose.scene.poses.sides import mend_sides
from egopose.scene.poses.timing import cut, known_span, resampled
from egopose.scene.poses.track import PoseTrack, load_track
from egopose.scene.projection import Projection, fit_projection
from egopose.scene.root import KinematicRoot, RootSettings, SeenPlaces, Support, kinematic_root, on_supports
from egopose.scene.scene_file import Scene, write_scene
from egopose.scene.supports import (
    Level,
    filled_scene,
    floor_height,
    level_heights,
    levels,
    matched,
    told_contacts,
    touched,
)
from egopose.scene.upright import first_to_world, focal_length, orientation, view_turns
from egopose.vision.video import Frame, iter_frames, probe_video

_SOURCE = "conf/reconstruct.yaml"
#: px and shares of the picture: a background that moves less than this stands still.
_STILL = 0.02
_LEAST_FRAMES = 9
#: One camera's poses are less sure than mocap's, and their errors last. Chosen on the bench of scenes, fixed camera.
_ROOT = RootSettings(level=0.15, level_in_flight=0.25, slip=0.5, sway=2.0, seen=0.1, seen_depth=0.15)
#: Factors of the usual focal length that are tried where nobody told it, and how widely they are spread (log).
_LENSES = (0.6, 0.7, 0.8, 0.9, 1.0, 1.15, 1.3, 1.5, 1.7)
_LENS = 0.3
Advance = Callable[[int], None]


@dataclass(frozen=True)
class Sources:
    """What a film is read from: ``video`` or ``poses`` or both, and the rate of all that follows, frames/s."""

    video: Path | None
    poses: Path | None
    fps: float

    @property
    def name(self) -> Path:
        """For errors."""
        path = self.video or self.poses
        assert path is not None
        return path

    def frames(self, advance: Advance = lambda _: None, begin: float = 0.0) -> Iterator[Frame]:
        """The film's frames from ``begin`` (s) on."""
        assert self.video is not None
        for frame in iter_frames(self.video, self.fps, begin):
            yield frame
            advance(1)


def find_poses(values: Mapping[str, Any], sources: Sources, advance: Advance, out: Path) -> None:
    """``poses.npz``: found in the film, or read."""
    at = convert(values["at"], tuple[float, float] | None, _SOURCE, "at")
    if sources.poses is None:
        turns = convert(values["estimator"]["turns"], tuple[int, ...], _SOURCE, "estimator.turns")
        threads = convert(values["estimator"]["threads"], int, _SOURCE, "estimator.threads")
        track = BlazePose(turns, at, threads).estimate(sources.frames(advance), sources.fps)
    else:
        track = _read(values, sources.poses, sources.video, at)
    resampled(track, sources.fps).save(out / "poses.npz")


def _read(values: Mapping[str, Any], poses: Path, video: Path | None, at: tuple[float, float] | None) -> PoseTrack:
    fps = convert(values["read"]["fps"], float | None, _SOURCE, "read.fps")
    size = convert(values["read"]["image_size"], tuple[int, int] | None, _SOURCE, "read.image_size")
    if video is not None:
        info = probe_video(video)
        fps, size = fps or info.fps, size or (info.width, info.height)
    if poses.is_dir():
        return read_poses(poses, fps=fps, at=at, image_size=size)
    saved = poses.suffix.lower() == ".npz" and "pose_layout" in entry_names(poses)
    track = read_poses(poses, **({} if saved or fps is None else {"fps": fps}))
    if track.axes != "camera" or not np.isfinite(track.pixels).any():
        cause = (
            "holds a motion in the world and no pixels: contacts are read from pixels. Give OpenPose's or VIBE's files"
        )
        raise InputError(poses, "poses", cause)
    return replace(track, image_size=track.image_size or size)


def follow_camera(values: Mapping[str, Any], sources: Sources, folder: Path, advance: Advance, out: Path) -> None:
    """``camera.npz``: given, else by the film's background; a camera that stands where there is no film."""
    track = load_track(folder / "poses.npz")
    given = convert(values["camera"]["track"], str | None, _SOURCE, "camera.track")
    if given is not None:
        camera = given_camera(Path(given).expanduser(), len(track))
    elif sources.video is None:
        frames = len(track)
        camera = CameraTrack(np.tile(np.eye(3), (frames, 1, 1)), np.zeros(frames, bool), np.ones(frames), "similarity")
    else:
        kind = convert(values["camera"]["kind"], str, _SOURCE, "camera.kind")
        film = _as_many(sources.frames(advance), len(track))
        camera = camera_motion(film, track.boxes(), kind)
    save_camera(camera, out / "camera.npz")


def _as_many(frames: Iterable[Frame], count: int) -> Iterator[Frame]:
    """``count`` frames: other programs find poses in a few more or less than there are."""
    last: Frame | None = None
    number = 0
    for last in frames:
        if number == count:
            return
        number += 1
        yield last
    while number < count and last is not None:
        number += 1
        yield last


def mend(folder: Path, sources: Sources, out: Path) -> None:
    """``mended.npz``: pixels of the first frame's picture, sides put right, gaps filled; ``clip.json``: its place.

    Frames before the person is first seen and after the last are left out.
    """
    track, camera = load_track(folder / "poses.npz"), load_camera(folder / "camera.npz")
    mended = fill_gaps(mend_sides(camera.undo_track(track)))
    start, stop = known_span(mended)
    if stop - start < _LEAST_FRAMES:
        raise InputError(sources.name, "person", f"was seen in {stop - start} frames; {_LEAST_FRAMES} are needed")
    cut(mended, start, stop).save(out / "mended.npz")
    video = None if sources.video is None else str(sources.video.resolve())
    (out / "clip.json").write_text(json.dumps({"start": start, "stop": stop, "of": len(track), "video": video}))


def clip_of(folder: Path) -> tuple[int, int]:
    """First frame of the clip in the film, and one past its last."""
    card = json.loads((folder / "clip.json").read_text())
    return int(card["start"]), int(card["stop"])


def film_of(folder: Path) -> Path | None:
    """Where the film was; None where there was none, or it is gone."""
    try:
        video = json.loads((folder / "clip.json").read_text()).get("video")
    except (OSError, ValueError):
        return None
    return Path(video) if isinstance(video, str) and Path(video).is_file() else None


def clip_camera(folder: Path) -> CameraTrack:
    """The camera over the clip's frames, still against the film's first picture."""
    camera, part = load_camera(folder / "camera.npz"), slice(*clip_of(folder))
    return replace(camera, to_first=camera.to_first[part], degenerate=camera.degenerate[part], alike=camera.alike[part])


def camera_moves(folder: Path, scene: Scene) -> str:
    """How the camera moves: as the scene says, else by whether its background moves. Turning is the usual way."""
    if scene.camera.motion is not None:
        return scene.camera.motion
    camera, track = clip_camera(folder), load_track(folder / "mended.npz")
    size = max(track.image_size or (1, 1))
    ways = np.ptp(camera.to_first[:, :2, 2], axis=0).max() / size
    zoom = np.ptp(np.log(camera.size()))
    return "fixed" if max(ways, zoom) < _STILL else "zoom" if zoom > 0.1 else "pan"


def tell_contacts(values: Mapping[str, Any], network: ContactEstimator, folder: Path, out: Path) -> None:
    """``contacts.npz``: the network's probabilities ``[T, 2]`` (right, left) and which feet touch something."""
    track, camera = load_track(folder / "mended.npz").to_schema(BODY_25), clip_camera(folder)
    rows = [BODY_25.index(name) for name in LOWER_BODY]
    pixels = camera.redo(track.pixels)[:, rows]
    confidence = np.where(np.isfinite(pixels).all(axis=-1), track.confidence[:, rows], 0.0)
    probability = network.probabilities(np.nan_to_num(pixels), confidence, camera.to_first)
    threshold = convert(values["contacts"]["threshold"], float, _SOURCE, "contacts.threshold")
    shortest = convert(values["contacts"]["shortest"], int, _SOURCE, "contacts.shortest")
    touching = without_short_runs(~without_short_runs(probability <= threshold, shortest), shortest)
    np.savez_compressed(out / "contacts.npz", probability=probability, touching=touching)


def touching_of(folder: Path, scene: Scene) -> NDArray[np.bool_]:
    """``[T, 2]``: the scene's contacts, else the network's."""
    found = read_arrays(folder / "contacts.npz", ("touching",))["touching"].astype(bool)
    told = told_contacts(scene, len(found))
    return found if told is None else told


def lift_joints(folder: Path, network: LiftingNetwork, out: Path) -> None:
    """``joints.npz``: 3D keypoints ``BODY_25`` in axes that look straight at the hips; NaN where little was seen."""
    track = load_track(folder / "mended.npz")
    seen = replace(track, pixels=clip_camera(folder).redo(track.pixels))
    lifted = lifted_track(seen, network)
    replace(lifted, pixels=track.to_schema(BODY_25).pixels).save(out / "joints.npz")


def pose_body(folder: Path, source: Path, scene: Scene, humanoid: HumanoidModel, out: Path) -> None:
    """``motion.npz``: the humanoid's poses, hips at the origin; ``orientation.npz`` and ``fit.json``: how it came."""
    track, camera = load_track(folder / "joints.npz"), clip_camera(folder)
    assert track.positions is not None
    frames = len(track)
    turns = np.tile(np.eye(3), (frames, 1, 1))
    motion = camera_moves(folder, scene)
    if track.image_size is not None:
        focal = focal_length(track.image_size, scene.camera.field_of_view)
        pelvis = camera.redo(track.pixels)[:, BODY_25.index("mid_hip")]
        turns = view_turns(_held(pelvis), camera, motion, track.image_size, focal)
    touching = touching_of(folder, scene)
    found = orientation(track.positions, touching, BODY_25, turns, scene.camera.pitch, scene.camera.roll)
    positions = np.einsum("tij,tkj->tki", found.to_world, track.positions)
    body, report = articulated(source, _held(positions), track.confidence, humanoid, track.fps)
    write_native(body, out / "motion.npz")
    np.savez_compressed(out / "orientation.npz", to_world=found.to_world, positions=positions)
    notes = {"camera": motion, "pitch": found.pitch, "roll": found.roll, "balanced": found.upright}
    notes |= {"off_mm": {part: mean for part, (mean, _) in report.position_mm.items()}}
    (out / "fit.json").write_text(json.dumps(notes))


def _held(values: Array) -> Array:
    """``[T, ...]`` with what is unknown held or interpolated in time; what is never known stays NaN."""
    flat, frames = values.reshape(len(values), -1).copy(), np.arange(len(values))
    for column in flat.T:
        known = np.isfinite(column)
        if known.any():
            column[~known] = np.interp(frames[~known], frames[known], column[known])
    return flat.reshape(values.shape)


def place_root(folder: Path, source: Path, scene: Scene, given: bool, humanoid: HumanoidModel, out: Path) -> None:
    """``body.npz``: the motion in the world, floor at 0; ``root.npz``: supports; ``projection.npz``: to the film.

    Where a scene is ``given``, feet stand on its floor and boxes alone.
    """
    motion, touching = read_native(folder / "motion.npz"), touching_of(folder, scene)
    if not touching.any():
        raise InputError(source, "contacts", "no foot touches anything: say which frames do in the scene file")
    # Where a scene tells the boxes, supports on one thing are put together by it, and not by their heights.
    settings = replace(_ROOT, level=0.0, level_in_flight=0.0) if given else _ROOT
    root, seen, focal = _seen_root(folder, motion, touching, humanoid, scene, settings)
    feet, com = about_pelvis(motion, humanoid)
    floor = floor_height(root.supports, touched(scene, root.supports))
    soles = (root.positions[:, None, None] + feet).mean(axis=2)[..., :2]
    _, on = _stood_on(scene, given, root.supports, floor, soles, motion.qpos)
    heights = level_heights(root.supports, floor, on)
    supports = tuple(replace(s, height=height) for s, height in zip(root.supports, heights, strict=True))
    root = on_supports(replace(root, supports=supports), feet, com, motion.fps, _ROOT, seen)
    qpos = motion.qpos.copy()
    qpos[:, :3] = root.positions - [0.0, 0.0, floor]
    stands = [replace(s, height=s.height - floor) for s in supports]
    trust = trust_of(folder)
    body = on_footholds(humanoid, replace(motion, qpos=qpos), stands, trust)
    names = tuple(f"{side.capitalize()}Foot" for side in FEET)
    body = replace(body, contacts=touching, contact_names=names, confidence=trust)
    write_native(body, out / "body.npz")
    rows = np.array([[s.foot, s.start, s.stop, s.height] for s in stands])
    np.savez_compressed(out / "root.npz", supports=rows, flight=root.flight)
    save_projection(_projection(folder, body), out / "projection.npz")
    (out / "lens.json").write_text(json.dumps({"focal_px": focal}))


def _stood_on(
    scene: Scene, given: bool, supports: Sequence[Support], floor: float, soles: Array, qpos: Array
) -> tuple[list[str | None], list[Level]]:
    """What each support is on, and what of it is not the floor; ``soles [T, 2, 2]`` m are the feet's places."""
    touches = touched(scene, supports)
    if given:
        touches = matched(scene, supports, touches, floor, soles)
    return touches, levels(supports, touches, floor, soles, rot.yaw(qpos[:, 3:7]))


def about_pelvis(motion: Motion, humanoid: HumanoidModel) -> tuple[Array, Array]:
    """Soles ``[T, 2, 2, 3]`` and centre of mass ``[T, 3]``, m, relative to the pelvis."""
    pelvis = motion.qpos[:, :3]
    com = reference_states(humanoid, motion)["com"].numpy() - pelvis
    return sole_points(humanoid, motion) - pelvis[:, None, None], com


def _seen_root(
    folder: Path,
    motion: Motion,
    touching: NDArray[np.bool_],
    humanoid: HumanoidModel,
    scene: Scene,
    settings: RootSettings,
) -> tuple[KinematicRoot, SeenPlaces | None, float | None]:
    """The root by feet, gravity and pictures; what pictures tell, with the focal length (px) that suits them best.

    A camera that travels tells nothing: the root is by feet and gravity, and there is no focal length.
    """
    feet, com = about_pelvis(motion, humanoid)
    track = load_track(folder / "joints.npz")
    size, pelvis = track.image_size, track.pixels[:, BODY_25.index("mid_hip")]
    if size is None or camera_moves(folder, scene) == "track" or not np.isfinite(pelvis).any():
        return kinematic_root(feet, touching, com, motion.fps, settings), None, None
    usual = focal_length(size, scene.camera.field_of_view)
    camera, moves = clip_camera(folder), camera_moves(folder, scene)
    hips = _held(camera.redo(track.pixels)[:, BODY_25.index("mid_hip")])
    told = json.loads((folder / "fit.json").read_text())
    first = first_to_world(told["pitch"], told["roll"])
    # Pixels a metre in the frame's own picture, whose focal length is the first one's and the zoom.
    scale = camera.size() * np.linalg.norm(_projection(folder, motion).matrix[:, 0], axis=1)
    found = []
    for factor in _LENSES if scene.camera.field_of_view is None else (1.0,):
        focal = factor * usual
        seen = _seen_places(first @ view_turns(hips, camera, moves, size, focal), focal / scale)
        root = kinematic_root(feet, touching, com, motion.fps, settings, seen)
        found.append((root.misfit + (np.log(factor) / _LENS) ** 2, focal, root, seen))
    _, focal, root, seen = min(found, key=lambda one: one[0])
    return root, seen, focal


def _seen_places(to_world: Array, depth: Array) -> SeenPlaces:
    """Of hips ``depth [T]`` m away, in the middle of cameras whose axes ``to_world [T, 3, 3]`` takes to the world's."""
    axes = to_world.transpose(0, 2, 1)
    return SeenPlaces(depth[:, None] * axes[:, 2], axes, depth)


def sole_points(humanoid: HumanoidModel, motion: Motion) -> Array:
    """``[T, 2, 2, 3]`` m: the right and the left foot's heel and ball."""
    names = [humanoid.skeleton.names[foot] for foot in humanoid.feet]
    order = [names.index(f"{side.capitalize()}Foot") for side in FEET]
    return sole_positions(humanoid, motion).reshape(len(motion), len(names), 2, 3)[:, order]


def _projection(folder: Path, body: Motion) -> Projection:
    """Of the body's joints onto the keypoints they stand for."""
    from_keypoint = {k: j for k, j in HUMANOID_JOINTS.items() if j in body.skeleton.names}
    positions, _ = body.forward_kinematics()
    points = positions[:, [body.skeleton.index(joint) for joint in from_keypoint.values()]]
    track = load_track(folder / "joints.npz")
    rows = [BODY_25.index(keypoint) for keypoint in from_keypoint]
    pixels = clip_camera(folder).redo(track.pixels)[:, rows]
    to_world = read_arrays(folder / "orientation.npz", ("to_world",))["to_world"]
    return fit_projection(points, pixels, track.confidence[:, rows], to_world, body.fps)


def save_projection(projection: Projection, path: Path) -> None:
    np.savez_compressed(path, **asdict(projection))


def load_projection(path: Path) -> Projection:
    """Read what :func:`save_projection` wrote."""
    return Projection(**read_arrays(path, ("matrix", "origin")))


def supports_of(folder: Path) -> tuple[Support, ...]:
    """Of ``root.npz``; heights over the floor."""
    rows = read_arrays(folder / "root.npz", ("supports",))["supports"]
    return tuple(Support(int(foot), int(start), int(stop), float(height)) for foot, start, stop, height in rows)


def trust_of(folder: Path) -> Array:
    """``[T]`` how far each frame is to be believed: the median confidence of its keypoints that are known."""
    track = load_track(folder / "joints.npz")
    seen = np.nanmedian(np.where(track.confidence > 0, track.confidence, np.nan), axis=1)
    trust: Array = np.clip(np.nan_to_num(seen, nan=MADE_UP), MADE_UP, 1.0)
    return trust


def fill_scene(folder: Path, scene: Scene, given: bool, humanoid: HumanoidModel, out: Path) -> None:
    """``scene.yaml``: the scene with what it left out. Boxes are proposed only where no scene was ``given``."""
    body, supports = read_native(folder / "body.npz"), supports_of(folder)
    soles = sole_points(humanoid, body).mean(axis=2)[..., :2]
    touches, on = _stood_on(scene, given, supports, 0.0, soles, body.qpos)
    filled = filled_scene(scene, supports, touches, on)
    fit = json.loads((folder / "fit.json").read_text())
    camera = replace(filled.camera, motion=fit["camera"])
    begin = clip_of(folder)[0] / body.fps
    write_scene(replace(filled, camera=camera, begin=round(begin, 6)), out / "scene.yaml")
