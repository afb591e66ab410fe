"""How a worn camera turns and moves over the ground: six numbers a frame in axes that gravity aligns.

The signal needs no knowledge of how the camera sits on the head, and motion capture gives the same numbers without a
picture: so a regressor of body states can be trained on the one and used on the other.

Axes of the signal: ahead (the optical axis without its vertical part), left, up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from egopose.motion.rotations import Array
from egopose.vision.ground_motion import GroundMotion, fit_ground_motion, gravity_axes, pixel_rays

#: s, standard deviation of the Gaussian that steadies the vertical: nodding stays in the signal.
_STEADY = 4.0 / 30.0
#: s over which a tilt without an instrument returns to its mean: long enough for nodding, too short to drift.
_TILT_MEMORY = 0.3
#: Heights a second and rad/s: numbers this uncertain have half of the quality.
_DOUBTFUL_VELOCITY, _DOUBTFUL_TURN = 0.1, 0.1
#: The share of the floor's points that move as a floor does, below which the velocity has no quality, and above which
#: it has all of it. Cauchy's weights of normal errors have a mean of 0.56.
_NO_FLOOR, _FLOOR = 0.05, 0.30
#: Cells across the picture in which flow is fitted; more cost time and do not help.
_CELLS = 24
#: rad, the pitches among which a film's is looked for, and what is taken where nobody walks.
_PITCHES = np.deg2rad(np.arange(-15.0, 61.0, 15.0))
_HALVINGS = 2  # of the step between them, where the right one lies
USUAL_PITCH = float(np.deg2rad(20.0))
#: Frames of a film that are looked at for its pitch.
_PITCH_FRAMES = 240
# s over which gyroscope and picture are compared, how strictly, and rad/s that count for nothing.
_AGREEMENT, _STRICT, _STILL = 1.0, 5.0, 0.05
#: Slow frames that are enough to know a gyroscope's bias.
_SLOW_FRAMES = 15
#: Heights a second: the mean speed below which a film tells nothing of its pitch.
_WALKS = 0.15

#: Numbers of a frame, see :meth:`HeadSignal.numbers`.
SIGNAL_NUMBERS = 10


@dataclass(frozen=True)
class HeadSignal:
    """What the camera's motion tells of the head, frame by frame. Frame t's is from t-1 to t; the first has none.

    Args:
        turning: ``[T, 3]`` rad/s about the axes ahead, left, up.
        velocity: ``[T, 3]`` camera heights a second ahead, left, up.
        tilt: ``[T, 2]`` rad: how far the camera looks below the horizon, and its roll; steadied.
        quality: ``[T, 3]`` in 0..1: of turning, of velocity, and the share of the picture that one camera explains.
    """

    turning: Array
    velocity: Array
    tilt: Array
    quality: Array

    def __len__(self) -> int:
        return len(self.turning)

    def numbers(self) -> Array:
        """``[T, 10]``: turning, velocity, tilt and their two qualities side by side, as a regressor reads them."""
        return np.concatenate([self.turning, self.velocity, self.tilt, self.quality[:, :2]], axis=1)


def tilt_of(down: Array) -> Array:
    """``[T, 2]`` rad, pitch below the horizon and roll, of unit vectors down ``[T, 3]`` in the camera's axes."""
    return np.stack([np.arcsin(np.clip(down[:, 2], -1, 1)), np.arctan2(down[:, 0], down[:, 1])], axis=1)


def down_of(pitch_down: Array | float, roll: Array | float) -> Array:
    """``[..., 3]`` unit vector down in the axes of a camera with that tilt (rad); the inverse of :func:`tilt_of`."""
    pitch, level = np.broadcast_arrays(np.asarray(pitch_down, float), np.asarray(roll, float))
    return np.stack([np.cos(pitch) * np.sin(level), np.cos(pitch) * np.cos(level), np.sin(pitch)], axis=-1)


def steadied(down: Array, fps: float) -> Array:
    """Unit vectors down ``[T, 3]`` smoothed in time: axes that nod with every step would hide the nodding."""
    smooth = gaussian_filter1d(down, _STEADY * fps, axis=0, mode="nearest")
    return np.asarray(smooth / np.linalg.norm(smooth, axis=1, keepdims=True))


def signal_of_motion(positions: Array, rotations: Array, fps: float) -> HeadSignal:
    """The exact signal of a camera whose poses are known, as motion capture has them.

    Args:
        positions: ``[T, 3]`` m in a world whose floor is z = 0.
        rotations: ``[T, 3, 3]`` from the camera's axes to the world's (:func:`egopose.vision.mounts.camera_poses`).
        fps: frames/s.
    """
    down = steadied(-rotations[:, 2], fps)
    axes = gravity_axes(down)
    turn, step = np.zeros_like(positions), np.zeros_like(positions)
    turn[1:] = Rotation.from_matrix(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:]).as_rotvec() * fps
    step[1:] = np.diff(positions, axis=0) * fps / np.maximum(positions[1:, 2:], 0.2)
    velocity = np.einsum("tji,tj->ti", rotations, step)
    quality = np.ones((len(positions), 3))
    quality[:1] = 0.0
    return HeadSignal(_in(axes, turn), _in(axes, velocity), tilt_of(down), quality)


def signal_of_flow(
    flow: NDArray[np.floating],
    field_of_view: float,
    intervals: Array,
    down: Array | None = None,
    turning: Array | None = None,
    pitch_down: float | None = None,
    steadied_picture: bool = False,
) -> HeadSignal:
    """The signal seen in a film.

    Args:
        flow: ``[T, 2, H, W]`` of pinhole pictures, in picture widths a frame, channel 0 right, 1 down. NaN counts for
            nothing.
        field_of_view: degrees across the picture's width.
        intervals: ``[T]`` s that each frame's flow took.
        down: ``[T, 3]`` unit vectors down in the camera's axes, where an instrument knows them.
        turning: ``[T, 3]`` rad/s in the camera's axes, where a gyroscope knows it. Its constant part is believed to
            the vertical and the picture: gyroscopes drift.
        pitch_down: rad, how far the camera looks below the horizon on average; None finds it in the film. Not read
            where ``down`` is given.
        steadied_picture: the picture does not turn as the gyroscope does; both are believed, each for its own.
    """
    moved, rays = _cells(flow, field_of_view)
    fps = 1.0 / float(np.median(intervals))
    known, seconds = down, intervals[:, None]
    if down is None:
        level = np.broadcast_to(down_of(USUAL_PITCH, 0.0), (len(moved), 3))
        seen = fit_ground_motion(moved, rays, level, fps).turn if turning is None else turning * seconds
        pitch = pitch_of_film(moved, rays, fps) if pitch_down is None else pitch_down
        down = down_from_turning(seen, pitch, fps)
    fit = fit_ground_motion(moved, rays, down, fps)
    turn, turn_quality = fit.turn, 1.0 / (1.0 + (fit.turn_deviation * fps / _DOUBTFUL_TURN) ** 2)
    if turning is not None:
        if steadied_picture:
            turn, turn_quality = turning * seconds, np.ones(len(moved))
        else:
            turn = without_bias(turning * seconds, fit, known)
            turn_quality = turns_agree(turn, fit, fps)
            fit = fit_ground_motion(moved, rays, down, fps, turn)
    axes = gravity_axes(steadied(down, fps))
    quality = np.stack([turn_quality, velocity_quality(fit, fps), fit.rigid], axis=1)
    quality[:1] = 0.0
    tilt = tilt_of(steadied(down, fps))
    return HeadSignal(_in(axes, turn) / seconds, _in(axes, fit.velocity) / seconds, tilt, quality)


def velocity_quality(fit: GroundMotion, fps: float) -> Array:
    """``[T]`` in 0..1: 1 where the velocity is certain and what lies below the horizon moves as a floor."""
    certain = 1.0 / (1.0 + (fit.deviation * fps / _DOUBTFUL_VELOCITY) ** 2)
    return certain * np.clip((fit.share - _NO_FLOOR) / (_FLOOR - _NO_FLOOR), 0.0, 1.0)


def without_bias(turn: Array, seen: GroundMotion, down: Array | None) -> Array:
    """A gyroscope's turns ``[T, 3]`` (rad a frame) less their constant error.

    The vertical must turn as the gyroscope says: that gives the error across it. The error about the vertical, which
    makes a heading drift, is the one against the picture. Frames that turn fast are left out.

    Args:
        turn: of the gyroscope.
        seen: what the picture tells of the same frames.
        down: ``[T, 3]`` unit vectors down, where an instrument knows them; None believes the picture about all axes.
    """
    speed = np.linalg.norm(turn, axis=1)
    slow = (speed <= max(float(np.quantile(speed, 0.5)), 1e-3)) & (seen.turn_deviation > 0)
    slow[:1] = False
    if slow.sum() < _SLOW_FRAMES:
        return turn
    against = (turn - seen.turn)[slow]
    if down is None:
        return turn - np.median(against, axis=0)
    # A vector that stands still in the world changes by -w x d: so b x d = w x d + d', and b . d is seen.
    before, after = down[:-1][slow[1:]], down[1:][slow[1:]]
    middle = 0.5 * (before + after)
    rows = [np.stack([_cross(d), np.outer(d, d)]).reshape(6, 3) for d in middle]
    gravity = np.cross(turn[slow], middle) + (after - before)
    about = np.median((against * middle).sum(1)) * middle
    wanted = np.stack([gravity, about], axis=1).reshape(-1)
    return turn - np.linalg.lstsq(np.concatenate(rows), wanted, rcond=None)[0]


def _cross(d: Array) -> Array:
    """``[3, 3]``: times b it is b x d."""
    return np.array([[0.0, d[2], -d[1]], [-d[2], 0.0, d[0]], [d[1], -d[0], 0.0]])


def turns_agree(turn: Array, seen: GroundMotion, fps: float) -> Array:
    """``[T]`` in 0..1: 1 where the picture turns as the gyroscope says, over a second; 0 where it does not.

    A lens that is not the film's turns the picture too fast or too slowly.
    """
    apart, both = (np.square(v).sum(1) for v in (turn - seen.turn, np.concatenate([turn, seen.turn], axis=1)))
    window = _AGREEMENT * fps
    apart, both = (gaussian_filter1d(v, window, mode="nearest") for v in (apart, both))
    return np.clip(1.0 - _STRICT * apart / (both + 2 * (_STILL / fps) ** 2), 0.0, 1.0)


def down_from_turning(turn: Array, pitch_down: float, fps: float) -> Array:
    """Unit vectors down ``[T, 3]`` of a camera that turns ``[T, 3]`` (rad a frame) and has that mean pitch (rad).

    The turns are integrated, and the result returns to the mean tilt at once: people hold their heads so,
    and errors do not add up.
    """
    usual = down_of(pitch_down, 0.0)
    # A constant error of the turns must not tilt the vertical: people do not roll or pitch on and on.
    turn = turn - gaussian_filter1d(turn, _TILT_MEMORY * fps, axis=0, mode="nearest")
    keep = float(np.exp(-1.0 / (_TILT_MEMORY * fps)))
    down, now = np.empty((len(turn), 3)), usual
    for t, one in enumerate(turn):
        now = now - np.cross(one, now)
        now = keep * now + (1 - keep) * usual
        now = now / np.linalg.norm(now)
        down[t] = now
    return down


def pitch_of_film(moved: Array, rays: Array, fps: float) -> float:
    """How far the camera looks below the horizon (rad), from a film in which somebody walks on level ground.

    Whoever walks there neither rises nor sinks. With the pitch too small, walking ahead seems to rise; too large, to
    sink. The pitch is where the mean vertical velocity vanishes.

    Args:
        moved: ``[T, 2, P]`` flow in focal lengths a frame, at ``rays [2, P]``.
        rays: see :func:`egopose.vision.ground_motion.pixel_rays`.
        fps: frames/s.
    """
    chosen = np.unique(np.linspace(1, len(moved) - 1, min(_PITCH_FRAMES, max(len(moved) - 1, 1))).astype(int))
    chosen = chosen[chosen < len(moved)]

    def walk(pitch: float) -> tuple[float, float]:
        """How much walking ahead rises with that pitch, and the mean speed ahead."""
        down = np.broadcast_to(down_of(pitch, 0.0), (len(chosen), 3))
        fit = fit_ground_motion(moved[chosen], rays, down, fps)
        velocity = _in(gravity_axes(down), fit.velocity) * fps
        weight = velocity_quality(fit, fps)
        ahead = velocity[:, 0] * weight
        speed = float(ahead.sum() / max(weight.sum(), 1e-9))
        return float((velocity[:, 2] * ahead).sum() / max((ahead**2).sum(), 1e-12)), speed

    found = {float(pitch): walk(float(pitch)) for pitch in _PITCHES}
    for _ in range(_HALVINGS):
        best = _crossing_of(found)
        if best is None:
            return USUAL_PITCH
        below, above = (max(p for p in found if p <= best), min(p for p in found if p >= best))
        found[0.5 * (below + above)] = walk(0.5 * (below + above))
    best = _crossing_of(found)
    at = np.array(sorted(found))
    if best is None or np.interp(best, at, [found[pitch][1] for pitch in at]) < _WALKS:
        return USUAL_PITCH
    return best


def _crossing_of(found: dict[float, tuple[float, float]]) -> float | None:
    at = np.array(sorted(found))
    return zero_crossing(at, np.array([found[pitch][0] for pitch in at]))


def zero_crossing(at: Array, values: Array) -> float | None:
    """Where ``values`` fall through zero, between two of the places ``at``; the last such place, None without one."""
    falls = np.flatnonzero((values[:-1] > 0) & (values[1:] <= 0))
    if not len(falls):
        return None
    left = int(falls[-1])
    part = values[left] / (values[left] - values[left + 1])
    return float(at[left] + part * (at[left + 1] - at[left]))


def _cells(flow: NDArray[np.floating], field_of_view: float) -> tuple[Array, Array]:
    """Mean flow in cells ``[T, 2, P]`` in focal lengths a frame, and their rays."""
    frames, _, height, width = flow.shape
    step = max(1, width // _CELLS)
    rows, columns = height // step, width // step
    top, left = (height - rows * step) // 2, (width - columns * step) // 2
    cut = np.asarray(flow, dtype=np.float64)[:, :, top : top + rows * step, left : left + columns * step]
    cells = cut.reshape(frames, 2, rows, step, columns, step).mean((3, 5))
    # Where sizes do not divide, whole cells from the middle are kept, and their view is narrower.
    rays, focal = pixel_rays(rows, columns, field_of_view)
    return cells.reshape(frames, 2, -1) / focal, rays * (columns * step / width)


def _in(axes: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("tij,tj->ti", axes, vectors))
