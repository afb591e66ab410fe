"""Whether a motion follows the film it was estimated from: frame by frame, and in one sentence.

A value function knows whether a body stands well, not whether it does what its wearer did. Here the body's own camera
is compared with the film's: how it turns, how fast it moves, and how it bobs with its steps. A film of no wearer (a
drone's, a picture that moves before a standing person) is told by the same three, and by flow that no single camera
explains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import butter, sosfiltfilt

from egopose.humanoid.model import HumanoidModel
from egopose.inference.film_states import FilmReading
from egopose.motion.rotations import Array
from egopose.vision.head_signal import HeadSignal, signal_of_motion
from egopose.vision.mounts import camera_poses, mount_of

#: s, standard deviation of the window in which both are compared.
_WINDOW = 1.0
#: s over which turns and speeds are averaged before: a body lags, and sways otherwise within a step.
_SLOW = 0.3
#: Hz, the band of steps.
_STEPS = (1.2, 4.0)
# What differences below count for nothing: rad/s, heights/s, and heights/s of the bob. Standing people have so much.
_TURN, _SPEED, _BOB = 0.12, 0.10, 0.035
# What a film must reach for a part to count in full, and below which the part is 0. A flat, narrow camera sees little
# ground and is right all the same; one lens for another leaves a sixth of the points unexplained.
_SEEN, _RIGID, _MEASURED = (0.0, 0.3), (0.55, 0.82), (0.0, 0.6)
#: rad/s, turning within steps (root mean square) of a worn camera that stands, and of one that moves by 0.3
#: heights/s or more. In motion capture 98 of 100 seconds have 0.05 and 0.12; real heads stand stiller.
_STANDING_SHAKE, _WALKING_SHAKE, _WALKING = 0.012, 0.10, 0.3
#: Above the first number the film is followed, below the second it is not.
FOLLOWS, FOLLOWS_NOT = 0.6, 0.4
_NAMES = {
    "turning": "the body turns otherwise than the camera",
    "speed": "the body moves otherwise than the camera",
    "bob": "the camera does not bob as a walking person's does",
    "seen": "no ground is seen that would tell how the camera moves",
    "rigid": "the picture does not move as a camera among things that stand still sees it",
    "worn": "the camera is too steady to be worn: it is held still, flies, or steadied its film",
    "measured": "the picture does not turn as the gyroscope does: another lens, or another film's telemetry",
}


@dataclass(frozen=True)
class FilmAgreement:
    """How well a motion follows its film.

    Args:
        parts: ``[T]`` in 0..1 by name, see :func:`film_agreement`.
        score: ``[T]`` in 0..1, of all of them.
    """

    parts: dict[str, Array]
    score: Array

    @property
    def mean(self) -> float:
        """Of the film."""
        return float(self.score.mean())

    @property
    def verdict(self) -> str:
        """``yes``, ``partly`` or ``no``."""
        return "yes" if self.mean >= FOLLOWS else "no" if self.mean < FOLLOWS_NOT else "partly"

    @property
    def sentence(self) -> str:
        """The verdict, and what speaks against it most."""
        if self.verdict == "yes":
            return f"follows the film: yes ({self.mean:.2f})"
        worst = min(self.parts, key=lambda name: float(self.parts[name].mean()))
        return f"follows the film: {self.verdict} ({self.mean:.2f}), because {_NAMES[worst]}"

    def columns(self) -> dict[str, Array]:
        """Per-frame figures ``[T]`` by name, for a table."""
        return {"follows_film": self.score, **{f"film_{name}": part for name, part in self.parts.items()}}


def film_agreement(humanoid: HumanoidModel, qpos: Array, reading: FilmReading, mount: str) -> FilmAgreement:
    """Compare a motion with what its film tells.

    Args:
        humanoid: whose motion it is.
        qpos: ``[T, nq]``.
        reading: of the film.
        mount: where the camera is worn.

    Returns:
        ``turning`` and ``speed``: one less the squared difference over the sum of squares, of what is slow. ``bob``:
        likewise of the vertical motion's size within steps. ``worn``: see :func:`worn_share`. ``seen``: the velocity's
        quality. ``rigid``: the share of the flow that one camera explains. ``measured``: the quality of turning, which
        falls where gyroscope and picture differ. The score is the root of their product.
    """
    fps = 1.0 / humanoid.control_dt
    pitch = float(np.mean(reading.signal.tilt[:, 0]))
    positions, rotations = camera_poses(humanoid.mj_model, qpos, mount_of(mount, 0.0, pitch, 0.0))
    return signal_agreement(signal_of_motion(positions, rotations, fps), reading.signal, fps)


def signal_agreement(body: HeadSignal, film: HeadSignal, fps: float) -> FilmAgreement:
    """:func:`film_agreement` of the body's own signal and the film's."""

    def slow(values: Array) -> Array:
        return np.asarray(gaussian_filter1d(values, _SLOW * fps, axis=0, mode="nearest"))

    def alike(one: Array, other: Array, least: float) -> Array:
        apart = _mean(np.square(one - other).sum(1), fps)
        both = _mean(np.square(one).sum(1) + np.square(other).sum(1), fps)
        return np.asarray(np.clip(1.0 - apart / (both + 2 * least**2), 0.0, 1.0))

    # The first frame has no flow: its quality of zero would stand for all that lies before the film.
    quality = np.concatenate([film.quality[1:2], film.quality[1:]]) if len(film) > 1 else film.quality
    bobs = [np.sqrt(_mean(steps_of(signal.velocity[:, 2], fps) ** 2, fps)) for signal in (body, film)]
    parts = {
        "turning": alike(slow(body.turning[:, 2:]), slow(film.turning[:, 2:]), _TURN),
        "speed": alike(slow(body.velocity[:, :2]), slow(film.velocity[:, :2]), _SPEED),
        "bob": np.clip(1.0 - np.square(bobs[0] - bobs[1]) / (bobs[0] ** 2 + bobs[1] ** 2 + 2 * _BOB**2), 0.0, 1.0),
        "worn": worn_share(film, fps),
        "seen": _reached(_mean(quality[:, 1], fps), _SEEN),
        "rigid": _reached(_mean(quality[:, 2], fps), _RIGID),
        "measured": _reached(_mean(quality[:, 0], fps), _MEASURED),
    }
    score = np.prod(np.stack(list(parts.values())), axis=0) ** 0.5
    return FilmAgreement(parts, np.clip(score, 0.0, 1.0))


def worn_share(film: HeadSignal, fps: float) -> Array:
    """``[T]`` in 0..1: how much the camera shakes within steps, of what a worn one does that moves as fast."""
    steps = np.stack([steps_of(column, fps) for column in film.turning.T])
    shake = np.sqrt(_mean(np.square(steps).sum(0), fps))
    speed = np.linalg.norm(gaussian_filter1d(film.velocity[:, :2], _WINDOW * fps, axis=0, mode="nearest"), axis=1)
    moving = np.clip(speed / _WALKING, 0.0, 1.0)
    return np.asarray(np.clip(shake / (_STANDING_SHAKE + moving * (_WALKING_SHAKE - _STANDING_SHAKE)), 0.0, 1.0))


def _reached(values: Array, limits: tuple[float, float]) -> Array:
    return np.asarray(np.clip((values - limits[0]) / (limits[1] - limits[0]), 0.0, 1.0))


def steps_of(values: Array, fps: float) -> Array:
    """``values [T]`` in the band of steps, without what is slower or quicker."""
    if len(values) < 30:
        return np.zeros_like(values)
    band = butter(2, _STEPS, "bandpass", fs=fps, output="sos")
    return np.asarray(sosfiltfilt(band, values, padlen=min(len(values) - 1, 30)))


def _mean(values: Array, fps: float) -> Array:
    return np.asarray(gaussian_filter1d(values, _WINDOW * fps, mode="nearest"))
