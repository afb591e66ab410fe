"""Motion capture as virtual cameras and a pose estimator see it, with the feet's contacts: nothing is rendered.

A clip's leg joints are seen by a camera that stands, turns, zooms or moves along, with the errors of a pose estimator
put on top. The labels come from the feet's heights and speeds (:mod:`egopose.motion.contacts`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from egopose.core.errors import InputError
from egopose.humanoid.foot_geometry import sole_names, sole_positions
from egopose.humanoid.model import HumanoidModel
from egopose.motion.contacts import contact_labels, point_speeds
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.scene.virtual_camera import KINDS, background_motion, draw_camera, project, slow_noise
from egopose.training.contact_examples import NETWORKS

Range = tuple[float, float]


@dataclass(frozen=True)
class ContactSettings:
    """``conf/contacts.yaml``, which gives the source of every value.

    Args:
        cameras: share of each of :data:`egopose.scene.virtual_camera.KINDS` in training.
        undone: share of the moving cameras whose motion is undone.
        bodies: standard deviation of the logarithm of each of a drawn body's proportions, see :func:`another_body`.
        error: mean distance of a keypoint from its joint, in body heights; drawn for each clip.
        lasting: share of the error's variance that lasts for about a second.
        definition: share of it that is constant: where the estimator's joint lies beside the skeleton's.
        dropped: share of the keypoints that are not seen.
        contact_height, contact_speed: m and m/s: a heel or ball no higher and no faster touches the floor.
        doubtful_height, doubtful_speed: m and m/s: a heel or ball that is higher than ``contact_height`` but not than
            this, and no faster, is not learned from. Most often it stands on the floor, and the skeleton is wrong.
        network: one of :data:`egopose.training.contact_examples.NETWORKS`.
        widths, dropout, input_noise: of its layers.
        views: cameras that every clip is seen by; each epoch takes the next.
        epochs, batch, learning_rate, weight_decay: AdamW in one cycle.
        seed: of weights, cuts, mirror images and order; :func:`draw_views` does not use it.
        threads: of torch.
    """

    cameras: dict[str, float]
    undone: float
    bodies: float
    error: Range
    lasting: float
    definition: float
    dropped: float
    contact_height: float
    contact_speed: float
    doubtful_height: float
    doubtful_speed: float
    network: str
    widths: tuple[int, ...]
    dropout: float
    input_noise: float
    views: int
    epochs: int
    batch: int
    learning_rate: float
    weight_decay: float
    seed: int
    threads: int

    def __post_init__(self) -> None:
        if unknown := set(self.cameras) - set(KINDS):
            raise InputError("contacts", "cameras", f"{sorted(unknown)[0]!r}; there are {', '.join(KINDS)}")
        if not sum(self.cameras.values()) > 0:
            raise InputError("contacts", "cameras", "need a share above 0")
        if self.network not in NETWORKS:
            raise InputError("contacts", "network", f"{self.network!r:.40}; there are {', '.join(NETWORKS)}")
        if self.network == "temporal" and len(self.widths) != 1:
            raise InputError("contacts", "widths", f"of a temporal network are one number, got {list(self.widths)}")
        for name in ("views", "epochs", "batch", "threads"):
            if getattr(self, name) < 1:
                raise InputError("contacts", name, "must be at least 1")
        if self.lasting < 0 or self.definition < 0 or self.lasting + self.definition > 1:
            raise InputError("contacts", "lasting", "and definition are shares: together at most 1")


@dataclass(frozen=True)
class ContactClip:
    """Legs in the world: ``points [T, 7, 3]`` m, body height in m, frames/s.

    ``contacts [T, 2]`` are of the right and the left foot, and ``doubtful [T, 2]`` which are not to be learned from.
    """

    name: str
    points: Array
    contacts: np.ndarray
    doubtful: np.ndarray
    height: float
    fps: float


@dataclass(frozen=True)
class SeenClip:
    """A clip as a camera sees it: see :func:`egopose.scene.contacts.contact_features`."""

    keypoints: Array
    confidence: Array
    camera: Array
    contacts: np.ndarray
    doubtful: np.ndarray


def contact_clip(humanoid: HumanoidModel, motion: Motion, settings: ContactSettings) -> ContactClip:
    """The legs of a reference clip, on the floor at z = 0; a foot touches it with its heel or its ball.

    The contacts that a clip carries come from before it was put on the floor, and miss whole stances.
    """
    sides = ("Right", "Left")
    positions, _ = motion.forward_kinematics()
    skeleton = motion.skeleton
    legs = [positions[:, skeleton.index(side + part)] for side in sides for part in ("UpLeg", "Leg", "Foot")]
    points = np.stack([0.5 * (legs[0] + legs[3]), *legs], axis=1)
    soles = sole_positions(humanoid, motion)
    touching = contact_labels(soles, motion.fps, height=settings.contact_height, speed=settings.contact_speed)
    near = soles[..., 2] <= settings.doubtful_height
    doubt = near & ~touching & (soles[..., 2] > settings.contact_height)
    doubt &= point_speeds(soles, motion.fps) <= settings.doubtful_speed
    columns = [[k for k, name in enumerate(sole_names(humanoid)) if name.startswith(side)] for side in sides]
    feet, doubtful = (np.stack([rows[:, of].any(axis=1) for of in columns], axis=1) for rows in (touching, doubt))
    # Hips stand at 53 % of a body's height (Winter 2009, figure 4.1).
    length = sum(float(np.linalg.norm(skeleton.offsets[skeleton.index("Right" + part)])) for part in ("Leg", "Foot"))
    ankle = -float(humanoid.sole_points[0][:, 2].min())
    return ContactClip(motion.name, points, feet, doubtful & ~feet, (length + ankle) / 0.53, motion.fps)


def another_body(clip: ContactClip, spread: float, rng: np.random.Generator) -> ContactClip:
    """The clip on legs of other proportions; what stands still goes on standing still.

    All takes come on one skeleton. Legs become longer against the stride, hips wider, thighs longer against shanks.

    Args:
        clip: on the floor at z = 0.
        spread: standard deviation of the logarithm of each proportion.
        rng: draws them.
    """
    tall, wide, thigh = np.exp(spread * rng.normal(size=3))
    points = clip.points * [1.0, 1.0, tall]
    pelvis, hips, knees, ankles = points[:, :1], points[:, [1, 4]], points[:, [2, 5]], points[:, [3, 6]]
    hips = pelvis + wide * (hips - pelvis)
    # The knee moves along the line from hip to ankle. A thigh is about half of it.
    knees = knees + 0.5 * (thigh - 1) * (ankles - hips)
    legs = np.stack([hips, knees, ankles], axis=2)  # [T, side, 3, 3]
    points = np.concatenate([pelvis, legs[:, 0], legs[:, 1]], axis=1)
    return replace(clip, points=points, height=tall * clip.height)


def seen_by(
    clip: ContactClip, kind: str, settings: ContactSettings, rng: np.random.Generator, points: int = 400
) -> SeenClip:
    """The clip on a drawn body, through a camera of ``kind`` whose motion ``points`` tell, by a pose estimator."""
    clip = another_body(clip, settings.bodies, rng)
    frames, joints = clip.points.shape[:2]
    camera = draw_camera(kind, clip.points[:, 0], clip.fps, rng)
    # A mean distance of 1 in a plane is a standard deviation of sqrt(2 / pi) an axis.
    level = rng.uniform(*settings.error) * np.sqrt(2 / np.pi)
    offset = np.sqrt(settings.definition) * level * clip.height * rng.normal(size=(joints, 3))
    pictures, depth = project(camera, clip.points + offset)
    lasting = slow_noise(rng, (frames, joints, 2), 1.0, clip.fps) * np.sqrt(settings.lasting)
    quick = slow_noise(rng, (frames, joints, 2), 0.05, clip.fps) * np.sqrt(1 - settings.lasting - settings.definition)
    # Estimators are surer where they are better: the error's size varies within the clip, confidence with it.
    size = np.exp(0.5 * slow_noise(rng, (frames, joints), 0.3, clip.fps) - 0.125)
    scale = (camera.focal[:, None] * clip.height * level / depth)[..., None]
    keypoints = pictures + scale * (lasting + quick) * size[..., None]
    confidence = np.clip(0.9 - 0.15 * (size - 1) + 0.05 * rng.normal(size=size.shape), 0.05, 1.0)
    confidence[rng.random(confidence.shape) < settings.dropped] = 0.0
    motion = np.tile(np.eye(3), (frames, 1, 1))
    if kind != "fixed":
        motion = background_motion(camera, clip.points[:, 0].mean(axis=0), rng, points)
    return SeenClip(keypoints, confidence, motion, clip.contacts, clip.doubtful)
