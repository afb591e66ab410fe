"""A state regressor that reads head signals, trained from motion capture alone: nothing is rendered.

Motion capture tells what a camera on any mount would measure (:func:`egopose.vision.head_signal.signal_of_motion`).
Each variant of a take is played at another speed, with a camera worn another way. What film adds is put on top: a
height that is wrong, a vertical that is off, noise, and stretches in which no ground is seen.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Slerp
from torch import Tensor, nn

from egopose.core.errors import InputError
from egopose.core.torch_settings import torch_threads
from egopose.envs.mdp.observations import humanoid_state_rows
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.state_layout import StateLayout
from egopose.models.head_signal_input import SIGNAL_FEATURES, mirrored_features, signal_features
from egopose.models.mirror import state_mirror
from egopose.models.regressor import StateRegressor, state_statistics
from egopose.motion import rotations as rot
from egopose.motion.motion import finite_difference
from egopose.motion.rotations import Array
from egopose.vision.head_signal import signal_of_motion
from egopose.vision.mounts import MOUNTS, Mount, camera_poses, held_sway, mount_of

Range = tuple[float, float]
_LEAST = 8  # frames of a clip below which there is nothing to learn


@dataclass(frozen=True)
class HeadSignalSettings:
    """``conf/head_signal.yaml``, which gives the source of every value.

    Args:
        variants: of each take.
        mounts: share of each mount.
        pitch_down, yaw, roll: degrees, ranges of how the camera is worn.
        play: degrees, standard deviation of a mount's play, correlated over ``play_time`` s.
        play_time: s.
        pace: standard deviation of the logarithm of the speed a take is played at.
        height_error: standard deviation of the logarithm of the velocity's factor: the height is not known well.
        vertical_error: degrees, standard deviation of the vertical's constant error.
        turn_noise: rad/s; velocity_noise: heights/s. White, and again as much correlated over half a second.
        unseen: share of the stretches of half a second to three seconds without any ground.
        still: share of the training fragments in which a standing body hardly moves.
        length: frames of a fragment.
        batch: fragments a step.
        epochs, learning_rate, weight_decay: AdamW in one cycle.
        context_size, hidden, dropout: of :class:`StateRegressor`.
        std_floor: see :func:`~egopose.models.regressor.state_statistics`.
        target_clip: standard deviations.
        seed, threads: of all.
    """

    variants: int
    mounts: dict[str, float]
    pitch_down: Range
    yaw: Range
    roll: Range
    play: float
    play_time: float
    pace: float
    height_error: float
    vertical_error: float
    turn_noise: float
    velocity_noise: float
    unseen: float
    still: float
    length: int
    batch: int
    epochs: int
    learning_rate: float
    weight_decay: float
    context_size: int
    hidden: tuple[int, ...]
    dropout: float
    std_floor: float
    target_clip: float
    seed: int
    threads: int

    def __post_init__(self) -> None:
        if unknown := set(self.mounts) - set(MOUNTS):
            raise InputError("head_signal", "mounts", f"{sorted(unknown)[0]!r}; there are {', '.join(MOUNTS)}")
        if not sum(self.mounts.values()) > 0:
            raise InputError("head_signal", "mounts", "need a share above 0")
        for name in ("variants", "length", "batch", "epochs"):
            if getattr(self, name) < 1:
                raise InputError("head_signal", name, "must be at least 1")


@dataclass(frozen=True)
class Example:
    """One variant of a take: features ``[T, N]`` and states z ``[T, S]``, float32."""

    features: Tensor
    states: Tensor


def draw_examples(
    humanoid: HumanoidModel, clips: Sequence[Array], settings: HeadSignalSettings, rng: np.random.Generator
) -> list[Example]:
    """A variant of every clip, ``qpos [T, nq]`` at the control rate each."""
    fps = 1.0 / humanoid.control_dt
    names = list(settings.mounts)
    shares = np.array([settings.mounts[name] for name in names])
    examples = []
    for clip in clips:
        qpos = paced(clip, float(np.exp(rng.normal(scale=settings.pace))))
        if len(qpos) < _LEAST:
            continue
        kind = str(rng.choice(names, p=shares / shares.sum()))
        yaw, pitch, roll = (np.deg2rad(rng.uniform(*r)) for r in (settings.yaw, settings.pitch_down, settings.roll))
        angles = _play(rng, len(qpos), fps, settings)
        shifts = np.zeros((len(qpos), 3))
        if kind == "held":
            sway, shifts = held_sway(rng, len(qpos), fps)
            angles = angles + sway
        mount = mount_of(kind, float(yaw), float(pitch), float(roll))
        examples.append(exact_example(humanoid, qpos, fps, mount, angles, shifts))
    return examples


def exact_example(
    humanoid: HumanoidModel,
    qpos: Array,
    fps: float,
    mount: Mount,
    angles: Array | None = None,
    shifts: Array | None = None,
) -> Example:
    """What a camera on ``mount`` would measure without an error.

    Args:
        humanoid: whose motion it is.
        qpos: ``[T, nq]``.
        fps: frames/s.
        mount, angles, shifts: see :func:`egopose.vision.mounts.camera_poses`.
    """
    positions, turned = camera_poses(humanoid.mj_model, qpos, mount, angles, shifts)
    features = signal_features(signal_of_motion(positions, turned, fps), mount.kind)
    states = torch.from_numpy(humanoid_state_rows(qpos, finite_difference(qpos, fps))).float()
    return Example(features, states)


def paced(qpos: Array, pace: float) -> Array:
    """``qpos [T, nq]`` played ``pace`` times as fast: turns of the root by slerp, the rest linearly."""
    count = int((len(qpos) - 1) / pace) + 1
    if len(qpos) < 2 or count < 2:
        return qpos[:1]
    at = np.minimum(np.arange(count) * pace, len(qpos) - 1)
    frames = np.arange(len(qpos))
    out = np.stack([np.interp(at, frames, column) for column in qpos.T], axis=1)
    out[:, 3:7] = rot.continuous(rot.from_scipy(Slerp(frames, rot.to_scipy(qpos[:, 3:7]))(at), (count,)))
    return out


def _play(rng: np.random.Generator, count: int, fps: float, settings: HeadSignalSettings) -> Array:
    keep = float(np.exp(-1.0 / (settings.play_time * fps)))
    noise = rng.normal(scale=np.deg2rad(settings.play), size=(count, 3))
    for t in range(1, count):
        noise[t] = keep * noise[t - 1] + np.sqrt(1 - keep**2) * noise[t]
    return noise


def still_example(example: Example, frame: int, length: int, generator: torch.Generator) -> Example:
    """A body that stands in the pose of one frame, breathing: its signal is what is left of a standing head's."""
    features = example.features[frame].repeat(length, 1)
    states = example.states[frame].repeat(length, 1)
    states[:, StateLayout.of_size(states.shape[1]).velocities] = 0.0
    sway = torch.randn(length, 6, generator=generator) * torch.tensor([0.01, 0.01, 0.01, 0.01, 0.01, 0.005])
    features[:, :6] = slow(sway, 0.5)
    return Example(features, states)


def slow(noise: Tensor, seconds: float, fps: float = 30.0) -> Tensor:
    """Noise ``[T, ...]`` or ``[B, T, ...]`` (time is the last axis but one) correlated over ``seconds``, as large."""
    keep = float(np.exp(-1.0 / (seconds * fps)))
    out = noise.clone()
    for t in range(1, noise.shape[-2]):
        out[..., t, :] = keep * out[..., t - 1, :] + (1 - keep**2) ** 0.5 * noise[..., t, :]
    return out


def as_filmed(features: Tensor, settings: HeadSignalSettings, generator: torch.Generator) -> Tensor:
    """Exact features ``[B, T, N]`` as a film would give them: with its errors, and a quality that tells of them."""
    count, frames = features.shape[:2]

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    out = features.clone()
    turning, velocity = out[..., 0:3], out[..., 3:6]
    # A vertical that is off mixes walking ahead with rising, and turning left with rolling.
    pitch = np.deg2rad(settings.vertical_error) * normal(count, 1)
    cos, sin = pitch.cos(), pitch.sin()
    for part in (turning, velocity):
        ahead, up = part[..., 0].clone(), part[..., 2].clone()
        part[..., 0], part[..., 2] = cos * ahead - sin * up, sin * ahead + cos * up
    out[..., 6] += pitch
    velocity *= (settings.height_error * normal(count, 1, 1)).exp()
    # Quality falls as the noise rises, as it does in film.
    level = 3.0 ** normal(count, 1, 1).clamp(-2, 2)
    turning += level * settings.turn_noise * (normal(count, frames, 3) + slow(normal(count, frames, 3), 0.5)) * 0.5
    velocity += level * settings.velocity_noise * (normal(count, frames, 3) + slow(normal(count, frames, 3), 0.5))
    quality = 1.0 / (1.0 + (level * settings.velocity_noise / 0.1) ** 2)
    out[..., 8:9] = 1.0 / (1.0 + (level * settings.turn_noise / 0.1) ** 2)
    out[..., 9:10] = (quality * (0.6 + 0.4 * torch.rand(count, frames, 1, generator=generator))).clamp(0, 1)
    for row in (torch.rand(count, generator=generator) < settings.unseen).nonzero().squeeze(1).tolist():
        begin = int(torch.randint(0, frames, (), generator=generator))
        end = begin + int(torch.randint(15, 90, (), generator=generator))
        out[row, begin:end, 3:6] *= 0.2 * torch.rand((), generator=generator)
        out[row, begin:end, 9] *= 0.1
    return out


def train_head_signal_regressor(
    humanoid: HumanoidModel,
    clips: Sequence[Array],
    settings: HeadSignalSettings,
    progress: Callable[[int, float, float], None] | None = None,
) -> StateRegressor:
    """The trained regressor, in evaluation mode.

    Args:
        humanoid: whose states it gives.
        clips: ``qpos [T, nq]`` at the control rate.
        settings: of all.
        progress: told epoch, mean squared error and seconds after each epoch.

    Raises:
        InputError: no clip is long enough.
    """
    with torch_threads(settings.threads), torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        rng, generator = np.random.default_rng(settings.seed), torch.Generator().manual_seed(settings.seed)
        pool = [example for _ in range(settings.variants) for example in draw_examples(humanoid, clips, settings, rng)]
        if not pool:
            raise InputError("head_signal", "takes", "none is long enough to learn from")
        mirror = state_mirror(humanoid.skeleton)
        statistics = state_statistics(torch.cat([example.states for example in pool]), settings.std_floor)
        model = StateRegressor(
            None,
            *statistics,
            SIGNAL_FEATURES,
            settings.context_size,
            settings.hidden,
            settings.dropout,
        )
        weights = torch.tensor([float(len(example.states)) for example in pool])
        steps = max(1, int(weights.sum() / settings.variants / settings.length / settings.batch))
        optimiser = torch.optim.AdamW(model.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, settings.learning_rate, total_steps=steps * settings.epochs, pct_start=0.15
        )
        model.train()
        for epoch in range(settings.epochs):
            began, total = time.perf_counter(), 0.0
            for _ in range(steps):
                features, states, lengths = _batch(pool, weights, settings, generator)
                flip = torch.rand(len(features), generator=generator) < 0.5
                features[flip], states[flip] = mirrored_features(features[flip]), mirror.state(states[flip])
                seen = as_filmed(features, settings, generator)
                wanted = model.normalise(states).clamp(-settings.target_clip, settings.target_clip)
                predicted = model.from_features(seen, lengths)["normalised_state"]
                valid = torch.arange(settings.length)[None] < lengths[:, None]
                error = (predicted - wanted)[valid].square().mean()
                optimiser.zero_grad(set_to_none=True)
                error.backward()
                nn.utils.clip_grad_norm_(model.parameters(), 1.0)
                optimiser.step()
                schedule.step()
                total += error.item()
            if progress is not None:
                progress(epoch + 1, total / steps, time.perf_counter() - began)
    return model.eval()


def _batch(
    pool: Sequence[Example], weights: Tensor, settings: HeadSignalSettings, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Features, states ``[B, L, ...]`` and valid lengths ``[B]`` of random fragments."""
    chosen = torch.multinomial(weights, settings.batch, replacement=True, generator=generator).tolist()
    still = torch.rand(settings.batch, generator=generator) < settings.still
    size = settings.length
    features = torch.zeros(settings.batch, size, SIGNAL_FEATURES)
    states = torch.zeros(settings.batch, size, pool[0].states.shape[1])
    lengths = torch.zeros(settings.batch, dtype=torch.int64)
    for row, number in enumerate(chosen):
        example = pool[number]
        if still[row]:
            calm = example.features[:, :6].abs().sum(1)
            example = still_example(example, int(calm[1:].argmin()) + 1, size, generator)
        count = len(example.states)
        begin = int(torch.randint(0, max(count - size, 0) + 1, (), generator=generator))
        part = slice(begin, begin + size)
        lengths[row] = min(size, count)
        features[row, : lengths[row]], states[row, : lengths[row]] = example.features[part], example.states[part]
    return features, states, lengths
