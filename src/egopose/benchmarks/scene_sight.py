"""What a camera and a pose estimator would tell of a true clip: keypoints, 3D landmarks, and the background's motion.

Cameras are those of :mod:`egopose.scene.virtual_camera`. A real estimator's errors are put on top: where its joints lie
beside the skeleton's, an error that lasts for a second, and a quick one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.scene.camera import CameraTrack
from egopose.scene.poses.from_motion import motion_keypoints
from egopose.scene.poses.keypoints import BODY_25
from egopose.scene.poses.track import PoseTrack
from egopose.scene.scene_file import Box, CameraNotes, Contact, Scene
from egopose.scene.virtual_camera import CameraPath, background_motion, draw_camera, project, slow_noise

#: Frames for which a hand may lift and is still said to hold.
_LIFTED = 12
#: px, of the pictures.
SIZE = (1280, 720)
#: A point beside a joint: joint and place in its frame (x ahead, y left, z up), m; Winter 2009, figure 4.1, at 1.75 m.
_BESIDE = {
    "nose": ("Head", (0.114, 0.0, 0.07)),
    "right_eye": ("Head", (0.10, -0.033, 0.10)),
    "left_eye": ("Head", (0.10, 0.033, 0.10)),
    "right_ear": ("Head", (0.009, -0.075, 0.07)),
    "left_ear": ("Head", (0.009, 0.075, 0.07)),
    **{f"{s.lower()}_big_toe": (f"{s}Foot", (0.184, y, -0.053)) for s, y in (("Left", -0.02), ("Right", 0.02))},
    **{f"{s.lower()}_small_toe": (f"{s}Foot", (0.15, y, -0.053)) for s, y in (("Left", 0.04), ("Right", -0.04))},
    **{f"{s.lower()}_heel": (f"{s}Foot", (-0.053, 0.0, -0.053)) for s in ("Left", "Right")},
}


@dataclass(frozen=True)
class SightNoise:
    """A pose estimator's errors.

    Args:
        error: mean distance of a keypoint from its joint, body heights, drawn for each clip: BlazePose on four
            calibrated views was 1.0-2.8 % off (experiments/lifting).
        lasting, definition: shares of the error's variance that last for a second, and that are constant
            (conf/contacts.yaml).
        across, depth: m, standard deviations an axis of a 3D landmark; relative to the hips about
            95 mm off in the mean, as on the same views (experiments/lifting: 92-106 mm).
        background: of a background point, picture heights: 1 pixel of 1,000.
        dropped: share of the keypoints that are not seen.
        wrong: frames, in the middle of the clip, in which another person is followed.
        gap: frames, from a third of the clip on, in which nobody is found.
    """

    error: tuple[float, float] = (0.01, 0.03)
    lasting: float = 0.35
    definition: float = 0.4
    across: float = 0.034
    depth: float = 0.07
    background: float = 0.001
    dropped: float = 0.02
    wrong: int = 0
    gap: int = 0


#: Frames without anybody, where a gap is asked for: Yu, Park & Lee 2021 could not bridge so many.
GAP = 30
#: A fifth of the keypoints unseen, and another person for some frames.
HARD = SightNoise(dropped=0.2, wrong=4)
#: Nothing is off.
EXACT = SightNoise((0.0, 0.0), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0)


@dataclass(frozen=True)
class Sight:
    """What is known of a clip from one camera.

    Args:
        track: keypoints and landmarks.
        camera: how the background says the camera moved.
        turn: rad about the vertical, from the world that a reconstruction is in (x is the first picture's right, y
            points away) to the true one. It is for judging alone.
    """

    track: PoseTrack
    camera: CameraTrack
    turn: float


def keypoints_of(motion: Motion) -> Array:
    """``[T, 25, 3]`` m, world: all of ``BODY_25`` on the default humanoid, face and heels too."""
    out = motion_keypoints(motion)
    positions, quats = motion.forward_kinematics()
    for name, (joint, place) in _BESIDE.items():
        row = motion.skeleton.index(joint)
        out[:, BODY_25.index(name)] = positions[:, row] + rot.rotate(quats[:, row], np.array([place]))
    return out


def seen(motion: Motion, kind: str, noise: SightNoise, rng: np.random.Generator) -> Sight:
    """The motion through a camera of ``kind``, one of :data:`egopose.scene.virtual_camera.KINDS`."""
    frames, height = len(motion), SIZE[1]
    points = keypoints_of(motion)
    camera = draw_camera(kind, motion.qpos[:, :3], motion.fps, rng)
    tall = _height(motion)
    level = rng.uniform(*noise.error) * np.sqrt(2 / np.pi)
    beside = np.sqrt(noise.definition) * level * tall * rng.normal(size=(points.shape[1], 3))
    pictures, depth = project(camera, points + beside)
    shape = pictures.shape
    lasting = np.sqrt(noise.lasting) * slow_noise(rng, shape, 1.0, motion.fps)
    quick = np.sqrt(1 - noise.lasting - noise.definition) * slow_noise(rng, shape, 0.05, motion.fps)
    # Estimators are surer where they are better.
    size = np.exp(0.5 * slow_noise(rng, shape[:2], 0.3, motion.fps) - 0.125)
    pictures = pictures + (camera.focal[:, None] * tall * level / depth * size)[..., None] * (lasting + quick)
    confidence = np.clip(0.9 - 0.15 * (size - 1) + 0.05 * rng.normal(size=size.shape), 0.05, 1.0)
    if not noise.error[1]:
        confidence[:] = 0.9
    pixels = pictures * height + 0.5 * np.array(SIZE)
    landmarks = _landmarks(points, camera, noise, motion.fps, rng)
    _follow_another(pixels, landmarks, noise.wrong)
    unseen = rng.random(confidence.shape) < noise.dropped
    unseen |= (depth < 0.2) | (pixels < 0).any(axis=-1) | (pixels > np.array(SIZE)).any(axis=-1)
    unseen[frames // 3 : frames // 3 + noise.gap] = True
    nobody = unseen.all(axis=1)
    pixels[unseen], confidence[unseen], landmarks[nobody] = np.nan, 0.0, np.nan
    track = PoseTrack(BODY_25, pixels, confidence, motion.fps, SIZE, landmarks)
    told = np.tile(np.eye(3), (frames, 1, 1))
    if kind != "fixed":
        told = background_motion(camera, motion.qpos[:, :3].mean(axis=0), rng, noise=noise.background)
    ahead = camera.axes[0, 2]
    return Sight(track, _in_pixels(told), float(np.arctan2(ahead[1], ahead[0]) - 0.5 * np.pi))


def _height(motion: Motion) -> float:
    """m: hips stand at 53 % of a body's height (Winter 2009, figure 4.1), legs without the ankle at 49 %."""
    skeleton = motion.skeleton
    legs = sum(float(np.linalg.norm(skeleton.offsets[skeleton.index(f"Right{part}")])) for part in ("Leg", "Foot"))
    return legs / 0.49


def _landmarks(points: Array, camera: CameraPath, noise: SightNoise, fps: float, rng: np.random.Generator) -> Array:
    """``[T, 25, 3]`` m relative to the middle of the hips, in axes of a camera that looks straight at them."""
    hips = points[:, BODY_25.index("mid_hip")]
    z = hips - camera.positions
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(camera.axes[:, 1], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    axes = np.stack([x, np.cross(z, x), z], axis=1)
    out = np.einsum("tij,tkj->tki", axes, points - hips[:, None])
    shape = out.shape
    error = np.sqrt(noise.definition) * rng.normal(size=shape[1:])
    error = error + np.sqrt(noise.lasting) * slow_noise(rng, shape, 1.0, fps)
    error = error + np.sqrt(1 - noise.lasting - noise.definition) * slow_noise(rng, shape, 0.05, fps)
    out += error * [noise.across, noise.across, noise.depth]
    middle = BODY_25.index("mid_hip")
    out[:, middle] = out[:, [BODY_25.index(f"{side}_hip") for side in ("left", "right")]].mean(axis=1)
    return np.asarray(out - out[:, [middle]])


def _follow_another(pixels: Array, landmarks: Array, count: int) -> None:
    """In the middle of the clip ``count`` frames show somebody in another pose, one and a half body heights aside."""
    first, away = len(pixels) // 2, len(pixels) // 4
    frames, others = slice(first, first + count), slice(first - away, first - away + count)
    tall = np.ptp(pixels[others, :, 1], axis=1)[:, None]
    pixels[frames] = pixels[others] + np.stack([1.5 * tall, 0 * tall], axis=-1)
    landmarks[frames] = landmarks[others]


def _in_pixels(told: Array) -> CameraTrack:
    """``told [T, 3, 3]`` is of pictures whose height is 1 and whose middle is the origin."""
    height = SIZE[1]
    to_pixels = np.array([[height, 0.0, SIZE[0] / 2], [0.0, height, SIZE[1] / 2], [0.0, 0.0, 1.0]])
    to_first = to_pixels @ told @ np.linalg.inv(to_pixels)
    frames = len(told)
    return CameraTrack(to_first, np.zeros(frames, dtype=bool), np.ones(frames), "similarity")


def guessed_scene(true: Scene, kind: str, turn: float, start: Array, rng: np.random.Generator) -> Scene:
    """A user's first guess: boxes up to 0.2 m off in height and 0.15 m in place, and how the camera moves.

    What hands hold on to is told, up to two frames off; contacts of feet are left to the film.

    Args:
        true: the scene.
        kind: of the camera.
        turn: of :class:`Sight`.
        start: ``[2]`` m, the true pelvis in the first frame: the origin of the guessed scene.
        rng: of the errors.
    """
    boxes = tuple(_guessed(box, turn, start, rng) for box in true.boxes)
    return Scene(fps=true.fps, camera=CameraNotes(motion=kind), boxes=boxes, contacts=_told(true, rng))


def _told(true: Scene, rng: np.random.Generator) -> tuple[Contact, ...]:
    """Contacts of hands as a user sees them: a hand that lifts for a few frames still holds."""
    found: list[Contact] = []
    for contact in sorted(true.contacts, key=lambda one: (one.effector, one.touches, one.first)):
        if not contact.effector.endswith("_hand"):
            continue
        before = found[-1] if found else None
        alike = before is not None and (before.effector, before.touches) == (contact.effector, contact.touches)
        if before is not None and alike and contact.first - before.last <= _LIFTED:
            found[-1] = replace(before, last=contact.last)
        else:
            found.append(contact)
    last = max((contact.last for contact in true.contacts), default=0)
    out = []
    for contact in found:
        early, late = rng.integers(-2, 3, 2).tolist()
        first = min(max(contact.first + early, 0), last)
        out.append(replace(contact, first=first, last=min(max(contact.last + late, first), last)))
    return tuple(sorted(out, key=lambda one: (one.first, one.effector)))


def _guessed(box: Box, turn: float, start: Array, rng: np.random.Generator) -> Box:
    assert box.place is not None
    assert box.height is not None
    assert box.yaw is not None
    c, s = np.cos(turn), np.sin(turn)
    place = np.array([[c, s], [-s, c]]) @ (np.array(box.place) - start) + rng.uniform(-0.15, 0.15, 2)
    height = max(box.height + rng.uniform(-0.2, 0.2), 0.0)
    return replace(
        box,
        place=(round(float(place[0]), 3), round(float(place[1]), 3)),
        height=round(float(height), 3),
        yaw=round(float(box.yaw - turn), 3),
        free={"along": (-0.3, 0.3), "across": (-0.3, 0.3), "height": (-0.3, 0.3)},
    )
