"""Training data of body-part estimators: pairs of pictures of random bodies in random rooms, with known limbs.

A body takes its posture from a clip, its limbs pulled towards random angles; rooms, clothes, lamps and the way the
camera is worn are those of rendered takes, the rooms of seeds that no take has. A sample is the wearer's view at two
control steps, the flow between them, the share of each cell of the later one that each limb covers, and its posture.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import uuid
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from scipy.spatial.transform import Rotation

from egopose.core.atomic_write import write_text_whole
from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.core.runtime import end_with_parent
from egopose.core.safe_io import read_json
from egopose.motion.io._npz import read_arrays
from egopose.motion.rotations import Array, from_axis_angle, from_scipy, multiply, rotate
from egopose.motion.skeleton import Skeleton
from egopose.vision.body_parts import FLOW, LIMBS
from egopose.vision.film import PICTURE
from egopose.vision.flow import FlowConfig, FlowEstimator, grey_square
from egopose.vision.gl import choose_backend
from egopose.vision.mounts import WEARER_CAMERA, camera_orientations
from egopose.vision.rendering import SceneRenderer, WearerCamera, furnished_model
from egopose.vision.rooms import draw_room
from egopose.vision.surfaces import Range
from egopose.vision.takes import RenderConfig

#: Bodies whose positions in the camera's frame (x right, y up, z back; m) make the first part of a posture.
BODIES = (
    *("RightHand", "LeftHand", "RightForeArm", "LeftForeArm", "RightLeg", "LeftLeg"),
    *("RightFoot", "LeftFoot", "RightArm", "LeftArm", "Hips"),
)
#: The bodies of each of :data:`egopose.vision.body_parts.LIMBS`.
LIMB_BODIES = (
    ("RightArm", "RightForeArm", "RightHand"),
    ("LeftArm", "LeftForeArm", "LeftHand"),
    ("RightUpLeg", "RightLeg", "RightFoot"),
    ("LeftUpLeg", "LeftLeg", "LeftFoot"),
    ("Hips", "Spine", "Spine1", "Spine2", "Spine3", "RightShoulder", "LeftShoulder", "Neck"),
)
#: Arrays of a part, and their shapes but for the first axis; None: as many as the humanoid has.
ARRAYS: dict[str, tuple[type, tuple[int | None, ...]]] = {
    "pictures": (np.uint8, (6, PICTURE, PICTURE)),
    "flow": (np.float16, (2, FLOW, FLOW)),
    "masks": (np.uint8, (len(LIMBS), FLOW, FLOW)),
    "posture": (np.float32, (None,)),
    "qpos": (np.float32, (None,)),
    "camera": (np.float32, (5,)),
    "room": (np.int64, ()),
}
_RECORD = "pictures.json"


@dataclass(frozen=True)
class PictureSettings:
    """The group ``pictures`` of ``conf/body_parts.yaml``, which says where its numbers come from.

    Args:
        samples: pictures in all.
        rooms_a_part: of a file; it is drawn whole or not at all.
        wearings: ways to wear the camera in a room.
        pairs: pictures a way.
        first_room: the lowest seed of a room; must lie above those of takes.
        least_frames: clips shorter than that are left out.
        steps, stride: of the random walk over the floor that a room is drawn around: their number, and the most that
            each goes along x and y (m).
        headroom: that stays free under the ceiling (m).
        arm_still, leg_still, trunk_still: probability that a limb stays as it is in the clip.
        arm_pull, leg_pull, trunk_pull: most that its angles are pulled, as a share of the way to random ones.
        steady: probability that the pull is the same in both pictures.
        change: frames in which one pull turns into another.
        lean_chance, lean: of the whole body about x and y (standard deviation, rad).
        lift_chance, lift: of the whole body (m).
        jpeg: quality that pictures are packed with.
    """

    samples: int
    rooms_a_part: int
    wearings: int
    pairs: int
    first_room: int
    least_frames: int
    steps: int
    stride: float
    headroom: float
    arm_still: float
    arm_pull: float
    leg_still: float
    leg_pull: float
    trunk_still: float
    trunk_pull: float
    steady: float
    change: tuple[int, int]
    lean_chance: float
    lean: float
    lift_chance: float
    lift: Range
    jpeg: tuple[int, int]

    @classmethod
    def from_config(cls, values: Mapping[str, Any]) -> PictureSettings:
        """Raises InputError: a key is missing, unknown or out of range; names it."""
        settings = from_mapping(cls, values, "conf/body_parts.yaml: pictures")
        for name in ("samples", "rooms_a_part", "wearings", "pairs", "least_frames", "steps"):
            least = 2 if name == "least_frames" else 1
            if getattr(settings, name) < least:
                cause = f"must be at least {least}, not {getattr(settings, name)}"
                raise InputError("conf/body_parts.yaml: pictures", name, cause)
        return settings

    @property
    def per_part(self) -> int:
        """Pictures of a whole part."""
        return self.rooms_a_part * self.wearings * self.pairs

    @property
    def parts(self) -> int:
        """Files in all; the last one may hold fewer pictures."""
        return -(-self.samples // self.per_part)

    def in_part(self, part: int) -> int:
        """Pictures in that part."""
        return min(self.per_part, self.samples - part * self.per_part)


@dataclass(frozen=True, eq=False)
class Scenes:
    """All that pictures are drawn from.

    Args:
        model_xml: the humanoid's MJCF.
        skeleton: its skeleton.
        joint_range: ``[D, 2]`` rad.
        clips: qpos ``[T, nq]`` each, at the control rate.
        render: rooms, cameras, size of the pictures, frame rate.
        flow: how flow is found in them.
        settings: see :class:`PictureSettings`.

    Raises:
        InputError: rooms that takes may have; flow of another size than finders see; no clip that is long enough.
    """

    model_xml: str
    skeleton: Skeleton
    joint_range: Array
    clips: tuple[Array, ...]
    render: RenderConfig
    flow: FlowConfig
    settings: PictureSettings

    def __post_init__(self) -> None:
        rooms = self.render.room.train_rooms + self.render.room.test_rooms
        if self.settings.first_room < rooms:
            cause = f"is {self.settings.first_room}, and takes are seen in the rooms up to {rooms - 1}"
            raise InputError("conf/body_parts.yaml: pictures", "first_room", cause)
        if self.flow.stored_size != FLOW:
            raise InputError("vision.flow", "stored_size", f"is {self.flow.stored_size}; the estimator reads {FLOW}")
        if not self.clips or min(len(clip) for clip in self.clips) < 2:
            raise InputError("conf/body_parts.yaml", "motions", "no clip of two frames or more")


def posture_names(skeleton: Skeleton) -> list[str]:
    """What each number of a posture is: ``RightHand x`` ..., ``up x`` ..., ``camera height``, then joint angles
    (``Spine_0`` ...).
    """
    places = [f"{name} {axis}" for name in (*BODIES, "up") for axis in "xyz"]
    angles = [f"{joint.name}_{k}" for joint in skeleton.joints for k in range(len(joint.dofs))]
    return [*places, "camera height", *angles]


def draw_pair(rng: np.random.Generator, scenes: Scenes, place: Array) -> Array:
    """The body at two control steps ``[2, nq]``: some clip's motion, turned, leaning, its limbs pulled elsewhere.

    Args:
        rng: what it is drawn with.
        scenes: clips, joints and settings.
        place: ``[2]`` on the floor (m), of the later one.
    """
    settings = scenes.settings
    weights = np.sqrt([len(clip) for clip in scenes.clips])  # a long clip has more to show, not in step with its length
    clip = scenes.clips[rng.choice(len(scenes.clips), p=weights / weights.sum())]
    at = int(rng.integers(1, len(clip)))
    share, target = np.stack([_pull(rng, scenes) for _ in range(2)], axis=1)
    if rng.random() < settings.steady:
        share, target = share[[0, 0]], target[[0, 0]]
    frames, begun = rng.integers(*settings.change), rng.random()
    gone = np.clip(begun + np.arange(2) / frames, 0.0, 1.0)[:, None]
    turn = from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array(rng.uniform(-np.pi, np.pi)))
    lean = rng.normal(scale=settings.lean, size=2) * (rng.random() < settings.lean_chance)
    tilt = from_scipy(Rotation.from_euler("XYZ", [*lean, 0.0]), ())
    lift = rng.uniform(*settings.lift) * (rng.random() < settings.lift_chance)

    pair = clip[at - 1 : at + 1].copy()
    pulled = [pair[:, 7:] + share[k] * (target[k] - pair[:, 7:]) for k in range(2)]
    pair[:, 7:] = (1.0 - gone) * pulled[0] + gone * pulled[1]
    moved = pair[:, :3] - np.array([*clip[at, :2], 0.0])
    pair[:, :3] = rotate(turn, moved) + np.array([*place, lift])
    pair[:, 3:7] = multiply(multiply(turn, pair[:, 3:7]), tilt)
    return pair


def _pull(rng: np.random.Generator, scenes: Scenes) -> Array:
    """``[2, D]``: how far each angle is pulled, and towards what."""
    settings, names = scenes.settings, [scenes.skeleton.names[joint] for joint in scenes.skeleton.dof_joint]
    share, target = np.zeros(len(names)), rng.uniform(*scenes.joint_range.T)
    for side in ("Right", "Left"):
        arm = 0.0 if rng.random() < settings.arm_still else rng.uniform(0.0, settings.arm_pull)
        leg = 0.0 if rng.random() < settings.leg_still else rng.uniform(0.0, settings.leg_pull)
        of_side = [name.startswith(side) for name in names]
        is_leg = ["Leg" in name or "Foot" in name for name in names]
        share[of_side] = np.where(is_leg, leg, arm)[of_side]
    trunk = 0.0 if rng.random() < settings.trunk_still else rng.uniform(0.0, settings.trunk_pull)
    share[[not name.startswith(("Right", "Left")) for name in names]] = trunk
    return np.stack([share, target])


def draw_part(scenes: Scenes, seed: int, part: int) -> dict[str, NDArray[Any]]:
    """The pictures of one part, always the same for a seed: see :data:`ARRAYS`.

    ``camera`` is the later picture's camera in the head's frame (quaternion) and its field of view (degrees).

    Raises:
        RuntimeError: no OpenGL here.
    """
    settings = scenes.settings
    rng, flow = np.random.default_rng([seed, part]), FlowEstimator(scenes.flow)
    out: dict[str, list[Any]] = {name: [] for name in ARRAYS}
    size, count = scenes.render.size, settings.in_part(part)
    while len(out["room"]) < count:
        room_seed = int(rng.integers(settings.first_room, 1 << 30))
        path = rng.uniform(-settings.stride, settings.stride, (settings.steps, 2)).cumsum(0)
        room = draw_room(room_seed, path, settings.headroom, scenes.render.room)
        model = furnished_model(scenes.model_xml, room, scenes.render.room)
        with SceneRenderer(model, size, size) as renderer:
            for _ in range(settings.wearings):
                worn = WearerCamera.draw(rng, scenes.render.camera)
                for _ in range(settings.pairs):
                    pair = draw_pair(rng, scenes, path[rng.integers(len(path))])
                    mounted = camera_orientations(model, worn.angles(rng, 2, scenes.render.fps))
                    quality = int(rng.integers(*settings.jpeg))
                    sample = _look(renderer, pair, mounted, worn.field_of_view, quality, flow)
                    sample["room"] = room_seed
                    for name, value in sample.items():
                        out[name].append(value)
    return {name: np.stack(values[:count]).astype(ARRAYS[name][0], copy=False) for name, values in out.items()}


def _look(
    renderer: SceneRenderer, pair: Array, mounted: Array, field_of_view: float, quality: int, flow: FlowEstimator
) -> dict[str, Any]:
    """A sample, but for its room."""
    camera = renderer.model.camera(WEARER_CAMERA).id
    renderer.model.cam_fovy[camera] = field_of_view
    frames = []
    for pose, orientation in zip(pair, mounted, strict=True):
        renderer.model.cam_quat[camera] = orientation
        frames.append(_packed(renderer.render(pose, WEARER_CAMERA), quality))
    before, now = (grey_square(frame, flow.config.working_size) for frame in frames)
    small = [cv2.resize(frame, (PICTURE, PICTURE), interpolation=cv2.INTER_AREA) for frame in frames]
    return {
        "pictures": np.concatenate(small, axis=2).transpose(2, 0, 1),
        "flow": flow(before, now),
        "masks": limb_masks(renderer.model, renderer.segment(pair[1], WEARER_CAMERA)),
        "posture": posture_in(renderer.model, renderer.data),
        "qpos": pair[1],
        "camera": [*mounted[1], field_of_view],
    }


def limb_masks(model: mujoco.MjModel, geoms: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Shares ``[5, 32, 32]`` (255: all) of the cells of a picture that limbs cover, from its geoms ``[H, W]``."""
    limb_of_body = np.full(model.nbody, -1)
    for limb, bodies in enumerate(LIMB_BODIES):
        limb_of_body[[model.body(name).id for name in bodies]] = limb
    limb_of_geom = np.append(limb_of_body[model.geom_bodyid], -1)  # the last one, by -1, is no geom
    shown = limb_of_geom[geoms]
    whole = [255.0 * (shown == limb).astype(np.float32) for limb in range(len(LIMBS))]
    return np.stack([cv2.resize(mask, (FLOW, FLOW), interpolation=cv2.INTER_AREA) for mask in whole]).astype(np.uint8)


def posture_in(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.float32]:
    """The posture ``[Q]`` (:func:`posture_names`) of kinematics that are computed, seen by the wearer's camera."""
    camera = model.camera(WEARER_CAMERA).id
    axes, origin = data.cam_xmat[camera].reshape(3, 3), data.cam_xpos[camera]
    places = (data.xpos[[model.body(name).id for name in BODIES]] - origin) @ axes
    return np.concatenate([places.ravel(), axes[2], origin[2:], data.qpos[7:]]).astype(np.float32)


def _packed(frame: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """The RGB frame as it comes out of a JPEG."""
    _, packed = cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), dtype=np.uint8)[..., ::-1]


def draw_pictures(
    scenes: Scenes, seed: int, folder: Path, made_from: Mapping[str, Any], workers: int, progress: bool = True
) -> int:
    """Draw the parts that are not in the folder yet; returns how many were drawn.

    An interruption loses only the parts being drawn: each appears whole, by renaming.

    Args:
        scenes: what is drawn.
        seed: of every draw.
        folder: of the parts; made if it is not there.
        made_from: the motions, by name; with the settings it decides whether parts there are these.
        workers: processes; 1 draws in this one.
        progress: show a bar.

    Raises:
        InputError: the folder holds pictures of other settings.
        RuntimeError: no OpenGL here.
    """
    fingerprint = _fingerprint(scenes, seed, made_from)
    folder.mkdir(parents=True, exist_ok=True)
    record = folder / _RECORD
    if record.is_file() and read_json(record, "fingerprint").get("fingerprint") != fingerprint:
        raise InputError(folder, "out", "holds pictures of other motions or settings: remove it or name another")
    write_text_whole(record, json.dumps({"fingerprint": fingerprint, "seed": seed, **made_from}, indent=1))
    todo = [part for part in range(scenes.settings.parts) if not part_path(folder, part).is_file()]
    if not todo:
        return 0
    choose_backend()
    columns = [TextColumn("drawing"), BarColumn(), MofNCompleteColumn(), TextColumn("parts"), TimeRemainingColumn()]
    with Progress(*columns, disable=not progress) as bar:
        task = bar.add_task("drawing", total=len(todo))
        if workers == 1:
            for part in todo:
                _write_part(scenes, seed, folder, part)
                bar.advance(task)
            return len(todo)
        # Spawned and not forked: neither OpenGL nor a parent's threads survive a fork.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, mp_context=context, initializer=end_with_parent) as pool:
            futures = [pool.submit(_write_part, scenes, seed, folder, part) for part in todo]
            try:
                for future in as_completed(futures):
                    future.result()
                    bar.advance(task)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    return len(todo)


def part_path(folder: Path, part: int) -> Path:
    """The file of a part."""
    return folder / f"part-{part:05d}.npz"


def _write_part(scenes: Scenes, seed: int, folder: Path, part: int) -> None:
    arrays = draw_part(scenes, seed, part)
    path = part_path(folder, part)
    unfinished = path.with_name(f".{path.stem}-{uuid.uuid4().hex}.npz")
    try:
        with unfinished.open("wb") as stream:
            np.savez(stream, **arrays)  # type: ignore[arg-type]  # the stub takes allow_pickle for an array
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def _fingerprint(scenes: Scenes, seed: int, made_from: Mapping[str, Any]) -> str:
    settings = [asdict(scenes.render), asdict(scenes.flow), asdict(scenes.settings), seed, made_from]
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    digest.update(scenes.model_xml.encode())
    return digest.hexdigest()


def read_pictures(folder: Path, settings: PictureSettings, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The arrays of that name of all parts, one after the other; they must fit into memory (34 kB a sample).

    Raises:
        InputError: a part is missing, damaged or of another size.
    """
    out: dict[str, NDArray[Any]] = {}
    for part in range(settings.parts):
        path, here = part_path(folder, part), settings.in_part(part)
        rows = slice(part * settings.per_part, part * settings.per_part + here)
        for name, array in _read_part(path, names).items():
            kind, shape = ARRAYS[name]
            fits = len(array.shape) == 1 + len(shape) and all(
                want in (None, have) for want, have in zip(shape, array.shape[1:], strict=True)
            )
            whole = out.setdefault(name, np.empty((settings.samples, *array.shape[1:]), kind))
            if array.dtype != kind or len(array) != here or not fits or array.shape[1:] != whole.shape[1:]:
                cause = f"is {array.dtype} {list(array.shape)}: remove the file to have it drawn again"
                raise InputError(path, name, cause)
            whole[rows] = array
    return out


def _read_part(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    try:
        held = read_arrays(path, names)
        return {name: held[name] for name in names}
    except (InputError, KeyError) as error:
        cause = f"cannot be read ({error}): remove the file to have it drawn again"
        raise InputError(path, "pictures", cause) from None
