"""Training of the contact network on motion capture that virtual cameras project: nothing is rendered.

A clip's leg joints are seen by a camera that stands, turns, zooms or moves along, with the errors of a pose estimator
put on top. The labels come from the feet's heights and speeds (:mod:`egopose.motion.contacts`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from egopose.core.errors import InputError
from egopose.core.torch_settings import torch_threads
from egopose.humanoid.foot_geometry import sole_names, sole_positions
from egopose.humanoid.model import HumanoidModel
from egopose.motion.contacts import contact_labels
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.scene.contacts import (
    ContactNetwork,
    contact_windows,
    estimate_contacts,
    labels_of_windows,
    mirrored_windows,
)
from egopose.scene.virtual_camera import KINDS, background_motion, draw_camera, project, slow_noise

Range = tuple[float, float]
_LEAST = 9  # frames: a window


@dataclass(frozen=True)
class ContactSettings:
    """``conf/contacts.yaml``, which gives the source of every value.

    Args:
        cameras: share of each of :data:`egopose.scene.virtual_camera.KINDS` in training.
        undone: share of the moving cameras whose motion is undone.
        error: mean distance of a keypoint from its joint, in body heights; drawn for each clip.
        lasting: share of the error's variance that lasts for about a second.
        definition: share of it that is constant: where the estimator's joint lies beside the skeleton's.
        dropped: share of the keypoints that are not seen.
        contact_height, contact_speed: m and m/s: a heel or ball no higher and no faster touches the floor.
        widths, dropout, input_noise: of :class:`ContactNetwork`.
        epochs, batch, learning_rate: Adam in one cycle; every epoch draws new cameras.
        bfloat16: forward passes in half precision.
        seed, threads: of all.
    """

    cameras: dict[str, float]
    undone: float
    error: Range
    lasting: float
    definition: float
    dropped: float
    contact_height: float
    contact_speed: float
    widths: tuple[int, ...]
    dropout: float
    input_noise: float
    epochs: int
    batch: int
    learning_rate: float
    bfloat16: bool
    seed: int
    threads: int

    def __post_init__(self) -> None:
        if unknown := set(self.cameras) - set(KINDS):
            raise InputError("contacts", "cameras", f"{sorted(unknown)[0]!r}; there are {', '.join(KINDS)}")
        if not sum(self.cameras.values()) > 0:
            raise InputError("contacts", "cameras", "need a share above 0")
        for name in ("epochs", "batch", "threads"):
            if getattr(self, name) < 1:
                raise InputError("contacts", name, "must be at least 1")
        if self.lasting < 0 or self.definition < 0 or self.lasting + self.definition > 1:
            raise InputError("contacts", "lasting", "and definition are shares: together at most 1")


@dataclass(frozen=True)
class ContactClip:
    """Legs in the world: ``points [T, 7, 3]`` m, ``contacts [T, 2]`` (right, left), body height in m, frames/s."""

    name: str
    points: Array
    contacts: np.ndarray
    height: float
    fps: float


@dataclass(frozen=True)
class SeenClip:
    """A clip as a camera sees it: see :func:`egopose.scene.contacts.contact_windows`."""

    keypoints: Array
    confidence: Array
    camera: Array
    contacts: np.ndarray


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
    names = sole_names(humanoid)
    feet = [touching[:, [k for k, name in enumerate(names) if name.startswith(side)]].any(axis=1) for side in sides]
    # Hips stand at 53 % of a body's height (Winter 2009, figure 4.1).
    length = sum(float(np.linalg.norm(skeleton.offsets[skeleton.index("Right" + part)])) for part in ("Leg", "Foot"))
    ankle = -float(humanoid.sole_points[0][:, 2].min())
    return ContactClip(motion.name, points, np.stack(feet, axis=1), (length + ankle) / 0.53, motion.fps)


def seen_by(clip: ContactClip, kind: str, settings: ContactSettings, rng: np.random.Generator) -> SeenClip:
    """The clip through a camera of ``kind`` and the eyes of a pose estimator."""
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
        motion = background_motion(camera, clip.points[:, 0].mean(axis=0), rng)
    return SeenClip(keypoints, confidence, motion, clip.contacts)


def training_rows(
    clips: Sequence[ContactClip], settings: ContactSettings, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Windows ``[N, 189]`` and labels ``[N, 5, 2]`` of all clips, each through one new camera."""
    kinds = list(settings.cameras)
    shares = np.array([settings.cameras[kind] for kind in kinds])
    windows, labels = [], []
    for clip in clips:
        seen = seen_by(clip, str(rng.choice(kinds, p=shares / shares.sum())), settings, rng)
        camera = seen.camera if rng.random() < settings.undone else None
        windows.append(contact_windows(seen.keypoints, seen.confidence, camera))
        labels.append(labels_of_windows(seen.contacts))
    return torch.from_numpy(np.concatenate(windows)), torch.from_numpy(np.concatenate(labels)).float()


def train_contact_network(
    clips: Sequence[ContactClip],
    settings: ContactSettings,
    progress: Callable[[int, float, float], None] | None = None,
) -> ContactNetwork:
    """The trained network, in evaluation mode.

    Args:
        clips: to learn from.
        settings: of all.
        progress: told epoch, mean cross-entropy and seconds after each epoch.

    Raises:
        InputError: no clip is long enough.
    """
    clips = [clip for clip in clips if len(clip.points) >= _LEAST]
    if not clips:
        raise InputError("contacts", "takes", f"none has {_LEAST} frames to learn from")
    with torch_threads(settings.threads), torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        rng = np.random.default_rng(settings.seed)
        network = ContactNetwork(settings.widths, settings.dropout, settings.input_noise)
        batch = min(settings.batch, sum(len(clip.points) for clip in clips))
        steps = sum(len(clip.points) for clip in clips) // batch
        optimiser = torch.optim.Adam(network.parameters(), lr=settings.learning_rate)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, settings.learning_rate, total_steps=max(2, steps * settings.epochs)
        )
        network.train()
        for epoch in range(settings.epochs):
            began, total = time.perf_counter(), 0.0
            windows, labels = training_rows(clips, settings, rng)
            flip = torch.rand(len(windows)) < 0.5
            windows[flip], labels[flip] = mirrored_windows(windows[flip]), labels[flip].flip(-1)
            order = torch.randperm(len(windows))
            for rows in order[: steps * batch].view(steps, batch):
                with torch.autocast("cpu", torch.bfloat16, enabled=settings.bfloat16):
                    logits = network(windows[rows])
                loss = nn.functional.binary_cross_entropy_with_logits(logits.float(), labels[rows])
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                optimiser.step()
                schedule.step()
                total += float(loss.detach())
            if progress is not None:
                progress(epoch + 1, total / steps, time.perf_counter() - began)
    return network.eval()


def contact_accuracy(network: ContactNetwork, seen: SeenClip, undone: bool) -> Array:
    """``[T, 2]``: 1 where the network's contact is the label's, 0 elsewhere."""
    estimated = estimate_contacts(network, seen.keypoints, seen.confidence, seen.camera if undone else None) > 0.5
    return (estimated == seen.contacts).astype(np.float64)


def accuracy_table(
    network: ContactNetwork,
    clips: Sequence[ContactClip],
    settings: ContactSettings,
    seed: int,
    draws: int = 1,
) -> dict[str, dict[str, dict[str, float]]]:
    """Share of feet and frames in which the network is right, through cameras that it has not seen.

    Args:
        network: in evaluation mode.
        clips: of people that it has not seen.
        settings: the keypoints' errors.
        seed: of the cameras: the same for networks that are compared, and from one kind of camera to the other.
        draws: cameras of each kind for each clip.

    Returns:
        ``{as seen | undone: {kind: {clip: share}}}``.
    """
    out: dict[str, dict[str, dict[str, float]]] = {"as seen": {}, "undone": {}}
    for kind in KINDS:
        for place, clip in enumerate(clips):
            seen = [seen_by(clip, kind, settings, np.random.default_rng([seed, k, place])) for k in range(draws)]
            for name, row in out.items():
                shares = [contact_accuracy(network, one, name == "undone").mean() for one in seen]
                row.setdefault(kind, {})[clip.name] = float(np.mean(shares))
    return out


def overall(row: dict[str, float], clips: Sequence[ContactClip]) -> float:
    """The clips' mean, weighted by their frames."""
    lengths = {clip.name: len(clip.points) for clip in clips}
    return float(np.average(list(row.values()), weights=[lengths[name] for name in row]))
